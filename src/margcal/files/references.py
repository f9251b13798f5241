"""The attitude from outside, from whatever file it is in: `read_reference`.

Quaternion columns (`ref_qw` ... or `qw` ...), marker columns, a C3D file, or a folder that holds one of these.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from margcal.core.checking import printable, without_options
from margcal.core.errors import InputError
from margcal.core.types import Reference
from margcal.files.batches import Table, is_table, open_table
from margcal.files.markers import Template, marker_columns, marker_reference, markers_of, read_markers
from margcal.files.tables import MAX_BYTES, _load, _reference, _time

_POSITION = re.compile(r"(?:ref_)?p_([xyz])_(m|mm|cm)", re.IGNORECASE)
_METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}


def read_reference(
    path: str | os.PathLike[str],
    *,
    markers: Sequence[str] | None = None,
    template: Template | None = None,
    unit: str | None = None,
    rate: float | None = None,
    max_bytes: int = MAX_BYTES,
) -> Reference:
    """The reference attitude (and position) in a table, a C3D file or a folder, as it was recorded.

    What is taken, in this order: marker tracks where `markers` or `template` is given, `ref_qw ref_qx ref_qy ref_qz`,
    `qw qx qy qz`, marker tracks. A folder must hold one such file only, after this order. Nothing is mended here:
    see `workflow.reference.clean_reference`.

    Parameters
    ----------
    path : path-like
    markers, template, unit
        For marker tracks: see `files.markers.marker_reference` and `read_markers`.
    rate : float, Hz, optional
        Take time from the row number instead of `t_s`.
    max_bytes : int

    Returns
    -------
    Reference
        Body to laboratory, scalar first, m; a `MarkerReference`, with the residual a frame, where it is of markers.

    Raises
    ------
    InputError
        Nothing of the kind is there; in a folder, more than one; or as the readers say.
    """
    path = Path(path)
    if rate is not None and not (np.isfinite(rate) and rate > 0):
        raise InputError(f"rate: {rate} is no frame rate; give frames per second")
    want_markers = markers is not None or template is not None
    if path.is_dir():
        path = _one_of(path, want_markers)
    if path.suffix.lower() == ".c3d":
        tracks = read_markers(path, unit=unit, max_bytes=max_bytes)
        return marker_reference(tracks, names=markers, template=template)
    _refuse_exports(path)
    table = open_table(path)
    if want_markers or _kind(table) == "markers":
        tracks = markers_of(table, unit=unit, rate=rate, max_bytes=max_bytes)
        return marker_reference(tracks, names=markers, template=template)
    if table.size > max_bytes:
        raise InputError(f"{table.file}: {table.size / 1e9:.1f} GB is more than is read into memory; cut it")
    return _quaternions(table, rate)


_EXPORTS = {
    b"Format Version,": "an OptiTrack Motive export: export C3D, or make a table t_s, qw, qx, qy, qz of its columns "
    "(Motive writes the quaternion X, Y, Z, W, y is up, and the units are in the header)",
    b"NO_OF_FRAMES": "a Qualisys TSV export: export C3D, or make a table t_s, qw, qx, qy, qz of its 6D columns "
    "(Rot[0] to Rot[8] hold the matrix column by column, lengths are mm)",
    b"PathFileType": "a TRC file: export C3D, or make a table t_s, name_x_mm, name_y_mm, name_z_mm of its columns",
}
"""How exports of motion-capture programs begin that are no table of ours, and what to do."""


def _refuse_exports(path: Path) -> None:
    """Refuse what would be read as a table with odd columns."""
    try:
        with open(path, "rb") as file:
            head = file.read(32).removeprefix(b"\xef\xbb\xbf")
    except OSError:
        return  # `open_table` says why
    for begin, what in _EXPORTS.items():
        if head.startswith(begin):
            raise InputError(f"{printable(path.name)}: this is {what}")


def _kind(table: Table) -> str | None:
    """``ref``, ``attitude`` or ``markers``: the first of what its columns hold."""
    lower = {n.strip().lower() for n in table.names}
    if any(n.startswith("ref_q") for n in lower):
        return "ref"
    if lower >= {"qw", "qx", "qy", "qz"}:
        return "attitude"
    return "markers" if len(marker_columns(table.names)) >= 3 else None


def _one_of(folder: Path, want_markers: bool) -> Path:
    """The file of a folder that holds the reference."""
    found: dict[str, list[Path]] = {"ref": [], "attitude": [], "markers": []}
    try:
        members = sorted(p for p in folder.iterdir() if p.is_file() and not p.name.startswith("."))
    except OSError as error:
        raise InputError(f"{printable(folder)}: cannot be read ({error.strerror})") from error
    for member in members:
        if member.suffix.lower() == ".c3d":
            found["markers"].append(member)
        elif is_table(member):
            table = open_table(member)
            kind = _kind(table)
            if want_markers:
                kind = "markers" if len(marker_columns(table.names)) >= 3 else None
            if kind is not None:
                found[kind].append(member)
    for files in found.values():
        if len(files) == 1:
            return files[0]
        if files:
            names = ", ".join(printable(f.name, 40) for f in files)
            raise InputError(f"{printable(folder)}: the reference may be any of {names}; give the one that is meant")
    raise InputError(
        f"{printable(folder)}: no reference: no table with ref_qw ref_qx ref_qy ref_qz (or qw qx qy qz) or marker "
        "columns such as heel_x_mm, and no C3D file"
    )


def _quaternions(table: Table, rate: float | None) -> Reference:
    lower = [n.strip().lower() for n in table.names]
    twice = next((n for n in lower if n and lower.count(n) > 1), None)
    if twice is not None:
        raise InputError(f"{table.file}: column name {printable(twice)!r} is there twice; rename one")
    prefix = "ref_q" if any(n.startswith("ref_q") for n in lower) else "q"
    wanted = [prefix + c for c in "wxyz"]
    missing = [n for n in wanted if n not in lower]
    if missing:
        listed = ", ".join(printable(n, 40) for n in table.names[:40])
        what = "no reference" if prefix == "q" else f"no {' and '.join(missing)}"
        raise InputError(f"{table.file}: {what} among its columns ({listed}); name them {' '.join(wanted)}")
    if rate is None and "t_s" not in lower:
        raise InputError(f"{table.file}: no column t_s; name the time in seconds t_s")
    groups = {"q": tuple(lower.index(n) for n in wanted)}
    p_columns, factor = _position(lower, table.file)
    if p_columns:
        groups["p"] = p_columns
    if rate is None:
        groups["t"] = (lower.index("t_s"),)
    try:
        values = _load(table, groups, 0, None)
    except InputError as error:
        raise InputError(without_options(str(error))) from error
    t = np.arange(len(values["q"])) / rate if rate is not None else _time(values["t"][:, 0], table)
    return _reference(t, values["q"], values["p"] * factor if p_columns else None)


def _position(lower: list[str], file: str) -> tuple[tuple[int, ...], float]:
    matches = {k: m for k, n in enumerate(lower) if (m := _POSITION.fullmatch(n))}
    own = {k: m for k, m in matches.items() if lower[k].startswith("ref_")} or matches
    axes, units = {m[1]: k for k, m in own.items()}, {m[2] for m in own.values()}
    if not axes:
        return (), 1.0
    if len(axes) < 3 or len(own) > 3 or len(units) > 1:
        raise InputError(f"{file}: the reference position needs ref_p_x, ref_p_y and ref_p_z in one unit (m, cm or mm)")
    return (axes["x"], axes["y"], axes["z"]), _METRES[units.pop()]
