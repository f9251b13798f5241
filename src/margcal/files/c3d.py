"""Marker tracks from C3D files: the layout is checked here, the points are read by ezc3d (optional extra `io`).

A cut or damaged C3D file makes ezc3d return fewer frames without a word, loop, or end the process. So the header, the
chain of parameters and the size of the data that they promise are held against the file's own size first; nothing is
allocated before.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from margcal.core.checking import printable
from margcal.core.errors import InputError, UsageError
from margcal.core.types import Array

BLOCK = 512
"""Bytes: C3D counts in these."""

_INTEL, _DEC, _MIPS = 84, 85, 86
_SIZES = {-1: 1, 1: 1, 2: 2, 4: 4}
"""Bytes of an element by a parameter's type: character, byte, integer, real."""

MOST_PARAMETERS = 1 << 20
"""Bytes of parameters: far more than any program writes."""


@dataclass(frozen=True)
class Layout:
    """What the header promises: points and analog values a frame, frames, bytes a value, where the data begin."""

    points: int
    analog: int
    first_frame: int
    frames: int
    value_bytes: int
    data_offset: int


@dataclass(frozen=True)
class Points:
    """Tracks as they are in the file: `x` (N, M, 3) in `unit` (lower case, empty where none is stated), NaN unseen."""

    names: tuple[str, ...]
    t: Array
    x: Array
    unit: str
    first_frame: int


def read_points(path: Path, max_bytes: int) -> Points:
    """The points of a C3D file.

    Raises
    ------
    InputError
        Not there, larger than `max_bytes`, no C3D file, cut or damaged, without points or rate.
    UsageError
        ezc3d is not installed.
    """
    layout = check_layout(path, max_bytes)
    try:
        import ezc3d  # type: ignore[import-untyped]
    except ImportError as error:
        raise UsageError(
            f"{printable(path.name)}: C3D files need the package ezc3d; install it with pip install 'margcal[io]'"
        ) from error
    try:
        return _points_of(ezc3d.c3d(str(path)), layout, printable(path.name))
    except (OSError, ValueError, RuntimeError, KeyError, IndexError, TypeError, MemoryError) as error:
        raise _damaged(path, printable(error, 120)) from error


def check_layout(path: Path, max_bytes: int) -> Layout:
    """`Layout` of the file, every length in it held against the file's size.

    Raises
    ------
    InputError
    """
    try:
        size = path.stat().st_size
        with open(path, "rb") as file:
            head = file.read(BLOCK)
            start = BLOCK * (head[0] - 1) if head else 0
            file.seek(max(start, 0))
            parameters = file.read(MOST_PARAMETERS)
    except OSError as error:
        raise InputError(f"{printable(path)}: cannot be read ({error.strerror})") from error
    if size > max_bytes:
        raise InputError(
            f"{printable(path.name)}: {size / 1e9:.1f} GB is more than is read into memory ({max_bytes / 1e9:.1f} GB); "
            "export the part that is needed"
        )
    if len(head) < BLOCK or head[1] != 0x50 or head[0] < 2 or len(parameters) < 4 or parameters[1] not in (0, 0x50):
        raise InputError(
            f"{printable(path.name)}: is no C3D file, or is cut ({size} bytes); export it again from the "
            "motion-capture program"
        )
    processor = parameters[3]
    if processor not in (_INTEL, _DEC, _MIPS):
        raise _damaged(path, f"processor type {processor} is none of 84, 85, 86")
    order = ">" if processor == _MIPS else "<"
    found = _parameters(path, parameters[: BLOCK * parameters[2]] if parameters[2] else parameters, order)
    layout = _layout(path, head, order, processor)
    _check_sizes(path, layout, size, found)
    return layout


def _layout(path: Path, head: bytes, order: str, processor: int) -> Layout:
    words = np.frombuffer(head, order + "u2")
    first, last = int(words[3]), int(words[4])
    scale = _real(head[12:16], order, processor)
    if last < first:
        raise _damaged(path, f"its last frame ({last}) is before its first ({first})")
    value_bytes, data_offset = 4 if scale < 0 else 2, BLOCK * (int(words[8]) - 1)
    return Layout(int(words[1]), int(words[2]), first, last - first + 1, value_bytes, data_offset)


def _real(raw: bytes, order: str, processor: int) -> float:
    """A real number of the header; DEC's floats have their halves swapped and are four times as large."""
    if processor == _DEC:
        raw = raw[2:4] + raw[0:2]
        return float(np.frombuffer(raw, "<f4")[0]) / 4
    return float(np.frombuffer(raw, order + "f4")[0])


def _check_sizes(path: Path, layout: Layout, size: int, found: dict[str, Any]) -> None:
    frame = layout.value_bytes * (4 * layout.points + layout.analog)
    if not layout.points:
        raise InputError(f"{printable(path.name)}: holds no marker points; export the trial with its trajectories")
    if not BLOCK < layout.data_offset < size:
        raise _damaged(path, f"its data would begin at byte {layout.data_offset} of {size}")
    have = size - layout.data_offset
    if frame * layout.frames > have:
        raise _damaged(
            path,
            f"its header promises {layout.frames} frames of {frame} bytes, and {have // frame} are there",
        )
    promised = max(_counts(found.get("POINT:FRAMES")), _counts(found.get("POINT:LONG_FRAMES")))
    if frame * promised > have:
        raise _damaged(path, f"its parameters promise {promised:g} frames of {frame} bytes, and {have // frame} fit")
    if (used := found.get("POINT:USED")) is not None and _counts(used) != layout.points:
        raise _damaged(path, f"header and parameters disagree ({layout.points} and {_counts(used):g} points)")


