"""R-BSN: calibration of a sensor node against motion capture, in the paper's order, with its contradictions resolved.

Rüschen, Misgeld, Kim, Leonhardt, "A Novel Algorithm for the Calibration of Inertial/Magnetic Sensors: Application to
a Body Sensor Network", section 4, equations (12)-(20).

============  ===========  ======================================================================  =========
name here     paper        meaning                                                                 shape
============  ===========  ======================================================================  =========
b_w           b_omega      bias of the gyroscope, raw                                              (3,)
gyr           Omega*^T     raw gyroscope at the optics' times; without b_w: Omega^T                (N, 3)
acc, mag      A*^T, M*^T   raw accelerometer and magnetometer at the optics' times                 (N, 3)
w_ref         Omega_ref^T  angular rate of the marker body in its own axes                         (N, 3)
R             C(q)         R_mk: takes marker-body components to the laboratory                    (N, 3, 3)
T             T            takes Omega to Omega_ref                                                (3, 3)
C_b           C^b          R_kh: takes node components to the marker body                          (3, 3)
K_rbsn        K_a, K_m     takes A, M (already turned by C^b) to the marker body                   (3, 3)
f_m, h_m      g^n, h^n     specific force at rest and field, in the laboratory                     (3,)
G, H_ref      G^T, H^T     f_m and h_m in the marker body                                          (N, 3)
============  ===========  ======================================================================  =========

What had to be mended:

* (14): ``w = 2 q+ q'``; as printed the rate is in the laboratory's axes (see `reference_rates`).
* (16), (17): a conjugated quaternion or a mirrored triad gives det T < 0, and the polar decomposition would hide it in
  K: the sign of the determinant is looked at.
* (18) turns the wrong way, and needs C^n, which nothing in the paper defines: ``G_i = R_i^T f_m``, with f_m and h_m
  estimated from the moved trial (`laboratory_vector`).
* (19), (20): K_a and K_m act behind C^b; the node's own matrix is ``C^bT K C^b``. The frame is therefore the one in
  which the gyroscope's K is symmetric.
* (9) is the forward model, (16) and (20) are its inverse. What is returned is u = H (y - B).

What cannot be mended within the method: linear acceleration is in the regressor A of (20), so that K_a comes out too
small (4-6 % at 1.5 m/s^2 rms) whatever the norm and whatever the gate. `mocap_fit` does it otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from margcal.core import lsq, so3
from margcal.core.errors import DataError, UsageError
from margcal.core.lad import least_absolute, least_lengths
from margcal.core.types import Array, Fit, Issue, Kind, Mask, SensorModel
from margcal.core.units import STANDARD_GRAVITY

CITES = "Rüschen et al., R-BSN, section 4, (12)-(20)"
GATE = 0.1
"""epsilon of the gate on | |a| / g - 1 |; "sufficiently high", the paper says."""
LEAST_SAMPLES = 100
MOST_SAMPLES = 30000
BLOCKS = 40
BATCHES = 200
"""Parts of the recording whose scores are taken as independent (covariance of the L1 fits)."""

Norm = Literal["l1", "lengths"]


@dataclass(frozen=True)
class RBsn:
    """What the method gives.

    Attributes
    ----------
    fits : dict of Fit
        In the frame `gyr-symmetric`.
    T, C_b : ndarray (3, 3)
        (16) and (17); C_b is R_kh.
    T_covariance : ndarray (9, 9)
        Of T row by row.
    f_m, h_m : ndarray (3,) or None
        Specific force at rest (m/s^2) and field in the laboratory.
    gated : float
        Share of the samples that the gate let pass.
    mirrored : {'x', 'y', 'z'} or None
        Axis of the gyroscope that was taken for mirrored (det T < 0 and nothing else to say for it).
    """

    fits: dict[Kind, Fit]
    T: Array
    C_b: Array
    T_covariance: Array
    f_m: Array | None
    h_m: Array | None
    gated: float
    mirrored: str | None = None


def r_bsn(
    w_ref: Array,
    R: Array,
    gyr: Array,
    acc: Array | None = None,
    mag: Array | None = None,
    *,
    b_w: Array | None = None,
    gravity: float = STANDARD_GRAVITY,
    field: float = 1.0,
    epsilon: float | None = GATE,
    norm: Norm = "l1",
    f_m: Array | None = None,
    h_m: Array | None = None,
    units: dict[Kind, tuple[str, str]] | None = None,
    allow_mirrored: bool = False,
) -> RBsn:
    """Calibrate a node against the attitudes of the marker body that it is fixed to.

    Parameters
    ----------
    w_ref : ndarray (N, 3), rad/s
        (14), (15); NaN where the body was not seen.
    R : ndarray (N, 3, 3)
        R_mk.
    gyr, acc, mag : ndarray (N, 3), raw unit
        Readings at the optics' times; NaN where there is none.
    b_w : ndarray (3,), raw unit, optional
        From the trial at rest, (12). Without one it is the constant of a fit of (16).
    gravity : float, m/s^2
    field : float, uT (or 1: `norm`)
    epsilon : float or None
        Of the gate in (20); None: no gate.
    norm : {'l1', 'lengths'}
        Of (20): entrywise, or the sum of the residuals' lengths, which does not depend on the choice of axes.
    f_m, h_m : ndarray (3,), optional
        Specific force at rest and field in the laboratory (only their directions count), where they are known.
    units : dict kind -> (raw unit, calibrated unit), optional
    allow_mirrored : bool
        Take det T < 0 for a mirrored gyroscope instead of refusing it.

    Raises
    ------
    DataError
        Too few samples, too little rotation, or det T < 0.
    """
    if norm not in ("l1", "lengths"):
        raise UsageError(f"norm {norm!r} is none of l1, lengths")
    names = units or {}
    moved = np.isfinite(gyr).all(axis=1) & np.isfinite(w_ref).all(axis=1)
    if moved.sum() < LEAST_SAMPLES:
        raise DataError(f"only {int(moved.sum())} samples were seen by gyroscope and reference both; record more")
    if b_w is None:
        b_w = _constant(gyr[moved], w_ref[moved])
    Omega = gyr - b_w  # (12), (13)
    T, T_covariance, left = _rates_fit(Omega[moved], w_ref[moved])  # (14)-(16)
    C_b, K_w, mirrored = polar_split(T, allow_mirrored)  # (17)
    raw, unit = names.get("gyr", ("count", "rad/s"))
    model = SensorModel("gyr", K_w, b_w, raw, unit, residual_rms=_rms(left), method="r-bsn")
    residual = np.full(len(gyr), np.nan)
    residual[moved] = np.linalg.norm(left, axis=1)
    fits: dict[Kind, Fit] = {"gyr": Fit(model, residual, float(np.sum(left**2)), "r-bsn", CITES, rank=9)}
    found: dict[Kind, Array] = {}
    share = 1.0
    both: tuple[tuple[Kind, Array | None, float, Array | None], ...]
    both = (("acc", acc, gravity, f_m), ("mag", mag, field, h_m))
    for kind, y, size, known in both:
        if y is None:
            continue
        raw, unit = names.get(kind, ("count", "m/s^2" if kind == "acc" else "norm"))
        use: Mask = np.logical_and(np.isfinite(y).all(axis=1), np.isfinite(R).all(axis=(1, 2)))
        v = known if known is not None else laboratory_vector(y[use], R[use], C_b)
        v = v * (size / np.linalg.norm(v))
        found[kind] = v
        fit, passed = _affine(kind, y, R, v, C_b, use, epsilon if kind == "acc" else None, norm, (raw, unit))
        share = passed if kind == "acc" else share
        fits[kind] = fit
    return RBsn(fits, T, C_b, T_covariance, found.get("acc"), found.get("mag"), share, mirrored)


def _constant(gyr: Array, w_ref: Array) -> Array:
    """# not in the paper: without a trial at rest, b_w is where the line of (16) with a constant crosses zero."""
    X = np.column_stack([gyr, np.ones(len(gyr))])
    scale = lsq.column_scales(X)
    x = np.linalg.lstsq(X / scale, w_ref, rcond=None)[0] / scale[:, None]
    return -np.linalg.solve(x[:3].T, x[3])


