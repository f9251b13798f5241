"""What a node's calibration would gain from one more rest: covariance, rest by rest, without any readings.

Not in the papers. The joint fit of `methods.joint` is linear near its solution, and a rest shares its attitude with
the readings at that rest and with the turns to its neighbours only. So the covariance of all parameters after one
more rest follows from the one before by a Kalman update: its state holds forward matrix A = H^-1 (gyroscope: H) and
bias of every sensor, the directions of gravity and field in the laboratory, and the attitude of the last rest. Run
over the rests of a recording it gives what the fit gives; run over attitudes that nobody has recorded yet, what the
fit will give.

=============  ==========================================================  ============
name here      meaning                                                     shape
=============  ==========================================================  ============
P              covariance of the state                                     (n, n)
R              R_nh of a rest                                              (..., 3, 3)
W              weights with  direction error^2 = trace(W C)                (12, 12)
=============  ==========================================================  ============
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from margcal.core import so3
from margcal.core.types import Array, Kind
from margcal.methods.joint import ANGLE_ERROR
from margcal.methods.uncertainty import sphere

UNKNOWN = 0.3
"""Relative standard deviation of a matrix that nobody has measured yet: far beyond any result."""
UNKNOWN_ANGLE = 1.0


@dataclass(frozen=True)
class Sensor:
    """One sensor as the plan takes it.

    Attributes
    ----------
    H, B : ndarray (3, 3), (3,)
    u : ndarray (3,)
        Its vector in the laboratory, calibrated unit (not used for a gyroscope).
    se : ndarray (3,)
        Standard error of its mean at a rest, raw unit.
    prior : ndarray (12, 12) or None
        Covariance of (H row by row, then B) from elsewhere than rests; None: unknown.
    triangular : bool
        Whether H is upper triangular (the sensor defines the frame).
    u_sd : float
        How well the direction of u is known beforehand, rad; 0: it is the vertical by definition.
    """

    kind: Kind
    H: Array
    B: Array
    u: Array
    se: Array
    prior: Array | None = None
    triangular: bool = False
    u_sd: float = 0.0

    @property
    def magnitude(self) -> float:
        return 1.0 if self.kind == "gyr" else float(np.linalg.norm(self.u))


@dataclass(frozen=True)
class Circumstances:
    """What is known of the attitudes beforehand, and how good a turn is.

    Attributes
    ----------
    s_rot : float or None
        Error of a known attitude about each axis, rad; None where attitudes are unknown.
    level_sd : float or None
        Error of a face that is up, rad, where only that is known.
    turn_se : ndarray (3,)
        Error of an integrated turn about each axis beside its share of the angle, rad.
    turn_s : float
        Duration of a turn, s.
    """

    s_rot: float | None = None
    level_sd: float | None = None
    turn_se: float = np.radians(0.1)
    turn_s: float = 2.0


@dataclass(frozen=True)
class Knowledge:
    """The covariance `P` after rests, the last of which had attitude `R` (3, 3); None before the first."""

    sensors: Mapping[Kind, Sensor]
    how: Circumstances
    P: Array
    R: Array | None

    def errors_deg(self) -> dict[Kind, float]:
        """Expected direction error of each sensor."""
        at, _ = _layout(self.sensors)
        weights = _weights(self.sensors).items()
        return {k: float(np.degrees(np.sqrt(max(np.sum(W * self.P[at[k], at[k]]), 0.0)))) for k, W in weights}


def beginning(sensors: Mapping[Kind, Sensor], how: Circumstances) -> Knowledge:
    """Nothing recorded yet."""
    at, size = _layout(sensors)
    P = np.zeros((size, size))
    for kind, sensor in sensors.items():
        where = at[kind]
        P[where, where] = _prior(sensor)
        if kind in ("acc", "mag"):
            direction = at[f"u_{kind}"]
            P[direction, direction] = sensor.u_sd**2 * np.eye(2)
    return Knowledge(sensors, how, P, None)


def after_rest(now: Knowledge, R: Array, *, turned: bool = True, read: Sequence[Kind] | None = None) -> Knowledge:
    """The knowledge after one more rest with attitude `R` (3, 3).

    Parameters
    ----------
    turned : bool
        Whether a usable turn leads there from the last rest.
    read : sequence of kind, optional
        Sensors that were read at it; default all that have no `prior` from elsewhere or will be read anew.
    """
    P = _updated(now, R, turned, tuple(now.sensors) if read is None else tuple(read))
    return replace(now, P=P, R=R)


def gain_of(now: Knowledge, candidates: Array) -> tuple[Array, dict[Kind, Array]]:
    """Expected direction variance (C,), summed over the sensors, after each candidate (C, 3, 3); and each sensor's."""
    big, PJ, S = _step(now, candidates, now.R is not None, tuple(now.sensors))
    solved = np.linalg.solve(S, np.swapaxes(PJ, 1, 2))
    at, _ = _layout(now.sensors)
    each: dict[Kind, Array] = {}
    for kind, W in _weights(now.sensors).items():
        where = at[kind]
        lost = np.sum((W @ PJ[:, where]) * np.swapaxes(solved[:, :, where], 1, 2), axis=(1, 2))
        each[kind] = np.maximum(np.sum(W * big[where, where]) - lost, 0.0)
    return np.sum(list(each.values()), axis=0), each


