"""What a place on earth gives: gravity, and the magnetic field on a date. Offline.

Gravity is the normal gravity of WGS 84 (the closed formula of Somigliana) at the height given; what the rock
below adds is left out, at most about .001 m/s^2. The field is the World Magnetic Model's (pygeomag).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import date as Date

import numpy as np

from margcal.core.errors import InputError, UsageError
from margcal.core.types import Array, Issue

MODEL_YEARS = (2025.0, 2030.0)
"""The decimal years that the World Magnetic Model shipped with pygeomag is made for (WMM2025)."""

HEIGHTS_M = (-1000.0, 100_000.0)

# WGS 84: equatorial radius, flattening, gravity at the equator, Somigliana's constant, first eccentricity
# squared, and m = omega^2 a^2 b / GM
_A, _F, _G_EQUATOR, _K = 6378137.0, 1 / 298.257223563, 9.7803253359, 0.00193185265241
_E2, _M = 0.00669437999013, 0.00344978650684


@dataclass(frozen=True)
class LocalField:
    """The earth's magnetic field at a place and date.

    Attributes
    ----------
    vector : ndarray (3,), uT
        In n (ENU whose y points to magnetic north): ``(0, horizontal, -down)``.
    total_uT, horizontal_uT : float, uT
    dip_deg : float, deg, positive where the field points down
    declination_deg : float, deg, magnetic north east of true north
    total_se_uT, dip_se_deg, declination_se_deg : float
        Standard errors that the model's makers state (of the model and of the rock below).
    year : float, decimal year
    issues : tuple of Issue
        Near a magnetic pole.
    """

    vector: Array
    total_uT: float
    horizontal_uT: float
    dip_deg: float
    declination_deg: float
    total_se_uT: float
    dip_se_deg: float
    declination_se_deg: float
    year: float
    issues: tuple[Issue, ...] = ()


@dataclass(frozen=True)
class Place:
    """A place on earth at a date: `gravity` in m/s^2 and its magnetic `field`."""

    latitude_deg: float
    longitude_deg: float
    height_m: float
    gravity: float
    field: LocalField

    @property
    def issues(self) -> tuple[Issue, ...]:
        return self.field.issues


def gravity(latitude_deg: float, height_m: float = 0.0) -> float:
    """Normal gravity of WGS 84, m/s^2.

    Parameters
    ----------
    latitude_deg : float, deg, geodetic
    height_m : float, m above the ellipsoid

    Raises
    ------
    InputError
        If latitude or height is out of range.

    References
    ----------
    NGA.STND.0036 (WGS 84), section 4: Somigliana's closed formula, and its second-order series in height.
    """
    _in_range("latitude", latitude_deg, -90, 90)
    _in_range("height", height_m, *HEIGHTS_M, unit="m")
    s2 = math.sin(math.radians(latitude_deg)) ** 2
    on_ellipsoid = _G_EQUATOR * (1 + _K * s2) / math.sqrt(1 - _E2 * s2)
    h = height_m / _A
    return on_ellipsoid * (1 - 2 * (1 + _F + _M - 2 * _F * s2) * h + 3 * h * h)


def field(
    latitude_deg: float,
    longitude_deg: float,
    date: Date | float | str | None = None,
    height_m: float = 0.0,
) -> LocalField:
    """The earth's magnetic field by the World Magnetic Model.

    Parameters
    ----------
    latitude_deg, longitude_deg : float, deg, geodetic, east positive
    date : datetime.date, decimal year, str ``YYYY-MM-DD`` or None
        None: today.
    height_m : float, m

    Raises
    ------
    InputError
        If the place is not on earth, or the date is not in the years of the model.
    """
    from pygeomag import GeoMag

    _in_range("latitude", latitude_deg, -90, 90)
    _in_range("longitude", longitude_deg, -180, 180)
    _in_range("height", height_m, *HEIGHTS_M, unit="m")
    year = decimal_year(date)
    if not MODEL_YEARS[0] <= year <= MODEL_YEARS[1]:
        raise InputError(
            f"the date {year:.2f} is outside the World Magnetic Model, which holds from {MODEL_YEARS[0]:.0f} "
            f"to {MODEL_YEARS[1]:.0f}; give a date within, or the field's strength itself (--field)"
        )
    found = GeoMag().calculate(latitude_deg, longitude_deg, height_m / 1000, year)
    error = found.calculate_uncertainty()
    return LocalField(
        vector=_read_only([0.0, found.h / 1000, -found.z / 1000]),
        total_uT=found.f / 1000,
        horizontal_uT=found.h / 1000,
        dip_deg=found.i,
        declination_deg=found.d,
        total_se_uT=error.f / 1000,
        dip_se_deg=error.i,
        declination_se_deg=error.d,
        year=year,
        issues=_near_pole(found.h / 1000, found.in_blackout_zone, found.in_caution_zone),
    )


def at(
    latitude_deg: float,
    longitude_deg: float,
    date: Date | float | str | None = None,
    height_m: float = 0.0,
) -> Place:
    """Gravity and field of a place; parameters and errors are those of `field`."""
    local = field(latitude_deg, longitude_deg, date, height_m)
    return Place(latitude_deg, longitude_deg, height_m, gravity(latitude_deg, height_m), local)


def parse_at(text: str) -> Place:
    """The place that ``LAT,LON[,DATE]`` names, as on the command line.

    Parameters
    ----------
    text : str
        Degrees, north and east positive; the date as ``YYYY-MM-DD`` or decimal year, today if left out.

    Raises
    ------
    UsageError
        If the text is not of that form, or there is no such latitude, longitude or day.
    InputError
        If the date is not in the years of the magnetic model.
    """
    parts = [part.strip() for part in text.split(",")]
    if len(parts) not in (2, 3):
        raise UsageError(f"--at {text!r}: expected LAT,LON or LAT,LON,DATE, such as 51.5,-0.12,2026-06-01")
    try:
        latitude, longitude = float(parts[0]), float(parts[1])
    except ValueError:
        raise UsageError(f"--at {text!r}: latitude and longitude are degrees as numbers, such as 51.5,-0.12") from None
    try:
        _in_range("latitude", latitude, -90, 90)
        _in_range("longitude", longitude, -180, 180)
        year = decimal_year(parts[2] if len(parts) == 3 else None)
    except InputError as error:
        raise UsageError(f"--at {text!r}: {error}") from None
    return at(latitude, longitude, year)


def decimal_year(date: Date | float | str | None) -> float:
    """`date` as a decimal year; None is today.

    Raises
    ------
    InputError
        If it is neither a date ``YYYY-MM-DD`` nor a number.
    """
    if date is None:
        date = Date.today()
    if isinstance(date, str):
        date = _parsed_date(date)
    if isinstance(date, Date):
        first, following = Date(date.year, 1, 1), Date(date.year + 1, 1, 1)
        return date.year + (date.toordinal() - first.toordinal()) / (following - first).days
    if not math.isfinite(date):
        raise InputError(f"the date {date} is not a number")
    return float(date)


def _parsed_date(text: str) -> Date | float:
    try:
        return float(text)
    except ValueError:
        pass
    try:
        return Date.fromisoformat(text)
    except ValueError:
        raise InputError(f"the date {text!r} is neither YYYY-MM-DD nor a decimal year") from None


def _in_range(name: str, value: float, low: float, high: float, unit: str = "degrees") -> None:
    if not low <= value <= high:  # not true of NaN either
        raise InputError(f"{name} {value:g} is not between {low:g} and {high:g} {unit}")


def _near_pole(horizontal_uT: float, blackout: bool, caution: bool) -> tuple[Issue, ...]:
    """The model's own zones: the horizontal field below 2 uT (blackout) or 6 uT (caution)."""
    if not (blackout or caution):
        return ()
    trust = "not to be relied on" if blackout else "weak"
    text = (
        f"near a magnetic pole: the horizontal field is {horizontal_uT:.1f} uT only, so magnetic north is "
        f"{trust} here; the calibration does not need it, a heading does"
    )
    return (
        Issue(
            "near-magnetic-pole",
            "warn" if blackout else "note",
            text,
            "mag",
            horizontal_uT,
            2.0 if blackout else 6.0,
        ),
    )


def _read_only(values: list[float]) -> Array:
    array = np.array(values, dtype=np.float64)
    array.flags.writeable = False
    return array
