"""What every orientation filter here has in common: frames, flags, the track that it leaves, its state in a file.

A filter is three plain types and four functions::

    params = ...                                        named numbers, never changed by the filter
    state = start(q, sd)                                named arrays: all that it remembers
    state = step(params, state, dt, gyr, acc, mag)      one sample
    track = batch(params, state, dt, gyr, acc, mag)     a recording; track.state goes on where it ended

`dt` is the time since the sample before; the gyroscope's reading is taken for the mean rate over that time. The earth
frame is ENU with y to magnetic north; q takes node components to it, scalar first. Readings are SI, `mag` in any unit.
NaN means not measured. Leading axes are nodes side by side: gyr (..., 3) for `step`, (..., N, 3) for `batch`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from margcal.core.types import Array, Mask

ACC, MAG, NO_GYR, GAP = 1, 2, 4, 8
"""Bits of a sample's flags: the accelerometer was used, the magnetometer was used, the rate was not measured, time was
missing before this sample."""

Flags = NDArray[np.uint8]

LONGEST_STEP = 10.0
"""Seconds without samples after which a filter is as ignorant as it can be; longer gaps count as this long."""

SHORTEST_STEP = 1e-9
"""Seconds; a step of zero (the first sample) measures with the variance that this gives, that is not at all."""

FASTEST = 1000.0
"""rad/s; no node turns like this (57 000 deg/s), so such a reading is none."""


class Track(NamedTuple):
    """What a filter makes of a recording.

    Attributes
    ----------
    q : ndarray (..., N, 4)
        Node to earth (ENU), scalar first, unit length, after each sample.
    variance : ndarray (..., N, 3), rad^2
        Of the small rotation about east, north and up (the last is the heading) that the estimate is off by, as the
        filter believes.
    flags : ndarray (..., N), uint8
        Bits `ACC`, `MAG`, `NO_GYR`, `GAP`: what was selected, what was missing.
    state : the filter's own state after the last sample
    """

    q: Array
    variance: Array
    flags: Flags
    state: Any


def as_samples(*arrays: ArrayLike) -> tuple[Array, ...]:
    """float64 arrays (..., N, 3)."""
    return tuple(np.asarray(a, dtype=np.float64) for a in arrays)


def as_quaternion(q: ArrayLike) -> Array:
    """Unit quaternions (..., 4), a copy."""
    copy: Array = np.array(q, dtype=np.float64)
    return copy / np.linalg.norm(copy, axis=-1, keepdims=True)


def to_plain(values: Any) -> dict[str, Any]:
    """Params or state as lists and numbers, for JSON. Numbers read back to the same float64."""
    plain = {name: v if isinstance(v, dict) else np.asarray(v).tolist() for name, v in values._asdict().items()}
    return {"type": type(values).__name__, **plain}


def from_plain(kind: Callable[..., Any], plain: dict[str, Any]) -> Any:
    """Inverse of `to_plain` for the named tuple class `kind`."""
    wanted = {k: v for k, v in plain.items() if k != "type"}
    return kind(**{k: v if isinstance(v, (int, float, dict)) else np.array(v) for k, v in wanted.items()})


def measured_rate(gyr: Array) -> Mask:
    """Which readings (..., 3) are rates."""
    with np.errstate(invalid="ignore"):
        return np.max(np.abs(gyr), axis=-1) < FASTEST  # False for NaN


def unit_sample(v: Array, least: float = 1e-12) -> tuple[Array, Array, Mask]:
    """Unit vectors (..., 3), lengths (...) and which had a direction; the others are zero with length zero."""
    with np.errstate(invalid="ignore", over="ignore"):
        length = np.sqrt(v[..., 0] * v[..., 0] + v[..., 1] * v[..., 1] + v[..., 2] * v[..., 2])
        good = (length > least) & (length < np.inf)
    length = np.where(good, length, 0.0)
    return np.where(good[..., None], v, 0.0) / np.where(good, length, 1.0)[..., None], length, good


def product(p: Array, q: Array) -> Array:
    """Hamilton product of quaternions (..., 4), written out: `so3.quat_multiply` takes five times as long on one."""
    a, b, c, d = p[..., 0], p[..., 1], p[..., 2], p[..., 3]
    w, x, y, z = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    out = np.empty(np.broadcast_shapes(p.shape, q.shape))
    out[..., 0] = a * w - b * x - c * y - d * z
    out[..., 1] = a * x + b * w + c * z - d * y
    out[..., 2] = a * y - b * z + c * w + d * x
    out[..., 3] = a * z + b * y - c * x + d * w
    return out


def rotation_step(v: Array) -> Array:
    """Quaternion (..., 4) of the rotation vector v (..., 3) rad."""
    square = v[..., 0] * v[..., 0] + v[..., 1] * v[..., 1] + v[..., 2] * v[..., 2]
    half = 0.5 * np.sqrt(square)
    small = half < 1e-4
    sinc = np.where(small, 0.5 - square / 48, 0.5 * np.sin(half) / np.where(small, 1.0, half))
    out = np.empty((*v.shape[:-1], 4))
    out[..., 0] = np.cos(half)
    out[..., 1:] = sinc[..., None] * v
    return out


def to_earth(q: Array, v: Array) -> Array:
    """Vectors v (..., 3) of the node in the earth frame: ``q v q+`` without building the matrix."""
    w, x, y, z = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    a, b, c = v[..., 0], v[..., 1], v[..., 2]
    p, r, s = 2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a)  # 2 e x v
    out = np.empty((*np.broadcast_shapes(q.shape[:-1], v.shape[:-1]), 3))
    out[..., 0] = a + w * p + y * s - z * r
    out[..., 1] = b + w * r + z * p - x * s
    out[..., 2] = c + w * s + x * r - y * p
    return out


def earth_tangents(q: Array) -> Array:
    """The unit 4-vectors (..., 3, 4) along which q moves when turned about east, north, up: (0, e_i) q."""
    w, x, y, z = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    out = np.empty((*q.shape[:-1], 3, 4))
    out[..., 0, 0], out[..., 0, 1], out[..., 0, 2], out[..., 0, 3] = -x, w, -z, y
    out[..., 1, 0], out[..., 1, 1], out[..., 1, 2], out[..., 1, 3] = -y, z, w, -x
    out[..., 2, 0], out[..., 2, 1], out[..., 2, 2], out[..., 2, 3] = -z, -y, x, w
    return out
