"""Three sensors, each calibrated in the marker body's frame k, in one frame of the node (ours, after R-BSN (17)).

=============  ===============================================================================  =============
name here      meaning                                                                          shape
=============  ===============================================================================  =============
T              H of the gyroscope in k, the paper's T                                           (3, 3)
R_kh           C^b of (17), node to marker body: T = R_kh K_w with K_w symmetric                (3, 3)
R_nm           C^n, laboratory to earth (x east, y magnetic north, z up)                        (3, 3)
delta          small rotation: estimate of R_kh = R_kh exp(delta)                               (3,)
=============  ===============================================================================  =============

The frame h is *defined* by a symmetric K_w (`gyr-symmetric`). Its error belongs to every sensor's H, and covariances
here contain it, as if the sensors' fits were independent (they share the reference's noise, far below their own).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from margcal.core import so3
from margcal.core.errors import DataError
from margcal.core.types import Array, Fit, Issue, SensorModel


@dataclass(frozen=True)
class CommonFrame:
    """The node's frame and its sensors in it.

    Attributes
    ----------
    R_kh : ndarray (3, 3)
        Node to marker body (C^b); `marker_to_node` of the calibration file is its transpose.
    R_kh_covariance : ndarray (3, 3), rad^2
        Of delta about the node's axes; `R_kh_se` (3,) rad is the root of its diagonal.
    R_nm : ndarray (3, 3) or None
        Laboratory to earth (C^n); None without accelerometer or magnetometer.
    R_nm_se : ndarray (3,) rad or None
        About the earth's axes east, north, up.
    acc, gyr, mag : SensorModel or None
        In frame h, covariance (12, 12) with the frame's share; `reference_vector` in the laboratory.
    """

    R_kh: Array
    R_kh_covariance: Array
    gyr: SensorModel
    acc: SensorModel | None = None
    mag: SensorModel | None = None
    R_nm: Array | None = None
    R_nm_se: Array | None = None

    @property
    def R_kh_se(self) -> Array:
        return np.sqrt(np.diag(self.R_kh_covariance))

    @property
    def models(self) -> dict[str, SensorModel]:
        found = {"acc": self.acc, "gyr": self.gyr, "mag": self.mag}
        return {k: m for k, m in found.items() if m is not None}


def common_frame(gyr: Fit, acc: Fit | None = None, mag: Fit | None = None) -> CommonFrame:
    """All sensors in the frame in which the gyroscope's K is symmetric.

    Parameters
    ----------
    gyr, acc, mag : Fit
        Of `mocap_fit`, in the marker body's frame.

    Raises
    ------
    DataError
        If det T < 0: the gyroscope or the reference is mirrored (a conjugated quaternion does that, too).
    """
    T = gyr.model.H
    if np.linalg.det(T) < 0:
        text = (
            "gyroscope and reference differ in handedness (det T < 0): the reference's quaternions are conjugated, or "
            "an axis of gyroscope or reference is mirrored"
        )
        raise DataError(text, (Issue("mirrored-axes", "fail", text, "gyr", float(np.linalg.det(T)), 0.0),))
    R_kh, K = so3.polar(T)  #                                                                            (17)
    to_delta = _polar_derivative(R_kh, K)
    covariance = np.full((3, 3), np.nan)
    if gyr.covariance is not None:
        covariance = to_delta @ gyr.covariance[:9, :9] @ to_delta.T
    R_nm = se = None
    if acc is not None and mag is not None and acc.u is not None and mag.u is not None:
        R_nm = earth_from_laboratory(acc.u, mag.u)
        se = _earth_errors(R_nm, acc.u, mag.u, acc.details["joint"], mag.details["joint"])
    return CommonFrame(
        R_kh,
        covariance,
        _rotated(gyr.model, R_kh, gyr_derivative=to_delta),
        None if acc is None else _rotated(acc.model, R_kh, covariance),
        None if mag is None else _rotated(mag.model, R_kh, covariance),
        R_nm,
        se,
    )


def earth_from_laboratory(f: Array, h: Array) -> Array:
    """R_nm from the specific force at rest (up) and the field in the laboratory: rows east, north, up.

    Raises
    ------
    DataError
        If the field is vertical.
    """
    up = f / np.linalg.norm(f)
    flat = h - (h @ up) * up
    if np.linalg.norm(flat) < 1e-3 * np.linalg.norm(h):
        raise DataError("the magnetic field is vertical: there is no magnetic north to align the laboratory with")
    north = flat / np.linalg.norm(flat)
    return np.stack([np.cross(north, up), north, up])


def _polar_derivative(C: Array, K: Array) -> Array:
    """(3, 9): delta from dT row by row. dT = C ([delta]x K + dK), and [delta]x K + K [delta]x = [(tr K - K) delta]x."""
    # X = C^T dT; vee(X - X^T)_i = eps_ijk X_kj
    vee = np.zeros((3, 9))
    for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
        vee[i] = np.outer(C[:, k], np.eye(3)[j]).ravel() - np.outer(C[:, j], np.eye(3)[k]).ravel()
    return np.linalg.solve(np.trace(K) * np.eye(3) - K, vee)


def _rotated(
    model: SensorModel, C: Array, covariance: Array | None = None, gyr_derivative: Array | None = None
) -> SensorModel:
    """`model` in h: H_h = C^T H, dH_h = C^T dH - [delta]x H_h."""
    H = C.T @ model.H
    if gyr_derivative is not None:
        H = (H + H.T) / 2
    if model.covariance is None:
        return replace(model, H=H)
    J = np.eye(12)
    J[:9, :9] = np.kron(C.T, np.eye(3))
    turn = np.stack([(-so3.skew(e) @ H).ravel() for e in np.eye(3)], axis=1)  # (9, 3)
    if gyr_derivative is not None:
        J[:9, :9] += turn @ gyr_derivative
    P = J @ model.covariance @ J.T
    if covariance is not None:
        P[:9, :9] += turn @ covariance @ turn.T
    return replace(model, H=H, covariance=(P + P.T) / 2)


def _earth_errors(R_nm: Array, f: Array, h: Array, joint_acc: Array, joint_mag: Array) -> Array:
    """Standard errors (3,) rad about east, north and up from the covariances of f and h, to first order."""
    P = np.zeros((6, 6))
    P[:3, :3] = joint_acc[12:15, 12:15]
    P[3:, 3:] = joint_mag[12:15, 12:15]
    J = np.zeros((3, 6))
    both = np.concatenate([f, h])
    for k in range(6):
        step = 1e-5 * np.linalg.norm(f if k < 3 else h)
        moved = both + step * np.eye(6)[k]
        J[:, k] = so3.log(earth_from_laboratory(moved[:3], moved[3:]) @ R_nm.T) / step
    return np.sqrt(np.diag(J @ P @ J.T))
