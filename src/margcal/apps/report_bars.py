"""A row of bars, one for each rest or turn, with a level across; what was left out keeps its place without a bar."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from margcal.apps.report_svg import Scale, percent, plot_row, tick_labels
from margcal.apps.report_text import number
from margcal.core.types import Array

Mask = NDArray[np.bool_]
HEIGHT, TOP, FOOT = 140.0, 10.0, 22.0
LABEL_ROOM = 0.024
"""Least step between two labels of up to three characters, as a share of the width."""


@dataclass(frozen=True)
class Bars:
    """What to draw.

    Attributes
    ----------
    value : ndarray (n,), not negative
    labels : tuple of str
        Of rest or turn: ``7``, ``7–8``.
    titles : tuple of str
        Said when the pointer is on a bar (HTML, escaped).
    worst : int or None
        The one to point out.
    level : float or None
        A dashed line across.
    held : ndarray (n,) of bool
        Drawn hollow: counted less or not at all.
    out : ndarray (n,) of bool
        Left out: a cross instead of a bar, whatever its value.
    """

    value: Array
    labels: Sequence[str]
    titles: Sequence[str]
    worst: int | None
    level: float | None
    held: Mask
    out: Mask


def bar_row(bars: Bars, title: str) -> str:
    """The picture; `title` (HTML, escaped) says what it shows."""
    shown = bars.value[~bars.out]
    top = max(float(shown.max(initial=0.0)), bars.level or 0.0, 1e-12)
    scale = Scale(0.0, top * 1.12)
    labels, plot = frame(scale, 3)
    plot += [_bar(bars, i, scale) for i in range(len(bars.value))]
    plot += _numbers(bars)
    if bars.level is not None:
        y = height_of(scale, bars.level)
        plot.append(f'<line class="rms" x1="0" x2="100%" y1="{y:.1f}" y2="{y:.1f}"/>')
    return plot_row("".join(labels), "".join(plot), HEIGHT, title)


def frame(scale: Scale, n: int) -> tuple[list[str], list[str]]:
    """Labels of the vertical scale and lines across."""
    ticks = scale.ticks(n)
    labels, plot = [], []
    for v, text in zip(ticks, tick_labels(ticks)):
        y = height_of(scale, v)
        labels.append(f'<text class="tick" x="52" y="{y + 3.5:.1f}" text-anchor="end">{text}</text>')
        plot.append(f'<line class="grid" x1="0" x2="100%" y1="{y:.1f}" y2="{y:.1f}"/>')
    return labels, plot


def height_of(scale: Scale, value: float) -> float:
    return TOP + (1 - float(scale(value))) * (HEIGHT - TOP - FOOT)


def _bar(bars: Bars, i: int, scale: Scale) -> str:
    n, base = len(bars.value), height_of(scale, 0.0)
    x = (i + 0.5) / n
    title = f"<title>{bars.titles[i]}</title>"
    if bars.out[i]:
        cross = '<path class="left-out" d="M-4-4L4 4M-4 4L4-4"/>'
        return f'<svg x="{percent(x)}" y="{base - 9:.1f}" overflow="visible">{title}{cross}</svg>'
    y = height_of(scale, float(bars.value[i]))
    name = f"bar{' worst' if i == bars.worst else ''}{' held' if bars.held[i] else ''}"
    share = min(0.72 / n, 0.03)
    return (
        f'<rect class="{name}" x="{percent(x - share / 2)}" width="{percent(share)}" y="{y:.1f}" '
        f'height="{max(base - y, 0.5):.1f}">{title}</rect>'
    )


def _numbers(bars: Bars) -> list[str]:
    """Labels below the bars, as many as there is room for, fewer of them on a narrow screen."""
    room = LABEL_ROOM if max(map(len, bars.labels), default=0) < 4 else 2 * LABEL_ROOM
    out, last_wide, last_narrow = [], -1.0, -1.0
    for i, text in enumerate(bars.labels):
        x = (i + 0.5) / len(bars.labels)
        if x - last_wide < room:
            continue
        last_wide = x
        thin = x - last_narrow < 3 * room
        last_narrow = last_narrow if thin else x
        name = f"tick{' worst' if i == bars.worst or bars.out[i] else ''}{' thin' if thin else ''}"
        out.append(f'<text class="{name}" x="{percent(x)}" y="{HEIGHT - 6:g}" text-anchor="middle">{text}</text>')
    return out


def bar_title(by: str, label: str, value: float, unit: str, note: str = "") -> str:
    """``rest 7: 3.21 mm/s²``, ``rest 6: left out`` (`unit` escaped)."""
    told = [] if not np.isfinite(value) else [f"{number(value, 3)} {unit}"]
    return f"{by} {label}: {', '.join([*told, *([note] if note else [])])}"
