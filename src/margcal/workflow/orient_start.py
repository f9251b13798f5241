"""What a recording says of itself before a filter runs: its rests, gravity, field and dip, and its first attitude."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from margcal.core.types import Array, Issue, Mask
from margcal.core.units import STANDARD_GRAVITY
from margcal.methods.filters import Surroundings
from margcal.methods.tracking import product, rotation_step, to_earth
from margcal.methods.wahba import triad
from margcal.workflow.orient_streams import Samples

WINDOW_S = 0.5
"""Length of the stretches that are looked at for rest."""
GYR_STILL, ACC_STILL = 0.03, 0.15
"""Scatter (rad/s, m/s^2) of a window at rest: several times that of any MEMS node on a table, and a hand shows more."""
GYR_SLOW, GYR_SLOW_CALIBRATED = 0.15, 0.02
"""Mean rate (rad/s) of a window at rest: the bias of a gyroscope that was never calibrated, and what is left of one."""
TOGETHER = 6
"""Windows in a row over which a turn is told from a bias."""
INDEPENDENT = 8
"""Samples of a sensor that count as one reading: it may be slower than the gyroscope, or filtered."""
AGREE = 0.01
"""Largest difference (rad/s) of a rest's mean rate from that of the others: a bias is the same in all of them."""
LEAST_S = 1.0
"""Seconds of rest from which a bias is taken."""
AT_START_S = 3.0
"""A rest that begins later does not tell the attitude at the start."""
FIRST_S = 0.1
"""Readings that make the first attitude where there is no rest."""
NEAR_G = 0.03
"""Readings of this length (relative to gravity) tell the dip where there is no rest."""
GRAVITY_OFF = 0.03
"""Error of gravity's length at rest that is worth a warning."""


@dataclass(frozen=True)
class Rests:
    """Windows (M,) of `WINDOW_S` at rest: means of the sensors over them, seconds in all, the first one's start.

    `gyr_bias` (3,) rad/s is None where there is too little rest.
    """

    first: Array
    last: Array
    still: Mask
    gyr_bias: Array | None
    seconds: float


def find_rests(t: Array, gyr: Array, acc: Array, mag: Array, *, calibrated: bool = False) -> Rests:
    """Stretches in which the node lies still.

    A steady hand turns as evenly as a gyroscope's bias: where gravity or the field turn in the node's axes as the
    gyroscope says, it is no rest. A `calibrated` gyroscope has little bias left.
    """
    period = (t[-1] - t[0]) / (len(t) - 1) if len(t) > 1 else 0.0
    width = max(4, math.ceil(WINDOW_S / period)) if period > 0 else len(t) + 1
    count = len(t) // width
    if count == 0:
        none = np.zeros(0)
        return Rests(none, none, none.astype(bool), None, 0.0)
    rows = slice(0, count * width)
    w, a = gyr[rows].reshape(count, width, 3), acc[rows].reshape(count, width, 3)
    first, last = t[rows].reshape(count, width)[:, 0], t[rows].reshape(count, width)[:, -1]
    mean = w.mean(axis=1)
    still = np.max(np.abs(w - mean[:, None]).max(axis=1), axis=1) < 5 * GYR_STILL
    slow = GYR_SLOW_CALIBRATED if calibrated else GYR_SLOW
    still &= (w.std(axis=1).max(axis=1) < GYR_STILL) & (np.abs(mean).max(axis=1) < slow)
    if np.isfinite(a).any():
        still &= a.std(axis=1).max(axis=1) < ACC_STILL
    still &= last - first < 2 * WINDOW_S  # no gap inside
    if still.any():
        half = (last - first) / 4
        middle = (first + last) / 2
        vectors = (a, mag[rows].reshape(count, width, 3))
        still &= ~_turning(still, mean, middle, (middle - half, middle + half), vectors)
    if still.any():
        still &= np.abs(mean - _middle(mean[still])).max(axis=1) < AGREE
    seconds = float(np.sum((last - first)[still])) + np.count_nonzero(still) * period
    bias = _middle(mean[still]) if seconds >= LEAST_S else None
    return Rests(first, last, still, bias, seconds)


