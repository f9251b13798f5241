"""Extended Kalman filter on rates and quaternion, fed with QUEST: the filter of R-BSN.

Papers: "R-BSN" section 3, equations (1)-(10), after X. Yun, E. R. Bachmann, "Design, implementation, and experimental
results of a quaternion-based Kalman filter for human body motion tracking", IEEE Trans. Robotics 22 (2006) 1216-1227.

The gyroscope and the quaternion that QUEST makes of accelerometer and magnetometer are the measurement, all seven
states are measured directly, and the dynamics is a rate that forgets what it was within `tau`, driven by white noise.

Corrected, as printed it does not work:

- (5) is the earth-to-body matrix of the quaternion that (6) needs; here R(q) v = q v q+, body to earth.
- (7) has signs [-x1, x2, x3] (two of three rates grow without bound) and unscaled noise; here
  ``w' = (noise - w) / tau``, noise of spectral density D, integrated exactly:
  ``exp(-dt / tau)`` and ``Q = D / (2 tau) (1 - exp(-2 dt / tau))``.
- (9) gravity: an accelerometer at rest shows +g upwards (specific force), north is y and up is z (ENU).

=============  ====================================================  ===========
name here      meaning                                               paper
=============  ====================================================  ===========
x[..., 0:3]    angular rate, body axes, rad/s                        x1..x3
x[..., 3:7]    quaternion, body to earth, scalar first               x4..x7
P              covariance of x (..., 7, 7)
z              gyroscope's reading, then QUEST's quaternion          z (8)
tau, D         time constant of the rate, spectral density           tau, w of (7)
=============  ====================================================  ===========

Not in the paper, and marked in the code:

- noises are densities: a filter whose gain grows with the sampling rate is another filter on every sensor;
- Q has the quaternion's share and its correlation with the rate: the gyroscope's reading is the mean rate over the
  interval that it was measured in, and turns the quaternion over that interval and not over the next;
- QUEST's quaternion is taken with the sign of the prediction, and its variance is divided by the length of the
  specific force: its tilt times that length is linear in the acceleration, and a hand's acceleration averages to zero;
- where the field is not as long as it should be, or is not measured, the tilt alone is taken;
- after a gap the gyroscope is not taken once: (7) forgets the rate over a long step, and the covariance grows by
  itself.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from margcal.core.types import Array, Mask
from margcal.core.units import STANDARD_GRAVITY
from margcal.methods import compiled_track
from margcal.methods.tracking import (
    ACC,
    GAP,
    LONGEST_STEP,
    MAG,
    NO_GYR,
    SHORTEST_STEP,
    Flags,
    Track,
    as_quaternion,
    as_samples,
    earth_tangents,
    measured_rate,
    product,
    rotation_step,
    to_earth,
    unit_sample,
)
from margcal.methods.wahba import quest


class Params(NamedTuple):
    """Numbers of the filter; all are plain floats, in this order in the flat form.

    Attributes
    ----------
    gravity : float, m/s^2
        Length of the specific force at rest.
    field, dip : float, unit of `mag`, rad
        Length of the undisturbed field, and its angle below the horizon.
    mag_gate : float
        A magnetometer reading is used while its length is within this of `field`, relative.
    tau : float, s
        Time constant of (7).
    D : float, rad^2/s
        Spectral density of the noise of (7): the rate's variance is D / (2 tau).
    rate_noise : float, rad/s/sqrt(Hz)
        Noise of the gyroscope and of what it does not see, density.
    quest_noise : float, rad sqrt(s)
        Error of QUEST's rotation, density; a component of the quaternion has half of it.
    mag_weight : float
        Weight of the magnetometer in QUEST; the accelerometer has 1.
    gap : float, s
        A longer step is flagged, and counts no more than this for the weight of what was measured after it.

    Notes
    -----
    `tau` and `D` are a hand's and hardly matter beside a gyroscope. `rate_noise` is reckoned: a gyroscope that is off
    by 0.2 deg/s, or by 0.5 % of a quick turn, for a second. Its ratio to `quest_noise` is the time in which QUEST is
    believed, 33 s: it and the two settings of the magnetometer were chosen on the four motions of tyrex (phones,
    Qualisys). There 0.06 and 0.1 are alike (2.4 degrees) where no magnet is near and 0.1 is better where one is;
    weights of 1, 3 and 10 differ by 3 %; without the gate the error near magnets is more than double
    (benchmarks/studies/filter_settings.py).
    """

    gravity: float = STANDARD_GRAVITY
    field: float = 49.0
    dip: float = 1.15
    mag_gate: float = 0.1
    tau: float = 0.5
    D: float = 50.0
    rate_noise: float = 0.003
    quest_noise: float = 0.1
    mag_weight: float = 3.0
    gap: float = 0.25


class State(NamedTuple):
    """All that the filter remembers: `x` (..., 7), `P` (..., 7, 7), `flags` (...) of the last sample."""

    x: Array
    P: Array
    flags: Flags


def start(q: ArrayLike, sd: ArrayLike = (0.05, 0.05, 0.1), rate_sd: float = 1.0) -> State:
    """State at rest at attitude `q` (..., 4), standard deviations `sd` (3,) rad about east, north, up."""
    q = as_quaternion(q)
    x, P = np.zeros((*q.shape[:-1], 7)), np.zeros((*q.shape[:-1], 7, 7))
    x[..., 3:] = q
    T = 0.5 * earth_tangents(q) * np.asarray(sd, dtype=np.float64)[:, None]
    P[..., :3, :3] = rate_sd**2 * np.eye(3)
    P[..., 3:, 3:] = np.swapaxes(T, -1, -2) @ T + 1e-6 * q[..., :, None] * q[..., None, :]
    return State(x, P, np.zeros(q.shape[:-1], dtype=np.uint8))


def step(params: Params, state: State, dt: ArrayLike, gyr: ArrayLike, acc: ArrayLike, mag: ArrayLike) -> State:
    """The state after one more sample; see `tracking` for the arguments."""
    gyr, acc, mag = as_samples(gyr, acc, mag)
    q, both = quest_measurement(params, acc, mag)
    return _advance(params, state, np.asarray(dt, dtype=np.float64), gyr, acc, q, both)


def batch(params: Params, state: State, dt: ArrayLike, gyr: ArrayLike, acc: ArrayLike, mag: ArrayLike) -> Track:
    """All samples of a recording, or of many nodes side by side.

    Parameters
    ----------
    dt : array_like (N,) or (..., N), s
    gyr, acc, mag : array_like (..., N, 3)
    """
    gyr, acc, mag = as_samples(gyr, acc, mag)
    dt = np.broadcast_to(np.asarray(dt, dtype=np.float64), gyr.shape[:-1])
    # src/ext/ekf_quest.h is the same filter, line by line: change both
    found = compiled_track.run("ekf_quest", params, ((state.x, 1), (state.P, 2)), dt, gyr, acc, mag)
    if found is not None:
        return Track(*found[:3], State(*found.memory, found.flags[..., -1]))
    q, variance = np.empty((*dt.shape, 4)), np.empty((*dt.shape, 3))
    flags = np.empty(dt.shape, dtype=np.uint8)
    measured, both = quest_measurement(params, acc, mag)  # all samples at once: it knows nothing of the state
    for k in range(dt.shape[-1]):
        state = _advance(params, state, dt[..., k], gyr[..., k, :], acc[..., k, :], measured[..., k, :], both[..., k])
        q[..., k, :], flags[..., k] = state.x[..., 3:], state.flags
        variance[..., k, :] = attitude_variance(state)
    return Track(q, variance, flags, state)


def attitude_variance(state: State) -> Array:
    """Variance (..., 3) rad^2 of the rotation about east, north, up that the quaternion is off by."""
    T = earth_tangents(state.x[..., 3:])
    return 4 * np.sum(T * (T @ state.P[..., 3:, 3:]), axis=-1)


def quest_measurement(params: Params, acc: Array, mag: Array) -> tuple[Array, Mask]:
    """QUEST's quaternions (..., 4), and where both directions were fit to make one of; (10)."""
    r = np.array([[0.0, 0.0, 1.0], [0.0, np.cos(params.dip), -np.sin(params.dip)]])
    found = quest(np.stack([acc, mag], axis=-2), r, [1.0, params.mag_weight])
    _, length, _ = unit_sample(mag)
    both = found.determined & (np.abs(length / params.field - 1) < params.mag_gate)
    return np.where(both[..., None], found.q, 0.0), both


