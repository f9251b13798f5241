"""The node that `simulate` simulates: its true errors, and the readings it gives of a motion.

The parts are those of an MPU-9250 with its AK8963, in 16 bits.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from margcal.core import so3
from margcal.core.errors import InputError
from margcal.core.types import Array, Calibration, Kind, Reference, SensorModel, Stream
from margcal.core.units import KINDS, STANDARD_GRAVITY
from margcal.methods.sensor_model import ErrorParameters, compose
from margcal.workflow.motion import Motion, State, minimum_jerk, random_directions

NOMINAL_SCALE: dict[Kind, float] = {
    "acc": 2048 / STANDARD_GRAVITY,  # +-16 g in 16 bits
    "gyr": 16.4 * 180 / math.pi,  # +-2000 deg/s in 16 bits
    "mag": 1 / 0.15,  # 0.15 uT a count
}
"""Counts per SI unit of the simulated parts (MPU-9250 with its AK8963)."""

NOISE: dict[Kind, float] = {"acc": 4.0, "gyr": 2.0, "mag": 3.0}
"""Standard deviation of a reading, counts: 2 mg, 0.12 deg/s, 0.45 uT."""

BIAS: dict[Kind, float] = {"acc": 400.0, "gyr": 60.0, "mag": 30.0}
"""Largest offset of an axis, counts: 0.2 g, 3.7 deg/s, 4.5 uT."""

BOARD_AXES = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""The AK8963 inside an MPU-9250: x and y swapped, z flipped; det +1, trace -1."""

FULL_SCALE = 32767


@dataclass(frozen=True)
class NodeErrors:
    """How far a simulated node is from a perfect one.

    `scale_error` relative, `non_orthogonality_deg`, `soft_iron` relative: largest of an axis or element.
    `mounting_deg` the size of each triad's mounting rotation, `hard_iron_uT` of the hard iron vector.
    `mag_axes` (3, 3) signed permutation that takes the magnetometer's axes to the housing's.
    """

    scale_error: float = 0.08
    non_orthogonality_deg: float = 1.0
    mounting_deg: float = 4.0
    soft_iron: float = 0.05
    hard_iron_uT: float = 30.0
    mag_axes: Array = field(default_factory=lambda: np.eye(3))


@dataclass(frozen=True)
class Field:
    """The field in n: the same everywhere, but for `extra` (3,) near the rest from `start` to `stop`."""

    vector: Array
    extra: Array = field(default_factory=lambda: np.zeros(3))
    start: float = 0.0
    stop: float = 0.0
    fade: float = 1.0

    def at(self, t: Array) -> Array:
        there = minimum_jerk((t - self.start) / self.fade + 1)[0] - minimum_jerk((t - self.stop) / self.fade)[0]
        return self.vector + there[:, None] * self.extra


def triad(kind: Kind, errors: NodeErrors, rng: np.random.Generator) -> tuple[Array, Array]:
    """H and B of one triad with random errors."""
    scale = NOMINAL_SCALE[kind] * (1 + errors.scale_error * rng.uniform(-1, 1, 3))
    lean = np.tan(np.radians(errors.non_orthogonality_deg * rng.uniform(-1, 1, 3)))
    turned = so3.exp(math.radians(errors.mounting_deg) * random_directions(rng, 1)[0])
    iron, hard = np.eye(3), np.zeros(3)
    if kind == "mag":
        upper = np.triu(rng.uniform(-1, 1, (3, 3)))
        iron = np.eye(3) + errors.soft_iron * (upper + np.triu(upper, 1).T)
        iron /= np.cbrt(np.linalg.det(iron))
        hard = errors.hard_iron_uT * NOMINAL_SCALE[kind] * random_directions(rng, 1)[0]
        turned = turned @ errors.mag_axes
    bias = BIAS[kind] * rng.uniform(-1, 1, 3)
    H, B = compose(ErrorParameters(1 / scale, *lean, soft_iron=iron, hard_iron=hard, bias=bias))
    return turned @ H, B


def true_calibration(
    errors: NodeErrors,
    vectors: Mapping[Kind, Array],
    sensors: tuple[Kind, ...],
    seed: int,
    *,
    mag_delay_s: float = 0.0,
    temperature_degC: float | None = None,
) -> Calibration:
    """The node's true calibration, frame 'housing'; `vectors` are the sensed vectors in n."""
    models: dict[str, SensorModel] = {}
    # a stream of random numbers each: leaving a sensor out changes no other
    for kind, rng in zip(KINDS, np.random.default_rng([seed, 0]).spawn(3)):
        H, B = triad(kind, errors, rng)
        delay = None if mag_delay_s == 0 else mag_delay_s if kind == "mag" else 0.0
        if kind in sensors:
            models[kind] = SensorModel(
                kind,
                H,
                B,
                reference_vector=vectors.get(kind),
                method="simulation",
                delay_s=delay,
                temperature_degC=temperature_degC,
            )
    return Calibration(models.get("acc"), models.get("gyr"), models.get("mag"), f"simulated-{seed}", frame="housing")


def readings(
    motion: Motion,
    truth: Calibration,
    clocks: Mapping[Kind, Array],
    up: Array,
    magnetic: Field,
    rng: np.random.Generator,
    *,
    noise: float = 1.0,
    quantise: bool = True,
) -> dict[Kind, Stream]:
    """What the node's sensors show, each on its clock: counts.

    Parameters
    ----------
    motion : Motion
    truth : Calibration
    clocks : mapping of kind to ndarray (N,), s
    up : ndarray (3,)
        Specific force at rest in n, m/s^2.
    magnetic : Field
    noise : float
        Factor on `NOISE`.
    quantise : bool
        Round to whole counts and saturate at 16 bits.
    """
    if not 0 <= noise < np.inf:
        raise InputError(f"noise is {noise}; it must be zero or above")
    streams: dict[Kind, Stream] = {}
    generators = dict(zip(KINDS, rng.spawn(3)))
    last: tuple[Array, State] | None = None
    for kind, model in truth.models.items():
        seen = clocks[kind] - (model.delay_s or 0.0)
        if last is None or not np.array_equal(last[0], seen):
            last = seen, motion.at(seen)
        u = _sensed(kind, last[1], seen, up, magnetic)
        y = model.invert(u) + noise * NOISE[kind] * generators[kind].normal(size=u.shape)
        if quantise:
            y = np.clip(np.round(y), -FULL_SCALE - 1, FULL_SCALE)
        streams[kind] = Stream(kind, clocks[kind], y, "count")
    return streams


def _sensed(kind: Kind, state: State, t: Array, up: Array, magnetic: Field) -> Array:
    """True vectors (N, 3) in h."""
    if kind == "gyr":
        return state.rate
    in_n = state.acceleration + up if kind == "acc" else magnetic.at(t)
    return np.einsum("nji,nj->ni", state.R, in_n)  # R_nh^T v_n


def reference_track(motion: Motion, t: Array, noise_deg: float, gaps: int, rng: np.random.Generator) -> Reference:
    """The housing's attitude as motion capture would give it; NaN in `gaps` gaps of 0.3 to 1.5 s."""
    R = motion.at(t).R @ so3.exp(math.radians(noise_deg) * rng.normal(size=(len(t), 3)))
    q = so3.quat_from_matrix(R)
    for begin, length in zip(rng.uniform(t[0], t[-1], gaps), rng.uniform(0.3, 1.5, gaps)):
        q[(t >= begin) & (t < begin + length)] = np.nan
    return Reference(t, q)
