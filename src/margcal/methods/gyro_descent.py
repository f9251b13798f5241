"""Weighted Gauss-Newton over (H, B) of a gyroscope for turns of known rotation or known end directions.

The machinery behind `gyro.gauss_newton` and `gyro.propagate_gravity`; ours, not from the papers. Each turn j
has a misfit r_j of its integrated rotation dR_j, which changes by G_j d when dR_j becomes dR_j exp(d)
(`preintegration.Preintegrated` tells d for changes of H and B). Its covariance is G C G^T + sigma_angle^2 I,
with C from the white noise of the readings. Minimised is the sum of squares of the whitened misfits, each
turn weighted by min(1, (4 sigma / misfit)^2), plus the prior on B.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from margcal.core import so3
from margcal.core.errors import DataError
from margcal.core.types import Array, Issue
from margcal.methods.preintegration import Preintegrated, TurnBatch, preintegrate

_CUT = 4.0  # sigma of a turn's misfit beyond which its weight falls; 1 honest turn in 1000
_THIN = 4  # samples put together in the first steps
_FLOOR = 1e-12  # rad; keeps the weights finite on noise-free data

# --- what is measured of a turn -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Misfit:
    """Misfit of the turns for their integrated rotations.

    `r` (T, k); ``dr = G d`` (T, k, 3) when dR becomes dR exp(d); `blind` (T, k, k) projects on the components
    of r that no small d moves, None where there are none.
    """

    r: Array
    G: Array
    blind: Array | None = None


Measure = Callable[[Array], Misfit]


def rotation_measure(known: Array) -> Measure:
    """Misfit log(dR_known^T dR), three components."""
    inverse = np.swapaxes(known, -1, -2)

    def measure(dR: Array) -> Misfit:
        # log(exp(r) exp(d)) = r + J_r(r)^-1 d
        return Misfit(*_log_and_jacobian(inverse @ dR))

    return measure


def _log_and_jacobian(R: Array) -> tuple[Array, Array]:
    """Rotation vectors r of a few rotations and J_r(r)^-1; as `so3.log` and faster, for angles below three radians."""
    twist = R - np.swapaxes(R, -1, -2)
    v = 0.5 * np.stack([twist[:, 2, 1], twist[:, 0, 2], twist[:, 1, 0]], axis=-1)
    sine = np.sqrt(np.sum(v * v, axis=-1))
    angle = np.arctan2(sine, 0.5 * (R[:, 0, 0] + R[:, 1, 1] + R[:, 2, 2] - 1))
    if np.any(angle > 3.0):
        r = so3.log(R)
    else:
        r = v * (angle / np.where(sine > 0, sine, 1.0) + (sine == 0))[:, None]
    # J_r(r)^-1 = I + [r]x / 2 + e [r]x^2
    small = angle < 1e-3
    a = np.where(small, 1.0, angle)
    e = np.where(small, 1 / 12 + angle**2 / 720, (1 - 0.5 * a / np.tan(0.5 * a)) / a**2)
    k = so3.skew(r)
    return r, np.eye(3) + 0.5 * k + e[:, None, None] * (k @ k)


def direction_measure(before: Array, after: Array) -> Measure:
    """Misfit ``dR v_after - v_before`` of M unit vectors, 3 M components of which 2 M carry information."""
    n, m = before.shape[:2]
    cross = -so3.skew(after)
    # along the vector itself a rotation moves nothing: only two of its three components measure
    blind = np.zeros((n, m, 3, m, 3))
    for i in range(m):
        blind[:, i, :, i, :] = before[:, i, :, None] * before[:, i, None, :]
    blind = blind.reshape(n, 3 * m, 3 * m)

    def measure(dR: Array) -> Misfit:
        r = np.einsum("tij,tmj->tmi", dR, after) - before
        # dR exp(d) v = dR (v + d x v) = dR v - dR [v]x d
        return Misfit(r.reshape(n, 3 * m), (dR[:, None] @ cross).reshape(n, 3 * m, 3), blind)

    return measure


# --- weighted Gauss-Newton, common to both ------------------------------------------------------------------


@dataclass(frozen=True)
class Problem:
    """Everything that does not change from iteration to iteration. `dof` (T,): what each turn measures."""

    batch: TurnBatch
    measure: Measure
    dof: Array
    prior_mean: Array
    prior_root: Array | None  # inverse square root of the prior's covariance; None: B is held at prior_mean
    sd: Array | None
    sigma_angle: float | None  # None: estimated from the misfits

    @cached_property
    def used(self) -> NDArray[np.bool_]:
        """Turns that measure something."""
        return self.dof > 0

    @cached_property
    def divisor(self) -> Array:
        """`dof`, at least one."""
        return np.maximum(self.dof, 1.0)

    @cached_property
    def typical(self) -> Array:
        """Median of chi-square with `dof` degrees of freedom (Wilson-Hilferty)."""
        return self.divisor * (1 - 2 / (9 * self.divisor)) ** 3

    @property
    def n_unknown(self) -> int:
        return 9 if self.prior_root is None else 12


@dataclass(frozen=True)
class _Point:
    """The misfits at one (H, B)."""

    H: Array
    B: Array
    step: Preintegrated
    misfit: Misfit


@dataclass(frozen=True)
class _Weights:
    """Whitening of the turns (T, k, k), robust weights (T,) and the sigma_angle that they rest on."""

    root: Array
    robust: Array
    sigma_angle: float


def _evaluate(problem: Problem, H: Array, B: Array) -> _Point:
    step = preintegrate(problem.batch.y, problem.batch.dt, H, B, problem.sd)
    return _Point(H, B, step, problem.measure(step.dR))


def _median(x: Array) -> float:
    """Median of a few numbers; NumPy's own takes ten times as long for them."""
    ranked = np.sort(x)
    return float(0.5 * (ranked[(len(x) - 1) // 2] + ranked[len(x) // 2]))


def _weigh(problem: Problem, point: _Point) -> _Weights:
    """Covariance of each turn's misfit, the angle noise if unknown (moments, robustly), robust weights."""
    G, r = point.misfit.G, point.misfit.r
    gyro = G @ point.step.C @ np.swapaxes(G, -1, -2)
    square, variance = np.einsum("ti,ti->t", r, r), np.einsum("tii->t", gyro)
    mean = variance / problem.divisor
    angle2 = _angle_variance(problem, square, variance) if problem.sigma_angle is None else problem.sigma_angle**2
    cov = gyro + (angle2 + _FLOOR**2 + 1e-8 * mean)[:, None, None] * np.eye(gyro.shape[-1])
    if point.misfit.blind is not None:
        # a share like that of the others: second-order terms must not be taken for precise measurements
        cov += mean[:, None, None] * point.misfit.blind
    root = np.linalg.inv(np.linalg.cholesky(cov))
    white = (root @ r[..., None])[..., 0]
    size2 = np.einsum("ti,ti->t", white, white)
    # the larger of the stated noise and what the middle of the turns shows: far from the solution all are large
    unit = max(1.0, _median((size2 / problem.typical)[problem.used]))
    limit = (_CUT + np.sqrt(np.maximum(problem.divisor - 3, 0))) ** 2 * unit
    return _Weights(root, np.minimum(1.0, limit / np.maximum(size2, _FLOOR)) * problem.used, math.sqrt(angle2))


def _angle_variance(problem: Problem, square: Array, variance: Array) -> float:
    """Variance of the attitudes or directions at the ends: what the misfits show beyond the readings' noise."""
    total_dof = float(problem.dof.sum())
    spare = max(total_dof - 9, 1.0) / max(total_dof, 1.0)
    # first the median, which one bad turn does not move; then the moment of the turns within the cut
    total = _median((square / problem.typical)[problem.used]) / spare
    near = np.minimum(1.0, (_CUT**2 * total) / np.maximum(square / problem.divisor, _FLOOR**2)) * problem.used
    n = max(float(near @ problem.dof), 1.0)
    return max(0.0, float(near @ square) / n / spare - float(near @ variance) / n)


def _cost(problem: Problem, point: _Point, weights: _Weights) -> float:
    white = (weights.root @ point.misfit.r[..., None])[..., 0]
    cost = float(weights.robust @ np.einsum("ti,ti->t", white, white))
    if problem.prior_root is not None:
        cost += float(np.sum((problem.prior_root @ (point.B - problem.prior_mean)) ** 2))
    return cost


def _rows(problem: Problem, point: _Point, weights: _Weights) -> tuple[Array, Array]:
    """Whitened rows A (n, 9 or 12) and misfit b (n,) of the linearised problem ``|A x + b|``."""
    root = weights.root * np.sqrt(weights.robust)[:, None, None]
    white = root @ point.misfit.G
    b = (root @ point.misfit.r[..., None]).ravel()
    A_H = (white @ point.step.J_H).reshape(-1, 9)
    if problem.prior_root is None:
        return A_H, b
    A_B = (white @ point.step.J_B).reshape(-1, 3)
    prior = np.hstack([np.zeros((3, 9)), problem.prior_root])
    b = np.concatenate([b, problem.prior_root @ (point.B - problem.prior_mean)])
    return np.vstack([np.hstack([A_H, A_B]), prior]), b


@dataclass(frozen=True)
class _Step:
    """Least-squares step `x` with its length in standard errors, covariance, rank and condition of the problem."""

    x: Array
    sigmas: float
    covariance: Array | None
    rank: int
    condition: float


def _solve_rows(A: Array, b: Array) -> _Step:
    """The step that minimises ``|A x + b|``, with the columns scaled to length one."""
    length = np.sqrt(np.sum(A * A, axis=0))
    length = np.where(length > 0, length, 1.0)
    U, s, Vt = np.linalg.svd(A / length, full_matrices=False)
    rank = int(np.sum(s > 1e-9 * s[0])) if s[0] > 0 else 0
    inverse = Vt[:rank].T / s[:rank]
    covariance = None
    if rank == A.shape[1]:
        covariance = (inverse @ inverse.T) / np.outer(length, length)
    condition = float(s[0] / s[-1]) if s[-1] > 0 and len(s) == A.shape[1] else float("inf")
    along = U[:, :rank].T @ b
    return _Step(-(inverse @ along) / length, float(np.sqrt(along @ along)), covariance, rank, condition)


@dataclass(frozen=True)
class Run:
    """One descent from one start."""

    point: _Point
    weights: _Weights
    last: _Step
    cost: float
    settled: bool
    H: list[Array]
    B: list[Array]
    costs: list[float]

    @property
    def typical(self) -> float:
        """Median misfit of the turns, rad."""
        return _median(np.sqrt(np.sum(self.point.misfit.r**2, axis=-1)))


def _coarse_to_fine(problem: Problem, H: Array, B: Array, max_iter: int, tol: float) -> Run:
    """Descend on turns thinned to a quarter of their samples as far as they are good for, then on all samples."""
    if problem.batch.dt.shape[1] < 16 * _THIN:
        return _descend(problem, H, B, max_iter, tol)
    sd = None if problem.sd is None else problem.sd / np.sqrt(_THIN)
    coarse = _descend(replace(problem, batch=_thinned(problem.batch), sd=sd), H, B, max_iter, tol, near=0.05)
    fine = _descend(problem, coarse.point.H, coarse.point.B, max_iter, tol)
    return replace(
        fine, H=coarse.H[:-1] + fine.H, B=coarse.B[:-1] + fine.B, costs=coarse.costs[: len(coarse.H) - 1] + fine.costs
    )


def _thinned(batch: TurnBatch) -> TurnBatch:
    """Every four readings replaced by their mean over the time that they stand for."""
    n = batch.dt.shape[1] // _THIN
    dt, y = batch.dt[:, : n * _THIN].reshape(-1, n, _THIN), batch.y[:, : n * _THIN].reshape(-1, n, _THIN, 3)
    total = dt.sum(axis=-1)
    weight = dt / np.where(total > 0, total, 1.0)[..., None]
    weight[total == 0, 0] = 1.0
    thinned = (weight[..., None, :] @ y)[..., 0, :]
    # the samples that are over at the end stay as they are
    rest = slice(n * _THIN, None)
    return TurnBatch(np.concatenate([thinned, batch.y[:, rest]], 1), np.concatenate([total, batch.dt[:, rest]], 1))


def _descend(problem: Problem, H: Array, B: Array, max_iter: int, tol: float, near: float = 0.0) -> Run:
    """Iterate until the step is below `tol` standard errors, or below the share `near` of H."""
    point = _evaluate(problem, H, B)
    Hs, Bs, costs = [point.H], [point.B], []
    while True:
        weights = _weigh(problem, point)
        step = _solve_rows(*_rows(problem, point, weights))
        costs.append(_cost(problem, point, weights))
        settled = step.sigmas < tol or float(np.sum(step.x[:9] ** 2)) < near**2 * float(np.sum(point.H**2))
        if settled or len(Hs) > max_iter:
            # the last step is so small that the linear model is exact for it: no further integration
            point = _moved(point, step.x) if settled else point
            Hs.append(point.H)
            Bs.append(point.B)
            return Run(point, weights, step, costs[-1], settled, Hs, Bs, costs)
        point = _line(problem, point, weights, step.x, costs[-1])
        Hs.append(point.H)
        Bs.append(point.B)


def _changes(x: Array) -> tuple[Array, Array]:
    """Step of H and of B."""
    return x[:9].reshape(3, 3), x[9:] if len(x) > 9 else np.zeros(3)


def _moved(point: _Point, x: Array) -> _Point:
    """The point after a small step, by the derivatives."""
    dH, dB = _changes(x)
    turned = point.step.J_H @ dH.ravel() + point.step.J_B @ dB
    misfit = replace(point.misfit, r=point.misfit.r + np.einsum("tij,tj->ti", point.misfit.G, turned))
    return replace(point, H=point.H + dH, B=point.B + dB, misfit=misfit)


def _line(problem: Problem, point: _Point, weights: _Weights, x: Array, cost: float) -> _Point:
    """The full step, halved while it makes the cost rise (at most six times; then no step)."""
    dH, dB = _changes(x)
    for halving in range(7):
        fraction = 0.5**halving
        new = _evaluate(problem, point.H + fraction * dH, point.B + fraction * dB)
        # a rise in the last digits is rounding, not divergence
        if _cost(problem, new, weights) <= cost * (1 + 1e-9) + 1e-9:
            return new
    return point


def misfit_limit(problem: Problem, run: Run) -> float:
    """Median misfit (rad) above which a minimum is taken for a wrong one: they have misfits of half a radian."""
    expected = np.sqrt(_median(np.trace(run.point.step.C, axis1=-2, axis2=-1)))
    return 0.15 + 5 * float(expected) + 5 * (problem.sigma_angle or 0.0)


def best_run(problem: Problem, starts: Iterable[Array], max_iter: int, tol: float) -> Run:
    """Descend from one start after the other until one ends with misfits that noise can explain."""
    best: Run | None = None
    for H in starts:
        run = _coarse_to_fine(problem, H, problem.prior_mean, max_iter, tol)
        if best is None or run.typical < best.typical:
            best = run
        if best.typical <= misfit_limit(problem, best):
            break
    if best is None:
        text = "gyroscope: the turns give no start for H; record turns about all axes, or give its nominal scale"
        raise DataError(text, (Issue("no-start", "fail", text, "gyr"),))
    return best
