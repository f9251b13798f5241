"""All sensors and all attitudes of a node in one maximum-likelihood fit (ours, not in the papers).

The papers take the attitudes of the rests as exact and fit one sensor after the other. A housing put down by
hand is tenths of a degree off, and where nobody knows the attitudes they must be estimated anyway. Here every
rest has an attitude R_j of its own that accelerometer, magnetometer and gyroscope share:

    acc, mag at rest j      y_j  = B + A R_j^T u + noise,        A = H^-1, |u| known               (i)
    gyroscope at rest j     y_j  = B_g + noise                                                     (ii)
    turn from rest i to j   log(dR(H_g, B_g)^T R_i^T R_j) = noise                                  (iii)
    known attitude          log(R0_j^T R_j) ~ N(0, s_rot^2 I)                                      (iv)
    level table             the housing's "up" at rest j is within level_sd of the vertical        (v)
    vertical of the lab     the direction of u_acc is within vertical_sd of z                      (vi)

Gauss-Newton on the manifold; the scale of each kind of residual is a variance component, estimated together
with the rest (restricted maximum likelihood, Foerstner's form: sigma^2 <- v^T P v / redundancy).

=============  =========================================================  ============
name here      meaning                                                    shape
=============  =========================================================  ============
A, B           forward matrix H^-1 and bias, raw unit                     (3, 3), (3,)
u              sensed vector in the laboratory, SI                        (3,)
R              R_nh of the rests                                          (J, 3, 3)
component      factor on the standard deviations of one kind of residual  scalar
=============  =========================================================  ============
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from margcal.core import so3
from margcal.core.types import Array, Index, Kind
from margcal.methods.preintegration import TurnBatch, integrate, preintegrate

ANGLE_ERROR = 2e-4
"""Error of an integrated turn beside the white noise, as a fraction of the angle turned (g-sensitivity,
nonlinearity, sampling); the variance component scales it to what the data show."""
SAMPLING_ERROR = 0.1
"""Error of one sampling interval as a fraction of the angle by which the rate's second difference misses."""
FIRST_S_ROT = np.radians(0.3)
"""Start of the attitude error s_rot, rad, before it is estimated."""
CHECKABLE = 0.02
"""Redundancy below which a residual says nothing of an error (the other readings do not check it)."""
PRIOR_DOF = 4.0
"""Weight, in residuals, of a sensor's own scatter (component 1) in the estimate of its component: with three
residuals the component is otherwise a lottery, and every tenth node far too sure of itself."""
COMPONENT_TOL = 1e-3
"""Relative change of a variance component that no longer matters: its own standard error is above 5 %."""
MIN_REDUNDANCY = 3.0
"""A variance component with less redundancy than this is not estimated."""
LEVEL_REDUNDANCY = 8.0
"""The same for the table's tilt, which is told beforehand: only clear evidence corrects it."""
FLOOR = {"rot": np.radians(0.005), "level": 0.02}
"""Least value of a component, for the algebra's sake; of the others 0.7: scatter over sqrt(n) is about the least
error that a mean can have."""


@dataclass(frozen=True)
class Triad:
    """One sensor at rest: means `y` (J, 3) raw unit with standard errors `se` (J, 3); NaN = not measured.

    `A`, `B` the start, `u` (3,) its vector in the laboratory, SI. `triangular`: keep A upper triangular (the
    frame is defined by this sensor). `u_free`: the direction of u is estimated.
    """

    y: Array
    se: Array
    A: Array
    B: Array
    u: Array
    triangular: bool = False
    u_free: bool = False


@dataclass(frozen=True)
class Gyro:
    """The gyroscope: its means at rest and the turns ``before -> after`` between rests.

    `weight` (T,): 0 for a turn that does not count.
    """

    y: Array
    se: Array
    H: Array
    B: Array
    turns: TurnBatch
    before: Index
    after: Index
    noise_sd: Array
    weight: Array | None = None


@dataclass(frozen=True)
class Priors:
    """What is known of the attitudes beforehand.

    Attributes
    ----------
    R0 : ndarray (J, 3, 3) or None
        Nominal attitudes; the deviation has the estimated standard deviation s_rot about each axis. NaN: none.
    up : ndarray (J, 3) or None
        Housing direction that points up at each rest, within `level_sd` (rad).
    vertical_sd : float or None
        Standard deviation (rad) of the tilt between the laboratory's z and the vertical; None: unknown.
    s_rot : float or None
        Fixes s_rot (rad) instead of estimating it.
    """

    R0: Array | None = None
    up: Array | None = None
    level_sd: float = np.radians(1.0)
    vertical_sd: float | None = None
    s_rot: float | None = None


