"""Was this calibration applied the right way? A recording that somebody calibrated elsewhere, held against the file.

Two cases. With the raw recording beside it the answer is exact: which map turned one into the other. With the
calibrated recording alone every usual mistake (`verify_mistakes`) is undone in turn, and the node is asked whether the
result makes sense: specific force of the length g and a field of constant length at rests, no rate at rest, one angle
between gravity and field, and turns that carry the rests into one another. A mistake is named only where undoing it
makes sense of what otherwise made none; where a mistake makes no difference that could be seen, that is said.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from margcal.core.errors import DataError, InputError
from margcal.core.types import Array, Calibration, Issue, Kind, Recording, SensorModel, Stream
from margcal.core.units import KINDS, SI_COLUMN, STANDARD_GRAVITY, UNITS
from margcal.workflow.verify_mistakes import Suspect, suspects

Outcome = Literal["right", "mistake", "other", "cannot-tell"]

SAME = 1e-3
"""Relative difference (to the sensed vector's length) up to which two maps are the same for any purpose."""

NOT_A_MAP = 0.05
"""Relative residual of the best affine map above which the recording is no such map of the raw one."""

MOST_ROWS = 5000

RATE = 1.0
"""Rate, rad/s, to which differences of gyroscope readings are relative."""


TYPICAL_FIELD = 48.0
"""uT, where neither file nor settings know the field."""


@dataclass(frozen=True)
class Finding:
    """What can be said of one sensor.

    Attributes
    ----------
    sensor : {'acc', 'gyr', 'mag'}
    outcome : {'right', 'mistake', 'other', 'cannot-tell'}
        'other': it was not applied rightly, but none of the known mistakes explains what was done.
    mistakes : tuple of str
        Their names (see `verify_mistakes.WORDS`; also 'unit', 'axes', 'other-sensor').
    text : str
    residual, mended, limit : float
        Figure of the recording as it is, the same after the mistake is undone, and what a right one stays below
        (`figure` says of what).
    figure : str
        What `residual` is, with its unit.
    unseen : dict of str to float
        Mistakes that would make no visible difference here, and how large their difference would be: relative to
        the sensed vector (gyroscope: to 1 rad/s).
    """

    sensor: Kind
    outcome: Outcome
    mistakes: tuple[str, ...]
    text: str
    residual: float
    mended: float
    limit: float
    figure: str
    unseen: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Verification:
    """Findings by sensor; `how` is 'exact' (with the raw recording) or 'rests'.

    `figures` of the case 'rests': name -> (as recorded, after the mistakes are undone, what a right one stays below).
    """

    how: Literal["exact", "rests"]
    findings: tuple[Finding, ...]
    figures: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    issues: tuple[Issue, ...] = ()

    @property
    def fails(self) -> bool:
        return any(f.outcome in ("mistake", "other") for f in self.findings)


def verify(calibration: Calibration, recording: Recording, raw: Recording | None = None) -> Verification:
    """Whether `recording` is what `calibration` makes of raw readings, and if not, which usual mistake was made.

    Parameters
    ----------
    calibration : Calibration
    recording : Recording
        Calibrated elsewhere with the numbers of `calibration`; in units that have a fixed factor to SI.
    raw : Recording, optional
        The readings that it was made from, in the calibration's raw units.

    Returns
    -------
    Verification

    Raises
    ------
    InputError
        No sensor of the recording is in the calibration, or it is in counts (not calibrated).
    DataError
        Without `raw`: too few rests to say anything.
    """
    streams = _in_si(calibration, recording)
    if raw is not None:
        return _exact(calibration, streams, raw)
    from margcal.workflow.verify_rests import verify_rests

    return verify_rests(calibration, streams, recording)


def _in_si(calibration: Calibration, recording: Recording) -> dict[Kind, Stream]:
    """The calibrated sensors of the recording in the calibration's unit, as far as their columns say it."""
    out: dict[Kind, Stream] = {}
    for kind, stream in recording.streams.items():
        model = calibration.models.get(kind)
        if model is None:
            continue
        wanted = SI_COLUMN[model.unit]
        factor = 1.0 if stream.unit == wanted else UNITS[kind].get(stream.unit)
        if factor is None or (wanted == "norm" and stream.unit != "norm"):
            hint = "; give the calibrated recording, and this one with --raw" if stream.unit == model.raw_unit else ""
            raise InputError(
                f"{recording.source}: {kind} is in {stream.unit}, the calibration gives {model.unit}{hint}"
            )
        seen = np.isfinite(stream.y).all(axis=1)
        if seen.sum() > 1:
            out[kind] = Stream(kind, stream.t[seen], stream.y[seen] * factor, wanted)
    shared = [k for k in recording.streams if k in calibration.models]
    if shared and not out:
        raise InputError(
            f"{recording.source}: {', '.join(shared)} with fewer than two readings; give the whole "
            "recording of the calibrated node"
        )
    if not out:
        raise InputError(
            f"{recording.source}: has readings of {', '.join(recording.streams) or 'no sensor'}, the calibration is of "
            f"{', '.join(calibration.models) or 'no sensor'}; give a recording of the calibrated node"
        )
    return out


def magnitude(calibration: Calibration, kind: Kind) -> float:
    """Length of the sensed vector that errors are relative to."""
    if kind == "gyr":
        return RATE
    model = calibration.models[kind]
    if model.reference_vector is not None:
        return float(np.linalg.norm(model.reference_vector))
    if kind == "acc":
        return float(calibration.settings.get("gravity") or STANDARD_GRAVITY)
    return float(calibration.settings.get("field_uT") or TYPICAL_FIELD) if model.unit == "uT" else 1.0


# --- with the raw recording ---------------------------------------------------------------------------


def _exact(calibration: Calibration, streams: Mapping[Kind, Stream], raw: Recording) -> Verification:
    findings, issues = [], [i for i in raw.issues if i.level != "note"]
    missing = [k for k in KINDS if k in calibration.models and not (k in streams and k in raw.streams)]
    if missing:
        where = {k: "the raw" if k in streams else "the calibrated" for k in missing}
        text = "not verified: " + ", ".join(f"{k} is not in {where[k]} recording" for k in missing)
        issues.append(Issue("not-verified", "warn", text))
    for kind, stream in streams.items():
        model, before = calibration.models[kind], raw.streams.get(kind)
        if before is None:
            continue
        if before.unit != model.raw_unit:
            raise InputError(
                f"{raw.source}: {kind} is in {before.unit}, the calibration takes {model.raw_unit}; give the raw "
                "recording that it was applied to"
            )
        y, v = _paired(stream, before, model)
        if len(v) < 20:
            raise DataError(
                f"{kind}: {len(v)} samples have a raw partner, 20 are needed; give the raw recording of the same time, "
                "on the same clock"
            )
        findings.append(_judge(calibration, kind, y, v))
    if not findings:
        raise InputError(f"{raw.source}: holds none of the sensors {', '.join(streams)}; give the raw recording")
    return Verification("exact", tuple(findings), issues=tuple(issues))


def _paired(stream: Stream, before: Stream, model: SensorModel) -> tuple[Array, Array]:
    """Raw readings and calibrated vectors (n, 3) of the same times; a delay is corrected if that fits better."""
    best: tuple[float, Array, Array] | None = None
    for shift in {0.0, model.delay_s or 0.0}:
        y = _at(before, stream.t + shift)
        rows = np.flatnonzero(np.isfinite(y).all(axis=1))
        rows = rows[:: max(1, len(rows) // MOST_ROWS)]
        pair = y[rows], stream.y[rows]
        left = _affine(*pair)[2] if len(rows) >= 20 else np.inf
        if best is None or left < best[0]:
            best = left, *pair
    assert best is not None
    return best[1], best[2]


def _at(stream: Stream, when: Array) -> Array:
    """Readings at times, linearly between neighbours; NaN beyond the ends and in gaps of five usual steps."""
    seen = np.isfinite(stream.y).all(axis=1)
    t, y = stream.t[seen], stream.y[seen]
    out = np.full((len(when), 3), np.nan)
    if len(t) < 2:
        return out
    near = 1e-3 * float(np.median(np.diff(t)))
    when = np.clip(when, np.where(when >= t[0] - near, t[0], -np.inf), np.where(when <= t[-1] + near, t[-1], np.inf))
    after = np.clip(np.searchsorted(t, when), 1, len(t) - 1)
    inside = (when >= t[0]) & (when <= t[-1]) & (t[after] - t[after - 1] <= 5e3 * near)
    for i in range(3):
        out[inside, i] = np.interp(when[inside], t, y[:, i])
    return out


def _affine(y: Array, v: Array) -> tuple[Array, Array, float]:
    """A, c of the best ``v = A y + c``, and the rms length of what it leaves."""
    middle, spread = y.mean(axis=0), max(float(y.std()), 1e-300)
    design = np.column_stack([(y - middle) / spread, np.ones(len(y))])
    solution, *_ = np.linalg.lstsq(design, v, rcond=1e-10)
    A = np.asarray(solution[:3].T / spread, dtype=np.float64)
    left = float(np.sqrt(np.mean(np.sum((v - design @ solution) ** 2, axis=1))))
    return A, solution[3] - A @ middle, left


def _judge(calibration: Calibration, kind: Kind, y: Array, v: Array) -> Finding:
    """Which map made `v` (n, 3) of `y` (n, 3)."""
    model = calibration.models[kind]
    ways = suspects(calibration.models, kind)
    length = magnitude(calibration, kind)
    with np.errstate(over="ignore"):
        off = [float(np.sqrt(np.mean(np.sum((w.of(y) - v) ** 2, axis=1)))) for w in ways]
    A, c, floor = _affine(y, v)
    spread = float(np.sqrt(np.mean(np.sum((v - v.mean(axis=0)) ** 2, axis=1))))
    # every way leaves what the best affine map leaves (rounding, interpolation), and its own difference from that
    limit = float(np.hypot(floor, max(SAME * length, 0.3 * floor)))
    figure = f"rms difference from H (y - B), {model.unit}"
    fits = [k for k, r in enumerate(off) if r <= limit]
    no_map = floor > max(NOT_A_MAP * spread, SAME * length)
    right = ways[0].of(y)
    if spread < SAME * float(np.sqrt(np.mean(np.sum((right - right.mean(axis=0)) ** 2, axis=1)))):
        # such as zeros: it would pass for numbers of a very small unit
        text = "the recording stands still where the raw one moves: nothing of it is in there"
        return Finding(kind, "other", (), text, off[0], floor, limit, figure)
    if 0 in fits and not no_map:
        unseen = {w.mistakes[0]: _difference(w, ways[0], y) / length for w in (ways[k] for k in fits if k)}
        text = f"u = H (y - B), to {off[0]:.2g} {model.unit}"
        return Finding(kind, "right", (), text, off[0], off[0], limit, figure, unseen)
    if no_map:
        text = (
            f"the recording is no affine map of the raw one (the best leaves {floor:.2g} {model.unit}): it was "
            "filtered, or is on another clock, or of another time"
        )
        return Finding(kind, "cannot-tell", (), text, off[0], floor, limit, figure)
    if fits:
        # of those that fit alike the one with the fewest mistakes, and then the commonest, comes first
        chosen = min(fits, key=lambda k: (len(ways[k].mistakes), off[k] > 2 * min(off) + 1e-9 * length, k))
        return Finding(kind, "mistake", ways[chosen].mistakes, ways[chosen].text, off[0], off[chosen], limit, figure)
    rows = "; ".join(" ".join(f"{x:.6g}" for x in row) for row in A)
    text = (
        f"none of the known mistakes; what was done is v = A y + c with A = [{rows}], "
        f"c = [{' '.join(f'{x:.6g}' for x in c)}]"
    )
    return Finding(kind, "other", (), text, off[0], floor, limit, figure)


def _difference(a: Suspect, b: Suspect, y: Array) -> float:
    return float(np.sqrt(np.mean(np.sum((a.of(y) - b.of(y)) ** 2, axis=1))))
