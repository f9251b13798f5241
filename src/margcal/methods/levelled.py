"""Accelerometer from a housing put down on a table that is nearly level: faces up, headings unknown.

Not in the papers: Ferraris' six-face procedure (F. Ferraris, U. Grimaldi, M. Parvis, "Procedure for
effortless in-field calibration of three-axis rate gyros and accelerometers", Sensors and Materials 7(5),
1995) with the tilt of the table taken for what it is. Every rest has a tilt of its own, so the direction of
the reading is known only to a degree or so, but its length is known to the noise:

    radial       |H (y_j - B)| - g                sd sigma              tight
    tangential   up_j x-components of H (y_j - B)  sd (sigma^2 + (g level_sd)^2)^1/2   loose
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from margcal.core import lsq
from margcal.core.errors import InputError
from margcal.core.types import Array, Fit, Kind
from margcal.methods.affine import (
    As,
    Scaled,
    checked_readings,
    model_of,
    scaled,
    tangents,
    too_few,
    unscaled,
    unscaled_covariance,
)
from margcal.methods.coverage import distinct_directions

FLOOR = 1e-4
"""Least radial sd, as a part of the magnitude: good MEMS accelerometers' rests keep to 1e-4 to 3e-4."""

MIN_RESTS = 6


def level_prior(
    y: ArrayLike,
    up: ArrayLike,
    magnitude: float,
    level_sd_rad: float = math.radians(1.0),
    start: tuple[ArrayLike, ArrayLike] | None = None,
    sigma: float | None = None,
    *,
    kind: Kind = "acc",
    raw_unit: str = "count",
    unit: str = "",
    max_iter: int = 50,
) -> Fit:
    """H and B from rests whose "up" is known in the housing, each with a tilt of its own.

    Parameters
    ----------
    y : array_like (J, 3), raw unit
        Mean reading of each rest.
    up : array_like (J, 3)
        Unit vector that points up, in the housing frame.
    magnitude : float
        Local gravity, m/s^2.
    level_sd_rad : float, rad
        Standard deviation of the tilt of "up" about each of two axes across it.
    start : (H, B), optional
        Start of the iteration; by default the linear fit of y to ``magnitude * up``.
    sigma : float, calibrated unit, optional
        Standard deviation of a calibrated reading along "up". By default estimated from the radial misfit,
        but not below `FLOOR` times the magnitude: with six rests the radial misfit vanishes and says nothing.

    Returns
    -------
    Fit
        `residual` are the radial misfits' magnitudes ``||H (y - B)| - g|``; `details`: `radial` (J,),
        `tilt_rad` (J,) the angle between calibrated reading and "up", `sigma` as used.

    Raises
    ------
    DataError
        With fewer than six rests or six distinct directions of "up", naming the faces that are missing.
    """
    y = checked_readings(y, kind)
    up = _checked_up(up, len(y))
    _refuse_missing_faces(kind, up)
    data = scaled(y)
    x = _linear_start(data.z, up) if start is None else _given_start(start, data, magnitude)
    radial_sd = FLOOR if sigma is None else sigma / magnitude
    solved = lsq.gauss_newton(_model(data.z, up, radial_sd, level_sd_rad), x, max_iter=max_iter)
    for _ in range(10 if sigma is None else 0):
        estimate = max(FLOOR, _radial_sd(data.z, up, solved, radial_sd, level_sd_rad))
        if abs(estimate - radial_sd) <= 1e-3 * radial_sd:
            break
        radial_sd = estimate
        solved = lsq.gauss_newton(_model(data.z, up, radial_sd, level_sd_rad), solved.x, max_iter=max_iter)
    A, a = solved.x[:9].reshape(3, 3), solved.x[9:]
    H, B = unscaled(A, a, data, magnitude)
    covariance = unscaled_covariance(solved.cofactor, A, a, data, magnitude)
    s = data.z @ A.T + a
    length = np.linalg.norm(s, axis=1)
    residual = np.abs(length - 1) * magnitude
    details = {
        "radial": (length - 1) * magnitude,
        "tilt_rad": np.arctan2(np.linalg.norm(np.cross(s, up), axis=1), np.sum(s * up, axis=1)),
        "sigma": np.array(radial_sd * magnitude),
    }
    return Fit(
        model_of(As(kind, raw_unit, unit), H, B, "level-prior", residual, covariance),
        residual,
        float(solved.residual @ solved.residual),
        "level-prior",
        "not in the papers: Ferraris et al. 1995 with a tilt of its own for each rest",
        covariance=covariance,
        rank=solved.rank,
        condition=solved.condition,
        n_iter=solved.n_iter,
        converged=solved.converged,
        details=details,
        text="" if solved.converged else f"no convergence in {solved.n_iter} iterations",
    )


