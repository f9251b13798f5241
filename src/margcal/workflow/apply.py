"""A calibration applied to a recording on disk: streamed, so that a night of data needs no more memory than a minute.

The rows stay the same; the columns of a calibrated sensor are replaced by SI ones, all others pass unchanged.
Readings of a sensor with a delay are moved to the times of the table by linear interpolation.
"""

from __future__ import annotations

import os
import shutil
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from margcal.core.checking import printable
from margcal.core.errors import InputError
from margcal.core.types import Array, Calibration, Kind, SensorModel
from margcal.core.units import KINDS, SI_COLUMN, UNITS
from margcal.files.atomic import atomic_folder, atomic_path
from margcal.files.batches import (
    As,
    BadCell,
    Progress,
    Table,
    arrow,
    cells,
    is_parquet,
    numbers,
    open_table,
)
from margcal.files.columns import Columns, SensorColumns, find_columns
from margcal.files.tables import tables_in
from margcal.files.writing import Write, check_suffix, table_writer

if TYPE_CHECKING:
    import pyarrow as pa

LONGEST_GAP = 5.0
"""Sample periods over which a delayed reading is interpolated; longer gaps stay empty."""


def apply_file(
    calibration: Calibration,
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    *,
    overwrite: bool = False,
    force: bool = False,
    units: dict[str, str] | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Write the recording `source` with calibrated columns in SI units to `target`.

    Parameters
    ----------
    calibration : Calibration
    source : path-like
        A table (CSV or Parquet) or a folder of tables.
    target : path-like
        A table, CSV or Parquet by its suffix, or a folder (the same file names) where the source is one.
    overwrite : bool
        Whether existing results may be replaced; the source itself never is.
    force : bool
        Go on where a sensor is in another unit than the calibration was made from: convert it where both have
        a fixed factor, else take the numbers as they are. Named in the summary.
    units : mapping, optional
        Units of sensor columns that name none, as in `files.tables.read`.
    progress : callable (done, total), optional
        Rows of a Parquet table, bytes of a text table.

    Returns
    -------
    dict
        `rows`, `seconds` (recorded time, None without `t_s`), `files`, `sensors` (for each calibrated one
        `rows`, `raw_unit`, `unit`, `delay_s`), `passed_through` (sensors without calibration), `missing`
        (calibrated sensors that the recording lacks), `forced`.

    Raises
    ------
    InputError
        No sensor of the recording is calibrated, units differ, a name is taken twice, or reading or writing fails.
    """
    source, target = Path(source), Path(target)
    if target.exists() and source.exists() and os.path.samefile(source, target):
        raise InputError(f"{printable(target)}: is the recording itself; give the result another name")
    summary: dict[str, Any] = {"rows": 0, "seconds": None, "files": [], "sensors": {}, "forced": []}
    passed: set[Kind] = set()
    if source.is_dir():
        jobs = [_job(calibration, p, units, force) for p in tables_in(source)]
        _check_found(calibration, jobs, source)
        with atomic_folder(target, overwrite=overwrite) as folder:
            for job in jobs:
                if job.sensors:
                    _write(job, folder / job.table.path.name, summary, progress)
                else:
                    shutil.copyfile(job.table.path, folder / job.table.path.name)
                passed |= job.passed
    else:
        check_suffix(target)
        job = _job(calibration, source, units, force)
        _check_found(calibration, [job], source)
        with atomic_path(target, overwrite=overwrite) as temporary:
            _write(job, temporary, summary, progress)
        passed |= job.passed
    summary["passed_through"] = [k for k in KINDS if k in passed]
    summary["missing"] = [k for k in calibration.models if k not in summary["sensors"]]
    return summary


@dataclass(frozen=True)
class _Sensor:
    """One sensor of one table: its columns, its model, the factor from the columns' unit to the model's raw unit."""

    columns: SensorColumns
    model: SensorModel
    factor: float
    forced: bool

    @property
    def delay(self) -> float:
        return self.model.delay_s or 0.0

    def calibrated(self, batch: pa.RecordBatch) -> Array:
        y = np.empty((len(batch), 3))
        for j, k in enumerate(self.columns.index):
            y[:, j] = numbers(batch.column(k))
        return self.model.apply(y if self.factor == 1.0 else y * self.factor)


@dataclass
class _Job:
    """What is to be done with one table."""

    table: Table
    columns: Columns
    sensors: dict[Kind, _Sensor]
    passed: set[Kind]
    names: list[str] = field(default_factory=list)

    @property
    def delays(self) -> dict[Kind, float]:
        return {k: s.delay for k, s in self.sensors.items() if s.delay}


def _job(calibration: Calibration, path: Path, units: dict[str, str] | None, force: bool) -> _Job:
    table = open_table(path)
    columns = find_columns(table.names, units, table.file)
    sensors: dict[Kind, _Sensor] = {}
    for kind, found in columns.sensors.items():
        if (model := calibration.models.get(kind)) is not None:
            sensors[kind] = _matched(found, model, table.file, force)
    job = _Job(table, columns, sensors, set(columns.sensors) - set(sensors), list(table.names))
    for kind, sensor in sensors.items():
        for axis, k in zip("xyz", sensor.columns.index):
            job.names[k] = f"{kind}_{axis}_{SI_COLUMN[sensor.model.unit]}"
    twice = {n for n in job.names if job.names.count(n) > 1}
    if twice & {job.names[k] for s in sensors.values() for k in s.columns.index}:
        raise InputError(
            f"{table.file}: the calibrated columns would be named {', '.join(sorted(twice))}, which are there already; "
            "remove or rename those"
        )
    if job.delays and columns.t is None:
        raise InputError(f"{table.file}: no column t_s, which correcting a delay needs; name the time in seconds t_s")
    return job


def _matched(found: SensorColumns, model: SensorModel, file: str, force: bool) -> _Sensor:
    """The sensor with its model, where the unit of the columns is the one that the model takes."""
    if found.unit == model.raw_unit:
        return _Sensor(found, model, 1.0, False)
    have, want = UNITS[found.kind].get(found.unit), UNITS[found.kind].get(model.raw_unit)
    if not force:
        if found.unit == SI_COLUMN[model.unit]:
            reason = "it looks as if it had been calibrated already; give the raw recording"
        else:
            reason = "give the recording that it fits, or the calibration of this one"
        raise InputError(
            f"{file}: {found.kind} is in {found.unit}, the calibration takes {printable(model.raw_unit)}: {reason} "
            "(--force applies it all the same)"
        )
    return _Sensor(found, model, have / want if have and want else 1.0, True)


def _check_found(calibration: Calibration, jobs: list[_Job], source: Path) -> None:
    if any(job.sensors for job in jobs):
        return
    have = sorted({k for job in jobs for k in job.columns.sensors})
    raise InputError(
        f"{printable(source.name)}: nothing to calibrate: it holds {', '.join(have) or 'no sensor'}, the calibration "
        f"is of {', '.join(calibration.models) or 'no sensor'}"
    )


def _write(job: _Job, path: Path, summary: dict[str, Any], progress: Progress | None) -> None:
    """Write one table; a text column that turns out to hold something else later on is read again as text."""
    keep_text = not is_parquet(path) and job.table.dialect is not None and job.table.dialect.plain
    take: dict[int, As] = dict.fromkeys(range(len(job.names)), "text" if keep_text else "own")
    must = [k for s in job.sensors.values() for k in s.columns.index]
    if job.columns.t is not None and (job.delays or not keep_text):
        must.append(job.columns.t)
    take.update(dict.fromkeys(must, "number"))
    while True:
        try:
            rows, seconds = _write_once(job, path, take, progress)
            break
        except BadCell as bad:
            if bad.column in must or take[bad.column] == "text":
                raise
            take[bad.column] = "number" if take[bad.column] == "own" else "text"
    summary["rows"] += rows
    summary["files"].append(job.table.file)
    if seconds is not None:
        summary["seconds"] = max(seconds, summary["seconds"] or 0.0)
    for kind, sensor in job.sensors.items():
        summary["sensors"][kind] = {
            "rows": rows,
            "raw_unit": sensor.model.raw_unit,
            "unit": sensor.model.unit,
            "delay_s": sensor.delay,
        }
        if sensor.forced:
            summary["forced"].append(f"{kind}: {sensor.columns.unit} taken as {sensor.model.raw_unit}")


def _write_once(job: _Job, path: Path, take: dict[int, As], progress: Progress | None) -> tuple[int, float | None]:
    """(rows, recorded seconds) of one pass over the table."""
    import pyarrow as pa

    rows, ends = 0, []
    with ExitStack() as stack:
        write: Write | None = None
        for batch, vectors in _corrected(job, take, progress):
            out = _output(job, batch, vectors, nan_is_null=not is_parquet(path))
            if write is None:
                write = stack.enter_context(table_writer(path, out.schema))
            try:
                write(out)
            except (pa.ArrowInvalid, pa.ArrowNotImplementedError, pa.ArrowTypeError) as error:
                raise InputError(
                    f"{job.table.file}: a column cannot be written as text ({printable(error, 120)}); write .parquet"
                ) from error
            if job.columns.t is not None and len(batch):
                time = batch.column(job.columns.t)
                ends = [ends[0] if ends else time[0].as_py(), time[len(batch) - 1].as_py()]
            rows += len(out)
    if not rows:
        raise InputError(f"{job.table.file}: holds no rows; record or export it again")
    return rows, _span(ends)


def _span(ends: list[Any]) -> float | None:
    try:
        return float(ends[1]) - float(ends[0])
    except (IndexError, TypeError, ValueError):
        return None


def _output(job: _Job, batch: pa.RecordBatch, vectors: Mapping[Kind, Array], *, nan_is_null: bool) -> pa.RecordBatch:
    """`batch` with the calibrated columns in place of the raw ones."""
    import pyarrow as pa

    arrays = [cells(column) if nan_is_null else column for column in batch.columns]
    for kind, sensor in job.sensors.items():
        for j, k in enumerate(sensor.columns.index):
            arrays[k] = arrow(vectors[kind][:, j], nan_is_null=nan_is_null)
    return pa.RecordBatch.from_arrays(arrays, names=job.names)


_Part = tuple["pa.RecordBatch", dict[Kind, Array]]


def _corrected(job: _Job, take: Mapping[int, As], progress: Progress | None) -> Iterator[_Part]:
    """Batches with their calibrated vectors, delays corrected."""
    every = range(len(job.names))

    def parts() -> Iterator[_Part]:
        for batch in job.table.batches(every, take, progress=progress):
            yield batch, {kind: sensor.calibrated(batch) for kind, sensor in job.sensors.items()}

    return _Delays(job).corrected(parts()) if job.delays else parts()


@dataclass
class _Track:
    """What is known of one delayed sensor around the batch in work: its sampled times and vectors, in order."""

    delay: float
    t: Array = field(default_factory=lambda: np.empty(0))
    u: Array = field(default_factory=lambda: np.empty((0, 3)))
    period: float | None = None

    def add(self, t: Array, u: Array) -> None:
        sampled = ~np.isnan(u).any(axis=1)
        self.t = np.concatenate([self.t, t[sampled]])
        self.u = np.concatenate([self.u, u[sampled]])
        if self.period is None and len(self.t) > 2 and self.t[-1] > self.t[0]:
            self.period = float(self.t[-1] - self.t[0]) / (len(self.t) - 1)

    @property
    def reach(self) -> float:
        """How far beyond a time the table must have been read before the vector at that time is known."""
        return np.inf if self.period is None else max(self.delay, 0.0) + (LONGEST_GAP + 1) * self.period

    def forget(self, before: float) -> None:
        """Drop what no later row can need, but for the neighbours of `before`."""
        if self.period is not None:
            first = np.searchsorted(self.t, before + min(self.delay, 0.0) - (LONGEST_GAP + 1) * self.period)
            self.t, self.u = self.t[first:], self.u[first:]

    def at(self, t: Array) -> Array:
        """Vectors at times `t` (the reading stamped t + delay was sensed at t); NaN beyond the ends and in gaps."""
        out = np.full((len(t), 3), np.nan)
        if not len(self.t):
            return out
        when = t + self.delay
        after = np.clip(np.searchsorted(self.t, when), 0, len(self.t) - 1)
        before = np.where(self.t[after] > when, np.maximum(after - 1, 0), after)
        gap = self.t[after] - self.t[before]
        known = (when >= self.t[0]) & (when <= self.t[-1])
        if self.period is not None:
            known &= gap <= LONGEST_GAP * self.period
        for j in range(3):
            out[known, j] = np.interp(when[known], self.t, self.u[:, j])
        return out


class _Delays:
    """Moves the readings of delayed sensors to the times of the table, holding back only the rows that need it."""

    def __init__(self, job: _Job) -> None:
        self.job = job
        self.tracks: dict[Kind, _Track] = {kind: _Track(delay) for kind, delay in job.delays.items()}
        self.waiting: deque[tuple[Array, _Part]] = deque()
        self.rows = 0
        self.last = -np.inf

    def corrected(self, parts: Iterable[_Part]) -> Iterator[_Part]:
        for batch, vectors in parts:
            t = self._time(batch)
            for kind, track in self.tracks.items():
                track.add(t, vectors[kind])
            self.waiting.append((t, (batch, vectors)))
            reach = max(track.reach for track in self.tracks.values())
            while self.waiting and self.waiting[0][0][-1] + reach < self.last:
                yield self._next()
        while self.waiting:
            yield self._next()

    def _time(self, batch: pa.RecordBatch) -> Array:
        t = numbers(batch.column(self.job.columns.t))
        with np.errstate(invalid="ignore"):  # inf - inf
            wrong = ~(np.diff(t, prepend=self.last) >= 0) | ~np.isfinite(t)
        if wrong.any():
            row = self.rows + int(np.argmax(wrong)) + 1
            raise InputError(
                f"{self.job.table.file}: time is missing or runs backwards in data row {row}; a delay can only be "
                "corrected where time runs forward: sort the rows, or take that one out"
            )
        self.rows += len(t)
        self.last = float(t[-1]) if len(t) else self.last
        return t

    def _next(self) -> _Part:
        t, (batch, vectors) = self.waiting.popleft()
        for kind, track in self.tracks.items():
            blank = np.isnan(vectors[kind]).any(axis=1)
            vectors[kind] = track.at(t)
            vectors[kind][blank] = np.nan
            if self.waiting and len(self.waiting[0][0]):
                track.forget(float(self.waiting[0][0][0]))
            elif len(t):
                track.forget(float(t[-1]))
        return batch, vectors