def _turning(still: Mask, rate: Array, middle: Array, halves: tuple[Array, Array], vectors: tuple[Array, ...]) -> Mask:
    """Windows (M,) in which fixed vectors (M, n, 3) turn as `rate` (M, 3) says, told over up to `TOGETHER` in a row.

    v' = -rate x v: the share of that which is seen is 1 in a turn and 0 at rest; half is the limit, where the scatter
    lets it be told (four standard errors from 0). v' is the slope of a line through the means of the windows' halves.
    """
    new = np.diff(np.flatnonzero(still), prepend=-2) != 1
    place = np.arange(len(new)) - np.maximum.accumulate(np.where(new, np.arange(len(new)), 0))
    block = np.cumsum(place % TOGETHER == 0) - 1
    count = np.bincount(block)

    def mean(x: Array) -> Array:
        """Means (K, 3) over the blocks of rows (m, 3) of the windows at rest."""
        return np.stack([np.bincount(block, c) / count for c in x.T], axis=-1)

    lever = [(t[still] - mean(middle[still, None])[block, 0]) for t in halves]
    square = np.bincount(block, lever[0] ** 2 + lever[1] ** 2)
    told, weight = np.zeros(len(count)), np.zeros(len(count))
    for v in vectors:
        n = v.shape[1] // 2
        parts = v[still, :n].mean(axis=1), v[still, -n:].mean(axis=1)
        slope = mean(parts[0] * lever[0][:, None] + parts[1] * lever[1][:, None]) * (count / square)[:, None]
        expected = -np.cross(mean(rate[still]), mean((parts[0] + parts[1]) / 2))
        scatter = mean(v[still].var(axis=1)).mean(axis=1) * INDEPENDENT / max(n, INDEPENDENT)
        here = np.sum(expected**2, axis=1) * square / (scatter + 1e-300)
        known = np.isfinite(here)
        told += np.where(known, np.sum(expected * slope, axis=1) * square / (scatter + 1e-300), 0.0)
        weight += np.where(known, here, 0.0)
    turning = np.zeros(len(still), dtype=bool)
    turning[still] = ((told > 0.5 * weight) & (told > 4 * np.sqrt(weight)))[block]
    return turning


