"""Damaged files into the readers and the calibration file: a result or a `MargcalError`, nothing else.

    python benchmarks/studies/fuzz.py [--cases 20000] [--seed 0] [--targets csv,calibration] [--json]
    python benchmarks/studies/fuzz.py --targets csv --case 1234 [--keep DIR]     one case again, with its traceback

Each case must end within 2 s and 300 MB; what is read must hold what a recording or a calibration holds (strictly
rising time, no infinite readings, known units; a calibration file that is written again reads back the same), and
nothing may warn. Cases run in a process of their own, one for each target after the other, so that a crash of a
library under it is a finding as well. Counts by outcome, and every finding with its case, are printed and kept in
``results/fuzz.json``. The exit status is 1 if there is a finding.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import contextlib
import json
import platform
import re
import selectors
import shutil
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

from fuzz_cases import TARGETS, case_of  # noqa: E402

from margcal.core.errors import MargcalError  # noqa: E402
from margcal.core.types import Calibration, Recording, SensorModel  # noqa: E402
from margcal.core.units import UNITS  # noqa: E402

SECONDS, MEGABYTES = 2.0, 300.0
PATIENCE = 30.0
"""Seconds of silence after which the process of a target is taken to hang."""


# --- what a case must do ------------------------------------------------------------------------------


class Broken(Exception):
    """What was read is not what the reader promises."""


def _must(holds: bool, what: str) -> None:
    if not holds:
        raise Broken(what)


OPTIONS: tuple[dict[str, Any], ...] = (
    {},
    {"skip_bad": 5, "sort": True},
    {"skip_bad": 1000, "units": {"acc": "g", "gyr": "dps", "mag": "uT"}},
    {"rate": 100.0, "skip_bad": 1},
)
"""How recordings are read, case by case in turn: as they are, or with what lets more of a damaged file pass."""


def _read(path: Path, number: int) -> None:
    from margcal.files.tables import read

    recording = read(path, **OPTIONS[number % len(OPTIONS)])
    _check_recording(recording)


def _check_recording(recording: Recording) -> None:
    _must(bool(recording.streams) or recording.reference is not None, "an empty recording")
    for kind, stream in recording.streams.items():
        _must(stream.unit in UNITS[kind], "an unknown unit")
        _must(bool(np.isfinite(stream.t).all() and (np.diff(stream.t) > 0).all()), "time that does not rise")
        _must(not np.isinf(stream.y).any() and len(stream.y) > 0, "infinite readings, or none")
    if (reference := recording.reference) is not None:
        norm = np.linalg.norm(reference.q, axis=1)
        _must(bool((np.isnan(norm) | (np.abs(norm - 1) < 1e-9)).all()), "a quaternion that is not of unit norm")


def _read_poses(path: Path, number: int) -> None:
    from margcal.files.tables import read_poses

    table = read_poses(path)
    _must((table.q is None) != (table.up is None), "both or neither of quaternions and faces")
    if table.q is not None:
        _must(bool(np.allclose(np.linalg.norm(table.q, axis=1), 1)), "a quaternion that is not of unit norm")
    if table.start is not None and table.stop is not None:
        _must(bool((table.stop > table.start).all()), "a rest that ends before it starts")


def _apply(path: Path, number: int) -> None:
    from margcal.workflow.apply import apply_file

    H = 0.01 * np.eye(3)
    mag = SensorModel("mag", H, np.ones(3), "uT", delay_s=0.004)
    calibration = Calibration(SensorModel("acc", H, np.ones(3)), mag=mag)
    before = set(os.listdir(path.parent))
    target = path.with_name("out.csv" if number % 2 else "out.parquet")
    try:
        apply_file(calibration, path, target, overwrite=True)
    except MargcalError:
        _must(not set(os.listdir(path.parent)) - before, "files left behind")
        raise
    _must(set(os.listdir(path.parent)) - before == {target.name}, "files left behind")


def _load(path: Path, number: int) -> None:
    from margcal.files.calfile import dumps, load, loads

    calibration = load(path)
    for model in calibration.models.values():
        _must(bool(np.isfinite(model.invert(model.H @ np.ones(3))).all()), "no inverse")
    if calibration.models:
        written = dumps(calibration)
        _must(dumps(loads(written)) == written, "a file that changes when it is written again")


RUN: dict[str, Callable[[Path, int], None]] = {
    "csv": _read,
    "parquet": _read,
    "folder": _read,
    "poses": _read_poses,
    "apply": _apply,
    "calibration": _load,
}


# --- one case -----------------------------------------------------------------------------------------


def run_case(target: str, seed: int, number: int, folder: Path) -> dict[str, Any]:
    """Outcome of one case: `outcome` (accepted, refused, or what went wrong), `where`, `seconds`, `megabytes`."""
    path = write_case(target, seed, number, folder)
    before = _reset_peak()
    start = time.perf_counter()
    outcome, where = outcome_of(target, path, number)
    seconds = time.perf_counter() - start
    megabytes = _peak() - before
    if seconds > SECONDS and outcome in ("accepted", "refused"):
        outcome, where = "slow", f"{seconds:.1f} s"
    if megabytes > MEGABYTES and outcome in ("accepted", "refused"):
        outcome, where = "large", f"{megabytes:.0f} MB"
    return {"outcome": outcome, "where": where, "seconds": round(seconds, 4), "megabytes": round(megabytes, 1)}


def write_case(target: str, seed: int, number: int, folder: Path) -> Path:
    """The case's input in `folder`, which is emptied first: a file, or the folder itself."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    files = case_of(target, seed, number)
    for name, data in files.items():
        (folder / name).write_bytes(data)
    return folder if target == "folder" else folder / next(iter(files))


