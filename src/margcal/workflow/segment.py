"""Rests and turns: when the node lay still, what each sensor read there, and the turns in between.

There is no threshold to tune: the noise floor comes from the recording itself. A window is still when its
scatter is within `STILL_RATIO` of the scatter of the quietest windows; that quietest scatter counts as noise
only if it is of the size of the sample-to-sample noise (a swing has quiet windows too, but they are all
motion). Two stretches of one attitude with a short disturbance between them are one rest that was knocked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from margcal.core import compiled, so3
from margcal.core.errors import UsageError
from margcal.core.types import Array, Issue, Kind, Poses, Recording, Stream, Turn
from margcal.core.units import KINDS

MIN_REST_S = 1.0
"""Shortest rest, s."""
WINDOW_S = 0.3
"""Window of the stillness test, s: long enough for a scatter good to 10 % at 100 Hz, short beside a rest."""
STEP_S = 0.05
"""Grid of the stillness test, s."""
STILL_RATIO = 5.0
"""Scatter over noise floor up to which a window is still. Measured: a node on a table 1.0-1.7, in a resting
hand 5-20 (gyroscope), being turned 90-400; anything from 4 to 5 finds the same rests in the recordings of
`imu_tk`, `imucal` and `mikoff`."""
HELD_RATIO = 20.0
"""The same for a node that rests in a hand; taken only where it finds clearly more rests (see `_find_rests`)."""
FEW_RESTS = 12
"""With this many rests on a table nobody looks for held ones."""
FLOOR_QUANTILE = 0.03
"""The quietest 3 % of one-second windows give the noise floor: rests fill more than that."""
NOISE_LIKE = 6.0
"""Floor over sample-to-sample noise up to which the floor is noise (measured: rests 1.0-3.5, swings 15-90)."""
MAX_KNOCK_S = 2.0
"""Longest disturbance that may lie inside one rest, s."""
SAME_ATTITUDE = 0.03
"""Change across a knock, relative to the spread over the recording, up to which the attitude is the same."""
MAX_TURN_S = 30.0
"""Longest motion over which the gyroscope is integrated, s."""
GAP_PERIODS = 5.0
"""A hole in time of more than this many sampling periods is a gap: nothing is integrated across it."""


Floors = dict[Kind, float]
"""Scatter of each sensor at rest (norm over its axes, raw unit); NaN where it is never at rest."""


@dataclass(frozen=True)
class Segmentation:
    """The rests and turns of one or several recordings, pooled, and what was noticed on the way."""

    poses: Poses
    turns: tuple[Turn, ...]
    issues: tuple[Issue, ...]


@dataclass(frozen=True)
class _Rest:
    """One rest: the still stretches ``(start, stop)`` s that it is made of; what lies between is knocks."""

    stretches: tuple[tuple[float, float], ...]

    @property
    def start(self) -> float:
        return self.stretches[0][0]

    @property
    def stop(self) -> float:
        return self.stretches[-1][1]

    @property
    def still_s(self) -> float:
        return sum(b - a for a, b in self.stretches)


def find_poses(*recordings: Recording) -> Segmentation:
    """Rests (1 s or longer) and the turns between them, pooled over the recordings of one node.

    Parameters
    ----------
    *recordings : Recording

    Returns
    -------
    Segmentation
        `poses` may be empty: a swing has none. Nothing is integrated across recordings.
    """
    if not recordings:
        raise UsageError("no recording to find rests in")
    tables, turns, issues, offset = [], [], [], 0
    for index, recording in enumerate(map(measured, recordings)):
        rests, held = _find_rests(recording)
        tables.append(_measure(recording, rests, index))
        found, noted = _find_turns(recording, rests, offset)
        turns += found
        issues += noted
        if held:
            text = (
                f"{recording.source}: the node rested in a hand, not on a table; its rests scatter up to "
                f"{HELD_RATIO:.0f} times the sensor noise. Put it down for better results"
            )
            issues.append(Issue("held-rests", "note", text))
        knocked = np.flatnonzero(tables[-1].knocks) + offset + 1
        if len(knocked):
            numbers = ", ".join(map(str, knocked))
            text = f"{recording.source}: rest {numbers}: a knock was cut out; the rest counts as one"
            issues.append(Issue("knocked-rest", "note", text, value=float(len(knocked))))
        offset += len(rests)
    return Segmentation(_pool(tables), tuple(turns), tuple(issues))


def measured(recording: Recording) -> Recording:
    """The recording without rows in which nothing was measured (NaN); they become gaps in time."""
    kept: dict[str, Stream | None] = {}
    for kind, stream in recording.streams.items():
        seen = np.isfinite(stream.y).all(axis=1)
        if not seen.all():
            kept[kind] = replace(stream, t=stream.t[seen], y=stream.y[seen]) if seen.sum() > 1 else None
    return replace(recording, **kept) if kept else recording


# --- stillness ---------------------------------------------------------------------------------------


def _scatter(t: Array, y: Array, centres: Array, width: float) -> Array:
    """Scatter (norm over the axes) of the samples within `width` s of each centre; NaN where fewer than four
    samples or a gap lie there."""
    kernels = compiled.extension()
    if kernels is not None and len(t) > 1 and width > 0:
        sd = np.empty(len(centres))
        kernels.moving_scatter(t, np.ascontiguousarray(y), centres, width, sd)
        return sd
    lo = np.searchsorted(t, centres - width / 2)
    hi = np.searchsorted(t, centres + width / 2)
    n = hi - lo
    y = y - y[:: 1 + len(y) // 1024].mean(axis=0)  # sums of squares stay small beside their variance
    sums = np.vstack([np.zeros(3), np.cumsum(y, axis=0)])
    squares = np.concatenate([[0.0], np.cumsum(y[:, 0] ** 2 + y[:, 1] ** 2 + y[:, 2] ** 2)])
    total = sums[hi] - sums[lo]
    within = squares[hi] - squares[lo] - np.einsum("ni,ni->n", total, total) / np.maximum(n, 1)
    sd = np.sqrt(np.maximum(within, 0.0) / np.maximum(n - 1, 1))
    expected = width / np.median(np.diff(t))
    sd[(n < 4) | (n < 0.5 * expected)] = np.nan
    return sd


def noise_floor(stream: Stream) -> float:
    """Scatter of the sensor at rest (norm over the axes, raw unit), from the recording itself.

    Returns
    -------
    float
        NaN where even the quietest windows are motion and not noise.
    """
    t, y = stream.t, stream.y
    if len(t) < 8 or t[-1] - t[0] < MIN_REST_S:
        return float("nan")
    centres = np.arange(t[0] + 0.5, t[-1] - 0.5 + 1e-9, 5 * STEP_S)
    slow = _scatter(t, y, centres, 1.0)
    curvature = (y[:-2] - 2 * y[1:-1] + y[2:]) / np.sqrt(6.0)  # white noise keeps its sd, motion vanishes
    fast = _scatter(t[1:-1], curvature, centres, 1.0)
    if not np.isfinite(slow).any():
        return float("nan")
    floor = float(np.nanquantile(slow, FLOOR_QUANTILE))
    quantised = quantum(y) * np.sqrt(3 / 12)
    quiet = slow <= 1.5 * floor
    noise = max(float(np.nanmedian(fast[quiet])), quantised)
    return max(floor, quantised) if floor <= NOISE_LIKE * noise else float("nan")


def quantum(y: Array) -> float:
    """Least significant bit: the smallest step between neighbouring values (0 if the data are continuous)."""
    values = np.unique(y[:20_000, 0])
    steps = np.diff(values)
    return float(np.min(steps)) if len(steps) else 0.0


def _watched(recording: Recording) -> list[Stream]:
    """The streams that tell motion: accelerometer and gyroscope, which a passing magnet does not move; where
    one of them is missing, all there are."""
    both = [s for s in (recording.acc, recording.gyr) if s is not None]
    return both if len(both) == 2 else list(recording.streams.values())


def _still(recording: Recording, floors: Floors, ratio: float) -> tuple[Array, Array]:
    """Grid (s) and whether the node was still there, by every stream that tells motion."""
    streams = _watched(recording)
    start = max((s.t[0] for s in streams), default=0.0)
    stop = min((s.t[-1] for s in streams), default=0.0)
    if stop - start < WINDOW_S:
        return np.zeros(0), np.zeros(0, dtype=bool)
    grid = np.arange(start + WINDOW_S / 2, stop - WINDOW_S / 2 + 1e-9, STEP_S)
    still = np.ones(len(grid), dtype=bool)
    for stream in streams:
        sd = _scatter(stream.t, stream.y, grid, max(WINDOW_S, 8 / stream.rate))
        with np.errstate(invalid="ignore"):
            still &= sd < ratio * floors[stream.kind]  # NaN is never still
    return grid, still


def _runs(mask: Array) -> list[tuple[int, int]]:
    """First and last index of every run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    return [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2])]


