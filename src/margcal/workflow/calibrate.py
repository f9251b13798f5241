"""The pipeline: recordings of a node in, a calibrated node out. The command line, the report and the live page
all call `calibrate`.

1. `find_poses` cuts rests and turns out of the recordings.
2. `decide` says how the housing lay at each rest, as told or inferred.
3. A route of `routes` turns readings and attitudes into a fit for every sensor.
4. `assemble` names the result: signs, units, uncertainty, issues, provenance.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from margcal.core import so3
from margcal.core.errors import DataError, InputError, UsageError
from margcal.core.types import Array, Calibration, Fit, Issue, Kind, Recording, SensorModel
from margcal.core.units import KINDS, STANDARD_GRAVITY
from margcal.methods.gyro import propagate_gravity
from margcal.methods.preintegration import integrate, pad
from margcal.methods.uncertainty import expected_error
from margcal.workflow import attitudes as att
from margcal.workflow import routes
from margcal.workflow.attitudes import Attitudes
from margcal.workflow.lint import lint
from margcal.workflow.routes import Job, Options, Solved
from margcal.workflow.segment import Segmentation, find_poses, measure_spans

if TYPE_CHECKING:
    from margcal.files.poses_table import PoseTable
    from margcal.workflow.place import Place

MODES = ("auto", "cube", "faces", "free", "reference", "swing")
NAMES = {"acc": "accelerometer", "gyr": "gyroscope", "mag": "magnetometer"}
MIN_FREE_RESTS_FOR_MAG = 10
"""Below this many rests a swing, if there is one, says more about the magnetometer."""


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
    lame = {i.sensor for i in issues if i.level == "fail"}
    usable = tuple(replace(r, **{k: None for k in lame if k}) for r in recordings)
    options = replace(options, sensors=tuple(k for k in options.sensors if k not in lame))
    solved, attitudes, segmentation = _solve(usable, poses, options, level, issues)
    calibration = _assemble(usable, attitudes, segmentation, options, solved, issues)
    calibration = replace(
        calibration,
        device=device,
        files=_hashes(recordings),
        settings=_settings(recordings, poses, attitudes, options, solved, sensors, place, level),
    )
    if not allow_fail:
        _refuse(calibration, sensors, recordings)
    return calibration


# --- what was asked for ------------------------------------------------------------------------------


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
    there = [k for k in KINDS if any(k in r.streams for r in recordings)]
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
        sensors=tuple(k for k in there if sensors is None or k in sensors),  # type: ignore[misc]
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
    pose, gyro = "one-step", "gauss-newton"
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


# --- attitudes ---------------------------------------------------------------------------------------


def _solve(
    recordings: tuple[Recording, ...],
    poses: str | PoseTable,
    options: Options,
    level: bool,
    issues: list[Issue],
) -> tuple[Solved, Attitudes, Segmentation]:
    """Rests, attitudes, and the route that they allow."""
    mode = poses if isinstance(poses, str) else "file"
    if mode not in (*MODES, "file"):
        raise UsageError(f"poses {mode!r} is none of {', '.join(MODES)} and no table of attitudes")
    segmentation = _segment(recordings, poses)
    issues += segmentation.issues
    attitudes = decide(recordings, segmentation, poses, options, level)
    issues += attitudes.issues
    job = Job(recordings, segmentation, attitudes, options)
    if attitudes.mode == "swing":
        return _swing_only(job), attitudes, segmentation
    if attitudes.R is not None:
        solved = routes.known(job)
    elif attitudes.up is not None:
        solved = routes.housed(job)
    else:
        solved = routes.free(job)
    if mode == "auto":
        _try_swing(job, solved)
    return solved, attitudes, segmentation


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


def decide(
    recordings: tuple[Recording, ...],
    segmentation: Segmentation,
    poses: str | PoseTable,
    options: Options,
    level: bool = False,
) -> Attitudes:
    """The attitudes of the rests: as told, or inferred and said so."""
    if not isinstance(poses, str):
        return _from_table(segmentation, poses, level)
    mode, n = poses, len(segmentation.poses)
    if mode == "swing":
        return Attitudes("swing", "acc-triangular", text="continuous motion: all samples of the magnetometer")
    if mode in ("auto", "reference"):
        found = _from_reference(segmentation, level)
        if found is not None:
            return found
        if mode == "reference":
            seen = att.from_reference(segmentation)
            have = 0 if seen is None else att.count_distinct(seen)
            what = "no ref_q* columns" if seen is None else f"{have} distinct attitudes at rest"
            text = f"--poses reference: {what}; {att.MIN_REFERENCE} distinct attitudes at rest are needed"
            raise DataError(text, (Issue("no-reference", "fail", text, None, float(have), float(att.MIN_REFERENCE)),))
    if mode in ("auto", "cube", "faces"):
        found = _boxed(recordings, segmentation, options, mode)
        if found is not None:
            return found
    if mode == "auto" and n < 5 and any("mag" in r.streams for r in recordings):
        if "acc" not in options.sensors or n == 0:
            return Attitudes("swing", "acc-triangular", text=f"{n} rests: taken as a swing of the magnetometer")
    text = f"{n} rests in attitudes that nobody told: free"
    return Attitudes("free", "acc-triangular", text=text)


def _from_table(segmentation: Segmentation, table: PoseTable, level: bool) -> Attitudes:
    n = len(segmentation.poses)
    if len(table) != n:
        raise InputError(
            f"the poses table has {len(table)} rows, but {n} rests were found; give start_s and stop_s for each row, "
            "or see `margcal segment` for the rests"
        )
    if table.q is not None:
        R = so3.matrix_from_quat(table.q)
        text = f"{n} attitudes from the table"
        return Attitudes("file", "housing", R=R, up=R[:, 2, :] if level else None, level=level, text=text)
    assert table.up is not None
    up, R = att.from_directions(table.up, table.front)
    text = f"{n} attitudes from the table" if R is not None else f"{n} faces from the table, headings free"
    return Attitudes("file" if R is not None else "faces", "housing", R=R, up=up, level=True, text=text)


def _from_reference(segmentation: Segmentation, level: bool) -> Attitudes | None:
    R = att.from_reference(segmentation)
    if R is None or (distinct := att.count_distinct(R)) < att.MIN_REFERENCE:
        return None
    seen = int(np.isfinite(R).all(axis=(1, 2)).sum())
    text = f"reference attitudes at {seen} of {len(R)} rests, {distinct} of them distinct"
    return Attitudes("reference", "marker", R=R, up=R[:, 2, :] if level else None, level=level, text=text)


def _boxed(
    recordings: tuple[Recording, ...], segmentation: Segmentation, options: Options, mode: str
) -> Attitudes | None:
    """Faces, and the four headings if they are multiples of ninety degrees; None where it is no box."""
    y = segmentation.poses.mean.get("acc")
    faces = None
    if y is not None and np.isfinite(y).all() and len(y) >= 4:
        faces = att.find_faces(y)
    if faces is None or (mode == "auto" and not att.lies_on_faces(faces)):
        if mode == "auto":
            return None
        text = f"--poses {mode}: {_why_no_faces(segmentation, recordings)}"
        raise DataError(text, (Issue("no-faces", "fail", text, "acc"),))
    if faces.tilt_deg.max() > 2.5 * att.FACE_TILT_DEG:
        worst = int(np.argmax(faces.tilt_deg))
        text = (
            f"--poses {mode}: rest {worst + 1} lies {faces.tilt_deg[worst]:.0f} degrees from every face; "
            "the node was not put down on its faces there: use --poses free, or leave that rest out"
        )
        raise DataError(text, (Issue("no-faces", "fail", text, "acc", float(faces.tilt_deg[worst]), 30.0),))
    n = len(faces.up)
    tilt = float(np.sqrt(np.mean(faces.tilt_deg**2)))
    seen = len({tuple(c) for c in np.round(faces.up).astype(int).tolist()})
    about = f"{n} rests on {seen} of 6 faces, tilt {tilt:.1f} deg rms"
    figures = {"tilt_rms_deg": tilt, "faces": float(seen)}
    if mode != "faces":
        cube = _cube(recordings, segmentation, options, faces, about, figures)
        if cube is not None:
            return cube
        if mode == "cube":
            text = (
                f"--poses cube: {about}, but neither gyroscope nor magnetometer tells headings that are multiples of "
                "90 degrees; use --poses faces if the box was put down with arbitrary headings"
            )
            raise DataError(text, (Issue("no-cube", "fail", text),))
    return Attitudes("faces", "housing", up=faces.up, level=True, text=f"{about}, headings free", figures=figures)


def _why_no_faces(segmentation: Segmentation, recordings: Sequence[Recording]) -> str:
    if not any("acc" in r.streams for r in recordings):
        return "without an accelerometer nobody knows which face is up; give the attitudes in a table"
    n = len(segmentation.poses)
    if n < 4:
        return f"{n} rests were found; put the node down on each of its six faces, two seconds each"
    return "the accelerometer's readings at rest lie in one plane; put the node down on all six faces"


def _cube(
    recordings: tuple[Recording, ...],
    segmentation: Segmentation,
    options: Options,
    faces: att.Faces,
    about: str,
    figures: dict[str, float],
) -> Attitudes | None:
    """Which of the 24 attitudes each rest has, by gyroscope and magnetometer together; None if it is no cube."""
    before, dR = _rough_turns(recordings, segmentation, options, faces)
    R, piece, snap = att.snap_chain(faces.up, dR, before)
    by_gyro = len(snap) > 0
    rms = float(np.sqrt(np.mean(snap**2))) if by_gyro else float("nan")
    if by_gyro and (rms > att.CUBE_RMS_DEG or snap.max() > att.CUBE_SNAP_DEG):
        return None
    m = segmentation.poses.mean.get("mag")
    field = None
    if m is not None and np.isfinite(m).all():
        field = att.headings_from_field(m, faces.up)
    if field is None and (not by_gyro or piece.max() > 0):
        return None
    if not by_gyro:
        assert field is not None
        if field.off_deg.max() > att.CUBE_SNAP_DEG:
            return None
    R, agree, _ = att.join_pieces(R, piece, None if field is None else field.R)
    text, found = about, []
    if by_gyro:
        text += f"; the gyroscope's turns end {rms:.1f} deg rms (worst {snap.max():.1f}) from cube attitudes"
        figures |= {"snap_rms_deg": rms, "snap_worst_deg": float(snap.max())}
    if field is not None:
        text += f"; the magnetometer says the same at {agree * 100:.0f} % of the rests"
        figures |= {"magnetometer_agrees": agree}
        if by_gyro and agree < 1 and float(field.off_deg.max()) < att.CUBE_SNAP_DEG:
            # the field's own headings are clear-cut and still differ: one of the two is wrong somewhere
            note = f"gyroscope and magnetometer agree on the heading of {agree * 100:.0f} % of the rests; the gyroscope was followed"
            found.append(Issue("heading-disagreement", "warn", note, None, agree, 1.0))
    return Attitudes("cube", "housing", R=R, up=faces.up, level=True, text=text, figures=figures, issues=tuple(found))


def _rough_turns(
    recordings: tuple[Recording, ...], segmentation: Segmentation, options: Options, faces: att.Faces
) -> tuple[Array, Array]:
    """Rest before each turn, and the turn's rotation by a gyroscope calibrated roughly, by gravity."""
    none = np.zeros(0, dtype=np.int64), np.zeros((0, 3, 3))
    if "gyr" not in segmentation.poses.mean:
        return none
    job = Job(recordings, segmentation, Attitudes("faces", "housing", up=faces.up), options)
    turns = routes.usable_turns(job)
    if len(turns) < routes.MIN_TURNS:
        return none
    y, _ = job.readings("gyr")
    v = (segmentation.poses.mean["acc"] - faces.B) @ faces.H.T
    samples = _along_turns(job, turns, faces)
    try:
        fit = propagate_gravity(
            turns,
            v[[t.before for t in turns]],
            v[[t.after for t in turns]],
            H0=routes.nominal_gyro(job),
            along=samples,
            bias_prior=(y.mean(axis=0), np.diag(y.var(axis=0) + 1e-6 * np.abs(y).max() ** 2)),
        )
    except DataError:
        return none
    batch = pad(turns)
    return np.array([t.before for t in turns]), integrate(batch.y, batch.dt, fit.model.H, fit.model.B)


