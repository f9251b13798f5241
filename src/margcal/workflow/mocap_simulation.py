"""A simulated node on a marker body in front of simulated cameras, with the truth.

The node turns about all axes and is moved about as a hand or a leg does; the cameras see the marker body that it is
fixed to, in a laboratory frame of their own, on a clock of their own, with noise and gaps. Everything is a closed form
of time: attitude, rate, position and acceleration agree exactly.

=============  ===============================================================================
name here      meaning
=============  ===============================================================================
n, m           earth (ENU) and the laboratory frame of the cameras, turned by `yaw_deg` and a little tilt
h, k           node (its housing; see `gyr_symmetric` for the frame of `align`) and marker body
t_ref          time of the cameras: ``t_ref = offset_s + (1 + drift_ppm 1e-6) t_node``
=============  ===============================================================================
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from margcal.core import so3
from margcal.core.errors import InputError
from margcal.core.types import Alignment, Array, Calibration, Kind, Recording, Reference, SensorModel, Stream
from margcal.core.units import KINDS, STANDARD_GRAVITY
from margcal.workflow.motion import State, Swing, random_directions
from margcal.workflow.simulate import check_new, tables_of
from margcal.workflow.simulated_node import NOMINAL_SCALE, Field, NodeErrors, readings, true_calibration

TONES = 60
"""Sinusoids in each axis of the translation: enough for a spectrum without lines."""
CORNER_HZ = 0.8
"""Up to here the excursions of a hand are of one size; faster ones shrink with the square of their frequency."""


@dataclass(frozen=True)
class Carried:
    """Turned as `turning` turns, carried along sums of sinusoids: `size` (TONES, 3) m, `hz`, `phase` alike.

    `still`: held as at time 0.
    """

    turning: Swing
    size: Array
    hz: Array
    phase: Array
    still: bool = False

    def at(self, t: Array) -> State:
        """The node's state at times `t` (N,), s."""
        t = np.asarray(t, dtype=np.float64)
        state = self.turning.at(np.zeros_like(t) if self.still else t)
        if self.still:
            nothing = np.zeros((len(t), 3))
            return State(state.R, nothing, nothing)
        turn = 2 * np.pi * self.hz
        acceleration = -np.sum(self.size * turn**2 * np.sin(turn * t[:, None, None] + self.phase), axis=1)
        return State(state.R, state.rate, acceleration)

    def position(self, t: Array) -> Array:
        """Position (N, 3) of the node in n, m."""
        t = np.zeros_like(t) if self.still else np.asarray(t, dtype=np.float64)
        return np.sum(self.size * np.sin(2 * np.pi * self.hz * t[:, None, None] + self.phase), axis=1)


def carried(
    rng: np.random.Generator,
    acceleration_rms: float,
    *,
    rotation: float = 1.0,
    hz: tuple[float, float] = (0.03, 2.5),
    still: bool = False,
) -> Carried:
    """A motion with rotation about all axes (up to about 70, 100 and 180 deg/s) and the given rms acceleration.

    Parameters
    ----------
    acceleration_rms : float, m/s^2
        Root mean square of the length of the linear acceleration.
    rotation : float
        Factor on the angles turned through.
    hz : tuple of float
        Least and largest frequency of the translation; its tones are spread evenly over their logarithm.
    """
    pace = np.array([0.2, 0.37, 0.53]) * 2 * rng.uniform(0.9, 1.1, 3)
    turning = Swing(rotation * np.array([3.0, 2.4, 3.0]), pace, rng.uniform(0, 2 * np.pi, 3), np.zeros(3), np.ones(3))
    tone = np.exp(rng.uniform(math.log(hz[0]), math.log(hz[1]), (TONES, 3)))
    size = rng.uniform(0.5, 1.0, (TONES, 3)) / (1 + (tone / CORNER_HZ) ** 2)
    power = float(np.sum((size * (2 * np.pi * tone) ** 2) ** 2) / 2)
    return Carried(
        turning, size * acceleration_rms / math.sqrt(power), tone, rng.uniform(0, 2 * np.pi, (TONES, 3)), still
    )


@dataclass(frozen=True)
class MocapSimulation:
    """Node and cameras, and the truth behind them.

    `truth` is in the frame 'housing' with `alignment`; `gyr_symmetric` is the same calibration in the frame that
    `align` gives. `motion` is the node's in n.
    """

    recording: Recording
    reference: Reference
    truth: Calibration
    R_kh: Array
    R_nm: Array
    motion: Carried = field(repr=False)

    @property
    def gyr_symmetric(self) -> Calibration:
        """The truth in the frame in which the gyroscope's H is symmetric."""
        return gyr_symmetric(self.truth)


