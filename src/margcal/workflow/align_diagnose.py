"""Is the reference what it should be, and is the node right-handed? Faults of convention, found and named.

What a gyroscope can tell of quaternions: with the right ones (16) leaves about nothing. Conjugated ones (earth to body)
give the rate in the laboratory's axes, reversed. Scalar-last ones read as scalar-first are conjugated ones in other
frames: the permutation (x, y, z, w) of (w, x, y, z) is a rotation of four-space times a conjugation, a constant turn of
laboratory and body beside it. Both errors together are therefore right quaternions with both frames turned (by 180 and
90 degrees): neither the gyroscope nor the constancy of gravity can see them (both frames are estimated), but positions
can, which are in the laboratory that is meant.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from margcal.core import so3
from margcal.core.errors import DataError
from margcal.core.types import Array, Issue, Reference, Stream
from margcal.methods.clock import PEAK, PEAK_APART_S, Synchronisation, synchronise
from margcal.methods.rate_correlation import correlate
from margcal.methods.reference_rates import ReferenceRates, reference_rates, resample

GOOD = 0.9
"""Share of the rate that (16) explains from which nothing else is tried. Right references: 0.993 and more."""
LEAST = 0.8
WARNED = 0.97
BETTER = 3.0
"""Another reading of the quaternions must leave this many times less (sum of squares) to be named."""
TURNED_DEG, ODD_DEG = 25.0, 60.0
"""A marker body is usually put on along the node, nearer than the first; beyond the second it is odd."""
UP_DEG = 20.0


def as_conjugated(reference: Reference) -> Reference:
    """The reference with its quaternions taken for laboratory to body."""
    return replace(reference, q=so3.quat_conjugate(reference.q))


def as_scalar_last(reference: Reference) -> Reference:
    """The reference with its quaternions taken for scalar last."""
    return replace(reference, q=np.roll(reference.q, 1, axis=1))


@dataclass(frozen=True)
class Diagnosis:
    """`sync` with the reference as it is; `mirrored` whether the gyroscope's triad is left-handed."""

    sync: Synchronisation
    mirrored: bool
    issues: tuple[Issue, ...]


def synchronised(gyr: Stream, reference: Reference, rates: ReferenceRates, common_clock: bool) -> Diagnosis:
    """The clocks, with quaternions of another convention refused and a mirrored gyroscope found.

    Raises
    ------
    DataError
        If another reading of the quaternions fits three times better, or nothing fits.
    """
    try:
        sync = synchronise(gyr.t, gyr.y, rates, common_clock=common_clock)
    except DataError as refusal:
        peak = max((i.value or 0.0 for i in refusal.issues if i.code == "no-synchronisation"), default=0.9)
        _refuse_convention(gyr, reference, peak**2, common_clock)
        _refuse_clock(gyr, rates, common_clock)
        raise
    negative = float(np.linalg.det(sync.T)) < 0
    if sync.explained < GOOD or negative:
        _refuse_convention(gyr, reference, sync.explained, common_clock)
    if sync.explained < LEAST:
        _refuse_clock(gyr, rates, common_clock)
        text = (
            f"the gyroscope accounts for {100 * max(sync.explained, 0.0):.0f} % of the reference's turning only "
            f"({100 * LEAST:.0f} % is needed), with any convention of its quaternions: is the reference of the same "
            "body, and rigidly fixed to the node?"
        )
        raise DataError(text, (Issue("rates-disagree", "fail", text, "gyr", sync.explained, LEAST),))
    issues: list[Issue] = []
    if sync.explained < WARNED:
        text = (
            f"the gyroscope accounts for {100 * sync.explained:.1f} % of the reference's turning; healthy recordings "
            "reach 99 %: markers that shake, a reference with swaps, or a poor clock"
        )
        issues.append(Issue("rates-disagree", "warn", text, "gyr", sync.explained, WARNED))
    return Diagnosis(sync, negative, tuple(issues))


def _refuse_clock(gyr: Stream, rates: ReferenceRates, common_clock: bool) -> None:
    """Say so where a clock that is taken for common is not."""
    if not common_clock:
        return
    curve = correlate(gyr.t, gyr.y - np.median(gyr.y, axis=0), rates)
    k = int(np.argmax(curve.correlation))
    if curve.correlation[k] < PEAK or abs(curve.lags[k]) < PEAK_APART_S:
        return
    text = (
        f"node and reference are not on one clock: they agree with an offset of {curve.lags[k]:.2f} s (correlation "
        f"{curve.correlation[k]:.3f}); give the reference as a file of its own, without --common-clock"
    )
    raise DataError(text, (Issue("clock-not-common", "fail", text, None, float(curve.lags[k]), PEAK_APART_S),))


def _refuse_convention(gyr: Stream, reference: Reference, explained: float, common_clock: bool) -> None:
    """Refuse quaternions that fit much better when read otherwise."""
    other = _explained(gyr, as_conjugated(reference), common_clock)
    times = (1 - min(explained, 1.0)) / max(1 - other, 1e-9)
    if times > BETTER and other > LEAST:
        text = _convention(gyr, reference, times, common_clock)
        raise DataError(text, (Issue("reference-convention", "fail", text, None, times, BETTER),))


def _explained(gyr: Stream, reference: Reference, common_clock: bool) -> float:
    try:
        rates = reference_rates(reference)
        # a short stretch, or one that stands still, fits anything somewhere: it must correlate as well
        return synchronise(gyr.t, gyr.y, rates, common_clock=common_clock).explained
    except DataError:
        return 0.0


