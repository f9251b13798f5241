"""`gls-ml`: maximum likelihood of one sensor from poses, with reading noise and housing-angle error (ours).

Not in the papers: Z-TIE and ZY-TBME weigh all poses alike and take their rotations as exact. Here

    y_j = B + A R_j exp(-[e_j]x) u + n_j,      n_j ~ N(0, kappa^2 diag(noise_sd_j^2)),   e_j ~ N(0, s_rot^2 I)

so the reading of pose j has covariance, with v_j = R_j u,

    S_j = kappa^2 diag(noise_sd_j^2) + s_rot^2 (A [v_j]x)(A [v_j]x)^T                                       (1)

Gauss-Newton on (A, B, direction of u) with these weights, in turn with restricted maximum likelihood (REML) for
kappa and s_rot. The fit without housing error (s_rot = 0) comes first; the one with it is taken where its
restricted likelihood is clearly larger. Nodes are independent and everything here is vectorised over them.
Several sensors of one node share their e_j; that fit is `joint`.

=============  ==========================================================  ===================
name here      meaning                                                     shape
=============  ==========================================================  ===================
A, B           forward matrix H^-1 and bias                                (..., 3, 3), (..., 3)
v              the sensed vector in each pose, R_j u                       (..., J, 3)
S              covariance of each pose's reading, (1)                      (..., J, 3, 3)
X              derivatives of the readings by the 14 unknowns (A, B, u)    (..., J, 3, 14)
N              normal matrix, X^T S^-1 X                                   (..., 14, 14)
P              S^-1 - S^-1 X N^-1 X^T S^-1                                 blocks (..., J, 3, 3)
=============  ==========================================================  ===================
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from margcal.core.errors import DataError
from margcal.core.types import Array, Fit, Issue, Kind, SensorModel
from margcal.methods.affine import checked_readings, checked_rotations, determinant3, inverse3, tangents
from margcal.methods.one_step import one_step

MAX_ITER = 30
MAX_STEP = 0.3
STEP_TOL = 1e-6
"""Largest last step, in standard deviations of the unknowns."""
COMPONENT_TOL = 1e-4
"""Largest last change of kappa^2 and s_rot^2, relative; their own standard error is 15 % and more."""
MIN_S_ROT, MAX_S_ROT = 1e-7, 0.2
"""Range of s_rot, rad; beyond, (1) is no longer first order, and something else is wrong."""
LEAST_NOISE = 1e-8
"""Least noise of a reading as a part of the readings' extent; rounding in float64 is near."""
MIN_NOISE = 1e-3
"""Least estimate of the noise as a part of what s_rot does to a reading: the housing alone leaves (1) singular."""
CLEAR = 2.0
"""Twice the gain in log-likelihood from which s_rot counts as different from zero (chance: 8 %). An estimate that
is not clear of zero is noise: taken at its word it would widen every covariance."""
MIN_POSES = 6

_Nodes = NDArray[np.bool_] | NDArray[np.intp]


@dataclass(frozen=True)
class _Problem:
    """n nodes: centred and scaled readings z and their noise (n, J, 3), rotations (n, J, 3, 3), weights (n, J)."""

    z: Array
    R: Array
    noise: Array
    weight: Array

    def of(self, index: _Nodes) -> _Problem:
        return _Problem(self.z[index], self.R[index], self.noise[index], self.weight[index])


@dataclass(frozen=True)
class _State:
    """Estimate of n nodes, |u| = 1."""

    A: Array
    b: Array
    u: Array
    kappa2: Array
    rot2: Array
    converged: NDArray[np.bool_]

    def of(self, index: _Nodes) -> _State:
        return _State(*(getattr(self, name)[index] for name in self.__dataclass_fields__))

    def with_nodes(self, index: _Nodes, other: _State) -> _State:
        """This one, but `other` at the nodes `index`."""
        columns = []
        for name in self.__dataclass_fields__:
            column = getattr(self, name).copy()
            column[index] = getattr(other, name)
            columns.append(column)
        return _State(*columns)