def outcome_of(target: str, path: Path, number: int) -> tuple[str, str]:
    """(outcome, where) of the target's reader on `path`; a warning counts as a crash."""
    unheard: list[Any] = []  # exceptions that Python only prints: a traceback on the user's screen all the same
    usual, sys.unraisablehook = sys.unraisablehook, unheard.append
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            RUN[target](path, number)
        _must(not unheard, "an exception that was only printed")
        return "accepted", ""
    except MargcalError as error:
        text = str(error)
        if not text.strip() or "\n" in text or "\x1b" in text or len(text) > 2000:
            return "bad message", _place(error)
        return ("crash: printed only", _place(error)) if unheard else ("refused", "")
    except Exception as error:
        return f"crash: {type(error).__name__}", f"{_place(error)}: {re.sub(r'[^ -~]', '?', str(error))[:100]}"
    finally:
        sys.unraisablehook = usual


def _place(error: Exception) -> str:
    """Last line of margcal that the error went through."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if "margcal" in f.filename]
    frame = frames[-1] if frames else traceback.extract_tb(error.__traceback__)[-1]
    return f"{Path(frame.filename).name}:{frame.lineno}"


def _reset_peak() -> float:
    """Forget the peak of memory so far (Linux); what is held now, MB."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    return _peak("VmRSS")


def _peak(name: str = "VmHWM") -> float:
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith(name):
                return int(line.split()[1]) / 1024
    return 0.0


# --- many cases ---------------------------------------------------------------------------------------


def work(target: str, seed: int, first: int, last: int) -> None:
    """The process of a target: a line of JSON for each case."""
    with tempfile.TemporaryDirectory(prefix="margcal-fuzz-") as folder:
        for number in range(first, last):
            print(json.dumps(run_case(target, seed, number, Path(folder) / "case")), flush=True)


def results(target: str, seed: int, cases: int) -> Iterator[dict[str, Any]]:
    """Outcomes in order; a process that dies or hangs is one too, and is started again behind that case."""
    number = 0
    while number < cases:
        command = [sys.executable, __file__, "--worker", target, str(seed), str(number), str(cases)]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
            for line in _lines(process):
                yield json.loads(line)
                number += 1
            hangs = process.poll() is None and number < cases
            process.kill() if hangs else process.wait()
        if number < cases:
            what = "hangs" if hangs else f"dies: exit status {process.returncode}"
            yield {"outcome": what, "where": "", "seconds": PATIENCE if hangs else 0.0, "megabytes": 0.0}
            number += 1


def _lines(process: subprocess.Popen[bytes]) -> Iterator[bytes]:
    """Lines of the process's output until it ends, or says nothing for `PATIENCE` seconds."""
    assert process.stdout is not None
    waiting = b""
    with selectors.DefaultSelector() as selector:
        selector.register(process.stdout, selectors.EVENT_READ)
        while selector.select(PATIENCE):
            block = os.read(process.stdout.fileno(), 1 << 16)
            if not block:
                process.wait()
                return
            *lines, waiting = (waiting + block).split(b"\n")
            yield from lines


