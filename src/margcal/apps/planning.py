"""`margcal plan`: which attitudes to record, from nothing or after recordings; printed, drawn, and as JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from margcal.apps import screen
from margcal.apps.calibrating import parse_sensors, read_one
from margcal.apps.outputs import check_outputs
from margcal.core import so3
from margcal.core.errors import UsageError
from margcal.core.types import Array
from margcal.core.units import KINDS
from margcal.workflow.plan import Plan, Step, plan, plan_more
from margcal.workflow.plan_start import DIP, Hands
from margcal.workflow.plan_words import side, turn_words

UNKNOWN_DEG = 10.0
"""An expected error above this means that the sensor is not determined."""


def run(
    recordings: Sequence[str],
    *,
    hands: Hands | None,
    number: int | None,
    sensors: str | None,
    at: str | None,
    output: str | None,
    overwrite: bool,
    as_json: bool,
    reading: Mapping[str, Any],
) -> int:
    """The verb."""
    if output is not None and Path(output).suffix.lower() != ".svg":
        raise UsageError(f"-o {output}: the drawing is an SVG file; call it {Path(output).stem}.svg")
    check_outputs([output], recordings, overwrite)
    wanted = parse_sensors(sensors)
    place = None
    if at is not None:
        from margcal.workflow.place import parse_at

        place = parse_at(at)
    dip = DIP if place is None else float(np.radians(place.field.dip_deg))
    read_in = [read_one(path, reading) for path in recordings]
    with screen.progress("planning"):
        if read_in:
            made = plan_more(*read_in, hands=hands, n=number, dip=dip, sensors=wanted, place=place)
        else:
            made = plan(hands or "box", **({} if number is None else {"n": number}), sensors=wanted or KINDS, dip=dip)
    if output is not None:
        from margcal.apps.planning_svg import drawing
        from margcal.files.atomic import atomic_path

        with atomic_path(output, overwrite=overwrite) as path:
            path.write_text(drawing(made), encoding="utf-8")
    if as_json:
        print(json.dumps(_as_plain(made, [r.source for r in read_in], output), indent=2))
    else:
        _show(made, [r.source for r in read_in], output)
    return 0


def shown(plan: Plan, R: Array) -> Array:
    """`R` as seen from in front of the box's table."""
    return so3.exp(np.array([0.0, 0.0, -plan.heading])) @ R


def _show(made: Plan, sources: Sequence[str], written: str | None) -> None:
    screen.line(_conclusion(made, sources))
    for issue in made.issues:
        if issue.level == "fail":
            screen.line(f"not yet: {issue.text}")
    screen.line()
    if made.last is not None:
        last = shown(made, made.last)
        front = f", {side(last[1])} to the front" if made.hands == "box" else ""
        screen.line(f"the node lies as in its last rest, {side(last[2])} up{front}")
    rows = [_row(made, i + 1, step) for i, step in enumerate(made.steps)]
    kinds = list(made.after_deg)
    head = ["", "up", *(["front"] if made.hands == "box" else []), "turn about the node's own axes"]
    first = len(head)
    header = [*head, *(f"{k} deg" for k in kinds)]
    screen.table(header, rows, right=(0, *range(first, first + len(kinds))))
    screen.line()
    if made.hands == "box":
        screen.line("front: the side that faces one fixed direction of the room, the same in all rests")
    screen.line("deg: expected direction error of each sensor once that rest is recorded")
    screen.line("Two seconds or more at rest, hands off; turn slowly, all of it in one recording, away from iron.")
    if written is not None:
        screen.line(f"written: {written}")


def _conclusion(made: Plan, sources: Sequence[str]) -> str:
    n = len(made.steps)
    what = "box put down on its faces" if made.hands == "box" else "node held or propped up in any attitude"
    if not sources:
        return f"{n} attitudes of a {what}: expected error {_errors(made.after_deg)}"
    if not made.before_deg or made.calibration is None or not made.calibration.models:
        return f"{', '.join(sources)}: nothing could be calibrated; {n} attitudes of a {what} to record"
    before, after = _errors(made.before_deg), _errors(made.after_deg)
    return f"{', '.join(sources)}: the next {n} attitudes take the expected error from {before} to {after}"


def _errors(errors: Mapping[Any, float]) -> str:
    return ", ".join(f"{k} {_degrees(v)}" for k, v in errors.items()) + " deg"


def _degrees(value: float) -> str:
    return f"over {UNKNOWN_DEG:.0f}" if value > UNKNOWN_DEG else f"{value:.2g}" if value >= 0.01 else f"{value:.1g}"


def _row(made: Plan, number: int, step: Step) -> list[str]:
    R = shown(made, step.R)
    front = [side(R[1])] if made.hands == "box" else []
    turn = "start" if step.turn is None else turn_words(step.turn)
    return [str(number), side(R[2]), *front, turn, *(_degrees(v) for v in step.errors_deg.values())]


def _as_plain(made: Plan, sources: Sequence[str], written: str | None) -> dict[str, Any]:
    """For programs: attitudes as quaternions (housing to laboratory, z up, scalar first) and in words."""
    calibration = made.calibration
    return {
        "recordings": list(sources),
        "hands": made.hands,
        "before_deg": dict(made.before_deg),
        "after_deg": dict(made.after_deg),
        "last": None if made.last is None else _attitude(made, made.last),
        "poses": [_step(made, i + 1, step) for i, step in enumerate(made.steps)],
        "verdict": None if calibration is None else calibration.verdict,
        "issues": [asdict(i) for i in made.issues],
        "written": written,
    }


def _attitude(made: Plan, R: Array) -> dict[str, Any]:
    seen = shown(made, R)
    return {
        "up": side(seen[2]),
        "front": side(seen[1]),
        "up_vector": [round(float(v), 6) for v in seen[2]],
        "q_wxyz": [round(float(v), 9) for v in so3.quat_from_matrix(seen)],
    }


def _step(made: Plan, number: int, step: Step) -> dict[str, Any]:
    turn = None
    if step.turn is not None:
        angle = float(np.linalg.norm(step.turn))
        axis = step.turn / angle if angle > 0 else step.turn
        words = turn_words(step.turn)
        turn = {"axis": [round(float(v), 6) for v in axis], "angle_deg": float(np.degrees(angle)), "text": words}
    errors = {k: float(v) for k, v in step.errors_deg.items()}
    return {"number": number, **_attitude(made, step.R), "turn": turn, "expected_error_deg": errors}
