"""Is a stream fit to be used at all? Stuck, clipped, missing and implausible readings, before any fitting."""

from __future__ import annotations

import numpy as np

from margcal.core.types import Array, Stream

INT_SCALES = ((0.0, 65535.0), (-32768.0, 32767.0), (0.0, 4095.0), (-2048.0, 2047.0))
NEAR_END = 0.004


def clip_limits(stream: Stream) -> tuple[Array, Array]:
    """Lowest and highest reading (3,) that is surely not clipped, by axis, raw unit; infinite where nothing is.

    An axis clips where three or more consecutive readings stand at its extreme value, and, for counts of 16
    bits, within .4 % of the end of the scale.
    """
    y = stream.y
    lo, hi = np.full(3, -np.inf), np.full(3, np.inf)
    for axis in range(3):
        x = y[:, axis]
        x = x[np.isfinite(x)]
        if len(x) < 3 or x.min() == x.max():
            continue
        for extreme, side in ((x.min(), lo), (x.max(), hi)):
            at = x == extreme
            if np.any(at[2:] & at[1:-1] & at[:-2]):
                side[axis] = np.nextafter(extreme, 0.0 if extreme > 0 else 0.0)
                side[axis] = extreme
        if stream.unit == "count":
            for low, high in INT_SCALES[:2]:
                margin = NEAR_END * (high - low)
                if low <= x.min() and x.max() <= high and (x.max() - x.min()) > 0.8 * (high - low):
                    lo[axis], hi[axis] = max(lo[axis], low + margin), min(hi[axis], high - margin)
    return lo, hi


def clipped(y: Array, stream: Stream) -> Array:
    """Mask (N,) of the readings `y` (N, 3) that stand at the end of the stream's scale on some axis."""
    lo, hi = clip_limits(stream)
    return ((y <= lo) | (y >= hi)).any(axis=1)


def lint(recording: object) -> tuple:
    return ()
