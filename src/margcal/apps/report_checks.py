"""The checks behind the verdict: a row a check, a column a sensor, each figure beside its limit."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from margcal.apps.report_text import NAMES, esc, number
from margcal.core.types import Calibration
from margcal.core.units import KINDS

MAX_CHECKS = 200
WORDS = {
    "expected-error": ("Expected direction error", "From the covariance, rms over the sphere. This one decides.", "°"),
    "no-uncertainty": ("Expected direction error", "The method gives none.", "°"),
    "residual": ("Residual", "What the fit leaves of the readings, of the magnitude.", "%"),
    "turn-residual": ("Turns", "How far turns end from where the rests lie, rms.", "°"),
    "condition": ("Gains of the axes", "Largest over smallest; a healthy triad has about one.", ""),
    "gain": ("Gain and unit", "How far the gains are from what the raw unit says.", "%"),
    "methods-agree": ("Two methods", "How far closed form and maximum likelihood are apart.", "°"),
    "field-strength": ("Field strength", "By the nominal gain; the earth's is 20 to 70 µT.", "µT"),
    "dip": ("Dip of the field", "Off the World Magnetic Model.", "°"),
    "rests-remaining": ("Rests that remain", "After those that contradict the others were left out.", ""),
    "synchronisation": ("Correlation of the rates", "Of node and optics, at the offset taken.", ""),
    "clock-drift": ("Clock drift", "Of the node's clock against the optics'.", "ppm"),
    "common-clock": ("Common clock", "Delay of the gyroscope behind the optics.", "s"),
    "overlap": ("Overlap", "What node and optics have in common, of the shorter one.", "%"),
    "reference-seen": ("Body seen", "Share of the optics' samples that were used.", "%"),
    "axes": ("Axes", "How far they are turned from the gyroscope's.", "°"),
    "mirrored-axes": ("Mirrored axes", "How far they are turned from the gyroscope's.", "°"),
    "housing-error": ("Housing", "How far it lay from the attitudes taken, rms about each axis.", "°"),
}
"""Name, meaning and unit by code."""
AT_LEAST = {"rests-remaining", "synchronisation", "overlap", "reference-seen"}
"""Codes whose limit is the least that passes."""
LEVELS = {"pass": "passed", "warn": "warning", "fail": "failed"}


@dataclass(frozen=True)
class Row:
    """A check as a calibration tells it; `sensor` is '' for one of the whole node."""

    code: str
    sensor: str
    value: float
    limit: float
    level: str
    text: str


def checks_of(calibration: Calibration) -> list[Row]:
    """The checks among the settings; whatever else stands there (the file is anybody's) is passed over."""
    found = calibration.settings.get("checks")
    rows = []
    for one in found[:MAX_CHECKS] if isinstance(found, (list, tuple)) else ():
        if isinstance(one, Mapping) and one.get("level") in LEVELS and isinstance(one.get("code"), str):
            sensor = one.get("sensor")
            rows.append(
                Row(
                    one["code"],
                    sensor if isinstance(sensor, str) and sensor in KINDS else "",
                    _number(one.get("value")),
                    _number(one.get("limit")),
                    one["level"],
                    str(one.get("text") or ""),
                )
            )
    return rows


def _number(value: object) -> float:
    good = isinstance(value, (int, float)) and not isinstance(value, bool)
    return float(value) if good else math.nan  # type: ignore[arg-type]


def checks_table(rows: list[Row]) -> str:
    """The table and how many passed."""
    columns = [k for k in (*KINDS, "") if any(r.sensor == k for r in rows)]
    codes = list(dict.fromkeys(r.code for r in rows))
    head = "".join(f'<th scope="col">{NAMES[k].capitalize() if k else "Node"}</th>' for k in columns)  # type: ignore[index]
    body = "".join(_line(code, columns, [r for r in rows if r.code == code]) for code in codes)
    passed = sum(r.level == "pass" for r in rows)
    said = "All of them passed." if passed == len(rows) else f"{passed} of {len(rows)} passed."
    return (
        f'<p>{said}</p><div class="scroll" tabindex="0" role="region" aria-label="checks"><table class="checks">'
        f'<thead><tr><th scope="col">Check</th>{head}</tr></thead><tbody>{body}</tbody></table></div>'
    )


def _line(code: str, columns: list[str], rows: list[Row]) -> str:
    name, meaning, unit = WORDS.get(code, (esc(code, 60), "", ""))
    cells = "".join(f"<td>{''.join(_cell(r, unit) for r in rows if r.sensor == k)}</td>" for k in columns)
    about = f'<span class="meaning">{meaning}</span>' if meaning else ""
    return f'<tr><th scope="row">{name}{about}</th>{cells}</tr>'


def _cell(row: Row, unit: str) -> str:
    limit = ""
    if math.isfinite(row.limit):
        above = row.value > row.limit
        least = row.code in AT_LEAST or (math.isfinite(row.value) and above == (row.level == "pass"))
        limit = f'<span class="limit">{"≥" if least else "≤"} {_figure(row.limit, unit)}</span>'
    return (
        f'<span class="mark {row.level}" title="{esc(row.text, 600)}"><span class="level">{LEVELS[row.level]}</span>'
        f"{_figure(row.value, unit)}</span>{limit}"
    )


def _figure(value: float, unit: str) -> str:
    if not math.isfinite(value):
        return "–"
    shown = 100 * value if unit == "%" else value
    near_one = unit == "" and 0.9 < shown < 1  # a correlation: not to be rounded to 1
    text = number(shown, 4 if near_one else 2 if abs(shown) < 10 else 3)
    return f"{text}{'' if unit in ('', '°') else ' '}{unit}"
