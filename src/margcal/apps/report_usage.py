"""How to apply the numbers: formula, code, a worked example to check one's own code by, delays."""

from __future__ import annotations

import numpy as np

from margcal.apps.report_code import c_code, python_code
from margcal.apps.report_data import magnitude
from margcal.apps.report_parameters import delay_text
from margcal.apps.report_summary import FRAMES
from margcal.apps.report_text import NAMES, decimals_for, esc, listing, number, table, unit_words
from margcal.core.types import Array, Calibration, SensorModel


def usage(calibration: Calibration) -> str:
    """The whole section."""
    return "".join(
        [
            _formula(calibration),
            _code("Python", "python-code", python_code(calibration)),
            _code("C", "c-code", c_code(calibration)),
            _example(calibration),
            _delays(calibration),
            '<p>Or let the program do it, for a file or a folder of any length: <code class="command">margcal apply '
            "CALIBRATION.json RECORDING -o OUT</code></p>",
        ]
    )


def _formula(calibration: Calibration) -> str:
    frame = FRAMES.get(calibration.frame, f"the frame “{esc(calibration.frame, 60)}”")
    units = listing(
        f"{NAMES[k]} {unit_words(m.raw_unit)} to {unit_words(m.unit)}" for k, m in calibration.models.items()
    )
    acc = " At rest the accelerometer then reads +g on the axis that points up." if calibration.acc else ""
    return (
        '<p class="formula"><var>u</var> = <var>H</var> (<var>y</var> − <var>B</var>)</p>'
        "<p>Take a reading <var>y</var> (x, y, z, in the raw unit), subtract <var>B</var>, then multiply by the "
        f"matrix <var>H</var>: first subtract, then multiply, with these signs. <var>u</var> is in {frame}; units: "
        f"{units}.{acc}</p>"
    )


def _code(title: str, name: str, text: str) -> str:
    return (
        f'<div class="snippet"><div class="bar"><span>{title}</span>'
        f'<button type="button" class="copy" data-copy="{name}" hidden>Copy</button></div>'
        f'<pre id="{name}" tabindex="0" aria-label="{title} code">{esc_code(text)}</pre></div>'
    )


def esc_code(text: str) -> str:
    """Code keeps its line ends, which `esc` would replace."""
    return "\n".join(esc(line, 5000) for line in text.split("\n"))


def _example(calibration: Calibration) -> str:
    rows = []
    for kind, model in calibration.models.items():
        y = _reading(calibration, model)
        if y is None:
            continue
        u = model.apply(y)
        rows.append(
            [
                NAMES[kind].capitalize(),
                _vector([number(v, 7) for v in y]) + f' <span class="unit">{unit_words(model.raw_unit)}</span>',
                _vector([number(v, 6) for v in u]) + f' <span class="unit">{unit_words(model.unit)}</span>',
                number(float(np.linalg.norm(u)), 6),
            ]
        )
    if not rows:
        return ""
    head = ["Check your code", "<var>y</var>", "<var>u</var>", "|<var>u</var>|"]
    return table(head, rows, "a worked example", "example")


def _vector(values: list[str]) -> str:
    return f'<span class="num">({", ".join(values)})</span>'


def _reading(calibration: Calibration, model: SensorModel) -> Array | None:
    """A round reading to check by, along no axis, so that a transposed H or a wrong sign shows."""
    length = 1.0 if model.kind == "gyr" else magnitude(calibration, model)
    y = model.invert(length * np.array([2.0, -1.0, 2.0]) / 3)
    if not np.isfinite(y).all():
        return None
    places = decimals_for(float(np.linalg.norm(np.linalg.inv(model.H))) * length * 1e-4, 1) or 0
    return np.round(y, places)


def _delays(calibration: Calibration) -> str:
    rows = []
    for kind, model in calibration.models.items():
        text = delay_text(model)
        if text:
            late = "after" if (model.delay_s or 0) > 0 else "before"
            rows.append(f"the {NAMES[kind]}'s are stamped {text.lstrip('−-')} {late} they were sensed")
    if not rows:
        return ""
    return (
        f"<p><strong>Delays.</strong> Of the readings, {listing(rows)}. Where that matters, interpolate the calibrated "
        "readings at <var>t</var> + delay to have what was sensed at <var>t</var>; <code>margcal apply</code> does."
        "</p>"
    )
