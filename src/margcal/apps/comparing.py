"""`margcal compare`: several calibrations of one node held against each other (Z-TIE Fig. 7, ZY-TBME Figs. 3 and 4)."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from margcal.apps import screen
from margcal.apps.outputs import check_outputs
from margcal.apps.papers.figures import COLOURS, Curve, Panel, figure
from margcal.apps.printing import NAMES
from margcal.apps.printing import figure as digits
from margcal.apps.report_text import plain_unit
from margcal.core.checking import printable
from margcal.core.errors import InputError, UsageError
from margcal.core.types import Array, Calibration, Kind, SensorModel
from margcal.core.units import KINDS
from margcal.workflow.metrics import Repeatability, repeatability, spread_of

PARAMETERS = ("B x", "B y", "B z", *(f"H {a}{b}" for a in "xyz" for b in "xyz"))

CLAIM = 2.0
"""Observed over stated scatter from which calibrations are said to differ more than they claim."""


def run(files: Sequence[str], *, output: str | None, overwrite: bool, as_json: bool) -> int:
    """The verb: at least two calibration files of one node, in one frame and in the same units."""
    from margcal.files.calfile import load

    check_outputs([output], files, overwrite)
    _refuse_few(files)
    names = _short_names(files)
    found = compare([load(f) for f in files], names)
    if output is not None:
        _write(found, names, Path(output), overwrite)
    if as_json:
        print(json.dumps(as_plain(found, names), indent=1, ensure_ascii=False, allow_nan=False))
        return 0
    _show(found, names)
    screen.line()
    if output is None:
        screen.line("nothing was written (-o DIR keeps the figures and draws them)")
    else:
        screen.line(f"written to {output}: {', '.join(_files_of(found))}")
    return 0


def _refuse_few(files: Sequence[str]) -> None:
    if len(files) < 2:
        raise UsageError("compare takes two calibration files or more")
    seen: dict[str, str] = {}
    for name in files:
        real = os.path.realpath(name)
        if real in seen:
            raise UsageError(f"{name} is given twice; each calibration counts once")
        seen[real] = name


def _short_names(files: Sequence[str]) -> list[str]:
    """File names, with as much of their folders as it takes to tell them apart."""
    paths = [Path(f) for f in files]
    for depth in range(1, max(len(p.parts) for p in paths) + 1):
        names = [str(Path(*p.parts[-depth:])) for p in paths]
        if len(set(names)) == len(names):
            return [printable(n, 60) for n in names]
    return [printable(f, 60) for f in files]


def compare(calibrations: Sequence[Calibration], names: Sequence[str]) -> dict[Kind, tuple[Repeatability, list[str]]]:
    """`Repeatability` of every sensor that two calibrations or more have, and the names of those that have it.

    Raises
    ------
    InputError
        Where frames, units or handedness differ, or no sensor is in two of them.
    """
    for calibration, name in zip(calibrations[1:], names[1:]):
        if calibration.frame != calibrations[0].frame:
            raise InputError(
                f"{names[0]} is in frame {calibrations[0].frame} and {name} in frame {calibration.frame}; their "
                "numbers compare only after the rotation between the frames: calibrate both with the same --poses"
            )
    found: dict[Kind, tuple[Repeatability, list[str]]] = {}
    for kind in KINDS:
        there = [(c.models[kind], n) for c, n in zip(calibrations, names) if kind in c.models]
        if len(there) > 1:
            models: list[SensorModel] = [m for m, _ in there]
            theirs = [n for _, n in there]
            found[kind] = repeatability(models, theirs), theirs
    if not found:
        raise InputError("no sensor is in two of these calibrations; there is nothing to compare")
    return found


# --- on the screen ------------------------------------------------------------------------------------


def _rows(r: Repeatability) -> list[tuple[str, Array, float | None]]:
    """Name, values (n,) and stated standard error of each parameter: three of B, nine of H."""
    claimed_B = [None] * 3 if r.claimed_B is None else r.claimed_B.tolist()
    claimed_H = [None] * 9 if r.claimed_H is None else r.claimed_H.ravel().tolist()
    values = np.concatenate([r.B, r.H.reshape(r.n, 9)], axis=1)
    return [(name, values[:, i], c) for i, (name, c) in enumerate(zip(PARAMETERS, [*claimed_B, *claimed_H]))]


def _show(found: Mapping[Kind, tuple[Repeatability, list[str]]], names: Sequence[str]) -> None:
    screen.line(f"{len(names)} calibrations: {', '.join(names)}")
    for kind, (r, theirs) in found.items():
        screen.line()
        less = "" if len(theirs) == len(names) else f" ({len(theirs)} of {len(names)} files: {', '.join(theirs)})"
        screen.line(f"{NAMES[kind]}, B in {r.raw_unit}, H in {r.unit} per {r.raw_unit}{less}", style="bold")
        rows = []
        for name, values, claimed in _rows(r):
            s = spread_of(values)
            stated = "-" if claimed is None or not claimed else digits(claimed, 2)
            rows.append([name, digits(float(s.mean), 7), digits(float(s.sd), 2), digits(float(s.span), 2), stated])
        screen.table(["", "mean", "sd", "largest - smallest", "stated se"], rows, right=(1, 2, 3, 4))
        for text in _words(r):
            screen.line(f"  {text}")


def _words(r: Repeatability) -> list[str]:
    sd = r.scatter
    out = [
        f"{len(r.raw)} readings of {digits(r.magnitude, 4)} {r.unit} converted by each: sd {digits(_rms(sd), 2)} "
        f"{r.unit} a component (rms), {digits(float(sd.max()), 2)} at most",
        f"direction: {digits(r.angle_rms_deg, 2)} deg between them (rms sd)"
        + ("" if r.expected_error_deg is None else f"; they state {digits(r.expected_error_deg, 2)} deg"),
    ]
    over = r.over_claimed
    if over is not None:
        verdict = "as they state" if over <= CLAIM else "MORE than they state: something changed between them"
        out.append(f"sd over stated standard error, rms of the parameters: {digits(over, 2)} ({verdict})")
    return out


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


# --- as files -----------------------------------------------------------------------------------------


def as_plain(found: Mapping[Kind, tuple[Repeatability, list[str]]], names: Sequence[str]) -> dict[str, Any]:
    """For JSON."""
    sensors: dict[str, Any] = {}
    for kind, (r, theirs) in found.items():
        B, H, u = spread_of(r.B), spread_of(r.H), spread_of(r.converted)
        sensors[kind] = {
            "files": theirs,
            "raw_unit": r.raw_unit,
            "unit": r.unit,
            "B": {"values": r.B.tolist(), "mean": B.mean.tolist(), "sd": B.sd.tolist(), "spread": B.span.tolist()},
            "H": {"values": r.H.tolist(), "mean": H.mean.tolist(), "sd": H.sd.tolist(), "spread": H.span.tolist()},
            "stated_se": None
            if r.claimed_B is None or r.claimed_H is None
            else {"B": r.claimed_B.tolist(), "H": r.claimed_H.tolist()},
            "sd_over_stated_se": r.over_claimed,
            "readings": {
                "raw": r.raw.tolist(),
                "converted": r.converted.tolist(),
                "mean": u.mean.tolist(),
                "sd": u.sd.tolist(),
            },
            "direction_sd_deg": r.angle_rms_deg,
            "expected_error_deg": r.expected_error_deg,
        }
    return {"files": list(names), "sensors": sensors}


def _files_of(found: Mapping[Kind, tuple[Repeatability, list[str]]]) -> list[str]:
    pictures = [f"{kind}-{what}.svg" for kind in found for what in ("parameters", "readings")]
    return ["compare.json", "parameters.csv", "readings.csv", *pictures]


def _write(
    found: Mapping[Kind, tuple[Repeatability, list[str]]], names: Sequence[str], folder: Path, overwrite: bool
) -> None:
    from margcal.files.atomic import atomic_folder
    from margcal.files.writing import write_table

    with atomic_folder(folder, overwrite=overwrite) as place:
        text = json.dumps(as_plain(found, names), indent=1, ensure_ascii=False, allow_nan=False)
        (place / "compare.json").write_text(text + "\n", encoding="utf-8")
        write_table(place / "parameters.csv", _parameter_columns(found))
        write_table(place / "readings.csv", _reading_columns(found))
        for kind, (r, theirs) in found.items():
            (place / f"{kind}-parameters.svg").write_text(parameter_picture(r, theirs), encoding="utf-8")
            (place / f"{kind}-readings.svg").write_text(reading_picture(r, theirs), encoding="utf-8")


def _parameter_columns(found: Mapping[Kind, tuple[Repeatability, list[str]]]) -> dict[str, list[Any]]:
    out: dict[str, list[Any]] = {k: [] for k in ("sensor", "file", "parameter", "unit", "value", "mean", "sd")}
    for kind, (r, theirs) in found.items():
        for name, values, _ in _rows(r):
            s = spread_of(values)
            for file, value in zip(theirs, values):
                unit = r.raw_unit if name.startswith("B") else f"{r.unit} per {r.raw_unit}"
                row = (kind, file, name, unit, float(value), float(s.mean), float(s.sd))
                for column, cell in zip(out, row):
                    out[column].append(cell)
    return out


def _reading_columns(found: Mapping[Kind, tuple[Repeatability, list[str]]]) -> dict[str, list[Any]]:
    out: dict[str, list[Any]] = {k: [] for k in ("sensor", "reading", "axis", "unit", "raw", "mean", "sd")}
    for kind, (r, _) in found.items():
        s = spread_of(r.converted)
        for j in range(len(r.raw)):
            for i, axis in enumerate("xyz"):
                row = (kind, j + 1, axis, r.unit, float(r.raw[j, i]), float(s.mean[j, i]), float(s.sd[j, i]))
                for column, cell in zip(out, row):
                    out[column].append(cell)
    return out


def parameter_picture(r: Repeatability, names: Sequence[str]) -> str:
    """Z-TIE Fig. 7, ZY-TBME Fig. 3: what each calibration says of B and H, as departures from their mean.

    The values themselves would lie on one another; H is drawn relative to its size, the length of its columns.
    """
    dB = r.B - r.B.mean(axis=0)
    mean = r.H.mean(axis=0)
    dH = 100 * (r.H - mean) / np.sqrt(np.mean(np.sum(mean**2, axis=0)))
    bias = Panel(
        "combined bias",
        "component",
        f"B - mean, {plain_unit(r.raw_unit)}",
        _beside(dB, names),
        x_names=("x", "y", "z"),
        x_range=(-0.5, 2.5),
        zero_line=True,
        legend=r.n <= 6,
    )
    matrix = Panel(
        "transformation matrix",
        "element",
        "H - mean, % of a column's length",
        _beside(dH.reshape(r.n, 9), names),
        x_names=tuple(f"{a}{b}" for a in "xyz" for b in "xyz"),
        x_range=(-0.5, 8.5),
        zero_line=True,
        legend=False,
    )
    return figure(f"{NAMES[r.kind]}: B and H of {r.n} calibrations", [bias, matrix], width=520)


def _beside(values: Array, names: Sequence[str]) -> tuple[Curve, ...]:
    """Dots of each calibration, a little beside each other."""
    n, count = values.shape
    shift = np.linspace(-0.28, 0.28, n)
    return tuple(
        Curve(
            _label(names[i], n),
            np.arange(count) + shift[i],
            values[i],
            COLOURS[i % len(COLOURS)],
            dots=True,
            line=False,
        )
        for i in range(n)
    )


def _label(name: str, n: int) -> str:
    """Short enough for a line of `n` names."""
    room = max(60 // n, 6)
    stem = name.removesuffix(".json")
    return stem if len(stem) <= room else stem[: room - 1] + "…"


def reading_picture(r: Repeatability, names: Sequence[str]) -> str:
    """ZY-TBME Fig. 4: raw readings converted by each calibration (left), and their scatter (right)."""
    unit, index = plain_unit(r.unit), np.arange(1, len(r.raw) + 1, dtype=float)
    dots = tuple(
        Curve(axis if i == 0 else "", index, r.converted[i, :, k], COLOURS[k], dots=True, line=False)
        for i in range(r.n)
        for k, axis in enumerate("xyz")
    )
    left = Panel("converted by each calibration", "reading", f"u, {unit}", dots)
    sd = r.scatter
    right = Panel(
        "standard deviation over the calibrations",
        "reading",
        f"sd, {unit}",
        tuple(Curve(axis, index, sd[:, k], COLOURS[k], dots=True, line=False) for k, axis in enumerate("xyz")),
        y_range=(0.0, 1.15 * float(sd.max()) or 1.0),
    )
    return figure(f"{NAMES[r.kind]}: {len(r.raw)} raw readings, {r.n} calibrations", [left, right], width=520)
