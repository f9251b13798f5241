"""How the housing lay at each rest: the labels of `--poses` turned into rotations, or inferred.

`R_nh` (J, 3, 3) takes housing components to the laboratory (z up). `up` (J, 3) is the housing direction that
points up, all that is known of a rest whose heading is not. Nothing here calibrates; rough models of the
accelerometer and the gyroscope serve only to tell ninety degrees from zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from margcal.core import so3
from margcal.core.errors import DataError
from margcal.core.types import Array, Index, Issue
from margcal.methods.alignment import rotation_from_dip
from margcal.methods.ellipsoid import ellipsoid
from margcal.workflow.segment import Segmentation

Mode = Literal["cube", "faces", "file", "reference", "free", "swing"]

FACE_TILT_DEG = 12.0
"""A rest whose "up" is farther than this from every housing axis does not lie on a face."""
CUBE_SNAP_DEG = 20.0
"""A turn that ends farther than this from every one of the 24 attitudes was not made by a cube."""
CUBE_RMS_DEG = 6.0
"""Root mean square of the same."""
MIN_REFERENCE = 5
"""Distinct attitudes that make a reference usable."""


@dataclass(frozen=True)
class Attitudes:
    """The attitudes that were taken for the rests.

    Attributes
    ----------
    mode : str
    frame : str
        What the calibrated frame h is: 'housing', 'marker', 'acc-triangular'.
    R : ndarray (J, 3, 3) or None
    up : ndarray (J, 3) or None
    level : bool
        Whether the level-table prior holds: "up" of the laboratory is up.
    text : str
        In words: what was taken and how sure it is.
    figures : dict
        The figures behind `text`.
    """

    mode: Mode
    frame: str
    R: Array | None = None
    up: Array | None = None
    level: bool = False
    text: str = ""
    figures: dict[str, float] = field(default_factory=dict)
    issues: tuple[Issue, ...] = ()


# --- which face is up --------------------------------------------------------------------------------


@dataclass(frozen=True)
class Faces:
    """Which housing face is up at each rest, from the accelerometer alone.

    `up` (J, 3) is one of +-e_k; `tilt_deg` (J,) how far the reading is from it after a rough calibration
    ``v = H (y - B)`` with |v| ~ 1.
    """

    up: Array
    tilt_deg: Array
    H: Array
    B: Array


def find_faces(y: Array) -> Faces | None:
    """Sort accelerometer means (J, 3) into the six faces of a box; None where they do not span space.

    The axes of the housing are named after the accelerometer's: of the 24 ways to name them, the one in which
    the accelerometer's H has the largest trace.
    """
    centre, radius = _sphere(y)
    if not np.isfinite(radius):
        return None
    H, B, up = np.eye(3) / radius, centre, np.zeros_like(y)
    for _ in range(10):
        v = _unit((y - B) @ H.T)
        up = _snap_to_axes(v)
        turned = so3.align_vectors(up, v)
        if so3.angle_between(turned, np.eye(3)) < 1e-6:
            break
        H = turned @ H
    for _ in range(3):
        H, B = _affine(y, up, H, B)
        up = _snap_to_axes(_unit((y - B) @ H.T))
    name = max(so3.cube_group(), key=lambda Q: float(np.trace(Q @ H)))
    H, up = name @ H, up @ name.T
    v = _unit((y - B) @ H.T)
    tilt = np.degrees(np.arccos(np.clip(np.sum(v * up, axis=1), -1, 1)))
    return Faces(up, tilt, H, B)


def _sphere(y: Array) -> tuple[Array, float]:
    """Centre and radius of the sphere through readings (J, 3) in least squares; NaN radius where coplanar."""
    mean = y.mean(axis=0)
    z = y - mean
    size = float(np.sqrt(np.mean(np.sum(z * z, axis=1))))
    if len(y) < 4 or size == 0 or np.linalg.svd(z / size, compute_uv=False)[2] < 0.1:
        return mean, float("nan")
    z = z / size
    A = np.column_stack([2 * z, np.ones(len(z))])
    x = np.linalg.lstsq(A, np.sum(z * z, axis=1), rcond=None)[0]
    return mean + size * x[:3], size * float(np.sqrt(x[3] + x[:3] @ x[:3]))


def _affine(y: Array, up: Array, H: Array, B: Array) -> tuple[Array, Array]:
    """H and B of ``y = B + H^-1 up`` in least squares, where all six faces were up; else unchanged."""
    seen = {tuple(np.round(c).astype(int)) for c in up}
    if len(seen) < 6:
        return H, B
    A = np.column_stack([up, np.ones(len(up))])
    x = np.linalg.lstsq(A, y, rcond=None)[0]
    return np.asarray(np.linalg.inv(x[:3].T), dtype=np.float64), x[3]


def _snap_to_axes(v: Array) -> Array:
    k = np.argmax(np.abs(v), axis=1)
    out = np.zeros_like(v)
    out[np.arange(len(v)), k] = np.sign(v[np.arange(len(v)), k])
    return out


def _unit(v: Array) -> Array:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def lies_on_faces(faces: Faces | None) -> bool:
    """Whether the rests look like those of a box put down on its faces."""
    if faces is None:
        return False
    within = np.quantile(faces.tilt_deg, 0.8) <= FACE_TILT_DEG / 2
    return bool(within and faces.tilt_deg.max() <= FACE_TILT_DEG)


# --- headings ----------------------------------------------------------------------------------------


def chain(v: Array, dR: Array, before: Index) -> tuple[Array, Index]:
    """Attitudes of the rests from the turns between them, levelled by the accelerometer.

    Parameters
    ----------
    v : ndarray (J, 3)
        "Up" in the node frame at each rest (calibrated accelerometer), any length.
    dR : ndarray (T, 3, 3)
        R_before_after of the turns.
    before : ndarray (T,) of int
        Rest before each turn; the rest after it is the next one.

    Returns
    -------
    R : ndarray (J, 3, 3)
        R_nh with ``R^T z`` along v; headings count from the first rest of each chain.
    piece : ndarray (J,) of int
        Number of the unbroken chain that each rest is in.
    """
    turn = {int(i): k for k, i in enumerate(before)}
    R = np.empty((len(v), 3, 3))
    piece = np.zeros(len(v), dtype=np.int64)
    for j in range(len(v)):
        if j and j - 1 in turn:
            R[j] = _levelled(R[j - 1] @ dR[turn[j - 1]], v[j])
            piece[j] = piece[j - 1]
        else:
            R[j] = _levelled(np.eye(3), v[j])
            piece[j] = piece[j - 1] + 1 if j else 0
    return R, piece


def _levelled(R: Array, v: Array) -> Array:
    """The attitude nearest to `R` in which the node direction `v` points up: R Q with (R Q)^T z along v."""
    have, want = R[2], _unit(v)  # R^T z
    axis = np.cross(want, have)
    sine, cosine = float(np.linalg.norm(axis)), float(want @ have)
    if sine < 1e-12:
        axis = np.eye(3)[np.argmin(np.abs(want))] if cosine < 0 else axis
        axis = np.cross(want, axis) if cosine < 0 else axis
        sine_ = np.linalg.norm(axis)
        turn = np.pi * axis / sine_ if cosine < 0 else np.zeros(3)
    else:
        turn = axis / sine * np.arctan2(sine, cosine)
    return R @ so3.exp(turn)


def _heading_choices(up: Array) -> Array:
    """The four cube attitudes R_nh (4, 3, 3) with housing direction `up` pointing up, 90 degrees apart."""
    group = so3.cube_group()
    base = next(R for R in group if np.allclose(R[2], up))
    quarter = so3.exp(np.pi / 2 * np.arange(4)[:, None] * np.array([0.0, 0.0, 1.0]))
    return np.round(quarter @ base)


def snap_chain(up: Array, dR: Array, before: Index) -> tuple[Array, Index, Array]:
    """Cube attitudes from the turns, snapped at every rest so that no error adds up.

    Returns
    -------
    R : ndarray (J, 3, 3), piece : ndarray (J,), snap_deg : ndarray (T,)
        `snap_deg` is how far each turn ended from the attitude that was taken.
    """
    turn = {int(i): k for k, i in enumerate(before)}
    R = np.empty((len(up), 3, 3))
    piece = np.zeros(len(up), dtype=np.int64)
    snap = np.full(len(before), np.nan)
    for j in range(len(up)):
        choices = _heading_choices(up[j])
        if j and j - 1 in turn:
            k = turn[j - 1]
            off = so3.angle_between(R[j - 1] @ dR[k], choices)
            R[j], snap[k] = choices[np.argmin(off)], np.degrees(off.min())
            piece[j] = piece[j - 1]
        else:
            R[j] = choices[0]
            piece[j] = piece[j - 1] + 1 if j else 0
    return R, piece, snap


@dataclass(frozen=True)
class FieldHeadings:
    """Cube attitudes from the magnetometer: `R` (J, 3, 3) up to one common heading, and how far each is off."""

    R: Array
    off_deg: Array


def headings_from_field(m: Array, up: Array) -> FieldHeadings | None:
    """Which of the four headings each rest has, from the magnetometer and the face that is up.

    The field's vertical component is the same at all rests: with ``v_j = K (m_j - B)`` on the unit sphere (the
    ellipsoid fit) and the unknown rotation Omega to the housing, ``up_j . (Omega v_j) = const`` is linear in
    Omega. Its horizontal part then points to one of four headings.

    Returns
    -------
    FieldHeadings or None
        None where the magnetometer's readings do not determine it.
    """
    if len(m) < 10:
        return None
    try:
        fit = ellipsoid(m, 1.0, kind="mag")
    except DataError:
        return None
    v = _unit(fit.model.apply(m))
    Omega = rotation_from_dip(v, up, least=1e-3)  # ninety degrees are told with less than a mounting needs
    if Omega is None:
        return None
    w = v @ Omega.T
    choices = np.array([_heading_choices(c) for c in up])  # (J, 4, 3, 3)
    level = np.einsum("jab,jb->ja", choices[:, 0], w)
    alpha = np.arctan2(level[:, 1], level[:, 0])
    common = np.angle(np.sum(np.exp(4j * alpha) * np.hypot(level[:, 0], level[:, 1]))) / 4
    k = np.round((common - alpha) / (np.pi / 2)).astype(int)
    off = np.abs(common - alpha - k * np.pi / 2)
    return FieldHeadings(choices[np.arange(len(up)), k % 4], np.degrees(off))


def join_pieces(R: Array, piece: Index, field_R: Array | None) -> tuple[Array, float, int]:
    """Turn every unbroken chain to the magnetometer's common heading, by majority.

    Returns
    -------
    R : ndarray (J, 3, 3)
    agree : float
        Share of the rests at which gyroscope and magnetometer then say the same (NaN without magnetometer).
    joined : int
        Number of chains that nothing joins to the first one.
    """
    if field_R is None:
        return R, float("nan"), int(piece.max())
    out = R.copy()
    quarter = _heading_choices(np.array([0.0, 0.0, 1.0]))
    quarter = quarter @ quarter[0].T
    same = np.zeros(len(R), dtype=bool)
    for p in np.unique(piece):
        inside = piece == p
        # field_R = Q R for one of four Q of the whole chain
        match = [np.isclose(field_R[inside], Q @ R[inside]).all(axis=(1, 2)) for Q in quarter]
        best = int(np.argmax([m.sum() for m in match]))
        out[inside] = quarter[best] @ R[inside]
        same[inside] = match[best]
    return out, float(same.mean()), 0


# --- given attitudes ---------------------------------------------------------------------------------


def from_directions(up: Sequence[str], front: Sequence[str | None] | None) -> tuple[Array, Array | None]:
    """Housing directions (J, 3) that point up, and R_nh (J, 3, 3) where `front` (to the laboratory's +y) is given."""
    c = np.array([_axis(name) for name in up])
    if front is None or any(f is None for f in front):
        return c, None
    d = np.array([_axis(str(name)) for name in front])
    return c, np.stack([np.cross(d, c), d, c], axis=1)


def _axis(name: str) -> Array:
    sign = -1.0 if name[0] == "-" else 1.0
    return sign * np.eye(3)["xyz".index(name[-1])]


def from_reference(segmentation: Segmentation) -> Array | None:
    """R of the rests from the reference attitude, NaN where it was not seen; None without a reference."""
    q = segmentation.poses.q_ref
    if q is None:
        return None
    seen = np.isfinite(q).all(axis=1)
    R = np.full((len(q), 3, 3), np.nan)
    if seen.any():
        R[seen] = so3.matrix_from_quat(q[seen])
    return R


def count_distinct(R: Array, angle_deg: float = 10.0) -> int:
    """Number of attitudes in `R` (J, 3, 3) that differ by more than `angle_deg` from those counted before."""
    kept: list[Array] = []
    for one in R:
        if np.isfinite(one).all() and all(so3.angle_between(one, k) > np.radians(angle_deg) for k in kept):
            kept.append(one)
    return len(kept)
