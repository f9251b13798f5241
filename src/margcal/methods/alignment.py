"""The rotation between a magnetometer calibrated by magnitude and the node (ours, not in the papers).

The ellipsoid leaves a magnetometer in an arbitrary frame: ``v = K (y - B)`` on a sphere, true field in the node
frame ``b = Omega v``. Two facts tell Omega without any known attitude:

* the dip: the angle between field and vertical is the same in every attitude, so with "up" in the node frame
  (accelerometer) ``up . Omega v = const`` (`rotation_from_dip`), linear in Omega;
* the gyroscope: a field fixed in the earth turns in the node frame by ``b' = -omega x b``
  (`rotation_from_rates`), which also tells the delay between the two sensors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from margcal.core import so3
from margcal.core.errors import DataError
from margcal.core.types import Array, Index, Issue
from margcal.methods.gyro import propagate_gravity
from margcal.methods.preintegration import TurnBatch

WINDOW_RAD = 0.5
"""Angle turned in one window of `rotation_from_rates`: large beside the magnetometer's noise, short in time."""
MAX_WINDOW_S = 1.0
JACKKNIFE_BLOCKS = 6
DELAYS_S = np.linspace(-0.06, 0.06, 7)
"""Delays that are tried before the parabola is laid through the best three."""


@dataclass(frozen=True)
class Alignment:
    """Omega (3, 3) takes the magnetometer's frame to the node's; `se_deg` (3,) its standard errors about the
    node's axes; `delay_s` by which the magnetometer lags, None where it was not estimated."""

    Omega: Array
    se_deg: Array
    delay_s: float | None = None
    delay_se_s: float | None = None
    misfit_deg: float = float("nan")
    gain: float = 1.0


def rotation_from_dip(v: Array, up: Array, least: float = 1e-2) -> Array | None:
    """Omega from the constant angle between field and vertical.

    Parameters
    ----------
    v : ndarray (J, 3)
        Unit vectors, magnetometer calibrated by magnitude.
    up : ndarray (J, 3)
        Unit vectors to the zenith in the node frame, in the same attitudes.
    least : float
        Second-smallest singular value relative to the largest, below which the attitudes do not determine it.

    Returns
    -------
    ndarray (3, 3) or None
        None where the attitudes do not determine it. (Omega, -Omega belong to field and negative field; the
        proper rotation is returned.)
    """
    rows = np.column_stack([(up[:, :, None] * v[:, None, :]).reshape(len(v), 9), -np.ones(len(v))])
    if len(rows) < 10:
        return None
    _, singular, Vt = np.linalg.svd(rows)
    if singular[8] < least * singular[0]:
        return None
    X = Vt[-1][:9].reshape(3, 3)
    return so3.nearest_rotation(X if np.linalg.det(X) > 0 else -X)


def rotation_from_rates(t: Array, v: Array, t_gyr: Array, rate: Array, *, delays: Array = DELAYS_S) -> Alignment:
    """Omega, and the magnetometer's delay, from a continuous motion.

    Parameters
    ----------
    t, v : ndarray (N,) s, (N, 3)
        Magnetometer calibrated by magnitude.
    t_gyr, rate : ndarray (M,) s, (M, 3) rad/s
        Gyroscope in the node frame; its bias is estimated along the way, a wrong gain shows in `gain`.

    Raises
    ------
    DataError
        If the motion does not determine the rotation.
    """
    edges = _window_edges(t, v)
    first = _solve(t, v, t_gyr, rate, edges, 0.0)
    costs = np.array([_solve(t, v, t_gyr, rate, edges, d, start=first.G).cost for d in delays])
    best = int(np.clip(np.argmin(costs), 1, len(delays) - 2))
    around, step = costs[best - 1 : best + 2], delays[1] - delays[0]
    curvature = (around[0] - 2 * around[1] + around[2]) / step**2
    delay = delays[best]
    se = None
    if curvature > 0:
        delay = delay - 0.5 * step * (around[2] - around[0]) / (around[0] - 2 * around[1] + around[2])
        delay = float(np.clip(delay, delays[0], delays[-1]))
    final = _solve(t, v, t_gyr, rate, edges, delay, start=first.G)
    if final.mirrored:
        text = (
            "magnetometer and gyroscope differ in handedness: one of them has a mirrored axis, so the rotation between "
            "them does not exist; find the axis whose sign the driver flips, or calibrate from rests and turns"
        )
        raise DataError(text, (Issue("mirrored-axes", "fail", text, "mag"),))
    se_deg = np.maximum(final.se_deg, _jackknife(t, v, t_gyr, rate, edges, delay, final))
    if curvature > 0:
        # cost is a sum of squares with noise variance cost/dof: d2(cost)/d(delay)2 = 2 variance / se^2
        se = float(np.sqrt(2 * final.cost / final.dof / curvature))
    misfit = float(np.degrees(np.sqrt(final.cost / final.dof)))
    return Alignment(final.Omega, se_deg, float(delay), se, misfit, final.gain)