@dataclass(frozen=True)
class _State:
    A: dict[Kind, Array]
    B: dict[Kind, Array]
    u: dict[Kind, Array]
    R: Array


@dataclass(frozen=True)
class JointFit:
    """The estimate; `covariance[kind]` (12, 12) is that of (H row by row, then B).

    `mag_acc` (12, 12) or None: the magnetometer's (H, B) against the accelerometer's. They share the attitudes, hence
    their errors, which is what a heading's error depends on.
    """

    H: dict[Kind, Array]
    B: dict[Kind, Array]
    u: dict[Kind, Array]
    covariance: dict[Kind, Array]
    R: Array
    component: dict[str, float]
    redundancy: dict[str, float]
    residual: dict[Kind, Array]
    deletion: dict[str, Array]
    shift: dict[Kind, Array]
    s_rot: float | None
    state: _State
    inverse: Array
    cost: float
    dof: float
    n_iter: int
    converged: bool
    mag_acc: Array | None = None


@dataclass(frozen=True)
class _Layout:
    """Where each unknown stands in the parameter vector."""

    size: int
    A: dict[Kind, slice]
    B: dict[Kind, slice]
    u: dict[Kind, slice]
    R: Index  # (J, 3) columns
    mask: dict[Kind, Index] = field(default_factory=dict)  # entries of A (or of the gyroscope's H) that are free


@dataclass(frozen=True)
class _Data:
    triads: Mapping[Kind, Triad]
    gyro: Gyro | None
    priors: Priors
    layout: _Layout


@dataclass(frozen=True)
class _Block:
    """Whitened residuals of one kind (before their component) and their Jacobian."""

    name: str
    r: Array
    J: Array
    rest: Index  # the rest (or turn) that each row belongs to


def joint_fit(
    triads: Mapping[Kind, Triad],
    gyro: Gyro | None,
    R: Array,
    priors: Priors,
    *,
    components: Mapping[str, float] | None = None,
    estimate_components: bool = True,
    max_iter: int = 60,
    tol: float = 1e-4,
) -> JointFit:
    """Maximum-likelihood fit of all sensors and attitudes.

    Parameters
    ----------
    triads : mapping from 'acc', 'mag' to Triad
    gyro : Gyro or None
    R : ndarray (J, 3, 3)
        Start of the attitudes, R_nh.
    priors : Priors
    components : mapping, optional
        Start of the variance components (factors on the standard deviations), by name: 'acc', 'mag', 'gyr',
        'turn', 'rot'.
    estimate_components : bool
        Whether they are estimated (restricted maximum likelihood) or kept.
    max_iter : int
    tol : float
        Converged when no unknown moves by more than this many of its standard deviations and no component by
        more than `COMPONENT_TOL` of itself.

    Returns
    -------
    JointFit
    """
    layout = _lay_out(triads, gyro, len(R))
    data = _Data(triads, gyro, priors, layout)
    scale = dict(components or {})
    if priors.s_rot is not None:
        scale["rot"] = priors.s_rot
    state = _start(triads, gyro, R)
    blocks = _blocks(data, state)
    converged, settled, n_iter = False, not estimate_components, 0
    while not converged and n_iter < max_iter:
        n_iter += 1
        N, g, parts = _normal(blocks, scale, layout.size)
        inverse = _inverse(N, layout.R)
        state, blocks, step = _damped(data, state, blocks, scale, inverse @ g)
        moved = np.max(np.abs(step) / np.sqrt(np.maximum(np.diag(inverse), 1e-300)), initial=0.0)
        changed = 0.0
        if not settled and moved < 1.0:
            scale, changed = _update_components(blocks, scale, inverse, parts, priors)
            # two components that trade off creep for ever; once they are settled the unknowns converge at once
            settled = changed < COMPONENT_TOL and moved < 0.1
        converged = bool(moved < tol and changed < COMPONENT_TOL)
    return _result(data, state, blocks, scale, n_iter, converged)


# --- unknowns ----------------------------------------------------------------------------------------


