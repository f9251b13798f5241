"""The papers' tables beside ours: cells with their marks, on the screen and in files.

A cell is `reproduced` where ours lies within `FACTOR` of the paper's figure (or on the right side of a limit that the
paper states). Every other cell carries a reason.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from numpy.typing import ArrayLike

from margcal.apps import screen
from margcal.workflow.metrics import summary

FACTOR = 1.5

Limit = Literal["", "below", "above"]

Tick = Callable[[int, int], None]
"""Told how much is done of how much."""

REPRODUCED = "reproduced"


@dataclass(frozen=True)
class Figure:
    """A number as it stands in a table: mean, and its standard deviation over the runs where there is one.

    `limit`: the paper says "less than" (below) or "over" (above) instead of a value.
    """

    mean: float
    sd: float | None = None
    limit: Limit = ""

    def text(self) -> str:
        sign = {"": "", "below": "< ", "above": "> "}[self.limit]
        return sign + short(self.mean) + ("" if self.sd is None else f" ± {short(self.sd)}")


def figure_of(values: ArrayLike) -> Figure:
    """Mean and standard deviation of the figures of all runs (runs,)."""
    found = summary(values)
    return Figure(found.mean, found.sd)


@dataclass(frozen=True)
class Cell:
    """One number of the paper and ours; `reason` says why they differ, where they do."""

    row: str
    column: str
    paper: Figure
    ours: Figure
    reason: str = ""

    @property
    def ratio(self) -> float:
        """Ours over the paper's."""
        return self.ours.mean / self.paper.mean if self.paper.mean else math.nan

    @property
    def reproduced(self) -> bool:
        if self.paper.limit == "below":
            return self.ratio <= FACTOR
        if self.paper.limit == "above":
            return self.ratio >= 1 / FACTOR
        return 1 / FACTOR <= self.ratio <= FACTOR

    @property
    def mark(self) -> str:
        return REPRODUCED if self.reproduced else self.reason or "no reason known"


@dataclass(frozen=True)
class Table:
    """The paper's cells beside ours, under the settings that were taken."""

    name: str
    title: str
    cells: tuple[Cell, ...]
    settings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Grid:
    """Figures of ours that the paper has no counterpart for: numbers by row and column."""

    name: str
    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str | float, ...], ...]
    settings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Reproduction:
    """Everything that `margcal reproduce` shows; `seconds` is what changes from run to run and nothing else."""

    paper: str
    citation: str
    runs: int
    seed: int
    tables: tuple[Table | Grid, ...]
    pictures: Mapping[str, str]
    seconds: tuple[Table | Grid, ...] = field(default=())


@dataclass
class Work:
    """How much is done, in units of about a millisecond."""

    tick: Tick | None
    total: int
    done: int = 0

    def of(self, cost: int) -> Callable[[int], None]:
        def step(n: int) -> None:
            self.done = min(self.done + cost * n, self.total)
            if self.tick is not None:
                self.tick(self.done, self.total)

        return step


@dataclass(frozen=True)
class Part:
    tables: tuple[Table | Grid, ...]
    pictures: dict[str, str]
    seconds: tuple[Table | Grid, ...] = ()


def short(value: float) -> str:
    """Four significant digits at most, four decimals at most, powers of ten for what is very large or small."""
    if not math.isfinite(value):
        return "-"
    size = abs(value)
    if size and not 1e-4 <= size < 1e5:
        return f"{value:.2g}"
    return f"{value:.4f}" if size < 100 else f"{value:.1f}"


def show(result: Reproduction) -> None:
    """All tables on the screen, the reasons numbered beneath each."""
    screen.line(f"{result.citation}; {result.runs} runs, seed {result.seed}", style="bold")
    for table in (*result.tables, *result.seconds):
        screen.line()
        screen.line(table.title, style="bold")
        for text in table.settings:
            screen.line(f"  {text}")
        if isinstance(table, Grid):
            rows = [[c if isinstance(c, str) else short(c) for c in row] for row in table.rows]
            screen.table(list(table.header), rows, right=range(1, len(table.header)))
        else:
            _show_cells(table)


