"""A sensor's scale: readings at its end (row 9), and steps that are coarser than the noise (row 11).

Here too: `View`, a stream as the checks of readings want it, and small tools that they share.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from margcal.core.types import Array, Issue, Mask, Stream

CLIPPED_LIMIT = 1e-3
"""Share of samples that may stand at the end of the scale: below they are left out, above the range is wrong."""
CLIP_RUN = 3
"""Equal readings in a row at the extreme that make a clipped stretch."""
ABRUPT_LSB = 3.0
"""Steps into and out of a clipped stretch, LSB: the top of a smooth curve that stays level for three samples is
entered and left by less."""
ABRUPT_NOISE = 12.0
"""The same in noise (sd): steps that large in and out of a level stretch are motion that was cut off. The top of a fast
turn is entered by up to 6, which with luck in the noise looks level (once in 1800 extremes at 6, never seen at 12)."""
LARGE_STEP = 6.0
"""Steps (sd of the noise) that are motion."""
HEAP, HEAP_LEAST = 5.0, 10
"""Readings at the extreme over those at a value next to it, and how many make a heap."""
CHANCE, CHANCE_CUT_OFF = 1e-6, 1e-3
"""Chance of a run of equal neighbours up to which it is taken for clipping: by noise (a recording has eighteen
extremes, and few recordings in 10 000 may give a false alarm), and between steps of motion."""
SIXTEEN_BITS = ((0.0, 65535.0), (-32768.0, 32767.0))
NEAR_END = 0.004
"""Share of a 16-bit scale at either end that is not trusted (converters bend before they clip)."""
COARSE = 0.5
"""Noise over LSB below which rounding is no longer averaged out."""
_LOOKED_AT = 2048


@dataclass(frozen=True)
class View:
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


def view_of(stream: Stream, where: str = "") -> View:
    x = np.ascontiguousarray(stream.y.T)
    rate = stream.rate if np.isfinite(stream.rate) else 1.0
    return View(stream, x, x[:, 1:] == x[:, :-1], rate, where)


# --- saturation --------------------------------------------------------------------------------------


def clip_limits(stream: Stream) -> tuple[Array, Array]:
    """Lowest and highest reading (3,) by axis at which the stream clips, raw unit; infinite where it does not.

    An axis clips where three or more readings in a row stand at its extreme, the signal went in and out of
    them abruptly, and noise of the recording's size would hardly ever repeat itself so often; or where they are
    heaped at the extreme and equal neighbours are rare elsewhere. Counts of 16
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
    return _clip_limits(view_of(stream))


def _clip_limits(view: View) -> tuple[Array, Array]:
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


def _clips_at(view: View, axis: int, extreme: float) -> bool:
    """Whether runs of the axis at its lowest or highest reading are clipping and no chance."""
    if np.count_nonzero(view.x[axis] == extreme) < CLIP_RUN:
        return False
    x = view.x[axis][np.concatenate([[True], ~view.held])]
    at = x == extreme
    first, length = runs(at[1:] & at[:-1], CLIP_RUN - 1)
    if not len(first):
        return False
    lsb = quantum(x)
    noise = max(_fast_noise(x), lsb)
    last = first + length
    step = np.abs(np.stack([x[np.maximum(first - 1, 0)], x[np.minimum(last + 1, len(x) - 1)]]) - extreme).min(axis=0)
    equal = np.count_nonzero((x[1:] == x[:-1]) & ~at[1:]) / max(np.count_nonzero(~at), 1)
    by_noise = 0.28 * lsb / noise  # two equal neighbours, normal noise of many steps
    unlikely = max(equal, by_noise, 1e-9) ** length < CHANCE
    cut_off = (step >= ABRUPT_NOISE * noise) & (_equal_in_motion(x, at, noise) ** length < CHANCE_CUT_OFF)
    if np.any((step >= ABRUPT_LSB * lsb) & (unlikely | cut_off)):
        return True
    near = np.count_nonzero(np.abs(x[~at] - extreme) <= 10.5 * lsb) / 10
    return bool(equal < 0.05 and np.count_nonzero(at) >= max(HEAP_LEAST, HEAP * near))


