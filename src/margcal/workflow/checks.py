"""Is the result good? The covariance decides; the other figures explain, and catch what contradicts the model.

Each check has a value, the limits from which it warns and fails, and says what to record next. `pass`: every
sensor's expected error is at most half a degree and nothing warns; `warn`: at most two degrees, or something was
left out or mended; `fail`: nothing that was asked for survives (conventions, calibration file).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from margcal.core.types import Calibration, Fit, Issue, Kind, Level, SensorModel, Verdict
from margcal.core.units import UNITS
from margcal.methods.uncertainty import expected_error, sphere, weakest_direction
from margcal.workflow.job import NAMES, Job, Solved
from margcal.workflow.robust import MIN_POSES

EXPECTED_ERROR_DEG = (0.5, 2.0)
RESIDUAL = (0.02, 0.10)
"""Rms residual of accelerometer and magnetometer relative to the magnitude; a magnet carried along leaves 24 %."""
TURN_RESIDUAL_DEG = (2.0, 10.0)
HOUSING_DEG = (2.0, 8.0)
"""Housing-angle error that the fit found; beyond, the labels cannot be what was meant."""
CONDITION = (3.0, 20.0)
GAIN_OFF = (0.25, 1.0)
"""Relative deviation of a gain from that of its unit (datasheets: 3-10 %; a factor of two is another unit)."""
METHODS_APART = 5.0
"""Closed form against maximum likelihood, in expected errors."""
DIP_OFF_DEG = 10.0
FIELD_UT = (20.0, 70.0)


@dataclass(frozen=True)
class Check:
    """One figure that was looked at: `level` is 'pass', 'warn' or 'fail'."""

    code: str
    sensor: Kind | None
    value: float | None
    limit: float
    level: Level | str
    text: str

    @property
    def issue(self) -> Issue:
        level: Level = "fail" if self.level == "fail" else "warn"
        return Issue(self.code, level, self.text, self.sensor, self.value, self.limit)


def run_checks(job: Job, solved: Solved, models: Iterable[SensorModel]) -> list[Check]:
    """Every check that applies, passed ones too."""
    checks: list[Check] = []
    for model in models:
        checks += _sensor_checks(job, solved, model)
    if solved.joint is not None and solved.joint.s_rot is not None:
        checks.append(_housing(float(np.degrees(solved.joint.s_rot))))
    return checks


def verdict_of(calibration: Calibration, asked: Sequence[Kind] | None) -> Verdict:
    """`pass`, `warn` or `fail` by the rule at the head of this module."""
    missing = [k for k in asked or () if k not in calibration.models]
    if not calibration.models or missing:
        return "fail"
    if any(i.level in ("warn", "fail") for i in calibration.issues):
        return "warn"
    known = all(m.expected_error_deg is not None for m in calibration.models.values())
    return "pass" if known else "warn"


# --- one sensor --------------------------------------------------------------------------------------


def _sensor_checks(job: Job, solved: Solved, model: SensorModel) -> list[Check]:
    checks = [_expected_error(job, model), _residual(job, model), condition(model, "look at its channels and units")]
    checks += [
        gain(model, "is that the unit of the readings? give it with --units"),
        _methods_agree(job, solved, model),
        _remaining(job, solved, model.kind),
    ]
    if model.kind == "mag":
        checks += [_field_strength(job, model), _dip(job, solved)]
    return [c for c in checks if c is not None]


def graded(value: float, limits: tuple[float, float]) -> tuple[str, float]:
    """Level of `value` by its limits (warn, fail), and the limit that counts; what is not a number fails."""
    if not value <= limits[1]:
        return "fail", limits[1]
    return ("warn", limits[0]) if value > limits[0] else ("pass", limits[0])


def _expected_error(job: Job, model: SensorModel) -> Check:
    name, error = NAMES[model.kind], model.expected_error_deg
    if error is None:
        text = f"{name}: this method gives no uncertainty; use the default method to know how good it is"
        return Check("no-uncertainty", model.kind, None, EXPECTED_ERROR_DEG[0], "warn", text)
    level, limit = graded(error, EXPECTED_ERROR_DEG)
    text = f"{name}: expected direction error {min(error, 180.0):.2f} degrees rms"
    if level != "pass" and model.covariance is not None:
        weak = weakest_direction(model.kind, model.H, model.covariance, job.options.magnitude[model.kind])
        text += f" (limit {limit:g}): {weak.text}; {_record_next(model, weak.what)}"
    return Check("expected-error", model.kind, error, limit, level, text)


def _record_next(model: SensorModel, what: str) -> str:
    if model.kind == "mag" and model.n_poses is None:
        return "swing the node longer, about all axes, with the gyroscope running"
    if model.kind == "gyr":
        return "record more turns of 60 to 270 degrees about all axes, with rests in between"
    if what == "rotation":
        return "turn the housing about a second and a third axis between rests"
    return "record more rests in new directions, spread over the whole sphere"


def _residual(job: Job, model: SensorModel) -> Check | None:
    if model.residual_rms is None:
        return None
    name = NAMES[model.kind]
    if model.kind == "gyr":
        value = float(np.degrees(model.residual_rms))
        level, limit = graded(value, TURN_RESIDUAL_DEG)
        text = f"{name}: turns end {value:.2f} degrees rms from where the rests lie"
        text += "" if level == "pass" else "; turn more slowly, without knocks, and let the node rest in between"
        return Check("turn-residual", "gyr", value, limit, level, text)
    value = model.residual_rms / job.options.magnitude[model.kind]
    level, limit = graded(value, RESIDUAL)
    text = f"{name}: residual {value * 100:.2f} % of the magnitude"
    if level != "pass":
        why = "the node moved during its rests, or the attitudes are wrong; put it down and take the hand away"
        if model.kind == "mag":
            why = "a magnet or iron near or on the node; record again in one place, away from iron"
        text += f" (limit {limit * 100:g} %): {why}"
    return Check("residual", model.kind, value, limit, level, text)


def condition(model: SensorModel, why: str) -> Check:
    """Whether the gains of the axes are those of a healthy triad; `why` they may not be."""
    value = float(np.linalg.cond(model.H))
    level, limit = graded(value, CONDITION)
    text = f"{NAMES[model.kind]}: the gains of its axes differ by a factor of {value:.2f}"
    if level != "pass":
        text += f" (limit {limit:g}); no healthy sensor does that: {why}"
    return Check("condition", model.kind, value, limit, level, text)


def gain(model: SensorModel, why: str) -> Check | None:
    """Whether the gains are about what the unit of the readings says; `why` they may not be."""
    factor = UNITS[model.kind].get(model.raw_unit)
    if factor is None or model.unit == "norm":
        return None
    gains = np.linalg.svd(model.H / factor, compute_uv=False)
    value = float(np.max(np.maximum(gains, 1 / np.maximum(gains, 1e-9))) - 1)
    level, limit = graded(value, GAIN_OFF)
    text = f"{NAMES[model.kind]}: gains up to {value * 100:.0f} % off what the unit {model.raw_unit} says"
    if level != "pass":
        text += f" (limit {limit * 100:g} %): {why}"
    return Check("gain", model.kind, value, limit, level, text)


def _methods_agree(job: Job, solved: Solved, model: SensorModel) -> Check | None:
    """Closed form (all poses alike) and maximum likelihood must tell the same within their errors."""
    single = solved.singles.get(model.kind)
    if single is None or model.expected_error_deg is None or solved.left_out:
        return None
    sign = 1.0 if np.linalg.det(single.model.H) * np.linalg.det(model.H) > 0 else -1.0
    u = job.options.magnitude[model.kind] * sphere(60)
    y = model.invert(u)
    other = sign * (single.model.apply(y) if model.kind != "gyr" else (y - model.B) @ single.model.H.T)
    apart = np.linalg.norm(np.cross(u, other), axis=1) / np.linalg.norm(u, axis=1) / np.linalg.norm(other, axis=1)
    value = float(np.degrees(np.sqrt(np.mean(np.arcsin(np.minimum(apart, 1.0)) ** 2))))
    expected = max(model.expected_error_deg, _single_error(job, single), 0.1)
    limit = METHODS_APART * expected
    text = f"{NAMES[model.kind]}: closed form and maximum likelihood differ by {value:.2f} degrees"
    level = "pass" if value <= limit else "warn"
    if level == "warn":
        text += f", {value / expected:.0f} times the expected error: some rests contradict the others; see the "
        text += "worst ones in the report, or record again"
    return Check("methods-agree", model.kind, value, limit, level, text)


def _single_error(job: Job, fit: Fit) -> float:
    if fit.covariance is None or not np.isfinite(fit.covariance).all():
        return 0.0
    kind = fit.model.kind
    return expected_error(kind, fit.model.H, fit.covariance, job.options.magnitude[kind]).direction_deg


def _field_strength(job: Job, model: SensorModel) -> Check | None:
    """Where nobody told the field and the raw unit is known, the raw gain gives a rough field."""
    factor = UNITS["mag"].get(model.raw_unit)
    if job.options.field_uT is not None or factor is None:
        return None
    value = float(factor / np.cbrt(abs(np.linalg.det(model.H))))
    inside = FIELD_UT[0] <= value <= FIELD_UT[1]
    text = f"magnetometer: by its nominal gain the local field is {value:.0f} uT"
    if not inside:
        text += f"; the earth's is {FIELD_UT[0]:g} to {FIELD_UT[1]:g}: a magnet or iron is near, or the unit is another"
    limit = FIELD_UT[0] if value < FIELD_UT[0] else FIELD_UT[1]
    return Check("field-strength", "mag", value, limit, "pass" if inside else "warn", text)


def _dip(job: Job, solved: Solved) -> Check | None:
    u = solved.vectors.get("mag")
    gravity_known = job.attitudes.level or "acc" in solved.fits
    if u is None or job.options.dip is None or not gravity_known or job.attitudes.mode in ("reference", "file"):
        return None
    dip = float(np.degrees(np.arcsin(-u[2] / np.linalg.norm(u))))
    value = abs(dip - float(np.degrees(job.options.dip)))
    model_dip = np.degrees(job.options.dip)
    text = f"magnetometer: the field dips by {dip:.1f} degrees, the World Magnetic Model says {model_dip:.1f}"
    if value > DIP_OFF_DEG:
        text += "; the field here is disturbed (steel, furniture): its size is not the model's either. Record elsewhere"
    return Check("dip", "mag", value, DIP_OFF_DEG, "pass" if value <= DIP_OFF_DEG else "warn", text)


def _remaining(job: Job, solved: Solved, kind: Kind) -> Check | None:
    """Rests that are left for a sensor after those that contradict the others."""
    out = set().union(*(solved.left_out.get(what, set()) for what in ("rot", "level", kind)))
    if not out:
        return None
    rests = len(job.segmentation.poses)
    remain = rests - len(out)
    contradict = "contradicts the others and was" if len(out) == 1 else "contradict the others and were"
    text = f"{NAMES[kind]}: {len(out)} of {rests} rests {contradict} left out; {remain} remain"
    if remain < MIN_POSES:
        text += f", {MIN_POSES} are needed to tell which are right: record again, with more rests"
    level = "pass" if remain >= MIN_POSES else "fail"
    return Check("rests-remaining", kind, float(remain), float(MIN_POSES), level, text)


def _housing(value: float) -> Check:
    level, limit = graded(value, HOUSING_DEG)
    text = f"the housing lay {value:.2f} degrees rms (each axis) from the attitudes that were taken"
    if level != "pass":
        text += f" (limit {limit:g}): the attitudes are wrong (give them with --poses FILE) or the housing lies badly"
    return Check("housing-error", None, value, limit, level, text)
