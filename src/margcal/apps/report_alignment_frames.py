"""The frames of an alignment, drawn and in words: node and marker body, laboratory and earth, lever arm.

Each pair is two triads seen from the same place: on the left the frame that is drawn upright, on the right the one
that is turned against it, with the first one's axes dashed behind it. A rotation is told as an angle and an axis, and
by where each axis of the one frame points in the other.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from margcal.apps.report_attitudes import view
from margcal.apps.report_expected import towards
from margcal.apps.report_text import degrees, fixed, listing, number, plus_minus, table
from margcal.core import so3
from margcal.core.types import Array

WIDTH, CENTRE, UNIT = 200.0, (96.0, 106.0), 62.0
"""Width of a picture, where its origin is, and pixels per unit of length."""
SHORT, TALL, DOWN = 156.0, 190.0, -0.35
"""Heights of a picture, the second where something reaches below `DOWN`."""
LONGEST_M = 100.0
"""A lever arm beyond this is none."""
SAME_DEG = 0.005
"""Frames that are turned less are told as parallel."""
ALONG = 0.985
"""An axis of rotation is named after an axis of the frame within about ten degrees of it."""
AXES = ("x", "y", "z")
EARTH = ("east", "north", "up")


def frames(values: Mapping[str, Any]) -> str:
    """Pictures, words and figures of what `values` (of the `Alignment`) tell; empty where they tell nothing."""
    node, earth = rotation(values.get("marker_to_node")), rotation(values.get("lab_to_earth"))
    lever = vector(values.get("lever_arm_m"), largest=LONGEST_M)
    parts = []
    if node is not None or lever is not None:
        parts.append(_node_figure(node, lever, values))
    if earth is not None:
        parts.append(_earth_figure(earth, values))
    return "".join(parts) + _figures(values, node, earth) if parts else ""


def rotation(q: Any) -> Array | None:
    """The rotation matrix of a scalar-first quaternion; None where it is none (the file is anybody's)."""
    found = vector(q, 4, largest=2.0)
    if found is None or float(np.linalg.norm(found)) < 0.5:
        return None
    return so3.matrix_from_quat(found)


def vector(values: Any, n: int = 3, largest: float = math.inf) -> Array | None:
    """`values` as n finite numbers up to `largest`, or None."""
    if values is None:
        return None
    found = np.asarray(values, dtype=np.float64)
    good = found.shape == (n,) and bool(np.isfinite(found).all()) and bool((np.abs(found) <= largest).all())
    return found if good else None


# --- words ---------------------------------------------------------------------------------------------


def turned(R: Array, one: str, other: str, se: Array | None = None) -> str:
    """``The marker body is turned by 20.9° against the node, about the direction ... of the node's axes`` (HTML).

    `se` (3,), rad: an angle within twice that is told as such, and without an axis.
    """
    turn = so3.log(R)
    angle = float(np.linalg.norm(turn))
    error = 0.0 if se is None else float(np.linalg.norm(se))
    if angle < 2 * error:
        return (
            f"The {one} is turned by <strong>{degrees(math.degrees(angle))}</strong> against the {other}; with a "
            f"standard error of {degrees(math.degrees(error))}, that is not to be told from parallel"
        )
    if math.degrees(angle) < SAME_DEG:
        return f"The {one} lies <strong>parallel</strong> to the {other}"
    axis = turn / angle
    k = int(np.argmax(np.abs(axis)))
    if abs(axis[k]) > ALONG:
        about = f"its {'+' if axis[k] > 0 else '−'}{AXES[k]} axis"
    else:
        about = f"the direction ({', '.join(fixed(v, 2) for v in axis)}) in its axes"
    return f"The {one} is turned by <strong>{degrees(math.degrees(angle))}</strong> against the {other}, about {about}"


def heading_words(R_nm: Array) -> str:
    """Which axis of the laboratory is up, how far off, and where a horizontal one points (HTML)."""
    up = int(np.argmax(np.abs(R_nm[2])))
    sign = "+" if R_nm[2, up] > 0 else "−"
    off = math.degrees(math.acos(min(1.0, abs(float(R_nm[2, up])))))
    level = [k for k in range(3) if k != up]
    north = max(level, key=lambda k: abs(R_nm[1, k]))
    s = 1.0 if R_nm[1, north] > 0 else -1.0
    bearing = math.degrees(math.atan2(s * R_nm[0, north], s * R_nm[1, north]))
    side = "east" if bearing > 0 else "west"
    return (
        f"Its {sign}{AXES[up]} axis points up, {_off(off)} the vertical; its {'+' if s > 0 else '−'}{AXES[north]} axis "
        f"points {degrees(abs(bearing))} {side} of magnetic north"
    )


def _off(angle: float) -> str:
    return f"{degrees(angle)} off" if angle >= SAME_DEG else "exactly along"


def lever_words(lever: Array, se: Array | None) -> str:
    """The lever arm as steps along the marker body's axes (HTML)."""
    steps = []
    for k, v in enumerate(1e3 * lever):
        width = None if se is None else 1e3 * float(se[k])
        steps.append(f"{plus_minus(abs(float(v)), width, 3)} mm along {'+' if v >= 0 else '−'}{AXES[k]}")
    return (
        f"The accelerometer sits <strong>{number(1e3 * float(np.linalg.norm(lever)), 3)} mm</strong> from the marker "
        f"body's origin: {listing(steps)} of the marker body's axes"
    )


# --- figures -------------------------------------------------------------------------------------------


def _node_figure(R_hk: Array | None, lever: Array | None, values: Mapping[str, Any]) -> str:
    """Node, marker body and lever arm; columns of R_hk are the marker body's axes in the node's."""
    words, pictures, low = [], [], 0.0
    if R_hk is not None:
        low = float(R_hk[2].min())
    if lever is not None:
        low = min(low, float(_drawn(lever)[2]))
    tall = _height(low)
    if R_hk is not None:
        words.append(f"{turned(R_hk, 'marker body', 'node', vector(values.get('marker_to_node_se')))}.")
        words.append("Dashed beside the marker body's axes: the node's.")
        pictures += [_triad("Node", np.eye(3), AXES, tall), _triad("Marker body", R_hk, AXES, tall, ghost=True)]
    if lever is not None:
        words.append(f"{lever_words(lever, vector(values.get('lever_arm_m_se')))}.")
        pictures.append(_lever(lever, tall))
    return _figure("Node and marker body", words, pictures)


def _earth_figure(R_nm: Array, values: Mapping[str, Any]) -> str:
    words = [
        f"{turned(R_nm, 'laboratory', 'earth', vector(values.get('lab_to_earth_se')))}.",
        f"{heading_words(R_nm)}. Dashed: the earth's axes.",
    ]
    tall = _height(float(R_nm[2].min()))
    pictures = [_triad("Earth", np.eye(3), EARTH, tall), _triad("Laboratory", R_nm, AXES, tall, ghost=True)]
    return _figure("Laboratory and earth", words, pictures)


def _figure(name: str, words: Sequence[str], pictures: Sequence[str]) -> str:
    return (
        f'<figure class="frames"><figcaption><strong>{name}.</strong> {" ".join(words)}</figcaption>'
        f'<div class="triads">{"".join(pictures)}</div></figure>'
    )


def _figures(values: Mapping[str, Any], R_hk: Array | None, R_nm: Array | None) -> str:
    """Rotation vectors with their standard errors, and where each axis points."""
    rows = []
    for R, name, one, other, names in (
        (R_hk, "marker_to_node", "Marker body to node", "node", tuple(f"{{}}{a}" for a in AXES)),
        (R_nm, "lab_to_earth", "Laboratory to earth", "earth", ("east west", "north south", "up down")),
    ):
        if R is None:
            continue
        se = vector(values.get(f"{name}_se"))
        turn = np.degrees(so3.log(R))
        widths = [None] * 3 if se is None else np.degrees(se).tolist()
        rows.append([f"{one}, rotation vector, °", *(plus_minus(float(v), w, 4) for v, w in zip(turn, widths))])
        rows.append(
            [f"{one.split(' to ')[0]}'s axis lies along the {other}'s", *(_points(R[:, k], names) for k in range(3))]
        )
    known = any(f"{name}_se" in values for name in ("marker_to_node", "lab_to_earth"))
    note = (
        '<p class="note">A rotation vector has the axis of the turn for its direction and the angle for its length. '
        f"The file holds the same as quaternions{'; behind ± is the standard error' if known else ''}.</p>"
    )
    return table(["", *AXES], rows, "frames in figures", "frames-table") + note if rows else ""


def _points(axis: Array, names: Sequence[str]) -> str:
    """``+x, 3.2° off``"""
    k = int(np.argmax(np.abs(axis)))
    positive = bool(axis[k] > 0)
    name = names[k].format("+" if positive else "−")
    if " " in name:
        name = name.split()[0 if positive else 1]
    across = math.degrees(math.atan2(float(np.linalg.norm(np.delete(axis, k))), abs(float(axis[k]))))
    return name if across < SAME_DEG else f'{name}, <span class="se">{degrees(across)} off</span>'


# --- pictures ------------------------------------------------------------------------------------------


def _screen(p: Array) -> Array:
    """Points (..., 3) of the upright frame (z up) to the picture (..., 2)."""
    q = np.asarray(p) @ view().T
    return np.stack([CENTRE[0] + UNIT * q[..., 0], CENTRE[1] - UNIT * q[..., 1]], axis=-1)


def _triad(name: str, R: Array, labels: Sequence[str], height: float, *, ghost: bool = False) -> str:
    """Three axes, columns of R in the upright frame; `ghost`: the upright frame dashed behind them."""
    parts = [_ground()]
    if ghost:
        parts += [_arrow(np.zeros(3), 1.0 * np.eye(3)[k], f"ghost axis-{AXES[k]}", head=False) for k in range(3)]
    order = sorted(range(3), key=lambda k: float((view() @ R[:, k])[2]))  # those that point away first
    parts += [_arrow(np.zeros(3), R[:, k], f"axis axis-{AXES[k]}") for k in order]
    parts += [_label(R[:, k], labels[k], AXES[k]) for k in range(3)]
    told = ", ".join(f"{labels[k]} along {towards(tuple(R[:, k]))}" for k in range(3))
    title = f"Axes of the {name.lower()}" + (f" in the frame on the left: {told}" if ghost else "")
    return _picture(name, title, "".join(parts), height)


def _height(low: float) -> float:
    return TALL if low < DOWN else SHORT


def _drawn(lever: Array) -> Array:
    """The lever arm in a size that fits the picture."""
    longest = float(np.abs(lever).max())
    return lever / longest * 0.8 if longest > 0 else np.zeros(3)


def _lever(lever: Array, height: float) -> str:
    """The way from the marker body's origin to the accelerometer, as steps along the axes and straight."""
    tip = _drawn(lever)
    parts = [_ground()]
    parts += [_arrow(np.zeros(3), 1.0 * np.eye(3)[k], f"ghost axis-{AXES[k]}", head=False) for k in range(3)]
    at = np.zeros(3)
    for k in range(3):
        step = np.where(np.arange(3) == k, tip, 0.0)
        parts.append(_arrow(at, at + step, f"axis axis-{AXES[k]}", head=False))
        at = at + step
    x, y = _screen(tip)
    parts.append(_arrow(np.zeros(3), tip, "lever", head=False))
    parts += [_label(np.eye(3)[k], AXES[k], AXES[k]) for k in range(3)]
    parts.append(f'<circle class="lever-end" cx="{x:.1f}" cy="{y:.1f}" r="4.5"/>')
    return _picture("Lever arm", "From the marker body's origin to the accelerometer", "".join(parts), height)


def _picture(name: str, title: str, content: str, height: float) -> str:
    return (
        f'<svg viewBox="0 0 {WIDTH:g} {height:g}" role="img" aria-label="{title}">{content}'
        f'<text class="panel-name" x="10" y="19">{name}</text></svg>'
    )


def _ground() -> str:
    """A circle in the plane of x and y, so that the picture is seen as three-dimensional."""
    s = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    rim = _screen(np.column_stack([np.cos(s), np.sin(s), np.zeros_like(s)]))
    return f'<path class="ground" d="M{"L".join(f"{x:.1f} {y:.1f}" for x, y in rim)}z"/>'


def _arrow(start: Array, stop: Array, name: str, head: bool = True) -> str:
    (x0, y0), (x1, y1) = _screen(start), _screen(stop)
    tip = ""
    length = math.hypot(x1 - x0, y1 - y0)
    if head and length > 8:
        ux, uy = (x1 - x0) / length, (y1 - y0) / length
        a, b = (x1 - 7 * ux + 3.5 * uy, y1 - 7 * uy - 3.5 * ux), (x1 - 7 * ux - 3.5 * uy, y1 - 7 * uy + 3.5 * ux)
        tip = f"M{a[0]:.1f} {a[1]:.1f}L{x1:.1f} {y1:.1f}L{b[0]:.1f} {b[1]:.1f}"
    return f'<path class="{name}" d="M{x0:.1f} {y0:.1f}L{x1:.1f} {y1:.1f}{tip}"/>'


def _label(axis: Array, text: str, colour: str) -> str:
    """Beyond the tip; beside it where the axis points at the viewer."""
    x, y = _screen(axis)
    dx, dy = x - CENTRE[0], y - CENTRE[1]
    length = math.hypot(dx, dy)
    if length < 12:
        dx, dy, length = 1.0, 0.6, math.hypot(1.0, 0.6)
    x, y = x + 11 * dx / length, y + 11 * dy / length + 4.5
    anchor = "middle" if len(text) < 2 or abs(dx) < 0.4 * length else "start" if dx > 0 else "end"
    return f'<text class="axis-{colour}" x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{text}</text>'
