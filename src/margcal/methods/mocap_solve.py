"""The equations of `mocap_fit` solved: accelerometer and magnetometer in the laboratory, the gyroscope in the body.

Names and equation numbers are those of `mocap_fit`, windows and spectra those of `mocap_spectra`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from margcal.core import lsq
from margcal.core.errors import DataError
from margcal.core.types import Array
from margcal.methods import mocap_spectra as ms

FORWARD_HZ, GYRO_HZ = 6.0, 12.0
"""Ends of the bands of `forward` and `gyroscope`: beyond them the optics' noise leaves nothing."""
RAMPS_S = (1.0, 0.5, 0.25)
"""Fall of the window before a gap, where derivatives are taken: the longest that leaves most of the recording."""
LOWPASS_RAMPS_S = (4.0, 2.0, 1.0, 0.5)
KEPT = 0.7
CLEAR = 60.0
"""Second eigenvalue over the smallest, from which `lowpass_svd` trusts its formal errors (see `_crowded`)."""
LOWPASS_END_HZ = 2.0
LEAST_BINS = 2
"""Neighbours on either side over which the residual's spectrum is averaged, at the low end."""
ROUNDS = 6
BAD = 3.0
"""Misfit, in upper deciles of the misfit, from which a moment is left out (`forward`, `gyroscope`)."""
HUBER = 2.0
"""Misfit, in typical misfits, from which a moment counts less."""


@dataclass(frozen=True)
class Scaled:
    """z = centre + size z', z' of about unit length."""

    z: Array
    centre: Array
    size: float


def _scaled(track: ms.Track) -> Scaled:
    z = track.z[track.valid]
    centre = np.median(z, axis=0)
    size = float(np.sqrt(np.mean(np.sum((z - centre) ** 2, axis=1))))
    if not size > 0:
        raise DataError("the readings do not change at all: the sensor is stuck, or the node was not moved")
    return Scaled(np.where(track.valid[:, None], (track.z - centre) / size, 0.0), centre, size)


@dataclass(frozen=True)
class Solved:
    """x in the units of z' and of the length; `C` its covariance; `scaled`, `length` lead back to raw units."""

    x: Array
    C: Array
    track: ms.Track
    scaled: Scaled
    length: float
    residual: Array
    weights: Array
    cost: float
    condition: float
    n_iter: int
    crowded: bool = False
    """The linear acceleration is not small beside what the frequencies used show of H: the errors are widened."""
    late: tuple[float, float] | None = None
    """How much later the readings are than their times say, to first order, and its standard error (`_late`)."""


def _force_rows(track: ms.Track, scaled: Scaled, win: ms.Window, b: ms.Band) -> ms.Spectra:
    """Rows (F, 3, 15) of ``R (H z - o) - f``."""
    rows = np.zeros((len(b.f), 3, 15), dtype=complex)
    P, Rw, one = ms.products(track, win, b, scaled.z), ms.plain(track.R, win, b), b.of(win.w)
    for a in range(3):
        rows[:, a, :9] = P[:, a].reshape(-1, 9)
        rows[:, a, 9:12] = -Rw[:, a]
        rows[:, a, 12 + a] = -one
    return rows


