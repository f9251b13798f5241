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
    if not text.startswith(("=", "+", "-", "@", "\t", "\r")) or text[1:] in ("x", "y", "z"):
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

        file: Any = gzip.GzipFile(path, "wb", compresslevel=6, mtime=0)
    else:
        file = open(path, "wb")
    with file:
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
    """Append rows; text is quoted only in batches that need it (pyarrow quotes all text or none)."""
    import pyarrow.csv as pc

    special = [delimiter.encode(), b'"', b"\n", b"\r"]
    quoting = "none"
    for column in batch.columns:
        if str(column.type) in ("string", "large_string", "string_view", "binary", "large_binary"):
            text = b"".join(bytes(b) for b in column.buffers()[2:] if b is not None)
            if any(s in text for s in special):
                quoting = "needed"
        elif not _is_simple(column):
            quoting = "needed"
    pc.write_csv(batch, file, pc.WriteOptions(include_header=False, delimiter=delimiter, quoting_style=quoting))


def _is_simple(column: pa.Array) -> bool:
    """Numbers and booleans: their text never needs quotes."""
    import pyarrow.types as pt

    kind = column.type
    return pt.is_integer(kind) or pt.is_floating(kind) or pt.is_boolean(kind) or pt.is_null(kind)


def _quoted(name: str, delimiter: str) -> str:
    special = any(c in name for c in ('"', "\n", "\r", delimiter))
    return '"' + name.replace('"', '""') + '"' if special else name
