"""Which attitudes the rests had: as the user says, or inferred from the readings, and how sure that is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from margcal.core import so3
from margcal.core.errors import DataError, InputError
from margcal.core.types import Array, Index, Issue, Kind, Recording, SensorModel
from margcal.methods.gyro import propagate_gravity
from margcal.methods.preintegration import integrate, pad
from margcal.workflow import attitudes as att
from margcal.workflow.attitudes import Attitudes
from margcal.workflow.job import Job, Options
from margcal.workflow.segment import Segmentation
from margcal.workflow.turns import MIN_TURNS, along_turns, nominal_gyro, usable_turns

if TYPE_CHECKING:
    from margcal.files.poses_table import PoseTable


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
    has_mag = any("mag" in r.streams for r in recordings)
    if mode == "auto" and has_mag and (n == 0 or (n < MIN_TURNS and "acc" not in options.sensors)):
        return Attitudes("swing", "acc-triangular", text=f"{n} rests: taken as a swing of the magnetometer")
    text = f"{n} rests in unknown attitudes"
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
    """Faces, and the four headings if they are multiples of ninety degrees; None where it is no box.

    Rests at which the accelerometer was not read (another recording lacks it) have no attitude: NaN.
    """
    rests, y = _read(segmentation, "acc")
    faces = att.find_faces(y) if len(rests) >= 4 else None
    if faces is None or (mode == "auto" and not att.lies_on_faces(faces)):
        if mode == "auto":
            return None
        text = f"--poses {mode}: {_why_no_faces(segmentation, recordings)}"
        raise DataError(text, (Issue("no-faces", "fail", text, "acc"),))
    if faces.tilt_deg.max() > 2.5 * att.FACE_TILT_DEG:
        worst = int(np.argmax(faces.tilt_deg))
        text = (
            f"--poses {mode}: rest {rests[worst] + 1} lies {faces.tilt_deg[worst]:.0f} degrees from every face; "
            "the node was not put down on its faces there: use --poses free, or leave that rest out"
        )
        raise DataError(text, (Issue("no-faces", "fail", text, "acc", float(faces.tilt_deg[worst]), 30.0),))
    n, without = len(rests), len(segmentation.poses) - len(rests)
    tilt = float(np.sqrt(np.mean(faces.tilt_deg**2)))
    seen = len({tuple(c) for c in np.round(faces.up).astype(int).tolist()})
    about = f"{n} rests on {seen} of 6 faces (named after the accelerometer's axes), tilt {tilt:.1f} deg rms"
    about += f"; {without} without accelerometer, their attitudes unknown" if without else ""
    figures = {"tilt_rms_deg": tilt, "faces": float(seen)}
    if mode != "faces":
        cube = _cube(recordings, segmentation, options, faces, rests, about, figures)
        if cube is not None:
            return cube
        if mode == "cube":
            text = (
                f"--poses cube: {about}, but neither gyroscope nor magnetometer tells headings that are multiples of "
                "90 degrees; use --poses faces if the box was put down with arbitrary headings"
            )
            raise DataError(text, (Issue("no-cube", "fail", text),))
    up = _among(len(segmentation.poses), rests, faces.up)
    return Attitudes("faces", "housing", up=up, level=True, text=f"{about}, headings free", figures=figures)


def _read(segmentation: Segmentation, kind: Kind) -> tuple[Index, Array]:
    """The rests at which a sensor was read, and its means (J', 3) there."""
    y = segmentation.poses.mean.get(kind, np.zeros((0, 3)))
    rests = np.flatnonzero(np.isfinite(y).all(axis=1))
    return rests, y[rests]


def _among(n: int, rests: Index, values: Array) -> Array:
    """`values` of some rests among all n, NaN at the others."""
    out = np.full((n, *values.shape[1:]), np.nan)
    out[rests] = values
    return out


def _why_no_faces(segmentation: Segmentation, recordings: Sequence[Recording]) -> str:
    if not any("acc" in r.streams for r in recordings):
        return "without an accelerometer nobody knows which face is up; give the attitudes in a table"
    n = len(_read(segmentation, "acc")[0])
    if n < 4:
        return f"{n} rests were found; put the node down on each of its six faces, two seconds each"
    return "the accelerometer's readings at rest lie in one plane; put the node down on all six faces"


def _cube(
    recordings: tuple[Recording, ...],
    segmentation: Segmentation,
    options: Options,
    faces: att.Faces,
    rests: Index,
    about: str,
    figures: dict[str, float],
) -> Attitudes | None:
    """Which of the 24 attitudes each rest has, by gyroscope and magnetometer together; None if it is no cube.

    `faces` are those of `rests`: the accelerometer was read there.
    """
    before, dR = _rough_turns(recordings, segmentation, options, faces, rests)
    R, piece, snap = att.snap_chain(faces.up, dR, before)
    by_gyro = len(snap) > 0
    rms = float(np.sqrt(np.mean(snap**2))) if by_gyro else float("nan")
    if by_gyro and (rms > att.CUBE_RMS_DEG or snap.max() > att.CUBE_SNAP_DEG):
        return None
    m = segmentation.poses.mean.get("mag")
    field = None
    if m is not None and np.isfinite(m[rests]).all():
        field = att.headings_from_field(m[rests], faces.up)
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
            note = (
                f"gyroscope and magnetometer agree on the heading of {agree * 100:.0f} % of the rests; "
                "the gyroscope was followed"
            )
            found.append(Issue("heading-disagreement", "warn", note, None, agree, 1.0))
    n = len(segmentation.poses)
    R, up = _among(n, rests, R), _among(n, rests, faces.up)
    return Attitudes("cube", "housing", R=R, up=up, level=True, text=text, figures=figures, issues=tuple(found))


def _rough_turns(
    recordings: tuple[Recording, ...],
    segmentation: Segmentation,
    options: Options,
    faces: att.Faces,
    rests: Index,
) -> tuple[Index, Array]:
    """Rest before each turn, as an index in `rests`, and the turn's rotation by a gyroscope calibrated roughly."""
    none = np.zeros(0, dtype=np.int64), np.zeros((0, 3, 3))
    if "gyr" not in segmentation.poses.mean:
        return none
    job = Job(recordings, segmentation, Attitudes("faces", "housing"), options)
    v = (segmentation.poses.mean["acc"] - faces.B) @ faces.H.T
    turns = usable_turns(job, np.all(np.isfinite(v), axis=1))
    if len(turns) < MIN_TURNS:
        return none
    y, _ = job.readings("gyr")
    samples = along_turns(job, turns, SensorModel("acc", faces.H, faces.B))
    try:
        fit = propagate_gravity(
            turns,
            v[[t.before for t in turns]],
            v[[t.after for t in turns]],
            H0=nominal_gyro(job),
            along=samples,
            bias_prior=(y.mean(axis=0), np.diag(y.var(axis=0) + 1e-6 * np.abs(y).max() ** 2)),
        )
    except DataError:
        return none
    batch = pad(turns)
    return np.searchsorted(rests, [t.before for t in turns]), integrate(batch.y, batch.dt, fit.model.H, fit.model.B)
