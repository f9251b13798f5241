"""Delay of the magnetometer against the attitudes that the optics saw (ours).

A sensor that is late by d shows at time t what was there at t - d. The magnetometer's reading is an affine function of
the field turned into the marker body, with d as one more unknown (Gauss-Newton). Both sides are taken as differences
over 0.15 s: what varies slowly and is not in the prediction (a field that differs from place to place) says nothing of
time and would only disturb. Errors by leaving out one of 24 stretches of the recording at a time (jackknife).

The accelerometer's delay is one more unknown of its fit (`mocap_solve`), with positions or without.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from margcal.core.errors import DataError
from margcal.core.types import Array
from margcal.methods.clock import BLOCKS, MOST_ROWS, normal, robust, solve
from margcal.methods.reference_rates import resample

APART_S = 0.15
"""Readings that are subtracted from each other are this far apart."""
STEP_S = 0.002
"""Half step of a derivative by time."""
FARTHEST_S = 0.05
"""Longest step of d in one round."""
SETTLED_S = 1e-5


@dataclass(frozen=True)
class SensorDelay:
    """`delay_s` of a sensor behind the clock of its times, its standard error, and the share of the squared changes of
    the reading that the prediction accounts for."""

    delay_s: float
    se_s: float
    explained: float


def delay_of(t: Array, y: Array, t_u: Array, u: Array, *, start: float = 0.0, rounds: int = 8) -> SensorDelay:
    """Delay of a sensor whose reading is an unknown affine function of a known track, ``y(t + d) = A u(t) + B``.

    Parameters
    ----------
    t, y : ndarray (M,) s, (M, 3) raw unit
    t_u, u : ndarray (N,) s, on the same clock, (N, 3)
        The predicted vector in the marker body, NaN where unknown.
    start : float, s

    Raises
    ------
    DataError
        If too little of both is known at the same time.
    """
    thin = max(1, len(t) // (2 * MOST_ROWS))
    t, y = t[::thin], y[::thin]
    lag = max(1, round(APART_S * (len(t) - 1) / (t[-1] - t[0])))
    together = (t[lag:] - t[:-lag]) < 2 * APART_S + 2 * float(np.median(np.diff(t)))
    d, w, x = start, np.ones(0), np.zeros(10)
    rows, target = np.empty((0, 3, 10)), np.empty((0, 3))
    for _ in range(rounds):
        before, here, after = (resample(t_u, u, t - d + s) for s in (-STEP_S, 0.0, STEP_S))
        good = np.isfinite(np.column_stack([before, here, after, y])).all(axis=1)
        good = np.atleast_1d(good)
        pair = np.flatnonzero(good[lag:] & good[:-lag] & together)
        if len(pair) < 100:
            raise DataError("sensor and reference have too little time in common")
        slope = (after - before) / (2 * STEP_S)
        X, target = here[pair + lag] - here[pair], y[pair + lag] - y[pair]
        A, w = robust(X, target)
        rows = np.zeros((len(target), 3, 10))
        for j in range(3):
            rows[:, j, 3 * j : 3 * j + 3] = X
        rows[:, :, 9] = -(slope[pair + lag] - slope[pair]) @ A
        x = solve(*normal(rows, target, w))
        change = float(np.clip(x[9], -FARTHEST_S, FARTHEST_S))
        d += change
        if abs(change) < SETTLED_S:
            break
    return _told(d, rows, target, w, x)


def _told(d: float, rows: Array, target: Array, w: Array, x: Array) -> SensorDelay:
    """The delay, the last unknown of `rows`, with its error by jackknife."""
    parts = [normal(rows[k], target[k], w[k]) for k in np.array_split(np.arange(len(target)), BLOCKS)]
    N, v = sum(p[0] for p in parts), sum(p[1] for p in parts)
    left = np.array([solve(N - P, v - q)[-1] for P, q in parts])
    se = float(np.std(left) * np.sqrt(len(left) - 1))
    centred = target - np.average(target, axis=0, weights=w**2)
    power = float(np.sum(w[:, None] ** 2 * centred**2))
    miss = target - rows @ x
    return SensorDelay(d, se, 1 - float(np.sum(w[:, None] ** 2 * miss**2)) / max(power, 1e-300))
