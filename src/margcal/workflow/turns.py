"""The gyroscope's share of a route: which turns can be used, what the rests say of its bias and noise."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from margcal.core import so3
from margcal.core.errors import DataError
from margcal.core.types import Array, Fit, Issue, Mask, SensorModel, Turn
from margcal.core.units import UNITS
from margcal.methods.gyro import mean_bias
from margcal.methods.gyro_start import full_turns
from margcal.methods.preintegration import along
from margcal.methods.uncertainty import expected_error
from margcal.workflow.job import Job, Solved
from margcal.workflow.lint import clip_limits, clipped

FULL_TURN_DEG = (345.0, 375.0)
MIN_TURNS = 5
FULL_TURN_BY_HAND_DEG = 2.0
"""How far from 360 degrees a full turn made by hand may end."""
NOMINAL_GAIN_SD = 0.03
"""Datasheet tolerance of a gyroscope's gain (consumer parts: 1-3 %), used where the turns do not tell it."""
NOMINAL_CROSS_SD = 0.02
"""The same of the entries off the diagonal: cross-axis sensitivity (2 % in the datasheets) and mounting."""
MAX_FREE_ERROR_DEG = 1.0
"""Expected error above which the turns alone are not trusted and the nominal gain is taken in."""


def usable_turns(job: Job, usable: Mask | None = None) -> list[Turn]:
    """Turns between usable rests whose readings are all there and none at the end of the scale."""
    limits = [None if r.gyr is None else clip_limits(r.gyr) for r in job.recordings]
    turns = []
    for turn in job.segmentation.turns:
        if usable is not None and not (usable[turn.before] and usable[turn.after]):
            continue
        index = job.segmentation.poses.recording[turn.before]
        stream = job.recordings[index].gyr
        assert stream is not None
        if not clipped(turn.y, stream, limits[index]).any():
            turns.append(turn)
    return turns


def need_turns(turns: list[Turn]) -> None:
    if len(turns) >= MIN_TURNS:
        return
    text = (
        f"gyroscope: {len(turns)} turns between rests can be used, {MIN_TURNS} are needed; "
        "record more rests with turns of 60 to 270 degrees about all axes in between"
    )
    raise DataError(text, (Issue("too-few-turns", "fail", text, "gyr", float(len(turns)), float(MIN_TURNS)),))


def gyro_rest(job: Job) -> tuple[Array, Array, Array]:
    """Bias (41), covariance of that bias, and noise of a single reading, from the rests."""
    poses = job.segmentation.poses
    y, index = job.readings("gyr")
    if not len(y):
        text = "gyroscope: no rest, so its bias is unknown; leave the node still for some seconds at the start"
        raise DataError(text, (Issue("no-rest", "fail", text, "gyr"),))
    sd = np.sqrt(np.nanmean(poses.sd["gyr"][index] ** 2, axis=0))
    sd = np.maximum(sd, 1e-9 * np.abs(y).max() + 1e-12)
    scatter = y.std(axis=0, ddof=1) if len(y) > 2 else sd
    # the bias of a turn is not exactly the mean over all rests: its own scatter over the rests is the prior
    return mean_bias(y), np.diag(np.maximum(scatter, sd / 10) ** 2), sd


def nominal_gyro(job: Job) -> Array | None:
    """The gyroscope's H by its unit, or the user's nominal one; None for raw counts."""
    if "gyr" in job.options.nominal:
        return job.options.nominal["gyr"].H
    factor = UNITS["gyr"][job.raw_unit("gyr")]
    return None if factor is None else factor * np.eye(3)


def without_full_turns(turns: list[Turn], fit: Fit, refit: Callable[[list[Turn]], Fit]) -> Fit:
    """Fit again without full turns: they tell one gain each and serve as a check that had no part in the fit."""
    rest = not_full(turns, fit)
    return fit if len(rest) == len(turns) or len(rest) < MIN_TURNS else refit(rest)


def check_full_turns(job: Job, solved: Solved) -> None:
    """Say at what angle the full turns close with the gyroscope as calibrated."""
    fit = solved.fits.get("gyr")
    turns = usable_turns(job)
    if fit is None or not turns:
        return
    left_out = {id(t) for t in turns} - {id(t) for t in not_full(turns, fit)}
    full = [t for t in turns if id(t) in left_out]
    if not full or len(turns) - len(full) < MIN_TURNS:
        return
    found = full_turns(full, fit.model.H, fit.model.B, low_deg=300, high_deg=420)
    angles = ", ".join(f"{a:.1f}" for a in found.angle_deg)
    off = np.abs(found.angle_deg - 360.0)
    limit = FULL_TURN_BY_HAND_DEG + 3 * np.array([360 * _gain_sd(fit, axis) for axis in found.axis])
    text = f"gyroscope: {len(full)} full turns, kept out of the fit as a check, close at {angles} degrees"
    wrong = bool(np.any(off > limit))
    if wrong:
        text += "; that is more than its covariance allows: record more turns about that axis"
    worst = int(np.argmax(off - limit))
    level = "warn" if wrong else "note"
    solved.issues.append(Issue("full-turns", level, text, "gyr", float(off[worst]), float(limit[worst])))


