"""Optical markers: tracks from C3D files and tables, and the attitude of the rigid body that carries them.

A table has a column a coordinate, the marker's name first: `heel_x_mm`, `heel_y_mm`, `heel_z_mm` (`_m`, `_cm`, `_in`),
beside `t_s`. The attitude is that of `core.rigid_body`: its docstring says what frame the body has.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from margcal.core import rigid_body, so3
from margcal.core.checking import printable, without_options
from margcal.core.errors import InputError
from margcal.core.rigid_body import MarkerReference
from margcal.core.types import Array
from margcal.files.batches import Table, open_table
from margcal.files.tables import MAX_BYTES, _load, _time

METRES = {"m": 1.0, "meters": 1.0, "metres": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254, "inches": 0.0254}
"""Length units by their spelling in column names and in C3D files."""

RIGID_M = 0.01
"""Distances between markers of one body may vary by this much (robust standard deviation): skin and shoes do."""

LARGEST_ROOM_M = 20.0
"""Markers farther apart are not in metres."""

_COLUMN = re.compile(r"(.+?)_([xyz])(?:_(m|cm|mm|in))?", re.IGNORECASE)
_NOT_MARKERS = re.compile(r"(acc|gyr|mag|ref_p|p|v|vel|pos|gravity|euler)", re.IGNORECASE)
_UNLABELLED = re.compile(r"\*|uname|unlabel|_\d+$", re.IGNORECASE)
"""How the programs name trajectories that nobody has named."""

Template = Mapping[str, ArrayLike] | MarkerReference | str | os.PathLike[str]


@dataclass(frozen=True)
class Markers:
    """Tracks of M markers: `t` (N,) s, `x` (N, M, 3) m in the laboratory, NaN where not seen."""

    names: tuple[str, ...]
    t: Array
    x: Array
    source: str = "markers"

    def select(self, wanted: Sequence[str]) -> Markers:
        """The markers that `wanted` names, in that order; ``node1*`` stands for all that begin so.

        Raises
        ------
        InputError
            If one is not there.
        """
        index: list[int] = []
        for name in wanted:
            hits = [k for k, n in enumerate(self.names) if n == name]
            hits = hits or [k for k, n in enumerate(self.names) if fnmatchcase(n.lower(), name.lower())]
            if not hits:
                raise InputError(f"{self.source}: no marker {printable(name, 40)!r}; there are {_listed(self.names)}")
            index += [k for k in hits if k not in index]
        return replace(self, names=tuple(self.names[k] for k in index), x=self.x[:, index])


def read_markers(
    path: str | os.PathLike[str],
    *,
    unit: str | None = None,
    rate: float | None = None,
    max_bytes: int = MAX_BYTES,
) -> Markers:
    """Marker tracks of a C3D file or a table (CSV, Parquet).

    Parameters
    ----------
    path : path-like
    unit : {'m', 'cm', 'mm', 'in'}, optional
        Needed where neither the file nor its columns state one; against a stated one it is refused.
    rate : float, Hz, optional
        Take time from the row number instead of `t_s` (tables only: a C3D file states its rate).
    max_bytes : int
        Refuse larger files.

    Returns
    -------
    Markers
        Time of a C3D file counts from its first stored frame. A point with residual -1, or at exactly (0, 0, 0), was
        not seen.

    Raises
    ------
    InputError
        With what is wrong with the file, and how to mend it.
    UsageError
        For a C3D file without ezc3d.
    """
    path = Path(path)
    if unit is not None and unit not in METRES:
        raise InputError(f"unit of the markers: {printable(unit, 40)!r} is none of m, cm, mm, in")
    if path.suffix.lower() == ".c3d":
        from margcal.files.c3d import read_points

        points = read_points(path, max_bytes)
        factor = _factor(points.unit, unit, printable(path.name))
        return _masked(Markers(points.names, points.t, points.x * factor, printable(path.name)))
    return markers_of(open_table(path), unit=unit, rate=rate, max_bytes=max_bytes)


def marker_columns(names: Sequence[str]) -> dict[str, dict[str, tuple[int, str]]]:
    """marker -> axis -> (column number, unit or empty) of every column name that looks like a marker's coordinate."""
    found: dict[str, dict[str, tuple[int, str]]] = {}
    for k, name in enumerate(names):
        match = _COLUMN.fullmatch(name.strip())
        if match and not _NOT_MARKERS.fullmatch(match[1]):
            found.setdefault(match[1], {})[match[2].lower()] = (k, (match[3] or "").lower())
    return {name: axes for name, axes in found.items() if len(axes) == 3}


