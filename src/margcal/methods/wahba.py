"""Attitude from directions known in two frames (Wahba's problem): QUEST, Davenport's q-method, SVD and TRIAD.

Papers: G. Wahba, SIAM Review 7 (1965) 409. M. D. Shuster, S. D. Oh, "Three-axis attitude determination from vector
observations", J. Guidance and Control 4 (1981) 70-77: TRIAD, Davenport's q-method, QUEST, covariances. F. L. Markley,
"Attitude determination using vector observations and the singular value decomposition", J. Astronautical Sciences 36
(1988) 245-258. F. L. Markley, D. Mortari, "Quaternion attitude estimation using vector observations", same 48 (2000)
359-380: the closed form for two vectors. It is equation (10) of R-BSN, whose filter takes the result as a measurement.

Minimised over rotations R = R_nb, body to reference::

    L = 1/2 sum a_i |r_i - R b_i|^2 = sum a_i - tr(R^T B) = sum a_i - q^T K q

============  ===================================================  ==============================================
name here     meaning                                              Shuster & Oh
============  ===================================================  ==============================================
b             measured directions, body frame (..., n, 3)          W_i
r             the same in the reference frame (..., n, 3)          V_i
weight        a_i, scaled to sum to one                            a_i
R, q          body to reference; scalar first, Hamilton            their A is R^T, their q our q with scalar last
B             sum a_i r_i b_i^T                                    B^T (38)
K             4x4, its largest eigenvector is q                    K (44), scalar first here
lam           its largest eigenvalue, sum a_i - L                  lambda_max
============  ===================================================  ==============================================

Directions need not be of length one; one that is zero or not finite has no weight. All leading axes are independent
problems, solved side by side. Where the directions leave the attitude open (fewer than two, or all parallel), q is NaN
and `determined` is False: no solver makes one up.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from margcal.core import so3
from margcal.core.types import Array

PARALLEL = 1e-6
"""Directions whose (weighted) gap between the two largest eigenvalues of K is below this are taken for parallel: two
unit vectors of equal weight about 0.1 degrees apart. The attitude's error grows with one over the gap's root."""

NEWTON_ROUNDS = 30


class Attitudes(NamedTuple):
    """Solutions of Wahba's problem.

    Attributes
    ----------
    q : ndarray (..., 4)
        R_nb, scalar first and not negative; NaN where the attitude is not determined.
    loss : ndarray (...)
        Wahba's loss with weights that sum to one (between 0 and 2); NaN where no direction was usable.
    determined : ndarray of bool (...)
    n_used : ndarray of int (...)
        Directions that had any weight.
    """

    q: Array
    loss: Array
    determined: NDArray[np.bool_]
    n_used: NDArray[np.int64]


def quest(b: ArrayLike, r: ArrayLike, weights: ArrayLike | None = None) -> Attitudes:
    """QUEST of Shuster & Oh: largest eigenvalue first, then its quaternion in closed form.

    Parameters
    ----------
    b : array_like (..., n, 3)
        Measured directions in the body frame, any length.
    r : array_like (..., n, 3) or (n, 3)
        The same directions in the reference frame.
    weights : array_like (..., n) or (n,), optional
        Best: one over the squared error of each direction. Only their ratios matter.

    Notes
    -----
    The null vector of K - lambda 1 is read off its adjugate, which is a multiple of q q^T. Its four columns are what
    the paper's four sequential rotations give (none, half a turn about x, y, z); taking the largest is choosing the
    rotation that is farthest from the singularity of the Gibbs vector, always.
    """
    p = _prepare(b, r, weights)
    K = davenport_matrix(p.b, p.r, p.a)
    two = _largest_of_two(p) if p.b.shape[-2] == 2 else None
    lam = _largest_by_newton(K, p) if two is None else two[0]
    adj = adjugate(K - lam[..., None, None] * np.eye(4))
    diagonal = np.abs(np.diagonal(adj, axis1=-2, axis2=-1))
    best = np.argmax(diagonal, axis=-1)
    q = np.take_along_axis(adj, best[..., None, None], axis=-1)[..., 0]
    # the trace of the adjugate is the product of the three gaps of lambda; the two smaller eigenvalues sum to -lam - e2
    gap = diagonal.sum(axis=-1) if two is None else two[1]
    if two is None:
        gap = gap / np.maximum((lam + 1) ** 2, 1.0)
    return _finish(q, 1 - lam, gap, p)


def davenport(b: ArrayLike, r: ArrayLike, weights: ArrayLike | None = None) -> Attitudes:
    """Davenport's q-method: all of K's eigenvectors, the most dependable and slowest; parameters as `quest`."""
    p = _prepare(b, r, weights)
    values, vectors = np.linalg.eigh(davenport_matrix(p.b, p.r, p.a))
    return _finish(vectors[..., :, 3], 1 - values[..., 3], values[..., 3] - values[..., 2], p)


def svd(b: ArrayLike, r: ArrayLike, weights: ArrayLike | None = None) -> Attitudes:
    """Markley's singular value decomposition of B; parameters as `quest`."""
    p = _prepare(b, r, weights)
    B = np.einsum("...n,...ni,...nj->...ij", p.a, p.r, p.b)
    U, s, Vt = np.linalg.svd(B)
    d = np.sign(np.linalg.det(U @ Vt))
    U = U.copy()
    U[..., :, 2] *= d[..., None]
    last = d * s[..., 2]
    return _finish(so3.quat_from_matrix(U @ Vt), 1 - s[..., 0] - s[..., 1] - last, 2 * (s[..., 1] + last), p)


