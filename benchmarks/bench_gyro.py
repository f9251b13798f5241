"""Gyroscope calibration: `gauss_newton` beside SciPy's trust region on Z-TIE's cost (43), in one run.

Ten turns of 180 degrees, 1 s at 100 Hz, standard deviation .05 rad/s, from the nominal scale. Reported are medians of
interleaved runs and their ratios; the machine's speed drops out. SciPy is called as a user would call it (numerical
Jacobian, default tolerances) on (43), with Int once as printed in the paper, a loop over the samples (all turns at
once), and once vectorised in NumPy over the samples too; for the record also with margcal's compiled Int, which makes
SciPy's side faster as well, and with margcal's exact Jacobian.

    python benchmarks/bench_gyro.py [--runs N]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np
from scipy.optimize import least_squares

from margcal.core import compiled, so3
from margcal.methods.gyro import gauss_newton
from margcal.methods.gyro_paper import trust_region, ukf
from margcal.methods.preintegration import TurnBatch, integrate_quat

TARGET = 10.0


def make(seed: int = 0) -> tuple[TurnBatch, np.ndarray, np.ndarray]:
    """Turns, their known quaternions, and the true H."""
    rng = np.random.default_rng(seed)
    H = np.eye(3) + 0.05 * rng.normal(size=(3, 3))
    axis = rng.normal(size=(10, 3))
    u = np.pi * (axis / np.linalg.norm(axis, axis=1, keepdims=True))[:, None] * np.ones((1, 100, 1))
    dt = np.full((10, 100), 0.01)
    y = u @ np.linalg.inv(H).T + 0.05 * rng.normal(size=u.shape)
    return TurnBatch(y, dt), integrate_quat(u, dt, np.eye(3)), H


def sample_by_sample(turns: TurnBatch, H: np.ndarray) -> np.ndarray:
    """Int of (52)-(55) as printed: a loop over the samples, all turns at once."""
    q = np.tile([1.0, 0, 0, 0], (len(turns), 1))
    for i in range(turns.dt.shape[1]):
        q = so3.quat_multiply(q, so3.quat_exp((turns.y[:, i] @ H.T) * turns.dt[:, i, None]))
    return q


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=15)
    runs = parser.parse_args().runs
    turns, q, H = make()
    dR, start = so3.matrix_from_quat(q), np.eye(3)

    def scipy_with(integrate: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        found = least_squares(lambda x: (integrate(x.reshape(3, 3)) - q).ravel(), start.ravel(), method="trf")
        return found.x.reshape(3, 3)

    def in_numpy(x: np.ndarray) -> np.ndarray:
        """Int of margcal, vectorised over turns and samples, by its NumPy path."""
        kernels, compiled._kernels = compiled.extension(), None
        try:
            return integrate_quat(turns.y, turns.dt, x)
        finally:
            compiled._kernels = kernels

    jobs: dict[str, Callable[[], np.ndarray]] = {
        "gauss_newton": lambda: gauss_newton(turns, dR, H0=start, sd=0.05, sigma_angle=0.0).model.H,
        "scipy trf, Int sample by sample": lambda: scipy_with(lambda x: sample_by_sample(turns, x)),
        "scipy trf, Int vectorised in NumPy": lambda: scipy_with(in_numpy),
        "scipy trf, Int of margcal, compiled": lambda: scipy_with(lambda x: integrate_quat(turns.y, turns.dt, x)),
        "scipy trf, Int and exact Jacobian of margcal": lambda: trust_region(turns, q=q, H0=start).model.H,
        "ukf, 10 iterations": lambda: ukf(turns, q=q, H0=start, n_iter=10).model.H,
    }
    spent: dict[str, list[float]] = {name: [] for name in jobs}
    error: dict[str, float] = {}
    for _ in range(runs + 1):
        for name, job in jobs.items():
            began = time.process_time()
            error[name] = float(np.linalg.norm(job() - H))
            spent[name].append(time.process_time() - began)
    median = {name: float(np.median(values[1:])) for name, values in spent.items()}
    ours = median["gauss_newton"]
    for name in jobs:
        print(
            f"{name:48s} {1e3 * median[name]:8.2f} ms   {median[name] / ours:6.1f} x   |H - H_true| {error[name]:.5f}"
        )
    print(f"compiled kernels: {compiled.state()}")
    for name in ("scipy trf, Int sample by sample", "scipy trf, Int vectorised in NumPy"):
        print(f"gauss_newton is {median[name] / ours:.1f} x faster than {name} (target {TARGET:.0f} x)")


if __name__ == "__main__":
    main()
