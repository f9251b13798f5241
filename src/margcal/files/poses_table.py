"""The attitudes of the rests in a table: the FILE of ``--poses`` (conventions, Attitudes of the rests)."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from margcal.core.checking import NORM_REFUSED, printable
from margcal.core.errors import InputError
from margcal.core.types import Array
from margcal.files.batches import Table, open_table
from margcal.files.writing import AXES

_QUATERNION = ("qw", "qx", "qy", "qz")


@dataclass(frozen=True)
class PoseTable:
    """Attitudes of J rests, in order: quaternions, or the housing axes that point up and to the front.

    Attributes
    ----------
    q : ndarray (J, 4) or None
        Scalar first, unit norm, housing to laboratory.
    up : tuple of str or None
        Housing axis that points up, ``+x`` ... ``-z``.
    front : tuple of (str or None) or None
        Housing axis that points to the laboratory's +y; None where the heading is free.
    start, stop : ndarray (J,), s, or None
    file : tuple of str or None
        The recording of each rest.
    """

    q: Array | None = None
    up: tuple[str, ...] | None = None
    front: tuple[str | None, ...] | None = None
    start: Array | None = None
    stop: Array | None = None
    file: tuple[str, ...] | None = None

    def __len__(self) -> int:
        return len(self.q) if self.q is not None else len(self.up or ())


def read_poses(path: str | os.PathLike[str]) -> PoseTable:
    """The poses table `path`, CSV or Parquet.

    Raises
    ------
    InputError
        Neither `qw qx qy qz` nor `up`, or a cell that is not what its column should hold, with its row.
    """
    table = open_table(Path(path))
    columns = _cells(table)
    have_q = [c for c in _QUATERNION if c in columns]
    if have_q and _filled(columns, have_q):
        if len(have_q) < 4:
            missing = ", ".join(c for c in _QUATERNION if c not in columns)
            raise InputError(f"{table.file}: has {', '.join(have_q)} but no {missing}; all four are needed")
        if "up" in columns and _filled(columns, ["up"]):
            raise InputError(f"{table.file}: has both qw qx qy qz and up; leave one of them out")
        attitude: dict[str, Any] = {"q": _quaternions(columns, table.file)}
    elif "up" in columns:
        attitude = _faces(columns, table.file)
    else:
        raise InputError(
            f"{table.file}: no attitudes: expected columns qw qx qy qz, or up (and front); found "
            f"{', '.join(printable(n, 40) for n in table.names[:40])}"
        )
    return PoseTable(**attitude, **_intervals(columns, table.file))


def _cells(table: Table) -> dict[str, list[Any]]:
    """Columns by lower-case name, cells stripped of blanks; empty cells are None."""
    names = [n.strip().lower() for n in table.names]
    twice = next((n for n in names if n and names.count(n) > 1), None)
    if twice is not None:
        raise InputError(f"{table.file}: column name {printable(twice)!r} is there twice; rename one")
    every = range(len(names))
    take: dict[int, Any] = dict.fromkeys(every, "text") if table.dialect else {}
    cells: dict[str, list[Any]] = {n: [] for n in names}
    for batch in table.batches(every, take):
        for k, name in enumerate(names):
            cells[name] += [_clean(v) for v in batch.column(k).to_pylist()]
    if table.dialect is not None and table.dialect.decimal == ",":
        for name in cells.keys() & {*_QUATERNION, "start_s", "stop_s"}:
            cells[name] = [v.replace(",", ".") if isinstance(v, str) else v for v in cells[name]]
    return cells


def _clean(value: Any) -> Any:
    if isinstance(value, str):
        return value.strip() or None
    return None if isinstance(value, float) and np.isnan(value) else value


def _filled(columns: dict[str, list[Any]], names: Sequence[str]) -> bool:
    return any(v is not None for n in names for v in columns[n])


def _number(columns: dict[str, list[Any]], name: str, file: str) -> Array:
    out = np.empty(len(columns[name]))
    for row, cell in enumerate(columns[name]):
        try:
            out[row] = float(cell)
        except (TypeError, ValueError):
            out[row] = np.nan
        if not np.isfinite(out[row]):
            what = "is empty" if cell is None else f"{printable(cell, 40)!r} is not a finite number"
            raise InputError(f"{file}: row {row + 1}: {name} {what}; give every rest its {name}")
    return out


def _quaternions(columns: dict[str, list[Any]], file: str) -> Array:
    q = np.column_stack([_number(columns, c, file) for c in _QUATERNION])
    with np.errstate(over="ignore"):
        norm = np.linalg.norm(q, axis=1)
    wrong = np.abs(norm - 1) > NORM_REFUSED
    if wrong.any():
        row = int(np.argmax(wrong))
        raise InputError(f"{file}: row {row + 1}: the quaternion has norm {norm[row]:.4g}; expected 1")
    return q / norm[:, None]


def _faces(columns: dict[str, list[Any]], file: str) -> dict[str, Any]:
    up = [_axis(v, row, "up", file) for row, v in enumerate(columns["up"])]
    missing = next((row for row, v in enumerate(up) if v is None), None)
    if missing is not None:
        raise InputError(f"{file}: row {missing + 1}: up is empty; give the housing axis that points up, such as +z")
    front = None
    if "front" in columns and _filled(columns, ["front"]):
        front = tuple(_axis(v, row, "front", file) for row, v in enumerate(columns["front"]))
        for row, (a, b) in enumerate(zip(up, front)):
            if a and b and a[1] == b[1]:
                raise InputError(
                    f"{file}: row {row + 1}: up {a} and front {b} are the same axis; front must lie across up"
                )
    return {"up": tuple(up), "front": front}


def _axis(cell: Any, row: int, name: str, file: str) -> str | None:
    """An axis name; a sign may be missing, and spreadsheets put ``'`` before it."""
    if cell is None:
        return None
    text = str(cell).lstrip("'").strip().lower().replace("\u2212", "-")
    text = "+" + text if text in ("x", "y", "z") else text
    if text not in AXES:
        raise InputError(f"{file}: row {row + 1}: {name} is {printable(cell, 40)!r}; expected one of {', '.join(AXES)}")
    return text


def _intervals(columns: dict[str, list[Any]], file: str) -> dict[str, Any]:
    found: dict[str, Any] = {}
    if ("start_s" in columns) != ("stop_s" in columns):
        raise InputError(f"{file}: start_s and stop_s belong together; add the other or leave both out")
    if "start_s" in columns and _filled(columns, ["start_s", "stop_s"]):
        start, stop = _number(columns, "start_s", file), _number(columns, "stop_s", file)
        if (wrong := ~(stop > start)).any():
            row = int(np.argmax(wrong))
            raise InputError(
                f"{file}: row {row + 1}: stop_s ({stop[row]:g}) is not after start_s ({start[row]:g}); correct it"
            )
        found = {"start": start, "stop": stop}
    if "file" in columns and _filled(columns, ["file"]):
        empty = next((row for row, v in enumerate(columns["file"]) if v is None), None)
        if empty is not None:
            raise InputError(f"{file}: row {empty + 1}: file is empty; name the recording of every rest")
        found["file"] = tuple(str(v) for v in columns["file"])
    return found
