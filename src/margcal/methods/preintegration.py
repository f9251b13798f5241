"""Integration of the gyroscope between two rests, and its derivatives with respect to H and B.

Z-TIE: Z.-Q. Zhang, "Two-step calibration methods for miniature inertial and magnetic sensor units", IEEE
Trans. Ind. Electron. 62(6), 2015. Appendix D, (52)-(55). The derivatives are those of pre-integration on
SO(3): Forster, Carlone, Dellaert, Scaramuzza, IEEE Trans. Robot. 33(1), 2017, section VI and appendix, taken
here with respect to the nine entries of H as well.

=================  ==================  ===================================================  ===============
name here          symbol              meaning                                              shape
=================  ==================  ===================================================  ===============
y                  y_g^{j,l}           raw readings of the turns, padded                    (..., N, 3)
dt                 Delta t             interval that each reading stands for; 0 = padding   (..., N)
H, B               H_g, B_g            transformation matrix, combined bias                 (..., 3, 3), (..., 3)
phi                u_g^{j,l} Delta t   rotation vector of each sample, rad                  (..., N, 3)
integrate_quat     Int                 attitude after the turn in the frame before it       (..., 4)
=================  ==================  ===================================================  ===============

Sign, derived twice. (1) The gyroscope reads the rate of the node in the node's own frame h, so
d/dt R_nh = R_nh [u]x, hence R_nh(t + dt) = R_nh(t) exp(u dt) and

    R_nh(after) = R_nh(before) dR,    dR = exp(u_1 dt_1) exp(u_2 dt_2) ... exp(u_N dt_N) = R_before_after:

dR takes components in the node frame AFTER the turn to the node frame BEFORE it, v_before = dR v_after. (2) A
vector v_n at rest in the laboratory has v_h = R_nh^T v_n, so v_before = R_nh(before)^T R_nh(after) v_after:
the same dR. In Z-TIE, (24) is u_j = R_j^i u_i (subscript: to, superscript: from), so R_j^{j+1} of (42) takes
components of pose j + 1 to pose j: it is dR, and (42) holds as printed with (54). The rotation that takes the
vectors of pose j to pose j + 1 (u_{j+1} = dR^T u_j) is its transpose R_{j+1}^j; put in by mistake it
conjugates every quaternion.

Z-TIE's quaternions are scalar last (53); here they are scalar first.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from margcal.core import compiled, so3
from margcal.core.errors import InputError
from margcal.core.types import Array, Index, Turn


@dataclass(frozen=True)
class TurnBatch:
    """T turns padded to the longest: `y` (T, N, 3) raw unit, `dt` (T, N) s with 0 where padded."""

    y: Array
    dt: Array

    def __len__(self) -> int:
        return len(self.dt)

    def select(self, keep: ArrayLike) -> TurnBatch:
        """The turns that `keep` (index or boolean mask) names, in that order."""
        index = np.arange(len(self))[np.asarray(keep)]
        return TurnBatch(self.y[index], self.dt[index])


def pad(turns: Sequence[Turn] | TurnBatch) -> TurnBatch:
    """Turns of different lengths as one batch; a batch is handed back as it is.

    Raises
    ------
    InputError
        If there is no turn, or a reading or interval is not finite (names the turn).
    """
    if isinstance(turns, TurnBatch):
        return turns
    if not turns:
        raise InputError("no turn between two rests; record the node being turned from rest to rest")
    longest = max(len(turn.dt) for turn in turns)
    y, dt = np.zeros((len(turns), longest, 3)), np.zeros((len(turns), longest))
    for j, turn in enumerate(turns):
        n = len(turn.dt)
        y[j, :n], dt[j, :n] = turn.y, turn.dt
        # the padding repeats a real reading: it keeps the centring of the readings honest
        y[j, n:] = turn.y[-1] if n else 0.0
        if not (np.isfinite(turn.y).all() and np.isfinite(turn.dt).all()):
            raise InputError(
                f"turn {j} (rest {turn.before} to {turn.after}) has gyroscope readings that are not numbers; "
                "leave this turn out"
            )
    return TurnBatch(y, dt)


def along(turns: Sequence[Turn], t: ArrayLike, u: ArrayLike) -> Array:
    """Another sensor's vectors `u` (M, 3) at times `t` (M,), interpolated to the samples of the turns.

    Returns
    -------
    ndarray (T, N, 3), padded like `pad` does; the last vector of each turn is repeated.
    """
    t, u = np.asarray(t, dtype=np.float64), np.asarray(u, dtype=np.float64)
    out = np.zeros((len(turns), max(len(turn.dt) for turn in turns), 3))
    for j, turn in enumerate(turns):
        n = len(turn.t)
        for axis in range(3):
            out[j, :n, axis] = np.interp(turn.t, t, u[:, axis])
        out[j, n:] = out[j, n - 1] if n else 0.0
    return out


def rotation_vectors(y: ArrayLike, dt: ArrayLike, H: ArrayLike, B: ArrayLike) -> Array:
    """Rotation vector of every sample, ``H (y - B) dt``, (..., N, 3) rad; leading axes broadcast."""
    y, H = np.asarray(y, dtype=np.float64), np.asarray(H, dtype=np.float64)
    u = (y - np.asarray(B, dtype=np.float64)[..., None, :]) @ np.swapaxes(H, -1, -2)  #                    (52)
    return u * np.asarray(dt, dtype=np.float64)[..., None]


def integrate_quat(y: ArrayLike, dt: ArrayLike, H: ArrayLike, B: ArrayLike | None = None) -> Array:
    """Z-TIE's Int operator, (52)-(55): the quaternion of the turn, on the branch that the motion took.

    Parameters
    ----------
    y : array_like (..., N, 3), raw unit
    dt : array_like (..., N), s
    H : array_like (..., 3, 3), rad/s per raw unit
        Leading axes broadcast against those of `y`: for S hypotheses and T turns pass ``H[:, None]``.
    B : array_like (..., 3), raw unit, default 0

    Returns
    -------
    ndarray (..., 4), scalar first
        q_before_after. Its sign is that of the continuous path from the identity: a turn of more than half a
        revolution about a fixed axis has a negative scalar part.
    """
    B = np.zeros(3) if B is None else B
    found = _compiled_quat(y, dt, H, B)
    if found is not None:
        return found
    phi = rotation_vectors(y, dt, H, B)
    half = 0.5 * np.moveaxis(phi, -1, 0)
    angle = np.sqrt(half[0] ** 2 + half[1] ** 2 + half[2] ** 2)
    sinc = np.sinc(angle / np.pi)
    q = np.stack([np.cos(angle), *(sinc * half)])  #                                                       (53)
    while q.shape[-1] > 1:
        # not in the paper: neighbours are multiplied in pairs (the product is associative), log2 N steps
        even = q.shape[-1] // 2 * 2
        pairs = _multiply(q[..., 0:even:2], q[..., 1:even:2])  #                                           (54)
        q = np.concatenate([pairs, q[..., even:]], axis=-1)
    return np.moveaxis(q[..., 0], 0, -1)  #                                                                (55)


def _compiled_quat(y: ArrayLike, dt: ArrayLike, H: ArrayLike, B: ArrayLike) -> Array | None:
    """`integrate_quat` by the compiled kernel, or None without it (or without samples).

    The kernel takes turns and sensors (H, B) as two lists, and for each result one index into either, so that
    nothing is copied however the leading axes broadcast.
    """
    kernels = compiled.extension()
    y, dt = np.asarray(y, dtype=np.float64), np.asarray(dt, dtype=np.float64)
    if kernels is None or y.size == 0 or dt.size == 0:
        return None
    H, B = np.asarray(H, dtype=np.float64), np.asarray(B, dtype=np.float64)
    plan = _plan(y.shape, dt.shape, H.shape, B.shape)
    out = np.empty(plan.out)
    y, dt, H, B = (_flat(a, wide, flat) for a, (wide, flat) in zip((y, dt, H, B), plan.shapes))
    kernels.integrate(y, dt, H, B, plan.turn, plan.sensor, out.reshape(-1, 4))
    return out


Shape = tuple[int, ...]


class _Plan(NamedTuple):
    """How arrays of given shapes meet: shape of the result, of each array broadcast and then flat, and the indices."""

    out: Shape
    shapes: tuple[tuple[Shape, Shape], ...]
    turn: Index
    sensor: Index


@lru_cache(maxsize=16)  # the same shapes come in every iteration, and finding out costs more than a turn of 200 samples
def _plan(y: Shape, dt: Shape, H: Shape, B: Shape) -> _Plan:
    samples = max(y[-2], dt[-1])
    turns, sensors = np.broadcast_shapes(y[:-2], dt[:-1]), np.broadcast_shapes(H[:-2], B[:-1])
    lead = np.broadcast_shapes(turns, sensors)

    def shapes(own: Shape, *tail: int) -> tuple[Shape, Shape]:
        return (*own, *tail), (math.prod(own), *tail)

    wanted = shapes(turns, samples, 3), shapes(turns, samples), shapes(sensors, 3, 3), shapes(sensors, 3)
    return _Plan((*lead, 4), wanted, _index(turns, lead), _index(sensors, lead))


def _flat(a: Array, wide: Shape, flat: Shape) -> Array:
    """`a` broadcast to shape `wide`, then as `flat`, in contiguous memory."""
    if a.shape != wide:
        a = np.broadcast_to(a, wide)
    return np.ascontiguousarray(a).reshape(flat)


def _index(own: Shape, lead: Shape) -> Index:
    """For each element of shape `lead` the flat index of the element of shape `own` that broadcasts to it."""
    return np.broadcast_to(np.arange(math.prod(own)).reshape(own), lead).flatten()


def _multiply(a: Array, b: Array) -> Array:
    """Hamilton product of quaternions whose components come first, (4, ...): fast for large batches."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    out[0] = aw * bw - ax * bx - ay * by - az * bz
    out[1] = aw * bx + ax * bw + ay * bz - az * by
    out[2] = aw * by - ax * bz + ay * bw + az * bx
    out[3] = aw * bz + ax * by - ay * bx + az * bw
    return out


