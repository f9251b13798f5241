"""Starts for the gyroscope's H that need no nominal scale and no axis order, and turns recognised as full ones.

Not from the papers. `linear_start` rests on the rate of change of a vector fixed in the laboratory as the
node sees it: from v_h = R_nh^T v_n and d/dt R_nh = R_nh [u]x follows d/dt v_h = -u x v_h = [v_h]x u, which is
linear in the nine entries of H when v_h is measured along the turn (the accelerometer does, apart from the
motion's own acceleration). Raw counts of unknown scale, permuted and mirrored axes are all the same to it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from margcal.core import so3
from margcal.core.errors import DataError
from margcal.core.types import Array, Turn
from margcal.methods.preintegration import TurnBatch, integrate, pad, rotation_vectors

_ROUNDS = 15  # of reweighting; the weights settle within ten


def linear_start(
    turns: Sequence[Turn] | TurnBatch,
    along: ArrayLike,
    *,
    B: ArrayLike | None = None,
    before: ArrayLike | None = None,
    after: ArrayLike | None = None,
    windows: int = 4,
) -> Array:
    """H of the gyroscope in closed form from a direction followed along the turns.

    Parameters
    ----------
    turns : sequence of Turn, or TurnBatch of (T, N, 3)
    along : array_like (T, N, 3)
        The direction (any length) in the node frame at each sample: the calibrated accelerometer,
        interpolated (`preintegration.along`).
    B : array_like (3,), raw unit, default 0
        Bias of the gyroscope (`mean_bias`).
    before, after : array_like (T, 3) or (T, M, 3), optional
        The direction at rest at both ends, where it is known better than from the first and last sample; of
        several (M) the first is taken.
    windows : int
        Each turn is also cut in so many pieces, for more equations.

    Returns
    -------
    ndarray (3, 3), rad/s per raw unit
        A start, biased by a few per cent by the motion's acceleration; not an estimate.

    Raises
    ------
    DataError
        If the turns do not determine nine entries.
    """
    batch = pad(turns)
    z = batch.y - (np.zeros(3) if B is None else np.asarray(B, dtype=np.float64))
    v = _unit(np.asarray(along, dtype=np.float64))
    lengths = (batch.dt > 0).sum(axis=1)
    whole = np.ones(len(batch), dtype=int) * v.shape[1]
    rows = [_rate_rows(v, z, batch.dt, 0 * whole, whole)]
    change = [_ends(after, v[:, -1]) - _ends(before, v[:, 0])]
    for part in range(windows if windows > 1 else 0):
        start, stop = lengths * part // windows, np.maximum(lengths * (part + 1) // windows, 1)
        rows.append(_rate_rows(v, z, batch.dt, start, stop))
        change.append(_between(v, stop, lengths, after) - _between(v, start, lengths, before))
    A, b = np.concatenate(rows), np.concatenate(change)
    # the pieces carry the motion's acceleration at their ends, the whole turns do not
    weight = np.concatenate([np.ones(len(batch)), np.full(len(A) - len(batch), 0.3)])
    return _robust_rows(A, b, weight).reshape(3, 3)


def _rate_rows(v: Array, z: Array, dt: Array, start: Array, stop: Array) -> Array:
    """Rows (T, 3, 9) of ``sum [v]x H z dt`` over samples start <= n < stop, for H row by row."""
    index = np.arange(v.shape[1])
    inside = (index >= start[:, None]) & (index < stop[:, None])
    moment = np.swapaxes(v, -1, -2) @ (z * np.where(inside, dt, 0.0)[..., None])  # sum v_a z_q dt
    # [v]x_ip = -eps_ipa v_a: row i, entry p of H's rows, q of its columns
    rows = np.zeros((len(v), 3, 3, 3))
    for i, p, a in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        rows[:, i, p], rows[:, p, i] = -moment[:, a], moment[:, a]
    return rows.reshape(len(v), 3, 9)


def _ends(given: ArrayLike | None, fallback: Array) -> Array:
    if given is None:
        return fallback
    rest = np.asarray(given, dtype=np.float64)
    rest = _unit(rest[:, 0] if rest.ndim == 3 else rest)
    return np.where(np.isfinite(rest), rest, fallback)


def _between(v: Array, at: Array, lengths: Array, end: ArrayLike | None) -> Array:
    """The direction at the border before sample `at` (T,): half way, or that at rest at the turn's ends."""
    rows = np.arange(len(v))
    left, right = v[rows, np.maximum(at - 1, 0)], v[rows, np.minimum(at, lengths - 1)]
    middle = _unit(left + right)
    outer = (at <= 0) | (at >= lengths)
    return np.where(outer[:, None], _ends(end, middle), middle)


