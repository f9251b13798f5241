"""Transformation matrix eliminated: the quadratic form in the sensed vector that is left, and its optimum.

Not in the papers, but equivalent to Z-TIE (25)-(26): for a given u the best H is linear in it, and what
remains of the cost is ``u^T M u``. `transform.eigen` uses it with the bias known, `one_step` with readings
and rotations centred, which eliminates the bias too.
"""

from __future__ import annotations

import numpy as np

from margcal.core.types import Array
from margcal.methods.affine import positive, predicted, unobservable

HOPELESS = 1e-4
"""Poses below this part of full observability (an eigenvalue over J) are refused; else the covariance decides."""

MANY = 32
"""From this many nodes on the 3x3 eigenproblem is solved in closed form for all at once, not by LAPACK."""


def quadratic_form(Z: Array, R: Array) -> tuple[Array, Array, Array]:
    """What is left of (25) when H is eliminated: ``min_H sum |R_j u - H z_j|^2 = u^T M u``.

    With the readings' Gram matrix Z^T Z = L L^T, the rows of ``D = L^-1 Z^T R`` are the rotations projected
    on an orthonormal basis of the readings, and ``M = sum R_j^T R_j - D^T D``.

    Parameters
    ----------
    Z : ndarray (..., J, 3)
    R : ndarray (J, 3, 3) or (..., J, 3, 3)

    Returns
    -------
    M (..., 3, 3), D (..., 3, 3, 3) as [basis, row of H, component of u], L (..., 3, 3)
    """
    J = Z.shape[-2]
    Zt = np.ascontiguousarray(np.swapaxes(Z, -1, -2))
    gram = Zt @ Z
    flat = R.reshape(*R.shape[:-2], 9)
    # shared poses: one matrix product for all nodes
    C = (Zt.reshape(-1, J) @ flat).reshape(*Zt.shape[:-1], 9) if R.ndim == 3 else Zt @ flat
    L = _cholesky3(gram)
    D = np.empty_like(C)
    D[..., 0, :] = C[..., 0, :] / L[..., 0, 0, None]
    D[..., 1, :] = (C[..., 1, :] - L[..., 1, 0, None] * D[..., 0, :]) / L[..., 1, 1, None]
    D[..., 2, :] = (C[..., 2, :] - L[..., 2, 0, None] * D[..., 0, :] - L[..., 2, 1, None] * D[..., 1, :]) / L[
        ..., 2, 2, None
    ]
    rows = D.reshape(*D.shape[:-2], 9, 3)
    stacked = R.reshape(*R.shape[:-3], 3 * J, 3)
    total = np.swapaxes(stacked, -1, -2) @ stacked
    M = total - np.swapaxes(rows, -1, -2) @ rows
    return M, D.reshape(*D.shape[:-1], 3, 3), L


def _cholesky3(S: Array) -> Array:
    """Lower Cholesky factor of (..., 3, 3), elementwise; a pivot that is not positive becomes tiny."""
    tiny = np.finfo(float).tiny ** 0.5
    L = np.zeros_like(S)
    with np.errstate(over="ignore"):
        L[..., 0, 0] = np.sqrt(np.maximum(S[..., 0, 0], tiny))
        L[..., 1, 0] = S[..., 1, 0] / L[..., 0, 0]
        L[..., 2, 0] = S[..., 2, 0] / L[..., 0, 0]
        L[..., 1, 1] = np.sqrt(np.maximum(S[..., 1, 1] - L[..., 1, 0] ** 2, tiny))
        L[..., 2, 1] = (S[..., 2, 1] - L[..., 2, 0] * L[..., 1, 0]) / L[..., 1, 1]
        L[..., 2, 2] = np.sqrt(np.maximum(S[..., 2, 2] - L[..., 2, 0] ** 2 - L[..., 2, 1] ** 2, tiny))
    return L


def optimum(Z: Array, R: Array) -> tuple[Array, Array, Array]:
    """Unit vector u and matrix A that minimise ``sum |R_j u - A z_j|^2``; eigenvalues of M, ascending."""
    M, D, L = quadratic_form(Z, R)
    u, eigenvalues = smallest_eigenvector(M)
    E = (D.reshape(*u.shape[:-1], 9, 3) @ u[..., None]).reshape(M.shape)  # [basis, row of A]
    A = np.empty_like(M)
    A[..., 2] = E[..., 2, :] / L[..., 2, 2, None]
    A[..., 1] = (E[..., 1, :] - A[..., 2] * L[..., 2, 1, None]) / L[..., 1, 1, None]
    A[..., 0] = (E[..., 0, :] - A[..., 1] * L[..., 1, 0, None] - A[..., 2] * L[..., 2, 0, None]) / L[..., 0, 0, None]
    A, u = positive(A, u)
    return u, A, eigenvalues


def smallest_eigenvector(M: Array) -> tuple[Array, Array]:
    """Unit eigenvector of the smallest eigenvalue of positive semidefinite M (..., 3, 3); all eigenvalues."""
    if M.size < 9 * MANY:
        eigenvalues, vectors = np.linalg.eigh(M)
        return np.ascontiguousarray(vectors[..., 0]), eigenvalues
    size = np.trace(M, axis1=-2, axis2=-1)
    size = np.where(size > 0, size, 1.0)
    m = M / size[..., None, None]
    a, b, c = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    d, e, f = m[..., 0, 1], m[..., 0, 2], m[..., 1, 2]
    c2, c1 = a + b + c, a * b + a * c + b * c - d * d - e * e - f * f
    c0 = a * (b * c - f * f) - d * (d * c - e * f) + e * (d * f - e * b)
    # -det(M - x I) = x^3 - c2 x^2 + c1 x - c0 rises and is concave left of its first root: Newton from 0
    # stays left
    x = np.zeros_like(c0)
    for _ in range(60):
        slope = np.maximum((3 * x - 2 * c2) * x + c1, 1e-300)
        step = (c0 - x * (c1 - x * (c2 - x))) / slope
        x = x + step
        if np.max(step) <= 1e-15:
            break
    half = (c2 - x) / 2
    gap = np.sqrt(np.maximum(half * half - (c1 - x * 2 * half), 0.0))
    eigenvalues = np.stack([x, half - gap, half + gap], axis=-1) * size[..., None]
    return _adjugate_column(a - x, b - x, c - x, d, e, f), eigenvalues


def _adjugate_column(a: Array, b: Array, c: Array, d: Array, e: Array, f: Array) -> Array:
    """Null vector of [[a d e], [d b f], [e f c]]: the longest column of its adjugate, normalised."""
    ab, ac, bc = a * b - d * d, a * c - e * e, b * c - f * f  # diagonal: squares of the vector's components
    ade, adf, aef = e * f - d * c, d * f - b * e, d * e - a * f
    columns = np.stack([np.stack([bc, ade, adf], -1), np.stack([ade, ac, aef], -1), np.stack([adf, aef, ab], -1)], -2)
    best = np.argmax(np.stack([bc, ac, ab], -1), axis=-1)
    v = np.take_along_axis(columns, best[..., None, None], axis=-2)[..., 0, :]
    length = np.sqrt(np.einsum("...i,...i->...", v, v))
    return v / np.where(length > 0, length, 1.0)[..., None]


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
