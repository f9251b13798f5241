"""Rotations as plain arrays: what scipy's `Rotation` lacks or what must not wait half a second for its import.

Matrices (..., 3, 3), rotation vectors (..., 3) rad, quaternions (..., 4) scalar first, Hamilton, with
``v_a = R_ab v_b`` and ``rotate(q_ab, v_b) = q v q+``. Leading axes broadcast. Public interfaces speak scipy
`Rotation`; these functions are the kernels behind them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from margcal.core.types import Array

_SMALL = 1e-4
"""Below this angle (rad) the closed forms lose digits to cancellation and series take over."""


def skew(v: ArrayLike) -> Array:
    """Cross-product matrix: ``skew(a) @ b = a x b``; (..., 3) -> (..., 3, 3)."""
    v = np.asarray(v, dtype=np.float64)
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2] = -v[..., 2], v[..., 1]
    out[..., 1, 0], out[..., 1, 2] = v[..., 2], -v[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -v[..., 1], v[..., 0]
    return out


def sinc_terms(angle: Array) -> tuple[Array, Array, Array]:
    """sin(a)/a, (1 - cos a)/a^2, (a - sin a)/a^3, exact through a = 0."""
    small = angle < _SMALL
    a = np.where(small, 1.0, angle)
    a2 = angle * angle
    s = np.where(small, 1 - a2 / 6, np.sin(a) / a)
    # 2 sin^2(a/2) instead of 1 - cos a: no cancellation
    c = np.where(small, 0.5 - a2 / 24, 2 * np.sin(a / 2) ** 2 / a**2)
    d = np.where(small, 1 / 6 - a2 / 120, (a - np.sin(a)) / a**3)
    return s, c, d


def exp(v: ArrayLike) -> Array:
    """Rotation matrix of rotation vector `v` (Rodrigues)."""
    v = np.asarray(v, dtype=np.float64)
    s, c, _ = sinc_terms(np.linalg.norm(v, axis=-1))
    k = skew(v)
    return np.eye(3) + s[..., None, None] * k + c[..., None, None] * (k @ k)


def log(R: ArrayLike) -> Array:
    """Rotation vector of `R`, angle in [0, pi]; exact near identity and near pi (through the quaternion)."""
    return quat_log(quat_from_matrix(R))


def left_jacobian(v: ArrayLike) -> Array:
    """J_l with ``exp(v + d) ~ exp(J_l(v) d) exp(v)``."""
    v = np.asarray(v, dtype=np.float64)
    _, c, d = sinc_terms(np.linalg.norm(v, axis=-1))
    k = skew(v)
    return np.eye(3) + c[..., None, None] * k + d[..., None, None] * (k @ k)


def right_jacobian(v: ArrayLike) -> Array:
    """J_r with ``exp(v + d) ~ exp(v) exp(J_r(v) d)``; ``J_r(v) = J_l(-v)``."""
    return left_jacobian(-np.asarray(v, dtype=np.float64))


def left_jacobian_inverse(v: ArrayLike) -> Array:
    """Inverse of `left_jacobian`, for angles below 2 pi."""
    return np.asarray(np.linalg.inv(left_jacobian(v)), dtype=np.float64)


def quat_multiply(a: ArrayLike, b: ArrayLike) -> Array:
    """Hamilton product of scalar-first quaternions: ``R(a b) = R(a) R(b)``."""
    a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    aw, av, bw, bv = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    w = aw * bw - np.sum(av * bv, axis=-1, keepdims=True)
    return np.concatenate([w, aw * bv + bw * av + np.cross(av, bv)], axis=-1)


def quat_conjugate(q: ArrayLike) -> Array:
    return np.asarray(q, dtype=np.float64) * np.array([1.0, -1.0, -1.0, -1.0])


def quat_exp(v: ArrayLike) -> Array:
    """Unit quaternion of rotation vector `v`."""
    v = np.asarray(v, dtype=np.float64)
    angle = np.linalg.norm(v, axis=-1, keepdims=True)
    half_sinc = 0.5 * sinc_terms(angle / 2)[0]
    return np.concatenate([np.cos(angle / 2), half_sinc * v], axis=-1)


def quat_log(q: ArrayLike) -> Array:
    """Rotation vector of unit quaternion `q` (either sign), angle in [0, pi]."""
    q = np.asarray(q, dtype=np.float64)
    q = np.where(q[..., :1] < 0, -q, q)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, q[..., :1])
    safe = np.where(sine > 0, sine, 1.0)
    return np.where(sine > 1e-9, angle / safe, 2.0) * q[..., 1:]


def matrix_from_quat(q: ArrayLike) -> Array:
    """Rotation matrix of quaternion `q`, which is normalised here."""
    q = np.asarray(q, dtype=np.float64)
    unit: Array = q / np.linalg.norm(q, axis=-1, keepdims=True)
    w, v = unit[..., 0, None, None], unit[..., 1:]
    k = skew(v)
    return np.eye(3) + 2 * w * k + 2 * (k @ k)


def quat_from_matrix(R: ArrayLike) -> Array:
    """Unit quaternion (scalar part >= 0) of rotation matrix `R`.

    Notes
    -----
    Bar-Itzhack's 4x4 form for every branch at once: the column of the largest diagonal element of
    4 q q^T is taken, so no branch divides by a small number.
    """
    R = np.asarray(R, dtype=np.float64)
    t = np.trace(R, axis1=-2, axis2=-1)
    K = np.empty((*R.shape[:-2], 4, 4))
    axis = np.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], -1)
    K[..., 0, 0] = 1 + t
    K[..., 0, 1:] = K[..., 1:, 0] = axis
    K[..., 1:, 1:] = R + np.swapaxes(R, -1, -2) + (1 - t)[..., None, None] * np.eye(3)
    best = np.argmax(np.diagonal(K, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(K, best[..., None, None], axis=-1)[..., 0]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., :1] < 0, -q, q)


def angle_between(R1: ArrayLike, R2: ArrayLike) -> Array:
    """Geodesic angle between two rotations, rad in [0, pi]."""
    R1, R2 = np.asarray(R1, dtype=np.float64), np.asarray(R2, dtype=np.float64)
    return np.linalg.norm(log(np.swapaxes(R1, -1, -2) @ R2), axis=-1)


def nearest_rotation(A: ArrayLike) -> Array:
    """The proper rotation (det +1) nearest to `A` in the Frobenius norm."""
    U, _, Vt = np.linalg.svd(np.asarray(A, dtype=np.float64))
    sign = np.sign(np.linalg.det(U @ Vt))
    U = U.copy()
    U[..., :, 2] *= sign[..., None]
    return U @ Vt


def mean_rotation(R: ArrayLike) -> Array:
    """Chordal mean of rotations (n, 3, 3)."""
    return nearest_rotation(np.mean(np.asarray(R, dtype=np.float64), axis=0))


def align_vectors(a: ArrayLike, b: ArrayLike, weights: ArrayLike | None = None) -> Array:
    """R_ab that takes `b` (n, 3) nearest to `a` (n, 3) in (weighted) least squares (Wahba's problem)."""
    a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    w = np.ones(len(a)) if weights is None else np.asarray(weights, dtype=np.float64)
    return nearest_rotation(np.einsum("n,ni,nj->ij", w, a, b))


def polar(A: ArrayLike) -> tuple[Array, Array]:
    """Right polar decomposition ``A = R S``, R orthogonal with det of A's sign, S symmetric positive definite."""
    U, s, Vt = np.linalg.svd(np.asarray(A, dtype=np.float64))
    V = np.swapaxes(Vt, -1, -2)
    return U @ Vt, (V * s[..., None, :]) @ Vt


def cube_group() -> Array:
    """The 24 proper rotations that take a cube to itself, (24, 3, 3); the first is the identity."""
    found = []
    for permutation in ((0, 1, 2), (1, 2, 0), (2, 0, 1), (0, 2, 1), (2, 1, 0), (1, 0, 2)):
        for signs in np.ndindex(2, 2, 2):
            R = np.zeros((3, 3))
            R[np.arange(3), permutation] = 1 - 2 * np.array(signs)
            if np.linalg.det(R) > 0:
                found.append(R)
    return np.array(found)
