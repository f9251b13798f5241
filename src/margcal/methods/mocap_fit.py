"""Accelerometer, magnetometer and gyroscope against the attitude and position of a marker body ("the right way" of
issue 5; ours, after Rüschen, Misgeld, Kim, Leonhardt, R-BSN section 4).

The paper's (20) compares what the accelerometer shows with gravity turned into the body: linear acceleration is then
an error of the regressors, and K shrinks with it whatever the norm. Here the laboratory is where things are compared,
since there the specific force at rest f and the field h are constant and accelerations are second derivatives of
something bounded:

    magnetometer    R (H z - o) = h                                                                         (i)
    accelerometer   R (H z - o) = f + p_s'',    p_s = p + R r                                               (ii)
    gyroscope       R (H z - o) = w_m,          w_m the body's angular rate in the laboratory's axes        (iii)

with R = R_mk from the marker body k to the laboratory m, o = H B, and r from the marker body's origin to the sensor.
All three are linear. `magnetometer` solves (i), `lowpass_svd` (ii) below `cutoff_hz`, where p_s'' is small, and needs
no positions, `forward` solves (ii) with positions and the lever arm r, `gyroscope` (iii).

(i) and (ii) without positions are homogeneous: the length of h or f fixes their scale, and the noise of z, which is
noise of the regressors, is dealt with by the norm that is held fixed, |H K| with K = H^-1 (a generalised eigenvalue
problem: total least squares), so that it does not shrink H. In (ii) with positions and (iii) the noise of the optics,
far larger than the sensor's, is on the right side, the target's.

Covariances are sandwiches with the spectrum of the residual, so that neighbouring samples' common errors count. In
simulation errors are .9 to 1.1 of the standard errors; `lowpass_svd`, which has few low frequencies to judge itself by,
.75 to 1.3.

=============  ===============================================================================  =============
name here      meaning                                                                          shape
=============  ===============================================================================  =============
t, z           times and raw readings of the sensor, on the reference's clock                   (N,), (N, 3)
R, p           attitude R_mk and position of the marker body at t                               (N, 3, 3), (N, 3)
x              unknowns: H row by row, o, then h or f (units of its length), then r             (12..18,)
=============  ===============================================================================  =============

Results are in the marker body's frame k; `mocap_frame.common_frame` takes them to the node's.
"""

from __future__ import annotations

import numpy as np

from margcal.core.types import Array, Fit, Kind, Mask, SensorModel
from margcal.core.units import STANDARD_GRAVITY
from margcal.methods.mocap_excitation import demand_attitudes, demand_rates, small_turns, turn_excitation
from margcal.methods.mocap_solve import Solved, homogeneous, rates, with_positions
from margcal.methods.mocap_spectra import even_track

CITES = "ours, after R-BSN section 4, (16)-(20)"
CROWDED = (
    "acc: the linear acceleration is not small beside what slow rotation shows, and the errors are widened for it; "
    "record positions, too, or turn the node more slowly"
)
CUTOFF_HZ = 0.3
"""Below this, a hand's acceleration averages out (`lowpass_svd`)."""


def magnetometer(
    t: Array,
    z: Array,
    R: Array,
    valid: Mask | None = None,
    *,
    field: float | None = None,
    raw_unit: str = "count",
    nominal: Array | None = None,
    gate: bool = True,
) -> Fit:
    """H, B of a magnetometer and the field in the laboratory, from (i).

    Parameters
    ----------
    t, z, R, valid
        See `mocap_spectra.even_track`.
    field : float, uT, optional
        Length of the field; without it the unit is `norm` (local field = 1).
    nominal : ndarray (3, 3), optional
        A rough H in the marker frame that decides the sign; else det H > 0.
    gate : bool
        Refuse data whose rotation does not determine H and B (see `mocap_excitation`).

    Returns
    -------
    Fit
        `model` in the marker frame k, `u` the field in the laboratory (also `model.reference_vector`), `residual`
        (N,) misfit of each reading in `unit` (NaN where masked), `details`: `joint` (15, 15) covariance of
        (H row by row, B, u), `weights` (N,), `track_t` (N,); `text` what the motion showed little of, if anything.

    Raises
    ------
    DataError
        With issues that say what to record, if the attitudes do not determine the unknowns.
    """
    track = even_track(t, z, R, valid)
    length, unit = (1.0, "norm") if field is None else (field, "uT")
    fit = homogeneous(track, length, nominal, None)
    return _finished(fit, "mag", "tracking-frame", raw_unit, unit, gate)


