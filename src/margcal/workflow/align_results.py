"""What an alignment leaves in the calibration: values of the file, notes, and figures for a report."""

from __future__ import annotations

from typing import Any

import numpy as np

from margcal.core import so3
from margcal.core.types import Array, Issue, Kind
from margcal.core.units import UNITS
from margcal.methods.clock import gyroscope_at_reference
from margcal.methods.reference_rates import ReferenceRates
from margcal.workflow.align_job import AlignFigures, AlignJob, AlignSolved, thinned
from margcal.workflow.job import NAMES


def values(job: AlignJob, solved: AlignSolved) -> dict[str, Any]:
    """`alignment` of the calibration file."""
    sync = job.sync
    values: dict[str, Any] = {"offset_s": sync.offset_s, "drift_ppm": sync.drift_ppm}
    if solved.R_kh is not None:
        values["marker_to_node"] = so3.quat_from_matrix(solved.R_kh.T).tolist()
    if solved.R_nm is not None:
        values["lab_to_earth"] = so3.quat_from_matrix(solved.R_nm).tolist()
    if solved.lever_arm is not None:
        values["lever_arm_m"] = solved.lever_arm[0].tolist()
        values["lever_arm_m_se"] = solved.lever_arm[1].tolist()
    if not sync.common_clock:
        values["offset_s_se"], values["drift_ppm_se"] = sync.offset_se_s, sync.drift_se_ppm
    if solved.R_kh_se is not None and np.isfinite(solved.R_kh_se).all():
        values["marker_to_node_se"] = solved.R_kh_se.tolist()
    if solved.R_nm_se is not None and np.isfinite(solved.R_nm_se).all():
        values["lab_to_earth_se"] = solved.R_nm_se.tolist()
    return values


def notes(job: AlignJob, solved: AlignSolved) -> list[Issue]:
    """What is worth knowing and needs no mending."""
    notes: list[Issue] = []
    mag, sync = solved.models.get("mag"), job.sync
    if mag is not None and job.options.dip is None:
        text = (
            "magnetometer: its sign is taken so that det H > 0 (axes not mirrored); give the place (--at) if the board "
            "flips them"
        )
        notes.append(Issue("sign-assumed", "note", text, "mag"))
    for kind in ("acc", "mag"):
        if kind in solved.models and kind in solved.delays:
            delay, se = solved.delays[kind]
            after = delay - sync.delay_s
            error = float(np.hypot(se or 0.0, sync.delay_se_s))
            text = (
                f"{NAMES[kind]}: {1e3 * after:+.2f} +- {1e3 * error:.2f} ms behind the gyroscope; `apply` corrects it"
            )
            notes.append(Issue("delay", "note", text, kind, after))
    return notes


def figures(job: AlignJob, solved: AlignSolved) -> AlignFigures:
    sync, rates = job.sync, job.rates
    gyr = job.raw.streams["gyr"]
    raw = gyroscope_at_reference(sync, gyr.t, gyr.y, rates)
    model, factor = solved.models.get("gyr"), UNITS["gyr"].get(gyr.unit)
    R_kh = np.eye(3) if solved.R_kh is None else solved.R_kh
    seen = rates.w @ R_kh
    before = np.full_like(seen, np.nan) if factor is None else raw * factor - rates.w
    after = np.full_like(seen, np.nan) if model is None else model.apply(raw) - seen
    residual_t: dict[Kind, Array] = {}
    residual: dict[Kind, Array] = {}
    for kind, fit in solved.fits.items():
        left = np.asarray(fit.residual)
        t = fit.details.get("track_t", rates.t)
        residual_t[kind], residual[kind] = thinned(t), thinned(left)
    near = np.abs(sync.lags - (0.0 if sync.common_clock else sync.offset_s)) <= 5.0
    return AlignFigures(
        method=job.options.method,
        lags=thinned(sync.lags[near]),
        correlation=thinned(sync.correlation[near]),
        peak=sync.peak,
        explained=sync.explained,
        t=thinned(rates.t),
        rate=thinned(seen),
        rate_before=thinned(before),
        rate_after=thinned(after),
        residual_t=residual_t,
        residual=residual,
        masked=_masked(rates),
        seen=float(rates.valid.mean()),
        f_m=solved.f_m,
        h_m=solved.h_m,
        delays=dict(solved.delays),
    )


def _masked(rates: ReferenceRates) -> tuple[tuple[float, float], ...]:
    """Stretches longer than the polynomials in which the body was not seen, the longest hundred."""
    lost = np.concatenate([[False], ~rates.valid, [False]])
    starts, stops = np.flatnonzero(~lost[:-1] & lost[1:]), np.flatnonzero(lost[:-1] & ~lost[1:])
    spans = [(float(rates.t[a]), float(rates.t[b - 1])) for a, b in zip(starts, stops) if b - a > rates.points // 2]
    spans = sorted(spans, key=lambda s: s[0] - s[1])[:100]
    return tuple(sorted(spans))
