"""Sensor and optical reference as linear equations in the frequency domain (ours, not in the papers).

The sensor's model and the reference's attitude and position make equations that are linear in what is sought, with
derivatives of what the cameras see. They are multiplied by ``w(t) exp(-i 2 pi f t)`` and integrated; w is a window
that falls smoothly to zero before every gap. Integration by parts moves the derivatives of positions to the window,

    integral of  w e x''  =  integral of (w e)'' x                     e = exp(-i 2 pi f t)                      (a)

and the turn between two neighbouring samples, ``log(R(t + dt) R(t)^T)``, is the integral of the rate w_m in the
laboratory's axes over dt (but for Magnus' second term, dt^3 w_m' x w_m / 12, which is taken off): its spectrum is that
of the rate times that of the mean over dt,

    spectrum of the turns / dt  =  sin(pi f dt) / (pi f dt)  times  spectrum of w_m                               (b)

Nothing is differentiated, smoothed or carried across a gap, and the cameras' white noise stays what it is: after (a)
it grows with f^2, after (b) with f, and each frequency is weighted accordingly.

=================  ===========================================================================  ==================
name here          meaning                                                                      shape
=================  ===========================================================================  ==================
t, z               times and raw readings of one sensor                                         (N,), (N, 3)
R, p               R_mk, marker body to laboratory, and the marker body's position at t         (N, 3, 3), (N, 3)
w, w1, w2          the window and its derivatives                                               (N,)
rows, target       the equations ``rows @ x = target`` at the frequencies of `f`                (F, E, n), (F, E)
gain               weight of each frequency                                                     (F,)
=================  ===========================================================================  ==================
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from margcal.core import so3
from margcal.core.errors import DataError, InputError
from margcal.core.types import Array, Mask

Spectra = NDArray[np.complex128]
"""Complex values (F, ...)."""

HOLE = 3.5
"""Sample intervals without a reading that are a gap; shorter holes (a lost packet) are filled linearly."""
EVEN = 0.02
"""Jitter, in sample intervals, up to which times count as even."""


@dataclass(frozen=True)
class Track:
    """Readings and reference at the same, evenly spaced times; `valid` where both are known."""

    t: Array
    z: Array
    R: Array
    valid: Mask
    p: Array | None = None

    @property
    def step(self) -> float:
        return float((self.t[-1] - self.t[0]) / (len(self.t) - 1))


def even_track(t: Array, z: Array, R: Array, valid: Mask | None = None, p: Array | None = None) -> Track:
    """Readings and reference on an even grid of the sensor's own rate.

    Parameters
    ----------
    t : ndarray (N,), s
    z : ndarray (N, 3), raw unit
    R : ndarray (N, 3, 3)
        R_mk at `t`: marker body to laboratory. Interpolated from the reference's own times with an error well below
        its noise (a cubic will do, linear interpolation will not).
    valid : ndarray (N,) of bool, optional
        False in gaps of the reference.
    p : ndarray (N, 3), m, optional
        Position of the marker body at `t`.

    Raises
    ------
    InputError
        If shapes differ or time does not run forward.
    DataError
        If fewer than 50 samples are seen by both.
    """
    t, z, R = (np.asarray(a, dtype=np.float64) for a in (t, z, R))
    n = len(t)
    if z.shape != (n, 3) or R.shape != (n, 3, 3) or (p is not None and np.shape(p) != (n, 3)):
        raise InputError(f"{n} times, but readings {z.shape}, attitudes {R.shape}: samples must go with one another")
    columns = [z, R.reshape(n, 9)] if p is None else [z, R.reshape(n, 9), np.asarray(p, dtype=np.float64)]
    known: Mask = np.asarray(np.isfinite(np.column_stack(columns)).all(axis=1), dtype=np.bool_)
    if valid is not None:
        known = known & valid
    if known.sum() < 50:
        raise DataError(f"only {int(known.sum())} samples were seen by sensor and reference both; record more")
    if n > 1 and np.any(np.diff(t) <= 0):
        raise InputError("the sensor's times do not run forward")
    first, last = np.flatnonzero(known)[[0, -1]]
    span = slice(first, last + 1)
    p = None if p is None else np.asarray(p, dtype=np.float64)[span]
    return _evened(t[span], z[span], R[span], known[span], p)


def _evened(t: Array, z: Array, R: Array, known: Mask, p: Array | None) -> Track:
    """Resampled if the times are uneven; unknown samples are zero and not valid."""
    steps = np.diff(t)
    step = float(np.median(steps))
    grid = t[0] + step * np.arange(round((t[-1] - t[0]) / step) + 1)
    grid = np.linspace(t[0], t[-1], len(grid))
    if len(grid) != len(t) or np.max(np.abs(grid - t)) > EVEN * step:
        index = np.clip(np.searchsorted(t, grid, side="right"), 1, len(t) - 1)
        bridged = steps[index - 1] < HOLE * step
        near = known[index] & known[index - 1]

        def at_grid(x: Array) -> Array:
            flat = np.where(np.isfinite(x), x, 0.0).reshape(len(x), -1)
            return np.column_stack([np.interp(grid, t, c) for c in flat.T]).reshape(len(grid), *x.shape[1:])

        z, R, p = at_grid(z), at_grid(R), None if p is None else at_grid(p)
        t, known = grid, bridged & near
    z, R = np.where(known[:, None], z, 0.0), np.where(known[:, None, None], R, 0.0)
    return Track(t, z, R, known, None if p is None else np.where(known[:, None], p, 0.0))


@dataclass(frozen=True)
class Window:
    """w and its first two derivatives by time."""

    w: Array
    w1: Array
    w2: Array


def window(valid: Mask, step: float, ramp_s: float, whole_s: float = 0.0) -> Window:
    """1 well inside every stretch of valid samples, falling to 0 over `ramp_s` at its ends, twice differentiable.

    `ramp_s` of 0 cuts sharply (no derivative is asked for then). Gaps up to `whole_s` are cut sharply, too.
    """
    w = valid.astype(np.float64)
    zero = np.zeros(len(w))
    if ramp_s <= 0:
        return Window(w, zero, zero)
    filled = _without_short_gaps(valid, round(whole_s / step))
    out = Window(zero.copy(), zero.copy(), zero.copy())
    for a, b in stretches(filled):
        x: Array = np.arange(b - a) * np.float64(step)
        u, u1, u2 = _ramp(x, ramp_s)
        v, v1, v2 = u[::-1], u1[::-1], u2[::-1]
        out.w[a:b] = u * v
        out.w1[a:b] = u1 * v - u * v1
        out.w2[a:b] = u2 * v - 2 * u1 * v1 + u * v2
    if not np.array_equal(filled, valid):
        for c in (out.w, out.w1, out.w2):
            c *= w
    return out


def _ramp(x: Array, length: float) -> tuple[Array, Array, Array]:
    """Minimum-jerk step over [0, length] and its derivatives."""
    s = np.clip(x / length, 0.0, 1.0)
    first = 30 * s**2 * (1 - s) ** 2 / length
    return s**3 * (10 - 15 * s + 6 * s * s), first, 60 * s * (1 - s) * (1 - 2 * s) / length**2


def stretches(valid: Mask) -> list[tuple[int, int]]:
    """Start and stop of every run of valid samples."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], valid, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def _without_short_gaps(valid: Mask, longest: int) -> Mask:
    filled = valid.copy()
    for a, b in stretches(~valid):
        if b - a <= longest and a > 0 and b < len(valid):
            filled[a:b] = True
    return filled