def simulate_mocap(
    *,
    seed: int = 0,
    node_seed: int | None = None,
    duration_s: float = 60.0,
    rate: float = 75.0,
    optics_rate: float = 100.0,
    acceleration_rms: float = 0.0,
    rotation: float = 1.0,
    translation_hz: tuple[float, float] = (0.03, 2.5),
    lever_arm_m: tuple[float, float, float] = (0.03, -0.02, 0.01),
    marker_deg: float = 20.0,
    yaw_deg: float = 25.0,
    offset_s: float = 0.0,
    drift_ppm: float = 0.0,
    delays_s: Mapping[Kind, float] | None = None,
    noise: float = 1.0,
    quantise: bool = True,
    unit: Literal["count", "si"] = "count",
    optics_noise_m: float = 2e-4,
    optics_noise_deg: float = 0.1,
    gaps: int = 0,
    scale_error: float = 0.06,
    non_orthogonality_deg: float = 1.15,
    mounting_deg: float = 4.0,
    soft_iron: float = 0.02,
    hard_iron_uT: float = 30.0,
    dip_deg: float = 66.5,
    field_uT: float = 49.1,
    gravity: float = STANDARD_GRAVITY,
    sensors: tuple[Kind, ...] = KINDS,
    still: bool = False,
) -> MocapSimulation:
    """A node and cameras watching it.

    Parameters
    ----------
    seed : int
        Motion, frames and noise each have random numbers of their own.
    node_seed : int, optional
        Seed of the node and its mounting on the marker body alone; `seed` if left out. With `still` this gives the
        static trial of a recording: same node, same frames.
    rate, optics_rate : float, Hz
    acceleration_rms, rotation, translation_hz
        See `carried`; `rotation=0` is a trial of pure translation.
    lever_arm_m : tuple of float, m
        From the marker body's origin to the sensors, marker body's axes.
    marker_deg : float
        Angle between node and marker body.
    yaw_deg : float
        Angle between magnetic north and the laboratory's y axis; the laboratory is also tilted by about 1 degree.
    offset_s, drift_ppm : float
        Of the clocks.
    delays_s : mapping, s
        Delay of each sensor, such as ``{'mag': 0.011}``.
    unit : {'count', 'si'}
        Raw counts, or the same divided by the nominal scale.
    optics_noise_m, optics_noise_deg : float
        Of a sample, per axis.
    gaps : int
        Of 0.3 to 1.5 s, in which the body is not seen.
    still : bool
        The node lies still all the time, at one attitude.

    Raises
    ------
    InputError
        If an option is out of range.
    """
    if min(duration_s, rate, optics_rate) <= 0 or acceleration_rms < 0:
        raise InputError("duration_s, rate and optics_rate must be above zero, acceleration_rms not below it")
    motion_rng, noise_rng, optics_rng = np.random.default_rng([seed, 11]).spawn(3)
    frame_rng = np.random.default_rng([seed if node_seed is None else node_seed, 12])
    R_kh = so3.exp(math.radians(marker_deg) * random_directions(frame_rng, 1)[0])
    tilt = np.radians(frame_rng.normal(0, 0.7, 3)) * np.array([1.0, 1.0, 0.0])
    R_nm = so3.exp(np.array([0.0, 0.0, math.radians(yaw_deg)])) @ so3.exp(tilt)
    up, dip = np.array([0.0, 0.0, gravity]), math.radians(dip_deg)
    north = field_uT * np.array([0.0, math.cos(dip), -math.sin(dip)])
    truth = _true_node(
        NodeErrors(scale_error, non_orthogonality_deg, mounting_deg, soft_iron, hard_iron_uT),
        {"acc": R_nm.T @ up, "mag": R_nm.T @ north},
        sensors,
        seed if node_seed is None else node_seed,
        delays_s or {},
    )
    motion = carried(motion_rng, acceleration_rms, rotation=rotation, hz=translation_hz, still=still)
    t_node = np.arange(math.floor(duration_s * rate)) / rate
    t_true = offset_s + (1 + drift_ppm * 1e-6) * t_node
    clocks: dict[Kind, Array] = dict.fromkeys(KINDS, t_true)
    streams = readings(motion, truth, clocks, up, Field(north), noise_rng, noise=noise, quantise=quantise)
    for kind in streams:
        streams[kind] = replace(streams[kind], t=t_node)
    if unit == "si":
        streams, truth = _nominal(streams, truth)
    begin, end = min(t_true[0], 0.0), t_true[-1]
    t_ref = begin + np.arange(math.floor((end - begin) * optics_rate) + 1) / optics_rate
    lever = np.asarray(lever_arm_m, dtype=np.float64)
    reference = _seen(motion, t_ref, R_kh, R_nm, lever, optics_noise_m, optics_noise_deg, gaps, optics_rng)
    alignment = Alignment(
        common_clock=False,
        values={
            "offset_s": offset_s,
            "drift_ppm": drift_ppm,
            "marker_to_node": so3.quat_from_matrix(R_kh.T),
            "lab_to_earth": so3.quat_from_matrix(R_nm),
            "lever_arm_m": lever,
        },
    )
    recording = Recording(streams.get("acc"), streams.get("gyr"), streams.get("mag"), source=f"mocap-{seed}")
    return MocapSimulation(recording, reference, replace(truth, alignment=alignment), R_kh, R_nm, motion)


