"""An existing calibration on other recordings: their rests and turns, and what is left over there.

Nothing is fitted. The residual of an accelerometer or magnetometer is the length of the calibrated mean of a rest
less the length it should have; that of the gyroscope is the angle by which "up", carried through a turn by the
calibrated rates, misses the "up" of the next rest. Attitudes are not needed for either.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from margcal.core.errors import InputError
from margcal.core.types import Array, Calibration, Fit, Kind, Recording, SensorModel
from margcal.core.units import STANDARD_GRAVITY
from margcal.methods.preintegration import integrate, pad
from margcal.workflow.segment import Segmentation, find_poses

METHOD = "on the recordings"


def revisit(calibration: Calibration, recordings: tuple[Recording, ...]) -> Calibration:
    """`calibration` with the poses, turns and residuals of `recordings` in place of those it was made from.

    Returns
    -------
    Calibration
        H and B as they were; `residual_rms` and `n_poses` are those of the recordings. A sensor that is in the
        calibration but not at rest in the recordings keeps its figures and has no fit.

    Raises
    ------
    InputError
        If a sensor is in another unit than the calibration was made for, or none of its sensors is there.
    """
    _check_units(calibration, recordings)
    found = find_poses(*recordings)
    residuals: dict[Kind, Array] = {}
    for kind in calibration.models:
        residual = _turned(calibration, found) if kind == "gyr" else _lengths(calibration, kind, found)
        if len(residual):
            residuals[kind] = residual
    fits: dict[Kind, Fit] = {}
    models: dict[Kind, SensorModel] = {}
    for kind, residual in residuals.items():
        rms = float(np.sqrt(np.mean(residual**2)))
        models[kind] = replace(calibration.models[kind], residual_rms=rms, n_poses=_rests(found, kind))
        fits[kind] = Fit(models[kind], residual, rms**2, METHOD)
    issues = (*calibration.issues, *(i for r in recordings for i in r.issues), *found.issues)
    return replace(
        _with_models(calibration, models),
        issues=tuple(dict.fromkeys(issues)),
        fits=fits,
        poses=found.poses,
        turns=found.turns,
        recordings=recordings,
    )


def _with_models(calibration: Calibration, models: Mapping[Kind, SensorModel]) -> Calibration:
    return replace(calibration, **models)  # type: ignore[arg-type]


def _check_units(calibration: Calibration, recordings: tuple[Recording, ...]) -> None:
    there = {k for r in recordings for k in r.streams}
    if not there & set(calibration.models):
        raise InputError(
            f"the calibration is of {', '.join(calibration.models) or 'no sensor'}, the recordings hold "
            f"{', '.join(sorted(there))}; give a recording of the calibrated node"
        )
    for recording in recordings:
        for kind, unit in recording.units.items():
            model = calibration.models.get(kind)
            if model is not None and unit != model.raw_unit:
                raise InputError(
                    f"{recording.source}: {kind} is in {unit}, the calibration takes {model.raw_unit}; give a "
                    "recording in the unit that it was made from"
                )


def _rests(found: Segmentation, kind: Kind) -> int:
    return int(np.isfinite(found.poses.mean[kind]).all(axis=1).sum())


def _lengths(calibration: Calibration, kind: Kind, found: Segmentation) -> Array:
    """Length of each calibrated rest less what it should be, calibrated unit."""
    y = found.poses.mean.get(kind)
    if y is None:
        return np.zeros(0)
    model = calibration.models[kind]
    u = model.apply(y[np.isfinite(y).all(axis=1)])
    return np.linalg.norm(u, axis=1) - _magnitude(calibration, model)


def _magnitude(calibration: Calibration, model: SensorModel) -> float:
    """Length of the sensed vector: as the file says, else as it was set."""
    if model.reference_vector is not None:
        return float(np.linalg.norm(model.reference_vector))
    settings = calibration.settings
    if model.kind == "acc":
        return float(settings.get("gravity") or STANDARD_GRAVITY)
    return float(settings.get("field_uT") or 1.0) if model.unit == "uT" else 1.0


def _turned(calibration: Calibration, found: Segmentation) -> Array:
    """Angle (rad) by which "up" misses after each turn; none without a calibrated accelerometer."""
    acc, gyr, y = calibration.acc, calibration.gyr, found.poses.mean.get("acc")
    if acc is None or gyr is None or y is None:
        return np.zeros(0)
    up = acc.apply(y)
    seen = set(np.flatnonzero(np.isfinite(up).all(axis=1)).tolist())
    turns = [t for t in found.turns if t.before in seen and t.after in seen]
    if not turns:
        return np.zeros(0)
    up = up / np.linalg.norm(up, axis=1, keepdims=True)
    batch = pad(turns)
    dR = integrate(batch.y, batch.dt, gyr.H, gyr.B)  # R_before_after
    carried = np.einsum("tji,tj->ti", dR, up[[t.before for t in turns]])
    after = up[[t.after for t in turns]]
    cross = np.linalg.norm(np.cross(carried, after), axis=1)
    return np.arctan2(cross, np.sum(carried * after, axis=1))
