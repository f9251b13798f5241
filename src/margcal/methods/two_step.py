"""How sure the papers' two-step estimates are: first-order propagation of the readings' noise.

Not in the papers. Both steps are linear in small errors n_j of the readings, so that the error of the estimate is
``S n`` and its covariance sigma^2 S S^T:

    step 1  (ellipsoid)       dB = -(Je^T Je)^-1 Je^T (g_j . n_j), rows of B; Je the derivatives of the orthogonal
                              distances, g_j the outward normal at reading j
    step 2  (25)-(26)         d(H, u) = (J^T J)^-1 J^T (H n_j - H dB), J the derivatives of R_j u - H (y_j - B)
    step 2  ZY-TBME (30)      dX = A^+ (H n_j - H n_i), then (32)-(33) make |u| = M again
"""

from __future__ import annotations

import math

import numpy as np

from margcal.core import lsq
from margcal.core.types import Array
from margcal.methods import quadric
from margcal.methods.affine import pose_residual, scaled, tangents


def bias_response(y: Array, H: Array, B: Array, magnitude: float) -> Array:
    """dB (3, J, 3) by the noise of each reading, when B is the ellipsoid's."""
    data = scaled(y)
    Sigma = H.T @ H * (data.scale / magnitude) ** 2
    values, vectors = np.linalg.eigh(Sigma)
    K, b = (vectors * np.sqrt(values)) @ vectors.T, (B - data.centre) / data.scale
    _, foot = quadric.distances(data.z, K, b)
    normal = (foot - b) @ Sigma
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    solution = np.linalg.pinv(quadric.distance_jacobian(foot, K, b))[6:]  # rows of b
    return -solution[:, :, None] * normal


def transform_response(y: Array, R: Array, H: Array, B: Array, u: Array, dB: Array) -> Array:
    """dH (9, J, 3) by the noise of each reading, for the optimum of (25)-(26)."""
    J = len(y)
    scale = float(np.sqrt(np.mean((y - B) ** 2)))
    jacobian = np.zeros((J, 3, 11))
    for row in range(3):
        jacobian[:, row, 3 * row : 3 * row + 3] = -(y - B) / scale
    jacobian[:, :, 9:] = R @ tangents(u)
    solution = np.linalg.pinv(jacobian.reshape(-1, 11))[:9].reshape(9, J, 3) / scale
    direct = np.einsum("pji,ik->pjk", solution, H)
    through_bias = np.einsum("pji,ib,bmk->pmk", solution, H, dB)
    return direct - through_bias


def homogeneous_response(A: Array, H: Array, u: Array, reference: int) -> Array:
    """dH (9, J, 3) by the noise of each reading, for the smallest singular vector of A (30) with columns in real units.

    `u` is the sensed vector in the reference pose.
    """
    scale = lsq.column_scales(A)
    U, s, Vt = np.linalg.svd(A / scale, full_matrices=False)
    inverse = (Vt[:-1].T / s[:-1]) @ U[:, :-1].T / scale[:, None]
    dX = np.einsum("xji,ik->xjk", inverse.reshape(12, -1, 3), H)
    dX = np.insert(dX, reference, -dX.sum(axis=1), axis=1)
    along = np.einsum("i,ijk->jk", u, dX[:3]) / (u @ u)
    return dX[3:] - H.reshape(9, 1, 1) * along


def covariance(y: Array, R: Array, H: Array, B: Array, u: Array, dH: Array, dB: Array) -> Array:
    """Covariance (12, 12) of (H row by row, B) from the responses and the noise seen in the residuals."""
    raw = pose_residual(y, R, H, B, u) @ np.linalg.inv(H).T
    raw -= raw.mean(axis=0)  # an error of the bias that the second step took over is not noise
    sigma = math.sqrt(float(np.sum(raw * raw)) / max(raw.size - 14, 1))
    response = np.concatenate([dH, dB]).reshape(12, -1) * sigma
    return response @ response.T
