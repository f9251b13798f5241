"""A calibration, its issues and its rests in tables that people read."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from margcal.apps import screen
from margcal.core.types import Array, Calibration, Issue, Poses, SensorModel
from margcal.methods.sensor_model import describe

NAMES = {"acc": "accelerometer", "gyr": "gyroscope", "mag": "magnetometer"}
FRAMES = {
    "housing": "axes of the housing",
    "marker": "axes of the reference (marker body)",
    "acc-triangular": "z is the accelerometer's z axis, its y axis lies in the yz-plane",
    "gyr-symmetric": "chosen so that the gyroscope's matrix is symmetric",
}
LEVEL_STYLE = {"note": "dim", "warn": "yellow", "fail": "red"}
VERDICT_STYLE = {"pass": "green", "warn": "yellow", "fail": "red"}


def figure(value: float | None, digits: int = 5) -> str:
    """`value` to so many significant digits, without an exponent where people would not expect one."""
    if value is None or not np.isfinite(value):
        return "-"
    if value == 0 or 1e-4 <= abs(value) < 1e7:
        decimals = max(0, digits - 1 - int(np.floor(np.log10(abs(value))))) if value else 0
        return f"{value:.{min(decimals, 9)}f}"
    return f"{value:.{digits - 1}e}"


def show_calibration(calibration: Calibration) -> None:
    """Verdict, attitudes, the sensors with their quality and parameters, issues, H and B."""
    if calibration.verdict is not None:
        screen.line(f"verdict:   {calibration.verdict}", style=VERDICT_STYLE[calibration.verdict])
    show_attitudes(calibration)
    if calibration.models:
        _show_quality(calibration)
        _show_parameters(calibration)
        _show_matrices(calibration)
    show_issues(calibration.issues)


def show_attitudes(calibration: Calibration) -> None:
    """What was taken for the attitudes of the rests, how sure it is, and the magnitudes."""
    settings = calibration.settings
    taken, text = settings.get("attitudes"), settings.get("attitudes_text")
    if taken:
        told = "as told" if settings.get("poses") not in (None, "auto") else "inferred"
        screen.line(f"attitudes: {taken}, {told}: {text}")
    frame = FRAMES.get(calibration.frame, "")
    screen.line(f"frame:     {calibration.frame}{': ' + frame if frame else ''}")
    if gravity := settings.get("gravity"):
        field = settings.get("field_uT")
        strength = f"field {field:.5g} uT" if field else "field unknown: the local field is 1 (norm)"
        screen.line(f"taken as:  gravity {gravity:.6g} m/s^2" + (f", {strength}" if calibration.mag else ""))


def _show_quality(calibration: Calibration) -> None:
    rows = []
    for kind, model in calibration.models.items():
        n = "all samples" if model.n_poses is None else str(model.n_poses)
        unit = "rad a turn" if kind == "gyr" and model.n_poses is not None else model.unit
        residual = "-" if model.residual_rms is None else f"{figure(model.residual_rms, 3)} {unit}"
        error = "-" if model.expected_error_deg is None else f"{figure(model.expected_error_deg, 2)} deg"
        rows.append([NAMES[kind], model.method, n, residual, error])
    screen.line()
    screen.table(["sensor", "method", "rests", "residual rms", "expected error"], rows, right=(2, 3, 4))


def _show_parameters(calibration: Calibration) -> None:
    rows: list[list[str]] = []
    for model in calibration.models.values():
        rows += _parameters(model)
    screen.line()
    screen.table(["sensor", "parameter", "x", "y", "z", "unit"], rows, right=(2, 3, 4))


def _parameters(model: SensorModel) -> list[list[str]]:
    d = describe(model)
    lean, turn = d.non_orthogonality_deg, d.mounting_deg
    rows = [
        ["bias", *(figure(v, 7) for v in d.bias), model.raw_unit],
        ["scale factor", *(figure(v, 6) for v in d.scale_factor), d.scale_unit],
    ]
    if d.axes is not None:
        rows.append(["axis points along", *d.axes, "mirrored" if d.mirrored else ""])
    rows += [
        ["non-orthogonality", *(f"{lean[k]:.3f}" for k in ("xy", "xz", "yz")), "deg: xy, xz, yz"],
        ["mounting", *(f"{turn[k]:.3f}" for k in ("roll", "pitch", "yaw")), "deg: roll, pitch, yaw"],
    ]
    if d.hard_iron is not None and d.soft_iron is not None:
        a = d.soft_iron
        rows += [
            ["hard iron", *(figure(v, 5) for v in d.hard_iron), model.unit],
            ["soft iron", *(f"{a[i][i]:.4f}" for i in range(3)), "xx, yy, zz"],
            ["", f"{a[0][1]:.4f}", f"{a[0][2]:.4f}", f"{a[1][2]:.4f}", "xy, xz, yz"],
        ]
    return [[model.kind if k == 0 else "", *row] for k, row in enumerate(rows)]


def _show_matrices(calibration: Calibration) -> None:
    rows = []
    for kind, model in calibration.models.items():
        for k in range(3):
            cells = [f"{v:.9e}" for v in model.H[k]]
            rows.append([kind if k == 0 else "", *cells, f"{model.B[k]:.9g}"])
    screen.line()
    screen.line("u = H (y - B), y the raw reading:")
    screen.table(["", "H", "", "", "B"], rows, right=(1, 2, 3, 4))


def show_issues(issues: Sequence[Issue]) -> None:
    """A line an issue, the worst first."""
    if issues:
        screen.line()
    for issue in sorted(issues, key=lambda i: ("fail", "warn", "note").index(i.level)):
        screen.line(f"{issue.level}: {issue.text}", style=LEVEL_STYLE[issue.level])


def show_written(written: dict[str, str], *, hint: bool = True) -> None:
    """Which files were written; `hint`: where none was, how to have some."""
    screen.line()
    if not written:
        how = " (-o CAL.json keeps the calibration, --report REPORT.html shows it)" if hint else ""
        screen.line(f"nothing was written{how}")
    for what, path in written.items():
        screen.line(f"written: {path} ({what})")


def show_rests(poses: Poses, sources: Sequence[str]) -> None:
    """The rests with their times and what each sensor read."""
    several = len(sources) > 1
    kinds = list(poses.mean)
    header = ["rest", *(["recording"] if several else []), "start s", "stop s", "knocks", *kinds]
    rows = []
    for j in range(len(poses)):
        where = [sources[poses.recording[j]]] if several else []
        means = [_triple(poses.mean[k][j]) for k in kinds]
        rows.append(
            [str(j + 1), *where, f"{poses.start[j]:.3f}", f"{poses.stop[j]:.3f}", f"{poses.knocks[j]:.0f}", *means]
        )
    first = 2 if several else 1
    screen.table(header, rows, right=(0, *range(first, first + 3 + len(kinds))))


def _triple(values: Array) -> str:
    return " ".join(figure(float(v), 5) for v in values)


def show_residuals(calibration: Calibration) -> None:
    """What is left over at the rests of the recordings that the calibration was held against."""
    rows = []
    for kind, fit in calibration.fits.items():
        unit = "deg (up after each turn)" if kind == "gyr" else f"{fit.model.unit} (length at rest)"
        residual = np.degrees(fit.residual) if kind == "gyr" else np.asarray(fit.residual)
        rms, worst = float(np.sqrt(np.mean(residual**2))), float(np.abs(residual).max())
        rows.append([NAMES[kind], str(residual.size), figure(rms, 3), figure(worst, 3), unit])
    screen.table(["left over", "number", "rms", "worst", "unit"], rows, right=(1, 2, 3))
