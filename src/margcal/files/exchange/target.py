"""What every target and source is made of: how it states one sensor, and how its file is written and read.

A file of another program states a sensor by *fields*, arrays under that program's own names. A `Form` is one such
statement: the formula in the program's own words, what of H it can hold, units, ranges, and three functions:
`encode` (H, B -> fields), `decode` (fields -> H, B) and `apply`, which calibrates a reading as that program does.
`decode` and `apply` are written down separately, so that each proves the other. A `Target` is a kind of file: the forms
of its sensors, and how pages of fields become bytes and bytes become fields.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from margcal.core.types import Array
from margcal.core.units import Kind

Matrix = Literal["full", "lower", "symmetric", "diagonal", "scalar", "unit"]
"""What of H a form holds: all of it, a lower triangle, a symmetric matrix, a scale an axis, one scale, or nothing."""

Fields = Mapping[str, Any]
Vectors = tuple[Array, Array]
"""Ten raw readings (10, 3) and what the target makes of them (10, 3)."""

MAX_BYTES = 500_000
"""No calibration in any of these formats is larger."""


@dataclass(frozen=True)
class Range:
    """Values of `name` (one of the fields) that the target takes; `hard`: it refuses or clips what lies outside."""

    name: str
    low: float
    high: float
    unit: str = ""
    hard: bool = True
    shown: str = ""


@dataclass(frozen=True)
class Form:
    """How a kind of file states one sensor.

    Attributes
    ----------
    formula : str
        Calibrated from raw `y`, in the target's own letters.
    encode : callable, (H, B, R) -> fields
        H (3, 3) and B (3,) in the units below. R (3, 3): the rotation that the file holds apart from H (a board
        orientation, a moved frame), the identity elsewhere; H includes it.
    decode : callable, fields -> (H, B)
    apply : callable, (fields, y (n, 3)) -> u (n, 3)
    matrix : what of H it holds; `bias`: whether it holds B.
    raw : tuple of str
        Units of raw readings that the target takes, as spelled in column names; empty: any.
    unit : str
        Unit of the calibrated vector, as spelled in column names; empty: that of the calibration.
    board : {'', 'before', 'after'}
        Whether a board orientation (see `fitting.ORIENTATIONS`) is applied before or after the matrix.
    group : str
        Sensors of one group share one board orientation.
    movable : bool
        Whether the file's frame may be turned so that H fits `matrix`, the turn being kept beside it.
    nominal : bool
        Whether the target multiplies by a nominal sensitivity that the file does not hold.
    step : callable, fields -> float, or None
        The step in which results come (fixed point), `unit`.
    """

    formula: str
    encode: Callable[[Array, Array, Array], Fields]
    decode: Callable[[Fields], tuple[Array, Array]]
    apply: Callable[[Fields, Array], Array]
    matrix: Matrix = "full"
    bias: bool = True
    raw: tuple[str, ...] = ()
    unit: str = ""
    board: Literal["", "before", "after"] = ""
    group: str = ""
    movable: bool = False
    nominal: bool = False
    ranges: tuple[Range, ...] = ()
    step: Callable[[Fields], float] | None = None


@dataclass(frozen=True)
class Sensor:
    """One sensor on a page: its fields and the units of what goes in and comes out (None: the file does not say)."""

    fields: Fields
    raw_unit: str | None = None
    unit: str | None = None
    vectors: Vectors | None = None
    dropped: str = ""


@dataclass(frozen=True)
class Page:
    """What one file says: the sensors, whose they are, and remarks (units, losses) for whoever opens the file."""

    sensors: Mapping[Kind, Sensor]
    device: str | None = None
    frame: str | None = None
    remarks: tuple[str, ...] = ()
    field_uT: float | None = None


@dataclass(frozen=True)
class Target:
    """A kind of file of another program.

    Attributes
    ----------
    name : str
        As in ``--to`` and ``--from``.
    title, suffix : str
    forms : mapping of sensor kind to `Form`
    write : callable, Page -> bytes
    read : callable, (data, name of the file, kinds asked for) -> Page
        A file that does not say which sensor it is of takes the kinds asked for; raises InputError where it cannot
        be understood.
    exact : float
        Relative difference of H and B after writing and reading, from the digits that the file keeps.
    facts : str
        Where formula and names are from.
    single : bool
        Whether a file holds one sensor only.
    required : tuple of kinds without which the file is of no use to its reader.
    vectors : bool
        Whether the file carries the ten test vectors.
    binary : bool
    remark : str
        What the user must know or do.
    """

    name: str
    title: str
    suffix: str
    forms: Mapping[Kind, Form]
    write: Callable[[Page], bytes]
    read: Callable[[bytes, str, tuple[Kind, ...]], Page]
    exact: float
    facts: str
    single: bool = False
    required: tuple[Kind, ...] = ()
    vectors: bool = True
    binary: bool = False
    remark: str = ""
    aliases: tuple[str, ...] = field(default=())


_UNSAFE = re.compile(r"[^A-Za-z0-9 ._,:;()\[\]+=^/-]")


def plain(text: object, limit: int = 200) -> str:
    """`text` from a file as one line that no syntax of a target can take for its own.

    Letters and digits (ASCII), spaces and ``._,:;()[]+=^/-`` stay; everything else (quotes, ``*``, ``%``, ``?`` that
    may begin a trigraph, ``#``, backslashes, line ends, marks that turn the writing direction) becomes ``_``.
    """
    return _UNSAFE.sub("_", str(text))[:limit]


def identifier(text: object) -> str:
    """`text` as part of a C or MATLAB name: capitals, digits and ``_``, at most 40."""
    return re.sub(r"[^A-Z0-9]+", "_", str(text).upper())[:40].strip("_") or "NODE"


def single_precision(a: Any) -> Array:
    """`a` rounded to float32, as float64."""
    with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinite, and is refused as such
        return np.asarray(a, dtype=np.float64).astype(np.float32).astype(np.float64)