def _gain_sd(fit: Fit, axis: Array) -> float:
    """Relative standard deviation of the gain about a unit `axis` (3,) of the node frame."""
    if fit.covariance is None:
        return 0.0
    # the gain about the axis is a . dH H^-1 a
    gradient = np.outer(axis, np.linalg.inv(fit.model.H) @ axis).ravel()
    return float(np.sqrt(max(gradient @ fit.covariance[:9, :9] @ gradient, 0.0)))


def with_nominal(job: Job, acc: SensorModel, solve: Callable[[], Fit], solved: Solved) -> Fit:
    """The gyroscope from its turns, and where these leave it open, helped by its nominal gain.

    A gyroscope in rad/s or degrees per second comes with a gain that is right to a few per cent, in axes that
    are the accelerometer's. Raw counts have no such thing: there the turns must do.

    Raises
    ------
    DataError
        If the turns are too few and the gain is unknown.
    """
    nominal = nominal_gyro(job)
    try:
        fit = solve()
    except DataError:
        if nominal is None:
            raise
        fit = None
    if nominal is None or (fit is not None and _expected(fit) <= MAX_FREE_ERROR_DEG):
        assert fit is not None
        return fit
    H0 = so3.polar(acc.H)[0] @ nominal
    scale = np.cbrt(abs(np.linalg.det(H0)))
    P = np.diag((scale * np.where(np.eye(3) > 0, NOMINAL_GAIN_SD, NOMINAL_CROSS_SD).ravel()) ** 2)
    return _nominal_fit(job, solved, fit, H0, P)


def _expected(fit: Fit) -> float:
    if fit.covariance is None or not fit.converged:
        return float("inf")
    return expected_error("gyr", fit.model.H, fit.covariance, 1.0).direction_deg


def _nominal_fit(job: Job, solved: Solved, fit: Fit | None, H0: Array, P: Array) -> Fit:
    """Least squares of the turns' H and the nominal one, both with their covariances; bias from the rests."""
    bias, spread, _ = gyro_rest(job)
    C = np.zeros((12, 12))
    C[9:, 9:] = spread
    usable = fit is not None and fit.converged and fit.covariance is not None
    if usable:
        assert fit is not None and fit.covariance is not None
        gain = P @ np.linalg.inv(P + fit.covariance[:9, :9])
        H = H0 + (gain @ (fit.model.H - H0).ravel()).reshape(3, 3)
        C[:9, :9] = P - gain @ P
        residual, what = np.asarray(fit.residual), f"{len(np.asarray(fit.residual))} turns and the nominal gain"
    else:
        H, residual, what = H0, np.zeros(1), "its nominal gain; only the bias was measured"
        C[:9, :9] = P
    C = (C + C.T) / 2
    text = (
        f"gyroscope: the turns do not carry it alone; it is calibrated from {what} "
        f"(taken as right to {NOMINAL_GAIN_SD * 100:.0f} %). Record ten or more turns of 60 to 270 degrees about "
        "all axes between rests"
    )
    solved.issues.append(
        Issue("nominal-gain", "warn", text, "gyr", _expected(fit) if fit else None, MAX_FREE_ERROR_DEG)
    )
    model = SensorModel("gyr", H, bias, covariance=C, raw_unit=job.raw_unit("gyr"), method="nominal-gain")
    return Fit(model, residual, float(residual @ residual), "nominal-gain", covariance=C, rank=3)


def not_full(turns: list[Turn], fit: Fit) -> list[Turn]:
    found = full_turns(turns, fit.model.H, fit.model.B, low_deg=FULL_TURN_DEG[0], high_deg=FULL_TURN_DEG[1])
    return [t for i, t in enumerate(turns) if i not in set(found.index.tolist())]


def along_turns(job: Job, turns: list[Turn], acc: SensorModel) -> Array:
    """Calibrated accelerometer at the gyroscope's samples of each turn, (T, N, 3)."""
    longest = max(len(t.dt) for t in turns)
    out = np.zeros((len(turns), longest, 3))
    for index, recording in enumerate(job.recordings):
        mine = [i for i, t in enumerate(turns) if job.segmentation.poses.recording[t.before] == index]
        if not mine or recording.acc is None:
            continue
        part = along([turns[i] for i in mine], recording.acc.t, acc.apply(recording.acc.y))
        out[mine, : part.shape[1]] = part
        out[mine, part.shape[1] :] = part[:, -1:]
    return out