def _lay_out(triads: Mapping[Kind, Triad], gyro: Gyro | None, n_rests: int) -> _Layout:
    at = 0
    A: dict[Kind, slice] = {}
    B: dict[Kind, slice] = {}
    u: dict[Kind, slice] = {}
    mask: dict[Kind, Index] = {}
    kinds: list[tuple[Kind, bool]] = [(k, t.triangular) for k, t in triads.items()]
    if gyro is not None:
        kinds.append(("gyr", False))
    for kind, triangular in kinds:
        free = np.triu(np.ones((3, 3), dtype=bool)) if triangular else np.ones((3, 3), dtype=bool)
        mask[kind] = np.flatnonzero(free)
        A[kind] = slice(at, at := at + len(mask[kind]))
        B[kind] = slice(at, at := at + 3)
    for kind, triad in triads.items():
        if triad.u_free:
            u[kind] = slice(at, at := at + 2)
    R = at + np.arange(3 * n_rests).reshape(n_rests, 3)
    return _Layout(at + 3 * n_rests, A, B, u, R, mask)


def _start(triads: Mapping[Kind, Triad], gyro: Gyro | None, R: Array) -> _State:
    A: dict[Kind, Array] = {k: t.A for k, t in triads.items()}
    B: dict[Kind, Array] = {k: t.B for k, t in triads.items()}
    if gyro is not None:
        A["gyr"], B["gyr"] = gyro.H, gyro.B
    return _State(A, B, {k: t.u for k, t in triads.items()}, R)


def _moved(layout: _Layout, state: _State, step: Array) -> _State:
    A, B, u = dict(state.A), dict(state.B), dict(state.u)
    for kind in A:
        flat = A[kind].ravel().copy()
        flat[layout.mask[kind]] += step[layout.A[kind]]
        A[kind], B[kind] = flat.reshape(3, 3), B[kind] + step[layout.B[kind]]
    for kind, where in layout.u.items():
        u[kind] = so3.exp(_tangent(u[kind]) @ step[where]) @ u[kind]
    return _State(A, B, u, state.R @ so3.exp(step[layout.R]))


def _tangent(u: Array) -> Array:
    """Two unit vectors across `u`, as columns (3, 2)."""
    return np.linalg.svd(u[None, :])[2][1:].T


# --- residuals ---------------------------------------------------------------------------------------


def _blocks(data: _Data, state: _State) -> list[_Block]:
    triads, gyro, priors, layout = data.triads, data.gyro, data.priors, data.layout
    blocks = [_triad_block(kind, triad, layout, state) for kind, triad in triads.items()]
    if gyro is not None:
        blocks.append(_gyro_rest_block(gyro, layout, state))
        if len(gyro.turns):
            blocks.append(_turn_block(gyro, layout, state))
    if priors.R0 is not None:
        blocks.append(_attitude_block(priors.R0, layout, state))
    if priors.up is not None:
        blocks.append(_level_block(priors.up, priors.level_sd, layout, state))
    if priors.vertical_sd is not None and "acc" in layout.u:
        blocks.append(_vertical_block(priors.vertical_sd, layout, state))
    return [b for b in blocks if len(b.r)]


def _triad_block(kind: Kind, triad: Triad, layout: _Layout, state: _State) -> _Block:
    """(i): (y - B - A R^T u) / se."""
    rest = np.flatnonzero(np.isfinite(triad.y).all(axis=1))
    A, u = state.A[kind], state.u[kind]
    R = state.R[rest]
    v = np.einsum("jba,b->ja", R, u)  # R^T u
    w = 1 / triad.se[rest]
    r = w * (triad.y[rest] - state.B[kind] - v @ A.T)
    J = np.zeros((len(rest), 3, layout.size))
    mask = layout.mask[kind]
    for column, entry in zip(range(layout.A[kind].start, layout.A[kind].stop), mask):
        row, col = divmod(int(entry), 3)
        J[:, row, column] = -v[:, col]
    J[:, :, layout.B[kind]] = -np.eye(3)
    # R <- R exp(d): R^T u changes by (R^T u) x d
    _put(J, layout.R[rest], -A @ so3.skew(v))
    if kind in layout.u:
        # u changes by t x u for the small rotation t = T p
        change = np.einsum("jba,bc->jac", R, -so3.skew(u) @ _tangent(u))
        J[:, :, layout.u[kind]] = -A @ change
    J *= w[:, :, None]
    return _Block(kind, r.ravel(), J.reshape(-1, layout.size), np.repeat(rest, 3))


