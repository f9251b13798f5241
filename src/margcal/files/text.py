"""Text tables before a library parses them: encoding, comments, delimiter, decimal mark, header.

pyarrow parses; what it does not do, or does silently wrong, is done here: UTF-16 is decoded, comment lines are
dropped, binary files, NUL bytes and quotes left open are refused with their line, gzip is unpacked up to a ratio.
"""

from __future__ import annotations

import io
import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from margcal.core.checking import printable
from margcal.core.errors import InputError

BLOCK = 1 << 20
LONGEST_LINE = 4 << 20
GZIP_RATIO = 200
"""More plain bytes than this for one packed byte is no table but a bomb."""

_COMMENTS = (b"#", b"//")
_BINARY = {
    b"\x89HDF": "an HDF5 file",
    b"PK\x03\x04": "a zip archive (or a spreadsheet); unpack it, or save it as CSV",
    b"MATLAB": "a MATLAB file",
    b"PAR1": "a Parquet file with another suffix; rename it to .parquet",
    b"SQLite": "an SQLite database (a ROS 2 bag?)",
    b"\x89MCAP": "an MCAP file",
    b"%PDF": "a PDF",
    b"\x28\xb5\x2f\xfd": "packed with zstd; unpack it",
    b"BZh": "packed with bzip2; unpack it",
    b"\xfd7zXZ": "packed with xz; unpack it",
}
_NUMERIC_NAME = re.compile(r"t_s|temp_degc|(acc|gyr|mag)_[xyz].*|(ref_)?q[wxyz]|ref_p_.*|start_s|stop_s", re.I)