def _along_turns(job: Job, turns: list[Any], faces: att.Faces) -> Array:
    model = SensorModel("acc", faces.H, faces.B)
    return routes.along_turns(job, turns, model)


# --- swing beside rests ------------------------------------------------------------------------------


def _swing_only(job: Job) -> Solved:
    solved = Solved()
    if job.wants("mag"):
        routes.swung(job, solved)
    for kind in ("acc", "gyr"):
        if job.wants(kind):
            text = (
                f"{NAMES[kind]}: a swing calibrates the magnetometer only; record rests (put the node down in ten "
                "to thirty attitudes, two seconds each) for the other sensors"
            )
            solved.issues.append(Issue("no-rests", "fail", text, kind))
    return solved


def _try_swing(job: Job, solved: Solved) -> None:
    """Where the rests carry the magnetometer badly or not at all, take it from continuous motion."""
    if not job.wants("mag") or job.attitudes.mode not in ("free", "faces"):
        return
    y, _ = job.readings("mag")
    if "mag" in solved.fits and len(y) >= MIN_FREE_RESTS_FOR_MAG:
        return
    trial = routes.swung(job, Solved(fits={k: f for k, f in solved.fits.items() if k != "mag"}))
    if "mag" not in trial.fits:
        return
    solved.issues[:] = [i for i in solved.issues if i.sensor != "mag"] + trial.issues
    solved.fits["mag"] = trial.fits["mag"]
    solved.sources |= trial.sources
    solved.delays |= trial.delays
    solved.vectors.pop("mag", None)


