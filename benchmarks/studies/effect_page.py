"""The tables and the figure of docs/effect.md from a run of `margcal reproduce effect`.

    MARGCAL_DATA=... margcal reproduce effect -o effect        # five to ten minutes
    python benchmarks/studies/effect_page.py effect

What stands between the marks ``<!-- table: NAME -->`` and ``<!-- end of table -->`` is replaced.
"""

from __future__ import annotations

import json
import re
import shutil
import sys
from pathlib import Path
from typing import Any

DOCS = Path(__file__).resolve().parents[2] / "docs"
PAPERS = {"zy-tbme-ii": "ZY-TBME II", "z-tie-iii": "Z-TIE III"}


def table(header: list[str], rows: list[list[str]], text_columns: int) -> str:
    rule = ["---"] * text_columns + ["---:"] * (len(header) - text_columns)
    return "\n".join(f"| {' | '.join(row)} |" for row in [header, rule, *rows])


def means(grid: dict[str, Any]) -> str:
    rows = []
    for first, *numbers in grid["rows"]:
        name, _, variant = first.partition(", ")
        rows.append([name, variant, *(f"{v:.2f}" for v in numbers)])
    return table(["filter", "of the calibration", *grid["header"][1:]], rows, 2)


def restored(grids: dict[str, Any]) -> str:
    rows = []
    for name, grid in grids.items():
        if name.startswith("restored-"):
            off = [abs(row[-1]) for row in grid["rows"]]
            rows.append([name.removeprefix("restored-"), f"{sum(v <= 0.05 for v in off)} of {len(off)}"])
            rows[-1] += [f"{max(off):.3f}", *(f"{min(row[k] for row in grid['rows']):.1f}" for k in range(2, 6))]
    header = ["filter", "H and B within .05", "worst, deg", *(f"least, {v}" for v in ("raw", "B", "mag B", "frames"))]
    return table(header, rows, 1)


def papers(grids: dict[str, Any]) -> str:
    rows = []
    for name, title in PAPERS.items():
        lines = {row[0]: row for row in grids[name]["rows"]}
        for variant in dict.fromkeys(first.partition(": ")[0] for first in lines):
            three = [lines[f"{variant}: {angle}"] for angle in ("roll", "pitch", "yaw")]
            rows.append([f"{title}, {variant}", *(f"{r[1]:.4f}" for r in three), *(f"{r[5]:.4f}" for r in three)])
    return table(["rms, rad", "roll", "pitch", "yaw", "ours: roll", "pitch", "yaw"], rows, 1)


def phones(grid: dict[str, Any]) -> str:
    rows = [[r[0], *(v if isinstance(v, str) else f"{v:.1f}" for v in r[1:])] for r in grid["rows"]]
    return table(["total, deg", *grid["header"][1:]], rows, 1)


def main() -> None:
    folder = Path(sys.argv[1])
    found = json.loads((folder / "results.json").read_text(encoding="utf-8"))
    grids = {t["name"]: t for t in found["tables"]}
    made = {"means": means(grids["effect"]), "restored": restored(grids), "papers": papers(grids)}
    made["phones"] = phones(grids["phones"])
    page = (DOCS / "effect.md").read_text(encoding="utf-8")
    for name, text in made.items():
        pattern = rf"(<!-- table: {name} -->\n).*?(<!-- end of table -->)"
        page, count = re.subn(pattern, lambda m, t=text: f"{m[1]}{t}\n{m[2]}", page, flags=re.DOTALL)
        if count != 1:
            sys.exit(f"docs/effect.md: {count} places for the table {name}")
    (DOCS / "effect.md").write_text(page, encoding="utf-8")
    shutil.copyfile(folder / "effect-total.svg", DOCS / "effect-total.svg")


if __name__ == "__main__":
    main()