@dataclass(frozen=True)
class Band:
    """Frequencies 0 <= f <= f_max of an even grid and the share of each (both signs of f) in an integral over time."""

    f: Array
    share: Array
    n: int
    step: float

    def of(self, x: Array) -> Spectra:
        """Spectrum (F,) of `x` (N,)."""
        return np.asarray(np.fft.rfft(x, self.n)[: len(self.f)], dtype=np.complex128)

    @property
    def turn(self) -> Spectra:
        return np.asarray(2j * np.pi * self.f, dtype=np.complex128)


def band(track: Track, f_max: float) -> Band:
    """The band of `track` up to `f_max` Hz, padded with zeros to a length whose transform is fast."""
    n = _fast_length(len(track.t))
    f = np.asarray(np.fft.rfftfreq(n, track.step), dtype=np.float64)
    share = np.full(len(f), 2.0 / n)
    share[0] = share[-1] = 1.0 / n
    keep = f <= f_max
    return Band(f[keep], share[keep], n, track.step)


def _fast_length(least: int) -> int:
    """The smallest even number from `least` on without a prime factor above 5; large ones make transforms slow."""
    odd = (3**b * 5**c for b in range(16) for c in range(11))
    return min(m << max(1, (-(-least // m) - 1).bit_length()) for m in odd)


def products(track: Track, win: Window, b: Band, z: Array) -> Spectra:
    """Spectra (F, 3, 3, 3) of ``w R_ab z_c``."""
    out = np.empty((len(b.f), 3, 3, 3), dtype=complex)
    for i, j, k in np.ndindex(3, 3, 3):
        out[:, i, j, k] = b.of(win.w * track.R[:, i, j] * z[:, k])
    return out


def plain(x: Array, win: Window, b: Band) -> Spectra:
    """Spectra of ``w x``, `x` (N, ...)."""
    return _each(x, lambda c: b.of(win.w * c))


def second_derivative(x: Array, win: Window, b: Band) -> Spectra:
    """Spectra of ``w x''`` by (a)."""
    return _each(x, lambda c: b.turn**2 * b.of(win.w * c) - 2 * b.turn * b.of(win.w1 * c) + b.of(win.w2 * c))


def rate(track: Track, win: Window, b: Band) -> Spectra:
    """Spectra (F, 3) of ``w w_m``, w_m the angular rate in the laboratory's axes, by (b)."""
    both = track.valid[1:] & track.valid[:-1]
    turned = np.zeros((len(both), 3))
    turned[both] = so3.log(track.R[1:][both] @ np.swapaxes(track.R[:-1][both], 1, 2)) / track.step
    bend = np.gradient(turned, axis=0)  # change of the rate over dt
    turned = turned + np.cross(turned, bend) * track.step / 12  # Magnus' second term
    middle = (win.w[1:] + win.w[:-1]) / 2 * both
    mean = np.exp(b.turn * track.step / 2) * np.sinc(b.f * track.step)
    found = np.stack([b.of(middle * c) for c in turned.T], axis=-1) / mean[:, None]
    return np.asarray(found, dtype=np.complex128)


def _each(x: Array, transform: Callable[[Array], Spectra]) -> Spectra:
    flat = x.reshape(len(x), -1)
    return np.stack([transform(c) for c in flat.T], axis=-1).reshape(-1, *x.shape[1:])


def real_rows(rows: Spectra, weight: Array) -> Array:
    """(F, E, n) complex and weights (F,) of the squares -> (2 F E, n) real, for ordinary least squares."""
    scaled = rows * np.sqrt(weight)[:, None, None]
    return np.concatenate([scaled.real, scaled.imag]).reshape(-1, rows.shape[-1])


def gram(rows: Spectra, weight: Array) -> Array:
    """``sum over f of weight Re(rows^H rows)``, (n, n)."""
    A = real_rows(rows, weight)
    return A.T @ A


def smoothed(power: Array, freedom: Array, least: int, most: int) -> Array:
    """The spectrum behind `power`, sums of `freedom` squares: the mean of its logarithm over neighbours on either side.

    Logarithms, since spectra here rise with powers of f: what neighbours above and below have too much and too little
    then cancels. The window is a quarter of the frequency wide, from `least` to `most` neighbours, and goes on beyond
    f = 0 with the mirrored spectrum.
    """
    half = freedom / 2
    level = np.log(np.maximum(power, 1e-300) / freedom) - (_digamma(half) - np.log(half))
    weight = half**2 / (1 + half)  # about the inverse variance of the logarithm
    n = len(power)
    i = np.arange(n)
    width = np.minimum(np.clip(i // 4, least, most), n - 1 - i)

    def running(x: Array) -> Array:
        total = np.concatenate([[0.0], np.cumsum(np.concatenate([x[:0:-1], x]))])
        middle = n - 1 + i
        return total[middle + width + 1] - total[np.maximum(middle - width, 0)]

    return np.exp(running(weight * level) / running(weight))


def _digamma(x: Array) -> Array:
    """Derivative of the logarithm of the gamma function: six steps up, then Stirling's series."""
    shift = sum((1 / (x + k) for k in range(6)), np.zeros_like(x))
    y = x + 6
    return np.log(y) - 1 / (2 * y) - 1 / (12 * y**2) + 1 / (120 * y**4) - shift
