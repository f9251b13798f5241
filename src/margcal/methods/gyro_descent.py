"""Weighted Gauss-Newton over (H, B) of a gyroscope for turns of known rotation or known end directions.

The machinery behind `gyro.gauss_newton` and `gyro.propagate_gravity`; ours, not from the papers. Each turn j
has a misfit r_j of its integrated rotation dR_j, which changes by G_j d when dR_j becomes dR_j exp(d)
(`preintegration.Preintegrated` tells d for changes of H and B). Its covariance is G C G^T + sigma_angle^2 I,
with C from the white noise of the readings. Minimised is the sum of squares of the whitened misfits, each
turn weighted by min(1, (4 sigma / misfit)^2), plus the prior on B.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from margcal.core import so3
from margcal.core.errors import InputError
from margcal.core.types import Array
from margcal.methods.preintegration import Preintegrated, TurnBatch, preintegrate

_CUT = 4.0  # sigma of a turn's misfit beyond which its weight falls; 1 honest turn in 1000
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
        r = so3.log(inverse @ dR)
        # log(exp(r) exp(d)) = r + J_r(r)^-1 d and J_r(r) = J_l(-r)
        return Misfit(r, so3.left_jacobian_inverse(-r))

    return measure


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


def _chi_median(dof: Array) -> Array:
    """Median of chi-square (Wilson-Hilferty)."""
    return dof * (1 - 2 / (9 * np.maximum(dof, 1))) ** 3


def _weigh(problem: Problem, point: _Point) -> _Weights:
    """Covariance of each turn's misfit, the angle noise if unknown (moments, robustly), robust weights."""
    gyro = point.misfit.G @ point.step.C @ np.swapaxes(point.misfit.G, -1, -2)
    square = np.sum(point.misfit.r**2, axis=-1)
    variance = np.trace(gyro, axis1=-2, axis2=-1)
    used = problem.dof > 0
    spare = max(float(problem.dof.sum()) - 9, 1.0) / max(float(problem.dof.sum()), 1.0)
    dof = np.maximum(problem.dof, 1)
    if problem.sigma_angle is not None:
        angle2 = problem.sigma_angle**2
    else:
        # first the median, which one bad turn does not move; then the moment of the turns within the cut
        total = _median((square / _chi_median(dof))[used]) / spare
        near = np.minimum(1.0, (_CUT**2 * total) / np.maximum(square / dof, _FLOOR**2)) * used
        total = float(near @ square / max(near @ problem.dof, 1)) / spare
        angle2 = max(0.0, total - float(near @ variance / max(near @ problem.dof, 1)))
    mean = variance / dof
    cov = gyro + (angle2 + _FLOOR**2 + 1e-8 * mean)[:, None, None] * np.eye(gyro.shape[-1])
    if point.misfit.blind is not None:
        # a share like that of the others: second-order terms must not be taken for precise measurements
        cov += mean[:, None, None] * point.misfit.blind
    root = np.linalg.inv(np.linalg.cholesky(cov))
    size2 = np.sum(np.einsum("tij,tj->ti", root, point.misfit.r) ** 2, axis=-1)
    # the larger of the stated noise and what the middle of the turns shows: far from the solution all are large
    unit = max(1.0, _median((size2 / _chi_median(dof))[used]))
    limit = (_CUT + np.sqrt(np.maximum(dof - 3, 0))) ** 2 * unit
    return _Weights(root, np.minimum(1.0, limit / np.maximum(size2, _FLOOR)) * used, float(np.sqrt(angle2)))


def _cost(problem: Problem, point: _Point, weights: _Weights) -> float:
    white = np.einsum("tij,tj->ti", weights.root, point.misfit.r)
    cost = float(weights.robust @ np.sum(white**2, axis=-1))
    if problem.prior_root is not None:
        cost += float(np.sum((problem.prior_root @ (point.B - problem.prior_mean)) ** 2))
    return cost


def _rows(problem: Problem, point: _Point, weights: _Weights) -> tuple[Array, Array]:
    """Whitened rows A (n, 9 or 12) and misfit b (n,) of the linearised problem ``|A x + b|``."""
    root = weights.root * np.sqrt(weights.robust)[:, None, None]
    white = root @ point.misfit.G
    b = np.einsum("tij,tj->ti", root, point.misfit.r).ravel()
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


def _descend(problem: Problem, H: Array, B: Array, max_iter: int, tol: float) -> Run:
    point = _evaluate(problem, H, B)
    Hs, Bs, costs = [point.H], [point.B], []
    while True:
        weights = _weigh(problem, point)
        step = _solve_rows(*_rows(problem, point, weights))
        costs.append(_cost(problem, point, weights))
        settled = step.sigmas < tol
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
        run = _descend(problem, H, problem.prior_mean, max_iter, tol)
        if best is None or run.typical < best.typical:
            best = run
        if best.typical <= misfit_limit(problem, best):
            break
    if best is None:
        raise InputError("no start for the gyroscope's H; give H0, the nominal scale in rad/s per raw unit")
    return best
