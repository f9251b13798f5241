"""R-BSN's experiment on paper: nodes at hip, thigh and ankle of a walker on a treadmill, cameras around, a wand.

A session has three trials on one pair of clocks: every node lies still, is moved freely by hand, and walks along. Each
node sits on a plate with four markers; what the cameras see becomes an attitude by `files.markers`, as with a real
recording.

n is the earth (ENU), m the tracking frame that the wand has set (its levels good, its yaw off magnetic north), h the
node's housing, k the marker plate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from margcal.core import so3
from margcal.core.types import Array, Calibration, Kind, Recording, Reference, SensorModel
from margcal.core.units import KINDS, STANDARD_GRAVITY
from margcal.files.markers import Markers, marker_reference
from margcal.workflow.gait import PLACES, GaitNode, Place, walker
from margcal.workflow.mocap_simulation import Carried, carried
from margcal.workflow.motion import State, random_directions
from margcal.workflow.simulated_node import NOMINAL_SCALE, Field, NodeErrors, readings, true_calibration

NODE_HZ, OPTICS_HZ = 75.0, 100.0
"""The paper's rates."""

UP = np.array([0.0, 0.0, STANDARD_GRAVITY])
FIELD_UT, DIP = 49.0, math.radians(66.5)
"""About the field in Aachen; the paper says neither."""

NORTH = FIELD_UT * np.array([0.0, math.cos(DIP), -math.sin(DIP)])

PLATE = {"A": (0.0, 0.0, 0.0), "B": (0.10, 0.0, 0.0), "C": (0.06, 0.08, 0.0), "D": (0.02, 0.04, 0.05)}
"""Markers on the plate, m, in k."""


@dataclass(frozen=True)
class Setting:
    """What the paper does not say. Angles in degrees, biases in parts of what `simulated_node.BIAS` allows.

    The nodes' errors are small enough for what the paper does say, that without a calibration roll and pitch are right
    and yaw is not.

    `still_s`, `moved_s`, `walk_s` are begin and end of the trials on the node's clock, `hard_iron_uT` the length of the
    magnetometer's whole offset, `yaw` is the largest angle between the wand's y and magnetic north; a
    session draws its own, evenly.
    """

    yaw: float = 15.0
    wand_level: float = 0.3
    plate: float = 2.0
    scale_error: float = 0.05
    non_orthogonality: float = 1.0
    mounting: float = 1.5
    soft_iron: float = 0.02
    hard_iron_uT: float = 2.5
    bias: float = 0.15
    hand_mps2: float = 1.0
    marker_noise_m: float = 2e-4
    offset_s: float = 0.137
    drift_ppm: float = 30.0
    still_s: tuple[float, float] = (0.0, 15.0)
    moved_s: tuple[float, float] = (20.0, 80.0)
    walk_s: tuple[float, float] = (90.0, 150.0)

    def decalibrated(self, factor: float) -> Setting:
        """All errors of the nodes and the plate `factor` times as large."""
        return replace(
            self,
            plate=factor * self.plate,
            scale_error=factor * self.scale_error,
            non_orthogonality=factor * self.non_orthogonality,
            mounting=factor * self.mounting,
            soft_iron=factor * self.soft_iron,
            hard_iron_uT=factor * self.hard_iron_uT,
            bias=factor * self.bias,
        )


@dataclass(frozen=True)
class Trial:
    """One node's recording, in the units that its data sheet gives, and what the cameras saw of it."""

    recording: Recording
    reference: Reference


@dataclass(frozen=True)
class Node:
    """A node with its three trials and the truth: `truth` in frame h, R_kh, R_nm; `perfect` is the walk with sensors
    that have noise only."""

    place: Place
    still: Trial
    moved: Trial
    walk: Trial
    perfect: Recording
    truth: Calibration
    R_kh: Array
    R_nm: Array


@dataclass(frozen=True)
class _Later:
    """A motion that begins at `start`."""

    motion: GaitNode
    start: float

    def at(self, t: Array) -> State:
        return self.motion.at(t - self.start)

    def position(self, t: Array) -> Array:
        return self.motion.position(t - self.start)


@dataclass(frozen=True)
class Session:
    """A walker with three nodes before one set of cameras."""

    nodes: dict[Place, Node]
    yaw_deg: float
    setting: Setting = field(repr=False)

    @property
    def R_nm(self) -> Array:
        return next(iter(self.nodes.values())).R_nm


def session(seed: int, setting: Setting | None = None, *, yaw_deg: float | None = None) -> Session:
    """A session; the same `seed` gives the same walker, hand and noise whatever the setting.

    Parameters
    ----------
    seed : int
    setting : Setting, optional
    yaw_deg : float, optional
        Of the wand, instead of a drawn one.
    """
    setting = setting or Setting()
    wand, walk, *each = np.random.default_rng([seed, 5]).spawn(2 + len(PLACES))
    drawn, tilt = setting.yaw * wand.uniform(-1, 1), np.radians(setting.wand_level) * wand.normal(size=3)
    yaw = drawn if yaw_deg is None else yaw_deg
    R_nm = so3.exp(np.array([0.0, 0.0, math.radians(yaw)])) @ so3.exp(tilt * np.array([1.0, 1.0, 0.0]))
    walked = walker(walk)
    nodes: dict[Place, Node] = {
        place: _node(place, GaitNode(walked, place), R_nm, setting, 3 * seed + k, rng)
        for k, (place, rng) in enumerate(zip(PLACES, each))
    }
    return Session(nodes, yaw, setting)


