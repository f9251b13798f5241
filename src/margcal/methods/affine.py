"""What every solver of ``u = H (y - B)`` shares: checks of the poses, scaling, the way back, the sign.

Readings are centred and scaled before anything is solved, ``z = (y - m) / k``, so that a 32000-count offset
costs nothing; the solvers find ``s = A z + a`` (of unit length, the magnitude taken out) and the way back is

    H = G A / k,    B = m - k A^-1 a.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from margcal.core.errors import DataError, InputError
from margcal.core.types import Array, Issue, Kind, SensorModel

MIN_POSES = 5
"""Poses with known rotations that twelve unknowns and a direction need (14 <= 3 J - 1)."""


class As(NamedTuple):
    """What the model is called: kind of sensor and its units."""

    kind: Kind
    raw_unit: str
    unit: str


class Scaled(NamedTuple):
    """Centred and scaled readings ``z = (y - centre) / scale``; `scale` has the leading axes only."""

    z: Array
    centre: Array
    scale: Array


def checked_readings(y: ArrayLike, kind: str, least: int = 1) -> Array:
    """`y` as float64 (..., J, 3), finite, with at least `least` poses.

    Raises
    ------
    InputError
        If the shape is wrong or a reading is not finite.
    DataError
        If there are fewer than `least` poses.
    """
    y = np.asarray(y, dtype=np.float64)
    if y.ndim < 2 or y.shape[-1] != 3:
        raise InputError(f"{kind}: readings have shape {y.shape}; expected (..., J, 3)")
    if not np.isfinite(y).all():
        bad = int(np.argwhere(~np.isfinite(y))[0][-2])
        raise InputError(f"{kind}: reading {bad} is not finite; leave it out before fitting")
    if y.shape[-2] < least:
        raise too_few(kind, y.shape[-2], least, "poses")
    return y


def checked_rotations(R: ArrayLike, n_poses: int) -> Array:
    """`R` as float64 (..., J, 3, 3).

    Raises
    ------
    InputError
        If the shape is wrong, there is not one rotation a pose, or a matrix is not a rotation.
    """
    R = np.asarray(R, dtype=np.float64)
    if R.ndim < 3 or R.shape[-2:] != (3, 3) or R.shape[-3] != n_poses:
        raise InputError(f"rotations have shape {R.shape}; expected (..., {n_poses}, 3, 3), one a pose")
    wrong = np.abs(np.swapaxes(R, -1, -2) @ R - np.eye(3)).max(axis=(-1, -2)) > 1e-6
    wrong |= determinant3(R) < 0
    if wrong.any():
        raise InputError(f"rotation {int(np.argwhere(wrong)[0][-1])} is not a rotation (orthogonal, det +1)")
    return R


def too_few(kind: str, found: int, needed: int, what: str, advice: str = "") -> DataError:
    """The error for too few poses or directions, naming the number found and the number needed."""
    text = f"{kind}: {found} {what} found, {needed} needed; {advice or 'record more attitudes'}"
    code = "too-few-directions" if "direction" in what else "too-few-poses"
    sensor: Kind | None = kind if kind in ("acc", "gyr", "mag") else None  # type: ignore[assignment]
    return DataError(text, [Issue(code, "fail", text, sensor, float(found), float(needed))])


def unobservable(kind: str, text: str, value: float, limit: float, code: str = "unobservable") -> DataError:
    """The error for poses that leave something undetermined."""
    sensor: Kind | None = kind if kind in ("acc", "gyr", "mag") else None  # type: ignore[assignment]
    text = f"{kind}: {text}"
    return DataError(text, [Issue(code, "fail", text, sensor, float(value), float(limit))])


def scaled(y: Array, weights: Array | None = None) -> Scaled:
    """Readings centred on their (weighted) mean and divided by their rms distance from it."""
    if weights is None:
        centre = y.sum(axis=-2) / y.shape[-2]
    else:
        centre = np.einsum("...j,...ji->...i", weights, y) / weights.sum(axis=-1)[..., None]
    z = y - centre[..., None, :]
    scale = np.sqrt(np.einsum("...ji,...ji->...", z, z) / y.shape[-2])
    scale = np.where(scale > 0, scale, 1.0)
    z /= scale[..., None, None]
    return Scaled(z, centre, scale)


def inverse3(A: Array) -> Array:
    """Inverse of (..., 3, 3) by cofactors: for many small matrices at once, where LAPACK's calls cost more."""
    out = np.empty_like(A)
    for i, j in np.ndindex(3, 3):
        p, q, r, s = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
        out[..., j, i] = A[..., p, r] * A[..., q, s] - A[..., p, s] * A[..., q, r]
    with np.errstate(divide="ignore", invalid="ignore"):
        out /= _expanded(A, out)[..., None, None]
    return out


