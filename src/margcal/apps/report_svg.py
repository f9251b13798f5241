"""Small SVG kit of the report: scales, ticks and paths that stay sharp when the page is narrow.

A plot is a row of two pictures: the labels of its scale, of fixed width, and the plot itself, which takes the
width that is left. Horizontal places are per cent of that width, so text keeps its size on a phone; curves lie in
a nested picture of `WIDE` x `TALL` units that is stretched while its strokes are not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from margcal.apps.report_text import fixed, number
from margcal.core.types import Array

WIDE, TALL = 2000, 1000
"""Units of a stretched picture: integers of this size are below half a pixel."""
FOOT = 24.0
"""Height in pixels of the axis below a picture."""


@dataclass(frozen=True)
class Scale:
    """A linear scale from `low` to `high` onto 0..1."""

    low: float
    high: float

    def __call__(self, value: Array | float) -> Array:
        with np.errstate(over="ignore", invalid="ignore"):
            return (np.asarray(value, dtype=np.float64) - self.low) / (self.high - self.low)

    def ticks(self, n: int = 4) -> list[float]:
        """About `n` round values within the scale, and at least three."""
        span = self.high - self.low
        if not (math.isfinite(span) and span > 0):
            return []
        step = nice_step(span / n)
        if math.floor(self.high / step) - math.ceil(self.low / step) < 2:
            step = nice_step(span / n / 2)
        first = math.ceil(self.low / step - 1e-9)
        last = math.floor(self.high / step + 1e-9)
        return [k * step for k in range(first, min(last, first + 50) + 1)]


def nice_step(step: float) -> float:
    """The round number (1, 2, 5 times a power of ten) at or above `step`."""
    power = 10.0 ** math.floor(math.log10(step))
    return next(m * power for m in (1, 2, 5, 10) if m * power >= step * (1 - 1e-9))


def scale_of(values: Array, margin: float = 0.06) -> Scale:
    """The scale that shows all finite `values` with a margin."""
    values = values[np.isfinite(values)]
    low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 1.0)
    pad = margin * (high - low)
    if not math.isfinite(pad) or pad <= 1e-12 * max(abs(low), abs(high), 1e-300):
        pad = max(abs(low) * 0.01, 1e-12)
    return Scale(low - pad, high + pad)


def tick_label(value: float, step: float) -> str:
    """A tick's value with the decimals that its step needs."""
    if abs(value) >= 1e6 or (value and step < 1e-5):
        return number(value, 3)
    return fixed(value, max(0, -math.floor(math.log10(step) + 1e-9)) if step > 0 else 0)


def tick_labels(ticks: list[float]) -> list[str]:
    step = ticks[1] - ticks[0] if len(ticks) > 1 else max(abs(ticks[0]), 1.0) if ticks else 1.0
    return [tick_label(v, step) for v in ticks]


def percent(fraction: float) -> str:
    return f"{100 * fraction:.3f}".rstrip("0").rstrip(".") + "%"


def envelope(t: Array, y: Array, time: Scale, bins: int) -> tuple[Array, Array, Array]:
    """Lowest and highest reading of every bin of time, NaN where there is none.

    Parameters
    ----------
    t : ndarray (N,), increasing
    y : ndarray (N,)
    time : Scale
        Spans the bins.
    bins : int

    Returns
    -------
    x : ndarray (bins,)
        Centres of the bins, 0..1.
    low, high : ndarray (bins,)
    """
    edges = np.searchsorted(t, time.low + np.arange(bins + 1) * (time.high - time.low) / bins)
    filled = edges[1:] > edges[:-1]
    low, high = np.full((2, bins), np.nan)
    if filled.any():
        first = edges[:-1][filled]
        end = edges[-1]
        low[filled] = np.fmin.reduceat(y[:end], first)
        high[filled] = np.fmax.reduceat(y[:end], first)
    return (np.arange(bins) + 0.5) / bins, low, high


