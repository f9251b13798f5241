"""`margcal demo`: a simulated node calibrated without being told anything, and held against the truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from margcal.apps import screen
from margcal.core.errors import InputError
from margcal.core.types import Calibration, Kind, SensorModel
from margcal.methods.uncertainty import direction_errors_deg

OWN = ("session.parquet", "poses.csv", "truth.json", "calibration.json", "report.html")
"""The files of a demo; a folder that holds nothing else may be filled again."""

PLACE = "52.24,6.85,2026-06-01"
"""Where and when the simulated node is, for gravity and the magnetic field."""


def run(*, output: str, seed: int, overwrite: bool, as_json: bool) -> int:
    """The verb: simulate, calibrate from the files alone, compare, write, and say what to try next."""
    folder = Path(output)
    _check(folder, overwrite)
    with screen.progress("simulating and calibrating"):
        truth, found = _calibrated(folder, seed)
    written = _write(found, folder)
    compared: dict[Kind, dict[str, Any]] = {
        kind: _compare(found.models[kind], truth.models[kind]) for kind in found.models
    }
    if as_json:
        from margcal.apps.calibrating import print_json

        print_json(found, compared=compared, written=written, exit_status=0)
        return 0
    _show(found, compared, folder)
    return 0


def _check(folder: Path, overwrite: bool) -> None:
    """Refuse a folder in which something else than a demo lies."""
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file; give the name of a folder")
    others = sorted(p.name for p in folder.iterdir() if p.name not in OWN) if folder.is_dir() else []
    if others and not overwrite:
        more = f" and {len(others) - 1} more" if len(others) > 1 else ""
        raise InputError(
            f"{folder}: holds files that are not a demo's ({others[0]}{more}); choose another folder with -o, or give "
            "--overwrite to write beside them"
        )


def _calibrated(folder: Path, seed: int) -> tuple[Calibration, Calibration]:
    """Truth, and the calibration from session.parquet alone: poses.csv is written but not used."""
    from margcal.files.calfile import created_now, load
    from margcal.files.tables import read
    from margcal.workflow.calibrate import calibrate
    from margcal.workflow.place import parse_at
    from margcal.workflow.simulate import simulate, write_simulation

    place = parse_at(PLACE)
    made = simulate(seed=seed, place=place, mag_axes="board", knocks=2)
    session, _, truth = write_simulation(made, folder, overwrite=True)
    found = calibrate(read(session), place=place, device="demo")
    return load(truth), replace(found, created=created_now())


def _write(found: Calibration, folder: Path) -> dict[str, str]:
    from margcal.apps.report import write_report
    from margcal.files.calfile import save

    save(found, folder / "calibration.json", overwrite=True)
    write_report(found, folder / "report.html", overwrite=True)
    return {name.split(".")[0]: str(folder / name) for name in OWN}


def _compare(found: SensorModel, true: SensorModel) -> dict[str, Any]:
    """Truth beside estimate: direction over the sphere, bias (raw unit), scale factors (raw unit per SI unit)."""
    from margcal.methods.sensor_model import describe

    length = None
    if true.kind != "gyr" and true.reference_vector is not None:
        length = float(np.linalg.norm(true.reference_vector))
    angle = direction_errors_deg(found.H, found.B, true.H, true.B, length)
    return {
        "direction_error_deg": {"rms": float(np.sqrt(np.mean(angle**2))), "worst": float(angle.max())},
        "bias": {"true": true.B.tolist(), "found": found.B.tolist()},
        "scale_factor": {
            "true": list(describe(true).scale_factor),
            "found": list(describe(found).scale_factor),
            "unit": describe(true).scale_unit,
        },
    }


def _show(found: Calibration, compared: dict[Kind, dict[str, Any]], folder: Path) -> None:
    from margcal.apps.printing import NAMES, figure, show_attitudes, show_issues

    screen.line("A simulated node was put down in 24 attitudes and calibrated from its raw counts alone.")
    screen.line()
    show_attitudes(found)
    rows = []
    for kind, told in compared.items():
        unit = found.models[kind].raw_unit
        for name, key, where in (
            ("bias", "bias", unit),
            ("scale factor", "scale_factor", told["scale_factor"]["unit"]),
        ):
            for which in ("true", "found"):
                first = NAMES[kind] if key == "bias" and which == "true" else ""
                values = [figure(v, 6) for v in told[key][which]]
                rows.append([first, f"{name}, {which}", *values, where])
    screen.line()
    screen.table(["sensor", "truth beside estimate", "x", "y", "z", "unit"], rows, right=(2, 3, 4))
    rows = []
    for kind, told in compared.items():
        error, expected = told["direction_error_deg"], found.models[kind].expected_error_deg
        rows.append([NAMES[kind], f"{error['rms']:.3f}", f"{error['worst']:.3f}", figure(expected, 2)])
    screen.line()
    screen.table(["direction error over the sphere, deg", "rms", "worst", "expected"], rows, right=(1, 2, 3))
    show_issues(found.issues)
    screen.line()
    screen.line(f"written to {folder}: {', '.join(OWN)}")
    screen.line()
    screen.line("Try next:")
    screen.line(f"  open {folder / 'report.html'} in a browser")
    screen.line(f"  margcal calibrate {folder / 'session.parquet'} --poses {folder / 'poses.csv'}")
    screen.line(f"  margcal apply {folder / 'calibration.json'} {folder / 'session.parquet'} -o calibrated.csv")
    screen.line("  margcal calibrate YOUR_RECORDING.csv -o node.json --report node.html")
