"""Kalman filter steps as pure functions of (x, P, ...): linear and unscented predict and correct.

Nothing is kept between calls. State x (..., n), covariance P (..., n, n), measurement z (..., m); leading
axes are independent filters run side by side.

References
----------
Unscented transform, scaled sigma points: S. J. Julier, "The scaled unscented transformation", ACC 2002;
E. A. Wan, R. van der Merwe, "The unscented Kalman filter for nonlinear estimation", AS-SPCC 2000.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from margcal.core.types import Array


class State(NamedTuple):
    """Mean `x` (..., n) and covariance `P` (..., n, n)."""

    x: Array
    P: Array


class Correction(NamedTuple):
    """State after a measurement, its innovation (..., m) and the innovation's covariance (..., m, m)."""

    x: Array
    P: Array
    innovation: Array
    S: Array


@dataclass(frozen=True)
class Sigma:
    """Parameters of the scaled sigma points.

    Attributes
    ----------
    alpha : float
        Spread: the points lie at alpha sqrt(n + kappa) standard deviations.
    beta : float
        2 is best for a Gaussian state; enters the covariance only.
    kappa : float
        Secondary scale.
    """

    alpha: float = 1e-3
    beta: float = 2.0
    kappa: float = 0.0

    def spread(self, n: int) -> float:
        """n + lambda, the squared distance of the points in standard deviations."""
        return self.alpha**2 * (n + self.kappa)


def _T(A: Array) -> Array:
    return np.swapaxes(A, -1, -2)


def _times(A: Array, x: Array) -> Array:
    return (A @ x[..., None])[..., 0]


def _symmetric(P: Array) -> Array:
    return 0.5 * (P + _T(P))


def predict(x: Array, P: Array, F: Array, Q: Array) -> State:
    """Linear prediction ``x <- F x``, ``P <- F P F^T + Q``."""
    return State(_times(F, x), _symmetric(F @ P @ _T(F) + Q))


def correct(x: Array, P: Array, z: Array, H: Array, R: Array) -> Correction:
    """Linear correction by ``z = H x + w``, w of covariance R; Joseph's form keeps P positive definite."""
    innovation = z - _times(H, x)
    S = _symmetric(H @ P @ _T(H) + R)
    K = _T(np.asarray(np.linalg.solve(S, H @ P), dtype=np.float64))
    rest = np.eye(x.shape[-1]) - K @ H
    return Correction(x + _times(K, innovation), _symmetric(rest @ P @ _T(rest) + K @ R @ _T(K)), innovation, S)


def sigma_points(x: Array, P: Array, sigma: Sigma) -> Array:
    """The 2 n + 1 sigma points (..., 2 n + 1, n): the mean, then plus and minus the columns of P's root."""
    L: Array = np.sqrt(sigma.spread(x.shape[-1])) * np.linalg.cholesky(P)
    middle = x[..., None, :]
    return np.concatenate([middle, middle + _T(L), middle - _T(L)], axis=-2)


def unscented_mean_cov(points: Array, images: Array, sigma: Sigma) -> tuple[Array, Array, Array]:
    """Mean (..., m), covariance (..., m, m) of the images and their covariance with the points (..., n, m).

    Notes
    -----
    With alpha = 1e-3 the weights are of order 1e6 and of both signs. They sum to one, so everything is
    written in differences from the middle point's image: the large weight of the middle drops out of the
    mean, and in the covariance it is left with ``(beta - alpha^2) d d^T`` apart from what cancels.
    """
    n = points.shape[-1]
    w = 0.5 / sigma.spread(n)
    D = images[..., 1:, :] - images[..., :1, :]
    d = w * D.sum(axis=-2)  # mean - image of the middle point
    # w sum (D_i - d)(D_i - d)^T + w0_cov d d^T, with sum w D_i = d and w0_cov = 1 - 2 n w + 1 - alpha^2 + beta
    cov = w * _T(D) @ D + (sigma.beta - sigma.alpha**2) * d[..., :, None] * d[..., None, :]
    X = points[..., 1:, :] - points[..., :1, :]
    return images[..., 0, :] + d, cov, w * _T(X) @ D


def unscented_predict(x: Array, P: Array, f: Callable[[Array], Array], Q: Array, sigma: Sigma | None = None) -> State:
    """Prediction through ``x <- f(x) + v``; `f` maps sigma points (..., 2 n + 1, n) row by row."""
    sigma = sigma or Sigma()
    points = sigma_points(x, P, sigma)
    mean, cov, _ = unscented_mean_cov(points, f(points), sigma)
    return State(mean, _symmetric(cov + Q))


def unscented_correct(
    x: Array, P: Array, z: Array, h: Callable[[Array], Array], R: Array, sigma: Sigma | None = None
) -> Correction:
    """Correction by ``z = h(x) + w``, w of covariance R; `h` maps (..., 2 n + 1, n) to (..., 2 n + 1, m)."""
    sigma = sigma or Sigma()
    points = sigma_points(x, P, sigma)
    mean, cov, cross = unscented_mean_cov(points, h(points), sigma)
    S = _symmetric(cov + R)
    K = _T(np.asarray(np.linalg.solve(S, _T(cross)), dtype=np.float64))
    innovation = z - mean
    return Correction(x + _times(K, innovation), _symmetric(P - K @ S @ _T(K)), innovation, S)
