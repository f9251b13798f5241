"""Findings (issues with their levels) and provenance (files, settings, program, methods)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from margcal.apps.report_text import NAMES, esc, number, plural, table
from margcal.core.types import Calibration, Issue

LEVELS = {"fail": "Failure", "warn": "Warning", "note": "Note"}
_SETTINGS = {
    "poses": "Attitudes asked for",
    "attitudes": "Attitudes taken",
    "attitudes_text": "How sure",
    "sensors": "Sensors asked for",
    "method": "Method asked for",
    "gravity": "Gravity, m/s²",
    "field_uT": "Magnetic field, µT",
    "at": "Place (latitude, longitude, year)",
    "level": "Level-table prior",
    "level_sd_deg": "Tilt of the table, sd in °",
    "units": "Units",
    "sources": "Taken from",
    "static": "Trial at rest",
    "common_clock": "Common clock",
    "as_printed": "R-BSN (14) as printed",
    "norm": "Norm of R-BSN (20)",
    "alignment": "Alignment",
}
_HIDDEN = {"attitudes_figures", "checks"}
_R_BSN = (
    " R-BSN: Rüschen, Misgeld, Kim and Leonhardt, A Novel Algorithm for the Calibration of Inertial/Magnetic Sensors: "
    "Application to a Body Sensor Network."
)
MAX_ISSUES = 300
_MOTION = (
    "This report was made from the calibration alone. The curves over time are in the report that is written along "
    'with it: <code class="command">margcal align RECORDING --reference REF -o CALIBRATION.json --report '
    "REPORT.html</code>"
)
_ALONE = (
    "This report was made from the calibration alone. Readings, attitudes and residuals are shown when it is given "
    'the recording too: <code class="command">margcal report CALIBRATION.json RECORDING -o REPORT.html</code>'
)


def findings(calibration: Calibration) -> str:
    """The notes; failures and warnings stand under the verdict."""
    notes = [i for i in calibration.issues if i.level not in ("fail", "warn")]
    alone = (
        "" if calibration.recordings else f'<p class="quiet">{_ALONE if calibration.alignment is None else _MOTION}</p>'
    )
    if not notes:
        return alone or '<p class="quiet">Nothing to report.</p>'
    return finding_list(notes) + alone


def finding_list(issues: Sequence[Issue]) -> str:
    """Issues as a list, the gravest first."""
    order = list(LEVELS)
    issues = sorted(issues, key=lambda i: order.index(i.level) if i.level in LEVELS else 9)
    more = len(issues) - MAX_ISSUES
    rest = f'<li class="note">{plural(more, "further finding")} not listed.</li>' if more > 0 else ""
    return f'<ul class="findings">{"".join(map(_finding, issues[:MAX_ISSUES]))}{rest}</ul>'


def _finding(issue: Issue) -> str:
    figures = ""
    if issue.value is not None:
        figures = f" · {number(issue.value, 4)}"
        figures += f", limit {number(issue.limit, 4)}" if issue.limit is not None else ""
    sensor = f" · {NAMES[issue.sensor]}" if issue.sensor in NAMES else ""
    level = issue.level if issue.level in LEVELS else "note"
    return (
        f'<li class="{level}"><span class="level">{LEVELS[level]}</span><div><p>{_sentence(issue.text)}</p>'
        f'<p class="code">{esc(issue.code, 80)}{sensor}{figures}</p></div></li>'
    )


def _sentence(text: str) -> str:
    first = text.partition(" ")[0]
    if first.isalpha() or first.rstrip(":") in NAMES.values():  # a file's name stays as it is
        text = text[:1].upper() + text[1:]
    return esc(text + ("" if text[-1:] in ".!?" else "."), 1200)


def provenance(calibration: Calibration) -> str:
    """Files with their hashes, settings, methods with their sources, program."""
    return "".join([_files(calibration), _methods(calibration), _settings(calibration), _program(calibration)])


def _files(calibration: Calibration) -> str:
    if not calibration.files:
        return '<p class="quiet">The readings came from no file, or the calibration does not name it.</p>'
    rows = [[esc(name, 200), f'<code class="hash">{esc(digest, 64)}</code>'] for name, digest in calibration.files]
    return table(["File", "SHA-256"], rows, "files")


def _methods(calibration: Calibration) -> str:
    rows = []
    for kind, model in calibration.models.items():
        fit = calibration.fits.get(kind)
        row = [NAMES[kind].capitalize(), esc(model.method, 60) or "–"]
        rows.append([*row, esc(fit.cites, 300) if fit is not None else "–"] if calibration.fits else row)
    return table(["Sensor", "Method", "Source"][: len(rows[0])], rows, "methods") if rows else ""


def _settings(calibration: Calibration) -> str:
    settings = calibration.settings
    told = {"attitudes_text"} if calibration.poses is not None and len(calibration.poses) else set()  # stands above
    rows = [
        [_SETTINGS.get(name) or esc(name, 60), esc(_plain(value), 600)]
        for name, value in settings.items()
        if name not in _HIDDEN | told and value not in (None, "", [], {})
    ]
    return table(["Setting", "Value"], rows, "settings") if rows else ""


def _plain(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return number(value, 8)
    if isinstance(value, Mapping):
        return ", ".join(f"{str(k).replace('_', ' ')} {_plain(v)}" for k, v in value.items() if v is not None)
    if isinstance(value, Iterable) and not isinstance(value, str):
        return ", ".join(map(_plain, value))
    return str(value)


def _program(calibration: Calibration) -> str:
    parts = [esc(calibration.program, 80) if calibration.program else "margcal"]
    if calibration.created:
        parts.append(esc(calibration.created, 40))
    paper = "" if calibration.alignment is None else _R_BSN
    return (
        f'<p class="program">{" · ".join(parts)}</p>'
        '<p class="program">Z-TIE: Zhang, IEEE Trans. Ind. Electron. 62(6), 2015, doi 10.1109/TIE.2014.2375258. '
        f"ZY-TBME: Zhang and Yang, IEEE Trans. Biomed. Eng. 62(2), 2015, doi 10.1109/TBME.2014.2360335.{paper}</p>"
    )
