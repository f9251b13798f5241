"""`margcal simulate`: a recording of a node that does not exist, with the truth beside it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from margcal.apps import screen
from margcal.apps.calibrating import parse_sensors
from margcal.core.errors import InputError
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
    if Path(output).exists() and not Path(output).is_dir():
        raise InputError(f"{output}: is a file; give the name of a folder")
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


def _span(made: Simulation) -> float:
    return max(float(s.t[-1]) for s in made.recording.streams.values())
