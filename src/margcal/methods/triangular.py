"""Bias, scale and non-orthogonality in the sensor's own frame, from the length of the sensed vector alone.

[5] I. Skog, P. Haendel, "Calibration of a MEMS inertial measurement unit", XVII IMEKO World Congress, 2006.
    The "sensor frame only" baseline of Z-TIE's Table III.

``u = H (y - B)`` with H upper triangular and of positive diagonal (`triangular`), or diagonal
(`bias_and_scale`). Scaled, ``s = A z + a`` is linear in its unknowns, and only the length of s is known.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from margcal.core import lsq
from margcal.core.types import Array, Fit, Kind
from margcal.methods import quadric
from margcal.methods.affine import As, checked_readings, scaled, unobservable, unscaled, unscaled_covariance
from margcal.methods.coverage import NINE, SIX, length_fit, refuse_few, refuse_wild, start

NON_ORTHOGONALITY_SD = 0.01
"""What `bias_and_scale` expects of the elements that it leaves at zero: a part of the scale (0.6 degrees)."""


def triangular(
    y: ArrayLike,
    magnitude: float,
    *,
    kind: Kind = "acc",
    raw_unit: str = "count",
    unit: str = "",
    weights: ArrayLike | None = None,
    min_directions: int = NINE,
) -> Fit:
    """Bias and upper-triangular H with positive diagonal: calibration in the sensor's own frame [5].

    Minimises ``sum w_j ((|H (y_j - B)| - G) / |H^T s_j|)^2``, s_j the unit vector along H (y_j - B): the
    deviation of the length in units of the reading's noise, which is the maximum likelihood of [5] for equal
    noise on the raw axes.

    Parameters
    ----------
    y : array_like (J, 3), raw unit
    magnitude : float, calibrated unit
    weights : array_like (J,), optional
        Inverse variance of each reading up to a factor.

    Returns
    -------
    Fit
        The z axis of its frame is the sensor's z sensing axis, its y sensing axis lies in the yz-plane
        (`acc-triangular`). `covariance` has zeros for the elements below the diagonal. `details`: `sigma`
        (raw unit).

    Raises
    ------
    DataError
        As `ellipsoid`.
    """
    y = checked_readings(y, kind)
    refuse_few(kind, y, min_directions, "nine parameters (bias, scale, non-orthogonality)")
    y = checked_readings(y, kind, 9)
    data = scaled(y)
    K, b, _, _ = quadric.refine(data.z, *start(data.z))
    refuse_wild(kind, data.z, K, b)
    A = np.asarray(np.linalg.cholesky(K.T @ K).T, dtype=np.float64)
    free = [0, 1, 2, 4, 5, 8, 9, 10, 11]  # of (A row by row, a)
    x = np.concatenate([A.ravel(), -A @ b])[free]
    root = np.ones(len(y)) if weights is None else np.sqrt(np.asarray(weights, dtype=np.float64))
    solved = _length_fit(data.z, x, free, root)
    full = np.zeros(12)
    full[free] = solved.x
    A, a = full[:9].reshape(3, 3), full[9:]
    H, B = unscaled(A, a, data, magnitude)
    variance = float(solved.residual @ solved.residual) / max(len(y) - 9, 1)
    cov = np.zeros((12, 12))
    cov[np.ix_(free, free)] = solved.cofactor * variance
    return length_fit(
        As(kind, raw_unit, unit),
        y,
        magnitude,
        H,
        B,
        unscaled_covariance(cov, A, a, data, magnitude),
        method="triangular",
        cites="Skog & Haendel 2006",
        cost=float(solved.residual @ solved.residual) * float(data.scale) ** 2,
        rank=solved.rank,
        condition=solved.condition,
        n_iter=solved.n_iter,
        converged=solved.converged,
        details={"sigma": np.array(math.sqrt(variance) * data.scale)},
    )


def _length_fit(z: Array, x: Array, free: list[int], root: Array) -> lsq.Solution:
    """Least squares on ``(|A z + a| - 1) / |A^T s|`` in the elements `free` of (A row by row, a)."""
    linear = np.zeros((len(z), 3, 12))
    for i in range(3):
        linear[:, i, 3 * i : 3 * i + 3] = z
        linear[:, i, 9 + i] = 1.0
    linear = linear[:, :, free]
    full = np.zeros(12)

    def parts(x: Array) -> tuple[Array, Array, Array]:
        full[free] = x
        s = linear @ x
        length = np.linalg.norm(s, axis=1)
        unit = s / length[:, None]
        return length, unit, np.linalg.norm(unit @ full[:9].reshape(3, 3), axis=1)

    def fit(x: Array) -> lsq.Solution:
        gain = root / parts(x)[2]

        def model(x: Array) -> tuple[Array, Array]:
            length, unit, _ = parts(x)
            return gain * (length - 1), gain[:, None] * np.einsum("ji,jip->jp", unit, linear)

        return lsq.gauss_newton(model, x)

    solved = fit(x)
    for _ in range(3):  # the noise of each length depends on A a little; a few passes settle it
        solved = fit(solved.x)
    return solved


def bias_and_scale(
    y: ArrayLike,
    magnitude: float,
    *,
    kind: Kind = "acc",
    raw_unit: str = "count",
    unit: str = "",
    min_directions: int = SIX,
) -> Fit:
    """Bias and scale factors only (diagonal H), for seven to nine distinct directions.

    Parameters
    ----------
    y : array_like (J, 3), raw unit
    magnitude : float, calibrated unit

    Returns
    -------
    Fit
        `covariance` includes what non-orthogonality of `NON_ORTHOGONALITY_SD` would do to the six parameters,
        and that uncertainty itself for the elements left at zero. `rank` of six. `details`: `sigma` (raw
        unit).

    Raises
    ------
    DataError
        With fewer than seven distinct directions, or readings that do not determine six parameters.
    """
    y = checked_readings(y, kind)
    refuse_few(kind, y, min_directions, "six parameters (bias, scale)")
    y = checked_readings(y, kind, 6)
    data = scaled(y)
    K, b = quadric.sphere(data.z)
    free, held = [0, 4, 8, 9, 10, 11], [1, 2, 5]
    x = np.concatenate([K.ravel(), -K @ b])
    solved = _length_fit(data.z, x[free], free, np.ones(len(y)))
    full = np.zeros(12)
    full[free] = solved.x
    A, a = full[:9].reshape(3, 3), full[9:]
    if solved.rank < 6 or np.diag(A).min() <= 0 or np.abs(a).max() > 3 * np.diag(A).max():
        raise unobservable(
            kind, f"the readings do not determine bias and scale: {quadric.why_not(data.z)}", solved.rank, 6
        )
    variance = float(solved.residual @ solved.residual) / max(len(y) - 6, 1)
    cov = _considered(data.z, A, a, free, held, solved.cofactor * variance)
    H, B = unscaled(A, a, data, magnitude)
    return length_fit(
        As(kind, raw_unit, unit),
        y,
        magnitude,
        H,
        B,
        unscaled_covariance(cov, A, a, data, magnitude),
        method="bias-and-scale",
        cites="not in the papers: triangular with a diagonal H",
        cost=float(solved.residual @ solved.residual) * float(data.scale) ** 2,
        rank=solved.rank,
        condition=solved.condition,
        n_iter=solved.n_iter,
        converged=solved.converged,
        details={"sigma": np.array(math.sqrt(variance) * data.scale)},
    )


def _considered(z: Array, A: Array, a: Array, free: list[int], held: list[int], cov: Array) -> Array:
    """Covariance (12, 12) when elements `held` at zero may be off by `NON_ORTHOGONALITY_SD` of the scale.

    A held element that is off by e moves the free ones by S e, S = -(J'J)^-1 J'J_held (Schmidt's "consider"
    parameters): the readings' noise and that error add up.
    """
    s = z @ A.T + a
    unit = s / np.linalg.norm(s, axis=1, keepdims=True)
    J = np.concatenate([unit[:, i, None] * z for i in range(3)] + [unit], axis=1)
    J = J / np.linalg.norm(unit @ A, axis=1)[:, None]
    S = np.zeros((12, len(held)))
    S[free] = -np.linalg.lstsq(J[:, free], J[:, held], rcond=None)[0]
    S[held, np.arange(len(held))] = 1.0
    out = np.zeros((12, 12))
    out[np.ix_(free, free)] = cov
    return out + (S @ S.T) * (NON_ORTHOGONALITY_SD * float(np.mean(np.diag(A)))) ** 2
