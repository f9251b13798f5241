"""`orient` on the eight BROAD trials: every filter, with and without the magnetometer's delay told from the motion.

    python benchmarks/studies/orientation.py [FILTER ...]

BROAD's own figures (`evaluate`: total, heading and inclination over the samples in which the body moved, nothing
aligned). The settings' numbers were taken on tyrex's motions or by reasoning, as the filters' docstrings say, and are
not those that do best here; but these trials were looked at on the way (thinned to 71 Hz), and it was they that showed
that the accelerometer's gate had better be open (means of 5.2-6.4 degrees with gates up to .1, 2.6-2.9 open; tyrex
agrees). Needs the recordings (MARGCAL_DATA). Prints the table and writes results/orientation.json; a minute with the
compiled filters.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from margcal.core import compiled
from margcal.files.tables import read
from margcal.methods.filters import FILTERS
from margcal.workflow.evaluate import evaluate
from margcal.workflow.orient import orient

HERE = Path(__file__).resolve().parent
RESULTS = HERE / "results"
DATA = Path(os.environ.get("MARGCAL_DATA", HERE.parents[1] / ".." / "shared" / "data")) / "broad"

BARS = {("ekf-quest", "none"): 6.2, ("vector-selection", "none"): 5.5, ("vqf-offline", "estimate"): 1.55}
"""Largest mean total error, degrees."""


def main() -> None:
    names = sys.argv[1:] or list(FILTERS)
    rows: list[dict[str, Any]] = []
    for path in sorted(DATA.glob("*.parquet")):
        recording = read(path)
        for name in names:
            for delays in ("none", "estimate"):
                begun = time.process_time()
                found = orient(recording, filter=name, delays=delays)
                spent = time.process_time() - begun
                e = evaluate(found.attitude, path)
                deg = [e.total_deg, e.heading_deg, e.inclination_deg]
                row = {"trial": path.stem[:2], "filter": name, "delays": delays, "deg": [round(v, 3) for v in deg]}
                row["delay_ms"] = round(1e3 * found.figures["delays_s"].get("mag", 0.0), 2)
                row["mag_used"] = round(found.figures["used"]["mag"], 4)
                rows.append(row)
                print(f"{row['trial']} {name:17s} {delays:9s} {_words(deg)}   {row['delay_ms']:5.1f} ms  {spent:.1f} s")
    means: dict[str, list[float]] = {}
    for name in names:
        for delays in ("none", "estimate"):
            mean = np.mean([r["deg"] for r in rows if (r["filter"], r["delays"]) == (name, delays)], axis=0)
            means[f"{name}, delays {delays}"] = mean.round(3).tolist()
            bar = BARS.get((name, delays))
            held = "" if bar is None else f"   bar {bar}: {'held' if mean[0] <= bar else 'NOT HELD'}"
            print(f"mean {name:17s} delays {delays:9s} {_words(mean)}{held}")
    kept = {
        "compiled": compiled.state(),
        "bars_total_deg": {", delays ".join(k): v for k, v in BARS.items()},
        "mean_deg": means,
        "rows": rows,
    }
    if not sys.argv[1:]:
        RESULTS.mkdir(exist_ok=True)
        (RESULTS / "orientation.json").write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")


def _words(deg: Any) -> str:
    return " / ".join(f"{v:5.2f}" for v in deg)


if __name__ == "__main__":
    main()
