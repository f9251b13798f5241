"""What can be said of a recording's clocks: gaps, bursts, a rate that changes, tables that share no time.

Times were checked by the reader already: finite, forward, in seconds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from margcal.core.types import Array, Issue, Recording, Stream

NAMES = {"acc": "accelerometer", "gyr": "gyroscope", "mag": "magnetometer"}

GAP_PERIODS = 5.0
"""A hole of more than this many sampling periods is a gap (row 14)."""
REGULAR = 0.7
"""Share of steps within a half of the median that makes a clock regular. Measured: 0.99-1.0 for clocks of the
device, 0.6 and less where a host stamped samples as they came in (`sunsided`)."""
FEW_HOLES = 0.05
"""Share of steps of several periods up to which they are gaps and not the clock's way. Measured: 0 for clocks of
the device, 0.22 for the ten minutes of `sunsided`."""
STALL = 3.0
"""A hole in a bursty clock is longer than this times what it does every now and then (98 % of its steps)."""
RATE_CHANGE = 0.2
"""Relative change of the step within a recording that is told (row 16)."""
SLOWEST = {"acc": 10.0, "gyr": 20.0, "mag": 5.0}
"""Rates (Hz) below which turns by hand are not followed any more."""
OVERLAP = 0.8
"""Share of the shorter stream that should lie within the other's time (row 27)."""


@dataclass(frozen=True)
class Clock:
    """Sampling period (s) without the holes, and whether the steps keep to it."""

    period: float
    regular: bool


def lint_clocks(recording: Recording) -> list[Issue]:
    """Issues of all clocks.

    Returns
    -------
    list of Issue
        Codes ``gaps``, ``bursty-clock``, ``rate-changes``, ``slow-rate``, ``no-overlap``, ``little-overlap``.
        Streams that share a clock are told once, under the first sensor.
    """
    issues: list[Issue] = []
    seen: list[Array] = []
    for kind, stream in recording.streams.items():
        if len(stream.t) < 8 or not np.all(np.diff(stream.t) > 0):
            continue
        where = f"{recording.source}: {NAMES[kind]}"
        clock = clock_of(stream.t)
        if not any(stream.t is t or np.array_equal(stream.t, t) for t in seen):
            seen.append(stream.t)
            issues += _lint_gaps(stream, clock, where)
            issues += _lint_steps(stream, clock, where)
        if 1 / clock.period < SLOWEST[kind]:
            text = (
                f"{where}: {1 / clock.period:.3g} samples per second are too few to follow turns by hand; record at "
                f"{SLOWEST[kind]:.0f} Hz or more (better 100)"
            )
            issues.append(Issue("slow-rate", "warn", text, kind, 1 / clock.period, SLOWEST[kind]))
    return issues + _lint_overlap(recording)


def clock_of(t: Array) -> Clock:
    """The sampling period of times `t` (N,) s: the median step of a regular clock, else count over span without
    the longest holes, never the median alone (host clocks stamp in bursts)."""
    step = np.diff(t)
    median = float(np.median(step))
    kept = np.mean(np.abs(step - median) <= 0.5 * median)
    if kept >= REGULAR and np.mean(step > GAP_PERIODS * median) <= FEW_HOLES:
        return Clock(median, True)
    mean = float(step.mean())
    kept = step[step <= 30 * mean]
    return Clock(float(kept.mean()), False)


def missing_in(t: Array, clock: Clock) -> tuple[NDArray[np.intp], Array]:
    """Index of the last sample before each gap, and the samples that are missing in it.

    A host that stalls stamps the samples that waited in quick succession afterwards: they are late, not
    missing. So what counts is how far time has run ahead of the number of samples over a stretch around the
    hole (five times as long, one second at least).
    """
    step = np.diff(t)
    shortest = GAP_PERIODS * clock.period * (1 + 1e-6)
    if not clock.regular:
        shortest = max(shortest, STALL * float(np.quantile(step, 0.98)))
    at = np.flatnonzero(step > shortest)
    if not len(at):
        return at, np.zeros(0)
    missing = step[at] / clock.period - 1
    if not clock.regular:
        reach = np.maximum(5 * step[at], 1.0)
        lo = np.searchsorted(t, t[at] - reach)
        hi = np.minimum(np.searchsorted(t, t[at + 1] + reach), len(t) - 1)
        missing = np.minimum(missing, (t[hi] - t[lo]) / clock.period - (hi - lo))
    gap = missing >= GAP_PERIODS - 1
    return at[gap], missing[gap]


