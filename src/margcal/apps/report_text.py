"""Text for the report: escaping, numbers as people write them, and small pieces of HTML.

Everything that comes from outside (names, issues, settings) goes through `esc`; everything else is written in
these files.
"""

from __future__ import annotations

import html
import json
import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from margcal.core.checking import printable
from margcal.core.types import Kind

NAMES: dict[Kind, str] = {"acc": "accelerometer", "gyr": "gyroscope", "mag": "magnetometer"}

_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_UNIT_WORDS = {"m/s^2": "m/s²", "uT": "µT", "norm": "local field", "mps2": "m/s²", "dps": "°/s", "mdps": "m°/s"}
_UNIT_WORDS |= {"radps": "rad/s", "count": "counts", "gauss": "G", "mgauss": "mG"}


def esc(text: object, limit: int = 2000) -> str:
    """`text` fit for HTML: control and direction characters replaced, markup inert, long text cut."""
    return html.escape(printable(text, limit), quote=True)


def data_block(name: str, value: Any) -> str:
    """`value` as a JSON script element that no content can end or turn into markup."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False, ensure_ascii=True)
    text = text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
    return f'<script type="application/json" id="{name}">{text}</script>'


def plain_unit(unit: str) -> str:
    """A unit as people write it, not escaped: ``m/s^2`` -> m/s²."""
    return printable(_UNIT_WORDS.get(unit, unit), 40)


def unit_words(unit: str) -> str:
    """A unit as people write it, escaped."""
    return esc(plain_unit(unit))


def per_unit(unit: str) -> str:
    """The same behind "per": one of it."""
    return "count" if unit == "count" else unit_words(unit)


def number(value: float | None, digits: int = 4) -> str:
    """`value` with so many significant digits, a true minus, and powers of ten where they save zeros."""
    if value is None or not math.isfinite(value):
        return "–"
    text = f"{value:.{digits}g}"
    if "e" in text or (value and not 1e-4 <= abs(value) < 1e7):
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        return f"{mantissa}×{power_of_ten(int(exponent))}".replace("-", "−")
    return text.replace("-", "−")


def fixed(value: float | None, decimals: int) -> str:
    """`value` with so many decimals and a true minus."""
    if value is None or not math.isfinite(value):
        return "–"
    if abs(value) >= 1e9:
        return number(value, 6)
    text = f"{value:.{decimals}f}"
    if not text.strip("-0."):
        text = text.lstrip("-")
    return text.replace("-", "−")


def decimals_for(spread: float | None, digits: int = 2) -> int | None:
    """Decimals that show `spread` with so many significant digits; None where there is no spread."""
    if spread is None or not math.isfinite(spread) or spread <= 0:
        return None
    return int(min(max(digits - 1 - math.floor(math.log10(spread)), 0), 9))


def plus_minus(value: float | None, se: float | None, digits: int = 5) -> str:
    """HTML of a value with its standard error, both cut where the standard error says so."""
    decimals = decimals_for(se)
    if decimals is None:
        return f'<span class="num">{number(value, digits)}</span>'
    return f'<span class="num">{fixed(value, decimals)}</span> <span class="se">± {fixed(se, decimals)}</span>'


def degrees(value: float | None) -> str:
    """An angle with two significant digits, three where it begins with 1."""
    if value is None:
        return "–"
    if value >= 10 or value < 0.01:
        return f"{number(value, 3 if value >= 10 else 2)}°"
    return f"{fixed(value, 1 if value >= 3 else 2 if value >= 0.1 else 3)}°"


def plural(n: int, one: str, many: str | None = None) -> str:
    return f"{n} {one if n == 1 else many or one + 's'}"


def listing(words: Iterable[str]) -> str:
    """``a, b and c``"""
    words = list(words)
    return words[0] if len(words) == 1 else ", ".join(words[:-1]) + " and " + words[-1] if words else ""


def power_of_ten(exponent: int) -> str:
    return f"10{str(exponent).translate(_SUPERSCRIPT)}"


def table(head: Sequence[str], rows: Iterable[Sequence[str]], label: str, kind: str = "") -> str:
    """A table of ready HTML cells in a box of its own that scrolls; the first cell of a row names it."""
    top = "".join(f'<th scope="col">{cell}</th>' for cell in head)
    body = "".join(
        f'<tr><th scope="row">{row[0]}</th>' + "".join(f"<td>{c}</td>" for c in row[1:]) + "</tr>" for row in rows
    )
    thead = f"<thead><tr>{top}</tr></thead>" if head else ""
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="{esc(label)}">'
        f'<table class="{kind}">{thead}<tbody>{body}</tbody></table></div>'
    )


def matrix(values: np.ndarray, label: str) -> str:
    """A matrix (or column vector) in brackets, seven digits, with one power of ten before it where that helps."""
    rows = np.atleast_2d(np.asarray(values, dtype=np.float64))
    if np.ndim(values) == 1:
        rows = rows.T
    size = float(np.abs(rows).max())
    power = math.floor(math.log10(size)) if size > 0 and math.isfinite(size) else 0
    shown = power if power < -1 or power > 6 else 0
    decimals = min(max(6 - (power - shown), 0), 9)
    body = "".join(
        "<tr>" + "".join(f"<td>{fixed(v, decimals)}</td>" for v in row) + "</tr>" for row in rows / 10.0**shown
    )
    factor = f'<span class="factor">{power_of_ten(shown)} ×</span>' if shown else ""
    return f'{factor}<table class="matrix" aria-label="{esc(label)}"><tbody>{body}</tbody></table>'
