"""Delays of accelerometer and magnetometer, against the attitudes and positions that the optics saw (ours).

A sensor that is late by d shows at time t what was there at t - d. Both estimates are linear least squares with d as
one more unknown (Gauss-Newton), errors by leaving out one of 24 stretches of the recording at a time.

* Magnetometer (`delay_of`): the reading is an affine function of the field turned into the marker body. Both sides are
  taken as differences over 0.15 s: what varies slowly and is not in the prediction (a field that differs from place to
  place) says nothing of time and would only disturb.
* Accelerometer (`accelerometer_delay`): in the laboratory, ``R (H y(t + d) - o) = f + p'' + R'' r``. p'' and R'' are
  second derivatives of local polynomials, that is a smoothed p''; the left side goes through the same smoothing, whose
  weights are those of the second derivative summed up twice. Without positions the low-passed fit has the delay as one
  more unknown (`mocap_solve`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from margcal.core.errors import DataError
from margcal.core.types import Array, Mask
from margcal.methods.clock import BLOCKS, MOST_ROWS, normal, robust, solve, weights
from margcal.methods.reference_rates import ReferenceRates, derivatives, resample, savitzky_golay, stretches

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


def accelerometer_delay(
    t: Array, y: Array, rates: ReferenceRates, *, start: float = 0.0, rounds: int = 8
) -> SensorDelay:
    """Delay of the accelerometer, with the optics' accelerations.

    Parameters
    ----------
    t, y : ndarray (M,) s, on the reference's clock, (M, 3) raw unit
    rates : ReferenceRates
        With positions.
    start : float, s

    Raises
    ------
    DataError
        If there are no positions, or too little of both is known at the same time.
    """
    if rates.p_ddot is None:
        raise DataError("an accelerometer's delay needs positions")
    centre = np.median(y, axis=0)
    size = float(np.sqrt(np.mean((y - centre) ** 2))) + 1e-300
    z = (y - centre) / size
    R, n = rates.R, rates.points
    bent = np.full((len(R), 9), np.nan)
    for part in stretches(rates.t, rates.valid, n):
        bent[part] = derivatives(rates.t[part], R[part].reshape(-1, 9), n)[2]
    smooth = _Smoothing(rates, np.isfinite(bent).all(axis=1) & rates.valid_p)
    R_smooth, bent = smooth.of(R.reshape(-1, 9)).reshape(-1, 3, 3), bent[smooth.at].reshape(-1, 3, 3)
    d, w, x, H = start, np.ones(len(smooth.at)), np.zeros(19), np.zeros((3, 3))
    rows, target = np.empty((0, 3, 19)), np.empty((0, 3))
    good = np.zeros(len(smooth.at), dtype=bool)
    for k in range(rounds):
        before, here, after = (resample(t, z, rates.t + d + s) for s in (-STEP_S, 0.0, STEP_S))
        turned = smooth.of((R[:, :, :, None] * here[:, None, None, :]).reshape(-1, 27)).reshape(-1, 3, 9)
        late = smooth.of(np.einsum("nij,nj->ni", R, (after - before) / (2 * STEP_S) @ H.T))
        good = np.isfinite(turned).all(axis=(1, 2)) & np.isfinite(late).all(axis=1)
        if good.sum() < 100:
            raise DataError("sensor and reference have too little time in common")
        rows = np.zeros((int(good.sum()), 3, 19))
        rows[:, :, :9], rows[:, :, 9:12] = turned[good], -R_smooth[good]
        rows[:, :, 12:15], rows[:, :, 15:18] = -np.eye(3), -bent[good]
        rows[:, :, 18] = late[good]
        target = rates.p_ddot[smooth.at[good]]
        unknown = 19 if k else 18  # d needs H first
        x = np.zeros(19)
        for _ in range(2):
            x[:unknown] = solve(*normal(rows[:, :, :unknown], target, w[good]))
            w[good] = weights(np.linalg.norm(rows @ x - target, axis=1))
        H = x[:9].reshape(3, 3)
        change = float(np.clip(x[18], -FARTHEST_S, FARTHEST_S))
        d += change
        if k and abs(change) < SETTLED_S:
            break
    return _told(d, rows, target, w[good], x)


class _Smoothing:
    """The weights by which the polynomials' second derivative smooths a true one, at samples `at` (K,) of the optics.

    Parameters
    ----------
    known : ndarray (N,) of bool
        Samples that may be asked for; every few of them are.
    """

    def __init__(self, rates: ReferenceRates, known: Mask) -> None:
        self.kernel = np.cumsum(np.cumsum(savitzky_golay(rates.points)[2]))[:-2]
        half = len(self.kernel) // 2
        at = np.flatnonzero(known)
        at = at[(at >= half) & (at < len(rates.t) - half)]
        self.at = at[:: max(1, rates.points // 4, len(at) // MOST_ROWS)]
        self.first = self.at - half

    def of(self, x: Array) -> Array:
        """x (N, m) smoothed, (K, m); NaN where something is missing."""
        length = len(self.kernel)
        windows = [np.lib.stride_tricks.sliding_window_view(np.ascontiguousarray(c), length) for c in x.T]
        return np.stack([window[self.first] @ self.kernel for window in windows], axis=-1)


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