def _checked_up(up: ArrayLike, J: int) -> Array:
    up = np.asarray(up, dtype=np.float64)
    if up.shape != (J, 3):
        raise InputError(f"up has shape {up.shape}; expected ({J}, 3), one direction a rest")
    length = np.linalg.norm(up, axis=1)
    if not (np.abs(length - 1) < 1e-3).all():
        raise InputError(f"up of rest {int(np.argmax(np.abs(length - 1)))} is not a unit vector")
    return up / length[:, None]


def _refuse_missing_faces(kind: str, up: Array) -> None:
    """Six distinct directions of "up", spanning three dimensions, or DataError."""
    found = distinct_directions(up, B=np.zeros(3))
    if found >= MIN_RESTS:
        return
    faces = {f"{sign}{axis}": s * np.eye(3)[i] for i, axis in enumerate("xyz") for sign, s in (("+", 1), ("-", -1))}
    missing = [name for name, face in faces.items() if (up @ face).max() < math.cos(math.radians(15))]
    advice = f"no rest has {', '.join(missing)} up: put the housing down on these faces too"
    raise too_few(kind, found, MIN_RESTS, "distinct directions of up", advice)


def _linear_start(z: Array, up: Array) -> Array:
    """Closed form: A and a that take the scaled readings nearest to "up"."""
    design = np.column_stack([z, np.ones(len(z))])
    solution = np.linalg.lstsq(design, up, rcond=None)[0]
    return np.asarray(np.concatenate([solution[:3].T.ravel(), solution[3]]), dtype=np.float64)


def _given_start(start: tuple[ArrayLike, ArrayLike], data: Scaled, magnitude: float) -> Array:
    H, B = (np.asarray(v, dtype=np.float64) for v in start)
    return np.concatenate([(H * (data.scale / magnitude)).ravel(), H @ (data.centre - B) / magnitude])


def _model(z: Array, up: Array, radial_sd: float, level_sd: float) -> lsq.Model:
    """Residual (3J,) and Jacobian (3J, 12) in the scaled unknowns (A row by row, a)."""
    J = len(z)
    across = tangents(up)
    linear = np.zeros((J, 3, 12))  # ds/d(A, a): s = A z + a is linear
    for i in range(3):
        linear[:, i, 3 * i : 3 * i + 3] = z
        linear[:, i, 9 + i] = 1.0
    loose = 1 / math.hypot(radial_sd, level_sd)
    tangential = np.einsum("jik,jip->jkp", across, linear) * loose

    def model(x: Array) -> tuple[Array, Array]:
        s = linear @ x
        length = np.linalg.norm(s, axis=1)
        radial = np.einsum("ji,jip->jp", s / length[:, None], linear) / radial_sd
        r = np.concatenate([(length - 1) / radial_sd, (tangential @ x).ravel()])
        return r, np.concatenate([radial, tangential.reshape(2 * J, 12)])

    return model


def _radial_sd(z: Array, up: Array, solved: lsq.Solution, radial_sd: float, level_sd: float) -> float:
    """Radial sd from the radial misfits and the freedom left to them (J less their leverage)."""
    J = len(z)
    _, jacobian = _model(z, up, radial_sd, level_sd)(solved.x)
    radial = jacobian[:J]
    freedom = J - float(np.einsum("jp,pq,jq->", radial, solved.cofactor, radial))
    if freedom < 0.5:
        return 0.0
    return radial_sd * math.sqrt(float(solved.residual[:J] @ solved.residual[:J]) / freedom)
