"""Bias, transformation matrix and sensed vector together, in closed form, from poses with known rotations.

Not in the papers: the cost is Z-TIE (25)-(26) with the bias among the unknowns, so that no ellipsoid is
needed and five poses suffice. Centring readings and rotations over the poses eliminates B:

    c_j = R_j - mean R,  z_j = y_j - mean y:   min sum |c_j u - H z_j|^2,  |u| = G
    M_c = sum c_j^T c_j - W^T W,  W the projection of the c_j on the row space of the z_j
    u: M_c's smallest eigenvector of length G;   H = (sum c_j u z_j^T)(sum z_j z_j^T)^-1;   B = mean y - H^-1
    mean(R) u
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from margcal.core import lsq
from margcal.core.errors import InputError
from margcal.core.types import Array, Fit, Kind
from margcal.methods.affine import (
    MIN_POSES,
    As,
    checked_readings,
    checked_rotations,
    inverse3,
    model_of,
    pose_residual,
    scaled,
    tangents,
    unscaled_covariance,
)
from margcal.methods.elimination import optimum, refuse_unobservable


def one_step(
    y: ArrayLike,
    R: ArrayLike,
    magnitude: float,
    *,
    kind: Kind = "acc",
    raw_unit: str = "count",
    unit: str = "",
    weights: ArrayLike | None = None,
    sigma: float | None = None,
    covariance: bool | None = None,
) -> Fit:
    """Bias, transformation and sensed vector together, in closed form.

    Minimises ``sum w_j |R_j u - H (y_j - B)|^2`` subject to ``|u| = magnitude``: [1] (25)-(26) with the bias
    among the unknowns. Centring readings and rotations over the poses eliminates B; what is left is a
    quadratic form in u, whose smallest eigenvector is the solution.

    Parameters
    ----------
    y : array_like (..., J, 3), raw unit
        Mean reading of each pose; leading axes are nodes.
    R : array_like (J, 3, 3) or (..., J, 3, 3)
    magnitude : float, calibrated unit
    weights : array_like (J,) or (..., J), optional
        Inverse variance of each pose's reading up to a factor.
    sigma : float, raw unit, optional
        Standard deviation of a reading (of weight 1); from the residuals where not given.
    covariance : bool, optional
        Whether to compute it; by default for a single node only.

    Returns
    -------
    Fit
        `rank` and `condition` are those of the column-scaled problem in 14 unknowns (H, B, two of u).
        `details`: `lambda` (..., 3) eigenvalues of M_c over J (of total weight J; the second below .1: look;
        below .01: hopeless),
        `sigma` the reading noise used, `u_covariance` (3, 3). In a batch, nodes that cannot be solved
        are NaN and `converged` is False.

    Raises
    ------
    DataError
        With fewer than five poses, or (single node) poses that do not determine H, naming what is missing.
    InputError
        Where shapes do not fit or a matrix is not a rotation.

    Notes
    -----
    Not in the papers. With reading noise alone the RMS error is within 3 % of the Cramer-Rao bound.
    """
    y = checked_readings(y, kind, MIN_POSES)
    R = checked_rotations(R, y.shape[-2])
    w = _checked_weights(weights, y.shape[-2])
    best = optimum(y, R, w, centred=True)
    if y.ndim == 2:
        refuse_unobservable(kind, R, best.u, best.eigenvalues)
    else:
        best.A[best.lost], best.u[best.lost] = np.nan, np.nan
    H, u = magnitude * best.A, magnitude * best.u
    B = best.centre - (inverse3(best.A) @ best.turned[..., None])[..., 0]
    squares = magnitude**2 * best.squares
    residual = np.sqrt(squares)
    details = {"lambda": best.eigenvalues / y.shape[-2]}
    cov, rank, condition = None, 14, float("nan")
    if covariance or (covariance is None and y.ndim == 2):
        cov, rank, condition, extra = _uncertainty(y, R, H, B, u, magnitude, w, sigma)
        details |= extra
    n_lost = int(best.lost.sum()) if y.ndim > 2 else 0
    return Fit(
        model_of(As(kind, raw_unit, unit), H, B, "one-step", residual, cov),
        residual,
        (squares if w is None else w * squares).sum(axis=-1),
        "one-step",
        "not in the papers: (25)-(26) of Z-TIE with the bias included",
        u=u,
        covariance=cov,
        rank=rank,
        condition=condition,
        converged=n_lost == 0,
        details=details,
        text=f"{n_lost} of {best.lost.size} nodes: their poses do not determine H" if n_lost else "",
    )


def _checked_weights(weights: ArrayLike | None, J: int) -> Array | None:
    """Weights scaled to mean 1 over the poses, or None."""
    if weights is None:
        return None
    w = np.asarray(weights, dtype=np.float64)
    if w.shape[-1:] != (J,) or not (np.isfinite(w).all() and (w > 0).all()):
        raise InputError(f"weights must be {J} positive numbers, one a pose; got shape {w.shape}")
    return w / w.mean(axis=-1, keepdims=True)


def _uncertainty(
    y: Array, R: Array, H: Array, B: Array, u: Array, magnitude: float, w: Array | None, sigma: float | None
) -> tuple[Array, int, float, dict[str, Array]]:
    """Covariance of a single node's estimate, from the problem linearised at the solution.

    The misfit of a pose is -H n_j for reading noise n_j, so its covariance is sigma^2 H H^T / w_j while the
    method weighs by w_j alone: the sandwich ``(J'WJ)^-1 J'W S WJ (J'WJ)^-1`` is the estimate's true
    covariance.
    """
    if y.ndim != 2:
        raise InputError("covariance: one node at a time; this is a batch")
    J = len(y)
    w = np.ones(J) if w is None else w
    data = scaled(y)
    A, a = H * (data.scale / magnitude), (H @ (data.centre - B)) / magnitude
    T = tangents(u)
    jacobian = np.zeros((J, 3, 14))
    for i in range(3):
        jacobian[:, i, 3 * i : 3 * i + 3] = -data.z
        jacobian[:, i, 9 + i] = -1.0
    jacobian[:, :, 12:] = R @ T
    root = np.sqrt(w)[:, None, None]
    solved = lsq.linear((root * jacobian).reshape(-1, 14), np.zeros(3 * J))
    raw = pose_residual(y, R, H, B, u) @ np.linalg.inv(H).T
    if sigma is None:
        sigma = float(np.sqrt(np.sum(w[:, None] * raw * raw) / max(3 * J - 14, 1)))
    scores = np.einsum("jip,il->jlp", root * jacobian, H * (sigma / magnitude)).reshape(-1, 14)
    half = scores @ solved.cofactor
    full = half.T @ half
    details = {"sigma": np.array(sigma), "u_covariance": magnitude**2 * (T @ full[12:, 12:] @ T.T)}
    covariance = unscaled_covariance(full[:12, :12], A, a, data, magnitude)
    return covariance, solved.rank, solved.condition, details
