"""The meaning of column names: `t_s`, `acc_x_count`, `temp_degC`, `ref_qw`, `ref_p_x_m` (conventions, Recordings)."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from margcal.core.checking import printable
from margcal.core.errors import InputError
from margcal.core.types import Issue, Kind
from margcal.core.units import KINDS, UNITS

_SENSOR = re.compile(r"(acc|gyr|mag)_([xyz])(?:_([a-z0-9]+))?", re.IGNORECASE)
_POSITION = re.compile(r"ref_p_([xyz])_(m|mm)", re.IGNORECASE)
_SPELLING = {kind: {unit.lower(): unit for unit in UNITS[kind]} for kind in KINDS}


@dataclass(frozen=True)
class SensorColumns:
    """The three columns (numbers in the table, x y z) of one sensor, its unit, and whether that was declared."""

    kind: Kind
    unit: str
    index: tuple[int, int, int]
    relabelled: str | None = None


@dataclass(frozen=True)
class Columns:
    """What the columns of one table mean, as column numbers; `other` are those without a meaning here."""

    names: tuple[str, ...]
    t: int | None
    sensors: Mapping[Kind, SensorColumns]
    temperature: int | None = None
    q: tuple[int, ...] | None = None
    p: tuple[int, ...] | None = None
    p_factor: float = 1.0
    other: tuple[int, ...] = ()
    issues: tuple[Issue, ...] = field(default=())

    @property
    def empty(self) -> bool:
        """Whether the table holds neither a sensor nor a reference."""
        return not self.sensors and self.q is None


def find_columns(names: Sequence[str], units: Mapping[str, str] | None, file: str) -> Columns:
    """What the columns `names` of `file` mean.

    Parameters
    ----------
    names : sequence of str
    units : mapping of sensor kind to unit, optional
        Units declared by the user (``--units``), for columns without one, or against the one in their name.

    Raises
    ------
    InputError
        Duplicate names; a sensor that lacks an axis or a unit, mixes units or has an unknown one; a reference
        that lacks a component.
    """
    check_units(units)
    lower = [n.lower() for n in names]
    keys = [n if n.startswith(("t_s", "temp_", "acc_", "gyr_", "mag_", "ref_")) else e for n, e in zip(lower, names)]
    for name, count in Counter(k for k in keys if k).items():
        if count > 1:
            places = ", ".join(str(k + 1) for k, n in enumerate(keys) if n == name)
            raise InputError(f"{file}: column name {printable(name)!r} is there twice (columns {places}); rename one")
    place = {n: k for k, n in enumerate(lower)}
    sensors: dict[Kind, SensorColumns] = {}
    for kind in KINDS:
        if (found := _find_sensor(kind, names, (units or {}).get(kind), file)) is not None:
            sensors[kind] = found
    q = _all_or_none([f"ref_q{c}" for c in "wxyz"], place, file)
    p, factor = _find_position(names, file)
    t, temperature = place.get("t_s"), place.get("temp_degc")
    used = {t, temperature, *(q or ()), *(p or ()), *(k for s in sensors.values() for k in s.index)}
    other = tuple(k for k in range(len(names)) if k not in used)
    issues = tuple(
        Issue(
            "unit-relabelled",
            "warn",
            f"{file}: {s.kind} columns are named {printable(s.relabelled)} and were taken as {s.unit}, as declared",
            sensor=s.kind,
        )
        for s in sensors.values()
        if s.relabelled
    )
    return Columns(tuple(names), t, sensors, temperature, q, p, factor, other, issues)


def check_units(units: Mapping[str, str] | None) -> None:
    """Refuse declared units that no sensor can be in."""
    for kind, unit in (units or {}).items():
        if kind not in UNITS:
            raise InputError(f"units: {printable(kind)!r} is no sensor; use {', '.join(KINDS)}")
        if unit not in UNITS[kind]:
            raise InputError(f"units: {kind} cannot be in {printable(unit)!r}; use one of {', '.join(UNITS[kind])}")


def _find_sensor(kind: Kind, names: Sequence[str], declared: str | None, file: str) -> SensorColumns | None:
    sets: dict[str | None, dict[str, int]] = {}
    for k, name in enumerate(names):
        match = _SENSOR.fullmatch(name)
        if match and match[1].lower() == kind:
            unit = match[3] and _SPELLING[kind].get(match[3].lower(), match[3])
            sets.setdefault(unit, {})[match[2].lower()] = k
    if not sets:
        return None
    named = _choose_set(kind, sets, declared, file)
    axes = sets[named]
    missing = [a for a in "xyz" if a not in axes]
    if missing:
        have = ", ".join(printable(names[k]) for k in axes.values())
        lacking = " and ".join(f"{kind}_{a}" + (f"_{named}" if named else "") for a in missing)
        raise InputError(f"{file}: {kind} has {have} but no {lacking}; a sensor needs x, y and z in one unit")
    unit = declared or named or ""
    relabelled = named if named is not None and named != unit else None
    return SensorColumns(kind, unit, (axes["x"], axes["y"], axes["z"]), relabelled)


def _choose_set(
    kind: Kind, sets: Mapping[str | None, Mapping[str, int]], declared: str | None, file: str
) -> str | None:
    """Which of a sensor's column sets to take, by the unit in the names."""
    known = [u for u in sets if u in UNITS[kind]]
    if len(known) > 1:  # stray columns beside one whole sensor do not make it doubtful
        known = [u for u in known if len(sets[u]) == 3] or known
    if declared is not None:
        if declared in sets:
            return declared
        if None in sets:
            return None
        if len(sets) == 1:
            return next(iter(sets))
    elif len(known) == 1:
        return known[0]
    if len(known) > 1:
        raise InputError(
            f"{file}: {kind} is there in {' and '.join(map(str, known))}; say which to take, such as "
            f"--units {kind}={known[0]}"
        )
    if None in sets:
        raise InputError(
            f"{file}: columns {kind}_x {kind}_y {kind}_z name no unit; give --units {kind}=UNIT with one of "
            f"{', '.join(UNITS[kind])}"
        )
    wrong = ", ".join(printable(u) for u in sets)
    raise InputError(
        f"{file}: {kind} cannot be in {wrong!r}; name its columns {kind}_x_UNIT with one of "
        f"{', '.join(UNITS[kind])}, or give --units {kind}=UNIT"
    )


def _all_or_none(wanted: list[str], place: Mapping[str, int], file: str) -> tuple[int, ...] | None:
    have = [n for n in wanted if n in place]
    if not have:
        return None
    if len(have) < len(wanted):
        missing = ", ".join(n for n in wanted if n not in place)
        raise InputError(f"{file}: the reference has {', '.join(have)} but no {missing}; all four are needed")
    return tuple(place[n] for n in wanted)


def _find_position(names: Sequence[str], file: str) -> tuple[tuple[int, ...] | None, float]:
    axes: dict[str, int] = {}
    units = set()
    for k, name in enumerate(names):
        if match := _POSITION.fullmatch(name):
            axes[match[1].lower()] = k
            units.add(match[2].lower())
    if not axes:
        return None, 1.0
    if len(units) > 1 or len(axes) < 3:
        raise InputError(f"{file}: the reference position needs ref_p_x, ref_p_y and ref_p_z in one unit (m or mm)")
    return (axes["x"], axes["y"], axes["z"]), 1.0 if units == {"m"} else 1e-3
