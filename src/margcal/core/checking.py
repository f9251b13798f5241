"""What a recording must be before anything is done with it: known units and time that runs forward.

Called by `Recording.from_arrays` and by the reader of tables. What can be mended without guessing is mended and
said in an `Issue`; what cannot is refused with an `InputError` that says what, where and how to mend. Checks of
the readings themselves (stuck, saturated, implausible) belong to the lint of the workflow, not here.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from margcal.core.errors import InputError
from margcal.core.types import Array, Issue, Recording, Reference, Stream
from margcal.core.units import UNITS

LATEST = 1e30
"""No clock shows more seconds, nor more nanoseconds taken for seconds."""

SLOWEST_STEP = 2.0
"""Median step (s) from which `t_s` is taken for a counter of milliseconds or finer."""

NORM_MENDED, NORM_REFUSED = 1e-3, 5e-2
"""Error of a quaternion's norm: below the first it is rounding, above the second it is no quaternion."""

FLAT_SECONDS = 0.25
"""A reference that stands exactly still this long, while the node moves, has lost the body."""


def printable(text: object, limit: int = 200) -> str:
    """`text` for a message: control characters (terminal escapes) become ``?``, long text is cut."""
    safe = "".join(c if c.isprintable() else "?" for c in str(text))
    return safe if len(safe) <= limit else safe[:limit] + "..."


def without_options(text: str) -> str:
    """`text` of a refusal without the options of `calibrate`, for readers that have none of them."""
    text = text.replace(", empty the cell, or give --skip-bad N", " or empty the cell")
    text = text.replace(", or give --skip-bad N", "").replace("give --sort if the rows", "sort the rows if they")
    return re.sub(r"(\. If it truly is one sample in [^,]*)?, (or )?declare the rate( \([^)]*\))?", "", text)


def checked_recording(recording: Recording, *, sort: bool = False, trust_clock: bool = False) -> Recording:
    """`recording` with every stream and the reference checked; what was mended is added to `issues`.

    Parameters
    ----------
    recording : Recording
    sort : bool
        Sort samples whose time runs backwards instead of refusing them.
    trust_clock : bool
        The rate was declared, so a slow clock is not taken for milliseconds.

    Raises
    ------
    InputError
        As `checked_stream` and `checked_reference`, and when there is neither a sensor nor a reference.
    """
    where = f"{printable(recording.source)}: "
    if not recording.streams and recording.reference is None:
        raise InputError(f"{where}holds no accelerometer, gyroscope, magnetometer or reference")
    issues = list(recording.issues)
    parts: dict[str, Stream | Reference] = {}
    for kind, stream in recording.streams.items():
        parts[kind], found = checked_stream(stream, sort=sort, trust_clock=trust_clock, where=where)
        issues += found
    if recording.reference is not None:
        moving = parts.get("gyr") or parts.get("acc")
        reference, found = checked_reference(
            recording.reference,
            moving if isinstance(moving, Stream) else None,
            sort=sort,
            trust_clock=trust_clock,
            where=where,
        )
        parts["reference"] = reference
        issues += found
    return replace(recording, **parts, issues=tuple(issues))  # type: ignore[arg-type]


def checked_stream(
    stream: Stream, *, sort: bool = False, trust_clock: bool = False, where: str = ""
) -> tuple[Stream, tuple[Issue, ...]]:
    """`stream` with time that runs strictly forward, and what had to be mended for it.

    Parameters
    ----------
    stream : Stream
        NaN readings are kept: NaN means "not measured".
    sort, trust_clock : bool
        As in `checked_recording`.
    where : str
        What messages begin with, such as ``"walk.csv: "``.

    Returns
    -------
    stream : Stream
    issues : tuple of Issue
        ``duplicate-time`` (the first of equal times is kept), ``time-sorted``, ``time-quantised``.

    Raises
    ------
    InputError
        Unknown unit, no samples, infinite readings, time that is missing, runs backwards, looks like
        milliseconds or is too coarse to tell samples apart.
    """
    kind, where = stream.kind, f"{where}{stream.kind}"
    if stream.unit not in UNITS[kind]:
        raise InputError(f"{where}: unknown unit {printable(stream.unit)!r}; {kind} may be in {', '.join(UNITS[kind])}")
    if len(stream.t) == 0:
        raise InputError(f"{where}: no samples")
    with np.errstate(over="ignore", invalid="ignore"):
        complete = bool(np.isfinite(stream.y.sum()))
    if not complete and np.isinf(stream.y).any():
        row = int(np.argmax(np.isinf(stream.y).any(axis=1)))
        raise InputError(f"{where}: infinite reading in sample {row + 1} (t = {stream.t[row]:.6g} s); take the row out")
    index, issues = _checked_time(stream.t, where, sort=sort, trust_clock=trust_clock)
    issues = tuple(replace(i, sensor=kind) for i in issues)
    if index is None:
        return stream, issues
    return replace(stream, t=stream.t[index], y=stream.y[index]), issues


