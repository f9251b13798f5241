"""How well can it be done: the Cramer-Rao bound for poses with known rotations, and Monte Carlo against it.

Readings are ``y_j = H^-1 R_j u + B + n_j`` with white noise of known standard deviation on each axis, R_j
known and |u| known: 14 unknowns, H (9), B (3) and two directions across u. No unbiased estimator has a
covariance below the inverse of the Fisher information ``sum J_j^T J_j / sigma_j^2``, J_j the derivatives of
y_j (S. M. Kay, Fundamentals of Statistical Signal Processing: Estimation Theory, 1993, section 3.9).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from margcal.core import lsq
from margcal.core.errors import DataError
from margcal.core.types import Array, Fit
from margcal.methods.affine import checked_rotations, determinant3, tangents

Solver = Callable[[Array, Array, float], Fit]
"""(readings (..., J, 3), rotations, magnitude) -> Fit."""


@dataclass(frozen=True)
class Bound:
    """Least covariance of an unbiased estimate: `covariance` (12, 12) of (H row by row, B), `u_covariance` (3, 3).

    `H_rms`, `B_rms`, `u_rms` are the least root mean square of ``|dH|_F``, ``|dB|`` and ``|du|``.
    """

    covariance: Array
    u_covariance: Array

    @property
    def H_rms(self) -> float:
        return math.sqrt(float(np.trace(self.covariance[:9, :9])))

    @property
    def B_rms(self) -> float:
        return math.sqrt(float(np.trace(self.covariance[9:, 9:])))

    @property
    def u_rms(self) -> float:
        return math.sqrt(float(np.trace(self.u_covariance)))


def reading_jacobian(H: Array, u: Array, R: Array) -> Array:
    """Derivatives (J, 3, 14) of the readings ``H^-1 R_j u + B`` by (H row by row, B, two tangents of u)."""
    K_fwd = np.linalg.inv(H)
    s = R @ u
    out = np.zeros((len(R), 3, 14))
    # d(H^-1 s) = -H^-1 dH H^-1 s
    out[:, :, :9] = -np.einsum("ia,jb->jiab", K_fwd, s @ K_fwd.T).reshape(len(R), 3, 9)
    out[:, :, 9:12] = np.eye(3)
    out[:, :, 12:] = K_fwd @ R @ tangents(u)
    return out


def cramer_rao(H: ArrayLike, u: ArrayLike, R: ArrayLike, sigma: ArrayLike) -> Bound:
    """Cramer-Rao bound of (H, B, u). It does not depend on B.

    Parameters
    ----------
    H : array_like (3, 3), calibrated unit per raw unit
    u : array_like (3,), calibrated unit
        True sensed vector; its length is taken as known.
    R : array_like (J, 3, 3)
        Rotations as the solvers take them: the sensed vector of pose j is ``R_j u``.
    sigma : float or array_like (J,), raw unit
        Standard deviation of each axis of a pose's reading.

    Raises
    ------
    DataError
        If the poses do not determine the 14 unknowns.
    """
    H, u = np.asarray(H, dtype=np.float64), np.asarray(u, dtype=np.float64)
    R = np.asarray(R, dtype=np.float64)
    R = checked_rotations(R, R.shape[-3])
    sd = np.broadcast_to(np.asarray(sigma, dtype=np.float64), (len(R),))
    J = (reading_jacobian(H, u, R) / sd[:, None, None]).reshape(-1, 14)
    solved = lsq.linear(J, np.zeros(len(J)))
    if solved.rank < 14:
        raise DataError(f"these poses determine {solved.rank} of 14 unknowns; there is no finite bound")
    T = tangents(u)
    return Bound(solved.cofactor[:12, :12], T @ solved.cofactor[12:, 12:] @ T.T)


@dataclass(frozen=True)
class Scatter:
    """Estimates of many runs beside the truth and the bound; `H`, `B`, `u` are RMS error / bound.

    `errors` holds (runs, 12) of (H row by row, B) and `u_errors` (runs, 3), NaN where a run found nothing;
    `lost` counts those runs, which the ratios leave out.
    """

    H: float
    B: float
    u: float
    errors: Array
    u_errors: Array
    bound: Bound
    lost: int = 0


def simulated_readings(
    H: Array, B: Array, u: Array, R: Array, sigma: float, runs: int, rng: np.random.Generator
) -> Array:
    """Readings (runs, J, 3) of the model with white noise."""
    clean = (R @ u) @ np.linalg.inv(H).T + B
    return clean + sigma * rng.normal(size=(runs, *clean.shape))


def monte_carlo(
    solve: Solver,
    H: ArrayLike,
    B: ArrayLike,
    u: ArrayLike,
    R: ArrayLike,
    sigma: float,
    runs: int,
    rng: np.random.Generator,
    batch: bool = True,
) -> Scatter:
    """RMS error of `solve` over `runs` draws of the noise, beside the Cramer-Rao bound.

    Parameters
    ----------
    solve : callable
        Called once with readings (runs, J, 3), or once a run where `batch` is False.
    H, B, u : array_like (3, 3), (3,), (3,)
        Truth. Estimates with the other sign of det H are flipped to its sign, u with them.
    R : array_like (J, 3, 3)
    sigma : float, raw unit
    """
    H, B, u, R = (np.asarray(v, dtype=np.float64) for v in (H, B, u, R))
    readings = simulated_readings(H, B, u, R, sigma, runs, rng)
    magnitude = float(np.linalg.norm(u))
    fits = [solve(readings, R, magnitude)] if batch else [solve(y, R, magnitude) for y in readings]
    H_hat = np.concatenate([f.model.H.reshape(-1, 3, 3) for f in fits])
    B_hat = np.concatenate([f.model.B.reshape(-1, 3) for f in fits])
    u_hat = np.concatenate([np.reshape(np.full(3, np.nan) if f.u is None else f.u, (-1, 3)) for f in fits])
    sign = np.sign(determinant3(H_hat) * determinant3(H))
    dH = H_hat * sign[:, None, None] - H
    dB, du = B_hat - B, u_hat * sign[:, None] - u
    bound = cramer_rao(H, u, R, sigma)

    errors = np.concatenate([dH.reshape(-1, 9), dB], axis=1)
    found = np.isfinite(errors).all(axis=1)

    def ratio(error: Array, least: float) -> float:
        return float(np.sqrt(np.mean(np.sum(error[found] ** 2, axis=-1)))) / least

    return Scatter(
        ratio(dH.reshape(-1, 9), bound.H_rms),
        ratio(dB, bound.B_rms),
        ratio(du, bound.u_rms),
        errors,
        du,
        bound,
        int(np.sum(~found)),
    )
