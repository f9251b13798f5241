"""Transformation matrix eliminated: the quadratic form in the sensed vector that is left, and its optimum.

Not in the papers, but equivalent to Z-TIE (25)-(26): for a given u the best H is linear in it, and what
remains of the cost is ``u^T M u``. `transform.eigen` uses it with the bias known, `one_step` with readings
and rotations centred, which eliminates the bias too.

Inside, the axis of nodes is the last one: (J, 3, n), (3, 3, n). Every step is then an operation on contiguous
rows of n numbers or one large matrix product, and a batch costs a few microseconds a node. Blocks of nodes
keep the work in cache.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from margcal.core.types import Array
from margcal.methods.affine import predicted, unobservable

HOPELESS = 1e-4
"""Poses below this part of full observability (an eigenvalue over J) are refused; else the covariance decides."""

MANY = 32
"""From this many nodes on the 3x3 eigenproblem is solved in closed form for all at once, not by LAPACK."""

BLOCK = 1024
"""Nodes that are worked on together."""


class Optimum(NamedTuple):
    """Minimum of ``sum w_j |R_j u - A (y_j - B)|^2`` over |u| = 1, A, and (where centred) B.

    Attributes
    ----------
    u : ndarray (..., 3)
    A : ndarray (..., 3, 3), det > 0
    eigenvalues : ndarray (..., 3)
        Of M, ascending.
    squares : ndarray (..., J)
        ``|R_j u - A (y_j - B)|^2``.
    centre, turned : ndarray (..., 3)
        Weighted means of the readings and of R_j u, zero where not centred: ``A (centre - B) = turned``.
    lost : ndarray (...,) of bool
        A second u fits as well, or the vectors R_j u do not reach all three dimensions.
    """

    u: Array
    A: Array
    eigenvalues: Array
    squares: Array
    centre: Array
    turned: Array
    lost: NDArray[np.bool_]


def optimum(y: Array, R: Array, w: Array | None = None, *, centred: bool) -> Optimum:
    """The optimum for readings y (..., J, 3), rotations R (J, 3, 3) or (..., J, 3, 3), weights (J,) or (..., J).

    `centred` says whether B is among the unknowns; else it must have been subtracted. Weights have mean 1.
    """
    lead, J = y.shape[:-2], y.shape[-2]
    nodes = y.reshape(-1, J, 3)
    own_R = np.broadcast_to(R, (*lead, J, 3, 3)).reshape(-1, J, 3, 3) if R.ndim > 3 else None
    own_w = np.broadcast_to(w, (*lead, J)).reshape(-1, J) if w is not None and w.ndim > 1 else None
    parts = []
    for i in range(0, len(nodes), BLOCK):
        some = slice(i, i + BLOCK)
        parts.append(
            _block(nodes[some], R if own_R is None else own_R[some], w if own_w is None else own_w[some], centred)
        )
    joined = parts[0] if len(parts) == 1 else [np.concatenate(column) for column in zip(*parts)]
    return Optimum(*(np.reshape(a, (*lead, *a.shape[1:])) for a in joined))


def _block(y: Array, R: Array, w: Array | None, centred: bool) -> Optimum:
    """`optimum` of n nodes: y (n, J, 3), R (J, 3, 3) or (n, J, 3, 3), w None, (J,) or (n, J)."""
    n, J, _ = y.shape
    Z = np.array(y.transpose(1, 2, 0), order="C")  # a copy in any case: it is centred in place
    Q = np.ascontiguousarray(R[..., None] if R.ndim == 3 else R.transpose(1, 2, 3, 0))  # (J, 3, 3, 1 or n)
    weights = np.ones((J, 1)) if w is None else w[:, None] if w.ndim == 1 else np.ascontiguousarray(w.T)
    centre, Q_mean = np.zeros((3, n)), np.zeros((3, 3, 1))
    if centred:
        centre, Q_mean = _weighted_mean(Z, weights), _weighted_mean(Q, weights)
        Z -= centre
        Q = Q - Q_mean
    root = None if w is None else np.sqrt(weights)
    M, D, L = quadratic_form(Z if root is None else Z * root[:, None], Q if root is None else Q * root[:, None, None])
    u, eigenvalues = smallest_eigenvector(M)
    E = _times(D, u)  # [basis, row of A, node]
    A = np.empty_like(M)
    A[:, 2] = E[2] / L[2, 2]
    A[:, 1] = (E[1] - A[:, 2] * L[2, 1]) / L[1, 1]
    A[:, 0] = (E[0] - A[:, 1] * L[1, 0] - A[:, 2] * L[2, 0]) / L[0, 0]
    sign = np.where(_determinant(A) < 0, -1.0, 1.0)
    A *= sign
    u *= sign
    squares = np.zeros((J, n))
    for row in range(3):
        misfit = _times(Q[:, row], u)
        for a in range(3):
            misfit -= A[row, a] * Z[:, a]
        squares += misfit * misfit
    turned = np.broadcast_to(_times(Q_mean, u), (3, n))
    return Optimum(u.T, A.transpose(2, 0, 1), eigenvalues.T, squares.T, centre.T, turned.T, _lost(eigenvalues, E, J))


def _weighted_mean(rows: Array, weights: Array) -> Array:
    """Mean over the first axis (poses); `weights` (J, 1 or n)."""
    shaped = weights.reshape(len(weights), *(1,) * (rows.ndim - 2), -1)
    return np.sum(rows * shaped, axis=0) / len(rows)


def _times(T: Array, u: Array) -> Array:
    """``T u`` over the last but one axis: T (..., 3, 1 or n), u (3, n) -> (..., n)."""
    if T.shape[-1] == 1 and u.shape[-1] > 1:
        return (T.reshape(-1, 3) @ u).reshape(*T.shape[:-2], -1)
    return T[..., 0, :] * u[0] + T[..., 1, :] * u[1] + T[..., 2, :] * u[2]


def quadratic_form(Z: Array, Q: Array) -> tuple[Array, Array, Array]:
    """What is left of (25) when H is eliminated: ``min_A sum |R_j u - A z_j|^2 = u^T M u``.

    With the readings' Gram matrix Z^T Z = L L^T, the rows of ``D = L^-1 Z^T R`` are the rotations projected
    on an orthonormal basis of the readings, and ``M = sum R_j^T R_j - D^T D``.

    Parameters
    ----------
    Z : ndarray (J, 3, n)
    Q : ndarray (J, 3, 3, n), or (J, 3, 3, 1) for poses that the nodes share

    Returns
    -------
    M (3, 3, n), D (3, 3, 3, n) as [basis, row of A, component of u, node], L (3, 3, n)
    """
    J, _, n = Z.shape
    L = _cholesky(np.einsum("jan,jbn->abn", Z, Z))
    if Q.shape[-1] == 1:
        D = (Q.reshape(J, 9).T @ Z.reshape(J, 3 * n)).reshape(9, 3, n).transpose(1, 0, 2).copy()
        flat = Q.reshape(3 * J, 3)
        total = (flat.T @ flat)[..., None]
    else:
        D = np.einsum("jan,jkn->akn", Z, Q.reshape(J, 9, n))
        total = np.einsum("jikn,jiln->kln", Q, Q)
    D[0] /= L[0, 0]
    D[1] = (D[1] - L[1, 0] * D[0]) / L[1, 1]
    D[2] = (D[2] - L[2, 0] * D[0] - L[2, 1] * D[1]) / L[2, 2]
    rows = D.reshape(9, 3, n)
    return total - np.einsum("rkn,rln->kln", rows, rows), D.reshape(3, 3, 3, n), L


def _cholesky(S: Array) -> Array:
    """Lower Cholesky factor of (3, 3, n); a pivot that is not positive becomes tiny."""
    tiny = np.finfo(float).tiny ** 0.5
    L = np.zeros_like(S)
    with np.errstate(over="ignore"):
        L[0, 0] = np.sqrt(np.maximum(S[0, 0], tiny))
        L[1, 0], L[2, 0] = S[1, 0] / L[0, 0], S[2, 0] / L[0, 0]
        L[1, 1] = np.sqrt(np.maximum(S[1, 1] - L[1, 0] ** 2, tiny))
        L[2, 1] = (S[2, 1] - L[2, 0] * L[1, 0]) / L[1, 1]
        L[2, 2] = np.sqrt(np.maximum(S[2, 2] - L[2, 0] ** 2 - L[2, 1] ** 2, tiny))
    return L


def _determinant(A: Array) -> Array:
    """Of (3, 3, n)."""
    return (
        A[0, 0] * (A[1, 1] * A[2, 2] - A[1, 2] * A[2, 1])
        - A[0, 1] * (A[1, 0] * A[2, 2] - A[1, 2] * A[2, 0])
        + A[0, 2] * (A[1, 0] * A[2, 1] - A[1, 1] * A[2, 0])
    )


def _lost(eigenvalues: Array, E: Array, J: int) -> NDArray[np.bool_]:
    """Nodes whose A is not determined. E^T E is the spread of the R_j u.

    Its least eigenvalue is at least 4 det / trace^2, and near that when it is small.
    """
    size = np.einsum("abn,abn->n", E, E)
    reach = 4 * _determinant(E) ** 2 / np.maximum(size, 1e-150) ** 2
    return np.asarray((eigenvalues[1] < HOPELESS * J) | (reach < HOPELESS * J))


def smallest_eigenvector(M: Array) -> tuple[Array, Array]:
    """Unit eigenvector (3, n) of the least eigenvalue of positive semidefinite M (3, 3, n); all eigenvalues."""
    if M.shape[-1] < MANY:
        eigenvalues, vectors = np.linalg.eigh(M.transpose(2, 0, 1))
        return np.ascontiguousarray(vectors[:, :, 0].T), eigenvalues.T
    size = M[0, 0] + M[1, 1] + M[2, 2]
    size = np.where(size > 0, size, 1.0)
    m = M / size
    a, b, c, d, e, f = m[0, 0], m[1, 1], m[2, 2], m[0, 1], m[0, 2], m[1, 2]
    c2, c1 = a + b + c, a * b + a * c + b * c - d * d - e * e - f * f
    c0 = a * (b * c - f * f) - d * (d * c - e * f) + e * (d * f - e * b)
    # -det(M - x I) = x^3 - c2 x^2 + c1 x - c0 rises and is concave left of its first root: Newton from 0
    # stays there
    x = np.zeros_like(c0)
    for _ in range(60):
        step = (c0 - x * (c1 - x * (c2 - x))) / np.maximum((3 * x - 2 * c2) * x + c1, 1e-300)
        x = x + step
        if np.max(step) <= 1e-15:
            break
    half = (c2 - x) / 2
    gap = np.sqrt(np.maximum(half * half - (c1 - x * 2 * half), 0.0))
    return _null_vector(a - x, b - x, c - x, d, e, f), np.stack([x, half - gap, half + gap]) * size


def _null_vector(a: Array, b: Array, c: Array, d: Array, e: Array, f: Array) -> Array:
    """Unit null vector (3, n) of [[a d e], [d b f], [e f c]]: the longest column of its adjugate."""
    xx, yy, zz = b * c - f * f, a * c - e * e, a * b - d * d  # squares of the components, up to a factor
    xy, xz, yz = e * f - d * c, d * f - b * e, d * e - a * f
    first, second = (xx >= yy) & (xx >= zz), yy >= zz
    v = np.stack([np.where(first, p, np.where(second, q, r)) for p, q, r in ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))])
    length = np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    return v / np.where(length > 0, length, 1.0)


def _words(direction: Array) -> str:
    """A direction as (0.0, 0.7, -0.7), signed so that its largest component is positive."""
    direction = direction * np.sign(direction[np.argmax(np.abs(direction))])
    return "(" + ", ".join(f"{x + 0.0:.1f}" for x in np.round(direction, 1)) + ")"


def refuse_unobservable(kind: str, R: Array, u: Array, eigenvalues: Array) -> None:
    """Raise if the poses do not determine H: what is missing, in words.

    Looked at in this order: rotations about a single axis leave the part of u along it unknown; a sensed
    vector that stays in one plane of the housing leaves one row of H unknown; anything else shows as a second
    small eigenvalue.

    Raises
    ------
    DataError
    """
    J = len(R)
    centred = R - R.mean(axis=0)
    spread, axes = np.linalg.eigh(np.einsum("jik,jil->kl", centred, centred) / J)
    if spread[1] < HOPELESS:
        raise unobservable(
            kind,
            "all poses are the same attitude; turn the node between them",
            spread[1],
            HOPELESS,
            "same-attitude",
        )
    if spread[0] < HOPELESS:
        axis = np.mean(R @ axes[:, 0], axis=0)  # in node components: the same in every pose
        text = f"the poses only turn about one axis {_words(axis)}; turn about a second one"
        raise unobservable(kind, text, spread[0], HOPELESS, "one-axis")
    s = predicted(centred, u)
    reach, normals = np.linalg.eigh(s.T @ s / J)
    if reach[0] < HOPELESS:
        plane = _words(normals[:, 0])
        text = f"the sensed vector stays in the plane across axis {plane}; tilt that axis up and down too"
        raise unobservable(kind, text, reach[0], HOPELESS, "one-plane")
    if eigenvalues[1] / J < HOPELESS:
        text = (
            "the poses fit two different sensed vectors equally well "
            f"(lambda2/J {eigenvalues[1] / J:.1e}); add poses turned about other axes"
        )
        raise unobservable(kind, text, eigenvalues[1] / J, HOPELESS, "two-vectors")
