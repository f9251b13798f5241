"""Tracks of attitudes from tables: `t_s` with `qw qx qy qz` (an estimate) or `ref_qw ref_qx ref_qy ref_qz`.

A column `movement` beside them (0 or 1) says when the body moved. Other columns are not looked at.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from margcal.core.checking import checked_reference, printable, without_options
from margcal.core.errors import InputError
from margcal.core.types import Array, Attitude, Issue, Mask, Reference
from margcal.files.batches import Table, numbers, open_table
from margcal.files.tables import tables_in

Prefix = Literal["q", "ref_q"]


@dataclass(frozen=True)
class AttitudeTable:
    """What a table (or folder) says of attitudes.

    Attributes
    ----------
    attitude : Attitude
        Unit quaternions of continuous sign, NaN where the body was not seen.
    columns : {'q', 'ref_q'}
        What the columns are named by.
    movement : tuple of ndarray (N,), s, and (N,) bool, or None
        When the body moved, on its own clock.
    source : str
        The file's name, for messages.
    issues : tuple of Issue
        What was mended.
    """

    attitude: Attitude
    columns: Prefix
    movement: tuple[Array, Mask] | None = None
    source: str = "attitudes"
    issues: tuple[Issue, ...] = ()


def read_attitudes(path: str | os.PathLike[str], *, prefer: Prefix = "q") -> AttitudeTable:
    """Attitudes from a table, CSV or Parquet, or from the one table of a folder that holds some.

    Parameters
    ----------
    path : path-like
    prefer : {'q', 'ref_q'}
        Which columns to take where a table has both; where it has one kind, that is taken.

    Raises
    ------
    InputError
        No attitudes, several tables with some, no time, or values that are no unit quaternions.
    """
    path = Path(path)
    tables = [open_table(p) for p in (tables_in(path) if path.is_dir() else [path])]
    holding: list[tuple[Table, Prefix]] = [(t, prefix) for t in tables if (prefix := _prefix(t, prefer)) is not None]
    if not holding:
        listed = ", ".join(printable(n, 40) for t in tables for n in t.names[:20])
        raise InputError(f"{printable(path.name)}: no attitudes among the columns ({listed}); name them qw qx qy qz")
    if len(holding) > 1:
        where = " and in ".join(t.file for t, _ in holding)
        raise InputError(f"{printable(path.name)}: attitudes are in {where}; give one of the tables")
    table, prefix = holding[0]
    attitude, issues = _attitude(table, prefix)
    moving = next((t for t in [table, *tables] if "movement" in _lower(t)), None)
    return AttitudeTable(attitude, prefix, None if moving is None else _movement(moving), table.file, issues)


def _lower(table: Table) -> list[str]:
    return [n.lower() for n in table.names]


def _prefix(table: Table, prefer: Prefix) -> Prefix | None:
    other: Prefix = "ref_q" if prefer == "q" else "q"
    names = _lower(table)
    for prefix in (prefer, other):
        have = [c for c in "wxyz" if f"{prefix}{c}" in names]
        if len(have) == 4:
            return prefix
    for prefix in (prefer, other):
        have = [f"{prefix}{c}" for c in "wxyz" if f"{prefix}{c}" in names]
        if have:
            raise InputError(
                f"{table.file}: attitudes need {' '.join(prefix + c for c in 'wxyz')}; only {', '.join(have)} found"
            )
    return None


def _attitude(table: Table, prefix: Prefix) -> tuple[Attitude, tuple[Issue, ...]]:
    values = _columns(table, ["t_s", *(f"{prefix}{c}" for c in "wxyz")])
    track = _thinned(values[:, 0], values[:, 1:])
    return checked_attitude(track.t, track.q, prefix, table.file)


def checked_attitude(t: Array, q: Array, prefix: Prefix, source: str) -> tuple[Attitude, tuple[Issue, ...]]:
    """Unit quaternions of continuous sign, NaN where nothing was seen, and what was mended for it.

    Raises
    ------
    InputError
        As `core.checking.checked_reference`.
    """
    where = f"{source}: "

    def said(text: str) -> str:  # the checks speak of a recording's reference; here an estimate may be meant
        return without_options(text.replace(f"{where}reference", source).replace("ref_q", prefix))

    try:
        checked, issues = checked_reference(Reference(t, q), where=where)
    except InputError as error:
        raise InputError(said(str(error))) from error
    return Attitude(checked.t, checked.q), tuple(replace(i, text=said(i.text)) for i in issues)


def _thinned(t: Array, q: Array) -> Reference:
    """Rows of a slower track in a faster table are left out; the others stay, NaN where nothing was seen."""
    seen = np.flatnonzero(~np.isnan(q).any(axis=1))
    if len(seen) >= 3 and np.partition(np.diff(seen), len(seen) // 2 - 1)[len(seen) // 2 - 1] >= 2:
        return Reference(t[seen], q[seen])
    return Reference(t, q)


def _movement(table: Table) -> tuple[Array, Mask]:
    values = _columns(table, ["t_s", "movement"])
    order = np.argsort(values[:, 0], kind="stable")
    return values[order, 0], values[order, 1] > 0


def _batches(table: Table, index: list[int], take: dict[int, Any]) -> Iterator[Any]:
    try:
        yield from table.batches(index, take)
    except InputError as error:
        raise InputError(without_options(str(error))) from error


def _columns(table: Table, wanted: list[str]) -> Array:
    """The columns (N, k) as numbers; booleans count as 0 and 1."""
    names = _lower(table)
    for name in wanted:
        if (count := names.count(name)) != 1:
            what = "no column" if not count else "more than one column"
            mend = "; name the time in seconds t_s" if name == "t_s" else "; each may be there once"
            raise InputError(f"{table.file}: {what} {name}{mend}")
    index = [names.index(n) for n in wanted]
    take = {k: "own" if n == "movement" else "number" for k, n in zip(index, wanted)}
    blocks = []
    for batch in _batches(table, index, take):
        try:
            blocks.append(np.column_stack([numbers(batch.column(j)) for j in range(len(index))]))
        except (TypeError, ValueError) as error:
            raise InputError(f"{table.file}: column movement holds something else than 0 and 1; correct it") from error
    if not blocks:
        raise InputError(f"{table.file}: holds no rows; record or export it again")
    return np.concatenate(blocks)