# --- result ------------------------------------------------------------------------------------------


def _assemble(
    recordings: tuple[Recording, ...],
    attitudes: Attitudes,
    segmentation: Segmentation,
    options: Options,
    solved: Solved,
    issues: list[Issue],
) -> Calibration:
    job = Job(recordings, segmentation, attitudes, options)
    issues = issues + solved.issues
    models: dict[Kind, SensorModel] = {}
    for kind in KINDS:
        if kind in solved.fits:
            fit = _signed(job, kind, solved, issues)  # type: ignore[arg-type]
            models[kind] = _finished(job, kind, fit, solved)  # type: ignore[index]
            solved.fits[kind] = replace(fit, model=models[kind])  # type: ignore[index]
    _mirrored(models, issues)
    frame = attitudes.frame
    poses = replace(segmentation.poses, R=solved.R)
    return Calibration(
        acc=models.get("acc"),
        gyr=models.get("gyr"),
        mag=models.get("mag"),
        frame=frame,
        issues=tuple(dict.fromkeys(issues)),
        fits=dict(solved.fits),
        poses=poses,
        turns=segmentation.turns,
        recordings=recordings,
    )


def _signed(job: Job, kind: Kind, solved: Solved, issues: list[Issue]) -> Fit:
    """(H, u) or (-H, -u): by the nominal H, by the dip where the place is known, else det H > 0 (conventions)."""
    fit = solved.fits[kind]
    H = fit.model.H
    if kind == "gyr":
        return fit  # rotations leave its sign no choice
    nominal = job.options.nominal.get(kind)
    if nominal is not None:
        flip = float(np.sum(so3.polar(H)[0] * so3.polar(nominal.H)[0])) < 0
    elif kind == "mag" and job.options.dip is not None and (up := _field_up(job, solved)) is not None:
        flip = up * np.sin(job.options.dip) > 0  # the field points down where the dip is positive
    else:
        flip = np.linalg.det(H) < 0
        if kind == "mag":
            text = (
                "magnetometer: its sign is taken so that det H > 0 (axes not mirrored); give --at or --nominal if "
                "the board flips them"
            )
            issues.append(Issue("sign-assumed", "note", text, "mag"))
    if not flip:
        return fit
    if kind in solved.vectors:
        solved.vectors[kind] = -solved.vectors[kind]
    model = replace(fit.model, H=-H, covariance=_negated(fit.model.covariance))
    return replace(fit, model=model, u=None if fit.u is None else -fit.u, covariance=model.covariance)


