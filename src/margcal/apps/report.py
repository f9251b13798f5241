"""The report: one HTML page that opens offline and asks for nothing from anywhere.

The page is a list of sections, each a function from the calibration to HTML or None where it has nothing to say.
Style and scripts are files in ``static/``; they are put into the page and named in its Content-Security-Policy by
their hashes, so that nothing else can run, whatever the names in the data are.
"""

from __future__ import annotations

import base64
import hashlib
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

from margcal.apps.report_alignment import frame_pictures, masked, motion_residuals, orientation, timing
from margcal.apps.report_attitudes import gallery
from margcal.apps.report_checks import checks_of, checks_table
from margcal.apps.report_data import attitudes, left_out, residuals
from margcal.apps.report_expected import expected
from margcal.apps.report_findings import findings, provenance
from margcal.apps.report_influence import influence, influences
from margcal.apps.report_parameters import matrices, parameter_table
from margcal.apps.report_residuals import residual_figure, worst_pose
from margcal.apps.report_sphere import sphere_data, still_pictures
from margcal.apps.report_summary import masthead
from margcal.apps.report_text import NAMES, data_block, esc, plural
from margcal.apps.report_timeline import timelines
from margcal.apps.report_usage import usage
from margcal.core.types import Calibration


@dataclass(frozen=True)
class Section:
    """A part of the page: its anchor, its title, a sentence beside it, and its content (HTML, escaped)."""

    id: str
    title: str
    lead: str
    body: str


def render(calibration: Calibration) -> str:
    """The report of `calibration` as one self-contained HTML page.

    Parameters
    ----------
    calibration : Calibration
        As `calibrate` returns it; of a loaded one there are the checks, the parameters, their uncertainty and how to
        apply them, and with `revisit` the readings as well.

    Returns
    -------
    str
        Same calibration, same text.
    """
    sections = [s for make in SECTIONS if (s := make(calibration)) is not None]
    links = "".join(f'<a href="#{s.id}">{s.title}</a>' for s in sections)
    body = (
        f'<header class="masthead">{masthead(calibration)}</header>'
        f'<nav aria-label="Sections">{links}</nav><main>{"".join(map(_section, sections))}</main>'
    )
    return _page(f"Calibration of {calibration.device or 'a sensor node'}", body)