def triad(b: ArrayLike, r: ArrayLike) -> Attitudes:
    """TRIAD: the first direction is taken as exact, of the second only what is across the first.

    Parameters
    ----------
    b, r : array_like (..., 2, 3)
    """
    p = _prepare(b, r, np.array([0.5, 0.5]))
    M_b, sine_b = _frame(p.b)
    M_r, sine_r = _frame(p.r)
    R = M_r @ np.swapaxes(M_b, -1, -2)
    miss = p.r - np.einsum("...ij,...nj->...ni", R, p.b)
    loss = 0.25 * np.sum(miss**2, axis=(-2, -1))
    return _finish(so3.quat_from_matrix(R), loss, 0.5 * np.minimum(sine_b, sine_r) ** 2, p)


def covariance(
    b: ArrayLike, sigma: ArrayLike, weights: ArrayLike | None = None, *, sigma_r: ArrayLike | None = None
) -> Array:
    """Covariance (..., 3, 3) rad^2 of the attitude's error, about the body axes.

    Parameters
    ----------
    b : array_like (..., n, 3)
        Directions in the body frame.
    sigma : array_like (..., n) or (n,)
        Error of each measured direction, rad per axis across it.
    weights : array_like (..., n) or (n,), optional
        Those that were used; without them ``1 / sigma^2``, which is best.
    sigma_r : array_like, optional
        Error of the reference directions, the same measure.

    Notes
    -----
    Shuster & Oh (101)-(104) with weights that need not be the best; with the best it is their Cramer-Rao bound
    ``inverse of sum (1 - b b^T) / sigma^2``. Not finite where the directions leave the attitude open.
    """
    measured = np.asarray(b, dtype=np.float64)
    unit: Array = measured / np.linalg.norm(measured, axis=-1, keepdims=True)
    variance = np.asarray(sigma, dtype=np.float64) ** 2
    if sigma_r is not None:
        variance = variance + np.asarray(sigma_r, dtype=np.float64) ** 2
    a = 1 / variance if weights is None else np.asarray(weights, dtype=np.float64)
    across = np.eye(3) - unit[..., :, None] * unit[..., None, :]  # (..., n, 3, 3), a projection
    information = np.sum(a[..., None, None] * across, axis=-3)
    spread = np.sum((a**2 * variance)[..., None, None] * across, axis=-3)
    d = np.linalg.eigvalsh(information)
    singular = d[..., 0] <= PARALLEL * d[..., 2]
    safe = np.where(singular[..., None, None], np.eye(3), information)
    inverse = np.linalg.inv(safe)
    return np.where(singular[..., None, None], np.inf, inverse @ spread @ inverse)


def davenport_matrix(b: Array, r: Array, a: Array) -> Array:
    """K (..., 4, 4) with ``q^T K q = sum a_i r_i . R(q) b_i``, scalar first."""
    B = np.einsum("...n,...ni,...nj->...ij", a, r, b)
    z = np.sum(a[..., None] * np.cross(b, r), axis=-2)  # r . (v x b) = v . (b x r)
    sigma = np.trace(B, axis1=-2, axis2=-1)
    K = np.empty((*B.shape[:-2], 4, 4))
    K[..., 0, 0] = sigma
    K[..., 0, 1:] = K[..., 1:, 0] = z
    K[..., 1:, 1:] = B + np.swapaxes(B, -1, -2) - sigma[..., None, None] * np.eye(3)  # (44)
    return K


def adjugate(M: Array) -> Array:
    """Adjugate (..., 4, 4) of symmetric matrices, from 2x2 minors of the upper and the lower two rows."""
    m = {(i, j): M[..., i, j] for i in range(4) for j in range(4)}

    def minor(rows: tuple[int, int], i: int, j: int) -> Array:
        p, q = rows
        return m[p, i] * m[q, j] - m[p, j] * m[q, i]

    s = {(i, j): minor((0, 1), i, j) for i in range(4) for j in range(i + 1, 4)}
    c = {(i, j): minor((2, 3), i, j) for i in range(4) for j in range(i + 1, 4)}
    out = np.empty(M.shape)
    for k in range(4):
        x, y, w = (i for i in range(4) if i != k)
        sign = (-1.0) ** k
        for row, other, minors in ((0, 1, c), (1, 0, c), (2, 3, s), (3, 2, s)):
            value = m[other, x] * minors[y, w] - m[other, y] * minors[x, w] + m[other, w] * minors[x, y]
            out[..., k, row] = sign * (value if row in (0, 2) else -value)
    return out


