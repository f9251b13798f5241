"""`margcal align`: a node's recording and a motion-capture recording in, an aligned and calibrated node out."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from margcal.apps import screen
from margcal.apps.calibrating import as_plain, parse_sensors, read_one, write_results
from margcal.apps.outputs import check_outputs
from margcal.core import so3
from margcal.core.errors import DataError, InputError
from margcal.core.types import Calibration, Issue, Recording, Reference
from margcal.workflow.align import align
from margcal.workflow.align_job import MocapAlignment

NAMES = {"acc": "accelerometer", "gyr": "gyroscope", "mag": "magnetometer"}


def run(
    recording: str,
    *,
    reference: str,
    static: str | None,
    common_clock: bool,
    markers: str | None,
    marker_unit: str | None,
    sensors: str | None,
    at: str | None,
    output: str | None,
    report: str | None,
    allow_fail: bool,
    overwrite: bool,
    as_json: bool,
    reading: Mapping[str, Any],
    options: Mapping[str, Any],
) -> int:
    """The verb; `reading` goes to `read`, `options` (method, gravity, field ...) to `align`.

    Returns
    -------
    int
        Exit status: 0, or 3 where the data cannot carry what was asked.
    """
    inputs = [recording, reference, *([static] if static else [])]
    check_outputs([output, report], inputs, overwrite)
    asked: dict[str, Any] = {**options, "sensors": parse_sensors(sensors)}
    if at is not None:
        from margcal.workflow.place import parse_at

        asked["place"] = parse_at(at)
    node = read_one(recording, reading)
    own = os.path.realpath(recording) == os.path.realpath(reference)
    if own and node.reference is None:
        raise InputError(f"{node.source}: holds no reference (ref_qw ref_qx ref_qy ref_qz); name the file that does")
    asked["reference"] = node.reference if own else _reference(reference, markers, marker_unit)
    asked["common_clock"] = own or common_clock
    if static is not None:
        asked["static"] = read_one(static, reading)
    calibration, failure = _aligned(node, asked)
    calibration = _with_files(calibration, inputs)
    keep = calibration.models and (failure is None or allow_fail)
    written = write_results(calibration, output if keep else None, report, overwrite)
    if as_json:
        print(
            json.dumps(
                {**as_json_values(calibration), "written": written, "exit_status": 3 if failure else 0}, indent=2
            )
        )
    else:
        _show(calibration, written, failure is not None)
    if failure is not None:
        kept = "" if output is None or allow_fail else f"; {output} was not written (--allow-fail writes it)"
        screen.error(f"{failure.rstrip('.')}{kept}")
        return 3
    return 0


def _reference(path: str, markers: str | None, unit: str | None) -> Reference:
    from margcal.files.references import read_reference

    names = [n.strip() for n in markers.split(",") if n.strip()] if markers else None
    with screen.progress(f"reading {Path(path).name}"):
        return read_reference(path, markers=names, unit=unit)


def _aligned(node: Recording, asked: Mapping[str, Any]) -> tuple[Calibration, str | None]:
    """The calibration and why it failed; where it failed, what there is all the same."""
    from margcal.files.calfile import created_now

    failure: str | None = None
    with screen.progress("aligning") as tick:
        try:
            found = align(node, **asked, tick=tick)
        except DataError as refused:
            failure = str(refused)
            try:
                found = align(node, **asked, allow_fail=True, tick=tick)
            except DataError:  # refused before any sensor was looked at
                reasons = refused.issues or (Issue("refused", "fail", str(refused)),)
                issues = (*node.issues, *reasons)
                found = Calibration(device=asked.get("device"), verdict="fail", issues=issues, recordings=(node,))
    if failure is None and found.verdict == "fail":
        failure = "the verdict is fail: " + "; ".join(i.text for i in found.issues if i.level == "fail")
    return replace(found, created=created_now()), failure


def _with_files(calibration: Calibration, inputs: list[str]) -> Calibration:
    from margcal.files.calfile import digests

    found = [f for r in calibration.recordings for f in r.files]
    extra = [p for p in inputs if Path(p).is_file()]
    paths = {os.path.realpath(p): p for p in [*found, *extra]}
    return replace(calibration, files=digests(paths.values()))


# --- what people and programs see -------------------------------------------------------------------


def as_json_values(calibration: Calibration) -> dict[str, Any]:
    """The calibration file's content, and the orientation error before and after."""
    content = as_plain(calibration)
    content.pop("attitudes", None)
    alignment = calibration.alignment
    if isinstance(alignment, MocapAlignment) and alignment.figures is not None:
        figures = alignment.figures
        content["synchronisation"] = {"correlation": figures.peak, "rate_explained": figures.explained}
        for name, errors in (("orientation_before", figures.before), ("orientation_after", figures.after)):
            content[name] = (
                None
                if errors is None
                else {
                    "total_deg": errors.total,
                    "heading_deg": errors.heading,
                    "inclination_deg": errors.inclination,
                    "text": errors.text,
                }
            )
    return content