def markers_of(
    table: Table, *, unit: str | None = None, rate: float | None = None, max_bytes: int = MAX_BYTES
) -> Markers:
    """As `read_markers`, of a table that is open."""
    columns = marker_columns(table.names)
    if len(columns) < 3:
        raise InputError(
            f"{table.file}: {len(columns)} markers among its columns ({_listed(table.names)}); three or more are "
            "needed, named such as heel_x_mm, heel_y_mm, heel_z_mm"
        )
    if table.size > max_bytes:
        raise InputError(f"{table.file}: {table.size / 1e9:.1f} GB is more than is read into memory; cut it")
    lower = [n.strip().lower() for n in table.names]
    if twice := [n for n in lower if n and lower.count(n) > 1]:
        raise InputError(f"{table.file}: column name {printable(twice[0])!r} is there twice; rename one")
    if "t_s" not in lower and rate is None:
        raise InputError(f"{table.file}: no column t_s; name the time in seconds t_s, or declare the frame rate")
    factors = {name: _unit_of(name, axes, unit, table.file) for name, axes in columns.items()}
    groups = {name: tuple(axes[a][0] for a in "xyz") for name, axes in columns.items()}
    if rate is None:
        groups["t_s"] = (lower.index("t_s"),)
    try:
        values = _load(table, groups, 0, None)
    except InputError as error:
        raise InputError(without_options(str(error))) from error
    x = np.stack([values[name] * factors[name] for name in columns], axis=1)
    t = np.arange(len(x)) / rate if rate is not None else _time(values["t_s"][:, 0], table)
    return _masked(Markers(tuple(printable(n, 80) for n in columns), t, x, table.file))


def marker_reference(
    markers: Markers, *, names: Sequence[str] | None = None, template: Template | None = None
) -> MarkerReference:
    """Attitude and position of the rigid body that carries the markers.

    Parameters
    ----------
    markers : Markers
    names : sequence of str, optional
        The markers of the body, in order (``node1*`` for all that begin so). Without it all named markers are taken,
        and must keep their distances.
    template : mapping of name to (3,) m, MarkerReference, or path, optional
        The markers' places in the body's frame: told, of an earlier trial, or a file with the means of the tracks.
        Without it the shape is that of this recording, and the first marker is the origin, the second lies on x, the
        third in the plane of x and y (`core.rigid_body.mean_shape`). Trials of one body: give the first one's result
        to the others, so that their frames are the same to the last digit.

    Returns
    -------
    MarkerReference
        NaN where fewer than three markers are seen; `residual` is kept a frame.

    Raises
    ------
    InputError
        If markers are missing, or do not keep their distances: then the groups that do are named.
    DataError
        If the markers lie on a line, or are never seen together.
    """
    shape = None
    if template is not None:
        places = _template(template)
        wanted = list(names) if names is not None else [n for n in places if n in markers.names]
        used = markers.select(wanted) if wanted else replace(markers, names=(), x=markers.x[:, :0])
        missing = [n for n in used.names if n not in places]
        if missing or len(used.names) < 3:
            raise InputError(
                f"{markers.source}: the template has {_listed(tuple(places))}, the recording {_listed(markers.names)}; "
                "three or more markers must be in both"
            )
        shape = np.array([places[n] for n in used.names], dtype=np.float64)
        rigid_body.frame_markers(shape)
    elif names is not None:
        used = markers.select(names)
    else:
        keep = [n for n in markers.names if not _UNLABELLED.match(n)]
        used = markers.select(keep) if len(keep) >= 3 else markers
    if len(used.names) < 3:
        raise InputError(f"{markers.source}: {_listed(used.names)}: an attitude needs three markers or more")
    _check_rigid(used)
    shape = rigid_body.mean_shape(used.x) if shape is None else shape
    found = rigid_body.fit(used.x, shape)
    q = np.full((len(used.t), 4), np.nan)
    seen = np.isfinite(found.residual)
    q[seen] = so3.quat_from_matrix(found.R[seen])
    return MarkerReference(used.t, q, found.p, found.residual, used.names, shape)


