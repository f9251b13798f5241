"""The attitude of a node through a recording: calibration applied, one clock, a filter run, and what to know of it.

What is done before the filter sees anything, in this order: readings to SI units (H and B of the calibration, or the
units of the columns); readings at the end of a sensor's range are taken as not measured; every sensor is brought to
the gyroscope's clock by interpolation, its delay corrected (the reading stamped t + delay was sensed at t), never
beyond its ends nor across a gap; rests give the gyroscope's bias, the length of gravity and the dip, the first of them
the attitude to start from. The filter works in ENU with y to magnetic north; other frames are made from it at the end.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from margcal.core import so3
from margcal.core.errors import InputError, UsageError
from margcal.core.types import Array, Attitude, Calibration, Issue, Kind, Mask, Recording, Stream
from margcal.methods.filters import DEFAULT, Filter, Surroundings, find_filter
from margcal.methods.tracking import ACC, GAP, MAG, NO_GYR, Flags, Track, measured_rate, to_earth, to_plain
from margcal.workflow.orient_start import Rests, find_rests, first_attitude, levelled, surroundings_of
from margcal.workflow.orient_streams import (
    NAMES,
    Samples,
    check_plausible,
    delays_to_correct,
    one_clock,
    si_streams,
)

Frame = Literal["enu", "ned", "nwu"]
Delays = Literal["file", "estimate", "none"]
Progress = Callable[[int, int], None]

_HALF = math.sqrt(0.5)
FRAMES: dict[str, tuple[float, float, float, float]] = {
    "enu": (1.0, 0.0, 0.0, 0.0),
    "ned": (0.0, _HALF, _HALF, 0.0),
    "nwu": (_HALF, 0.0, 0.0, -_HALF),
}
"""Quaternion that takes components from ENU to each earth frame."""

CHUNK = 20_000
"""Samples between two ticks of the progress bar."""

LOST_S = 0.5
"""Seconds without samples or rates after which a node may lie anyhow: its attitude is then read off again, not
corrected. A tilt that is off by a right angle is beyond what the corrections of a Kalman filter are made for."""

MOST_LOST = 0.05
"""Share of the samples before which time is missing from which a recording is slow, not broken."""

SLOWEST_HZ = 8.0
"""Rate of a gyroscope below which turns of a hand pass between its samples."""

DIP_OFF = 0.1
"""Median deviation (rad) of the field's dip, against the estimated vertical, from what it was at rest that is worth a
warning: a field in buildings bends by less."""


@dataclass(frozen=True)
class Orientation:
    """What `orient` returns.

    Attributes
    ----------
    attitude : Attitude
        Node to earth at the gyroscope's times, unit quaternions of continuous sign.
    variance : ndarray (N, 3), rad^2
        What the filter makes of its own noise model about east, north and up; NaN where it does not say. No bound:
        linear acceleration and bent fields last longer than noise, and real errors are several times larger.
    flags : ndarray (N,), uint8
        Bits of `methods.tracking`: `ACC`, `MAG` were used, `NO_GYR`, `GAP`.
    filter, frame : str
    params, state : dict
        The filter's, as plain lists and numbers: what is needed to go on later.
    figures : dict
        Numbers that the issues speak of: shares used, bias removed, delays, field, dip.
    issues : tuple of Issue
    """

    attitude: Attitude
    variance: Array = field(repr=False)
    flags: Flags = field(repr=False)
    filter: str
    frame: str
    params: Mapping[str, Any]
    state: Mapping[str, Any]
    figures: Mapping[str, Any]
    issues: tuple[Issue, ...]


def orient(
    recording: Recording,
    calibration: Calibration | None = None,
    *,
    filter: str = DEFAULT,
    frame: Frame = "enu",
    delays: Delays = "file",
    mag: bool = True,
    q0: ArrayLike | None = None,
    gyro_bias: Literal["rest", "none"] = "rest",
    progress: Progress | None = None,
) -> Orientation:
    """Attitudes of a node through a recording.

    Parameters
    ----------
    recording : Recording
        Raw, with the `calibration` that it fits, or in units that are known.
    calibration : Calibration, optional
    filter : str
        A name in `methods.filters.FILTERS`.
    frame : {'enu', 'ned', 'nwu'}
        The earth frame of the result (x, y, z: east, magnetic north, up; north, east, down; north, west, up).
    delays : {'file', 'estimate', 'none'}
        Correct those of the calibration file; or take the magnetometer's against the gyroscope from this recording
        (the others from the file); or correct none.
    mag : bool
        Use the magnetometer. Without it the heading starts at zero (or at that of `q0`) and drifts.
    q0 : array_like (4,), optional
        Attitude at the start, scalar first, in `frame`.
    gyro_bias : {'rest', 'none'}
        Subtract the gyroscope's mean over the rests of this recording, for filters that do not estimate it.
    progress : callable (done, total), optional

    Raises
    ------
    InputError
        No gyroscope, raw counts without calibration, a unit that the calibration does not take, or a package missing.
    DataError
        Sensors that have no time in common.
    UsageError
        A filter or frame that does not exist.
    """
    chosen = find_filter(filter)
    if frame not in FRAMES:
        raise UsageError(f"there is no frame {frame!r}; choose one of {', '.join(FRAMES)}")
    # what would stop a calibration (too many missing rows) is only worth a warning here
    issues = [replace(i, level="warn") if i.level == "fail" else i for i in recording.issues]
    recording = recording if mag else replace(recording, mag=None)
    streams, late = si_streams(recording, calibration, issues)
    _check_sensors(recording, streams, chosen, q0)
    if _no_field(streams.get("mag"), recording.source, issues):
        streams.pop("mag", None)
    check_plausible(streams, recording, calibration, issues)
    late = delays_to_correct(delays, streams, late, recording.source, issues)
    samples = one_clock(streams, late, recording.source, issues)
    known = calibration is not None and calibration.gyr is not None
    rests = find_rests(samples.t, samples.gyr, samples.acc, samples.mag, calibrated=known)
    bias = _bias(rests, chosen, gyro_bias, known, issues)
    gyr = samples.gyr - bias
    around = surroundings_of(samples.t, samples.acc, samples.mag, rests, issues)
    from_enu = np.array(FRAMES[frame])
    if q0 is not None:
        given = np.asarray(q0, dtype=np.float64)
        _check_quaternion(given)
        q, sd = so3.quat_multiply(so3.quat_conjugate(from_enu), given), (0.02, 0.02, 0.02)
    else:
        q, sd = first_attitude(samples.t, samples.acc, samples.mag, rests, around, issues)
    params = chosen.params(around)
    dt = np.diff(samples.t, prepend=samples.t[0])
    state = chosen.start(q, sd)
    track = _run(chosen, params, state, dt, gyr, samples, around.dip, progress)
    figures = _figures(track, samples, bias, late, around)
    issues += _told(chosen, track, samples, "mag" in streams)
    issues += _told_of_dip(track, samples, around.dip)
    turned = _continuous(so3.quat_multiply(from_enu, track.q))
    return Orientation(
        Attitude(samples.t, turned, parent=f"earth ({frame})", child="node"),
        track.variance,
        track.flags,
        chosen.name,
        frame,
        to_plain(params),
        to_plain(track.state),
        figures,
        tuple(issues),
    )


def _check_sensors(recording: Recording, streams: Mapping[Kind, Stream], chosen: Filter, q0: ArrayLike | None) -> None:
    if "gyr" not in streams:
        raise InputError(f"{recording.source}: holds no gyroscope, without which no attitude can be followed")
    if "acc" not in streams and not (chosen.name == "gyro" and q0 is not None):
        raise InputError(
            f"{recording.source}: holds no accelerometer, which tells what is up; with --filter gyro and a start "
            "attitude the gyroscope alone is integrated"
        )


def _no_field(mag: Stream | None, source: str, issues: list[Issue]) -> bool:
    """Whether the magnetometer shows no field at all: then there is none, and the heading is the gyroscope's."""
    if mag is None or not np.isfinite(mag.y).any() or np.nanmax(np.abs(mag.y)) > 0:
        return False
    issues.append(Issue("no-field", "warn", f"{source}: the magnetometer reads zero throughout; left out", "mag"))
    return True


