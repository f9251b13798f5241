"""`one_step` in a batch of 1e4 nodes beside SLSQP on the same cost, a node, in one run.

    python benchmarks/bench_solvers.py [--nodes 10000] [--poses 20] [--slsqp 30] [--json]

One thread, CPU time, the two interleaved; the ratio is what counts (bar: at least 1000 with gradient). SLSQP
is given the bias, gradients and scaled variables; `one_step` finds the bias itself.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json
import time
from collections.abc import Callable

import numpy as np

from margcal.core import so3
from margcal.methods.baselines import slsqp
from margcal.methods.bounds import simulated_readings
from margcal.methods.ellipsoid import adjusted_ellipsoid, ellipsoid
from margcal.methods.transform import alternation, eigen, one_step, svd

H = np.array([[0.0210, -0.0024, 0.0034], [0.0, 0.0238, 0.0022], [0.0021, 0.0024, 0.0224]])
B = np.array([32429.0, 32318.0, 32368.0])
G = 9.80665
U = G * np.array([2.0, 4.0, 6.0]) / np.sqrt(56)


def cpu(job: Callable[[], object]) -> float:
    start = time.process_time()
    job()
    return time.process_time() - start


def measure(nodes: int, poses: int, n_slsqp: int) -> dict[str, float]:
    """CPU seconds a node of each solver: medians of five interleaved passes."""
    rng = np.random.default_rng(1)
    R = so3.matrix_from_quat(rng.normal(size=(poses, 4)))
    own = so3.matrix_from_quat(rng.normal(size=(nodes * poses, 4))).reshape(nodes, poses, 3, 3)
    y = simulated_readings(H, B, U, R, 1.39, nodes, rng)
    y_own = (own @ U) @ np.linalg.inv(H).T + B + 1.39 * rng.normal(size=y.shape)
    few = y[:1000]
    jobs: dict[str, tuple[Callable[[], object], int]] = {
        "one_step": (lambda: one_step(y, R, G), nodes),
        "one_step, own poses": (lambda: one_step(y_own, own, G), nodes),
        "one_step, single node with covariance": (lambda: one_step(y[0], R, G), 1),
        "eigen, bias given": (lambda: eigen(y, R, G, bias=B), nodes),
        "svd, bias given": (lambda: svd(few, R, G, bias=B), len(few)),
        "alternation 50, bias given": (lambda: alternation(few, R, G, bias=B), len(few)),
        "ellipsoid": (lambda: ellipsoid(few, G), len(few)),
        "slsqp, gradient": (lambda: [slsqp(v, R, G, bias=B) for v in y[:n_slsqp]], n_slsqp),
        "slsqp, differences": (lambda: [slsqp(v, R, G, bias=B, gradient=False) for v in y[:5]], 5),
    }
    seconds: dict[str, list[float]] = {name: [] for name in jobs}
    for job, _ in jobs.values():
        job()  # imports and caches
    for _ in range(5):
        for name, (job, count) in jobs.items():
            seconds[name].append(cpu(job) / count)
    result = {name: float(np.median(values)) for name, values in seconds.items()}
    d = rng.normal(size=(100_000, 3))
    swing = (G * d / np.linalg.norm(d, axis=1, keepdims=True)) @ np.linalg.inv(H).T + B + 14 * rng.normal(size=d.shape)
    result["adjusted_ellipsoid, 1e5 samples"] = cpu(lambda: adjusted_ellipsoid(swing, G))
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--nodes", type=int, default=10_000)
    parser.add_argument("--poses", type=int, default=20)
    parser.add_argument("--slsqp", type=int, default=30, help="nodes that SLSQP is timed on")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    found = measure(args.nodes, args.poses, args.slsqp)
    ratio = found["slsqp, gradient"] / found["one_step"]
    if args.json:
        print(json.dumps({"seconds_per_node": found, "slsqp_over_one_step": ratio, "bar": 1000}))
        return
    for name, value in found.items():
        print(f"{name:42s} {value * 1e6:12.2f} us")
    print(f"SLSQP with gradient / one_step, a node: {ratio:.0f} (bar 1000)")


if __name__ == "__main__":
    main()