def _robust_rows(A: Array, b: Array, weight: Array) -> Array:
    """Huber's reweighted least squares over blocks of three rows, columns scaled."""
    length = np.linalg.norm(A, axis=(0, 1))
    if not np.all(length > 0):
        raise DataError("the gyroscope has an axis that never moves in any turn; turn the node about every axis")
    A = A / length
    w = weight.copy()
    x = np.zeros(9)
    for _ in range(_ROUNDS):
        rows = (A * w[:, None, None]).reshape(-1, 9)
        x, _, rank, _ = np.linalg.lstsq(rows, (b * w[:, None]).ravel(), rcond=1e-9)
        if rank < 9:
            raise DataError(
                "the turns do not determine the gyroscope's nine entries; turn about at least three axes, "
                "most of them not vertical"
            )
        miss = np.linalg.norm(A @ x - b, axis=-1) * weight
        limit = 1.5 * np.median(miss) + 1e-12
        w = weight * np.minimum(1.0, np.sqrt(limit / np.maximum(miss, 1e-300)))
    return x / length


def _unit(v: Array) -> Array:
    norm = np.linalg.norm(v, axis=-1, keepdims=True)
    return v / np.where(norm > 0, norm, 1.0)


def rotation_starts(turns: Sequence[Turn] | TurnBatch, dR: ArrayLike, B: ArrayLike | None = None) -> Iterator[Array]:
    """Starts for H where only the rotation of each turn is known, best first.

    Parameters
    ----------
    turns : sequence of Turn, or TurnBatch of (T, N, 3)
    dR : array_like (T, 3, 3), R_before_after
    B : array_like (3,), raw unit, default 0

    Yields
    ------
    ndarray (3, 3), rad/s per raw unit

    Notes
    -----
    Were each turn about one axis, log(dR) = H s with s the integral of y - B, but the logarithm has branches:
    the motion may have gone the other way round. Three turns with both branches each give eight hypotheses
    for H; those of several well-spread triples are held against all turns by full integration, and the best
    are refined by taking the nearest branch in every turn.
    """
    batch, known = pad(turns), np.asarray(dR, dtype=np.float64)
    z = batch.y - (np.zeros(3) if B is None else np.asarray(B, dtype=np.float64))
    s = np.einsum("tn,tni->ti", batch.dt, z)
    branches = _branches(so3.log(known))
    guesses = _triples(s, branches)
    if not guesses:
        return
    scored = sorted(guesses, key=lambda H: _misfit(batch, known, H, B))
    for H in scored[:6]:
        yield _nearest_branch(H, s, branches)


def _branches(r: Array) -> Array:
    """Rotation vectors (2, T, 3) of the same rotations: the short way round and the long one."""
    angle = np.linalg.norm(r, axis=-1, keepdims=True)
    other = np.where(angle > 1e-9, r * (1 - 2 * np.pi / np.maximum(angle, 1e-9)), r)
    return np.stack([r, other])


def _triples(s: Array, branches: Array, most: int = 12) -> list[Array]:
    """Hypotheses for H from the triples of turns whose axes are most nearly at right angles."""
    axes = _unit(s)
    some = list(combinations(range(len(s)), 3))[:20000]
    if not some:
        return []
    volume = np.abs(np.linalg.det(axes[np.array(some)]))
    best = np.argsort(-volume)[:most]
    found = []
    for i in best[volume[best] > 0.05]:
        triple = np.array(some[i])
        inverse = np.linalg.inv(s[triple])
        found += [(inverse @ branches[list(pick), triple]).T for pick in product((0, 1), repeat=3)]
    return found