# --- the working --------------------------------------------------------------------------------------


def _advance(params: Params, state: State, dt: Array, gyr: Array, acc: Array, measured: Array, both: Mask) -> State:
    dt = np.minimum(np.maximum(np.nan_to_num(dt), 0.0), LONGEST_STEP)
    x, P = _predict(params, state, dt)
    seen = measured_rate(gyr)
    b, length, has_acc = unit_sample(acc)
    density = 1 / np.maximum(np.minimum(dt, params.gap), SHORTEST_STEP)  # not in the paper: densities
    gap = dt > params.gap  # a reading after a gap is no mean rate over it
    R_w = np.where(seen & ~gap, params.rate_noise**2 * density, np.inf)
    # not in the paper: the longer the specific force, the more its direction counts
    R_q = 0.25 * params.quest_noise**2 * density * params.gravity / np.where(has_acc, length, 1.0)
    z_w = np.where(seen[..., None], gyr, 0.0)
    for i in range(3):
        x, P = _correct_state(x, P, i, z_w[..., i], R_w)  # (8)
    q = x[..., 3:]
    flip = np.where(np.sum(q * measured, axis=-1) < 0, -1.0, 1.0)  # q and -q are one attitude
    z_q = flip[..., None] * measured
    for i in range(4):
        x, P = _correct_state(x, P, 3 + i, z_q[..., i], np.where(both, R_q, np.inf))  # (8)
    tilt_only = has_acc & ~both
    if np.any(tilt_only):
        x, P = _correct_tilt(x, P, b, np.where(tilt_only, R_q, np.inf))
    x = x.copy()
    x[..., 3:] /= np.sqrt(np.sum(x[..., 3:] * x[..., 3:], axis=-1, keepdims=True))
    flags = ACC * has_acc + MAG * both + NO_GYR * ~seen + GAP * gap
    return State(x, P, flags.astype(np.uint8))


