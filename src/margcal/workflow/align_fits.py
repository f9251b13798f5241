"""The sensors of a node against its reference: delays, fits in the marker body's axes, one frame for all of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from margcal.core import so3
from margcal.core.errors import DataError
from margcal.core.types import Array, Fit, Issue, Kind, Mask, SensorModel, Stream
from margcal.methods import mocap_fit
from margcal.methods.delays import FARTHEST_S, SensorDelay, delay_of
from margcal.methods.mocap_frame import CommonFrame, common_frame
from margcal.methods.r_bsn import laboratory_vector
from margcal.methods.reference_rates import attitude_at, resample
from margcal.workflow.align_diagnose import check_laboratory
from margcal.workflow.align_job import AlignJob, AlignSolved, Tick
from margcal.workflow.job import NAMES

TOLD_SE_S = 4e-3
"""A delay whose standard error is larger is not known, and not corrected."""
EXPLAINED = 0.02
"""Share of the sensor's changes that the prediction must account for before its delay means anything."""
DELAY_ROUNDS, DELAY_SETTLED_S = 5, 1e-4
CLOCKS_S = 2e-5
"""What the clocks' relation leaves of an error in a delay, measured in simulation over ten minutes."""
LARGEST_DELAY_S = 0.3
APART, WIDE = 2.0, 0.005
"""Standard errors between the two estimates of T from which errors are widened; difference that is warned of."""


# --- readings and attitudes at the same times -----------------------------------------------------------


def placed(job: AlignJob, stream: Stream, delay: float) -> tuple[Array, Array, Array | None, Mask]:
    """Times on the reference's clock at which the readings were sensed, R_mk and p there, and where these are known."""
    t = job.sync.reference_time(stream.t - delay)
    R = attitude_at(job.reference, t)
    known: Mask = np.atleast_1d(np.isfinite(R).all(axis=(1, 2)))
    p = None
    if job.reference.p is not None:
        p = resample(job.reference.t, job.reference.p, t)
    return t, R, p, known


def magnetometer_delay(job: AlignJob, rounds: int = 3) -> SensorDelay:
    """Of the magnetometer, from the field turned into the marker body.

    Raises
    ------
    DataError
        If the attitudes do not tell the field.
    """
    found = _magnetometer_delay(job, job.sync.delay_s)
    for _ in range(rounds - 1):
        last, found = found.delay_s, _magnetometer_delay(job, found.delay_s)
        if abs(found.delay_s - last) < 1e-4:
            break
    return found


def _magnetometer_delay(job: AlignJob, start: float) -> SensorDelay:
    """One round: the field in the laboratory for a delay of `start`, then the delay for that field."""
    mag = job.recording.streams["mag"]
    _, R, _, known = placed(job, mag, start)
    h = laboratory_vector(mag.y[known], R[known], so3.nearest_rotation(job.sync.T))
    u = np.einsum("nji,j->ni", job.rates.R, h)
    return delay_of(job.sync.reference_time(mag.t), mag.y, job.rates.t, u, start=start)


def usable(delay: SensorDelay) -> bool:
    told = np.isfinite(delay.se_s) and delay.se_s < TOLD_SE_S and abs(delay.delay_s) < LARGEST_DELAY_S
    return bool(told and delay.explained > EXPLAINED)


def _unknown_delay(kind: Kind, delay: SensorDelay | None) -> Issue:
    why = "the motion does not tell it" if delay is None else f"standard error {1e3 * delay.se_s:.1f} ms"
    text = f"{NAMES[kind]}: its delay is not known ({why}); it is taken to be the gyroscope's"
    return Issue("delay-not-known", "note", text, kind, None if delay is None else delay.se_s, TOLD_SE_S)


# --- the right way --------------------------------------------------------------------------------------


def solve_right(job: AlignJob, tick: Tick) -> AlignSolved:
    """Every sensor by `mocap_fit`; one that the motion does not carry is left out with the reason."""
    solved, wanted = AlignSolved(), job.options.sensors
    fits: dict[Kind, Fit] = {}
    _gyroscope(job, solved, fits)
    tick(4, 9)
    if "mag" in wanted:
        _attempt(solved, "mag", lambda: _magnetometer(job, solved), fits)
    tick(6, 9)
    if "acc" in wanted:
        _attempt(solved, "acc", lambda: _accelerometer(job, solved), fits)
    tick(8, 9)
    if "gyr" not in fits:
        raise DataError(next(i.text for i in solved.issues if i.sensor == "gyr" and i.level == "fail"), solved.issues)
    _same_handed(job, fits)
    frame = common_frame(fits["gyr"], fits.get("acc"), fits.get("mag"))
    _take_frame(job, solved, frame, fits)
    return solved