def _misfit(batch: TurnBatch, known: Array, H: Array, B: ArrayLike | None) -> float:
    return float(np.median(so3.angle_between(known, integrate(batch.y, batch.dt, H, B))))


def _nearest_branch(H: Array, s: Array, branches: Array, rounds: int = 3) -> Array:
    """Least squares over all turns, each on the branch nearest to H s."""
    for _ in range(rounds):
        miss = np.linalg.norm(branches - s @ H.T, axis=-1)
        r = np.where((miss[1] < miss[0])[:, None], branches[1], branches[0])
        w = 1 / np.maximum(np.min(miss, axis=0), 0.3 * np.median(miss.min(axis=0)) + 1e-9)[:, None]
        H = np.linalg.lstsq(s * w, r * w, rcond=None)[0].T
    return H


# --- full turns ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TurnAngle:
    """How far the node was turned, by the gyroscope, (T,) each.

    Attributes
    ----------
    net : rad in [0, pi], angle of the rotation from before to after
    about_axis : rad, the rate about `axis` integrated: counts full revolutions
    path : rad, the rate's magnitude about `axis` integrated: larger than `about_axis` when it went to and fro
    axis : (T, 3), unit vector in the node frame, the main axis of the motion, in the sense of the turn
    fixed : share of the squared rate that is about `axis`: 1 for a turn about a fixed axis
    """

    net: Array
    about_axis: Array
    path: Array
    axis: Array
    fixed: Array


def turn_angle(turns: Sequence[Turn] | TurnBatch, H: ArrayLike, B: ArrayLike | None = None) -> TurnAngle:
    """Net, integrated and path angle of each turn, and its axis.

    Parameters
    ----------
    turns : sequence of Turn, or TurnBatch of (T, N, 3)
    H, B : array_like (3, 3), (3,)
        Calibrated, or nominal to a few per cent.
    """
    batch = pad(turns)
    phi = rotation_vectors(batch.y, batch.dt, H, np.zeros(3) if B is None else B)
    scatter = np.swapaxes(phi, -1, -2) @ phi
    power, axes = np.linalg.eigh(scatter)
    axis = axes[..., -1]
    along = np.einsum("tni,ti->tn", phi, axis)
    sign = np.where(along.sum(axis=1) < 0, -1.0, 1.0)
    net = np.linalg.norm(so3.log(integrate(batch.y, batch.dt, H, B)), axis=-1)
    total = power.sum(axis=-1)
    fixed = power[..., -1] / np.where(total > 0, total, 1.0)
    return TurnAngle(net, np.abs(along.sum(axis=1)), np.abs(along).sum(axis=1), axis * sign[:, None], fixed)


@dataclass(frozen=True)
class FullTurns:
    """Full turns: `index` (F,) among the turns, `axis` (F, 3) in the node frame, `angle_deg` (F,) integrated."""

    index: NDArray[np.intp]
    axis: Array
    angle_deg: Array


def full_turns(
    turns: Sequence[Turn] | TurnBatch,
    H: ArrayLike,
    B: ArrayLike | None = None,
    *,
    low_deg: float = 345.0,
    high_deg: float = 375.0,
    fixed: float = 0.95,
) -> FullTurns:
    """The turns that are full ones about a fixed axis: a check of that axis' gain, not for the fit.

    Parameters
    ----------
    turns, H, B
        See `turn_angle`. With a nominal H whose gain may be off by p per cent, widen the limits by that.
    low_deg, high_deg : float
        Integrated angle that counts as a full turn.
    fixed : float
        Smallest share of the squared rate that must be about one axis.

    Notes
    -----
    Such a turn ends where it began whatever the cross terms of H are: it tells the gain along its axis only.
    """
    found = turn_angle(turns, H, B)
    angle = np.degrees(found.about_axis)
    steady = found.about_axis > 0.9 * found.path
    full = (angle >= low_deg) & (angle <= high_deg) & (found.fixed >= fixed) & steady
    index = np.flatnonzero(full)
    return FullTurns(index, found.axis[index], angle[index])