def _gyro_rest_block(gyro: Gyro, layout: _Layout, state: _State) -> _Block:
    """(ii): (y - B_g) / se."""
    rest = np.flatnonzero(np.isfinite(gyro.y).all(axis=1))
    w = 1 / gyro.se[rest]
    J = np.zeros((len(rest), 3, layout.size))
    J[:, :, layout.B["gyr"]] = -w[:, :, None] * np.eye(3)
    r = w * (gyro.y[rest] - state.B["gyr"])
    return _Block("gyr", r.ravel(), J.reshape(-1, layout.size), np.repeat(rest, 3))


def _turn_block(gyro: Gyro, layout: _Layout, state: _State) -> _Block:
    """(iii): log(dR^T R_before^T R_after), whitened by the noise of the integration."""
    H, B = state.A["gyr"], state.B["gyr"]
    pre = preintegrate(gyro.turns.y, gyro.turns.dt, H, B, gyro.noise_sd)
    back = np.swapaxes(pre.dR, -1, -2)
    r = so3.log(back @ np.swapaxes(state.R[gyro.before], -1, -2) @ state.R[gyro.after])
    left, right = so3.left_jacobian_inverse(r), so3.left_jacobian_inverse(-r)
    J = np.zeros((len(r), 3, layout.size))
    J[:, :, layout.A["gyr"]] = -left @ pre.J_H
    J[:, :, layout.B["gyr"]] = -left @ pre.J_B
    _put(J, layout.R[gyro.before], -left @ back)
    _put(J, layout.R[gyro.after], right)
    C = pre.C + _turn_variance(gyro.turns, H, B)[:, None, None] * np.eye(3)
    W = np.linalg.inv(np.linalg.cholesky(C))
    r, J = np.einsum("tij,tj->ti", W, r), W @ J
    turn = np.arange(len(r)) if gyro.weight is None else np.flatnonzero(gyro.weight)
    return _Block("turn", r[turn].ravel(), J[turn].reshape(-1, layout.size), np.repeat(turn, 3))


def _turn_variance(turns: TurnBatch, H: Array, B: Array) -> Array:
    """Variance (T,), rad^2, of integrated turns beside the white noise: a share of the angle turned, and what
    happens between samples, for which the second differences of the rate are the measure (a clattering box shakes
    faster than it is sampled)."""
    u = (turns.y - B) @ H.T
    inside = turns.dt[:, 1:-1] > 0
    bend = np.linalg.norm(u[:, :-2] - 2 * u[:, 1:-1] + u[:, 2:], axis=-1) * turns.dt[:, 1:-1] * inside
    angle = np.sum(np.linalg.norm(u, axis=-1) * turns.dt, axis=-1)
    return (ANGLE_ERROR * angle) ** 2 + SAMPLING_ERROR**2 * np.sum(bend**2, axis=-1)


def _attitude_block(R0: Array, layout: _Layout, state: _State) -> _Block:
    """(iv): log(R0^T R), in units of rad (its component is s_rot); rests whose R0 is NaN have none."""
    rest = np.flatnonzero(np.isfinite(R0).all(axis=(1, 2)))
    r = so3.log(np.swapaxes(R0[rest], -1, -2) @ state.R[rest])
    J = np.zeros((len(r), 3, layout.size))
    _put(J, layout.R[rest], so3.left_jacobian_inverse(-r))
    return _Block("rot", r.ravel(), J.reshape(-1, layout.size), np.repeat(rest, 3))


def _level_block(up: Array, level_sd: float, layout: _Layout, state: _State) -> _Block:
    """(v): components of R^T z across the housing direction that is up, over level_sd."""
    rest = np.flatnonzero(np.isfinite(up).all(axis=1))
    v = state.R[rest, 2, :]  # R^T z
    across = np.stack([_tangent(c).T for c in up[rest]])  # (J, 2, 3)
    turned = so3.skew(v)  # dv for a small rotation of R
    x, dx = np.einsum("jkc,jc->jk", across, v), across @ turned
    # as an angle, up to 180 degrees: a face taken for its opposite must not look level
    n, c = np.linalg.norm(x, axis=1), np.sum(v * up[rest], axis=1)
    safe, angle = np.maximum(n, 1e-9), np.arctan2(n, c)
    f = np.where(n > 1e-9, angle / safe, 1.0)
    dn = np.einsum("jk,jkc->jc", x, dx) / safe[:, None]
    dc = np.einsum("jk,jkc->jc", up[rest], turned)
    df = (c[:, None] * dn - n[:, None] * dc - f[:, None] * dn) / safe[:, None]
    r = f[:, None] * x / level_sd
    J = np.zeros((len(r), 2, layout.size))
    _put(J, layout.R[rest], (f[:, None, None] * dx + x[:, :, None] * df[:, None, :]) / level_sd)
    return _Block("level", r.ravel(), J.reshape(-1, layout.size), np.repeat(rest, 2))