# --- the working --------------------------------------------------------------------------------------


class _Problem(NamedTuple):
    b: Array
    r: Array
    a: Array
    n_used: NDArray[np.int64]


def _prepare(b: ArrayLike, r: ArrayLike, weights: ArrayLike | None) -> _Problem:
    """Unit directions and weights that sum to one; unusable directions with weight zero."""
    b, r = np.broadcast_arrays(np.asarray(b, dtype=np.float64), np.asarray(r, dtype=np.float64))
    a = np.ones(b.shape[-2]) if weights is None else np.asarray(weights, dtype=np.float64)
    (b, good_b), (r, good_r) = _units(b), _units(r)
    a = np.where(good_b & good_r & np.isfinite(a) & (a > 0), a, 0.0)
    total = a.sum(axis=-1, keepdims=True)
    return _Problem(b, r, a / np.where(total > 0, total, 1.0), np.sum(a > 0, axis=-1))


def _units(v: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Unit vectors, and which of `v` had a direction; the others become zero."""
    with np.errstate(invalid="ignore", over="ignore"):
        length = np.sqrt(np.sum(v * v, axis=-1))
    good = np.isfinite(length) & (length > 1e-100)
    safe = np.where(good, length, 1.0)[..., None]
    return np.where(good[..., None], v, 0.0) / safe, good


def _frame(v: Array) -> tuple[Array, Array]:
    """Right-handed frame (columns) from two directions, and the sine between them."""
    across = np.cross(v[..., 0, :], v[..., 1, :])
    sine = np.sqrt(np.sum(across**2, axis=-1))
    second = across / np.where(sine > 0, sine, 1.0)[..., None]
    return np.stack([v[..., 0, :], second, np.cross(v[..., 0, :], second)], axis=-1), sine


def _largest_of_two(p: _Problem) -> tuple[Array, Array]:
    """lambda of two directions in closed form, and its distance from the next eigenvalue.

    The eigenvalues are +-sqrt(a1^2 + a2^2 + 2 a1 a2 cos(theta_b -+ theta_r))                  Shuster & Oh (72)
    """
    cosines = np.sum(p.b[..., 0, :] * p.b[..., 1, :], axis=-1) * np.sum(p.r[..., 0, :] * p.r[..., 1, :], axis=-1)
    cross_b, cross_r = np.cross(p.b[..., 0, :], p.b[..., 1, :]), np.cross(p.r[..., 0, :], p.r[..., 1, :])
    sines = np.sqrt(np.sum(cross_b**2, axis=-1) * np.sum(cross_r**2, axis=-1))
    squares, product = np.sum(p.a**2, axis=-1), 2 * p.a[..., 0] * p.a[..., 1]
    lam = np.sqrt(np.maximum(squares + product * (cosines + sines), 0.0))
    second = np.sqrt(np.maximum(squares + product * (cosines - sines), 0.0))
    return lam, 2 * product * sines / np.maximum(lam + second, 1e-300)  # = lam - second without cancellation


def _largest_by_newton(K: Array, p: _Problem) -> Array:
    """Largest root of the characteristic polynomial, downwards from the sum of the weights       (70), (71)"""
    S = K[..., 1:, 1:] + K[..., 0, 0, None, None] * np.eye(3)
    z, sigma = K[..., 0, 1:], K[..., 0, 0]
    Sz = np.einsum("...ij,...j->...i", S, z)
    kappa = 0.5 * (np.trace(S, axis1=-2, axis2=-1) ** 2 - np.sum(S * S, axis=(-2, -1)))  # trace of adj S
    a, b = sigma**2 - kappa, sigma**2 + np.sum(z * z, axis=-1)
    c, d = np.linalg.det(S) + np.sum(z * Sz, axis=-1), np.sum(Sz * Sz, axis=-1)
    lam = np.sum(p.a, axis=-1)
    for _ in range(NEWTON_ROUNDS):
        f = lam**4 - (a + b) * lam**2 - c * lam + (a * b + c * sigma - d)
        slope = 4 * lam**3 - 2 * (a + b) * lam - c
        step = np.where(slope > 1e-12, f / np.where(slope > 1e-12, slope, 1.0), 0.0)
        lam = lam - step
        if np.max(np.abs(step), initial=0.0) < 1e-15:
            break
    return lam


def _finish(q: Array, loss: Array, gap: Array, p: _Problem) -> Attitudes:
    determined = (p.n_used >= 2) & (gap > PARALLEL)
    norm = np.sqrt(np.sum(q * q, axis=-1, keepdims=True))
    q = q / np.where(norm > 0, norm, 1.0)
    q = np.where(q[..., :1] < 0, -q, q)
    q = np.where(determined[..., None], q, np.nan)
    return Attitudes(q, np.where(p.n_used > 0, np.maximum(loss, 0.0), np.nan), determined, p.n_used)
