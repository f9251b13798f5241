"""What `evaluate` needs to hold two tracks of attitudes together: common times, a constant offset of the clocks, and
constant rotations between their frames. Not in the papers, which say nothing of either.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from margcal.core import so3
from margcal.core.errors import DataError
from margcal.core.types import Array, Attitude, Issue

LONGEST_GAP = 5.0
"""Usual steps of a track over which it is interpolated."""

GRID_HZ = 100.0
"""Finest grid on which angular speeds are compared."""

SPEED_S = 0.04
"""Over how long an angular speed is taken: the same for both tracks, so it biases nothing and averages noise."""

LEAST_OVERLAP = 0.3
"""Part of the shorter track that must still have a partner after it was moved."""

LEAST_CORRELATION = 0.5
"""Correlation of the angular speeds below which no offset is believed."""

UNTOLD = 0.01
"""Relative distance of the two largest singular values below which the two rotations cannot be told apart."""

_ONE = np.array([1.0, 0.0, 0.0, 0.0])


@dataclass(frozen=True)
class Frames:
    """``laboratory * q_est * body`` is what was judged: unit quaternions (4,), scalar first."""

    laboratory: Array
    body: Array

    @property
    def laboratory_deg(self) -> Array:
        """Rotation vector (3,), degrees."""
        return np.degrees(so3.quat_log(self.laboratory))

    @property
    def body_deg(self) -> Array:
        return np.degrees(so3.quat_log(self.body))


def no_turn() -> Frames:
    return Frames(_ONE, _ONE)


# --- times --------------------------------------------------------------------------------------------


def usual_step(t: Array) -> float:
    """Median distance of the samples, s."""
    return float(np.median(np.diff(t))) if len(t) > 1 else 1.0


def at_times(track: Attitude, when: Array) -> Array:
    """Attitudes (N, 4) at the times `when`, by slerp between neighbouring samples; NaN in gaps and beyond the ends.

    A sample that was not seen (NaN) is a gap, however short; samples that are farther apart than `LONGEST_GAP`
    usual steps are one too.
    """
    t, q = track.t, track.q
    if len(t) < 2:
        return np.full((len(when), 4), np.nan)
    after = np.clip(np.searchsorted(t, when), 1, len(t) - 1)
    before = after - 1
    step = t[after] - t[before]
    part = (when - t[before]) / step
    # on a sample (but for rounding of the clocks) its neighbour is not asked
    near = 1e-6 * usual_step(t)
    at_before, at_after = np.abs(when - t[before]) <= near, np.abs(when - t[after]) <= near
    between = so3.quat_multiply(so3.quat_conjugate(q[before]), q[after])
    out = so3.quat_multiply(q[before], so3.quat_exp(part[:, None] * so3.quat_log(between)))
    out[(part < 0) | (part > 1) | (step > LONGEST_GAP * usual_step(t))] = np.nan
    out[at_before], out[at_after] = q[before][at_before], q[after][at_after]
    return out


def time_offset(estimate: Attitude, reference: Attitude) -> tuple[float, float]:
    """Constant offset of the clocks from the angular speeds, which no constant rotation changes.

    Returns
    -------
    offset : float, s
        ``t_reference = t_estimate + offset``.
    correlation : float
        Of the two speeds after the estimate was moved.

    Raises
    ------
    DataError
        No offset makes the speeds agree.
    """
    step = max(usual_step(estimate.t), usual_step(reference.t), 1 / GRID_HZ)
    start = _coarse(estimate, reference, step)
    offset = start
    grid = np.arange(reference.t[0], reference.t[-1], step)
    wanted = _speed(reference, grid, step)
    for _ in range(8):
        # the speed of the estimate at t - offset - d is s - d s': one unknown
        here, later = (_speed(estimate, grid - offset + d, step) for d in (0.0, 0.1 * step))
        sooner = _speed(estimate, grid - offset - 0.1 * step, step)
        slope = (later - sooner) / (0.2 * step)
        good = np.isfinite(slope) & np.isfinite(here) & np.isfinite(wanted)
        if good.sum() < 10 or not (energy := float(slope[good] @ slope[good])):
            break
        d = float(slope[good] @ (here - wanted)[good]) / energy
        offset += float(np.clip(d, -step, step))
        if abs(d) < 1e-7:
            break
    here = _speed(estimate, grid - offset, step)
    good = np.isfinite(here) & np.isfinite(wanted)
    correlation = _correlation(here[good], wanted[good]) if good.sum() >= 10 else 0.0
    if not correlation >= LEAST_CORRELATION or abs(offset - start) > 5 * step:
        raise DataError(
            f"no offset between the clocks makes the two tracks agree (correlation of the angular speeds "
            f"{correlation:.2f}, {LEAST_CORRELATION:g} is needed): they show different motions, or too little of one"
        )
    return offset, correlation


def _speed(track: Attitude, when: Array, step: float) -> Array:
    """Angular speed (N,), rad/s, over a window about each time; NaN where it is not known."""
    window = max(step, SPEED_S)
    a, b = at_times(track, when - window / 2), at_times(track, when + window / 2)
    return np.linalg.norm(so3.quat_log(so3.quat_multiply(so3.quat_conjugate(a), b)), axis=1) / window


def _correlation(a: Array, b: Array) -> float:
    a, b = a - a.mean(), b - b.mean()
    size = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / size if size > 0 else 0.0


def _coarse(estimate: Attitude, reference: Attitude, step: float) -> float:
    """The lag with the largest correlation of the speeds, to a grid step."""
    a = _filled(_speed(reference, np.arange(reference.t[0], reference.t[-1], step), step))
    b = _filled(_speed(estimate, np.arange(estimate.t[0], estimate.t[-1], step), step))
    n = 1 << int(np.ceil(np.log2(len(a[0]) + len(b[0]))))

    def product(x: Array, y: Array) -> Array:
        """Sum over t of x(t + lag) y(t) for each lag (negative ones at the end)."""
        return np.fft.irfft(np.fft.rfft(x, n) * np.conj(np.fft.rfft(y, n)), n)

    overlap = product(a[1], b[1])
    energy = np.sqrt(np.maximum(product(a[0] ** 2, b[1]) * product(a[1], b[0] ** 2), 1e-300))
    score = np.where(overlap >= LEAST_OVERLAP * min(a[1].sum(), b[1].sum()), product(a[0], b[0]) / energy, -1.0)
    best = int(np.argmax(score))
    lag = best - n if best > n // 2 else best
    return reference.t[0] - estimate.t[0] + lag * step


def _filled(speed: Array) -> tuple[Array, Array]:
    """Speed about its mean with zeros where it is not known, and 1 where it is known."""
    known = np.isfinite(speed)
    if not known.any():
        raise DataError("a track has no two neighbouring samples; nothing can be said of its motion")
    return np.where(known, speed - speed[known].mean(), 0.0), known.astype(np.float64)


# --- frames -------------------------------------------------------------------------------------------


def turned(q_est: Array, q_ref: Array, how: Literal["yaw", "full"]) -> tuple[Frames, list[Issue]]:
    """The constant rotations that bring `q_est` (N, 4) nearest to `q_ref` (N, 4), and what is to be said of them.

    ``yaw``: about the vertical. With d = q_est q_ref^-1 and the turn (c, 0, 0, s), the scalar part of the error
    becomes c d_w - s d_z; the sum of its squares is largest along the eigenvector of a 2x2 matrix.
    ``full``: laboratory and body. ``q_ref . (a q_est b)`` is bilinear in a and b, so its sum is largest along the
    first pair of singular vectors of a 4x4 matrix; signs of the quaternions are settled by repetition.
    """
    if how == "yaw":
        d = so3.quat_multiply(q_est, so3.quat_conjugate(q_ref))
        w, z = d[:, 0], d[:, 3]
        _, vectors = np.linalg.eigh(np.array([[w @ w, -w @ z], [-w @ z, z @ z]]))
        c, s = vectors[:, 1] * (1.0 if vectors[0, 1] >= 0 else -1.0)
        return Frames(np.array([c, 0.0, 0.0, s]), _ONE), []
    basis = np.eye(4)
    terms = np.array(
        [[np.sum(q_ref * so3.quat_multiply(so3.quat_multiply(u, q_est), v), axis=1) for v in basis] for u in basis]
    )
    a, b, size = _bilinear(terms, np.ones(len(q_est)))
    for _ in range(20):
        sign = np.where(np.einsum("i,ijn,j->n", a, terms, b) < 0, -1.0, 1.0)
        before, (a, b, size) = a, _bilinear(terms, sign)
        if np.array_equal(a, before):
            break
    issues = []
    if size[0] - size[1] < UNTOLD * size[0]:
        text = (
            "the motion turns about one axis at most: a rotation of the laboratory and one of the body cannot be told "
            "apart, only their product means something"
        )
        issues.append(Issue("frames-not-told", "note", text, value=float((size[0] - size[1]) / size[0]), limit=UNTOLD))
    return Frames(np.copysign(1.0, a[0]) * a, np.copysign(1.0, b[0]) * b), issues


def _bilinear(terms: Array, sign: Array) -> tuple[Array, Array, Array]:
    """Unit a, b (4,) that make the sum of ``sign a^T terms b`` largest, and the singular values (4,)."""
    U, size, Vt = np.linalg.svd(terms @ sign)
    return U[:, 0], Vt[0], size
