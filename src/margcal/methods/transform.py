"""Transformation matrix H (and bias B) of accelerometer or magnetometer from poses with known rotations.

[1] Z. Zhang, "Two-step calibration methods for miniature inertial and magnetic sensor units", IEEE Trans.
    Industrial Electronics, 2015 (Z-TIE), section II.B.2, equations (23)-(36) and appendix.
[2] Z.-Q. Zhang, G.-Z. Yang, "Micromagnetometer calibration for accurate orientation estimation", IEEE Trans.
    Biomedical Engineering 62(2), 2015 (ZY-TBME), section II.C, equations (23)-(33).

name here    symbol in [1], [2]   meaning                                                      shape
y            y_a^j, g_j           raw reading of pose j                                        (..., J, 3)
R            R_j^i                takes the sensed vector of reference pose i to that of j     (J, 3, 3) or
(..., J, 3, 3) magnitude    G, M                 length of the sensed vector
() bias, B      B_a, B               combined bias                                                (..., 3)
H            H_a, H               transformation matrix                                        (..., 3, 3)
u            u_a^i, u_i           sensed vector in the reference pose                          (..., 3)
Y            Y_a (27)             readings less bias, a column a pose                          (..., 3, J)

`alternation` and `svd` are the papers' methods, verbatim; `eigen` is the global optimum of [1] (25)-(26) that
`alternation` approaches; `one_step` solves for bias, H and u together. Where u is wanted in the laboratory,
R_j = R_nh(j)^T; with R_j^i = R_nh(j)^T R_nh(i) it is that of pose i. All return det H > 0: (H, u) and (-H,
-u) fit equally well, and the caller, who may know the dip, flips a magnetometer's.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from margcal.core import lsq
from margcal.core.errors import InputError
from margcal.core.types import Array, Fit, Kind
from margcal.methods import two_step
from margcal.methods.affine import (
    MIN_POSES,
    As,
    checked_readings,
    checked_rotations,
    determinant3,
    model_of,
    pose_residual,
    positive,
    predicted,
)
from margcal.methods.elimination import optimum, refuse_unobservable
from margcal.methods.ellipsoid import ellipsoid
from margcal.methods.levelled import level_prior
from margcal.methods.one_step import one_step

__all__ = ["alternation", "eigen", "level_prior", "one_step", "svd", "two_step_bias"]


def two_step_bias(y: Array, magnitude: float, kind: Kind, bias: ArrayLike | None) -> Array:
    """The first of the two steps: `bias` where it is given, else that of `ellipsoid` (..., 3)."""
    if bias is None:
        return ellipsoid(y, magnitude, kind=kind).model.B
    B = np.asarray(bias, dtype=np.float64)
    if B.shape[-1:] != (3,):
        raise InputError(f"{kind}: bias has shape {B.shape}; expected (..., 3)")
    return np.broadcast_to(B, (*y.shape[:-2], 3))


def _fit(
    name: As,
    y: Array,
    R: Array,
    H: Array,
    B: Array,
    u: Array,
    method: str,
    cites: str,
    covariance: Array | None,
    **more: object,
) -> Fit:
    """The `Fit` of a two-step method: residual norms of (25) and their sum of squares."""
    residual = np.linalg.norm(pose_residual(y, R, H, B, u), axis=-1)
    model = model_of(name, H, B, method, residual, covariance)
    cost = np.sum(residual * residual, axis=-1)
    return Fit(model, residual, cost, method, cites, u=u, covariance=covariance, rank=11, **more)  # type: ignore[arg-type]


def _covariance(
    y: Array, R: Array, H: Array, B: Array, u: Array, magnitude: float, bias: ArrayLike | None
) -> Array | None:
    """Of a single node's optimum of (25)-(26); a bias that was given counts as exact."""
    if y.ndim > 2:
        return None
    dB = two_step.bias_response(y, H, B, magnitude) if bias is None else np.zeros((3, len(y), 3))
    return two_step.covariance(y, R, H, B, u, two_step.transform_response(y, R, H, B, u, dB), dB)


