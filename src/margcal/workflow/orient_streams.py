"""Readings for an orientation filter: SI units, ends of the range taken out, delays corrected, all on one clock."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from margcal.core.errors import DataError, InputError, UsageError
from margcal.core.types import Array, Calibration, Issue, Kind, Recording, Stream
from margcal.core.units import SI_COLUMN, UNITS
from margcal.workflow.lint_scale import clip_limits
from margcal.workflow.lint_units import TURN_RATIO, lint_units, turn_ratio

NAMES = {"acc": "accelerometer", "gyr": "gyroscope", "mag": "magnetometer"}

LONGEST_GAP = 5.0
"""Sampling periods of a sensor across which its readings are interpolated, as in `apply`."""

DELAY_SE_S = 2e-3
"""A delay that is known no better is not corrected."""

DELAY_EXPLAINED = 0.5
"""Share of the field's turning that the gyroscope must explain before a delay between the two means anything."""


LARGEST = 1e15
"""Readings beyond this come from no converter, and their squares from no arithmetic."""

SLOWER = 1.5
"""A sensor that is measured in fewer of a table's rows than one in so many has a rate of its own."""


@dataclass(frozen=True)
class Samples:
    """All sensors at the gyroscope's times; NaN where one has nothing to say."""

    t: Array
    gyr: Array
    acc: Array
    mag: Array


def si_streams(
    recording: Recording, calibration: Calibration | None, issues: list[Issue]
) -> tuple[dict[Kind, Stream], dict[Kind, float]]:
    """Streams in SI units without readings at the end of their range, and the delays of the calibration file."""
    models = {} if calibration is None else calibration.models
    streams: dict[Kind, Stream] = {}
    delays: dict[Kind, float] = {}
    for kind, raw in recording.streams.items():
        y = _without_clipped(raw, recording.source, issues)
        if not np.max(np.abs(y)) <= LARGEST:
            with np.errstate(invalid="ignore"):
                y = np.where(np.abs(y) <= LARGEST, y, np.nan)
        model = models.get(kind)
        if model is not None:
            if raw.unit != model.raw_unit:
                raise InputError(
                    f"{recording.source}: {kind} is in {raw.unit}, the calibration takes {model.raw_unit}; give the "
                    "recording that it fits, or no calibration if this one is calibrated already"
                )
            streams[kind] = Stream(kind, raw.t, model.apply(y), SI_COLUMN[model.unit])
            delays[kind] = model.delay_s or 0.0
            continue
        factor = 1.0 if raw.unit == "norm" else UNITS[kind].get(raw.unit)
        if factor is None:
            what = "there is no calibration" if calibration is None else "the calibration does not hold it"
            without = ", or go without it (--no-mag)" if kind == "mag" else ""
            raise InputError(
                f"{recording.source}: the {NAMES[kind]} is in {raw.unit} and {what}: calibrate the node first (margcal "
                f"calibrate), or name the unit if the readings have one (--units){without}"
            )
        if calibration is not None:
            text = f"{recording.source}: the {NAMES[kind]} is not in the calibration; taken as it is"
            issues.append(Issue("not-calibrated", "warn", text, kind))
        unit = {"acc": "mps2", "gyr": "radps", "mag": "norm" if raw.unit == "norm" else "uT"}[kind]
        streams[kind] = Stream(kind, raw.t, y * factor, unit)
    return streams, delays


