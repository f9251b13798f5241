"""What the pictures of the report are drawn from: magnitudes, residuals by rest or turn, attitudes of the rests.

A calibration that was loaded has no fits; with a recording beside it, the residual of a rest is then how far the
magnitude of its calibrated reading is off, which needs no attitudes.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from margcal.core import so3
from margcal.core.types import Array, Calibration, Fit, Kind, Poses, SensorModel
from margcal.core.units import STANDARD_GRAVITY

Mask = NDArray[np.bool_]
FULL_TURN_DEG = (345.0, 375.0)


@dataclass(frozen=True)
class Residuals:
    """What is left over at each rest or turn, in `unit` as shown.

    `labels` names each value shortly (``7``, ``7–8``). `by` is 'rest', 'turn' or 'sample'; `from_fit` is False where
    the figure is the deviation of the magnitude. `out` marks what was left out of the fit, whose value may be NaN:
    `used`, `rms` and `worst` are of the others.
    """

    kind: Kind
    value: Array
    labels: tuple[str, ...]
    unit: str
    by: str
    from_fit: bool
    out: Mask
    weight: Array | None = None

    @property
    def used(self) -> Array:
        return self.value[~self.out]

    @property
    def rms(self) -> float:
        return float(np.sqrt(np.mean(self.used**2)))

    @property
    def worst(self) -> int:
        return int(np.argmax(np.where(self.out, -1.0, np.abs(self.value))))


def left_out(calibration: Calibration, code: str) -> set[tuple[int, ...]]:
    """Numbers of the rests (or pairs of them, turns) that the issues of this code say were left out."""
    found = set()
    for issue in calibration.issues:
        match = _NAMED.search(issue.text) if issue.code == code else None
        if match is not None:
            found.add(tuple(int(g) for g in match.groups() if g))
    return found


_NAMED = re.compile(r"\brest (\d{1,6})(?: to (\d{1,6}))?")


def setting(calibration: Calibration, name: str) -> float | None:
    """A number among the settings; None where it is missing or no number (the file is anybody's)."""
    value = calibration.settings.get(name)
    good = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value) and value > 0
    return float(value) if good else None  # type: ignore[arg-type]


def magnitude(calibration: Calibration, model: SensorModel) -> float:
    """Length of the sensed vector in `model.unit`: gravity or the local field."""
    if model.reference_vector is not None and np.isfinite(model.reference_vector).all():
        length = float(np.linalg.norm(model.reference_vector))
        if length > 0:
            return length
    if model.kind == "acc":
        return setting(calibration, "gravity") or STANDARD_GRAVITY
    if model.unit == "norm":
        return 1.0
    return setting(calibration, "field_uT") or _typical(calibration, model)


def _typical(calibration: Calibration, model: SensorModel) -> float:
    """Median length of the calibrated readings, for a field that nobody told."""
    y = [r.streams[model.kind].y[::50] for r in calibration.recordings if model.kind in r.streams]
    length = np.linalg.norm(model.apply(np.concatenate(y)), axis=1) if y else np.zeros(0)
    length = length[np.isfinite(length)]
    return float(np.median(length)) if len(length) else 50.0


def shown_unit(model: SensorModel) -> tuple[float, str]:
    """Factor and unit in which a residual is shown."""
    if model.kind == "acc":
        return 1e3, "mm/s²"
    if model.kind == "gyr":
        return math.degrees(1.0), "°"
    return (100.0, "% of the field") if model.unit == "norm" else (1.0, "µT")


def residuals(calibration: Calibration, kind: Kind) -> Residuals | None:
    """The residuals of one sensor, or None where nothing tells them."""
    model, fit = calibration.models[kind], calibration.fits.get(kind)
    factor, unit = shown_unit(model)
    if fit is None:
        return _magnitude_residuals(calibration, model, factor, unit)
    value = np.asarray(fit.residual, dtype=np.float64)
    if value.ndim != 1 or not len(value) or not np.isfinite(value).any():
        return None
    labels, by = _turn_labels(calibration, fit) if kind == "gyr" else _rest_labels(calibration, kind, len(value))
    out = _turns_left_out(calibration, labels) if kind == "gyr" else np.isnan(value) & _read(calibration, kind, labels)
    if (out | ~np.isfinite(value)).all():
        return None
    weight = _weights(fit, len(value))
    keep = np.isfinite(value) | out
    return Residuals(
        kind,
        factor * value[keep],
        tuple(t for t, k in zip(labels, keep) if k),
        unit,
        by,
        True,
        out[keep],
        None if weight is None else weight[keep],
    )


