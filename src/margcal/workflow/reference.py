"""A motion-capture reference made fit for use: what the optics did not see is a gap, and gaps are never bridged.

`clean_reference` takes a track as a reader gives it (`files.references.read_reference`, `Recording.reference`) and
returns it with NaN wherever the body was not seen, was held at its last place, or was taken for another body; every
finding is an `Issue`. Nothing is interpolated, filtered or moved.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from margcal.core import so3
from margcal.core.checking import _continuous, _runs, checked_reference, without_options
from margcal.core.errors import InputError
from margcal.core.rigid_body import MarkerReference
from margcal.core.types import Array, Issue, Mask, Reference, Stream

JUMP_DEG, FASTEST_DEG_S = 30.0, 1500.0
"""A step of more than the first, and faster than the second, is no motion but a body whose markers were swapped."""

TIMES_USUAL = 3.0
"""The same of a step across a gap that is this many times faster than all but a hundredth of the steps."""

SAME_BODY_DEG = 25.0
"""Jumps that lead back to within this angle lead back to the body as it was."""

SHORTLY_S = 0.5
"""A stretch of wrong attitudes that lasts no longer is seen by what comes after it."""

LONGEST_STEPS = 6.0
"""Steps for which the motion before a jump is taken to have gone on."""

FROZEN_S = 0.1
"""A track that repeats itself to the last digit for longer, while the body turns, is held and not measured."""

TURNING_DEG_S = 5.0
"""Faster into or out of a stretch that stands exactly still, and the body did not come to rest there."""

IDENTITY_DEG = 5.0
"""Exact identities this far from their neighbours are what some programs write for a body that is lost."""

RESIDUAL_TIMES, RESIDUAL_M = 15.0, 3e-3
"""Frames whose marker residual is above this many medians, and above this length, show a marker that is another's."""

FASTEST_M_S, LARGEST_M, SMALLEST_M = 30.0, 100.0, 3e-3
"""Positions beyond the first two are millimetres taken for metres; below the last, on a turning body, the reverse."""

LARGEST_BODY_M = 3.0
"""Markers farther apart are not on one body that a node could be fixed to."""

MANY_LOST = 0.2
"""Share of samples without an attitude from which it is worth a warning."""


@dataclass
class _Findings:
    """What is lost so far (N,), and why."""

    lost: Mask
    where: str
    issues: list[Issue]

    def add(self, code: str, mask: Mask, t: Array, text: str, limit: float | None = None) -> None:
        fresh = mask & ~self.lost
        if not fresh.any():
            return
        first = float(t[np.argmax(fresh)])
        count = int(fresh.sum())
        said = f"{self.where}: {count} of {len(t)} samples, the first at {first:.2f} s, {text}; taken as not seen"
        self.issues.append(Issue(code, "warn", said, value=count / len(t), limit=limit))
        self.lost = self.lost | mask


