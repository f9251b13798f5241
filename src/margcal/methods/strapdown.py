"""The gyroscope alone, integrated: the attitude without any correction.

Not from a paper; the baseline that shows what correction is worth, and good for seconds. Over each step the rate is
taken as constant and the quaternion is turned by it exactly: q <- q exp(w dt). The variance grows as the gyroscope's
noise and what it does not see make it: dt times `rate_noise` squared, and faster where the rate was not measured.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from margcal.core.types import Array
from margcal.methods import compiled_track
from margcal.methods.tracking import (
    GAP,
    LONGEST_STEP,
    NO_GYR,
    Flags,
    Track,
    as_quaternion,
    as_samples,
    measured_rate,
    product,
    rotation_step,
)


class Params(NamedTuple):
    """`rate_noise` rad/s/sqrt(Hz), `unknown_rate` rad/s while nothing measures it, `gap` s beyond which a step is
    time that is missing."""

    rate_noise: float = 0.003
    unknown_rate: float = 1.0
    gap: float = 0.25


class State(NamedTuple):
    """Attitude `q` (..., 4), variance about east, north, up (..., 3) rad^2, `flags` (...) of the last sample."""

    q: Array
    variance: Array
    flags: Flags


def start(q: ArrayLike, sd: ArrayLike = (0.05, 0.05, 0.1)) -> State:
    """State at attitude `q` (..., 4) with standard deviations `sd` (3,) rad about east, north, up."""
    q = as_quaternion(q)
    variance = np.broadcast_to(np.asarray(sd, dtype=np.float64) ** 2, (*q.shape[:-1], 3)).copy()
    return State(q, variance, np.zeros(q.shape[:-1], dtype=np.uint8))


def step(params: Params, state: State, dt: ArrayLike, gyr: ArrayLike, acc: ArrayLike, mag: ArrayLike) -> State:
    """The state after one more sample; `acc` and `mag` are not looked at."""
    (gyr,) = as_samples(gyr)
    dt = np.minimum(np.maximum(np.nan_to_num(np.asarray(dt, dtype=np.float64)), 0.0), LONGEST_STEP)
    measured = measured_rate(gyr)
    gap = dt > params.gap
    known = measured & ~gap
    q = product(state.q, rotation_step(np.where(known[..., None], gyr, 0.0) * dt[..., None]))
    q = q / np.sqrt(np.sum(q * q, axis=-1, keepdims=True))
    grown = np.where(known, params.rate_noise**2 * dt, (params.unknown_rate * dt) ** 2)
    flags = NO_GYR * ~measured + GAP * gap
    return State(q, state.variance + grown[..., None], np.asarray(flags, dtype=np.uint8))


def batch(params: Params, state: State, dt: ArrayLike, gyr: ArrayLike, acc: ArrayLike, mag: ArrayLike) -> Track:
    """All samples of a recording, or of many nodes side by side; arguments as in `tracking`."""
    (gyr,) = as_samples(gyr)
    dt = np.broadcast_to(np.asarray(dt, dtype=np.float64), gyr.shape[:-1])
    # src/ext/strapdown.h is the same filter, line by line: change both
    found = compiled_track.run("strapdown", params, ((state.q, 1), (state.variance, 1)), dt, gyr, acc, mag)
    if found is not None:
        return Track(*found[:3], State(*found.memory, found.flags[..., -1]))
    q, variance = np.empty((*dt.shape, 4)), np.empty((*dt.shape, 3))
    flags = np.empty(dt.shape, dtype=np.uint8)
    for k in range(dt.shape[-1]):
        state = step(params, state, dt[..., k], gyr[..., k, :], acc, mag)
        q[..., k, :], variance[..., k, :], flags[..., k] = state
    return Track(q, variance, flags, state)
