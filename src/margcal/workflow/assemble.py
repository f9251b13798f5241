"""From fits to a calibrated node: signs, units, uncertainty and what to know about it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace

import numpy as np

from margcal.core import so3
from margcal.core.types import Array, Calibration, Fit, Issue, Kind, Recording, SensorModel
from margcal.core.units import KINDS
from margcal.methods.uncertainty import expected_error
from margcal.workflow.checks import Check, run_checks
from margcal.workflow.job import Job, Solved


def assemble(job: Job, solved: Solved, issues: list[Issue], *, keep_failed: bool = False) -> Calibration:
    """Name the result of a route and check it; `issues` are those found before it.

    A sensor that fails a check is left out, unless `keep_failed`.
    """
    issues = issues + solved.issues
    models: dict[Kind, SensorModel] = {}
    found: list[Kind] = [k for k in KINDS if k in solved.fits]
    for kind in found:
        fit = _signed(job, kind, solved, issues)
        models[kind] = _finished(job, kind, fit, solved)
        solved.fits[kind] = replace(fit, model=models[kind])
    checks = run_checks(job, solved, models.values())
    issues += [c.issue for c in checks if c.level != "pass"]
    lost = {c.sensor for c in checks if c.level == "fail"}
    if not keep_failed:
        models = {k: m for k, m in models.items() if k not in lost and None not in lost}
    _mirrored(models, issues)
    return Calibration(
        acc=models.get("acc"),
        gyr=models.get("gyr"),
        mag=models.get("mag"),
        frame=job.attitudes.frame,
        issues=tuple(dict.fromkeys(issues)),
        settings={"checks": [_plain(c) for c in checks]},
        fits=dict(solved.fits),
        poses=replace(job.segmentation.poses, R=solved.R),
        turns=job.segmentation.turns,
        recordings=job.recordings,
    )


def _plain(check: Check) -> dict[str, object]:
    """A check as the calibration file keeps it: plain JSON values, NaN as null."""
    row = asdict(check)
    return {k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in row.items()}


def _signed(job: Job, kind: Kind, solved: Solved, issues: list[Issue]) -> Fit:
    """(H, u) or (-H, -u): by the nominal H, by the dip where the place is known, else det H > 0 (conventions)."""
    fit = solved.fits[kind]
    H = fit.model.H
    if kind == "gyr":
        return fit  # rotations leave its sign no choice
    nominal = job.options.nominal.get(kind)
    if nominal is not None:
        flip = float(np.sum(so3.polar(H)[0] * so3.polar(nominal.H)[0])) < 0
    elif kind == "mag" and job.options.dip is not None and (up := _field_up(job, solved)) is not None:
        flip = up * np.sin(job.options.dip) > 0  # the field points down where the dip is positive
    else:
        flip = np.linalg.det(H) < 0
        if kind == "mag":
            text = (
                "magnetometer: its sign is taken so that det H > 0 (axes not mirrored); give --at or --nominal if "
                "the board flips them"
            )
            issues.append(Issue("sign-assumed", "note", text, "mag"))
    if not flip:
        return fit
    if kind in solved.vectors:
        solved.vectors[kind] = -solved.vectors[kind]
    model = replace(fit.model, H=-H, covariance=_negated(fit.model.covariance))
    _negate_between(kind, solved)
    fit = solved.fits[kind]
    return replace(
        fit,
        model=model,
        u=None if fit.u is None else -fit.u,
        covariance=model.covariance,
        details=_negated_rows(fit.details),
    )


_SIGNS = np.r_[-np.ones(9), np.ones(3)]
"""What becomes of (H row by row, B) when H changes its sign."""


def _negated_rows(details: Mapping[str, Array]) -> dict[str, Array]:
    """Details of (-H, B): leave-one-out shifts have a parameter to the column."""
    return {k: v * _SIGNS if k == "leave_one_out" else v for k, v in details.items()}


def _negate_between(kind: Kind, solved: Solved) -> None:
    """The magnetometer's covariance with the accelerometer, when one of the two changes its sign."""
    mag = solved.fits.get("mag")
    if mag is None or kind == "gyr" or "covariance_with_acc" not in mag.details:
        return
    signs = _SIGNS[:, None] if kind == "mag" else _SIGNS
    details = {**mag.details, "covariance_with_acc": mag.details["covariance_with_acc"] * signs}
    solved.fits["mag"] = replace(mag, details=details)


