"""`margcal calibrate`: recordings in, a calibration on the screen, in a file, in a report."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from margcal.apps import screen
from margcal.apps.outputs import check_outputs
from margcal.core.errors import DataError, InputError, UsageError
from margcal.core.types import Calibration, Kind, Recording
from margcal.core.units import KINDS
from margcal.files.tables import read
from margcal.workflow.calibrate import MODES, calibrate


def run(
    recordings: Sequence[str],
    *,
    poses: str,
    sensors: str | None,
    at: str | None,
    nominal: str | None,
    output: str | None,
    report: str | None,
    allow_fail: bool,
    overwrite: bool,
    as_json: bool,
    reading: Mapping[str, Any],
    options: Mapping[str, Any],
) -> int:
    """The verb; `reading` goes to `read`, `options` (gravity, field, method ...) to `calibrate`.

    Returns
    -------
    int
        Exit status: 0, or 3 where the data cannot carry what was asked.
    """
    wanted = parse_sensors(sensors)
    check_outputs([output, report], recordings, overwrite)
    asked: dict[str, Any] = {**options, "sensors": wanted, "poses": _poses(poses)}
    if at is not None:
        from margcal.workflow.place import parse_at

        asked["place"] = parse_at(at)
    if nominal is not None:
        from margcal.files.calfile import load

        asked["nominal"] = load(nominal)
    read_in = tuple(read_one(path, reading) for path in recordings)
    calibration, failure = _calibrated(read_in, asked)
    written = write_results(calibration, output if failure is None or allow_fail else None, report, overwrite)
    if as_json:
        print_json(calibration, written=written, exit_status=0 if failure is None else 3)
    else:
        _show(calibration, written, failure is not None)
    if failure is not None:
        kept = "" if output is None or allow_fail else f"; {output} was not written (--allow-fail writes it)"
        screen.error(f"{failure.rstrip('.')}{kept}")
        return 3
    return 0


def _show(calibration: Calibration, written: dict[str, str], failed: bool) -> None:
    from margcal.apps.printing import show_calibration, show_written

    show_calibration(calibration)
    show_written(written, hint=not failed)


def read_one(path: str, reading: Mapping[str, Any]) -> Recording:
    """The recording `path`, with a progress bar if it takes long."""
    with screen.progress(f"reading {Path(path).name}") as tick:
        return read(path, **reading, progress=tick)


def parse_sensors(text: str | None) -> tuple[Kind, ...] | None:
    """``acc,mag`` as a tuple."""
    if text is None:
        return None
    names = [n.strip() for n in text.split(",") if n.strip()]
    for name in names:
        if name not in KINDS:
            raise UsageError(f"--sensors: {name!r} is none of {', '.join(KINDS)}")
    if not names:
        raise UsageError(f"--sensors: name some of {', '.join(KINDS)}")
    return tuple(k for k in KINDS if k in names)


def _poses(text: str) -> Any:
    """A mode by name, or the table of attitudes that is called so."""
    if text in MODES:
        return text
    if not Path(text).exists():
        kind = UsageError if Path(text).suffix == "" and Path(text).name == text else InputError
        raise kind(f"--poses: {text!r} is none of {', '.join(MODES)}, and there is no such file")
    from margcal.files.poses_table import read_poses

    return read_poses(text)


def _calibrated(recordings: tuple[Recording, ...], asked: Mapping[str, Any]) -> tuple[Calibration, str | None]:
    """The calibration and why it failed; where it failed, what there is all the same."""
    from margcal.files.calfile import created_now

    failure: str | None = None
    with screen.progress("calibrating"):
        try:
            found = calibrate(*recordings, **asked)
        except DataError as refused:
            failure = str(refused)
            try:
                found = calibrate(*recordings, **asked, allow_fail=True)
            except DataError:  # refused before any sensor was looked at
                issues = (*(i for r in recordings for i in r.issues), *refused.issues)
                found = Calibration(device=asked.get("device"), verdict="fail", issues=issues, recordings=recordings)
    if failure is None and found.verdict == "fail":
        failure = "the verdict is fail: " + "; ".join(i.text for i in found.issues if i.level == "fail")
    return replace(found, created=created_now()), failure


def write_results(calibration: Calibration, output: str | None, report: str | None, overwrite: bool) -> dict[str, str]:
    """Write the report and the calibration file; the names of those that were asked for."""
    written: dict[str, str] = {}
    if report is not None:
        from margcal.apps.report import write_report

        with screen.progress("writing the report"):
            write_report(calibration, report, overwrite=overwrite)
        written["report"] = str(report)
    if output is not None:
        from margcal.files.calfile import save

        save(calibration, output, overwrite=overwrite)
        written["calibration"] = str(output)
    return written


def print_json(calibration: Calibration, **more: Any) -> None:
    """The calibration file's content on stdout, with what else is to be said beside it."""
    print(json.dumps({**as_plain(calibration), **more}, indent=2))


def as_plain(calibration: Calibration) -> dict[str, Any]:
    """The calibration file's content, and the attitudes that were taken."""
    from margcal.files.calfile import dumps

    content = json.loads(dumps(calibration))
    settings = calibration.settings
    content["attitudes"] = {
        "mode": settings.get("attitudes"),
        "text": settings.get("attitudes_text"),
        "figures": dict(settings.get("attitudes_figures") or {}),
        "n_rests": None if calibration.poses is None else len(calibration.poses),
    }
    return content
