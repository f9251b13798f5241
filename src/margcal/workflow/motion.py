"""Motions of a simulated node whose attitude, angular rate and acceleration are closed forms of time.

A node lies still, is picked up, turned and put down (`RestsAndTurns`), or is waved about (`Swing`).
Everything is evaluated at any array of times, so sensors may have clocks of their own and nothing is
integrated: rate and attitude agree exactly at every sample.

``R_nh`` takes node components to the earth frame n (ENU); rates are in the node's axes, accelerations in n.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from margcal.core import so3
from margcal.core.types import Array

PoseSet = Literal["cube", "free", "faces"]


@dataclass(frozen=True)
class State:
    """Attitude R_nh (N, 3, 3), angular rate (N, 3) rad/s in h, acceleration (N, 3) m/s^2 in n."""

    R: Array
    rate: Array
    acceleration: Array


class Motion(Protocol):
    """Anything that knows the node's state at times (N,) s."""

    def at(self, t: Array) -> State: ...


def minimum_jerk(x: Array) -> tuple[Array, Array, Array]:
    """The minimum-jerk step from 0 to 1 over x in [0, 1] and its two derivatives; all constant outside."""
    x = np.clip(x, 0.0, 1.0)
    y = x**3 * (10 - 15 * x + 6 * x * x)
    return y, 30 * x**2 * (1 - x) ** 2, 60 * x * (1 - x) * (1 - 2 * x)


def bump(x: Array) -> tuple[Array, Array, Array]:
    """A smooth excursion 0 -> 1 -> 0 over x in [0, 1], height one, and its two derivatives."""
    x = np.clip(x, 0.0, 1.0)
    u, du = x * (1 - x), 1 - 2 * x
    return 64 * u**3, 192 * u**2 * du, 384 * u * (du * du - u)