def write_report(calibration: Calibration, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
    """Write the report of `calibration` to `path`, whole or not at all.

    Raises
    ------
    InputError
        If `path` exists (without `overwrite`) or cannot be written.
    """
    from margcal.files.atomic import atomic_path

    page = render(calibration)
    with atomic_path(path, overwrite=overwrite) as temporary:
        temporary.write_text(page, encoding="utf-8", newline="\n")


# --- sections ----------------------------------------------------------------------------------------


def _findings(calibration: Calibration) -> Section | None:
    lead = "What else the program noticed on the way; failures and warnings stand under the verdict."
    return Section("findings", "Notes", lead, findings(calibration))


def _expected(calibration: Calibration) -> Section | None:
    body = expected(calibration)
    lead = (
        "How far a calibrated reading is likely to be off, from the covariance of the twelve numbers: root mean square "
        "over all directions, one standard deviation."
    )
    return Section("expected", "Expected error", lead, body) if body else None


def _checks(calibration: Calibration) -> Section | None:
    rows = checks_of(calibration)
    lead = "Figures behind the verdict, each with its limit. What stands under the verdict counts as well."
    return Section("checks", "Checks", lead, checks_table(rows)) if rows else None


def _recorded(calibration: Calibration) -> Section | None:
    body = timelines(calibration)
    if not body:
        return None
    lead = "Raw readings over time."
    if calibration.poses is not None and len(calibration.poses):
        lead += " Shaded: the node lay still. In between it was turned."
    return Section("recorded", "What was recorded", lead, body)


ATTITUDES = {
    "cube": ("<strong>Cube.</strong> Each rest is one of the housing's 24 attitudes; the readings tell which.", True),
    "faces": ("<strong>Faces.</strong> One face of the housing is up at each rest.", True),
    "file": ("<strong>Told.</strong> The attitudes were read from a table.", False),
    "reference": ("<strong>Reference.</strong> The attitudes were measured from outside, beside the readings.", True),
    "free": (
        "<strong>Free.</strong> Nothing was told of the attitudes; these are estimated, in the sensors' own frame.",
        False,
    ),
}
"""By what was taken (`settings['attitudes']`): a sentence, and whether the program's own words say more than it."""


def _attitudes(calibration: Calibration) -> Section | None:
    R, headings = attitudes(calibration)
    if R is None:
        return None
    text, mode = calibration.settings.get("attitudes_text"), calibration.settings.get("attitudes")
    said, more = ATTITUDES.get(mode, ("", True)) if isinstance(mode, str) else ("", True)
    if more and isinstance(text, str) and text:
        said += f" {esc(text[:1].upper() + text[1:])}."
    said = f"<p>{said.strip()}</p>" if said else ""
    gone = _mislabelled(calibration)
    if gone:
        said += (
            '<p class="note">Framed: what was told or taken does not hold there; the attitude drawn is estimated.</p>'
        )
    if not headings:
        said += '<p class="note">Headings are not known: each box is drawn in the heading that turns it least.</p>'
    lead = f"{plural(len(R), 'rest')}, each seen from the same place. The arrow is up."
    return Section("attitudes", "Attitudes taken", lead, said + gallery(R, gone))


def _mislabelled(calibration: Calibration) -> set[int]:
    """Numbers of the rests whose attitude, as told or taken, was left out."""
    return {t[0] for t in left_out(calibration, "label-left-out")}


def _sphere(calibration: Calibration) -> Section | None:
    data = sphere_data(calibration)
    if not data:
        return None
    lead = (
        "A perfect sensor reads points on a sphere about zero, whichever way it lies. A real one reads an ellipsoid "
        "somewhere else. Calibration takes the one to the other."
    )
    body = f'<div id="viewer" hidden></div><noscript>{still_pictures(data)}</noscript>{data_block("sphere-data", data)}'
    return Section("sphere", "Before and after", lead, body)


def _timing(calibration: Calibration) -> Section | None:
    body = timing(calibration)
    lead = "How node and optics were brought together in time, from the angular rates that both of them tell."
    return Section("timing", "Timing", lead, body) if body else None


def _frames(calibration: Calibration) -> Section | None:
    body = frame_pictures(calibration)
    lead = (
        "How the node sits on the marker body, and how the optics' laboratory lies to the earth; seen from one place."
    )
    return Section("frames", "Frames", lead, body) if body else None


def _orientation(calibration: Calibration) -> Section | None:
    body = orientation(calibration)
    lead = "What an orientation filter makes of the readings, held against the optics."
    return Section("orientation", "Orientation", lead, body) if body else None


def _motion(calibration: Calibration) -> Section | None:
    body = motion_residuals(calibration)
    lead = "How far each sensor is from what the optics say that it should have read. Shaded: the body was not seen."
    return Section("motion", "Residuals over time", lead, body) if body else None


def _masked(calibration: Calibration) -> Section | None:
    body = masked(calibration)
    lead = "What of the reference was not used. Gaps are left out, never bridged."
    return Section("masked", "What was masked", lead, body) if body else None


def _residuals(calibration: Calibration) -> Section | None:
    if calibration.alignment is not None and not calibration.poses:
        return None  # sample by sample against the optics, over time: above
    found = [r for kind in calibration.models if (r := residuals(calibration, kind)) is not None]
    if not found:
        return None
    lead = "What the calibration does not explain, rest by rest and turn by turn."
    return Section(
        "residuals",
        "Residuals",
        lead,
        worst_pose(found, _mislabelled(calibration)) + "".join(map(residual_figure, found)),
    )


def _influence(calibration: Calibration) -> Section | None:
    found = influences(calibration)
    lead = "How far the answer moves when a rest is left out. Below the dashed line: less than its expected error."
    return Section("influence", "Leaving out a rest", lead, influence(found)) if found else None


def _parameters(calibration: Calibration) -> Section | None:
    if not calibration.models:
        return None
    parts = []
    for kind, model in calibration.models.items():
        parts.append(f"<h3>{NAMES[kind].capitalize()}</h3>{parameter_table(model)}{matrices(model)}")
    lead = "The twelve numbers of each sensor, in words and as the matrix H and the offset B."
    if any(m.covariance is not None for m in calibration.models.values()):
        lead += " Behind ± is the standard error."
    return Section("parameters", "Parameters", lead, "".join(parts))


def _usage(calibration: Calibration) -> Section | None:
    if not calibration.models:
        return None
    lead = "The formula, and code with the numbers in place. Nothing else is needed."
    return Section("apply", "How to apply", lead, usage(calibration))


def _provenance(calibration: Calibration) -> Section | None:
    lead = "Where the numbers come from, for whoever has to repeat them."
    return Section("provenance", "Provenance", lead, provenance(calibration))


SECTIONS: Sequence[Callable[[Calibration], Section | None]] = (
    _findings,
    _expected,
    _checks,
    _timing,
    _frames,
    _orientation,
    _motion,
    _masked,
    _recorded,
    _attitudes,
    _sphere,
    _residuals,
    _influence,
    _parameters,
    _usage,
    _provenance,
)
"""In the order of the page. Verdict, its reasons and the expected errors stand before all of them in the masthead."""


def _section(section: Section) -> str:
    return (
        f'<section id="{section.id}" aria-labelledby="{section.id}-title"><div class="gutter">'
        f'<h2 id="{section.id}-title">{section.title}</h2><p class="lead">{section.lead}</p></div>'
        f'<div class="content">{section.body}</div></section>'
    )


# --- page --------------------------------------------------------------------------------------------


@cache
def _asset(name: str) -> str:
    from importlib import resources

    return (resources.files("margcal.apps") / "static" / name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _page(title: str, body: str) -> str:
    style, script = _asset("report.css"), "\n".join(_asset(n) for n in ("viewer.js", "report.js"))
    policy = (
        f"default-src 'none'; script-src {_hash(script)}; style-src {_hash(style)}; img-src data:; "
        "base-uri 'none'; form-action 'none'"
    )
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n<meta name="referrer" content="no-referrer">\n'
        f'<meta name="generator" content="margcal">\n<link rel="icon" href="data:,">\n<title>{esc(title)}</title>\n'
        f"<style>{style}</style>\n</head>\n<body>\n{body}\n<script>{script}</script>\n</body>\n</html>\n"
    )
