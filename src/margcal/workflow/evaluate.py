"""How good an estimate of attitude is, against a reference: the papers' figures and BROAD's.

The papers (Z-TIE Table III, ZY-TBME Table II, R-BSN section 5) give RMS, mean, standard deviation and correlation of
roll, pitch and yaw. Laidig, Caruso, Cereatti & Seel, "BROAD - A Benchmark for Robust Inertial Orientation Estimation",
Data 6(7), 2021, section 4, split the error quaternion in the earth frame, d = q_est q_ref^-1, into a total angle
2 acos |d_w|, the part about the vertical (heading) 2 atan(d_z / d_w) and the rest (inclination)
2 acos sqrt(d_w^2 + d_z^2), and take the RMS over the samples in which the body moved.

Nothing is aligned unless asked. Tracks are brought to common times by slerp between neighbouring samples, never across
a gap.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from margcal.core import so3
from margcal.core.errors import DataError, InputError
from margcal.core.types import Array, Attitude, Issue, Mask, Recording, Reference
from margcal.files.attitude_table import AttitudeTable, Prefix, checked_attitude, read_attitudes
from margcal.workflow.evaluate_align import Frames, at_times, no_turn, time_offset, turned, usual_step

Track = str | os.PathLike[str] | AttitudeTable | Attitude | Reference | Recording

FEWEST = 10
"""Common samples below which nothing is said."""

SLOWER = 1.5
"""A reference with samples so many times farther apart than the estimate's sets the times."""

STEEP_DEG = 85.0
"""Pitch beyond which roll and yaw lose their meaning."""

ODD_DEG, BETTER = 10.0, 5.0
"""Total error from which other conventions are tried, and how many times less they must leave to be named."""

ANGLES = ("roll", "pitch", "yaw")


@dataclass(frozen=True)
class AngleError:
    """Error (estimate - reference) of one angle, degrees, and the correlation of the two angles (NaN if constant)."""

    rms: float
    mean: float
    sd: float
    correlation: float


@dataclass(frozen=True)
class Evaluation:
    """An estimate against its reference.

    Attributes
    ----------
    total_deg, heading_deg, inclination_deg : float
        RMS (BROAD's definitions).
    roll, pitch, yaw : AngleError
        Of R = R_z(yaw) R_y(pitch) R_x(roll).
    quaternion : float
        RMS length of q_est - q_ref after the signs were made to agree, and
    quaternion_wxyz : ndarray (4,)
        RMS by component.
    n, n_common : int
        Samples that count, and samples that both tracks have.
    samples : {'movement', 'all'}
        Which counted: those that a column `movement` names, or all.
    times : {'estimate', 'reference'}
        Whose times were taken; the other track was interpolated.
    time_offset_s : float or None
        ``t_reference = t_estimate + time_offset_s``, where it was asked for; `time_correlation` how well the angular
        speeds then agree.
    frames : Frames
        What the frames were turned by, where that was asked for.
    t, q_est, q_ref : ndarray (n_common,), (n_common, 4)
        Common samples, after alignment; `counted` (n_common,) bool which of them count.
    """

    total_deg: float
    heading_deg: float
    inclination_deg: float
    roll: AngleError
    pitch: AngleError
    yaw: AngleError
    quaternion: float
    quaternion_wxyz: Array
    n: int
    n_common: int
    samples: Literal["movement", "all"]
    times: Literal["estimate", "reference"]
    time_offset_s: float | None
    time_correlation: float | None
    frames: Frames
    t: Array = field(repr=False)
    q_est: Array = field(repr=False)
    q_ref: Array = field(repr=False)
    counted: Mask = field(repr=False)
    issues: tuple[Issue, ...] = ()

    @property
    def seconds(self) -> float:
        """From the first common sample to the last."""
        return float(self.t[-1] - self.t[0])

    def angles_deg(self) -> tuple[Array, Array, Array]:
        """Roll, pitch, yaw (n_common, 3) of the reference (without jumps at +-180), of the estimate, and its error."""
        return _angles(self.q_est, self.q_ref)


