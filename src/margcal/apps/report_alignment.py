"""What a calibration against motion capture adds to the report: timing, frames, residuals, orientation, masks.

Each function gives the HTML of a section, or nothing where the calibration does not tell it. The figures behind the
curves are there after `align`; a calibration that was loaded has the values alone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from margcal.apps.report_alignment_frames import frames
from margcal.apps.report_alignment_plots import (
    correlation_figure,
    floored,
    masked_strip,
    no_before,
    orientation_figure,
    residual_figure,
    residual_unit,
    rms,
)
from margcal.apps.report_findings import finding_list
from margcal.apps.report_text import (
    NAMES,
    decimals_for,
    degrees,
    esc,
    fixed,
    listing,
    number,
    plural,
    plus_minus,
    table,
)
from margcal.core.types import Calibration, Kind, SensorModel
from margcal.workflow.align_job import AlignFigures, MocapAlignment, OrientationErrors

MOST_STRETCHES = 12
"""Masked stretches that are listed, the longest ones."""
MASKED = ("reference-gaps", "reference-origin", "reference-identity", "reference-frozen", "reference-residual")
MASKED = (*MASKED, "reference-swap", "reference-position-unit", "reference-norm")
"""Codes of what was cut out of the reference, or mended in it."""
KEYS = "".join(f'<span class="key axis-{a}">{a}</span>' for a in "xyz")
HELD_DOWN, LITTLE = 0.5, 0.0005
"""Readings below this weight in their fit are told, where they are more than this share."""


def figures_of(calibration: Calibration) -> AlignFigures | None:
    """The figures that `align` leaves; None in a loaded calibration."""
    alignment = calibration.alignment
    return alignment.figures if isinstance(alignment, MocapAlignment) else None


def told(calibration: Calibration, name: str) -> float | None:
    """A number that `align` left in the settings; None where it is missing or none (the file is anybody's)."""
    found = calibration.settings.get("alignment")
    value = found.get(name) if isinstance(found, Mapping) else None
    return _number(value)


def _number(value: Any) -> float | None:
    good = isinstance(value, (int, float, np.floating)) and not isinstance(value, bool) and math.isfinite(value)
    return float(value) if good else None


# --- timing --------------------------------------------------------------------------------------------


def timing(calibration: Calibration) -> str:
    """Correlation curve, and a table of offset, drift and delays with their standard errors."""
    alignment, figures = calibration.alignment, figures_of(calibration)
    if alignment is None:
        return ""
    rows = [*_correlation_rows(calibration), *_clock_rows(calibration)]
    rows += [_delay_row(model, alignment.common_clock) for model in calibration.models.values()]
    body = table(["Timing", "Value", "What it means"], rows, "clock and delays", "node timing")
    if figures is None:
        return body
    at = (
        figures.delays.get("gyr", (0.0, None))[0]
        if alignment.common_clock
        else _number(alignment.values.get("offset_s"))
    )
    return correlation_figure(figures, at or 0.0, alignment.common_clock) + body


def _correlation_rows(calibration: Calibration) -> list[list[str]]:
    """For a calibration without the curve."""
    peak, share = told(calibration, "correlation"), told(calibration, "rate_explained")
    if figures_of(calibration) is not None or peak is None:
        return []
    text = "how alike the angular rates of node and optics are at the best offset, of at most 1"
    if share is not None:
        text += f"; {floored(100 * share, 2)} % of the squared rate is accounted for"
    return [["Correlation", f'<span class="num">{floored(peak, 4)}</span>', text]]


def _clock_rows(calibration: Calibration) -> list[list[str]]:
    alignment = calibration.alignment
    if alignment is None:
        return []
    if alignment.common_clock:
        return [["Clock", "common", "node and optics were recorded on one clock: no offset, no drift"]]
    offset, drift = (_number(alignment.values.get(n)) for n in ("offset_s", "drift_ppm"))
    rows = []
    if offset is not None:
        se = _number(alignment.values.get("offset_s_se"))
        shown = plus_minus(1e3 * offset, None if se is None else 1e3 * se, 7)
        rows.append(["Clock offset", f"{shown} ms", "what the optics' clock reads when the node's reads zero"])
    if drift is not None:
        shown = plus_minus(drift, _number(alignment.values.get("drift_ppm_se")), 4)
        pace = "slow" if drift > 0 else "fast"
        text = f"the node's clock is {pace} by {number(abs(drift) * 0.06, 2)} ms a minute against the optics'"
        rows.append(["Clock drift", f"{shown} ppm", text if drift else "none"])
    return rows


def _delay_row(model: SensorModel, common_clock: bool) -> list[str]:
    name = f"Delay of the {NAMES[model.kind]}"
    behind = "the optics" if common_clock else "the gyroscope"
    if model.kind == "gyr" and not common_clock:
        return [name, "0", "counts as zero: on separate clocks it cannot be told from the offset"]
    if model.delay_s is None:
        return [name, "–", "not known"]
    delay, se = 1e3 * model.delay_s, None if model.delay_se_s is None else 1e3 * model.delay_se_s
    value = f"{plus_minus(delay, se, 4)} ms"
    if se is None:
        return [name, value, "not found from the motion: taken to be the gyroscope's"]
    if abs(delay) < 2 * se:
        return [name, value, f"behind {behind}; not to be told from none"]
    order = "after" if delay > 0 else "before"
    size = fixed(abs(delay), max((decimals_for(se) or 0) - 1, 0))
    return [
        name,
        value,
        f"its readings come {size} ms {order} those of {behind}; <code>margcal apply</code> corrects it",
    ]


# --- frames --------------------------------------------------------------------------------------------


def frame_pictures(calibration: Calibration) -> str:
    """Node and marker body, laboratory and earth, lever arm."""
    return "" if calibration.alignment is None else frames(calibration.alignment.values)


# --- residuals -----------------------------------------------------------------------------------------


def motion_residuals(calibration: Calibration) -> str:
    """Residuals over time, and their root mean squares."""
    figures = figures_of(calibration)
    if figures is None:
        return ""
    picture = residual_figure(calibration, figures)
    if not picture:
        return ""
    before = ""
    if math.isfinite(rms(figures.rate_before)):
        before = "<strong>Before:</strong> the gyroscope as read, its axes taken for the marker body's. "
    caption = (
        f'<figcaption><span class="keys">{KEYS}{_shaded(figures)}</span>{before}<strong>After:</strong> '
        f"calibrated, in the common frame.{_lengths(calibration, figures)}</figcaption>"
    )
    rows = [["Angular rate of the body", f"{_figure(math.degrees(rms(figures.rate)))} °/s", "by the optics"]]
    for name, rate in (("before", figures.rate_before), ("after", figures.rate_after)):
        if math.isfinite(rms(rate)):
            rows.append(
                [f"Gyroscope less optics, {name}", f"{_figure(math.degrees(rms(rate)))} °/s", _part(rate, figures)]
            )
    rows += [_residual_row(calibration, kind) for kind in ("acc", "mag") if kind in figures.residual]
    rows = [r for r in rows if r]
    body = f'<figure class="timeline">{caption}{picture}</figure>{no_before(calibration)}'
    return body + table(["Root mean square", "Of its length", ""], rows, "residuals", "node")


def _lengths(calibration: Calibration, figures: AlignFigures) -> str:
    names = listing(NAMES[k] for k in calibration.models if k != "gyr" and k in figures.residual)
    return f" {names.capitalize()}: length of what is left of each reading." if names else ""


def _shaded(figures: AlignFigures) -> str:
    return '<span class="key masked-key">not seen</span>' if figures.masked else ""


def _figure(value: float) -> str:
    return f'<span class="num">{number(value, 3)}</span>'


def _part(rate: Any, figures: AlignFigures) -> str:
    whole = rms(figures.rate)
    return f"{number(100 * rms(rate) / whole, 2)} % of the body's rate" if whole > 0 else ""


def _residual_row(calibration: Calibration, kind: Kind) -> list[str]:
    figures, model = figures_of(calibration), calibration.models.get(kind)
    if figures is None or model is None:
        return []
    factor, unit = residual_unit(calibration, kind)
    value = rms(figures.residual[kind])
    if not math.isfinite(value):
        return []
    cause = (
        "field that differs from place to place, and noise" if kind == "mag" else "noise, and motion not accounted for"
    )
    return [f"{NAMES[kind].capitalize()}, what is left", f"{_figure(factor * value)} {unit}", cause]


# --- orientation ---------------------------------------------------------------------------------------


def orientation(calibration: Calibration) -> str:
    """What a filter makes of the readings before and after, against the optics."""
    figures = figures_of(calibration)
    if figures is None or (figures.before is None and figures.after is None):
        return ""
    before, after = figures.before, figures.after
    picture = orientation_figure(before, after, figures)
    told_of = [
        f"<strong>{name}:</strong> {esc(e.text)}."
        for name, e in (("Before", before), ("After", after))
        if e is not None
    ]
    caption = f'<figcaption><span class="keys">{_shaded(figures)}</span>{" ".join(told_of)}</figcaption>'
    note = ""
    if before is None:
        note = '<p class="note">No figure before the calibration: a filter cannot run on raw counts.</p>'
    return f"{_gain(before, after)}{_orientation_table(before, after)}{note}" + (
        f'<figure class="timeline">{caption}{picture}</figure>' if picture else ""
    )


def _gain(before: OrientationErrors | None, after: OrientationErrors | None) -> str:
    if before is None or after is None:
        return ""
    word = "down" if after.total <= before.total else "up"
    return (
        f"<p>The orientation is off by <strong>{degrees(after.total)}</strong> rms with the calibration, {word} from "
        f"{degrees(before.total)} without.</p>"
    )


def _orientation_table(before: OrientationErrors | None, after: OrientationErrors | None) -> str:
    columns = [(n, e) for n, e in (("Before", before), ("After", after)) if e is not None]
    rows = [
        [name, *(f'<span class="num">{degrees(getattr(e, part))}</span>' for _, e in columns)]
        for name, part in (("Total", "total"), ("Heading", "heading"), ("Inclination", "inclination"))
    ]
    return table(["Orientation error, rms", *(n for n, _ in columns)], rows, "orientation error", "expected")


# --- what was masked -----------------------------------------------------------------------------------


def masked(calibration: Calibration) -> str:
    """Share of the reference that was used, why the rest was not, and where it lies."""
    if calibration.alignment is None:
        return ""
    figures = figures_of(calibration)
    seen = told(calibration, "reference_seen") if figures is None else figures.seen
    reasons = [i for i in calibration.issues if i.code in MASKED]
    if seen is None and not reasons:
        return ""
    body = ""
    if seen is not None:
        body = f"<p><strong>{floored(100 * seen, 2)} %</strong> of the reference's samples were used."
        body += " Beside a gap a few more are lost: a rate needs neighbours on both sides.</p>" if seen < 1 else "</p>"
    body += finding_list(reasons) if reasons else ""
    return body if figures is None else body + _stretches(figures) + _held_down(calibration)


def _stretches(figures: AlignFigures) -> str:
    """A strip over time, and the longest stretches with their times."""
    if not figures.masked:
        return ""
    start = float(figures.t[0]) if len(figures.t) else 0.0
    longest = sorted(figures.masked, key=lambda s: s[0] - s[1])[:MOST_STRETCHES]
    rows = [
        [f"{fixed(a - start, 2)} s", f"{fixed(b - start, 2)} s", f"{fixed(b - a, 2)} s"] for a, b in sorted(longest)
    ]
    more = len(figures.masked) - len(longest)
    note = (
        f'<p class="note">{plural(more, "further stretch", "further stretches")}, none of them longer, not listed.</p>'
        if more > 0
        else ""
    )
    return masked_strip(figures) + table(["Not seen from", "to", "for"], rows, "stretches not seen", "stretches") + note


def _held_down(calibration: Calibration) -> str:
    """Readings that count little in their fit: beside gaps, and where the field does not agree with the rest."""
    low: dict[Kind, float] = {k: share for k in calibration.models if (share := _little(calibration, k)) > LITTLE}
    beside = [f"{number(100 * share, 2)} % of the {NAMES[k]}'s" for k, share in low.items() if k != "mag"]
    text = ""
    if beside:
        text = (
            "<p>Beside a gap, and at the ends, the weight of a reading rises gently from nothing: "
            f"{listing(beside)} readings count less than half for that.</p>"
        )
    if "mag" in low:
        text += (
            f"<p>{number(100 * low['mag'], 2)} % of the magnetometer's readings count less than half because they do "
            "not agree with the others: the field was different there.</p>"
        )
    return text


def _little(calibration: Calibration, kind: Kind) -> float:
    """Share of the readings that were used with less than half a weight."""
    fit = calibration.fits.get(kind)
    weights = np.asarray(fit.details.get("weights", ()) if fit is not None else (), dtype=np.float64)
    used = weights[np.isfinite(weights) & (weights > 0)]
    return float(np.mean(used < HELD_DOWN)) if len(used) else 0.0
