"""`evaluate` on the public `vqf` package: BROAD's figures for eight trials beside those of the data's README.

    python benchmarks/studies/evaluate.py

Needs the recordings (MARGCAL_DATA) and the package vqf. Prints the table and writes results/evaluate.json; half a
minute.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import json
from pathlib import Path
from typing import Any

import numpy as np

from margcal.core.types import Array, Attitude, Recording, Stream
from margcal.files.tables import read
from margcal.workflow.evaluate import Evaluation, evaluate

HERE = Path(__file__).resolve().parent
RESULTS = HERE / "results"
DATA = Path(os.environ.get("MARGCAL_DATA", HERE.parents[1] / ".." / "shared" / "data")) / "broad"

MAG_DELAY_S = 0.0107
FILTERS = ("online", "offline", "offline, magnetometer advanced by 10.7 ms")

PUBLISHED = {
    "01": ((1.99, 1.89, 0.60), (3.37, 3.35, 0.37), (3.21, 3.19, 0.37)),
    "03": ((1.93, 1.88, 0.42), (1.35, 1.29, 0.39), (1.23, 1.17, 0.39)),
    "05": ((0.99, 0.92, 0.35), (0.63, 0.57, 0.27), (0.55, 0.48, 0.27)),
    "08": ((3.34, 2.84, 1.76), (2.27, 2.07, 0.93), (1.85, 1.60, 0.93)),
    "12": ((1.36, 1.33, 0.25), (0.62, 0.59, 0.19), (0.62, 0.59, 0.19)),
    "21": ((4.08, 3.70, 1.72), (5.24, 5.15, 0.95), (1.54, 1.20, 0.95)),
    "29": ((2.38, 2.13, 1.06), (1.81, 1.60, 0.85), (1.19, 0.84, 0.85)),
    "33": ((3.75, 3.70, 0.60), (1.81, 1.77, 0.39), (1.77, 1.73, 0.39)),
}
"""Total, heading, inclination of each filter, degrees: the table in the README of the recordings."""


def vqf_attitude(recording: Recording, how: str) -> Attitude:
    """What the package makes of a recording whose three sensors share a clock; `how` is one of `FILTERS`."""
    from vqf import VQF, offlineVQF

    acc, gyr, mag = recording.acc, recording.gyr, recording.mag
    assert acc is not None and gyr is not None and mag is not None
    ts = float(gyr.t[-1] - gyr.t[0]) / (len(gyr.t) - 1)
    a, w = np.ascontiguousarray(acc.y), np.ascontiguousarray(gyr.y)
    m = np.ascontiguousarray(advanced(mag, MAG_DELAY_S) if "advanced" in how else mag.y)
    q = VQF(ts).updateBatch(w, a, m)["quat9D"] if how == "online" else offlineVQF(w, a, m, ts)["quat9D"]
    return Attitude(gyr.t, q)


def advanced(stream: Stream, delay_s: float) -> Array:
    """Readings (N, 3) moved to the times at which they were true."""
    return np.column_stack([np.interp(stream.t + delay_s, stream.t, stream.y[:, i]) for i in range(3)])


def figures(found: Evaluation) -> tuple[float, float, float]:
    return found.total_deg, found.heading_deg, found.inclination_deg


def main() -> None:
    rows: list[dict[str, Any]] = []
    for trial, published in PUBLISHED.items():
        path = next(DATA.glob(f"{trial}_*.parquet"))
        recording = read(path)
        for how, theirs in zip(FILTERS, published):
            found = figures(evaluate(vqf_attitude(recording, how), path))
            off = max(abs(a - b) for a, b in zip(found, theirs))
            rows.append({"trial": trial, "filter": how, "deg": [round(v, 4) for v in found], "published": theirs})
            rows[-1]["largest difference"] = round(off, 4)
            print(f"{trial} {how:44s} {' / '.join(f'{v:.2f}' for v in found)}   off by {off:.4f}")
    worst = max(r["largest difference"] for r in rows)
    means = {how: np.mean([r["deg"] for r in rows if r["filter"] == how], axis=0).round(4).tolist() for how in FILTERS}
    print("\n".join(f"mean {how}: {' / '.join(f'{v:.2f}' for v in m)}" for how, m in means.items()))
    print(f"largest difference from the README's figures: {worst:.4f} deg (bar: .02)")
    RESULTS.mkdir(exist_ok=True)
    kept = {"bar_deg": 0.02, "largest_difference_deg": worst, "mean_deg": means, "rows": rows}
    (RESULTS / "evaluate.json").write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