def _predict(params: Params, state: State, dt: Array) -> tuple[Array, Array]:
    """The solution of (7) over dt. F and Q by blocks: rate w, quaternion q."""
    keep, reach, Q_ww, Q_wt, Q_tt = rate_model(params.tau, params.D, dt)
    w, P = state.x[..., :3], state.P
    x = np.empty(state.x.shape)
    x[..., :3] = keep[..., None] * w
    turn = rotation_step(reach[..., None] * w)
    x[..., 3:] = q = product(state.x[..., 3:], turn)  # (6)
    F = np.zeros(P.shape)
    F[..., :3, :3] = keep[..., None, None] * np.eye(3)
    half = 0.5 * body_tangents(q)  # d q = half @ (small rotation about the body's axes)
    F[..., 3:, :3] = reach[..., None, None] * half
    F[..., 3:, 3:] = _right(turn)
    P = F @ P @ np.swapaxes(F, -1, -2)
    P = 0.5 * (P + np.swapaxes(P, -1, -2))
    P[..., :3, :3] += Q_ww[..., None, None] * np.eye(3)
    cross = Q_wt[..., None, None] * half  # not in the paper: the angle is dt times the new rate
    P[..., 3:, :3] += cross
    P[..., :3, 3:] += np.swapaxes(cross, -1, -2)
    P[..., 3:, 3:] += 0.25 * Q_tt[..., None, None] * np.eye(4)
    return x, P


def rate_model(tau: float, D: float, dt: Array) -> tuple[Array, Array, Array, Array, Array]:
    """(7) over dt, for one axis: factor of the rate, seconds that the old rate turns on for, and the covariance of rate
    and angle (rate-rate, rate-angle, angle-angle).

    The gyroscope's reading is the mean rate since the last one, so the angle is dt times the new rate.
    """
    u = -np.expm1(-dt / tau)
    keep, variance = 1 - u, 0.5 * D / tau * u * (2 - u)
    return keep, dt * keep, variance, dt * variance, dt * dt * variance


def body_tangents(q: Array) -> Array:
    """Columns (..., 4, 3) along which q moves when turned about the body's axes: q (0, e_i)."""
    w, x, y, z = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    out = np.empty((*q.shape[:-1], 4, 3))
    out[..., 0, 0], out[..., 1, 0], out[..., 2, 0], out[..., 3, 0] = -x, w, z, -y
    out[..., 0, 1], out[..., 1, 1], out[..., 2, 1], out[..., 3, 1] = -y, -z, w, x
    out[..., 0, 2], out[..., 1, 2], out[..., 2, 2], out[..., 3, 2] = -z, y, -x, w
    return out


def _right(q: Array) -> Array:
    """Matrix (..., 4, 4) of multiplication by q from the right."""
    return np.concatenate([q[..., :, None], body_columns(q)], axis=-1)


def body_columns(q: Array) -> Array:
    """The last three columns of `_right`: (0, e_i) q for the unit vectors e_i."""
    return np.swapaxes(earth_tangents(q), -1, -2)


def _correct_state(x: Array, P: Array, i: int, z: Array, R: Array) -> tuple[Array, Array]:
    """Kalman correction by z = x[i] + noise of variance R (inf: not taken).

    H = 1 and R is diagonal, so seven scalar corrections are the matrix one, without an inverse.
    """
    p = P[..., :, i]
    S = (p[..., i] + R)[..., None]
    return x + p * ((z - x[..., i])[..., None] / S), P - p[..., :, None] * p[..., None, :] / S[..., None]


def _correct_tilt(x: Array, P: Array, b: Array, R: Array) -> tuple[Array, Array]:
    """Not in the paper: one direction, the vertical. q is corrected along the two 4-vectors that turn it about
    east and north, towards the attitude that is reached by the shortest turn."""
    q = x[..., 3:]
    f = to_earth(q, b)
    T = earth_tangents(q)
    # half of the rotation vector of the shortest turn from f to up: f x up, scaled from sine to half angle
    scale = 0.5 * np.arctan2(np.hypot(f[..., 0], f[..., 1]), f[..., 2])
    sine = np.hypot(f[..., 0], f[..., 1])
    scale = np.where(sine > 1e-9, scale / np.where(sine > 1e-9, sine, 1.0), 0.5)
    for i, miss in ((0, scale * f[..., 1]), (1, -scale * f[..., 0])):
        h = T[..., i, :]
        p = np.sum(P[..., :, 3:] * h[..., None, :], axis=-1)
        S = (np.sum(p[..., 3:] * h, axis=-1) + R)[..., None]
        done = np.sum((x[..., 3:] - q) * h, axis=-1)
        x = x + p * ((miss - done)[..., None] / S)
        P = P - p[..., :, None] * p[..., None, :] / S[..., None]
    return x, P
