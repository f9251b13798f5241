"""`margcal orient`: the attitude of a node through a recording, as a table."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from margcal.apps import screen
from margcal.apps.outputs import check_outputs
from margcal.core.errors import UsageError
from margcal.files.tables import read
from margcal.files.writing import check_suffix, write_table
from margcal.workflow.orient import orient

if TYPE_CHECKING:
    from margcal.workflow.orient import Orientation


def run(
    recording: str,
    *,
    output: str,
    calibration: str | None,
    filter: str,
    frame: str,
    delays: str,
    no_mag: bool,
    start: str | None,
    gyro_bias: str,
    reading: dict[str, Any],
    overwrite: bool,
    as_json: bool,
) -> int:
    """The verb."""
    check_outputs([output], [recording] if calibration is None else [recording, calibration], overwrite)
    check_suffix(Path(output))
    q0 = _quaternion(start)
    model = None
    if calibration is not None:
        from margcal.files.calfile import load

        model = load(calibration)
    with screen.progress(f"reading {Path(recording).name}") as tick:
        table = read(recording, **reading, progress=tick)
    with screen.progress(f"orienting with {filter}") as tick:
        found = orient(
            table,
            model,
            filter=filter,
            frame=frame,  # type: ignore[arg-type]
            delays=delays,  # type: ignore[arg-type]
            mag=not no_mag,
            q0=q0,
            gyro_bias=gyro_bias,  # type: ignore[arg-type]
            progress=tick,
        )
    write_table(output, _columns(found), overwrite=overwrite)
    if as_json:
        print(json.dumps(_summary(found, output), indent=2))
    else:
        _show(found, output)
    return 0


def _quaternion(text: str | None) -> Sequence[float] | None:
    if text is None:
        return None
    try:
        q = [float(v) for v in text.split(",")]
    except ValueError:
        q = []
    if len(q) != 4:
        raise UsageError(f"--start {text!r} is not W,X,Y,Z; expected such as 1,0,0,0")
    return q


def _columns(found: Orientation) -> dict[str, Any]:
    q = found.attitude.q
    return {"t_s": found.attitude.t, **{f"q{c}": q[:, k] for k, c in enumerate("wxyz")}}


def _summary(found: Orientation, output: str) -> dict[str, Any]:
    return {
        "filter": found.filter,
        "frame": found.frame,
        **found.figures,
        "params": dict(found.params),
        "issues": [{"code": i.code, "level": i.level, "sensor": i.sensor, "text": i.text} for i in found.issues],
        "written": output,
    }


def _show(found: Orientation, output: str) -> None:
    figures = found.figures
    screen.line(f"{figures['samples']} attitudes, {figures['seconds']:.6g} s, node to earth ({found.frame.upper()})")
    used = figures["used"]
    screen.line(
        f"filter:  {found.filter}; accelerometer used in {100 * used['acc']:.4g} %, magnetometer in "
        f"{100 * used['mag']:.4g} % of the samples"
    )
    if figures["field"] is not None:
        screen.line(f"field:   {figures['field']:.4g}, dip {figures['dip_deg']:.3g} deg (from this recording)")
    for kind, delay in figures["delays_s"].items():
        screen.line(f"delay:   {kind} {1e3 * delay:.2f} ms, corrected")
    if figures["end_sd_deg"] is not None:
        east, north, up = figures["end_sd_deg"]
        tilt = (0.5 * (east**2 + north**2)) ** 0.5
        screen.line(
            f"spread at the end by the filter's noise model: tilt {tilt:.2g}, heading {up:.2g} deg (1 sd; motion and "
            "bent fields come on top)"
        )
    for issue in found.issues:
        screen.line(f"{issue.level}: {issue.text}", style="yellow" if issue.level == "warn" else "")
    screen.line(f"written: {output}")
