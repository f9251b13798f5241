"""Whole processes, from the command to its end: `margcal --help` and `margcal calibrate`, beside bare Python.

    python benchmarks/bench_startup.py [--rounds 9] [--json]

Targets: `margcal --help` at most 1.5 times `python -c "import numpy"`; `margcal calibrate` on the Xsens recording
(51175 rows, 37 rests), without report, at most 3 times a Python process that only reads the same
file into NumPy. The candidates take turns (A B A B ...), each is a new process with one thread; CPU time is the
process's own (user and system), wall time from start to end. Ratios are of the medians over the rounds, and of the
minima. The recording is read from MARGCAL_DATA (default ../shared/data); without it that part is left out.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

DATA = Path(os.environ.get("MARGCAL_DATA", Path(__file__).resolve().parents[1] / ".." / "shared" / "data"))
XSENS = DATA.resolve() / "imu_tk" / "xsens_mti_multipose.parquet"
MARGCAL = str(Path(sys.executable).parent / "margcal")
READ = (
    "import sys, pyarrow.parquet as pq; "
    "t = pq.read_table(sys.argv[1], use_threads=False); a = {n: t[n].to_numpy() for n in t.column_names}"
)
HELP_LIMIT, CALIBRATE_LIMIT = 1.5, 3.0


def run_once(command: list[str]) -> tuple[float, float]:
    """(CPU s, wall s) of one process."""
    env = os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    env.pop("PYTHONDONTWRITEBYTECODE", None)  # installed packages have their byte code; ours is to have it too
    start = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, env=env)
    assert process.stderr is not None
    message = process.stderr.read()
    _, status, usage = os.wait4(process.pid, 0)
    wall = time.perf_counter() - start
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        sys.exit(f"{' '.join(command)}: exit status {process.returncode}: {message.decode()}")
    return usage.ru_utime + usage.ru_stime, wall


def compare(ours: list[str], bare: list[str], rounds: int, limit: float) -> dict[str, object]:
    """Times of the two side by side, and their ratios."""
    for command in (ours, bare):
        run_once(command)  # byte code and the disk's cache
    times = [(run_once(ours), run_once(bare)) for _ in range(rounds)]
    found: dict[str, object] = {"command": " ".join(Path(c).name if c.startswith("/") else c for c in ours)}
    for k, name in enumerate(("cpu", "wall")):
        a, b = [o[k] for o, _ in times], [p[k] for _, p in times]
        found[name] = {
            "ours_ms": round(1e3 * statistics.median(a), 1),
            "bare_ms": round(1e3 * statistics.median(b), 1),
            "ratio": round(statistics.median(a) / statistics.median(b), 3),
            "ratio_of_minima": round(min(a) / min(b), 3),
        }
    return found | {"limit": limit}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    python = sys.executable
    results = {"help": compare([MARGCAL, "--help"], [python, "-c", "import numpy"], options.rounds, HELP_LIMIT)}
    if XSENS.exists():
        ours = [MARGCAL, "calibrate", str(XSENS), "--poses", "free", "--gravity", "9.81744"]
        bare = [python, "-c", READ, str(XSENS)]
        results["calibrate"] = compare(ours, bare, options.rounds, CALIBRATE_LIMIT)
    if options.json:
        print(json.dumps(results))
        return
    print(f"{'':10s} {'':4s} {'margcal ms':>11s} {'bare ms':>9s} {'ratio':>7s} {'of minima':>10s}  target")
    for name, found in results.items():
        for clock in ("cpu", "wall"):
            row = found[clock]
            assert isinstance(row, dict)
            print(
                f"{name:10s} {clock:4s} {row['ours_ms']:11.1f} {row['bare_ms']:9.1f} {row['ratio']:7.2f} "
                f"{row['ratio_of_minima']:10.2f}  <= {found['limit']}"
            )
    if not XSENS.exists():
        print(f"calibrate: left out, {XSENS} is not here (set MARGCAL_DATA)")


if __name__ == "__main__":
    main()
