"""General-purpose optimisers on Z-TIE (25)-(26), for comparison with `transform`.

[1] Z. Zhang, "Two-step calibration methods for miniature inertial and magnetic sensor units", IEEE Trans.
    Industrial Electronics, 2015, section II.B.2: cost (25), constraint (26), and the algorithms that it
    names.

name here         named in [1]                          stands for it here (SciPy), and how it differs
slsqp             sequential quadratic programming [29]  SLSQP (Kraft 1988): the same idea as MATLAB's fmincon
'sqp',
                                                         another line search and BFGS update
interior_point    interior point [27]                    trust-constr with its barrier (Byrd, Hribar,
Nocedal): it takes
                                                         up the barrier only for inequalities, so the bounds
                                                         |u_k| <= G that (26) implies are given too
active_set        active set [28]                        L-BFGS-B: active set over box constraints, as Hager &
Zhang's;
                                                         (26) is met by two angles of u, boxed to one turn

Unknowns X = (H row by row, u). `history` holds `H` (n, 3, 3), `u` (n, 3) of every iteration, in real units
and with the sign of the result.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from margcal.core.errors import InputError
from margcal.core.types import Array, Fit, Kind
from margcal.methods.affine import (
    MIN_POSES,
    As,
    checked_readings,
    checked_rotations,
    model_of,
    pose_residual,
    positive,
)
from margcal.methods.transform import two_step_bias

Start = tuple[ArrayLike, ArrayLike]


class Problem(NamedTuple):
    """(25) in the optimiser's variables: ``Y = (y - B) / length``, u in units of `unit`."""

    Y: Array
    R: Array
    length: float
    unit: float
    magnitude: float

    def cost(self, x: Array) -> float:
        """(25)."""
        r = self.residual(x)
        return float(np.sum(r * r))

    def residual(self, x: Array) -> Array:
        return self.R @ x[9:] - self.Y @ x[:9].reshape(3, 3).T

    def gradient(self, x: Array) -> Array:
        """Of `cost`; not in the paper, whose optimiser takes differences."""
        r = self.residual(x)
        by_u = np.tensordot(r, self.R, axes=([0, 1], [0, 1]))
        return np.concatenate([-2 * (r.T @ self.Y).ravel(), 2 * by_u])

    @property
    def radius(self) -> float:
        """|u| of (26) in the optimiser's unit."""
        return self.magnitude / self.unit

    def constraint(self, x: Array) -> float:
        """(26), as |u|^2 - G^2 = 0, which has a derivative everywhere."""
        return float(x[9:] @ x[9:]) - self.radius**2

    def constraint_gradient(self, x: Array) -> Array:
        return np.concatenate([np.zeros(9), 2 * x[9:]])

    def into(self, H: ArrayLike, u: ArrayLike) -> Array:
        """The optimiser's variables of H and u in real units."""
        H, u = np.asarray(H, dtype=np.float64), np.asarray(u, dtype=np.float64)
        return np.concatenate([H.ravel() * self.length, u]) / self.unit

    def out_of(self, x: Array) -> tuple[Array, Array]:
        """H (..., 3, 3) and u (..., 3) in real units."""
        x = np.asarray(x) * self.unit
        return x[..., :9].reshape(*x.shape[:-1], 3, 3) / self.length, x[..., 9:]


