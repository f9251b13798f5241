"""Z-TIE III.A: accelerometer from 20 orientations, simulated; errors of every method over many runs.

Nothing here knows the paper's results: those are in `z_tie`. Where the paper leaves a setting open, the choice stands
in `Setting` and is printed with the table.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from margcal.core import so3
from margcal.core.types import Array, Fit
from margcal.methods import baselines
from margcal.methods.bounds import Bound, cramer_rao, simulated_readings
from margcal.methods.gls import gls_ml
from margcal.methods.sensor_model import mounting
from margcal.methods.transform import alternation, eigen, one_step, svd
from margcal.workflow.metrics import frobenius, length, rms

B_A = np.array([2429.0, 2318.0, 2368.0])  # count
U_A = np.array([2.6191601, 5.2383203, 7.8574805])  # m/s^2
H_A = np.array(
    [[0.0209850, -0.0023786, 0.0033562], [0.0, 0.0237864, 0.0022374], [0.0020985, 0.0023786, -0.0223744]]
)  # m/s^2 per count
G = float(np.linalg.norm(U_A))
SCALES = np.array([9.8 / 467, 9.8 / 412, 9.8 / 438])
"""S of H_a = T S, m/s^2 per count: the printed H_a is [[1, -.1, .15], [0, 1, .1], [.1, .1, -1]] times this."""

N_POSES = 20
N_ITER = 50
N_DRAWS = 21
"""Pose sets that are drawn to find a typical one, and to see how far the choice matters."""

Work = Callable[[int], None]
"""Told how much more is done."""


@dataclass(frozen=True)
class World:
    """What is simulated: rotations R (J, 3, 3) or, drawn anew in each run, (runs, J, 3, 3), and readings.

    `H_unit` (3,) divides the columns of an error of H: `SCALES` gives errors of T, ones those of H itself.
    `u0` (runs, 3) starts the iteration.
    """

    R: Array
    y: Array
    sigma: float
    H_unit: Array
    u0: Array

    @property
    def runs(self) -> int:
        return len(self.y)

    def R_of(self, run: int) -> Array:
        return self.R if self.R.ndim == 3 else self.R[run]

    def first(self, runs: int) -> World:
        R = self.R if self.R.ndim == 3 else self.R[:runs]
        return World(R, self.y[:runs], self.sigma, self.H_unit, self.u0[:runs])


def euler_set(rng: np.random.Generator, n: int) -> Array:
    """n attitudes (n, 3, 3) with three Euler angles uniform on 0..180 degrees; the first is the reference, I."""
    R = np.array([mounting(*angles) for angles in rng.uniform(0, np.pi, (n, 3))])
    R[0] = np.eye(3)
    return R


def random_set(rng: np.random.Generator, *shape: int) -> Array:
    """Attitudes (*shape, 3, 3) uniform over all rotations; the first of each set is the reference, I."""
    R = so3.matrix_from_quat(rng.normal(size=(*shape, 4)))
    R[..., 0, :, :] = np.eye(3)
    return R


def lambda2(R: Array) -> float:
    """Second eigenvalue of M/J without noise: the iteration converges at the rate 1 - lambda2."""
    y = (R @ U_A) @ np.linalg.inv(H_A).T + B_A
    return float(eigen(y, R, G, bias=B_A).details["lambda"][1])


def pose_sets(rng: np.random.Generator) -> list[Array]:
    """`N_DRAWS` Euler sets in the order of their lambda2: the one in the middle is typical."""
    return sorted((euler_set(rng, N_POSES) for _ in range(N_DRAWS)), key=lambda2)


def fixed_world(R: Array, sigma: float, runs: int, rng: np.random.Generator) -> World:
    """One pose set for all runs; u0 as MATLAB's rand(3, 1) gives it, each component uniform on 0..1."""
    y = simulated_readings(H_A, B_A, U_A, R, sigma, runs, rng)
    return World(R, y, sigma, SCALES, rng.uniform(size=(runs, 3)))


def redrawn_world(sigma: float, runs: int, rng: np.random.Generator) -> World:
    """Random attitudes, anew in each run; errors of H as they are."""
    R = random_set(rng, runs, N_POSES)
    y = (R @ U_A) @ np.linalg.inv(H_A).T + B_A + sigma * rng.normal(size=(runs, N_POSES, 3))
    return World(R, y, sigma, np.ones(3), rng.uniform(size=(runs, 3)))


# --- errors of one method over the runs ---------------------------------------------------------------


@dataclass(frozen=True)
class Errors:
    """Estimate minus truth: H (..., 3, 3) in units of `World.H_unit`, B (..., 3) counts, u (..., 3) m/s^2."""

    H: Array
    B: Array
    u: Array

    @property
    def H_norm(self) -> Array:
        return frobenius(self.H)

    @property
    def u_norm(self) -> Array:
        return length(self.u)

    @property
    def B_percent(self) -> Array:
        """Of each component of the bias, relative to it (runs, 3)."""
        return 100 * np.abs(self.B) / B_A


