"""Cramer-Rao bound of the gyroscope's H (and B) from turns whose rotations are known.

Not from the papers. The readings are y = H^-1 u + B + n with n white; the true rates u_l of every sample are
unknown too, but tied by the known rotation of the turn, prod exp(u_l dt_l) = dR. Eliminating them (they are 3
N nuisance unknowns of turn j with three equations) leaves for each turn the information J^T C^-1 J, where J
is the derivative of the integrated rotation with respect to (H, B) and C the covariance of the integrated
rotation from the noise of the readings, both at the truth, plus the noise of the known rotation itself.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from margcal.core.errors import DataError
from margcal.core.types import Array, Turn
from margcal.methods.preintegration import TurnBatch, pad, preintegrate


def bound(
    turns: Sequence[Turn] | TurnBatch,
    H: ArrayLike,
    B: ArrayLike | None = None,
    *,
    sd: ArrayLike,
    sigma_angle: float = 0.0,
    bias_cov: ArrayLike | None = None,
) -> Array:
    """Smallest covariance that an unbiased estimate of (H row by row, B) can have.

    Parameters
    ----------
    turns : sequence of Turn, or TurnBatch of (T, N, 3)
        NOISE-FREE readings.
    H, B : array_like (3, 3), (3,)
        The truth.
    sd : array_like (3,) or scalar, raw unit
        White noise of one reading.
    sigma_angle : float, rad
        Noise of each known rotation, each axis.
    bias_cov : array_like (3, 3), raw unit^2, optional
        What is known of B beforehand. Without it B is known exactly, as in Z-TIE's simulation B, and its rows
        and columns are zero.

    Returns
    -------
    ndarray (12, 12)

    Raises
    ------
    DataError
        If the turns do not determine H.
    """
    batch = pad(turns)
    step = preintegrate(batch.y, batch.dt, H, B, sd)
    weight = np.linalg.inv(step.C + sigma_angle**2 * np.eye(3))
    J = np.concatenate([step.J_H, step.J_B], axis=-1)
    information = np.einsum("tia,tij,tjb->ab", J, weight, J)
    if bias_cov is None:
        information = information[:9, :9]
    else:
        information[9:, 9:] += np.linalg.inv(np.asarray(bias_cov, dtype=np.float64))
    scale = 1 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    normal = information * np.outer(scale, scale)
    if np.linalg.cond(normal) > 1e14:
        raise DataError("these turns do not determine the gyroscope's H; turn about at least three axes")
    out = np.zeros((12, 12))
    n = len(normal)
    out[:n, :n] = np.linalg.inv(normal) * np.outer(scale, scale)
    return out
