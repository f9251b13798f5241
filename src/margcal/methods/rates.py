"""How a direction sensor and a gyroscope lie to each other, and which of them is late, from the motion alone.

Not in the papers. A vector v fixed in the laboratory turns in the node's axes by ``v' = -u x v = [v]x u`` with the
rate ``u = G z + c``, z the gyroscope's raw reading (`gyro_start` has the derivation). Integrated from a to b along
the measured v, and with the sensor a time d behind the gyroscope,

    v(b) - v(a) = integral over s in (a, b) of  [v(s)]x (G z(s - d) + c)  ds                                  (i)

which is exact, linear in the nine entries of G and in the gyroscope's bias c, and nearly so in d. No scale, no axis
order, no attitude and no rest need be known.

What (i) cannot tell: v and -v obey it alike, so a sensor whose three axes are all reversed looks right, and one with
one mirrored axis looks turned by 180 degrees. det G < 0 is proof that the gyroscope's own triad is left-handed.

=============  ===========================================================  =========
name here      meaning                                                      shape
=============  ===========================================================  =========
G              takes raw gyroscope readings to rates in the sensor's axes   (3, 3)
c              rate by which the gyroscope's bias was wrong, rad/s          (3,)
d              delay of the sensor behind the gyroscope, s                  scalar
=============  ===========================================================  =========
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from margcal.core import so3
from margcal.core.errors import DataError
from margcal.core.types import Array

WINDOW_S = 0.2
"""Length of (a, b). Measured on BROAD: from 0.15 to 0.5 s the delay moves by less than its standard error."""
MOST_SAMPLES = 12000
"""Samples of the sensor that are used; longer streams are thinned."""
MIN_WINDOWS = 20
BLOCKS = 12
"""Contiguous parts of the recording that are left out in turn: what lasts for many samples is not averaged away."""
GAP_S = 0.25
"""A window with a hole longer than this is left out."""
STEP_S = 0.002
"""Half step of the derivative by d."""
ROUNDS = 6


@dataclass(frozen=True)
class RateRelation:
    """What (i) says.

    Attributes
    ----------
    G : ndarray (3, 3), rad/s per raw unit
    replicas : ndarray (BLOCKS, 3, 3)
        G without one part of the recording each.
    explained : float
        Share of the squared changes of v that (i) accounts for.
    delay_s, delay_se_s : float
        Delay of the sensor behind the gyroscope, and its standard error by leaving parts out: on the safe side by a
        factor of two where the sensor's noise is white (neighbouring windows share a reading, whose noise cancels
        but where a part was cut out).
    """

    G: Array
    replicas: Array
    explained: float
    delay_s: float
    delay_se_s: float


def relate(t: Array, v: Array, t_gyr: Array, z: Array, *, rounds: int = 4) -> RateRelation:
    """G and the delay from sensor and gyroscope on clocks of their own.

    Parameters
    ----------
    t, v : ndarray (N,) s, (N, 3)
        The sensor without its bias, about one long.
    t_gyr, z : ndarray (M,) s, (M, 3) raw unit
        The gyroscope without its bias, as far as it is known.
    rounds : int
        Of Gauss-Newton on d.

    Raises
    ------
    DataError
        If there is too little motion in common.
    """
    windows = _cut(t, v, t_gyr, z)
    d, D = 0.0, None
    weight = np.ones(len(windows.change))
    x, solved, full = np.zeros(12), np.zeros(13), np.empty((0, 3, 13))
    for k in range(rounds):
        rows = windows.rows(d)
        if D is None:
            x, weight = _robust(rows, windows.change, weight)
        D = (windows.rows(d + STEP_S) - windows.rows(d - STEP_S)) / (2 * STEP_S) @ x
        full = np.concatenate([rows, D[:, :, None]], axis=2)
        solved, _ = _robust(full, windows.change, weight, rounds=2)
        x, step = solved[:12], float(np.clip(solved[12], -0.05, 0.05))
        d += step
        if abs(step) < 1e-5 or k == rounds - 1:
            break
    miss = windows.change - full @ solved
    replicas = _left_out(full, windows.change, weight)
    spread = np.std(replicas[:, 12]) * np.sqrt(len(replicas) - 1)
    total = float(np.sum(weight[:, None] ** 2 * windows.change**2))
    explained = 1 - float(np.sum((weight[:, None] * miss) ** 2)) / max(total, 1e-300)
    return RateRelation(x[:9].reshape(3, 3), replicas[:, :9].reshape(-1, 3, 3), explained, d, float(spread))


@dataclass(frozen=True)
class _Windows:
    """(i) on a grid: `s` times (K, n+1), `middle` v between them (K, n, 3), `change` v(b) - v(a) (K, 3)."""

    s: Array
    middle: Array
    change: Array
    bias_rows: Array
    t_gyr: Array
    angle: Array  # integral of z from the start to t_gyr

    def rows(self, d: float) -> Array:
        """(K, 3, 12): entries of G row by row, then c."""
        turned = np.stack([np.interp(self.s - d, self.t_gyr, self.angle[:, k]) for k in range(3)], axis=-1)
        moment = np.swapaxes(self.middle, -1, -2) @ np.diff(turned, axis=1)  # sum of v_a z_q ds
        rows = np.zeros((len(self.s), 3, 3, 3))
        for i, p, a in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):  # [v]x_ip = -eps_ipa v_a
            rows[:, i, p], rows[:, p, i] = -moment[:, a], moment[:, a]
        return np.concatenate([rows.reshape(-1, 3, 9), self.bias_rows], axis=2)


def _cut(t: Array, v: Array, t_gyr: Array, z: Array) -> _Windows:
    inside = (t > t_gyr[0] + 0.1) & (t < t_gyr[-1] - 0.1)
    t, v = t[inside], v[inside]
    thin = max(1, len(t) // MOST_SAMPLES)
    t, v = t[::thin], v[::thin]
    if len(t) < 2 * MIN_WINDOWS:
        raise DataError("the sensors have too little time in common to be compared")
    n = max(2, round(WINDOW_S * (len(t) - 1) / (t[-1] - t[0])))
    index = np.arange(0, len(t) - n, n)[:, None] + np.arange(n + 1)
    s, w = t[index], v[index]
    good = np.max(np.diff(s, axis=1), axis=1) < GAP_S
    if good.sum() < MIN_WINDOWS:
        raise DataError("the sensors have too little time in common to be compared")
    s, w = s[good], w[good]
    middle = (w[:, 1:] + w[:, :-1]) / 2
    bias_rows = so3.skew(np.einsum("kna,kn->ka", middle, np.diff(s, axis=1)))
    angle = np.zeros((len(t_gyr), 3))
    np.cumsum((z[1:] + z[:-1]) / 2 * np.diff(t_gyr)[:, None], axis=0, out=angle[1:])
    return _Windows(s, middle, w[:, -1] - w[:, 0], bias_rows, t_gyr, angle)


def _robust(A: Array, b: Array, weight: Array, rounds: int = ROUNDS) -> tuple[Array, Array]:
    """Huber's reweighted least squares over blocks of three rows (K, 3, n)."""
    x = np.zeros(A.shape[2])
    for _ in range(rounds):
        x = _solve(*_normal(A, b, weight))
        miss = np.linalg.norm(A @ x - b, axis=1)
        limit = 2 * np.median(miss) + 1e-300
        weight = np.minimum(1.0, np.sqrt(limit / np.maximum(miss, 1e-300)))
    return x, weight


def _normal(A: Array, b: Array, weight: Array) -> tuple[Array, Array]:
    rows = (A * weight[:, None, None]).reshape(-1, A.shape[2])
    return rows.T @ rows, rows.T @ (b * weight[:, None]).ravel()


def _solve(N: Array, g: Array) -> Array:
    """Least squares from normal equations, columns scaled; what they leave open is zero."""
    d = np.sqrt(np.maximum(np.diag(N), 1e-300))
    return np.linalg.pinv(N / np.outer(d, d), rcond=1e-12, hermitian=True) @ (g / d) / d


def _left_out(A: Array, b: Array, weight: Array) -> Array:
    """Solutions (BLOCKS, n) without one part of the windows each."""
    parts = [_normal(A[k], b[k], weight[k]) for k in np.array_split(np.arange(len(A)), BLOCKS)]
    N, g = sum(p[0] for p in parts), sum(p[1] for p in parts)
    return np.array([_solve(N - p[0], g - p[1]) for p in parts])
