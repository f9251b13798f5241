"""Are the reference's quaternions what they are taken for? (ours, not in the papers)

A gyroscope and the attitude q of the body that it is fixed to obey ``w = H (z - B)``, w from q, for one constant H.
Quaternions that are conjugated (laboratory to body), or written scalar last and read scalar first, do not: the misfit
of the best H tells, while the *length* of the rate, which either error leaves as it is, does not.

Both errors at once are a constant rotation on either side, ``q -> a q b`` with a and b turns of 120 degrees about a
diagonal: no gyroscope sees it, and nothing is calibrated wrongly, but the laboratory's vertical is then not z and the
marker body's frame is turned. An accelerometer whose axes lie roughly along the marker body's tells: only for the
quaternion as it should be read is ``R a`` the same at all times.

=============  ===============================================================================  =============
name here      meaning                                                                          shape
=============  ===============================================================================  =============
t, z           times and raw readings of the gyroscope                                          (N,), (N, 3)
q              quaternions at t as read, scalar first                                           (N, 4)
misfit         rms of ``w - H (z - B)`` in parts of the rms of w (.006 right, about 1 wrong)    scalar
=============  ===============================================================================  =============
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from margcal.core import lsq, so3
from margcal.core.errors import DataError
from margcal.core.types import Array, Fit, Index, Issue, Mask
from margcal.methods.mocap_spectra import stretches

Reading = Literal["as read", "conjugated", "scalar last", "conjugated and scalar last"]
READINGS: tuple[Reading, ...] = ("as read", "conjugated", "scalar last", "conjugated and scalar last")

SPAN_S = 0.06
"""Rates are taken over this time, reference and gyroscope alike."""
BETTER = 3.0
"""A reading of the quaternions that fits so many times better than as read is the right one."""
WORST = 0.5
"""Misfit from which no reading of the quaternions counts as right."""
LEAST_RATE = 0.05
"""Rms rate, rad/s, below which nothing can be said."""
STEADY = 0.95
"""Length of the mean of ``R a / |a|`` above which gravity counts as constant."""
CALM = 0.1
"""Accelerometer readings whose length is farther from the usual are left out."""
_WORDS: dict[Reading, str] = {
    "as read": "",
    "conjugated": "they take the laboratory to the body: conjugate them (negate qx, qy, qz)",
    "scalar last": "their scalar is the last column: write qx qy qz qw as ref_qw ... in the order w x y z",
    "conjugated and scalar last": "their scalar is the last column and they take the laboratory to the body: "
    "put the last column first and negate the other three",
}


@dataclass(frozen=True)
class ReferenceCheck:
    """What the gyroscope says of the reference.

    Attributes
    ----------
    reading : str
        The reading of the quaternions that the data support; `mended` applies it.
    misfit : dict
        Of each reading.
    steadiness : dict
        Length of the mean of ``R a / |a|`` of each reading, 1 for constant gravity; empty without an accelerometer.
    H : ndarray (3, 3)
        Rough H of the gyroscope in the marker body's frame, for that reading.
    issues : tuple of Issue
        ``reference-quaternions`` (fail, or warn where only the frames are turned), ``mirrored-axes``,
        ``reference-mismatch`` (no reading fits).
    """

    reading: Reading
    misfit: dict[Reading, float]
    steadiness: dict[Reading, float]
    H: Array
    issues: tuple[Issue, ...]


def mended(q: Array, reading: Reading) -> Array:
    """Quaternions scalar first, body to laboratory, from `q` (N, 4) read as scalar first."""
    q = np.asarray(q, dtype=np.float64)
    if reading in ("scalar last", "conjugated and scalar last"):
        q = np.roll(q, 1, axis=-1)
    return so3.quat_conjugate(q) if reading in ("conjugated", "conjugated and scalar last") else q


def check_reference(
    t: Array, z: Array, q: Array, valid: Mask | None = None, acc: Array | None = None
) -> ReferenceCheck:
    """Which reading of the quaternions do gyroscope (and accelerometer) support?

    Parameters
    ----------
    t : ndarray (N,), s
        Times of the gyroscope on the reference's clock, to a few milliseconds.
    z : ndarray (N, 3), raw unit
    q : ndarray (N, 4)
        Quaternions at `t` as read, scalar first; NaN where not seen.
    valid : ndarray (N,) of bool, optional
    acc : ndarray (N, 3), optional
        Accelerometer at `t`, any unit, roughly free of bias, its axes roughly along the marker body's: only with it
        can both errors at once be seen.

    Raises
    ------
    DataError
        If there is too little rotation or too little in common to say anything.
    """
    ok: Mask = np.asarray(np.isfinite(np.column_stack([q, z])).all(axis=1), dtype=np.bool_)
    if valid is not None:
        ok = ok & valid
    first, last = _spans(t, ok)
    found = {reading: _fit(t, z, mended(q, reading), first, last) for reading in READINGS}
    misfit: dict[Reading, float] = {r: found[r][0] for r in READINGS}
    steadiness: dict[Reading, float] = {}
    if acc is not None:
        both = np.isfinite(np.column_stack([q, acc])).all(axis=1) & ok
        steadiness = {r: _steadiness(mended(q[both], r), acc[both]) for r in READINGS}
    reading, issues = _judged(misfit, steadiness)
    H = found[reading][1]
    if np.linalg.det(H) < 0 and misfit[reading] < WORST:
        other: Reading = "conjugated" if reading == "as read" else "as read"
        told_apart = BETTER * misfit[reading] < misfit[other]
        issues.append(_mirrored(float(np.linalg.det(H)), or_conjugated=not told_apart))
    return ReferenceCheck(reading, misfit, steadiness, H, tuple(issues))


def check_handedness(gyr: Fit, acc: Fit | None = None) -> Issue | None:
    """Do gyroscope, accelerometer and reference agree in handedness? None if they do.

    A mirrored gyroscope axis shows as det T < 0. A mirrored (left-handed) laboratory shows only against measured
    accelerations: with positions, the accelerometer's H comes out with det < 0.
    """
    det = float(np.linalg.det(gyr.model.H))
    if det < 0:
        return _mirrored(det)
    if acc is not None and np.linalg.det(acc.model.H) < 0:
        text = (
            "the accelerometer agrees with the cameras' positions only as a mirror image: the laboratory's axes are "
            "left-handed (negate one axis of positions and attitudes), or an axis of the accelerometer is mirrored"
        )
        return Issue("mirrored-axes", "fail", text, "acc", float(np.linalg.det(acc.model.H)), 0.0)
    return None


def _mirrored(det: float, *, or_conjugated: bool = False) -> Issue:
    text = (
        "the gyroscope follows the reference only as a mirror image (det T < 0): one of its axes has the wrong sign, "
        "or two of them are swapped; mend the driver's axes or declare the mirrored axis"
    )
    if or_conjugated:
        text += ". Or the reference's quaternions are conjugated: there is too little rotation to tell"
    return Issue("mirrored-axes", "fail", text, "gyr", det, 0.0)


def _judged(misfit: dict[Reading, float], steadiness: dict[Reading, float]) -> tuple[Reading, list[Issue]]:
    plain: Reading = "as read"
    best = min(READINGS, key=lambda r: misfit[r])
    if misfit[best] > WORST:
        text = (
            "gyroscope and reference do not belong together: whichever way the quaternions are read, "
            f"{misfit[best]:.0%} of the rate is unexplained; is it the same body and trial, are the clocks aligned?"
        )
        return plain, [Issue("reference-mismatch", "fail", text, "gyr", misfit[best], WORST)]
    pair: dict[Reading, Reading] = {
        "as read": "conjugated and scalar last",
        "conjugated and scalar last": "as read",
        "conjugated": "scalar last",
        "scalar last": "conjugated",
    }
    if BETTER * misfit[best] < misfit[plain]:
        twin = pair[best]  # no gyroscope can tell the two: gravity may, else conjugation is the commoner error
        chosen: Reading = "conjugated"
        if steadiness and max(steadiness[best], steadiness[twin]) > STEADY:
            chosen = best if steadiness[best] > steadiness[twin] else twin
        doubt = "" if steadiness else f" (or {pair[chosen]}: the gyroscope cannot tell the two)"
        text = (
            f"the reference's quaternions are not scalar first, body to laboratory: read as they are they leave "
            f"{misfit[plain]:.0%} of the gyroscope's rate unexplained, read as {chosen}{doubt} {misfit[chosen]:.1%}; "
            + _WORDS[chosen]
        )
        return chosen, [Issue("reference-quaternions", "fail", text, "gyr", misfit[plain], BETTER * misfit[chosen])]
    twin = pair[plain]
    if steadiness and steadiness[twin] > STEADY and BETTER * (1 - steadiness[twin]) < 1 - steadiness[plain]:
        text = (
            f"gravity turned into the laboratory is constant only if the reference's quaternions are read as {twin} "
            f"({steadiness[twin]:.2f}; as read {steadiness[plain]:.2f}): {_WORDS[twin]}; the gyroscope cannot see it, "
            "only the frames of marker body and laboratory are wrong"
        )
        return twin, [Issue("reference-quaternions", "warn", text, "acc", steadiness[plain], STEADY)]
    return plain, []


def _spans(t: Array, ok: Mask) -> tuple[Index, Index]:
    """First and last index of spans of about `SPAN_S` that were seen throughout."""
    step = float(np.median(np.diff(t)))
    n = max(2, round(SPAN_S / step))
    first = [np.arange(a, b - n) for a, b in stretches(ok) if b - a > n]
    if not first or sum(map(len, first)) < 100:
        raise DataError("gyroscope and reference have too little in common to check the reference's quaternions")
    start: Index = np.concatenate(first)
    start = start[t[start + n] - t[start] < 1.5 * n * step]
    return start, start + n


def _fit(t: Array, z: Array, q: Array, first: Index, last: Index) -> tuple[float, Array]:
    """Misfit and H of the gyroscope against the rates of `q`."""
    q = q / np.linalg.norm(q, axis=1, keepdims=True)
    turned = so3.quat_log(so3.quat_multiply(so3.quat_conjugate(q[first]), q[last]))
    w = turned / (t[last] - t[first])[:, None]
    rms = float(np.sqrt(np.mean(np.sum(w**2, axis=1))))
    if rms < LEAST_RATE:
        raise DataError("the reference hardly turns: nothing can be said of its quaternions; record rotation")
    known = np.where(np.isfinite(z), z, 0.0)
    total = np.concatenate([np.zeros((1, 3)), np.cumsum((known[1:] + known[:-1]) / 2 * np.diff(t)[:, None], axis=0)])
    mean = (total[last] - total[first]) / (t[last] - t[first])[:, None]
    rows = np.column_stack([mean, np.ones(len(mean))])
    solved = np.column_stack([lsq.linear(rows, w[:, k]).x for k in range(3)])
    return float(np.sqrt(np.mean(np.sum((rows @ solved - w) ** 2, axis=1)))) / rms, solved[:3].T


def _steadiness(q: Array, acc: Array) -> float:
    length = np.linalg.norm(acc, axis=1)
    calm = np.abs(length / np.median(length) - 1) < CALM
    q, unit = q[calm], acc[calm] / length[calm, None]
    return float(np.linalg.norm(np.mean(np.einsum("nij,nj->ni", so3.matrix_from_quat(q), unit), axis=0)))