def _negated(C: Array | None) -> Array | None:
    """Covariance of (-H, B)."""
    if C is None:
        return None
    return C * np.outer(_SIGNS, _SIGNS)


def _field_up(job: Job, solved: Solved) -> float | None:
    """Mean component of the calibrated field along "up" (calibrated unit), as the fit has it now."""
    acc, mag = solved.fits.get("acc"), solved.fits["mag"]
    u = solved.vectors.get("mag")
    if job.attitudes.level and u is not None:
        return float(u[2])
    if acc is None:
        return None
    y = job.segmentation.poses.mean
    if "mag" in solved.sources:
        recording = next(r for r in job.recordings if solved.sources["mag"].startswith(r.source))
        return _field_up_moving(recording, acc.model, mag.model)
    f, m = acc.model.apply(y["acc"]), mag.model.apply(y["mag"])
    both = np.isfinite(f).all(axis=1) & np.isfinite(m).all(axis=1)
    if not both.any():
        return None
    return float(np.mean(np.sum(f[both] * m[both], axis=1) / np.linalg.norm(f[both], axis=1)))


def _field_up_moving(recording: Recording, acc: SensorModel, mag: SensorModel) -> float | None:
    if recording.acc is None or recording.mag is None:
        return None
    f = acc.apply(recording.acc.y)
    f = np.column_stack([np.interp(recording.mag.t, recording.acc.t, f[:, k]) for k in range(3)])
    return float(np.mean(np.sum(f * mag.apply(recording.mag.y), axis=1) / np.linalg.norm(f, axis=1)))


def _finished(job: Job, kind: Kind, fit: Fit, solved: Solved) -> SensorModel:
    """The model with the figures that say how good it is."""
    model = fit.model
    magnitude = job.options.magnitude[kind]
    error = None
    if model.covariance is not None and np.isfinite(model.covariance).all():
        error = expected_error(kind, model.H, model.covariance, magnitude).direction_deg
    _, index = job.readings(kind)
    delay = solved.delays.get(kind, (None, None))
    residual = np.asarray(fit.residual)
    rests = None if kind in solved.sources else len(index) if kind == "gyr" else int(np.isfinite(residual).sum())
    return replace(
        model,
        raw_unit=job.raw_unit(kind),
        unit=job.options.unit[kind],
        residual_rms=float(np.sqrt(np.nanmean(residual**2))),
        n_poses=rests,
        method=fit.method,
        reference_vector=solved.vectors.get(kind),
        expected_error_deg=error,
        delay_s=delay[0],
        delay_se_s=delay[1],
        temperature_degC=_temperature(job),
    )


def _temperature(job: Job) -> float | None:
    means = [np.nanmean(r.temperature[1]) for r in job.recordings if r.temperature is not None]
    return float(np.mean(means)) if means else None


def _mirrored(models: Mapping[Kind, SensorModel], issues: list[Issue]) -> None:
    """A gyroscope of the other handedness than the accelerometer: the data prove it, so say it and go on."""
    gyr = models.get("gyr")
    if gyr is None or np.linalg.det(gyr.H) > 0:
        return
    Q = so3.polar(gyr.H)[0]
    axis = "xyz"[int(np.argmin(np.diag(Q)))]
    text = (
        f"gyroscope: its axes are mirrored (left-handed) against the accelerometer's, most likely {axis}; H takes "
        "care of it, but check the wiring or driver that flips an axis"
    )
    issues.append(Issue("mirrored-axes", "warn", text, "gyr", float(np.linalg.det(Q))))
