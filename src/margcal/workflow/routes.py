"""The ways from rests, turns and attitudes to H and B, one function for each kind of knowledge.

`known`: the attitude of every rest is known. `housed`: only the face that is up is known, not the heading.
`free`: nothing is known of the attitudes. `swung`: no rests at all. Each returns a `Solved`: a `Fit` for every
sensor that the data carry, and an `Issue` for every one that they do not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from margcal.core import so3
from margcal.core.errors import DataError
from margcal.core.types import Array, Fit, Issue, Kind, Recording, SensorModel, Turn
from margcal.core.units import UNITS
from margcal.methods import ellipsoid as by_magnitude
from margcal.methods import gyro as gyroscope
from margcal.methods import gyro_paper, transform
from margcal.methods.alignment import rotation_from_dip, rotation_from_rates
from margcal.methods.coverage import distinct_directions
from margcal.methods.gyro_start import full_turns
from margcal.methods.joint import Gyro, JointFit, Priors, Triad, joint_fit
from margcal.methods.levelled import level_prior
from margcal.methods.preintegration import along, integrate, pad
from margcal.workflow import attitudes as att
from margcal.workflow.attitudes import Attitudes
from margcal.workflow.lint import clipped
from margcal.workflow.segment import Segmentation

POSE_SOLVERS: dict[str, Callable[..., Fit]] = {
    "one-step": transform.one_step,
    "alternation": transform.alternation,
    "eigen": transform.eigen,
    "svd": transform.svd,
}
"""Accelerometer and magnetometer from poses of known attitude: ``solver(y, R, magnitude, ...)``."""

MAGNITUDE_SOLVERS: dict[str, Callable[..., Fit]] = {
    "ellipsoid": by_magnitude.ellipsoid,
    "triangular": by_magnitude.triangular,
}
"""The same from the magnitude alone, in a frame of each sensor's own."""

GYRO_SOLVERS = ("gauss-newton", "ukf")

FULL_TURN_DEG = (345.0, 375.0)
MIN_TURNS = 5
MIN_SWING_SAMPLES = 200


@dataclass(frozen=True)
class Options:
    """What the user asked for; angles in rad, `field_uT` None where the unit is the local field."""

    sensors: tuple[Kind, ...]
    pose_method: str = "one-step"
    gyro_method: str = "gauss-newton"
    gravity: float = 9.80665
    field_uT: float | None = None
    dip: float | None = None
    level_sd: float = np.radians(1.0)
    nominal: dict[Kind, SensorModel] = field(default_factory=dict)

    @property
    def magnitude(self) -> dict[Kind, float]:
        return {"acc": self.gravity, "mag": 1.0 if self.field_uT is None else self.field_uT, "gyr": 1.0}

    @property
    def unit(self) -> dict[Kind, str]:
        return {"acc": "m/s^2", "gyr": "rad/s", "mag": "norm" if self.field_uT is None else "uT"}


@dataclass(frozen=True)
class Job:
    """Everything a route works with."""

    recordings: tuple[Recording, ...]
    segmentation: Segmentation
    attitudes: Attitudes
    options: Options

    def wants(self, kind: Kind) -> bool:
        return kind in self.options.sensors

    def readings(self, kind: Kind) -> tuple[Array, Array]:
        """Means (J', 3) of the rests at which the sensor was read, and the indices of these rests."""
        y = self.segmentation.poses.mean.get(kind)
        if y is None:
            return np.zeros((0, 3)), np.zeros(0, dtype=np.int64)
        index = np.flatnonzero(np.isfinite(y).all(axis=1))
        return y[index], index

    def raw_unit(self, kind: Kind) -> str:
        return next(r.streams[kind].unit for r in self.recordings if kind in r.streams)

    def as_named(self, kind: Kind) -> dict[str, object]:
        """Keywords that name a solver's result."""
        return {"kind": kind, "raw_unit": self.raw_unit(kind), "unit": self.options.unit[kind]}