def clean_reference(
    reference: Reference, *, gyr: Stream | None = None, where: str = "reference"
) -> tuple[Reference, tuple[Issue, ...]]:
    """`reference` with unit quaternions of continuous sign, and NaN wherever it is not a measurement of the body.

    Found, in this order: norms off (mended, or refused), (0, 0, 0, 0), positions of exactly zero, exact identities
    and stretches that repeat exactly while the body turns (held at the last value), frames whose markers do not fit
    the rigid shape (a `MarkerReference` keeps its residual), jumps of more than 30 degrees in a frame (swapped
    markers: the labelling that lasts longest is kept, the others are cut out), positions in the wrong unit (left
    out).

    Parameters
    ----------
    reference : Reference or MarkerReference
        As it was read; samples that repeat the time before are dropped.
    gyr : Stream, optional
        The node's gyroscope on the same clock, in any unit: tells a body at rest from one that is held. Without it a
        held stretch is known by the speed with which the track runs into or out of it.
    where : str
        What messages begin with.

    Returns
    -------
    reference : Reference
        Of the same type; samples are kept in their places, and masked by NaN.
    issues : tuple of Issue
        ``reference-norm``, ``reference-origin``, ``reference-identity``, ``reference-frozen``,
        ``reference-residual``, ``reference-swap``, ``reference-position-unit``, ``reference-gaps``,
        ``reference-empty``, ``duplicate-time``.

    Raises
    ------
    InputError
        As `core.checking.checked_reference`: norms off by more than 5e-2, infinite values, time that runs backwards.
    """
    try:
        checked, first = checked_reference(reference, where=_prefix(where))
    except InputError as error:
        raise InputError(without_options(str(error))) from error
    t, q = checked.t, checked.q.copy()
    p = None if checked.p is None else checked.p.copy()
    kept = np.concatenate([[True], np.diff(reference.t) > 0])
    found = _Findings(np.isnan(q[:, 0]), where, [replace(i, text=_renamed(i.text, where)) for i in first])
    found.add("reference-origin", _at_origin(q, p), t, "stand at exactly (0, 0, 0)")
    found.add("reference-identity", _identities(q, found.lost), t, "are exact identities beside other attitudes")
    found.add("reference-frozen", _frozen(t, q, p, gyr, found.lost), t, "repeat the last value while the body turns")
    residual = reference.residual[kept] if isinstance(reference, MarkerReference) else None
    if residual is not None:
        bad, limit = _misfits(residual)
        found.add("reference-residual", bad, t, f"have markers off the rigid shape by more than {1e3 * limit:.1f} mm")
    swapped, jumps = _swaps(t, q, found.lost)
    text = f"lie between jumps of more than {JUMP_DEG:.0f} deg in a frame ({jumps} in all: swapped markers)"
    found.add("reference-swap", swapped, t, text, JUMP_DEG)
    q[found.lost] = np.nan
    if p is not None:
        p[found.lost] = np.nan
        issue = _size(reference.shape, where) if isinstance(reference, MarkerReference) else _positions(t, q, p, where)
        if issue is not None:
            p = None
            found.issues.append(issue)
    found.issues += _gaps(t, found.lost, where)
    changes = {"t": t, "q": _continuous(q), "p": p}
    if residual is not None:
        changes["residual"] = residual
    return replace(reference, **changes), tuple(found.issues)


def _prefix(where: str) -> str:
    """What `checked_reference` puts before the word reference."""
    return "" if where == "reference" else f"{where}: "


def _renamed(text: str, where: str) -> str:
    return text.replace(f"{where}: reference", where, 1) if where != "reference" else text


def _at_origin(q: Array, p: Array | None) -> Mask:
    """Samples at exactly (0, 0, 0), where the others are somewhere."""
    if p is None:
        return np.zeros(len(q), dtype=bool)
    zero = np.logical_and.reduce(p == 0, axis=1)
    somewhere = np.logical_or.reduce((p != 0) & ~np.isnan(p), axis=1)
    return zero if somewhere.sum() > zero.sum() else np.zeros(len(q), dtype=bool)


def _identities(q: Array, lost: Mask) -> Mask:
    """Samples that are exactly (1, 0, 0, 0) while the nearest others are elsewhere."""
    exact = (np.abs(q[:, 0]) == 1) & np.logical_and.reduce(q[:, 1:] == 0, axis=1) & ~lost
    other = np.flatnonzero(~exact & ~lost)
    out = np.zeros(len(q), dtype=bool)
    if not exact.any() or not other.size:
        return out
    at = np.flatnonzero(exact)
    after = np.searchsorted(other, at)
    away = 2 * np.degrees(np.arccos(np.minimum(np.abs(q[other, 0]), 1.0)))  # angle to the identity
    before = away[np.clip(after - 1, 0, None)]
    out[at] = np.minimum(before, away[np.clip(after, None, len(other) - 1)]) > IDENTITY_DEG
    return out


def _frozen(t: Array, q: Array, p: Array | None, gyr: Stream | None, lost: Mask) -> Mask:
    """All but the first sample of stretches that are held while the body turns."""
    out = np.zeros(len(t), dtype=bool)
    if len(t) < 4:
        return out
    same = np.logical_and.reduce(q[1:] == q[:-1], axis=1) & ~lost[1:] & ~lost[:-1]
    if p is not None:
        same &= np.logical_and.reduce((p[1:] == p[:-1]) | np.isnan(p[1:]), axis=1)
    runs = list(_runs(same))
    if not runs:
        return out
    step = float(np.median(np.diff(t)))
    # a reference that was written faster than it was measured repeats each value a few times, all along
    changes = max(1, int((~same & ~lost[1:]).sum()))
    usual = (len(same) - sum(b - a for a, b in runs if t[b] - t[a] > FROZEN_S)) / changes
    shortest = max(FROZEN_S, 3.5 * usual * step)
    speed = _speeds(t, q)
    for a, b in runs:
        if t[b] - t[a] < shortest - 1e-9:
            continue
        edges = [speed[k] for k in (a - 1, b) if 0 <= k < len(speed)]
        moving = any(math.isfinite(v) and v > TURNING_DEG_S for v in edges)
        if moving or (gyr is not None and _turning(gyr, t[a], t[b])):
            out[a + 1 : b + 1] = True
    return out


