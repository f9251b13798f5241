"""Clock and delay between a node and the optics that follow it, from the angular rates.

Not in R-BSN, which says nothing of time. The node's clock and that of the optics are related by

    t_ref = offset + (1 + drift) t_node                                                            (i)

and the gyroscope's reading z, without its bias, by the paper's own (16),

    w(t_ref) = T z(t_node) + c                                                                     (ii)

1. *Coarse.* For every lag at once (FFT), masked where the body was not seen: the share of w that a linear function of z
   with a constant accounts for, and its root, the multiple correlation. Unlike the correlation of |w| and |z| it needs
   neither the gyroscope's bias, which a motion without a rest does not show, nor equal gains of its axes, and three
   axes are less easily alike by chance. A peak below 0.8 carries nothing.
2. *Fine.* Least squares of (ii) over offset, drift, T and c, with the derivative by time in closed form, from every
   peak that rivals the highest. Huber's weights on the length of the residual. Both sides go through the same
   polynomials: those that gave w are laid through the *integral* of z at the optics' times, so the low-pass is the
   same on both sides, and rates such as 75 Hz against 100 Hz need no resampling.
3. *Errors.* The residual is far from white (the polynomials, cables, soft tissue), so standard errors come from leaving
   out one of 24 stretches of the recording at a time (jackknife), not from its variance.

A gyroscope that lags by d has the same (ii) with offset - d: on separate clocks the two cannot be told apart and the
gyroscope's delay counts as 0; on a common clock (offset 0, drift 0) d is what is estimated. For the other sensors'
delays see `delays`.

=============  =========================================================================  ==============
name here      meaning                                                                    shape
=============  =========================================================================  ==============
t, w           optics: time, rate in the body's axes                                      (N,), (N, 3)
t_gyr, z       node: time, raw gyroscope                                                  (M,), (M, 3)
g              z through the polynomials at the optics' times                             (N, 3)
T, c           of (ii)                                                                    (3, 3), (3,)
=============  =========================================================================  ==============
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from margcal.core.errors import DataError
from margcal.core.types import Array, Index, Issue
from margcal.methods.rate_correlation import Curve, correlate
from margcal.methods.reference_rates import ReferenceRates, derivatives, hermite, stretches

PEAK = 0.8
"""Least correlation of the angular rates."""
RIVAL = 0.9
"""Peaks this part of the highest are tried as well."""
RIVALS = 6
DISTINCT = 1.5
"""The misfit (sum of squares) at any other peak must be this much larger."""
PEAK_APART_S = 0.25
BLOCKS = 24
MOST_ROWS = 12000
DRIFT_SD = 1e-3
"""Prior on the drift: crystals keep 1e-4; it only matters in recordings too short to tell."""
ROUNDS = 12


@dataclass(frozen=True)
class Synchronisation:
    """Offset, drift and T.

    Attributes
    ----------
    common_clock : bool
        Whether offset and drift were held at 0 and `delay_s` estimated instead.
    offset_s, drift_ppm, delay_s : float
        Of (i); delay of the gyroscope behind the optics (0 on separate clocks).
    offset_se_s, drift_se_ppm, delay_se_s : float
        Standard errors by jackknife.
    T : ndarray (3, 3), rad/s per raw unit
    c : ndarray (3,), rad/s
    covariance : ndarray (12, 12)
        Of (T row by row, c), jackknife.
    explained : float
        Share of the squared rate that (ii) accounts for.
    residual_rms : float, rad/s
    peak, peak_lag_s, second : float
        Highest correlation, where it is, and the highest one of another peak (0: none).
    lags, correlation : ndarray
        The curve, s (of `offset_s`) and correlation.
    """

    common_clock: bool
    offset_s: float
    drift_ppm: float
    delay_s: float
    offset_se_s: float
    drift_se_ppm: float
    delay_se_s: float
    T: Array
    c: Array
    covariance: Array
    explained: float
    residual_rms: float
    peak: float
    peak_lag_s: float
    second: float
    lags: Array
    correlation: Array

    def node_time(self, t_ref: Array) -> Array:
        """The node's clock at the optics' times, by (i)."""
        return (t_ref - self.offset_s) / (1 + 1e-6 * self.drift_ppm)

    def reference_time(self, t_node: Array) -> Array:
        return self.offset_s + (1 + 1e-6 * self.drift_ppm) * t_node


def synchronise(
    t_gyr: Array,
    z: Array,
    rates: ReferenceRates,
    *,
    common_clock: bool = False,
    peak_needed: float = PEAK,
    tick: Callable[[int, int], None] | None = None,
) -> Synchronisation:
    """Clock of the node against that of the optics.

    Parameters
    ----------
    t_gyr, z : ndarray (M,) s, (M, 3) raw unit
    rates : ReferenceRates
    common_clock : bool
        Both are on one clock: the gyroscope's delay is estimated instead of offset and drift.
    peak_needed : float
    tick : callable (done, total), optional

    Raises
    ------
    DataError
        If the correlation is too low, or has several peaks that fit alike.
    """
    say = tick or (lambda done, total: None)
    bias = np.median(z, axis=0)  # any constant near the bias will do: c takes the rest
    curve = correlate(t_gyr, z - bias, rates)
    say(1, 4)
    peaks = _peaks(curve, common_clock)
    best, height = peaks[0][0], peaks[0][1]
    if not height >= peak_needed:
        text = (
            f"the turning of the node and of the reference body correlate by {max(height, 0.0):.2f} at best "
            f"({peak_needed:g} is needed): are they of the same motion and body? (The body turned at "
            f"{np.degrees(np.sqrt(np.mean(np.sum(rates.w[rates.valid] ** 2, axis=1)))):.0f} deg/s rms.) Record a "
            "minute of lively turning about all axes in both"
        )
        raise DataError(text, (Issue("no-synchronisation", "fail", text, None, float(height), peak_needed),))
    angle = _integral(t_gyr, z - bias)
    problem = _Problem(t_gyr, z - bias, angle, rates, common_clock)
    rivals = [problem.solve(lag, rounds=6) for lag, h in peaks[: 1 if common_clock else RIVALS] if h >= RIVAL * height]
    say(2, 4)
    rivals.sort(key=lambda s: s.cost)
    if len(rivals) > 1 and (other := _apart(rivals)) is not None and other.cost < DISTINCT * rivals[0].cost:
        text = (
            f"the motion repeats itself: offsets of {rivals[0].offset(rates, t_gyr):.3f} s and "
            f"{other.offset(rates, t_gyr):.3f} s fit alike; begin the recording with a few turns that do not repeat"
        )
        raise DataError(text, (Issue("several-offsets", "fail", text, None, other.cost / rivals[0].cost, DISTINCT),))
    found = problem.solve(rivals[0].lag, rivals[0].drift)
    say(3, 4)
    second = max((h for lag, h in peaks if abs(lag - best) > PEAK_APART_S), default=0.0)
    return _named(problem, found, curve, (height, best, second), bias)


# --- coarse -----------------------------------------------------------------------------------------


def _peaks(curve: Curve, common_clock: bool) -> list[tuple[float, float]]:
    """(lag, correlation) of the maxima, highest first; on a common clock those near 0 only."""
    lags, r = curve.lags, curve.correlation
    if common_clock:
        near = np.flatnonzero(np.abs(lags) <= PEAK_APART_S)
        if not len(near):
            return [(0.0, 0.0)]
        return [(0.0, float(r[near].max()))]
    top = np.flatnonzero((r[1:-1] >= r[:-2]) & (r[1:-1] > r[2:])) + 1
    top = top[np.argsort(-r[top])]
    kept: list[int] = []
    for k in top.tolist():
        if all(abs(lags[k] - lags[j]) > PEAK_APART_S for j in kept):
            kept.append(k)
        if len(kept) == RIVALS:
            break
    return [(float(lags[k]), float(r[k])) for k in kept] or [(0.0, 0.0)]


def _apart(solved: list[_Fine]) -> _Fine | None:
    """The best of the solutions that are not the first one found again."""
    return next((s for s in solved[1:] if abs(s.lag - solved[0].lag) > PEAK_APART_S / 2), None)


# --- fine --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Fine:
    """`lag`: offset at the middle of the common time; x = (T row by row, c, lag, drift)."""

    lag: float
    drift: float
    x: Array
    cost: float
    rows: Array
    target: Array
    weight: Array
    middle: float

    def offset(self, rates: ReferenceRates, t_gyr: Array) -> float:
        return self.lag - self.drift * (self.middle - self.lag)


class _Problem:
    """(ii) at the optics' times as a function of lag and drift."""

    def __init__(
        self, t_gyr: Array, z: Array, angle: Array, rates: ReferenceRates, common_clock: bool, most: int = MOST_ROWS
    ) -> None:
        self.t_gyr, self.z, self.angle, self.rates, self.common = t_gyr, z, angle, rates, common_clock
        self.most = most

    def at(self, lag: float, drift: float, middle: float) -> Array:
        """Node time of every sample of the optics."""
        t = self.rates.t
        return middle - lag + (t - middle) / (1 + drift)

    def solve(self, lag: float, drift: float = 0.0, rounds: int = ROUNDS) -> _Fine:
        rates = self.rates
        first, last = max(rates.t[0], self.t_gyr[0] + lag), min(rates.t[-1], self.t_gyr[-1] + lag)
        middle = 0.5 * (first + last)
        weight: Array | None = None
        fine = _Fine(lag, drift, np.zeros(14), np.inf, np.empty(0), np.empty(0), np.empty(0), middle)
        T = None
        for _ in range(rounds):
            g, g_dot, use = self._filtered(lag, drift, middle)
            target = rates.w[use]
            if len(target) < 60:
                raise DataError("node and reference have too little time in common; record them together")
            X = np.column_stack([g[use], np.ones(len(target))])
            if T is None or weight is None or len(weight) != len(target):
                T, weight = robust(X, target)
            slope = g_dot[use] @ T[:3]  # T dz/dt_node
            away = (rates.t[use] - middle) / (1 + drift) ** 2
            rows = np.zeros((len(target), 3, 14))
            for k in range(3):
                rows[:, k, 3 * k : 3 * k + 3] = X[:, :3]
                rows[:, k, 9 + k] = 1.0
            rows[:, :, 12] = -slope
            rows[:, :, 13] = -slope * away[:, None]
            N, v = normal(rows, target, weight)
            self._prior(N, v, drift, rows, target, weight)
            x = solve(N, v)
            step = float(np.clip(x[12], -0.1, 0.1))
            lag, drift = lag + step, drift + float(np.clip(x[13], -1e-3, 1e-3))
            T = np.vstack([x[:9].reshape(3, 3).T, x[9:12]])
            miss = np.linalg.norm(X @ T - target, axis=1)
            weight = weights(miss)
            cost = float(np.mean(weight**2 * miss**2))
            fine = _Fine(lag, drift, x, cost, rows, target, weight, middle)
            if abs(step) < 1e-7 and abs(x[13]) < 1e-9:
                break
        return fine

    def _prior(self, N: Array, v: Array, drift: float, rows: Array, target: Array, weight: Array) -> None:
        """The drift's prior, in units of the residual's variance; on a common clock it is held at 0."""
        variance = max(float(np.median(np.sum(target**2, axis=1))) * 1e-4, 1e-12)
        sd = 1e-12 if self.common else DRIFT_SD
        N[13, 13] += variance / sd**2
        v[13] -= drift * variance / sd**2

    def _filtered(self, lag: float, drift: float, middle: float) -> tuple[Array, Array, Index]:
        """z and its slope through the optics' polynomials, and the samples of which both sides are known."""
        rates, n = self.rates, self.rates.points
        node = self.at(lag, drift, middle)
        inside = (node > self.t_gyr[0]) & (node < self.t_gyr[-1])
        g, g_dot = np.full((len(node), 3), np.nan), np.full((len(node), 3), np.nan)
        for part in stretches(rates.t, inside, n):
            both = np.column_stack(hermite(self.t_gyr, self.angle, self.z, node[part]))
            slope = derivatives(rates.t[part], both, n)[1]
            g[part], g_dot[part] = slope[:, :3] * (1 + drift), slope[:, 3:] * (1 + drift)
        good = rates.valid & np.isfinite(g).all(axis=1) & np.isfinite(g_dot).all(axis=1)
        use = np.flatnonzero(good)
        thin = max(1, n // 4, len(use) // self.most) if self.most else 1
        return g, g_dot, use[::thin]


def gyroscope_at_reference(sync: Synchronisation, t_gyr: Array, z: Array, rates: ReferenceRates) -> Array:
    """The raw gyroscope through the optics' polynomials at the optics' times (N, 3): Omega* of R-BSN (11).

    The delay of `sync` is taken out. NaN where either is unknown.
    """
    centre = np.median(z, axis=0)
    angle = _integral(t_gyr, z - centre)
    node = sync.node_time(rates.t) + sync.delay_s
    out = np.full((len(node), 3), np.nan)
    inside = (node > t_gyr[0]) & (node < t_gyr[-1])
    for part in stretches(rates.t, inside, rates.points):
        turned, _ = hermite(t_gyr, angle, z - centre, node[part])
        slope = derivatives(rates.t[part], turned, rates.points)[1]
        out[part] = slope * (1 + 1e-6 * sync.drift_ppm) + centre
    return out


def _named(
    problem: _Problem, found: _Fine, curve: Curve, heights: tuple[float, float, float], bias: Array
) -> Synchronisation:
    parts = [
        normal(found.rows[k], found.target[k], found.weight[k])
        for k in np.array_split(np.arange(len(found.target)), BLOCKS)
    ]
    N, v = sum(p[0] for p in parts), sum(p[1] for p in parts)
    held = np.zeros((14, 14))
    problem._prior(held, np.zeros(14), 0.0, found.rows, found.target, found.weight)
    left = np.array([solve(N - P + held, v - q) for P, q in parts])
    C = (len(parts) - 1) / len(parts) * (left - left.mean(axis=0)).T @ (left - left.mean(axis=0))
    # lag is the offset in the middle of the recording: offset = lag - drift (middle - lag)
    away = -(found.middle - found.lag)
    L = np.array([1 + found.drift, away])
    offset_se = float(np.sqrt(max(L @ C[12:, 12:] @ L, 0.0)))
    T = found.x[:9].reshape(3, 3)
    miss = problem_residual(found)
    power = float(np.sum(found.weight[:, None] ** 2 * found.target**2))
    explained = 1 - float(np.sum(found.weight[:, None] ** 2 * miss**2)) / max(power, 1e-300)
    common = problem.common
    offset = found.lag - found.drift * (found.middle - found.lag)
    peak, lag, second = heights
    mixed = np.eye(12)
    for k in range(3):
        mixed[9 + k, 3 * k : 3 * k + 3] = -bias  # T (z - bias) + x = T z + c
    return Synchronisation(
        common_clock=common,
        offset_s=0.0 if common else offset,
        drift_ppm=0.0 if common else 1e6 * found.drift,
        delay_s=-found.lag if common else 0.0,
        offset_se_s=0.0 if common else offset_se,
        drift_se_ppm=0.0 if common else float(1e6 * np.sqrt(C[13, 13])),
        delay_se_s=float(np.sqrt(C[12, 12])) if common else 0.0,
        T=T,
        c=found.x[9:12] - T @ bias,
        covariance=mixed @ C[:12, :12] @ mixed.T,
        explained=explained,
        residual_rms=float(np.sqrt(np.mean(miss**2))),
        peak=peak,
        peak_lag_s=lag,
        second=second,
        lags=curve.lags,
        correlation=curve.correlation,
    )


def problem_residual(found: _Fine) -> Array:
    """(N, 3), rad/s."""
    return found.target - found.rows[:, :, :12] @ found.x[:12]


# --- numbers -----------------------------------------------------------------------------------------


def _integral(t: Array, z: Array) -> Array:
    angle = np.zeros_like(z)
    np.cumsum((z[1:] + z[:-1]) / 2 * np.diff(t)[:, None], axis=0, out=angle[1:])
    return angle


def robust(X: Array, target: Array, rounds: int = 5) -> tuple[Array, Array]:
    """Least squares of target (N, 3) on X (N, p) with Huber's weights on the residual's length."""
    weight = np.ones(len(target))
    T = np.zeros((X.shape[1], target.shape[1]))
    for _ in range(rounds):
        Xw = X * weight[:, None]
        N, v = Xw.T @ Xw, Xw.T @ (target * weight[:, None])
        d = np.sqrt(np.maximum(np.diag(N), 1e-300))
        T = np.linalg.pinv(N / np.outer(d, d), rcond=1e-12, hermitian=True) @ (v / d[:, None]) / d[:, None]
        weight = weights(np.linalg.norm(X @ T - target, axis=1))
    return T, weight


def weights(miss: Array) -> Array:
    """Square roots of Huber's weights."""
    limit = 2 * float(np.median(miss)) + 1e-300
    return np.minimum(1.0, np.sqrt(limit / np.maximum(miss, 1e-300)))


def normal(rows: Array, target: Array, weight: Array) -> tuple[Array, Array]:
    A = (rows * weight[:, None, None]).reshape(-1, rows.shape[2])
    return A.T @ A, A.T @ (target * weight[:, None]).ravel()


def solve(N: Array, v: Array) -> Array:
    d = np.sqrt(np.maximum(np.diag(N), 1e-300))
    return np.linalg.pinv(N / np.outer(d, d), rcond=1e-12, hermitian=True) @ (v / d) / d