def _attempt(solved: AlignSolved, kind: Kind, make: Callable[[], Fit], fits: dict[Kind, Fit]) -> None:
    """Keep the fit of a sensor and what it warns of, or why there is none."""
    try:
        fits[kind] = make()
        if fits[kind].text:
            solved.issues.append(Issue("weak-excitation", "warn", fits[kind].text, kind))
    except DataError as error:
        reasons = error.issues or (Issue("cannot-align", "fail", f"{NAMES[kind]}: {error}", kind),)
        solved.issues += [replace(i, level="fail", sensor=i.sensor or kind) for i in reasons]


def _gyroscope(job: AlignJob, solved: AlignSolved, fits: dict[Kind, Fit]) -> None:
    sync, gyr = job.sync, job.recording.streams["gyr"]
    solved.delays["gyr"] = (sync.delay_s, sync.delay_se_s if sync.common_clock else 0.0)
    t, R, _, known = placed(job, gyr, sync.delay_s)
    _attempt(solved, "gyr", lambda: mocap_fit.gyroscope(t, gyr.y, R, known, raw_unit=gyr.unit), fits)
    if "gyr" in fits:
        fits["gyr"] = _widened(job, solved, fits["gyr"])
    if "gyr" in fits and job.static_bias is not None:
        fits["gyr"] = _with_static(fits["gyr"], *job.static_bias)


def _widened(job: AlignJob, solved: AlignSolved, fit: Fit) -> Fit:
    """The fit with errors as large as the two estimates of T differ: that of the synchronisation weights slow and fast
    turning differently, and what is neither noise nor a gain (a mount that gives way) shows between them."""
    C = fit.covariance
    if C is None:
        return fit
    variance = np.diag(C)[:9] + np.diag(job.sync.covariance)[:9]
    apart = float(np.sqrt(np.mean((fit.model.H - job.sync.T).ravel() ** 2 / variance)))
    if apart <= APART:
        return fit
    size = float(np.abs(fit.model.H - job.sync.T).max() / np.linalg.norm(job.sync.T, 2))
    text = (
        f"gyroscope: slow and fast turning tell gains up to {100 * size:.1f} % apart, {apart:.0f} standard errors; the "
        "errors are widened to that: a mount that gives way, or too little rotation about an axis"
    )
    solved.issues.append(Issue("errors-widened", "warn" if size > WIDE else "note", text, "gyr", apart, APART))
    C = C * apart**2
    return replace(fit, model=replace(fit.model, covariance=C), covariance=C)


def _with_static(fit: Fit, b: Array, se: Array) -> Fit:
    """# not in the paper: (12) as one more observation of B, weighted with what the moved trial says of it."""
    model, C = fit.model, fit.covariance
    if C is None:
        return replace(fit, model=replace(model, B=b))
    gain = C[:, 9:] @ np.linalg.inv(C[9:, 9:] + np.diag(se**2))
    x = np.concatenate([model.H.ravel(), model.B]) + gain @ (b - model.B)
    C = C - gain @ C[9:, :]
    C = (C + C.T) / 2
    return replace(fit, model=replace(model, H=x[:9].reshape(3, 3), B=x[9:], covariance=C), covariance=C)


def _magnetometer(job: AlignJob, solved: AlignSolved) -> Fit:
    mag = job.recording.streams["mag"]
    d = job.sync.delay_s
    delay = magnetometer_delay(job)
    if usable(delay):
        d = delay.delay_s
        solved.delays["mag"] = (d, delay.se_s)
    else:
        solved.issues.append(_unknown_delay("mag", delay))
    t, R, _, known = placed(job, mag, d)
    return mocap_fit.magnetometer(t, mag.y, R, known, field=job.options.field_uT, raw_unit=mag.unit)


