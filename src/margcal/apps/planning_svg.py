"""A plan as one SVG picture: the box in every attitude, in order, with the turn that leads there."""

from __future__ import annotations

import math

import numpy as np

from margcal.apps.planning import shown
from margcal.apps.report_attitudes import SIZE
from margcal.apps.report_attitudes import _box as box
from margcal.apps.report_text import esc
from margcal.workflow.plan import Plan, Step
from margcal.workflow.plan_words import side, turn_words

WIDE, TALL, COLUMNS = 168, 168, 6
"""Cell of one attitude, pixels, and cells in a row."""
MARGIN, HEAD = 16, 62

STYLE = """
svg{background:#fff;color:#1d2329;font:12px system-ui,-apple-system,'Segoe UI',sans-serif}
text{fill:#1d2329}.title{font-size:17px;font-weight:600}.small{fill:#59636b;font-size:11px}.number{font-weight:700}
.shadow{fill:#00000018}.face{stroke:#5a646c;stroke-width:.8;stroke-linejoin:round}
.shade-1{fill:#b9c0c5}.shade-2{fill:#cbd1d5}.shade-3{fill:#dde1e4}.shade-4{fill:#eef0f1}
.letters{font-size:10px;font-weight:700;text-anchor:middle}.axis-x{fill:#b3261e}.axis-y{fill:#1f6f3a}.axis-z{fill:#1a4f9c}
.up{fill:none;stroke:#1d2329;stroke-width:1.6;stroke-linecap:round;stroke-linejoin:round}
.cell{fill:none;stroke:#e1e5e8}
@media(prefers-color-scheme:dark){svg{background:#14181c}text{fill:#e6eaed}.small{fill:#9aa4ab}.up{stroke:#e6eaed}
.cell{stroke:#2b3238}.shadow{fill:#00000060}.letters.axis-x{fill:#b3261e}.letters.axis-y{fill:#1f6f3a}.letters.axis-z{fill:#1a4f9c}}
"""


def drawing(plan: Plan) -> str:
    """The whole picture."""
    columns = min(COLUMNS, max(len(plan.steps), 4))
    rows = math.ceil(len(plan.steps) / columns)
    width, height = 2 * MARGIN + columns * WIDE, HEAD + rows * TALL + MARGIN
    cells = "".join(_cell(plan, i, step, columns) for i, step in enumerate(plan.steps))
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" viewBox="0 0 {width} {height}" '
        f'role="img" aria-label="{esc(_title(plan))}"><style>{STYLE}</style>'
        f'<text class="title" x="{MARGIN}" y="28">{esc(_title(plan))}</text>'
        f'<text class="small" x="{MARGIN}" y="47">{esc(_subtitle(plan))}</text>{cells}</svg>\n'
    )


def _title(plan: Plan) -> str:
    if plan.before_deg:
        return f"The next {len(plan.steps)} attitudes"
    return f"{len(plan.steps)} attitudes to record"


def _subtitle(plan: Plan) -> str:
    parts = []
    for kind, after in plan.after_deg.items():
        before = plan.before_deg.get(kind)
        parts.append(f"{kind} {after:.2g}°" if before is None else f"{kind} {min(before, 99):.2g}° → {after:.2g}°")
    return f"Expected direction error: {', '.join(parts)}. The arrow points up; turns are about the node's own axes."


def _cell(plan: Plan, i: int, step: Step, columns: int) -> str:
    x, y = MARGIN + (i % columns) * WIDE, HEAD + (i // columns) * TALL
    R = shown(plan, step.R)
    seen = np.diag([-1.0, -1.0, 1.0]) @ R  # from the side that "front" faces
    caption = f"{side(R[2])} up" + (f", {side(R[1])} front" if plan.hands == "box" else "")
    turn = _lines("start here" if step.turn is None else turn_words(step.turn))
    lines = "".join(
        f'<text class="small" x="8" y="{TALL - 22 + 13 * k}">{esc(text)}</text>' for k, text in enumerate(turn)
    )
    return (
        f'<g transform="translate({x} {y})"><rect class="cell" x="1" y="1" width="{WIDE - 6}" height="{TALL - 6}" '
        f'rx="6"/><text class="number" x="8" y="19">{i + 1}</text><text x="28" y="19">{esc(caption)}</text>'
        f'<svg x="28" y="22" width="106" height="106" viewBox="0 0 {SIZE:g} {SIZE:g}">{box(seen)}</svg>{lines}</g>'
    )


def _lines(text: str) -> list[str]:
    """A turn in one line, or two where it is long."""
    for word in (", then ", " about ("):
        first, found, last = text.partition(word)
        if found:
            return [
                first + word[: word.index(" ") + 1].rstrip(),
                word.strip(", ") + ("" if word[-1] == "(" else " ") + last,
            ]
    return ["", text]
