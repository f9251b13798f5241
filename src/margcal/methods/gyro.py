"""The gyroscope's transformation matrix and bias from turns between rests: the default solvers.

`gauss_newton` (ours) where the rotation of each turn is known; `propagate_gravity` where only directions are
known at both ends (gravity, and the field perhaps): Tedaldi, Pretto, Menegatti, "A robust and easy to
implement method for IMU calibration without external equipments", ICRA 2014, section III.C, with a
covariance. Z-TIE's own method and its baselines on (43) are in `gyro_paper`, closed-form starts and full
turns in `gyro_start`, integration in `preintegration`, the Cramer-Rao bound in `gyro_bound`.

=================  ============  =======================================================  =============
name here          symbol        meaning                                                  shape
=================  ============  =======================================================  =============
y, dt              y_g^{j,l}     readings of turn j, their intervals                      (T, N, 3), (T, N)
H, B               H_g, B_g      transformation matrix, bias: u = H (y - B)               (3, 3), (3,)
dR                 R_j^{j+1}     rotation of the turn, R_before_after                     (T, 3, 3)
before, after                    unit vectors known in the node frame at both ends        (T, M, 3)
=================  ============  =======================================================  =============

Both minimise, over H and B, the misfit of each turn weighted by its covariance (white noise of the readings
carried through the integration, plus `sigma_angle` of the attitude or direction at the ends), with a Gaussian
prior on B from the rests. One bad turn is held down by weights 1 / misfit^2 beyond four sigma.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from margcal.core.errors import InputError
from margcal.core.types import Array, Fit, SensorModel, Turn
from margcal.methods.gyro_descent import (
    Measure,
    Problem,
    Run,
    best_run,
    direction_measure,
    misfit_limit,
    rotation_measure,
)
from margcal.methods.gyro_start import linear_start, rotation_starts
from margcal.methods.preintegration import TurnBatch, integrate, pad

CITES = "Z-TIE II.C, (42)-(43) and appendix D; derivatives: Forster et al. 2017"
_SCALES = 2.0 ** np.array([-1, 1, -0.5, 0.5, -1.5, 1.5, -2, 2])  # tried when the nominal scale leads nowhere


def mean_bias(Y: ArrayLike) -> Array:
    """Combined bias: the mean reading over the rests, Z-TIE (41).

    Parameters
    ----------
    Y : array_like (..., J, 3), raw unit
        Mean reading of each rest; rests with NaN are left out.
    """
    return np.nanmean(np.asarray(Y, dtype=np.float64), axis=-2)  #                                         (41)


def _scaled_starts(problem: Problem, H0: Array) -> Iterable[Array]:
    """`H0` itself, then other scales of it, the one with the smallest misfit first."""
    yield H0
    guesses = _SCALES[:, None, None] * H0
    y, dt = problem.batch.y, problem.batch.dt
    misfit = [
        np.median(np.linalg.norm(problem.measure(integrate(y, dt, H, problem.prior_mean)).r, axis=-1)) for H in guesses
    ]
    for i in np.argsort(misfit)[:4]:
        yield guesses[i]


def _to_fit(problem: Problem, run: Run, residual: Array, method: str, raw_unit: str) -> Fit:
    covariance = None
    if run.last.covariance is not None and run.last.rank == problem.n_unknown:
        covariance = np.zeros((12, 12))
        covariance[: problem.n_unknown, : problem.n_unknown] = run.last.covariance
    used = problem.dof > 0
    rms = float(np.sqrt(np.mean(residual[used] ** 2)))
    model = SensorModel(
        "gyr",
        run.point.H,
        run.point.B,
        raw_unit,
        covariance=covariance,
        residual_rms=rms,
        n_poses=int(used.sum()),
        method=method,
    )
    text = ""
    if run.last.rank < problem.n_unknown:
        text = (
            f"the turns determine only {run.last.rank} of {problem.n_unknown} unknowns of the gyroscope; "
            "turn the node about at least three different axes, several times each"
        )
    elif run.typical > misfit_limit(problem, run):
        text = (
            f"half of the turns misfit by more than {np.degrees(run.typical):.1f} degrees; the attitudes, the axes "
            "or the nominal scale of the gyroscope are wrong"
        )
    elif not run.settled:
        text = f"no rest after {len(run.H) - 1} iterations"
    dof = float(run.weights.robust @ problem.dof) - 9
    history = {
        "H": np.array(run.H),
        "B": np.array(run.B),
        "cost": np.array(run.costs),
        "weights": run.weights.robust,
        "sigma_angle": np.array(run.weights.sigma_angle),
        "dof": np.array(dof),
    }
    return Fit(
        model,
        residual,
        run.cost,
        method,
        CITES,
        covariance=covariance,
        rank=run.last.rank,
        condition=run.last.condition,
        n_iter=len(run.H) - 1,
        converged=not text,
        history=history,
        text=text,
    )


def _problem(
    turns: Sequence[Turn] | TurnBatch,
    measure: Measure,
    dof: Array,
    B0: ArrayLike | None,
    bias_prior: tuple[ArrayLike, ArrayLike] | None,
    sd: ArrayLike | None,
    sigma_angle: float | None,
) -> Problem:
    batch = pad(turns)
    if len(dof) != len(batch):
        raise InputError(f"{len(batch)} turns but attitudes or directions for {len(dof)}; give one for each turn")
    if not np.any(dof > 0):
        raise InputError("no turn has a known attitude or direction at both of its ends")
    mean, root = np.zeros(3) if B0 is None else np.asarray(B0, dtype=np.float64), None
    if bias_prior is not None:
        mean = np.asarray(bias_prior[0], dtype=np.float64)
        root = _inverse_root(np.asarray(bias_prior[1], dtype=np.float64))
    noise = None if sd is None else np.asarray(sd, dtype=np.float64) * np.ones(3)
    return Problem(batch, measure, dof.astype(np.float64), mean, root, noise, sigma_angle)


def _inverse_root(covariance: Array) -> Array:
    power, axes = np.linalg.eigh(covariance)
    if not (np.isfinite(power).all() and power[0] > 0):
        raise InputError("the covariance of the bias prior is not positive definite; give each axis a spread")
    return np.asarray(axes.T / np.sqrt(power)[:, None])


def gauss_newton(
    turns: Sequence[Turn] | TurnBatch,
    dR: ArrayLike,
    *,
    H0: ArrayLike | None = None,
    B0: ArrayLike | None = None,
    bias_prior: tuple[ArrayLike, ArrayLike] | None = None,
    sd: ArrayLike | None = None,
    sigma_angle: float | None = None,
    max_iter: int = 20,
    tol: float = 0.3,
    raw_unit: str = "count",
) -> Fit:
    """H and B of the gyroscope from turns whose rotations are known: Gauss-Newton on SO(3).

    Parameters
    ----------
    turns : sequence of Turn, or TurnBatch of (T, N, 3)
    dR : array_like (T, 3, 3)
        R_before_after of each turn, ``R_nh(before).T @ R_nh(after)``; see `known_rotations`.
    H0 : array_like (3, 3), rad/s per raw unit, optional
        Nominal scale and axes. From within about 40 % two or three iterations do; other scales of it are
        tried when the misfits say that it led nowhere. Without it `gyro_start.rotation_starts` looks for one.
    B0 : array_like (3,), raw unit, default 0
        The bias, taken as known. Not used with `bias_prior`.
    bias_prior : (mean (3,), covariance (3, 3)), raw unit, optional
        The bias is estimated jointly, from this (`mean_bias` of the rests and how well it is known).
    sd : array_like (3,) or scalar, raw unit, optional
        White noise of a single reading by axis (scatter within the rests).
    sigma_angle : float, rad, optional
        Noise of the known rotations, each axis. Without it, what the misfits show beyond `sd`.
    max_iter, tol : int, float
        Stop after so many iterations, or with the step that is shorter than `tol` standard errors (what is
        then left is of second order: about 1e-3 of a standard error).

    Returns
    -------
    Fit
        `residual` (T,) rad, the angle by which each turn misses; `covariance` (12, 12), rows of B zero when
        it was not estimated, None where the turns do not determine H; `cost` is chi-square. `history`: `H`,
        `B` and `cost` by iteration, `weights` of the turns at the end (below 1: held down as bad),
        `sigma_angle`, `dof`. `converged` False and `text` say when the minimum is not the right one or the
        turns are too few.

    Raises
    ------
    InputError
        If turns and rotations differ in number or a reading is not finite.

    References
    ----------
    Cost: Z-TIE (43) on the group instead of on quaternion components, weighted. Derivatives: Forster et al.
    2017.
    """
    known = np.asarray(dR, dtype=np.float64)
    problem = _problem(turns, rotation_measure(known), np.full(len(known), 3.0), B0, bias_prior, sd, sigma_angle)

    def starts() -> Iterable[Array]:
        if H0 is not None:
            yield from _scaled_starts(problem, np.asarray(H0, dtype=np.float64))
        yield from rotation_starts(problem.batch, known, problem.prior_mean)

    run = best_run(problem, starts(), max_iter, tol)
    return _to_fit(problem, run, np.asarray(np.linalg.norm(run.point.misfit.r, axis=-1)), "gauss-newton", raw_unit)


def propagate_gravity(
    turns: Sequence[Turn] | TurnBatch,
    before: ArrayLike,
    after: ArrayLike,
    *,
    H0: ArrayLike | None = None,
    B0: ArrayLike | None = None,
    along: ArrayLike | None = None,
    bias_prior: tuple[ArrayLike, ArrayLike] | None = None,
    sd: ArrayLike | None = None,
    sigma_angle: float | None = None,
    max_iter: int = 30,
    tol: float = 0.3,
    raw_unit: str = "count",
) -> Fit:
    """H and B of the gyroscope from turns at whose ends directions are known in the node frame.

    Parameters
    ----------
    turns : sequence of Turn, or TurnBatch of (T, N, 3)
    before, after : array_like (T, 3) or (T, M, 3)
        The same vectors, fixed in the laboratory (specific force at rest; field), as the calibrated
        accelerometer (magnetometer) reads them before and after the turn. Any length; NaN: not known in this
        turn.
    H0 : array_like (3, 3), rad/s per raw unit, optional
        Nominal scale and axes; may be left out when `along` is given.
    along : array_like (T, N, 3), optional
        Calibrated accelerometer at each gyroscope sample (`preintegration.along`), for `linear_start`.
    sigma_angle : float, rad, optional
        Noise of the directions, each component. Without it, what the misfits show beyond `sd`.
    B0, bias_prior, sd, max_iter, tol
        See `gauss_newton`.

    Returns
    -------
    Fit
        As `gauss_newton`; `residual` (T,) rad is the root mean square over the M directions of the angle
        between propagated and measured direction.

    Notes
    -----
    Gravity alone tells two angles of a turn: five turns at least, and a turn about the vertical does not
    tell the gain along it.
    """
    v_before, v_after = _directions(before), _directions(after)
    if v_before.shape != v_after.shape:
        raise InputError(f"directions before {v_before.shape} and after {v_after.shape} the turns do not match")
    known = np.asarray(np.isfinite(v_before + v_after).all(axis=-1))
    v_before, v_after = np.where(known[..., None], v_before, 0.0), np.where(known[..., None], v_after, 0.0)
    problem = _problem(
        turns, direction_measure(v_before, v_after), 2 * known.sum(axis=1), B0, bias_prior, sd, sigma_angle
    )

    def starts() -> Iterable[Array]:
        if H0 is not None:
            yield from _scaled_starts(problem, np.asarray(H0, dtype=np.float64))
        if along is not None:
            yield linear_start(problem.batch, along, B=problem.prior_mean, before=before, after=after)

    run = best_run(problem, starts(), max_iter, tol)
    angle: Array = _angles(v_before, np.einsum("tij,tmj->tmi", run.point.step.dR, v_after))
    residual = np.sqrt(np.sum(angle**2 * known, axis=1) / np.maximum(known.sum(axis=1), 1))
    return _to_fit(problem, run, residual, "propagate-gravity", raw_unit)


def _directions(v: ArrayLike) -> Array:
    """Unit vectors (T, M, 3)."""
    v = np.asarray(v, dtype=np.float64)
    v = v[:, None, :] if v.ndim == 2 else v
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def _angles(a: Array, b: Array) -> Array:
    return np.asarray(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1)))


def known_rotations(R: ArrayLike, turns: Sequence[Turn]) -> Array:
    """dR = R_before_after (T, 3, 3) of the turns from the attitudes R_nh (J, 3, 3) of the rests."""
    R = np.asarray(R, dtype=np.float64)
    before, after = ([getattr(turn, end) for turn in turns] for end in ("before", "after"))
    return np.swapaxes(R[before], -1, -2) @ R[after]
