"""Rests, turns and directions of a recording: what they carry, what is missing, what to record next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from margcal.core import so3
from margcal.core.errors import DataError
from margcal.core.types import Array, Issue, Kind, Recording, Turn
from margcal.core.units import UNITS
from margcal.methods.coverage import NINE, SIX, distinct_directions
from margcal.methods.preintegration import integrate, pad
from margcal.methods.triangular import triangular
from margcal.methods.uncertainty import expected_error
from margcal.workflow import attitudes as att
from margcal.workflow.attitudes import Attitudes
from margcal.workflow.decide import decide
from margcal.workflow.findings import Finding, Grade, graded
from margcal.workflow.inspect_axes import gyr_bias
from margcal.workflow.job import NAMES, Job, Options
from margcal.workflow.lint_units import sphere_of
from margcal.workflow.routes import GOOD_ENOUGH_DEG
from margcal.workflow.segment import Segmentation
from margcal.workflow.swing import MIN_SWING_SAMPLES
from margcal.workflow.turns import MIN_TURNS, usable_turns

RESTS = 10
AXES_SPREAD = 0.2
"""Least over largest singular value of the stacked turn axes (robustness.md, 5b)."""
LEAST_TURN_DEG = 30.0
MIN_ATTITUDES = 8
SPHERE = 0.25
"""Misfit of the sphere, and standard error of its radius, up to which its directions are counted (an attached magnet:
0.21; a node that does not turn: 0.5)."""
ROUND = 0.15
"""The same from which the field is doubtful. Measured: 0.02 to 0.09, with a magnet beside the path too; 0.13 where hard
iron and few attitudes mix."""
LOOKED_AT = 1500
"""Samples of a swing whose directions are counted."""
FACE_NAMES = ("+x", "-x", "+y", "-y", "+z", "-z")


@dataclass(frozen=True)
class Carried:
    """What the recordings carry of one sensor: `level` 'pass' (all of it), 'warn' (part), 'fail' (nothing)."""

    kind: Kind
    level: Grade
    text: str
    todo: str = ""


def inspect_coverage(
    recordings: tuple[Recording, ...],
    segmentation: Segmentation,
    lame: Sequence[Kind],
    gains: Mapping[Kind, Array],
) -> tuple[list[Finding], list[Carried]]:
    """Findings on rests, turns, directions and attitudes, and what follows for each sensor.

    Parameters
    ----------
    lame : sequence of kind
        Sensors that `lint` found unusable.
    gains : mapping
        ``gains['gyr']`` (3, 3): rad/s per raw unit where it is known from the motion.
    """
    there: list[Kind] = [k for k in NAMES if any(k in r.streams for r in recordings) and k not in lame]
    options = Options(sensors=tuple(there))
    attitudes, failed = _attitudes(recordings, segmentation, options)
    job = Job(recordings, segmentation, attitudes, options)
    out = [_rests(segmentation)]
    spread = None
    if "gyr" in there:
        finding, spread = _turns(job, gains.get("gyr"))
        out.append(finding)
    directions: dict[Kind, Directions] = {k: _directions(job, k) for k in there if k != "gyr"}
    faces = _faces(segmentation) if "acc" in there else None
    if faces is not None and attitudes.mode in ("cube", "faces"):
        out.append(_faces_finding(faces))
    out += [_direction_finding(job, k, n) for k, n in directions.items()]
    level = "pass" if not failed and len(segmentation.poses) else "note"
    out.append(Finding("attitudes", level, f"would be taken as {attitudes.mode}: {attitudes.text}"))
    out += [Finding("attitudes", i.level, i.text, i.sensor, i.value, i.limit) for i in attitudes.issues]
    carried = [_carried(job, k, directions, faces, spread) for k in there]
    return out, carried


def _attitudes(
    recordings: tuple[Recording, ...], segmentation: Segmentation, options: Options
) -> tuple[Attitudes, bool]:
    try:
        return decide(recordings, segmentation, "auto", options), False
    except DataError as error:
        return Attitudes("free", "acc-triangular", text=str(error)), True


# --- rests and turns ---------------------------------------------------------------------------------


def _rests(segmentation: Segmentation) -> Finding:
    poses = segmentation.poses
    n = len(poses)
    if n == 0:
        text = "no rests of one second or longer"
        todo = "put the node down, hands off, two seconds or more, in ten to thirty attitudes"
        return Finding("rests", "warn", text, None, 0.0, float(RESTS), "", todo)
    length = poses.stop - poses.start
    text = f"{n} rests of {length.min():.1f} to {length.max():.1f} s"
    knocked = int(np.sum(poses.knocks > 0))
    if knocked:
        text += f", {knocked} of them knocked (cut out)"
    todo = "" if n >= RESTS else f"record {RESTS - n} or more further rests in new attitudes"
    return Finding("rests", graded(n >= RESTS, "warn"), text, None, float(n), float(RESTS), "", todo)


def _turns(job: Job, gain: Array | None) -> tuple[Finding, float | None]:
    """Turns between rests: how many, how large, about how many axes (0 to 1)."""
    turns = usable_turns(job)
    n = len(turns)
    todo = "turn by 90 to 180 degrees between rests, about all three axes"
    if n == 0:
        return Finding("turns", "warn", "no turns between rests", "gyr", 0.0, float(MIN_TURNS), "", todo), None
    if gain is None:
        factor = UNITS["gyr"][job.raw_unit("gyr")]
        gain = None if factor is None else factor * np.eye(3)
    lost = len(job.segmentation.turns) - n
    text = f"{n} turns between rests" + (f" ({lost} more left out: saturated)" if lost else "")
    if gain is None:
        level = graded(n >= MIN_TURNS, "warn")
        return Finding(
            "turns", level, text, "gyr", float(n), float(MIN_TURNS), "", "" if n >= MIN_TURNS else todo
        ), None
    vectors = _turn_vectors(job, turns, gain)
    angle = np.degrees(np.linalg.norm(vectors, axis=1))
    large = vectors[angle > LEAST_TURN_DEG]
    spread = 0.0
    if len(large) > 2:
        singular = np.linalg.svd(large / np.linalg.norm(large, axis=1, keepdims=True), compute_uv=False)
        spread = float(singular[2] / singular[0])
    text += f" of {np.quantile(angle, 0.1):.0f} to {np.quantile(angle, 0.9):.0f} degrees"
    if n < MIN_TURNS or len(large) < MIN_TURNS:
        return Finding("turns", "warn", text, "gyr", float(len(large)), float(MIN_TURNS), "", todo), spread
    good = spread >= AXES_SPREAD
    text += f"; spread of their axes {spread:.2f} (1: all directions alike, 0: in one plane)"
    return Finding("turns", graded(good, "warn"), text, "gyr", spread, AXES_SPREAD, "", "" if good else todo), spread


def _turn_vectors(job: Job, turns: Sequence[Turn], gain: Array) -> Array:
    poses = job.segmentation.poses
    y = poses.mean.get("gyr")
    seen = y is not None and np.isfinite(y).all(axis=1).any()
    stream = next(r.gyr for r in job.recordings if r.gyr is not None)
    bias = np.nanmean(y, axis=0) if y is not None and seen else gyr_bias(stream)
    batch = pad(list(turns))
    return so3.log(integrate(batch.y, batch.dt, gain, bias))


# --- directions --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Directions:
    """Directions that are 15 degrees apart: at rest, and over all samples (of a magnetometer)."""

    rest: int
    swing: int = 0
    misfit: float = 0.0
    """Of the sphere through a magnetometer's samples, over its radius."""