def write_mocap(simulation: MocapSimulation, folder: str | Path, *, overwrite: bool = False) -> tuple[Path, Path, Path]:
    """Write session.parquet, reference.parquet and truth.json (in the frame that `align` gives) into `folder`.

    Returns
    -------
    tuple of Path
        Recording, reference (``t_s ref_qw ... ref_p_x_m ...``), truth (schema of a calibration file).

    Raises
    ------
    InputError
        If one of them exists and `overwrite` is False; nothing is written then.
    """
    from margcal.files.calfile import save
    from margcal.files.tables import write_table

    folder = Path(folder)
    session, reference, truth = (folder / name for name in ("session.parquet", "reference.parquet", "truth.json"))
    check_new((session, reference, truth), overwrite)
    folder.mkdir(parents=True, exist_ok=True)
    (columns,) = tables_of(simulation.recording).values()  # one clock
    write_table(session, columns, overwrite=overwrite)
    seen = simulation.reference
    columns = {"t_s": seen.t} | {f"ref_q{c}": seen.q[:, i] for i, c in enumerate("wxyz")}
    if seen.p is not None:
        columns |= {f"ref_p_{c}_m": seen.p[:, i] for i, c in enumerate("xyz")}
    write_table(reference, columns, overwrite=overwrite)
    save(simulation.gyr_symmetric, truth, overwrite=overwrite)
    return session, reference, truth


def gyr_symmetric(calibration: Calibration) -> Calibration:
    """`calibration` with a gyroscope in the frame in which its H is symmetric (R-BSN (17)).

    Raises
    ------
    InputError
        If there is no gyroscope.
    """
    if calibration.gyr is None:
        raise InputError("without a gyroscope there is no frame 'gyr-symmetric'")
    C = so3.polar(calibration.gyr.H)[0]
    turned = {kind: replace(m, H=C.T @ m.H, covariance=None) for kind, m in calibration.models.items()}
    alignment = calibration.alignment
    if alignment is not None and "marker_to_node" in alignment.values:
        old = so3.matrix_from_quat(alignment.values["marker_to_node"])
        values = dict(alignment.values) | {"marker_to_node": so3.quat_from_matrix(C.T @ old)}
        alignment = replace(alignment, values=values)
    return replace(calibration, frame="gyr-symmetric", alignment=alignment, **turned)


def _true_node(
    errors: NodeErrors,
    vectors: Mapping[Kind, Array],
    sensors: tuple[Kind, ...],
    seed: int,
    delays: Mapping[Kind, float],
) -> Calibration:
    truth = true_calibration(errors, vectors, sensors, seed)
    if not delays:
        return truth
    models = {k: replace(m, delay_s=delays.get(k, 0.0)) for k, m in truth.models.items()}
    return replace(truth, **models)


def _nominal(streams: dict[Kind, Stream], truth: Calibration) -> tuple[dict[Kind, Stream], Calibration]:
    """Readings in SI by the data sheet's scale, and the truth for them."""
    units = {"acc": "mps2", "gyr": "radps", "mag": "uT"}
    models: dict[str, SensorModel] = {}
    found: dict[Kind, Stream] = {}
    for kind, stream in streams.items():
        scale = NOMINAL_SCALE[kind]
        found[kind] = Stream(kind, stream.t, stream.y / scale, units[kind])
        m = truth.models[kind]
        models[kind] = replace(m, H=m.H * scale, B=m.B / scale, raw_unit=units[kind])
    return found, replace(truth, **models)


def _seen(
    motion: Carried,
    t: Array,
    R_kh: Array,
    R_nm: Array,
    lever: Array,
    noise_m: float,
    noise_deg: float,
    gaps: int,
    rng: np.random.Generator,
) -> Reference:
    """What the cameras report: the marker body's attitude and position in m."""
    R_mk = R_nm.T @ motion.at(t).R @ R_kh.T
    p = motion.position(t) @ R_nm - R_mk @ lever  # rows: R_nm^T p_n, less the way from origin to sensor
    R = R_mk @ so3.exp(math.radians(noise_deg) * rng.normal(size=(len(t), 3)))
    p = p + noise_m * rng.normal(size=p.shape)
    q = so3.quat_from_matrix(R)
    for begin, length in zip(rng.uniform(t[0], t[-1], gaps), rng.uniform(0.3, 1.5, gaps)):
        hidden = (t >= begin) & (t < begin + length)
        q[hidden], p[hidden] = np.nan, np.nan
    return Reference(t, q, p)