class TextLines(io.RawIOBase):
    """A text table as clean UTF-8 bytes: whole lines, without BOM, comments and the rows in `drop`.

    `comments` keeps the comment lines before the first row, `packed_read` counts the bytes taken from disk.
    """

    def __init__(self, path: Path, drop: Collection[int] = ()) -> None:
        super().__init__()
        self.path = path
        self.name = printable(path.name)
        self.drop = frozenset(drop)
        self.comments: list[str] = []
        self.encoding = "utf-8"
        self.rows = 0  # rows passed or dropped so far, the header among them; counted only while dropping
        self.lines = 0  # lines before the block that is being read
        self._disk = _open(path)
        self._packed = self._disk.peek(2)[:2] == b"\x1f\x8b"  # type: ignore[attr-defined]
        self._plain_read = 0
        self._ready: memoryview = memoryview(b"")
        self._blocks = self._clean_blocks()

    @property
    def packed_read(self) -> int:
        return self._disk.tell()

    def readable(self) -> bool:
        return True

    def readinto(self, buffer) -> int:  # type: ignore[override]
        while not self._ready:
            block = next(self._blocks, None)
            if block is None:
                return 0
            self._ready = memoryview(block)
        n = min(len(buffer), len(self._ready))
        buffer[:n] = self._ready[:n]
        self._ready = self._ready[n:]
        return n

    def close(self) -> None:
        self._disk.close()
        super().close()

    def row_line(self, row: int) -> int:
        """Line number (from 1) in the file of row `row` (0 is the header), blank and comment lines counted."""
        seen = -1
        with TextLines(self.path) as again:
            for block in again._whole_lines():
                for k, line in enumerate(block.split(b"\n")):
                    if line.strip() and not _is_comment(line):
                        seen += 1
                        if seen == row:
                            return again.lines + k + 1
                again.lines += block.count(b"\n")
        return 0

    def _raw_blocks(self) -> Iterator[bytes]:
        if not self._packed:
            while block := self._disk.read(BLOCK):
                yield block
            return
        import gzip
        import zlib

        try:
            with gzip.GzipFile(fileobj=self._disk) as unpacked:
                while block := unpacked.read(BLOCK):
                    self._plain_read += len(block)
                    if self._plain_read > GZIP_RATIO * max(self._disk.tell(), BLOCK // 16):
                        raise InputError(
                            f"{self.name}: unpacks to more than {GZIP_RATIO} times its size; unpack it yourself "
                            "if you trust it"
                        )
                    yield block
        except (EOFError, zlib.error, gzip.BadGzipFile) as error:
            raise InputError(f"{self.name}: the gzip file is damaged or cut ({error}); fetch it again") from error

    def _utf8_blocks(self) -> Iterator[bytes]:
        """Blocks decoded from whatever the file is in, line ends made `\\n` where they are `\\r` only."""
        import codecs

        blocks = self._raw_blocks()
        first = next(blocks, b"")
        self.encoding, skip = _encoding(first, self.name)
        decoder = None
        if self.encoding != "utf-8":
            decoder = codecs.getincrementaldecoder(self.encoding)(errors="replace")
        old_mac = False
        block: bytes | None = first[skip:]
        if decoder is None:
            old_mac = b"\n" not in first and b"\r" in first
        while block is not None:
            if decoder is not None:
                block = decoder.decode(block).encode("utf-8", errors="replace")
            yield block.replace(b"\r", b"\n") if old_mac else block
            block = next(blocks, None)

    def _whole_lines(self) -> Iterator[bytes]:
        tail = b""
        for block in self._utf8_blocks():
            block = tail + block if tail else block
            cut = block.rfind(b"\n") + 1
            block, tail = block[:cut], block[cut:]
            if len(tail) > LONGEST_LINE:
                raise InputError(f"{self.name}: a line is longer than {LONGEST_LINE >> 20} MB; this is no table")
            if block:
                yield block
        if tail:
            yield tail

    def _clean_blocks(self) -> Iterator[bytes]:
        for block in self._whole_lines():
            if self.encoding == "utf-8" and not block.isascii():
                block = _as_utf8(block)
            if b"\0" in block:
                line = self.lines + block.count(b"\n", 0, block.index(b"\0")) + 1
                raise InputError(
                    f"{self.name}: line {line}: a NUL byte; the file is damaged (or binary): remove the line"
                )
            if b"#" in block or b"//" in block or self.drop or _quote_left_open(block):
                clean = self._clean_lines(block)
            else:
                clean = block
            self.lines += block.count(b"\n")
            if clean:
                yield clean

    def _clean_lines(self, block: bytes) -> bytes:
        """`block` without comments and dropped rows; a quote left open is refused (a cell holds one line)."""
        kept = []
        for k, line in enumerate(block.splitlines(keepends=True)):
            if _is_comment(line):
                if len(self.comments) < 100:
                    self.comments.append(line.decode(errors="replace").strip())
                continue
            if self.drop and line.strip():
                self.rows += 1
                if self.rows - 1 in self.drop:
                    continue
            if line.count(b'"') % 2:
                raise InputError(
                    f"{self.name}: line {self.lines + k + 1}: a quote is opened and not closed on the line; "
                    "close it or remove it"
                )
            kept.append(line)
        return b"".join(kept)


def _as_utf8(block: bytes) -> bytes:
    """`block` with lines that are not UTF-8 read as cp1252, which the first block did not show the file to be.

    pyarrow prints a traceback of its own at a ragged row that is not UTF-8.
    """
    try:
        block.decode("utf-8")
        return block
    except UnicodeDecodeError:
        lines = block.split(b"\n")
    for k, line in enumerate(lines):
        try:
            line.decode("utf-8")
        except UnicodeDecodeError:
            lines[k] = line.decode("cp1252", errors="replace").encode()
    return b"\n".join(lines)


def _quote_left_open(block: bytes) -> bool:
    """Whether some line of `block` holds an odd number of quotes."""
    if b'"' not in block:
        return False
    data = np.frombuffer(block, dtype=np.uint8)
    before_end = np.searchsorted(np.flatnonzero(data == ord('"')), np.flatnonzero(data == ord("\n")))
    return bool((before_end % 2).any()) or bool(block.count(b'"') % 2)


def _is_comment(line: bytes) -> bool:
    return line.lstrip().startswith(_COMMENTS)


def _open(path: Path) -> IO[bytes]:
    try:
        return open(path, "rb", buffering=BLOCK)
    except OSError as error:
        raise InputError(f"{printable(path)}: cannot be read ({error.strerror})") from error


def _encoding(first: bytes, name: str) -> tuple[str, int]:
    """Encoding of a file by its first block, and the length of its byte order mark."""
    if not first:
        raise InputError(f"{name}: the file is empty; record or export it again")
    for magic, what in _BINARY.items():
        if first.startswith(magic):
            raise InputError(f"{name}: this is {what}; expected a text table (CSV) or Parquet")
    for mark, encoding in (
        (b"\xef\xbb\xbf", "utf-8"),
        (b"\xff\xfe", "utf-16-le"),
        (b"\xfe\xff", "utf-16-be"),
    ):
        if first.startswith(mark):
            return encoding, len(mark)
    head = first[:4096]
    for start, encoding in ((1, "utf-16-le"), (0, "utf-16-be")):
        if len(head) > 8 and head[start::2].count(0) > 0.9 * len(head[start::2]) and not head[1 - start :: 2].count(0):
            return encoding, 0
    if head.count(0) > 8 or sum(b < 9 or 13 < b < 32 for b in head) > 0.1 * len(head):
        raise InputError(f"{name}: this is a binary file, not a text table; expected CSV or Parquet")
    try:
        first.decode("utf-8")
    except UnicodeDecodeError as error:
        if error.end < len(first) - 4:  # not merely a character cut by the end of the block
            return "cp1252", 0
    return "utf-8", 0


@dataclass(frozen=True)
class Dialect:
    """How a text table is written: column `names`, `delimiter`, `decimal` mark, `encoding`, header's place."""

    names: tuple[str, ...]
    delimiter: str
    decimal: str
    encoding: str
    header_rows: int

    @property
    def plain(self) -> bool:
        return self.decimal == "." and self.encoding == "utf-8"


def sniff(path: Path) -> Dialect:
    """Dialect of the text table `path`, from its first rows.

    Raises
    ------
    InputError
        Empty, binary, only a header, no header, or numbers that can be read in two ways.
    """
    with TextLines(path) as source:
        rows: list[str] = []
        stream = io.BufferedReader(source, BLOCK)
        for line in stream:
            if line.strip():
                rows.append(line.decode("utf-8", errors="replace").rstrip("\r\n"))
            if len(rows) > 200:
                break
        name, comments, encoding = source.name, source.comments, source.encoding
    if not rows:
        raise InputError(f"{name}: holds no rows; record or export it again")
    header, header_rows = rows[0], 1
    delimiter = max(";\t,", key=lambda d: _outside_quotes(header).count(d))
    if all(_is_number(f) for f in _split(header, delimiter)):
        found = _commented_header(comments, len(_split(header, delimiter)), delimiter)
        if found is None:
            raise InputError(
                f"{name}: the first row holds numbers, not column names; put a row such as "
                "t_s,acc_x_count,acc_y_count,acc_z_count at the top"
            )
        header, header_rows = found, 0
    names = tuple(f.strip() for f in _split(header, delimiter))
    if len(rows) == header_rows:
        raise InputError(f"{name}: holds a header and no rows; record or export it again")
    decimal = _decimal_mark(names, [_split(r, delimiter) for r in rows[header_rows:]], delimiter, name)
    return Dialect(names, delimiter, decimal, encoding, header_rows)


def _split(line: str, delimiter: str) -> list[str]:
    if '"' not in line:
        return line.split(delimiter)
    import csv

    try:
        return next(csv.reader([line], delimiter=delimiter))
    except csv.Error:  # a line end within the line, or a cell beyond csv's limit: pyarrow says what is wrong with it
        return line.split(delimiter)


def _outside_quotes(line: str) -> str:
    return re.sub(r'"[^"]*"', "", line)


def _is_number(field: str) -> bool:
    return bool(re.fullmatch(r"\s*[+-]?(\d+[.,]?\d*|[.,]\d+)([eE][+-]?\d+)?\s*|\s*nan\s*|", field, re.I))


def _commented_header(comments: list[str], width: int, delimiter: str) -> str | None:
    """The header where it is the last comment line (as numpy.savetxt writes it)."""
    for comment in reversed(comments):
        text = comment.lstrip("#/ ")
        if len(_split(text, delimiter)) == width and not all(_is_number(f) for f in _split(text, delimiter)):
            return text
    return None


def _decimal_mark(names: tuple[str, ...], rows: list[list[str]], delimiter: str, file: str) -> str:
    """``.`` or ``,``; refused where `1,234` could be 1.234 or 1234."""
    numeric = [k for k, n in enumerate(names) if _NUMERIC_NAME.fullmatch(n)]
    if delimiter == "," and rows and all(len(r) >= 2 * len(names) - 1 > 1 for r in rows):
        raise InputError(
            f"{file}: {len(names)} column names but {len(rows[0])} fields a row: the comma is used both between "
            "columns and in numbers; export with semicolons or with decimal points"
        )
    cells = [r[k].strip() for r in rows for k in numeric if k < len(r)]
    commas = [c for c in cells if re.fullmatch(r"[+-]?\d*(,\d*)+([eE][+-]?\d+)?", c)]
    if not commas:
        return "."
    example = printable(commas[0], 40)
    if any("." in c for c in cells) or any(c.count(",") > 1 for c in commas):
        raise InputError(
            f"{file}: numbers such as {example!r} hold a comma where others hold a point; remove the thousands "
            "separators or use one decimal mark"
        )
    if all(re.fullmatch(r"[+-]?[1-9]\d{0,2},\d{3}", c) for c in commas):
        raise InputError(
            f"{file}: {example!r} may mean {example.replace(',', '.')} or {example.replace(',', '')}; export with "
            "decimal points and without thousands separators"
        )
    return ","
