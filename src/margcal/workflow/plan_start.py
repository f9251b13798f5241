"""What a plan starts from: a node of which only the kind is known, or what recordings told of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from margcal.core.types import Array, Calibration, Kind, Recording
from margcal.core.units import KINDS, STANDARD_GRAVITY, UNITS
from margcal.workflow.plan_information import Circumstances, Knowledge, Sensor, after_rest, beginning

Hands = Literal["box", "free"]
S_ROT, LEVEL_SD = np.radians(0.2), np.radians(1.0)
"""Housing error of a box put down by hand, and tilt of a table, where no recording tells them."""
DIP = np.radians(60.0)
NOISE: dict[Kind, float] = {"acc": 0.02 / 14, "gyr": 0.002 / 14, "mag": 0.009 / 14}
"""Standard errors of the mean over two seconds at 100 Hz, of a consumer part: m/s^2, rad/s, share of the field."""
LEAST_TURN_SE = np.radians(0.003)
FLOOR = 0.1
"""Share of `NOISE` below which nobody believes a standard error (readings without noise)."""


def nominal(hands: Hands, sensors: Sequence[Kind], dip: float) -> Knowledge:
    """A node of which only the kind is known, SI units."""
    kinds: dict[Kind, Sensor] = {k: _nominal_sensor(k, dip, hands == "free") for k in KINDS if k in sensors}
    how = Circumstances(s_rot=S_ROT if hands == "box" else None)
    return beginning(kinds, how)


def _nominal_sensor(kind: Kind, dip: float, free: bool) -> Sensor:
    u = {"acc": np.array([0.0, 0.0, STANDARD_GRAVITY]), "mag": np.array([0.0, np.cos(dip), -np.sin(dip)])}
    sd = {"acc": 0.0 if free else float(LEVEL_SD), "mag": 1.0, "gyr": 0.0}[kind]
    vector = u.get(kind, np.array([0.0, 0.0, 1.0]))
    se = np.full(3, NOISE[kind])
    return Sensor(kind, np.eye(3), np.zeros(3), vector, se, triangular=free and kind == "acc", u_sd=sd)


def knowledge_of(
    calibration: Calibration, recordings: Sequence[Recording], hands: Hands = "box", dip: float = DIP
) -> Knowledge:
    """What recordings told of a node, rest by rest.

    Parameters
    ----------
    calibration : Calibration
        From `calibrate(*recordings, allow_fail=True)`.
    recordings : sequence of Recording
    """
    free = calibration.frame == "acc-triangular" or (not calibration.models and hands == "free")
    there: list[Kind] = [k for k in KINDS if any(k in r.streams for r in recordings)]
    sensors: dict[Kind, Sensor] = {k: _sensor(calibration, recordings, k, dip, free) for k in there}
    how = _circumstances(calibration, hands if not calibration.models else None)
    now = beginning(sensors, how)
    poses = calibration.poses
    if poses is None or poses.R is None or not calibration.models:
        return now
    turned = {t.after for t in calibration.turns}
    rests = [j for j in range(len(poses)) if np.isfinite(poses.R[j]).all()]
    for j in rests:
        read: list[Kind] = [k for k in calibration.models if k in poses.mean and np.isfinite(poses.mean[k][j]).all()]
        if j != rests[-1]:  # what is known from elsewhere is told once; but it tells how the node lies at last
            read = [k for k in read if sensors[k].prior is None]
        now = after_rest(now, poses.R[j], turned=j in turned and "gyr" in read, read=read)
    return now


def _sensor(calibration: Calibration, recordings: Sequence[Recording], kind: Kind, dip: float, free: bool) -> Sensor:
    model = calibration.models.get(kind)
    nominal = _nominal_sensor(kind, dip, free)
    if model is None:
        return _unfitted(recordings, kind, nominal)
    u = model.reference_vector
    if kind == "gyr" or u is None or not np.isfinite(u).all():
        size = STANDARD_GRAVITY if kind == "acc" else 1.0 if model.unit == "norm" else 50.0
        u = nominal.u / np.linalg.norm(nominal.u) * size
    elsewhere = model.method == "nominal-gain" or kind in calibration.settings.get("sources", {})
    prior = _prior_of(model.covariance) if elsewhere else None
    return replace(nominal, H=model.H, B=model.B, u=np.asarray(u), se=_standard_error(calibration, kind), prior=prior)


def _prior_of(C: Array | None) -> Array | None:
    """Covariance of a sensor that was not fitted at the rests with all others, as far as it is known."""
    return None if C is None or not np.isfinite(C).all() else np.array(C)


def _unfitted(recordings: Sequence[Recording], kind: Kind, nominal: Sensor) -> Sensor:
    """A sensor that could not be calibrated: SI by its unit, else its counts as one magnitude."""
    stream = next(r.streams[kind] for r in recordings if kind in r.streams)
    factor = UNITS[kind][stream.unit]
    if factor is None:  # its noise relative to its magnitude is what counts
        return nominal
    H = np.eye(3) * (factor / 50.0 if kind == "mag" else factor)
    return replace(nominal, H=H, se=nominal.se / H[0, 0])


def _standard_error(calibration: Calibration, kind: Kind) -> Array:
    """Of the mean at a rest, raw unit; the nominal one where the sensor was not read at rest."""
    poses, model = calibration.poses, calibration.models[kind]
    usual = NOISE[kind] * (50.0 if model.unit == "uT" else 1.0) / float(np.cbrt(abs(np.linalg.det(model.H))))
    if poses is None or kind not in poses.sd:
        return np.full(3, usual)
    variance = poses.sd[kind] ** 2 / np.maximum(poses.count[kind], 1)[:, None]
    seen = np.isfinite(variance).all(axis=1)
    if not seen.any():
        return np.full(3, usual)
    return np.maximum(np.sqrt(variance[seen].mean(axis=0)), FLOOR * usual)


def _circumstances(calibration: Calibration, hands: Hands | None) -> Circumstances:
    """Housing error, tilt and turns as the recordings had them."""
    how = Circumstances(s_rot=S_ROT if hands == "box" else None)
    mode = calibration.settings.get("attitudes")
    if mode in ("cube", "file", "reference"):
        rows = calibration.settings.get("checks", [])
        found = [r["value"] for r in rows if r["code"] == "housing-error" and r["value"] is not None]
        how = replace(how, s_rot=np.radians(max(found[0], 0.01)) if found else S_ROT)
    elif mode == "faces":
        how = replace(how, level_sd=_tilt(calibration))
    lasted = [float(t.t[-1] - t.t[0]) for t in calibration.turns if len(t.t) > 1]
    how = replace(how, turn_s=float(np.median(lasted)) if lasted else how.turn_s)
    return replace(how, turn_se=max(_turn_error(calibration, how.turn_s), LEAST_TURN_SE))


def _turn_error(calibration: Calibration, turn_s: float) -> float:
    """Error of an integrated turn about each axis, rad: as the joint fit left it over, else by the noise of the
    readings (what single fits leave over is mostly the accelerometer's)."""
    gyr, poses = calibration.gyr, calibration.poses
    fit = calibration.fits.get("gyr")
    if gyr is None or poses is None or fit is None or "gyr" not in poses.sd or not calibration.turns:
        return Circumstances().turn_se
    residual = np.asarray(fit.residual)
    if gyr.method == "gls-ml" and np.isfinite(residual).any():
        return float(np.sqrt(np.nanmean(residual**2) / 3))
    sd = np.sqrt(np.nanmean(poses.sd["gyr"] ** 2)) * float(np.cbrt(abs(np.linalg.det(gyr.H))))
    period = float(np.median([np.mean(t.dt) for t in calibration.turns]))
    return float(sd * np.sqrt(turn_s * period))


def _tilt(calibration: Calibration) -> float:
    """How far "up" was from the faces, about each horizontal axis, rad."""
    poses = calibration.poses
    if poses is None or poses.R is None or len(poses) < 6:
        return float(LEVEL_SD)
    off = 1 - np.max(np.abs(poses.R[:, 2, :]), axis=1) ** 2  # sine of the tilt, squared
    return float(max(np.sqrt(np.mean(off) / 2), np.radians(0.02)))
