"""Figures of merit: statistics of Monte Carlo runs, and how well several calibrations of one node agree.

`Summary` and `rms` condense the errors of many runs; `Repeatability` is Z-TIE Fig. 7 and ZY-TBME Figs. 3 and 4: mean,
standard deviation and spread of B and H, and raw readings converted by each calibration.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from margcal.core.errors import InputError
from margcal.core.types import Array, Kind, SensorModel
from margcal.core.units import STANDARD_GRAVITY
from margcal.methods.uncertainty import sphere

# --- Monte Carlo --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Summary:
    """Mean and standard deviation of the `n` runs that gave a finite figure; `lost` did not."""

    mean: float
    sd: float
    n: int
    lost: int = 0


def summary(values: ArrayLike) -> Summary:
    """`Summary` of the figures (runs,)."""
    values = np.asarray(values, dtype=np.float64).ravel()
    found = values[np.isfinite(values)]
    if not found.size:
        return Summary(math.nan, math.nan, 0, values.size)
    return Summary(float(found.mean()), float(found.std()), found.size, values.size - found.size)


def rms(values: ArrayLike) -> float:
    """Root mean square of the finite `values`; NaN where there are none."""
    values = np.asarray(values, dtype=np.float64)
    found = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(found**2))) if found.size else math.nan


def share_below(values: ArrayLike, limit: float) -> float:
    """Part (0..1) of the `values` that lie below `limit`; what is not finite counts as above."""
    return float(np.mean(np.asarray(values, dtype=np.float64) < limit))


def frobenius(error: Array) -> Array:
    """Frobenius norms (...,) of matrices (..., 3, 3)."""
    return np.asarray(np.linalg.norm(error, axis=(-2, -1)), dtype=np.float64)


def length(error: Array) -> Array:
    """Lengths (...,) of vectors (..., 3)."""
    return np.asarray(np.linalg.norm(error, axis=-1), dtype=np.float64)


# --- repeatability ------------------------------------------------------------------------------------

CONVERTED = 20
"""Raw readings that are converted by each calibration, as in ZY-TBME Fig. 4."""

TYPICAL = {"acc": STANDARD_GRAVITY, "gyr": 2.0, "mag": 50.0}
"""Length of the vectors that are converted where the calibrations do not name one, in SI."""


@dataclass(frozen=True)
class Repeatability:
    """Several calibrations of one sensor held against each other.

    Attributes
    ----------
    kind : {'acc', 'gyr', 'mag'}
    raw_unit, unit : str
    H, B : ndarray (n, 3, 3), (n, 3)
        Of each calibration.
    claimed_H, claimed_B : ndarray (3, 3), (3,) or None
        Standard error that the calibrations state for themselves, rms over them.
    raw : ndarray (20, 3), raw unit
        Readings that were converted: vectors of length `magnitude`, evenly over the sphere.
    converted : ndarray (n, 20, 3), `unit`
    magnitude : float, `unit`
    angle_deg : ndarray (n, 20)
        Between each converted vector and the mean of the n.
    expected_error_deg : float or None
        What the calibrations state for themselves, rms over them.
    """

    kind: Kind
    raw_unit: str
    unit: str
    H: Array
    B: Array
    claimed_H: Array | None
    claimed_B: Array | None
    raw: Array
    converted: Array
    magnitude: float
    angle_deg: Array
    expected_error_deg: float | None

    @property
    def n(self) -> int:
        return len(self.B)

    @property
    def scatter(self) -> Array:
        """Standard deviation over the calibrations of every converted component (20, 3)."""
        return spread_of(self.converted).sd

    @property
    def angle_rms_deg(self) -> float:
        """Scatter of the direction: rms over the readings, with n - 1 in the denominator."""
        return float(np.sqrt(np.sum(self.angle_deg**2) / ((self.n - 1) * self.angle_deg.shape[1])))

    @property
    def over_claimed(self) -> float | None:
        """Observed scatter of the twelve parameters over the stated one, rms; about 1 where the files are right."""
        if self.claimed_H is None or self.claimed_B is None:
            return None
        sd = np.concatenate([spread_of(self.H).sd.ravel(), spread_of(self.B).sd])
        claimed = np.concatenate([self.claimed_H.ravel(), self.claimed_B])
        stated = claimed > 0  # the elements that the frame fixes have none
        return rms(sd[stated] / claimed[stated]) if stated.any() else None


@dataclass(frozen=True)
class Spread:
    """Over the first axis: mean, standard deviation (n - 1) and largest minus smallest."""

    mean: Array
    sd: Array
    span: Array


def spread_of(values: Array) -> Spread:
    """`Spread` of n values (n, ...)."""
    return Spread(values.mean(axis=0), values.std(axis=0, ddof=1), np.ptp(values, axis=0))


def repeatability(models: Sequence[SensorModel], names: Sequence[str] | None = None) -> Repeatability:
    """How well calibrations of one sensor agree: Z-TIE Fig. 7, ZY-TBME Figs. 3 and 4.

    Parameters
    ----------
    models : sequence of SensorModel
        At least two, in the same units and the same frame (which a `SensorModel` does not know).
    names : sequence of str, optional
        What to call them in errors.

    Raises
    ------
    InputError
        With fewer than two, or where kinds, units or handedness differ.
    """
    if len(models) < 2:
        raise InputError("repeatability needs at least two calibrations of a sensor")
    names = names or [f"calibration {i + 1}" for i in range(len(models))]
    _same(models, names)
    first = models[0]
    H, B = np.array([m.H for m in models]), np.array([m.B for m in models])
    magnitude = _magnitude(models)
    raw = magnitude * sphere(CONVERTED) @ np.linalg.inv(H.mean(axis=0)).T + B.mean(axis=0)
    converted = np.array([m.apply(raw) for m in models])
    middle = converted.mean(axis=0)
    across = np.linalg.norm(np.cross(converted, middle), axis=-1)
    angle = np.degrees(np.arctan2(across, np.sum(converted * middle, axis=-1)))
    claimed_H = claimed_B = None
    covariances = [m.covariance for m in models if m.covariance is not None]
    if len(covariances) == len(models):
        claimed = np.sqrt(np.mean([np.diag(c) for c in covariances], axis=0))
        claimed_H, claimed_B = claimed[:9].reshape(3, 3), claimed[9:]
    stated = [m.expected_error_deg for m in models if m.expected_error_deg is not None]
    expected = rms(stated) if len(stated) == len(models) else None
    return Repeatability(
        first.kind,
        first.raw_unit,
        first.unit,
        H,
        B,
        claimed_H,
        claimed_B,
        raw,
        converted,
        magnitude,
        angle,
        expected,
    )


def _same(models: Sequence[SensorModel], names: Sequence[str]) -> None:
    """Refuse what has no common meaning."""
    first = models[0]
    for model, name in zip(models[1:], names[1:]):
        for what, mine, theirs in (
            ("sensor", model.kind, first.kind),
            ("raw unit", model.raw_unit, first.raw_unit),
            ("unit", model.unit, first.unit),
        ):
            if mine != theirs:
                raise InputError(
                    f"{first.kind}: {what} is {theirs} in {names[0]} and {mine} in {name}; "
                    "compare calibrations in the same units"
                )
        if np.linalg.det(model.H) * np.linalg.det(first.H) < 0:
            raise InputError(
                f"{first.kind}: {names[0]} and {name} differ in the sign of det H, one of them is mirrored; "
                "calibrate both with the same --nominal or --at, which settle the sign"
            )


def _magnitude(models: Sequence[SensorModel]) -> float:
    """Length of the vectors to convert: that of the reference vectors, else a typical one."""
    vectors = [m.reference_vector for m in models if m.reference_vector is not None]
    if vectors:
        return float(np.mean([np.linalg.norm(v) for v in vectors]))
    return 1.0 if models[0].unit == "norm" else TYPICAL[models[0].kind]
