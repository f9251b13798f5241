"""Did the motion show enough? What a trial against optics determines, in words (ours, not in the papers).

An accelerometer or magnetometer is calibrated from the directions in which the marker body saw gravity or the field:
``G = R^T f / |f|``. Its H and B follow only if these directions spread along three axes, that is if no eigenvalue of
their scatter ``mean of (G - mean)(G - mean)^T`` is small. A gyroscope needs rotation about three axes: the eigenvalues
of ``mean of w w^T``. A trial of pure translation has neither; fitted all the same it gives K near 0 or anything else,
with a small residual. The covariance of the fit is looked at as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from margcal.core import so3
from margcal.core.errors import DataError
from margcal.core.types import Array, Issue, Kind, Level
from margcal.methods.uncertainty import weakest_direction

LEAST_SPREAD = 0.004
"""Variance of unit directions along their weakest axis below which nothing is fitted: 3.6 degrees."""
WEAK_SPREAD = 0.02
"""Below this (8 degrees) a warning."""
LEAST_RATE, WEAK_RATE = 0.05, 0.15
"""The same for the rms rate about the weakest axis, rad/s."""
LEAST_TURN_DEG, WEAK_TURN_DEG = 1.0, 6.0
"""The same for the rms angle through which the body turned about its least turned axis."""
SYSTEMATIC_DEG = 0.05
"""What cameras misjudge an attitude by, the same again at the same place, so that no averaging helps: beside small
turns it is a scale error. Measured on BROAD 12 (turns of 2 degrees rms: 1.3 %) and 03 (28 degrees: 0.15 %)."""
LEAST_RATIO = 1e-4
"""Weakest to strongest eigenvalue of w w^T below which an axis counts as not turned about."""
REFUSED_SD, WEAK_SD = 0.1, 0.02
"""Relative standard error of the least determined combination of H and B from which a fit is refused, or warned of."""


@dataclass(frozen=True)
class Excitation:
    """How well directions or rates are spread.

    Attributes
    ----------
    eigenvalues : ndarray (3,), ascending
        Of the scatter of unit directions, or of the mean of w w^T, rad^2/s^2.
    axes : ndarray (3, 3)
        Columns: the eigenvectors, marker body frame; the first is the least excited.
    condition : float
        Square root of the ratio of largest and smallest.
    level : {'note', 'warn', 'fail'}
    text : str
        Which direction was not excited and what to record; empty when all is well.
    """

    eigenvalues: Array
    axes: Array
    condition: float
    level: Level
    text: str

    def issue(self, kind: Kind) -> Issue | None:
        """None when all is well."""
        if self.level == "note":
            return None
        return Issue("poor-excitation", self.level, self.text, kind, float(self.eigenvalues[0]))


def attitude_excitation(kind: Kind, directions: Array) -> Excitation:
    """Spread of the directions (N, 3) in which the marker body saw gravity or the field."""
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    values, axes = np.linalg.eigh(np.cov(unit.T, bias=True))
    weak = _axis_words(axes[:, 0])
    felt = "gravity" if kind == "acc" else "the field"
    spread = float(np.degrees(np.sqrt(max(values[0], 0.0))))
    level: Level = "fail" if values[0] < LEAST_SPREAD else "warn" if values[0] < WEAK_SPREAD else "note"
    text = ""
    if level != "note":
        few = int(np.sum(values < LEAST_SPREAD))
        lack = "hardly rotated at all" if few == 3 else f"hardly changed its tilt along {weak}"
        text = (
            f"{kind}: the node {lack} ({felt} moved by {spread:.1f} degrees rms along {weak} of the marker body); "
            f"record again and turn the node slowly so that each of its axes points along {felt} and against it"
        )
    return Excitation(values, axes, _ratio(values), level, text)


def rate_excitation(rates: Array) -> Excitation:
    """Rotation about the axes of the marker body; `rates` (N, 3) rad/s."""
    values, axes = np.linalg.eigh(rates.T @ rates / len(rates))
    rms = float(np.sqrt(max(values[0], 0.0)))
    weak = _axis_words(axes[:, 0])
    nothing = rms < LEAST_RATE or values[0] < LEAST_RATIO * values[-1]
    level: Level = "fail" if nothing else "warn" if rms < WEAK_RATE else "note"
    text = ""
    if level != "note":
        text = (
            f"gyr: hardly any rotation about {weak} of the marker body ({np.degrees(rms):.1f} deg/s rms, about the "
            f"strongest axis {np.degrees(np.sqrt(values[-1])):.1f}); record again and turn the node about all three "
            "of its axes, to and fro"
        )
    return Excitation(values, axes, _ratio(values), level, text)


def turn_excitation(R: Array) -> Excitation:
    """Angles through which the marker body turned about its axes; `R` (N, 3, 3). Eigenvalues in rad^2."""
    middle = so3.mean_rotation(R)
    turns = so3.log(middle.T @ R)
    values, axes = np.linalg.eigh(np.cov(turns.T, bias=True))
    weak, rms = _axis_words(axes[:, 0]), float(np.degrees(np.sqrt(max(values[0], 0.0))))
    level: Level = "fail" if rms < LEAST_TURN_DEG else "warn" if rms < WEAK_TURN_DEG else "note"
    text = ""
    if level != "note":
        text = (
            f"gyr: the node turned through {rms:.1f} degrees rms only about {weak} of the marker body; record again "
            "and turn it through 45 degrees or more, to and fro, about all three of its axes"
        )
    return Excitation(values, axes, _ratio(values), level, text)


def small_turns(R: Array, H: Array) -> Array:
    """Covariance (9, 9) that `SYSTEMATIC_DEG` adds to that of a gyroscope's H (row by row): E = dH H^-1 errs by
    the cameras' error over the angle turned through."""
    turns = turn_excitation(R)
    inverse = turns.axes @ np.diag(1 / np.maximum(turns.eigenvalues, 1e-12)) @ turns.axes.T
    return np.kron(np.eye(3), H.T @ inverse @ H) * np.radians(SYSTEMATIC_DEG) ** 2


