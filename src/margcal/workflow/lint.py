"""What can be said of a recording before anything is fitted to it: `lint`.

Every finding is an `Issue`. A `fail` with a sensor means that this sensor cannot be used, a `fail` without one
that the recording cannot be understood (a unit that cannot be, clocks that share no time). What the reader
finds (missing rows, duplicate or backward time, infinite readings, milliseconds) is in `Recording.issues` and
not repeated here. Here: readings that are missing in arrays, stuck or frozen, and the temperature;
`lint_scale` looks at saturation and quantisation, `lint_clock` at time, `lint_units` at what the readings must
be in the units that they claim.

The limits are those of the project's list of bad inputs (rows 1, 2, 9, 10, 11, 70); where a figure was
measured on real recordings, it says so.
"""

from __future__ import annotations

import numpy as np

from margcal.core.types import Array, Issue, Kind, Recording, Stream
from margcal.workflow.lint_clock import lint_clocks
from margcal.workflow.lint_scale import (
    CLIP_RUN,
    COARSE,
    View,
    axes_in,
    clip_limits,
    clipped,
    lint_quantisation,
    lint_saturated,
    runs,
    thinned,
    view_of,
)
from margcal.workflow.lint_units import lint_units

__all__ = ["clip_limits", "clipped", "lint"]

NAMES = {"acc": "accelerometer", "gyr": "gyroscope", "mag": "magnetometer"}

MISSING_LIMIT = 0.05
"""Share of samples that may be missing."""
STUCK_S, STUCK_SAMPLES = 0.5, 50
"""An axis that stands exactly still this long, in seconds and samples, while the others change, is stuck."""
FROZEN_S, FROZEN_SAMPLES = 0.25, 10
"""The same for all three axes. Measured: radio drop-outs of BROAD 12 repeat up to 14 samples, 50 ms."""
HANG_NOISY, HANG = 0.5, 8.0
"""Step into or out of a frozen stretch over the steps beside it that tells a hang from a rest without noise, in
readings with noise and without."""
FROZEN_LIMIT = 0.2
"""Share of the samples above which stuck or frozen stretches make a sensor unusable."""
MEANINGLESS = ("infinite", "too-large", "stuck-sensor", "stuck-axis", "same-axes", "same-readings")
"""Findings after which nothing more is said of a sensor's unit."""
LARGEST = 1e18
"""Readings beyond this come from no converter (64 bits), and their squares from no arithmetic."""
TEMPERATURE_SPAN = 10.0


def lint(recording: Recording) -> tuple[Issue, ...]:
    """Everything that is wrong or doubtful with `recording`, before any fitting.

    Parameters
    ----------
    recording : Recording

    Returns
    -------
    tuple of Issue
        By sensor. Codes: ``nan-rows``, ``infinite``, ``too-large``, ``too-short``, ``stuck-sensor``,
        ``stuck-axis``, ``stuck-stretch``, ``same-axes``, ``same-readings``, ``frozen-samples``, ``saturated``,
        ``coarse-quantisation``, ``temperature-span``, and those of `lint_clocks` and `lint_units`.
    """
    issues: list[Issue] = []
    for stream in recording.streams.values():
        issues += _lint_stream(stream, recording)
    issues += lint_clocks(recording)
    issues += _lint_copies(recording)
    unusable: set[Kind | None] = {i.sensor for i in issues if i.level == "fail" and i.code in MEANINGLESS}
    issues += lint_units(recording, unusable)
    issues += _lint_temperature(recording)
    return tuple(issues)


def _lint_stream(stream: Stream, recording: Recording) -> list[Issue]:
    where = f"{recording.source}: {NAMES[stream.kind]}"
    issues, stream = _lint_missing(stream, where)
    if any(i.code == "infinite" for i in issues):
        return issues
    if len(stream.y) and not np.abs(stream.y).max() <= LARGEST:
        worst = float(np.abs(stream.y).max())
        text = f"{where}: readings up to {worst:.3g} {stream.unit}, which no sensor gives; export them again"
        return [*issues, Issue("too-large", "fail", text, stream.kind, worst, LARGEST)]
    if len(stream.t) < CLIP_RUN:
        text = f"{where}: {len(stream.t)} readings are too few to say anything; record again"
        return issues or [Issue("too-short", "fail", text, stream.kind, float(len(stream.t)), float(CLIP_RUN))]
    view = view_of(stream, where)
    issues += _lint_stuck(view) or _lint_same_axes(view)
    if any(i.code in MEANINGLESS for i in issues):
        return issues
    coarse = lint_quantisation(view)
    issues += coarse
    if not coarse:
        issues += _lint_frozen(view)
    return issues + lint_saturated(view)