def _find_rests(recording: Recording) -> tuple[list[_Rest], bool]:
    """The rests, and whether the node had to be taken as held in a hand to find enough of them."""
    floors: Floors = {kind: noise_floor(stream) for kind, stream in recording.streams.items()}
    rests = _rests_at(recording, floors, STILL_RATIO)
    if 1 <= len(rests) < FEW_RESTS:
        held = _rests_at(recording, floors, HELD_RATIO)
        if len(held) >= len(rests) + 3:
            return held, True
    return rests, False


def _rests_at(recording: Recording, floors: Floors, ratio: float) -> list[_Rest]:
    grid, still = _still(recording, floors, ratio)
    if not still.any():
        return []
    half = WINDOW_S / 2
    stretches = [(float(grid[a]) - half, float(grid[b]) + half) for a, b in _runs(still)]
    # the stillness test lets the onset of motion reach a little into its window: leave the edges out
    edge = WINDOW_S / 4
    rests = []
    for rest in _join_knocked(recording, floors, stretches):
        trimmed = tuple((a + edge, b - edge) for a, b in rest.stretches if b - a > 2 * edge + 0.1)
        if rest.still_s >= MIN_REST_S and trimmed:
            rests.append(_Rest(trimmed))
    return [r for r in rests if not _drifts(recording, floors, ratio, r)]


