"""The small matrices of a MATLAB 5 to 7 file, read strictly.

scipy's reader follows the sizes that a file states: on files with a flipped bit it was seen to end the process with a
segmentation fault, and a compressed variable may unpack to anything. Here every length is checked against the bytes
that are there. Only real matrices of numbers and rows of characters are read; structures, cells, objects, functions
and sparse or complex matrices are named by their class and never unpacked.

From       MathWorks, "MAT-File Format" (level 5): header, tags, small elements, miMATRIX, miCOMPRESSED.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from margcal.core.errors import InputError
from margcal.core.types import Array

LARGEST_UNPACKED = 4_000_000
MOST_ELEMENTS = 10_000

_CLASSES = {1: "cell", 2: "struct", 3: "object", 4: "char", 5: "sparse", 6: "double", 7: "single", 16: "function"}
_NUMBERS = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    9: "f8",
    12: "i8",
    13: "u8",
    16: "u1",
    17: "u2",
}
_MATRIX, _COMPRESSED = 14, 15
_COMPLEX = 0x0800


@dataclass(frozen=True)
class Variable:
    """One variable: its class in words, and its value if it is a small matrix of numbers (2-D) or text."""

    name: str
    kind: str
    value: Array | str | None


class _Damaged(Exception):
    """The bytes are not what the format says."""


def read(data: bytes, name: str) -> dict[str, Variable]:
    """The variables in `data` by name; messages call the file `name`.

    Raises
    ------
    InputError
        It is no MATLAB file of level 5, or damaged.
    """
    if data[:8] == b"\x89HDF\r\n\x1a\n" or b"MATLAB 7.3" in data[:128]:
        raise InputError(f"{name}: is a MATLAB 7.3 file; save it again with save(..., '-v7')")
    order = {b"IM": "<", b"MI": ">"}.get(bytes(data[126:128]))
    if len(data) < 128 or order is None:
        raise InputError(f"{name}: is no MATLAB file of version 5 to 7")
    found: dict[str, Variable] = {}
    try:
        for kind, body in _elements(data[128:], order):
            if kind == _COMPRESSED:
                inner = zlib.decompressobj()
                unpacked = inner.decompress(body, LARGEST_UNPACKED)
                if inner.unconsumed_tail:
                    raise InputError(f"{name}: a variable unpacks to more than 4 MB; this is no calibration")
                kind, body = next(_elements(unpacked, order), (0, b""))
            if kind == _MATRIX:
                variable = _variable(body, order)
                found[variable.name] = variable
    except (_Damaged, struct.error, zlib.error, ValueError, OverflowError) as error:
        raise InputError(f"{name}: is a damaged MATLAB file") from error
    return found


def _elements(data: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    """Type and bytes of each data element; those of four bytes or fewer may stand in their own tag."""
    at = 0
    while at + 8 <= len(data):
        first, size = struct.unpack(order + "II", data[at : at + 8])
        if first >> 16:  # small: size in the upper half, data in the second word
            kind, size, start, step = first & 0xFFFF, first >> 16, at + 4, 8
            if size > 4:
                raise _Damaged
        else:
            kind, start = first, at + 8
            step = 8 + (size if kind == _COMPRESSED else (size + 7) // 8 * 8)
        if start + size > len(data):
            raise _Damaged
        yield kind, data[start : start + size]
        at += step


def _variable(body: bytes, order: str) -> Variable:
    parts = list(_elements(body, order))
    if len(parts) < 3 or len(parts[0][1]) != 8:
        raise _Damaged
    (flags,) = struct.unpack(order + "I", parts[0][1][:4])
    kind = _CLASSES.get(flags & 0xFF, "integer" if 8 <= flags & 0xFF <= 15 else "unknown")
    shape = tuple(int(n) for n in np.frombuffer(parts[1][1], dtype=f"{order}i4"))
    name = parts[2][1].decode("ascii", errors="replace")
    if kind not in ("double", "single", "integer", "char") or flags & _COMPLEX or len(parts) < 4:
        return Variable(name, "complex" if flags & _COMPLEX else kind, None)
    if len(shape) != 2 or min(shape) < 0 or shape[0] * shape[1] > MOST_ELEMENTS:
        return Variable(name, kind, None)
    code = _NUMBERS.get(parts[3][0])
    if code is None:
        raise _Damaged
    values = np.frombuffer(parts[3][1], dtype=f"{order}{code}")
    if values.size != shape[0] * shape[1]:
        raise _Damaged
    if kind == "char":
        return Variable(name, kind, "".join(map(chr, values)) if shape[0] <= 1 else None)
    return Variable(name, kind, values.astype(np.float64).reshape(shape, order="F"))