def homogeneous(track: ms.Track, length: float, nominal: Array | None, cutoff: float | None) -> Solved:
    """``rows @ x = 0`` with |H K| fixed, then scaled to |f| = 1.

    With `cutoff` (accelerometer) frequencies are weighted: first a Butterworth filter of fourth order, forwards and
    backwards, then the inverse of the residual's spectrum, which is that of the linear acceleration. Without
    (magnetometer) moments are: Huber's weights.
    """
    scaled = _scaled(track)
    if cutoff is None:
        win, n = _huber_window(track, scaled)
        b = ms.band(track, np.inf)
        weight, again = np.ones(len(b.f)), 0
    else:
        win, n = ms.window(track.valid, track.step, _ramp(track, LOWPASS_RAMPS_S, 0.1), 0.1), 0
        b = ms.band(track, LOWPASS_END_HZ)
        weight, again = (1 + (b.f / cutoff) ** 8) ** -2.0, ROUNDS - 1
    rows = _force_rows(track, scaled, win, b)
    x, inverse = _smallest(ms.gram(rows, b.share * weight), n_inner=4)
    for _ in range(again):
        S = _spectrum(rows @ x, rows, b, weight, inverse)
        weight = np.min(S) / S
        x, inverse = _smallest(ms.gram(rows, b.share * weight), n_inner=4)
    H = x[:9].reshape(3, 3)
    if (np.linalg.det(H) if nominal is None else np.sum(H * nominal)) < 0:
        x = -x
    C = _sandwich(rows @ x, rows, b, weight, inverse, np.sum(win.w**2))
    crowded, shift = (False, np.zeros((15, 15))) if cutoff is None else _crowded(ms.gram(rows, b.share * weight), x)
    late = None if cutoff is None else _late(track, scaled, win, b, rows, rows @ x, x, weight, inverse)
    x, C = _to_unit_length(x, C + shift)
    cost = float(np.sum(b.share * weight * np.sum(np.abs(rows @ x) ** 2, axis=1)))
    misfit = np.where(track.valid, _force_misfit(track, scaled, x), np.nan)
    condition = _condition(ms.gram(rows, b.share * weight)[:12, :12])
    return Solved(x, C, track, scaled, length, misfit * length, win.w, cost, condition, n + again + 1, crowded, late)


def _huber_window(track: ms.Track, scaled: Scaled) -> tuple[ms.Window, int]:
    """Roots of Huber's weights of every moment, and the rounds that it took; all frequencies alike, so in time."""
    R, z = track.R[track.valid], scaled.z[track.valid]
    rows = np.zeros((len(z), 3, 15))
    rows[:, :, :9] = (R[:, :, :, None] * z[:, None, None, :]).reshape(-1, 3, 9)
    rows[:, :, 9:12] = -R
    rows[:, :, 12:] = -np.eye(3)
    w, moved, n = np.ones(len(z)), 1.0, 0
    while moved > 1e-3 and n < ROUNDS:
        A = (rows * w[:, None, None]).reshape(-1, 15)
        x = _smallest(A.T @ A, n_inner=4)[0]
        misfit = np.linalg.norm(rows @ x, axis=1)
        new = np.sqrt(lsq.huber_weights(misfit, _typical(misfit), HUBER))
        moved, w, n = float(np.max(np.abs(new - w))), new, n + 1
    full = np.zeros(len(track.t))
    full[track.valid] = w
    return ms.Window(full, 0 * full, 0 * full), n


def _ramp(track: ms.Track, ramps: tuple[float, ...], whole_s: float = 0.0) -> float:
    """The longest ramp that still leaves most of the recording: what is cut off sharply leaks into low frequencies."""
    for ramp in ramps:
        if np.sum(ms.window(track.valid, track.step, ramp, whole_s).w ** 2) > KEPT * np.sum(track.valid):
            return ramp
    return ramps[-1]


def _smallest(M: Array, n_inner: int) -> tuple[Array, Array]:
    """x that minimises ``x' M x`` with |H K|_F = const, K = H^-1, and the inverse of the curvature across x.

    Noise n of z enters (i) as R H n: its part of x' M x is proportional to |H S|^2 with S the noise's root. S is
    taken as K: equal noise of the calibrated axes, wherever the scale of the axes differs.
    """
    A, B, D = M[:9, :9], M[:9, 9:], M[9:, 9:]
    back = -np.linalg.solve(D, B.T)  # o and f for a given H
    S = A + B @ back
    N, h = np.eye(9), np.zeros(9)
    smallest = 0.0
    for _ in range(n_inner):
        L = np.linalg.cholesky(N)
        half = np.linalg.solve(L, np.linalg.solve(L, S).T).T
        values, vectors = np.linalg.eigh((half + half.T) / 2)
        h, smallest = np.linalg.solve(L.T, vectors[:, 0]), float(values[0])
        H = h.reshape(3, 3)
        if np.linalg.cond(H) > 1e6:
            break
        K = np.linalg.inv(H) * np.cbrt(abs(np.linalg.det(H)))
        N = np.kron(np.eye(3), K @ K.T)
    x: Array = np.zeros(15)
    x[:9], x[9:] = h, back @ h
    curvature = np.array(M, dtype=np.float64)
    curvature[:9, :9] -= smallest * N
    return x, _inverse_across(curvature, x)