def _speeds(t: Array, q: Array) -> Array:
    """Angular speed (N-1,) between neighbours, deg/s; NaN where one is not seen."""
    return _steps(q) / np.diff(t)


def _steps(q: Array) -> Array:
    """Angle (N-1,) between neighbours, deg; NaN where one is not seen."""
    with np.errstate(invalid="ignore"):
        return np.degrees(np.linalg.norm(so3.quat_log(so3.quat_multiply(so3.quat_conjugate(q[:-1]), q[1:])), axis=1))


def _turning(gyr: Stream, start: float, stop: float) -> bool:
    """Whether the gyroscope, its bias and unit unknown, moves from `start` to `stop` as it does at large."""
    good = ~np.isnan(gyr.y[:, 0])
    y = gyr.y[good] - np.median(gyr.y[good], axis=0)
    inside = (gyr.t[good] >= start) & (gyr.t[good] <= stop)
    if inside.sum() < 3:
        return False
    size = np.sum(y**2, axis=1)
    return bool(np.mean(size[inside]) > 0.04 * np.mean(size))


def _misfits(residual: Array) -> tuple[Mask, float]:
    """Frames whose residual is far above the usual one, and the limit (m)."""
    seen = np.isfinite(residual)
    if not seen.any():
        return np.zeros(len(residual), dtype=bool), RESIDUAL_M
    limit = max(RESIDUAL_M, RESIDUAL_TIMES * float(np.median(residual[seen])))
    return np.where(seen, residual, 0.0) > limit, limit


def _swaps(t: Array, q: Array, lost: Mask) -> tuple[Mask, int]:
    """Samples of labellings other than the one that lasts longest, and the number of jumps."""
    seen = np.flatnonzero(~lost)
    out = np.zeros(len(t), dtype=bool)
    if len(seen) < 2:
        return out, 0
    R, at = so3.matrix_from_quat(q[seen]), t[seen]
    angle, dt = np.degrees(so3.angle_between(R[:-1], R[1:])), np.diff(at)
    usual = float(np.quantile(angle / dt, 0.99))
    jumps = np.flatnonzero(angle > np.maximum(JUMP_DEG, min(FASTEST_DEG_S, TIMES_USUAL * usual) * dt))
    if not jumps.size:
        return out, 0
    starts = np.concatenate([[0], jumps + 1])
    labels = _labels(R, at, starts, usual)
    length = np.diff(np.append(starts, len(seen)))
    best = int(np.argmax(np.bincount(labels, weights=length)))
    for begin, n, label in zip(starts, length, labels):
        out[seen[begin : begin + n]] = label != best
    return out, len(jumps)


def _labels(R: Array, t: Array, starts: NDArray[np.intp], usual: float) -> NDArray[np.intp]:
    """The labelling, by number, of each stretch between jumps, which begin at `starts`.

    A stretch that goes on where one shortly before left off has the labelling of that one. Otherwise: a swap turns
    the body's frame by a constant rotation S, R_seen = R S. Each jump J changes it to S J, whatever the motion between
    the jumps, so stretches with the same S belong together. J is what is left of the step after the motion of the
    frame before.
    """
    S, known, labels = np.eye(3), [np.eye(3)], [0]
    for k in range(1, len(starts)):
        begin = int(starts[k])
        label = _goes_on(R, t, starts, k, usual)
        if label is not None:
            label = labels[label]
        else:
            S = S @ _jump(R, t, begin, int(starts[k - 1]))
            off = np.degrees(so3.angle_between(np.array(known), S))
            label = int(np.argmin(off))
            if off[label] > SAME_BODY_DEG:
                known.append(S)
                label = len(known) - 1
        S = known[label]  # or the errors of many jumps would add up
        labels.append(label)
    return np.array(labels)