def _checked_time(
    t: Array, where: str, *, sort: bool, trust_clock: bool
) -> tuple[NDArray[np.intp] | None, tuple[Issue, ...]]:
    """Index of the samples to keep, in order (None: all of them as they are), and what was mended."""
    if not np.isfinite(t).all():
        row = int(np.argmin(np.isfinite(t)))
        raise InputError(f"{where}: time of sample {row + 1} is missing or not finite; take the row out")
    if np.abs(t).max(initial=0.0) > LATEST:
        row = int(np.argmax(np.abs(t) > LATEST))
        raise InputError(f"{where}: time of sample {row + 1} is {t[row]:g} s, which no clock shows; take the row out")
    issues: list[Issue] = []
    index = None
    step = np.diff(t)
    if step.size and step.min() < 0:
        row = int(np.argmax(step < 0))
        if not sort:
            raise InputError(
                f"{where}: time runs backwards at sample {row + 2} ({t[row]:.6f} s, then {t[row + 1]:.6f} s); "
                "cut the file there if the clock was restarted, or give --sort if the rows are only shuffled"
            )
        index = np.argsort(t, kind="stable")
        step = np.diff(t[index])
        text = f"{where}: rows were sorted by time (the first backward step was at sample {row + 2})"
        issues.append(Issue("time-sorted", "warn", text))
    if not trust_clock:
        _refuse_milliseconds(step, where)
    issues += _check_quantisation(t, step, where)
    if step.size and step.min() == 0:
        keep = np.concatenate([[True], step > 0])
        count = int(len(keep) - keep.sum())
        index = np.flatnonzero(keep) if index is None else index[keep]
        text = f"{where}: {count} of {len(t)} samples repeat the time before; the first of each was kept"
        issues.append(Issue("duplicate-time", "warn", text, value=float(count), limit=0.0))
    return index, tuple(issues)


