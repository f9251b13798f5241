"""Bars of what is left over at every rest and turn; a histogram where there are samples instead."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from margcal.apps.report_bars import HEIGHT, Bars, bar_row, bar_title, frame, height_of
from margcal.apps.report_data import Residuals
from margcal.apps.report_svg import Scale, percent, plot_row, tick_labels
from margcal.apps.report_text import NAMES, esc, listing, number

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
    return len(found.used) > 4 and _times_the_others(found) > OUTSTANDING


def _times_the_others(found: Residuals) -> float:
    """The worst residual in units of the rms of all others."""
    others = np.delete(found.value, found.worst)[~np.delete(found.out, found.worst)]
    rms = float(np.sqrt(np.mean(others**2))) if len(others) else 0.0
    return abs(float(found.value[found.worst])) / rms if rms > 0 else 1.0


def worst_pose(all_found: list[Residuals], labels: Collection[int] = ()) -> str:
    """The rest that fits worst, named, in a sentence or two (HTML); nothing where there are no rests.

    `labels`: numbers of the rests whose attitude, as told or taken, was left out.
    """
    at_rest = [f for f in all_found if f.by == "rest"]
    gone: dict[int, list[str]] = {n: ["attitude"] for n in labels}
    for found in at_rest:
        for label, out in zip(found.labels, found.out):
            if out:
                gone.setdefault(int(label), []).append(NAMES[found.kind])
    text = ""
    if gone:
        told = listing(f"rest {n} (its {listing(gone[n])})" for n in sorted(gone))
        text = f"<p><strong>Left out:</strong> {told}, because the other rests contradict it.</p>"
    candidates = [f for f in at_rest if len(f.used) > 1]
    if not candidates:
        return text
    found = max(candidates, key=_times_the_others)
    stands = "stands out from the others" if outstanding(found) else "does not stand out"
    among = " of those that were used" if gone else ""
    return text + (
        f"<p><strong>Worst rest{among}: {found.labels[found.worst]}.</strong> Its {NAMES[found.kind]} is off by "
        f"{number(abs(found.value[found.worst]), 3)} {esc(found.unit)}, {number(_times_the_others(found), 2)} times "
        f"the rms of the other rests; it {stands}.</p>"
    )


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
    gone = [t for t, out in zip(found.labels, found.out) if out]
    if gone:
        text += f"; left out of the fit (crosses): {found.by} {', '.join(gone)}"
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


def _bars(found: Residuals) -> str:
    held = np.zeros(len(found.value), dtype=bool) if found.weight is None else found.weight < 0.5
    value = np.where(np.isfinite(found.value), np.abs(found.value), 0.0)
    notes = ["left out of the fit" if out else "" for out in found.out]
    titles = [
        bar_title(found.by, label, abs(v), esc(found.unit), note)
        for label, v, note in zip(found.labels, found.value.tolist(), notes)
    ]
    title = f"Residual of the {NAMES[found.kind]} by {found.by}, in {_unit(found)}"
    return bar_row(Bars(value, found.labels, titles, found.worst, found.rms, held, found.out), title)


def _histogram(found: Residuals) -> str:
    values = found.used
    low, high = np.percentile(values, [0.1, 99.9])
    if not high > low:
        low, high = low - 0.5, high + 0.5
    count, edges = np.histogram(np.clip(values, low, high), bins=48, range=(low, high))
    scale = Scale(0.0, float(count.max()) * 1.12)
    labels, plot = frame(scale, 3)
    across = Scale(float(low), float(high))
    base = height_of(scale, 0.0)
    for c, a, b in zip(count.tolist(), across(edges[:-1]).tolist(), across(edges[1:]).tolist()):
        y = height_of(scale, c)
        place = f'x="{percent(a)}" width="{percent((b - a) * 0.94)}"'
        plot.append(f'<rect class="bar" {place} y="{y:.1f}" height="{base - y:.1f}"/>')
    ticks = across.ticks(6)
    for v, text in zip(ticks, tick_labels(ticks)):
        x = float(across(v))
        if 0.03 < x < 0.97:
            plot.append(f'<text class="tick" x="{percent(x)}" y="{HEIGHT - 6:g}" text-anchor="middle">{text}</text>')
    title = f"Histogram of the {NAMES[found.kind]} residuals, in {_unit(found)}; samples on the vertical axis"
    return plot_row("".join(labels), "".join(plot), HEIGHT, title)
