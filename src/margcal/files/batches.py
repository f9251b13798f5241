"""A table on disk, CSV or Parquet, as a stream of record batches with errors that a person can act on.

pyarrow parses. Arrays cross from it by their buffers: `to_numpy` and `pa.array` import pandas wherever that is
installed, 0.4 s for nothing.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from margcal.core.checking import printable
from margcal.core.errors import InputError
from margcal.core.types import Array, Issue

if TYPE_CHECKING:
    import pyarrow as pa

    from margcal.files.text import Dialect, TextLines

SUFFIXES = (".csv", ".txt", ".tsv", ".parquet", ".csv.gz", ".txt.gz", ".tsv.gz")
CSV_BLOCK = 4 << 20
PARQUET_ROWS = 1 << 17

As = Literal["number", "text", "own"]
"""How to take a column: as float64, as text exactly as written, or as the library sees it."""

Progress = Callable[[int, int], None]
"""Called with (done, total): rows of a Parquet table, bytes of a text table."""


def is_table(path: Path) -> bool:
    """Whether `path` has the name of a table (hidden files have not)."""
    return not path.name.startswith(".") and path.name.lower().endswith(SUFFIXES)


def is_parquet(path: Path) -> bool:
    return path.name.lower().endswith((".parquet", ".pq"))


@dataclass
class Table:
    """One table on disk. `names` are its columns; `n_rows` is known for Parquet; `issues` what reading mended."""

    path: Path
    names: tuple[str, ...]
    dialect: Dialect | None
    n_rows: int | None
    size: int
    parquet: Any = None
    issues: list[Issue] = field(default_factory=list)

    @property
    def file(self) -> str:
        """The file's name, for messages."""
        return printable(self.path.name)

    def batches(
        self,
        columns: Sequence[int],
        take: Mapping[int, As],
        *,
        skip_bad: int = 0,
        progress: Progress | None = None,
    ) -> Iterator[pa.RecordBatch]:
        """Record batches with the `columns` (numbers) in that order, each taken as `take` says (default own).

        Raises
        ------
        InputError
            A row or cell that cannot be read, with its line, once more than `skip_bad` such rows were met.
        """
        if self.dialect is None:
            return self._parquet_batches(columns, take, progress)
        return self._text_batches(self.dialect, columns, take, skip_bad, progress)

    def _parquet_batches(
        self, columns: Sequence[int], take: Mapping[int, As], progress: Progress | None
    ) -> Iterator[pa.RecordBatch]:
        names = [self.names[k] for k in columns]
        schema = self.parquet.schema_arrow
        for k in columns:
            if take.get(k) == "number" and not _is_number_type(schema.field(k).type):
                raise InputError(
                    f"{self.file}: column {printable(self.names[k])!r} holds {schema.field(k).type}; expected numbers"
                )
        done, total = 0, self.n_rows or 0
        with _refused(self.path):
            for batch in self.parquet.iter_batches(batch_size=PARQUET_ROWS, columns=names, use_threads=False):
                yield batch.select(names)
                done += len(batch)
                if progress is not None:
                    progress(done, total)

    def _text_batches(
        self,
        dialect: Dialect,
        columns: Sequence[int],
        take: Mapping[int, As],
        skip_bad: int,
        progress: Progress | None,
    ) -> Iterator[pa.RecordBatch]:
        """Parsed batches; bad cells within `skip_bad` are found by their row, dropped, and the file read again.

        Reading again is only possible until the first batch went out, so with `skip_bad` all are held back.
        """
        dropped: set[int] = set()
        ragged: list[int] = []
        while True:
            ragged.clear()
            try:
                batches = self._parse(dialect, columns, take, dropped, ragged, skip_bad - len(dropped), progress)
                if not skip_bad:
                    yield from batches
                    return
                held = list(batches)
                break
            except BadCell as bad:
                if len(dropped) + 1 > skip_bad:
                    raise
                dropped.add(bad.row)
        count = len(dropped) + len(ragged)
        if count:
            text = f"{self.file}: {count} rows could not be read and were skipped, as asked"
            self.issues.append(Issue("rows-skipped", "warn", text, value=float(count), limit=float(skip_bad)))
        yield from held

    def _parse(
        self,
        dialect: Dialect,
        columns: Sequence[int],
        take: Mapping[int, As],
        dropped: set[int],
        ragged: list[int],
        allowed: int,
        progress: Progress | None,
    ) -> Iterator[pa.RecordBatch]:
        import pyarrow as pa
        import pyarrow.csv as pc

        from margcal.files.text import TextLines

        kinds = {"number": pa.float64(), "text": pa.string()}
        types = {str(k): kinds[take[k]] for k in columns if take.get(k, "own") != "own"}

        def on_ragged(row: Any) -> str:
            ragged.append(row.number)
            return "skip" if len(ragged) <= allowed else "error"

        with TextLines(self.path, dropped) as lines:
            stream = io.BufferedReader(lines, CSV_BLOCK)
            for _ in range(dialect.header_rows):
                while not stream.readline().strip():
                    pass
            try:
                reader = pc.open_csv(
                    stream,
                    read_options=pc.ReadOptions(
                        use_threads=False,
                        block_size=CSV_BLOCK,
                        column_names=[str(k) for k in range(len(dialect.names))],
                    ),
                    parse_options=pc.ParseOptions(delimiter=dialect.delimiter, invalid_row_handler=on_ragged),
                    convert_options=pc.ConvertOptions(
                        column_types=types,
                        include_columns=[str(k) for k in columns],
                        decimal_point=dialect.decimal,
                    ),
                )
                for batch in reader:
                    yield batch.rename_columns([self.names[k] for k in columns])
                    if progress is not None:
                        progress(min(lines.packed_read, self.size), self.size)
            except (pa.ArrowInvalid, pa.ArrowKeyError, UnicodeDecodeError) as error:
                raise self._explained(str(error), lines, dropped) from error

    def _explained(self, message: str, lines: TextLines, dropped: set[int]) -> Exception:
        """What pyarrow says of a row, in the user's terms: line, column, cell and mend."""
        where = re.search(r"Row #(\d+)", message)
        row = int(where[1]) if where else 0
        header = self.dialect.header_rows if self.dialect else 1
        row += header - 1  # from here on: rows from 0, the header among them
        for gone in sorted(dropped):
            row += gone <= row
        line = lines.row_line(row) if where else 0
        place = f"{self.file}: line {line}" if line else self.file
        if bad := re.search(r"In CSV column #(\d+)", message):
            name = printable(self.names[int(bad[1])]) if int(bad[1]) < len(self.names) else bad[1]
            value = re.search(r"invalid value '(.*)'", message, re.DOTALL)
            cell = printable(value[1], 40) if value else "?"
            number = "double" in message or "int" in message
            text = f"{place}: column {name}: {cell!r} is not " + ("a number" if number else "valid text")
            return BadCell(f"{text}; correct it, empty the cell, or give --skip-bad N", row, int(bad[1]))
        if fields := re.search(r"Expected (\d+) columns, got (\d+)", message):
            return InputError(
                f"{place}: {fields[2]} fields where the header has {fields[1]}; correct the line, or give --skip-bad N"
            )
        return InputError(f"{place}: cannot be read as a table ({printable(message, 120)})")