def _template(template: Template) -> dict[str, Array]:
    if isinstance(template, MarkerReference):
        return dict(zip(template.names, template.shape))
    if isinstance(template, Mapping):
        places = {str(k): np.asarray(v, dtype=np.float64) for k, v in template.items()}
        for name, place in places.items():
            if place.shape != (3,) or not np.isfinite(place).all():
                raise InputError(f"template: {printable(name, 40)} must have three finite coordinates in metres")
        return places
    tracks = read_markers(template, rate=1.0)
    tracked = [k for k in range(len(tracks.names)) if np.isfinite(tracks.x[:, k]).any()]
    return {tracks.names[k]: np.nanmean(tracks.x[:, k], axis=0) for k in tracked}


def _check_rigid(markers: Markers) -> None:
    sd = rigid_body.edges_sd(markers.x)
    if not np.isfinite(sd).any():
        raise InputError(f"{markers.source}: no two of the markers {_listed(markers.names)} are ever seen together")
    worst = np.unravel_index(int(np.nanargmax(sd)), sd.shape)
    if sd[worst] <= RIGID_M:
        return
    a, b = (markers.names[k] for k in worst)
    apart = float(np.nanmedian(np.linalg.norm(markers.x[:, worst[0]] - markers.x[:, worst[1]], axis=1)))
    if apart > LARGEST_ROOM_M:
        raise InputError(
            f"{markers.source}: {printable(a, 40)} and {printable(b, 40)} are {apart:.0f} m apart: millimetres taken "
            "for metres? Name the columns by their unit (_mm, _m), or declare it (--marker-unit)"
        )
    groups = [g for g in _groups(sd) if len(g) >= 3]
    hint = "; ".join(", ".join(markers.names[k] for k in g) for g in groups[:6])
    mend = f"name those of one body: {hint}" if groups else "no three of them belong to one rigid body"
    raise InputError(
        f"{markers.source}: the markers are not on one rigid body (the distance of {printable(a, 40)} and "
        f"{printable(b, 40)} varies by {1e3 * sd[worst]:.0f} mm); {mend}"
    )


def _groups(sd: Array) -> list[list[int]]:
    """Markers that keep their distances to all others of their group, in the file's order."""
    groups: list[list[int]] = []
    for k in range(len(sd)):
        home = next((g for g in groups if all(sd[k, j] <= RIGID_M for j in g)), None)
        if home is None:
            groups.append([k])
        else:
            home.append(k)
    return groups


def _unit_of(name: str, axes: Mapping[str, tuple[int, str]], declared: str | None, file: str) -> float:
    stated = {u for _, u in axes.values()}
    if len(stated) > 1:
        raise InputError(f"{file}: marker {printable(name, 40)} has its axes in different units; name them alike")
    return _factor(stated.pop(), declared, f"{file}: marker {printable(name, 40)}")


def _factor(stated: str, declared: str | None, where: str) -> float:
    if stated and stated not in METRES:
        if declared is None:
            raise InputError(f"{where}: its length unit is {stated!r}; declare m, cm, mm or in (--marker-unit)")
        stated = ""
    if stated and declared is not None and METRES[stated] != METRES[declared]:
        raise InputError(f"{where}: is in {stated}, and {declared} was declared; leave the declaration out")
    if not stated and declared is None:
        raise InputError(f"{where}: no length unit; end the column names in _mm or _m, or declare it (--marker-unit)")
    return METRES[stated or declared or ""]


def _masked(markers: Markers) -> Markers:
    """Infinite values refused; a marker at exactly (0, 0, 0) was not seen, nor was one without a coordinate."""
    x = np.array(markers.x)
    if np.isinf(x).any():
        row = int(np.argmax(np.isinf(x).any(axis=(1, 2))))
        raise InputError(f"{markers.source}: an infinite coordinate in frame {row + 1}; leave such cells empty")
    gone = np.isnan(x).any(axis=2) | (x == 0).all(axis=2)
    x[gone] = np.nan
    return replace(markers, x=x)


def _listed(names: Sequence[str]) -> str:
    shown = ", ".join(printable(n, 40) for n in names[:20])
    return f"{shown} and {len(names) - 20} more" if len(names) > 20 else shown or "nothing"