def _check_quaternion(q: Array) -> None:
    if q.shape != (4,) or not np.all(np.isfinite(q)) or abs(np.linalg.norm(q) - 1) > 0.05:
        raise InputError("the attitude at the start is no unit quaternion (w, x, y, z)")


# --- the filter ---------------------------------------------------------------------------------------


def _bias(rests: Rests, chosen: Filter, how: str, calibrated: bool, issues: list[Issue]) -> Array:
    """What is left of the gyroscope's bias (3,) rad/s: from the rests, or zero."""
    if how not in ("rest", "none"):
        raise UsageError(f"gyro_bias {how!r} is neither rest nor none")
    if how == "none" or chosen.own_bias:
        return np.zeros(3)
    if rests.gyr_bias is None and calibrated:
        text = "no rest to take the gyroscope's bias from: that of the calibration is taken as it is"
        issues.append(Issue("no-rest", "note", text, "gyr"))
        return np.zeros(3)
    if rests.gyr_bias is None:
        text = (
            "no rest to take the gyroscope's bias from, so it was left as it is: let the node lie for two seconds at "
            "the start, or take --filter vqf, which estimates it in motion"
        )
        issues.append(Issue("no-rest", "warn", text, "gyr"))
        return np.zeros(3)
    size = math.degrees(float(np.linalg.norm(rests.gyr_bias)))
    text = f"the gyroscope's mean over {rests.seconds:.3g} s of rest, {size:.2g} deg/s, was subtracted"
    issues.append(Issue("gyro-bias", "note", text, "gyr", size))
    return rests.gyr_bias


