"""`margcal segment`: the rests of a recording, as a table that becomes a poses file once attitudes are filled in."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from margcal.apps import screen
from margcal.apps.calibrating import read_one
from margcal.apps.outputs import check_outputs
from margcal.core.types import Poses, Recording
from margcal.workflow.segment import Segmentation, find_poses


def run(
    recordings: Sequence[str], *, output: str | None, overwrite: bool, as_json: bool, reading: Mapping[str, Any]
) -> int:
    """The verb; exit status 3 where there are no rests."""
    check_outputs([output], recordings, overwrite)
    read_in = [read_one(path, reading) for path in recordings]
    with screen.progress("looking for rests"):
        found = find_poses(*read_in)
    if len(found.poses) and output is not None:
        from margcal.files.tables import write_table

        write_table(output, rest_table(found.poses, read_in), overwrite=overwrite)
    written = output if len(found.poses) else None
    if as_json:
        print(json.dumps(_as_plain(found, read_in, written), indent=2))
    else:
        _show(found, read_in, written)
    if not len(found.poses):
        screen.error(
            "no rests of one second or longer: put the node down, hands off, for two seconds or more in each "
            "attitude (a magnetometer that was waved about needs none: calibrate --poses swing)"
        )
        return 3
    return 0


def rest_table(poses: Poses, recordings: Sequence[Recording]) -> dict[str, Any]:
    """Columns of the table: times, attitude to be filled in, knocks, and mean, scatter and count of each sensor.

    A recording with reference attitudes has them filled in (`qw` to `qz`); otherwise `up` and `front` are empty.
    """
    columns: dict[str, Any] = {}
    if len(recordings) > 1:
        columns["file"] = [recordings[i].source for i in poses.recording]
    columns |= {"start_s": poses.start, "stop_s": poses.stop}
    if poses.q_ref is not None and np.isfinite(poses.q_ref).all():
        columns |= {f"q{c}": poses.q_ref[:, i] for i, c in enumerate("wxyz")}
    else:
        columns |= {"up": [None] * len(poses), "front": [None] * len(poses)}
    columns["knocks"] = poses.knocks.astype(int)
    for kind in poses.mean:
        unit = next(r.units[kind] for r in recordings if kind in r.units)
        for i, axis in enumerate("xyz"):
            columns[f"{kind}_{axis}_{unit}"] = poses.mean[kind][:, i]
        for i, axis in enumerate("xyz"):
            columns[f"{kind}_{axis}_{unit}_sd"] = poses.sd[kind][:, i]
        columns[f"{kind}_n"] = poses.count[kind].astype(int)
    return columns


def _show(found: Segmentation, recordings: Sequence[Recording], written: str | None) -> None:
    from margcal.apps.printing import show_issues, show_rests

    n, sources = len(found.poses), [r.source for r in recordings]
    screen.line(f"{n} rests, {len(found.turns)} turns between them in {', '.join(sources)}")
    if n:
        show_rests(found.poses, sources)
    show_issues([*(i for r in recordings for i in r.issues), *found.issues])
    if written is not None:
        screen.line()
        screen.line(f"written: {written}; fill in `up` (and `front`) or qw qx qy qz for calibrate --poses {written}")


def _as_plain(found: Segmentation, recordings: Sequence[Recording], written: str | None) -> dict[str, Any]:
    columns = rest_table(found.poses, recordings)
    rows = [{name: _plain(values[j]) for name, values in columns.items()} for j in range(len(found.poses))]
    return {
        "recordings": [r.source for r in recordings],
        "rests": rows,
        "turns": [{"before": t.before, "after": t.after, "samples": len(t.t)} for t in found.turns],
        "issues": [asdict(i) for i in (*(i for r in recordings for i in r.issues), *found.issues)],
        "written": written,
    }


def _plain(value: Any) -> Any:
    """A JSON value; NaN (not measured) is null."""
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not np.isfinite(value) else value