def _lint_gaps(stream: Stream, clock: Clock, where: str) -> list[Issue]:
    at, missing = missing_in(stream.t, clock)
    if not len(at):
        return []
    worst = int(np.argmax(missing))
    start = stream.t[at[worst]]
    seconds = stream.t[at[worst] + 1] - start
    lost = float(missing.sum()) / (len(stream.t) + float(missing.sum()))
    text = (
        f"{where}: {len(at)} gap{'s' if len(at) > 1 else ''} of more than {GAP_PERIODS:.0f} sampling periods, the "
        f"longest {seconds:.3g} s at t = {start:.5g} s; {100 * lost:.2g} % of the samples are missing. Nothing is "
        "integrated across: record again if many turns fall out"
    )
    return [Issue("gaps", "warn", text, stream.kind, float(seconds / clock.period), GAP_PERIODS)]


def _lint_steps(stream: Stream, clock: Clock, where: str) -> list[Issue]:
    """Row 16, as far as a recording can tell without a declared rate."""
    step = np.diff(stream.t)
    if not clock.regular:
        text = (
            f"{where}: time stamps come in bursts (half of the steps are under {1e3 * np.median(step):.2g} ms, on "
            f"average {1e3 * clock.period:.3g} ms): a computer stamped the samples as they arrived. The rate "
            f"{1 / clock.period:.4g} Hz is from count over span; record the device's own clock for better turns"
        )
        return [Issue("bursty-clock", "warn", text, stream.kind, float(np.median(step) / clock.period), 0.5)]
    if len(step) < 200:
        return []
    tenths = np.array([np.median(part) for part in np.array_split(step, 10)])
    ratio = float(tenths.max() / tenths.min())
    if ratio <= 1 + RATE_CHANGE:
        return []
    text = (
        f"{where}: the sampling rate changes from {1 / tenths.max():.4g} to {1 / tenths.min():.4g} Hz within the "
        "recording; times are taken as they stand: cut the recording there if the device did not change its rate"
    )
    return [Issue("rate-changes", "warn", text, stream.kind, ratio - 1, RATE_CHANGE)]


def _lint_overlap(recording: Recording) -> list[Issue]:
    """Streams on clocks of their own must share an origin; each is compared with the first one."""
    issues = []
    clocks = [(k, s) for k, s in recording.streams.items() if len(s.t) > 1]
    for (a, s), (b, o) in ((clocks[0], other) for other in clocks[1:]):
        common = min(s.t[-1], o.t[-1]) - max(s.t[0], o.t[0])
        share = float(common / max(min(s.t[-1] - s.t[0], o.t[-1] - o.t[0]), 1e-12))
        spans = f"{NAMES[a]} {s.t[0]:.6g} to {s.t[-1]:.6g} s, {NAMES[b]} {o.t[0]:.6g} to {o.t[-1]:.6g} s"
        if share <= 0:
            text = (
                f"{recording.source}: {spans}: no time in common. The clocks of one recording must share an origin: "
                "subtract the same start from all, or give them as recordings of their own"
            )
            issues.append(Issue("no-overlap", "fail", text, None, share, OVERLAP))
        elif share < OVERLAP:
            text = f"{recording.source}: {spans}: only {100 * share:.0f} % in common; check that t_s shares an origin"
            issues.append(Issue("little-overlap", "warn", text, None, share, OVERLAP))
    return issues
