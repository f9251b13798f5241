"""Z-TIE's simulation A: closed form beside SLSQP with numerical gradient, per run, in one run of this script.

    python benchmarks/bench_papers.py [--runs 1000] [--json]

CPU time, one thread, interleaved. Bar: the closed form (`eigen` with the bias given, `one-step` with the bias found) at
least 300 times faster than SciPy's SLSQP on the paper's cost with a gradient by differences. Both numbers of the closed
form are printed: a run alone, which is Python's overhead, and a run within a batch, which is how `margcal reproduce`
and a fleet use it.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json

import numpy as np

from margcal.apps.papers import z_tie_simulation_a as sim

BAR = 300.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=1000)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    rng = np.random.default_rng(0)
    typical = sim.pose_sets(rng)[sim.N_DRAWS // 2]
    world = sim.fixed_world(typical, 1.39, args.runs, rng)
    spent = sim.cpu_seconds(world, lambda _: None, repeats=8)
    slow = spent["slsqp, differences"]
    if args.json:
        print(json.dumps({"seconds": spent, "slsqp_over": {k: slow / v for k, v in spent.items()}, "bar": BAR}))
        return
    for name, seconds in spent.items():
        print(f"{name:42s} {1e6 * seconds:10.1f} us   SLSQP with differences / this {slow / seconds:9.1f}")
    for name in ("eigen, in a batch", "one-step, in a batch"):
        print(f"{name}: {slow / spent[name]:.0f} x faster than SLSQP with differences (bar {BAR:.0f})")


if __name__ == "__main__":
    main()