SIGN = float(np.sign(np.linalg.det(H_A)))
"""Solvers return det H > 0; the paper's H_a has det < 0, so (H, u) are compared with their sign turned."""


def errors_of(fit: Fit, world: World) -> Errors:
    u = np.zeros(3) if fit.u is None else fit.u
    return Errors((SIGN * fit.model.H - H_A) / world.H_unit, fit.model.B - B_A, SIGN * u - U_A)


METHODS: dict[str, Callable[[World], Fit]] = {
    "alternation (paper)": lambda w: alternation(w.y, w.R, G, u0=w.u0, n_iter=N_ITER),
    "svd (ZY-TBME)": lambda w: svd(w.y, w.R, G),
    "eigen": lambda w: eigen(w.y, w.R, G),
    "one-step": lambda w: one_step(w.y, w.R, G),
    "gls-ml": lambda w: gls_ml(w.y, w.R, G),
}


def all_errors(world: World, work: Work) -> dict[str, Errors]:
    """Errors of every method on the same readings."""
    out = {}
    for name, solve in METHODS.items():
        parts = [errors_of(solve(part), part) for part in _parts(world, 250)]
        joined = (np.concatenate(columns) for columns in zip(*((e.H, e.B, e.u) for e in parts)))
        out[name] = Errors(*joined)
        work(world.runs)
    return out


def _parts(world: World, size: int) -> list[World]:
    """The runs in pieces that keep the work in cache."""
    out = []
    for i in range(0, world.runs, size):
        some = slice(i, i + size)
        R = world.R if world.R.ndim == 3 else world.R[some]
        out.append(World(R, world.y[some], world.sigma, world.H_unit, world.u0[some]))
    return out


# --- iterates -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Iterates:
    """Errors of the estimate after 1, 2 ... `N_ITER` iterations: norms (N_ITER, runs); u (N_ITER, 3) of `shown`.

    `n_iter` (runs,): iterations after which the method stopped by itself.
    """

    H_norm: Array
    u_norm: Array
    u: Array
    n_iter: Array