def _crowded(M: Array, x: Array) -> tuple[bool, Array]:
    """Is the residual's part of ``x' M x`` no longer small beside the next eigenvalue, and the covariance to add then?

    The residual counts as noise of the regressors that does not depend on the attitude. A hand's and a leg's
    acceleration does, and H is then off by up to the ratio of the two, however long the recording: 8 % on BROAD 21 and
    14 % on 29, where the ratio is 7, below 1 % where it is above 100.
    """
    A, B, D = M[:9, :9], M[:9, 9:], M[9:, 9:]
    back = -np.linalg.solve(D, B.T)
    values, vectors = np.linalg.eigh(A + B @ back)
    if values[1] > CLEAR * values[0]:
        return False, np.zeros((15, 15))
    part = values[0] / np.maximum(values[1:] - values[0], 1e-3 * values[0])
    directions = np.concatenate([vectors[:, 1:], back @ vectors[:, 1:]]) * part * np.linalg.norm(x[:9])
    return True, directions @ directions.T


def _late(
    track: ms.Track,
    scaled: Scaled,
    win: ms.Window,
    b: ms.Band,
    rows: ms.Spectra,
    residual: ms.Spectra,
    x: Array,
    weight: Array,
    inverse: Array,
) -> tuple[float, float]:
    """One Gauss-Newton step for the delay d in ``R (H z(t + d) - o)``, along with x, and its standard error."""
    slope = np.zeros_like(scaled.z)
    inner = np.flatnonzero(track.valid[2:] & track.valid[1:-1] & track.valid[:-2]) + 1
    slope[inner] = (scaled.z[inner + 1] - scaled.z[inner - 1]) / (2 * track.step)
    turned = np.einsum("nij,nj->ni", track.R, slope @ x[:9].reshape(3, 3).T)
    column = ms.plain(turned, win, b)
    both = np.concatenate([rows, column[:, :, None]], axis=2)
    M = ms.gram(both, b.share * weight)
    along = np.append(-inverse @ M[:-1, -1], 1.0)  # what x does while d moves
    curvature = float(M[-1] @ along)
    gradient = float(np.sum((b.share * weight)[:, None] * (np.conj(column) * residual).real))
    S = _spectrum(residual, rows, b, weight, inverse) / np.sum(win.w**2)
    variance = along @ ms.gram(both, b.share * weight**2 * S) @ along
    return -gradient / curvature, float(np.sqrt(variance)) / curvature


def _inverse_across(curvature: Array, x: Array) -> Array:
    """Inverse of a symmetric matrix on the complement of x."""
    Z: Array = np.linalg.svd(x[None, :])[2][1:].T
    inverse = np.asarray(np.linalg.pinv(Z.T @ curvature @ Z, rcond=1e-13, hermitian=True), dtype=np.float64)
    return Z @ inverse @ Z.T


def _to_unit_length(x: Array, C: Array) -> tuple[Array, Array]:
    """Scaled so that x[12:15] has length one, and the covariance with it."""
    size = float(np.linalg.norm(x[12:15]))
    x = x / size
    J = np.eye(15)
    J[:, 12:15] -= np.outer(x, x[12:15])
    J /= size
    return x, J @ C @ J.T


def _force_misfit(track: ms.Track, scaled: Scaled, x: Array) -> Array:
    """|R (H z - o) - f| of every sample."""
    u = scaled.z @ x[:9].reshape(3, 3).T - x[9:12]
    return np.linalg.norm(np.einsum("nij,nj->ni", track.R, u) - x[12:15], axis=1)


