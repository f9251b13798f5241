"""`margcal export` and `margcal import`: calibrations to and from the files of other programs."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from margcal.apps import screen
from margcal.apps.outputs import check_outputs
from margcal.apps.printing import NAMES, show_calibration
from margcal.core.checking import printable
from margcal.core.errors import InputError, UsageError
from margcal.core.units import KINDS, Kind
from margcal.files.atomic import atomic_path
from margcal.files.calfile import created_now, digests, load, program_now, save
from margcal.files.exchange.registry import TARGETS, find
from margcal.files.exchange.target import MAX_BYTES, Target
from margcal.workflow.export import KEPT, Export, angle, bias_words, export, percent, step_words
from margcal.workflow.export_check import Check, check_export
from margcal.workflow.importing import import_calibration


def run_export(
    calibration: str | None,
    *,
    to: str | None,
    output: str | None,
    sensors: str | None,
    scale: Mapping[str, float] | None,
    field: float | None,
    max_loss: float,
    allow_lossy: bool,
    move_frame: bool,
    check: bool,
    list_targets: bool,
    overwrite: bool,
    as_json: bool,
) -> int:
    """The verb `export`."""
    if list_targets:
        return _list(as_json)
    if calibration is None or to is None or output is None:
        raise UsageError("give CAL.json, --to TARGET and -o FILE; --list shows the targets")
    target = find(to)
    check_outputs([output], [calibration], overwrite)
    done = export(
        load(calibration),
        target,
        sensors=kinds_of(sensors) or None,
        scale=scale,
        field_uT=field,
        max_loss_deg=max_loss,
        allow_lossy=allow_lossy,
        move_frame=move_frame,
    )
    checks: tuple[Check, ...] = ()
    with atomic_path(output, overwrite=overwrite) as temporary:
        temporary.write_bytes(done.data)
        if check:  # a file that fails is not left behind
            with screen.progress(f"checking {Path(output).name}"):
                checks = check_export(done, temporary.read_bytes())
    if as_json:
        print(json.dumps(_document(done, checks, output), indent=2))
    else:
        _show(done, checks, output)
    return 0


def kinds_of(text: str | None) -> tuple[Kind, ...]:
    """``acc,mag`` as kinds.

    Raises
    ------
    UsageError
        For anything else.
    """
    names = [t.strip() for t in text.split(",")] if text else []
    if wrong := [n for n in names if n not in KINDS]:
        raise UsageError(f"{wrong[0]!r} is no sensor; --sensors takes acc, gyr and mag, with commas")
    return tuple(k for k in KINDS if k in names)


def carries(target: Target) -> dict[str, str]:
    """What a target holds of each sensor, in words."""
    out = {}
    for kind, form in target.forms.items():
        kept = KEPT[form.matrix]
        if form.movable and form.matrix != "full":
            kept += " (all with --move-frame)"
        out[kind] = kept + ("" if form.bias else ", no bias") if form.matrix != "unit" else "bias only"
    return out


def _list(as_json: bool) -> int:
    if as_json:
        rows = [
            {
                "name": t.name,
                "title": t.title,
                "suffix": t.suffix,
                "carries": carries(t),
                "formulas": {k: f.formula for k, f in t.forms.items()},
                "raw_units": {k: list(f.raw) or "any" for k, f in t.forms.items()},
                "units": {k: f.unit or "as calibrated" for k, f in t.forms.items()},
                "facts": t.facts,
                "remark": t.remark,
            }
            for t in TARGETS.values()
        ]
        print(json.dumps(rows, indent=2))
        return 0
    rows = [[t.name, t.title, "; ".join(f"{k} {v}" for k, v in carries(t).items())] for t in TARGETS.values()]
    screen.table(["--to, --from", "file", "carries"], rows)
    return 0


def _document(done: Export, checks: tuple[Check, ...], output: str) -> dict[str, Any]:
    sensors = {}
    for loss in done.losses:
        model = done.models[loss.kind]
        sensors[loss.kind] = {
            "keeps": KEPT[loss.kept],
            "bias": loss.bias,
            "raw_unit": model.raw_unit,
            "unit": model.unit,
            "direction_error_deg": {"rms": loss.rms_deg, "max": loss.max_deg},
            "length_error_percent": loss.length_percent,
            "board_orientation": loss.orientation,
            "bias_forgotten_deg": loss.without_bias_deg,
            "step": loss.step,
            "step_deg": loss.step_deg,
        }
    return {
        "target": done.target.name,
        "sensors": sensors,
        "left_out": list(done.left_out),
        "warnings": list(done.warnings),
        "frame_turn_deg": done.frame_turn_deg,
        "checks": [{"name": c.name, "passed": c.passed, "text": c.text, "value": c.value} for c in checks],
        "written": output,
    }


def _show(done: Export, checks: tuple[Check, ...], output: str) -> None:
    rows = []
    for loss in done.losses:
        model = done.models[loss.kind]
        length = "-" if loss.length_percent is None else percent(loss.length_percent)
        kept = KEPT[loss.kept] + ("" if loss.bias else ", no bias")
        units = f"{model.raw_unit} to {model.unit}"
        rows.append([NAMES[loss.kind], kept, units, angle(loss.rms_deg), angle(loss.max_deg), length])
    screen.table(["sensor", "keeps", "units", "direction error", "worst", "length error"], rows, right=(3, 4, 5))
    for loss in done.losses:
        if loss.orientation:
            screen.line(f"{loss.kind}: board orientation {loss.orientation}")
        if loss.step is not None:
            screen.line(step_words(loss, done.models[loss.kind].unit))
        if not loss.bias:
            screen.line(bias_words(loss, done.models[loss.kind]))
    if done.frame_turn_deg is not None:
        screen.line(f"the frame of the file is the node's turned by {done.frame_turn_deg:.4g} deg")
    if done.left_out:
        screen.line(f"left out, no place for it in this file: {', '.join(done.left_out)}")
    for text in done.warnings:
        screen.line(f"warn: {text}", style="yellow")
    for c in checks:
        screen.line(f"check: {c.text}", style="" if c.passed else "yellow")
    if done.target.remark:
        screen.line(f"note: {done.target.remark}", style="dim")
    screen.line(f"written: {output} ({done.target.title})")


def run_import(
    file: str,
    *,
    source: str,
    output: str,
    sensors: str | None,
    units: Mapping[str, str] | None,
    unit: Mapping[str, str] | None,
    scale: Mapping[str, float] | None,
    device: str | None,
    frame: str | None,
    overwrite: bool,
    as_json: bool,
) -> int:
    """The verb `import`."""
    from dataclasses import replace

    target = find(source)
    check_outputs([output], [file], overwrite)
    path = Path(file)
    try:
        with open(path, "rb") as opened:
            data = opened.read(MAX_BYTES + 1)
    except FileNotFoundError as error:
        raise InputError(f"{printable(file)}: there is no such file") from error
    except OSError as error:
        raise InputError(f"{printable(file)}: cannot be read ({error.strerror})") from error
    result = import_calibration(
        data,
        printable(path.name),
        target,
        sensors=kinds_of(sensors),
        units=units,
        unit=unit,
        scale=scale,
        device=device,
        frame=frame,
    )
    result = replace(result, files=digests([path]), created=created_now(), program=program_now())
    save(result, output, overwrite=overwrite)
    if as_json:
        issues = [{"code": i.code, "level": i.level, "sensor": i.sensor, "text": i.text} for i in result.issues]
        rows = {k: {"raw_unit": m.raw_unit, "unit": m.unit} for k, m in result.models.items()}
        print(json.dumps({"source": target.name, "sensors": rows, "issues": issues, "written": output}, indent=2))
    else:
        show_calibration(result)
        screen.line()
        screen.line("nothing is known of how good these numbers are: no verdict, no covariance")
        screen.line(f"written: {output} (calibration)")
    return 0