def slsqp(
    y: ArrayLike,
    R: ArrayLike,
    magnitude: float,
    *,
    kind: Kind = "acc",
    raw_unit: str = "count",
    unit: str = "",
    bias: ArrayLike | None = None,
    start: Start | None = None,
    gradient: bool = True,
    scale: bool = True,
    tol: float = 1e-12,
    max_iter: int = 200,
) -> Fit:
    """Sequential quadratic programming on (25)-(26): SciPy's SLSQP.

    Parameters
    ----------
    y : array_like (J, 3), raw unit
    R : array_like (J, 3, 3)
    magnitude : float, calibrated unit
    bias : array_like (3,), raw unit, optional
        From `ellipsoid` where not given.
    start : (H, u), optional
        By default u along (1, 1, 1) and H the identity times the ratio of the magnitude to the readings' rms.
    gradient : bool
        Analytic gradient, or finite differences as in the paper.
    scale : bool
        Readings of unit rms and u of unit length inside; without it the raw variables as in the paper.
    tol : float
        SLSQP's ``ftol``.

    Returns
    -------
    Fit
        `details`: `evaluations` of the cost.
    """
    problem, B = _problem(y, R, magnitude, kind, bias, scale)

    def run(x0: Array, keep: Callable[..., None]) -> Any:
        from scipy.optimize import minimize

        equality = {"type": "eq", "fun": problem.constraint}
        if gradient:
            equality["jac"] = problem.constraint_gradient
        return minimize(
            problem.cost,
            x0,
            jac=problem.gradient if gradient else None,
            method="SLSQP",
            constraints=[equality],
            callback=keep,
            options={"ftol": tol, "maxiter": max_iter},
        )

    return _solve(run, problem, B, start, "slsqp", As(kind, raw_unit, unit), y)


def interior_point(
    y: ArrayLike,
    R: ArrayLike,
    magnitude: float,
    *,
    kind: Kind = "acc",
    raw_unit: str = "count",
    unit: str = "",
    bias: ArrayLike | None = None,
    start: Start | None = None,
    gradient: bool = True,
    scale: bool = True,
    tol: float = 1e-9,
    max_iter: int = 1000,
) -> Fit:
    """Interior point on (25)-(26): SciPy's trust-constr with its barrier. Parameters as in `slsqp`."""
    problem, B = _problem(y, R, magnitude, kind, bias, scale)

    def run(x0: Array, keep: Callable[..., None]) -> Any:
        from scipy.optimize import BFGS, Bounds, NonlinearConstraint, minimize

        bound = np.concatenate([np.full(9, np.inf), np.full(3, problem.radius * (1 + 1e-9))])
        sphere = NonlinearConstraint(
            lambda x: np.array([problem.constraint(x)]),
            0.0,
            0.0,
            jac=(lambda x: problem.constraint_gradient(x)[None]) if gradient else "2-point",  # type: ignore[arg-type]
            hess=BFGS(),
        )
        with warnings.catch_warnings():
            # its quasi-Newton update says so when a constraint's gradient stands still; nothing follows from it
            warnings.filterwarnings("ignore", "delta_grad", UserWarning)
            return minimize(
                problem.cost,
                x0,
                jac=problem.gradient if gradient else "2-point",
                hess=BFGS(),
                method="trust-constr",
                constraints=[sphere],
                bounds=Bounds(-bound, bound),  # type: ignore[arg-type]
                callback=keep,
                options={"gtol": tol, "xtol": tol * 1e-3, "barrier_tol": tol, "maxiter": max_iter},
            )

    return _solve(run, problem, B, start, "interior-point", As(kind, raw_unit, unit), y)


