"""Curves of an alignment: correlation against the clock offset, residuals and orientation error over time.

Every picture over time has the reference's clock, from its first sample on, and shades what the optics did not see.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from margcal.apps.report_svg import FOOT, Scale, axis_below, panel_frame, percent, plot_row, scale_of, stretched, trace
from margcal.apps.report_text import NAMES, fixed
from margcal.core.types import Array, Calibration
from margcal.core.units import KINDS, UNITS
from margcal.methods.clock import PEAK
from margcal.workflow.align_job import AlignFigures, OrientationErrors

BINS = 700
PANEL, SPACE, CURVE = 84.0, 26.0, 132.0
"""Heights in pixels: a panel over time, room above it for its name, the correlation's panel."""
LANE = 18.0
BEYOND = 3.0
"""A panel's scale ends where the most extreme half per cent of its values is this many times farther out."""
Spans = Sequence[tuple[float, float]]


@dataclass(frozen=True)
class Panel:
    """A panel over time: its name (HTML), times (n,), and curves (n,) by CSS class; `zero` puts 0 on its scale."""

    name: str
    t: Array
    curves: tuple[tuple[str, Array], ...]
    zero: bool = False


def rms(values: Array) -> float:
    """Root mean square of the finite values (of their rows' lengths, where there are rows); NaN without any."""
    squares = np.sum(np.asarray(values, dtype=np.float64).reshape(len(values), -1) ** 2, axis=1)
    squares = squares[np.isfinite(squares)]
    return float(np.sqrt(squares.mean())) if len(squares) else math.nan


def span_of(figures: AlignFigures) -> Scale:
    """The time of the reference."""
    start, stop = (float(figures.t[0]), float(figures.t[-1])) if len(figures.t) else (0.0, 1.0)
    return Scale(start, stop if stop > start else start + 1.0)


# --- correlation ---------------------------------------------------------------------------------------


def correlation_figure(figures: AlignFigures, at: float, common_clock: bool) -> str:
    """The correlation of the angular rates against the offset, with the one that was taken (`at`, s)."""
    good = np.isfinite(figures.lags) & np.isfinite(figures.correlation)
    lags, correlation = figures.lags[good], figures.correlation[good]
    if len(lags) < 3:
        return ""
    across, value = Scale(float(lags[0]), float(lags[-1])), Scale(0.0, 1.04)
    height, top = CURVE + FOOT + SPACE, SPACE
    labels, ground = panel_frame(value, top, CURVE)
    level = top + (1 - float(value(PEAK))) * CURVE
    curve = stretched(f'<path class="after" d="{trace(lags, correlation, across, value, BINS)}"/>', top, CURVE)
    what = "delay of the gyroscope" if common_clock else "clock offset"
    plot = [
        ground,
        axis_below(across, height),
        f'<line class="rms" x1="0" x2="100%" y1="{level:.1f}" y2="{level:.1f}"/>',
        curve,
        _taken(float(across(at)), top, f"{fixed(1e3 * at, 2)} ms"),
        f'<text class="panel-name" x="0" y="{top - 9:g}">Correlation against the {what}</text>',
    ]
    title = f"Correlation of the angular rates against the {what}; highest, {figures.peak:.3f}, at {1e3 * at:.2f} ms"
    caption = (
        '<span class="keys"><span class="key after-key">correlation</span>'
        '<span class="key taken-key">taken</span></span>'
        f"How alike the rates of node and optics are when one is moved against the other: "
        f"<strong>{floored(figures.peak, 4)}</strong> at the peak, of at most 1. A peak below {PEAK:g} (dashed) is "
        f"refused. Of the squared rate, {floored(100 * figures.explained, 2)} % is accounted for."
    )
    return (
        f'<figure class="timeline"><figcaption>{caption}</figcaption>'
        f"{plot_row(labels, ''.join(plot), height, title)}</figure>"
    )


def floored(value: float, decimals: int) -> str:
    """A share with so many decimals, never rounded up to the whole."""
    return fixed(math.floor(value * 10**decimals) / 10**decimals, decimals) if math.isfinite(value) else "–"


def _taken(x: float, top: float, text: str) -> str:
    """An upright line with its value, on the side where there is room."""
    right = x < 0.7
    anchor, shift = ("start", 7) if right else ("end", -7)
    label = f'<text class="tick taken-text" x="{shift}" y="{top + CURVE - 9:g}" text-anchor="{anchor}">{text}</text>'
    line = f'<line class="taken" x1="0" x2="0" y1="{top:g}" y2="{top + CURVE:g}"/>'
    return f'<svg x="{percent(x)}" overflow="visible">{line}{label}</svg>'


# --- over time -----------------------------------------------------------------------------------------


