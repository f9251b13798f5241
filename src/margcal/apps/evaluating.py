"""`margcal evaluate`: an estimate of attitude against a reference, in figures and in a picture."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from margcal.apps import screen
from margcal.apps.outputs import check_outputs
from margcal.apps.papers.figures import BLUE, GREY, ORANGE, Curve, Panel, stacked
from margcal.apps.printing import figure as digits
from margcal.apps.printing import show_issues
from margcal.apps.report_svg import envelope, scale_of
from margcal.core.errors import UsageError
from margcal.core.types import Array, Mask
from margcal.workflow.evaluate import ANGLES, Evaluation, error_angles, evaluate
from margcal.workflow.evaluate_align import LONGEST_GAP, usual_step

FILES = ("evaluation.json", "errors.csv", "evaluation.svg")

OTHER_KINDS = (".json", ".csv", ".html", ".parquet", ".png", ".pdf", ".txt")
"""Who gives such a name wants one file of that kind, and would find a folder."""

BINS = 380
"""Columns of a panel: longer tracks are drawn as the band between lowest and highest."""

SHOWN = 0.002
"""Part of the samples at either end that does not decide the scale of an error."""


def run(
    estimate: str,
    reference: str,
    *,
    output: str | None,
    align_frames: Literal["none", "yaw", "full"],
    align_time: bool,
    all_samples: bool,
    overwrite: bool,
    as_json: bool,
) -> int:
    """The verb; `output` is a folder, or one picture where it ends in .svg."""
    check_outputs([output], [estimate, reference], overwrite)
    if output is not None and not _is_picture(output) and Path(output).suffix.lower() in OTHER_KINDS:
        raise UsageError(f"-o {output}: give a folder (for {', '.join(FILES)}) or a name that ends in .svg")
    with screen.progress("evaluating"):
        found = evaluate(estimate, reference, align_frames=align_frames, align_time=align_time, all_samples=all_samples)
    title = f"{Path(estimate).name} against {Path(reference).name}"
    if output is not None:
        _write(found, title, Path(output), overwrite)
    if as_json:
        print(_json(found, estimate, reference))
        return 0
    _show(found, title)
    screen.line()
    if output is None:
        screen.line("nothing was written (-o DIR keeps the figures and draws them, -o PICTURE.svg draws only)")
    else:
        names = "" if _is_picture(output) else f": {', '.join(FILES)}"
        screen.line(f"written to {output}{names}")
    return 0


# --- on the screen ------------------------------------------------------------------------------------


def _show(found: Evaluation, title: str) -> None:
    screen.line(title, style="bold")
    for text in words(found):
        screen.line(f"  {text}")
    screen.line()
    rows = [
        ["total", digits(found.total_deg, 4)],
        ["heading", digits(found.heading_deg, 4)],
        ["inclination", digits(found.inclination_deg, 4)],
    ]
    screen.table(["error, degrees", "rms"], rows, right=(1,))
    screen.line()
    rows = []
    for name in ANGLES:
        e = getattr(found, name)
        rows.append([name, f"{e.rms:.3f}", f"{e.mean:.3f}", f"{e.sd:.3f}", _correlation(e.correlation)])
    screen.table(["error, degrees", "rms", "mean", "sd", "correlation"], rows, right=(1, 2, 3, 4))
    screen.line()
    parts = ", ".join(f"{c} {v:.5f}" for c, v in zip("wxyz", found.quaternion_wxyz))
    screen.line(f"difference of the quaternions, rms: {found.quaternion:.5f} ({parts})")
    show_issues(found.issues)


def _correlation(value: float) -> str:
    return f"{value:.5f}" if math.isfinite(value) else "-"


def words(found: Evaluation) -> list[str]:
    """Which samples count, on whose times, and what was aligned."""
    other = "reference" if found.times == "estimate" else "estimate"
    counted = "those in which the body moved (column movement)" if found.samples == "movement" else "all of them"
    out = [
        f"{found.n_common} common samples in {found.seconds:.1f} s at the times of the {found.times} (the {other} "
        "interpolated where it must be, never across a gap)",
        f"{found.n} samples count: {counted}",
    ]
    if found.time_offset_s is None:
        out.append("time: taken as it is")
    else:
        out.append(
            f"time: the estimate was moved by {1e3 * found.time_offset_s:+.2f} ms (correlation of the angular speeds "
            f"{found.time_correlation:.4f})"
        )
    lab, body = found.frames.laboratory_deg, found.frames.body_deg
    if not lab.any() and not body.any():
        out.append("frames: taken as they are")
    elif not body.any():
        out.append(f"frames: the estimate was turned by {lab[2]:+.3f} deg about the vertical")
    else:
        out.append(f"frames: the laboratory was turned by {_vector(lab)} deg, the body by {_vector(body)} deg")
    return out


def _vector(v: Array) -> str:
    return "[" + " ".join(f"{x:+.3f}" for x in v) + "]"


# --- as files -----------------------------------------------------------------------------------------


def as_plain(found: Evaluation) -> dict[str, Any]:
    """For JSON: degrees and seconds; what has no value is null."""

    def number(value: float | None) -> float | None:
        return None if value is None or not math.isfinite(value) else float(value)

    angles = {
        name: {k: number(getattr(getattr(found, name), k)) for k in ("rms", "mean", "sd", "correlation")}
        for name in ANGLES
    }
    return {
        "total_deg": found.total_deg,
        "heading_deg": found.heading_deg,
        "inclination_deg": found.inclination_deg,
        **angles,
        "quaternion": {"rms": found.quaternion, "rms_wxyz": found.quaternion_wxyz.tolist()},
        "n": found.n,
        "n_common": found.n_common,
        "seconds": found.seconds,
        "samples": found.samples,
        "times": found.times,
        "time_offset_s": number(found.time_offset_s),
        "time_correlation": number(found.time_correlation),
        "laboratory_turned_deg": found.frames.laboratory_deg.tolist(),
        "body_turned_deg": found.frames.body_deg.tolist(),
        "issues": [
            {"code": i.code, "level": i.level, "text": i.text, "value": number(i.value), "limit": number(i.limit)}
            for i in found.issues
        ],
    }


def _json(found: Evaluation, estimate: str, reference: str) -> str:
    plain = {"estimate": Path(estimate).name, "reference": Path(reference).name, **as_plain(found)}
    return json.dumps(plain, indent=1, ensure_ascii=False, allow_nan=False)


def _is_picture(output: str | Path) -> bool:
    return str(output).lower().endswith(".svg")


def _write(found: Evaluation, title: str, target: Path, overwrite: bool) -> None:
    from margcal.files.atomic import atomic_folder, atomic_path
    from margcal.files.writing import write_table

    if _is_picture(target):
        with atomic_path(target, overwrite=overwrite) as place:
            place.write_text(picture(found, title), encoding="utf-8")
        return
    with atomic_folder(target, overwrite=overwrite) as folder:
        text = json.dumps(as_plain(found), indent=1, ensure_ascii=False, allow_nan=False)
        (folder / "evaluation.json").write_text(text + "\n", encoding="utf-8")
        write_table(folder / "errors.csv", _error_columns(found))
        (folder / "evaluation.svg").write_text(picture(found, title), encoding="utf-8")


def _error_columns(found: Evaluation) -> dict[str, Any]:
    """A row a common sample; roll, pitch and yaw without jumps at 180 degrees."""
    ref, est, error = found.angles_deg()
    columns: dict[str, Any] = {"t_s": found.t, "counted": found.counted.astype(int)}
    for name, angle in zip(("total", "heading", "inclination"), error_angles(found.q_est, found.q_ref)):
        columns[f"{name}_deg"] = np.degrees(angle)
    for i, name in enumerate(ANGLES):
        columns |= {
            f"{name}_deg": est[:, i],
            f"ref_{name}_deg": ref[:, i],
            f"{name}_error_deg": error[:, i],
        }
    return columns


# --- the picture --------------------------------------------------------------------------------------


def picture(found: Evaluation, title: str) -> str:
    """Roll, pitch and yaw of both tracks; their errors; total, heading and inclination error: over time."""
    ref, est, error = found.angles_deg()
    tracks, angles, parts = [], [], []
    for i, name in enumerate(ANGLES):
        e = getattr(found, name)
        curves = (
            _line("estimate", found.t, est[:, i], BLUE),
            replace(_line("reference", found.t, ref[:, i], "#111827"), dash="2 5"),
        )
        tracks.append(Panel(f"{name}, without jumps at 180 degrees", "time, s", "degrees", curves))
        note = f"rms {e.rms:.2f}, mean {e.mean:.2f}, sd {e.sd:.2f}"
        angles.append(_error_panel(f"{name} error", found, error[:, i], note))
    kinds = ("total", "heading", "inclination")
    for name, angle in zip(kinds, error_angles(found.q_est, found.q_ref)):
        note = f"rms {getattr(found, f'{name}_deg'):.2f}"
        parts.append(_error_panel(f"{name} error", found, np.degrees(angle), note))
    return stacked(title, [tracks, angles, parts])


def _error_panel(title: str, found: Evaluation, error: Array, note: str) -> Panel:
    """The error where it counts, and in grey where it does not; rare peaks (steep pitch) are cut."""
    curves = _errors(found.t, error, found.counted)
    low, high = (float(v) for v in np.quantile(error, (SHOWN, 1 - SHOWN)))
    pad = 0.6 * (high - low) or 1.0
    y_range = (max(low - pad, float(error.min()) - 0.1 * pad), min(high + pad, float(error.max()) + 0.1 * pad))
    cut = bool(error.min() < y_range[0] or error.max() > y_range[1])
    note += f" (peaks of {np.abs(error).max():.0f} are cut)" if cut else ""
    return Panel(f"{title}, {note}", "time, s", "degrees", curves, y_range=y_range, zero_line=True)


def _errors(t: Array, error: Array, counted: Mask) -> tuple[Curve, ...]:
    counts = _line("counts", t, np.where(counted, error, np.nan), ORANGE)
    if counted.all():
        return (counts,)
    return (_line("does not count", t, np.where(counted, np.nan, error), GREY), counts)


def _line(label: str, t: Array, y: Array, colour: str) -> Curve:
    """A curve that a picture can hold: where there are more samples than columns, up and down within each."""
    good = np.isfinite(y)
    if len(t) <= 2 * BINS:
        breaks = np.flatnonzero(np.diff(t) > LONGEST_GAP * usual_step(t))
        return Curve(label, np.insert(t, breaks + 1, t[breaks]), np.insert(y, breaks + 1, np.nan), colour)
    time = scale_of(t, 0.0)
    x, low, high = envelope(t[good], y[good], time, BINS)
    odd = np.arange(BINS) % 2 == 1
    zigzag = np.column_stack([np.where(odd, high, low), np.where(odd, low, high)]).ravel()
    return Curve(label, np.repeat(time.low + x * (time.high - time.low), 2), zigzag, colour)
