"""A small picture of the housing at every rest: a box seen from a fixed place, "up" upwards."""

from __future__ import annotations

import math
from collections.abc import Collection

import numpy as np

from margcal.apps.report_text import plural
from margcal.core.types import Array

MAX_DRAWN = 96
HALF = np.array([0.60, 0.46, 0.30])
"""Half edges of the box: three different ones, so that its attitude can be told from its shape."""
FACE_UP = math.cos(math.radians(12.0))
SIZE, UNIT = 100.0, 46.0
"""Edge of a picture, and pixels per unit of length."""

_AZIMUTH, _ELEVATION = math.radians(-58.0), math.radians(26.0)
_LIGHT = np.array([0.25, -0.55, 0.80])
# for each face: its outward axis, the direction in which its letters run, and their "up"; run x up = outward
_FACES = [
    ("+x", (1, 0, 0), (0, 1, 0), (0, 0, 1)),
    ("−x", (-1, 0, 0), (0, -1, 0), (0, 0, 1)),
    ("+y", (0, 1, 0), (-1, 0, 0), (0, 0, 1)),
    ("−y", (0, -1, 0), (1, 0, 0), (0, 0, 1)),
    ("+z", (0, 0, 1), (1, 0, 0), (0, 1, 0)),
    ("−z", (0, 0, -1), (-1, 0, 0), (0, 1, 0)),
]


def view(azimuth: float = _AZIMUTH, elevation: float = _ELEVATION) -> Array:
    """Rows right, up and towards the viewer, in laboratory components (z up)."""
    ca, sa, ce, se = math.cos(azimuth), math.sin(azimuth), math.cos(elevation), math.sin(elevation)
    return np.array([[-sa, ca, 0.0], [-se * ca, -se * sa, ce], [ce * ca, ce * sa, se]])


def gallery(R: Array, framed: Collection[int] = ()) -> str:
    """Boxes of the rests (J, 3, 3), numbered from 1; those whose numbers are in `framed` are marked."""
    cells = [_cell(i + 1, r, i + 1 in framed) for i, r in enumerate(R[:MAX_DRAWN])]
    more = len(R) - MAX_DRAWN
    note = f'<p class="note">{plural(more, "further rest")} not drawn.</p>' if more > 0 else ""
    return f'<ol class="boxes">{"".join(cells)}</ol>{note}'


def up_name(R: Array) -> str:
    """Which way of the frame points up: ``+z up``, or the angle of the nearest axis from up."""
    up = R[2]
    k = int(np.argmax(np.abs(up)))
    name = f"{'+' if up[k] > 0 else '−'}{'xyz'[k]}"
    if abs(up[k]) >= FACE_UP:
        return f"{name} up"
    return f"{name} {math.degrees(math.acos(min(1.0, abs(float(up[k]))))):.0f}° from up"


def _cell(n: int, R: Array, framed: bool) -> str:
    if not np.isfinite(R).all():
        return f'<li><svg viewBox="0 0 100 100" aria-hidden="true"></svg><span><b>{n}</b> not known</span></li>'
    name, frame = up_name(R), ' class="framed"' if framed else ""
    return (
        f'<li{frame}><svg viewBox="0 0 {SIZE:g} {SIZE:g}" role="img" aria-label="rest {n}: {name}">{_box(R)}</svg>'
        f"<span><b>{n}</b> {name}</span></li>"
    )


def _point(p: Array) -> str:
    return f"{p[0]:.1f} {p[1]:.1f}"


def _screen(p: Array) -> Array:
    """Laboratory points (..., 3) to the picture (..., 2)."""
    q = p @ view().T
    return np.stack([0.47 * SIZE + UNIT * q[..., 0], 0.53 * SIZE - UNIT * q[..., 1]], axis=-1)


def _box(R: Array) -> str:
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * HALF @ R.T
    sides = (_face(R, *face) for face in _FACES)
    return "".join([_shadow(corners, float(corners[:, 2].min())), *sides, _UP_ARROW])


def _shadow(corners: Array, bottom: float) -> str:
    """What the box covers on the table that it stands on, a little larger."""
    flat = corners * np.array([1.14, 1.14, 0.0]) + np.array([0.0, 0.0, bottom - 0.03])
    hull = _hull(_screen(flat))
    return f'<path class="shadow" d="M{"L".join(_point(p) for p in hull)}z"/>'


def _hull(points: Array) -> Array:
    """Convex hull of points (n, 2), by Andrew's monotone chain."""
    ordered = sorted(map(tuple, points.tolist()))

    def chain(seq: list[tuple[float, float]]) -> list[tuple[float, float]]:
        out: list[tuple[float, float]] = []
        for p in seq:
            while len(out) > 1 and _left(out[-2], out[-1], p) <= 0:
                out.pop()
            out.append(p)
        return out[:-1]

    return np.array(chain(ordered) + chain(ordered[::-1]))


def _left(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> float:
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def _face(R: Array, name: str, out: tuple, run: tuple, up: tuple) -> str:
    """One side of the box with its letters on it, if it is turned to the viewer."""
    n, a, b = (R @ np.array(v, dtype=np.float64) for v in (out, run, up))
    towards = float(n @ view()[2])
    if towards <= 0.01:
        return ""
    h = {v: float(HALF @ np.abs(v)) for v in (out, run, up)}
    centre = h[out] * n
    corners = [centre + s * h[run] * a + t * h[up] * b for s, t in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    shade = 1 + round(3 * max(0.0, float(n @ _LIGHT) / float(np.linalg.norm(_LIGHT))))
    sides = "L".join(_point(p) for p in _screen(np.array(corners)))
    return f'<path class="face shade-{shade}" d="M{sides}z"/>' + _letters(name, centre, a, b, min(h[run], h[up]))


def _letters(name: str, centre: Array, run: Array, up: Array, room: float) -> str:
    """The name of a side, lying in its plane, turned by quarters until it can be read."""
    c = _screen(centre)
    quarters = [(run, up), (up, -run), (-run, -up), (-up, run)]
    x, y = max(
        ((_screen(centre + r) - c, c - _screen(centre + u)) for r, u in quarters), key=lambda v: v[0][0] + v[1][1]
    )
    if abs(x[0] * y[1] - x[1] * y[0]) < 0.10 * UNIT**2:
        return ""  # seen too flat to be read
    s = 1.15 * room / 10
    m = " ".join(f"{v:.3f}" for v in (s * x[0], s * x[1], s * y[0], s * y[1], c[0], c[1]))
    return f'<text class="letters axis-{name[-1]}" transform="matrix({m})" x="0" y="3.4">{name}</text>'


_UP_ARROW = '<path class="up" d="M93 62V38M89.5 42.5L93 38L96.5 42.5"/>'