def evaluate(
    estimate: Track,
    reference: Track,
    *,
    align_frames: Literal["none", "yaw", "full"] = "none",
    align_time: bool = False,
    all_samples: bool = False,
    movement: ArrayLike | None = None,
) -> Evaluation:
    """An estimate of attitude against a reference.

    Parameters
    ----------
    estimate, reference : path, Attitude, Reference, or Recording with a reference
        Body to earth (or laboratory), both in one frame. Of a table `qw ...` are taken for the estimate and `ref_qw`
        ... for the reference where both are there. Rows that are NaN were not seen.
    align_frames : {'none', 'yaw', 'full'}
        Turn the estimate before it is judged: about the vertical by the best constant angle; or ``A q_est B``
        with the best constant rotations of the laboratory and of the body. The result says what was found.
    align_time : bool
        Move the estimate by the constant time that makes the angular speeds agree best.
    all_samples : bool
        Count all samples, not those in which the body moved.
    movement : array_like (N,) bool, optional
        When the body moved, on the reference's clock; else a table's column `movement`.

    Returns
    -------
    Evaluation

    Raises
    ------
    InputError
        What cannot be read as attitudes.
    DataError
        The tracks have (nearly) no moment in common, or cannot be aligned.
    """
    if align_frames not in ("none", "yaw", "full"):
        raise InputError(f"align_frames {align_frames!r} is none of none, yaw, full")
    est, ref = _track(estimate, "q"), _track(reference, "ref_q")
    moved = _moved(est, ref, movement)
    offset = correlation = None
    if align_time:
        offset, correlation = time_offset(est.attitude, ref.attitude)
    times, t, q_est, q_ref = _common(est, ref, offset or 0.0)
    counted, samples = _counted(t, None if all_samples else moved)
    frames, issues = no_turn(), [*est.issues, *ref.issues]
    if align_frames != "none":
        frames, found = turned(q_est[counted], q_ref[counted], align_frames)
        q_est = so3.quat_multiply(so3.quat_multiply(frames.laboratory, q_est), frames.body)
        issues += found
    issues += [*_alike(q_est, q_ref), *_otherwise(q_est[counted], q_ref[counted]), *_steep(q_ref[counted])]
    return _judged(t, q_est, q_ref, counted, samples, times, (offset, correlation), frames, issues)


def error_angles(q_est: ArrayLike, q_ref: ArrayLike) -> tuple[Array, Array, Array]:
    """Total, heading and inclination error (N,), rad, of quaternions (N, 4): BROAD's definitions (module's head)."""
    d = so3.quat_multiply(q_est, so3.quat_conjugate(q_ref))
    vertical = np.hypot(d[:, 0], d[:, 3])
    across = np.hypot(d[:, 1], d[:, 2])
    # atan2 of sine and cosine of the half angle: acos loses half of the digits where the error is small
    total = 2 * np.arctan2(np.linalg.norm(d[:, 1:], axis=1), np.abs(d[:, 0]))
    heading = 2 * np.arctan2(d[:, 3] * np.where(d[:, 0] < 0, -1.0, 1.0), np.abs(d[:, 0]))
    return total, heading, 2 * np.arctan2(across, vertical)


def euler_zyx(q: ArrayLike) -> Array:
    """Roll, pitch, yaw (N, 3), rad, of R = R_z(yaw) R_y(pitch) R_x(roll), quaternions (N, 4) scalar first."""
    w, x, y, z = np.asarray(q, dtype=np.float64).T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.column_stack([roll, pitch, yaw])


# --- from what is given to common samples -------------------------------------------------------------


def _track(given: Track, prefer: Prefix) -> AttitudeTable:
    if isinstance(given, AttitudeTable):
        return given
    if isinstance(given, (str, os.PathLike)):
        return read_attitudes(given, prefer=prefer)
    if isinstance(given, Recording):
        if given.reference is None:
            raise InputError(f"{given.source}: has no reference attitudes (ref_qw ref_qx ref_qy ref_qz)")
        return AttitudeTable(Attitude(given.reference.t, given.reference.q), "ref_q", source=given.source)
    name = "estimate" if prefer == "q" else "reference"
    attitude, issues = checked_attitude(given.t, given.q, prefer, name)
    return AttitudeTable(attitude, prefer, source=name, issues=issues)


def _moved(est: AttitudeTable, ref: AttitudeTable, given: ArrayLike | None) -> tuple[Array, Mask] | None:
    """When the body moved, and on which clock, where anybody says so."""
    if given is None:
        return ref.movement if ref.movement is not None else est.movement
    mask = np.asarray(given).astype(bool)
    if mask.shape != ref.attitude.t.shape:
        raise InputError(f"movement: {mask.size} values for {ref.attitude.t.size} samples of the reference")
    return ref.attitude.t, mask


def _common(
    est: AttitudeTable, ref: AttitudeTable, offset: float
) -> tuple[Literal["estimate", "reference"], Array, Array, Array]:
    """Whose times, the times on the reference's clock, and both tracks at them."""
    for track in (est, ref):
        if not np.isfinite(track.attitude.q).all(axis=1).any():
            raise DataError(f"{track.source}: no sample holds an attitude: all are empty or (0, 0, 0, 0)")
    a = Attitude(est.attitude.t + offset, est.attitude.q)
    b = ref.attitude
    if usual_step(b.t) > SLOWER * usual_step(a.t):
        times, t = "reference", b.t
        q_est, q_ref = at_times(a, t), b.q
    else:
        times, t = "estimate", a.t
        q_est, q_ref = a.q, at_times(b, t)
    both = np.isfinite(q_est).all(axis=1) & np.isfinite(q_ref).all(axis=1)
    if both.sum() < FEWEST:
        raise DataError(
            f"{est.source} ({a.t[0]:.6g} to {a.t[-1]:.6g} s) and {ref.source} ({b.t[0]:.6g} to {b.t[-1]:.6g} s) have "
            f"{int(both.sum())} samples in common; {FEWEST} are needed: give tracks on one clock, without long gaps"
        )
    q_est = q_est[both] / np.linalg.norm(q_est[both], axis=1, keepdims=True)
    q_ref = q_ref[both] / np.linalg.norm(q_ref[both], axis=1, keepdims=True)
    return times, t[both], q_est, q_ref