def _join_knocked(recording: Recording, floors: Floors, stretches: Sequence[tuple[float, float]]) -> list[_Rest]:
    """Join neighbouring stretches of one attitude that a short disturbance separates."""
    spread = _spread(recording, stretches)
    rests: list[_Rest] = []
    for stretch in stretches:
        if rests:
            last = rests[-1].stretches[-1]
            short = stretch[0] - last[1] <= MAX_KNOCK_S
            if short and _same_attitude(recording, floors, last, stretch, spread):
                rests[-1] = _Rest((*rests[-1].stretches, stretch))
                continue
        rests.append(_Rest((stretch,)))
    return rests


def _between(stream: Stream, span: tuple[float, float]) -> slice:
    lo, hi = np.searchsorted(stream.t, span)
    return slice(int(lo), int(hi))


def _mean(stream: Stream, span: tuple[float, float]) -> Array:
    part = stream.y[_between(stream, span)]
    return part.mean(axis=0) if len(part) else np.full(3, np.nan)


def _integral(stream: Stream, start: float, stop: float, bias: Array) -> Array:
    """Integral of the reading less `bias` over time, raw unit times s."""
    part = _between(stream, (start, stop))
    t, y = stream.t[part], stream.y[part]
    if len(t) < 2:
        return np.zeros(3)
    return ((y - bias) * np.gradient(t)[:, None]).sum(axis=0)


def _spread(recording: Recording, stretches: Sequence[tuple[float, float]]) -> dict[Kind, float]:
    """How far each sensor moves over the recording: half the largest range of its readings at rest
    (gyroscope: the median integral between long rests), the yardstick for "the same attitude"."""
    spread: dict[Kind, float] = {}
    long = [s for s in stretches if s[1] - s[0] >= MIN_REST_S]
    for kind, stream in recording.streams.items():
        if len(long) < 2:
            continue
        means = np.array([_mean(stream, s) for s in long])
        if kind == "gyr":
            bias = np.nanmedian(means, axis=0)
            moved = [np.linalg.norm(_integral(stream, a[1], b[0], bias)) for a, b in pairwise(long)]
            spread[kind] = float(np.median(moved))
        else:
            spread[kind] = float(np.nanmax(np.ptp(means, axis=0)) / 2)
    return spread


