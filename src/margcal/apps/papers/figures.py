"""The papers' figures as SVG: curves, histograms, dots. Each is a file of its own, readable without a style sheet.

A figure is a row of panels; a panel draws its frame, its scale and its marks in a box of pixels.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from margcal.apps.report_svg import Scale, nice_step, tick_labels
from margcal.apps.report_text import esc
from margcal.core.types import Array

BLUE, ORANGE, GREY, GREEN, PURPLE = "#1668a8", "#d5580b", "#6b7280", "#1b7f4d", "#7b3fa0"
COLOURS = (BLUE, ORANGE, GREEN, PURPLE, "#8a6d00", "#b0125b", "#0f766e", GREY)
"""Told apart by the colour-blind in pairs, and by name in the legend."""

Place = Callable[[ArrayLike], Array]
"""Value to pixel."""

LEFT, RIGHT, TOP, BOTTOM = 70.0, 18.0, 46.0, 50.0


@dataclass(frozen=True)
class Curve:
    """A line through (x, y), or dots only (`dots`); gaps at NaN."""

    label: str
    x: Array
    y: Array
    colour: str = BLUE
    dash: str = ""
    dots: bool = False
    line: bool = True
    error: Array | None = None  # half-height of the bars


@dataclass(frozen=True)
class Bars:
    """Bars of height `y` between `edges`."""

    label: str
    edges: Array
    y: Array
    colour: str = BLUE


@dataclass(frozen=True)
class Panel:
    """One pair of axes. `y_range` cuts what goes beyond; `log` draws powers of ten upwards."""

    title: str
    x_label: str
    y_label: str
    curves: tuple[Curve, ...] = ()
    bars: tuple[Bars, ...] = ()
    log: bool = False
    x_range: tuple[float, float] | None = None
    y_range: tuple[float, float] | None = None
    x_names: tuple[str, ...] = ()
    zero_line: bool = False
    note: str = ""
    legend: bool = True
    lines: tuple[tuple[float, str], ...] = field(default=())


def figure(title: str, panels: Sequence[Panel], *, width: float = 460, height: float = 340) -> str:
    """The SVG of panels side by side under a common title."""
    return stacked(title, [panels], width=width, height=height)


def stacked(title: str, rows: Sequence[Sequence[Panel]], *, width: float = 460, height: float = 300) -> str:
    """The SVG of several rows of panels under a common title."""
    total, tall = width * max(len(row) for row in rows), 34 + height * len(rows)
    name = f"c{zlib.crc32(title.encode()):x}"  # of clip paths: several figures may stand on one page
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {total:g} {tall:g}" width="{total:g}" '
        f'height="{tall:g}" font-family="system-ui, sans-serif" font-size="12" role="img">',
        f"<title>{esc(title)}</title>",
        f'<rect width="{total:g}" height="{tall:g}" fill="#ffffff"/>',
        f'<text x="14" y="24" font-size="15" font-weight="600" fill="#111827">{esc(title)}</text>',
    ]
    for j, row in enumerate(rows):
        for i, panel in enumerate(row):
            place = f"translate({i * width:g} {34 + j * height:g})"
            parts.append(f'<g transform="{place}">{_draw(panel, width, height, f"{name}-{j}-{i}")}</g>')
    return "\n".join([*parts, "</svg>", ""])


def _draw(panel: Panel, width: float, height: float, clip: str) -> str:
    x, y = _ranges(panel)
    left, right, top, bottom = LEFT, width - RIGHT, TOP, height - BOTTOM

    def px(v: ArrayLike) -> Array:
        return left + (right - left) * x(np.asarray(v, dtype=np.float64))

    def py(v: ArrayLike) -> Array:
        v = np.asarray(v, dtype=np.float64)
        if panel.log:
            v = np.log10(np.maximum(v, 1e-300))
        return bottom - (bottom - top) * y(v)

    parts = [
        f'<clipPath id="{clip}"><rect x="{left:g}" y="{top:g}" width="{right - left:g}" '
        f'height="{bottom - top:g}"/></clipPath>',
        f'<text x="{left:g}" y="16" font-weight="600" fill="#111827">{esc(panel.title)}</text>',
        _y_axis(panel, y, left, right, top, bottom),
        _x_axis(panel, x, px, left, right, top, bottom),
    ]
    marks = [_bars(b, px, py, bottom) for b in panel.bars]
    marks += [
        f'<line x1="{left:g}" x2="{right:g}" y1="{py(v):.1f}" y2="{py(v):.1f}" stroke="{GREY}" stroke-dasharray="4 3"/>'
        f'<text x="{right - 4:g}" y="{float(py(v)) - 4:.1f}" text-anchor="end" fill="{GREY}">{esc(name)}</text>'
        for v, name in panel.lines
    ]
    marks += [_curve(c, px, py) for c in panel.curves]
    parts.append(f'<g clip-path="url(#{clip})">{"".join(marks)}</g>')
    parts.append(
        f'<rect x="{left:g}" y="{top:g}" width="{right - left:g}" height="{bottom - top:g}" fill="none" '
        f'stroke="#9ca3af"/>'
    )
    if panel.note:
        parts.append(
            f'<text x="{right - 6:g}" y="{top + 16:g}" text-anchor="end" fill="#374151">{esc(panel.note)}</text>'
        )
    if panel.legend:
        parts.append(_legend(panel, left, top))
    return "".join(parts)


def _ranges(panel: Panel) -> tuple[Scale, Scale]:
    xs = [c.x for c in panel.curves] + [b.edges for b in panel.bars]
    ys = [c.y[np.isfinite(c.y)] for c in panel.curves] + [b.y for b in panel.bars]
    x = panel.x_range or _around(np.concatenate(xs), 0.0 if panel.bars else 0.03)
    if panel.y_range:
        y = panel.y_range
    elif panel.bars:
        y = (0.0, 1.12 * max(float(np.max(v)) for v in ys))
    else:
        y = _around(np.concatenate(ys), 0.08, panel.log)
    if panel.log:
        y = (math.log10(y[0]), math.log10(y[1]))
    return Scale(*x), Scale(*y)


def _around(values: Array, margin: float, log: bool = False) -> tuple[float, float]:
    low, high = float(np.min(values)), float(np.max(values))
    if log:
        low = max(low, 1e-12)
        return low / 1.6, high * 1.6
    pad = margin * (high - low) or 0.5 * abs(high) or 1.0
    return low - pad, high + pad


def _y_axis(panel: Panel, y: Scale, left: float, right: float, top: float, bottom: float) -> str:
    if panel.log:
        ticks = [float(k) for k in range(math.ceil(y.low - 1e-9), math.floor(y.high + 1e-9) + 1)]
        ticks = ticks[:: max(1, math.ceil(len(ticks) / 6))]
        labels = [f"{10.0**k:g}" for k in ticks]
    else:
        ticks = y.ticks(5)
        labels = tick_labels(ticks)
    parts = []
    for value, label in zip(ticks, labels):
        at = bottom - (bottom - top) * float(y(value))
        heavy = panel.zero_line and value == 0
        colour = "#6b7280" if heavy else "#e5e7eb"
        parts.append(f'<line x1="{left:g}" x2="{right:g}" y1="{at:.1f}" y2="{at:.1f}" stroke="{colour}"/>')
        parts.append(f'<text x="{left - 6:g}" y="{at + 4:.1f}" text-anchor="end" fill="#374151">{esc(label)}</text>')
    middle = (top + bottom) / 2
    parts.append(
        f'<text x="14" y="{middle:g}" text-anchor="middle" fill="#374151" transform="rotate(-90 14 {middle:g})">'
        f"{esc(panel.y_label)}</text>"
    )
    return "".join(parts)


def _x_axis(panel: Panel, x: Scale, px: Place, left: float, right: float, top: float, bottom: float) -> str:
    if panel.x_names:
        ticks, labels = [float(i) for i in range(len(panel.x_names))], list(panel.x_names)
    else:
        step = nice_step((x.high - x.low) / 6)
        first, last = math.ceil(x.low / step - 1e-9), math.floor(x.high / step + 1e-9)
        ticks = [k * step for k in range(first, last + 1)]
        labels = tick_labels(ticks)
    parts = []
    for value, label in zip(ticks, labels):
        at = left + (right - left) * float(x(value))
        parts.append(f'<line x1="{at:.1f}" x2="{at:.1f}" y1="{bottom:g}" y2="{bottom + 4:g}" stroke="#9ca3af"/>')
        parts.append(f'<text x="{at:.1f}" y="{bottom + 18:g}" text-anchor="middle" fill="#374151">{esc(label)}</text>')
    parts.append(
        f'<text x="{(left + right) / 2:g}" y="{bottom + 38:g}" text-anchor="middle" fill="#374151">'
        f"{esc(panel.x_label)}</text>"
    )
    return "".join(parts)


def _bars(bars: Bars, px: Place, py: Place, bottom: float) -> str:
    parts = []
    for low, high, value in zip(bars.edges[:-1], bars.edges[1:], bars.y):
        if value <= 0:
            continue
        a, b, t = float(px(low)), float(px(high)), float(py(value))
        parts.append(
            f'<rect x="{a + 0.5:.1f}" y="{t:.1f}" width="{max(b - a - 1, 0.5):.1f}" height="{bottom - t:.1f}" '
            f'fill="{bars.colour}" fill-opacity=".75"/>'
        )
    return "".join(parts)


def _curve(curve: Curve, px: Place, py: Place) -> str:
    good = np.isfinite(curve.y)
    # what leaves the panel is cut by the clip path; far beyond it coordinates would overflow a viewer
    xs, ys = px(curve.x), np.clip(py(np.where(good, curve.y, 0)), -1e4, 1e4)
    parts = []
    if curve.line:
        pieces, pen = [], "M"
        for a, b, ok in zip(xs, ys, good):
            pieces.append(f"{pen}{a:.1f} {b:.1f}" if ok else "")
            pen = "L" if ok else "M"
        dash = f' stroke-dasharray="{curve.dash}"' if curve.dash else ""
        parts.append(f'<path d="{"".join(pieces)}" fill="none" stroke="{curve.colour}" stroke-width="1.8"{dash}/>')
    if curve.error is not None:
        lows, highs = py(curve.y - curve.error), py(curve.y + curve.error)
        parts += [
            f'<line x1="{a:.1f}" x2="{a:.1f}" y1="{lo:.1f}" y2="{hi:.1f}" stroke="{curve.colour}" stroke-width="1.4"/>'
            for a, lo, hi, ok in zip(xs, lows, highs, good)
            if ok
        ]
    if curve.dots:
        parts += [
            f'<circle cx="{a:.1f}" cy="{b:.1f}" r="2.6" fill="{curve.colour}"/>' for a, b, ok in zip(xs, ys, good) if ok
        ]
    return "".join(parts)


def _legend(panel: Panel, left: float, top: float) -> str:
    """Names above the plot, in one line."""
    parts, at = [], left
    seen: set[str] = set()
    for item in (*panel.bars, *panel.curves):
        if not item.label or item.label in seen:
            continue
        seen.add(item.label)
        dash = f' stroke-dasharray="{item.dash}"' if isinstance(item, Curve) and item.dash else ""
        y = top - 14
        if isinstance(item, Curve) and not item.line:
            parts.append(f'<circle cx="{at + 8:g}" cy="{y:g}" r="3" fill="{item.colour}"/>')
        else:
            parts.append(
                f'<line x1="{at:g}" x2="{at + 18:g}" y1="{y:g}" y2="{y:g}" stroke="{item.colour}" '
                f'stroke-width="3"{dash}/>'
            )
        parts.append(f'<text x="{at + 23:g}" y="{y + 4:g}" fill="#374151">{esc(item.label)}</text>')
        at += 34 + 6.6 * len(item.label)
    return "".join(parts)


def histogram(
    title: str,
    x_label: str,
    values: ArrayLike,
    *,
    bins: int,
    upto: float,
    note: str = "",
    colour: str = BLUE,
    compare: tuple[str, ArrayLike, str] | None = None,
    label: str = "",
) -> Panel:
    """Share of `values` (per cent) in `bins` equal steps from 0 to `upto`; what is above counts in the last."""
    edges = np.linspace(0, upto, bins + 1)

    def share(v: ArrayLike) -> Array:
        v = np.minimum(np.asarray(v, dtype=np.float64).ravel(), upto * (1 - 1e-12))
        return 100 * np.histogram(v, edges)[0] / max(v.size, 1)

    bars = (Bars(label, edges, share(values), colour),)
    if np.nanmax(values) > upto:
        x_label += f" (last bar: and above {upto:g})"
    panel = Panel(title, x_label, "share, %", bars=bars, x_range=(0.0, upto), note=note)
    if compare is not None:
        name, other, other_colour = compare
        heights = share(other)
        outline = Curve(name, np.repeat(edges, 2)[1:-1], np.repeat(heights, 2), other_colour)
        top = 1.12 * max(float(heights.max()), float(bars[0].y.max()))
        panel = replace(panel, curves=(outline,), y_range=(0.0, top))
    return panel