def _directions(job: Job, kind: Kind) -> Directions:
    y, _ = job.readings(kind)
    rest = distinct_directions(y) if len(y) >= 4 and np.ptp(y, axis=0).max() > 0 else len(y[:1])
    swing, misfit = 0, 0.0
    if kind == "mag":
        for recording in job.recordings:
            if recording.mag is None or len(recording.mag.t) < MIN_SWING_SAMPLES:
                continue
            thin = recording.mag.y[:: max(1, len(recording.mag.y) // LOOKED_AT)]
            thin = thin[np.isfinite(thin).all(axis=1)]
            sphere = sphere_of(thin)
            if sphere is not None and sphere.rms < SPHERE * sphere.radius and sphere.radius_se < SPHERE * sphere.radius:
                swing = max(swing, distinct_directions(thin, sphere.centre))
                misfit = max(misfit, sphere.rms / sphere.radius)
    return Directions(rest, swing, misfit)


def _direction_finding(job: Job, kind: Kind, found: Directions) -> Finding:
    name = NAMES[kind]
    boxed = job.attitudes.mode in ("cube", "faces", "file", "reference")
    need = 6 if boxed and kind == "acc" else NINE
    n, where = found.rest, "at rest"
    if kind == "mag" and found.swing >= NINE > found.rest:
        n, where = found.swing, "in motion"
    text = f"{name}: {n} directions more than 15 degrees apart {where}"
    if n >= need:
        return Finding("directions", "pass", text, kind, float(n), float(need))
    todo = f"record attitudes that point it in {need - n} or more new directions, edges and corners up too"
    return Finding("directions", "warn", text, kind, float(n), float(need), "", todo)


def _faces(segmentation: Segmentation) -> set[str] | None:
    """Names of the faces that were up; None where the rests do not lie on faces."""
    y = segmentation.poses.mean.get("acc")
    if y is None:
        return None
    y = y[np.isfinite(y).all(axis=1)]  # a recording may lack the accelerometer
    faces = att.find_faces(y) if len(y) >= 4 else None
    if faces is None or not att.lies_on_faces(faces):
        return None
    k = np.argmax(np.abs(faces.up), axis=1)
    return {("+" if faces.up[j, i] > 0 else "-") + "xyz"[i] for j, i in enumerate(k)}


def _faces_finding(faces: set[str]) -> Finding:
    missing = [f for f in FACE_NAMES if f not in faces]
    text = f"{len(faces)} of 6 faces were up" + (f"; never {', '.join(missing)}" if missing else "")
    todo = f"put the node down with {', '.join(missing)} up" if missing else ""
    return Finding("faces", graded(not missing, "warn"), text, "acc", float(len(faces)), 6.0, "", todo)


# --- what is carried ---------------------------------------------------------------------------------


def _carried(
    job: Job, kind: Kind, directions: Mapping[Kind, Directions], faces: set[str] | None, spread: float | None
) -> Carried:
    if kind == "acc":
        return _acc_carried(job, directions["acc"], faces)
    if kind == "gyr":
        return _gyr_carried(job, spread)
    return _mag_carried(job, directions["mag"])


def _known(job: Job) -> bool:
    return job.attitudes.mode in ("cube", "reference", "file")


def _acc_carried(job: Job, found: Directions, faces: set[str] | None) -> Carried:
    more = "put the node down in more attitudes: all six faces up, edges and corners too"
    if job.attitudes.mode in ("cube", "faces") and faces is not None:
        if len(faces) == 6:
            return Carried("acc", "pass", "can be calibrated")
        missing = ", ".join(f for f in FACE_NAMES if f not in faces)
        level = "warn" if len(faces) >= 4 else "fail"
        return Carried("acc", level, f"not all of it: {missing} never was up", f"put it down with {missing} up")
    if _known(job) or (found.rest >= NINE and _nine_parameters(job) <= GOOD_ENOUGH_DEG):
        return Carried("acc", "pass", "can be calibrated")
    if found.rest >= NINE:
        text = f"hardly: its {found.rest} directions lie so that nine parameters come out uncertain"
        return Carried("acc", "warn", text, more)
    if found.rest >= SIX:
        text = f"bias and scale factors only: {found.rest} directions, nine parameters need {NINE}"
        return Carried("acc", "warn", text, more)
    return Carried("acc", "fail", f"cannot be calibrated: {found.rest} directions at rest, {SIX} are the least", more)


def _nine_parameters(job: Job) -> float:
    """Expected error (deg) of bias, scale factors and angles from lengths alone: what `calibrate` goes by."""
    y, _ = job.readings("acc")
    try:
        fit = triangular(y, job.options.gravity)
    except DataError:
        return float("inf")
    if fit.covariance is None or not np.isfinite(fit.covariance).all():
        return float("inf")
    return expected_error("acc", fit.model.H, fit.covariance, job.options.gravity).direction_deg


def _gyr_carried(job: Job, spread: float | None) -> Carried:
    more = "record ten or more turns of 90 to 180 degrees about all axes, with rests in between"
    rests, turns = len(job.readings("gyr")[0]), len(usable_turns(job))
    enough = turns >= MIN_TURNS and (spread is None or spread >= AXES_SPREAD)
    if enough and ("acc" in job.options.sensors or _known(job)):
        return Carried("gyr", "pass", "can be calibrated")
    if rests and UNITS["gyr"][job.raw_unit("gyr")] is not None:
        return Carried("gyr", "warn", f"bias only, gains as its unit says: {turns} usable turns between rests", more)
    what = f"{turns} usable turns between rests" if rests else "no rest"
    return Carried("gyr", "fail", f"cannot be calibrated: {what}", more)


def _mag_carried(job: Job, found: Directions) -> Carried:
    rests = len(job.readings("mag")[0])
    turns = "gyr" in job.options.sensors and len(usable_turns(job)) >= MIN_TURNS
    if rests >= MIN_ATTITUDES and found.rest >= MIN_ATTITUDES and (_known(job) or turns):
        return Carried("mag", "pass", "can be calibrated")
    if found.swing >= NINE and found.misfit > ROUND:
        text = f"doubtful: its samples lie {100 * found.misfit:.0f} % of the field off a sphere"
        return Carried("mag", "warn", text, "keep magnets and iron away from the node, or take them off; record again")
    if found.swing >= NINE:
        gyr = next((r.gyr for r in job.recordings if r.gyr is not None and r.mag is not None), None)
        if gyr is not None and (UNITS["gyr"][gyr.unit] is not None or turns):
            return Carried("mag", "pass", "can be calibrated from its motion (swing)")
        return Carried("mag", "warn", "can be calibrated in a frame of its own: no gyroscope ties it to the node")
    if rests >= NINE and found.rest >= NINE:
        return Carried("mag", "pass", "can be calibrated by the constant dip")
    todo = "wave the node about all axes for 20 s, or put it down in more attitudes"
    n = max(found.rest, found.swing)
    return Carried("mag", "fail", f"cannot be calibrated: {n} directions, nine parameters need {NINE}", todo)


def as_findings(carried: Sequence[Carried], issues: Sequence[Issue]) -> list[Finding]:
    """One finding a sensor; a sensor that fails fails the recording only where nothing else is left."""
    alone = not any(c.level in ("pass", "warn") for c in carried)
    out = [from_carried(c, alone) for c in carried]
    lame = {i.sensor for i in issues if i.level == "fail" and i.sensor is not None}
    out += [Finding("carries", "fail", "cannot be used, see above", kind) for kind in NAMES if kind in lame]
    return [replace(f, text=f"{NAMES[f.sensor]}: {f.text}") for f in out if f.sensor]


def from_carried(carried: Carried, alone: bool) -> Finding:
    level = carried.level if carried.level != "fail" or alone else "warn"
    return Finding("carries", level, carried.text, carried.kind, todo=carried.todo)
