"""Least absolute deviations: minimise ``sum |A x - b|`` exactly, with a certificate.

A few rounds of iteratively reweighted least squares come near the optimum; from there a simplex method walks along
vertices (points where as many equations hold exactly as there are unknowns) to the exact one. At a vertex with rows K
the optimum is certified by numbers y with

    A^T y = 0,   y_i = sign(r_i) off K,   |y_i| <= 1 on K                                       (certificate)

the slopes of the cost along the edges: none leads down. ``-b^T y`` is then the same as the cost, which no other x can
undercut (duality).

Only rows near the fit can change their sign on the way, so the others are summed into one linear term; the signs are
looked at afterwards and rows that were wrongly taken for far come back. NumPy only; scipy's HiGHS is the oracle in the
tests.

Sources: Barrodale & Roberts, SIAM J. Numer. Anal. 10 (1973) 839 (edges and the weighted-median step); Portnoy &
Koenker, Statist. Sci. 12 (1997) 279 (far rows as one linear term).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from margcal.core.errors import DataError
from margcal.core.lsq import RANK_TOLERANCE
from margcal.core.types import Array, Index

ROUNDS = 15
"""Of reweighted least squares before the walk along vertices."""
SMALLEST_WEIGHT = 1e-7
"""Residuals below this part of the median count as this large in the weights."""
NEAR_ROWS = 400
"""Rows that are kept one by one at least, whatever their residual."""
NEAR_SHARE = 0.01
MAX_PIVOTS = 5000
TOLERANCE = 1e-9
"""By how much a slope may exceed 1 and still count as 1 (rounding of the sum over all rows)."""


@dataclass(frozen=True)
class LadFit:
    """Minimisers of ``sum |A x - b|``, a column a right-hand side.

    Attributes
    ----------
    x : ndarray (p, k)
    cost : ndarray (k,)
        ``sum |A x - b|``.
    rows : ndarray (k, p)
        The rows K that hold exactly.
    slopes : ndarray (k, p)
        y on K; all within [-1, 1] at the optimum.
    gap : ndarray (k,)
        Cost less the dual bound, relative to the cost: 0 up to rounding at the optimum.
    pivots : ndarray (k,)
        Steps from vertex to vertex.
    """

    x: Array
    cost: Array
    rows: Index
    slopes: Array
    gap: Array
    pivots: Index


def least_absolute(A: ArrayLike, b: ArrayLike) -> LadFit:
    """Minimise ``sum |A x - b|`` for every column of b.

    Parameters
    ----------
    A : array_like (n, p), n > p, of full column rank
    b : array_like (n, k) or (n,)

    Raises
    ------
    DataError
        If the columns of A depend on each other.
    """
    A, b = np.ascontiguousarray(A, dtype=np.float64), np.asarray(b, dtype=np.float64)
    b = b.reshape(len(A), -1)
    Q, R = _orthonormal(A)
    found = [_one(Q, column) for column in b.T]
    z = np.column_stack([f.z for f in found])
    x = np.asarray(np.linalg.solve(R, z), dtype=np.float64)
    return LadFit(
        x,
        np.array([f.cost for f in found]),
        np.array([f.rows for f in found]),
        np.array([f.slopes for f in found]),
        np.array([f.gap for f in found]),
        np.array([f.pivots for f in found]),
    )


def least_lengths(A: ArrayLike, b: ArrayLike, *, rounds: int = 60) -> tuple[Array, float]:
    """Minimise ``sum_i |A_i x - b_i|_2``, the sum of the lengths of the rows' residuals (does not depend on axes).

    Parameters
    ----------
    A : array_like (n, p)
    b : array_like (n, k)

    Returns
    -------
    x : ndarray (p, k)
    cost : float
        By reweighting; to about 1e-6 of the cost.
    """
    A, b = np.ascontiguousarray(A, dtype=np.float64), np.asarray(b, dtype=np.float64)
    Q, R = _orthonormal(A)
    z = Q.T @ b
    for _ in range(rounds):
        length = np.linalg.norm(Q @ z - b, axis=1)
        w = 1 / np.maximum(length, SMALLEST_WEIGHT * _typical(length))
        z, last = np.linalg.solve((Q * w[:, None]).T @ Q, (Q * w[:, None]).T @ b), z
        if np.abs(z - last).max() <= 1e-10 * np.abs(z).max():
            break
    x = np.asarray(np.linalg.solve(R, z), dtype=np.float64)
    return x, float(np.linalg.norm(Q @ z - b, axis=1).sum())


def _orthonormal(A: Array) -> tuple[Array, Array]:
    """A = Q R with orthogonal columns of Q whose entries are of order one."""
    n, p = A.shape
    if n <= p:
        raise DataError(f"{n} equations for {p} unknowns; more samples are needed")
    scale = np.sqrt(np.einsum("ij,ij->j", A, A) / n)
    if not (np.isfinite(scale).all() and (scale > 0).all()):
        raise DataError("an unknown has no share in any equation (a column of zeros), or a value is not finite")
    Q, R = np.linalg.qr(A / scale)
    diagonal = np.abs(np.diag(R))
    if diagonal.min() < RANK_TOLERANCE * diagonal.max():
        raise DataError("the equations do not determine all unknowns (columns depend on each other)")
    root = np.sqrt(n)
    return np.ascontiguousarray(Q * root), R * scale / root


def _typical(size: Array) -> float:
    return float(np.partition(size, len(size) // 2)[len(size) // 2]) + 1e-300


@dataclass
class _Vertex:
    """State of the walk: rows K, the signs of all others, and what came of it."""

    z: Array
    rows: Index
    slopes: Array
    pivots: int = 0
    cost: float = 0.0
    gap: float = float("inf")


def _one(Q: Array, b: Array) -> _Vertex:
    z, r = _reweighted(Q, b)
    size = np.abs(r)
    count = min(len(b), max(NEAR_ROWS, int(NEAR_SHARE * len(b))))
    near = np.argpartition(size, count - 1)[:count] if count < len(b) else np.arange(len(b))
    rows = _start(Q, near[np.argsort(size[near])])
    sign = np.where(r >= 0, 1.0, -1.0)
    vertex = _Vertex(z, rows, np.zeros(len(rows)))
    while True:
        bounded = _walk(Q, b, near, sign, vertex)
        r = Q @ vertex.z - b
        r[vertex.rows] = 0.0
        wrong = r * sign < 0
        wrong[near] = False  # these were looked after one by one
        if bounded and not wrong.any():
            break
        more = np.flatnonzero(wrong)
        if not bounded:
            count = min(len(b), 4 * len(near))
            more = np.union1d(more, np.argpartition(np.abs(r), count - 1)[:count])
        near = np.union1d(near, more)
        sign[more] = np.where(r[more] >= 0, 1.0, -1.0)
    y = sign
    y[vertex.rows] = vertex.slopes
    y = y / max(1.0, float(np.abs(vertex.slopes).max()))
    vertex.cost = float(np.abs(r).sum())
    vertex.gap = float(np.sum(np.abs(r) - y * r)) / max(vertex.cost, 1e-300)
    return vertex


def _reweighted(Q: Array, b: Array) -> tuple[Array, Array]:
    z: Array = Q.T @ b / len(b)
    r = Q @ z - b
    for _ in range(ROUNDS):
        size = np.abs(r)
        w = 1 / np.maximum(size, SMALLEST_WEIGHT * _typical(size))
        weighted = Q * w[:, None]
        z = np.asarray(np.linalg.solve(weighted.T @ Q, weighted.T @ b), dtype=np.float64)
        r = Q @ z - b
    return z, r


def _start(Q: Array, order: Index) -> Index:
    """The first rows of `order` that are independent, as many as there are unknowns."""
    p = Q.shape[1]
    rows: list[int] = []
    basis = np.zeros((0, p))
    for least in (1e-2, 1e-6):
        for i in order:
            row = Q[i] - basis.T @ (basis @ Q[i])
            length = np.linalg.norm(row)
            if length > least * np.linalg.norm(Q[i]) and i not in rows:
                rows.append(int(i))
                basis = np.vstack([basis, row / length])
                if len(rows) == p:
                    return np.array(rows)
    raise DataError("the equations do not determine all unknowns (rows near the fit depend on each other)")


def _walk(Q: Array, b: Array, near: Index, sign: Array, vertex: _Vertex) -> bool:
    """From vertex to vertex downhill, among the rows `near`; the others keep their signs. False: no lowest vertex."""
    place = np.full(len(b), -1)
    place[near] = np.arange(len(near))
    N, c, s = Q[near], b[near], sign[near]
    K = place[vertex.rows]
    far = sign.copy()
    far[near] = 0.0
    pull = far @ Q
    at_start = N @ np.linalg.solve(N[K], c[K]) - c
    s = np.where(at_start == 0, s, np.sign(at_start))
    bounded, done = True, False
    while not done and vertex.pivots < MAX_PIVOTS:
        corner = N[K]
        vertex.z = np.asarray(np.linalg.solve(corner, c[K]), dtype=np.float64)
        s[K] = 0.0
        slopes = np.asarray(np.linalg.solve(corner.T, -(pull + s @ N)), dtype=np.float64)
        worst = int(np.argmax(np.abs(slopes)))
        vertex.slopes = slopes
        if abs(slopes[worst]) <= 1 + TOLERANCE:
            done = True
            break
        side = float(np.sign(slopes[worst]))
        edge = np.linalg.solve(corner, side * np.eye(len(K))[worst])
        enters, passed = _along(N, c, s, vertex.z, edge, K, abs(float(slopes[worst])) - 1)
        if enters < 0:
            bounded = False
            break
        s[passed] *= -1
        s[K[worst]] = side
        K[worst] = enters
        vertex.pivots += 1
    vertex.rows = near[K]
    sign[near] = s
    return bounded


def _along(N: Array, c: Array, s: Array, z: Array, edge: Array, K: Index, fall: float) -> tuple[int, Index]:
    """The row at which the cost stops falling along `edge`, and those that change their sign before it."""
    speed = N @ edge
    closing = np.flatnonzero(s * speed < -1e-14)
    closing = closing[~np.isin(closing, K)]
    if not len(closing):
        return -1, closing
    r = N[closing] @ z - c[closing]
    when = np.maximum(-r / speed[closing], 0.0)
    order = np.argsort(when, kind="stable")
    climbed = np.cumsum(2 * np.abs(speed[closing[order]]))
    stop = int(np.searchsorted(climbed, fall))
    if stop == len(order):
        return -1, closing
    return int(closing[order[stop]]), closing[order[:stop]]
