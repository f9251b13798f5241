"""`align` on real recordings: BROAD (factory calibrated, so the identity is right) and tyrex (raw phones).

    python benchmarks/studies/mocap.py [--only NAME,...]

Writes benchmarks/studies/results/mocap.json and prints tables. About three minutes. For BROAD also decimated to 75 Hz
(node) and 100 Hz (optics) on clocks of their own, with offsets of -250, 0 and +137 ms and 50 ppm put in: what must come
out again is that difference; the offset itself holds the gyroscope's own delay of 4 ms.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from margcal.core import so3
from margcal.core.errors import DataError
from margcal.core.types import Array, Calibration, Recording, Reference, Stream
from margcal.files.tables import read
from margcal.methods.clock import synchronise
from margcal.methods.reference_rates import hermite, reference_rates
from margcal.workflow.align import align
from margcal.workflow.align_job import MocapAlignment
from margcal.workflow.reference import clean_reference

DATA = Path(os.environ.get("MARGCAL_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))
RESULTS = Path(__file__).resolve().parent / "results" / "mocap.json"
BROAD = {
    "01": "01_undisturbed_slow_rotation_A",
    "03": "03_undisturbed_slow_rotation_C",
    "05": "05_undisturbed_slow_rotation_with_breaks_B",
    "08": "08_undisturbed_fast_rotation_with_breaks_A",
    "12": "12_undisturbed_slow_translation_C",
    "21": "21_undisturbed_fast_combined",
}
TYREX = ("Jakob_Nexus5_NoDist_AR", "Thibaud_Nexus5_NoDist_AR")
OFFSETS_S, DRIFT = (-0.25, 0.0, 0.137), 50e-6


def figures(found: Calibration) -> dict[str, Any]:
    """What is looked at, plain numbers."""
    row: dict[str, Any] = {"verdict": found.verdict, "sensors": list(found.models)}
    for kind, model in found.models.items():
        H = model.H / np.cbrt(abs(np.linalg.det(model.H))) if kind == "mag" else model.H
        row[kind] = {
            "off_identity_percent": 100 * float(np.abs(H - np.eye(3)).max()),
            "strain_percent": 100 * float(np.abs(so3.polar(H)[1] - np.eye(3)).max()),
            "B": model.B.tolist(),
            "delay_ms": 1e3 * (model.delay_s or 0.0),
            "delay_se_ms": None if model.delay_se_s is None else 1e3 * model.delay_se_s,
            "expected_error_deg": model.expected_error_deg,
        }
    alignment = found.alignment
    if alignment is None:
        return row
    for name in ("marker_to_node", "lab_to_earth"):
        if name in alignment.values:
            row[f"{name}_deg"] = np.degrees(so3.quat_log(np.array(alignment.values[name]))).tolist()
    row |= {k: v for k, v in alignment.values.items() if "lever" in k or "offset" in k or "drift" in k}
    if isinstance(alignment, MocapAlignment) and alignment.figures is not None:
        row["correlation"], row["explained"] = alignment.figures.peak, alignment.figures.explained
        for name, errors in (("before", alignment.figures.before), ("after", alignment.figures.after)):
            row[f"orientation_{name}_deg"] = None if errors is None else errors.total
    row["issues"] = [f"{i.level}: {i.text}" for i in found.issues if i.level != "note"]
    return row


def one(recording: Recording, **options: Any) -> dict[str, Any]:
    start = time.process_time()
    try:
        found = align(recording, recording.reference, **options)
    except DataError as refused:
        return {"refused": str(refused)}
    return {**figures(found), "cpu_s": round(time.process_time() - start, 2)}


def decimated(recording: Recording, offset: float, phase: float) -> tuple[Array, Array, Reference]:
    """Gyroscope at 75 Hz (averages between its samples) and the reference at 100 Hz on a clock of its own.

    `phase` (s) moves the instants at which both are sampled.
    """
    gyr, reference = recording.streams["gyr"], recording.reference
    assert reference is not None
    t = np.arange(gyr.t[0] + 1 + phase, gyr.t[-1] - 1, 1 / 75)
    angle = np.zeros_like(gyr.y)
    np.cumsum((gyr.y[1:] + gyr.y[:-1]) / 2 * np.diff(gyr.t)[:, None], axis=0, out=angle[1:])
    turned = [hermite(gyr.t, angle, gyr.y, t + half / 75)[0] for half in (-0.5, 0.5)]
    step = reference.t[1] - reference.t[0]
    index = np.unique(np.round(np.arange(2 * phase, reference.t[-1], 0.01) / step).astype(int))
    index = index[index < len(reference.t)]
    return t, 75 * (turned[1] - turned[0]), Reference(offset + (1 + DRIFT) * reference.t[index], reference.q[index])


def clocks(recording: Recording) -> list[dict[str, float]]:
    assert recording.reference is not None
    clean, _ = clean_reference(recording.reference, gyr=Stream("gyr", *_gyr(recording), "radps"))
    rows = []
    for k, offset in enumerate(OFFSETS_S):
        t, z, reference = decimated(replace(recording, reference=clean), offset, 0.0041 * k)
        found = synchronise(t, z, reference_rates(reference))
        rows.append(
            {
                "put_in_ms": 1e3 * offset,
                "found_less_put_in_ms": 1e3 * (found.offset_s - offset),
                "se_ms": 1e3 * found.offset_se_s,
                "drift_off_ppm": found.drift_ppm - 1e6 * DRIFT,
                "drift_se_ppm": found.drift_se_ppm,
            }
        )
    return rows


def _gyr(recording: Recording) -> tuple[Array, Array]:
    gyr = recording.streams["gyr"]
    return gyr.t, gyr.y


def show(name: str, row: dict[str, Any]) -> None:
    if "refused" in row:
        print(f"{name}: refused: {row['refused']}")
        return
    parts = []
    for kind in ("acc", "gyr", "mag"):
        if kind in row:
            s = row[kind]
            parts.append(
                f"{kind} {s['off_identity_percent']:.2f} % (strain {s['strain_percent']:.2f}), {s['delay_ms']:.2f} ms"
            )
    turned = " ".join(f"{v:.2f}" for v in row.get("marker_to_node_deg", []))
    print(f"{name}: {row['verdict']}; {'; '.join(parts)}; marker [{turned}] deg; {row['cpu_s']:.1f} s CPU")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", help="some of " + ", ".join((*BROAD, *TYREX)))
    only = parser.parse_args().only
    wanted = only.split(",") if only else [*BROAD, *TYREX]
    results: dict[str, Any] = {}
    for name, file in BROAD.items():
        if name not in wanted:
            continue
        recording = read(DATA / "broad" / f"{file}.parquet")
        results[name] = one(recording, common_clock=True)
        show(f"BROAD {name}", results[name])
        if name != "12":
            results[name]["paper"] = one(recording, common_clock=True, method="r-bsn", orientation=False)
            show("   r-bsn", results[name]["paper"])
            results[name]["clocks"] = clocks(recording)
            for row in results[name]["clocks"]:
                found = f"{row['found_less_put_in_ms']:+.3f} +- {row['se_ms']:.3f} ms beside it"
                drift = f"{row['drift_off_ppm']:+.2f} +- {row['drift_se_ppm']:.2f} ppm"
                print(f"   put in {row['put_in_ms']:+.0f} ms: found {found}, drift off by {drift}")
    for name in TYREX:
        if name in wanted:
            results[name] = one(read(DATA / "tyrex" / name), common_clock=False)
            show(name, results[name])
            hard_iron, offset = np.round(results[name]["mag"]["B"], 2), 1e3 * results[name]["offset_s"]
            print(f"   hard iron {hard_iron}, offset {offset:.2f} ms")
    if not only:
        RESULTS.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
        print(f"written: {RESULTS}")


if __name__ == "__main__":
    main()