def _negated(C: Array | None) -> Array | None:
    """Covariance of (-H, B)."""
    if C is None:
        return None
    s = np.r_[-np.ones(9), np.ones(3)]
    return C * np.outer(s, s)


def _field_up(job: Job, solved: Solved) -> float | None:
    """Mean component of the calibrated field along "up" (calibrated unit), as the fit has it now."""
    acc, mag = solved.fits.get("acc"), solved.fits["mag"]
    u = solved.vectors.get("mag")
    if job.attitudes.level and u is not None:
        return float(u[2])
    if acc is None:
        return None
    y = job.segmentation.poses.mean
    if "mag" in solved.sources:
        recording = next(r for r in job.recordings if solved.sources["mag"].startswith(r.source))
        return _field_up_moving(recording, acc.model, mag.model)
    f, m = acc.model.apply(y["acc"]), mag.model.apply(y["mag"])
    both = np.isfinite(f).all(axis=1) & np.isfinite(m).all(axis=1)
    if not both.any():
        return None
    return float(np.mean(np.sum(f[both] * m[both], axis=1) / np.linalg.norm(f[both], axis=1)))


def _field_up_moving(recording: Recording, acc: SensorModel, mag: SensorModel) -> float | None:
    if recording.acc is None or recording.mag is None:
        return None
    f = acc.apply(recording.acc.y)
    f = np.column_stack([np.interp(recording.mag.t, recording.acc.t, f[:, k]) for k in range(3)])
    return float(np.mean(np.sum(f * mag.apply(recording.mag.y), axis=1)) / job_gravity(f))