# --- missing -----------------------------------------------------------------------------------------


def _lint_missing(stream: Stream, where: str) -> tuple[list[Issue], Stream]:
    """Rows 1 and 2: NaN and infinite readings of arrays; tables have none left. Returns the finite samples."""
    if np.isfinite(stream.y.sum()):
        return [], stream
    finite = np.asarray(np.isfinite(stream.y).all(axis=1))
    kept = Stream(stream.kind, stream.t[finite], stream.y[finite], stream.unit)
    infinite = np.asarray(np.isinf(stream.y).any(axis=1))
    if infinite.any():
        first = int(np.argmax(infinite))
        text = f"{where}: infinite reading in sample {first + 1} (t = {stream.t[first]:.6g} s); take the row out"
        return [Issue("infinite", "fail", text, stream.kind, float(infinite.sum()), 0.0)], kept
    share = 1 - float(finite.mean())
    text = f"{where}: {int((~finite).sum())} of {len(finite)} readings are missing ({100 * share:.2g} %); left out"
    if share > MISSING_LIMIT:
        text += "; record again, or cut to the part that is complete"
    level = "fail" if share > MISSING_LIMIT else "warn"
    return [Issue("nan-rows", level, text, stream.kind, share, MISSING_LIMIT)], kept


# --- stuck and frozen --------------------------------------------------------------------------------


def _lint_stuck(view: View) -> list[Issue]:
    """Row 10: an axis, or the whole sensor, that shows one value all the time; and long stretches of it."""
    n, kind, where = view.x.shape[1], view.stream.kind, view.where
    dead = np.asarray(view.same.all(axis=1))
    if dead.all():
        text = f"{where}: all {n} readings are the same; the sensor was not read: check the driver, record again"
        return [Issue("stuck-sensor", "fail", text, kind, 0.0, 0.0)]
    if dead.any():
        which = axes_in(dead)
        if all(len(np.unique(thinned(x))) <= 8 for x in view.x[~dead]):
            text = f"{where}: {which} shows one value only, and the others hardly more; too coarse to tell noise"
            return [Issue("coarse-quantisation", "warn", text, kind, 0.0, COARSE)]
        text = (
            f"{where}: {which} shows the same value in all {n} samples while the others change; it is stuck or not "
            "connected: check the driver, record again"
        )
        return [Issue("stuck-axis", "fail", text, kind, 0.0, 0.0)]
    return _lint_stuck_stretches(view)


def _lint_same_axes(view: View) -> list[Issue]:
    """Two axes with the same readings: one channel was written twice."""
    for a, b in ((0, 1), (0, 2), (1, 2)):
        if np.array_equal(view.x[a], view.x[b]):
            text = (
                f"{view.where}: {'xyz'[a]} and {'xyz'[b]} hold the same readings: one channel was exported twice; "
                "check the driver or the export, record again"
            )
            return [Issue("same-axes", "fail", text, view.stream.kind)]
    return []


def _lint_copies(recording: Recording) -> list[Issue]:
    """Two sensors with the same readings: the second one is not what its columns say."""
    issues = []
    streams = list(recording.streams.values())
    for i, stream in enumerate(streams):
        for other in streams[:i]:
            if len(stream.y) > CLIP_RUN and np.array_equal(stream.y, other.y) and np.ptp(stream.y) > 0:
                text = (
                    f"{recording.source}: the {NAMES[stream.kind]} holds the same readings as the {NAMES[other.kind]}; "
                    "its columns were exported from the wrong sensor: export again"
                )
                issues.append(Issue("same-readings", "fail", text, stream.kind))
    return issues