def _vertical_block(sd: float, layout: _Layout, state: _State) -> _Block:
    """(vi): horizontal components of the direction of u_acc, over sd."""
    u = state.u["acc"]
    J = np.zeros((2, layout.size))
    J[:, layout.u["acc"]] = (-so3.skew(u) @ _tangent(u))[:2] / (np.linalg.norm(u) * sd)
    return _Block("vertical", u[:2] / (np.linalg.norm(u) * sd), J, np.zeros(2, dtype=int))


def _put(J: Array, columns: Index, values: Array) -> None:
    """``J[i, :, columns[i]] += values[i]`` for the three columns of each rest or turn i."""
    i = np.arange(len(J))
    for k in range(3):
        J[i, :, columns[:, k]] += values[:, :, k]


# --- normal equations and variance components --------------------------------------------------------


def _sigma(name: str, scale: Mapping[str, float]) -> float:
    return scale.get(name, FIRST_S_ROT if name == "rot" else 1.0)


def _normal(blocks: Sequence[_Block], scale: Mapping[str, float], size: int) -> tuple[Array, Array, dict[str, Array]]:
    parts = {b.name: b.J.T @ b.J / _sigma(b.name, scale) ** 2 for b in blocks}
    g = np.zeros(size)
    for b in blocks:
        g -= b.J.T @ b.r / _sigma(b.name, scale) ** 2
    return np.sum(list(parts.values()), axis=0), g, parts


def _inverse(N: Array, angles: Index) -> Array:
    """Pseudo-inverse of the scaled normal matrix: undetermined (gauge) directions stay where they are.

    `angles` are the columns of the rests' attitudes. All have one unit, so one that is nothing but rounding (a heading
    that nobody knows, about a housing axis that points up exactly) must not be scaled up to look determined.
    """
    d = np.sqrt(np.maximum(np.diag(N), 1e-300))
    d[angles] = np.maximum(d[angles], 1e-6 * np.max(d[angles], initial=0.0))
    values, vectors = np.linalg.eigh(N / np.outer(d, d))
    good = values > 1e-12 * values[-1]
    scaled = vectors[:, good] / d[:, None]
    return (scaled / values[good]) @ scaled.T


def _cost(blocks: Sequence[_Block], scale: Mapping[str, float]) -> float:
    return float(sum(b.r @ b.r / _sigma(b.name, scale) ** 2 for b in blocks))


def _damped(
    data: _Data, state: _State, blocks: list[_Block], scale: Mapping[str, float], step: Array
) -> tuple[_State, list[_Block], Array]:
    """The full step, halved while it raises the cost."""
    before = _cost(blocks, scale)
    for _ in range(8):
        trial = _moved(data.layout, state, step)
        after = _blocks(data, trial)
        if _cost(after, scale) <= before * (1 + 1e-9) + 1e-12:
            return trial, after, step
        step = step / 2
    return state, blocks, np.zeros_like(step)


def _update_components(
    blocks: Sequence[_Block],
    scale: dict[str, float],
    inverse: Array,
    parts: Mapping[str, Array],
    priors: Priors,
) -> tuple[dict[str, float], float]:
    """sigma^2 <- v^T P v / redundancy for every component that the data can tell."""
    new, changed = dict(scale), 0.0
    fixed = {"vertical"} | ({"rot"} if priors.s_rot is not None else set())
    for b in blocks:
        if b.name in fixed:
            continue
        redundancy = _redundancy(b, inverse, parts)
        if redundancy < (LEVEL_REDUNDANCY if b.name == "level" else MIN_REDUNDANCY):
            continue
        # few residuals tell little: what the scatter within the rests says counts as `PRIOR_DOF` of them
        told = 0.0 if b.name in ("rot", "level") else PRIOR_DOF
        sigma = float(np.sqrt((b.r @ b.r + told) / (redundancy + told)))
        sigma = max(sigma, FLOOR.get(b.name, 0.7))
        changed = max(changed, abs(sigma / _sigma(b.name, scale) - 1))
        new[b.name] = sigma
    return new, changed