def _refuse_milliseconds(step: Array, where: str) -> None:
    """Refuse a clock whose median step is seconds long: it counts milli-, micro- or nanoseconds."""
    # np.partition: np.median imports numpy.ma, 10 ms at every start
    median = float(np.partition(step, step.size // 2)[step.size // 2]) if step.size else 0.0
    if median < SLOWEST_STEP:
        return
    name, divisor = next(
        (n, d)
        for n, d, top in (
            ("milliseconds", "1e3", 1e3),
            ("microseconds", "1e6", 1e6),
            ("nanoseconds", "1e9", np.inf),
        )
        if median <= top
    )
    raise InputError(
        f"{where}: samples are {median:g} s apart, so t_s looks like {name}: divide it by {divisor}. "
        f"If it truly is one sample in {median:g} s, declare the rate ({1 / median:.6g} Hz)"
    )


def _check_quantisation(t: Array, step: Array, where: str) -> list[Issue]:
    """Time that went through float32 at a large offset (seconds since 1970): steps are no longer true.

    Only times that all are float32 numbers can have suffered; steps that are all equal have not.
    """
    if len(t) < 3 or (np.ptp(step) == 0 and step[0] > 0):
        return []
    mean_step = (t.max() - t.min()) / (len(t) - 1)
    if 2 * np.count_nonzero(step == 0) > len(step):
        raise InputError(
            f"{where}: most samples repeat the time before ({np.count_nonzero(step) + 1} times for {len(t)} "
            "samples): t_s is coarser than the sampling, or was stored as float32; export it as float64 in fractions "
            "of a second, or declare the rate"
        )
    if not np.array_equal(t.astype(np.float32), t):
        return []
    grain = float(np.spacing(np.float32(np.abs(t).max())))
    if grain >= mean_step:
        raise InputError(
            f"{where}: time moves in jumps of {grain:g} s for samples {mean_step:.3g} s apart: it was stored as "
            "float32; export it as float64, or subtract the start first"
        )
    if grain > 0.01 * mean_step:
        text = f"{where}: time is rounded to {grain:.2g} s (float32) for samples {mean_step:.3g} s apart"
        return [Issue("time-quantised", "warn", text, value=grain / mean_step, limit=0.01)]
    return []


def checked_reference(
    reference: Reference,
    moving: Stream | None = None,
    *,
    sort: bool = False,
    trust_clock: bool = False,
    where: str = "",
) -> tuple[Reference, tuple[Issue, ...]]:
    """`reference` with unit quaternions of continuous sign, and NaN wherever the body was not seen.

    Parameters
    ----------
    reference : Reference
        Rows that are NaN in part, of norm zero, or flat lines become NaN.
    moving : Stream, optional
        Gyroscope (or accelerometer) that tells a flat line from a body at rest: a track that stands exactly
        still counts as lost only while this sensor moves.

    Raises
    ------
    InputError
        Norm off by more than 5e-2, infinite values, or time as in `checked_stream`.
    """
    where = f"{where}reference"
    if len(reference.t) == 0:
        raise InputError(f"{where}: no samples")
    index, issues = _checked_time(reference.t, where, sort=sort, trust_clock=trust_clock)
    t, q, p = reference.t, reference.q.copy(), None if reference.p is None else reference.p.copy()
    if index is not None:
        t, q, p = t[index], q[index], None if p is None else p[index]
    if np.isinf(q).any() or (p is not None and np.isinf(p).any()):
        raise InputError(f"{where}: infinite values; take the rows out or leave their cells empty")
    with np.errstate(over="ignore"):
        norm = np.linalg.norm(q, axis=1)
    lost = ~(norm > 1e-6)
    norm[lost] = np.nan
    more = _check_norm(norm, t, where)
    flat = _flat_lines(t, q, p, moving)
    if flat.any():
        text = f"{where}: {int(flat.sum())} samples stand still while the node moves; taken as not seen"
        more.append(Issue("reference-flat", "warn", text, value=float(flat.mean())))
    lost |= flat
    q /= norm[:, None]
    q[lost] = np.nan
    if p is not None:
        p[flat | np.isnan(p).any(axis=1) | (lost & (p == 0).all(axis=1))] = np.nan
    return Reference(t, _continuous(q), p), (*issues, *more)


def _check_norm(norm: Array, t: Array, where: str) -> list[Issue]:
    error = np.abs(norm - 1)
    if np.isnan(error).all():
        return [Issue("reference-empty", "warn", f"{where}: the body is never seen")]
    worst = int(np.nanargmax(error))
    if error[worst] >= NORM_REFUSED:
        raise InputError(
            f"{where}: the quaternion of sample {worst + 1} (t = {t[worst]:.6g} s) has norm {norm[worst]:.4g}; "
            "expected 1. Check that ref_qw ref_qx ref_qy ref_qz are the right columns"
        )
    if error[worst] < NORM_MENDED:
        return []
    text = f"{where}: norms are off by up to {error[worst]:.2g}; normalised"
    return [Issue("reference-norm", "warn", text, value=float(error[worst]), limit=NORM_MENDED)]


def _flat_lines(t: Array, q: Array, p: Array | None, moving: Stream | None) -> NDArray[np.bool_]:
    """Samples of runs that stand exactly still for `FLAT_SECONDS` or more while `moving` moves."""
    flat = np.zeros(len(t), dtype=bool)
    if moving is None or len(t) < 3:
        return flat
    same = (q[1:] == q[:-1]).all(axis=1)
    if p is not None:
        same &= ((p[1:] == p[:-1]) | np.isnan(p[1:])).all(axis=1)
    runs = [(a, b) for a, b in _runs(same) if t[b] - t[a] >= FLAT_SECONDS]
    if not runs:
        return flat
    overall = np.nanstd(moving.y, axis=0).max()
    for a, b in runs:
        inside = moving.y[np.searchsorted(moving.t, t[a]) : np.searchsorted(moving.t, t[b])]
        inside = inside[~np.isnan(inside).any(axis=1)]
        if len(inside) > 3 and inside.std(axis=0).max() > 0.2 * overall:
            flat[a + 1 : b + 1] = True  # the first sample of the run was seen
    return flat


def _runs(mask: NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    """(first, last) sample of every run of True in `mask`, where mask[i] compares samples i and i + 1."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return zip(edges[::2].tolist(), edges[1::2].tolist())


def _continuous(q: Array) -> Array:
    """Quaternions with the sign that makes each the neighbour of the one seen before it."""
    seen = np.flatnonzero(~np.isnan(q[:, 0]))
    track = q[seen]
    flips = np.where(np.sum(track[1:] * track[:-1], axis=1) < 0, -1.0, 1.0)
    q[seen[1:]] *= np.cumprod(flips)[:, None]
    return q