def _rates_fit(Omega: Array, w_ref: Array) -> tuple[Array, Array, Array]:
    """(16) in the Frobenius norm, the covariance of T by leaving out one stretch at a time, and the residual."""
    if np.linalg.cond(Omega.T @ Omega) > 1e8:
        text = "the gyroscope was turned about one or two axes only: T has no solution; turn the node about all axes"
        raise DataError(text, (Issue("one-axis-rotation", "fail", text, "gyr"),))
    parts = [(o.T @ o, o.T @ w) for o, w in zip(np.array_split(Omega, BLOCKS), np.array_split(w_ref, BLOCKS))]
    N, v = sum(p[0] for p in parts), sum(p[1] for p in parts)
    T: Array = np.asarray(np.linalg.solve(N, v).T, dtype=np.float64)  # (16)
    left = np.array([np.linalg.solve(N - P, v - q).T.ravel() for P, q in parts])
    off = left - left.mean(axis=0)
    return T, (BLOCKS - 1) / BLOCKS * off.T @ off, w_ref - Omega @ T.T


def polar_split(T: Array, allow_mirrored: bool = False) -> tuple[Array, Array, str | None]:
    """(17) ``T = C^b K_w``: a proper rotation and a symmetric matrix, and the axis that was taken for mirrored.

    # not in the paper: det T is looked at. Where it is negative and `allow_mirrored`, the axis is sought without whose
    # sign the gyroscope would lie nearest to the marker body's axes; its sign stays in K_w.

    Raises
    ------
    DataError
        If det T < 0 (a conjugated quaternion does this, or a mirrored axis), unless `allow_mirrored`.
    """
    if np.linalg.det(T) > 0:
        C_b, K_w = so3.polar(T)
        return C_b, K_w, None
    if not allow_mirrored:
        text = (
            f"det T is negative ({np.linalg.det(T):.3g}): the reference's quaternions are conjugated, or an axis of "
            "the gyroscope is mirrored"
        )
        raise DataError(text, (Issue("negative-determinant", "fail", text, "gyr", float(np.linalg.det(T)), 0.0),))
    flips = [np.diag(np.where(np.arange(3) == k, -1.0, 1.0)) for k in range(3)]
    split = [so3.polar(T @ F) for F in flips]
    k = int(np.argmax([np.trace(C) for C, _ in split]))
    return split[k][0], split[k][1] @ flips[k], "xyz"[k]


