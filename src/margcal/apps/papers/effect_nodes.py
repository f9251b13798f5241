"""Nodes with known errors for `effect`: public recordings corrupted, and calibrated as a user would.

A node has scale errors of 5 to 10 %, mountings of 3 to 5 degrees, biases, and on the magnetometer hard and soft iron.
It is calibrated by the pipeline from a simulated session of its own (24 attitudes), and a factory-calibrated public
recording is turned into what this node would have read. What the calibration leaves out is then put back step by step.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from margcal.core import so3
from margcal.core.types import Array, Calibration, Kind, Recording, SensorModel
from margcal.core.units import SI_COLUMN, STANDARD_GRAVITY
from margcal.methods.ellipsoid import ellipsoid
from margcal.workflow.calibrate import calibrate
from margcal.workflow.segment import find_poses
from margcal.workflow.simulate import simulate
from margcal.workflow.simulated_node import NOMINAL_SCALE

FIELD = 49.1
"""uT: the field at which the nodes are calibrated (that of the recordings is another; H and B do not mind)."""

HOUSING_SD_DEG = 0.02
REST_S, TURN_S = 10.0, 1.0
"""A milled cube, ten seconds an attitude, quick turns: BROAD's fast trials turn so much that 0.1 % of the gyroscope's
scale factor moves the online filter's heading by 0.3 degrees."""

SCALE, MOUNTING_DEG = (0.05, 0.10), (3.0, 5.0)
"""Largest scale error of an axis, and mounting of every sensor: drawn anew for each node from these ranges."""

RAW, BIAS_ONLY, MAG_BIAS_ONLY = "raw", "bias only", "H and B, but magnetometer bias only"
SENSOR_FRAME, FULL, UNCORRUPTED = "sensor frame only", "H and B", "uncorrupted"

VARIANTS = (RAW, BIAS_ONLY, MAG_BIAS_ONLY, SENSOR_FRAME, FULL)


@dataclass(frozen=True)
class Node:
    """The truth, and what each variant takes for it."""

    truth: Calibration
    variants: Mapping[str, Calibration]

    def reads(self, recording: Recording) -> Recording:
        """What this node would have shown: raw readings, in counts (not rounded: they were digitised once already)."""
        return _of(recording, {k: self.truth.models[k].invert(s.y) for k, s in recording.streams.items()}, "count")


def make_node(seed: int) -> Node:
    """The node number `seed`, calibrated from its own simulated sessions."""
    rng = np.random.default_rng([seed, 5])
    told = {
        "rest_s": REST_S,
        "turn_s": TURN_S,
        "node_seed": seed,
        "scale_error": float(rng.uniform(*SCALE)),
        "mounting_deg": float(rng.uniform(*MOUNTING_DEG)),
    }
    session = simulate(seed=seed, n_poses=24, housing_sd_deg=HOUSING_SD_DEG, **told)  # type: ignore[arg-type]
    # by magnitude alone: a box shows an accelerometer six directions only, so this one is held in any attitude
    free = simulate(seed=seed + 1, n_poses=24, poses="free", **told)  # type: ignore[arg-type]
    calibrated = calibrate(session.recording, field=FIELD)
    means = find_poses(free.recording).poses.mean
    spheres = {
        "acc": ellipsoid(means["acc"], STANDARD_GRAVITY, kind="acc").model,
        "mag": ellipsoid(means["mag"], FIELD, kind="mag").model,
    }
    return Node(session.truth, variants_of(calibrated, spheres, NOMINAL_SCALE))


def variants_of(
    calibrated: Calibration, spheres: Mapping[str, SensorModel], scale: Mapping[Kind, float]
) -> dict[str, Calibration]:
    """The calibrations that leave something out.

    Parameters
    ----------
    calibrated : Calibration
        H and B.
    spheres : mapping of kind to SensorModel
        What the length of the sensed vector alone gives (symmetric H).
    scale : mapping of kind to float
        Raw units per SI unit, by the data sheet.
    """
    models = calibrated.models
    plain: dict[Kind, Array] = {k: np.eye(3) / scale[k] for k in models}
    raw: dict[Kind, SensorModel] = {k: replace(m, H=plain[k], B=np.zeros(3)) for k, m in models.items()}
    bias: dict[Kind, SensorModel] = {k: replace(m, H=plain[k]) for k, m in models.items()}
    # the gyroscope's own scale factors and axes without its mounting: the symmetric factor of H
    own: dict[Kind, SensorModel] = {k: spheres.get(k) or replace(m, H=so3.polar(m.H)[1]) for k, m in models.items()}
    return {
        RAW: _calibration(raw),
        BIAS_ONLY: _calibration(bias),
        MAG_BIAS_ONLY: _calibration({**models, "mag": bias["mag"]}),
        SENSOR_FRAME: _calibration(own),
        FULL: _calibration(models),
    }


def _calibration(models: Mapping[Kind, SensorModel]) -> Calibration:
    return Calibration(models.get("acc"), models.get("gyr"), models.get("mag"))


def applied(calibration: Calibration, raw: Recording) -> Recording:
    """Calibrated vectors in SI."""
    models = calibration.models
    return _of(raw, {k: models[k].apply(s.y) for k, s in raw.streams.items() if k in models}, None)


def _of(recording: Recording, vectors: Mapping[Kind, Array], unit: str | None) -> Recording:
    """The recording with other vectors: in `unit`, or in SI."""
    si: dict[Kind, str] = {"acc": SI_COLUMN["m/s^2"], "gyr": SI_COLUMN["rad/s"], "mag": "uT"}
    streams = {k: replace(s, y=vectors[k], unit=unit or si[k]) for k, s in recording.streams.items() if k in vectors}
    return replace(recording, acc=streams.get("acc"), gyr=streams.get("gyr"), mag=streams.get("mag"))
