"""`margcal apply`: a calibration on a recording, streamed from file to file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from margcal.apps import screen
from margcal.apps.outputs import check_outputs
from margcal.files.calfile import load
from margcal.workflow.apply import apply_file


def run(
    calibration: str,
    recording: str,
    *,
    output: str,
    units: dict[str, str] | None,
    force: bool,
    overwrite: bool,
    as_json: bool,
) -> int:
    """The verb."""
    check_outputs([output], [calibration, recording], overwrite)
    model = load(calibration)
    with screen.progress(f"applying to {Path(recording).name}") as tick:
        summary = apply_file(model, recording, output, overwrite=overwrite, force=force, units=units, progress=tick)
    if as_json:
        print(json.dumps({**summary, "written": output}, indent=2))
    else:
        _show(summary, output)
    return 0


def _show(summary: dict[str, Any], output: str) -> None:
    seconds = summary["seconds"]
    span = "" if seconds is None else f", {seconds:.6g} s"
    screen.line(f"{summary['rows']} rows{span}")
    for kind, done in summary["sensors"].items():
        delay = f", delay of {1e3 * done['delay_s']:.2f} ms corrected" if done["delay_s"] else ""
        screen.line(f"{kind}: {done['raw_unit']} to {done['unit']}{delay}")
    if summary["passed_through"]:
        screen.line(f"passed through, not in the calibration: {', '.join(summary['passed_through'])}")
    if summary["missing"]:
        screen.line(f"in the calibration, not in the recording: {', '.join(summary['missing'])}")
    for text in summary["forced"]:
        screen.line(f"forced: {text}", style="yellow")
    screen.line(f"written: {output}")
