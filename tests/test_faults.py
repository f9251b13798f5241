"""Kill, full disk, read-only disk, Ctrl-C: a result is the old file or the new one, never half, and nothing is left.

What a process may do to a disk is done by a process of its own. A killed one cannot clean up: then a hidden temporary
file beside the result is all that may be there.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from margcal.apps.report import write_report
from margcal.core.errors import InputError
from margcal.core.types import Calibration, SensorModel
from margcal.files import calfile
from margcal.files.tables import write_table
from margcal.workflow.apply import apply_file

posix = pytest.mark.skipif(os.name != "posix", reason="needs POSIX signals and limits")

CAL = Calibration(
    acc=SensorModel("acc", 0.01 * np.eye(3), np.ones(3)),
    mag=SensorModel("mag", 0.1 * np.eye(3), np.ones(3), delay_s=0.004),
    created="2026-11-22T00:00:00Z",
)


def a_table(rows: int) -> dict[str, np.ndarray]:
    y = np.round(1e4 * np.random.default_rng(1).normal(size=(rows, 6)))
    names = [f"{kind}_{axis}_count" for kind in ("acc", "mag") for axis in "xyz"]
    return {"t_s": np.arange(rows) / 100, **{name: y[:, k] for k, name in enumerate(names)}}


def apply_folder(folder: Path, target: Path) -> None:
    apply_file(CAL, folder / "session", target, overwrite=True)


WRITERS: dict[str, Callable[[Path, Path], Any]] = {
    "cal.json": lambda source, target: calfile.save(CAL, target, overwrite=True),
    "table.csv": lambda source, target: write_table(target, a_table(3000), overwrite=True),
    "table.csv.gz": lambda source, target: write_table(target, a_table(3000), overwrite=True),
    "table.parquet": lambda source, target: write_table(target, a_table(3000), overwrite=True),
    "applied.csv": lambda source, target: apply_file(CAL, source / "session" / "a.csv", target, overwrite=True),
    "applied.parquet": lambda source, target: apply_file(CAL, source / "session" / "a.csv", target, overwrite=True),
    "applied": apply_folder,
    "report.html": lambda source, target: write_report(CAL, target, overwrite=True),
}
"""Everything that writes a result, by the result's name; the table in ``session/a.csv`` is what is applied to."""

OLD = b"what was there before\n"
every_writer = pytest.mark.parametrize("name", list(WRITERS))


def put_old(folder: Path, name: str) -> Path:
    """An old result `name` in `folder`: a file, or a folder that holds one."""
    folder.mkdir(exist_ok=True)
    target = folder / name
    if "." in name:
        target.write_bytes(OLD)
    else:
        target.mkdir()
        (target / "a.csv").write_bytes(OLD)
    return target


def content(target: Path) -> bytes:
    return (target if target.is_file() else target / "a.csv").read_bytes()


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("source")
    (folder / "session").mkdir()
    write_table(folder / "session" / "a.csv", a_table(3000))
    return folder


# --- a disk that fails --------------------------------------------------------------------------------


@every_writer
@pytest.mark.parametrize("call", ["fsync", "replace", "open"])
@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO, errno.EROFS, errno.EDQUOT, errno.EFBIG])
def test_a_call_that_fails_leaves_the_old_result(tmp_path, source, monkeypatch, name, call, code):
    """The disk may say that it is full only when it is asked to keep what was written."""
    target = put_old(tmp_path / "out", name)
    usual = getattr(os, call)

    def fails(path, *more, **options):
        mine = call == "fsync" or str(path).startswith(str(tmp_path / "out" / "."))
        if mine and (call != "open" or (more == (os.O_RDONLY,) and not options)):  # nor the cleaning up
            raise OSError(code, os.strerror(code))
        return usual(path, *more, **options)

    with monkeypatch.context() as patch:
        patch.setattr(os, call, fails)
        with pytest.raises(InputError, match=name):
            WRITERS[name](source, target)
    assert content(target) == OLD
    assert os.listdir(tmp_path / "out") == [name]
    WRITERS[name](source, target)
    assert content(target) != OLD