def _equal_in_motion(x: Array, at: Mask, noise: float) -> float:
    """Share of equal neighbours beside steps of motion: high only where samples were held or filled in."""
    step = np.diff(x)
    large = np.abs(step) >= LARGE_STEP * noise
    beside = (large[:-2] | large[2:]) & ~at[1:-2]
    return float(np.count_nonzero(beside & (step[1:-1] == 0))) / max(float(np.count_nonzero(beside)), 1.0)


def _fast_noise(x: Array) -> float:
    """Noise of an axis from its second differences, in which slow motion vanishes."""
    some = x[: 20 * _LOOKED_AT]
    return float(np.median(np.abs(some[:-2] - 2 * some[1:-1] + some[2:]))) / (0.6745 * np.sqrt(6.0))


def clipped(y: Array, stream: Stream, limits: tuple[Array, Array] | None = None) -> Mask:
    """Mask (N,) of the readings `y` (N, 3) that stand at the end of the stream's scale on some axis.

    `limits` are the stream's `clip_limits`, for callers that ask for many pieces of one stream.
    """
    low, high = clip_limits(stream) if limits is None else limits
    if np.isinf(low).all() and np.isinf(high).all():
        return np.zeros(len(y), dtype=bool)
    return np.asarray(((y <= low) | (y >= high)).any(axis=1))


def lint_saturated(view: View) -> list[Issue]:
    """Row 9."""
    low, high = _clip_limits(view)
    if np.isinf(low).all() and np.isinf(high).all():
        return []
    by_axis = (view.x <= low[:, None]) | (view.x >= high[:, None])
    at = np.asarray(by_axis.any(axis=0))
    share = float(at.mean())
    which = np.asarray(by_axis.any(axis=1))
    ends = ", ".join(f"{v:.6g}" for v in np.unique(np.concatenate([low, high])) if np.isfinite(v))
    text = (
        f"{view.where}: {axes_in(which)} at the end of the scale ({ends} {view.stream.unit}) in "
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
    values = np.unique(thinned(x))
    steps = np.diff(values)
    steps = steps[steps > 1e-6 * (values[-1] - values[0])] if len(steps) else steps
    return float(steps.min()) if len(steps) else 0.0


def lint_quantisation(view: View) -> list[Issue]:
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
        f"{view.where}: {axes_in(coarse)}: a step of the readings ({lsb[worst]:.3g} {unit}) is coarser than the noise "
        f"at rest ({noise[worst]:.2g}); means of rests are no better than {lsb[worst] / np.sqrt(12):.2g} {unit}: "
        "choose a narrower range or more bits"
    )
    return [Issue("coarse-quantisation", "warn", text, view.stream.kind, float(ratio[worst]), COARSE)]


def _on_grid(x: Array, lsb: Array) -> Mask:
    """Whether all readings of an axis are whole numbers of steps apart."""
    some = x[:, :: max(1, x.shape[1] // _LOOKED_AT)]
    steps = (some - some[:, :1]) / np.where(lsb > 0, lsb, 1.0)[:, None]
    return np.abs(steps - np.round(steps)).max(axis=1) < 0.1


def _rest_noise(view: View) -> Array | None:
    """Median scatter (3,) in the quieter blocks (two fifths) of a quarter second; None where there are too few."""
    size = max(8, round(0.25 * view.rate))
    n = view.x.shape[1] // size
    if n < 4:
        return None
    sd = view.x[:, : n * size].reshape(3, n, size).std(axis=2)
    total = sd.sum(axis=0)
    return np.median(sd[:, total <= np.quantile(total, 0.4)], axis=1)


# --- small tools -------------------------------------------------------------------------------------


def thinned(x: Array) -> Array:
    return x[:: max(1, len(x) // _LOOKED_AT)]


def runs(mask: Mask, shortest: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First index and length of every run of True that is at least `shortest` long."""
    half = shortest // 2
    if half > 1:  # a run so long covers one whole block of half its length: mostly there is none, and no more to do
        blocks = mask[: len(mask) - len(mask) % half].reshape(-1, half)
        if not blocks.all(axis=1).any():
            return np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    first, length = edges[::2], edges[1::2] - edges[::2]
    long = length >= shortest
    return first[long], length[long]


def axes_in(mask: Mask) -> str:
    names = ["xyz"[k] for k in np.flatnonzero(mask)]
    return " and ".join(names) if len(names) < 3 else "x, y and z"
