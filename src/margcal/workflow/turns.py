"""The gyroscope's share of a route: which turns can be used, what the rests say of its bias and noise."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from margcal.core.errors import DataError
from margcal.core.types import Array, Fit, Issue, SensorModel, Turn
from margcal.core.units import UNITS
from margcal.methods.gyro import mean_bias
from margcal.methods.gyro_start import full_turns
from margcal.methods.preintegration import along
from margcal.workflow.job import Job, Solved
from margcal.workflow.lint import clipped

FULL_TURN_DEG = (345.0, 375.0)
MIN_TURNS = 5


def usable_turns(job: Job, usable: Array | None = None) -> list[Turn]:
    """Turns between usable rests whose readings are all there and none at the end of the scale."""
    turns = []
    for turn in job.segmentation.turns:
        if usable is not None and not (usable[turn.before] and usable[turn.after]):
            continue
        stream = job.recordings[job.segmentation.poses.recording[turn.before]].gyr
        assert stream is not None
        if not clipped(turn.y, stream).any():
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


def without_full_turns(
    job: Job, turns: list[Turn], fit: Fit, solved: Solved, refit: Callable[[list[Turn]], Fit]
) -> Fit:
    """Fit again without full turns, and report what angle they close to: a check that had no part in the fit."""
    found = full_turns(turns, fit.model.H, fit.model.B, low_deg=FULL_TURN_DEG[0], high_deg=FULL_TURN_DEG[1])
    rest = [t for i, t in enumerate(turns) if i not in set(found.index.tolist())]
    if not len(found.index) or len(rest) < MIN_TURNS:
        return fit
    again = refit(rest)
    found = full_turns([turns[i] for i in found.index], again.model.H, again.model.B, low_deg=300, high_deg=420)
    angles = ", ".join(f"{a:.1f}" for a in found.angle_deg)
    text = (
        f"gyroscope: {len(found.index)} full turns were kept out of the fit; calibrated they close at {angles} degrees"
    )
    worst = float(np.max(np.abs(found.angle_deg - 360.0), initial=0.0))
    solved.issues.append(Issue("full-turns", "note", text, "gyr", worst))
    return again


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