_FILL = """
import json, os, sys
from pathlib import Path
sys.path.insert(0, {tests!r})
from test_faults import OLD, WRITERS, content, put_old
from margcal.core.errors import MargcalError
source, place, limit = Path({source!r}), Path({place!r}), {limit!r}
found = {{}}
for name, write in WRITERS.items():
    target = put_old(place, name)
    if limit == "size":
        import resource
        resource.setrlimit(resource.RLIMIT_FSIZE, (100, resource.RLIM_INFINITY))
    if limit == "read-only":
        assert os.system(f"mount -o remount,ro {{place}}") == 0
    try:
        write(source, target)
        what = "written"
    except MargcalError as error:
        what = str(error)
    except BaseException as error:
        what = repr(error)
    if limit == "size":
        resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    if limit == "read-only":
        assert os.system(f"mount -o remount,rw {{place}}") == 0
    found[name] = [what, content(target) == OLD, os.listdir(place)]
    (os.unlink if target.is_file() else __import__("shutil").rmtree)(target)
print(json.dumps(found))
"""


def fill(limit: str, source: Path, place: Path, *, mount: str = "") -> dict[str, list[Any]]:
    """Every writer in a process whose disk is full (`mount`: its size) or whose files may not grow."""
    code = _FILL.format(tests=str(Path(__file__).parent), source=str(source), place=str(place), limit=limit)
    command = [sys.executable, "-c", code]
    if mount:
        inside = f'mount -t tmpfs -o size={mount} tmpfs {place} && exec "$0" -c "$1"'
        command = ["unshare", "-m", "sh", "-c", inside, sys.executable, code]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def can_mount(place: Path) -> bool:
    if shutil.which("unshare") is None or shutil.which("mount") is None:
        return False
    command = ["unshare", "-m", "sh", "-c", f"mount -t tmpfs -o size=64k tmpfs {place}"]
    return subprocess.run(command, capture_output=True, check=False).returncode == 0


@posix
@pytest.mark.parametrize("limit", ["full", "read-only", "size"])
def test_no_room_for_the_result(tmp_path, source, limit):
    """A full disk, a read-only one, a limit on the size of a file: one line that says so, and the old result stays."""
    place = tmp_path / "disk"
    place.mkdir()
    if limit != "size" and not can_mount(place):
        pytest.skip("this user cannot mount a small disk")
    # the old result and a folder take pages of the disk; none is left for even the smallest new one
    found = fill(limit, source, place, mount={"full": "8k", "read-only": "1m", "size": ""}[limit])
    words = {"full": "the disk is full", "read-only": "is not writable", "size": "cannot be written"}[limit]
    for name in WRITERS:
        what, old_is_there, listed = found[name]
        if limit == "full" and what == "written":
            continue  # small enough after all
        assert words in what and name in what, (name, what)
        assert old_is_there and listed == [name], (name, listed)
    assert sum(found[name][0] != "written" for name in WRITERS) >= 6


@posix
@pytest.mark.skipif(os.name == "posix" and os.geteuid() == 0, reason="nothing is read-only to root")
@every_writer
def test_a_folder_without_leave_to_write(tmp_path, source, name):
    target = put_old(tmp_path / "out", name)
    (tmp_path / "out").chmod(0o500)
    try:
        with pytest.raises(InputError, match="not writable"):
            WRITERS[name](source, target)
    finally:
        (tmp_path / "out").chmod(0o700)
    assert content(target) == OLD and os.listdir(tmp_path / "out") == [name]


# --- a process that is killed -------------------------------------------------------------------------

