"""Orientation filters and the other compiled kernels, beside what else there is, interleaved in one run.

One thread, CPU time, ratios of the minima: `ekf-quest`, `vector-selection` and plain integration beside vqf, imufusion
and ahrs (those that are installed; the last two go sample by sample through Python, as their users do); eight nodes
in the lanes beside one node after the other; still detection, integration over sigma points and apply beside their
NumPy paths and a memory copy. Then whole processes: `margcal orient` on a CSV of 60 s and of one hour, beside Python
with pandas and vqf doing the same.

    python benchmarks/bench_orient.py [--rounds N] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from margcal.core import compiled
from margcal.core.types import SensorModel
from margcal.methods import ekf_quest, strapdown, vector_selection
from margcal.methods.preintegration import integrate_quat
from margcal.workflow import segment

_THREADS = dict.fromkeys(("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"), "1")
N, NODES, RATE = 20_000, 8, 100.0
IN_A_ROW = 20
"""Calls of what takes microseconds that are timed together."""
PANDAS = """
import sys, numpy as np, pandas as pd, vqf
d = pd.read_csv(sys.argv[1])
read = lambda k, u: np.ascontiguousarray(d[[f"{k}_{a}_{u}" for a in "xyz"]].to_numpy())
out = vqf.VQF(0.01).updateBatch(read("gyr", "radps"), read("acc", "mps2"), read("mag", "uT"))
q = pd.DataFrame(out["quat9D"], columns=["qw", "qx", "qy", "qz"])
q.insert(0, "t_s", d["t_s"])
q.to_csv(sys.argv[2], index=False)
"""
Job = Callable[[], object]


def motion(nodes: int, n: int, seed: int = 0) -> tuple[np.ndarray, ...]:
    """dt, gyroscope, accelerometer, magnetometer of nodes that are turned about like a hand."""
    from margcal.core import so3

    rng = np.random.default_rng(seed)
    t = np.arange(n) / RATE
    w = 2 * np.sin((0.5 + rng.random((nodes, 1, 3))) * t[:, None] + 6 * rng.random((nodes, 1, 3)))
    q = integrate_steps(w / RATE)
    R = so3.matrix_from_quat(q)
    acc = np.einsum("mnji,j->mni", R, [0, 0, 9.80665]) + 0.3 * rng.normal(size=w.shape)
    mag = np.einsum("mnji,j->mni", R, [0, 20.0, -44.7]) + 0.3 * rng.normal(size=w.shape)
    return np.full((nodes, n), 1 / RATE), w + 0.002 * rng.normal(size=w.shape), acc, mag


def integrate_steps(steps: np.ndarray) -> np.ndarray:
    """Attitudes (..., n, 4) after each small rotation."""
    params, start = strapdown.Params(), strapdown.start(np.tile([1.0, 0, 0, 0], (len(steps), 1)))
    return strapdown.batch(params, start, np.ones(steps.shape[:2]), steps, steps, steps).q


def peers(gyr: np.ndarray, acc: np.ndarray, mag: np.ndarray) -> dict[str, tuple[Job, int]]:
    """The public filters that are installed: what to run, and on how many samples."""
    jobs: dict[str, tuple[Job, int]] = {}
    try:
        import vqf

        jobs["vqf.VQF.updateBatch"] = (lambda: vqf.VQF(1 / RATE).updateBatch(gyr, acc, mag), len(gyr))
    except ImportError:
        pass
    few = len(gyr) // 10
    try:
        import imufusion

        degrees, g = np.degrees(gyr), acc / 9.80665

        def fusion() -> None:
            filter = imufusion.Ahrs()
            for k in range(few):
                filter.update(degrees[k], g[k], mag[k])
                filter.get_quaternion()

        fusion()
        jobs["imufusion.Ahrs.update"] = (fusion, few)
    except (ImportError, TypeError):
        pass
    try:
        from ahrs.filters import Madgwick

        jobs["ahrs.filters.Madgwick"] = (
            lambda: Madgwick(gyr=gyr[:few], acc=acc[:few], mag=mag[:few], frequency=RATE),
            few,
        )
    except ImportError:
        pass
    return jobs


def interleaved(jobs: dict[str, Job], rounds: int) -> dict[str, float]:
    """Least CPU seconds of each job."""
    best = dict.fromkeys(jobs, float("inf"))
    for _ in range(rounds):
        for name, job in jobs.items():
            began = time.process_time()
            job()
            best[name] = min(best[name], time.process_time() - began)
    return best


def switched(off: bool, job: Job) -> Job:
    """The job with the compiled kernels, or without."""
    kernels = compiled.extension()

    def run() -> object:
        compiled._kernels = None if off else kernels
        try:
            return job()
        finally:
            compiled._kernels = kernels

    return run


def filters(rounds: int) -> dict[str, float]:
    """Nanoseconds a sample (and node)."""
    dt, gyr, acc, mag = motion(NODES, N)
    one = tuple(a[0].copy() for a in (dt, gyr, acc, mag))
    q0 = np.tile([1.0, 0, 0, 0], (NODES, 1))
    jobs: dict[str, tuple[Job, int]] = {}
    for name, f in (("ekf-quest", ekf_quest), ("vector-selection", vector_selection), ("gyro", strapdown)):
        p = f.Params() if f is strapdown else f.Params(field=49.0, dip=1.15)
        jobs[name] = (lambda f=f, p=p: f.batch(p, f.start(q0[0]), *one), N)
        jobs[f"{name}, {NODES} nodes in lanes"] = (
            lambda f=f, p=p: f.batch(p, f.start(q0), dt, gyr, acc, mag),
            NODES * N,
        )
        few = tuple(a[:200].copy() for a in one)
        slow = switched(True, lambda f=f, p=p, few=few: f.batch(p, f.start(q0[0]), *few))
        jobs[f"{name}, NumPy"] = (slow, 200)
    jobs["ekf-quest, plain doubles"] = (plain_ekf(one), N)
    jobs |= peers(*one[1:])
    best = interleaved({k: job for k, (job, _) in jobs.items()}, rounds)
    return {k: 1e9 * best[k] / jobs[k][1] for k in jobs}


def plain_ekf(one: tuple[np.ndarray, ...]) -> Job:
    """The same C++ with plain doubles for one node: what the lanes hold eight of."""
    kernels = compiled.extension()
    assert kernels is not None
    dt, gyr, acc, mag = (a[None] for a in one)
    out = np.empty((1, N, 4)), np.empty((1, N, 3)), np.empty((1, N), dtype=np.uint8)
    params, start = np.array([ekf_quest.Params()]), ekf_quest.start([1.0, 0, 0, 0])

    def run() -> None:
        state = np.concatenate([start.x, start.P.ravel()])[None].copy()
        best = kernels.lanes()
        kernels.use_lanes("baseline")
        kernels.ekf_quest(params, state, dt, gyr, acc, mag, *out, one_by_one=True)
        kernels.use_lanes(best)

    return run


def others(rounds: int) -> dict[str, dict[str, float]]:
    """Still detection, sigma points, apply: kernel, NumPy, and a memory copy (seconds)."""
    rng = np.random.default_rng(1)
    n = 360_000
    t = np.sort(np.arange(n) / RATE + 1e-4 * rng.normal(size=n))
    y = 0.01 * rng.normal(size=(n, 3)).cumsum(axis=0)
    grid = np.arange(t[0] + 0.15, t[-1] - 0.15, 0.05)

    def still() -> object:
        return segment._scatter(t, y, grid, 0.3)

    turn, dt = rng.normal(size=(1, 200, 3)), np.full((1, 200), 0.01)
    H = (np.eye(3) + 0.1 * rng.normal(size=(19, 3, 3)))[:, None]

    def sigma() -> None:
        for _ in range(IN_A_ROW):  # as a filter calls it
            integrate_quat(turn, dt, H)

    rows = 33_000.0 + 4000 * rng.normal(size=(2_000_000, 3))
    model, target = SensorModel("acc", np.eye(3) + 0.01, np.full(3, 33_000.0)), np.empty_like(rows)
    kernels = compiled.extension()
    assert kernels is not None
    many = interleaved({"kernel": sigma, "NumPy": switched(True, sigma)}, 3 * rounds)
    found = {
        "still detection, 1 h": interleaved({"kernel": still, "NumPy": switched(True, still)}, rounds),
        "19 sigma points x 200": {name: seconds / IN_A_ROW for name, seconds in many.items()},
        "apply, 2e6 rows": interleaved(
            {
                "kernel": lambda: model.apply(rows),
                "NumPy": switched(True, lambda: model.apply(rows)),
                "copy": lambda: np.copyto(np.empty_like(rows), rows),
                "kernel, into place": lambda: kernels.apply(rows, model.H, model.B, target),
                "copy, into place": lambda: np.copyto(target, rows),
            },
            rounds,
        ),
    }
    return found


def processes(seconds: int, rounds: int) -> dict[str, float] | None:
    """CPU seconds of `margcal orient` and of pandas with vqf on a CSV file; None without them."""
    from bench_startup import MARGCAL, run_once

    try:
        import pandas as pd
        import vqf  # noqa: F401
    except ImportError:
        return None
    n = int(seconds * RATE)
    _, gyr, acc, mag = (a[0] for a in motion(1, n))
    with tempfile.TemporaryDirectory() as folder:
        recording, ours, theirs = (Path(folder) / name for name in ("recording.csv", "ours.csv", "theirs.csv"))
        columns = {"t_s": np.arange(n) / RATE}
        for kind, unit, values in (("acc", "mps2", acc), ("gyr", "radps", gyr), ("mag", "uT", mag)):
            columns |= {f"{kind}_{a}_{unit}": values[:, i] for i, a in enumerate("xyz")}
        pd.DataFrame(columns).to_csv(recording, index=False)
        base = [MARGCAL, "orient", str(recording), "-o", str(ours), "--overwrite", "--filter"]
        commands = {
            "vector-selection": [*base, "vector-selection"],
            "ekf-quest": [*base, "ekf-quest"],
            "pandas + vqf": [sys.executable, "-c", PANDAS, str(recording), str(theirs)],
        }
        times: dict[str, list[float]] = {name: [] for name in commands}
        for k in range(rounds + 1):
            for name, command in commands.items():
                cpu, _ = run_once(command)
                if k:  # the first round is for byte code and the disk's cache
                    times[name].append(cpu)
    return {name: float(np.median(values)) for name, values in times.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    if any(os.environ.get(name) != "1" for name in _THREADS):  # only taken note of when a process starts
        os.execve(sys.executable, [sys.executable, *sys.argv], os.environ | _THREADS)
    if compiled.extension() is None:
        sys.exit(f"compiled kernels: {compiled.state()}")
    speed, kernels = filters(options.rounds), others(options.rounds)
    whole = {f"{s} s": processes(s, rounds) for s, rounds in ((60, options.rounds), (3600, 2))}
    ratios = summary(speed, kernels, whole)
    if options.json:
        print(
            json.dumps(
                {
                    "lanes": compiled.state(),
                    "ns_per_sample": speed,
                    "seconds": kernels,
                    "processes": whole,
                    "ratios": ratios,
                }
            )
        )
        return
    print(f"compiled kernels: {compiled.state()}")
    for name, ns in speed.items():
        print(f"{name:36s} {ns:10.1f} ns a sample   {1e3 / ns:8.3f} million samples/s")
    for name, row in kernels.items():
        print(f"{name:24s} " + "   ".join(f"{k} {1e6 * s:.1f} us" for k, s in row.items()))
    for name, row in whole.items():
        if row:
            print(f"orient, {name:16s} " + "   ".join(f"{k} {1e3 * s:.0f} ms" for k, s in row.items()))
    for name, (value, target) in ratios.items():
        print(f"{name:64s} {value:8.2f}   {target}")


def summary(
    speed: dict[str, float], kernels: dict[str, dict[str, float]], whole: dict[str, dict[str, float] | None]
) -> dict[str, tuple[float, str]]:
    """The ratios that count, each with its target."""
    lanes = speed[f"ekf-quest, {NODES} nodes in lanes"]
    ratios: dict[str, tuple[float, str]] = {}
    if "vqf.VQF.updateBatch" in speed:
        ratios["ekf-quest, samples/s over vqf"] = (speed["vqf.VQF.updateBatch"] / speed["ekf-quest"], "target 1.6")
    ratios["ekf-quest in lanes over plain doubles, one node"] = (speed["ekf-quest, plain doubles"] / lanes, "target 5")
    ratios["ekf-quest in lanes over the kernel for one node"] = (speed["ekf-quest"] / lanes, "")
    for name, target in (("still detection, 1 h", "target 12"), ("19 sigma points x 200", "target 30")):
        ratios[f"{name}, NumPy over kernel"] = (kernels[name]["NumPy"] / kernels[name]["kernel"], target)
    copies = kernels["apply, 2e6 rows"]
    ratios["apply over a memory copy, new arrays"] = (copies["kernel"] / copies["copy"], "target at most 1.6")
    ratios["apply over a memory copy, into place"] = (
        copies["kernel, into place"] / copies["copy, into place"],
        "at most 1.6",
    )
    for name, row in whole.items():
        for ours in ("vector-selection", "ekf-quest"):
            if row is None:
                continue
            limit = "target at most .5" if name == "60 s" else ""
            ratios[f"orient {ours}, {name}, over pandas + vqf"] = (row[ours] / row["pandas + vqf"], limit)
    return ratios


if __name__ == "__main__":
    main()