def integrate(y: ArrayLike, dt: ArrayLike, H: ArrayLike, B: ArrayLike | None = None) -> Array:
    """Rotation of a turn by integrating the gyroscope, Z-TIE (52)-(55), as a matrix.

    Parameters
    ----------
    y, dt, H, B
        See `integrate_quat`.

    Returns
    -------
    ndarray (..., 3, 3)
        dR = R_before_after: ``R_nh(after) = R_nh(before) @ dR`` and ``v_before = dR @ v_after``.
        It is Z-TIE's R_j^{j+1} (see the head of this module).
    """
    return so3.matrix_from_quat(integrate_quat(y, dt, H, B))


def attitudes(E: Array) -> Array:
    """Running products ``P_l = E_1 E_2 ... E_l`` of matrices (..., N, 3, 3) along axis -3.

    Notes
    -----
    In blocks of about sqrt(N): the products within all blocks at once, then those of the blocks, then both
    together; 2 sqrt(N) array operations instead of N.
    """
    lead, n = E.shape[:-3], E.shape[-3]
    size = max(1, int(np.ceil(np.sqrt(n))))
    blocks = -(-n // size)
    P = np.empty((*lead, blocks * size, 3, 3))
    P[..., :n, :, :] = E
    P[..., n:, :, :] = np.eye(3)
    # the place within the block comes first: every product then runs over contiguous memory
    last = len(lead) + 1
    P = np.ascontiguousarray(P.reshape(*lead, blocks, size, 3, 3).transpose(last, *range(last), -2, -1))
    for i in range(1, size):
        P[i] = P[i - 1] @ P[i]
    start = np.empty((*lead, blocks, 3, 3))
    start[..., 0, :, :] = np.eye(3)
    for b in range(1, blocks):
        start[..., b, :, :] = start[..., b - 1, :, :] @ P[-1, ..., b - 1, :, :]
    return (start @ P).transpose(*range(1, last + 1), 0, -2, -1).reshape(*lead, blocks * size, 3, 3)[..., :n, :, :]


@dataclass(frozen=True)
class Preintegrated:
    """The rotation of turns and what it does when H, B or the readings change a little.

    ``dR(H + dH, B + dB) ~ dR exp(J_H dH.ravel() + J_B dB)``; `C` is the covariance of that small rotation
    (rad^2, in the frame after the turn) for white noise of the readings.

    Attributes
    ----------
    dR : ndarray (..., 3, 3), R_before_after
    J_H : ndarray (..., 3, 9), H row by row
    J_B : ndarray (..., 3, 3)
    C : ndarray (..., 3, 3)
    """

    dR: Array
    J_H: Array
    J_B: Array
    C: Array


def preintegrate(
    y: ArrayLike, dt: ArrayLike, H: ArrayLike, B: ArrayLike | None = None, sd: ArrayLike | None = None
) -> Preintegrated:
    """`integrate` with its right Jacobians with respect to H and B, all turns at once.

    Parameters
    ----------
    y, dt, H, B
        See `integrate_quat`.
    sd : array_like (3,) or scalar, raw unit, default 0
        Standard deviation of one reading (white) by axis, for `Preintegrated.C`.

    Notes
    -----
    With P_l the running product and J_l the left Jacobian of sample l, a change d of its rotation vector
    turns dR into ``dR exp(dR^T P_{l-1} J_l d)``; d is ``dt (dH (y - B) - H dB)``. Summed over the samples.
    """
    y, dt = np.asarray(y, dtype=np.float64), np.asarray(dt, dtype=np.float64)
    H, B = np.asarray(H, dtype=np.float64), np.zeros(3) if B is None else np.asarray(B, dtype=np.float64)
    kernels = compiled.extension()
    if kernels is not None and y.ndim == 3 and dt.shape == y.shape[:2] and H.ndim == 2 and B.ndim == 1 and y.size:
        return _compiled_preintegrate(kernels.preintegrate, y, dt, H, B, sd)
    turns, samples = dt.shape[0] if dt.ndim else 1, dt.shape[-1]
    if y.ndim == 3 and H.ndim == 2 and turns > 1 and turns * samples > _CHUNK:
        return _in_chunks(y, dt, H, B, sd)
    z = y - B[..., None, :]
    E, J = _exp_and_jacobian((z @ np.swapaxes(H, -1, -2)) * dt[..., None])
    P = attitudes(E)
    J[..., 1:, :, :] = P[..., :-1, :, :] @ J[..., 1:, :, :]
    J *= dt[..., None, None]
    dR = P[..., -1, :, :]
    back = np.swapaxes(dR, -1, -2)
    lead = J.shape[:-3]
    A = np.swapaxes(J.reshape(*lead, samples, 9), -1, -2)
    J_H = back @ (A @ z).reshape(*lead, 3, 9)
    J_B = -back @ (A @ np.ones(samples)).reshape(*lead, 3, 3) @ H
    C = np.zeros((*lead, 3, 3))
    if sd is not None:
        noise = H * (np.asarray(sd, dtype=np.float64) * np.ones(3))
        gram = (A @ np.swapaxes(A, -1, -2)).reshape(*lead, 3, 3, 3, 3)
        C = back @ np.einsum("...iakb,...ab->...ik", gram, noise @ np.swapaxes(noise, -1, -2)) @ dR
    return Preintegrated(dR, J_H, J_B, C)


def _compiled_preintegrate(
    kernel: Callable[..., None], y: Array, dt: Array, H: Array, B: Array, sd: ArrayLike | None
) -> Preintegrated:
    """`preintegrate` of turns (T, N, 3) by the compiled kernel."""
    noise = H * ((0.0 if sd is None else np.asarray(sd, dtype=np.float64)) * np.ones(3))
    dR, J_H, J_B, C = (np.empty((len(y), 3, n)) for n in (3, 9, 3, 3))
    y, dt, H, B = (np.ascontiguousarray(a) for a in (y, dt, H, B))
    kernel(y, dt, H, B, noise @ noise.T, dR, J_H, J_B, C)
    return Preintegrated(dR, J_H, J_B, C)


_CHUNK = 4096
"""Samples worked on at once: their matrices stay in the cache."""


def _in_chunks(y: Array, dt: Array, H: Array, B: Array, sd: ArrayLike | None) -> Preintegrated:
    """`preintegrate` a few turns at a time, without the padding that they do not need."""
    lengths = dt.shape[1] - np.argmax(dt[:, ::-1] > 0, axis=1)
    order = np.argsort(lengths)
    parts, start = [], 0
    while start < len(order):
        stop = start + 1
        while stop < len(order) and (stop + 1 - start) * lengths[order[stop]] <= _CHUNK:
            stop += 1
        index, n = order[start:stop], lengths[order[stop - 1]]
        parts.append(preintegrate(y[index, :n], dt[index, :n], H, B, sd))
        start = stop
    back = np.argsort(order)
    dR, J_H, J_B, C = (np.concatenate([getattr(p, k) for p in parts])[back] for k in ("dR", "J_H", "J_B", "C"))
    return Preintegrated(dR, J_H, J_B, C)


_SERIES = np.array(
    [[(-1) ** k / math.factorial(2 * k + first) for k in range(6)] for first in (1, 2, 3)], dtype=np.float64
)
"""Coefficients in the squared angle of sin(a)/a, (1 - cos a)/a^2, (a - sin a)/a^3."""


def _sinc_terms(square: Array) -> Array:
    """The three functions of `so3.sinc_terms`, stacked, from the squared angle; by series where that is exact."""
    if square.size and square.max() > 0.1:
        return np.stack(so3.sinc_terms(np.sqrt(square)))
    # what is left out is below angle^12 / 13! < 2e-16
    coefficients = _SERIES.reshape(3, 6, *[1] * square.ndim)
    total = coefficients[:, 5] * square
    for k in (4, 3, 2, 1):
        total += coefficients[:, k]
        total *= square
    total += coefficients[:, 0]
    return total


def _exp_and_jacobian(phi: Array) -> tuple[Array, Array]:
    """exp and left Jacobian of rotation vectors (..., 3), both at once by components, for speed (see `so3`)."""
    x, y, z = phi[..., 0].copy(), phi[..., 1].copy(), phi[..., 2].copy()
    xx, yy, zz = x * x, y * y, z * z
    terms = _sinc_terms(xx + yy + zz)
    # I + s [v]x + c [v]x^2 and I + c [v]x + d [v]x^2
    first, second = terms[:2], terms[1:]
    out = np.empty((2, *x.shape, 3, 3))
    fx, fy, fz, sx = first * x, first * y, first * z, second * x
    mixed = sx * y
    out[..., 0, 1], out[..., 1, 0] = mixed - fz, mixed + fz
    mixed = sx * z
    out[..., 0, 2], out[..., 2, 0] = mixed + fy, mixed - fy
    mixed = second * (y * z)
    out[..., 1, 2], out[..., 2, 1] = mixed - fx, mixed + fx
    out[..., 0, 0], out[..., 1, 1] = 1 - second * (yy + zz), 1 - second * (xx + zz)
    out[..., 2, 2] = 1 - second * (xx + yy)
    return out[0], out[1]