def laboratory_vector(y: Array, R: Array, C_b: Array) -> Array:
    """Direction of a vector that is constant in the laboratory, from raw readings of it in many attitudes.

    # not in the paper, which takes g^n and h^n for known although C^n is not: ``R_i (K y_i - b) = v`` is homogeneous
    # in K, b and v; its smallest singular vector. (R-BSN's static trial would leave v wrong by the sensor's own bias
    # and scale, 7 to 29 degrees.) The sign is the one that leaves K C_b^T with a positive determinant.

    Parameters
    ----------
    y : ndarray (N, 3), raw
    R : ndarray (N, 3, 3)
        R_mk.

    Returns
    -------
    ndarray (3,)
        Unit vector.
    """
    centre, scale = np.mean(y, axis=0), np.sqrt(np.mean(np.var(y, axis=0)))
    z = (y - centre) / scale
    M = np.zeros((15, 15))
    for part, turn in zip(np.array_split(z, 50), np.array_split(R, 50)):
        rows = np.concatenate(
            [
                np.einsum("nij,nk->nijk", turn, part).reshape(-1, 3, 9),
                -turn,
                np.broadcast_to(-np.eye(3), turn.shape),
            ],
            axis=2,
        ).reshape(-1, 15)
        M += rows.T @ rows
    values, vectors = np.linalg.eigh(M / len(y))
    if values[1] < 1e-10 * values[-1]:
        text = "the node was hardly turned: the laboratory's vertical and field cannot be told; turn it about all axes"
        raise DataError(text, (Issue("too-little-rotation", "fail", text),))
    x = vectors[:, 0]
    sign = np.sign(np.linalg.det(x[:9].reshape(3, 3) @ C_b.T))
    return sign * x[12:] / np.linalg.norm(x[12:])


