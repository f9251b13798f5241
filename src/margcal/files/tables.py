"""Recordings from tables on disk: `read` (and, from `writing`, tables to disk: `write_table`).

A library parses (see `batches`); ours is the meaning of the columns (see `columns`) and of missing values.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from margcal.core.checking import checked_recording, printable
from margcal.core.errors import InputError
from margcal.core.types import Array, Issue, Kind, Recording, Reference, Stream
from margcal.core.units import KINDS
from margcal.files.batches import Progress, Table, is_table, numbers, open_table
from margcal.files.columns import Columns, check_units, find_columns

if TYPE_CHECKING:
    from margcal.files.poses_table import PoseTable, read_poses
    from margcal.files.writing import write_table

__all__ = ["PoseTable", "read", "read_poses", "tables_in", "write_table"]

MAX_BYTES = 2_000_000_000
"""Larger tables are not read into memory unless asked; `apply` streams them."""

NAN_LIMIT = 0.05
"""Share of a sensor's samples that may be missing irregularly before a calibration is refused."""

_BRIDGED = 1.6
"""Samples this many usual steps apart still follow each other; farther apart, something is missing between."""


def __getattr__(name: str) -> Any:
    """`write_table`, `read_poses`, `PoseTable` from their own modules, when first asked for."""
    from margcal.files import poses_table, writing

    for module in (poses_table, writing):
        if name in __all__ and hasattr(module, name):
            return getattr(module, name)
    raise AttributeError(name)


def read(
    path: str | os.PathLike[str],
    *,
    units: Mapping[str, str] | None = None,
    sort: bool = False,
    skip_bad: int = 0,
    rate: float | None = None,
    max_bytes: int = MAX_BYTES,
    progress: Progress | None = None,
) -> Recording:
    """One recording: a table (CSV or Parquet), or a folder of tables that each have a clock of their own.

    Parameters
    ----------
    path : path-like
        A column is named `t_s`, `acc_x_mps2` (sensor, axis, unit), `temp_degC`, `ref_qw` ... `ref_qz`,
        `ref_p_x_m`; others are listed in `Recording.other`. Text tables may use comma, semicolon or tab,
        decimal commas, comment lines (``#``, ``//``), UTF-8 or UTF-16, and be packed with gzip.
    units : mapping such as ``{'acc': 'count'}``, optional
        Unit of sensor columns that name none. Against a unit in the name it wins, with a ``warn`` issue.
    sort : bool
        Sort rows whose time runs backwards instead of refusing them.
    skip_bad : int
        Rows of a text table that may be unreadable; they are skipped and counted in an issue.
    rate : float, Hz, optional
        Take time from the row number instead of `t_s`.
    max_bytes : int
        Refuse larger files.
    progress : callable (done, total), optional

    Returns
    -------
    Recording
        `issues` holds what was mended. Rows at which a sensor was not sampled (all its axes NaN) are left
        out of its stream: regular ones silently, others with a ``nan-rows`` issue, ``fail`` above 5 %.

    Raises
    ------
    InputError
        With file, line, column and mend.
    """
    path = Path(path)
    check_units(units)
    if rate is not None and not (np.isfinite(rate) and rate > 0):
        raise InputError(f"rate: {rate} is no sampling rate; give samples per second")
    paths = tables_in(path) if path.is_dir() else [path]
    recording = Recording(source=printable(path.name or str(path.resolve().name)))
    skipped = []
    for member in paths:
        table = open_table(member)
        if table.size > max_bytes:
            raise InputError(
                f"{table.file}: {table.size / 1e9:.1f} GB is more than is read into memory "
                f"({max_bytes / 1e9:.1f} GB); cut it, or raise the limit (--max-bytes)"
            )
        columns = find_columns(table.names, units, table.file)
        if columns.empty and len(paths) > 1:
            skipped.append(table.file)
            continue
        part = _read_table(table, columns, rate, skip_bad, progress)
        recording = _joined(recording, part, table.file)
    if skipped:
        if not recording.files:
            raise InputError(f"{printable(path)}: none of the tables holds a sensor: {', '.join(skipped)}")
        text = f"{recording.source}: no sensor in {', '.join(skipped)}; left out"
        recording = replace(recording, issues=(*recording.issues, Issue("table-skipped", "note", text)))
    if rate is not None and len(recording.files) > 1:
        raise InputError(f"{recording.source}: its tables have clocks of their own; a rate cannot stand for all")
    return checked_recording(recording, sort=sort, trust_clock=rate is not None)


