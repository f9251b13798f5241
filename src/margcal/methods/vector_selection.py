"""The filter that Z-TIE and ZY-TBME are judged with: a quaternion Kalman filter that selects its vectors.

A RECONSTRUCTION. Z.-Q. Zhang, X.-L. Meng, J.-K. Wu, "Quaternion-based Kalman filter with vector selection for accurate
orientation tracking", IEEE Trans. Instrumentation and Measurement 61 (2012) 2817-2824, is not public; what follows is
built from its abstract and from what the two papers say of it: the quaternion is the state, the gyroscope drives it in
closed form, each vector gives a linear pseudo-measurement, and an accelerometer or magnetometer reading that cannot be
gravity or the undisturbed field is not taken. Its own numbers may differ.

    q <- q exp(w dt)                                                    the transition, closed form          (i)
    0 = q b - r q + noise = (R(b) - L(r)) q + noise                     b measured, r in the earth frame    (ii)
    cov(noise) = s^2 (1 - q q^T)                                                                           (iii)

L and R are the matrices of multiplication from the left and from the right. q^T (R(b) - L(r)) q = 0 always (both
matrices are skew) and (iii) has no noise along q: the measurement says nothing there. So the whole filter lives in the
three directions t_i = (0, e_i) q in which q can turn about east, north and up, and the covariance of q is

    cov(q) = 1/4 T P T^T,   T = [t_1 t_2 t_3],   P (3, 3) in rad^2, of the rotation about east, north, up           (iv)

which (i) does not change (turning the node does not turn an error about the earth's axes) and normalising q keeps. In
these directions (ii) reads, with f = R(q) b and a rotation theta about the earth's axes,

    accelerometer, r = up      t_1: f_x + ((1 + f_z) theta_y - f_y theta_z) / 2 = 0
                               t_2: f_y - ((1 + f_z) theta_x - f_x theta_z) / 2 = 0

Measured f in the matrix is not taken as printed: products of two readings do not average out when the node is
accelerated to and fro, and would tell a heading from it. With what f is expected to be, up,

    accelerometer              t_1: f_x + theta_y = 0                                                        (v)
                               t_2: f_y - theta_x = 0                                                       (vi)
    magnetometer, r = north    t_1: h_x - (1 + h_y) theta_z / 2 = 0    h: level part of the field, unit     (vii)

The third row of the accelerometer is of second order. The magnetometer is used for the heading only: its level part is
taken with the estimated vertical, and of (ii) the one row that turns about it.

===========  =====================================================================================  ===========
name here    meaning                                                                                shape, unit
===========  =====================================================================================  ===========
q            node to earth (ENU), scalar first                                                      (..., 4)
P            covariance (iv)                                                                        (..., 3, 3)
rate_noise   noise of the gyroscope and of what it does not see, density                            rad/s/sqrt(Hz)
acc_noise    direction error of a selected accelerometer reading, density                           rad sqrt(s)
mag_noise    heading error of a selected magnetometer reading, density                              rad sqrt(s)
===========  =====================================================================================  ===========

Densities, not errors of a sample: linear acceleration and field errors last for many samples, and a filter whose gain
grew with the sampling rate would be another filter on every sensor.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from margcal.core.types import Array
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
    measured_rate,
    product,
    rotation_step,
    to_earth,
    unit_sample,
)

LEAST_LEVEL = 1e-3
"""Level part of the field, relative to it, below which it points nowhere (at the magnetic poles)."""


class Params(NamedTuple):
    """Numbers of the filter; all are plain floats, in this order in the flat form.

    Attributes
    ----------
    gravity : float, m/s^2
        Length of the specific force at rest.
    field : float, unit of `mag`
        Length of the undisturbed field.
    dip : float, rad
        Its angle below the horizon.
    acc_gate, mag_gate : float
        A reading is selected while its length is within this of `gravity` or `field`, relative.
    dip_gate : float, rad
        And, for the magnetometer, its dip against the estimated vertical within this of `dip`.
    rate_noise, acc_noise, mag_noise : float
        Densities; see the table above.
    unknown_rate : float, rad/s
        How fast the node may turn while nothing measures it.
    gap : float, s
        A longer step is a gap: the reading after it says nothing of the time before.

    Notes
    -----
    `rate_noise` is reckoned: a gyroscope that is off by 0.2 deg/s, or by 0.5 % of a quick turn, for a second. Its ratio
    to the other two, which is all that matters between disturbances, makes the tilt forget within 5 s and the heading
    within 20 s. The tilt's and the gates were chosen on the four motions of tyrex (phones, Qualisys 60 Hz); there the
    heading would like to forget more slowly, but there the gyroscope's bias was known from the optics, and 20 s is what
    0.05 deg/s of it allow. Mean error on tyrex by `acc_gate`: 0.05 4.1, 0.1 4.2, 0.2 4.0, 0.5 3.5, 3 and more 3.5
    degrees (benchmarks/studies/filter_settings.py). A gate on the length keeps the readings that happen to have the
    right length, and their mean is no vertical; all of them together average to one. So the accelerometer's gate only
    keeps out impacts, and what is selected is, in the main, the magnetometer.
    """

    gravity: float = STANDARD_GRAVITY
    field: float = 49.0
    dip: float = 1.15
    acc_gate: float = 3.0
    mag_gate: float = 0.1
    dip_gate: float = 0.1
    rate_noise: float = 0.003
    acc_noise: float = 0.015
    mag_noise: float = 0.06
    unknown_rate: float = 1.0
    gap: float = 0.25


class State(NamedTuple):
    """All that the filter remembers: `q` (..., 4), `P` (..., 3, 3) rad^2, `flags` (...) of the last sample."""

    q: Array
    P: Array
    flags: Flags


def start(q: ArrayLike, sd: ArrayLike = (0.05, 0.05, 0.1)) -> State:
    """State at attitude `q` (..., 4) with standard deviations `sd` (3,) rad about east, north, up."""
    q = as_quaternion(q)
    P = np.broadcast_to(np.diag(np.asarray(sd, dtype=np.float64) ** 2), (*q.shape[:-1], 3, 3)).copy()
    return State(q, P, np.zeros(q.shape[:-1], dtype=np.uint8))


def step(params: Params, state: State, dt: ArrayLike, gyr: ArrayLike, acc: ArrayLike, mag: ArrayLike) -> State:
    """The state after one more sample; see `tracking` for the arguments."""
    gyr, acc, mag = as_samples(gyr, acc, mag)
    dt = np.minimum(np.maximum(np.nan_to_num(np.asarray(dt, dtype=np.float64)), 0.0), LONGEST_STEP)
    q, P, flags = _predict(params, state, dt, gyr)
    density = 1 / np.maximum(np.minimum(dt, params.gap), SHORTEST_STEP)
    q, P, used = _correct_tilt(params, q, P, acc, density)
    flags |= used
    q, P, used = _correct_heading(params, q, P, mag, density)
    flags |= used
    return State(q, P, flags)


def batch(params: Params, state: State, dt: ArrayLike, gyr: ArrayLike, acc: ArrayLike, mag: ArrayLike) -> Track:
    """All samples of a recording, or of many nodes side by side.

    Parameters
    ----------
    dt : array_like (N,) or (..., N), s
    gyr, acc, mag : array_like (..., N, 3)
    """
    gyr, acc, mag = as_samples(gyr, acc, mag)
    dt = np.broadcast_to(np.asarray(dt, dtype=np.float64), gyr.shape[:-1])
    # src/ext/selection.h is the same filter, line by line: change both
    found = compiled_track.run("vector_selection", params, ((state.q, 1), (state.P, 2)), dt, gyr, acc, mag)
    if found is not None:
        return Track(*found[:3], State(*found.memory, found.flags[..., -1]))
    q, variance = np.empty((*dt.shape, 4)), np.empty((*dt.shape, 3))
    flags = np.empty(dt.shape, dtype=np.uint8)
    for k in range(dt.shape[-1]):
        state = step(params, state, dt[..., k], gyr[..., k, :], acc[..., k, :], mag[..., k, :])
        q[..., k, :], flags[..., k] = state.q, state.flags
        variance[..., k, :] = np.diagonal(state.P, axis1=-2, axis2=-1)
    return Track(q, variance, flags, state)


# --- the working --------------------------------------------------------------------------------------


def _predict(params: Params, state: State, dt: Array, gyr: Array) -> tuple[Array, Array, Flags]:
    measured = measured_rate(gyr)
    gap = dt > params.gap
    known = measured & ~gap
    turn = np.where(known[..., None], gyr, 0.0) * dt[..., None]
    q = product(state.q, rotation_step(turn))  # (i)
    variance = np.where(known, params.rate_noise**2 * dt, (params.unknown_rate * dt) ** 2)
    P = state.P + variance[..., None, None] * np.eye(3)  # (iv)
    flags = NO_GYR * (~measured).astype(np.uint8) + GAP * gap.astype(np.uint8)
    return q, P, flags.astype(np.uint8)


def _correct_tilt(params: Params, q: Array, P: Array, acc: Array, density: Array) -> tuple[Array, Array, Flags]:
    b, length, good = unit_sample(acc)
    use = good & (np.abs(length / params.gravity - 1) < params.acc_gate)
    R = np.where(use, params.acc_noise**2 * density, np.inf)
    # not a unit vector: f_x and f_y are linear in the acceleration of the node, which averages to zero
    f = to_earth(q, b * np.where(use, length / params.gravity, 1.0)[..., None])
    theta = np.zeros(f.shape)
    theta, P = _correct(theta, P, f[..., 0], np.array([0.0, 1.0, 0.0]), R)  # (v)
    theta, P = _correct(theta, P, f[..., 1], np.array([-1.0, 0.0, 0.0]), R)  # (vi)
    return _turned(q, theta), P, ACC * use.astype(np.uint8)


def _correct_heading(params: Params, q: Array, P: Array, mag: Array, density: Array) -> tuple[Array, Array, Flags]:
    b, length, good = unit_sample(mag)
    h = to_earth(q, b)
    level = np.sqrt(h[..., 0] * h[..., 0] + h[..., 1] * h[..., 1])
    dip = np.arctan2(-h[..., 2], level)
    use = good & (level > LEAST_LEVEL)
    use &= (np.abs(length / params.field - 1) < params.mag_gate) & (np.abs(dip - params.dip) < params.dip_gate)
    R = np.where(use, params.mag_noise**2 * density, np.inf)
    safe = np.where(level > LEAST_LEVEL, level, 1.0)
    x, y = h[..., 0] / safe, h[..., 1] / safe
    theta, zero = np.zeros(h.shape), np.zeros(x.shape)
    theta, P = _correct(theta, P, x, np.stack([zero, zero, -0.5 * (1 + y)], axis=-1), R)  # (vii)
    return _turned(q, theta), P, MAG * use.astype(np.uint8)


def _correct(theta: Array, P: Array, miss: Array, row: Array, R: Array) -> tuple[Array, Array]:
    """Kalman correction by the scalar ``0 = miss + row . theta + noise``, noise of variance `R` (inf: not taken)."""
    p = np.sum(P * row[..., None, :], axis=-1)  # P row
    S = (np.sum(row * p, axis=-1) + R)[..., None]
    innovation = -(miss + np.sum(row * theta, axis=-1))
    return theta + p * (innovation[..., None] / S), P - p[..., :, None] * p[..., None, :] / S[..., None]


def _turned(q: Array, theta: Array) -> Array:
    """q turned by the small rotation theta about the earth's axes: q + sum of theta_i t_i / 2, unit length."""
    half = np.concatenate([np.ones((*theta.shape[:-1], 1)), 0.5 * theta], axis=-1)
    q = product(half, q)
    return q / np.sqrt(np.sum(q * q, axis=-1, keepdims=True))