def _show(calibration: Calibration, written: dict[str, str], failed: bool) -> None:
    from margcal.apps.printing import show_calibration, show_written

    show_alignment(calibration)
    show_calibration(calibration)
    show_written(written, hint=not failed)


def show_alignment(calibration: Calibration) -> None:
    """Clocks, delays, frames and the orientation error in a table."""
    alignment = calibration.alignment
    if alignment is None:
        return
    rows = [*_clock_rows(calibration), *_frame_rows(calibration)]
    if isinstance(alignment, MocapAlignment) and alignment.figures is not None:
        figures = alignment.figures
        rows.insert(0, ["method", figures.method, "", ""])
        rows.insert(1, ["correlation of the angular rates", f"{figures.peak:.4f}", "", ""])
        for name, errors in (("without", figures.before), ("with", figures.after)):
            if errors is not None:
                value = f"{errors.total:.2f} (heading {errors.heading:.2f}, inclination {errors.inclination:.2f})"
                rows.append([f"orientation error {name} the calibration", value, "", "deg rms"])
    screen.table(["alignment", "value", "standard error", "unit"], rows)
    screen.line()


def _clock_rows(calibration: Calibration) -> list[list[str]]:
    alignment = calibration.alignment
    if alignment is None:
        return []
    values, rows = alignment.values, []
    if alignment.common_clock:
        rows.append(["clock", "common", "", ""])
    else:
        rows.append(["clock offset", f"{1e3 * values['offset_s']:.3f}", f"{1e3 * values['offset_s_se']:.3f}", "ms"])
        rows.append(["clock drift", f"{values['drift_ppm']:.2f}", f"{values['drift_ppm_se']:.2f}", "ppm"])
    for kind, model in calibration.models.items():
        if model.delay_s is not None and not (kind == "gyr" and not alignment.common_clock):
            error = "-" if model.delay_se_s is None else f"{1e3 * model.delay_se_s:.2f}"
            rows.append([f"delay of the {NAMES[kind]}", f"{1e3 * model.delay_s:.2f}", error, "ms"])
    return rows


def _frame_rows(calibration: Calibration) -> list[list[str]]:
    alignment = calibration.alignment
    values = {} if alignment is None else alignment.values
    rows = []
    for name, text in (("marker_to_node", "marker body to node"), ("lab_to_earth", "laboratory to earth")):
        if name in values:
            angles = np.degrees(so3.quat_log(np.array(values[name])))
            errors = values.get(f"{name}_se")
            se = "-" if errors is None else _triple(np.degrees(errors), 3)
            rows.append([text, _triple(angles, 3), se, "deg about x, y, z"])
    if "lever_arm_m" in values:
        errors = values.get("lever_arm_m_se")
        se = "-" if errors is None else _triple(1e3 * np.array(errors), 2)
        rows.append(["lever arm (marker body's axes)", _triple(1e3 * np.array(values["lever_arm_m"]), 1), se, "mm"])
    return rows


def _triple(values: Any, digits: int) -> str:
    return " ".join(f"{v:.{digits}f}" for v in np.asarray(values))