@dataclass
class Solved:
    """What a route found, filled sensor by sensor."""

    fits: dict[Kind, Fit] = field(default_factory=dict)
    vectors: dict[Kind, Array] = field(default_factory=dict)
    issues: list[Issue] = field(default_factory=list)
    sources: dict[Kind, str] = field(default_factory=dict)
    delays: dict[Kind, tuple[float, float | None]] = field(default_factory=dict)
    R: Array | None = None
    joint: JointFit | None = None

    def attempt(self, kind: Kind, solve: Callable[[], Fit]) -> Fit | None:
        """Keep the fit of one sensor, or the reason why there is none."""
        try:
            fit = solve()
        except DataError as error:
            reasons = error.issues or (Issue("cannot-calibrate", "fail", str(error), kind),)
            self.issues += [replace(i, level="fail", sensor=i.sensor or kind) for i in reasons]
            return None
        if not (np.isfinite(fit.model.H).all() and np.isfinite(fit.model.B).all()):
            self.issues.append(Issue("not-finite", "fail", f"{kind}: the fit has no finite solution", kind))
            return None
        if not fit.converged:
            text = f"{kind}: {fit.text or 'the fit did not converge'}; record more rests in other attitudes"
            self.issues.append(Issue("not-converged", "fail", text, kind))
            return None
        self.fits[kind] = fit
        return fit


# --- known attitudes ---------------------------------------------------------------------------------


def known(job: Job) -> Solved:
    """Every rest's attitude is known: Z-TIE and ZY-TBME's case, with the solver that was asked for."""
    solved = Solved()
    R = job.attitudes.R
    assert R is not None
    solved.R = R
    usable = np.isfinite(R).all(axis=(1, 2))
    if job.wants("acc"):
        solved.attempt("acc", lambda: _acc_known(job, R, usable))
    if job.wants("mag"):
        solved.attempt("mag", lambda: _poses(job, "mag", R, usable))
    if job.wants("gyr"):
        solved.attempt("gyr", lambda: _gyr_known(job, R, usable, solved))
    for kind, fit in solved.fits.items():
        if fit.u is not None:
            solved.vectors[kind] = fit.u
    if "acc" in solved.fits and "acc" not in solved.vectors and job.attitudes.level:
        solved.vectors["acc"] = np.array([0.0, 0.0, job.options.gravity])
    return solved


def _poses(job: Job, kind: Kind, R: Array, usable: Array) -> Fit:
    y, index = job.readings(kind)
    keep = usable[index]
    y, index = y[keep], index[keep]
    magnitude, name = job.options.magnitude[kind], job.options.pose_method
    if name in MAGNITUDE_SOLVERS:
        return MAGNITUDE_SOLVERS[name](y, magnitude, **job.as_named(kind))
    return POSE_SOLVERS[name](y, np.swapaxes(R[index], 1, 2), magnitude, **job.as_named(kind))


def _acc_known(job: Job, R: Array, usable: Array) -> Fit:
    """One-step, and where the table is level its knowledge of "up" too."""
    up = job.attitudes.up
    if not (job.attitudes.level and up is not None and job.options.pose_method == "one-step"):
        return _poses(job, "acc", R, usable)
    try:
        return _level(job, up)
    except DataError:
        return _poses(job, "acc", R, usable)  # some face never was up: only known headings can carry it


def _level(job: Job, up: Array) -> Fit:
    y, index = job.readings("acc")
    keep = np.isfinite(up[index]).all(axis=1)
    return level_prior(y[keep], up[index[keep]], job.options.gravity, job.options.level_sd, **job.as_named("acc"))


def _gyr_known(job: Job, R: Array, usable: Array, solved: Solved) -> Fit:
    turns = usable_turns(job, usable)
    _need_turns(turns)
    bias, spread, sd = _gyro_rest(job)
    dR = gyroscope.known_rotations(R, turns)
    if job.options.gyro_method == "ukf":
        start = nominal_gyro(job)
        fit = gyro_paper.ukf(turns, dR, H0=start, B0=bias, raw_unit=job.raw_unit("gyr"))
        return fit
    fit = gyroscope.gauss_newton(
        turns, dR, H0=nominal_gyro(job), bias_prior=(bias, spread), sd=sd, raw_unit=job.raw_unit("gyr")
    )
    return _without_full_turns(
        job,
        turns,
        fit,
        solved,
        lambda kept: gyroscope.gauss_newton(
            kept,
            gyroscope.known_rotations(R, kept),
            H0=fit.model.H,
            bias_prior=(bias, spread),
            sd=sd,
            raw_unit=job.raw_unit("gyr"),
        ),
    )