class BadCell(InputError):
    """A cell that is not what its column should hold: row from 0 (the header among them), column number."""

    def __init__(self, message: str, row: int, column: int) -> None:
        super().__init__(message)
        self.row = row
        self.column = column


def open_table(path: Path) -> Table:
    """The table `path`, its columns known and nothing else read.

    Raises
    ------
    InputError
        Not there, not readable, not a table, empty.
    """
    try:
        size = path.stat().st_size
    except FileNotFoundError as error:
        raise InputError(f"{printable(path)}: there is no such file or folder") from error
    except OSError as error:
        raise InputError(f"{printable(path)}: cannot be read ({error.strerror})") from error
    if is_parquet(path):
        return _open_parquet(path, size)
    from margcal.files.text import sniff

    dialect = sniff(path)
    table = Table(path, dialect.names, dialect, None, size)
    if dialect.decimal == ",":
        text = f"{table.file}: numbers are written with a decimal comma"
        table.issues.append(Issue("decimal-comma", "note", text))
    return table


def _open_parquet(path: Path, size: int) -> Table:
    with _refused(path):
        from pyarrow.parquet import ParquetFile

        # buffered, not pre-buffered: a row group of a gigabyte must not come into memory at once
        file = ParquetFile(path, pre_buffer=False, buffer_size=1 << 20)
        names = tuple(file.schema_arrow.names)
        if not file.metadata.num_rows:
            raise InputError(f"{printable(path.name)}: holds a header and no rows; record or export it again")
        return Table(path, names, None, file.metadata.num_rows, size, file)