def _same_attitude(
    recording: Recording,
    floors: Floors,
    a: tuple[float, float],
    b: tuple[float, float],
    spread: dict[Kind, float],
) -> bool:
    """Whether accelerometer, magnetometer and integrated gyroscope say that nothing was turned from a to b."""
    for kind, stream in recording.streams.items():
        before, after = _mean(stream, a), _mean(stream, b)
        if kind == "gyr":
            change = np.linalg.norm(_integral(stream, a[1], b[0], (before + after) / 2))
            noise = 0.0
        else:
            change = np.linalg.norm(after - before)
            floor = floors[kind]
            n = min(_count(stream, a), _count(stream, b))
            noise = 5 * floor / np.sqrt(max(n, 1)) if np.isfinite(floor) else 0.0
        if change > SAME_ATTITUDE * spread.get(kind, np.inf) + noise:
            return False
    return True


def _count(stream: Stream, span: tuple[float, float]) -> int:
    part = _between(stream, span)
    return part.stop - part.start


def _drifts(recording: Recording, floors: Floors, ratio: float, rest: _Rest) -> bool:
    """Whether accelerometer or magnetometer turns steadily through the "rest": a slow turn, not a rest.

    Its means over the first and the last third must agree within half of the scatter that counts as still. (The
    magnetometer is asked only where it tells motion: a passing magnet is no turn.)
    """
    third = (rest.stop - rest.start) / 3
    for stream in _watched(recording):
        if stream.kind == "gyr":
            continue
        first = _mean(stream, (rest.start, rest.start + third))
        last = _mean(stream, (rest.stop - third, rest.stop))
        if np.linalg.norm(last - first) > 0.5 * ratio * floors[stream.kind]:
            return True
    return False


# --- what the sensors read ---------------------------------------------------------------------------


def _measure(recording: Recording, rests: Sequence[_Rest], index: int) -> Poses:
    """Mean, scatter and count of every sensor, and the mean reference attitude, over each rest."""
    mean: dict[Kind, Array] = {}
    sd: dict[Kind, Array] = {}
    count: dict[Kind, Array] = {}
    for kind, stream in recording.streams.items():
        rows = [np.concatenate([stream.y[_between(stream, s)] for s in r.stretches]) for r in rests]
        mean[kind] = np.array([x.mean(axis=0) if len(x) else np.full(3, np.nan) for x in rows]).reshape(-1, 3)
        sd[kind] = np.array([x.std(axis=0, ddof=1) if len(x) > 1 else np.full(3, np.nan) for x in rows])
        sd[kind] = sd[kind].reshape(-1, 3)
        count[kind] = np.array([len(x) for x in rows], dtype=np.float64)
    return Poses(
        start=np.array([r.start for r in rests]),
        stop=np.array([r.stop for r in rests]),
        recording=(index,) * len(rests),
        mean=mean,
        sd=sd,
        count=count,
        knocks=np.array([len(r.stretches) - 1 for r in rests], dtype=np.float64),
        q_ref=_mean_reference(recording, rests),
    )


def _mean_reference(recording: Recording, rests: Sequence[_Rest]) -> Array | None:
    """Mean of the reference attitude over each rest, (J, 4) scalar first; NaN where it was not seen."""
    ref = recording.reference
    if ref is None:
        return None
    out = np.full((len(rests), 4), np.nan)
    for j, rest in enumerate(rests):
        inside = np.zeros(len(ref.t), dtype=bool)
        for a, b in rest.stretches:
            inside |= (ref.t >= a) & (ref.t <= b)
        q = ref.q[inside]
        q = q[np.isfinite(q).all(axis=1)]
        if len(q):
            out[j] = so3.quat_from_matrix(so3.mean_rotation(so3.matrix_from_quat(q)))
    return out


