"""How far off a calibrated reading may be: sensor by sensor over the sphere, and for the node in tilt and heading.

Everything comes from the covariance of (H, B), so a loaded calibration tells it as well.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from margcal.apps.report_attitudes import view
from margcal.apps.report_data import magnitude
from margcal.apps.report_sphere import wireframe
from margcal.apps.report_text import NAMES, degrees, esc, fixed, number, table
from margcal.core.types import Array, Calibration, Kind, SensorModel
from margcal.methods.uncertainty import ExpectedError, direction_ellipses, expected_error, heading_error

FULL_CIRCLE_DEG = 90.0
"""An expected error beyond this says that the data determine nothing."""
OUTSTANDING = 1.4
"""A direction is marked beyond this many times the rms of all."""
LARGEST_DRAWN = 0.20
"""Semi-axis (rad) of the largest ellipse in the picture."""


def told(calibration: Calibration) -> dict[Kind, ExpectedError]:
    """Expected errors of the sensors that have a covariance."""
    out: dict[Kind, ExpectedError] = {}
    for kind, model in calibration.models.items():
        if _has_covariance(model):
            assert model.covariance is not None
            out[kind] = expected_error(kind, model.H, model.covariance, magnitude(calibration, model))
    return out


def _has_covariance(model: SensorModel) -> bool:
    C = model.covariance
    whole = C is not None and np.isfinite(C).all() and np.isfinite(model.H).all() and model.H.ndim == 2
    return bool(whole and np.linalg.det(model.H) != 0)


# --- the node ----------------------------------------------------------------------------------------


def heading(calibration: Calibration) -> tuple[float, float, bool] | None:
    """Expected heading error and dip in degrees, and whether the error is an upper limit; None if not to be told.

    Only the fit knows how the errors of the two sensors go together; from the calibration file there is a limit.
    """
    acc, mag, dip = calibration.acc, calibration.mag, _dip(calibration)
    if acc is None or mag is None or dip is None or not (_has_covariance(acc) and _has_covariance(mag)):
        return None
    assert acc.covariance is not None and mag.covariance is not None
    fit = calibration.fits.get("mag")
    between = None if fit is None else fit.details.get("covariance_with_acc")
    g, m = magnitude(calibration, acc), magnitude(calibration, mag)
    error = heading_error((acc.H, acc.covariance), (mag.H, mag.covariance), g, m, dip, between)
    return error, math.degrees(dip), between is None


def _dip(calibration: Calibration) -> float | None:
    """Angle of the field below the horizontal, rad: from the reference vectors, else from the rests."""
    acc, mag, poses = calibration.acc, calibration.mag, calibration.poses
    if acc is None or mag is None:
        return None
    if mag.reference_vector is not None:
        up = acc.reference_vector if acc.reference_vector is not None else np.array([0.0, 0.0, 1.0])
        return _below(up[None], mag.reference_vector[None])
    if poses is None or not {"acc", "mag"} <= poses.mean.keys():
        return None
    return _below(acc.apply(poses.mean["acc"]), mag.apply(poses.mean["mag"]))


def _below(up: Array, field: Array) -> float | None:
    both = np.linalg.norm(up, axis=1) * np.linalg.norm(field, axis=1)
    good = np.isfinite(both) & (both > 0)
    if not good.any():
        return None
    sine = -np.sum(up[good] * field[good], axis=1) / both[good]
    return math.asin(float(np.clip(np.mean(sine), -1.0, 1.0)))


# --- table -------------------------------------------------------------------------------------------


def expected(calibration: Calibration) -> str:
    """Tables and pictures; empty where no sensor has a covariance."""
    errors = told(calibration)
    if not errors:
        return ""
    rows = [
        [
            NAMES[kind].capitalize(),
            angle(e.direction_deg),
            f'{angle(e.worst_direction_deg)} <span class="unit">at {towards(e.worst_towards)}</span>',
            f"{number(e.magnitude_percent, 2)} %" if e.magnitude_percent < 100 else "not determined",
        ]
        for kind, e in errors.items()
    ]
    head = ["Sensor", "Direction, rms", "Worst direction", "Magnitude, rms"]
    return (
        table(head, rows, "expected errors of the sensors", "expected")
        + _node(calibration, errors)
        + _ellipses(calibration, errors)
    )


def angle(value: float) -> str:
    return degrees(value) if value < FULL_CIRCLE_DEG else "not determined"


def _node(calibration: Calibration, errors: dict[Kind, ExpectedError]) -> str:
    rows = []
    if "acc" in errors:
        rows.append(["Tilt", angle(errors["acc"].direction_deg), "at rest, from the accelerometer"])
    found = heading(calibration)
    if found is not None:
        error, dip, limit = found
        where = f"at rest, from magnetometer and accelerometer, where the field dips by {fixed(dip, 1)}°"
        if limit:
            where += "; how the errors of the two go together is not known, so this is an upper limit"
        rows.append(["Heading", f"{'at most ' if limit else ''}{angle(error)}", where])
    return table(["Node", "Expected, rms", "How"], rows, "expected errors of the node", "node") if rows else ""


def towards(u: tuple[float, float, float]) -> str:
    """A direction in words: ``+x``, ``+x −z``."""
    size = max(map(abs, u))
    return " ".join(f"{'+' if v > 0 else '−'}{a}" for a, v in zip("xyz", u) if abs(v) > 0.4 * size)


# --- ellipses ----------------------------------------------------------------------------------------

_SIZE, _RADIUS, _POINTS = 300.0, 118.0, 28


def around() -> Array:
    """The 26 directions of a cube's faces, edges and corners."""
    grid = np.array([[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or y or z], dtype=float)
    return grid / np.linalg.norm(grid, axis=1, keepdims=True)


def enlargement(largest: float) -> float:
    """The round factor (1, 2, 5 times a power of ten) that makes a semi-axis of `largest` rad well visible."""
    power = 10.0 ** math.floor(math.log10(LARGEST_DRAWN / largest))
    return max(m * power for m in (1, 2, 5) if m * power * largest <= LARGEST_DRAWN * (1 + 1e-9))


def _ellipses(calibration: Calibration, errors: dict[Kind, ExpectedError]) -> str:
    u = around()
    axes: dict[Kind, Array] = {}
    for kind, error in errors.items():
        model = calibration.models[kind]
        assert model.covariance is not None
        if error.worst_direction_deg < FULL_CIRCLE_DEG:
            axes[kind] = direction_ellipses(kind, model.H, model.covariance, magnitude(calibration, model), u)
    largest = max((float(np.linalg.norm(a, axis=2).max()) for a in axes.values()), default=0.0)
    if not 1e-12 < largest < math.radians(FULL_CIRCLE_DEG):
        return ""
    factor = enlargement(largest)
    pictures = "".join(_ball(kind, u, a, factor) for kind, a in axes.items())
    times = f"{number(factor, 6)} times" if factor != 1 else "in true size"
    size = "enlarged " if factor > 1 else "drawn at " if factor < 1 else ""
    caption = (
        "Where a calibrated reading may lie that belongs at the middle of its ellipse: one standard deviation, "
        f"{size}{times}, in 26 directions of the calibrated frame. Marked: directions that are much worse than the "
        "others. Pale: on the far side."
    )
    return f'<figure class="balls"><figcaption>{caption}</figcaption><div class="stills">{pictures}</div></figure>'


def _ball(kind: Kind, u: Array, axes: Array, factor: float) -> str:
    s = np.linspace(0, 2 * np.pi, _POINTS, endpoint=False)
    rim = np.cos(s)[:, None, None] * axes[:, 0] + np.sin(s)[:, None, None] * axes[:, 1]
    loops = np.swapaxes(u + factor * rim, 0, 1)
    loops = loops / np.linalg.norm(loops, axis=2, keepdims=True)
    far = (u @ view().T)[:, 2] < 0
    size = np.sqrt(np.sum(axes**2, axis=(1, 2)))
    worst = size > OUTSTANDING * np.sqrt(np.mean(size**2))
    order = sorted(range(len(u)), key=lambda i: not far[i])
    drawn = "".join(
        f'<path class="ellipse{" far" if far[i] else ""}{" worst" if worst[i] else ""}" d="{_loop(loops[i])}"/>'
        for i in order
    )
    wires = "".join(f'<path class="wire" d="M{_points(line)}"/>' for line in wireframe(12, 5, 40))
    label = f"directions of the {NAMES[kind]} with the ellipse of their error"
    return (
        f'<svg viewBox="0 0 {_SIZE:g} {_SIZE:g}" role="img" aria-label="{label}">{wires}{_axes()}{drawn}'
        f'<text class="panel-name" x="10" y="20">{NAMES[kind].capitalize()}</text></svg>'
    )


def _screen(p: Array) -> Array:
    q = p @ view().T
    return np.column_stack([_SIZE / 2 + _RADIUS * q[:, 0], _SIZE / 2 - _RADIUS * q[:, 1]])


def _points(p: Array) -> str:
    return "L".join(f"{x:.1f} {y:.1f}" for x, y in _screen(p))


def _loop(p: Array) -> str:
    return f"M{_points(p)}z"


def _axes() -> str:
    parts: list[Any] = []
    for k, name in enumerate("xyz"):
        tip = np.eye(3)[k]
        (x0, y0), (x1, y1), (x2, y2) = _screen(np.array([tip, 1.18 * tip, 1.27 * tip]))
        parts.append(
            f'<path class="axis axis-{name}" d="M{x0:.1f} {y0:.1f}L{x1:.1f} {y1:.1f}"/>'
            f'<text class="axis-{name}" x="{x2:.1f}" y="{y2 + 4:.1f}" text-anchor="middle">{esc(name)}</text>'
        )
    return "".join(parts)
