"""Applying a calibration to 5e6 rows in memory, beside NumPy's own expression and a copy of the memory.

Interleaved in one process, one thread, CPU time; ratios of the minima. Run: python benchmarks/bench_apply.py
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time

import numpy as np

from margcal.core.types import SensorModel

_THREADS = dict.fromkeys(("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"), "1")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=5_000_000)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    if any(os.environ.get(name) != "1" for name in _THREADS):  # only taken note of when a process starts
        os.execve(sys.executable, [sys.executable, *sys.argv], os.environ | _THREADS)
    rng = np.random.default_rng(1)
    H = 0.0024 * (np.eye(3) + 0.03 * rng.normal(size=(3, 3)))
    B = np.array([33123.0, 33276.0, 32360.0])
    y = B + 4000 * rng.normal(size=(options.rows, 3))
    model = SensorModel("acc", H, B)
    candidates = {
        "margcal": lambda: model.apply(y),
        "numpy (y - B) @ H.T": lambda: (y - B) @ H.T,
        "np.copyto, new array": lambda: np.copyto(np.empty_like(y), y),
    }
    seconds: dict[str, list[float]] = {name: [] for name in candidates}
    for _ in range(options.rounds):
        for name, run in candidates.items():
            start = time.process_time()
            run()
            seconds[name].append(time.process_time() - start)
    best = {name: min(values) for name, values in seconds.items()}
    own = best["margcal"]
    exact = (y[:200_000].astype(np.longdouble) - B) @ H.T.astype(np.longdouble)
    scale = np.abs(H).max() * np.abs(B).max()
    error = float(np.abs(model.apply(y[:200_000]) - exact).max() / scale)
    result = {
        "rows": options.rows,
        "ns_per_row": {name: round(1e9 * s / options.rows, 2) for name, s in best.items()},
        "ratio_to_numpy": round(own / best["numpy (y - B) @ H.T"], 3),
        "ratio_to_copy": round(own / best["np.copyto, new array"], 3),
        "error_relative_to_HB": error,
    }
    if options.json:
        print(json.dumps(result))
        return
    for name, s in best.items():
        print(f"{name:24s} {1e9 * s / options.rows:7.2f} ns a row")
    print(f"margcal / numpy          {result['ratio_to_numpy']:7.3f}   (target <= 1)")
    print(f"margcal / memory copy    {result['ratio_to_copy']:7.3f}")
    print(f"error against long double, relative to |H||B|: {error:.1e}")


if __name__ == "__main__":
    main()