def _pool(tables: Sequence[Poses]) -> Poses:
    """One table of the rests of all recordings; NaN where a recording lacks a sensor."""
    if len(tables) == 1:
        return tables[0]
    kinds: list[Kind] = [k for k in KINDS if any(k in p.mean for p in tables)]

    def stack(name: str, kind: Kind, shape: tuple[int, ...], fill: float) -> Array:
        parts = [getattr(p, name).get(kind, np.full((len(p), *shape), fill)) for p in tables]
        return np.concatenate(parts)

    has_ref = any(p.q_ref is not None for p in tables)
    refs = [p.q_ref if p.q_ref is not None else np.full((len(p), 4), np.nan) for p in tables]
    return Poses(
        start=np.concatenate([p.start for p in tables]),
        stop=np.concatenate([p.stop for p in tables]),
        recording=tuple(i for p in tables for i in p.recording),
        mean={k: stack("mean", k, (3,), np.nan) for k in kinds},
        sd={k: stack("sd", k, (3,), np.nan) for k in kinds},
        count={k: stack("count", k, (), 0.0) for k in kinds},
        knocks=np.concatenate([p.knocks for p in tables]),
        q_ref=np.concatenate(refs) if has_ref else None,
    )


def measure_spans(recordings: Sequence[Recording], spans: Sequence[tuple[int, float, float]]) -> Segmentation:
    """Rests that the user names: ``(recording index, start s, stop s)`` each, in order of time.

    Used for ``--poses FILE`` with ``start_s stop_s``: nothing is searched for, the spans are taken as they are.
    """
    tables, turns, issues, offset = [], [], [], 0
    for index, recording in enumerate(map(measured, recordings)):
        rests = [_Rest(((a, b),)) for i, a, b in spans if i == index]
        tables.append(_measure(recording, rests, index))
        found, noted = _find_turns(recording, rests, offset)
        turns += found
        issues += noted
        offset += len(rests)
    return Segmentation(_pool(tables), tuple(turns), tuple(issues))


# --- turns -------------------------------------------------------------------------------------------


def _find_turns(recording: Recording, rests: Sequence[_Rest], offset: int) -> tuple[list[Turn], list[Issue]]:
    """The gyroscope between neighbouring rests; motions with a gap or longer than `MAX_TURN_S` are left out."""
    if recording.gyr is None:
        return [], []
    turns, gaps = [], []
    for i, (a, b) in enumerate(pairwise(rests)):
        turn = _cut_turn(recording.gyr, a.stop, b.start, offset + i)
        if turn is None:
            gaps.append(offset + i + 1)
        elif turn.t[-1] - turn.t[0] <= MAX_TURN_S:
            turns.append(turn)
    if not gaps:
        return turns, []
    numbers = ", ".join(f"{i}-{i + 1}" for i in gaps)
    text = f"{recording.source}: the gyroscope has a gap in the turn between rests {numbers}; it is left out"
    return turns, [Issue("gap-in-turn", "warn", text, "gyr", float(len(gaps)))]


def _cut_turn(gyr: Stream, start: float, stop: float, before: int) -> Turn | None:
    """Samples from `start` to `stop`, each standing for the time up to half-way to its neighbours."""
    lo, hi = np.searchsorted(gyr.t, (start, stop))
    lo, hi = max(int(lo), 1), min(int(hi), len(gyr.t) - 1)
    if hi - lo < 2:
        return None
    t = gyr.t[lo:hi]
    middles = (gyr.t[lo - 1 : hi] + gyr.t[lo : hi + 1]) / 2
    if np.max(np.diff(gyr.t[lo - 1 : hi + 1])) > GAP_PERIODS / gyr.rate:
        return None
    return Turn(before, before + 1, t, gyr.y[lo:hi], np.diff(middles))


def drop_poses(segmentation: Segmentation, keep: Array) -> Segmentation:
    """The segmentation with only the rests of the boolean mask `keep` and the turns between two kept ones."""
    number = np.cumsum(keep) - 1
    turns = tuple(
        replace(t, before=int(number[t.before]), after=int(number[t.after]))
        for t in segmentation.turns
        if keep[t.before] and keep[t.after]
    )
    return replace(segmentation, poses=segmentation.poses.select(keep), turns=turns)