def with_positions(track: ms.Track, gravity: float, lever: bool) -> Solved:
    """(ii) by weighted least squares, |f| = 1 held by a multiplier; bad moments held down."""
    if track.p is None:
        raise DataError("`forward` needs the positions of the marker body; without them take `lowpass-svd`")
    scaled = _scaled(track)
    p = (track.p - np.mean(track.p[track.valid], axis=0)) / gravity
    ramp = _ramp(track, RAMPS_S)
    base = ms.window(track.valid, track.step, ramp)
    b = ms.band(track, FORWARD_HZ)
    win, n = base, 0
    n_x = 18 if lever else 15
    x, inverse, power = np.zeros(n_x), np.eye(n_x), np.ones(len(b.f))
    rows, target = _position_rows(track, scaled, p, win, b, gravity, lever)
    noise = _lever_noise(track, win, b, gravity)
    weight = 1 / (1 + b.f**4) ** 2
    for n in range(ROUNDS):
        x, inverse = _constrained(rows, target, b.share * weight, noise)
        residual = rows @ x - target
        power = _two_part_power(b, residual, 4)
        new_weight = power[0] / power
        moved = np.max(np.abs(new_weight - weight))
        weight = new_weight
        if n == 2:
            win = _held_down(base, b, residual * np.sqrt(weight)[:, None], track, ramp)
            if win is not base:
                rows, target = _position_rows(track, scaled, p, win, b, gravity, lever)
        elif moved < 1e-3 and n > 3:
            break
    x = _upright(x, rows, target, b.share * weight)
    residual = rows @ x - target
    C = _sandwich(residual, rows, b, weight, inverse, np.sum(win.w**2))
    misfit = _in_time(residual * np.sqrt(weight)[:, None], b, len(track.t))
    misfit = np.where(track.valid, np.linalg.norm(misfit, axis=1), np.nan)
    cost = float(np.sum(b.share * weight * np.sum(np.abs(residual) ** 2, axis=1)))
    condition = _condition(ms.gram(rows, b.share * weight))
    late = _late(track, scaled, win, b, rows, residual, x, weight, inverse)
    return Solved(x, C, track, scaled, gravity, misfit * gravity, win.w, cost, condition, n + 1, late=late)


def _upright(x: Array, rows: ms.Spectra, target: ms.Spectra, weight: Array) -> Array:
    """The solution with det H > 0 where the data do not mind.

    Without acceleration (H, o, f) and (-H, -o, -f) fit alike: only accelerations, known with their sign, tell.
    """
    if np.linalg.det(x[:9].reshape(3, 3)) > 0:
        return x
    flipped = np.concatenate([-x[:15], x[15:]])

    def cost(v: Array) -> float:
        return float(np.sum(weight * np.sum(np.abs(rows @ v - target) ** 2, axis=1)))

    return flipped if cost(flipped) < 1.5 * cost(x) else x


def _position_rows(
    track: ms.Track, scaled: Scaled, p: Array, win: ms.Window, b: ms.Band, gravity: float, lever: bool
) -> tuple[ms.Spectra, ms.Spectra]:
    """Rows (F, 3, 15 or 18) and target (F, 3) of ``R (H z - o) - f - R'' r = p''``."""
    rows = _force_rows(track, scaled, win, b)
    if lever:
        rows = np.concatenate([rows, -ms.second_derivative(track.R, win, b) / gravity], axis=2)
    return rows, ms.second_derivative(p, win, b)


def _lever_noise(track: ms.Track, win: ms.Window, b: ms.Band, gravity: float) -> Array:
    """Power (F,) of the optics' noise in a column of R'', of all three equations.

    Unlike that of p'' it is noise of a regressor: it would shorten the lever arm. It is white in R, so the quietest
    part of the band above a hand's motion shows it.
    """
    high = ms.band(track, min(20.0, 0.3 / track.step))
    bend = (
        np.abs(ms.second_derivative(track.R, win, high)) ** 2 / np.maximum(np.abs(high.turn), 1.0)[:, None, None] ** 4
    )
    parts = np.array_split(bend[high.f > 4.0], 8)
    return 3 * min(float(np.median(part)) for part in parts) / np.log(2) * np.abs(b.turn) ** 4 / gravity**2


