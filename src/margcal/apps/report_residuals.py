"""Bars of what is left over at every rest and turn; a histogram where there are samples instead."""

from __future__ import annotations

import numpy as np

from margcal.apps.report_data import Residuals
from margcal.apps.report_svg import Scale, percent, plot_row, tick_labels
from margcal.apps.report_text import NAMES, esc, number

HEIGHT, TOP, FOOT = 140.0, 10.0, 22.0
MAX_BARS = 240
OUTSTANDING = 3.0
"""A bar is marked as outstanding beyond this many times the rms of all others."""


def residual_figure(found: Residuals) -> str:
    """The picture of one sensor's residuals with its caption."""
    draw = _bars if _as_bars(found) else _histogram
    return f'<figure class="residual"><figcaption>{_caption(found)}</figcaption>{draw(found)}</figure>'


def _as_bars(found: Residuals) -> bool:
    return found.by != "sample" and len(found.value) <= MAX_BARS


def _unit(found: Residuals) -> str:
    return "degrees" if found.unit == "°" else esc(found.unit)


def outstanding(found: Residuals) -> bool:
    """Whether the worst one stands out from the others."""
    others = np.delete(found.value, found.worst)
    return len(others) > 3 and abs(found.value[found.worst]) > OUTSTANDING * float(np.sqrt(np.mean(others**2)))


def _caption(found: Residuals) -> str:
    worst, name = found.value[found.worst], NAMES[found.kind]
    text = f"<strong>{name.capitalize()}</strong>, {_unit(found)}: rms {number(found.rms, 3)}"
    if _as_bars(found):
        text += " (dashed)"
    if found.by in ("rest", "turn"):
        text += f"; largest {number(worst, 3)} at {found.by} {found.labels[found.worst]}"
        text += ", which stands out from the others" if outstanding(found) else ""
    held = [] if found.weight is None else [t for t, w in zip(found.labels, found.weight) if w < 0.5]
    if held:
        text += f"; held down in the fit because it does not agree with the others: {found.by} {', '.join(held)}"
    return f"{text}. {_meaning(found)}"


def _meaning(found: Residuals) -> str:
    if found.kind == "gyr":
        return (
            "Each bar is a turn from one rest to the next: the angle between where the calibrated rates end and "
            "where the node then lay."
        )
    if found.by == "sample":
        return "How far the calibrated readings are off the field's magnitude, over all samples."
    if not found.from_fit:
        return "How far the magnitude of the calibrated mean reading of each rest is off."
    return "What is left of each rest's mean reading after the fit."


def _frame(scale: Scale, n: int) -> tuple[list[str], list[str]]:
    ticks = scale.ticks(n)
    labels, plot = [], []
    for v, text in zip(ticks, tick_labels(ticks)):
        y = _y(scale, v)
        labels.append(f'<text class="tick" x="52" y="{y + 3.5:.1f}" text-anchor="end">{text}</text>')
        plot.append(f'<line class="grid" x1="0" x2="100%" y1="{y:.1f}" y2="{y:.1f}"/>')
    return labels, plot


def _y(scale: Scale, value: float) -> float:
    return TOP + (1 - float(scale(value))) * (HEIGHT - TOP - FOOT)


def _bars(found: Residuals) -> str:
    size = np.abs(found.value)
    n = len(size)
    scale = Scale(0.0, max(float(size.max()), 1e-12) * 1.12)
    labels, plot = _frame(scale, 3)
    base = _y(scale, 0.0)
    last_wide = last_narrow = -1.0
    for i, v in enumerate(size.tolist()):
        x, y = (i + 0.5) / n, _y(scale, v)
        worst = " worst" if i == found.worst else ""
        held = " held" if found.weight is not None and found.weight[i] < 0.5 else ""
        share = min(0.72 / n, 0.03)
        plot.append(
            f'<rect class="bar{worst}{held}" x="{percent(x - share / 2)}" width="{percent(share)}" y="{y:.1f}" '
            f'height="{max(base - y, 0.5):.1f}"><title>{found.by} {found.labels[i]}: {number(v, 3)} '
            f"{esc(found.unit)}</title></rect>"
        )
        room = 0.024 if max(map(len, found.labels)) < 4 else 0.048
        if x - last_wide < room:
            continue
        last_wide = x
        thin = x - last_narrow < 3 * room
        last_narrow = last_narrow if thin else x
        plot.append(
            f'<text class="tick{worst}{" thin" if thin else ""}" x="{percent(x)}" y="{HEIGHT - 6:g}" '
            f'text-anchor="middle">{found.labels[i]}</text>'
        )
    y = _y(scale, found.rms)
    plot.append(f'<line class="rms" x1="0" x2="100%" y1="{y:.1f}" y2="{y:.1f}"/>')
    title = f"Residual of the {NAMES[found.kind]} by {found.by}, in {_unit(found)}"
    return plot_row("".join(labels), "".join(plot), HEIGHT, title)


def _histogram(found: Residuals) -> str:
    low, high = np.percentile(found.value, [0.1, 99.9])
    if not high > low:
        low, high = low - 0.5, high + 0.5
    count, edges = np.histogram(np.clip(found.value, low, high), bins=48, range=(low, high))
    scale = Scale(0.0, float(count.max()) * 1.12)
    labels, plot = _frame(scale, 3)
    across = Scale(float(low), float(high))
    base = _y(scale, 0.0)
    for c, a, b in zip(count.tolist(), across(edges[:-1]).tolist(), across(edges[1:]).tolist()):
        y = _y(scale, c)
        place = f'x="{percent(a)}" width="{percent((b - a) * 0.94)}"'
        plot.append(f'<rect class="bar" {place} y="{y:.1f}" height="{base - y:.1f}"/>')
    ticks = across.ticks(6)
    for v, text in zip(ticks, tick_labels(ticks)):
        x = float(across(v))
        if 0.03 < x < 0.97:
            plot.append(f'<text class="tick" x="{percent(x)}" y="{HEIGHT - 6:g}" text-anchor="middle">{text}</text>')
    title = f"Histogram of the {NAMES[found.kind]} residuals, in {_unit(found)}; samples on the vertical axis"
    return plot_row("".join(labels), "".join(plot), HEIGHT, title)
