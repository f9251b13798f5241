"""The few types that everything speaks in. Read this first.

    u = H (y - B)

`y` a raw reading (3,), `B` the combined bias in raw units, `H` the full 3x3 transformation matrix, `u` the
calibrated vector in physical units in ONE frame `h` common to the sensors of the node. Samples first,
components last: (N, 3), (J, 3), (J, 3, 3); J poses (rests), N samples. `R_ab` takes components from b to a:
``v_a = R_ab @ v_b``. SI inside: m/s^2, rad/s, s; magnetic field uT, or `norm` (local field = 1).

All types are frozen dataclasses; their arrays are float64, read-only and checked once, at construction.
NaN means "not measured".
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from margcal.core import compiled
from margcal.core.errors import InputError
from margcal.core.units import KINDS, SI_UNIT, Kind

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]
Level = Literal["note", "warn", "fail"]
Verdict = Literal["pass", "warn", "fail"]


def _frozen(value: ArrayLike, shape: tuple[int | None, ...], name: str) -> Array:
    """A read-only, C-contiguous float64 copy of `value` whose trailing axes have `shape` (None: any length).

    An array that is all this already is taken as it is: streams of 1e7 rows are not copied at every door.
    """
    if isinstance(value, np.ndarray) and value.dtype == np.float64 and not value.flags.writeable:
        array = np.asarray(value, order="C")
    else:
        array = np.array(value, dtype=np.float64, order="C")
    tail = array.shape[array.ndim - len(shape) :] if array.ndim >= len(shape) else None
    if tail is None or any(want is not None and want != have for want, have in zip(shape, tail)):
        wanted = ", ".join("n" if n is None else str(n) for n in shape)
        raise InputError(f"{name} has shape {array.shape}; expected (..., {wanted})")
    array.flags.writeable = False
    return array


@dataclass(frozen=True)
class Issue:
    """Something to know about the data or the result: data, never a print or an exit.

    Attributes
    ----------
    code : str
        Stable identifier in kebab-case, such as ``too-few-directions``.
    level : {'note', 'warn', 'fail'}
    text : str
        What, where, and what to do about it.
    sensor : {'acc', 'gyr', 'mag'} or None
    value, limit : float or None
        The figure that was looked at and the limit that it was held against.
    """

    code: str
    level: Level
    text: str
    sensor: Kind | None = None
    value: float | None = None
    limit: float | None = None


@dataclass(frozen=True)
class SensorModel:
    """One calibrated sensor: ``u = H (y - B)``, and how good it is.

    `H` (..., 3, 3) in `unit` per `raw_unit` and `B` (..., 3) in `raw_unit`; leading axes are nodes of a batch.
    `covariance` (12, 12) is that of (H row by row, then B). `reference_vector` is the sensed vector
    (specific force at rest, field) in the earth or laboratory frame. `expected_error_deg` is the rms angle
    between calibrated and true vector over the sphere, from the covariance.
    """

    kind: Kind
    H: Array
    B: Array
    raw_unit: str = "count"
    unit: str = ""
    covariance: Array | None = None
    residual_rms: float | None = None
    n_poses: int | None = None
    method: str = ""
    reference_vector: Array | None = None
    expected_error_deg: float | None = None
    delay_s: float | None = None
    delay_se_s: float | None = None
    temperature_degC: float | None = None

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise InputError(f"sensor kind {self.kind!r} is none of {', '.join(KINDS)}")
        _set(self, "H", _frozen(self.H, (3, 3), "H"))
        _set(self, "B", _frozen(self.B, (3,), "B"))
        _set(self, "unit", self.unit or SI_UNIT[self.kind])
        if self.covariance is not None:
            _set(self, "covariance", _frozen(self.covariance, (12, 12), "covariance"))
        if self.reference_vector is not None:
            _set(self, "reference_vector", _frozen(self.reference_vector, (3,), "reference_vector"))

    def apply(self, y: ArrayLike) -> Array:
        """Calibrated vectors ``u = H (y - B)``.

        Parameters
        ----------
        y : array_like (..., 3), raw unit

        Returns
        -------
        ndarray (..., 3), `unit`
        """
        y = np.asarray(y, dtype=np.float64)
        kernels = compiled.extension()
        if kernels is not None and self.H.ndim == 2 and y.ndim and y.shape[-1] == 3:
            y = np.ascontiguousarray(y)
            out = np.empty(y.shape)
            kernels.apply(y.reshape(-1, 3), self.H, self.B, out.reshape(-1, 3))
            return out
        with np.errstate(invalid="ignore", over="ignore"):  # a reading that is not finite is no accident here
            if self.H.ndim > 2:
                return np.einsum("...ij,...j->...i", self.H, y - self.B)
            if y.size < 3 * _BLOCK or not y.flags.c_contiguous:
                return (y - self.B) @ self.H.T
            return _apply_blocks(y.reshape(-1, 3), self.H, self.B).reshape(y.shape)

    def invert(self, u: ArrayLike) -> Array:
        """Raw readings ``y = H^-1 u + B`` that calibrated vectors `u` (..., 3) came from."""
        inverse = np.linalg.inv(self.H)
        return np.einsum("...ij,...j->...i", inverse, np.asarray(u, dtype=np.float64)) + self.B


_BLOCK, _LANES = 4096, 4
"""Rows that fit the cache with what is made of them, and rows that one row of the product takes at once."""


def _apply_blocks(y: Array, H: Array, B: Array) -> Array:
    """``(y - B) @ H.T`` in one pass over memory, twice as fast on long recordings.

    Matrix libraries are slow on products three wide, so `_LANES` rows are taken as one and multiplied by a
    block-diagonal H. A value that is not finite would spread to its neighbours (0 * NaN): such blocks are done
    row by row. B is subtracted first: raw counts are large, and H y - H B would lose their last digits.
    """
    out = np.empty_like(y)
    wide_H = np.kron(np.eye(_LANES), H.T)
    wide_B = np.tile(B, _LANES)
    difference = np.empty((_BLOCK // _LANES, 3 * _LANES))
    whole = len(y) - len(y) % _LANES
    for a in range(0, whole, _BLOCK):
        b = min(a + _BLOCK, whole)
        d = difference[: (b - a) // _LANES]
        np.subtract(y[a:b].reshape(-1, 3 * _LANES), wide_B, out=d)
        if np.isfinite(d.sum()):
            np.matmul(d, wide_H, out=out[a:b].reshape(-1, 3 * _LANES))
        else:
            np.matmul(d.reshape(-1, 3), H.T, out=out[a:b])
    out[whole:] = (y[whole:] - B) @ H.T
    return out


@dataclass(frozen=True)
class Fit:
    """What every solver returns.

    Attributes
    ----------
    model : SensorModel
        The estimate; leading axes of H and B are those of a batch.
    u : ndarray (..., 3) or None
        The sensed vector in the reference pose or laboratory frame, where the method estimates it.
    residual : ndarray (..., J)
        Misfit of each pose, in `model.unit` (gyroscope: of each turn, rad).
    cost : float or ndarray
        Value of the method's own cost function at the estimate.
    covariance : ndarray (12, 12) or None
        Of (H row by row, then B).
    rank : int
        Number of unknowns that the data determine.
    condition : float or ndarray
        Condition number (or the method's own figure, see its docstring).
    n_iter, converged, history
        `history` holds what the method keeps of each iteration (for instance arrays H and u).
    details
        Further figures of the method's own, each explained in its docstring (for instance `lambda2`,
        `u_covariance`, `sigma`, `weights`).
    method, cites : str
        Its name, and paper, section and equations.
    text : str
        What happened, in words, when `converged` is False.
    """

    model: SensorModel
    residual: Array
    cost: float | Array
    method: str
    cites: str = ""
    u: Array | None = None
    covariance: Array | None = None
    rank: int = 12
    condition: float | Array = float("nan")
    n_iter: int = 0
    converged: bool = True
    history: Mapping[str, Array] = field(default_factory=dict)
    details: Mapping[str, Array] = field(default_factory=dict)
    text: str = ""


@dataclass(frozen=True)
class Stream:
    """The samples of one sensor on its own clock: `t` (N,) s, `y` (N, 3) in `unit` (spelled as in a column)."""

    kind: Kind
    t: Array
    y: Array
    unit: str

    def __post_init__(self) -> None:
        _set(self, "t", _frozen(self.t, (None,), f"{self.kind} time"))
        _set(self, "y", _frozen(self.y, (None, 3), f"{self.kind} readings"))
        if len(self.t) != len(self.y):
            raise InputError(f"{self.kind}: {len(self.t)} times for {len(self.y)} readings")

    @property
    def rate(self) -> float:
        """Samples per second: count over span, never the median step (host clocks are bursty)."""
        span = self.t[-1] - self.t[0] if len(self.t) > 1 else 0.0
        return (len(self.t) - 1) / span if span > 0 else float("nan")


@dataclass(frozen=True)
class Reference:
    """Attitude (and position) from outside, NaN where the body was not seen.

    `q` (N, 4) scalar first, body to laboratory; `p` (N, 3) in m or None.
    """

    t: Array
    q: Array
    p: Array | None = None

    def __post_init__(self) -> None:
        _set(self, "t", _frozen(self.t, (None,), "reference time"))
        _set(self, "q", _frozen(self.q, (None, 4), "reference quaternions"))
        if self.p is not None:
            _set(self, "p", _frozen(self.p, (None, 3), "reference positions"))


@dataclass(frozen=True)
class Recording:
    """One recording of one node: a `Stream` for each sensor that it has, and a `Reference` perhaps.

    The clocks of the streams share an origin; each keeps its own rate. `source` is the file's name (for
    messages), `files` the paths read, `other` the names of columns that carry no sensor, `issues` what the
    reader had to mend or noticed.
    """

    acc: Stream | None = None
    gyr: Stream | None = None
    mag: Stream | None = None
    temperature: tuple[Array, Array] | None = None
    reference: Reference | None = None
    source: str = "recording"
    files: tuple[str, ...] = ()
    other: tuple[str, ...] = ()
    issues: tuple[Issue, ...] = ()

    @property
    def streams(self) -> dict[Kind, Stream]:
        """The streams that are there, by kind, in the order acc, gyr, mag."""
        found: dict[Kind, Stream | None] = {"acc": self.acc, "gyr": self.gyr, "mag": self.mag}
        return {k: s for k, s in found.items() if s is not None}

    @property
    def units(self) -> dict[Kind, str]:
        return {k: s.unit for k, s in self.streams.items()}

    @classmethod
    def from_arrays(
        cls,
        t: ArrayLike | None = None,
        *,
        acc: Any = None,
        gyr: Any = None,
        mag: Any = None,
        units: Mapping[str, str] | None = None,
        rate: float | None = None,
        reference: ArrayLike | None = None,
        source: str = "arrays",
    ) -> Recording:
        """A recording from NumPy arrays or pandas objects.

        Parameters
        ----------
        t : array_like (N,), s, optional
            Shared time of all sensors. Without it, `rate` must be given, or each sensor as ``(t, y)``.
        acc, gyr, mag : array_like (N, 3) or tuple of array_like (N,), (N, 3)
        units : mapping, such as ``{'acc': 'count', 'gyr': 'dps', 'mag': 'uT'}``
            The unit of each sensor as spelled in column names.
        rate : float, Hz
        reference : array_like (N, 4), optional
            Attitude quaternions, scalar first, body to laboratory.

        Raises
        ------
        InputError
            If a unit is missing or unknown, lengths differ, or time is missing or runs backwards.
        """
        from margcal.core.checking import checked_recording

        def split(kind: Kind, value: Any) -> Stream | None:
            if value is None:
                return None
            own_clock = isinstance(value, tuple) and len(value) == 2
            y = np.asarray(value[1] if own_clock else value, dtype=np.float64)
            if y.ndim != 2 or y.shape[1] != 3:
                raise InputError(f"{kind}: readings have shape {y.shape}; expected (N, 3)")
            clock = value[0] if own_clock else t
            if clock is None:
                if rate is None:
                    raise InputError(f"{kind}: no time; give t=, rate= or {kind}=(t, y)")
                clock = np.arange(len(y)) / rate
            unit = (units or {}).get(kind)
            if unit is None:
                raise InputError(f"{kind}: no unit; give units={{'{kind}': 'count'}} or another")
            return Stream(kind, np.asarray(clock, dtype=np.float64), y, unit)

        ref = None
        if reference is not None:
            q = np.asarray(reference, dtype=np.float64)
            clock = np.arange(len(q)) / rate if t is None and rate else t
            if clock is None:
                raise InputError("reference: no time; give t= or rate=")
            ref = Reference(np.asarray(clock, dtype=np.float64), q)
        recording = cls(split("acc", acc), split("gyr", gyr), split("mag", mag), reference=ref, source=source)
        return checked_recording(recording, trust_clock=rate is not None)


@dataclass(frozen=True)
class Poses:
    """J rests of a node, pooled over its recordings.

    Attributes
    ----------
    start, stop : ndarray (J,), s, on the clock of their recording
    recording : tuple of int, length J
        Index of the recording that each rest is from.
    mean, sd : dict of ndarray (J, 3), raw unit, by sensor kind
        Mean and scatter (standard deviation of a sample about the mean) within the rest; NaN where the
        recording lacks the sensor.
    count : dict of ndarray (J,), samples behind each mean
    knocks : ndarray (J,), samples cut out of the rest because it was knocked
    R : ndarray (J, 3, 3) or None
        R_nh: takes housing (or marker body) components to the laboratory.
    q_ref : ndarray (J, 4) or None
        Mean of the reference attitude over the rest, scalar first; NaN where it was not seen.
    """

    start: Array
    stop: Array
    recording: tuple[int, ...]
    mean: dict[Kind, Array]
    sd: dict[Kind, Array]
    count: dict[Kind, Array]
    knocks: Array
    R: Array | None = None
    q_ref: Array | None = None

    def __len__(self) -> int:
        return len(self.start)

    def select(self, keep: ArrayLike) -> Poses:
        """The poses that `keep` (index or boolean mask) names, in that order."""
        index = np.arange(len(self))[np.asarray(keep)]

        def rows(a: Array | None) -> Array | None:
            return None if a is None else a[index]

        return replace(
            self,
            start=self.start[index],
            stop=self.stop[index],
            recording=tuple(self.recording[i] for i in index),
            mean={k: v[index] for k, v in self.mean.items()},
            sd={k: v[index] for k, v in self.sd.items()},
            count={k: v[index] for k, v in self.count.items()},
            knocks=self.knocks[index],
            R=rows(self.R),
            q_ref=rows(self.q_ref),
        )


@dataclass(frozen=True)
class Turn:
    """The gyroscope's readings while the node was turned from rest `before` to rest `after` (indices in Poses).

    `y` (N, 3) raw unit, `dt` (N,) s the interval that each reading stands for.
    """

    before: int
    after: int
    t: Array
    y: Array
    dt: Array


@dataclass(frozen=True)
class Attitude:
    """A track of attitudes: `t` (N,) s and `q` (N, 4), scalar first, which takes frame `child` to frame `parent`."""

    t: Array
    q: Array
    parent: str = "earth"
    child: str = "node"

    def __post_init__(self) -> None:
        _set(self, "t", _frozen(self.t, (None,), "attitude time"))
        _set(self, "q", _frozen(self.q, (None, 4), "attitude quaternions"))
        if len(self.t) != len(self.q):
            raise InputError(f"{len(self.t)} times for {len(self.q)} attitudes")

    @property
    def R(self) -> Rotation:
        """The attitudes as scipy `Rotation`: ``v_parent = R.apply(v_child)``."""
        from scipy.spatial.transform import Rotation

        return Rotation.from_quat(np.roll(self.q, -1, axis=1))


@dataclass(frozen=True)
class Alignment:
    """Clocks and frames between a node and a motion-capture system (see the calibration file)."""

    common_clock: bool
    values: Mapping[str, Any]


@dataclass(frozen=True)
class Calibration:
    """A calibrated node: what the calibration file holds, and the working behind it.

    `fits`, `poses`, `turns`, `recordings` are there after `calibrate` and empty after `load`.
    `settings` says what was asked for and what was taken (attitudes, magnitudes, options).
    """

    acc: SensorModel | None = None
    gyr: SensorModel | None = None
    mag: SensorModel | None = None
    device: str | None = None
    frame: str = "housing"
    verdict: Verdict | None = None
    issues: tuple[Issue, ...] = ()
    alignment: Alignment | None = None
    created: str | None = None
    program: str | None = None
    files: tuple[tuple[str, str], ...] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    fits: Mapping[Kind, Fit] = field(default_factory=dict)
    poses: Poses | None = None
    turns: tuple[Turn, ...] = ()
    recordings: tuple[Recording, ...] = ()

    @property
    def models(self) -> dict[Kind, SensorModel]:
        """The calibrated sensors by kind, in the order acc, gyr, mag."""
        found: dict[Kind, SensorModel | None] = {"acc": self.acc, "gyr": self.gyr, "mag": self.mag}
        return {k: m for k, m in found.items() if m is not None}

    def apply(self, recording: Recording) -> Recording:
        """`recording` with every calibrated sensor in SI units.

        Raises
        ------
        InputError
            If a sensor's unit in the recording is not the raw unit that the calibration was made for.
        """
        streams: dict[str, Stream] = {}
        for kind, stream in recording.streams.items():
            model = self.models.get(kind)
            if model is None:
                continue
            if stream.unit != model.raw_unit:
                raise InputError(
                    f"{recording.source}: {kind} is in {stream.unit}, the calibration takes {model.raw_unit}; "
                    "apply it to readings in the unit that it was made from"
                )
            streams[kind] = replace(stream, y=model.apply(stream.y), unit=_column_unit(model.unit))
        return replace(recording, **streams)


def _column_unit(unit: str) -> str:
    from margcal.core.units import SI_COLUMN

    return SI_COLUMN[unit]


def _set(instance: object, name: str, value: object) -> None:
    """Assign in a frozen dataclass's ``__post_init__``."""
    object.__setattr__(instance, name, value)
