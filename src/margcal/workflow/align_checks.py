"""Is an alignment good? The same rule as in `checks`: the covariance decides, the other figures explain.

`pass`: expected error of every sensor at most half a degree and nothing warns; `warn`: at most two degrees, or
something was left out or mended; `fail`: nothing that was asked for survives.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from margcal.core import so3
from margcal.core.types import Kind, SensorModel
from margcal.methods.uncertainty import expected_error, weakest_direction
from margcal.workflow.align_job import AlignJob, AlignSolved
from margcal.workflow.checks import EXPECTED_ERROR_DEG, Check, condition, gain, graded
from margcal.workflow.job import NAMES

RESIDUAL = (0.10, 0.35)
"""Rms residual of accelerometer and magnetometer relative to the magnitude. Measured: BROAD 0.4 to 3 %; hand-held
motion with the paper's method up to 30 %."""
PEAK = 0.9
DRIFT_PPM = 200.0
OFF_GYRO_DEG = 10.0
"""Accelerometer and magnetometer turned further than this against the gyroscope do not share its axes."""
OVERLAP = 0.8
STATIC_APART = 5.0
SEEN = 0.5


def checks_of(job: AlignJob, solved: AlignSolved) -> list[Check]:
    """Every check that applies, passed ones too."""
    found: list[Check | None] = [_peak(job), *_clock(job), _overlap(job), _seen(job)]
    for model in solved.models.values():
        found += [_expected(job, solved, model), _residual(job, model), gain(model, _why_gain(model))]
        found.append(condition(model, "the motion did not show all axes"))
        found.append(_axes(job, solved, model))
    return [c for c in found if c is not None]


def with_expected_error(job: AlignJob, model: SensorModel) -> SensorModel:
    """The model with the rms angle that its covariance tells."""
    if model.covariance is None or not np.isfinite(model.covariance).all():
        return model
    error = expected_error(model.kind, model.H, model.covariance, job.options.magnitude[model.kind]).direction_deg
    return replace(model, expected_error_deg=error)


def _peak(job: AlignJob) -> Check:
    value = job.sync.peak
    text = f"node and reference turn alike: correlation of the angular rates {value:.4f}"
    low = value < PEAK
    if low:
        text += f" (limit {PEAK:g}); a livelier motion, or cleaner markers, would tell the clock better"
    return Check("synchronisation", None, value, PEAK, "warn" if low else "pass", text)


def _clock(job: AlignJob) -> Iterable[Check]:
    sync = job.sync
    if sync.common_clock:
        off = abs(sync.delay_s)
        text = f"the gyroscope lags the reference by {1e3 * sync.delay_s:.2f} ms on their common clock"
        if off > 0.1:
            text += (
                "; that is more than a sensor's delay: the clocks do not share an origin (leave --common-clock away)"
            )
        yield Check("common-clock", "gyr", off, 0.1, "warn" if off > 0.1 else "pass", text)
        return
    drift = abs(sync.drift_ppm)
    pace = "slow" if sync.drift_ppm > 0 else "fast"  # t_ref = offset + (1 + drift) t_node
    text = f"the node's clock is {drift:.1f} +- {sync.drift_se_ppm:.1f} ppm {pace} against the reference's"
    if drift > DRIFT_PPM:
        text += f" (limit {DRIFT_PPM:g}): is the rate of one of them wrong? The drift is taken into account"
    yield Check("clock-drift", None, drift, DRIFT_PPM, "warn" if drift > DRIFT_PPM else "pass", text)


def _overlap(job: AlignJob) -> Check:
    t, gyr = job.sync.node_time(job.rates.t), job.recording.streams["gyr"].t
    common = min(t[-1], gyr[-1]) - max(t[0], gyr[0])
    value = float(common / max(min(t[-1] - t[0], gyr[-1] - gyr[0]), 1e-9))
    text = f"node and reference have {common:.1f} s in common"
    low = value < OVERLAP
    if low:
        text += f", {100 * value:.0f} % of the shorter one; start and stop them together"
    return Check("overlap", None, value, OVERLAP, "warn" if low else "pass", text)


def _seen(job: AlignJob) -> Check:
    value = float(job.rates.valid.mean())
    text = f"the body was seen well enough for {100 * value:.1f} % of the reference's samples"
    low = value < SEEN
    text += f" (limit {100 * SEEN:g} %): look at cameras and markers" if low else ""
    return Check("reference-seen", None, value, SEEN, "warn" if low else "pass", text)