# --- the gyroscope's turns ---------------------------------------------------------------------------


def usable_turns(job: Job, usable: Array | None = None) -> list[Turn]:
    """Turns between usable rests whose readings are all there and none at the end of the scale."""
    turns = []
    for turn in job.segmentation.turns:
        if usable is not None and not (usable[turn.before] and usable[turn.after]):
            continue
        stream = job.recordings[job.segmentation.poses.recording[turn.before]].gyr
        assert stream is not None
        if not clipped(turn.y, stream).any():
            turns.append(turn)
    return turns


def _need_turns(turns: list[Turn]) -> None:
    if len(turns) >= MIN_TURNS:
        return
    text = (
        f"gyroscope: {len(turns)} turns between rests can be used, {MIN_TURNS} are needed; "
        "record more rests with turns of 60 to 270 degrees about all axes in between"
    )
    raise DataError(text, (Issue("too-few-turns", "fail", text, "gyr", float(len(turns)), float(MIN_TURNS)),))


def _gyro_rest(job: Job) -> tuple[Array, Array, Array]:
    """Bias (41), covariance of that bias, and noise of a single reading, from the rests."""
    poses = job.segmentation.poses
    y, index = job.readings("gyr")
    if not len(y):
        text = "gyroscope: no rest, so its bias is unknown; leave the node still for some seconds at the start"
        raise DataError(text, (Issue("no-rest", "fail", text, "gyr"),))
    sd = np.sqrt(np.nanmean(poses.sd["gyr"][index] ** 2, axis=0))
    sd = np.maximum(sd, 1e-9 * np.abs(y).max() + 1e-12)
    scatter = y.std(axis=0, ddof=1) if len(y) > 2 else sd
    # the bias of a turn is not exactly the mean over all rests: its own scatter over the rests is the prior
    return gyroscope.mean_bias(y), np.diag(np.maximum(scatter, sd / 10) ** 2), sd


def nominal_gyro(job: Job) -> Array | None:
    """The gyroscope's H by its unit, or the user's nominal one; None for raw counts."""
    if "gyr" in job.options.nominal:
        return job.options.nominal["gyr"].H
    factor = UNITS["gyr"][job.raw_unit("gyr")]
    return None if factor is None else factor * np.eye(3)


def _without_full_turns(
    job: Job, turns: list[Turn], fit: Fit, solved: Solved, refit: Callable[[list[Turn]], Fit]
) -> Fit:
    """Fit again without full turns, and report what angle they close to: a check that had no part in the fit."""
    found = full_turns(turns, fit.model.H, fit.model.B, low_deg=FULL_TURN_DEG[0], high_deg=FULL_TURN_DEG[1])
    rest = [t for i, t in enumerate(turns) if i not in set(found.index.tolist())]
    if not len(found.index) or len(rest) < MIN_TURNS:
        return fit
    again = refit(rest)
    found = full_turns([turns[i] for i in found.index], again.model.H, again.model.B, low_deg=300, high_deg=420)
    angles = ", ".join(f"{a:.1f}" for a in found.angle_deg)
    text = (
        f"gyroscope: {len(found.index)} full turns were kept out of the fit; calibrated they close at {angles} degrees"
    )
    worst = float(np.max(np.abs(found.angle_deg - 360.0), initial=0.0))
    solved.issues.append(Issue("full-turns", "note", text, "gyr", worst))
    return again


# --- faces and free: attitudes from gravity and the gyroscope ----------------------------------------