def _counted(t: Array, moved: tuple[Array, Mask] | None) -> tuple[Mask, Literal["movement", "all"]]:
    if moved is None:
        return np.ones(len(t), dtype=bool), "all"
    clock, mask = moved
    middle = (clock[1:] + clock[:-1]) / 2  # the flag of the nearest sample
    counted = mask[np.searchsorted(middle, t)]
    if counted.sum() < FEWEST:
        raise DataError(
            f"the column movement leaves {int(counted.sum())} common samples, {FEWEST} are needed; count all of them "
            "(--all-samples)"
        )
    return counted, "movement"


def _alike(q_est: Array, q_ref: Array) -> list[Issue]:
    """Not one digit of difference: nothing was estimated."""
    if not (np.array_equal(q_est, q_ref) or np.array_equal(q_est, -q_ref)):
        return []
    text = "estimate and reference are the same numbers to the last digit: a track was compared with itself"
    return [Issue("same-track", "warn", text)]


def _otherwise(q_est: Array, q_ref: Array) -> list[Issue]:
    """Is the estimate right when its quaternions are read otherwise? Then its convention is wrong, not the filter."""
    last = np.roll(q_est, 1, axis=1)
    readings = {
        "conjugated (earth to body)": so3.quat_conjugate(q_est),
        "scalar last": last,
        "scalar last and conjugated": so3.quat_conjugate(last),
    }
    given = _total_deg(q_est, q_ref)
    found = {name: _total_deg(q, q_ref) for name, q in readings.items()}
    best = min(found, key=lambda name: found[name])
    if given < ODD_DEG or found[best] * BETTER > given:
        return []
    text = (
        f"read {best}, the estimate's quaternions are off by {found[best]:.3g} degrees instead of {given:.3g}: one of "
        "the two files is of that convention; margcal's is scalar first, body to earth"
    )
    return [Issue("convention", "warn", text, value=found[best], limit=given / BETTER)]


def _total_deg(q_est: Array, q_ref: Array) -> float:
    return float(np.degrees(np.sqrt(np.mean(error_angles(q_est, q_ref)[0] ** 2))))


def _steep(q_ref: Array) -> list[Issue]:
    share = float(np.mean(np.abs(euler_zyx(q_ref)[:, 1]) > np.radians(STEEP_DEG)))
    if not share:
        return []
    text = (
        f"pitch is beyond {STEEP_DEG:g} degrees in {100 * share:.2g} % of the samples, where roll and yaw turn into "
        "one another: their figures are worse than the attitude is; total, heading and inclination are not affected"
    )
    return [Issue("steep-pitch", "note", text, value=share, limit=0.0)]


# --- the figures --------------------------------------------------------------------------------------


def _judged(
    t: Array,
    q_est: Array,
    q_ref: Array,
    counted: Mask,
    samples: Literal["movement", "all"],
    times: Literal["estimate", "reference"],
    offset: tuple[float | None, float | None],
    frames: Frames,
    issues: Sequence[Issue],
) -> Evaluation:
    total, heading, inclination = (
        float(np.degrees(np.sqrt(np.mean(e**2)))) for e in error_angles(q_est[counted], q_ref[counted])
    )
    reference, estimate, error = (a[counted] for a in _angles(q_est, q_ref))
    roll, pitch, yaw = (_angle_error(error[:, i], estimate[:, i], reference[:, i]) for i in range(3))
    same = np.where(np.sum(q_est * q_ref, axis=1) < 0, -1.0, 1.0)
    by_component = np.sqrt(np.mean((same[:, None] * q_est - q_ref)[counted] ** 2, axis=0))
    return Evaluation(
        total,
        heading,
        inclination,
        roll,
        pitch,
        yaw,
        float(np.linalg.norm(by_component)),
        by_component,
        int(counted.sum()),
        len(t),
        samples,
        times,
        *offset,
        frames,
        t,
        q_est,
        q_ref,
        counted,
        tuple(issues),
    )


def _angles(q_est: Array, q_ref: Array) -> tuple[Array, Array, Array]:
    """Reference without jumps, estimate beside it, and the error within +-180, degrees."""
    ref, est = np.degrees(euler_zyx(q_ref)), np.degrees(euler_zyx(q_est))
    error = (est - ref + 180.0) % 360.0 - 180.0
    ref = np.unwrap(ref, period=360.0, axis=0)
    return ref, ref + error, error


def _angle_error(error: Array, estimate: Array, reference: Array) -> AngleError:
    a, b = estimate - estimate.mean(), reference - reference.mean()
    size = float(np.sqrt((a @ a) * (b @ b)))
    # an angle that does not change correlates with nothing; rounding must not decide
    constant = min(float(a @ a), float(b @ b)) <= 1e-18 * len(a)
    correlation = float("nan") if constant else float(a @ b) / size
    return AngleError(float(np.sqrt(np.mean(error**2))), float(error.mean()), float(error.std()), correlation)
