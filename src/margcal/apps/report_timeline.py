"""Pictures of what was recorded: every sensor over time, rests shaded and numbered, knocks marked."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from margcal.apps.report_svg import (
    FOOT,
    TALL,
    WIDE,
    Scale,
    axis_below,
    panel_frame,
    percent,
    plot_row,
    scale_of,
    stretched,
    trace,
)
from margcal.apps.report_text import NAMES, esc, fixed, listing, plural, unit_words
from margcal.core import so3
from margcal.core.types import Array, Calibration, Kind, Poses, Recording, Stream

BINS = 900
MAX_RECORDINGS = 8
MAX_RESTS = 200
"""More rests than this in a recording are shaded without numbers."""
LANE, PANEL, SPACE = 30.0, 104.0, 26.0
"""Heights in pixels: lane of the rests, panel of a sensor, room above it for its name."""


def timelines(calibration: Calibration) -> str:
    """A picture for each recording."""
    shown = [(i, r) for i, r in enumerate(calibration.recordings) if any(len(s.t) for s in r.streams.values())]
    bins = int(BINS / max(1, len(shown[:MAX_RECORDINGS])) ** 0.5)
    parts = [_timeline(calibration, recording, index, bins) for index, recording in shown[:MAX_RECORDINGS]]
    if len(shown) > MAX_RECORDINGS:
        parts.append(f'<p class="note">{plural(len(shown) - MAX_RECORDINGS, "further recording")} not drawn.</p>')
    return "".join(parts)


Index = NDArray[np.intp]


def _span(recording: Recording) -> Scale:
    ends = [(s.t[0], s.t[-1]) for s in recording.streams.values() if len(s.t)]
    start, stop = float(min(a for a, _ in ends)), float(max(b for _, b in ends))
    return Scale(start, stop if stop > start else start + 1.0)


def _timeline(calibration: Calibration, recording: Recording, index: int, bins: int) -> str:
    time = _span(recording)
    streams: dict[Kind, Stream] = {k: s for k, s in recording.streams.items() if len(s.t)}
    mine = _rests_of(calibration.poses, index)
    lane = LANE if len(mine) else 0.0
    height = lane + len(streams) * (PANEL + SPACE) + FOOT
    tops = [lane + SPACE + row * (PANEL + SPACE) for row in range(len(streams))]
    labels, frames, curves = [], [], []
    for top, (kind, stream) in zip(tops, streams.items()):
        value = scale_of(stream.y)
        ticks, frame = panel_frame(value, top, PANEL)
        labels.append(ticks)
        frames.append(frame)
        curves.append(_curves(stream, time, value, top, bins))
        name = f"{NAMES[kind].capitalize()}, {unit_words(stream.unit)}"
        curves.append(f'<text class="panel-name" x="0" y="{top - 7:g}">{name}</text>')
    plot = [
        *frames,
        axis_below(Scale(0.0, time.high - time.low), height),
        _rests(calibration, mine, time, tops),
        *curves,
    ]
    title = f"Readings of {esc(recording.source)} over time with {plural(len(mine), 'rest')}"
    return (
        f'<figure class="timeline">{plot_row("".join(labels), "".join(plot), height, title)}'
        f"<figcaption>{_caption(calibration, recording, mine)}</figcaption></figure>"
    )


def _rests_of(poses: Poses | None, index: int) -> Index:
    """Indices of the rests that lie in recording `index`."""
    if poses is None:
        return np.zeros(0, dtype=np.intp)
    return np.flatnonzero(np.asarray(poses.recording, dtype=np.int64) == index)


def _rests(calibration: Calibration, mine: Index, time: Scale, tops: list[float]) -> str:
    poses = calibration.poses
    if poses is None:
        return ""
    if len(mine) > MAX_RESTS:
        return _shading(time(poses.start[mine]), time(poses.stop[mine]), tops)
    parts, last = [], {"wide": -1.0, "narrow": -1.0}
    for i in mine.tolist():
        start, stop = float(poses.start[i]), float(poses.stop[i])
        a, b = float(time(start)), float(time(stop))
        knocked = int(poses.knocks[i])
        title = f"rest {i + 1}: {fixed(start - time.low, 1)} to {fixed(stop - time.low, 1)} s"
        title += f", a knock cut out ({plural(knocked, 'sample')})" if knocked else ""
        place = f'x="{percent(a)}" width="{percent(b - a)}"'
        shades = "".join(f'<rect class="rest" {place} y="{top:g}" height="{PANEL:g}"/>' for top in tops)
        bar = f'<rect class="rest-bar" {place} y="{LANE - 8:g}" height="4"/>'
        parts.append(f"<g><title>{title}</title>{shades}{bar}</g>")
        middle = (a + b) / 2
        if knocked:
            parts.append(_knock(middle))
        parts.append(_rest_number(i + 1, middle, last))
    parts += [_turn(poses, t.before, t.after, time) for t in calibration.turns if t.before in mine]
    return "".join(parts)


def _shading(start: Array, stop: Array, tops: list[float]) -> str:
    """Rests without numbers, where they are too many for them."""
    spans = np.rint(WIDE * np.column_stack([start, np.maximum(stop - start, 0)])).astype(np.int64).tolist()
    path = "".join(f"M{a} 0h{w}v{TALL}h-{w}z" for a, w in spans[: 20 * MAX_RESTS])
    return "".join(stretched(f'<path class="rest" d="{path}"/>', top, PANEL) for top in tops)


def _knock(x: float) -> str:
    return (
        f'<svg x="{percent(x)}" y="{LANE - 6:g}" overflow="visible"><path class="knock" d="M0-5L5 0 0 5-5 0z"/></svg>'
    )


def _rest_number(n: int, x: float, last: dict[str, float]) -> str:
    """The number above a rest; left out where its neighbour is too near, more of them on a narrow screen."""
    if x - last["wide"] < 0.021:
        return ""
    last["wide"] = x
    narrow = x - last["narrow"] >= 0.06
    if narrow:
        last["narrow"] = x
    return f'<text class="rest-no{"" if narrow else " thin"}" x="{percent(x)}" y="14">{n}</text>'


def _turn(poses: Poses, before: int, after: int, time: Scale) -> str:
    a, b = float(time(poses.stop[before])), float(time(poses.start[after]))
    title = f"turn from rest {before + 1} to rest {after + 1}"
    if poses.R is not None and np.isfinite(poses.R[[before, after]]).all():
        title += f": {fixed(float(np.degrees(so3.angle_between(poses.R[before], poses.R[after]))), 0)}° apart"
    y = f"{LANE - 6:g}"
    return f'<line class="turn" x1="{percent(a)}" x2="{percent(b)}" y1="{y}" y2="{y}"><title>{title}</title></line>'


def _curves(stream: Stream, time: Scale, value: Scale, top: float, bins: int) -> str:
    lines = "".join(
        f'<path class="axis-{name}" d="{trace(stream.t, stream.y[:, k], time, value, bins)}"/>'
        for k, name in enumerate("xyz")
    )
    return stretched(lines, top, PANEL)


def _caption(calibration: Calibration, recording: Recording, mine: Index) -> str:
    knocks = calibration.poses is not None and any(calibration.poses.knocks[i] for i in mine.tolist())
    keys = "".join(f'<span class="key axis-{a}">{a}</span>' for a in "xyz")
    keys += '<span class="key rest-key">rest</span>' if len(mine) else ""
    keys += '<span class="key knock-key">knock, cut out</span>' if knocks else ""
    return f'<span class="keys">{keys}</span><strong>{esc(recording.source)}</strong>: {_rates(recording)}.'


def _rates(recording: Recording) -> str:
    """``accelerometer and gyroscope 15451 samples at 100.0 Hz, magnetometer ...``"""
    groups: dict[str, list[str]] = {}
    for kind, s in recording.streams.items():
        if len(s.t) > 1:
            text = f"{plural(len(s.t), 'sample')} at {fixed(s.rate, 1 if s.rate < 1000 else 0)} Hz"
            groups.setdefault(text, []).append(NAMES[kind])
    return "; ".join(f"{listing(names)} {text}" for text, names in groups.items())
