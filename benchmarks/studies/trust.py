"""Every figure that the project's statistics rest on, printed and written to results/trust.json.

    python benchmarks/studies/trust.py [--runs 2000] [--only NAME ...]

`--runs` single-sensor simulations each; a tenth as many whole nodes, a fifth as many for the labels, a fortieth
for the gain of the joint fit. Seeds are fixed: the same command prints the same figures. With 2000 runs it takes
about half an hour on one core.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import json
import platform
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import nodes
import numpy as np
import single

RESULTS = Path(__file__).resolve().parent / "results"

Row = dict[str, float | str]
Study = tuple[str, str, Callable[[int], list[Row]]]

STUDIES: dict[str, Study] = {
    "bound": (
        "gls-ml, noise from the scatter, s_rot unknown: RMS / Cramer-Rao bound, NEES of 14 unknowns, 95 % intervals",
        "RMS / bound .95-1.06, NEES 13.5-14.5, coverage 93-97 %",
        lambda runs: single.bound_study(runs),
    ),
    "bound-noise-unknown": (
        "the same, noise from the misfits too (ten poses leave it 16 degrees of freedom)",
        "none",
        lambda runs: single.bound_study(runs, noise_known=False),
    ),
    "housing": (
        ".5 deg/axis of housing error, s_rot unknown, 24 poses: error over the better of two-step and one-step",
        "H <= .95, B <= .90, NEES <= 16",
        lambda runs: single.housing_study(runs),
    ),
    "bad-pose": (
        "one bad pose of 20 random ones, .33 % noise, .1 deg housing error",
        "named >= 99.5 %, others left out <= 1.5 %",
        lambda runs: single.bad_pose_study(runs),
    ),
    "expected": (
        "true against expected direction error of whole nodes",
        "ratio .75-1.25 in each class, single ratios .3-3 in 95 %",
        lambda runs: nodes.expected_error_study(max(4, runs // 10)),
    ),
    "labels": (
        "attitudes of 24 rests on a cube's faces, inferred",
        "right >= 99 % (dip 85: 95 %), wrong and silent 0, right but warned <= 5 %",
        lambda runs: nodes.label_study(max(1, runs // 5)),
    ),
    "joint": (
        "the joint fit against sensor by sensor, 24 cube poses: RMS over nodes",
        "none",
        lambda runs: nodes.joint_study(max(1, runs // 40)),
    ),
}


def table(rows: Sequence[Row]) -> str:
    names = list(dict.fromkeys(name for row in rows for name in row))
    cells = [names] + [[cell(row.get(name, "")) for name in names] for row in rows]
    width = [max(len(line[i]) for line in cells) for i in range(len(names))]
    return "\n".join("  ".join(text.rjust(w) for text, w in zip(line, width)) for line in cells)


def cell(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:.4g}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=2000)
    parser.add_argument("--only", nargs="+", choices=list(STUDIES), metavar="NAME", help=f"of {', '.join(STUDIES)}")
    options = parser.parse_args()
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / "trust.json"
    for name in options.only or STUDIES:
        title, bar, study = STUDIES[name]
        begin = time.process_time()
        rows = study(options.runs)
        spent = time.process_time() - begin
        print(f"\n{name}: {title}\nbar: {bar}\n{table(rows)}\n({options.runs} runs, {spent:.0f} s)", flush=True)
        kept = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        kept[name] = {"runs": options.runs, "bar": bar, "numpy": np.__version__, "python": platform.python_version()}
        kept[name] |= {"rows": rows}
        path.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