def job_gravity(f: Array) -> float:
    return float(np.mean(np.linalg.norm(f, axis=1)))


def _finished(job: Job, kind: Kind, fit: Fit, solved: Solved) -> SensorModel:
    """The model with the figures that say how good it is."""
    model = fit.model
    magnitude = job.options.magnitude[kind]
    error = None
    if model.covariance is not None and np.isfinite(model.covariance).all():
        error = expected_error(kind, model.H, model.covariance, magnitude).direction_deg
    y, index = job.readings(kind)
    delay = solved.delays.get(kind, (None, None))
    residual = np.asarray(fit.residual)
    rests = len(index) if kind not in solved.sources else None
    return replace(
        model,
        raw_unit=job.raw_unit(kind),
        unit=job.options.unit[kind],
        residual_rms=float(np.sqrt(np.mean(residual**2))),
        n_poses=rests,
        method=fit.method,
        reference_vector=solved.vectors.get(kind),
        expected_error_deg=error,
        delay_s=delay[0],
        delay_se_s=delay[1],
        temperature_degC=_temperature(job),
    )


def _temperature(job: Job) -> float | None:
    means = [np.nanmean(r.temperature[1]) for r in job.recordings if r.temperature is not None]
    return float(np.mean(means)) if means else None


def _mirrored(models: Mapping[Kind, SensorModel], issues: list[Issue]) -> None:
    """A gyroscope of the other handedness than the accelerometer: the data prove it, so say it and go on."""
    gyr = models.get("gyr")
    if gyr is None or np.linalg.det(gyr.H) > 0:
        return
    Q = so3.polar(gyr.H)[0]
    axis = "xyz"[int(np.argmin(np.diag(Q)))]
    text = (
        f"gyroscope: its axes are mirrored (left-handed) against the accelerometer's, most likely {axis}; H takes "
        "care of it, but check the wiring or driver that flips an axis"
    )
    issues.append(Issue("mirrored-axes", "warn", text, "gyr", float(np.linalg.det(Q))))


def _refuse(calibration: Calibration, sensors: Sequence[Kind] | None, recordings: Sequence[Recording]) -> None:
    fails = [i for i in calibration.issues if i.level == "fail"]
    missing = [k for k in (sensors or ()) if k not in calibration.models]
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
    recordings: Sequence[Recording],
    poses: str | PoseTable,
    attitudes: Attitudes,
    options: Options,
    solved: Solved,
    sensors: Sequence[Kind] | None,
    place: Place | None,
    level: bool,
) -> dict[str, Any]:
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
        "units": {k: u for r in recordings for k, u in r.units.items()},
        "sources": dict(solved.sources),
    }