def _constrained(rows: ms.Spectra, target: ms.Spectra, weight: Array, noise: Array) -> tuple[Array, Array]:
    """Least squares with |x[12:15]| = 1, and the inverse of the curvature on the constraint.

    `noise` (F,) is the power of noise in each of the columns from the 15th on.
    """
    A = ms.real_rows(rows, weight)
    y = ms.real_rows(target[:, :, None], weight)[:, 0]
    M, g = A.T @ A, A.T @ y
    if len(g) > 15:
        known = M[15:, 15:] - M[15:, :15] @ np.linalg.lstsq(M[:15, :15], M[:15, 15:], rcond=None)[0]
        M[15:, 15:] -= min(float(weight @ noise), 0.3 * float(np.linalg.eigvalsh(known)[0])) * np.eye(3)
    scale = np.sqrt(np.diag(M))
    M, g = M / np.outer(scale, scale), g / scale
    rest = np.r_[0:12, 15 : len(g)]
    f = np.r_[12:15]
    back = np.linalg.solve(M[np.ix_(rest, rest)], np.column_stack([M[np.ix_(rest, f)], g[rest]]))
    Q = M[np.ix_(f, f)] - M[np.ix_(f, rest)] @ back[:, :3]
    q = g[f] - M[np.ix_(f, rest)] @ back[:, 3]
    # |f| = 1 in the scaled unknowns: f_s = scale f
    s = scale[f]
    direction, multiplier = _on_sphere(Q * np.outer(s, s), q * s)
    x = np.empty(len(g))
    x[f] = direction * s
    x[rest] = back[:, 3] - back[:, :3] @ x[f]
    x /= scale
    curvature = M * np.outer(scale, scale)
    curvature[12:15, 12:15] += multiplier * np.eye(3)
    normal = np.zeros(len(g))
    normal[12:15] = direction
    return x, _inverse_across(curvature, normal)


def _on_sphere(Q: Array, q: Array) -> tuple[Array, float]:
    """Unit v that minimises ``v' Q v - 2 q' v`` and the multiplier m of ``(Q + m) v = q``."""
    values, V = np.linalg.eigh((Q + Q.T) / 2)
    c = V.T @ q
    low = -values[0] + 1e-14 * max(values[-1], 1e-300)
    high = -values[0] + np.linalg.norm(q) + 1e-300
    for _ in range(200):
        m = (low + high) / 2
        if np.sum((c / (values + m)) ** 2) > 1:
            low = m
        else:
            high = m
    v = V @ (c / (values + high))
    return v / np.linalg.norm(v), float(high)


def rates(track: ms.Track) -> Solved:
    """(iii) by weighted least squares."""
    scaled = _scaled(track)
    ramp = _ramp(track, RAMPS_S)
    base = ms.window(track.valid, track.step, ramp)
    b = ms.band(track, GYRO_HZ)
    win, n = base, 0
    rows, target = _rate_rows(track, scaled, win, b)
    x, inverse, weight = np.zeros(12), np.eye(12), 1 / (1 + (b.f / 2.0) ** 2)
    for n in range(ROUNDS):
        A, y = ms.real_rows(rows, b.share * weight), ms.real_rows(target[:, :, None], b.share * weight)[:, 0]
        solution = lsq.linear(A, y)
        x, inverse = solution.x, solution.cofactor
        residual = rows @ x - target
        power = _two_part_power(b, residual, 2)
        new_weight = power[0] / power
        moved = np.max(np.abs(new_weight - weight))
        weight = new_weight
        if n == 2:
            win = _held_down(base, b, residual * np.sqrt(weight)[:, None], track, ramp)
            if win is not base:
                rows, target = _rate_rows(track, scaled, win, b)
        elif moved < 1e-3 and n > 3:
            break
    residual = rows @ x - target
    C = _sandwich(residual, rows, b, weight, inverse, np.sum(win.w**2))
    misfit = _in_time(residual * np.sqrt(weight)[:, None], b, len(track.t))
    misfit = np.where(track.valid, np.linalg.norm(misfit, axis=1), np.nan)
    cost = float(np.sum(b.share * weight * np.sum(np.abs(residual) ** 2, axis=1)))
    condition = _condition(ms.gram(rows, b.share * weight))
    return Solved(x, C, track, scaled, 1.0, misfit, win.w, cost, condition, n + 1)


