"""What people see: lines and tables on stdout, errors and progress on stderr.

On a terminal tables are drawn by rich; otherwise they are plain text in columns, and rich is not even imported.
Text that comes from files (names, columns) may hold terminal escapes: everything goes through `clean`.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

Tick = Callable[[int, int], None]

SHOWN_AFTER_S = 0.8
"""A progress bar appears only for what takes longer than this."""


def clean(text: object) -> str:
    """`text` on one line, control characters (terminal escapes) replaced by ``?``."""
    return "".join(c if c.isprintable() else " " if c in "\n\r\t" else "?" for c in str(text))


def line(text: str = "", *, style: str = "") -> None:
    """One line on stdout; `style` is for terminals only."""
    if sys.stdout.isatty():
        _console().print(_text(clean(text), style), soft_wrap=False)
    else:
        print(clean(text))


def error(text: str) -> None:
    """One line on stderr."""
    print(f"margcal: {clean(text)}", file=sys.stderr)


def table(header: Sequence[str], rows: Sequence[Sequence[str]], *, right: Sequence[int] = ()) -> None:
    """A table on stdout; the columns `right` (index) are flush right."""
    rows = [[clean(cell) for cell in row] for row in rows]
    if sys.stdout.isatty():
        _rich_table(header, rows, right)
    else:
        for row in [list(header), *rows] if any(header) else rows:
            print(_columns(row, _widths(header, rows), right))


def _widths(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[int]:
    return [max(len(row[k]) for row in [header, *rows]) for k in range(len(header))]


def _columns(row: Sequence[str], widths: Sequence[int], right: Sequence[int]) -> str:
    cells = [c.rjust(w) if k in right else c.ljust(w) for k, (c, w) in enumerate(zip(row, widths))]
    return ("  " + "  ".join(cells)).rstrip()


def _rich_table(header: Sequence[str], rows: Sequence[Sequence[str]], right: Sequence[int]) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    drawn = Table(box=SIMPLE_HEAD, show_header=any(header), show_edge=False, header_style="bold")
    for k, name in enumerate(header):
        drawn.add_column(name, justify="right" if k in right else "left", no_wrap=k in right)
    for row in rows:
        drawn.add_row(*(_text(cell) for cell in row))
    _console().print(drawn)


def _console() -> Any:
    from rich.console import Console

    return Console(highlight=False, markup=False, emoji=False)


def _text(text: str, style: str = "") -> Any:
    from rich.text import Text

    return Text(text, style=style)


@contextmanager
def progress(label: str) -> Iterator[Tick]:
    """``tick(done, total)`` for a bar on stderr: shown on terminals only, and only after `SHOWN_AFTER_S`.

    Work that never ticks gets a bar that shows that something is going on.
    """
    if not sys.stderr.isatty():
        yield lambda done, total: None
        return
    bar = _Bar(clean(label))
    try:
        yield bar.tick
    finally:
        bar.close()


class _Bar:
    """A rich progress bar that starts by itself when the work turns out to be long."""

    def __init__(self, label: str) -> None:
        self.label, self.done, self.total = label, 0, 0
        self.bar: Any = None
        self.lock = threading.Lock()
        self.closed = False
        self.timer = threading.Timer(SHOWN_AFTER_S, self._start)
        self.timer.daemon = True
        self.timer.start()

    def _start(self) -> None:
        from rich.console import Console
        from rich.markup import escape
        from rich.progress import Progress

        with self.lock:
            if self.closed:
                return
            self.bar = Progress(console=Console(stderr=True, markup=False), transient=True)
            self.bar.add_task(escape(self.label), total=self.total or None, completed=self.done)
            self.bar.start()

    def tick(self, done: int, total: int) -> None:
        self.done, self.total = done, total
        if self.bar is not None:
            self.bar.update(self.bar.task_ids[0], completed=done, total=total or None)

    def close(self) -> None:
        self.timer.cancel()
        with self.lock:
            self.closed = True
            if self.bar is not None:
                self.bar.stop()
