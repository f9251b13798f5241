"""Tables to disk, CSV or Parquet by the suffix, row by row or in one go."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from margcal.core.checking import printable
from margcal.core.errors import InputError
from margcal.files.batches import PARQUET_ROWS, arrow, is_parquet

if TYPE_CHECKING:
    import pyarrow as pa

_TEXT = (".csv", ".txt", ".tsv", ".csv.gz", ".txt.gz", ".tsv.gz")

AXES = ("+x", "-x", "+y", "-y", "+z", "-z")
"""The names of a housing's axes, as a poses table spells them."""

Write = Callable[["pa.RecordBatch"], None]


def check_suffix(path: Path) -> None:
    """Refuse a name whose suffix is no table's."""
    if not is_parquet(path) and not path.name.lower().endswith(_TEXT):
        raise InputError(f"{printable(path.name)}: a table is written as .csv or .parquet; give it that suffix")


def write_table(
    path: str | os.PathLike[str],
    columns: Mapping[str, NDArray[Any] | Sequence[Any]],
    *,
    overwrite: bool = False,
) -> None:
    """Write a table, CSV or Parquet by the suffix of `path`, whole or not at all.

    Parameters
    ----------
    path : path-like
    columns : mapping of name to numbers (NaN: an empty cell in CSV) or text (None: an empty cell)
        Text that a spreadsheet would run as a formula gets a ``'`` before it; axis names such as ``+x`` stay.
    overwrite : bool

    Raises
    ------
    InputError
        The file exists, cannot be written, or columns differ in length.
    """
    import pyarrow as pa

    from margcal.files.atomic import atomic_path

    path = Path(path)
    check_suffix(path)
    arrays = [_column(values, csv=not is_parquet(path)) for values in columns.values()]
    if len({len(a) for a in arrays}) > 1:
        raise InputError(f"{printable(path.name)}: columns differ in length")
    batch = pa.RecordBatch.from_arrays(arrays, names=list(columns))
    with atomic_path(path, overwrite=overwrite) as temporary, table_writer(temporary, batch.schema) as write:
        write(batch)


def _column(values: Any, *, csv: bool) -> pa.Array:
    """Arrow array of one column: integers and booleans as they are, other numbers as float64, else text."""
    import pyarrow as pa

    array = np.asarray(values)
    if array.dtype.kind in "iub":
        return pa.array(array.tolist())
    if array.dtype.kind == "f":
        return arrow(array, nan_is_null=csv)
    return pa.array([None if v is None else _harmless(str(v)) for v in values], type=pa.string())


def _harmless(text: str) -> str:
    """`text` with ``'`` before what a spreadsheet would take for a formula; axis names and numbers stay."""
    if not text.startswith(("=", "+", "-", "@", "\t", "\r")) or text in AXES:
        return text
    try:
        float(text)
    except ValueError:
        return "'" + text
    return text


@contextmanager
def table_writer(path: Path, schema: pa.Schema) -> Iterator[Write]:
    """A function that appends record batches of `schema` to the table `path`; tab-separated for .tsv."""
    if is_parquet(path):
        with _parquet_writer(path, schema) as write:
            yield write
        return
    name = path.name.lower()
    delimiter = "\t" if ".tsv" in name else ","
    if name.endswith(".gz"):
        import gzip

        opened: Any = gzip.GzipFile(path, "wb", compresslevel=6, mtime=0)
    else:
        opened = path.open("wb")
    with opened as file:
        file.write((delimiter.join(_quoted(n, delimiter) for n in schema.names) + "\n").encode())
        yield lambda batch: _write_csv(batch, file, delimiter)


@contextmanager
def _parquet_writer(path: Path, schema: pa.Schema) -> Iterator[Write]:
    """Batches are gathered to row groups of `PARQUET_ROWS` or more."""
    import pyarrow as pa
    from pyarrow.parquet import ParquetWriter

    waiting: list[pa.RecordBatch] = []

    def flush() -> None:
        if waiting:
            writer.write_table(pa.Table.from_batches(waiting, schema))
            waiting.clear()

    def write(batch: pa.RecordBatch) -> None:
        waiting.append(batch)
        if sum(len(b) for b in waiting) >= PARQUET_ROWS:
            flush()

    with ParquetWriter(path, schema, compression="zstd") as writer:
        yield write
        flush()


def _write_csv(batch: pa.RecordBatch, file: Any, delimiter: str) -> None:
    """Append rows. pyarrow quotes all text or none, so text that needs quotes is quoted here, cell by cell."""
    special = [k for k, column in enumerate(batch.columns) if _needs_quotes(column, delimiter)]
    if not special:
        file.write(_plain_rows(batch, delimiter))
        return
    pieces: list[list[bytes]] = []
    start = 0
    for k in [*special, batch.num_columns]:
        if k > start:
            between = batch.select(list(range(start, k)))
            pieces.append(bytes(_plain_rows(between, delimiter)).split(b"\n")[:-1])
        if k < batch.num_columns:
            cells = batch.column(k).to_pylist()
            pieces.append([b"" if v is None else _quoted(v, delimiter).encode() for v in cells])
        start = k + 1
    file.write(b"\n".join(map(delimiter.encode().join, zip(*pieces))) + b"\n")


def _plain_rows(batch: pa.RecordBatch, delimiter: str) -> pa.Buffer:
    import pyarrow as pa
    import pyarrow.csv as pc

    sink = pa.BufferOutputStream()
    pc.write_csv(batch, sink, pc.WriteOptions(include_header=False, delimiter=delimiter, quoting_style="none"))
    return sink.getvalue()


def _needs_quotes(column: pa.Array, delimiter: str) -> bool:
    """Whether a text column holds the delimiter, a quote or a line end; numbers never do."""
    if str(column.type) not in ("string", "large_string"):
        return False
    data = column.buffers()[2]
    text = b"" if data is None else bytes(data)
    return any(mark in text for mark in (delimiter.encode(), b'"', b"\n", b"\r"))


def _quoted(name: str, delimiter: str) -> str:
    special = any(c in name for c in ('"', "\n", "\r", delimiter))
    return '"' + name.replace('"', '""') + '"' if special else name