@dataclass(frozen=True)
class _Linear:
    """The weighted problem linearised at a state."""

    r: Array
    X: Array
    S: Array
    S_inverse: Array
    back: Array  # S^-1 X
    inverse: Array  # N^-1
    step: Array
    V_rot: Array  # dS / d(s_rot^2)
    log_likelihood: Array  # restricted, up to a constant; meant for where the step vanishes


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
        `predicted` (..., J, 3) reading minus prediction from the other poses, `chi2`, `dof`, `converged` (...,).

    Raises
    ------
    DataError
        With fewer than six poses, or (single node) poses that do not determine H.

    Notes
    -----
    Where the noise must come from the misfits too, ten poses leave it 16 degrees of freedom, and the covariance
    is as uncertain as that; give `noise_sd`.
    """
    y = checked_readings(y, kind, MIN_POSES)
    R = checked_rotations(R, y.shape[-2])
    J = y.shape[-2]
    lead = np.broadcast_shapes(y.shape[:-2], R.shape[:-3], () if use is None else np.shape(use)[:-1])
    y = np.broadcast_to(y, (*lead, J, 3)).reshape(-1, J, 3)
    R = np.broadcast_to(R, (*lead, J, 3, 3)).reshape(-1, J, 3, 3)
    counted = np.broadcast_to(True if use is None else np.asarray(use, dtype=bool), (*lead, J)).reshape(-1, J)
    noise = np.broadcast_to(1.0 if noise_sd is None else np.asarray(noise_sd, float), (*lead, J, 3)).reshape(-1, J, 3)
    start = _start(y, R, counted, kind, single=not lead)
    centre, size = _scale(y, counted)
    problem = _Problem(
        (y - centre[:, None]) / size[:, None, None],
        R,
        np.maximum(noise / size[:, None, None], LEAST_NOISE),
        np.where(counted, 1.0, 0.0),
    )
    state = _first_state(problem, start, centre, size, noise_sd is None, s_rot)
    state, n_iter = _solve(problem, state, (noise_sd is None, False), max_iter)
    if s_rot is None:
        state, more = _with_s_rot(problem, state, noise_sd is None, max_iter)
        n_iter += more
    found = _Found(problem, state, _linearise(problem, state), centre, size, magnitude, n_iter)
    return _to_fit(found, y, kind, raw_unit, unit, lead)


def _start(y: Array, R: Array, counted: NDArray[np.bool_], kind: Kind, *, single: bool) -> Fit:
    """One-step with |u| = 1; poses that do not count have next to no weight."""
    weights = None if counted.all() else np.where(counted, 1.0, 1e-12)
    if single:  # it says what is missing where the poses do not determine H
        one_step(y[0], R[0], 1.0, kind=kind, weights=None if weights is None else weights[0], covariance=False)
    return one_step(y, R, 1.0, kind=kind, weights=weights, covariance=False)


def _scale(y: Array, counted: NDArray[np.bool_]) -> tuple[Array, Array]:
    w = counted / counted.sum(axis=-1, keepdims=True)
    centre = np.einsum("nj,nji->ni", w, y)
    return centre, np.sqrt(np.einsum("nj,nji->n", w, (y - centre[:, None]) ** 2))


def _first_state(p: _Problem, start: Fit, centre: Array, size: Array, free_noise: bool, s_rot: float | None) -> _State:
    A, b = inverse3(start.model.H) / size[:, None, None], (start.model.B - centre) / size[:, None]
    n = len(size)
    rot2 = MIN_S_ROT**2 if s_rot is None else max(s_rot, MIN_S_ROT) ** 2
    state = _State(A, b, np.asarray(start.u), np.ones(n), np.full(n, rot2), np.zeros(n, dtype=bool))
    if not free_noise:
        return state
    r = _linearise(p, state).r / p.noise
    dof = np.maximum(3 * p.weight.sum(axis=-1) - 14, 1)
    kappa2 = np.einsum("nji,nji,nj->n", r, r, p.weight) / dof
    return replace(state, kappa2=np.maximum(kappa2, _least_kappa2(p, state.rot2)))


def _least_kappa2(p: _Problem, rot2: Array) -> Array:
    return np.maximum(MIN_NOISE**2 * rot2, LEAST_NOISE**2) / np.mean(p.noise**2, axis=(-1, -2))


def _solve(p: _Problem, state: _State, free: tuple[bool, bool], max_iter: int) -> tuple[_State, int]:
    """Gauss-Newton, with a step of REML on the components (kappa^2, s_rot^2) that are `free` after each step."""
    n_iter, active, now = 0, np.arange(len(p.z)), state
    while n_iter < max_iter and len(active):
        n_iter += 1
        at = _linearise(p, now)
        sd = np.sqrt(np.diagonal(at.inverse, axis1=-2, axis2=-1))
        done = np.max(np.abs(at.step) / sd, axis=-1) < STEP_TOL
        lost = ~np.isfinite(at.step).all(axis=-1)
        if any(free):
            kappa2, rot2 = _reml(p, at, now, free)
            least = np.mean(p.noise**2, axis=(-1, -2)) * kappa2
            change = np.abs(kappa2 / now.kappa2 - 1) + np.abs(rot2 - now.rot2) / (rot2 + least)
            done &= change < COMPONENT_TOL
            now = replace(now, kappa2=kappa2, rot2=rot2)
        now = replace(_moved(now, at.step), converged=done & ~lost)
        state = state.with_nodes(active, now)
        if (left := ~(done | lost)).sum() < len(active):  # the others go on without those that are done
            active, p, now = active[left], p.of(left), now.of(left)
    return state, n_iter


def _with_s_rot(p: _Problem, null: _State, free_noise: bool, max_iter: int) -> tuple[_State, int]:
    """The fit with s_rot estimated, at the nodes where its likelihood is clearly above that of `null`, s_rot = 0."""
    at = _linearise(p, null)
    score, info = _score(p, at, (free_noise, True))
    worth = np.flatnonzero((score[:, 1] > 0) & null.converged)  # elsewhere the likelihood falls from zero on
    if not len(worth):
        return null, 0
    first = np.clip(score[worth, 1] / info[worth, 1, 1], MIN_S_ROT**2, MAX_S_ROT**2)
    full, n_iter = _solve(p.of(worth), replace(null.of(worth), rot2=first), (free_noise, True), max_iter)
    gain = 2 * (_linearise(p.of(worth), full).log_likelihood - at.log_likelihood[worth])
    better = full.converged & (gain > CLEAR)
    return null.with_nodes(worth[better], full.of(better)), n_iter


def _linearise(p: _Problem, state: _State) -> _Linear:
    A, u = state.A, state.u
    n, J = p.weight.shape
    v = (p.R @ u[:, None, :, None])[..., 0]
    Av = v @ np.swapaxes(A, -1, -2)
    r = p.z - state.b[:, None] - Av
    X = np.zeros((n, J, 3, 14))
    for i in range(3):
        X[..., i, 3 * i : 3 * i + 3] = v
        X[..., i, 9 + i] = 1.0
    X[..., 12:] = (A[:, None] @ p.R) @ tangents(u)[:, None]
    # A [v]x [v]x^T A^T with |v| = 1
    V_rot = (A @ np.swapaxes(A, -1, -2))[:, None] - Av[..., :, None] * Av[..., None, :]
    S = state.rot2[:, None, None, None] * V_rot
    S[..., range(3), range(3)] += state.kappa2[:, None, None] * p.noise**2
    S_inverse = inverse3(S)
    back = S_inverse @ X
    weighted = (back * p.weight[..., None, None]).reshape(n, 3 * J, 14)
    N = np.swapaxes(X.reshape(n, 3 * J, 14), -1, -2) @ weighted
    d = np.sqrt(np.diagonal(N, axis1=-2, axis2=-1))
    d = d[:, :, None] * d[:, None, :]
    inverse = np.linalg.inv(N / d) / d
    g = np.swapaxes(weighted, -1, -2) @ r.reshape(n, 3 * J, 1)
    # inverse3 divides by the determinant, so |S| is safely positive here
    log_S = np.einsum("nj,nj->n", np.log(determinant3(S)), p.weight)
    square = np.einsum("nja,njab,njb,nj->n", r, S_inverse, r, p.weight, optimize=True)
    with np.errstate(invalid="ignore"):  # NaN for nodes that `one_step` could not solve
        log_likelihood = -0.5 * (log_S + np.linalg.slogdet(N)[1] + square)
    return _Linear(r, X, S, S_inverse, back, inverse, (inverse @ g)[..., 0], V_rot, log_likelihood)


def _moved(state: _State, step: Array) -> _State:
    # in these units A and u are of order one: longer steps come of a wrong label or a wild s_rot, and run away
    step = step * np.minimum(1.0, MAX_STEP / np.maximum(np.linalg.norm(step, axis=-1), 1e-300))[:, None]
    u = state.u + (tangents(state.u) @ step[:, 12:, None])[..., 0]
    u = u / np.linalg.norm(u, axis=-1, keepdims=True)
    return replace(state, A=state.A + step[:, :9].reshape(-1, 3, 3), b=state.b + step[:, 9:12], u=u)


def _score(p: _Problem, at: _Linear, free: tuple[bool, bool]) -> tuple[Array, Array]:
    """Twice the score (n, 2) and information (n, 2, 2) of the restricted likelihood by (kappa^2, s_rot^2).

    With V the derivative of S by a component and q = S^-1 r: score (q' V q - tr P V) / 2, and as information the
    average of the observed and the expected one, q' V P V q / 2 (Gilmour, Thompson & Cullis, Biometrics 51, 1995).
    """
    w = p.weight[..., None]
    q = (at.S_inverse @ at.r[..., None])[..., 0] * w
    Vq = (p.noise**2 * q, (at.V_rot @ q[..., None])[..., 0])
    P = (at.S_inverse - (at.back @ at.inverse[:, None]) @ np.swapaxes(at.back, -1, -2)) * w[..., None]
    trace = (
        np.einsum("njaa,nja->n", P, p.noise**2),
        np.einsum("njab,njba->n", P, at.V_rot),
    )
    to_N = [np.einsum("njap,nja->np", at.back, x * w) for x in Vq]
    n = len(p.z)
    score, info = np.zeros((n, 2)), np.zeros((n, 2, 2))
    info[:] = np.eye(2)
    for i in (i for i in range(2) if free[i]):
        score[:, i] = np.einsum("nja,nja->n", q, Vq[i]) - trace[i]
        for k in (k for k in range(2) if free[k]):
            direct = np.einsum("nja,nja->n", Vq[i] * w, (at.S_inverse @ Vq[k][..., None])[..., 0])
            info[:, i, k] = direct - np.einsum("np,npq,nq->n", to_N[i], at.inverse, to_N[k], optimize=True)
    return score, info


def _reml(p: _Problem, at: _Linear, state: _State, free: tuple[bool, bool]) -> tuple[Array, Array]:
    """One step of REML on (kappa^2, s_rot^2), of at most a factor of five."""
    score, info = _score(p, at, free)
    d = np.sqrt(np.maximum(np.diagonal(info, axis1=-2, axis2=-1), 1e-300))
    scaled = info / (d[:, :, None] * d[:, None, :]) + 1e-6 * np.eye(2)
    step = np.linalg.solve(scaled, (score / d)[..., None])[..., 0] / d
    theta = np.stack([state.kappa2, state.rot2], axis=-1)
    new = np.where(free, np.clip(theta + step, 0.2 * theta, 5 * theta + 1e-12), theta)
    rot2 = np.clip(new[:, 1], MIN_S_ROT**2, MAX_S_ROT**2) if free[1] else new[:, 1]
    return np.maximum(new[:, 0], _least_kappa2(p, rot2)) if free[0] else new[:, 0], rot2


@dataclass(frozen=True)
class _Found:
    """What the result is made of."""

    problem: _Problem
    state: _State
    at: _Linear
    centre: Array
    size: Array
    magnitude: float
    n_iter: int


def _to_fit(found: _Found, y: Array, kind: Kind, raw_unit: str, unit: str, lead: tuple[int, ...]) -> Fit:
    state, at, size, magnitude = found.state, found.at, found.size, found.magnitude
    # sign: det H > 0 (conventions); (A, u) and (-A, -u) are the same fit
    sign = np.where(determinant3(state.A) < 0, -1.0, 1.0)
    A = state.A * (sign * size / magnitude)[:, None, None]
    u = sign[:, None] * state.u * magnitude
    H, B = inverse3(A), found.centre + size[:, None] * state.b
    cofactor, covariance = _covariances(found, H, sign)
    residual = np.linalg.norm(
        (y - B[:, None]) @ np.swapaxes(H, -1, -2) - (found.problem.R @ u[:, None, :, None])[..., 0], axis=-1
    )
    weight = found.problem.weight
    deletion, predicted = _deletion(at, weight)
    chi2 = np.einsum("nja,njab,njb,nj->n", at.r, at.S_inverse, at.r, weight, optimize=True)
    details = {
        "s_rot": np.sqrt(state.rot2),
        "noise": np.sqrt(state.kappa2),
        "cofactor": cofactor,
        "tangent": tangents(state.u) * sign[:, None, None],
        "deletion": deletion,
        "predicted": predicted * size[:, None, None],
        "chi2": chi2,
        "dof": 3 * weight.sum(axis=-1) - 14,
        "converged": state.converged,
    }
    details = {name: np.reshape(value, (*lead, *value.shape[1:])) for name, value in details.items()}
    if not lead:
        _refuse_open(kind, covariance[0])
    rms = None if lead else float(np.sqrt(np.mean(residual[weight > 0] ** 2)))
    H, B, u, residual, covariance = (np.reshape(a, (*lead, *a.shape[1:])) for a in (H, B, u, residual, covariance))
    model = SensorModel(kind, H, B, raw_unit, unit, None if lead else covariance, rms, y.shape[-2], "gls-ml")
    solved = np.asarray(np.isfinite(determinant3(H)))
    condition = np.where(solved, np.linalg.cond(np.where(solved[..., None, None], H, np.eye(3))), np.nan)
    bad = int((~state.converged).sum())
    return Fit(
        model,
        residual,
        details["chi2"] if lead else float(details["chi2"]),
        "gls-ml",
        "not in the papers: maximum likelihood with reading noise and housing-angle error",
        u=u,
        covariance=covariance,
        rank=14,
        condition=condition if lead else float(condition),
        n_iter=found.n_iter,
        converged=bad == 0,
        details=details,
        text=f"{bad} of {len(size)} did not converge in {found.n_iter} iterations" if bad else "",
    )


def _covariances(found: _Found, H: Array, sign: Array) -> tuple[Array, Array]:
    """Covariance (n, 14, 14) of (A, B, u) in physical units, and (n, 12, 12) of (H, B): dH = -H dA H."""
    n, size, magnitude = len(H), found.size, found.magnitude
    units = np.empty((n, 14))
    units[:, :9] = (sign * size / magnitude)[:, None]
    units[:, 9:12] = size[:, None]
    units[:, 12:] = magnitude
    cofactor = found.at.inverse * units[:, :, None] * units[:, None, :]
    to = np.zeros((n, 12, 12))
    to[:, :9, :9] = -np.einsum("nik,nlj->nijkl", H, H).reshape(n, 9, 9)
    to[:, 9:, 9:] = np.eye(3)
    C = to @ cofactor[:, :12, :12] @ np.swapaxes(to, -1, -2)
    return cofactor, (C + np.swapaxes(C, -1, -2)) / 2


def _deletion(at: _Linear, weight: Array) -> tuple[Array, Array]:
    """For each pose: chi-square of its misfit to the fit of the others, and that misfit (linearised, exact for
    the linear problem): with h = X N^-1 X^T, the predicted residual is (I - h S^-1)^-1 r."""
    h = (at.X @ at.inverse[:, None]) @ np.swapaxes(at.X, -1, -2)
    inside = at.S - h  # covariance of the residual within the fit
    inside = inside + 1e-12 * np.trace(at.S, axis1=-2, axis2=-1)[..., None, None] * np.eye(3)
    counts = weight > 0
    # of poses that were left out already, the residual is the prediction's misfit
    Q = np.where(counts[..., None, None], inside, at.S + h)
    Q_inverse_r = np.linalg.solve(Q, at.r[..., None])
    predicted = np.where(counts[..., None], (at.S @ Q_inverse_r)[..., 0], at.r)
    return np.einsum("nja,nja->nj", at.r, Q_inverse_r[..., 0]), predicted


def _refuse_open(kind: Kind, covariance: Array) -> None:
    if np.isfinite(covariance).all() and np.all(np.diag(covariance) >= 0):
        return
    text = f"{kind}: the poses do not determine H; turn the housing about a second and a third axis"
    raise DataError(text, (Issue("unobservable", "fail", text, kind),))
