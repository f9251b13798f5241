"""Least squares with what comes out of it: solution, covariance, rank, condition.

Plain dense problems with a handful of unknowns, NumPy only. Columns are scaled to unit length before anything
is decided about rank, so that unknowns of different units (counts, m/s^2, radians) are judged alike.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from margcal.core.types import Array

RANK_TOLERANCE = 1e-8
"""Singular values of the column-scaled matrix below this part of the largest count as zero."""


@dataclass(frozen=True)
class Solution:
    """What a least-squares problem gives.

    Attributes
    ----------
    x : ndarray (n,)
        The unknowns (for an underdetermined problem: the shortest solution of the scaled problem).
    cofactor : ndarray (n, n)
        Covariance of `x` for unit noise variance; infinite directions are left out (see `rank`).
    residual : ndarray (m,)
        Weighted residual at `x`.
    rank : int
    condition : float
        Of the column-scaled matrix.
    null : ndarray (n, n - rank)
        Columns span what the data do not determine, in the unknowns' own units.
    n_iter, converged
        Of an iterative solution.
    """

    x: Array
    cofactor: Array
    residual: Array
    rank: int
    condition: float
    null: Array
    n_iter: int = 0
    converged: bool = True

    @property
    def variance(self) -> float:
        """Noise variance estimated from the residual (NaN without a surplus equation)."""
        surplus = len(self.residual) - self.rank
        return float(self.residual @ self.residual) / surplus if surplus > 0 else float("nan")


def column_scales(A: ArrayLike) -> Array:
    """Lengths of the columns of `A` (m, n), 1 where a column is zero."""
    length = np.linalg.norm(np.asarray(A, dtype=np.float64), axis=0)
    return np.where(length > 0, length, 1.0)


def linear(A: ArrayLike, b: ArrayLike, weights: ArrayLike | None = None) -> Solution:
    """Minimise ``sum w (A x - b)^2``.

    Parameters
    ----------
    A : array_like (m, n)
    b : array_like (m,)
    weights : array_like (m,), optional
        Inverse variances of the equations.
    """
    A, b = np.asarray(A, dtype=np.float64), np.asarray(b, dtype=np.float64)
    if weights is not None:
        root = np.sqrt(np.asarray(weights, dtype=np.float64))
        A, b = A * root[:, None], b * root
    scale = column_scales(A)
    U, s, Vt = np.linalg.svd(A / scale, full_matrices=False)
    rank = int(np.sum(s > RANK_TOLERANCE * s[0]))
    inverse = Vt[:rank].T / s[:rank]
    x = (inverse @ (U[:, :rank].T @ b)) / scale
    cofactor = (inverse @ inverse.T) / np.outer(scale, scale)
    condition = float(s[0] / s[-1]) if s[-1] > 0 else float("inf")
    null = Vt[rank:].T / scale[:, None]
    return Solution(x, cofactor, A @ x - b, rank, condition, null)


def homogeneous(A: ArrayLike) -> tuple[Array, Array]:
    """Unit vector(s) `x` that minimise ``|A x|``, and all singular values, largest first.

    `A` (..., m, n), leading axes are separate problems; returns (..., n) and (..., min(m, n)). No scaling:
    which unit vector is smallest depends on the columns' units, and that choice is the caller's.
    """
    _, s, Vt = np.linalg.svd(np.asarray(A, dtype=np.float64), full_matrices=False)
    return Vt[..., -1, :], s


def huber_weights(residual: ArrayLike, scale: ArrayLike, k: float = 1.345) -> Array:
    """Weights of Huber's estimator: 1 up to `k` scales, then falling as 1/|r|."""
    r = np.abs(np.asarray(residual, dtype=np.float64)) / np.maximum(scale, np.finfo(float).tiny)
    return np.where(r > k, k / np.maximum(r, k), 1.0)


def robust_scale(residual: ArrayLike) -> float:
    """Standard deviation of the bulk of `residual`: 1.4826 times the median of its magnitude."""
    return 1.4826 * float(np.median(np.abs(np.asarray(residual, dtype=np.float64))))


Model = Callable[[Array], tuple[Array, Array]]
"""x (n,) -> residual (m,), Jacobian (m, n)."""


def gauss_newton(model: Model, start: ArrayLike, *, max_iter: int = 50, tol: float = 1e-12) -> Solution:
    """Minimise ``|r(x)|^2`` by Gauss-Newton steps, damped (Levenberg-Marquardt) where a full step is uphill.

    Parameters
    ----------
    model : callable
        x -> (residual (m,), Jacobian (m, n)), both already weighted.
    start : array_like (n,)
    tol : float
        Stops when a step changes the scaled unknowns by less than this part, or the cost by nothing.
    """
    x = np.array(start, dtype=np.float64)
    r, J = model(x)
    cost, damping, converged, n_iter = float(r @ r), 0.0, False, 0
    while n_iter < max_iter and not converged:
        n_iter += 1
        step, predicted = _damped_step(J, r, damping)
        r_new, J_new = model(x + step)
        cost_new = float(r_new @ r_new)
        # the last digits of a cost are noise: a rise of rounding size is not uphill
        if cost_new <= cost * (1 + 1e-13) + 1e-300:
            scale = column_scales(J)
            converged = bool(np.linalg.norm(step * scale) <= tol * (np.linalg.norm(x * scale) + tol))
            converged |= predicted <= 1e-15 * cost
            x, r, J, cost = x + step, r_new, J_new, cost_new
            damping = 0.0 if damping < 1e-9 else damping / 10
        else:
            damping = 1e-6 if damping == 0.0 else damping * 10
            if damping > 1e12:
                converged = predicted <= 1e-12 * cost  # no way down that rounding would let us see
                break
    final = linear(J, np.zeros(len(r)))
    return Solution(x, final.cofactor, r, final.rank, final.condition, final.null, n_iter, converged)


def _damped_step(J: Array, r: Array, damping: float) -> tuple[Array, float]:
    """Step in x and the fall of the cost that the linear model predicts for it."""
    scale = column_scales(J)
    U, s, Vt = np.linalg.svd(J / scale, full_matrices=False)
    told = s > 1e-13 * s[0]
    gradient = np.where(told, U.T @ r, 0.0)
    filtered = np.divide(s, s * s + damping, out=np.zeros_like(s), where=told)
    predicted = float(gradient @ gradient)
    return -(Vt.T @ (filtered * gradient)) / scale, predicted