def _expected(job: AlignJob, solved: AlignSolved, model: SensorModel) -> Check:
    name, error = NAMES[model.kind], model.expected_error_deg
    if error is None or model.covariance is None:
        text = f"{name}: this method gives no uncertainty"
        return Check("no-uncertainty", model.kind, None, EXPECTED_ERROR_DEG[0], "warn", text)
    level, limit = graded(error, EXPECTED_ERROR_DEG)
    text = f"{name}: expected direction error {min(error, 180.0):.2f} degrees rms"
    if level != "pass":
        weak = weakest_direction(model.kind, model.H, model.covariance, job.options.magnitude[model.kind])
        text += f" (limit {limit:g}): {weak.text}; record longer, and turn the node about all of its axes"
    return Check("expected-error", model.kind, error, limit, level, text)


def _residual(job: AlignJob, model: SensorModel) -> Check | None:
    if model.residual_rms is None or model.kind == "gyr":
        return None
    value = model.residual_rms / job.options.magnitude[model.kind]
    level, limit = graded(value, RESIDUAL)
    text = f"{NAMES[model.kind]}: residual {100 * value:.2f} % of the magnitude"
    if level != "pass":
        why = "linear acceleration, which this method takes for noise; a reference with positions would account for it"
        if model.kind == "mag":
            why = "the field differs from place to place, or a magnet or iron is near; move in a smaller volume"
        text += f" (limit {100 * limit:g} %): {why}"
    return Check("residual", model.kind, value, limit, level, text)


def _why_gain(model: SensorModel) -> str:
    if model.kind == "acc" and model.method == "r-bsn":
        return (
            "linear acceleration shrinks the paper's K, whatever its norm and gate; `--method lowpass-svd`, or "
            "`forward` with positions, does not suffer from it"
        )
    return "is that the unit of the readings (--units)? or is the reference of another body?"


def _axes(job: AlignJob, solved: AlignSolved, model: SensorModel) -> Check | None:
    """Accelerometer and magnetometer against the gyroscope, whose axes the frame follows."""
    gyr = solved.models.get("gyr")
    if model.kind == "gyr" or gyr is None or job.mirrored is not None:
        return None
    between = so3.polar(gyr.H)[0].T @ so3.polar(model.H)[0]
    mirrored = float(np.linalg.det(between)) < 0
    turned = float(np.degrees(np.linalg.norm(so3.log(-between if mirrored else between))))
    name = NAMES[model.kind]
    text = f"{name}: its axes lie {turned:.1f} degrees from the gyroscope's"
    if mirrored and turned < OFF_GYRO_DEG:
        text = f"{name}: it shows the reverse of what gyroscope and reference say"
        text += (
            " of specific force: its sign is another, or the laboratory's axes are left-handed (negate one axis of "
            "positions and attitudes; till then the frames are wrong)"
            if model.kind == "acc"
            else " of the field at this place; H takes care of it"
        )
        return Check("mirrored-axes", model.kind, turned, OFF_GYRO_DEG, "warn", text)
    if mirrored:
        text = f"{name}: its axes are mirrored against the gyroscope's, {_order(between)}; H takes care of it"
        return Check("mirrored-axes", model.kind, turned, OFF_GYRO_DEG, "warn", text)
    far = turned > OFF_GYRO_DEG
    if far:
        text += f" ({_order(between)}); H takes care of it"
        if abs(turned - 180) < OFF_GYRO_DEG:
            text += (
                ". A mirrored axis looks like this too, since a vector and its reverse cannot be told apart: "
                "compare a reading at rest"
            )
    return Check("axes", model.kind, turned, OFF_GYRO_DEG, "warn" if far else "pass", text)


def _order(between: np.ndarray) -> str:
    """Which raw axis of the sensor points along each axis of the gyroscope."""
    words = []
    for k in range(3):
        j = int(np.argmax(np.abs(between[k])))
        words.append(f"{'xyz'[k]} is its {'-' if between[k, j] < 0 else '+'}{'xyz'[j]}")
    return ", ".join(words)


def failed_sensors(checks: Iterable[Check]) -> set[Kind]:
    """Sensors that a check takes out."""
    return {c.sensor for c in checks if c.level == "fail" and c.sensor is not None}