# --- state -------------------------------------------------------------------------------------------


def _layout(sensors: Mapping[Kind, Sensor]) -> tuple[dict[str, slice], int]:
    """Where each part of the state stands; the last three are the attitude of the last rest."""
    at: dict[str, slice] = {}
    n = 0
    for kind in sensors:
        at[kind] = slice(n, n := n + 12)
    for kind in sensors:
        if kind != "gyr":
            at[f"u_{kind}"] = slice(n, n := n + 2)
    at["rest"] = slice(n, n + 3)
    return at, n + 3


def _prior(sensor: Sensor) -> Array:
    """Covariance of (A, B), for a gyroscope of (H, B)."""
    if sensor.prior is not None:
        to = np.eye(12)
        if sensor.kind != "gyr":
            A = np.linalg.inv(sensor.H)
            to[:9, :9] = -np.kron(A, A.T)
        return to @ sensor.prior @ to.T
    M = sensor.H if sensor.kind == "gyr" else np.linalg.inv(sensor.H)
    size = float(np.cbrt(abs(np.linalg.det(M))))
    sd = np.full((3, 3), UNKNOWN * size)
    if sensor.triangular:
        sd = np.triu(sd)
    bias = 0.3 / size if sensor.kind == "gyr" else size * sensor.magnitude
    return np.diag(np.concatenate([sd.ravel(), np.full(3, bias)]) ** 2)


def _tangent(u: Array) -> Array:
    return np.linalg.svd(u[None, :])[2][1:].T


# --- update ------------------------------------------------------------------------------------------


def _updated(now: Knowledge, R: Array, turned: bool, read: tuple[Kind, ...]) -> Array:
    """P (n, n) after a rest at R (3, 3); the attitude of the rest before it is let go."""
    big, PJ, S = _step(now, R[None], turned, read)
    P = big - PJ[0] @ np.linalg.solve(S[0], PJ[0].T)
    n = len(now.P)
    keep = np.r_[0 : n - 3, n : n + 3]
    P = P[np.ix_(keep, keep)]
    return (P + P.T) / 2


def _step(now: Knowledge, R: Array, turned: bool, read: tuple[Kind, ...]) -> tuple[Array, Array, Array]:
    """P with the attitude of one more rest (n+3, n+3), and for each of R (C, 3, 3) P J^T and J P J^T + 1."""
    at, n = _layout(now.sensors)
    new = slice(n, n + 3)
    big = np.zeros((n + 3, n + 3))
    big[:n, :n] = now.P
    big[new, new] = UNKNOWN_ANGLE**2 * np.eye(3)
    rows = [_reading_rows(s, at, new, n + 3, R) for k, s in now.sensors.items() if k in read]
    if turned and now.R is not None and "gyr" in now.sensors:
        rows.append(_turn_rows(now, at, new, n + 3, R))
    rows += _attitude_rows(now.how, new, n + 3, R)
    if not rows:
        return big, np.zeros((len(R), n + 3, 0)), np.zeros((len(R), 0, 0))
    J = np.concatenate(rows, axis=1)
    m = J.shape[1]
    PJ = np.swapaxes((J.reshape(-1, n + 3) @ big).reshape(-1, m, n + 3), 1, 2)
    return big, PJ, J @ PJ + np.eye(m)