def random_directions(rng: np.random.Generator, n: int) -> Array:
    """Unit vectors (n, 3), uniform on the sphere."""
    v = rng.normal(size=(n, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


@dataclass(frozen=True)
class Shakes:
    """Bursts of vibration: each under a `bump` of its own from `start` for `duration`, about one axis.

    `angle` (K, 3) rad is the axis times the amplitude of the wobble, `push` (K, 3) m/s^2 the amplitude of the
    linear acceleration, `frequency` (K,) Hz, `phase` (K,) rad.
    """

    start: Array
    duration: Array
    frequency: Array
    phase: Array
    angle: Array
    push: Array

    def merged(self, other: Shakes) -> Shakes:
        """Both, in the order of time."""
        names = ("start", "duration", "frequency", "phase", "angle", "push")
        joined = {name: np.concatenate([getattr(self, name), getattr(other, name)]) for name in names}
        order = np.argsort(joined["start"])
        return Shakes(**{name: value[order] for name, value in joined.items()})

    def at(self, t: Array) -> tuple[Array, Array, Array]:
        """Wobble (N, 3) rad, its derivative and the linear acceleration; the axis is fixed within a burst."""
        if len(self.start) == 0:
            zero = np.zeros((len(t), 3))
            return zero, zero, zero
        k = np.clip(np.searchsorted(self.start, t, side="right") - 1, 0, None)
        x = (t - self.start[k]) / self.duration[k]
        height, slope, _ = bump(x)
        turn = 2 * np.pi * self.frequency[k]
        sine, cosine = np.sin(turn * t + self.phase[k]), np.cos(turn * t + self.phase[k])
        wobble = height * sine
        wobble_rate = slope / self.duration[k] * sine + height * turn * cosine
        return (
            wobble[:, None] * self.angle[k],
            wobble_rate[:, None] * self.angle[k],
            wobble[:, None] * self.push[k],
        )


@dataclass(frozen=True)
class RestsAndTurns:
    """J rests at attitudes `R` (J, 3, 3) from `start` to `stop` (J,), and smooth turns between them.

    In a turn the net rotation runs along a minimum-jerk profile (zero rate and angular acceleration at both
    ends) while a `detour` (J-1, 3) rad, an excursion about another axis, comes and goes: the rate's axis is
    not fixed, as it is not when a hand turns a box. `lift` (J-1, 3) m is the excursion of the hand. `shakes`
    are the hand's tremor during turns and knocks during rests.
    """

    R: Array
    start: Array
    stop: Array
    detour: Array
    lift: Array
    shakes: Shakes

    def at(self, t: Array) -> State:
        """The node's state at times `t` (N,), s."""
        t = np.asarray(t, dtype=np.float64)
        wobble, wobble_rate, push = self.shakes.at(t)
        if len(self.R) == 1:
            R, rate, acceleration = np.broadcast_to(self.R[0], (len(t), 3, 3)), np.zeros((len(t), 3)), push
        else:
            R, rate, acceleration = self._turned(t)
            acceleration = acceleration + push
        return State(*_wobbled(R, rate, wobble, wobble_rate), acceleration)

    def _turned(self, t: Array) -> tuple[Array, Array, Array]:
        net = so3.log(np.swapaxes(self.R[:-1], 1, 2) @ self.R[1:])
        duration = self.start[1:] - self.stop[:-1]
        j = np.clip(np.searchsorted(self.stop, t, side="right") - 1, 0, len(net) - 1)
        x, T = (t - self.stop[j]) / duration[j], duration[j, None]
        s, ds, _ = minimum_jerk(x)
        b, db, ddb = bump(x)
        R = self.R[j] @ so3.exp(s[:, None] * net[j])
        R, rate = _wobbled(R, ds[:, None] / T * net[j], b[:, None] * self.detour[j], db[:, None] / T * self.detour[j])
        return R, rate, ddb[:, None] / T**2 * self.lift[j]


def _wobbled(R: Array, rate: Array, angle: Array, angle_rate: Array) -> tuple[Array, Array]:
    """``R exp(angle)`` and its rate, for a rotation vector `angle` whose direction does not change."""
    E = so3.exp(angle)
    return R @ E, np.einsum("nji,nj->ni", E, rate) + angle_rate


@dataclass(frozen=True)
class Swing:
    """Continuous motion without rests: rotations about z, x, z that swing to and fro at paces of their own.

    `amplitude` (3,) rad, `pace` (3,) rad/s, `phase` (3,) rad; `sway` (3,) m is the excursion of the hand at
    `sway_hz` (3,).
    """

    amplitude: Array
    pace: Array
    phase: Array
    sway: Array
    sway_hz: Array

    def at(self, t: Array) -> State:
        """The node's state at times `t` (N,), s."""
        t = np.asarray(t, dtype=np.float64)[:, None]
        angle = self.amplitude * np.sin(self.pace * t + self.phase)
        rate = self.amplitude * self.pace * np.cos(self.pace * t + self.phase)
        R = np.broadcast_to(np.eye(3), (len(t), 3, 3))
        omega = np.zeros((len(t), 3))
        for i, axis in enumerate(np.eye(3)[[2, 0, 2]]):
            R, omega = _wobbled(R, omega, angle[:, i, None] * axis, rate[:, i, None] * axis)
        turn = 2 * np.pi * self.sway_hz
        return State(R, omega, -self.sway * turn**2 * np.sin(turn * t + self.phase))


def attitudes(poses: PoseSet, n: int, rng: np.random.Generator) -> Array:
    """Attitudes R_nh (n, 3, 3) in an order in which neighbours differ."""
    if poses == "free":
        steps = rng.uniform(math.radians(60), math.radians(175), (n, 1)) * random_directions(rng, n)
        R = so3.exp(steps)
        for j in range(1, n):
            R[j] = R[j - 1] @ R[j]
        return R
    by_face = _cube_by_face()
    found: list[Array] = []
    while len(found) < n:
        by_face = np.array([face[rng.permutation(4)] for face in by_face])
        for heading in range(4):  # every six rests show all six faces
            order = rng.permutation(6)
            if found and np.allclose(found[-1], by_face[order[0], heading]):
                order = np.roll(order, 1)
            found.extend(by_face[order, heading])
    R = np.array(found[:n])
    if poses == "faces":
        R = so3.exp(rng.uniform(0, 2 * np.pi, (n, 1)) * np.array([0.0, 0.0, 1.0])) @ R
    return R


def _cube_by_face() -> Array:
    """The 24 attitudes of a cube, (6 faces up, 4 headings, 3, 3)."""
    group = so3.cube_group()
    up = np.round(group[:, 2, :]).astype(int)  # R^T z: the housing axis that points up
    order = np.lexsort(up.T)
    return group[order].reshape(6, 4, 3, 3)


def put_down(label: Array, housing_sd_deg: float, level_sd_deg: float, rng: np.random.Generator) -> Array:
    """Labels with the housing's error (about axes of h) and the table's tilt (about horizontal axes of n)."""
    housing = math.radians(housing_sd_deg) * rng.normal(size=(len(label), 3))
    tilt = math.radians(level_sd_deg) * rng.normal(size=(len(label), 3)) * np.array([1.0, 1.0, 0.0])
    return so3.exp(tilt) @ label @ so3.exp(housing)


def knock_times(start: Array, stop: Array, knocks: int, rng: np.random.Generator) -> Array:
    """Start and end (K, 2) of knocks spread over the rests, clear of their ends and of each other."""
    rest = np.sort(np.resize(rng.permutation(len(start)), knocks))
    times = []
    for j in np.unique(rest):
        length = stop[j] - start[j]
        edges = np.linspace(start[j] + 0.2 * length, start[j] + 0.8 * length, int(np.sum(rest == j)) + 1)
        for low, high in itertools.pairwise(edges):
            duration = min(rng.uniform(0.12, 0.25), 0.8 * (high - low))
            begin = rng.uniform(low, high - duration)
            times.append((begin, begin + duration))
    return np.array(times).reshape(-1, 2)


def by_hand(R: Array, start: Array, stop: Array, knocks: Array, rng: np.random.Generator) -> RestsAndTurns:
    """Turns by hand (detour, lift, tremor) between rests, and knocks in them."""
    n, turn = len(R) - 1, start[1:] - stop[:-1]
    detour = np.radians(rng.uniform(5, 20, (n, 1))) * random_directions(rng, n)
    lift = rng.uniform([-0.2, -0.2, 0.1], [0.2, 0.2, 0.3], (n, 3)) * np.minimum(1, turn**2)[:, None]
    tremor = Shakes(
        start=stop[:-1],
        duration=turn,
        frequency=rng.uniform(6, 10, n),
        phase=rng.uniform(0, 2 * np.pi, n),
        angle=np.radians(rng.uniform(0.1, 0.3, (n, 1))) * random_directions(rng, n),
        push=rng.uniform(0.1, 0.4, (n, 1)) * random_directions(rng, n),
    )
    k = len(knocks)
    blows = Shakes(
        start=knocks[:, 0],
        duration=knocks[:, 1] - knocks[:, 0],
        frequency=rng.uniform(12, 25, k),
        phase=rng.uniform(0, 2 * np.pi, k),
        angle=np.radians(rng.uniform(0.1, 0.3, (k, 1))) * random_directions(rng, k),
        push=rng.uniform(1, 4, (k, 1)) * random_directions(rng, k),
    )
    return RestsAndTurns(R, start, stop, detour, lift, tremor.merged(blows))