def housed(job: Job) -> Solved:
    """The face that is up is known, the heading is not."""
    solved = Solved()
    up = job.attitudes.up
    assert up is not None
    if job.wants("acc"):
        solved.attempt("acc", lambda: _level(job, up))
        solved.vectors["acc"] = np.array([0.0, 0.0, job.options.gravity])
    return _with_gravity(job, solved, Priors(up=up, level_sd=job.options.level_sd), triangular=False)


def free(job: Job) -> Solved:
    """Nobody knows the attitudes: the accelerometer from its magnitude, the others by gravity (Tedaldi 2014)."""
    solved = Solved()
    if job.wants("acc"):
        solved.attempt("acc", lambda: _acc_free(job, solved))
        solved.vectors["acc"] = np.array([0.0, 0.0, job.options.gravity])
    return _with_gravity(job, solved, Priors(), triangular=True)


def _acc_free(job: Job, solved: Solved) -> Fit:
    y, _ = job.readings("acc")
    try:
        return by_magnitude.triangular(y, job.options.gravity, **job.as_named("acc"))
    except DataError as error:
        first = error
    try:
        fit = by_magnitude.bias_and_scale(y, job.options.gravity, **job.as_named("acc"))
    except DataError:
        raise first from None
    n = distinct_directions(y)
    text = (
        f"accelerometer: {n} distinct directions carry bias and scale factors only, not the angles between its "
        f"axes (10 are needed); record rests in at least {10 - n} more directions, such as edges and corners up"
    )
    solved.issues.append(Issue("bias-and-scale-only", "warn", text, "acc", float(n), 10.0))
    return fit


def _with_gravity(job: Job, solved: Solved, priors: Priors, *, triangular: bool) -> Solved:
    """Gyroscope and magnetometer on top of a calibrated accelerometer, then all of them together."""
    acc = solved.fits.get("acc")
    if acc is None:
        for kind in ("gyr", "mag"):
            if job.wants(kind):
                _needs_accelerometer(kind, solved)
        return solved
    y, index = job.readings("acc")
    v = np.full((len(job.segmentation.poses), 3), np.nan)
    v[index] = acc.model.apply(y)
    turns = usable_turns(job, np.isfinite(v).all(axis=1))
    if job.wants("gyr"):
        solved.attempt("gyr", lambda: _gyr_by_gravity(job, turns, v, acc, solved))
        if "gyr" in solved.fits:
            turns = _not_full(turns, solved.fits["gyr"])
    R, piece = _attitudes_by_gyro(job, solved, v)
    if job.wants("mag"):
        fit = solved.attempt("mag", lambda: _mag_by_attitudes(job, R, piece, v))
        if fit is not None and fit.u is not None:
            R = _turned_to_field(job, fit, R, piece)
    return _refined(job, solved, R, turns, priors, triangular=triangular and acc.rank >= 9)


def _needs_accelerometer(kind: Kind, solved: Solved) -> None:
    name = {"gyr": "gyroscope", "mag": "magnetometer"}[kind]
    text = (
        f"{name}: without known attitudes it is calibrated by gravity, and the accelerometer is not there or "
        "could not be calibrated; give the attitudes with --poses FILE, or record the accelerometer too"
    )
    solved.issues.append(Issue("needs-accelerometer", "fail", text, kind))


def _gyr_by_gravity(job: Job, turns: list[Turn], v: Array, acc: Fit, solved: Solved) -> Fit:
    _need_turns(turns)
    bias, spread, sd = _gyro_rest(job)

    def fit_of(kept: list[Turn], start: Array | None) -> Fit:
        before = v[[t.before for t in kept]]
        after = v[[t.after for t in kept]]
        return gyroscope.propagate_gravity(
            kept,
            before,
            after,
            H0=start,
            along=along_turns(job, kept, acc.model),
            bias_prior=(bias, spread),
            sd=sd,
            raw_unit=job.raw_unit("gyr"),
        )

    fit = fit_of(turns, nominal_gyro(job))
    return _without_full_turns(job, turns, fit, solved, lambda kept: fit_of(kept, fit.model.H))


