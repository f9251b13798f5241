"""What can be said of a recording before anything is fitted to it: `lint`.

Every finding is an `Issue`. A `fail` with a sensor means that this sensor cannot be used, a `fail` without one
that the recording cannot be understood (a unit that cannot be, clocks that share no time). What the reader
finds (missing rows, duplicate or backward time, infinite readings, milliseconds) is in `Recording.issues` and
not repeated here. Here: readings that are missing in arrays, stuck, frozen, saturated or coarse, and the
temperature; `lint_clock` looks at time, `lint_units` at what the readings must be in the units they claim.

The limits are those of the project's list of bad inputs (rows 1, 2, 9, 10, 11, 70); where a figure was
measured on real recordings, it says so.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from margcal.core.types import Array, Issue, Recording, Stream
from margcal.workflow.lint_clock import lint_clocks
from margcal.workflow.lint_units import lint_units

Mask = NDArray[np.bool_]

NAMES = {"acc": "accelerometer", "gyr": "gyroscope", "mag": "magnetometer"}

MISSING_LIMIT = 0.05
"""Share of samples that may be missing."""
CLIPPED_LIMIT = 1e-3
"""Share of samples that may stand at the end of the scale: below they are left out, above the range is wrong."""
CLIP_RUN = 3
"""Equal readings in a row at the extreme that make a clipped stretch."""
ABRUPT_LSB = 3.0
"""Steps into and out of a clipped stretch, LSB: the top of a smooth curve that stays level for three samples is
entered and left by less."""
RARE_EQUALS = 0.05
"""Share of equal neighbours up to which they are rare, so that a heap of them at the extreme is clipping."""
CHANCE = 1e-3
"""Chance of a run of equal neighbours up to which it is taken for clipping."""
SIXTEEN_BITS = ((0.0, 65535.0), (-32768.0, 32767.0))
NEAR_END = 0.004
"""Share of a 16-bit scale at either end that is not trusted (converters bend before they clip)."""
STUCK_S, STUCK_SAMPLES = 0.5, 50
"""An axis that stands exactly still this long, in seconds and samples, while the others change, is stuck."""
FROZEN_S, FROZEN_SAMPLES = 0.25, 10
"""The same for all three axes. Measured: radio drop-outs of BROAD 12 repeat up to 14 samples, 50 ms."""
FROZEN_LIMIT = 0.2
COARSE = 0.5
"""Noise over LSB below which rounding is no longer averaged out."""
TEMPERATURE_SPAN = 10.0
_LOOKED_AT = 4096


def lint(recording: Recording) -> tuple[Issue, ...]:
    """Everything that is wrong or doubtful with `recording`, before any fitting.

    Parameters
    ----------
    recording : Recording

    Returns
    -------
    tuple of Issue
        By sensor. Codes: ``nan-rows``, ``infinite``, ``too-short``, ``stuck-sensor``, ``stuck-axis``,
        ``stuck-stretch``, ``frozen-samples``, ``saturated``, ``coarse-quantisation``, ``temperature-span``, and
        those of `lint_clocks` and `lint_units`.
    """
    issues: list[Issue] = []
    for stream in recording.streams.values():
        issues += _lint_stream(stream, recording)
    issues += lint_clocks(recording)
    unusable = {i.sensor for i in issues if i.level == "fail" and i.code in ("stuck-sensor", "stuck-axis", "infinite")}
    issues += lint_units(recording, unusable)
    issues += _lint_temperature(recording)
    return tuple(issues)


@dataclass(frozen=True)
class _View:
    """A stream without missing samples, as the checks want it: three contiguous axes `x` (3, N), whether each
    sample equals the one before `same` (3, N - 1), samples per second, and what messages begin with."""

    stream: Stream
    x: Array
    same: Mask
    rate: float
    where: str

    @property
    def held(self) -> Mask:
        """Samples (N - 1,) of which all axes equal the one before."""
        return self.same[0] & self.same[1] & self.same[2]


def _view(stream: Stream, where: str = "") -> _View:
    x = np.ascontiguousarray(stream.y.T)
    rate = stream.rate if np.isfinite(stream.rate) else 1.0
    return _View(stream, x, x[:, 1:] == x[:, :-1], rate, where)


def _lint_stream(stream: Stream, recording: Recording) -> list[Issue]:
    where = f"{recording.source}: {NAMES[stream.kind]}"
    issues, stream = _lint_missing(stream, where)
    if any(i.code == "infinite" for i in issues):
        return issues
    if len(stream.t) < CLIP_RUN:
        text = f"{where}: {len(stream.t)} readings are too few to say anything; record again"
        return issues or [Issue("too-short", "fail", text, stream.kind, float(len(stream.t)), float(CLIP_RUN))]
    view = _view(stream, where)
    issues += _lint_stuck(view)
    if any(i.code in ("stuck-sensor", "stuck-axis") for i in issues):
        return issues
    coarse = _lint_quantisation(view)
    issues += coarse
    if not coarse:
        issues += _lint_frozen(view)
    return issues + _lint_saturated(view)


# --- missing -----------------------------------------------------------------------------------------


def _lint_missing(stream: Stream, where: str) -> tuple[list[Issue], Stream]:
    """Rows 1 and 2: NaN and infinite readings of arrays; tables have none left. Returns the finite samples."""
    if np.isfinite(stream.y.sum()):
        return [], stream
    finite = np.isfinite(stream.y).all(axis=1)
    kept = Stream(stream.kind, stream.t[finite], stream.y[finite], stream.unit)
    infinite = np.isinf(stream.y).any(axis=1)
    if infinite.any():
        first = int(np.argmax(infinite))
        text = f"{where}: infinite reading in sample {first + 1} (t = {stream.t[first]:.6g} s); take the row out"
        return [Issue("infinite", "fail", text, stream.kind, float(infinite.sum()), 0.0)], kept
    share = 1 - float(finite.mean())
    text = f"{where}: {int((~finite).sum())} of {len(finite)} readings are missing ({100 * share:.2g} %); left out"
    if share > MISSING_LIMIT:
        text += "; record again, or cut to the part that is complete"
    level = "fail" if share > MISSING_LIMIT else "warn"
    return [Issue("nan-rows", level, text, stream.kind, share, MISSING_LIMIT)], kept


# --- stuck and frozen --------------------------------------------------------------------------------


def _lint_stuck(view: _View) -> list[Issue]:
    """Row 10: an axis, or the whole sensor, that shows one value all the time; and long stretches of it."""
    n, kind, where = view.x.shape[1], view.stream.kind, view.where
    dead = view.same.all(axis=1)
    if dead.all():
        text = f"{where}: all {n} readings are the same; the sensor was not read: check the driver, record again"
        return [Issue("stuck-sensor", "fail", text, kind, 0.0, 0.0)]
    if dead.any():
        which = _axes(dead)
        if all(len(np.unique(_thinned(x))) <= 8 for x in view.x[~dead]):
            text = f"{where}: {which} shows one value only, and the others hardly more; too coarse to tell noise"
            return [Issue("coarse-quantisation", "warn", text, kind, 0.0, COARSE)]
        text = (
            f"{where}: {which} shows the same value in all {n} samples while the others change; it is stuck or not "
            "connected: check the driver, record again"
        )
        return [Issue("stuck-axis", "fail", text, kind, 0.0, 0.0)]
    return _lint_stuck_stretches(view)


def _lint_stuck_stretches(view: _View) -> list[Issue]:
    """One axis still for long while another of the same sensor goes on changing: neither noise nor rest."""
    n = max(STUCK_SAMPLES, round(STUCK_S * view.rate))
    issues = []
    for axis, same in enumerate(view.same):
        first, length = _runs(same, n)
        if not len(first):
            continue
        k = int(np.argmax(length))
        inside = np.s_[first[k] : first[k] + length[k]]
        elsewhere = (same.sum() - length[k]) / max(len(same) - length[k], 1)
        others = min(view.same[b, inside].mean() for b in range(3) if b != axis)
        if others > 0.5 or elsewhere > 0.5:
            continue  # all axes stand still, or this one is always so coarse
        share = float(length[k] + 1) / view.x.shape[1]
        text = (
            f"{view.where}: {'xyz'[axis]} shows one value for {length[k] + 1} samples from t = "
            f"{view.stream.t[first[k]]:.4g} s on, while another axis goes on changing; cut that part off, or record "
            "again"
        )
        level = "fail" if share > FROZEN_LIMIT else "warn"
        issues.append(Issue("stuck-stretch", level, text, view.stream.kind, share, FROZEN_LIMIT))
    return issues


def _lint_frozen(view: _View) -> list[Issue]:
    """Stretches in which all axes repeat: a link that hung. A noiseless rest, entered gently, is none."""
    first, length = _runs(view.held, max(FROZEN_SAMPLES, round(FROZEN_S * view.rate)))
    hung = [i for i in range(len(first)) if _broke_off(view.x, int(first[i]), int(first[i] + length[i]))]
    if not hung:
        return []
    first, length = first[hung], length[hung]
    share = float(length.sum()) / view.x.shape[1]
    longest = int(np.argmax(length))
    stretches = f"{len(hung)} stretch{'es' if len(hung) > 1 else ''}"
    text = (
        f"{view.where}: {stretches} in which all axes repeat one reading ({100 * share:.2g} % of the samples), the "
        f"longest {length[longest] / view.rate:.2g} s at t = {view.stream.t[first[longest]]:.4g} s: the connection or "
        "the logger hung; record again if turns fall into them"
    )
    level = "fail" if share > FROZEN_LIMIT else "warn"
    return [Issue("frozen-samples", level, text, view.stream.kind, share, FROZEN_LIMIT)]


def _broke_off(x: Array, first: int, last: int) -> bool:
    """Whether samples first..last repeat a reading out of a signal that was changing at its usual pace."""
    before = np.abs(np.diff(x[:, max(first - 6, 0) : first + 1])).sum(axis=0)
    after = np.abs(np.diff(x[:, last : last + 7])).sum(axis=0)[::-1]
    return any(len(step) > 2 and step[-1] >= 0.5 * np.median(step[:-1]) for step in (before, after))


# --- saturation --------------------------------------------------------------------------------------


def clip_limits(stream: Stream) -> tuple[Array, Array]:
    """Lowest and highest reading (3,) by axis at which the stream clips, raw unit; infinite where it does not.

    An axis clips where three or more readings in a row stand at its extreme and the signal went in and out of
    them abruptly, or, where equal neighbours are rare, more often than at the next value inside. Counts of 16
    bits also clip within .4 % of the ends of their scale. Samples of which all axes repeat are one reading that
    was held: streams that were filled up to a higher rate do not clip at every peak.

    Returns
    -------
    low, high : ndarray (3,)
        Readings at or beyond them are not to be fitted.
    """
    y = stream.y
    if not np.isfinite(y.sum()):
        finite = np.isfinite(y).all(axis=1)
        stream = Stream(stream.kind, stream.t[finite], y[finite], stream.unit)
    return _clip_limits(_view(stream))


def _clip_limits(view: _View) -> tuple[Array, Array]:
    low, high = np.full(3, -np.inf), np.full(3, np.inf)
    if view.x.shape[1] < CLIP_RUN + 2:
        return low, high
    bottom, top = view.x.min(axis=1), view.x.max(axis=1)
    for axis in range(3):
        if bottom[axis] < top[axis]:
            if _clips_at(view, axis, bottom[axis]):
                low[axis] = bottom[axis]
            if _clips_at(view, axis, top[axis]):
                high[axis] = top[axis]
    if view.stream.unit == "count":
        _limit_to_scale(bottom, top, low, high)
    return low, high


def _limit_to_scale(bottom: Array, top: Array, low: Array, high: Array) -> None:
    """Take the ends of a 16-bit scale out where readings come near them."""
    for start, end in SIXTEEN_BITS:
        margin = NEAR_END * (end - start)
        if bottom.min() < start or top.max() > end:
            continue
        if start == 0.0 and top.max() < 0.75 * end:
            continue  # small positive counts are no sign of an unsigned scale
        low[bottom <= start + margin] = start + margin
        high[top >= end - margin] = end - margin
        return


def _clips_at(view: _View, axis: int, extreme: float) -> bool:
    """Whether runs of the axis at its lowest or highest reading are clipping and no chance."""
    if np.count_nonzero(view.x[axis] == extreme) < CLIP_RUN:
        return False
    x = view.x[axis][np.concatenate([[True], ~view.held])]
    at = x == extreme
    first, length = _runs(at[1:] & at[:-1], CLIP_RUN - 1)
    if not len(first):
        return False
    equal = float(np.count_nonzero((x[1:] == x[:-1]) & ~at[1:])) / max(float(np.count_nonzero(~at)), 1.0)
    last = first + length
    into = np.abs(x[np.maximum(first - 1, 0)] - extreme)
    out = np.abs(x[np.minimum(last + 1, len(x) - 1)] - extreme)
    lsb = quantum(x)
    abrupt = (into >= ABRUPT_LSB * lsb) & (out >= ABRUPT_LSB * lsb)
    if np.any(abrupt & (np.maximum(equal, 1e-9) ** length < CHANCE)):
        return True
    inside = x[~at]
    beside = inside.min() if inside[0] > extreme else inside.max()
    return equal < RARE_EQUALS and bool(at.sum() >= 5 * np.count_nonzero(x == beside))


def clipped(y: Array, stream: Stream, limits: tuple[Array, Array] | None = None) -> Mask:
    """Mask (N,) of the readings `y` (N, 3) that stand at the end of the stream's scale on some axis.

    `limits` are the stream's `clip_limits`, for callers that ask for many pieces of one stream.
    """
    low, high = clip_limits(stream) if limits is None else limits
    if np.isinf(low).all() and np.isinf(high).all():
        return np.zeros(len(y), dtype=bool)
    return ((y <= low) | (y >= high)).any(axis=1)


def _lint_saturated(view: _View) -> list[Issue]:
    """Row 9."""
    low, high = _clip_limits(view)
    if np.isinf(low).all() and np.isinf(high).all():
        return []
    by_axis = (view.x <= low[:, None]) | (view.x >= high[:, None])
    at = by_axis.any(axis=0)
    share = float(at.mean())
    ends = ", ".join(f"{v:.6g}" for v in np.unique(np.concatenate([low, high])) if np.isfinite(v))
    text = (
        f"{view.where}: {_axes(by_axis.any(axis=1))} at the end of the scale ({ends} {view.stream.unit}) in "
        f"{int(at.sum())} of {len(at)} samples ({100 * share:.2g} %), first at t = "
        f"{view.stream.t[int(np.argmax(at))]:.4g} s"
    )
    kind = view.stream.kind
    if share < CLIPPED_LIMIT:
        return [Issue("saturated", "warn", f"{text}; they are left out", kind, share, CLIPPED_LIMIT)]
    mend = {
        "acc": "put the node down more gently, or choose a wider range",
        "gyr": "turn the node more slowly, or choose a wider range",
        "mag": "keep magnets and iron away, or choose a wider range",
    }[kind]
    return [Issue("saturated", "fail", f"{text}; {mend}, and record again", kind, share, CLIPPED_LIMIT)]


# --- quantisation ------------------------------------------------------------------------------------


def quantum(x: Array) -> float:
    """Least significant bit of one axis: the smallest step between neighbouring values (0: one value only)."""
    values = np.unique(_thinned(x))
    steps = np.diff(values)
    steps = steps[steps > 1e-6 * (values[-1] - values[0])] if len(steps) else steps
    return float(steps.min()) if len(steps) else 0.0


def _lint_quantisation(view: _View) -> list[Issue]:
    """Row 11: rest that shows no noise because the steps are coarser than it."""
    noise = _rest_noise(view)
    if noise is None:
        return []
    lsb = np.array([quantum(x) for x in view.x])
    ratio = noise / np.where(lsb > 0, lsb, np.inf)
    coarse = (ratio < COARSE) & _on_grid(view.x, lsb)
    if not coarse.any():
        return []
    worst = int(np.argmin(np.where(coarse, ratio, np.inf)))
    unit = view.stream.unit
    text = (
        f"{view.where}: {_axes(coarse)}: a step of the readings ({lsb[worst]:.3g} {unit}) is coarser than the noise at "
        f"rest ({noise[worst]:.2g}); means of rests are no better than {lsb[worst] / np.sqrt(12):.2g} {unit}: choose "
        "a narrower range or more bits"
    )
    return [Issue("coarse-quantisation", "warn", text, view.stream.kind, float(ratio[worst]), COARSE)]


def _on_grid(x: Array, lsb: Array) -> Mask:
    """Whether all readings of an axis are whole numbers of steps apart."""
    some = x[:, :: max(1, x.shape[1] // _LOOKED_AT)]
    steps = (some - some[:, :1]) / np.where(lsb > 0, lsb, 1.0)[:, None]
    return np.abs(steps - np.round(steps)).max(axis=1) < 0.1


def _rest_noise(view: _View) -> Array | None:
    """Median scatter (3,) in the quietest fifth of quarter-second blocks; None where there are too few."""
    size = max(8, round(0.25 * view.rate))
    n = view.x.shape[1] // size
    if n < 4:
        return None
    sd = view.x[:, : n * size].reshape(3, n, size).std(axis=2)
    total = sd.sum(axis=0)
    return np.median(sd[:, total <= np.quantile(total, 0.2)], axis=1)


# --- temperature -------------------------------------------------------------------------------------


def _lint_temperature(recording: Recording) -> list[Issue]:
    """Row 70."""
    if recording.temperature is None or len(recording.temperature[1]) < 2:
        return []
    low, high = np.nanquantile(recording.temperature[1], (0.005, 0.995))
    if not high - low > TEMPERATURE_SPAN:
        return []
    text = (
        f"{recording.source}: the temperature runs from {low:.1f} to {high:.1f} degC; biases drift with it: let the "
        "node warm up first, and record at one temperature"
    )
    return [Issue("temperature-span", "warn", text, None, float(high - low), TEMPERATURE_SPAN)]


# --- small tools -------------------------------------------------------------------------------------


def _thinned(x: Array) -> Array:
    return x[:: max(1, len(x) // _LOOKED_AT)]


def _runs(mask: Mask, shortest: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First index and length of every run of True that is at least `shortest` long."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    first, length = edges[::2], edges[1::2] - edges[::2]
    long = length >= shortest
    return first[long], length[long]


def _axes(mask: Mask) -> str:
    names = ["xyz"[k] for k in np.flatnonzero(mask)]
    return " and ".join(names) if len(names) < 3 else "x, y and z"