def _jackknife(t: Array, v: Array, t_gyr: Array, rate: Array, edges: Index, delay: float, full: _Solved) -> Array:
    """Standard errors (3,) deg from leaving out one stretch of the motion at a time: misfits that last (a field that
    differs from place to place) are not white, and the formal errors know nothing of them."""
    blocks = np.array_split(np.arange(len(edges) - 1), JACKKNIFE_BLOCKS)
    turns = []
    for left_out in blocks:
        keep = np.setdiff1d(np.arange(len(edges) - 1), left_out)
        solved = _solve(t, v, t_gyr, rate, edges, delay, keep, full.G)
        turns.append(so3.log(solved.Omega @ full.Omega.T))
    off = np.array(turns) - np.mean(turns, axis=0)
    k = len(blocks)
    return np.degrees(np.sqrt((k - 1) / k * np.sum(off**2, axis=0)))


@dataclass(frozen=True)
class _Solved:
    G: Array
    Omega: Array
    se_deg: Array
    cost: float
    dof: float
    gain: float
    mirrored: bool


def _solve(
    t: Array,
    v: Array,
    t_gyr: Array,
    rate: Array,
    edges: Index,
    delay: float,
    keep: Index | None = None,
    start: Array | None = None,
) -> _Solved:
    """Gyroscope matrix in the magnetometer's frame by propagating the field over windows; Omega is the
    transpose of its rotation."""
    batch, along = _windows(t - delay, v, t_gyr, rate, edges)
    unit = v / np.linalg.norm(v, axis=1, keepdims=True)
    before, after = unit[edges[:-1]], unit[edges[1:]]
    use = (batch.dt > 0).sum(axis=1) >= 2
    if keep is not None:
        use &= np.isin(np.arange(len(use)), keep)
    if use.sum() < 8:
        raise DataError("the motion is too short to align the magnetometer with the gyroscope", (_too_short(),))
    fit = propagate_gravity(
        batch.select(use),
        before[use],
        after[use],
        H0=start,
        along=along[use] if start is None else None,
        bias_prior=(rate.mean(axis=0) * 0, np.eye(3) * 0.1**2),
        sigma_angle=1.0,
        raw_unit="rad/s",
    )
    G = fit.model.H
    Omega = so3.nearest_rotation(G).T
    r2 = float(np.sum(np.asarray(fit.residual) ** 2))
    dof = 2.0 * use.sum() - 12
    se = np.full(3, np.nan)
    if fit.covariance is not None:
        # rotation part of Omega dG: theta_i = eps_ijk (Omega dG)_kj / 2
        J = np.zeros((3, 9))
        for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
            for a in range(3):
                J[i, 3 * a + j] += Omega[k, a] / 2
                J[i, 3 * a + k] -= Omega[j, a] / 2
        variance = np.diag(J @ fit.covariance[:9, :9] @ J.T) * r2 / dof
        se = np.degrees(np.sqrt(np.maximum(variance, 0.0)))
    det = float(np.linalg.det(G))
    return _Solved(G, Omega, se, r2, dof, float(np.cbrt(abs(det))), det < 0)


def _too_short() -> Issue:
    text = "too little rotation to align the magnetometer with the gyroscope: turn the node about all axes for 20 s"
    return Issue("no-alignment", "fail", text, "mag")


def _window_edges(t: Array, v: Array) -> Index:
    """Indices that cut the motion into windows over which the field turned by about `WINDOW_RAD`."""
    unit = v / np.linalg.norm(v, axis=1, keepdims=True)
    edges = [0]
    for i in range(1, len(t)):
        a = edges[-1]
        turned = np.linalg.norm(unit[i] - unit[a]) > WINDOW_RAD
        if turned or t[i] - t[a] > MAX_WINDOW_S:
            edges.append(i)
    return np.array(edges)


def _windows(t: Array, v: Array, t_gyr: Array, rate: Array, edges: Index) -> tuple[TurnBatch, Array]:
    """The gyroscope between neighbouring edges, exact to the edge times, and the field along it."""
    lo, hi = t[edges[:-1]], t[edges[1:]]
    middles = np.concatenate([[t_gyr[0]], (t_gyr[1:] + t_gyr[:-1]) / 2, [t_gyr[-1]]])
    first = np.searchsorted(middles, lo, side="right") - 1
    last = np.searchsorted(middles, hi, side="left") - 1
    inside = (lo >= t_gyr[0]) & (hi <= t_gyr[-1])
    longest = int(np.max(np.where(inside, last - first + 1, 1)))
    index = np.clip(first[:, None] + np.arange(longest), 0, len(t_gyr) - 1)
    start = np.maximum(middles[index], lo[:, None])
    stop = np.minimum(middles[index + 1], hi[:, None])
    dt = np.where(inside[:, None], np.maximum(stop - start, 0.0), 0.0)
    along = np.stack([np.interp(t_gyr[index], t, v[:, k]) for k in range(3)], axis=-1)
    return TurnBatch(rate[index], dt), along