def _read(calibration: Calibration, kind: Kind, labels: tuple[str, ...]) -> Mask:
    """Whether the sensor was read at the rest of each label: a NaN there is a reading that was left out."""
    poses = calibration.poses
    if poses is None or kind not in poses.mean or len(labels) != len(poses):
        return np.zeros(len(labels), dtype=bool)
    read: Mask = np.all(np.isfinite(poses.mean[kind]), axis=-1)
    return read


def _turns_left_out(calibration: Calibration, labels: tuple[str, ...]) -> Mask:
    gone = {f"{t[0]}–{t[-1]}" for t in left_out(calibration, "turn-left-out") if len(t) == 2}
    return np.array([label in gone for label in labels], dtype=bool)


def _weights(fit: Fit, n: int) -> Array | None:
    weight = np.asarray(fit.details.get("weights", ()), dtype=np.float64)
    return weight if weight.shape == (n,) else None


def _magnitude_residuals(calibration: Calibration, model: SensorModel, factor: float, unit: str) -> Residuals | None:
    poses = calibration.poses
    if poses is None or model.kind == "gyr" or model.kind not in poses.mean:
        return None
    off = np.linalg.norm(model.apply(poses.mean[model.kind]), axis=1) - magnitude(calibration, model)
    index = np.flatnonzero(np.isfinite(off))
    if not len(index):
        return None
    labels = tuple(str(i + 1) for i in index)
    return Residuals(
        model.kind, factor * np.abs(off[index]), labels, unit, "rest", False, np.zeros(len(index), dtype=bool)
    )


def _rest_labels(calibration: Calibration, kind: Kind, n: int) -> tuple[tuple[str, ...], str]:
    """The number of the rest behind each residual."""
    poses = calibration.poses
    if poses is not None and kind in poses.mean:
        index = np.flatnonzero(np.isfinite(poses.mean[kind]).all(axis=1))
        for candidate in (index, np.arange(len(poses))):
            if len(candidate) == n:
                return tuple(str(i + 1) for i in candidate), "rest"
    return tuple(str(i + 1) for i in range(n)), "sample" if n > 200 else "reading"


def _turn_labels(calibration: Calibration, fit: Fit) -> tuple[tuple[str, ...], str]:
    """``7–8`` for the turn from rest 7 to rest 8; a plain number where the fit's turns cannot be told."""
    n = len(fit.residual)
    turns = calibration.turns
    if len(turns) != n:
        angles = turn_angles_deg(calibration, fit.model)
        full = (angles >= FULL_TURN_DEG[0]) & (angles <= FULL_TURN_DEG[1])
        turns = tuple(t for t, out in zip(turns, full) if not out)
    if len(turns) == n:
        return tuple(f"{t.before + 1}–{t.after + 1}" for t in turns), "turn"
    return tuple(str(i + 1) for i in range(n)), "turn"


def turn_angles_deg(calibration: Calibration, model: SensorModel) -> Array:
    """How far each turn went about the axis that it was made about, by the calibrated gyroscope."""
    if not calibration.turns:
        return np.zeros(0)
    from margcal.methods.gyro_start import turn_angle

    return np.degrees(np.abs(turn_angle(calibration.turns, model.H, model.B).about_axis))


def attitudes(calibration: Calibration) -> tuple[Array | None, bool]:
    """Rotations (J, 3, 3) of the rests, frame h to laboratory, NaN where unknown; and whether headings are known."""
    poses = calibration.poses
    if poses is None or not len(poses):
        return None, False
    if poses.R is not None:
        return np.asarray(poses.R), True
    if "acc" not in calibration.models or "acc" not in poses.mean:
        return None, False
    return _by_gravity(poses, calibration.models["acc"]), False


def _by_gravity(poses: Poses, acc: SensorModel) -> Array:
    """The attitude with the right "up" and the smallest turn from level."""
    f = acc.apply(poses.mean["acc"])
    up = np.full_like(f, np.nan)
    good = np.linalg.norm(np.nan_to_num(f), axis=1) > 0
    up[good] = f[good] / np.linalg.norm(f[good], axis=1, keepdims=True)
    z = np.array([0.0, 0.0, 1.0])
    axis = np.cross(up, z)
    sine = np.linalg.norm(axis, axis=1, keepdims=True)
    angle = np.arctan2(sine, up[:, 2:])
    axis = np.where(sine > 1e-9, axis / np.where(sine > 1e-9, sine, 1.0), np.array([1.0, 0.0, 0.0]))
    R = np.full((len(f), 3, 3), np.nan)
    whole = np.isfinite(up).all(axis=1)
    R[whole] = so3.exp((angle * axis)[whole])
    return R