_KILLED = """
import os, signal, sys
from pathlib import Path
sys.path.insert(0, {tests!r})
from test_faults import OLD, WRITERS, content, put_old
source, name, place, points = Path({source!r}), {name!r}, Path({place!r}), {points!r}
target = put_old(place, name)

def write(stop):
    # SIGKILL before the line number `stop` that runs from the first line of files.atomic on; the lines that ran
    seen = 0
    def each(frame, event, argument):
        nonlocal seen
        if event == "line":
            seen += 1
            if seen == stop:
                os.kill(os.getpid(), signal.SIGKILL)
        return each
    def begin(frame, event, argument):
        return each if seen or frame.f_code.co_filename.endswith("atomic.py") else None
    sys.settrace(begin)
    WRITERS[name](source, target)
    sys.settrace(None)
    return seen

def forked(stop):
    child = os.fork()
    if child == 0:
        write(stop)
        os._exit(0)
    return os.waitpid(child, 0)[1]

WRITERS[name](source, place / ("whole-" + name))
new = content(place / ("whole-" + name))
lines = write(-1)
assert content(target) == new
outcomes = {{"old": 0, "new": 0, "other": 0}}
for point in range(points):
    (target if target.is_file() else target / "a.csv").write_bytes(OLD)
    assert forked(1 + point * (lines - 1) // (points - 1)) == signal.SIGKILL
    now = content(target)
    outcomes["old" if now == OLD else "new" if now == new else "other"] += 1
    left = [p for p in os.listdir(place) if p not in (name, "whole-" + name)]
    outcomes["other"] += any(not p.startswith(".") for p in left)
assert forked(-1) == 0 and content(target) == new  # what the killed ones left is in nobody's way
print(lines, outcomes["old"], outcomes["new"], outcomes["other"])
"""


@posix
@pytest.mark.parametrize(
    ("name", "points"),
    [("cal.json", 60), ("table.csv", 25), ("applied.parquet", 25), ("applied", 25), ("report.html", 25)],
)
def test_killed_anywhere_leaves_the_old_or_the_new(tmp_path, source, name, points):
    """SIGKILL at points spread over all the lines that run while the result is written, first and last among them."""
    place = tmp_path / "out"
    code = _KILLED.format(
        tests=str(Path(__file__).parent), source=str(source), name=name, place=str(place), points=points
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    lines, old, new, other = map(int, done.stdout.split())
    assert other == 0
    assert lines > 50 and old > points // 4 and new > 0 and old + new == points


# --- Ctrl-C -------------------------------------------------------------------------------------------


@posix
@pytest.mark.parametrize(("suffix", "wait"), [(".csv", 0.0), (".parquet", 0.02), ("", 0.05)])
def test_interrupted_apply_leaves_the_old_result(tmp_path, suffix, wait):
    """Ctrl-C in the midst of a long table: exit status 130, one line, no half file, the old one as it was."""
    session, out = tmp_path / "session", tmp_path / "out"
    session.mkdir()
    write_table(session / "a.csv", a_table(1_000_000))
    calfile.save(CAL, tmp_path / "cal.json")
    target = put_old(out, f"result{suffix}")
    given = [tmp_path / "cal.json", session if suffix == "" else session / "a.csv", "-o", target, "--overwrite"]
    command = [sys.executable, "-m", "margcal.apps.cli", "apply", *map(str, given)]
    # a test run in the background of a shell inherits SIGINT as ignored: give the command what a terminal would
    heeding = lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)  # noqa: E731
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=heeding
    ) as process:
        while process.poll() is None and not _half_written(out):
            time.sleep(0.002)
        time.sleep(wait)
        process.send_signal(signal.SIGINT)
        _, said = process.communicate()
    assert process.returncode == 130, said
    assert said == "margcal: interrupted; nothing was left half written\n"
    assert content(target) == OLD
    assert os.listdir(out) == [f"result{suffix}"]


def _half_written(out: Path) -> bool:
    """Whether a temporary file, in a temporary folder perhaps, holds something by now."""
    return any(p.is_file() and p.stat().st_size for hidden in out.glob(".*") for p in (hidden, *hidden.glob("*")))
