"""`margcal check`: what recordings can be used for, before anything is fitted."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from margcal.apps import screen
from margcal.apps.calibrating import read_one
from margcal.workflow.findings import Finding
from margcal.workflow.inspect import Inspection, inspect

LEVEL_STYLE = {"pass": "green", "note": "", "warn": "yellow", "fail": "red"}


def run(recordings: Sequence[str], *, at: str | None, up: str | None, as_json: bool, reading: Mapping[str, Any]) -> int:
    """The verb; exit status 3 where a check fails."""
    place = None
    if at is not None:
        from margcal.workflow.place import parse_at

        place = parse_at(at)
    read_in = [read_one(path, reading) for path in recordings]
    with screen.progress("checking"):
        found = inspect(*read_in, place=place, up=up)
    status = 3 if found.level == "fail" else 0
    if as_json:
        print(json.dumps(_as_plain(found, [r.source for r in read_in], status), indent=2))
    else:
        _show(found, [r.source for r in read_in], recordings)
    return status


def _show(found: Inspection, sources: Sequence[str], paths: Sequence[str]) -> None:
    screen.line(f"{', '.join(sources)}: {found.conclusion}", style=LEVEL_STYLE[found.level])
    screen.line()
    alone = sources[0] if len(sources) == 1 else ""
    rows = [_row(f, sensors) for f, sensors in _merged([_local(f, alone) for f in found.findings])]
    screen.table(["check", "sensor", "result", "value", "limit", "what was found"], rows, right=(3, 4))
    if found.next_steps:
        screen.line()
        screen.line("what to do:")
        for step in found.next_steps:
            screen.line(f"- {step}")
    if any(c.level != "pass" for c in found.carried):
        screen.line(f"- `margcal plan {' '.join(paths)}` says which attitudes help most")


def _local(finding: Finding, source: str) -> Finding:
    """Without the recording's name, where there is only one."""
    return replace(finding, text=finding.text.removeprefix(f"{source}: ")) if source else finding


def _merged(findings: Sequence[Finding]) -> list[tuple[Finding, str]]:
    """Findings with their sensors; passed ones of one check that have no figure share a row."""
    rows: list[tuple[Finding, list[str]]] = []
    for finding in findings:
        last = rows[-1] if rows else None
        plain = finding.level == "pass" and _words(finding) != finding.text
        if last and plain and last[0].check == finding.check and _words(last[0]) == _words(finding):
            same = last[0].level == "pass" and last[0].value in (None, 0.0, finding.value)
            if same:
                last[1].append(finding.sensor or "")
                continue
        rows.append((finding, [finding.sensor or ""]))
    return [(f, " ".join(s)) for f, s in rows]


def _words(finding: Finding) -> str:
    """What was found, without the sensor's name, which has a column of its own."""
    from margcal.workflow.job import NAMES

    name = NAMES.get(finding.sensor) if finding.sensor else None
    return finding.text.removeprefix(f"{name}: ") if name else finding.text


def _row(finding: Finding, sensors: str) -> list[str]:
    value = "" if finding.value is None else f"{_figure(finding.value)} {finding.unit}".rstrip()
    limit = "" if finding.limit is None else _figure(finding.limit)
    words = _words(finding)
    if finding.todo and finding.level == "note":
        words += f"; {finding.todo}"
    return [finding.check, sensors, finding.level, value, limit, words]


def _figure(value: float) -> str:
    if not np.isfinite(value):
        return "-"
    return f"{value:.0f}" if value == round(value) and abs(value) < 1e7 else f"{value:.3g}"


def _as_plain(found: Inspection, sources: Sequence[str], status: int) -> dict[str, Any]:
    rows = [{k: _plain(v) for k, v in asdict(f).items()} for f in found.findings]
    rests = found.segmentation
    return {
        "recordings": list(sources),
        "exit_status": status,
        "level": found.level,
        "conclusion": found.conclusion,
        "sensors": {c.kind: {"level": c.level, "text": c.text, "todo": c.todo} for c in found.carried},
        "checks": rows,
        "next_steps": list(found.next_steps),
        "rests": None if rests is None else len(rests.poses),
        "turns": None if rests is None else len(rests.turns),
    }


def _plain(value: Any) -> Any:
    """A JSON value; what is not finite is null."""
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not np.isfinite(value) else value
