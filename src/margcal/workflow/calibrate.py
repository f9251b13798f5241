"""The pipeline: recordings of a node in, a calibrated node out. The command line, the report and the live page
all call `calibrate`.

1. `find_poses` cuts rests and turns out of the recordings.
2. `decide` says how the housing lay at each rest, as told or inferred.
3. A route of `routes` (or `swing`) turns readings and attitudes into a fit for every sensor.
4. `assemble` names the result: signs, units, uncertainty, issues, provenance.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from margcal.core.errors import DataError, InputError, UsageError
from margcal.core.types import Calibration, Issue, Kind, Recording, Verdict
from margcal.core.units import KINDS, STANDARD_GRAVITY
from margcal.workflow import routes
from margcal.workflow.assemble import assemble
from margcal.workflow.checks import verdict_of
from margcal.workflow.decide import decide
from margcal.workflow.job import NAMES, Job, Options, Solved
from margcal.workflow.lint import clipped, lint
from margcal.workflow.motion_delay import keep_magnetometer_delay
from margcal.workflow.segment import Segmentation, find_poses, measure_spans, measured
from margcal.workflow.swing import swing_only, try_swing

if TYPE_CHECKING:
    from margcal.files.poses_table import PoseTable
    from margcal.workflow.place import Place


MODES = ("auto", "cube", "faces", "free", "reference", "swing")


def calibrate(
    *recordings: Recording,
    poses: str | PoseTable = "auto",
    sensors: Sequence[Kind] | None = None,
    method: str | Sequence[str] | None = None,
    gravity: float | None = None,
    field: float | None = None,
    place: Place | None = None,
    level: bool = False,
    level_sd_deg: float = 1.0,
    nominal: Calibration | None = None,
    device: str | None = None,
    allow_fail: bool = False,
) -> Calibration:
    """Calibrate a node from one or several recordings of it.

    Parameters
    ----------
    *recordings : Recording
        Rests and turns are pooled; nothing is integrated across recordings; a sensor may be missing in some.
    poses : {'auto', 'cube', 'faces', 'free', 'reference', 'swing'} or PoseTable
        How the housing lay at the rests.
    sensors : sequence of {'acc', 'gyr', 'mag'}, optional
        Default: every sensor in the recordings. One that is named here and cannot be calibrated is an error.
    method : str or sequence of str, optional
        Solver for accelerometer and magnetometer (`routes.POSE_SOLVERS`, `routes.MAGNITUDE_SOLVERS`) and/or for
        the gyroscope (`routes.GYRO_SOLVERS`).
    gravity : float, m/s^2, optional
        Local gravity; default: that of `place`, else one standard gravity.
    field : float, uT, optional
        Local field; default: that of `place`, else the local field is the unit (`norm`).
    place : Place, optional
        Latitude, longitude and date (`place.parse_at`), for gravity, field and dip.
    level : bool
        Whether "up" of quaternion attitudes is up (the level-table prior); always so for cube, faces, up/front.
    level_sd_deg : float
        Standard deviation of a rest's tilt.
    nominal : Calibration, optional
        Nominal models: their H settles signs and starts the gyroscope.
    device : str, optional
    allow_fail : bool
        Return what there is even when nothing that was asked for can be calibrated.

    Returns
    -------
    Calibration
        With `fits`, `poses` (and their attitudes `R`), `turns` and `recordings`.

    Raises
    ------
    InputError
        If the recordings cannot be understood (units that cannot be, another number of rests than labels).
    DataError
        If no sensor that was asked for can be calibrated, or one that was named in `sensors`; its `issues` say
        why and what to record next.
    """
    if not recordings:
        raise UsageError("no recording to calibrate from")
    options = _options(recordings, sensors, method, gravity, field, place, level_sd_deg, nominal)
    issues = [i for r in recordings for i in r.issues] + [i for r in recordings for i in lint(r)]
    _refuse_unreadable(issues, options)
    issues += () if place is None else place.issues
    lame = {i.sensor for i in issues if i.level == "fail"}
    usable = tuple(measured(replace(r, **{k: None for k in lame if k})) for r in recordings)
    options = replace(options, sensors=tuple(k for k in options.sensors if k not in lame))
    job = _job(usable, poses, options, level, issues)
    issues = _without_harmless(job, issues)
    solved = _solve(job, auto=poses == "auto")
    keep_magnetometer_delay(job, solved)
    calibration = assemble(job, solved, issues, keep_failed=allow_fail)
    calibration = replace(
        calibration,
        device=device,
        files=_hashes(recordings),
        settings={**_settings(job, poses, solved, sensors, place, level), **calibration.settings},
    )
    calibration = replace(calibration, verdict=_verdict(calibration, sensors))
    if not allow_fail:
        _refuse(calibration, sensors, recordings)
    return calibration


def _refuse_unreadable(issues: list[Issue], options: Options) -> None:
    """A wrong unit or clocks that do not overlap: nothing can be made of it, whatever is fitted."""
    for issue in issues:
        of = issue.code.split("-")[0]  # `acc-unit` concerns the accelerometer only
        concerned = of not in KINDS or of in options.sensors
        if issue.level == "fail" and issue.sensor is None and concerned:
            raise InputError(issue.text)
    issues[:] = [i for i in issues if not (i.level == "fail" and i.sensor is None)]


def _options(
    recordings: Sequence[Recording],
    sensors: Sequence[Kind] | None,
    method: str | Sequence[str] | None,
    gravity: float | None,
    field: float | None,
    place: Place | None,
    level_sd_deg: float,
    nominal: Calibration | None,
) -> Options:
    there: list[Kind] = [k for k in KINDS if any(k in r.streams for r in recordings)]
    for kind in sensors or ():
        if kind not in KINDS:
            raise UsageError(f"sensor {kind!r} is none of {', '.join(KINDS)}")
        if kind not in there:
            raise InputError(f"{NAMES[kind]} was asked for, but no recording has one (found: {', '.join(there)})")
    if not there:
        raise InputError("no accelerometer, gyroscope or magnetometer in the recordings")
    if field is not None and place is not None:
        raise UsageError("--field and --at both give the magnetic field; give one of them")
    if not (np.isfinite(level_sd_deg) and 0 < level_sd_deg <= 45):
        raise UsageError(f"level_sd_deg is {level_sd_deg:g}; it must be above 0 and at most 45 degrees")
    pose_method, gyro_method = _methods(method)
    _same_units(recordings)
    where = None if place is None else place.field
    return Options(
        sensors=tuple(k for k in there if sensors is None or k in sensors),
        pose_method=pose_method,
        gyro_method=gyro_method,
        gravity=_positive("gravity", gravity, 9.0, 11.0) or (place.gravity if place else STANDARD_GRAVITY),
        field_uT=_positive("field", field, 1.0, 1000.0) or (where.total_uT if where else None),
        dip=np.radians(where.dip_deg) if where else None,
        level_sd=np.radians(level_sd_deg),
        nominal=dict(nominal.models) if nominal else {},
    )


def _positive(name: str, value: float | None, low: float, high: float) -> float | None:
    if value is not None and not low <= value <= high:
        unit = {"gravity": "m/s^2", "field": "uT"}[name]
        raise UsageError(f"{name} is {value:g} {unit}; on the earth it lies between {low:g} and {high:g}")
    return value


def _methods(method: str | Sequence[str] | None) -> tuple[str, str]:
    pose, gyro = "gls-ml", "gauss-newton"
    names = method.split(",") if isinstance(method, str) else list(method or ())
    for name in (n.strip() for n in names):
        if name in routes.POSE_SOLVERS or name in routes.MAGNITUDE_SOLVERS:
            pose = name
        elif name in routes.GYRO_SOLVERS:
            gyro = name
        else:
            known = (*routes.POSE_SOLVERS, *routes.MAGNITUDE_SOLVERS, *routes.GYRO_SOLVERS)
            raise UsageError(f"method {name!r} is none of {', '.join(known)}")
    return pose, gyro


def _same_units(recordings: Sequence[Recording]) -> None:
    seen: dict[Kind, tuple[str, str]] = {}
    for recording in recordings:
        for kind, unit in recording.units.items():
            first = seen.setdefault(kind, (unit, recording.source))
            if first[0] != unit:
                raise InputError(
                    f"{NAMES[kind]} is in {first[0]} in {first[1]} and in {unit} in {recording.source}; "
                    "recordings that are calibrated together must have one raw unit"
                )


def _job(
    recordings: tuple[Recording, ...], poses: str | PoseTable, options: Options, level: bool, issues: list[Issue]
) -> Job:
    """Rests and attitudes; what was noticed on the way is added to `issues`."""
    if isinstance(poses, str) and poses not in MODES:
        raise UsageError(f"poses {poses!r} is none of {', '.join(MODES)} and no table of attitudes")
    segmentation = _segment(recordings, poses)
    attitudes = decide(recordings, segmentation, poses, options, level)
    issues += (*segmentation.issues, *attitudes.issues)
    return Job(recordings, segmentation, attitudes, options)


def _solve(job: Job, *, auto: bool) -> Solved:
    """The route that the attitudes allow."""
    if job.attitudes.mode == "swing":
        return swing_only(job)
    if job.attitudes.R is not None:
        return routes.known(job)
    solved = routes.housed(job) if job.attitudes.up is not None else routes.free(job)
    if auto:
        try_swing(job, solved)
    return solved


def _without_harmless(job: Job, issues: list[Issue]) -> list[Issue]:
    """Saturated samples outside every rest and turn had no part in the fit: worth a note, no warning."""
    streams = [(i, r.gyr) for i, r in enumerate(job.recordings) if r.gyr is not None]
    poses = job.segmentation.poses
    for index, stream in streams:
        at = stream.t[clipped(stream.y, stream)]
        spans = [(t.t[0], t.t[-1]) for t in job.segmentation.turns if poses.recording[t.before] == index]
        if any(((at >= a) & (at <= b)).any() for a, b in spans):
            return issues
    harmless = [i for i in issues if i.code == "saturated" and i.sensor == "gyr" and i.level == "warn"]
    return [replace(i, level="note") if i in harmless else i for i in issues]


def _segment(recordings: tuple[Recording, ...], poses: str | PoseTable) -> Segmentation:
    if isinstance(poses, str) or poses.start is None or poses.stop is None:
        return find_poses(*recordings)
    index = _file_index(recordings, poses)
    spans = [(i, float(a), float(b)) for i, a, b in zip(index, poses.start, poses.stop)]
    for j, (i, a, b) in enumerate(spans):
        stream = next(iter(recordings[i].streams.values()))
        if not (a < b and b > stream.t[0] and a < stream.t[-1]):
            raise InputError(
                f"poses table, row {j + 1}: {a:g} to {b:g} s is no span of {recordings[i].source}, "
                f"which runs from {stream.t[0]:g} to {stream.t[-1]:g} s"
            )
    return measure_spans(recordings, spans)


def _file_index(recordings: Sequence[Recording], table: PoseTable) -> list[int]:
    """Index of the recording that each row of the table belongs to."""
    n = len(table)
    if table.file is None:
        if len(recordings) > 1 and table.start is not None:
            raise InputError("poses table: with several recordings and start_s, stop_s it needs a column `file`")
        return [0] * n
    names = [Path(r.source).name for r in recordings]
    out = []
    for j, name in enumerate(table.file):
        if Path(name).name not in names:
            raise InputError(
                f"poses table, row {j + 1}: no recording is called {name!r} (there are {', '.join(names)})"
            )
        out.append(names.index(Path(name).name))
    return out


def _verdict(calibration: Calibration, sensors: Sequence[Kind] | None) -> Verdict:
    """The verdict of the checks; models that are kept in spite of a failed check do not count."""
    failed = {i.sensor for i in calibration.issues if i.level == "fail"}
    sound = {k: None for k in calibration.models if k in failed or None in failed}
    return verdict_of(replace(calibration, **sound), sensors)


def _refuse(calibration: Calibration, sensors: Sequence[Kind] | None, recordings: Sequence[Recording]) -> None:
    fails = [i for i in calibration.issues if i.level == "fail"]
    missing: list[Kind] = [k for k in (sensors or ()) if k not in calibration.models]
    if calibration.models and not missing:
        return
    which = ", ".join(NAMES[k] for k in missing) or "any sensor"
    name = ", ".join(r.source for r in recordings)
    reasons = "; ".join(dict.fromkeys(i.text for i in fails)) or "no rests were found"
    raise DataError(f"{name} cannot calibrate {which}: {reasons}", calibration.issues)


def _hashes(recordings: Sequence[Recording]) -> tuple[tuple[str, str], ...]:
    out = []
    for name in dict.fromkeys(f for r in recordings for f in r.files):
        with Path(name).open("rb") as stream:
            out.append((Path(name).name, hashlib.file_digest(stream, "sha256").hexdigest()))
    return tuple(out)


def _settings(
    job: Job,
    poses: str | PoseTable,
    solved: Solved,
    sensors: Sequence[Kind] | None,
    place: Place | None,
    level: bool,
) -> dict[str, Any]:
    options, attitudes = job.options, job.attitudes
    return {
        "poses": poses if isinstance(poses, str) else "file",
        "attitudes": attitudes.mode,
        "attitudes_text": attitudes.text,
        "attitudes_figures": dict(attitudes.figures),
        "sensors": list(sensors) if sensors else None,
        "method": [options.pose_method, options.gyro_method],
        "gravity": options.gravity,
        "field_uT": options.field_uT,
        "at": None if place is None else [place.latitude_deg, place.longitude_deg, place.field.year],
        "level": level,
        "level_sd_deg": float(np.degrees(options.level_sd)),
        "units": {k: u for r in job.recordings for k, u in r.units.items()},
        "sources": dict(solved.sources),
    }