def _lint_stuck_stretches(view: View) -> list[Issue]:
    """One axis still for long while another of the same sensor goes on changing: neither noise nor rest."""
    n = max(STUCK_SAMPLES, round(STUCK_S * view.rate))
    issues = []
    for axis, same in enumerate(view.same):
        first, length = runs(same, n)
        if not len(first):
            continue
        k = int(np.argmax(length))
        inside = np.s_[first[k] : first[k] + length[k]]
        elsewhere = (same.sum() - length[k]) / max(len(same) - length[k], 1)
        others = min(view.same[b, inside].mean() for b in range(3) if b != axis)
        if others > 0.5 or elsewhere > 0.5:
            continue  # all axes stand still, or this one is always so coarse
        share = float(length[k] + 1) / view.x.shape[1]
        text = (
            f"{view.where}: {'xyz'[axis]} shows one value for {length[k] + 1} samples from t = "
            f"{view.stream.t[first[k]]:.4g} s on, while another axis goes on changing; cut that part off, or record "
            "again"
        )
        level = "fail" if share > FROZEN_LIMIT else "warn"
        issues.append(Issue("stuck-stretch", level, text, view.stream.kind, share, FROZEN_LIMIT))
    return issues


def _lint_frozen(view: View) -> list[Issue]:
    """Stretches in which all axes repeat: a link that hung. A noiseless rest, entered gently, is none."""
    first, length = runs(view.held, max(FROZEN_SAMPLES, round(FROZEN_S * view.rate)))
    if not len(first):
        return []
    least = HANG_NOISY if _is_noisy(view) else HANG
    hung = [i for i in range(len(first)) if _jump(view.x, int(first[i]), int(first[i] + length[i])) >= least]
    if not hung:
        return []
    first, length = first[hung], length[hung]
    share = float(length.sum()) / view.x.shape[1]
    longest = int(np.argmax(length))
    stretches = f"{len(hung)} stretch{'es' if len(hung) > 1 else ''}"
    text = (
        f"{view.where}: {stretches} in which all axes repeat one reading ({100 * share:.2g} % of the samples), the "
        f"longest {length[longest] / view.rate:.2g} s at t = {view.stream.t[first[longest]]:.4g} s: the connection or "
        "the logger hung; record again if turns fall into them"
    )
    level = "fail" if share > FROZEN_LIMIT else "warn"
    return [Issue("frozen-samples", level, text, view.stream.kind, share, FROZEN_LIMIT)]


def _is_noisy(view: View) -> bool:
    """Whether the readings that do change do so like noise, and not like smooth motion alone."""
    x = view.x[:, np.concatenate([[True], ~view.held])]
    if x.shape[1] < 16:
        return False
    first, second = np.abs(np.diff(x)), np.abs(np.diff(x, n=2))
    return bool(np.median(second.sum(axis=0)) > 0.7 * np.median(first.sum(axis=0)))


def _jump(x: Array, first: int, last: int) -> float:
    """Step into or out of the repeated samples first..last (the larger), over the usual step beside them."""
    before = np.abs(np.diff(x[:, max(first - 6, 0) : first + 1])).sum(axis=0)
    after = np.abs(np.diff(x[:, last : last + 7])).sum(axis=0)[::-1]
    jumps = [step[-1] / max(np.mean(step[:-1]), 1e-300) for step in (before, after) if len(step) > 2]
    return float(max(jumps, default=0.0))


# --- temperature -------------------------------------------------------------------------------------


def _lint_temperature(recording: Recording) -> list[Issue]:
    """Row 70."""
    if recording.temperature is None or len(recording.temperature[1]) < 2:
        return []
    low, high = np.nanquantile(recording.temperature[1], (0.005, 0.995))
    if not high - low > TEMPERATURE_SPAN:
        return []
    text = (
        f"{recording.source}: the temperature runs from {low:.1f} to {high:.1f} degC; biases drift with it: let the "
        "node warm up first, and record at one temperature"
    )
    return [Issue("temperature-span", "warn", text, None, float(high - low), TEMPERATURE_SPAN)]
