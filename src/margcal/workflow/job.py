"""What a route works with (`Job`, `Options`) and what it gives back (`Solved`)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from margcal.core.errors import DataError
from margcal.core.types import Array, Fit, Index, Issue, Kind, Recording, SensorModel
from margcal.core.units import STANDARD_GRAVITY
from margcal.methods.joint import JointFit
from margcal.workflow.attitudes import Attitudes
from margcal.workflow.segment import Segmentation

MAX_CONDITION = 1e4
"""Condition number of H from which it is no model of a sensor at all."""
NAMES: dict[Kind, str] = {"acc": "accelerometer", "gyr": "gyroscope", "mag": "magnetometer"}


@dataclass(frozen=True)
class Options:
    """What the user asked for; angles in rad, `field_uT` None where the unit is the local field."""

    sensors: tuple[Kind, ...]
    pose_method: str = "gls-ml"
    gyro_method: str = "gauss-newton"
    gravity: float = STANDARD_GRAVITY
    field_uT: float | None = None
    dip: float | None = None
    level_sd: float = np.radians(1.0)
    nominal: dict[Kind, SensorModel] = field(default_factory=dict)

    @property
    def magnitude(self) -> dict[Kind, float]:
        return {"acc": self.gravity, "mag": 1.0 if self.field_uT is None else self.field_uT, "gyr": 1.0}

    @property
    def unit(self) -> dict[Kind, str]:
        return {"acc": "m/s^2", "gyr": "rad/s", "mag": "norm" if self.field_uT is None else "uT"}


@dataclass(frozen=True)
class Job:
    """Everything a route works with."""

    recordings: tuple[Recording, ...]
    segmentation: Segmentation
    attitudes: Attitudes
    options: Options

    def wants(self, kind: Kind) -> bool:
        return kind in self.options.sensors

    def readings(self, kind: Kind) -> tuple[Array, Index]:
        """Means (J', 3) of the rests at which the sensor was read, and the indices of these rests."""
        y = self.segmentation.poses.mean.get(kind)
        if y is None:
            return np.zeros((0, 3)), np.zeros(0, dtype=np.int64)
        index = np.flatnonzero(np.isfinite(y).all(axis=1))
        return y[index], index

    def raw_unit(self, kind: Kind) -> str:
        return next(r.streams[kind].unit for r in self.recordings if kind in r.streams)

    def as_named(self, kind: Kind) -> dict[str, Any]:
        """Keywords that name a solver's result."""
        return {"kind": kind, "raw_unit": self.raw_unit(kind), "unit": self.options.unit[kind]}


@dataclass
class Solved:
    """What a route found, filled sensor by sensor."""

    fits: dict[Kind, Fit] = field(default_factory=dict)
    vectors: dict[Kind, Array] = field(default_factory=dict)
    issues: list[Issue] = field(default_factory=list)
    sources: dict[Kind, str] = field(default_factory=dict)
    delays: dict[Kind, tuple[float, float | None]] = field(default_factory=dict)
    R: Array | None = None
    joint: JointFit | None = None
    singles: dict[Kind, Fit] = field(default_factory=dict)
    left_out: dict[str, set[int]] = field(default_factory=dict)  # see robust.LeftOut

    def attempt(self, kind: Kind, solve: Callable[[], Fit]) -> Fit | None:
        """Keep the fit of one sensor, or the reason why there is none."""
        try:
            fit = solve()
        except DataError as error:
            reasons = error.issues or (Issue("cannot-calibrate", "fail", str(error), kind),)
            self.issues += [replace(i, level="fail", sensor=i.sensor or kind) for i in reasons]
            return None
        if not (np.isfinite(fit.model.H).all() and np.isfinite(fit.model.B).all()):
            self.issues.append(Issue("not-finite", "fail", f"{kind}: the fit has no finite solution", kind))
            return None
        if np.linalg.cond(fit.model.H) > MAX_CONDITION:
            text = (
                f"{NAMES[kind]}: its H came out singular: the rests or turns contradict the attitudes or do not "
                "determine it; check the attitudes (an inverted quaternion does this), turn the node about all axes"
            )
            self.issues.append(Issue("singular", "fail", text, kind))
            return None
        if not fit.converged:
            text = f"{kind}: {fit.text or 'the fit did not converge'}; record more rests in other attitudes"
            self.issues.append(Issue("not-converged", "fail", text, kind))
            return None
        self.fits[kind] = fit
        return fit