def _affine(
    kind: Kind,
    y: Array,
    R: Array,
    v: Array,
    C_b: Array,
    use: Mask,
    epsilon: float | None,
    norm: Norm,
    units: tuple[str, str],
) -> tuple[Fit, float]:
    """(18)-(20) for one sensor, and the share of samples that passed the gate."""
    index = np.flatnonzero(use)
    index = index[:: max(1, len(index) // MOST_SAMPLES)]
    if len(index) < LEAST_SAMPLES:
        raise DataError(f"only {len(index)} samples were seen by sensor and reference both; record more")
    G = np.einsum("nji,j->ni", R[index], v)  # (18), corrected: R^T f_m
    A = y[index] @ C_b.T  # (19)
    passed = np.ones(len(index), dtype=bool)
    if epsilon is not None:
        size = np.linalg.norm(_in_gravities(A, G), axis=1) / np.linalg.norm(v)
        passed = np.abs(size - 1) < epsilon  # the gate of (20)
        if passed.sum() < LEAST_SAMPLES:
            passed[:] = True
    X = np.column_stack([A, -np.ones(len(A))])[passed]
    gap = np.full(3, np.nan)
    if norm == "l1":
        solved = least_absolute(X, G[passed])  # (20)
        x, cost, gap = solved.x, float(solved.cost.sum()), solved.gap
    else:
        x, cost = least_lengths(X, G[passed])
    left = G[passed] - X @ x
    K_rbsn, b = x[:3].T, x[3]
    H = C_b.T @ K_rbsn @ C_b
    B = np.linalg.solve(H, C_b.T @ b)
    C = _covariance(X, left, norm, C_b, H, B)
    model = SensorModel(kind, H, B, *units, covariance=C, residual_rms=_rms(left), method="r-bsn", reference_vector=v)
    residual = np.full(len(y), np.nan)
    residual[index[passed]] = np.linalg.norm(left, axis=1)
    fit = Fit(
        model,
        residual,
        cost,
        "r-bsn",
        CITES,
        u=v,
        covariance=C,
        condition=float(np.linalg.cond(X / lsq.column_scales(X))),
        details={"K_rbsn": K_rbsn, "b_rbsn": b, "gap": gap},
    )
    return fit, float(passed.mean())


def _in_gravities(A: Array, G: Array) -> Array:
    """# not in the paper, whose accelerometer reads g already: readings calibrated by least squares, for the gate."""
    X = np.column_stack([A, np.ones(len(A))])
    scale = lsq.column_scales(X)
    return X @ (np.linalg.lstsq(X / scale, G, rcond=None)[0] / scale[:, None])


def _rms(left: Array) -> float:
    return float(np.sqrt(np.mean(left**2)))


def _covariance(X: Array, left: Array, norm: Norm, C_b: Array, H: Array, B: Array) -> Array:
    """# not in the paper: covariance (12, 12) of (H, B) for given C^b and v, from sums of the scores over stretches of
    the recording (neighbouring residuals are of one motion, not independent)."""
    n = len(X)
    score = np.sign(left) if norm == "l1" else left / np.maximum(np.linalg.norm(left, axis=1, keepdims=True), 1e-300)
    curvature = np.zeros((12, 12))  # unknowns: column of x for each component, 4 entries each
    for k in range(3):
        block = slice(4 * k, 4 * k + 4)
        if norm == "l1":
            width = 0.5 * np.quantile(np.abs(left[:, k]), 0.6) + 1e-300
            density = np.mean(np.abs(left[:, k]) < width) / (2 * width)
            curvature[block, block] = 2 * density * X.T @ X
        else:
            weight = 1 / np.maximum(
                np.linalg.norm(left, axis=1), 1e-6 * np.median(np.linalg.norm(left, axis=1)) + 1e-300
            )
            curvature[block, block] = 2 / 3 * (X * weight[:, None]).T @ X
    sums = np.array(
        [
            np.concatenate([s[:, k] @ x for k in range(3)])
            for s, x in zip(np.array_split(score, min(BATCHES, n // 20)), np.array_split(X, min(BATCHES, n // 20)))
        ]
    )
    scale = np.sqrt(np.diag(curvature))
    inverse = np.linalg.inv(curvature / np.outer(scale, scale)) / np.outer(scale, scale)
    C = inverse @ (sums.T @ sums) @ inverse
    # (K row by row, b) from x, then H = C^bT K C^b, B = H^-1 C^bT b
    J = np.zeros((12, 12))
    turn = np.kron(C_b.T, C_b.T)
    for k in range(3):
        J[:9, 4 * k : 4 * k + 3] = turn[:, 3 * k : 3 * k + 3]
    inverse_H = np.linalg.inv(H)
    J[9:] = -inverse_H @ np.kron(np.eye(3), B[None, :]) @ J[:9]
    for k in range(3):
        J[9:, 4 * k + 3] += inverse_H @ C_b.T[:, k]
    return J @ C @ J.T