def trace(t: Array, y: Array, time: Scale, value: Scale, bins: int) -> str:
    """The ``d`` of a curve, decimated to an envelope where there are more samples than `bins` can show."""
    y = np.where(np.isfinite(y), y, np.nan)
    if len(t) <= 2 * bins:
        x, v = time(t), value(y)
    else:
        x, low, high = envelope(t, y, time, bins)
        # up and down in turn, so that the curve runs from bin to bin by short steps
        odd = np.arange(bins) % 2 == 1
        v = value(np.column_stack([np.where(odd, high, low), np.where(odd, low, high)]).ravel())
        x = np.repeat(x, 2)
    return path(x, 1 - v, gaps=_gaps(t, x, time, bins))


def _gaps(t: Array, x: Array, time: Scale, bins: int) -> float:
    """Step along the plot beyond which the curve is broken: five sampling periods and more than a few bins."""
    period = (t[-1] - t[0]) / max(len(t) - 1, 1) / (time.high - time.low) if len(t) else 0.0
    return max(5 * period, 3.0 / bins)


def path(x: Array, y: Array, gaps: float = math.inf) -> str:
    """The ``d`` of a polyline through (x, y), 0..1 from the top left, broken at NaN and at long steps."""
    good = np.isfinite(x) & np.isfinite(y)
    x, y = x[good], y[good]
    if not len(x):
        return ""
    px = np.rint(np.clip(x, -1, 2) * WIDE).astype(np.int64)
    py = np.rint(np.clip(y, -1, 2) * TALL).astype(np.int64)
    cut = np.flatnonzero(np.diff(x) > gaps) + 1
    parts = []
    for xs, ys in zip(np.split(px, cut), np.split(py, cut)):
        steps = np.column_stack([np.diff(xs), np.diff(ys)])
        moved = steps.any(axis=1)
        pairs = " ".join(f"{a} {b}" for a, b in steps[moved].tolist())
        parts.append(f"M{xs[0]} {ys[0]}" + (f"l{pairs}" if pairs else "h1"))
    return "".join(parts)


def stretched(content: str, y: float, height: float) -> str:
    """`content`, drawn in `WIDE` x `TALL` units, over the whole width."""
    return (
        f'<svg x="0" y="{y:g}" width="100%" height="{height:g}" viewBox="0 0 {WIDE} {TALL}" '
        f'preserveAspectRatio="none" overflow="hidden">{content}</svg>'
    )


def plot_row(labels: str, plot: str, height: float, title: str) -> str:
    """Scale labels and plot side by side."""
    return (
        '<div class="plot">'
        f'<svg class="ylabels" height="{height:g}" width="58" aria-hidden="true">{labels}</svg>'
        f'<svg class="area" height="{height:g}" width="100%" role="img" aria-label="{title}">{plot}</svg></div>'
    )


def panel_frame(value: Scale, top: float, tall: float) -> tuple[str, str]:
    """Scale labels and ground of a panel that is `tall` pixels high and lies `top` pixels down."""
    ticks = value.ticks(4)
    labels, ground = [], [f'<rect class="frame" x="0" y="{top:g}" width="100%" height="{tall:g}"/>']
    for v, text in zip(ticks, tick_labels(ticks)):
        y = top + (1 - float(value(v))) * tall
        labels.append(f'<text class="tick" x="52" y="{y + 3.5:.1f}" text-anchor="end">{text}</text>')
        ground.append(f'<line class="grid" x1="0" x2="100%" y1="{y:.1f}" y2="{y:.1f}"/>')
    return "".join(labels), "".join(ground)


def axis_below(across: Scale, height: float, unit: str = "s") -> str:
    """Ticks and numbers along the foot of a picture of this height; the first one says the unit."""
    ticks = across.ticks(8)
    parts = []
    for i, (v, text) in enumerate(zip(ticks, tick_labels(ticks))):
        x = float(across(v))
        anchor = "start" if x < 0.02 else "end" if x > 0.98 else "middle"
        thin = " thin" if i % 2 else ""
        parts.append(
            f'<line class="mark" x1="{percent(x)}" x2="{percent(x)}" y1="{height - FOOT:g}" y2="{height - 20:g}"/>'
        )
        parts.append(
            f'<text class="tick{thin}" x="{percent(x)}" y="{height - 6:g}" text-anchor="{anchor}">'
            f"{text}{f' {unit}' if i == 0 else ''}</text>"
        )
    return "".join(parts)
