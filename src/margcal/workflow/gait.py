"""Walking on a treadmill, for simulated nodes at hip, thigh and ankle: a chain of rigid segments in closed form.

Pelvis, thigh and shank of one leg hang together by joints whose angles are Fourier series of the gait's phase. The
series run through 20 points of a stride each, read off the normal ranges that textbooks give for adults (Perry &
Burnfield, Gait Analysis, 2010; Winter, Biomechanics and Motor Control of Human Movement, 2009) and made a little
smaller for slow walking: plausible and no measurement. Heel strikes are short bumps of the segments' places. The pace
wavers, and the walker stands before setting off.

Every segment carries its attitude, angular rate, angular acceleration, position, velocity and acceleration down the
chain by the exact derivatives, so that nothing that a node would feel is inconsistent with where it is seen.

Frames: x forward, y left, z up for the segments of the left leg at rest; n is ENU.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from margcal.core import so3
from margcal.core.types import Array
from margcal.workflow.motion import State, bump, minimum_jerk

Place = Literal["hip", "thigh", "ankle"]
PLACES: tuple[Place, ...] = ("hip", "thigh", "ankle")

_HIP = (28, 27, 25, 20, 14, 8, 2, -3, -7, -9, -8, -2, 8, 18, 26, 31, 32, 31, 29, 28)
_KNEE = (4, 11, 15, 15, 13, 10, 7, 5, 6, 10, 19, 32, 47, 57, 57, 47, 31, 14, 4, 2)
"""Flexion, deg, at every twentieth of a stride from heel strike."""

HARMONICS = 6
"""Of the two: 5 Hz at this pace; what is left out of the points is below 1.5 degrees."""

STRIDE_S = 1.3
"""Seconds from heel strike to heel strike of one foot: 1.08 m at 3 km/h."""

Derivatives = tuple[Array, Array, Array]
"""A quantity and its first and second derivative by time."""


@dataclass(frozen=True)
class Series:
    """``mean + sum_k a_k cos(k phi) + b_k sin(k phi)``; `a`, `b` (K,)."""

    mean: float
    a: Array
    b: Array

    def at(self, phase: Derivatives) -> Derivatives:
        """Value and derivatives by time, at a phase (N,) that is a function of time."""
        phi, speed, change = phase
        k = np.arange(1, len(self.a) + 1)
        c, s = np.cos(phi[:, None] * k), np.sin(phi[:, None] * k)
        value = self.mean + c @ self.a + s @ self.b
        slope = c @ (k * self.b) - s @ (k * self.a)
        curve = -(c @ (k**2 * self.a) + s @ (k**2 * self.b))
        return value, slope * speed, curve * speed**2 + slope * change


def through(points_deg: tuple[float, ...], harmonics: int = HARMONICS) -> Series:
    """The series, rad, of points evenly over a stride, deg."""
    c = np.fft.rfft(np.radians(points_deg)) / len(points_deg)
    return Series(float(c[0].real), 2 * c[1 : harmonics + 1].real, -2 * c[1 : harmonics + 1].imag)


def wave(k: int, size: float, phase_deg: float = 0.0, mean: float = 0.0) -> Series:
    """``mean + size cos(k phi - phase)``."""
    a, b = np.zeros(k), np.zeros(k)
    a[-1], b[-1] = size * math.cos(math.radians(phase_deg)), size * math.sin(math.radians(phase_deg))
    return Series(mean, a, b)


@dataclass(frozen=True)
class Segment:
    """A rigid body along time: R (N, 3, 3) to n, rate and its derivative (N, 3) in its axes, place and its derivatives
    (N, 3) in n."""

    R: Array
    rate: Array
    rate_change: Array
    p: Array
    v: Array
    a: Array

    def turned(self, axis: int, angle: Derivatives) -> Segment:
        """The segment that is turned from this one about its axis 0, 1 or 2."""
        e = np.eye(3)[axis]
        value, slope, curve = (d[:, None] * e for d in angle)
        E = so3.exp(value)
        carried = np.einsum("nji,nj->ni", E, self.rate)
        rate = carried + slope
        # (E^T w)' = E^T w' - slope x (E^T w), since E' = E [slope]x for a fixed axis
        change = np.einsum("nji,nj->ni", E, self.rate_change) - np.cross(slope, carried) + curve
        return Segment(self.R @ E, rate, change, self.p, self.v, self.a)

    def at(self, r: Array) -> Segment:
        """The same body, at the point `r` (3,) m of it."""
        swing = np.cross(self.rate, r)
        pull = np.cross(self.rate_change, r) + np.cross(self.rate, swing)

        def in_n(u: Array) -> Array:
            return np.einsum("nij,nj->ni", self.R, np.broadcast_to(u, self.p.shape))

        return Segment(self.R, self.rate, self.rate_change, self.p + in_n(r), self.v + in_n(swing), self.a + in_n(pull))

    def shifted(self, moved: list[Derivatives]) -> Segment:
        """Moved along the axes of n."""
        p, v, a = (np.column_stack(parts) for parts in zip(*moved))
        return Segment(self.R, self.rate, self.rate_change, self.p + p, self.v + v, self.a + a)


@dataclass(frozen=True)
class Gait:
    """One walker on a treadmill.

    Attributes
    ----------
    heading : float, rad
        Of the walking direction, from east to north.
    stride_s : float
    waver : ndarray (W, 3)
        Size (rad of phase), angular frequency (rad/s) and phase of the pace's slow changes.
    sway : ndarray (3, W, 3)
        The same for slow changes of the pelvis' place (m) along the axes of n.
    scale : float
        Factor on the joints' angles.
    standing_s, starting_s : float
        Time before the first step, and until the stride is full.
    """

    heading: float = math.radians(70.0)
    stride_s: float = STRIDE_S
    waver: Array = field(default_factory=lambda: np.zeros((0, 3)))
    sway: Array = field(default_factory=lambda: np.zeros((3, 0, 3)))
    scale: float = 0.95
    standing_s: float = 4.0
    starting_s: float = 3.0

    def phase(self, t: Array) -> Derivatives:
        """Phase of the stride, rad, 0 at heel strike."""
        steady = 2 * math.pi / self.stride_s
        size, pace, start = self.waver.T
        turn = pace * t[:, None] + start
        return (
            steady * t + np.sin(turn) @ size,
            steady + np.cos(turn) @ (size * pace),
            -(np.sin(turn) @ (size * pace**2)),
        )

    def pelvis(self, t: Array) -> Segment:
        zero = np.zeros((len(t), 3))
        phase, fade = self.phase(t), self._fade(t)
        c, s = math.cos(self.heading), math.sin(self.heading)
        still = Segment(
            np.broadcast_to(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]), (len(t), 3, 3)), zero, zero, zero, zero, zero
        )
        forward = _scaled(wave(2, 0.010, 60).at(phase), fade)
        left = _scaled(wave(1, 0.022, 100).at(phase), fade)
        up = _sum(_scaled(wave(2, 0.014, 200).at(phase), fade), _strike(phase, fade, (0.0, 0.5), 0.0003))
        along = [_turn(forward, left, c, -s), _turn(forward, left, s, c), up]
        moved = still.shifted([_sum(a, self._swayed(t, k)) for k, a in enumerate(along)])
        moved = moved.turned(2, _scaled(wave(1, math.radians(4.5), 20).at(phase), fade))
        moved = moved.turned(1, _scaled(wave(2, math.radians(1.5), 40, math.radians(8.0)).at(phase), fade))
        return moved.turned(0, _scaled(wave(1, math.radians(3.5), 60).at(phase), fade))

    def thigh(self, t: Array) -> Segment:
        phase, fade = self.phase(t), self._fade(t)
        hip = self.pelvis(t).at(np.array([0.0, 0.09, -0.06]))
        bent = hip.turned(1, self._joint(_HIP, -1.0, phase, fade))
        bent = bent.turned(0, _scaled(wave(1, math.radians(4.0), 60).at(phase), fade))
        return bent.turned(2, _scaled(wave(1, math.radians(4.0), 250, math.radians(3.0)).at(phase), fade))

    def shank(self, t: Array) -> Segment:
        phase, fade = self.phase(t), self._fade(t)
        knee = self.thigh(t).at(np.array([0.0, 0.0, -0.42]))
        bent = knee.turned(1, self._joint(_KNEE, 1.0, phase, fade))
        bent = bent.turned(2, _scaled(wave(2, math.radians(4.0), 130).at(phase), fade))
        jolt = _strike(phase, fade, (0.0,), 0.0008)
        rest = tuple(np.zeros(len(t)) for _ in range(3))
        return bent.shifted([rest, rest, jolt])  # type: ignore[list-item]

    def _joint(self, points: tuple[int, ...], sign: float, phase: Derivatives, fade: Derivatives) -> Derivatives:
        factor = sign * self.scale
        value, slope, curve = through(points).at(phase)
        return _scaled((factor * value, factor * slope, factor * curve), fade)

    def _fade(self, t: Array) -> Derivatives:
        """From standing (0) to walking (1)."""
        T = self.starting_s
        value, slope, curve = minimum_jerk((t - self.standing_s) / T)
        return value, slope / T, curve / T**2

    def _swayed(self, t: Array, axis: int) -> Derivatives:
        size, pace, start = self.sway[axis].T
        turn = pace * t[:, None] + start
        return np.sin(turn) @ size, np.cos(turn) @ (size * pace), -(np.sin(turn) @ (size * pace**2))


_ATTACHED: dict[Place, tuple[Array, Array]] = {
    "hip": (np.array([-0.02, 0.15, 0.02]), np.radians([2.0, -6.0, 12.0])),
    "thigh": (np.array([0.03, 0.08, -0.22]), np.radians([-5.0, 4.0, -15.0])),
    "ankle": (np.array([0.02, 0.045, -0.34]), np.radians([4.0, 7.0, 10.0])),
}
"""Place of each node on its segment, m, and how it is turned there (rotation vector): straps are never straight."""


@dataclass(frozen=True)
class GaitNode:
    """The motion of a node on a walker: a `Motion` whose position is known too."""

    gait: Gait
    place: Place

    def at(self, t: Array) -> State:
        """The node's state at times `t` (N,), s."""
        body, mount = self._body(t)
        return State(body.R @ mount, body.rate @ mount, body.a)

    def position(self, t: Array) -> Array:
        """Position (N, 3) of the node in n, m."""
        return self._body(t)[0].p

    def _body(self, t: Array) -> tuple[Segment, Array]:
        t = np.asarray(t, dtype=np.float64)
        segment = {"hip": self.gait.pelvis, "thigh": self.gait.thigh, "ankle": self.gait.shank}[self.place](t)
        r, turn = _ATTACHED[self.place]
        return segment.at(r), so3.exp(turn)