def _redundancy(block: _Block, inverse: Array, parts: Mapping[str, Array]) -> float:
    return len(block.r) - float(np.sum(inverse * parts[block.name]))


def predicted_misfit(
    fit: JointFit, triads: Mapping[Kind, Triad], gyro: Gyro | None, priors: Priors, name: str, index: int
) -> tuple[float, float]:
    """How far one rest's (or turn's) readings are from what a fit without them predicts.

    Parameters
    ----------
    fit : JointFit
        Made without these rows; `triads`, `gyro`, `priors` hold them.
    name : {'acc', 'mag', 'rot', 'turn'}
    index : int, of the rest or turn

    Returns
    -------
    chi2 : float
        3 degrees of freedom, with the uncertainty of rows and prediction.
    size : float
        Length of the misfit: of a reading relative to its magnitude, of an attitude or a turn in rad.
    """
    layout = _lay_out(triads, gyro, len(fit.R))
    blocks = {b.name: b for b in _blocks(_Data(triads, gyro, priors, layout), fit.state)}
    block, sigma = blocks[name], fit.component.get(name, 1.0)
    rows = block.rest == index
    r, J = block.r[rows] / sigma, block.J[rows] / sigma
    S = np.eye(len(r)) + J @ fit.inverse @ J.T
    chi2 = float(r @ np.linalg.solve(S, r))
    if name in triads:
        kind: Kind = "acc" if name == "acc" else "mag"
        off = block.r[rows] * triads[kind].se[index]
        return chi2, float(np.linalg.norm(fit.H[kind] @ off) / np.linalg.norm(fit.u[kind]))
    if name == "turn":
        assert gyro is not None
        dR = integrate(gyro.turns.y[index], gyro.turns.dt[index], fit.H["gyr"], fit.B["gyr"])
        net = fit.R[gyro.before[index]].T @ fit.R[gyro.after[index]]
        return chi2, float(so3.angle_between(dR, net))
    if name == "level":
        assert priors.up is not None
        return chi2, float(np.arccos(np.clip(fit.R[index][2] @ priors.up[index], -1.0, 1.0)))
    return chi2, float(np.linalg.norm(block.r[rows]))


# --- result ------------------------------------------------------------------------------------------


def _result(
    data: _Data, state: _State, blocks: list[_Block], scale: dict[str, float], n_iter: int, converged: bool
) -> JointFit:
    triads, gyro, layout = data.triads, data.gyro, data.layout
    N, _, parts = _normal(blocks, scale, layout.size)
    inverse = _inverse(N, layout.R)
    H: dict[Kind, Array] = {}
    covariance: dict[Kind, Array] = {}
    residual: dict[Kind, Array] = {}
    for kind in triads:
        H[kind] = np.asarray(np.linalg.inv(state.A[kind]), dtype=np.float64)
        covariance[kind] = _model_covariance(layout, inverse, kind, H[kind])
        v = np.einsum("jba,b->ja", state.R, state.u[kind])
        off = (triads[kind].y - state.B[kind]) @ H[kind].T - v
        residual[kind] = np.linalg.norm(off, axis=-1)
    if gyro is not None:
        H["gyr"] = state.A["gyr"]
        covariance["gyr"] = _model_covariance(layout, inverse, "gyr", H["gyr"])
        dR = integrate(gyro.turns.y, gyro.turns.dt, H["gyr"], state.B["gyr"])
        net = np.swapaxes(state.R[gyro.before], -1, -2) @ state.R[gyro.after]
        counted = np.ones(len(net)) if gyro.weight is None else gyro.weight
        residual["gyr"] = np.where(counted > 0, so3.angle_between(dR, net), np.nan)
    redundancy = {b.name: _redundancy(b, inverse, parts) for b in blocks}
    return JointFit(
        H=H,
        B=dict(state.B),
        u=dict(state.u),
        covariance=covariance,
        R=state.R,
        component={b.name: _sigma(b.name, scale) for b in blocks},
        redundancy=redundancy,
        residual=residual,
        deletion={b.name: _deletion(b, _sigma(b.name, scale), inverse) for b in blocks},
        s_rot=_sigma("rot", scale) if data.priors.R0 is not None else None,
        shift=_shifts(layout, blocks, scale, inverse, H),
        state=state,
        inverse=inverse,
        cost=_cost(blocks, scale),
        dof=float(sum(redundancy.values())),
        n_iter=n_iter,
        converged=converged,
        mag_acc=_between(layout, inverse, "mag", "acc", H) if {"acc", "mag"} <= triads.keys() else None,
    )


