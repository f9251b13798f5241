"""A simulated sensor node: known errors, known attitudes, plausible motion, raw counts.

`simulate` puts a node down in attitudes and turns it between them, `swing` waves it about. Both return the
recording as a user would have it, with the truth beside it. What is simulated:

- three triads with bias, scale factors, non-orthogonality and mounting of their own, and for the magnetometer
  hard and soft iron and, if asked, the swapped and flipped axes of common boards;
- a housing that is not perfect: attitudes differ from their labels by a small rotation each;
- the hand: smooth turns with tremor and linear acceleration; knocks inside rests;
- white noise, rounding to integers, saturation at 16 bits.

Not simulated: the earth's rotation (15 degrees an hour, far below a MEMS gyroscope's noise), temperature
drift and lever arms between the sensors.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike

from margcal.core import so3
from margcal.core.errors import InputError
from margcal.core.types import Array, Calibration, Kind, Recording
from margcal.core.units import KINDS, STANDARD_GRAVITY
from margcal.workflow.motion import (
    Motion,
    PoseSet,
    Swing,
    attitudes,
    by_hand,
    knock_times,
    put_down,
    random_directions,
)
from margcal.workflow.simulated_node import (
    BOARD_AXES,
    Field,
    NodeErrors,
    readings,
    reference_track,
    true_calibration,
)

if TYPE_CHECKING:
    from margcal.workflow.place import Place


_QUARTER_TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Simulation:
    """A recording and the truth behind it.

    Attributes
    ----------
    recording : Recording, in counts
    truth : Calibration
        Frame 'housing', `reference_vector` in n, verdict None.
    R_nh : ndarray (J, 3, 3)
        True attitude of the housing in each rest.
    nominal : ndarray (J, 3, 3)
        The attitudes as a user would write them down: without housing error and tilt, with a wrong label if
        one was asked for.
    start, stop : ndarray (J,), s
        True ends of the rests.
    knocks : ndarray (K, 2), s
        Start and end of each knock.
    motion : Motion
        ``motion.at(t)`` is the true state at any time.
    """

    recording: Recording
    truth: Calibration
    R_nh: Array
    nominal: Array
    start: Array
    stop: Array
    knocks: Array
    motion: Motion = field(repr=False)


def simulate(
    *,
    seed: int = 0,
    node_seed: int | None = None,
    n_poses: int = 24,
    poses: PoseSet = "cube",
    rate: float = 100.0,
    rest_s: float = 5.0,
    turn_s: float = 1.5,
    housing_sd_deg: float = 0.2,
    level_sd_deg: float = 0.0,
    mounting_deg: float = 4.0,
    scale_error: float = 0.08,
    non_orthogonality_deg: float = 1.0,
    soft_iron: float = 0.05,
    hard_iron_uT: float = 30.0,
    mag_axes: Literal["board"] | ArrayLike | None = None,
    place: Place | None = None,
    gravity: float = STANDARD_GRAVITY,
    dip_deg: float = 66.5,
    field_uT: float = 49.1,
    noise: float = 1.0,
    quantise: bool = True,
    knocks: int = 0,
    reference: bool = False,
    reference_noise_deg: float = 0.05,
    reference_gaps: int = 0,
    sensors: tuple[Kind, ...] = ("acc", "gyr", "mag"),
    separate_clocks: bool = False,
    disturbed: int | None = None,
    disturbance: float = 0.05,
    wrong_label: int | None = None,
    temperature_degC: float | None = None,
    mag_delay_s: float = 0.0,
) -> Simulation:
    """A node put down in `n_poses` attitudes and turned between them.

    Parameters
    ----------
    seed : int
        Attitudes, motion, node and noise each have a stream of random numbers of their own: an option
        changes nothing but what it says.
    node_seed : int, optional
        Seed of the node alone, for several recordings of one node; `seed` if left out. `swing` makes the same
        node of it.
    poses : {'cube', 'free', 'faces'}
        Attitudes of a cube (every six rests show all six faces), any attitudes, or one of six faces up with
        any heading.
    rate : float, Hz
    rest_s, turn_s : float, s
    housing_sd_deg : float, deg per axis
        The housing's own error, anew in every rest.
    level_sd_deg : float, deg per horizontal axis
        Tilt of the table, anew in every rest.
    mounting_deg, scale_error, non_orthogonality_deg, soft_iron, hard_iron_uT, mag_axes
        The node; see `NodeErrors`. ``mag_axes='board'``: see `BOARD_AXES`.
    place : Place, optional
        Gravity and field of a place on earth instead of `gravity` (m/s^2), `dip_deg`, `field_uT`.
    noise : float
        Factor on `NOISE`.
    quantise : bool
        Round to whole counts and saturate at 16 bits.
    knocks : int
        Short knocks inside rests.
    reference : bool
        Add the reference attitude of the housing, with `reference_noise_deg` per axis and `reference_gaps`.
    separate_clocks : bool
        Each sensor on its own clock and rate (accelerometer `rate`, gyroscope 1.37 times, magnetometer half).
    disturbed : int, optional
        The rest whose field is changed by `disturbance` (relative to the field) in some direction.
    wrong_label : int, optional
        The rest whose label in `nominal` is wrong by a quarter turn.
    temperature_degC : float, optional
        Add a temperature that rises from this by a degree. It has no effect.
    mag_delay_s : float, s
        The magnetometer shows what was so long ago.

    Returns
    -------
    Simulation

    Raises
    ------
    InputError
        If an option is out of range.
    """
    seconds = {"rate": rate, "rest_s": rest_s, "turn_s": turn_s}
    _check(n_poses, poses, seconds, sensors, disturbed, wrong_label)
    pose_rng, motion_rng, noise_rng, knock_rng, other_rng = np.random.default_rng([seed, 1]).spawn(5)
    up, north = _vectors(place, gravity, dip_deg, field_uT)
    errors = NodeErrors(scale_error, non_orthogonality_deg, mounting_deg, soft_iron, hard_iron_uT, _mag_axes(mag_axes))
    label = attitudes(poses, n_poses, pose_rng)
    R_nh = put_down(label, housing_sd_deg, level_sd_deg, pose_rng)
    start = np.arange(n_poses, dtype=np.float64) * (rest_s + turn_s)
    stop: Array = start + np.float64(rest_s)
    knocked = knock_times(start, stop, knocks, knock_rng)
    motion = by_hand(R_nh, start, stop, knocked, motion_rng)
    truth = true_calibration(
        errors,
        {"acc": up, "mag": north},
        sensors,
        seed if node_seed is None else node_seed,
        mag_delay_s=mag_delay_s,
        temperature_degC=None if temperature_degC is None else temperature_degC + 0.5,
    )
    magnetic = Field(north)
    if disturbed is not None:
        size = disturbance * float(np.linalg.norm(north))
        magnetic = Field(north, size * random_directions(other_rng, 1)[0], start[disturbed], stop[disturbed], turn_s)
    if wrong_label is not None:
        label[wrong_label] = label[wrong_label] @ _QUARTER_TURN
    clocks = _clocks(stop[-1], rate, separate_clocks)
    t = clocks[min(sensors, key=KINDS.index)]  # the clock of what is not a sensor
    warmth = None
    if temperature_degC is not None:
        warmth = (t, np.round(temperature_degC + t / t[-1] + other_rng.normal(0, 0.05, len(t)), 2))
    track = reference_track(motion, t, reference_noise_deg, reference_gaps, other_rng)
    recording = Recording(
        **readings(motion, truth, clocks, up, magnetic, noise_rng, noise=noise, quantise=quantise),
        temperature=warmth,
        reference=track if reference else None,
        source=f"simulation-{seed}",
    )
    return Simulation(recording, truth, R_nh, label, start, stop, knocked, motion)


def swing(
    *,
    seed: int = 0,
    node_seed: int | None = None,
    duration_s: float = 60.0,
    rate: float = 100.0,
    mounting_deg: float = 4.0,
    scale_error: float = 0.08,
    non_orthogonality_deg: float = 1.0,
    soft_iron: float = 0.05,
    hard_iron_uT: float = 30.0,
    mag_axes: Literal["board"] | ArrayLike | None = None,
    place: Place | None = None,
    gravity: float = STANDARD_GRAVITY,
    dip_deg: float = 66.5,
    field_uT: float = 49.1,
    noise: float = 1.0,
    quantise: bool = True,
    sensors: tuple[Kind, ...] = ("acc", "gyr", "mag"),
    separate_clocks: bool = False,
    mag_delay_s: float = 0.0,
) -> Simulation:
    """A node waved about without rests, so that its magnetometer sees the field from everywhere.

    Parameters are those of `simulate`. `R_nh`, `nominal`, `start`, `stop` of the result are empty.
    """
    _check(1, "free", {"rate": rate, "duration_s": duration_s}, sensors)
    motion_rng, noise_rng = np.random.default_rng([seed, 2]).spawn(2)
    up, north = _vectors(place, gravity, dip_deg, field_uT)
    errors = NodeErrors(scale_error, non_orthogonality_deg, mounting_deg, soft_iron, hard_iron_uT, _mag_axes(mag_axes))
    truth = true_calibration(
        errors,
        {"acc": up, "mag": north},
        sensors,
        seed if node_seed is None else node_seed,
        mag_delay_s=mag_delay_s,
    )
    # up to 35, 100 and 140 deg/s, in no simple ratio: the field's direction fills the sphere
    pace = np.array([0.2, 0.37, 0.53]) * motion_rng.uniform(0.9, 1.1, 3)
    phase = motion_rng.uniform(0, 2 * np.pi, 3)
    sway, sway_hz = motion_rng.uniform(0.05, 0.15, 3), motion_rng.uniform(0.3, 0.8, 3)
    motion = Swing(np.array([3.0, 4.7, 4.7]), pace, phase, sway, sway_hz)
    clocks = _clocks(duration_s, rate, separate_clocks)
    streams = readings(motion, truth, clocks, up, Field(north), noise_rng, noise=noise, quantise=quantise)
    none = np.zeros((0, 3, 3))
    recording = Recording(**streams, source=f"swing-{seed}")
    return Simulation(recording, truth, none, none, np.zeros(0), np.zeros(0), np.zeros((0, 2)), motion)


def write_simulation(simulation: Simulation, folder: str | Path, *, overwrite: bool = False) -> tuple[Path, Path, Path]:
    """Write session.parquet (or a folder `session`, a table a clock), poses.csv and truth.json into `folder`.

    Returns
    -------
    tuple of Path
        Recording, poses file (not written for a swing, which has no rests), truth (schema of a calibration
        file).

    Raises
    ------
    InputError
        If one of them exists and `overwrite` is False; nothing is written then.
    """
    from margcal.files.calfile import save
    from margcal.files.tables import write_table

    folder = Path(folder)
    tables = tables_of(simulation.recording)
    session = folder / ("session.parquet" if len(tables) == 1 else "session")
    poses, truth = folder / "poses.csv", folder / "truth.json"
    check_new((session, poses, truth), overwrite)
    (session if len(tables) > 1 else folder).mkdir(parents=True, exist_ok=True)
    for name, columns in tables.items():
        path = session if len(tables) == 1 else session / f"{name}.parquet"
        write_table(path, columns, overwrite=overwrite)
    if len(simulation.start):
        q = so3.quat_from_matrix(simulation.nominal)
        columns = {"start_s": simulation.start, "stop_s": simulation.stop}
        columns |= {f"q{c}": q[:, i] for i, c in enumerate("wxyz")}
        write_table(poses, columns, overwrite=overwrite)
    save(simulation.truth, truth, overwrite=overwrite)
    return session, poses, truth


def check_new(paths: Iterable[Path], overwrite: bool) -> None:
    """Raise `InputError` if one of `paths` exists and may not be overwritten."""
    for path in paths:
        if path.exists() and not overwrite:
            raise InputError(f"{path} exists; choose another folder or allow it to be overwritten")


def tables_of(recording: Recording) -> dict[str, dict[str, Array]]:
    """Columns by table: one table if all sensors share a clock, else one a sensor."""
    streams = recording.streams
    clocks = [s.t for s in streams.values()]
    shared = all(np.array_equal(clocks[0], t) for t in clocks[1:])
    tables: dict[str, dict[str, Array]] = {}
    for kind, stream in streams.items():
        table = tables.setdefault("session" if shared else kind, {"t_s": stream.t})
        table |= {f"{kind}_{axis}_{stream.unit}": stream.y[:, i] for i, axis in enumerate("xyz")}
    first = next(iter(tables.values()))  # temperature and reference are on the clock of the first sensor
    if recording.temperature is not None:
        first["temp_degC"] = recording.temperature[1]
    if recording.reference is not None:
        first |= {f"ref_q{c}": recording.reference.q[:, i] for i, c in enumerate("wxyz")}
    return tables


def _check(
    n_poses: int,
    poses: str,
    seconds: Mapping[str, float],
    sensors: tuple[Kind, ...],
    *indices: int | None,
) -> None:
    if poses not in ("cube", "free", "faces"):
        raise InputError(f"poses {poses!r} is none of cube, free, faces")
    if n_poses < 1:
        raise InputError(f"n_poses is {n_poses}; at least one rest is needed")
    for name, value in seconds.items():
        if not (math.isfinite(value) and value > 0):
            raise InputError(f"{name} is {value}; it must be above zero")
    if not sensors or any(s not in KINDS for s in sensors):
        raise InputError(f"sensors {sensors!r}: choose some of {', '.join(KINDS)}")
    for index in indices:
        if index is not None and not 0 <= index < n_poses:
            raise InputError(f"there is no rest {index}: the rests are numbered 0 to {n_poses - 1}")


def _vectors(place: Place | None, gravity: float, dip_deg: float, field_uT: float) -> tuple[Array, Array]:
    """Specific force at rest and magnetic field in n."""
    if place is not None:
        return np.array([0.0, 0.0, place.gravity]), np.array(place.field.vector)
    dip = math.radians(dip_deg)
    return np.array([0.0, 0.0, gravity]), field_uT * np.array([0.0, math.cos(dip), -math.sin(dip)])


def _mag_axes(axes: Literal["board"] | ArrayLike | None) -> Array:
    if axes is None:
        return np.eye(3)
    if isinstance(axes, str):
        if axes != "board":
            raise InputError(f"mag_axes {axes!r} is neither 'board' nor a 3x3 matrix")
        return BOARD_AXES
    matrix = np.array(axes, dtype=np.float64)
    if matrix.shape != (3, 3) or not np.allclose(matrix @ matrix.T, np.eye(3)):
        raise InputError("mag_axes is not an orthogonal 3x3 matrix")
    return matrix


def _clocks(end: float, rate: float, separate: bool) -> dict[Kind, Array]:
    """Sample times from 0 to `end`; on separate clocks each sensor starts a little later than the last."""
    if not separate:
        t = np.arange(math.floor(end * rate + 1e-9) + 1) / rate
        return dict.fromkeys(KINDS, t)
    clocks: dict[Kind, Array] = {}
    for i, (kind, factor) in enumerate(zip(KINDS, (1.0, 1.37, 0.5))):
        begin = 0.0031 * i
        clocks[kind] = begin + np.arange(math.floor((end - begin) * rate * factor) + 1) / (rate * factor)
    return clocks