def _counts(value: Any) -> float:
    """The first number of a parameter, as the unsigned number that it stands for."""
    if value is None or not isinstance(value, np.ndarray) or not value.size:
        return 0.0
    number = float(value.flat[0])
    return number % 65536 if value.dtype.kind == "i" else number if np.isfinite(number) else np.inf


def _parameters(path: Path, raw: bytes, order: str) -> dict[str, Any]:
    """``GROUP:NAME`` -> numbers, or None for text; every entry must end within `raw` and lead on to the next."""
    groups: dict[int, str] = {}
    entries: list[tuple[int, str, Any]] = []
    at = 4
    while at < len(raw) and raw[at]:
        length, group = abs(_signed(raw[at])), _signed(raw[at + 1]) if at + 1 < len(raw) else 0
        step_at = at + 2 + length
        if not group or step_at + 2 > len(raw):
            raise _damaged(path, f"the parameter section breaks off at byte {at}")
        name = raw[at + 2 : step_at].decode("latin-1").upper()
        if not (length and name.isascii() and name.isprintable()):
            raise _damaged(path, f"the name of a parameter at byte {at} is no text")
        step = int(np.frombuffer(raw[step_at : step_at + 2], order + "i2")[0])
        end = len(raw) if step == 0 else step_at + step
        if step < 0 or end > len(raw):
            raise _damaged(path, f"parameter {printable(name, 40)!r} leads out of the parameter section")
        if group < 0:
            groups[-group] = name
            _check_text(path, raw, step_at + 2, end, name)
        else:
            entries.append((group, name, _value(path, raw, step_at + 2, end, name, order)))
        if step == 0:
            break
        at = end
    if not {"POINT"} <= set(groups.values()):
        raise _damaged(path, "it has no parameter group POINT")
    orphans = sorted({n for g, n, _ in entries if g not in groups})
    if orphans:
        raise _damaged(path, f"parameter {printable(orphans[0], 40)!r} belongs to no group")
    return {f"{groups[g]}:{name}": value for g, name, value in entries}


def _value(path: Path, raw: bytes, at: int, end: int, name: str, order: str) -> Any:
    if at + 2 > end:
        raise _damaged(path, f"parameter {printable(name, 40)!r} is cut")
    kind, n_dims = _signed(raw[at]), raw[at + 1]
    # a character without a dimension is allowed by the format; no program writes it, and ezc3d ends the process
    if kind not in _SIZES or n_dims > 7 or at + 2 + n_dims > end or (kind == -1 and n_dims == 0):
        raise _damaged(path, f"parameter {printable(name, 40)!r} has type {kind} and {n_dims} dimensions")
    dims = list(raw[at + 2 : at + 2 + n_dims])
    begin = at + 2 + n_dims
    stop = begin + _SIZES[kind] * int(np.prod(dims, dtype=np.int64))
    if stop > end:
        raise _damaged(path, f"parameter {printable(name, 40)!r} is longer than its place")
    _check_text(path, raw, stop, end, name)
    if kind == -1:
        return None
    return np.frombuffer(raw[begin:stop], {1: "i1", 2: order + "i2", 4: order + "f4"}[kind])


def _check_text(path: Path, raw: bytes, at: int, end: int, name: str) -> None:
    """The description that ends an entry."""
    if at < end and at + 1 + raw[at] > end:
        raise _damaged(path, f"the description of {printable(name, 40)!r} is longer than its place")


def _signed(byte: int) -> int:
    return byte - 256 if byte > 127 else byte


def _points_of(file: Any, layout: Layout, name: str) -> Points:
    point = file["parameters"]["POINT"]
    x = np.array(file["data"]["points"][:3], dtype=np.float64).transpose(2, 1, 0)  # (3, M, N) -> (N, M, 3)
    residual = np.asarray(file["data"]["meta_points"]["residuals"], dtype=np.float64)[0].T
    if residual.shape == x.shape[:2]:
        x[residual < 0] = np.nan
    rate = float(point["RATE"]["value"][0]) if "RATE" in point and len(point["RATE"]["value"]) else 0.0
    if not (np.isfinite(rate) and 0 < rate < 1e5):
        raise InputError(f"{name}: its frame rate is {rate:g} Hz; export it again with the rate set")
    unit = point["UNITS"]["value"][0].strip() if "UNITS" in point and len(point["UNITS"]["value"]) else ""
    labels = _labels(point, x.shape[1])
    return Points(labels, np.arange(len(x)) / rate, x, printable(unit, 20).lower(), layout.first_frame)


def _labels(point: Any, count: int) -> tuple[str, ...]:
    """LABELS, LABELS2, LABELS3 ... joined; points beyond them are named by their number."""
    found: list[str] = []
    for k in range(1, 1 + (count + 254) // 255):
        key = "LABELS" if k == 1 else f"LABELS{k}"
        if key in point:
            found += [printable(str(v).strip(), 80) for v in point[key]["value"]]
    found = found[:count] + [""] * (count - len(found))
    return tuple(v or f"point{k + 1}" for k, v in enumerate(found))


def _damaged(path: Path, reason: str) -> InputError:
    return InputError(f"{printable(path.name)}: the C3D file is cut or damaged ({reason}); copy or export it again")
