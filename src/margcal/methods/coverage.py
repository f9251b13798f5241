"""Do readings of a vector of constant length cover enough directions, and is what was fitted a sensor?

Shared by the methods that use the length alone (`ellipsoid`, `triangular`): they look before they fit, and
judge the surface after.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from margcal.core.types import Array, Fit
from margcal.methods import quadric
from margcal.methods.affine import As, model_of, scaled, too_few, unobservable

NINE = 10
"""Distinct directions that nine parameters need, so that one is left to show a misfit."""

SIX = 7
"""Distinct directions that bias and scale factors alone need."""

FAR = 3.0
"""A centre farther from the readings' mean than this many of their rms radii belongs to no sensor."""


def distinct_directions(
    y: ArrayLike, B: ArrayLike | None = None, H: ArrayLike | None = None, angle_deg: float = 15.0
) -> int:
    """Number of directions of the sensed vector that are more than `angle_deg` apart.

    Parameters
    ----------
    y : array_like (J, 3), raw unit
    B : array_like (3,), optional
        Bias; before any fit, the centre of the sphere nearest to the readings is taken (linear least
        squares), which is good to well below 15 degrees for gains that differ by less than a fifth.
    H : array_like (3, 3), optional
        Where it is known, directions are those of ``H (y - B)``.

    Notes
    -----
    Greedy: the first reading counts, and each one that is farther than `angle_deg` from all counted so far.
    Opposite directions are two.
    """
    y = np.asarray(y, dtype=np.float64).reshape(-1, 3)
    if len(y) < 2:
        return len(y)
    if B is None:
        z = scaled(y).z
        vectors = z - quadric.sphere(z)[1]
    else:
        vectors = y - np.asarray(B, dtype=np.float64)
    if H is not None:
        vectors = vectors @ np.asarray(H, dtype=np.float64).T
    left = vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300)
    count, limit = 0, math.cos(math.radians(angle_deg))
    left = left[np.isfinite(left).all(axis=1) & (np.abs(left).sum(axis=1) > 0)]
    while len(left):
        count += 1
        left = left[left @ left[0] < limit]
    return count


def refuse_few(kind: str, y: Array, needed: int, parameters: str) -> None:
    """Raise DataError where `y` (J, 3) has fewer than `needed` distinct directions."""
    found = distinct_directions(y)
    if found < needed:
        advice = f"{parameters} cannot be told apart; record attitudes that point it in other directions"
        raise too_few(kind, found, needed, "distinct directions", advice)


def start(z: Array) -> tuple[Array, Array]:
    """K and b of Taubin's fit; of a sphere where that is not an ellipsoid, to be judged after refinement."""
    K, b, good = quadric.ellipsoid_of(quadric.taubin(z))
    if good.all():
        return K, b
    K_sphere, b_sphere = quadric.sphere(z)
    return np.where(good[..., None, None], K, K_sphere), np.where(good[..., None], b, b_sphere)


def wild(z: Array, K: Array, b: Array) -> NDArray[np.bool_]:
    """Whether a surface (...,) is no sensor's: its readings in a plane, its centre far off, or needle-like."""
    flat = np.linalg.svd(z, compute_uv=False)[..., 2] < quadric.FLAT * math.sqrt(z.shape[-2])
    inverse_axes = np.linalg.eigvalsh(K)
    long = inverse_axes[..., 0] < np.maximum(1 / 5, inverse_axes[..., 2] / 20)
    far = np.linalg.norm(b, axis=-1) > FAR
    return np.asarray(flat | long | far)


def refuse_wild(kind: str, z: Array, K: Array, b: Array) -> None:
    """Raise DataError with the reason where the surface of a single node is `wild`."""
    if wild(z, K, b):
        text = f"the readings do not determine an ellipsoid: {quadric.why_not(z)}"
        raise unobservable(kind, text, float(np.linalg.norm(b)), FAR, "not-an-ellipsoid")


def length_fit(
    name: As,
    y: Array,
    magnitude: float,
    H: Array,
    B: Array,
    covariance: Array | None,
    *,
    method: str,
    cites: str,
    cost: float | Array,
    rank: int,
    condition: float,
    n_iter: int,
    converged: bool,
    details: dict[str, Array],
) -> Fit:
    """The `Fit` of a method that uses the length alone; its residual is ``||H (y - B)| - G|``."""
    u = (y - B[..., None, :]) @ np.swapaxes(H, -1, -2)
    residual = np.abs(np.linalg.norm(u, axis=-1) - magnitude)
    return Fit(
        model_of(name, H, B, method, residual, covariance),
        residual,
        cost,
        method,
        cites,
        covariance=covariance,
        rank=rank,
        condition=condition,
        n_iter=n_iter,
        converged=converged,
        details=details,
        text="" if converged else f"no convergence in {n_iter} iterations",
    )
