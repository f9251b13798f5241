"""Angular rates, angular accelerations and accelerations of a rigid body from optical attitudes and positions.

Rüschen, Misgeld, Kim, Leonhardt, "A Novel Algorithm for the Calibration of Inertial/Magnetic Sensors: Application to
a Body Sensor Network" (R-BSN), equations (14), (15).

The quaternion q takes body components to the laboratory (Hamilton; (5) of the paper is the transpose of what its (6)
needs). ``q' = 1/2 q (0, w)`` then gives the rate in the body's axes, where the gyroscope is,

    (0, w) = 2 q+ q'                                                                       (14), corrected

while (14) as printed, ``2 q' q+``, is the same vector in the laboratory's axes: fitted to a gyroscope it leaves about
all of the signal. It can be had here for comparison.

# not in the paper: derivatives by local polynomials of degree four (Savitzky & Golay, Anal. Chem. 36 (1964) 1627)
over 11 samples at 100 Hz, instead of differences of neighbours; gaps are masked and never bridged, so that no
derivative is taken across one.

=========  ===========================================================================  ==============
name here  meaning                                                                      shape
=========  ===========================================================================  ==============
t          time of the optics, s                                                        (N,)
q          attitude, scalar first, body to laboratory                                   (N, 4)
w          rate in the body's axes, rad/s: a row of Omega_ref^T                         (N, 3)
W          weights of the local polynomial for value, first and second derivative       (3, n)
=========  ===========================================================================  ==============
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from margcal.core import so3
from margcal.core.errors import DataError
from margcal.core.types import Array, Mask, Reference

SPAN_S = 0.1
"""Length of the polynomials: 11 points at 100 Hz."""
DEGREE = 4
LEAST_POINTS = 7
GAP = 1.5
"""Samples this many usual steps apart do not follow each other."""


@dataclass(frozen=True)
class ReferenceRates:
    """The motion of the body on the optics' clock; NaN where it was not seen long enough.

    Attributes
    ----------
    t : ndarray (N,), s
    q : ndarray (N, 4)
        Smoothed attitude, unit, of continuous sign.
    w, w_dot : ndarray (N, 3), rad/s, rad/s^2
        Angular rate and acceleration in the body's axes (with `as_printed`: in the laboratory's).
    p, p_ddot : ndarray (N, 3) or None, m, m/s^2
        Smoothed position and acceleration in the laboratory.
    valid, valid_p : ndarray (N,) of bool
        Where `w` is known; where `p_ddot` is known too.
    noise_w, noise_a : float, rad/s, m/s^2
        Standard deviation of a component of w and p_ddot, from what the polynomials leave over.
    points : int
        Points of a polynomial.
    rate : float, Hz
    """

    t: Array
    q: Array
    w: Array
    w_dot: Array
    p: Array | None
    p_ddot: Array | None
    valid: Mask
    valid_p: Mask
    noise_w: float
    noise_a: float
    points: int
    rate: float

    @property
    def R(self) -> Array:
        """R_mk (N, 3, 3): takes body components to the laboratory; NaN where not seen."""
        return so3.matrix_from_quat(self.q)


def reference_rates(reference: Reference, *, as_printed: bool = False, points: int | None = None) -> ReferenceRates:
    """Rates and accelerations of the body that the optics followed.

    Parameters
    ----------
    reference : Reference
        NaN where the body was not seen.
    as_printed : bool
        (14) as the paper prints it: the rate in the laboratory's axes.
    points : int, optional
        Points of a polynomial, odd; default: those of 0.1 s, at least 7.

    Raises
    ------
    DataError
        If the body is nowhere seen long enough for one polynomial.
    """
    t, q = reference.t, np.array(reference.q)
    rate = usual_rate(t)
    n = points or points_at(rate)
    seen: Mask = np.atleast_1d(np.isfinite(q).all(axis=1))
    value, first, second = (np.full_like(q, np.nan) for _ in range(3))
    noise, count = 0.0, 0
    for part in stretches(t, seen, n):
        part_q = continuous(q[part])
        value[part], first[part], second[part], left = derivatives(t[part], part_q, n)
        noise, count = noise + left, count + part.stop - part.start
    if not count:
        raise DataError(
            "the reference sees the body nowhere for a tenth of a second at a stretch; look at the cameras and markers"
        )
    length = np.linalg.norm(value, axis=1, keepdims=True)
    value, first, second = value / length, first / length, second / length
    conjugate = so3.quat_conjugate(value)
    if as_printed:
        w = 2 * so3.quat_multiply(first, conjugate)[:, 1:]  # (14) as printed
        w_dot = 2 * so3.quat_multiply(second, conjugate)[:, 1:]
    else:
        w = 2 * so3.quat_multiply(conjugate, first)[:, 1:]  # (14) corrected, (15)
        w_dot = 2 * so3.quat_multiply(conjugate, second)[:, 1:]
    W = savitzky_golay(n)
    # unit quaternions err in three directions of their four
    sd_q = np.sqrt(noise / count / 3 / (1 - W[0, n // 2]))
    noise_w = float(2 * sd_q * np.linalg.norm(W[1]) * rate)
    p, p_ddot, noise_a = _positions(reference, n, rate)
    valid: Mask = np.atleast_1d(np.isfinite(w).all(axis=1))
    valid_p: Mask = np.zeros(len(t), dtype=bool)
    if p_ddot is not None:
        valid_p = np.logical_and(valid, np.isfinite(p_ddot).all(axis=1))
    return ReferenceRates(t, value, w, w_dot, p, p_ddot, valid, valid_p, noise_w, noise_a, n, rate)


def _positions(reference: Reference, n: int, rate: float) -> tuple[Array | None, Array | None, float]:
    if reference.p is None or not np.isfinite(reference.p).any():
        return None, None, float("nan")
    value, second = np.full_like(reference.p, np.nan), np.full_like(reference.p, np.nan)
    noise, count = 0.0, 0
    seen: Mask = np.atleast_1d(np.isfinite(reference.p).all(axis=1))
    for part in stretches(reference.t, seen, n):
        value[part], _, second[part], left = derivatives(reference.t[part], reference.p[part], n)
        noise, count = noise + left, count + part.stop - part.start
    if not count:
        return None, None, float("nan")
    W = savitzky_golay(n)
    sd = np.sqrt(noise / count / 3 / (1 - W[0, n // 2]))
    return value, second, float(sd * np.linalg.norm(W[2]) * rate**2)


# --- pieces that others use too ---------------------------------------------------------------------


def usual_rate(t: Array) -> float:
    """Samples per second where the samples follow each other: gaps in time do not count."""
    step = np.diff(t)
    if not len(step):
        return float("nan")
    usual = float(np.median(step))
    follow = step < GAP * usual
    return float(1 / np.mean(step[follow])) if follow.any() else 1 / usual


def points_at(rate: float, span_s: float = SPAN_S) -> int:
    """Odd number of points that cover `span_s`, at least `LEAST_POINTS`."""
    return max(LEAST_POINTS, 2 * round(span_s * rate / 2) + 1)


def savitzky_golay(n: int, degree: int = DEGREE) -> Array:
    """Weights (3, n) that give value, first and second derivative (a sample for unit of time) in the middle."""
    k = np.arange(n) - n // 2
    powers = (k[:, None] / max(n // 2, 1)) ** np.arange(min(degree, n - 1) + 1)
    inverse = np.linalg.pinv(powers)
    half = max(n // 2, 1)
    return np.stack([inverse[0], inverse[1] / half, 2 * inverse[2] / half**2])


def stretches(t: Array, seen: Mask, least: int) -> Iterator[slice]:
    """Runs of samples that were seen and follow each other without a gap, `least` samples or longer."""
    usual = 1 / usual_rate(t) if len(t) > 1 else 1.0
    joined = np.concatenate([[False], seen[1:] & seen[:-1] & (np.diff(t) < GAP * usual), [False]])
    starts = np.flatnonzero(~joined[:-1] & joined[1:])
    stops = np.flatnonzero(joined[:-1] & ~joined[1:])
    for a, b in zip(starts.tolist(), stops.tolist()):
        if b + 1 - a >= least:
            yield slice(a, b + 1)


def continuous(q: Array) -> Array:
    """Quaternions (N, 4) with the sign that makes each the neighbour of the one before."""
    flips = np.where(np.sum(q[1:] * q[:-1], axis=1) < 0, -1.0, 1.0)
    return q * np.concatenate([[1.0], np.cumprod(flips)])[:, None]


def derivatives(t: Array, x: Array, n: int, degree: int = DEGREE) -> tuple[Array, Array, Array, float]:
    """Value, first and second derivative by time of one stretch, and the sum of squares of what is left over.

    Parameters
    ----------
    t : ndarray (N,), s
        Steps may differ a little: time is fitted as x is, and the chain rule does the rest.
    x : ndarray (N, m)
    n : int
        Points; n // 2 at either end stay NaN.
    """
    W, half = savitzky_golay(n, degree), n // 2
    value, first, second = (np.full(x.shape, np.nan) for _ in range(3))
    tau = t - t[0]
    speed, turn = (np.convolve(tau, w[::-1], mode="valid")[:, None] for w in W[1:])
    inner = slice(half, len(t) - half)
    columns = [[np.convolve(column, w[::-1], mode="valid") for w in W] for column in x.T]
    value[inner], by_sample, bend = (np.stack([c[k] for c in columns], axis=-1) for k in range(3))
    first[inner] = by_sample / speed
    second[inner] = (bend - first[inner] * turn) / speed**2
    left = float(np.sum((x[inner] - value[inner]) ** 2))
    return value, first, second, left


def hermite(t: Array, x: Array, slope: Array, at: Array) -> tuple[Array, Array]:
    """x and its slope at times `at`, by the cubic through values and slopes at the samples."""
    k = np.clip(np.searchsorted(t, at) - 1, 0, len(t) - 2)
    h = (t[k + 1] - t[k])[:, None]
    s = ((at - t[k]) / (t[k + 1] - t[k]))[:, None]
    a, b, da, db = x[k], x[k + 1], slope[k] * h, slope[k + 1] * h
    value = a + s * (da + s * (3 * (b - a) - 2 * da - db + s * (2 * (a - b) + da + db)))
    first = slope[k] + s * (slope[k + 1] - slope[k])
    return value, first


def resample(t: Array, x: Array, at: Array, longest: float = 3.0) -> Array:
    """x (N, m) at times `at` by cubics through four neighbours; NaN beside a gap, a NaN and beyond the ends.

    Parameters
    ----------
    longest : float
        Neighbours this many usual steps apart are no neighbours.
    """
    slope = np.full_like(x, np.nan)
    slope[1:-1] = (x[2:] - x[:-2]) / (t[2:] - t[:-2])[:, None]
    k = np.clip(np.searchsorted(t, at) - 1, 0, len(t) - 2)
    h = t[k + 1] - t[k]
    out = hermite(t, x, slope, at)[0]
    out[(at < t[0]) | (at > t[-1]) | (h > longest * np.median(np.diff(t)))] = np.nan
    return out


def attitude_at(reference: Reference, at: Array) -> Array:
    """R_mk (M, 3, 3) at times `at`: cubics through four unit quaternions; NaN in gaps and beyond the ends."""
    q = np.array(reference.q)
    seen = np.flatnonzero(np.isfinite(q).all(axis=1))
    q[seen] = continuous(q[seen])
    return so3.matrix_from_quat(resample(reference.t, q, at))