def typical_run(world: World, of: int) -> int:
    """Of the first `of` runs the one whose start is at the median angle from the truth: the run that is drawn."""
    angle = np.abs(world.u0[:of] @ U_A) / length(world.u0[:of])
    return int(np.argsort(angle)[of // 2])


def alternation_iterates(world: World, shown: int = 0) -> Iterates:
    """The paper's iteration, each iterate rescaled by (32); `u` of the run `shown`."""
    fit = METHODS["alternation (paper)"](world)
    scale = SIGN * G / length(fit.history["u"])
    H = fit.history["H"] * scale[..., None, None]
    u = fit.history["u"] * scale[..., None]
    return Iterates(
        frobenius((H - H_A) / world.H_unit), length(u - U_A), u[:, shown], np.full(world.runs, N_ITER, dtype=float)
    )


def slsqp_iterates(world: World, work: Work, shown: int = 0) -> Iterates:
    """SciPy's SLSQP on the raw variables of (25)-(26), gradient by differences; it stays where it stopped."""
    H, u, n_iter = [], [], []
    for run in range(world.runs):
        fit = slsqp_run(world, run)
        last = np.minimum(np.arange(N_ITER), len(fit.history["u"]) - 1)
        H.append(SIGN * fit.history["H"][last])
        u.append(SIGN * fit.history["u"][last])
        n_iter.append(float(fit.n_iter))
        work(1)
    return Iterates(
        frobenius((np.array(H) - H_A) / world.H_unit).T, length(np.array(u) - U_A).T, u[shown], np.array(n_iter)
    )


def slsqp_run(world: World, run: int, *, gradient: bool = False, bias: ArrayLike | None = None) -> Fit:
    """One run as in the paper: raw variables, differences for the gradient, start H = I G / rms, u along (1, 1, 1)."""
    return baselines.slsqp(
        world.y[run], world.R_of(run), G, bias=bias, gradient=gradient, scale=False, tol=1e-10, max_iter=N_ITER
    )


def iterations_to(iterates: Iterates, world: World, part: float) -> Array:
    """First iteration (runs,) from which on both |dH| and |du| stay below `part` of H and u; NaN if none."""
    H_size = float(frobenius(H_A / world.H_unit))
    good = (iterates.H_norm < part * H_size) & (iterates.u_norm < part * G)
    for_good = np.logical_and.accumulate(good[::-1], axis=0)[::-1]
    first = np.argmax(for_good, axis=0) + 1.0
    return np.where(for_good[-1], first, np.nan)


# --- bounds, draws, identities, time ------------------------------------------------------------------


def bound_rms(world: World) -> tuple[float, float, float]:
    """Least rms of |dH| (in units of `H_unit`), |dB|, |du| of an unbiased estimate, over the runs' poses."""
    sets = world.R[None] if world.R.ndim == 3 else world.R
    bounds = [cramer_rao(H_A, U_A, R, world.sigma) for R in sets]
    return (
        rms([_H_rms(b, world.H_unit) for b in bounds]),
        rms([b.B_rms for b in bounds]),
        rms([b.u_rms for b in bounds]),
    )


def _H_rms(bound: Bound, H_unit: Array) -> float:
    variance = np.diag(bound.covariance)[:9].reshape(3, 3) / H_unit**2
    return float(np.sqrt(variance.sum()))


@dataclass(frozen=True)
class Draw:
    """Mean errors in one pose set: alternation's iterates, and `one_step` beside the two-step method."""

    lambda2: float
    H_norm: Array  # (N_ITER,)
    u_norm: Array  # (N_ITER,)
    one_step_u: float
    bias_max: float  # per cent
    one_step_bias_max: float


def draw(R: Array, sigma: float, runs: int, rng: np.random.Generator) -> Draw:
    world = fixed_world(R, sigma, runs, rng)
    path = alternation_iterates(world)
    two, one = (errors_of(METHODS[m](world), world) for m in ("eigen", "one-step"))
    return Draw(
        lambda2(R),
        path.H_norm.mean(axis=1),
        path.u_norm.mean(axis=1),
        float(one.u_norm.mean()),
        float(np.nanmax(two.B_percent)),
        float(np.nanmax(one.B_percent)),
    )


def identity_errors(world: World) -> tuple[float, float]:
    """Alternation after 300 iterations against `eigen`, worst of the runs: u, and H (1 - lambda1(M/J)); relative."""
    best = eigen(world.y, world.R, G)
    slow = alternation(world.y, world.R, G, bias=best.model.B, u0=world.u0, n_iter=300)
    u = [np.zeros((world.runs, 3)) if f.u is None else f.u for f in (slow, best)]
    mended = slow.model.H * (1 - best.details["lambda"][:, :1, None])
    return (
        float(np.max(length(u[0] - u[1])) / G),
        float(np.max(frobenius(mended - best.model.H) / frobenius(best.model.H))),
    )


def cpu_seconds(world: World, work: Work, repeats: int = 7) -> dict[str, float]:
    """CPU seconds of one run of each method (medians, interleaved), and of a run within a batch."""
    batch = world.first(min(world.runs, 1000))
    y, R = world.y[0], world.R_of(0)
    B = eigen(y, R, G).model.B
    some = range(min(world.runs, 5))
    biases = [eigen(world.y[run], world.R_of(run), G).model.B for run in some]

    def optimised(gradient: bool) -> Callable[[], object]:
        return lambda: [slsqp_run(world, run, bias=biases[run], gradient=gradient) for run in some]

    jobs: dict[str, tuple[Callable[[], object], int]] = {
        "slsqp, differences": (optimised(False), len(some)),
        "slsqp, gradient": (optimised(True), len(some)),
        "alternation, 50 iterations": (lambda: alternation(y, R, G, bias=B, u0=world.u0[0], n_iter=N_ITER), 1),
        "alternation, 50 iterations, in a batch": (
            lambda: alternation(batch.y, batch.R, G, bias=B, u0=batch.u0, n_iter=N_ITER),
            batch.runs,
        ),
        "eigen, alone": (lambda: eigen(y, R, G, bias=B), 1),
        "one-step, alone": (lambda: one_step(y, R, G, covariance=False), 1),
        "eigen, in a batch": (lambda: eigen(batch.y, batch.R, G, bias=B), batch.runs),
        "one-step, in a batch": (lambda: one_step(batch.y, batch.R, G), batch.runs),
    }
    spent: dict[str, list[float]] = {name: [] for name in jobs}
    for _ in range(repeats):
        for name, (job, count) in jobs.items():
            begun = time.process_time()
            job()
            spent[name].append((time.process_time() - begun) / count)
        work(1)
    return {name: float(np.median(values[1:])) for name, values in spent.items()}


def optimiser_path(name: str, world: World, run: int) -> tuple[float, float, float]:
    """Iterations, CPU seconds and final |du| of another of the paper's optimisers, from SciPy, on one run."""
    solver = {"interior-point": baselines.interior_point, "active-set": baselines.active_set, "slsqp": baselines.slsqp}
    begun = time.process_time()
    fit = solver[name](world.y[run], world.R_of(run), G, gradient=True)
    spent = time.process_time() - begun
    return float(fit.n_iter), spent, float(length(errors_of(fit, world).u))