def residual_figure(calibration: Calibration, figures: AlignFigures) -> str:
    """Rates before and after, accelerometer and magnetometer after."""
    panels = _rate_panels(calibration, figures)
    for kind in KINDS:
        if kind != "gyr" and kind in figures.residual and kind in calibration.models:
            factor, unit = residual_unit(calibration, kind)
            y = factor * np.asarray(figures.residual[kind], dtype=np.float64)
            t = np.asarray(figures.residual_t[kind], dtype=np.float64)
            if len(t) == len(y) and np.isfinite(y).any():
                name = f"{NAMES[kind].capitalize()}, what is left, {unit}"
                panels.append(Panel(name, t, (("after", y),), zero=True))
    if not panels:
        return ""
    return stacked(panels, span_of(figures), figures.masked, "Residuals over time")


def residual_unit(calibration: Calibration, kind: str) -> tuple[float, str]:
    """Factor and unit in which a residual of accelerometer or magnetometer is shown."""
    if kind == "acc":
        return 1.0, "m/s²"
    mag = calibration.mag
    return (100.0, "% of the field") if mag is None or mag.unit == "norm" else (1.0, "µT")


def _rate_panels(calibration: Calibration, figures: AlignFigures) -> list[Panel]:
    panels = []
    for name, rate in (("before", figures.rate_before), ("after", figures.rate_after)):
        if not np.isfinite(rate).any():
            continue
        y = np.degrees(rate)
        curves = tuple((f"axis-{a}", y[:, k]) for k, a in enumerate("xyz"))
        panels.append(Panel(f"Gyroscope less optics, {name}, °/s", figures.t, curves))
    return panels


def no_before(calibration: Calibration) -> str:
    """Why there is no curve before the calibration, where the raw unit says nothing (HTML)."""
    raw = [m.raw_unit for k, m in calibration.models.items() if k != "mag" and UNITS[k].get(m.raw_unit) is None]
    if not raw:
        return ""
    return '<p class="note">Before: not drawn, because raw counts say nothing of °/s until they are calibrated.</p>'


def orientation_figure(before: OrientationErrors | None, after: OrientationErrors | None, figures: AlignFigures) -> str:
    """Orientation error over time."""
    panels = []
    for name, errors in (("before", before), ("after", after)):
        if errors is not None and len(errors.t):
            panels.append(Panel(f"Orientation error {name}, °", errors.t, ((name, errors.error),), zero=True))
    return stacked(panels, span_of(figures), figures.masked, "Orientation error over time") if panels else ""


def masked_strip(figures: AlignFigures) -> str:
    """The reference as a bar with what was not seen cut out."""
    time = span_of(figures)
    height = LANE + 8 + FOOT
    bar = f'<rect class="seen" x="0" width="100%" y="4" height="{LANE:g}"/>'
    title = "What of the reference was seen, over time"
    plot = bar + _shading(figures.masked, time, [4.0], LANE, "lost") + axis_below(_since(time), height)
    return f'<figure class="timeline">{plot_row("", plot, height, title)}</figure>'


def stacked(panels: Sequence[Panel], time: Scale, masked: Spans, title: str) -> str:
    """Panels below each other on one time axis, with shaded stretches."""
    height = len(panels) * (PANEL + SPACE) + FOOT
    tops = [SPACE + i * (PANEL + SPACE) for i in range(len(panels))]
    labels, ground, curves = [], [], []
    for top, panel in zip(tops, panels):
        value = _value_scale(panel)
        ticks, frame = panel_frame(value, top, PANEL)
        labels.append(ticks)
        ground.append(frame)
        lines = (f'<path class="{c}" d="{trace(panel.t, y, time, value, BINS)}"/>' for c, y in panel.curves)
        curves.append(stretched("".join(lines), top, PANEL))
        curves.append(f'<text class="panel-name" x="0" y="{top - 7:g}">{panel.name}</text>')
    plot = [*ground, _shading(masked, time, tops, PANEL, "masked"), axis_below(_since(time), height), *curves]
    return plot_row("".join(labels), "".join(plot), height, title)


def _since(time: Scale) -> Scale:
    return Scale(0.0, time.high - time.low)


def _value_scale(panel: Panel) -> Scale:
    """All values, but not a few wild ones that would make a line of the rest."""
    y = np.concatenate([c for _, c in panel.curves])
    y = y[np.isfinite(y)]
    if len(y) > 200:
        low, high = np.percentile(y, [0.5, 99.5])
        reach = max(abs(float(low)), abs(float(high)))
        if float(np.abs(y).max()) > BEYOND * reach:
            y = np.clip(y, -BEYOND * reach, BEYOND * reach)
    return scale_of(np.append(y, 0.0) if panel.zero or not len(y) else y)


def _shading(masked: Spans, time: Scale, tops: Sequence[float], tall: float, name: str) -> str:
    parts = []
    for start, stop in masked:
        a, b = (float(np.clip(time(v), 0.0, 1.0)) for v in (start, stop))
        text = f"{fixed(start - time.low, 2)} to {fixed(stop - time.low, 2)} s: not seen"
        place = f'x="{percent(a)}" width="{percent(max(b - a, 0.001))}"'
        boxes = "".join(f'<rect class="{name}" {place} y="{top:g}" height="{tall:g}"/>' for top in tops)
        parts.append(f"<g><title>{text}</title>{boxes}</g>")
    return "".join(parts)