def check_plausible(
    streams: Mapping[Kind, Stream], recording: Recording, calibration: Calibration | None, issues: list[Issue]
) -> None:
    """Refuse readings that cannot be what their unit, or the calibration, says; name an axis that stands still.

    Raises
    ------
    InputError
        Gravity or field of an impossible length, or gravity that turns at another rate than the gyroscope's.
    DataError
        An accelerometer from which gravity was taken, or a gyroscope that does not turn when the node does.
    """
    where, calibrated = recording.source, set() if calibration is None else set(calibration.models)
    # of a sensor that was not calibrated the readings as they were recorded, so that the text names their unit
    seen = {k: s if k in calibrated else recording.streams[k] for k, s in streams.items()}
    for kind, stream in streams.items():
        if not np.isfinite(stream.y.sum()):
            seen[kind] = replace(seen[kind], y=np.where(np.isfinite(stream.y), seen[kind].y, np.nan))
    for issue in lint_units(Recording(**seen, source=where)):  # type: ignore[arg-type]
        if issue.code.endswith("-unit"):
            kind = next(k for k in NAMES if issue.code.startswith(k))
            of = f"{issue.text.partition(';')[0]} after the calibration: it is of another node or of another range"
            raise InputError(of if kind in calibrated else issue.text)
        if issue.code == "no-gravity" and issue.value:
            raise DataError(issue.text, (issue,))
    ratio = turn_ratio(seen["acc"], seen["gyr"]) if _enough(streams) else None
    if ratio is not None and not 1 / TURN_RATIO < ratio < TURN_RATIO:
        text = (
            f"{where}: gravity turns {ratio:.3g} times as fast as the gyroscope says: the gyroscope is dead, of "
            "another clock or unit, or its calibration is of another node or range"
        )
        raise DataError(text, (Issue("gyr-turns", "fail", text, "gyr", ratio, TURN_RATIO),))
    issues += [i for k, s in streams.items() for i in _standing(k, s, where)]


def _enough(streams: Mapping[Kind, Stream]) -> bool:
    """Whether accelerometer and gyroscope are there to be compared, without holes."""
    pair = [streams.get(k) for k in ("acc", "gyr")]
    return all(s is not None and len(s.t) >= 16 and bool(np.isfinite(s.y.sum())) for s in pair)


