"""`margcal simulate`: a recording of a node that does not exist, with the truth beside it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from margcal.apps import screen
from margcal.apps.calibrating import parse_sensors
from margcal.core.errors import InputError
from margcal.core.units import KINDS
from margcal.workflow.simulate import Simulation, simulate, swing, write_simulation


def run(
    *,
    output: str,
    poses: str,
    sensors: str | None,
    at: str | None,
    board: bool,
    overwrite: bool,
    as_json: bool,
    rests: Mapping[str, Any],
    node: Mapping[str, Any],
) -> int:
    """The verb; `rests` are options of `simulate` alone, `node` those of `swing` too; None: the default."""
    options = {k: v for k, v in node.items() if v is not None}
    if (wanted := parse_sensors(sensors)) is not None:
        options["sensors"] = wanted
    if at is not None:
        from margcal.workflow.place import parse_at

        options["place"] = parse_at(at)
    if board:
        options["mag_axes"] = "board"
    if poses == "swing":
        made = swing(**options)
    else:
        made = simulate(poses=poses, **options, **{k: v for k, v in rests.items() if v is not None})  # type: ignore[arg-type]
    _check_folder(output)
    session, table, truth = write_simulation(made, output, overwrite=overwrite)
    written = {"recording": str(session), "poses": str(table), "truth": str(truth)}
    if not len(made.start):
        del written["poses"]
    if as_json:
        print(json.dumps({"rests": len(made.start), "seconds": _span(made), "written": written}, indent=2))
        return 0
    what = f"{len(made.start)} rests" if len(made.start) else "a swing"
    screen.line(f"simulated {what}, {_span(made):.0f} s, {', '.join(made.recording.streams)}")
    for name, path in written.items():
        screen.line(f"written: {path} ({name})")
    return 0


CAMERAS = {
    "acceleration_rms": 1.5,
    "offset_s": 0.25,
    "drift_ppm": 40.0,
    "delays_s": {"mag": 0.01},
    "gaps": 4,
}
"""What `--poses mocap` simulates: a hand's motion, clocks that differ, a late magnetometer, a body out of sight."""


def run_mocap(*, output: str, sensors: str | None, overwrite: bool, as_json: bool, **node: Any) -> int:
    """`--poses mocap`: a node moved about in front of cameras; for `align`, `orient` and `evaluate`."""
    from margcal.workflow.mocap_simulation import simulate_mocap, write_mocap

    options = {k: v for k, v in node.items() if v is not None}
    if (wanted := parse_sensors(sensors)) is not None:
        options["sensors"] = wanted
    if "gyr" not in options.get("sensors", KINDS):
        raise InputError("--poses mocap needs a gyroscope; name gyr in --sensors")
    made = simulate_mocap(**options, **CAMERAS)
    _check_folder(output)
    paths = write_mocap(made, output, overwrite=overwrite)
    written = dict(zip(("recording", "reference", "truth"), map(str, paths)))
    span = float(next(iter(made.recording.streams.values())).t[-1])
    if as_json:
        print(json.dumps({"seconds": span, "written": written}, indent=2))
        return 0
    screen.line(f"simulated a node in front of cameras, {span:.0f} s, {', '.join(made.recording.streams)}")
    for name, path in written.items():
        screen.line(f"written: {path} ({name})")
    return 0


def _check_folder(output: str) -> None:
    if Path(output).exists() and not Path(output).is_dir():
        raise InputError(f"{output}: is a file; give the name of a folder")


def _span(made: Simulation) -> float:
    return max(float(s.t[-1]) for s in made.recording.streams.values())