def tables_in(folder: Path) -> list[Path]:
    """The tables of a folder by name, hidden files left out; none is an `InputError`."""
    try:
        found = sorted(p for p in folder.iterdir() if is_table(p) and p.is_file())
    except OSError as error:
        raise InputError(f"{printable(folder)}: cannot be read ({error.strerror})") from error
    if not found:
        raise InputError(f"{printable(folder)}: the folder holds no table (.csv, .txt, .tsv or .parquet)")
    return found


def _joined(whole: Recording, part: Recording, file: str) -> Recording:
    """`whole` with the sensors of another table; one sensor in two tables is refused."""
    changes: dict[str, Any] = {}
    for name in (*KINDS, "reference", "temperature"):
        new = getattr(part, name)
        if new is None:
            continue
        if getattr(whole, name) is not None:
            if name == "temperature":
                continue
            before = ", ".join(printable(Path(f).name) for f in whole.files)
            raise InputError(
                f"{whole.source}: {name} is in {file} and in another table ({before}); a folder is one recording: "
                "give the tables one at a time, or move one out"
            )
        changes[name] = new
    return replace(
        whole,
        **changes,
        files=whole.files + part.files,
        other=whole.other + part.other,
        issues=whole.issues + part.issues,
    )


def _read_table(
    table: Table, columns: Columns, rate: float | None, skip_bad: int, progress: Progress | None
) -> Recording:
    file = table.file
    listed = ", ".join(printable(n, 40) for n in table.names[:40])
    if columns.empty:
        raise InputError(
            f"{file}: no sensor among the columns ({listed}); name them as in t_s,acc_x_mps2,acc_y_mps2,acc_z_mps2"
        )
    if columns.t is None and rate is None:
        raise InputError(
            f"{file}: no column t_s among {listed}; name the time in seconds t_s, or declare the sampling rate"
        )
    groups: dict[str, tuple[int, ...]] = {k: s.index for k, s in columns.sensors.items()}
    if columns.t is not None and rate is None:
        groups["t"] = (columns.t,)
    for name in ("q", "p"):
        if (index := getattr(columns, name)) is not None:
            groups[name] = index
    if columns.temperature is not None:
        groups["temperature"] = (columns.temperature,)
    values = _load(table, groups, skip_bad, progress)
    n_rows = len(next(iter(values.values())))
    t = np.arange(n_rows) / rate if rate is not None else _time(values["t"][:, 0], table)
    t.flags.writeable = False
    issues = [*table.issues, *columns.issues]
    streams: dict[Kind, Stream] = {}
    for kind, sensor in columns.sensors.items():
        stream, found = _sampled(kind, t, values.pop(kind), sensor.unit, file)
        issues += found
        if stream is not None:
            streams[kind] = stream
    reference = None
    if "q" in values:
        p = values["p"] * columns.p_factor if "p" in values else None
        reference = _reference(t, values["q"], p)
    temperature = None
    if "temperature" in values:
        degrees = values["temperature"][:, 0]
        known = np.isfinite(degrees)
        if known.any():
            temperature = (t, degrees) if known.all() else (t[known], degrees[known])
    return Recording(
        **streams,  # type: ignore[arg-type]
        temperature=temperature,
        reference=reference,
        source=file,
        files=(str(table.path),),
        other=tuple(printable(table.names[k]) for k in columns.other),
        issues=tuple(issues),
    )