def demand_attitudes(kind: Kind, directions: Array, H: Array, covariance: Array, magnitude: float) -> str:
    """Refuse a fit whose attitudes cannot carry it; a warning in words, or nothing, for one that they can.

    Parameters
    ----------
    directions : ndarray (N, 3)
        Gravity or field in the marker body's frame.
    H, covariance, magnitude
        Of the fit; see `uncertainty.weakest_direction`.

    Raises
    ------
    DataError
    """
    return _demand([attitude_excitation(kind, directions).issue(kind), fit_issue(kind, H, covariance, magnitude)])


def demand_rates(R: Array, rates: Array, H: Array, covariance: Array) -> str:
    """Refuse a gyroscope's fit whose rotations cannot carry it; a warning in words, or nothing, for one they can.

    Raises
    ------
    DataError
    """
    found = [rate_excitation(rates), turn_excitation(R)]
    return _demand([*(e.issue("gyr") for e in found), fit_issue("gyr", H, covariance, 1.0)])


def fit_issue(kind: Kind, H: Array, covariance: Array, magnitude: float) -> Issue | None:
    """What the covariance says: None when every combination of H and B is known to `WEAK_SD`."""
    kept = covariance.copy()
    if kind == "gyr":  # its bias is not a share of anything
        kept[9:], kept[:, 9:] = 0.0, 0.0
    if not np.isfinite(kept).all():
        return Issue("not-determined", "fail", f"{kind}: the motion does not determine H and B", kind)
    weak = weakest_direction(kind, H, kept, magnitude)
    if weak.sd < WEAK_SD:
        return None
    level: Level = "fail" if weak.sd > REFUSED_SD else "warn"
    text = f"{kind}: {weak.text}; record longer, with rotation about all axes of the node"
    return Issue("not-determined", level, text, kind, weak.sd, REFUSED_SD if level == "fail" else WEAK_SD)


def _demand(issues: list[Issue | None]) -> str:
    found = [i for i in issues if i is not None]
    failed = [i for i in found if i.level == "fail"]
    if failed:
        raise DataError(failed[0].text, tuple(found))
    return "; ".join(i.text for i in found)


def _ratio(values: Array) -> float:
    return float(np.sqrt(values[-1] / values[0])) if values[0] > 0 else float("inf")


def _axis_words(v: Array) -> str:
    k = int(np.argmax(np.abs(v)))
    if abs(v[k]) > 0.9:
        return f"the {'xyz'[k]} axis"
    v = v * np.sign(v[k])
    return "({:.1f} {:.1f} {:.1f})".format(*(np.round(v, 1) + 0.0))