def _expanded(A: Array, cofactors: Array) -> Array:
    """Determinant along the first row of `A`, whose cofactors are the first column of the adjugate."""
    return (
        A[..., 0, 0] * cofactors[..., 0, 0] + A[..., 0, 1] * cofactors[..., 1, 0] + A[..., 0, 2] * cofactors[..., 2, 0]
    )


def determinant3(A: Array) -> Array:
    """Determinant of (..., 3, 3); NaN where an element is."""
    a, b, c = A[..., 0, 0], A[..., 0, 1], A[..., 0, 2]
    d, e, f = A[..., 1, 0], A[..., 1, 1], A[..., 1, 2]
    g, h, i = A[..., 2, 0], A[..., 2, 1], A[..., 2, 2]
    return a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)


def unscaled(A: Array, a: Array, data: Scaled, magnitude: ArrayLike) -> tuple[Array, Array]:
    """H and B from the scaled model ``s = A z + a``."""
    gain = np.asarray(magnitude, dtype=np.float64) / data.scale
    offset = np.einsum("...ij,...j->...i", inverse3(A), a)
    return A * gain[..., None, None], data.centre - data.scale[..., None] * offset


def unscaled_covariance(cov: Array, A: Array, a: Array, data: Scaled, magnitude: float) -> Array:
    """Covariance (12, 12) of (H row by row, B) from that of (A row by row, a)."""
    inverse = np.linalg.inv(A)
    b = -inverse @ a
    T = np.zeros((12, 12))
    T[:9, :9] = np.eye(9) * (magnitude / data.scale)
    # B = m - k A^-1 a  gives  dB = -k A^-1 (dA b + da)
    T[9:, :9] = -data.scale * np.kron(inverse, b)
    T[9:, 9:] = -data.scale * inverse
    cov = T @ cov @ T.T
    return (cov + cov.T) / 2


def positive(H: Array, *others: Array) -> tuple[Array, ...]:
    """(H, u) and (-H, -u) fit equally well: the pair with det H > 0. Arrays (..., 3, 3), (..., 3) ..."""
    sign = np.where(determinant3(H) < 0, -1.0, 1.0)
    return H * sign[..., None, None], *(v * sign[..., None] for v in others)


def tangents(u: Array) -> Array:
    """Two unit vectors across `u` (..., 3) as the columns of (..., 3, 2)."""
    u = np.asarray(u, dtype=np.float64)
    helper = np.eye(3)[np.argmin(np.abs(u), axis=-1)]
    first = np.cross(u, helper)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    second = np.cross(u, first)
    return np.stack([first, second / np.linalg.norm(second, axis=-1, keepdims=True)], axis=-1)


def pose_residual(y: Array, R: Array, H: Array, B: Array, u: Array) -> Array:
    """Misfit vectors ``R_j u - H (y_j - B)``, (..., J, 3), in the unit of `u`."""
    return predicted(R, u) - (y - B[..., None, :]) @ np.swapaxes(H, -1, -2)


def predicted(R: Array, u: Array) -> Array:
    """``R_j u`` (..., J, 3); one matrix product where all nodes share their poses."""
    if R.ndim == 3:
        return (u @ R.reshape(-1, 3).T).reshape(*u.shape[:-1], -1, 3)
    return (R @ u[..., None, :, None])[..., 0]


def model_of(
    name: As, H: Array, B: Array, method: str, residual: Array, covariance: Array | None = None
) -> SensorModel:
    """The `SensorModel` of an estimate; `residual` (..., J) are norms in the calibrated unit."""
    rms = float(np.sqrt(np.mean(residual * residual))) if residual.ndim == 1 else None
    return SensorModel(
        name.kind,
        H,
        B,
        name.raw_unit,
        name.unit,
        covariance=covariance,
        residual_rms=rms,
        n_poses=residual.shape[-1],
        method=method,
    )