def _load(
    table: Table, groups: Mapping[str, tuple[int, ...]], skip_bad: int, progress: Progress | None
) -> dict[str, Array]:
    """The columns of each group as one array (N, k); a gigabyte table is held about one and a half times."""
    wanted = list(dict.fromkeys(k for index in groups.values() for k in index))
    place = {k: i for i, k in enumerate(wanted)}
    parts: dict[str, list[Array]] = {name: [] for name in groups}
    take: dict[int, Any] = dict.fromkeys(wanted, "number")
    for batch in table.batches(wanted, take, skip_bad=skip_bad, progress=progress):
        for name, index in groups.items():
            block = np.empty((len(batch), len(index)))
            for j, k in enumerate(index):
                block[:, j] = numbers(batch.column(place[k]))
            parts[name].append(block)
    values = {}
    for name in groups:
        blocks = parts.pop(name)
        if not blocks:
            raise InputError(f"{table.file}: holds no rows; record or export it again")
        values[name] = blocks[0] if len(blocks) == 1 else np.concatenate(blocks)
    return values


def _time(t: Array, table: Table) -> Array:
    bad = ~np.isfinite(t)
    if bad.any():
        row = int(np.argmax(bad))
        raise InputError(
            f"{table.file}: t_s is missing or not finite in data row {row + 1} ({int(bad.sum())} in all); take the "
            "rows out"
        )
    return np.ascontiguousarray(t)


def _sampled(kind: Kind, t: Array, y: Array, unit: str, file: str) -> tuple[Stream | None, list[Issue]]:
    """The rows at which a sensor was sampled, and what is missing beyond its own, slower rate."""
    with np.errstate(over="ignore", invalid="ignore"):  # infinite readings are refused later, by name
        complete = not np.isnan(y.sum())
    if complete:
        y.flags.writeable = False
        return Stream(kind, t, y, unit), []
    blank = np.isnan(y)
    empty = np.asarray(blank.all(axis=1))
    valid = ~np.asarray(blank.any(axis=1))
    if not valid.any():
        text = f"{file}: every row of {kind} is empty; taken as a recording without {kind}"
        return None, [Issue("sensor-empty", "warn", text, sensor=kind)]
    partial = int((~valid & ~empty).sum())
    lost = _lost_rows(t, valid, empty)
    count = lost + partial
    stream = Stream(kind, t[valid], y[valid], unit)
    if not count:
        return stream, []
    share = lost / len(t) + partial / (int(valid.sum()) + partial)
    text = f"{file}: {kind} is missing in {count} of {len(t)} rows ({100 * share:.2g} %); they were left out"
    if share > NAN_LIMIT:
        text += "; record again, or cut the file to the part that is complete"
    level = "fail" if share > NAN_LIMIT else "warn"
    return stream, [Issue("nan-rows", level, text, sensor=kind, value=share, limit=NAN_LIMIT)]


def _lost_rows(t: Array, valid: NDArray[np.bool_], empty: NDArray[np.bool_]) -> int:
    """How many `empty` rows are missing samples rather than rows of faster sensors in the same table.

    An empty row between two samples that are one usual step of this sensor apart is the other sensors' row.
    """
    at = np.flatnonzero(valid)
    if len(at) < 3:
        return int(empty.sum())
    usual = _median(np.diff(t[at]))
    before = np.concatenate([[0], np.cumsum(empty)])
    inside = before[at[1:]] - before[at[:-1]]
    lost = int(inside[np.diff(t[at]) > _BRIDGED * usual].sum())
    for first, last in ((0, at[0]), (at[-1], len(t) - 1)):
        if abs(t[last] - t[first]) > _BRIDGED * usual:
            lost += int(before[last + 1] - before[first])
    return lost


def _median(values: NDArray[Any]) -> float:
    """Upper median; np.median imports numpy.ma, which costs 10 ms at the first call."""
    return float(np.partition(values, len(values) // 2)[len(values) // 2])


def _reference(t: Array, q: Array, p: Array | None) -> Reference:
    """Rows of a slower reference in a faster table are left out; the others stay, NaN where nothing was seen."""
    seen = ~np.isnan(q).any(axis=1)
    if seen.sum() >= 3 and _median(np.diff(np.flatnonzero(seen))) >= 2:
        return Reference(t[seen], q[seen], None if p is None else p[seen])
    return Reference(t, q, p)
