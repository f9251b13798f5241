"""Readings on their ellipsoid and on the unit sphere: data for the 3-D view, and the same as a fixed picture."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from margcal.apps.report_attitudes import view
from margcal.apps.report_data import magnitude
from margcal.apps.report_text import NAMES, plain_unit
from margcal.core.types import Array, Calibration, Kind, SensorModel

MAX_SAMPLES = 1500
MAX_RESTS = 400
ORIGIN_WITHIN = 2.2
"""The raw zero is in the picture when it is nearer to the ellipsoid's centre than this many radii."""
KINDS: tuple[Kind, ...] = ("acc", "mag")


def sphere_data(calibration: Calibration) -> dict[str, Any]:
    """What the viewer needs, by sensor; empty where there are no readings to show."""
    out: dict[str, Any] = {}
    moved = calibration.alignment is not None and not calibration.poses
    for kind in KINDS[1:] if moved else KINDS:  # what an accelerometer reads in motion lies on no sphere
        model = calibration.models.get(kind)
        if model is None or model.H.ndim != 2 or abs(np.linalg.det(model.H)) == 0:
            continue
        rests, numbers = _rests(calibration, kind)
        samples = _samples(calibration, kind)
        if not len(rests) and not len(samples):
            continue
        out[kind] = _view_of(calibration, model, rests, numbers, samples)
    return out


def _view_of(
    calibration: Calibration, model: SensorModel, rests: Array, numbers: NDArray[np.intp], samples: Array
) -> dict:
    length = magnitude(calibration, model)
    radius = length / abs(np.linalg.det(model.H)) ** (1 / 3)
    centred = bool(np.linalg.norm(model.B) > ORIGIN_WITHIN * radius)
    return {
        "name": NAMES[model.kind],
        "unit": plain_unit(model.unit),
        "raw_unit": plain_unit(model.raw_unit),
        "magnitude": length,
        "radius": radius,
        "centred": centred,
        "H": model.H.tolist(),
        "B": model.B.tolist(),
        "rests": _short(rests),
        "numbers": numbers.tolist(),
        "samples": _short(samples),
    }


def _short(values: Array) -> list[list[float]]:
    """Six significant digits are plenty for a picture."""
    return [[float(f"{v:.6g}") for v in row] for row in values.tolist()]


def _rests(calibration: Calibration, kind: Kind) -> tuple[Array, NDArray[np.intp]]:
    poses = calibration.poses
    if poses is None or kind not in poses.mean:
        return np.zeros((0, 3)), np.zeros(0, dtype=np.intp)
    index = np.flatnonzero(np.isfinite(poses.mean[kind]).all(axis=1))[:MAX_RESTS]
    return poses.mean[kind][index], index + 1


def _samples(calibration: Calibration, kind: Kind) -> Array:
    """Every n-th finite reading over all recordings."""
    streams = [r.streams[kind].y for r in calibration.recordings if kind in r.streams]
    if not streams:
        return np.zeros((0, 3))
    step = max(1, sum(map(len, streams)) // MAX_SAMPLES)
    y = np.concatenate([s[::step] for s in streams])[: 2 * MAX_SAMPLES]
    return y[np.isfinite(y).all(axis=1)]


# --- the fixed picture -------------------------------------------------------------------------------

_SIZE, _RADIUS = 360.0, 118.0


def still_pictures(data: dict[str, Any]) -> str:
    """Before and after of every sensor as SVG, for readers without scripts."""
    parts = []
    for one in data.values():
        before, after = _still(one, raw=True), _still(one, raw=False)
        parts.append(f'<div class="stills">{before}{after}</div>')
    return "".join(parts)


def wireframe(meridians: int = 12, parallels: int = 5, points: int = 40) -> list[Array]:
    """Lines of longitude and latitude on the unit sphere."""
    s = np.linspace(0, 2 * np.pi, points)
    lines = []
    for k in range(meridians // 2):
        a = np.pi * k / (meridians // 2)
        lines.append(np.column_stack([np.cos(a) * np.sin(s), np.sin(a) * np.sin(s), np.cos(s)]))
    for k in range(1, parallels + 1):
        b = np.pi * k / (parallels + 1)
        lines.append(np.column_stack([np.sin(b) * np.cos(s), np.sin(b) * np.sin(s), np.full_like(s, np.cos(b))]))
    return lines


def _still(one: dict[str, Any], *, raw: bool) -> str:
    H, B, m = np.array(one["H"]), np.array(one["B"]), one["magnitude"]
    origin = B if one["centred"] else np.zeros(3)
    inverse = np.linalg.inv(H)
    shift = 0.0 if one["centred"] or not raw else float(np.linalg.norm(B)) / one["radius"]
    size = _RADIUS / (1 + 0.6 * shift)

    def place(y: Array, *, unit: bool = False) -> Array:
        """Points of the picture from raw readings, or from unit vectors of the calibrated frame."""
        if raw:
            p = ((y * m) @ inverse.T + B if unit else y) - origin
            p = p / one["radius"]
        else:
            p = y if unit else ((y - B) @ H.T) / m
        q = p @ view().T
        return np.column_stack([_SIZE / 2 + size * q[:, 0], _SIZE / 2 - size * q[:, 1]])

    lines = "".join(f'<path class="wire" d="{_line(place(w, unit=True))}"/>' for w in wireframe())
    dots = _dots(one["samples"][:400], place, "sample", 1.1) + _dots(one["rests"], place, "rest-dot", 3.2)
    what = "as read" if raw else "calibrated"
    return (
        f'<svg viewBox="0 0 {_SIZE:g} {_SIZE:g}" class="{"raw" if raw else "cal"}" role="img" '
        f'aria-label="{one["name"]} readings {what}">'
        f'{lines}{dots}<text class="panel-name" x="8" y="18">{one["name"]}, {what}</text></svg>'
    )


def _line(points: Array) -> str:
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in np.clip(points, -1e4, 1e4))


def _dots(values: list, place: Any, name: str, radius: float) -> str:
    if not values:
        return ""
    points = place(np.array(values))
    points = points[(np.abs(points) < 2 * _SIZE).all(axis=1)]
    return "".join(f'<circle class="{name}" cx="{x:.1f}" cy="{y:.1f}" r="{radius:g}"/>' for x, y in points)