def _node(place: Place, walking: GaitNode, R_nm: Array, setting: Setting, seed: int, rng: np.random.Generator) -> Node:
    frames, hand, *noise = rng.spawn(6)
    R_kh = so3.exp(math.radians(setting.plate) * random_directions(frames, 1)[0])
    truth = _true_node(setting, seed)
    seen = _Cameras(R_nm, R_kh, setting)
    still, moved = carried(hand, 0.0, still=True), carried(hand, setting.hand_mps2)
    walk = _Later(walking, setting.walk_s[0])

    def trial(motion: Carried | _Later, when: tuple[float, float], name: str, rng: np.random.Generator) -> Trial:
        recording = _recorded(motion, truth, when, setting, rng, f"{place}-{name}")
        return Trial(recording, seen.reference(motion, when, rng))

    return Node(
        place,
        still=trial(still, setting.still_s, "still", noise[0]),
        moved=trial(moved, setting.moved_s, "moved", noise[1]),
        walk=trial(walk, setting.walk_s, "walk", noise[2]),
        perfect=_recorded(walk, _perfect(), setting.walk_s, setting, noise[3], f"{place}-perfect"),
        truth=truth,
        R_kh=R_kh,
        R_nm=R_nm,
    )


def _true_node(setting: Setting, seed: int) -> Calibration:
    """In SI by the data sheet: readings divided by the nominal scale."""
    errors = NodeErrors(
        setting.scale_error,
        setting.non_orthogonality,
        setting.mounting,
        setting.soft_iron,
        setting.hard_iron_uT,
    )
    counts = true_calibration(errors, {"acc": UP, "mag": NORTH}, KINDS, seed)
    models: dict[str, SensorModel] = {}
    for kind, m in counts.models.items():
        scale = NOMINAL_SCALE[kind]
        B = setting.bias * m.B / scale
        if kind == "mag":
            B = setting.hard_iron_uT * m.B / np.linalg.norm(m.B)
        models[kind] = replace(m, H=m.H * scale, B=B, raw_unit=_UNIT[kind])
    return replace(counts, **models)


_UNIT: dict[Kind, str] = {"acc": "mps2", "gyr": "radps", "mag": "uT"}


def _perfect() -> Calibration:
    models = {k: SensorModel(k, np.eye(3), np.zeros(3), raw_unit=_UNIT[k]) for k in KINDS}
    return Calibration(models["acc"], models["gyr"], models["mag"])


def _recorded(
    motion: Carried | _Later,
    truth: Calibration,
    when: tuple[float, float],
    setting: Setting,
    rng: np.random.Generator,
    name: str,
) -> Recording:
    """The node's readings, rounded as its converters round, on its own clock."""
    t = when[0] + np.arange(math.floor((when[1] - when[0]) * NODE_HZ)) / NODE_HZ
    t_true = setting.offset_s + (1 + setting.drift_ppm * 1e-6) * t
    counts = {
        k: replace(m, H=m.H / NOMINAL_SCALE[k], B=m.B * NOMINAL_SCALE[k], raw_unit="count")
        for k, m in truth.models.items()
    }
    clocks: dict[Kind, Array] = dict.fromkeys(KINDS, t_true)
    streams = readings(motion, replace(truth, **counts), clocks, UP, Field(NORTH), rng)
    in_si = {k: replace(s, t=t, y=s.y / NOMINAL_SCALE[k], unit=_UNIT[k]) for k, s in streams.items()}
    return Recording(in_si["acc"], in_si["gyr"], in_si["mag"], source=name)


@dataclass(frozen=True)
class _Cameras:
    R_nm: Array
    R_kh: Array
    setting: Setting

    def reference(self, motion: Carried | _Later, when: tuple[float, float], rng: np.random.Generator) -> Reference:
        """The plate's attitude and position from its markers; now and then a marker is hidden."""
        begin, end = (self.setting.offset_s + (1 + self.setting.drift_ppm * 1e-6) * v for v in when)
        t = math.ceil(begin * OPTICS_HZ) / OPTICS_HZ + np.arange(math.floor((end - begin) * OPTICS_HZ)) / OPTICS_HZ
        state = motion.at(t)
        R_mk = self.R_nm.T @ state.R @ self.R_kh.T
        places = np.array(list(PLATE.values())) - np.array([0.04, 0.03, -0.01])  # from the sensors
        x = (motion.position(t) @ self.R_nm)[:, None] + np.einsum("nij,mj->nmi", R_mk, places)
        x = x + np.array([0.3, 1.2, 0.9]) + self.setting.marker_noise_m * rng.normal(size=x.shape)
        for marker, start in zip(rng.integers(0, 4, 6), rng.uniform(t[0], t[-1], 6)):
            x[(t >= start) & (t < start + 0.3), marker] = np.nan
        return marker_reference(Markers(tuple(PLATE), t, x), template=PLATE)
