"""The paper's method within `align`: R-BSN on clocks that were found first, its result in the house's form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from margcal.core import so3
from margcal.core.errors import DataError
from margcal.core.types import Array, Fit, Issue, Kind
from margcal.methods.clock import gyroscope_at_reference
from margcal.methods.mocap_excitation import attitude_excitation, rate_excitation
from margcal.methods.mocap_fit import lowpass_svd
from margcal.methods.mocap_frame import earth_from_laboratory
from margcal.methods.r_bsn import RBsn, laboratory_vector, polar_split, r_bsn
from margcal.methods.reference_rates import reference_rates, resample
from margcal.workflow.align_fits import magnetometer_delay, negated, placed, usable
from margcal.workflow.align_job import AlignJob, AlignSolved, Tick

SHRUNK = 0.015
"""Relative difference of H from a method that linear acceleration does not shrink, above which it is warned of."""


def solve_paper(job: AlignJob, tick: Tick) -> AlignSolved:
    """Every sensor by R-BSN (12)-(20)."""
    solved, sync, rates, options = AlignSolved(), job.sync, job.rates, job.options
    streams = job.recording.streams
    solved.delays["gyr"] = (sync.delay_s, sync.delay_se_s if sync.common_clock else 0.0)
    delays = {"acc": sync.delay_s, "mag": sync.delay_s}
    if "mag" in options.sensors:
        try:  # not in the paper, which takes all sensors for simultaneous
            found = magnetometer_delay(job)
            if usable(found):
                delays["mag"] = found.delay_s
                solved.delays["mag"] = (found.delay_s, found.se_s)
        except DataError:
            pass
    tick(5, 9)
    node = sync.node_time(rates.t)
    w_ref = reference_rates(job.reference, as_printed=True).w if options.as_printed else rates.w
    turning = rate_excitation(rates.w[rates.valid])
    if turning.level == "fail":
        raise DataError(turning.text, (Issue("poor-excitation", "fail", turning.text, "gyr"),))
    if turning.text:
        solved.issues.append(Issue("weak-excitation", "warn", turning.text, "gyr"))
    readings = {
        kind: y
        for kind in ("acc", "mag")
        if kind in options.sensors
        and (y := _excited(job, solved, kind, resample(streams[kind].t, streams[kind].y, node + delays[kind])))
        is not None
    }
    gyr = gyroscope_at_reference(sync, streams["gyr"].t, streams["gyr"].y, rates)
    found = r_bsn(
        w_ref,
        rates.R,
        gyr,
        readings.get("acc"),
        readings.get("mag"),
        b_w=None if job.static_bias is None else job.static_bias[0],
        gravity=options.gravity,
        field=options.field_uT or 1.0,
        norm=options.norm,
        units={k: (s.unit, options.units[k]) for k, s in streams.items()},
        allow_mirrored=options.as_printed,
    )
    tick(8, 9)
    _take_paper(job, solved, found)
    if options.as_printed:
        solved.issues.append(_as_printed(job, gyr - found.fits["gyr"].model.B, w_ref, found.T))
    return solved


def _excited(job: AlignJob, solved: AlignSolved, kind: Kind, y: Array) -> Array | None:
    """The readings, if the attitudes in which they were taken can carry a fit."""
    use = np.isfinite(y).all(axis=1) & job.rates.valid
    R = job.rates.R[use]
    try:
        v = laboratory_vector(y[use], R, so3.nearest_rotation(job.sync.T))
        spread = attitude_excitation(kind, np.einsum("nji,j->ni", R, v))
    except DataError as error:
        solved.issues.append(Issue("poor-excitation", "fail", str(error), kind))
        return None
    if spread.level == "fail":
        solved.issues.append(Issue("poor-excitation", "fail", spread.text, kind))
        return None
    if spread.text:
        solved.issues.append(Issue("weak-excitation", "warn", spread.text, kind))
    return y


def _as_printed(job: AlignJob, Omega: Array, w_ref: Array, T: Array) -> Issue:
    """What (14) as printed leaves of the rate, beside what it leaves corrected."""
    use = np.isfinite(Omega).all(axis=1) & np.isfinite(w_ref).all(axis=1)
    left = np.sum((w_ref[use] - Omega[use] @ T.T) ** 2) / np.sum(w_ref[use] ** 2)
    text = (
        f"(14) as printed gives the rate in the laboratory's axes: T leaves {100 * left:.0f} % of its square "
        f"(corrected {100 * (1 - job.sync.explained):.2f} %), det T {np.linalg.det(T):.3g} (corrected "
        f"{np.linalg.det(job.sync.T):.3g}); everything that follows is in no known frame"
    )
    return Issue("as-printed", "fail", text, None, float(left), 1 - job.sync.explained)


def _take_paper(job: AlignJob, solved: AlignSolved, found: RBsn) -> None:
    fits = dict(found.fits)
    if "mag" in fits and "acc" in fits and job.options.dip is not None and found.f_m is not None:
        h = fits["mag"].u
        if h is not None and float(found.f_m @ h) * np.sin(job.options.dip) > 0:
            fits["mag"] = negated(fits["mag"])
    fits["gyr"] = _gyroscope_covariance(job, fits["gyr"], found)
    for kind in job.options.sensors:
        if kind in fits:
            solved.fits[kind] = fits[kind]
            solved.models[kind] = fits[kind].model
    solved.R_kh = found.C_b
    solved.f_m, solved.h_m = found.f_m, fits["mag"].u if "mag" in fits else None
    if solved.f_m is not None and solved.h_m is not None:
        solved.R_nm = earth_from_laboratory(solved.f_m, solved.h_m)
    if "acc" in fits and (shrunk := _shrunk(job, fits["acc"], found.C_b)) is not None:
        solved.issues.append(shrunk)
    if "acc" in fits and found.gated < 0.999:
        text = (
            f"accelerometer: {100 * (1 - found.gated):.0f} % of the samples were left out by the gate of (20) "
            "(linear acceleration)"
        )
        solved.issues.append(Issue("gated", "note", text, "acc", 1 - found.gated))


def _shrunk(job: AlignJob, fit: Fit, C_b: Array) -> Issue | None:
    """What linear acceleration did to the paper's K: its standard errors know nothing of it."""
    acc, d = job.recording.streams["acc"], job.sync.delay_s
    t, R, _, known = placed(job, acc, d)
    try:
        other = lowpass_svd(t, acc.y, R, known, gravity=job.options.gravity, raw_unit=acc.unit).model.H
        off = float(np.linalg.norm(C_b @ fit.model.H @ np.linalg.inv(other) - np.eye(3), 2))
        text = f"accelerometer: H is {100 * off:.1f} % off that of `lowpass-svd`"
    except DataError:
        off = (fit.model.residual_rms or 0.0) / job.options.gravity
        text = f"accelerometer: {100 * off:.1f} % of gravity are left over"
    if off <= SHRUNK:
        return None
    text += (
        ": linear acceleration, which the paper's (20) has in its regressor, makes K come out too small; its standard "
        "errors do not contain this. Take `lowpass-svd`, or `forward` with positions"
    )
    return Issue("linear-acceleration", "warn", text, "acc", off, SHRUNK)


def _gyroscope_covariance(job: AlignJob, fit: Fit, found: RBsn) -> Fit:
    """Covariance of (K_w row by row, b_w) from that of T (jackknife) and of b_w, K_w = C^bT T sym by numbers."""
    T, step = found.T, 1e-6 * float(np.linalg.norm(found.T))
    J = np.zeros((12, 9))
    se = np.zeros(9)
    for k in range(9):
        moved = T.copy()
        moved[k // 3, k % 3] += step
        try:
            J[:9, k] = (polar_split(moved, True)[1] - fit.model.H).ravel() / step
            se[k] = 1.0
        except DataError:
            continue
    C = J @ found.T_covariance @ J.T
    if job.static_bias is not None:
        C[9:, 9:] = np.diag(job.static_bias[1] ** 2)
    else:
        # B = -T^-1 c, hence dB = -T^-1 (dc + dT B)
        T, c = job.sync.T, job.sync.c
        by = -np.linalg.solve(T, np.column_stack([np.kron(np.eye(3), -np.linalg.solve(T, c)), np.eye(3)]))
        C[9:, 9:] = by @ job.sync.covariance @ by.T
    model = replace(fit.model, covariance=(C + C.T) / 2)
    return replace(fit, model=model, covariance=model.covariance)