def _not_full(turns: list[Turn], fit: Fit) -> list[Turn]:
    found = full_turns(turns, fit.model.H, fit.model.B, low_deg=FULL_TURN_DEG[0], high_deg=FULL_TURN_DEG[1])
    return [t for i, t in enumerate(turns) if i not in set(found.index.tolist())]


def along_turns(job: Job, turns: list[Turn], acc: SensorModel) -> Array:
    """Calibrated accelerometer at the gyroscope's samples of each turn, (T, N, 3)."""
    longest = max(len(t.dt) for t in turns)
    out = np.zeros((len(turns), longest, 3))
    for index, recording in enumerate(job.recordings):
        mine = [i for i, t in enumerate(turns) if job.segmentation.poses.recording[t.before] == index]
        if not mine or recording.acc is None:
            continue
        part = along([turns[i] for i in mine], recording.acc.t, acc.apply(recording.acc.y))
        out[mine, : part.shape[1]] = part
        out[mine, part.shape[1] :] = part[:, -1:]
    return out


def _attitudes_by_gyro(job: Job, solved: Solved, v: Array) -> tuple[Array, Array]:
    """R_nh of all rests: levelled by the accelerometer, headings by the gyroscope where there is one."""
    gyr = solved.fits.get("gyr")
    filled = np.where(np.isfinite(v), v, np.array([0.0, 0.0, 1.0]))
    if gyr is None:
        return att.chain(filled, np.zeros((0, 3, 3)), np.zeros(0, dtype=np.int64))
    turns = list(job.segmentation.turns)  # full turns too: they keep the chain together
    seen = np.isfinite(v).all(axis=1)
    turns = [t for t in turns if seen[t.before] and seen[t.after]]
    if not turns:
        return att.chain(filled, np.zeros((0, 3, 3)), np.zeros(0, dtype=np.int64))
    batch = pad(turns)
    dR = integrate(batch.y, batch.dt, gyr.model.H, gyr.model.B)
    return att.chain(filled, dR, np.array([t.before for t in turns]))


def _mag_by_attitudes(job: Job, R: Array, piece: Array, v: Array) -> Fit:
    """One-step on the longest chain that the gyroscope holds together; without one, by the constant dip."""
    y, index = job.readings("mag")
    numbers, counts = np.unique(piece[index], return_counts=True)
    longest = index[piece[index] == numbers[np.argmax(counts)]]
    magnitude = job.options.magnitude["mag"]
    if len(longest) >= 8:
        means = job.segmentation.poses.mean["mag"][longest]
        return transform.one_step(means, np.swapaxes(R[longest], 1, 2), magnitude, **job.as_named("mag"))
    return _mag_by_dip(job, y, v[index])


def _mag_by_dip(job: Job, y: Array, v: Array) -> Fit:
    fit = by_magnitude.ellipsoid(y, job.options.magnitude["mag"], **job.as_named("mag"))
    unit = fit.model.apply(y) / job.options.magnitude["mag"]
    Omega = rotation_from_dip(unit, v / np.linalg.norm(v, axis=1, keepdims=True))
    if Omega is None:
        text = (
            "magnetometer: the rests do not tell how it is mounted to the accelerometer; record the gyroscope "
            "too, or more rests in more attitudes"
        )
        raise DataError(text, (Issue("no-alignment", "fail", text, "mag"),))
    inclination = float(np.mean(np.sum((unit @ Omega.T) * v, axis=1) / np.linalg.norm(v, axis=1)))
    inclination = float(np.clip(inclination, -1, 1))
    u = job.options.magnitude["mag"] * np.array([0.0, np.sqrt(1 - inclination**2), inclination])
    model = replace(fit.model, H=Omega @ fit.model.H, method="ellipsoid+dip", covariance=None)
    return replace(fit, model=model, u=u, method="ellipsoid+dip", covariance=None)