def surroundings_of(t: Array, acc: Array, mag: Array, rests: Rests, issues: list[Issue]) -> Surroundings:
    """Gravity, field, dip and sampling period of the recording."""
    gravity, standard = _gravity(t, acc, rests), STANDARD_GRAVITY
    if abs(gravity / standard - 1) > GRAVITY_OFF:
        text = (
            f"the accelerometer shows {gravity:.4g} m/s^2 at rest instead of {standard:.4g}: it is not calibrated, or "
            "in another unit; the length found was taken for gravity"
        )
        issues.append(Issue("gravity", "warn", text, "acc", gravity, standard))
        if abs(gravity / standard - 1) > 0.5:
            gravity = standard
    steps = np.diff(t)
    period = float(np.partition(steps, len(steps) // 2)[len(steps) // 2]) if len(steps) else 0.01
    with np.errstate(invalid="ignore", over="ignore"):
        length = np.sqrt(np.sum(mag * mag, axis=1))
    good = np.isfinite(length) & (length > 0)
    if not good.any():
        return Surroundings(gravity=gravity, period=period)
    field = float(_middle(length[good]))
    return Surroundings(gravity, field, _dip(t, acc, mag, length, field, gravity, rests), period)


def first_attitude(
    t: Array, acc: Array, mag: Array, rests: Rests, around: Surroundings, issues: list[Issue]
) -> tuple[Array, tuple[float, float, float]]:
    """Attitude (ENU) at the start, and its standard deviations (rad) about east, north, up."""
    at_rest = np.flatnonzero(rests.still & (rests.first - t[0] <= AT_START_S))
    if len(at_rest) and np.all(rests.still[: at_rest[0] + 1]):
        span = (t >= rests.first[at_rest[0]]) & (t <= rests.last[at_rest[0]])
        sd = (0.02, 0.02, 0.05)
    else:
        span = t <= t[0] + FIRST_S
        if not (_has(acc[span]) or _has(acc)):
            return np.array([1.0, 0.0, 0.0, 0.0]), (math.pi, math.pi, math.pi)
        if not _has(acc[span]):
            span = t <= t[int(np.argmax(np.isfinite(acc).all(axis=1)))]
        sd = (0.3, 0.3, 0.5)
        text = "no rest at the start: the first attitude is rough, and the seconds after it are spent finding it"
        issues.append(Issue("start-in-motion", "note", text))
    up = _mean(acc[span])
    if not _usable(up):
        return np.array([1.0, 0.0, 0.0, 0.0]), (math.pi, math.pi, math.pi)
    north = _mean(mag[span]) if _has(mag[span]) else None
    if north is not None and _usable(north):
        found = triad(np.stack([up, north]), _reference(around.dip))
        if found.determined:
            return found.q, sd
    # no field: the node's axis that is most level points north as nearly as it can
    level = np.eye(3)[int(np.argmin(np.abs(up)[:2]))]
    heading = [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0] if level[0] else [0.0, 1.0, 0.0]]
    heading_sd = sd[2] if not _has(mag) else math.pi
    return triad(np.stack([up, level]), np.array(heading)).q, (sd[0], sd[1], heading_sd)


def levelled(q: Array, samples: Samples, k: int, dip: float) -> tuple[Array, tuple[float, float, float]] | None:
    """Attitude `q`, held through a gap, as the readings from sample `k` on show it, and its standard deviations.

    Without a usable field the heading is the one that was held. None without an accelerometer.
    """
    span = slice(k, max(k + 1, int(np.searchsorted(samples.t, samples.t[k] + FIRST_S, side="right"))))
    if not _has(samples.acc[span]) or not _usable(up := _mean(samples.acc[span])):
        return None
    if _has(samples.mag[span]) and _usable(field := _mean(samples.mag[span])):
        found = triad(np.stack([up, field]), _reference(dip))
        if found.determined:
            return found.q, (0.3, 0.3, 0.5)
    f = to_earth(q, up / np.linalg.norm(up))
    sine = math.hypot(f[0], f[1])
    axis = np.array([f[1], -f[0], 0.0]) / sine if sine > 1e-9 else np.array([1.0, 0.0, 0.0])  # f x up
    return product(rotation_step(math.atan2(sine, f[2]) * axis), q), (0.3, 0.3, 1.0)


def _reference(dip: float) -> Array:
    return np.array([[0.0, 0.0, 1.0], [0.0, math.cos(dip), -math.sin(dip)]])


def _gravity(t: Array, acc: Array, rests: Rests) -> float:
    """Length of the specific force at rest; without a rest one standard gravity."""
    means = _means(t, acc, rests)
    length = np.linalg.norm(means, axis=1)
    length = length[np.isfinite(length) & (length > 0)]
    return float(_middle(length)) if len(length) else STANDARD_GRAVITY


def _dip(t: Array, acc: Array, mag: Array, length: Array, field: float, gravity: float, rests: Rests) -> float:
    """Angle of the field below the horizon: at rest, or where the accelerometer shows about gravity."""
    a, m = _means(t, acc, rests), _means(t, mag, rests)
    sine = _sines(a, m)
    if not len(sine):
        with np.errstate(invalid="ignore"):
            near = np.abs(np.linalg.norm(acc, axis=1) / gravity - 1) < NEAR_G
            near &= np.abs(length / field - 1) < 0.2
        sine = _sines(acc[near], mag[near])
    return float(np.arcsin(np.clip(_middle(sine), -1, 1))) if len(sine) else Surroundings().dip


def _sines(a: Array, m: Array) -> Array:
    with np.errstate(invalid="ignore", divide="ignore"):
        sine = -np.sum(a * m, axis=1) / (np.linalg.norm(a, axis=1) * np.linalg.norm(m, axis=1))
    return sine[np.isfinite(sine)]


def _means(t: Array, y: Array, rests: Rests) -> Array:
    """Means (M, 3) of `y` over the windows at rest."""
    start = np.searchsorted(t, rests.first[rests.still])
    stop = np.searchsorted(t, rests.last[rests.still], side="right")
    return np.array([y[a:b].mean(axis=0) for a, b in zip(start, stop)]).reshape(-1, 3)


def _mean(y: Array) -> Array:
    return y[np.isfinite(y).all(axis=1)].mean(axis=0)


def _has(y: Array) -> bool:
    return bool(np.isfinite(y).all(axis=1).any())


def _usable(v: Array) -> bool:
    return bool(1e-9 < float(np.linalg.norm(v)) < 1e30)


def _middle(y: Array) -> Array:
    """Median over the first axis; np.median imports numpy.ma, 10 ms at every start."""
    ordered = np.sort(y, axis=0)
    n = len(ordered)
    return 0.5 * (ordered[(n - 1) // 2] + ordered[n // 2])
