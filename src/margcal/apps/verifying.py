"""`margcal verify`: was a calibration applied the right way? A recording calibrated elsewhere, against the file."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from margcal.apps import screen
from margcal.apps.printing import NAMES, figure, show_issues
from margcal.core.checking import printable
from margcal.core.errors import InputError
from margcal.core.types import Calibration, Kind, Recording, SensorModel
from margcal.core.units import KINDS, SI_COLUMN
from margcal.workflow.verify import Finding, Verification, verify

_COLUMN = re.compile(r"(acc|gyr|mag)_[xyz]_([a-z0-9]+)", re.IGNORECASE)

STYLE = {"right": "green", "mistake": "red", "other": "red", "cannot-tell": "yellow"}


def run(calibration: str, recording: str, *, raw: str | None, as_json: bool, reading: Mapping[str, Any]) -> int:
    """The verb; exit status 3 where a mistake was found."""
    from margcal.files.calfile import load

    model = load(calibration)
    calibrated, before = _read(model, recording, raw, reading)
    with screen.progress("verifying"):
        found = verify(model, calibrated, before)
    if as_json:
        print(json.dumps(as_plain(found), indent=1, ensure_ascii=False, allow_nan=False))
    else:
        _show(found, Path(recording).name)
    return 3 if found.fails else 0


def _read(
    calibration: Calibration, recording: str, raw: str | None, reading: Mapping[str, Any]
) -> tuple[Recording, Recording | None]:
    """The calibrated recording and the raw one: of its own file, or of columns that are there beside it."""
    from margcal.apps.calibrating import read_one

    beside = _both(calibration, recording) if raw is None and not reading.get("units") else {}
    if beside:
        calibrated = read_one(recording, {**reading, "units": {k: SI_COLUMN[m.unit] for k, m in beside.items()}})
        return calibrated, read_one(recording, {**reading, "units": {k: m.raw_unit for k, m in beside.items()}})
    return read_one(recording, reading), None if raw is None else read_one(raw, {})


def _both(calibration: Calibration, recording: str) -> dict[Kind, SensorModel]:
    """The models of the sensors of which a table holds raw columns and calibrated ones."""
    from margcal.files.batches import open_table
    from margcal.files.tables import tables_in

    path = Path(recording)
    there: dict[str, set[str]] = {}
    for member in tables_in(path) if path.is_dir() else [path]:
        for match in filter(None, map(_COLUMN.fullmatch, open_table(member).names)):
            there.setdefault(match[1].lower(), set()).add(match[2].lower())
    several: dict[Kind, set[str]] = {
        k: there[k] for k in KINDS if len(there.get(k, ())) > 1 and k in calibration.models
    }
    for kind, units in several.items():
        model = calibration.models[kind]
        if not {model.raw_unit.lower(), SI_COLUMN[model.unit].lower()} <= units:
            raise InputError(
                f"{printable(path.name)}: {kind} is there in {' and '.join(sorted(units))}; of the calibration are "
                f"{model.raw_unit} (raw) and {SI_COLUMN[model.unit]}: say which to take, such as --units "
                f"{kind}={sorted(units)[0]}"
            )
    return {k: calibration.models[k] for k in several}


def _show(found: Verification, name: str) -> None:
    how = (
        "with the raw recording: which map made one of the other"
        if found.how == "exact"
        else "without the raw recording: what makes sense of the rests and turns"
    )
    screen.line(f"{name}, {how}", style="bold")
    for finding in found.findings:
        screen.line(f"{NAMES[finding.sensor]}: {_headline(finding)}", style=STYLE[finding.outcome])
        for text in _unseen(finding):
            screen.line(f"  {text}")
    screen.line()
    if found.how == "exact":
        rows = [
            [f.sensor, figure(f.residual, 3), figure(f.mended, 3), figure(f.limit, 2), f.figure] for f in found.findings
        ]
        screen.table(["", "as recorded", "explained", "limit", ""], rows, right=(1, 2, 3))
    else:
        rows = [[n, figure(a, 3), figure(b, 3), figure(c, 2)] for n, (a, b, c) in found.figures.items()]
        first = found.findings[0]
        rows.append([first.figure, figure(first.residual, 3), figure(first.mended, 3), figure(first.limit, 2)])
        screen.table(["", "as recorded", "mended", "limit"], rows, right=(1, 2, 3))
    show_issues([i for i in found.issues if i.level != "fail"])
    if found.fails:
        screen.line()
        screen.line(
            "the right way is u = H (y - B), H row by row and B in raw units: docs/apply.md has it in your language"
        )


def _headline(finding: Finding) -> str:
    if finding.outcome == "right":
        return f"right: {finding.text}"
    return {"mistake": "WRONG: ", "other": "WRONG: ", "cannot-tell": "cannot tell: "}[finding.outcome] + finding.text


def _unseen(finding: Finding) -> list[str]:
    """What could have been done wrong without being seen, and how much it would matter."""
    of = "1 rad/s" if finding.sensor == "gyr" else "the sensed vector"
    return [
        f"cannot tell it from the mistake '{name}', which would make {100 * size:.3g} % of {of} here"
        for name, size in sorted(finding.unseen.items(), key=lambda item: -item[1])
    ]


def as_plain(found: Verification) -> dict[str, Any]:
    """For JSON."""

    def number(value: float) -> float | None:
        return float(value) if math.isfinite(value) else None

    return {
        "how": found.how,
        "verdict": "fail" if found.fails else "pass" if all(f.outcome == "right" for f in found.findings) else "warn",
        "sensors": {
            f.sensor: {
                "outcome": f.outcome,
                "mistakes": list(f.mistakes),
                "text": f.text,
                "figure": f.figure,
                "residual": number(f.residual),
                "mended": number(f.mended),
                "limit": number(f.limit),
                "unseen": {k: number(v) for k, v in f.unseen.items()},
            }
            for f in found.findings
        },
        "figures": {
            n: {"as_recorded": number(a), "mended": number(b), "limit": number(c)}
            for n, (a, b, c) in found.figures.items()
        },
        "issues": [{"code": i.code, "level": i.level, "sensor": i.sensor, "text": i.text} for i in found.issues],
    }