def _rate_rows(track: ms.Track, scaled: Scaled, win: ms.Window, b: ms.Band) -> tuple[ms.Spectra, ms.Spectra]:
    """Rows (F, 3, 12) and target (F, 3) of ``R (H z - o) = w_m``."""
    return _force_rows(track, scaled, win, b)[:, :, :12], ms.rate(track, win, b)


# --- what they share ---------------------------------------------------------------------------------


def _two_part_power(b: ms.Band, residual: ms.Spectra, order: int) -> Array:
    """Power (F,) of the residual as ``c0 + c f^order``: the sensor's white noise and the optics' after (a) or (b).

    Whittle's likelihood by a few reweighted least squares; neither part may be negative.
    """
    power = np.mean(np.abs(residual) ** 2, axis=1)
    relative = (b.f / b.f[-1]) ** order
    model = np.full(len(b.f), np.median(power))
    floor = 1e-6 * float(np.mean(power)) + 1e-300
    for _ in range(12):
        A = np.column_stack([np.ones(len(b.f)), relative]) / model[:, None]
        c = np.linalg.lstsq(A, power / model, rcond=None)[0]
        if c[1] <= 0:
            c = np.array([np.sum(power / model**2) / np.sum(1 / model**2), 0.0])
        elif c[0] <= 0:
            c = np.array([floor, np.sum(power * relative / model**2) / np.sum(relative**2 / model**2)])
        model = np.maximum(c[0] + c[1] * relative, floor)
    return model


def _spectrum(residual: ms.Spectra, rows: ms.Spectra, b: ms.Band, weight: Array, inverse: Array) -> Array:
    """Power (F,) of one component of the residual, averaged over components and neighbouring frequencies, for what
    freedom the fit has left it."""
    A = rows * np.sqrt(b.share * weight)[:, None, None]
    leverage = np.einsum("fen,nm,fem->f", A.conj(), inverse, A).real
    double = np.where(b.share > 1.5 / b.n, 2.0, 1.0)  # a complex value holds two
    freedom = np.maximum(3 * double - leverage, 0.1)
    power = np.sum(np.abs(residual) ** 2, axis=1) * double
    return ms.smoothed(power, freedom, LEAST_BINS, max(LEAST_BINS, len(b.f) // 20))


def _sandwich(residual: ms.Spectra, rows: ms.Spectra, b: ms.Band, weight: Array, inverse: Array, used: float) -> Array:
    """Covariance of x: ``inverse (sum of weight^2 S rows^H rows) inverse``, S the residual's spectrum.

    `used` is the sum of the squared window.
    """
    S = _spectrum(residual, rows, b, weight, inverse) / used
    return inverse @ ms.gram(rows, b.share * weight**2 * S) @ inverse


def _held_down(base: ms.Window, b: ms.Band, residual: ms.Spectra, track: ms.Track, ramp: float) -> ms.Window:
    """The window with moments of large misfit taken down, smoothly."""
    misfit = np.linalg.norm(_in_time(residual, b, len(track.t)), axis=1)
    # the upper decile, not the median: between rests the misfit of motion is no fault
    bad = misfit > BAD * np.percentile(misfit[base.w > 0.5], 90)
    if not bad.any():
        return base
    return ms.window(track.valid & ~bad, track.step, min(ramp, 0.25))


def _in_time(spectrum: ms.Spectra, b: ms.Band, n: int) -> Array:
    full = np.zeros((b.n // 2 + 1, spectrum.shape[1]), dtype=complex)
    full[: len(b.f)] = spectrum
    return np.fft.irfft(full, b.n, axis=0)[:n]


def _typical(length: Array) -> float:
    """Root mean square of the bulk of lengths of three components."""
    return float(np.median(length)) * 1.13  # median of chi with 3 degrees of freedom is 1.538, its rms 1.732


def _condition(M: Array) -> float:
    scale = np.sqrt(np.maximum(np.diag(M), 1e-300))
    values = np.linalg.eigvalsh(M / np.outer(scale, scale))
    return float(np.sqrt(values[-1] / values[0])) if values[0] > 0 else float("inf")