def fuzz(target: str, seed: int, cases: int, *, quiet: bool = False) -> dict[str, Any]:
    """Counts by outcome, the slowest and largest case, and findings, of one target."""
    counts: Counter[str] = Counter()
    findings: dict[str, list[int]] = {}
    slowest = largest = {"seconds": 0.0, "megabytes": 0.0, "case": -1}
    start = time.perf_counter()
    for number, result in enumerate(results(target, seed, cases)):
        counts[result["outcome"]] += 1
        result["case"] = number
        slowest = max(slowest, result, key=lambda r: r["seconds"])
        largest = max(largest, result, key=lambda r: r["megabytes"])
        if result["outcome"] not in ("accepted", "refused"):
            findings.setdefault(f"{result['outcome']} {result['where']}".strip(), []).append(number)
        if not quiet and (number + 1) % 1000 == 0:
            print(f"\r{target}: {number + 1} of {cases}", end="", file=sys.stderr, flush=True)
    if not quiet:
        print("\r" + " " * 60 + "\r", end="", file=sys.stderr)
    return {
        "cases": cases,
        "outcomes": dict(counts.most_common()),
        "slowest": {"seconds": slowest["seconds"], "case": slowest["case"]},
        "largest": {"megabytes": largest["megabytes"], "case": largest["case"]},
        "findings": {what: {"count": len(n), "cases": n[:5]} for what, n in findings.items()},
        "seconds": round(time.perf_counter() - start, 1),
    }


def show(target: str, found: dict[str, Any]) -> None:
    counts = ", ".join(f"{n} {what}" for what, n in found["outcomes"].items())
    slowest, largest = found["slowest"], found["largest"]
    print(f"{target}: {found['cases']} cases in {found['seconds']:.0f} s: {counts}")
    print(f"    slowest {slowest['seconds']:.2f} s (case {slowest['case']}), ", end="")
    print(f"largest {largest['megabytes']:.0f} MB (case {largest['case']})", flush=True)
    for what, finding in found["findings"].items():
        print(f"    {what}: {finding['count']} times, cases {', '.join(map(str, finding['cases']))}", flush=True)


def again(target: str, seed: int, number: int, keep: str | None) -> int:
    """One case, its files kept in `keep`, with the traceback."""
    folder = Path(keep or tempfile.mkdtemp(prefix="margcal-fuzz-")) / f"{target}-{seed}-{number}"
    path = write_case(target, seed, number, folder)
    print(f"{path} ({', '.join(sorted(os.listdir(folder)))})")
    outcome, where = outcome_of(target, path, number)
    print(outcome, where)
    try:
        RUN[target](path, number)
    except MargcalError as error:
        print(f"{type(error).__name__}: {error}")
    return 0


def main() -> int:
    if sys.argv[1:2] == ["--worker"]:
        target, seed, first, last = sys.argv[2:]
        work(target, int(seed), int(first), int(last))
        return 0
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=20_000, help="of each target (default 20000)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--targets", default=",".join(TARGETS), help=f"default {','.join(TARGETS)}")
    parser.add_argument("--case", type=int, help="this case alone, with its traceback")
    parser.add_argument("--keep", metavar="DIR", help="where the files of --case go")
    parser.add_argument("--no-record", action="store_true", help="leave results/fuzz.json as it is")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    targets = options.targets.split(",")
    if unknown := [t for t in targets if t not in TARGETS]:
        parser.error(f"there is no target {unknown[0]!r}; there are {', '.join(TARGETS)}")
    if options.case is not None:
        return again(targets[0], options.seed, options.case, options.keep)
    found = {}
    for target in targets:
        found[target] = fuzz(target, options.seed, options.cases, quiet=options.json)
        if not options.json:
            show(target, found[target])
    machine = f"Python {platform.python_version()}, {platform.machine()}"
    record = {"date": time.strftime("%Y-%m-%d"), "machine": machine, "seed": options.seed, "targets": found}
    text = json.dumps(record, indent=2) + "\n"
    if not options.no_record:
        (HERE / "results").mkdir(exist_ok=True)
        (HERE / "results" / "fuzz.json").write_text(text, encoding="utf-8")
    if options.json:
        print(text, end="")
    return int(any(f["findings"] for f in found.values()))


if __name__ == "__main__":
    sys.exit(main())
