"""Studies of one sensor: `gls_ml` against the Cramer-Rao bound, with housing error, and with bad poses.

Every function simulates `runs` nodes from a seed and returns a list of rows (dicts) of figures. Node and noise are
those of methods.md: an accelerometer of Z-TIE's parameters, 417 counts long, .33 % noise = 1.39 counts.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from margcal.core import so3
from margcal.core.types import Array, Fit
from margcal.methods.bounds import cramer_rao, simulated_readings
from margcal.methods.gls import gls_ml
from margcal.methods.robust_gls import robust_gls
from margcal.methods.transform import eigen, one_step

H = np.array([[0.0210, -0.0024, 0.0034], [0.0, 0.0238, 0.0022], [0.0021, 0.0024, 0.0224]])
A = np.linalg.inv(H)
B = np.array([2429.0, 2318.0, 2368.0])
U = np.array([2.6191601, 5.2383203, 7.8574805])
G = float(np.linalg.norm(U))
COUNTS = 417.0
"""|u| in raw units."""
NOISE = 0.0033 * COUNTS

Row = dict[str, float | str]


def random_poses(n: int, rng: np.random.Generator) -> Array:
    return so3.matrix_from_quat(rng.normal(size=(n, 4)))


def euler_poses(n: int, rng: np.random.Generator) -> Array:
    """Euler angles U[0, 180] degrees, as in the papers."""
    a = rng.uniform(0, np.pi, size=(n, 3))
    turns = [so3.exp(a[:, k, None] * np.eye(3)[k]) for k in range(3)]
    return turns[2] @ turns[1] @ turns[0]


def cone_poses(n: int, rng: np.random.Generator) -> Array:
    """Turned by up to 60 degrees from one attitude."""
    axis = rng.normal(size=(n, 3))
    return so3.exp(axis / np.linalg.norm(axis, axis=1, keepdims=True) * rng.uniform(0, np.pi / 3, size=(n, 1)))


def cube_poses(_: int, __: np.random.Generator) -> Array:
    return np.swapaxes(so3.cube_group(), 1, 2)


SETTINGS: dict[str, tuple[Callable[[int, np.random.Generator], Array], int, float]] = {
    "random, J = 10": (random_poses, 10, 0.0033),
    "random, J = 20": (random_poses, 20, 0.0033),
    "random, J = 30": (random_poses, 30, 0.0033),
    "random, J = 20, 3.3 %": (random_poses, 20, 0.033),
    "Euler 0..180, J = 20": (euler_poses, 20, 0.0033),
    "cone 60 deg, J = 20": (cone_poses, 20, 0.0033),
}


def rms(error: Array) -> float:
    """Root mean square over runs (first axis) of the length of `error`."""
    return float(np.sqrt(np.mean(np.sum(error.reshape(len(error), -1) ** 2, axis=1))))


def nees(fit: Fit) -> Array:
    """Normalised squared error of the 14 unknowns (A, B, direction of u), a run each."""
    dA = (np.linalg.inv(fit.model.H) - A).reshape(-1, 9)
    assert fit.u is not None
    du = np.einsum("nck,nc->nk", fit.details["tangent"], fit.u - U)
    e = np.concatenate([dA, fit.model.B - B, du], axis=1)
    return np.einsum("np,np->n", e, np.linalg.solve(fit.details["cofactor"], e[..., None])[..., 0])


def coverage(fit: Fit) -> float:
    """Share of the 95 % intervals of the 12 entries of (H, B) that hold the truth."""
    assert fit.covariance is not None
    e = np.concatenate([(fit.model.H - H).reshape(-1, 9), fit.model.B - B], axis=1)
    return float(np.mean(np.abs(e) < 1.96 * np.sqrt(np.diagonal(fit.covariance, axis1=-2, axis2=-1))))


def bound_study(runs: int, *, noise_known: bool = True, seed: int = 4) -> list[Row]:
    """RMS error over the Cramer-Rao bound (s_rot = 0), NEES and coverage with s_rot unknown, in the six settings.

    `noise_known`: whether the noise of the readings is told, as the scatter within the rests tells it.
    """
    rows: list[Row] = []
    for name, (poses, J, noise) in SETTINGS.items():
        rng = np.random.default_rng(seed)
        R, sigma = poses(J, rng), noise * COUNTS
        fit = gls_ml(simulated_readings(H, B, U, R, sigma, runs, rng), R, G, noise_sd=sigma if noise_known else None)
        bound = cramer_rao(H, U, R, sigma)
        assert fit.u is not None
        rows.append(
            {
                "setting": name,
                "H": rms(fit.model.H - H) / bound.H_rms,
                "B": rms(fit.model.B - B) / bound.B_rms,
                "u": rms(fit.u - U) / bound.u_rms,
                "NEES": float(nees(fit).mean()),
                "NEES_se": float(nees(fit).std() / np.sqrt(runs)),
                "coverage_%": 100 * coverage(fit),
                "s_rot_taken_%": 100 * float(np.mean(fit.details["s_rot"] > 1e-6)),
                "converged_%": 100 * float(np.mean(fit.details["converged"])),
            }
        )
    return rows


def housed_readings(R: Array, s_rot_deg: float, runs: int, rng: np.random.Generator) -> Array:
    """Readings (runs, J, 3) with a housing error about each axis, anew in every pose."""
    turn = so3.exp(-np.radians(s_rot_deg) * rng.normal(size=(runs, R.shape[-3], 3)))
    v = np.einsum("njab,njb->nja", turn, np.broadcast_to(R @ U, (runs, R.shape[-3], 3)))
    return v @ A.T + B + NOISE * rng.normal(size=v.shape)


def housing_study(runs: int, *, seed: int = 5, s_rot_deg: float = 0.5) -> list[Row]:
    """`gls_ml` with s_rot unknown against two-step (ellipsoid, then `eigen`) and `one_step`, 24 poses."""
    rows: list[Row] = []
    for name, poses in (("24 random poses", random_poses), ("24 cube poses", cube_poses)):
        rng = np.random.default_rng(seed)
        R = poses(24, rng)
        y = housed_readings(R, s_rot_deg, runs, rng)
        fit, other = gls_ml(y, R, G, noise_sd=NOISE), (one_step(y, R, G), eigen(y, R, G))
        best_H = min(rms(f.model.H - H) for f in other)
        best_B = min(rms(f.model.B - B) for f in other)
        rows.append(
            {
                "poses": name,
                "H_over_best": rms(fit.model.H - H) / best_H,
                "B_over_best": rms(fit.model.B - B) / best_B,
                "B_counts": rms(fit.model.B - B),
                "one_step_B": rms(other[0].model.B - B),
                "two_step_B": rms(other[1].model.B - B),
                "NEES": float(nees(fit).mean()),
                "s_rot_deg": float(np.degrees(np.median(fit.details["s_rot"]))),
            }
        )
    return rows


FAULTS = ("none", "disturbance", "label of the set", "label of the 24")


def bad_pose_study(runs: int, *, seed: int = 6, J: int = 20, s_rot_deg: float = 0.1) -> list[Row]:
    """Which poses `robust_gls` leaves out: of faultless nodes, and with one wrong label or disturbed pose."""
    rows: list[Row] = []
    for fault in FAULTS:
        y, R, bad = faulty_nodes(fault, runs, J, s_rot_deg, np.random.default_rng(seed))
        found = robust_gls(y, R, G, noise_sd=NOISE)
        named = found.left_out[np.arange(runs), bad] if fault != "none" else np.zeros(runs, dtype=bool)
        others = found.left_out.sum(axis=1) - named
        rows.append(
            {
                "fault": fault,
                "named_%": 100 * float(named.mean()),
                "others_left_out_%": 100 * float(np.mean(others > 0)),
                "converged_%": 100 * float(found.fit.details["converged"].mean()),
            }
        )
    return rows


def faulty_nodes(
    fault: str, runs: int, J: int, s_rot_deg: float, rng: np.random.Generator
) -> tuple[Array, Array, NDArray[np.int64]]:
    """Readings (runs, J, 3), the labels they are given (runs, J, 3, 3), and which pose is bad (runs,)."""
    R = random_poses(runs * J, rng).reshape(runs, J, 3, 3)
    turn = so3.exp(-np.radians(s_rot_deg) * rng.normal(size=(runs, J, 3)))
    v = np.einsum("njab,njbc,c->nja", turn, R, U, optimize=True)
    n, bad = np.arange(runs), rng.integers(J, size=runs)
    if fault == "disturbance":
        d = rng.normal(size=(runs, 3))
        v[n, bad] += 0.05 * G * d / np.linalg.norm(d, axis=1, keepdims=True)
    y = v @ A.T + B + NOISE * rng.normal(size=v.shape)
    if fault == "label of the set":
        R[n, bad] = R[n, (bad + rng.integers(1, J, size=runs)) % J]
    elif fault == "label of the 24":
        R[n, bad] = R[n, bad] @ so3.cube_group()[rng.integers(1, 24, size=runs)]
    return y, R, bad