def _reading_rows(sensor: Sensor, at: Mapping[str, slice], new: slice, size: int, R: Array) -> Array:
    """Mean of one sensor at the rest, over its standard error: (C, 3, size)."""
    J = np.zeros((len(R), 3, size))
    where = at[sensor.kind]
    J[:, :, where.start + 9 : where.stop] = np.eye(3)
    if sensor.kind != "gyr":
        A = np.linalg.inv(sensor.H)
        v = np.einsum("cba,b->ca", R, sensor.u)
        for row in range(3):
            J[:, row, where.start + 3 * row : where.start + 3 * row + 3] = v
        J[:, :, new] = A @ so3.skew(v)
        turned = -so3.skew(sensor.u) @ _tangent(sensor.u)
        J[:, :, at[f"u_{sensor.kind}"]] = A @ (np.swapaxes(R, 1, 2) @ turned)
    return J / sensor.se[:, None]


def _turn_rows(now: Knowledge, at: Mapping[str, slice], new: slice, size: int, R: Array) -> Array:
    """The integrated turn against the two rests: about a fixed axis, at a constant rate."""
    gyr, how = now.sensors["gyr"], now.how
    assert now.R is not None
    dR = now.R.T @ R
    phi = so3.log(dR)
    bent = so3.right_jacobian(phi)
    raw = phi @ np.linalg.inv(gyr.H).T  # H^-1 phi: integral of y - B
    J = np.zeros((len(R), 3, size))
    start = at["gyr"].start
    for row in range(3):  # dH raw, row by row
        J[:, :, start + 3 * row : start + 3 * row + 3] = -bent[:, :, row, None] * raw[:, None, :]
    J[:, :, start + 9 : start + 12] = bent @ gyr.H * how.turn_s
    J[:, :, at["rest"]] = -np.swapaxes(dR, 1, 2)
    J[:, :, new] = np.eye(3)
    sd = np.hypot(how.turn_se, ANGLE_ERROR * np.linalg.norm(phi, axis=1))
    return J / sd[:, None, None]


def _attitude_rows(how: Circumstances, new: slice, size: int, R: Array) -> list[Array]:
    if how.s_rot is not None:
        J = np.zeros((len(R), 3, size))
        J[:, :, new] = np.eye(3) / how.s_rot
        return [J]
    if how.level_sd is not None:
        v = R[:, 2, :]  # R^T z
        across = np.stack([_tangent(c).T for c in v])
        J = np.zeros((len(R), 2, size))
        J[:, :, new] = across @ so3.skew(v) / how.level_sd
        return [J]
    return []


# --- what it means -----------------------------------------------------------------------------------


def direction_weight(kind: Kind, H: Array, magnitude: float) -> Array:
    """W (12, 12) with trace(W C) the mean square angle, rad^2, of `uncertainty.expected_error`."""
    u = sphere()
    z = magnitude * u @ np.linalg.inv(H).T
    L = np.zeros((len(u), 3, 12))
    for i in range(3):
        L[:, i, 3 * i : 3 * i + 3] = z
    if kind != "gyr":
        L[:, :, 9:] = -H
    across = np.eye(3) - u[:, :, None] * u[:, None, :]
    return np.einsum("nia,nij,njb->ab", L, across, L) / len(u) / magnitude**2


def _weights(sensors: Mapping[Kind, Sensor]) -> dict[Kind, Array]:
    """`direction_weight` of each sensor for its part of the state: (A, B), for a gyroscope (H, B)."""
    out: dict[Kind, Array] = {}
    for kind, sensor in sensors.items():
        W = direction_weight(kind, sensor.H, sensor.magnitude)
        if kind != "gyr":
            to = np.eye(12)
            to[:9, :9] = -np.kron(sensor.H, sensor.H.T)
            W = to.T @ W @ to
        out[kind] = (W + W.T) / 2
    return out