def active_set(
    y: ArrayLike,
    R: ArrayLike,
    magnitude: float,
    *,
    kind: Kind = "acc",
    raw_unit: str = "count",
    unit: str = "",
    bias: ArrayLike | None = None,
    start: Start | None = None,
    gradient: bool = True,
    scale: bool = True,
    tol: float = 1e-15,
    max_iter: int = 1000,
) -> Fit:
    """Active set over box constraints on (25), u by two angles: SciPy's L-BFGS-B. Parameters as in `slsqp`.

    The angles are those from the start's u, which is where they are zero, so that no pole is near.
    """
    problem, B = _problem(y, R, magnitude, kind, bias, scale)
    frame = np.eye(3)

    def unfold(p: Array) -> Array:
        a, b = p[9], p[10]
        u = np.array([math.cos(a) * math.cos(b), math.sin(a) * math.cos(b), math.sin(b)]) * problem.radius
        return np.concatenate([p[:9], frame @ u])

    def slope(p: Array) -> Array:
        a, b = p[9], p[10]
        by_a = np.array([-math.sin(a) * math.cos(b), math.cos(a) * math.cos(b), 0.0])
        by_b = np.array([-math.cos(a) * math.sin(b), -math.sin(a) * math.sin(b), math.cos(b)])
        g = problem.gradient(unfold(p))
        by_u = problem.radius * (g[9:] @ frame)
        return np.concatenate([g[:9], [by_u @ by_a, by_u @ by_b]])

    def run(x0: Array, keep: Callable[..., None]) -> Any:
        from scipy.optimize import minimize

        first = x0[9:] / np.linalg.norm(x0[9:])
        frame[:] = np.column_stack([first, *_across(first)])
        found = minimize(
            lambda p: problem.cost(unfold(p)),
            np.concatenate([x0[:9], [0.0, 0.0]]),
            jac=slope if gradient else None,
            method="L-BFGS-B",
            bounds=[(None, None)] * 9 + [(-math.pi, math.pi)] * 2,
            callback=lambda p: keep(unfold(p)),
            options={"ftol": tol, "gtol": 1e-12, "maxiter": max_iter, "maxfun": 100 * max_iter, "maxcor": 20},
        )
        found.x = unfold(found.x)
        return found

    return _solve(run, problem, B, start, "active-set", As(kind, raw_unit, unit), y)


def _across(u: Array) -> tuple[Array, Array]:
    from margcal.methods.affine import tangents

    T = tangents(u)
    return T[:, 0], T[:, 1]


def _problem(
    y: ArrayLike, R: ArrayLike, magnitude: float, kind: Kind, bias: ArrayLike | None, scale: bool
) -> tuple[Problem, Array]:
    y = checked_readings(y, kind, MIN_POSES)
    R = checked_rotations(R, y.shape[-2])
    if y.ndim != 2 or R.ndim != 3:
        raise InputError(f"{kind}: optimisers take one node at a time; readings have shape {y.shape}")
    B = two_step_bias(y, magnitude, kind, bias)
    Y = y - B
    length = float(np.sqrt(np.mean(np.sum(Y * Y, axis=1))))
    if scale:
        return Problem(Y / length, R, length, magnitude, magnitude), B
    return Problem(Y, R, 1.0, 1.0, magnitude), B


def _solve(
    run: Callable[[Array, Callable[..., None]], Any],
    problem: Problem,
    B: Array,
    start: Start | None,
    method: str,
    name: As,
    y: ArrayLike,
) -> Fit:
    """Run an optimiser from `start`, keep its iterates, and return the `Fit`."""
    if start is None:
        rms = float(np.sqrt(np.mean(np.sum((np.asarray(y) - B) ** 2, axis=1))))
        start = np.eye(3) * problem.magnitude / rms, np.full(3, problem.magnitude / math.sqrt(3))
    x0 = problem.into(*start)
    iterates: list[Array] = []

    def keep(x: Array, *_: object) -> None:
        iterates.append(np.array(x))

    found = run(x0, keep)
    H_found, u_found = problem.out_of(found.x)
    H, u = positive(H_found, u_found)
    sign = np.sign(np.sum(H * H_found))
    all_H, all_u = problem.out_of(np.array(iterates or [found.x]))
    residual = np.linalg.norm(pose_residual(np.asarray(y, dtype=np.float64), problem.R, H, B, u), axis=-1)
    return Fit(
        model_of(name, H, B, method, residual),
        residual,
        float(residual @ residual),
        method,
        "Z-TIE (25)-(26)",
        u=u,
        rank=11,
        n_iter=len(iterates),
        converged=bool(found.success),
        history={"H": all_H * sign, "u": all_u * sign},
        details={"evaluations": np.array(found.nfev)},
        text="" if found.success else str(found.message),
    )
