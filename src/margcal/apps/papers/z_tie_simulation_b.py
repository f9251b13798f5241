"""Z-TIE III.B: the gyroscope's H from turns between 10 orientations, simulated; errors of every method."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from margcal.core import so3
from margcal.core.types import Array
from margcal.methods.gyro import gauss_newton
from margcal.methods.gyro_bound import bound
from margcal.methods.gyro_paper import trust_region, ukf
from margcal.methods.preintegration import TurnBatch, integrate_quat
from margcal.methods.sensor_model import mounting, non_orthogonality
from margcal.workflow.metrics import frobenius

H_G = mounting(0.1, 0.1, 0.1) @ non_orthogonality(0.1, 0.1, 0.1)
"""Not in the paper, which does not say its H_g: readings in rad/s, mounting and T of ZY-TBME Table I."""

N_TURNS = 9  # between 10 orientations
RATE = 100  # Hz; each turn lasts 1 s ("usually less than 2 s")
N_ITER = 50
N_DRAWS = 21
"""Sets of turns that are drawn to find a typical one."""
SETTLED = 12
"""Iterations after which the filter has long stopped (steps below 1e-9); what follows repeats the last."""

Work = Callable[[int], None]


@dataclass(frozen=True)
class World:
    """Turns about `axis` (T, 3), known quaternions q (T, 4), readings y (runs, T, N, 3), starts H0 (runs, 3, 3)."""

    clean: Array
    q: Array
    y: Array
    H0: Array
    sd: float

    @property
    def runs(self) -> int:
        return len(self.y)

    @property
    def dt(self) -> Array:
        return np.full(self.y.shape[1:3], 1.0 / RATE)

    def turns(self, run: int) -> TurnBatch:
        return TurnBatch(self.y[run], self.dt)


def rotation_vectors(rng: np.random.Generator, half_turns: bool) -> Array:
    """Rotation vectors (9, 3): half turns about random axes, or what lies between random orientations."""
    if half_turns:
        axis = rng.normal(size=(N_TURNS, 3))
        return np.pi * axis / np.linalg.norm(axis, axis=1, keepdims=True)
    R = so3.matrix_from_quat(rng.normal(size=(N_TURNS + 1, 4)))
    return so3.log(np.swapaxes(R[:-1], -1, -2) @ R[1:])


def typical_turns(rng: np.random.Generator, draws: int, half_turns: bool, sd: float) -> Array:
    """Of several draws the turns whose Cramer-Rao bound is in the middle."""
    sets = [rotation_vectors(rng, half_turns) for _ in range(draws)]
    return sorted(sets, key=lambda v: bound_rms(v, sd))[draws // 2]


def clean_readings(vectors: Array) -> tuple[Array, Array]:
    """Readings (T, N, 3) of turns at a constant rate, and their quaternions on the branch of the motion."""
    u = np.repeat(vectors[:, None, :], RATE, axis=1)  # rad/s, the turn lasts one second
    q = integrate_quat(u, np.full(u.shape[:2], 1.0 / RATE), np.eye(3))
    return u @ np.linalg.inv(H_G).T, q


def make_world(vectors: Array, sd: float, runs: int, rng: np.random.Generator) -> World:
    """Noise of standard deviation `sd` rad/s on every reading; H0 as MATLAB's rand(3, 3) gives it."""
    clean, q = clean_readings(vectors)
    y = clean + sd * rng.normal(size=(runs, *clean.shape))
    return World(clean, q, y, rng.uniform(size=(runs, 3, 3)), sd)


def bound_rms(vectors: Array, sd: float) -> float:
    """Least rms of |dH_g| of an unbiased estimate."""
    clean, _ = clean_readings(vectors)
    covariance = bound(TurnBatch(clean, np.full(clean.shape[:2], 1.0 / RATE)), H_G, sd=sd)
    return float(np.sqrt(np.trace(covariance)))


def ukf_errors(world: World, work: Work) -> Array:
    """|dH_g| (N_ITER + 1, runs) of the paper's filter, the start first."""
    out, size = [], 8
    for i in range(0, world.runs, size):
        some = slice(i, min(i + size, world.runs))
        history = _filtered(world, some, SETTLED)
        if np.max(frobenius(history[-1] - history[-2])) > 1e-9:
            history = _filtered(world, some, N_ITER)
        last = np.minimum(np.arange(N_ITER + 1), len(history) - 1)
        out.append(frobenius(history[last] - H_G))
        work(some.stop - some.start)
    return np.concatenate(out, axis=1)


def _filtered(world: World, some: slice, n_iter: int) -> Array:
    y = world.y[some]
    turns = TurnBatch(y, np.broadcast_to(world.dt, y.shape[:3]))
    q = np.broadcast_to(world.q, (len(y), *world.q.shape))
    return ukf(turns, q=q, H0=world.H0[some], n_iter=n_iter).history["H"]


def trust_region_errors(world: World, work: Work) -> Array:
    """|dH_g| (N_ITER + 1, runs) of SciPy's trust region on (43), from the same starts."""
    out = []
    for run in range(world.runs):
        path = trust_region(world.turns(run), q=world.q, H0=world.H0[run], n_iter=N_ITER + 1).history["H"]
        last = np.minimum(np.arange(N_ITER + 1), len(path) - 1)
        out.append(frobenius(path[last] - H_G))
        work(1)
    return np.array(out).T


def gauss_newton_errors(world: World, work: Work) -> Array:
    """|dH_g| (runs,) of our default solver from the nominal H = I."""
    dR, out = so3.matrix_from_quat(world.q), []
    for run in range(world.runs):
        fit = gauss_newton(world.turns(run), dR, H0=np.eye(3), sd=world.sd, sigma_angle=0.0)
        out.append(float(frobenius(fit.model.H - H_G)))
        work(1)
    return np.array(out)