def _turned_to_field(job: Job, fit: Fit, R: Array, piece: Array) -> Array:
    """Turn every chain about the vertical so that its field points where the fit's does."""
    y, index = job.readings("mag")
    assert fit.u is not None
    field_n = np.full((len(R), 3), np.nan)
    field_n[index] = np.einsum("jab,jb->ja", R[index], fit.model.apply(y))
    out = R.copy()
    alone = len(np.unique(piece)) == len(piece)
    for p in np.unique(piece):
        inside = piece == p
        mean = np.nanmean(field_n[inside], axis=0) if np.isfinite(field_n[inside]).any() else fit.u
        want, have = np.arctan2(fit.u[1], fit.u[0]), np.arctan2(mean[1], mean[0])
        if len(index) >= 8 and (alone or inside.sum() < len(R)):
            out[inside] = so3.exp(np.array([0.0, 0.0, want - have])) @ R[inside]
    return out


def _refined(job: Job, solved: Solved, R: Array, turns: list[Turn], priors: Priors, *, triangular: bool) -> Solved:
    """One joint refinement of all sensors and attitudes; where the accelerometer stands alone there is nothing
    to share."""
    solved.R = R
    if "gyr" not in solved.fits and "mag" not in solved.fits:
        return solved
    acc_only_diagonal = solved.fits["acc"].rank < 9
    if acc_only_diagonal:
        return solved
    triads: dict[Kind, Triad] = {}
    for kind in ("acc", "mag"):
        if kind in solved.fits:
            triads[kind] = triad_of(job, kind, solved.fits[kind], solved.vectors.get(kind), triangular)
    gyro = gyro_of(job, solved.fits["gyr"], turns) if "gyr" in solved.fits else None
    joint = joint_fit(triads, gyro, R, priors)
    if joint.converged and all(np.isfinite(h).all() for h in joint.H.values()):
        adopt(job, solved, joint)
    return solved


def triad_of(job: Job, kind: Kind, fit: Fit, u: Array | None, triangular: bool) -> Triad:
    """One sensor's rests as the joint fit takes them, started from `fit`."""
    poses = job.segmentation.poses
    vector = fit.u if u is None else u
    assert vector is not None
    return Triad(
        poses.mean[kind],
        standard_error(job, kind),
        np.linalg.inv(fit.model.H),
        fit.model.B,
        vector,
        triangular=triangular and kind == "acc",
        u_free=kind == "mag",
    )


def gyro_of(job: Job, fit: Fit, turns: list[Turn]) -> Gyro:
    poses = job.segmentation.poses
    _, _, sd = _gyro_rest(job)
    return Gyro(
        poses.mean["gyr"],
        standard_error(job, "gyr"),
        fit.model.H,
        fit.model.B,
        pad(turns),
        np.array([t.before for t in turns]),
        np.array([t.after for t in turns]),
        sd,
    )


def standard_error(job: Job, kind: Kind) -> Array:
    """Standard error (J, 3) of the rests' means: scatter over sqrt(n), never below a tenth of its median."""
    poses = job.segmentation.poses
    se = poses.sd[kind] / np.sqrt(np.maximum(poses.count[kind], 1))[:, None]
    floor = 0.1 * np.nanmedian(se) + 1e-9 * np.nanmax(np.abs(poses.mean[kind]))
    return np.maximum(se, floor)


def adopt(job: Job, solved: Solved, joint: JointFit) -> None:
    """Put the joint estimate in the place of the single ones."""
    solved.joint, solved.R = joint, joint.R
    for kind, H in joint.H.items():
        old = solved.fits[kind]
        model = replace(old.model, H=H, B=joint.B[kind], covariance=joint.covariance[kind])
        method = f"{old.method}+joint"
        solved.fits[kind] = replace(
            old,
            model=replace(model, method=method),
            residual=joint.residual[kind],
            covariance=joint.covariance[kind],
            u=joint.u.get(kind),
            method=method,
        )
        if kind in joint.u:
            solved.vectors[kind] = joint.u[kind]


# --- swing -------------------------------------------------------------------------------------------