def _accelerometer(job: AlignJob, solved: AlignSolved) -> Fit:
    """The delay is one more unknown, to first order, and the fit is made again with it."""
    acc, d, options = job.recording.streams["acc"], job.sync.delay_s, job.options

    def fit(delay: float, *, gate: bool = False, positions: bool = options.method == "forward") -> Fit:
        t, R, p, known = placed(job, acc, delay)
        if p is None or not positions:
            return mocap_fit.lowpass_svd(t, acc.y, R, known, gravity=options.gravity, raw_unit=acc.unit, gate=gate)
        known = known & np.isfinite(p).all(axis=1)
        return mocap_fit.forward(t, acc.y, R, p, known, gravity=options.gravity, raw_unit=acc.unit, gate=gate)

    rough = fit(d, positions=False)
    if options.method == "forward":
        check_laboratory(acc, job.rates, job.sync, rough.model.H, rough.model.B)
    step, se = 0.0, np.inf
    for _ in range(DELAY_ROUNDS):
        step, se = (float(v) for v in fit(d).details["late_s"])
        d += float(np.clip(step, -FARTHEST_S, FARTHEST_S))
        if abs(step) < DELAY_SETTLED_S:
            break
    settled = abs(step) < TOLD_SE_S and abs(d - job.sync.delay_s) < LARGEST_DELAY_S
    if not (settled and se < TOLD_SE_S):
        solved.issues.append(_unknown_delay("acc", SensorDelay(d, se, 0.0) if settled else None))
        return fit(job.sync.delay_s, gate=True)
    solved.delays["acc"] = (d, float(np.hypot(se, CLOCKS_S)))
    return fit(d, gate=True)


def _same_handed(job: AlignJob, fits: dict[Kind, Fit]) -> None:
    """Signs that the fits leave open: (H, u) and (-H, -u). The dip where the place is known; a mirrored node."""
    acc, mag, k = fits.get("acc"), fits.get("mag"), job.mirrored
    if k is not None:
        # with the gyroscope's axis k reversed in the data the others are taken for reversed as well
        flip = np.diag(np.where(np.arange(3) == "xyz".index(k), -1.0, 1.0))
        C = so3.nearest_rotation(job.sync.T)
        for kind, fit in list(fits.items()):
            if kind == "gyr" or fit.model.method == "forward":
                continue  # positions tell an accelerometer's sign
            nearness = float(np.trace(C.T @ so3.polar(fit.model.H)[0] @ flip))
            if nearness < 0:
                fits[kind] = negated(fit)
    acc, mag = fits.get("acc"), fits.get("mag")
    if job.options.dip is None or acc is None or mag is None or acc.u is None or mag.u is None:
        return
    if float(acc.u @ mag.u) * np.sin(job.options.dip) > 0:  # the field points down where the dip is positive
        fits["mag"] = negated(mag)


def negated(fit: Fit) -> Fit:
    """(-H, B, -u) with its covariance."""
    signs = np.concatenate([-np.ones(9), np.ones(3)])
    C = None if fit.covariance is None else fit.covariance * np.outer(signs, signs)
    u = None if fit.u is None else -fit.u
    details = dict(fit.details)
    if "joint" in details:
        joint = np.concatenate([signs, -np.ones(3), np.ones(len(details["joint"]) - 15)])
        details["joint"] = details["joint"] * np.outer(joint, joint)
    model = replace(fit.model, H=-fit.model.H, covariance=C, reference_vector=u)
    return replace(fit, model=model, u=u, covariance=C, details=details)


def _take_frame(job: AlignJob, solved: AlignSolved, frame: CommonFrame, fits: dict[Kind, Fit]) -> None:
    for kind in job.options.sensors:
        model = {"acc": frame.acc, "gyr": frame.gyr, "mag": frame.mag}[kind]
        if model is not None:
            solved.models[kind] = model
            solved.fits[kind] = replace(fits[kind], model=model, covariance=model.covariance)
    solved.R_kh, solved.R_kh_se = frame.R_kh, frame.R_kh_se
    solved.R_nm, solved.R_nm_se = frame.R_nm, frame.R_nm_se
    acc, mag = fits.get("acc"), fits.get("mag")
    solved.f_m = None if acc is None else acc.u
    solved.h_m = None if mag is None else mag.u
    if acc is not None and "lever_arm" in acc.details:
        se = np.sqrt(np.maximum(np.diag(acc.details["joint"])[15:18], 0.0))
        solved.lever_arm = (np.asarray(acc.details["lever_arm"]), se)


# --- a mirrored gyroscope -------------------------------------------------------------------------------


def with_axis_reversed(stream: Stream, axis: str) -> Stream:
    """The stream with one axis' sign turned round."""
    signs = np.where(np.arange(3) == "xyz".index(axis), -1.0, 1.0)
    return replace(stream, y=stream.y * signs)


def of_raw_axes(model: SensorModel, axis: str) -> SensorModel:
    """The model for raw readings, from one for readings with that axis reversed."""
    signs = np.where(np.arange(3) == "xyz".index(axis), -1.0, 1.0)
    both = np.concatenate([np.tile(signs, 3), signs])
    C = None if model.covariance is None else model.covariance * np.outer(both, both)
    return replace(model, H=model.H * signs, B=model.B * signs, covariance=C)
