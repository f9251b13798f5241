"""Combined bias, and H up to a rotation, from the known length of the sensed vector alone.

[1] Z-TIE (Zhang 2015, IEEE Trans. Industrial Electronics), section II.B.1, equations (11)-(22).
[2] ZY-TBME (Zhang & Yang 2015, IEEE Trans. Biomedical Engineering 62(2)), II.B, (12)-(22): the same step.
[3] N. Chernov, H. Ma, "Least squares fitting of quadratic curves and surfaces", Computer Vision, 2011.
[4] I. Markovsky, A. Kukush, S. Van Huffel, "Consistent least squares fitting of ellipsoids", Numerische
    Mathematik 98, 2004, pp. 177-194.

name here    symbol in [1]      meaning                                             shape
y            y_a^j              raw reading of pose j                               (..., J, 3)
magnitude    G                  length of the sensed vector                         ()
Sigma        Sigma (16)         (H/G)^T (H/G)                                       (..., 3, 3)
Gamma        Gamma (16)         2 Sigma B                                           (..., 3)
B            B_a (17)           combined bias                                       (..., 3)
H_sym        K (20)             symmetric positive definite with K^T K = G^2 Sigma  (..., 3, 3)

The length says nothing of a rotation: with H, any Omega H fits equally well (22). Each function fixes that
gauge in its own way and says so; its covariance is that within the gauge (directions that the gauge fixes
have none).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from margcal.core import lsq
from margcal.core.types import Array, Fit, Kind
from margcal.methods import quadric
from margcal.methods.affine import As, Scaled, checked_readings, scaled
from margcal.methods.coverage import (
    NINE,
    distinct_directions,
    length_fit,
    refuse_few,
    refuse_wild,
    start,
    wild,
)
from margcal.methods.triangular import bias_and_scale, triangular

__all__ = ["adjusted_ellipsoid", "bias_and_scale", "distinct_directions", "ellipsoid", "triangular"]

BLOCKS = 50
"""Contiguous blocks whose sums give the covariance from correlated samples."""


def ellipsoid(
    y: ArrayLike,
    magnitude: float,
    *,
    kind: Kind = "acc",
    raw_unit: str = "count",
    unit: str = "",
    min_directions: int = NINE,
    geometric: bool = True,
) -> Fit:
    """Combined bias and symmetric H: [1] (11)-(21), by orthogonal distances [3].

    Parameters
    ----------
    y : array_like (..., J, 3), raw unit
        Mean reading of each pose; leading axes are nodes.
    magnitude : float, calibrated unit
    min_directions : int
        Distinct directions (15 degrees apart) below which a single node is refused.
    geometric : bool
        Whether to refine Taubin's algebraic fit by orthogonal distances.

    Returns
    -------
    Fit
        H symmetric positive definite (the gauge); `covariance` (single node) holds the nine parameters of
        (H, B) in it, noise variance from the residuals. `details`: `Sigma`, `Gamma` of (16), `distance` (...,
        J) signed orthogonal distance in raw units, `sigma` its standard deviation. `rank` of nine. In a
        batch, nodes without an ellipsoid are NaN.

    Raises
    ------
    DataError
        With fewer than nine readings or `min_directions` directions, or where the surface is not an
        ellipsoid, with the reason.
    """
    y = checked_readings(y, kind)
    single = y.ndim == 2
    if single:
        refuse_few(kind, y, min_directions, "nine parameters (bias, scale, non-orthogonality)")
    y = checked_readings(y, kind, 9)
    data = scaled(y)
    if geometric:
        K, b, converged, n_iter = quadric.refine(data.z, *start(data.z))
    else:
        K, b, converged = quadric.ellipsoid_of(quadric.taubin(data.z))
        n_iter = 0
    if single:
        refuse_wild(kind, data.z, K, b)
    Sigma, Gamma = _algebraic(K, b, data)
    B = np.asarray(0.5 * np.linalg.solve(Sigma, Gamma[..., None])[..., 0], dtype=np.float64)  # (17)
    D, Lambda = np.linalg.eigh(Sigma)  # (19)
    H_sym = magnitude * (Lambda * np.sqrt(D)[..., None, :]) @ np.swapaxes(Lambda, -1, -2)  # (20)
    distance, foot = quadric.distances(data.z, K, b)
    distance = distance * data.scale[..., None]
    details = {"Sigma": Sigma, "Gamma": Gamma, "distance": distance}
    covariance, rank, condition = None, 9, float("nan")
    if single:
        jacobian = quadric.distance_jacobian(foot, K, b)
        solved = lsq.linear(jacobian, distance / data.scale)
        rank, condition = solved.rank, solved.condition
        sigma = math.sqrt(float(distance @ distance) / max(len(y) - 9, 1))
        details["sigma"] = np.array(sigma)
        covariance = _nine_covariance(solved.cofactor * (sigma / data.scale) ** 2, data, magnitude)
    else:
        lost = wild(data.z, K, b) | np.logical_not(converged)
        H_sym[lost], B[lost] = np.nan, np.nan
    return length_fit(
        As(kind, raw_unit, unit),
        y,
        magnitude,
        H_sym,
        B,
        covariance,
        method="ellipsoid",
        cites="Z-TIE (11)-(21), ZY-TBME (12)-(21); Chernov & Ma 2011",
        cost=np.sum(distance * distance, axis=-1),
        rank=rank,
        condition=condition,
        n_iter=n_iter,
        converged=bool(np.all(converged)),
        details=details,
    )


def _algebraic(K: Array, b: Array, data: Scaled) -> tuple[Array, Array]:
    """Sigma and Gamma of (16) in raw units."""
    Sigma = np.swapaxes(K, -1, -2) @ K / (data.scale**2)[..., None, None]
    B = data.centre + data.scale[..., None] * b
    Gamma = 2 * (Sigma @ B[..., None])[..., 0]
    return Sigma, Gamma


def _nine_covariance(cov: Array, data: Scaled, magnitude: float) -> Array:
    """Covariance (12, 12) of (H, B) from that of (six of K, b) in scaled units."""
    T = np.zeros((12, 9))
    for column, (p, q) in enumerate(quadric.PAIRS):
        T[3 * p + q, column] = T[3 * q + p, column] = magnitude / data.scale
    T[9:, 6:] = data.scale * np.eye(3)
    return T @ cov @ T.T


def adjusted_ellipsoid(
    y: ArrayLike,
    magnitude: float,
    *,
    kind: Kind = "mag",
    raw_unit: str = "count",
    unit: str = "",
    min_directions: int = NINE,
    max_iter: int = 20,
) -> Fit:
    """Bias and symmetric H from many noisy samples: adjusted least squares [4], robust to some outliers.

    For continuous motion (100 samples to millions). The plain algebraic fit is biased by noise; the adjusted
    one is consistent, with the noise variance estimated from the data. Samples farther from the surface than
    four robust standard deviations lose weight, beyond six they have none.

    Parameters
    ----------
    y : array_like (N, 3), raw unit, in order of time
    magnitude : float, calibrated unit

    Returns
    -------
    Fit
        H symmetric positive definite (the gauge). `covariance` comes from sums over 50 contiguous blocks of
        samples, so that errors which last for many samples are not averaged away. `details`: `weights` (N,),
        `sigma` (raw unit) of the noise, `distance` (N,) signed, raw unit, first order, `radius` (raw unit) of
        the sphere of equal volume.

    Raises
    ------
    DataError
        As `ellipsoid`.
    """
    y = checked_readings(y, kind, 30)
    data = scaled(y)
    keep = _near_median(data.z)
    refuse_few(kind, y[keep], min_directions, "nine parameters (bias, scale or soft iron)")
    weights = keep.astype(np.float64)
    K, b, v, distance, converged, n_iter = np.eye(3), np.zeros(3), 0.0, np.zeros(len(y)), False, 0
    while n_iter < max_iter and not converged:
        n_iter += 1
        theta, v = quadric.adjusted(data.z, weights)
        K, b, good = quadric.ellipsoid_of(theta)
        if not good:
            refuse_wild(kind, data.z[keep], K, b)
        distance = _first_order(data.z, K, b)
        spread = max(lsq.robust_scale(distance[weights > 0]), 1e-12)
        updated = np.clip((6 - np.abs(distance) / spread) / 2, 0.0, 1.0)
        converged = bool(np.abs(updated - weights).mean() < 1e-6)
        weights = updated
    refuse_wild(kind, data.z[weights > 0], K, b)
    cov = _block_covariance(data.z, K, b, distance, weights)
    H = K * (magnitude / data.scale)
    B = data.centre + data.scale * b
    details = {
        "weights": weights,
        "sigma": np.array(math.sqrt(v) * data.scale),
        "distance": distance * data.scale,
        "radius": np.array(magnitude / np.linalg.det(H) ** (1 / 3)),
    }
    return length_fit(
        As(kind, raw_unit, unit),
        y,
        magnitude,
        H,
        B,
        _nine_covariance(cov, data, magnitude),
        method="adjusted-ellipsoid",
        cites="Markovsky, Kukush & Van Huffel 2004",
        cost=float(weights @ (distance * data.scale) ** 2),
        rank=9,
        condition=float("nan"),
        n_iter=n_iter,
        converged=converged,
        details=details,
    )


def _near_median(z: Array) -> NDArray[np.bool_]:
    """Samples within four median distances of the median: what is beyond would spoil even the first fit."""
    distance = np.linalg.norm(z - np.median(z, axis=0), axis=1)
    return distance <= 4 * np.median(distance)


def _first_order(z: Array, K: Array, b: Array) -> Array:
    """Signed distance from the surface to first order, F/|grad F|."""
    s = (z - b) @ K
    length = np.linalg.norm(s, axis=1)
    normal = (s / length[:, None]) @ K
    return (length - 1) / np.linalg.norm(normal, axis=1)


def _block_covariance(z: Array, K: Array, b: Array, distance: Array, weights: Array) -> Array:
    """Covariance (9, 9) of (six of K, b): ``N^-1 (sum of g g') N^-1``, g the sum of a block's scores."""
    v = (z - b) / np.linalg.norm((z - b) @ K, axis=1)[:, None]  # the point on the surface along the ray
    J = quadric.distance_jacobian(v + b, K, b)
    normal = J.T @ (J * weights[:, None])
    scores = J * (weights * distance)[:, None]
    n_blocks = min(BLOCKS, len(z) // 3)
    starts = np.linspace(0, len(z), n_blocks, endpoint=False).astype(int)
    sums = np.add.reduceat(scores, starts, axis=0)
    inverse = np.linalg.inv(normal)
    return inverse @ (sums.T @ sums) @ inverse * n_blocks / max(n_blocks - 9, 1)