def _show_cells(table: Table) -> None:
    reasons: list[str] = []
    rows = []
    for cell in table.cells:
        mark = cell.mark
        if not cell.reproduced:
            if mark not in reasons:
                reasons.append(mark)
            mark = f"[{reasons.index(mark) + 1}]"
        rows.append([cell.column, cell.row, cell.paper.text(), cell.ours.text(), short(cell.ratio), mark])
    screen.table(["", "", "paper", "ours", "ours/paper", ""], rows, right=(2, 3, 4))
    for number, reason in enumerate(reasons, 1):
        screen.line(f"  [{number}] {reason}")


def as_plain(result: Reproduction) -> dict[str, Any]:
    """For JSON; `seconds` apart from the rest."""

    def plain(table: Table | Grid) -> dict[str, Any]:
        if isinstance(table, Grid):
            return asdict(table)
        return {
            "name": table.name,
            "title": table.title,
            "settings": list(table.settings),
            "cells": [{**asdict(c), "ratio": c.ratio, "reproduced": c.reproduced, "mark": c.mark} for c in table.cells],
        }

    return _finite(
        {
            "paper": result.paper,
            "citation": result.citation,
            "runs": result.runs,
            "seed": result.seed,
            "tables": [plain(t) for t in result.tables],
            "seconds": [plain(t) for t in result.seconds],
            "pictures": sorted(result.pictures),
        }
    )


def _finite(value: Any) -> Any:
    """What is not finite becomes null: JSON has no NaN."""
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def file_names(result: Reproduction) -> list[str]:
    """What `write` writes."""
    times = ["times.csv"] if result.seconds else []
    return ["results.json", "tables.csv", "ours.csv", *times, *sorted(result.pictures)]


def write(result: Reproduction, folder: Path) -> None:
    """`results.json`, `tables.csv` (a row a cell), `ours.csv`, `times.csv` and the pictures into an existing folder.

    Same runs and seed, same files, but for `times.csv` and the times in `results.json`.
    """
    from margcal.files.writing import write_table

    text = json.dumps(as_plain(result), indent=1, ensure_ascii=False, allow_nan=False)
    (folder / "results.json").write_text(text + "\n", encoding="utf-8")
    cells = [(t, c) for t in result.tables if isinstance(t, Table) for c in t.cells]
    write_table(folder / "tables.csv", _columns(cells))
    write_table(folder / "ours.csv", _grid_columns([t for t in result.tables if isinstance(t, Grid)]))
    if result.seconds:
        write_table(folder / "times.csv", _grid_columns([t for t in result.seconds if isinstance(t, Grid)]))
    for name, svg in result.pictures.items():
        (folder / name).write_text(svg, encoding="utf-8")


def _columns(cells: Sequence[tuple[Table, Cell]]) -> dict[str, list[Any]]:
    def sd(figure: Figure) -> float:
        return math.nan if figure.sd is None else figure.sd

    return {
        "table": [t.name for t, _ in cells],
        "column": [c.column for _, c in cells],
        "row": [c.row for _, c in cells],
        "paper_limit": [c.paper.limit for _, c in cells],
        "paper_mean": [c.paper.mean for _, c in cells],
        "paper_sd": [sd(c.paper) for _, c in cells],
        "ours_mean": [c.ours.mean for _, c in cells],
        "ours_sd": [sd(c.ours) for _, c in cells],
        "ratio": [c.ratio for _, c in cells],
        "mark": [c.mark for _, c in cells],
    }


def _grid_columns(grids: Sequence[Grid]) -> dict[str, list[Any]]:
    """A row a number."""
    out: dict[str, list[Any]] = {"table": [], "row": [], "column": [], "value": [], "text": []}
    for grid in grids:
        for row in grid.rows:
            for name, value in zip(grid.header[1:], row[1:]):
                out["table"].append(grid.name)
                out["row"].append(str(row[0]))
                out["column"].append(name)
                out["value"].append(math.nan if isinstance(value, str) else float(value))
                out["text"].append(value if isinstance(value, str) else None)
    return out