def alternation(
    y: ArrayLike,
    R: ArrayLike,
    magnitude: float,
    *,
    kind: Kind = "acc",
    raw_unit: str = "count",
    unit: str = "",
    bias: ArrayLike | None = None,
    u0: ArrayLike | None = None,
    n_iter: int = 50,
    tol: float | None = None,
) -> Fit:
    """The paper's iteration [1] (27)-(32), verbatim.

    Parameters
    ----------
    y : array_like (..., J, 3), raw unit
        Mean reading of each pose; leading axes are nodes (or runs).
    R : array_like (J, 3, 3) or (..., J, 3, 3)
    magnitude : float, calibrated unit
    bias : array_like (..., 3), raw unit, optional
        Combined bias; from `ellipsoid` where not given. A bias that is given counts as exact in the covariance.
    u0 : array_like (..., 3), optional
        Initial vector, any length; ``(1, 1, 1)`` where not given (the paper leaves it open).
    n_iter : int
        Number of iterations.
    tol : float, rad, optional
        Stop early when the direction of u turns by less.

    Returns
    -------
    Fit
        `history`: iterates as they stand before (32), `H` (n, ..., 3, 3) and `u` (n, ..., 3); the
        estimate after k iterations is both times G / |u_k|. `details`: `turned` (...,) the angle of the last
        iteration's turn of u, rad. `converged` when that is below 1e-6.

    Notes
    -----
    (30)-(31) is power iteration with I - M/J (see `eigen`), so u goes to the global optimum of (25)-(26) at
    the rate (1 - lambda2)/(1 - lambda1). Where the paper misleads: (32) scales H_k, which was built from
    u_(k-1), by |u_k|, so the H returned is too large by 1/(1 - lambda1(M/J)), kept as printed. The iterates
    shrink for ever with noise, so a tolerance on |u_k - u_(k-1)| never fires; `tol` looks at the direction.
    """
    y = checked_readings(y, kind, MIN_POSES)
    R = checked_rotations(R, y.shape[-2])
    B = two_step_bias(y, magnitude, kind, bias)
    Y = np.swapaxes(y - B[..., None, :], -1, -2)  # (27)
    stacked = R.reshape(*R.shape[:-3], -1, 3)  # (28)
    Y_pinv, R_pinv = np.linalg.pinv(Y), np.linalg.pinv(stacked)
    u = np.array(np.broadcast_to(np.ones(3) if u0 is None else np.asarray(u0, dtype=np.float64), (*y.shape[:-2], 3)))
    H = np.zeros((*y.shape[:-2], 3, 3))
    turned = np.full(y.shape[:-2], np.inf)
    all_H, all_u = [], []
    for _ in range(n_iter):
        previous = u
        H = _C2M(predicted(R, u)) @ Y_pinv  # (30)
        u = (R_pinv @ _M2C(H @ Y))[..., 0]  # (31)
        all_H.append(H)
        all_u.append(u)
        turned = _angle(previous, u)
        if tol is not None and np.all(turned <= tol):
            break
    H, u, sign = _rescaled(H, u, magnitude)  # (32)
    history = {"H": np.array(all_H) * sign[..., None, None], "u": np.array(all_u) * sign[..., None]}
    converged = bool(np.all(turned < 1e-6))
    return _fit(
        As(kind, raw_unit, unit),
        y,
        R,
        H,
        B,
        u,
        "alternation",
        "Z-TIE (27)-(32)",
        _covariance(y, R, H, B, u, magnitude, bias),
        history=history,
        details={"turned": turned},
        n_iter=len(all_u),
        converged=converged,
        text="" if converged else f"u still turned by {np.max(turned):.1e} rad in iteration {len(all_u)}",
    )


def _C2M(rows: Array) -> Array:
    """C2M of [1]'s appendix: from the stacked column, held here as (..., J, 3), to the matrix (..., 3, J)."""
    return np.swapaxes(rows, -1, -2)


def _M2C(matrix: Array) -> Array:
    """M2C of [1]'s appendix: the columns of (..., 3, J) stacked to (..., 3J, 1)."""
    return np.swapaxes(matrix, -1, -2).reshape(*matrix.shape[:-2], -1, 1)


def _angle(a: Array, b: Array) -> Array:
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1))


def _rescaled(H: Array, u: Array, magnitude: float) -> tuple[Array, Array, Array]:
    """(32), and the sign that makes det H positive."""
    factor = magnitude / np.linalg.norm(u, axis=-1)
    sign = np.where(determinant3(H) < 0, -1.0, 1.0)
    factor = factor * sign
    return H * factor[..., None, None], u * factor[..., None], sign


def eigen(
    y: ArrayLike,
    R: ArrayLike,
    magnitude: float,
    *,
    kind: Kind = "acc",
    raw_unit: str = "count",
    unit: str = "",
    bias: ArrayLike | None = None,
) -> Fit:
    """Global optimum of [1] (25)-(26) without iteration or start value.

    ``min_H`` of (25) is u^T M u with ``M = sum_jk R_j^T (delta_jk - P_jk) R_k``, P = Y^+ Y: u is M's smallest
    eigenvector, of length G, and H = C2M(R u) Y^+.

    Parameters
    ----------
    y, R, magnitude, bias
        As in `alternation`.

    Returns
    -------
    Fit
        `details`: `lambda` (..., 3), the eigenvalues of M/J.

    Raises
    ------
    DataError
        Where (a single node's) poses do not determine H, naming what is missing.
    """
    y = checked_readings(y, kind, MIN_POSES)
    R = checked_rotations(R, y.shape[-2])
    B = two_step_bias(y, magnitude, kind, bias)
    best = optimum(y - B[..., None, :], R, centred=False)
    if y.ndim == 2:
        refuse_unobservable(kind, R, best.u, best.eigenvalues)
    else:
        best.A[best.lost], best.u[best.lost] = np.nan, np.nan
    H, u = magnitude * best.A, magnitude * best.u
    return _fit(
        As(kind, raw_unit, unit),
        y,
        R,
        H,
        B,
        u,
        "eigen",
        "not in the papers: the global optimum of Z-TIE (25)-(26)",
        _covariance(y, R, H, B, u, magnitude, bias),
        details={"lambda": best.eigenvalues / y.shape[-2]},
    )


