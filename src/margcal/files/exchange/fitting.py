"""The nearest H that a target can hold, and the board orientations that autopilots list.

Minimised is the mean square of ``|H' H^-1 u - u|`` over all directions of u, which is ``||H' H^-1 - I||^2 / 3`` in the
Frobenius norm and linear in the parameters of H'. The result is scaled to the determinant of H: least squares shrinks
what it cannot turn, and lengths would be a little short.
"""

from __future__ import annotations

import math

import numpy as np

from margcal.core import so3
from margcal.core.types import Array
from margcal.files.exchange.target import Matrix

_EULER = (
    "0 0 0|0 0 45|0 0 90|0 0 135|0 0 180|0 0 225|0 0 270|0 0 315|180 0 0|180 0 45|180 0 90|180 0 135|0 180 0|180 0 225|"
    "180 0 270|180 0 315|90 0 0|90 0 45|90 0 90|90 0 135|270 0 0|270 0 45|270 0 90|270 0 135|0 90 0|0 270 0|0 180 90|"
    "0 180 270|90 90 0|180 90 0|270 90 0|90 180 0|270 180 0|90 270 0|180 270 0|270 270 0|90 180 90|90 0 270"
)
"""Roll, pitch, yaw in degrees of orientations 0 to 37, which MAVLink, ArduPilot and PX4 number alike
(MAV_SENSOR_ORIENTATION; ArduPilot AP_Math/rotations.h; PX4 lib/conversion/rotation.h). Higher numbers differ."""


def _from_euler(roll: float, pitch: float, yaw: float) -> Array:
    """R_z(yaw) R_y(pitch) R_x(roll), which takes sensor to board components."""
    axes = np.eye(3)
    angles = (math.radians(yaw), math.radians(pitch), math.radians(roll))
    z, y, x = (so3.exp(a * axes[k]) for a, k in zip(angles, (2, 1, 0)))
    return np.where(np.abs(R := z @ y @ x) < 1e-12, 0.0, R)


ORIENTATIONS: tuple[Array, ...] = tuple(_from_euler(*map(float, e.split())) for e in _EULER.split("|"))
"""Rotation matrices (3, 3) by number; orientation 0 is the identity."""


def orientation_of(H: Array, *, before: bool) -> int:
    """Number of the board orientation nearest to the rotation in `H`: H = S R (`before` the matrix) or H = R S.

    Both polar decompositions have the same rotation, so `before` only says where it will stand.
    """
    R, _ = so3.polar(H)
    return int(np.argmax([np.sum(R * Q) for Q in ORIENTATIONS]))


def orientation_number(R: Array) -> int:
    """The number of orientation matrix `R`."""
    return int(np.argmax([np.sum(R * Q) for Q in ORIENTATIONS]))


def inverse(A: Array) -> Array:
    """The inverse of `A` (3, 3)."""
    return np.asarray(np.linalg.inv(A), dtype=np.float64)


def _basis(matrix: Matrix) -> list[Array]:
    unit = np.eye(9).reshape(3, 3, 3, 3)
    if matrix == "full":
        return [unit[i, j] for i in range(3) for j in range(3)]
    if matrix == "lower":
        return [unit[i, j] for i in range(3) for j in range(i + 1)]
    if matrix == "symmetric":
        return [unit[i, j] if i == j else unit[i, j] + unit[j, i] for i in range(3) for j in range(i, 3)]
    if matrix == "diagonal":
        return [unit[i, i] for i in range(3)]
    return [np.eye(3)]


def nearest(H: Array, matrix: Matrix, R: Array | None = None, *, before: bool = False) -> Array:
    """The H' nearest to `H` that is ``R M`` (or ``M R`` if `before`) with M of the shape `matrix`.

    Parameters
    ----------
    H : ndarray (3, 3)
    matrix : {'full', 'lower', 'symmetric', 'diagonal', 'scalar', 'unit'}
        'unit': M is the identity, nothing is fitted.
    R : ndarray (3, 3), optional
        A rotation that the target applies beside M.
    """
    R = np.eye(3) if R is None else R
    if matrix == "full":
        return np.array(H)
    if matrix == "unit":
        return np.array(R)
    G = inverse(H)
    shapes = [E @ R if before else R @ E for E in _basis(matrix)]
    columns = np.column_stack([(E @ G).ravel() for E in shapes])
    parameters, *_ = np.linalg.lstsq(columns, np.eye(3).ravel(), rcond=None)
    found = np.einsum("k,kij->ij", parameters, np.array(shapes))
    ratio = np.linalg.det(H) / np.linalg.det(found) if np.linalg.det(found) else 0.0
    return found * np.cbrt(ratio) if ratio > 0 else found


def lower_frame(H: Array) -> Array:
    """R_ih: the turn of the frame after which ``R_ih H`` is lower triangular with a positive diagonal.

    For a mirrored triad (det H < 0) the last diagonal element is negative, since the frame may only be turned.
    """
    flip = np.eye(3)[::-1]
    Q, U = np.linalg.qr(flip @ H @ flip)  # flipped both ways, an upper triangle is a lower one
    signs = np.where(np.diag(U) < 0, -1.0, 1.0)
    R = (flip @ (Q * signs) @ flip).T
    if np.linalg.det(R) < 0:
        R = np.diag([1.0, 1.0, -1.0]) @ R
    return R


def lower_times_rotation(K: Array) -> tuple[Array, Array]:
    """``K = L C``, L lower triangular with a positive diagonal, C a rotation.

    For a mirrored triad (det K < 0) the last diagonal element of L is negative.
    """
    Q, U = np.linalg.qr(K.T)
    signs = np.where(np.diag(U) < 0, -1.0, 1.0)
    L, C = U.T * signs, (Q * signs).T
    if np.linalg.det(C) < 0:
        mirror = np.diag([1.0, 1.0, -1.0])
        L, C = L @ mirror, mirror @ C
    return np.tril(L), C
