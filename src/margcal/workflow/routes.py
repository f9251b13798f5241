"""The ways from rests, turns and attitudes to H and B, one function for each kind of knowledge.

`known`: the attitude of every rest is known. `housed`: only the face that is up is known, not the heading.
`free`: nothing is known of the attitudes. Each returns a `Solved`: a `Fit` for every sensor that the data
carry, and an `Issue` for every one that they do not. (A swing, without rests, is in `swing`.)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from margcal.core import so3
from margcal.core.errors import DataError
from margcal.core.types import Array, Fit, Index, Issue, Kind, Mask, Turn
from margcal.methods import ellipsoid as by_magnitude
from margcal.methods import gyro as gyroscope
from margcal.methods import gyro_paper, transform
from margcal.methods.alignment import rotation_from_dip
from margcal.methods.coverage import distinct_directions
from margcal.methods.gyro_start import rotation_starts
from margcal.methods.joint import Gyro, JointFit, Priors, Triad
from margcal.methods.levelled import level_prior
from margcal.methods.preintegration import integrate, pad
from margcal.methods.uncertainty import expected_error
from margcal.workflow import attitudes as att
from margcal.workflow.job import NAMES, Job, Solved
from margcal.workflow.robust import issues_of, robust_joint
from margcal.workflow.segment import quantum
from margcal.workflow.turns import (
    along_turns,
    check_full_turns,
    gyro_rest,
    need_turns,
    nominal_gyro,
    not_full,
    usable_turns,
    with_nominal,
    without_full_turns,
)

POSE_SOLVERS: dict[str, Callable[..., Fit]] = {
    "gls-ml": transform.one_step,  # its start; `_jointly` does the rest
    "one-step": transform.one_step,
    "alternation": transform.alternation,
    "eigen": transform.eigen,
    "svd": transform.svd,
}


MAGNITUDE_SOLVERS: dict[str, Callable[..., Fit]] = {
    "ellipsoid": by_magnitude.ellipsoid,
    "triangular": by_magnitude.triangular,
}


GOOD_ENOUGH_DEG = 0.5
"""Expected error up to which nobody looks for a fit with fewer parameters."""

TILTED = 5.0
"""From how many standard deviations of a rest's tilt on the laboratory's own is to blame."""

GYRO_SOLVERS = ("gauss-newton", "ukf")


def known(job: Job) -> Solved:
    """Every rest's attitude is known: Z-TIE and ZY-TBME's case, with the solver that was asked for."""
    solved = Solved()
    R = job.attitudes.R
    assert R is not None
    solved.R = R
    usable: Mask = np.all(np.isfinite(R), axis=(1, 2))
    if job.wants("acc"):
        solved.attempt("acc", lambda: _acc_known(job, R, usable))
    if job.wants("mag"):
        solved.attempt("mag", lambda: _poses(job, "mag", R, usable))
    if job.wants("gyr"):
        solved.attempt("gyr", lambda: _gyr_known(job, R, usable))
    if job.options.pose_method in MAGNITUDE_SOLVERS:
        _own_frames(job, solved)
    for kind, fit in solved.fits.items():
        if fit.u is not None:
            solved.vectors[kind] = fit.u
    if "acc" in solved.fits and "acc" not in solved.vectors and job.attitudes.level:
        solved.vectors["acc"] = np.array([0.0, 0.0, job.options.gravity])
    if job.options.pose_method == "gls-ml":
        vertical = job.options.level_sd if job.attitudes.level else None
        _jointly(job, solved, usable_turns(job, usable), Priors(R0=R, vertical_sd=vertical), free_up=True)
    check_full_turns(job, solved)
    return solved


def _poses(job: Job, kind: Kind, R: Array, usable: Mask) -> Fit:
    y, index = job.readings(kind)
    keep = usable[index]
    y, index = y[keep], index[keep]
    magnitude, name = job.options.magnitude[kind], job.options.pose_method
    if name in MAGNITUDE_SOLVERS:
        return MAGNITUDE_SOLVERS[name](y, magnitude, **job.as_named(kind))
    return POSE_SOLVERS[name](y, np.swapaxes(R[index], 1, 2), magnitude, **job.as_named(kind))


def _own_frames(job: Job, solved: Solved) -> None:
    """A fit by magnitude alone knows nothing of the housing: say so, and claim no direction."""
    for kind in ("acc", "mag"):
        fit = solved.fits.get(kind)
        if fit is None:
            continue
        text = (
            f"{NAMES[kind]}: method {job.options.pose_method} uses magnitudes only; H is in the sensor's own frame, "
            "not in the housing's, and only magnitudes can be trusted; leave --method out to have one frame for all"
        )
        solved.issues.append(Issue("own-frame", "warn", text, kind))
        solved.fits[kind] = replace(fit, model=replace(fit.model, covariance=None), covariance=None)


def _acc_known(job: Job, R: Array, usable: Mask) -> Fit:
    """One-step, and where the table is level its knowledge of "up" too."""
    up = job.attitudes.up
    if not (job.attitudes.level and up is not None and job.options.pose_method == "gls-ml"):
        return _poses(job, "acc", R, usable)
    try:
        fit = _level(job, up)
    except DataError:
        return _poses(job, "acc", R, usable)  # some face never was up: only known headings can carry it
    if not fit.converged:
        _refuse_tilted(job, _poses(job, "acc", R, usable))
    return fit


def _refuse_tilted(job: Job, fit: Fit) -> None:
    """Say so where "up" of the given attitudes is not up, by a `fit` that did not take it for granted."""
    if fit.u is None:
        return
    u = fit.u if np.linalg.det(fit.model.H) > 0 else -fit.u
    tilt = float(np.degrees(np.arccos(np.clip(u[2] / np.linalg.norm(u), -1, 1))))
    limit = TILTED * float(np.degrees(job.options.level_sd))
    if tilt > limit:
        text = (
            f"accelerometer: the attitudes' up is {tilt:.0f} degrees off the vertical, so the fit that takes the table "
            "as level does not converge; leave --level out, or turn the attitudes so that their z is up"
        )
        raise DataError(text, (Issue("not-converged", "fail", text, "acc", tilt, limit),))


def _level(job: Job, up: Array) -> Fit:
    y, index = job.readings("acc")
    keep = np.isfinite(up[index]).all(axis=1)
    return level_prior(y[keep], up[index[keep]], job.options.gravity, job.options.level_sd, **job.as_named("acc"))


def _gyr_known(job: Job, R: Array, usable: Mask) -> Fit:
    turns = usable_turns(job, usable)
    need_turns(turns)
    bias, spread, sd = gyro_rest(job)
    dR = gyroscope.known_rotations(R, turns)
    if job.options.gyro_method == "ukf":
        start = nominal_gyro(job)
        start = next(rotation_starts(turns, dR, bias)) if start is None else start
        scale = float(np.cbrt(abs(np.linalg.det(start))))  # the filter is tuned for an H of order one
        return gyro_paper.ukf(turns, dR, H0=start, B=bias, scale=scale, raw_unit=job.raw_unit("gyr"))
    fit = gyroscope.gauss_newton(
        turns, dR, H0=nominal_gyro(job), bias_prior=(bias, spread), sd=sd, raw_unit=job.raw_unit("gyr")
    )
    return without_full_turns(
        turns,
        fit,
        lambda kept: gyroscope.gauss_newton(
            kept,
            gyroscope.known_rotations(R, kept),
            H0=fit.model.H,
            bias_prior=(bias, spread),
            sd=sd,
            raw_unit=job.raw_unit("gyr"),
        ),
    )


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
    """Nine parameters where the directions carry them, else bias and scale factors; the more certain of the two."""
    y, _ = job.readings("acc")
    nine = six = reason = None
    try:
        nine = by_magnitude.triangular(y, job.options.gravity, **job.as_named("acc"))
        if _acc_error(job, nine) <= GOOD_ENOUGH_DEG:
            return nine
    except DataError as error:
        reason = error
    try:
        six = by_magnitude.bias_and_scale(y, job.options.gravity, **job.as_named("acc"))
    except DataError:
        if nine is None and reason is not None:
            raise reason from None
    if six is None or (nine is not None and _acc_error(job, nine) <= _acc_error(job, six)):
        assert nine is not None
        return nine
    n, error = distinct_directions(y), _acc_error(job, six)
    than = (
        "" if nine is None else f" (expected error {_acc_error(job, nine):.1f} degrees with them, {error:.1f} without)"
    )
    text = (
        f"accelerometer: {len(y)} rests in {n} directions carry bias and scale factors only, not the angles between "
        f"its axes{than}; record five or more rests in new directions, edges and corners up too"
    )
    solved.issues.append(Issue("bias-and-scale-only", "warn", text, "acc", float(n), 15.0))
    return six


def _acc_error(job: Job, fit: Fit) -> float:
    if fit.covariance is None or not fit.converged:
        return float("inf")
    return expected_error("acc", fit.model.H, fit.covariance, job.options.gravity).direction_deg


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
    turns = usable_turns(job, np.all(np.isfinite(v), axis=1))
    if job.wants("gyr"):
        by_gravity = lambda: _gyr_by_gravity(job, turns, v, acc)  # noqa: E731
        solved.attempt("gyr", lambda: with_nominal(job, acc.model, by_gravity, solved))
    R, piece = _attitudes_by_gyro(job, solved, v)
    if job.wants("mag"):
        fit = solved.attempt("mag", lambda: _mag_by_attitudes(job, R, piece, v))
        if fit is not None and fit.u is not None:
            R = _turned_to_field(job, fit, R, piece)
            solved.vectors["mag"] = fit.u
    solved.R = R
    if job.options.pose_method == "gls-ml" and job.options.gyro_method == "gauss-newton":
        _jointly(job, solved, turns, priors, triangular=triangular)
    else:
        _say_what_was_taken(job, solved)
    if solved.joint is None:
        _inherit_frame_error(job, solved, acc)
    check_full_turns(job, solved)
    return solved


def _say_what_was_taken(job: Job, solved: Solved) -> None:
    """Where nobody knows the attitudes the solvers for known ones have no place; nothing is swapped in silence."""
    asked = {"acc": job.options.pose_method, "mag": job.options.pose_method, "gyr": job.options.gyro_method}
    for kind, fit in solved.fits.items():
        if fit.method in (asked[kind], "nominal-gain") or asked[kind] in ("gls-ml", "gauss-newton"):
            continue
        text = f"{NAMES[kind]}: method {asked[kind]} needs known attitudes; {fit.method} was taken"
        solved.issues.append(Issue("method-replaced", "note", text, kind))


def _inherit_frame_error(job: Job, solved: Solved, acc: Fit) -> None:
    """Fitted one after the other, gyroscope and magnetometer know the frame no better than the accelerometer does
    (which may have been levelled by the table alone, or has had its axes taken as orthogonal)."""
    sd = np.radians(_acc_error(job, acc)) / np.sqrt(2)  # about each axis
    for kind in ("gyr", "mag"):
        fit = solved.fits.get(kind)
        if fit is None or fit.covariance is None or not np.isfinite(sd):
            continue
        J = np.stack([(so3.skew(axis) @ fit.model.H).ravel() for axis in np.eye(3)], axis=1)
        C = fit.covariance.copy()
        C[:9, :9] += sd**2 * J @ J.T
        solved.fits[kind] = replace(fit, model=replace(fit.model, covariance=C), covariance=C)


def _needs_accelerometer(kind: Kind, solved: Solved) -> None:
    name = {"gyr": "gyroscope", "mag": "magnetometer"}[kind]
    text = (
        f"{name}: without known attitudes it is calibrated by gravity, and the accelerometer is not there or "
        "could not be calibrated; give the attitudes with --poses FILE, or record the accelerometer too"
    )
    solved.issues.append(Issue("needs-accelerometer", "fail", text, kind))


def _gyr_by_gravity(job: Job, turns: list[Turn], v: Array, acc: Fit) -> Fit:
    need_turns(turns)
    bias, spread, sd = gyro_rest(job)

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
    return without_full_turns(turns, fit, lambda kept: fit_of(kept, fit.model.H))


def _attitudes_by_gyro(job: Job, solved: Solved, v: Array) -> tuple[Array, Index]:
    """R_nh of all rests: levelled by the accelerometer, headings by the gyroscope where there is one."""
    gyr = solved.fits.get("gyr")
    filled = np.where(np.isfinite(v), v, np.array([0.0, 0.0, 1.0]))
    if gyr is None:
        return att.chain(filled, np.zeros((0, 3, 3)), np.zeros(0, dtype=np.int64))
    turns = list(job.segmentation.turns)  # full turns too: they keep the chain together
    seen: Mask = np.all(np.isfinite(v), axis=1)
    turns = [t for t in turns if seen[t.before] and seen[t.after]]
    if not turns:
        return att.chain(filled, np.zeros((0, 3, 3)), np.zeros(0, dtype=np.int64))
    batch = pad(turns)
    dR = integrate(batch.y, batch.dt, gyr.model.H, gyr.model.B)
    return att.chain(filled, dR, np.array([t.before for t in turns]))


def _mag_by_attitudes(job: Job, R: Array, piece: Index, v: Array) -> Fit:
    """One-step on the longest chain that the gyroscope holds together; without one, by the constant dip."""
    y, index = job.readings("mag")
    if not len(index):
        text = (
            "magnetometer: it was read at no rest; record it while the node lies still, or wave the node about with "
            "magnetometer and gyroscope recorded together"
        )
        raise DataError(text, (Issue("no-rest", "fail", text, "mag"),))
    numbers, counts = np.unique(piece[index], return_counts=True)
    longest = index[piece[index] == numbers[np.argmax(counts)]]
    magnitude = job.options.magnitude["mag"]
    if len(longest) >= 8:
        means = job.segmentation.poses.mean["mag"][longest]
        solver = POSE_SOLVERS.get(job.options.pose_method, transform.one_step)
        return solver(means, np.swapaxes(R[longest], 1, 2), magnitude, **job.as_named("mag"))
    return _mag_by_dip(job, y, v[index])


def _mag_by_dip(job: Job, y: Array, v: Array) -> Fit:
    fit = by_magnitude.ellipsoid(y, job.options.magnitude["mag"], **job.as_named("mag"))
    both = np.isfinite(v).all(axis=1)  # rests at which the accelerometer was read too
    y, v = y[both], v[both]
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


def _turned_to_field(job: Job, fit: Fit, R: Array, piece: Index) -> Array:
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


def _jointly(
    job: Job, solved: Solved, turns: list[Turn], priors: Priors, *, triangular: bool = False, free_up: bool = False
) -> None:
    """All sensors and attitudes together, started from the single fits in `solved`, which it replaces.

    `triangular`: the accelerometer defines the frame; `free_up`: the vertical of the laboratory is estimated.
    """
    poses: tuple[Kind, ...] = ("acc", "mag")
    whole: dict[Kind, Fit] = {k: f for k, f in solved.fits.items() if f.rank >= 9}
    if not whole.keys() & set(poses) or (solved.fits.keys() - whole.keys()):
        return  # a sensor with bias and scale only has no attitudes to share
    assert solved.R is not None
    known_R: Mask = np.all(np.isfinite(solved.R), axis=(1, 2))
    triads: dict[Kind, Triad] = {
        k: triad_of(job, k, whole[k], solved, triangular, free_up, known_R) for k in poses if k in whole
    }
    gyro = None
    if "gyr" in whole and job.options.gyro_method == "gauss-newton":
        gyro = gyro_of(job, whole["gyr"], _not_full(turns, whole))
    R = np.where(known_R[:, None, None], solved.R, np.eye(3))
    robust = robust_joint(triads, gyro, R, priors)
    if robust.fit.converged and all(np.isfinite(h).all() for h in robust.fit.H.values()):
        solved.singles = dict(solved.fits)
        for out in robust.left_out:
            solved.left_out.setdefault(out.what, set()).add(out.index)
        adopt(solved, robust.fit)
        solved.R = np.where(known_R[:, None, None], robust.fit.R, np.nan)
        solved.issues += issues_of(robust, cube=job.attitudes.mode in ("cube", "file"))
        return
    text = (
        f"the joint fit of all sensors did not converge in {robust.fit.n_iter} iterations; each sensor was "
        "calibrated by itself, with larger errors: look at the residuals for a wrong attitude"
    )
    solved.issues.append(Issue("joint-not-converged", "warn", text))


def _not_full(turns: list[Turn], fits: dict[Kind, Fit]) -> list[Turn]:
    return not_full(turns, fits["gyr"]) if "gyr" in fits and turns else turns


def triad_of(job: Job, kind: Kind, fit: Fit, solved: Solved, triangular: bool, free_up: bool, usable: Mask) -> Triad:
    """One sensor's rests as the joint fit takes them, started from `fit`; rests that are not `usable` count as not
    measured."""
    return Triad(
        np.where(usable[:, None], job.segmentation.poses.mean[kind], np.nan),
        standard_error(job, kind),
        np.asarray(np.linalg.inv(fit.model.H), dtype=np.float64),
        fit.model.B,
        solved.vectors[kind],
        triangular=triangular and kind == "acc",
        u_free=kind == "mag" or free_up,
    )


def gyro_of(job: Job, fit: Fit, turns: list[Turn]) -> Gyro:
    poses = job.segmentation.poses
    _, _, sd = gyro_rest(job)
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
    """Standard error (J, 3) of the rests' means: scatter over sqrt(n), never below a tenth of its median.

    Where a rest scatters by less than a step of the converter, more samples tell no more: step / sqrt(12).
    """
    poses = job.segmentation.poses
    step = max((quantum(r.streams[kind].y) for r in job.recordings if kind in r.streams), default=0.0)
    se = poses.sd[kind] / np.sqrt(np.maximum(poses.count[kind], 1))[:, None]
    se = np.where(poses.sd[kind] < step / 2, np.maximum(se, step / np.sqrt(12)), se)
    floor = 0.1 * np.nanmedian(se) + 1e-9 * np.nanmax(np.abs(poses.mean[kind]))
    return np.maximum(se, floor)


def adopt(solved: Solved, joint: JointFit) -> None:
    """Put the joint estimate in the place of the single ones."""
    solved.joint, solved.R = joint, joint.R
    for kind, H in joint.H.items():
        fit = solved.fits[kind]
        C = joint.covariance[kind]
        model = replace(fit.model, H=H, B=joint.B[kind], covariance=C, method="gls-ml")
        solved.fits[kind] = replace(
            fit,
            model=model,
            residual=joint.residual[kind],
            cost=joint.cost,
            covariance=C,
            u=joint.u.get(kind),
            n_iter=joint.n_iter,
            details=_details(joint, kind),
            method="gls-ml",
            cites="not in the papers: joint maximum likelihood, see margcal.methods.joint",
        )
        if kind in joint.u:
            solved.vectors[kind] = joint.u[kind]


def _details(joint: JointFit, kind: Kind) -> dict[str, Array]:
    details = {"leave_one_out": joint.shift[kind]}
    if kind == "mag" and joint.mag_acc is not None:
        details["covariance_with_acc"] = joint.mag_acc
    return details