def _columns(layout: _Layout, kind: Kind) -> Index:
    return np.r_[layout.A[kind], layout.B[kind]]


def _to_model(layout: _Layout, kind: Kind, H: Array) -> Array:
    """Derivatives (12, n) of (H row by row, then B) by the sensor's unknowns: dH = -H dA H; the gyroscope's are H."""
    n = len(layout.mask[kind])
    to = np.zeros((12, n + 3))
    full = np.eye(9) if kind == "gyr" else -np.kron(H, H.T)
    to[:9, :n] = full[:, layout.mask[kind]]
    to[9:, n:] = np.eye(3)
    return to


def _model_covariance(layout: _Layout, inverse: Array, kind: Kind, H: Array) -> Array:
    """Covariance (12, 12) of (H row by row, then B)."""
    columns, to = _columns(layout, kind), _to_model(layout, kind, H)
    C = to @ inverse[np.ix_(columns, columns)] @ to.T
    return (C + C.T) / 2


def _between(layout: _Layout, inverse: Array, one: Kind, other: Kind, H: Mapping[Kind, Array]) -> Array:
    """Covariance (12, 12) of one sensor's (H, B) with another's."""
    C = inverse[np.ix_(_columns(layout, one), _columns(layout, other))]
    return _to_model(layout, one, H[one]) @ C @ _to_model(layout, other, H[other]).T


def _shifts(
    layout: _Layout,
    blocks: Sequence[_Block],
    scale: Mapping[str, float],
    inverse: Array,
    H: Mapping[Kind, Array],
) -> dict[Kind, Array]:
    """How far (H row by row, B) of each sensor moves when a rest is left out, (J, 12), to first order: with the
    rest's rows J_j, r_j the unknowns move by ``N^-1 J_j^T (I - J_j N^-1 J_j^T)^-1 r_j``."""
    n = len(layout.R)
    moved = np.zeros((n, layout.size))
    at_rest = [b for b in blocks if b.name in ("acc", "mag", "rot", "level")]
    for j in range(n):
        rows = [(b, b.rest == j, _sigma(b.name, scale)) for b in at_rest]
        r = np.concatenate([b.r[k] / s for b, k, s in rows])
        J = np.concatenate([b.J[k] / s for b, k, s in rows])
        values, vectors = np.linalg.eigh(np.eye(len(r)) - J @ inverse @ J.T)
        along = np.where(values > CHECKABLE, (vectors.T @ r) / np.maximum(values, CHECKABLE), 0.0)
        moved[j] = inverse @ J.T @ (vectors @ along)
    return {kind: moved[:, _columns(layout, kind)] @ _to_model(layout, kind, H[kind]).T for kind in H}


def _deletion(block: _Block, sigma: float, inverse: Array) -> Array:
    """By how much the cost falls without each rest's (or turn's) rows of this block: chi-square with as many
    degrees of freedom as there are rows. ``r^T (I - J N^-1 J^T)^-1 r``, exact for the linear problem."""
    out = np.full(int(block.rest.max()) + 1, np.nan)
    rows = int(np.sum(block.rest == block.rest[0]))
    r, J = block.r.reshape(-1, rows) / sigma, block.J.reshape(-1, rows, block.J.shape[1]) / sigma
    left = np.eye(rows) - J @ inverse @ np.swapaxes(J, -1, -2)
    # a row that alone determines an unknown has nothing to be checked by: its direction is skipped
    values, vectors = np.linalg.eigh(left)
    along = np.einsum("jab,ja->jb", vectors, r)
    out[block.rest[::rows]] = np.sum(
        np.where(values > CHECKABLE, along**2 / np.maximum(values, CHECKABLE), 0.0), axis=1
    )
    return out