def svd(
    y: ArrayLike,
    R: ArrayLike,
    magnitude: float,
    *,
    kind: Kind = "acc",
    raw_unit: str = "count",
    unit: str = "",
    bias: ArrayLike | None = None,
    reference: int = 0,
    scale: bool = False,
) -> Fit:
    """Homogeneous least squares on differences to one reference reading: [2] (23)-(33), verbatim.

    Parameters
    ----------
    y, R, magnitude, bias
        As in `alternation`. H and u do not depend on the bias. R need not be relative to the reference pose:
        rotations are made so, and u is returned in the frame that R came in.
    reference : int
        The pose i that differences are taken to.
    scale : bool
        Not in the paper: scale readings to unit rms before the decomposition, so that the solution does not
        depend on their unit.

    Returns
    -------
    Fit
        `details`: `singular_values` (..., 12) of A; `ratio` (...,) of the largest to the second-smallest
        singular value with the columns scaled (about 7 or less is good, above 12 unreliable). `condition` is
        that ratio.

    Notes
    -----
    "Positive kappa" (33) fixes nothing, as the sign of a singular vector is arbitrary: here det H > 0.
    """
    y = checked_readings(y, kind, MIN_POSES)
    R = checked_rotations(R, y.shape[-2])
    B = two_step_bias(y, magnitude, kind, bias)
    R_i = R[..., reference, :, :]
    R_ji = R @ np.swapaxes(R_i, -1, -2)[..., None, :, :]
    others = np.delete(np.arange(y.shape[-2]), reference)
    Delta = y[..., others, :] - y[..., reference, None, :]
    unit_scale = np.sqrt(np.mean(Delta * Delta, axis=(-1, -2))) if scale else np.ones(y.shape[:-2])
    A = _homogeneous_matrix(R_ji[..., others, :, :], Delta / unit_scale[..., None, None])
    X, singular_values = lsq.homogeneous(A)  # (31)
    u_v, H_v = X[..., :3], X[..., 3:].reshape(*X.shape[:-1], 3, 3) / unit_scale[..., None, None]  # (28)
    kappa = np.sqrt(magnitude**2 / np.sum(u_v * u_v, axis=-1))  # (33)
    H, u = positive(kappa[..., None, None] * H_v, kappa[..., None] * u_v)
    covariance, u_i = None, u
    u = np.einsum("...ji,...j->...i", R_i, u_i)  # back from the reference pose to the frame of R
    if y.ndim == 2:
        dB = two_step.bias_response(y, H, B, magnitude) if bias is None else np.zeros((3, len(y), 3))
        raw_A = _homogeneous_matrix(R_ji[others], Delta)
        covariance = two_step.covariance(y, R, H, B, u, two_step.homogeneous_response(raw_A, H, u_i, reference), dB)
    # not in the paper: columns of unit length make the ratio comparable between sensors
    lengths = np.linalg.norm(A, axis=-2, keepdims=True)
    scaled_values = np.linalg.svd(A / np.where(lengths > 0, lengths, 1.0), compute_uv=False)
    ratio = scaled_values[..., 0] / np.maximum(scaled_values[..., -2], 1e-300)
    return _fit(
        As(kind, raw_unit, unit),
        y,
        R,
        H,
        B,
        u,
        "svd",
        "ZY-TBME (23)-(33)",
        covariance,
        condition=ratio,
        details={"singular_values": singular_values, "ratio": ratio},
    )


def _homogeneous_matrix(R_ji: Array, Delta: Array) -> Array:
    """A of (30), (..., 3(J-1), 12): rows [R_j^i - I_3, Delta_j^i] of (27), (29)."""
    lead, n = np.broadcast_shapes(R_ji.shape[:-3], Delta.shape[:-2]), Delta.shape[-2]
    A = np.zeros((*lead, n, 3, 12))
    A[..., :3] = R_ji - np.eye(3)  # (27)
    for row in range(3):
        A[..., row, 3 + 3 * row : 6 + 3 * row] = -Delta
    return A.reshape(*lead, 3 * n, 12)