def lowpass_svd(
    t: Array,
    z: Array,
    R: Array,
    valid: Mask | None = None,
    *,
    gravity: float = STANDARD_GRAVITY,
    cutoff_hz: float = CUTOFF_HZ,
    raw_unit: str = "count",
    nominal: Array | None = None,
    gate: bool = True,
) -> Fit:
    """H, B of an accelerometer and the specific force at rest in the laboratory, without positions.

    Below `cutoff_hz` the acceleration of something that stays in a room is small: (ii) without its last term. With a
    first answer the acceleration is known up to what is sought, and each frequency is then weighted with the inverse of
    its spectrum, which halves the error. See `magnetometer` for parameters and result, here with `gravity`, m/s^2;
    `details` also `late_s` (2,): how much later than `t` the readings came, to first order, and its standard error, s.
    """
    track = even_track(t, z, R, valid)
    fit = homogeneous(track, gravity, nominal, cutoff_hz)
    return _finished(fit, "acc", "lowpass-svd", raw_unit, "m/s^2", gate)


def forward(
    t: Array,
    z: Array,
    R: Array,
    p: Array,
    valid: Mask | None = None,
    *,
    gravity: float = STANDARD_GRAVITY,
    raw_unit: str = "count",
    lever: bool = True,
    gate: bool = True,
) -> Fit:
    """H, B of an accelerometer, the specific force at rest in the laboratory and the lever arm, with positions.

    Parameters
    ----------
    p : ndarray (N, 3), m
        Position of the marker body's origin at `t`, laboratory.
    lever : bool
        Estimate r; else it is zero.

    Returns
    -------
    Fit
        As of `magnetometer`; `details` also `late_s` (as of `lowpass_svd`), `lever_arm` (3,) m in k, and `joint` is
        (18, 18): (H, B, u, r).
    """
    track = even_track(t, z, R, valid, p)
    fit = with_positions(track, gravity, lever)
    return _finished(fit, "acc", "forward", raw_unit, "m/s^2", gate)


def gyroscope(
    t: Array, z: Array, R: Array, valid: Mask | None = None, *, raw_unit: str = "count", gate: bool = True
) -> Fit:
    """H (T of the paper's (16)) and B of a gyroscope together, from (iii).

    Parameters and result as of `magnetometer`; `residual` is in rad/s, that of the band used.

    Raises
    ------
    DataError
        If the axes of rotation do not determine H, or the gyroscope is mirrored against the reference.
    """
    track = even_track(t, z, R, valid)
    fit = rates(track)
    return _finished(fit, "gyr", "tracking-frame", raw_unit, "rad/s", gate)


def _finished(s: Solved, kind: Kind, method: str, raw_unit: str, unit: str, gate: bool) -> Fit:
    """Raw units, sign and excitation checked."""
    H1, o = s.x[:9].reshape(3, 3), s.x[9:12]
    H = s.length * H1 / s.scaled.size
    lean = np.linalg.solve(H1, o)
    B = s.scaled.centre + s.scaled.size * lean
    n = len(s.x)
    J = np.zeros((n, n))
    J[:9, :9] = np.eye(9) * s.length / s.scaled.size
    inverse = np.linalg.inv(H1)
    J[9:12, :9] = -s.scaled.size * np.kron(inverse, lean[None, :])
    J[9:12, 9:12] = s.scaled.size * inverse
    if n > 12:
        J[12:15, 12:15] = s.length * np.eye(3)
    if n > 15:
        J[15:, 15:] = np.eye(3)
    C = J @ s.C @ J.T
    C = (C + C.T) / 2
    u = s.length * s.x[12:15] if n > 12 else None
    text, seen = "", s.track.R[s.track.valid]
    if u is None and turn_excitation(seen).level != "note":
        C[:9, :9] += small_turns(seen, H)
    if gate and u is not None:
        text = demand_attitudes(kind, np.einsum("nji,j->ni", seen, u / s.length), H, C[:12, :12], s.length)
    elif gate:
        text = demand_rates(seen, (s.track.z[s.track.valid] - B) @ H.T, H, C[:12, :12])
    if s.crowded:
        text = "; ".join(filter(None, [text, CROWDED]))
    used = np.isfinite(s.residual) & (s.weights > 0)
    rms = float(np.sqrt(np.mean(s.residual[used] ** 2) / 3))
    model = SensorModel(
        kind, H, B, raw_unit, unit, covariance=C[:12, :12], residual_rms=rms, method=method, reference_vector=u
    )
    details = {"joint": C, "weights": s.weights, "track_t": s.track.t}
    if n > 15:
        details["lever_arm"] = s.x[15:]
    if s.late is not None:
        details["late_s"] = np.array(s.late)
    return Fit(
        model,
        s.residual,
        s.cost,
        method,
        CITES,
        u=u,
        covariance=C[:12, :12],
        rank=n,
        condition=s.condition,
        n_iter=s.n_iter,
        details=details,
        text=text,
    )
