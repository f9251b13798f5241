"""What the steps of `align` hand to each other, and what of it stays in the calibration for the report."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from margcal.core.types import Alignment, Array, Fit, Issue, Kind, Recording, Reference, SensorModel
from margcal.core.units import STANDARD_GRAVITY
from margcal.methods.clock import Synchronisation
from margcal.methods.reference_rates import ReferenceRates

Method = Literal["r-bsn", "lowpass-svd", "forward"]
METHODS: tuple[Method, ...] = ("r-bsn", "lowpass-svd", "forward")
Tick = Callable[[int, int], None]

MOST_POINTS = 2000
"""Points of a curve that are kept for the report."""


@dataclass(frozen=True)
class AlignOptions:
    """What was asked for; `field_uT` None where the unit is the local field, `dip` rad, positive downwards."""

    method: Method
    sensors: tuple[Kind, ...]
    as_printed: bool = False
    norm: Literal["l1", "lengths"] = "l1"
    gravity: float = STANDARD_GRAVITY
    field_uT: float | None = None
    dip: float | None = None

    @property
    def magnitude(self) -> dict[Kind, float]:
        return {"acc": self.gravity, "gyr": 1.0, "mag": self.field_uT or 1.0}

    @property
    def units(self) -> dict[Kind, str]:
        return {"acc": "m/s^2", "gyr": "rad/s", "mag": "uT" if self.field_uT else "norm"}


@dataclass(frozen=True)
class AlignJob:
    """A node, its reference and how their clocks lie to each other.

    `static_bias` is the mean raw gyroscope of the trial at rest, (12), with its standard errors. `mirrored` names the
    gyroscope's axis that was found mirrored; `recording` then has that axis turned round already, `raw` has not.
    """

    recording: Recording
    raw: Recording
    reference: Reference
    rates: ReferenceRates
    sync: Synchronisation
    options: AlignOptions
    static_bias: tuple[Array, Array] | None = None
    mirrored: str | None = None


@dataclass
class AlignSolved:
    """What was found: models in the node's frame, and the rotations; filled sensor by sensor."""

    models: dict[Kind, SensorModel] = field(default_factory=dict)
    fits: dict[Kind, Fit] = field(default_factory=dict)
    delays: dict[Kind, tuple[float, float | None]] = field(default_factory=dict)
    issues: list[Issue] = field(default_factory=list)
    R_kh: Array | None = None
    R_kh_se: Array | None = None
    R_nm: Array | None = None
    R_nm_se: Array | None = None
    f_m: Array | None = None
    h_m: Array | None = None
    lever_arm: tuple[Array, Array] | None = None


@dataclass(frozen=True)
class OrientationErrors:
    """The orientation that a filter makes of the node's readings against the optics, degrees.

    `total`, `heading`, `inclination` are root mean squares over the samples that the optics saw, as in `evaluate`;
    `t` (n,) s, the reference's clock, `error` (n,) deg: the total error over time (thinned). `text` says what was
    compared.
    """

    total: float
    heading: float
    inclination: float
    t: Array
    error: Array
    text: str


@dataclass(frozen=True)
class AlignFigures:
    """What a report can show of an alignment. Times are the reference's, s; arrays are thinned to `MOST_POINTS`.

    Attributes
    ----------
    method : str
    lags, correlation : ndarray (n,)
        Multiple correlation of the angular rates against the offset; `peak` its height.
    peak, explained : float
        Share of the squared angular rate that the gyroscope accounts for.
    t : ndarray (n,)
    rate : ndarray (n, 3), rad/s
        Angular rate of the optics in the node's axes.
    rate_before, rate_after : ndarray (n, 3), rad/s
        The gyroscope less that: raw in its unit's SI value with nothing corrected (NaN for counts), and calibrated.
    residual_t, residual : dict kind -> ndarray (n,)
        What is left of each sensor after calibration, in its unit.
    masked : tuple of (start, stop)
        Stretches in which the body was not seen.
    seen : float
        Share of the reference that was used.
    f_m, h_m : ndarray (3,) or None
        Specific force at rest and field in the laboratory.
    delays : dict kind -> (s, standard error or None)
        Of each sensor behind the clock relation.
    before, after : OrientationErrors or None
        Orientation error with the readings as they are and with the calibration.
    """

    method: str
    lags: Array
    correlation: Array
    peak: float
    explained: float
    t: Array
    rate: Array
    rate_before: Array
    rate_after: Array
    residual_t: dict[Kind, Array]
    residual: dict[Kind, Array]
    masked: tuple[tuple[float, float], ...]
    seen: float
    f_m: Array | None
    h_m: Array | None
    delays: dict[Kind, tuple[float, float | None]]
    before: OrientationErrors | None = None
    after: OrientationErrors | None = None


@dataclass(frozen=True)
class MocapAlignment(Alignment):
    """An `Alignment` as `align` returns it, with the figures behind it; `load` gives a plain one."""

    figures: AlignFigures | None = None


def thinned(x: Array) -> Array:
    """Every k-th row of x, at most `MOST_POINTS`."""
    return np.ascontiguousarray(x[:: max(1, -(-len(x) // MOST_POINTS))])