@contextmanager
def _refused(path: Path) -> Iterator[None]:
    """pyarrow's complaints about a Parquet file, as an `InputError`."""
    import pyarrow as pa

    try:
        yield
    except (pa.ArrowException, OSError, ValueError, OverflowError) as error:
        if isinstance(error, InputError):
            raise
        reason = printable(str(error).splitlines()[0] if str(error) else type(error).__name__, 120)
        raise InputError(
            f"{printable(path.name)}: is no Parquet file, or is cut or damaged ({reason}); copy or export it again"
        ) from error


def _is_number_type(kind: pa.DataType) -> bool:
    import pyarrow.types as pt

    return pt.is_integer(kind) or pt.is_floating(kind) or pt.is_boolean(kind) or pt.is_decimal(kind) or pt.is_null(kind)


def numbers(array: pa.Array) -> Array:
    """Float64 values of an Arrow array of numbers, NaN where it is null."""
    import pyarrow as pa

    if isinstance(array, pa.ChunkedArray):
        parts = [numbers(chunk) for chunk in array.chunks]
        return np.concatenate(parts) if len(parts) != 1 else parts[0]
    kind = str(array.type)
    plain = {"double": "f8", "float": "f4", "halffloat": "f2"}.get(kind)
    if plain is None and kind.lstrip("u").startswith("int"):
        plain = kind
    if plain is None:
        return np.array([np.nan if v is None else float(v) for v in array.to_pylist()], dtype=np.float64)
    valid, data = array.buffers()
    if data is None:
        return np.full(len(array), np.nan)
    itemsize = np.dtype(plain).itemsize
    values = np.frombuffer(data, dtype=plain, count=len(array), offset=array.offset * itemsize)
    if array.null_count and valid is not None:
        bits = np.unpackbits(np.frombuffer(valid, dtype=np.uint8), bitorder="little")
        return np.where(bits[array.offset : array.offset + len(array)].astype(bool), values, np.nan)
    return values.astype(np.float64, copy=False)


def cells(array: pa.Array) -> pa.Array:
    """A column as CSV can hold it: null (an empty cell) for NaN, categories spelled out."""
    import pyarrow as pa

    if isinstance(array, pa.DictionaryArray):
        return array.dictionary_decode()
    plain = {"double": "f8", "float": "f4"}.get(str(array.type))
    if plain is None or array.null_count or (data := array.buffers()[1]) is None:
        return array
    offset = array.offset * np.dtype(plain).itemsize
    values = np.frombuffer(data, dtype=plain, count=len(array), offset=offset)
    missing = np.isnan(values)
    if not missing.any():
        return array
    validity = pa.py_buffer(np.packbits(~missing, bitorder="little").tobytes())
    return pa.Array.from_buffers(array.type, len(array), [validity, pa.py_buffer(values)])


def arrow(values: NDArray[Any], *, nan_is_null: bool) -> pa.Array:
    """Arrow array of float64 `values`; NaN becomes null (an empty cell in CSV) where asked."""
    import pyarrow as pa

    values = np.ascontiguousarray(values, dtype=np.float64)
    missing = np.isnan(values) if nan_is_null else None
    validity = None
    if missing is not None and missing.any():
        validity = pa.py_buffer(np.packbits(~missing, bitorder="little").tobytes())
    return pa.Array.from_buffers(pa.float64(), len(values), [validity, pa.py_buffer(values)])