def _standing(kind: Kind, stream: Stream, source: str) -> list[Issue]:
    few = stream.y[:: max(1, len(stream.y) // 64)]
    few = few[np.isfinite(few).all(axis=1)]
    if len(few) and not np.any(np.ptp(few, axis=0) == 0):
        return []  # seen at a glance: the whole stream takes long
    y = stream.y[np.isfinite(stream.y).all(axis=1)]
    still = np.ptp(y, axis=0) == 0 if len(y) >= 16 else np.zeros(3, dtype=bool)
    if not still.any() or still.all():
        return []
    names = " and ".join(a for a, s in zip("xyz", still) if s)
    text = f"{source}: the {NAMES[kind]}'s {names} stands at one value throughout while other axes move: is it alive?"
    return [Issue("stuck-axis", "warn", text, kind)]


def _without_clipped(stream: Stream, source: str, issues: list[Issue]) -> Array:
    """Readings with NaN where an axis stands at the end of its range."""
    low, high = clip_limits(stream)
    if not (np.isfinite(low).any() or np.isfinite(high).any()):
        return stream.y
    with np.errstate(invalid="ignore"):
        clipped = np.any((stream.y <= low) | (stream.y >= high), axis=1)
    count = int(clipped.sum())
    if not count:
        return stream.y
    text = (
        f"{source}: {count} readings of the {NAMES[stream.kind]} are at the end of its range and were taken as not "
        "measured; set a larger range, or move more slowly"
    )
    issues.append(Issue("saturated", "warn", text, stream.kind, count / len(clipped)))
    return np.where(clipped[:, None], np.nan, stream.y)


def delays_to_correct(
    how: str, streams: Mapping[Kind, Stream], file: dict[Kind, float], source: str, issues: list[Issue]
) -> dict[Kind, float]:
    """Delay by sensor that is to be corrected, s."""
    if how not in ("file", "estimate", "none"):
        raise UsageError(f"delays {how!r} is none of file, estimate, none")
    if how == "none":
        return {}
    late: dict[Kind, float] = {k: d for k, d in file.items() if d and k in streams}
    if how == "file" or "mag" not in streams:
        return late
    found = _magnetometer_delay(streams["mag"], streams["gyr"], source, issues)
    if found is not None:
        late["mag"] = late.get("gyr", 0.0) + found
    return late


def _magnetometer_delay(mag: Stream, gyr: Stream, source: str, issues: list[Issue]) -> float | None:
    """How far the magnetometer is behind the gyroscope, by following the field with the gyroscope (`methods.rates`)."""
    from margcal.methods.rates import relate

    good_m, good_g = np.isfinite(mag.y).all(axis=1), np.isfinite(gyr.y).all(axis=1)
    length = float(np.median(np.linalg.norm(mag.y[good_m], axis=1))) if good_m.any() else 0.0
    why = "the field does not turn"
    if length > 0:
        try:
            found = relate(mag.t[good_m], mag.y[good_m] / length, gyr.t[good_g], gyr.y[good_g])
        except DataError as error:
            why = str(error)
        else:
            if found.delay_se_s <= DELAY_SE_S and found.explained >= DELAY_EXPLAINED:
                text = (
                    f"{source}: the magnetometer is {1e3 * found.delay_s:.1f} +- {1e3 * found.delay_se_s:.1f} ms "
                    "behind the gyroscope, told by the motion; corrected"
                )
                issues.append(Issue("mag-delay", "note", text, "mag", found.delay_s))
                return found.delay_s
            why = (
                f"the motion tells it to {1e3 * found.delay_se_s:.1f} ms only, and the gyroscope explains "
                f"{100 * found.explained:.0f} % of the field's turning"
            )
    text = f"{source}: the magnetometer's delay cannot be told from this recording ({why}); none was corrected"
    issues.append(Issue("no-mag-delay", "warn", text, "mag"))
    return None


# --- one clock ----------------------------------------------------------------------------------------


def one_clock(streams: Mapping[Kind, Stream], late: Mapping[Kind, float], source: str, issues: list[Issue]) -> Samples:
    t = streams["gyr"].t
    at: dict[Kind, Array] = {}
    for kind in ("gyr", "acc", "mag"):
        stream = streams.get(kind)
        at[kind] = np.full((len(t), 3), np.nan) if stream is None else _at(t, stream, late.get(kind, 0.0))
        if stream is not None and not np.isfinite(at[kind][:, 0]).any():
            raise DataError(
                f"{source}: the {NAMES[kind]} has no usable reading in the time of the gyroscope; check the clocks of "
                "the tables, they must share an origin",
                (Issue("no-overlap", "fail", f"{NAMES[kind]}: no reading in the time of the gyroscope", kind),),
            )
    for kind in streams:
        share = 1 - float(np.isfinite(at[kind]).all(axis=1).mean())
        if share > 0.01:
            text = (
                f"{source}: the {NAMES[kind]} has nothing to say in {100 * share:.2g} % of the samples (gaps, missing "
                "or clipped readings, no time in common)"
            )
            issues.append(Issue("missing-readings", "warn", text, kind, share, 0.01))
    return Samples(t, at["gyr"], at["acc"], at["mag"])


def _at(t: Array, stream: Stream, delay: float) -> Array:
    """Readings (N, 3) at times `t`: interpolated, NaN beyond the ends and in gaps."""
    good = np.isfinite(stream.y).all(axis=1)
    if delay == 0.0 and (stream.t is t or np.array_equal(stream.t, t)) and SLOWER * good.sum() > len(t):
        return stream.y
    clock, y = stream.t[good], stream.y[good]
    out = np.full((len(t), 3), np.nan)
    if len(clock) < 2:
        return out
    when = t + delay
    after = np.clip(np.searchsorted(clock, when), 1, len(clock) - 1)
    step = clock[after] - clock[after - 1]
    known = (when >= clock[0]) & (when <= clock[-1]) & (step <= LONGEST_GAP * _usual(np.diff(clock)))
    for k in range(3):
        out[known, k] = np.interp(when[known], clock, y[:, k])
    return out


def _usual(step: Array) -> float:
    """Upper median, or the mean without the longest hundredth: clocks of hosts come in bursts of short steps."""
    ordered = np.sort(step)
    return max(float(ordered[len(step) // 2]), float(ordered[: max(1, 99 * len(step) // 100)].mean()))
