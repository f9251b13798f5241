"""A node against motion capture: recording and reference in, a calibrated and aligned node out.

1. `clean_reference` masks what the optics did not see; `reference_rates` differentiates what they did.
2. `synchronise` finds offset, drift and T from the angular rates; `diagnose` names wrong conventions.
3. `align_fits` (or `align_paper`) finds delays, H and B of every sensor, the frames and the lever arm.
4. `align_checks` judges; `align_errors` says what the orientation gains.

The frame of the result is `gyr-symmetric`: that in which the gyroscope's K is symmetric (R-BSN (17)).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from margcal.core.errors import DataError, InputError, UsageError
from margcal.core.types import Array, Calibration, Issue, Kind, Recording, Reference, Stream, Verdict
from margcal.core.units import KINDS, STANDARD_GRAVITY
from margcal.methods.clock import Synchronisation
from margcal.methods.r_bsn import polar_split
from margcal.methods.rate_correlation import LEAST_OVERLAP_S
from margcal.methods.reference_rates import reference_rates
from margcal.workflow import align_diagnose
from margcal.workflow.align_checks import Check, checks_of, failed_sensors, with_expected_error
from margcal.workflow.align_errors import orientation_errors
from margcal.workflow.align_fits import of_raw_axes, solve_right, with_axis_reversed
from margcal.workflow.align_job import (
    METHODS,
    AlignJob,
    AlignOptions,
    AlignSolved,
    Method,
    MocapAlignment,
    Tick,
)
from margcal.workflow.align_paper import solve_paper
from margcal.workflow.align_results import figures, notes, values
from margcal.workflow.checks import verdict_of
from margcal.workflow.job import NAMES
from margcal.workflow.lint import lint
from margcal.workflow.reference import clean_reference
from margcal.workflow.segment import measured

if TYPE_CHECKING:
    from margcal.workflow.place import Place

LEAST_SAMPLES = 20
DRIFTED_DEG_S, FOREIGN_DEG_S = 1.0, 5.0
"""Difference of the bias at rest and in motion that is warned of, and that no bias drifts by in a day."""

STILL = 0.2
"""A trial at rest must turn less than this part of the moved one (rms)."""


def align(
    recording: Recording,
    reference: Reference | None = None,
    *,
    static: Recording | None = None,
    common_clock: bool | None = None,
    method: Method | None = None,
    as_printed: bool = False,
    norm: Literal["l1", "lengths"] = "l1",
    sensors: Sequence[Kind] | None = None,
    gravity: float | None = None,
    field: float | None = None,
    place: Place | None = None,
    device: str | None = None,
    orientation: bool = True,
    allow_fail: bool = False,
    tick: Tick | None = None,
) -> Calibration:
    """Calibrate a node against a motion-capture recording of the body that it is fixed to.

    Parameters
    ----------
    recording : Recording
        With a gyroscope; accelerometer and magnetometer where they are to be calibrated.
    reference : Reference, optional
        Attitude, and position perhaps, of the marker body; default: that of `recording` (one clock).
    static : Recording, optional
        The node at rest, for the gyroscope's bias, R-BSN (12).
    common_clock : bool, optional
        Whether node and reference are on one clock: then each sensor's delay is estimated instead of offset and
        drift. Default: whether the reference is the recording's own.
    method : {'r-bsn', 'lowpass-svd', 'forward'}, optional
        Default: `forward` where the reference holds positions, else `lowpass-svd`.
    as_printed : bool
        R-BSN (14) as printed, to see what it gives (method `r-bsn`).
    norm : {'l1', 'lengths'}
        Of R-BSN (20).
    sensors : sequence of {'acc', 'gyr', 'mag'}, optional
        Default: all that the recording has. One that is named here and cannot be calibrated is an error.
    gravity : float, m/s^2, optional
    field : float, uT, optional
        Default: the local field is the unit (`norm`).
    place : Place, optional
        Gravity, field, and the dip, which settles the magnetometer's sign.
    device : str, optional
    orientation : bool
        Whether the orientation error before and after is found.
    allow_fail : bool
        Return what there is even where nothing that was asked for survives.
    tick : callable (done, total), optional

    Returns
    -------
    Calibration
        `alignment` is a `MocapAlignment` with the figures for a report.

    Raises
    ------
    InputError, UsageError
        If recording or options cannot be understood.
    DataError
        If the clocks cannot be told, the reference is of another convention, or no sensor survives.
    """
    say = tick or (lambda done, total: None)
    own = reference is None
    reference = recording.reference if reference is None else reference
    if reference is None:
        raise InputError(f"{recording.source}: holds no reference (ref_qw ref_qx ref_qy ref_qz); give one")
    issues = list(recording.issues)
    recording = _usable(recording, issues)
    options = _options(recording, reference, method, as_printed, norm, sensors, gravity, field, place)
    common = own if common_clock is None else common_clock
    job = _job(recording, reference, common, options, static, issues, say)
    solved = solve_paper(job, say) if options.method == "r-bsn" else solve_right(job, say)
    calibration = _assembled(job, solved, issues, keep_failed=allow_fail)
    say(8, 9)
    calibration = _with_orientation(job, solved, calibration, wanted=orientation)
    calibration = replace(
        calibration,
        device=device,
        recordings=(recording,) if static is None else (recording, static),
        settings={**_settings(job, place, static), **calibration.settings},
    )
    calibration = replace(calibration, verdict=_verdict(calibration, sensors))
    if not allow_fail and calibration.verdict == "fail":
        reasons = "; ".join(dict.fromkeys(i.text for i in calibration.issues if i.level == "fail"))
        raise DataError(f"{recording.source} cannot be aligned: {reasons}", calibration.issues)
    say(9, 9)
    return calibration


# --- what is asked for ----------------------------------------------------------------------------------


def _usable(recording: Recording, issues: list[Issue]) -> Recording:
    """The recording without sensors that the lint finds unusable; a wrong unit is refused."""
    if recording.gyr is None:
        raise InputError(f"{recording.source}: holds no gyroscope; node and reference are compared by it")
    found = lint(recording)
    for issue in found:
        if issue.level == "fail" and issue.sensor is None:
            raise InputError(issue.text)
        if issue.level == "fail" and issue.sensor == "gyr":
            raise DataError(issue.text, tuple(found))
    issues += found
    lame = {i.sensor for i in found if i.level == "fail"}
    return measured(replace(recording, **{k: None for k in lame if k}))


def _options(
    recording: Recording,
    reference: Reference,
    method: Method | None,
    as_printed: bool,
    norm: Literal["l1", "lengths"],
    sensors: Sequence[Kind] | None,
    gravity: float | None,
    field: float | None,
    place: Place | None,
) -> AlignOptions:
    if method is not None and method not in METHODS:
        raise UsageError(f"method {method!r} is none of {', '.join(METHODS)}")
    if as_printed and method not in (None, "r-bsn"):
        raise UsageError(f"(14) as printed belongs to the method r-bsn, not to {method}")
    if field is not None and place is not None:
        raise UsageError("--field and --at both give the magnetic field; give one of them")
    positions = reference.p is not None and bool(np.isfinite(reference.p).any())
    if method == "forward" and not positions:
        raise InputError("the method forward needs the positions of the reference (ref_p_x_m ...); it has none")
    for kind in sensors or ():
        if kind not in KINDS:
            raise UsageError(f"sensor {kind!r} is none of {', '.join(KINDS)}")
        if kind not in recording.streams:
            raise InputError(f"{NAMES[kind]} was asked for, but {recording.source} has none that can be used")
    _within("gravity", gravity, 9.0, 11.0, "m/s^2")
    _within("field", field, 1.0, 1000.0, "uT")
    chosen = method or ("r-bsn" if as_printed else "forward" if positions else "lowpass-svd")
    where = None if place is None else place.field
    return AlignOptions(
        method=chosen,
        sensors=tuple(k for k in recording.streams if sensors is None or k in sensors),
        as_printed=as_printed,
        norm=norm,
        gravity=gravity or (place.gravity if place else STANDARD_GRAVITY),
        field_uT=field or (where.total_uT if where else None),
        dip=np.radians(where.dip_deg) if where else None,
    )


def _within(name: str, value: float | None, low: float, high: float, unit: str) -> None:
    if value is not None and not low <= value <= high:
        raise UsageError(f"{name} is {value:g} {unit}; on the earth it lies between {low:g} and {high:g}")


# --- clocks and conventions -----------------------------------------------------------------------------


def _job(
    recording: Recording,
    reference: Reference,
    common: bool,
    options: AlignOptions,
    static: Recording | None,
    issues: list[Issue],
    say: Tick,
) -> AlignJob:
    gyr = recording.streams["gyr"]
    reference, found = clean_reference(reference, gyr=gyr if common else None)
    issues += found
    say(1, 9)
    for what, t in (("reference", reference.t), ("gyroscope", gyr.t)):
        if len(t) < LEAST_SAMPLES or np.ptp(t) < LEAST_OVERLAP_S:
            text = f"the {what} has {len(t)} samples in {np.ptp(t):.1f} s, which is too short: record a minute"
            raise DataError(text, (Issue("too-short", "fail", text),))
    rates = reference_rates(reference)
    bias = None if static is None else _static_bias(static, gyr)
    diagnosis = align_diagnose.synchronised(gyr, reference, rates, common)
    sync = diagnosis.sync
    if static is not None and bias is not None:
        foreign = _foreign_static(static, bias[0], sync, options.method == "r-bsn")
        issues += foreign
        bias = None if foreign and options.method != "r-bsn" else bias
    issues += diagnosis.issues
    raw, axis = recording, None
    if diagnosis.mirrored:
        axis = polar_split(sync.T, allow_mirrored=True)[2]
    if axis is not None:
        issues.append(align_diagnose.mirrored_issue(axis))
        recording = replace(recording, gyr=with_axis_reversed(gyr, axis))
        signs = np.where(np.arange(3) == "xyz".index(axis), -1.0, 1.0)
        bias = None if bias is None else (bias[0] * signs, bias[1])
        both = np.concatenate([np.tile(signs, 3), np.ones(3)])
        sync = replace(sync, T=sync.T * signs, covariance=sync.covariance * np.outer(both, both))
    say(3, 9)
    return AlignJob(recording, raw, reference, rates, sync, options, bias, axis)


def _static_bias(static: Recording, moved: Stream) -> tuple[Array, Array]:
    """(12): mean raw gyroscope of the trial at rest, and its standard error with slow drift counted."""
    gyr = static.gyr
    if gyr is None:
        raise InputError(f"{static.source}: the trial at rest holds no gyroscope")
    if gyr.unit != moved.unit:
        raise InputError(f"{static.source}: gyroscope in {gyr.unit}, in the moved trial in {moved.unit}")
    y = gyr.y[np.isfinite(gyr.y).all(axis=1)]
    if len(y) < 20:
        raise DataError(f"{static.source}: the trial at rest has only {len(y)} samples; record ten seconds or more")
    if np.std(y, axis=0).max() > STILL * np.nanstd(moved.y, axis=0).max():
        text = f"{static.source}: the node is not at rest in the trial at rest; put it down and take the hand away"
        raise DataError(text, (Issue("static-moved", "fail", text, "gyr"),))
    parts = np.array([p.mean(axis=0) for p in np.array_split(y, max(4, min(40, len(y) // 50)))])
    return y.mean(axis=0), np.std(parts, axis=0) / 2 + np.std(y, axis=0) / np.sqrt(len(y)) + 1e-12


def _foreign_static(static: Recording, bias: Array, sync: Synchronisation, used: bool) -> list[Issue]:
    """Is the bias at rest that of the moved trial? Then ``T b + c`` of (16) is nothing. `used`: it is taken either way.

    Raises
    ------
    DataError
        If it is a turn that no drift of a bias makes: another node, or a trial that was not at rest.
    """
    rows = np.hstack([np.kron(np.eye(3), bias), np.eye(3)])
    miss = np.abs(sync.T @ bias + sync.c)
    sure = np.degrees(float(np.max(miss - 5 * np.sqrt(np.maximum(np.diag(rows @ sync.covariance @ rows.T), 0.0)))))
    if sure < DRIFTED_DEG_S:
        return []
    level: Literal["warn", "fail"] = "fail" if sure > FOREIGN_DEG_S else "warn"
    text = (
        f"{static.source}: at rest the gyroscope's bias is {np.degrees(miss.max()):.2f} deg/s off what the moved trial "
        "shows"
    )
    text += "" if used else ", which is taken instead"
    text += ": give a trial at rest of the same node and day, or leave --static out"
    issue = Issue("static-bias", level, text, "gyr", float(np.degrees(miss.max())), DRIFTED_DEG_S)
    if level == "fail":
        raise DataError(text, (issue,))
    return [issue]


# --- the result -----------------------------------------------------------------------------------------


def _assembled(job: AlignJob, solved: AlignSolved, issues: list[Issue], *, keep_failed: bool) -> Calibration:
    options = job.options
    issues += solved.issues
    if job.mirrored is not None and "gyr" in solved.models:
        solved.models["gyr"] = of_raw_axes(solved.models["gyr"], job.mirrored)
    for kind, model in solved.models.items():
        delay, se = solved.delays.get(kind, (job.sync.delay_s, None))
        model = with_expected_error(job, replace(model, delay_s=delay, delay_se_s=se))
        solved.models[kind] = model
        solved.fits[kind] = replace(solved.fits[kind], model=model)
    if solved.R_kh is not None and (odd := align_diagnose.suspected_order(solved.R_kh, solved.f_m)) is not None:
        issues.append(odd)
    checks = checks_of(job, solved)
    issues += [c.issue for c in checks if c.level != "pass"]
    lost = failed_sensors(checks)
    if "gyr" in lost or any(i.level == "fail" and i.sensor is None for i in issues):
        lost = set(solved.models)  # without the gyroscope there is no frame for the others
    models = dict(solved.models) if keep_failed else {k: m for k, m in solved.models.items() if k not in lost}
    issues += notes(job, solved)
    return Calibration(
        acc=models.get("acc"),
        gyr=models.get("gyr"),
        mag=models.get("mag"),
        frame="gyr-symmetric",
        issues=tuple(dict.fromkeys(issues)),
        alignment=MocapAlignment(job.sync.common_clock, values(job, solved), figures(job, solved)),
        settings={"checks": [_plain(c) for c in checks], "method": options.method},
        fits=dict(solved.fits),
    )


def _plain(check: Check) -> dict[str, Any]:
    return {k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in asdict(check).items()}


def _with_orientation(job: AlignJob, solved: AlignSolved, calibration: Calibration, *, wanted: bool) -> Calibration:
    alignment = calibration.alignment
    if not (wanted and isinstance(alignment, MocapAlignment) and alignment.figures is not None):
        return calibration
    before, after, issues = orientation_errors(job, solved, calibration)
    shown = replace(alignment.figures, before=before, after=after)
    return replace(
        calibration,
        alignment=replace(alignment, figures=shown),
        issues=(*calibration.issues, *issues),
    )


def _verdict(calibration: Calibration, sensors: Sequence[Kind] | None) -> Verdict:
    failed = {i.sensor for i in calibration.issues if i.level == "fail"}
    sound = {k: None for k in calibration.models if k in failed or None in failed or "gyr" in failed}
    return verdict_of(replace(calibration, **sound), sensors)


def _settings(job: AlignJob, place: Place | None, static: Recording | None) -> dict[str, Any]:
    options, sync = job.options, job.sync
    return {
        "method": options.method,
        "as_printed": options.as_printed,
        "norm": options.norm,
        "sensors": list(options.sensors),
        "common_clock": sync.common_clock,
        "static": None if static is None else static.source,
        "gravity": options.gravity,
        "field_uT": options.field_uT,
        "at": None if place is None else [place.latitude_deg, place.longitude_deg, place.field.year],
        "units": dict(job.recording.units),
        "alignment": {
            "correlation": sync.peak,
            "rate_explained": sync.explained,
            "reference_rate_hz": job.rates.rate,
            "reference_seen": float(job.rates.valid.mean()),
            "mirrored_gyroscope_axis": job.mirrored,
            "lever_arm_axes": "marker body",
        },
    }
