"""A sensor's H and B in the units of another program."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from margcal.core.errors import DataError, UsageError
from margcal.core.types import Array, Calibration, SensorModel
from margcal.core.units import SI_COLUMN, STANDARD_GRAVITY, UNITS, Kind
from margcal.files.exchange.target import Form

FIELD_UT = 50.0
"""Strength of the field where nothing says it, for the weight of the bias in the direction error only."""

RATE = math.radians(100.0)
"""Turn rate of the gyroscope's test vectors, rad/s."""


@dataclass(frozen=True)
class Converted:
    """A sensor in the units of a target: ``u = H (y - B)``; `magnitude` of the sensed vector, `unit`."""

    H: Array
    B: Array
    raw_unit: str
    unit: str
    magnitude: float


def converted(
    calibration: Calibration,
    kind: Kind,
    form: Form,
    name: str,
    scale: Mapping[str, float] | None = None,
    field_uT: float | None = None,
) -> Converted:
    """The sensor `kind` in the units that `form` takes and gives.

    With ``y' = y f / f'`` (f: SI units a raw unit) and ``u' = u g / g'``, ``H' = H g f' / (g' f)``, ``B' = B f / f'``.
    """
    model = calibration.models[kind]
    raw, per_raw = _raw_unit(model, form, name, scale)
    out, per_out = _unit(calibration, model, form, name, field_uT)
    H, B = model.H * (per_raw * per_out), model.B / per_raw
    magnitude = _magnitude(calibration, model, field_uT) * per_out
    if form.nominal:  # only directions are known: the size of H is the driver's affair
        size = float(np.cbrt(abs(np.linalg.det(H))))
        H, magnitude = H / size, magnitude / size
    return Converted(H, B, raw, out, magnitude)


def _raw_unit(model: SensorModel, form: Form, name: str, scale: Mapping[str, float] | None) -> tuple[str, float]:
    """The raw unit that the target takes, and how many of the calibration's raw units it is."""
    kind, have = model.kind, model.raw_unit
    if not form.raw or have in form.raw:
        return have, 1.0
    want = form.raw[0]
    if want == "count":
        raise DataError(f"{name} takes raw counts; {kind} was calibrated from readings in {have}")
    known, told = UNITS[kind].get(have), (scale or {}).get(kind)
    if known is not None and told is not None:
        raise UsageError(f"--scale {kind} is for raw counts; the calibration is for {have}, whose scale is known")
    si = told or known
    if si is None:
        named = {"mps2": "m/s^2", "radps": "rad/s", "g": "g"}.get(want, want)
        si_name = {"acc": "m/s^2", "gyr": "rad/s", "mag": "uT"}[kind]
        raise DataError(
            f"{name} takes {kind} readings in {named}, and the calibration is for raw {have}: say what its driver "
            f"makes of a {have}, --scale {kind}=... ({si_name} a {have}, from the data sheet)"
        )
    factor = UNITS[kind][want]
    return want, (1.0 if factor is None else factor) / si


def _unit(
    calibration: Calibration, model: SensorModel, form: Form, name: str, field_uT: float | None
) -> tuple[str, float]:
    """The unit that the target gives, and how many of it one of the calibration's is."""
    have = SI_COLUMN[model.unit]
    if form.nominal or not form.unit or form.unit == have:
        return form.unit or have, 1.0
    if have == "norm":
        field = field_strength(calibration, field_uT)
        if field is None:
            raise DataError(
                f"{name} wants the magnetometer in {form.unit}, and the calibration is in units of the local field: "
                "give its strength, --field uT"
            )
        return form.unit, field / (UNITS["mag"][form.unit] or 1.0)
    return form.unit, 1.0 / (UNITS[model.kind][form.unit] or 1.0)


def field_strength(calibration: Calibration, field_uT: float | None) -> float | None:
    """Strength of the field in uT, if anything says it."""
    if field_uT:
        return field_uT
    mag = calibration.mag
    if mag is not None and mag.unit == "uT" and mag.reference_vector is not None:
        return float(np.linalg.norm(mag.reference_vector))
    told = calibration.settings.get("field_uT")
    return float(told) if isinstance(told, (int, float)) and told > 0 else None


def _magnitude(calibration: Calibration, model: SensorModel, field_uT: float | None) -> float:
    """Size of the sensed vector in the calibration's unit; of the gyroscope's a rate for its test vectors."""
    if model.kind == "gyr":
        return RATE
    if model.reference_vector is not None and np.any(model.reference_vector):
        return float(np.linalg.norm(model.reference_vector))
    if model.kind == "acc":
        return STANDARD_GRAVITY
    return 1.0 if model.unit == "norm" else field_strength(calibration, field_uT) or FIELD_UT