def _goes_on(R: Array, t: Array, starts: NDArray[np.intp], k: int, usual: float) -> int | None:
    """The stretch, latest first, that ended shortly before stretch `k` begins and near its attitude; None if none."""
    begin = starts[k]
    for j in range(k - 2, -1, -1):
        end = starts[j + 1] - 1
        elapsed = t[begin] - t[end]
        if elapsed > SHORTLY_S:
            return None
        angle = np.degrees(so3.angle_between(R[end], R[begin]))
        if angle < max(JUMP_DEG, min(usual * elapsed, 2 * JUMP_DEG)):
            return j
    return None


def _jump(R: Array, t: Array, begin: int, stretch: int) -> Array:
    """The step into sample `begin` without the motion, which is that of the step before within the same stretch."""
    J = R[begin - 1].T @ R[begin]
    if begin - 2 < stretch:
        return J
    steps = (t[begin] - t[begin - 1]) / (t[begin - 1] - t[begin - 2])
    return so3.exp(so3.log(R[begin - 2].T @ R[begin - 1]) * min(steps, LONGEST_STEPS)).T @ J


def _positions(t: Array, q: Array, p: Array, where: str) -> Issue | None:
    """Why the positions cannot be metres."""
    seen = np.flatnonzero(~np.isnan(p[:, 0]))
    if len(seen) < 3:
        return None
    extent = float(np.linalg.norm(np.quantile(p[seen], 0.99, axis=0) - np.quantile(p[seen], 0.01, axis=0)))
    step = np.linalg.norm(np.diff(p[seen], axis=0), axis=1) / np.diff(t[seen])
    speed = float(np.quantile(step, 0.95))
    if speed > FASTEST_M_S or extent > LARGEST_M:
        text = (
            f"{where}: positions range over {extent:.4g} m at up to {speed:.3g} m/s, which looks like millimetres "
            "taken for metres; they were left out: name the columns ref_p_x_mm ..., or divide by 1000"
        )
        return Issue("reference-position-unit", "warn", text, value=extent, limit=LARGEST_M)
    turned = _range_deg(q)
    if extent < SMALLEST_M and turned > JUMP_DEG:
        text = (
            f"{where}: positions range over {1e3 * extent:.2g} mm while the body turns by {turned:.0f} deg, which "
            "looks like metres taken for millimetres; they were left out: name the columns ref_p_x_m ..., or multiply "
            "by 1000"
        )
        return Issue("reference-position-unit", "warn", text, value=extent, limit=SMALLEST_M)
    return None


def _size(shape: Array, where: str) -> Issue | None:
    """Why the markers' places cannot be metres."""
    if len(shape) < 3:
        return None
    size = float(np.linalg.norm(shape[:, None] - shape[None], axis=2).max())
    if SMALLEST_M < size < LARGEST_BODY_M:
        return None
    text = (
        f"{where}: the markers of the body are up to {size:.3g} m apart, which looks like the wrong unit of length; "
        "positions were left out: name the columns by their unit (_mm, _m), or declare it"
    )
    return Issue("reference-position-unit", "warn", text, value=size, limit=LARGEST_BODY_M)


def _range_deg(q: Array) -> float:
    """Largest angle from the first seen attitude to any other."""
    seen = q[~np.isnan(q[:, 0])]
    if not len(seen):
        return 0.0
    dot = np.abs(seen @ seen[0])
    return float(np.degrees(2 * np.arccos(np.min(np.minimum(dot, 1.0)))))


def _gaps(t: Array, lost: Mask, where: str) -> list[Issue]:
    """How much is not seen, in words."""
    if not lost.any() or lost.all():
        return []  # an empty reference has been named already
    edges = np.flatnonzero(np.diff(np.concatenate([[False], lost, [False]]).astype(np.int8)))
    step = float(t[-1] - t[0]) / max(len(t) - 1, 1)
    longest = max(float(t[b - 1] - t[a]) + step for a, b in zip(edges[::2], edges[1::2]))
    share = float(np.mean(lost))
    text = (
        f"{where}: not seen in {100 * share:.2g} % of its samples ({len(edges) // 2} gaps, longest {longest:.2f} s); "
        "they are left out and not bridged"
    )
    return [Issue("reference-gaps", "warn" if share > MANY_LOST else "note", text, value=share, limit=MANY_LOST)]
