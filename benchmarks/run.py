"""Every benchmark of this folder, one after the other: python benchmarks/run.py [NAME...] [--json]

NAME is the middle of a file's name: `apply` for bench_apply.py. Each is a process of its own and prints ratios of
what it holds side by side in one run. Output is shown as it comes and kept in benchmarks/results/; with --json the
results come as one JSON object instead (of a benchmark that prints no JSON, its lines). The exit status is 1 if a
benchmark could not be run.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    known = [p.stem.removeprefix("bench_") for p in sorted(HERE.glob("bench_*.py"))]
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"some of {', '.join(known)}; default: all")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    if unknown := [n for n in options.names if n not in known]:
        parser.error(f"there is no benchmark {unknown[0]!r}; there are {', '.join(known)}")
    load = os.getloadavg()[0]
    machine = f"Python {platform.python_version()}, {platform.machine()}, {os.cpu_count()} cores, load {load:.1f}"
    results, failed = {}, False
    if not options.json:
        print(machine, flush=True)
    for name in options.names or known:
        text, status = run(name, options.json)
        failed |= status != 0
        if options.json:
            results[name] = None if status else json.loads(text) if text.startswith("{") else text.splitlines()
    if options.json:
        print(json.dumps({"machine": machine, "results": results}, indent=2))
    return int(failed)


def run(name: str, as_json: bool) -> tuple[str, int]:
    """Output and exit status of one benchmark; shown line by line unless it is JSON."""
    file = HERE / f"bench_{name}.py"
    options = ["--json"] if as_json and '"--json"' in file.read_text(encoding="utf-8") else []
    command = [sys.executable, str(file), *options]
    if not as_json:
        print(f"\n== {name}", flush=True)
    start, lines = time.perf_counter(), []
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            lines.append(line)
            if not as_json:
                print(line, end="", flush=True)
    text = "".join(lines)
    if not as_json:
        print(f"({time.perf_counter() - start:.0f} s)", flush=True)
        folder = HERE / "results"
        folder.mkdir(exist_ok=True)
        (folder / f"{name}.txt").write_text(text, encoding="utf-8")
    if process.returncode:
        print(f"bench_{name}.py: exit status {process.returncode}", file=sys.stderr)
    return text, process.returncode


if __name__ == "__main__":
    sys.exit(main())