def swung(job: Job, solved: Solved | None = None) -> Solved:
    """A magnetometer waved about: B and H^T H from all samples, its frame from the gyroscope."""
    solved = solved or Solved()
    best: tuple[float, Recording, Fit] | None = None
    failure: DataError | None = None
    for recording in job.recordings:
        if recording.mag is None or len(recording.mag.t) < MIN_SWING_SAMPLES:
            continue
        try:
            fit = by_magnitude.adjusted_ellipsoid(
                recording.mag.y[np.isfinite(recording.mag.y).all(axis=1)],
                job.options.magnitude["mag"],
                **job.as_named("mag"),
            )
        except DataError as error:
            failure = error
            continue
        spread = np.inf if fit.covariance is None else float(np.trace(fit.covariance[9:, 9:]))
        if best is None or spread < best[0]:
            best = (spread, recording, fit)
    if best is None:
        solved.attempt("mag", lambda: _no_swing(failure))
        return solved
    _, recording, fit = best
    solved.fits["mag"] = fit
    solved.sources["mag"] = f"{recording.source}: all {len(recording.streams['mag'].t)} samples"
    _aligned(job, solved, recording, fit)
    return solved


def _no_swing(failure: DataError | None) -> Fit:
    if failure is not None:
        raise failure
    text = f"magnetometer: fewer than {MIN_SWING_SAMPLES} samples; wave the node about all axes for 20 s or longer"
    raise DataError(text, (Issue("too-few-samples", "fail", text, "mag"),))


def _aligned(job: Job, solved: Solved, recording: Recording, fit: Fit) -> None:
    """Turn the magnetometer's H into the gyroscope's frame, if the recording has one."""
    gyr = recording.gyr
    calibrated = solved.fits.get("gyr")
    if gyr is None or (calibrated is None and UNITS["gyr"][gyr.unit] is None):
        text = (
            "magnetometer: nothing tells its rotation to the other sensors (no gyroscope in a known unit in this "
            "recording); its frame is its own, and only magnitudes can be trusted"
        )
        solved.issues.append(Issue("own-frame", "warn", text, "mag"))
        upper = np.linalg.cholesky(fit.model.H.T @ fit.model.H).T
        solved.fits["mag"] = replace(fit, model=replace(fit.model, H=upper, covariance=None), covariance=None)
        return
    if calibrated is not None:
        rate = calibrated.model.apply(gyr.y)
    else:
        factor = UNITS["gyr"][gyr.unit] or 1.0
        rate = factor * gyr.y
    mag = recording.streams["mag"]
    good = np.isfinite(mag.y).all(axis=1)
    v = fit.model.apply(mag.y[good]) / job.options.magnitude["mag"]
    found = rotation_from_rates(mag.t[good], v, gyr.t, rate)
    H = found.Omega @ fit.model.H
    covariance = _turned_covariance(fit.covariance, found.Omega, found.se_deg, H)
    solved.fits["mag"] = replace(fit, model=replace(fit.model, H=H, covariance=covariance), covariance=covariance)
    if found.delay_s is not None:
        solved.delays["mag"] = (found.delay_s, found.delay_se_s)
    angles = np.degrees(so3.log(found.Omega))
    text = (
        "magnetometer: turned into the gyroscope's frame by "
        f"[{angles[0]:.2f} {angles[1]:.2f} {angles[2]:.2f}] deg, standard errors "
        f"[{found.se_deg[0]:.2f} {found.se_deg[1]:.2f} {found.se_deg[2]:.2f}] deg"
    )
    solved.issues.append(Issue("aligned-to-gyroscope", "note", text, "mag", float(np.nanmax(found.se_deg))))


def _turned_covariance(C: Array | None, Omega: Array, se_deg: Array, H: Array) -> Array | None:
    """Covariance of (Omega K, B) from that of (K, B) and the standard errors of Omega."""
    if C is None or not np.isfinite(se_deg).all():
        return None
    T = np.zeros((12, 12))
    T[:9, :9] = np.kron(Omega, np.eye(3))
    T[9:, 9:] = np.eye(3)
    turned = T @ C @ T.T
    # H <- exp(d) H changes row by row by (d x columns of H)
    J = np.zeros((9, 3))
    for k in range(3):
        J[:, k] = (so3.skew(np.eye(3)[k]) @ H).ravel()
    turned[:9, :9] += (J * np.radians(se_deg) ** 2) @ J.T
    return turned