def walker(rng: np.random.Generator, *, heading_deg: float = 70.0, standing_s: float = 4.0) -> Gait:
    """A walker at 3 km/h: stride times scatter by about two per cent, the pelvis wanders by a few centimetres."""
    pace = 2 * math.pi * rng.uniform(0.04, 0.35, 6)
    # a tone of size a and pace w changes the stride's duration by a w / steady, relative
    steady = 2 * math.pi / STRIDE_S
    waver = np.column_stack([0.011 * steady / pace, pace, rng.uniform(0, 2 * np.pi, 6)])
    slow = 2 * math.pi * rng.uniform(0.02, 0.15, (3, 4))
    size = np.array([0.02, 0.02, 0.002])[:, None] * rng.uniform(0.5, 1.0, (3, 4))
    sway = np.stack([size, slow, rng.uniform(0, 2 * np.pi, (3, 4))], axis=2)
    scale = float(rng.uniform(0.9, 1.0))
    return Gait(math.radians(heading_deg), STRIDE_S, waver, sway, scale, standing_s)


# --- products and sums with their derivatives ---------------------------------------------------------


def _scaled(x: Derivatives, by: Derivatives) -> Derivatives:
    return x[0] * by[0], x[1] * by[0] + x[0] * by[1], x[2] * by[0] + 2 * x[1] * by[1] + x[0] * by[2]


def _sum(x: Derivatives, y: Derivatives) -> Derivatives:
    return x[0] + y[0], x[1] + y[1], x[2] + y[2]


def _turn(x: Derivatives, y: Derivatives, c: float, s: float) -> Derivatives:
    return c * x[0] + s * y[0], c * x[1] + s * y[1], c * x[2] + s * y[2]


def _strike(phase: Derivatives, fade: Derivatives, when: tuple[float, ...], size: float) -> Derivatives:
    """Bumps of height `size` m over a twentieth of a stride, at these parts of it."""
    width = 0.05
    total = tuple(np.zeros_like(phase[0]) for _ in range(3))
    for start in when:
        x = ((phase[0] / (2 * np.pi) - start) % 1.0) / width
        value, slope, curve = (size * v for v in bump(x))
        by = 1 / (2 * np.pi * width)
        one = value, slope * by * phase[1], curve * (by * phase[1]) ** 2 + slope * by * phase[2]
        total = _sum(total, one)  # type: ignore[arg-type]
    return _scaled(total, fade)  # type: ignore[arg-type]
