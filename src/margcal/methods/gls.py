"""`gls-ml`: maximum likelihood of one sensor from poses, with reading noise and housing-angle error (ours).

Not in the papers: Z-TIE and ZY-TBME weigh all poses alike and take their rotations as exact. Here

    y_j = B + A R_j exp(-[e_j]x) u + n_j,      n_j ~ N(0, kappa^2 diag(noise_sd_j^2)),   e_j ~ N(0, s_rot^2 I)

so the reading of pose j has covariance, with v_j = R_j u,

    S_j = kappa^2 diag(noise_sd_j^2) + s_rot^2 (A [v_j]x)(A [v_j]x)^T                                       (1)

Gauss-Newton on (A, B, direction of u) with these weights, in turn with restricted maximum likelihood (REML) for
kappa and s_rot. All leading axes are nodes (or one node with another pose left out in each): everything here is
vectorised over them. Several sensors of one node share their e_j; that fit is `joint`.

=============  ==========================================================  ===================
name here      meaning                                                     shape
=============  ==========================================================  ===================
A, B           forward matrix H^-1 and bias                                (..., 3, 3), (..., 3)
v              the sensed vector in each pose, R_j u                       (..., J, 3)
S              covariance of each pose's reading, (1)                      (..., J, 3, 3)
N              normal matrix of the 14 unknowns (A, B, two of u)           (..., 14, 14)
P              S^-1 - S^-1 X N^-1 X^T S^-1, X the derivatives              blocks (..., J, 3, 3)
=============  ==========================================================  ===================
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from margcal.core import so3
from margcal.core.errors import DataError
from margcal.core.types import Array, Fit, Issue, Kind, SensorModel
from margcal.methods.affine import checked_readings, checked_rotations
from margcal.methods.one_step import one_step

MAX_ITER = 40
REML_ITER = 20
"""Rounds in which the two components are estimated; the change of the last is far below their standard error."""
STEP_TOL = 1e-6
"""Largest last step, in standard deviations of the unknowns."""
START_S_ROT = np.radians(0.1)
MIN_S_ROT = 1e-7
MIN_POSES = 6


@dataclass(frozen=True)
class _State:
    """Centred and scaled: readings z = (y - centre) / size, |u| = 1."""

    A: Array
    b: Array
    u: Array


@dataclass(frozen=True)
class _Linear:
    """The weighted problem linearised at a state."""

    r: Array  # (..., J, 3)
    X: Array  # (..., J, 3, 14), derivatives of the model y(A, b, u)
    S: Array
    S_inverse: Array
    inverse: Array  # N^-1
    step: Array
    V_rot: Array  # dS / d(s_rot^2)
    V_noise: Array  # dS / d(kappa^2)


def gls_ml(
    y: ArrayLike,
    R: ArrayLike,
    magnitude: float,
    *,
    kind: Kind = "acc",
    raw_unit: str = "count",
    unit: str = "",
    noise_sd: ArrayLike | None = None,
    s_rot: float | None = None,
    use: ArrayLike | None = None,
    max_iter: int = MAX_ITER,
) -> Fit:
    """Joint maximum likelihood of H, B and the sensed vector of one sensor.

    Parameters
    ----------
    y : array_like (..., J, 3), raw unit
        Mean reading of each pose; leading axes are nodes.
    R : array_like (J, 3, 3) or (..., J, 3, 3)
        Takes the sensed vector u to pose j.
    magnitude : float, calibrated unit
    noise_sd : array_like, raw unit, broadcast to (..., J, 3), optional
        Standard error of the readings, from the scatter within the rests; taken as it is (kappa = 1). Without
        it all readings are equally noisy and kappa is estimated.
    s_rot : float, rad, optional
        Housing-angle error about each axis; estimated where not given.
    use : array_like of bool (..., J), optional
        Poses that count.

    Returns
    -------
    Fit
        `covariance` (..., 12, 12) of (H row by row, B). `details`: `s_rot` (...,) rad, `noise` (...,) the factor
        kappa (raw unit where `noise_sd` was not given), `cofactor` (..., 14, 14) covariance of (A row by row, B,
        two components of u across it, calibrated unit), `tangent` (..., 3, 2) the directions of these two,
        `deletion` (..., J) the chi-square (3 degrees of freedom) by which the fit improves without each pose,
        `predicted` (..., J, 3) reading minus prediction from the other poses, `chi2`, `dof`.

    Raises
    ------
    DataError
        With fewer than six poses, or (single node) poses that do not determine H.
    """
    y = checked_readings(y, kind, MIN_POSES)
    R = checked_rotations(R, y.shape[-2])
    lead = np.broadcast_shapes(y.shape[:-2], R.shape[:-3], () if use is None else np.shape(use)[:-1])
    y = np.broadcast_to(y, (*lead, *y.shape[-2:]))
    counted = np.ones(y.shape[:-1], dtype=bool) if use is None else np.broadcast_to(np.asarray(use, bool), y.shape[:-1])
    start = _start(y, R, counted, kind)
    centre, size = _scale(y, counted)
    z = (y - centre[..., None, :]) / size[..., None, None]
    noise = np.ones(y.shape) if noise_sd is None else np.broadcast_to(np.asarray(noise_sd, float), y.shape)
    noise = noise / size[..., None, None]
    weight = counted.astype(np.float64)
    state = _State(
        np.linalg.inv(start.model.H) / size[..., None, None],
        (start.model.B - centre) / size[..., None],
        np.asarray(start.u),
    )
    kappa2 = np.ones(lead) if noise_sd is not None else _first_noise(z, R, state, weight, noise)
    rot2 = np.full(lead, (START_S_ROT if s_rot is None else s_rot) ** 2)
    free = np.array([noise_sd is None, s_rot is None])
    converged, n_iter = np.zeros(lead, dtype=bool), 0
    while n_iter < max_iter and not (converged.all() and not free.any()):
        n_iter += 1
        at = _linearise(z, R, state, kappa2, rot2, noise, weight)
        moved = np.max(np.abs(at.step) / np.sqrt(np.diagonal(at.inverse, axis1=-2, axis2=-1)), axis=-1)
        state = _moved(state, at.step)
        converged = moved < STEP_TOL
        if not free.any():
            continue
        new_kappa2, new_rot2, rot2_se = _reml(at, kappa2, rot2, weight, free)
        least = np.mean(noise**2, axis=(-1, -2)) * kappa2
        changed = np.maximum(np.abs(new_kappa2 / kappa2 - 1), np.abs(new_rot2 - rot2) / (rot2 + least))
        kappa2, rot2 = new_kappa2, new_rot2
        if n_iter >= REML_ITER or np.all(converged & (changed < 1e-4)):
            # an s_rot that is not clear of zero is noise: taken at its word it would widen every covariance
            rot2 = np.where(rot2 < rot2_se, MIN_S_ROT**2, rot2) if free[1] else rot2
            free = np.zeros(2, dtype=bool)
            converged = np.zeros(lead, dtype=bool)
    at = _linearise(z, R, state, kappa2, rot2, noise, weight)
    return _to_fit(
        at, state, y, R, centre, size, magnitude, kappa2, rot2, converged, n_iter, kind, raw_unit, unit, weight
    )


def _start(y: Array, R: Array, counted: Array, kind: Kind) -> Fit:
    """One-step with |u| = 1; poses that do not count have weight zero."""
    weights = None if counted.all() else np.where(counted, 1.0, 1e-12)
    return one_step(y, R, 1.0, kind=kind, weights=weights, covariance=False)


def _scale(y: Array, counted: Array) -> tuple[Array, Array]:
    w = counted / counted.sum(axis=-1, keepdims=True)
    centre = np.einsum("...j,...ji->...i", w, y)
    size = np.sqrt(np.einsum("...j,...ji->...", w, (y - centre[..., None, :]) ** 2))
    return centre, size


def _first_noise(z: Array, R: Array, state: _State, weight: Array, noise: Array) -> Array:
    r = (z - state.b[..., None, :] - _predicted(state, R)) / noise
    dof = np.maximum(3 * weight.sum(axis=-1) - 14, 1)
    return np.maximum(np.einsum("...ji,...ji,...j->...", r, r, weight) / dof, 1e-24)


def _predicted(state: _State, R: Array) -> Array:
    return np.einsum("...ab,...jbc,...c->...ja", state.A, R, state.u)


def _linearise(z: Array, R: Array, state: _State, kappa2: Array, rot2: Array, noise: Array, weight: Array) -> _Linear:
    A, u = state.A, state.u
    v = np.einsum("...jbc,...c->...jb", R, u)
    r = z - state.b[..., None, :] - np.einsum("...ab,...jb->...ja", A, v)
    X = np.zeros((*r.shape, 14))
    for i in range(3):
        X[..., i, 3 * i : 3 * i + 3] = v
        X[..., i, 9 + i] = 1.0
    X[..., 12:] = np.einsum("...ab,...jbc,...ck->...jak", A, R, _across(u))
    G = np.einsum("...ab,...jbc->...jac", A, so3.skew(v))
    V_rot = G @ np.swapaxes(G, -1, -2)
    V_noise = noise[..., :, None] ** 2 * np.eye(3)
    S = kappa2[..., None, None, None] * V_noise + rot2[..., None, None, None] * V_rot
    S_inverse = np.linalg.inv(S)
    XW = np.swapaxes(X, -1, -2) @ S_inverse * weight[..., None, None]
    N = (XW @ X).sum(axis=-3)
    d = np.sqrt(np.diagonal(N, axis1=-2, axis2=-1))
    inverse = np.linalg.inv(N / (d[..., :, None] * d[..., None, :])) / (d[..., :, None] * d[..., None, :])
    g = np.einsum("...jpa,...ja->...p", XW, r)
    return _Linear(r, X, S, S_inverse, inverse, np.einsum("...pq,...q->...p", inverse, g), V_rot, V_noise)


def _across(u: Array) -> Array:
    """Two unit vectors across each unit vector `u` (..., 3), as columns (..., 3, 2)."""
    return np.swapaxes(np.linalg.svd(u[..., None, :])[2][..., 1:, :], -1, -2)


def _moved(state: _State, step: Array) -> _State:
    u = state.u + np.einsum("...ck,...k->...c", _across(state.u), step[..., 12:])
    return _State(
        state.A + step[..., :9].reshape(state.A.shape),
        state.b + step[..., 9:12],
        u / np.linalg.norm(u, axis=-1, keepdims=True),
    )


def _reml(at: _Linear, kappa2: Array, rot2: Array, weight: Array, free: Array) -> tuple[Array, Array, Array]:
    """One step of REML on (kappa^2, s_rot^2), kept positive, and the standard error of s_rot^2.

    Score of a component with derivative V: (q' V q - tr P V) / 2 with q = S^-1 r; its information is the average of
    the observed and the expected one, q' V P V q / 2 (Gilmour, Thompson & Cullis, Biometrics 51, 1995).
    """
    theta = np.stack([kappa2, rot2], axis=-1)
    w = weight[..., None, None]
    back = at.S_inverse @ at.X
    q = np.einsum("...jab,...jb->...ja", at.S_inverse, at.r) * weight[..., None]
    V = (at.V_noise, at.V_rot)
    Vq = [np.einsum("...jab,...jb->...ja", v, q) for v in V]
    to_N = [np.einsum("...jap,...ja->...p", back, x * weight[..., None]) for x in Vq]
    diagonal = (at.S_inverse - back @ at.inverse[..., None, :, :] @ np.swapaxes(back, -1, -2)) * w
    score, info = np.empty((*kappa2.shape, 2)), np.empty((*kappa2.shape, 2, 2))
    for i in range(2):
        score[..., i] = np.einsum("...ja,...ja->...", q, Vq[i]) - np.einsum("...jab,...jba->...", diagonal, V[i])
        for k in range(2):
            direct = np.einsum("...ja,...jab,...jb,...j->...", Vq[i], at.S_inverse, Vq[k], weight)
            info[..., i, k] = direct - np.einsum("...p,...pq,...q->...", to_N[i], at.inverse, to_N[k])
    info = np.where(free[:, None] & free, info, np.eye(2))
    score = np.where(free, score, 0.0)
    d = np.sqrt(np.maximum(np.diagonal(info, axis1=-2, axis2=-1), 1e-300))
    inverse = np.linalg.inv(info / (d[..., :, None] * d[..., None, :]) + 1e-6 * np.eye(2)) / (
        d[..., :, None] * d[..., None, :]
    )
    step = np.einsum("...ik,...k->...i", inverse, score)
    new = np.where(free, np.clip(theta + step, 0.2 * theta, 5 * theta + 1e-12), theta)
    new[..., 1] = np.maximum(new[..., 1], MIN_S_ROT**2)
    return new[..., 0], new[..., 1], np.sqrt(2 * np.abs(inverse[..., 1, 1]))


def _to_fit(
    at: _Linear,
    state: _State,
    y: Array,
    R: Array,
    centre: Array,
    size: Array,
    magnitude: float,
    kappa2: Array,
    rot2: Array,
    converged: Array,
    n_iter: int,
    kind: Kind,
    raw_unit: str,
    unit: str,
    weight: Array,
) -> Fit:
    # sign: det H > 0 (conventions); (A, u) and (-A, -u) are the same fit
    sign = np.where(np.linalg.det(state.A) < 0, -1.0, 1.0)
    A = sign[..., None, None] * state.A * (size / magnitude)[..., None, None]
    u = sign[..., None] * state.u * magnitude
    H, B = np.linalg.inv(A), centre + size[..., None] * state.b
    # unknowns in physical units: A scales by size / magnitude, b by size, u by magnitude
    lead = size.shape
    units = np.concatenate(
        [
            np.broadcast_to((sign * size / magnitude)[..., None], (*lead, 9)),
            np.broadcast_to(size[..., None], (*lead, 3)),
            np.full((*lead, 2), magnitude),
        ],
        axis=-1,
    )
    cofactor = at.inverse * units[..., :, None] * units[..., None, :]
    to = np.zeros((*lead, 12, 12))
    to[..., :9, :9] = -np.einsum("...ik,...lj->...ijkl", H, H).reshape(*lead, 9, 9)  # dH = -H dA H
    to[..., 9:, 9:] = np.eye(3)
    covariance = to @ cofactor[..., :12, :12] @ np.swapaxes(to, -1, -2)
    off = (y - B[..., None, :]) @ np.swapaxes(H, -1, -2) - np.einsum("...jbc,...c->...jb", R, u)
    residual = np.linalg.norm(off, axis=-1)
    deletion, predicted = _deletion(at, weight)
    chi2 = np.einsum("...ja,...jab,...jb,...j->...", at.r, at.S_inverse, at.r, weight)
    details = {
        "s_rot": np.sqrt(rot2),
        "noise": np.sqrt(kappa2),
        "cofactor": cofactor,
        "tangent": _across(state.u) * sign[..., None, None],
        "deletion": deletion,
        "predicted": predicted * size[..., None, None],
        "chi2": chi2,
        "dof": 3 * weight.sum(axis=-1) - 14,
    }
    single = H.ndim == 2
    if single:
        _refuse_open(kind, covariance, A, magnitude)
    rms = float(np.sqrt(np.mean(residual[weight > 0] ** 2))) if single else None
    model = SensorModel(kind, H, B, raw_unit, unit, covariance if single else None, rms, y.shape[-2], "gls-ml")
    bad = int((~converged).sum())
    return Fit(
        model,
        residual,
        float(chi2) if single else chi2,
        "gls-ml",
        "not in the papers: maximum likelihood with reading noise and housing-angle error",
        u=u,
        covariance=covariance,
        rank=14,
        condition=np.linalg.cond(A) if not single else float(np.linalg.cond(A)),
        n_iter=n_iter,
        converged=bool(converged.all()),
        details=details,
        text=f"{bad} of {converged.size} did not converge in {n_iter} iterations" if bad else "",
    )


def _deletion(at: _Linear, weight: Array) -> tuple[Array, Array]:
    """For each pose: chi-square of its misfit to the fit of the others, and that misfit (linearised, exact for
    the linear problem): with h = X N^-1 X^T, the predicted residual is (I - h S^-1)^-1 r."""
    h = at.X @ at.inverse[..., None, :, :] @ np.swapaxes(at.X, -1, -2)
    counted = weight[..., None, None]
    Q = at.S - h * counted  # covariance of the residual within the fit
    Q += 1e-12 * np.trace(at.S, axis1=-2, axis2=-1)[..., None, None] * np.eye(3)
    within = np.linalg.solve(Q, at.r[..., None])[..., 0]
    predicted = np.einsum("...jab,...jb->...ja", at.S, within)
    outside = np.linalg.solve(at.S + h, at.r[..., None])[..., 0]  # of poses that were left out already
    chi2 = np.where(
        weight > 0, np.einsum("...ja,...ja->...j", at.r, within), np.einsum("...ja,...ja->...j", at.r, outside)
    )
    return chi2, np.where(weight[..., None] > 0, predicted, at.r)


def _refuse_open(kind: Kind, covariance: Array, A: Array, magnitude: float) -> None:
    if np.isfinite(covariance).all() and np.all(np.diag(covariance) >= 0):
        return
    text = f"{kind}: the poses do not determine H; turn the housing about a second and a third axis"
    raise DataError(text, (Issue("unobservable", "fail", text, kind),))