def _convention(gyr: Stream, reference: Reference, times: float, common_clock: bool) -> str:
    """Conjugated or scalar last: alike for the gyroscope; the one that leaves the marker body nearer to the node."""
    turned = []
    for candidate in (as_conjugated(reference), as_scalar_last(reference)):
        try:
            found = synchronise(gyr.t, gyr.y, reference_rates(candidate), common_clock=common_clock, peak_needed=0.0)
            turned.append(float(np.linalg.norm(so3.log(so3.nearest_rotation(found.T)))))
        except DataError:
            turned.append(np.pi)
    likely = "conjugated (laboratory to body)" if turned[0] <= turned[1] else "scalar last"
    other = "scalar last" if turned[0] <= turned[1] else "conjugated (laboratory to body)"
    k = 0 if turned[0] <= turned[1] else 1
    return (
        f"the reference's quaternions are {likely}: read so, they agree with the gyroscope {times:.0f} times better "
        f"(sum of squares), the marker body turned by {np.degrees(turned[k]):.0f} degrees from the node; a gyroscope "
        f"cannot tell this from {other} ({np.degrees(turned[1 - k]):.0f} degrees). Write ref_qw ref_qx ref_qy ref_qz "
        "scalar first, body to laboratory"
    )


# --- both errors together, positions in another frame ---------------------------------------------------


def check_laboratory(acc: Stream, rates: ReferenceRates, sync: Synchronisation, H: Array, B: Array) -> None:
    """Do attitudes and positions speak of one laboratory? ``R H (y - B)`` must move as p'' does.

    Parameters
    ----------
    H, B : ndarray (3, 3), (3,)
        The accelerometer in the marker body's axes, m/s^2, found without the positions.

    Raises
    ------
    DataError
        If they do once the quaternions are read scalar last and conjugated, and not as they are.
    """
    if rates.p_ddot is None:
        return
    y = resample(acc.t, acc.y, sync.node_time(rates.t) + sync.delay_s)
    use = np.flatnonzero(rates.valid_p & np.isfinite(y).all(axis=1))[:: max(1, rates.points // 2)]
    if len(use) < 200:
        return
    body = (y[use] - B) @ H.T
    p = rates.p_ddot[use] - rates.p_ddot[use].mean(axis=0)
    given = _agreement(rates.R[use], body, p)
    C, D = _both_undone()
    other = _agreement(C @ rates.R[use] @ D.T, body @ D.T, p)
    if other < max(0.3, given + 0.3):
        return
    text = (
        "the reference's attitudes and positions are of different laboratories: accelerations correlate by "
        f"{given:.2f}, and by {other:.2f} if the quaternions are both scalar last and conjugated; check their order "
        "and direction"
    )
    raise DataError(text, (Issue("reference-convention", "fail", text, None, other, given),))


def _agreement(R: Array, body: Array, p: Array) -> float:
    a = np.einsum("nij,nj->ni", R, body)
    a = a - a.mean(axis=0)
    return abs(float(np.sum(a * p))) / float(np.sqrt(np.sum(a * a) * np.sum(p * p) + 1e-300))


def _both_undone() -> tuple[Array, Array]:
    """Constant rotations C, D: quaternions read scalar last and conjugated give R' = C R D^T."""
    moved = so3.quat_conjugate(np.roll(np.eye(4), 1, axis=1))
    # q -> a q b with unit a, b: 1 goes to a b, and (image of i) (a b)+ = a i a+
    ab = moved[0]
    C = np.stack([so3.quat_multiply(moved[k], so3.quat_conjugate(ab))[1:] for k in (1, 2, 3)], axis=1)
    return C, so3.matrix_from_quat(ab).T @ C


def suspected_order(R_kh: Array, f_m: Array | None) -> Issue | None:
    """Without positions, both errors together only show in frames that nobody would choose: say so."""
    if f_m is None:
        return None
    C, D = _both_undone()
    up = f_m / np.linalg.norm(f_m)
    other_up, other_kh = C @ up, D @ R_kh
    odd = np.degrees(so3.angle_between(R_kh, np.eye(3))) > ODD_DEG and max(up[2], abs(up[1])) < np.cos(
        np.radians(UP_DEG)
    )
    usual = np.degrees(so3.angle_between(other_kh, np.eye(3))) < TURNED_DEG
    if not (odd and usual and other_up[2] > np.cos(np.radians(UP_DEG))):
        return None
    text = (
        "the laboratory's vertical comes out along its x axis and the marker body turned by "
        f"{np.degrees(so3.angle_between(R_kh, np.eye(3))):.0f} degrees from the node; read scalar last and conjugated, "
        "the quaternions would give a laboratory with z up and a marker body along the node: check their order and "
        "direction (H and B are right either way, marker_to_node and lab_to_earth are not)"
    )
    return Issue("reference-order-suspected", "warn", text)


def mirrored_issue(axis: str) -> Issue:
    """The words for a left-handed gyroscope."""
    text = (
        f"gyroscope: its axes are mirrored (left-handed): with {axis} reversed it agrees with the reference (a mirror "
        "of another axis is the same but for a turn of the frame); H takes care of it, but check the driver or wiring "
        "that flips an axis"
    )
    return Issue("mirrored-axes", "warn", text, "gyr")