def _run(
    chosen: Filter,
    params: Any,
    state: Any,
    dt: Array,
    gyr: Array,
    samples: Samples,
    dip: float,
    progress: Progress | None,
) -> Track:
    """The filter over all samples, in pieces where it can be paused, so that progress shows; begun anew where a gap is
    so long that the node may lie anyhow after it."""
    n, acc, mag = len(dt), samples.acc, samples.mag
    lost = _lost(samples.t, dt, gyr, params.gap) if chosen.corrects else np.zeros(0, dtype=np.intp)
    if chosen.own_bias or (n <= CHUNK and not len(lost)):
        return chosen.batch(params, state, dt, gyr, acc, mag)
    edges = np.union1d(np.arange(0, n, CHUNK), lost).astype(int)
    parts: list[Track] = []
    anew, usual = set(lost.tolist()), float(np.sort(dt)[n // 2])
    for a, b in zip(edges.tolist(), [*edges[1:].tolist(), n]):
        found = levelled(parts[-1].q[-1], samples, a, dip) if parts and a in anew else None
        if found is None:
            part = chosen.batch(params, state, dt[a:b], gyr[a:b], acc[a:b], mag[a:b])
        else:  # the gap is over: its length must not count again
            steps = dt[a:b].copy()
            steps[0] = min(steps[0], usual)
            part = chosen.batch(params, chosen.start(*found), steps, gyr[a:b], acc[a:b], mag[a:b])
            part.flags[0] |= GAP * np.uint8(dt[a] > params.gap)
        parts.append(part)
        state = part.state
        if progress is not None:
            progress(b, n)
    q, variance, flags = (np.concatenate([getattr(p, name) for p in parts]) for name in ("q", "variance", "flags"))
    return Track(q, variance, flags, state)


def _lost(t: Array, dt: Array, gyr: Array, gap: float) -> NDArray[np.intp]:
    """Samples before which the rate was unknown for longer than a node stays as it is."""
    after = np.flatnonzero(dt > max(LOST_S, gap))
    first, stop = _runs(~measured_rate(gyr))
    inside = stop < len(t)
    first, stop = first[inside], stop[inside]
    blind = stop[t[stop] - t[np.maximum(first - 1, 0)] > LOST_S]
    return np.union1d(after, blind) if len(after) < MOST_LOST * len(t) else blind[:0]


def _continuous(q: Array) -> Array:
    """Quaternions with the sign that makes each the neighbour of the one before; the first has w >= 0."""
    flips = np.where(np.sum(q[1:] * q[:-1], axis=1) < 0, -1.0, 1.0)
    sign = np.concatenate([[-1.0 if q[0, 0] < 0 else 1.0], flips])
    return q * np.cumprod(sign)[:, None]


# --- what to know of it -------------------------------------------------------------------------------


def _figures(
    track: Track, samples: Samples, bias: Array, late: Mapping[Kind, float], around: Surroundings
) -> dict[str, Any]:
    n = len(track.q)
    last = track.variance[-1]
    return {
        "samples": n,
        "seconds": float(samples.t[-1] - samples.t[0]),
        "used": {"acc": float(np.mean(track.flags & ACC > 0)), "mag": float(np.mean(track.flags & MAG > 0))},
        "gaps": int(np.count_nonzero(track.flags & GAP)),
        "without_rate": int(np.count_nonzero(track.flags & NO_GYR)),
        "gyro_bias_dps": np.degrees(bias).tolist(),
        "delays_s": dict(late),
        "gravity": around.gravity,
        "field": around.field if np.isfinite(samples.mag).any() else None,
        "dip_deg": math.degrees(around.dip) if np.isfinite(samples.mag).any() else None,
        "end_sd_deg": None if np.isnan(last).any() else np.degrees(np.sqrt(last)).tolist(),
    }


def _told(chosen: Filter, track: Track, samples: Samples, has_mag: bool) -> list[Issue]:
    """Issues of what happened on the way."""
    issues = []
    after = (
        "the seconds after it are spent finding it again"
        if chosen.corrects
        else "what the node turned meanwhile is missing from all that follows"
    )
    rate = (len(samples.t) - 1) / (samples.t[-1] - samples.t[0]) if len(samples.t) > 2 else SLOWEST_HZ
    if rate < SLOWEST_HZ:
        text = (
            f"the gyroscope was sampled {rate:.2g} times a second: turns pass between its samples, and the attitude is "
            "right only while the node turns slowly; record 20 samples a second or more"
        )
        issues.append(Issue("slow-gyroscope", "warn", text, "gyr", rate, SLOWEST_HZ))
    gap = np.flatnonzero(track.flags & GAP)
    if len(gap):
        step = np.diff(samples.t, prepend=samples.t[0])[gap]
        text = (
            f"{len(gap)} gap{'s' if len(gap) > 1 else ''} in the gyroscope, the longest {step.max():.3g} s: the "
            f"attitude is held across each, and {after}"
        )
        issues.append(Issue("gaps", "warn", text, "gyr", float(step.max())))
    blind = _longest(samples.t, track.flags & NO_GYR > 0)
    if blind > 0:
        text = f"the rate is not known for up to {blind:.3g} s on end: the attitude is held, and {after}"
        issues.append(Issue("no-rate", "warn", text, "gyr", blind))
    if not chosen.corrects:
        text = "the gyroscope alone: the attitude drifts away from the first one"
        return [*issues, Issue("drifts", "note", text, "gyr")]
    if not has_mag:
        text = "no magnetometer: the heading is relative to the start and drifts with the gyroscope"
        issues.append(Issue("heading-drifts", "note", text, "mag"))
    else:
        issues += _told_of("mag", track, samples.t, MAG, "the heading is the gyroscope's meanwhile")
    if np.isfinite(samples.acc).any():
        issues += _told_of("acc", track, samples.t, ACC, "the tilt is the gyroscope's meanwhile")
    return issues


def _told_of(kind: Kind, track: Track, t: Array, bit: int, then: str) -> list[Issue]:
    unused = track.flags & bit == 0
    # a sample after a gap does not count for the time that is missing before it
    share, longest = float(np.mean(unused)), _longest(t, unused & (track.flags & GAP == 0))
    if share < 0.05 and longest < 2.0:
        return []
    text = (
        f"the {NAMES[kind]} was not used in {100 * share:.3g} % of the samples, {longest:.3g} s on end at most "
        f"(missing, or not the length or direction that it should have): {then}"
    )
    return [Issue(f"{kind}-not-used", "warn", text, kind, share, 0.05)]


def _told_of_dip(track: Track, samples: Samples, dip: float) -> list[Issue]:
    """Whether the field keeps its angle to the vertical: it does not where an axis is mirrored, swapped or off."""
    seen = np.flatnonzero(np.isfinite(samples.mag).all(axis=1) & (track.flags & ACC > 0))
    seen = seen[:: max(1, len(seen) // 5000)]
    h = to_earth(track.q[seen], samples.mag[seen])
    level = np.hypot(h[:, 0], h[:, 1])
    h, level = h[level + np.abs(h[:, 2]) > 0], level[level + np.abs(h[:, 2]) > 0]
    if not len(h):
        return []
    issues = []
    off = float(np.sort(np.abs(np.arctan2(-h[:, 2], level) - dip))[len(h) // 2])
    if off > DIP_OFF:
        text = (
            f"the field's angle to the horizon moves with the attitude, by {math.degrees(off):.2g} deg in half of the "
            "samples: the magnetometer is not calibrated, an axis of it is mirrored or swapped, or the field is bent; "
            "the heading is not to be trusted"
        )
        issues.append(Issue("mag-disagrees", "warn", text, "mag", off, DIP_OFF))
    elif dip < 0:
        text = (
            "the field points upwards, as it does south of the magnetic equator; north of it all three axes of the "
            "magnetometer are reversed and the heading is off by 180 deg"
        )
        issues.append(Issue("field-upwards", "note", text, "mag", math.degrees(dip)))
    return issues


def _longest(t: Array, mask: Mask) -> float:
    """Seconds of the longest run of True; a single sample counts for the step before it."""
    first, stop = _runs(mask)
    if not len(first):
        return 0.0
    return float(np.max(t[stop - 1] - t[np.maximum(first - 1, 0)]))


def _runs(mask: Mask) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First index of every run of True, and the index after its last."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return edges[::2], edges[1::2]
