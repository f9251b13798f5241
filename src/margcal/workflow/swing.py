"""A magnetometer waved about without rests: its bias and shape from all samples, its frame from the gyroscope."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from margcal.core import so3
from margcal.core.errors import DataError
from margcal.core.types import Array, Fit, Issue, Recording
from margcal.core.units import UNITS
from margcal.methods.alignment import rotation_from_rates
from margcal.methods.ellipsoid import adjusted_ellipsoid
from margcal.methods.uncertainty import expected_error
from margcal.workflow.job import NAMES, Job, Solved

MIN_SWING_SAMPLES = 200
GOOD_ENOUGH_DEG = 0.5
"""Expected error of the magnetometer from rests up to which a swing is not tried."""


def swung(job: Job, solved: Solved | None = None) -> Solved:
    """A magnetometer waved about: B and H^T H from all samples, its frame from the gyroscope."""
    solved = solved or Solved()
    best: tuple[float, Recording, Fit] | None = None
    failure: DataError | None = None
    for recording in job.recordings:
        if recording.mag is None or len(recording.mag.t) < MIN_SWING_SAMPLES:
            continue
        try:
            fit = adjusted_ellipsoid(
                recording.mag.y[np.isfinite(recording.mag.y).all(axis=1)],
                job.options.magnitude["mag"],
                **job.as_named("mag"),
            )
        except DataError as error:
            failure = error
            continue
        error = _error(job, fit)
        if best is None or error < best[0]:
            best = (error, recording, fit)
    if best is None:
        solved.attempt("mag", lambda: _no_swing(failure))
        return solved
    _, recording, fit = best
    solved.fits["mag"] = fit
    solved.sources["mag"] = f"{recording.source}: all {len(recording.streams['mag'].t)} samples"
    _aligned(job, solved, recording, fit)
    return solved


def _no_swing(failure: DataError | None) -> Fit:
    if failure is not None:
        raise failure
    text = f"magnetometer: fewer than {MIN_SWING_SAMPLES} samples; wave the node about all axes for 20 s or longer"
    raise DataError(text, (Issue("too-few-samples", "fail", text, "mag"),))


def _aligned(job: Job, solved: Solved, recording: Recording, fit: Fit) -> None:
    """Turn the magnetometer's H into the gyroscope's frame, if the recording has one."""
    gyr = recording.gyr
    calibrated = solved.fits.get("gyr")
    if gyr is None or (calibrated is None and UNITS["gyr"][gyr.unit] is None):
        text = (
            "magnetometer: nothing tells its rotation to the other sensors (no gyroscope in a known unit in this "
            "recording); its frame is its own, and only magnitudes can be trusted"
        )
        solved.issues.append(Issue("own-frame", "warn", text, "mag"))
        upper = np.linalg.cholesky(fit.model.H.T @ fit.model.H).T
        solved.fits["mag"] = replace(fit, model=replace(fit.model, H=upper, covariance=None), covariance=None)
        return
    if calibrated is not None:
        rate = calibrated.model.apply(gyr.y)
    else:
        factor = UNITS["gyr"][gyr.unit] or 1.0
        rate = factor * gyr.y
    mag = recording.streams["mag"]
    good = np.isfinite(mag.y).all(axis=1)
    v = fit.model.apply(mag.y[good]) / job.options.magnitude["mag"]
    found = rotation_from_rates(mag.t[good], v, gyr.t, rate)
    H = found.Omega @ fit.model.H
    se_deg = np.hypot(found.se_deg, _frame_error_deg(calibrated))
    covariance = _turned_covariance(fit.covariance, found.Omega, se_deg, H)
    solved.fits["mag"] = replace(fit, model=replace(fit.model, H=H, covariance=covariance), covariance=covariance)
    if found.delay_s is not None:
        solved.delays["mag"] = (found.delay_s, found.delay_se_s)
    angles = np.degrees(so3.log(found.Omega))
    text = (
        "magnetometer: turned into the gyroscope's frame by "
        f"[{angles[0]:.2f} {angles[1]:.2f} {angles[2]:.2f}] deg, standard errors "
        f"[{found.se_deg[0]:.2f} {found.se_deg[1]:.2f} {found.se_deg[2]:.2f}] deg"
    )
    solved.issues.append(Issue("aligned-to-gyroscope", "note", text, "mag", float(np.nanmax(found.se_deg))))


def _frame_error_deg(gyr: Fit | None) -> float:
    """Error about each axis of the frame that the calibrated gyroscope hands on; one by its datasheet is the frame."""
    if gyr is None or gyr.covariance is None or not np.isfinite(gyr.covariance).all():
        return 0.0
    return expected_error("gyr", gyr.model.H, gyr.covariance, 1.0).direction_deg / np.sqrt(2)


def _turned_covariance(C: Array | None, Omega: Array, se_deg: Array, H: Array) -> Array | None:
    """Covariance of (Omega K, B) from that of (K, B) and the standard errors of Omega."""
    if C is None or not np.isfinite(se_deg).all():
        return None
    T = np.zeros((12, 12))
    T[:9, :9] = np.kron(Omega, np.eye(3))
    T[9:, 9:] = np.eye(3)
    turned = T @ C @ T.T
    # H <- exp(d) H changes row by row by (d x columns of H)
    J = np.zeros((9, 3))
    for k in range(3):
        J[:, k] = (so3.skew(np.eye(3)[k]) @ H).ravel()
    turned[:9, :9] += (J * np.radians(se_deg) ** 2) @ J.T
    return turned


def swing_only(job: Job) -> Solved:
    solved = Solved()
    if job.wants("mag"):
        swung(job, solved)
    for kind in ("acc", "gyr"):
        if job.wants(kind):
            text = (
                f"{NAMES[kind]}: a swing calibrates the magnetometer only; record rests (put the node down in ten "
                "to thirty attitudes, two seconds each) for the other sensors"
            )
            solved.issues.append(Issue("no-rests", "fail", text, kind))
    return solved


def try_swing(job: Job, solved: Solved) -> None:
    """Where the rests carry the magnetometer badly or not at all, take it from continuous motion if that is better."""
    if not job.wants("mag"):
        return
    have = _error(job, solved.fits.get("mag"))
    if have <= GOOD_ENOUGH_DEG:
        return
    try:
        trial = swung(job, Solved(fits={k: f for k, f in solved.fits.items() if k != "mag"}))
    except DataError:
        return  # the motion does not tell the magnetometer's frame either
    if _error(job, trial.fits.get("mag")) >= have:
        return
    solved.issues[:] = [i for i in solved.issues if i.sensor != "mag"] + trial.issues
    solved.fits["mag"] = trial.fits["mag"]
    solved.sources |= trial.sources
    solved.delays |= trial.delays
    solved.vectors.pop("mag", None)


def _error(job: Job, fit: Fit | None) -> float:
    if fit is None or fit.covariance is None or not np.isfinite(fit.covariance).all():
        return float("inf")
    return expected_error("mag", fit.model.H, fit.covariance, job.options.magnitude["mag"]).direction_deg
