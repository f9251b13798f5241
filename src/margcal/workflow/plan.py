"""Which attitudes to record next: `plan` from nothing, `plan_more` after recordings.

A-optimal, greedy: the next attitude is the one after which the sum of the sensors' expected squared direction errors
is least (`plan_information`), out of the 24 of a box or of some two hundred directions for free hands; then the plan
is improved by exchanging what it can do better without. In the end every attitude has a reason that can be printed:
the error before and after it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from margcal.core import so3
from margcal.core.errors import DataError, UsageError
from margcal.core.types import Array, Calibration, Issue, Kind, Recording
from margcal.core.units import KINDS, STANDARD_GRAVITY, UNITS
from margcal.methods.uncertainty import sphere
from margcal.workflow.calibrate import calibrate
from margcal.workflow.plan_information import Circumstances, Knowledge, Sensor, after_rest, beginning, gain_of

Hands = Literal["box", "free"]

N_FIRST, N_MORE = 18, 6
MOST = 96
SAME = np.radians(15.0)
"""Attitudes nearer than this are one."""
DIRECTIONS, HEADINGS = 200, 4
LEAST_TURN = np.radians(60.0)
"""Smaller turns tell the gyroscope little; larger than `LARGEST_TURN` ones nobody makes in one go."""
LARGEST_TURN = np.radians(181.0)
S_ROT, LEVEL_SD = np.radians(0.2), np.radians(1.0)
"""Housing error of a box put down by hand, and tilt of a table, where no recording tells them."""
DIP = np.radians(60.0)
NOISE: dict[Kind, float] = {"acc": 0.02 / 14, "gyr": 0.002 / 14, "mag": 0.009 / 14}
"""Standard errors of the mean over two seconds at 100 Hz, of a consumer part: m/s^2, rad/s, share of the field."""
EXCHANGES = 60
NOMINAL_SE = 1e-3


@dataclass(frozen=True)
class Step:
    """One attitude of the plan.

    Attributes
    ----------
    R : ndarray (3, 3)
        R_nh: takes housing (or node) components to a laboratory whose z is up.
    turn : ndarray (3,) or None
        Rotation vector (rad, housing axes) that leads there from the attitude before; None at the start.
    errors_deg : dict
        Expected direction error of each sensor after it.
    """

    R: Array
    turn: Array | None
    errors_deg: dict[Kind, float]


@dataclass(frozen=True)
class Plan:
    """Attitudes in the order in which to record them.

    `before_deg` is empty where nothing was recorded yet; `calibration` and `issues` are what the recordings gave,
    `last` (3, 3) is the attitude of their last rest. `heading` (rad) is that of the box's table in the laboratory.
    """

    hands: Hands
    steps: tuple[Step, ...]
    before_deg: dict[Kind, float] = field(default_factory=dict)
    calibration: Calibration | None = None
    issues: tuple[Issue, ...] = ()
    last: Array | None = None
    heading: float = 0.0

    @property
    def after_deg(self) -> dict[Kind, float]:
        return self.steps[-1].errors_deg if self.steps else self.before_deg


def plan(
    hands: Hands = "box",
    n: int = N_FIRST,
    *,
    sensors: Sequence[Kind] = KINDS,
    dip: float = DIP,
) -> Plan:
    """Attitudes for a first recording.

    Parameters
    ----------
    hands : {'box', 'free'}
        A box that is put down on its faces, or a node in the hand that is held or propped up in any attitude.
    n : int
        Number of rests.
    sensors : sequence of {'acc', 'gyr', 'mag'}
    dip : float
        Dip of the local field, rad.

    Raises
    ------
    UsageError
        If `n` or `sensors` is out of range.
    """
    _check(n, sensors)
    start = _nominal(hands, sensors, dip)
    now = after_rest(start, np.eye(3))
    first = Step(np.eye(3), None, now.errors_deg())
    candidates = attitudes(hands)
    chosen = _exchanged(now, _greedy(now, candidates, n - 1, [np.eye(3)]))
    return Plan(hands, (first, *_steps(now, chosen, _Told())))


def plan_more(
    *recordings: Recording, hands: Hands | None = None, n: int | None = None, dip: float = DIP, **options: object
) -> Plan:
    """The next attitudes after recordings of a node.

    Parameters
    ----------
    *recordings : Recording
    hands : {'box', 'free'}, optional
        Default: as the recordings were made.
    n : int, optional
        Default: `N_MORE`, or `N_FIRST` where nothing could be calibrated yet.
    dip : float
        Dip of the local field, rad, used where no magnetometer was calibrated yet.
    **options
        Of `calibrate` (`poses`, `place`, `gravity` ...).

    Returns
    -------
    Plan
        The node is taken to lie as in the last rest when recording goes on.
    """
    calibration, issues = _calibrated(recordings, options)
    n = n or (N_MORE if calibration.models else N_FIRST)
    _check(n, KINDS)
    boxed = calibration.settings.get("attitudes") in ("cube", "faces", "file")
    hands = hands or ("box" if boxed or not calibration.models else "free")
    known = knowledge_of(calibration, recordings, hands, dip)
    told = _told(known, calibration)
    before = told.errors(known)
    poses = calibration.poses
    seen = [] if known.R is None or poses is None or poses.R is None else [r for r in poses.R if np.isfinite(r).all()]
    candidates, heading = _candidates(known, hands)
    chosen = _greedy(known, candidates, n, seen)
    return Plan(hands, tuple(_steps(known, chosen, told)), before, calibration, issues, known.R, heading)


def _check(n: int, sensors: Sequence[Kind]) -> None:
    if not 1 <= n <= MOST:
        raise UsageError(f"a plan has 1 to {MOST} attitudes, not {n}")
    if not sensors or any(s not in KINDS for s in sensors):
        raise UsageError(f"sensors {tuple(sensors)!r}: choose some of {', '.join(KINDS)}")


def _calibrated(
    recordings: Sequence[Recording], options: Mapping[str, object]
) -> tuple[Calibration, tuple[Issue, ...]]:
    try:
        calibration = calibrate(*recordings, **options, allow_fail=True)  # type: ignore[arg-type]
    except DataError as error:  # refused before any sensor was looked at: nothing is known yet
        return Calibration(recordings=tuple(recordings)), error.issues
    return calibration, calibration.issues


# --- candidates --------------------------------------------------------------------------------------


def attitudes(hands: Hands) -> Array:
    """Attitudes R_nh (C, 3, 3) that a plan chooses from."""
    if hands == "box":
        return so3.cube_group()
    up = sphere(DIRECTIONS)
    quarter = 2 * np.pi * np.arange(HEADINGS) / HEADINGS
    about = so3.exp(quarter[:, None] * np.array([0.0, 0.0, 1.0]))
    upright = np.array([so3.align_vectors(np.array([[0.0, 0.0, 1.0]]), c[None]) for c in up])
    return (about[None] @ upright[:, None]).reshape(-1, 3, 3)


def _candidates(known: Knowledge, hands: Hands) -> tuple[Array, float]:
    """The same, with the box's table turned as the last rest has it; and its heading (rad)."""
    found = attitudes(hands)
    if hands == "free" or known.R is None:
        return found, 0.0
    nearest = found[int(np.argmax(found[:, 2] @ known.R[2]))]
    D = known.R @ nearest.T
    heading = float(np.arctan2(D[1, 0] - D[0, 1], D[0, 0] + D[1, 1]))
    return so3.exp(np.array([0.0, 0.0, heading])) @ found, heading


def _greedy(now: Knowledge, candidates: Array, n: int, seen: Sequence[Array]) -> Array:
    """n attitudes, each the best after those before it; none that was `seen` while there are others."""
    taken = np.zeros(len(candidates), dtype=bool)
    for R in seen:
        taken |= so3.angle_between(R, candidates) < SAME
    chosen = []
    for _ in range(n):
        open_ = _reachable(now.R, candidates)
        open_ = open_ & ~taken if (open_ & ~taken).any() else open_
        cost = np.where(open_, gain_of(now, candidates)[0], np.inf)
        best = int(np.argmin(cost))
        taken[best] = True
        chosen.append(candidates[best])
        now = after_rest(now, candidates[best])
    return np.array(chosen).reshape(-1, 3, 3)


def _reachable(R: Array | None, candidates: Array) -> Array:
    """Which attitudes a turn worth making leads to."""
    if R is None:
        return np.ones(len(candidates), dtype=bool)
    angle = so3.angle_between(R, candidates)
    return (angle >= LEAST_TURN) & (angle <= LARGEST_TURN)


def _exchanged(now: Knowledge, chosen: Array) -> Array:
    """Two attitudes of the plan change places where that lowers the error at its end."""
    if len(chosen) < 3:
        return chosen
    best, cost = chosen, _final(now, chosen)
    rng = np.random.default_rng(0)  # the same plan every time
    for _ in range(EXCHANGES):
        i, j = rng.choice(len(best), 2, replace=False)
        trial = best.copy()
        trial[[i, j]] = trial[[j, i]]
        if not _can_be_made(now.R, trial):
            continue
        value = _final(now, trial)
        if value < cost:
            best, cost = trial, value
    return best


def _can_be_made(R: Array | None, sequence: Array) -> bool:
    return all(_reachable(a, b[None])[0] for a, b in zip([R, *sequence[:-1]], sequence))


def _final(now: Knowledge, sequence: Array) -> float:
    for R in sequence:
        now = after_rest(now, R)
    return float(np.sum(np.square(list(now.errors_deg().values()))))


@dataclass(frozen=True)
class _Told:
    """What the fit said of its errors: factors on those of the recursion, and what they cannot exceed."""

    scale: Mapping[Kind, float] = field(default_factory=dict)
    most: Mapping[Kind, float] = field(default_factory=dict)

    def errors(self, known: Knowledge) -> dict[Kind, float]:
        errors = {k: v * self.scale.get(k, 1.0) for k, v in known.errors_deg().items()}
        return {k: min(v, self.most.get(k, 180.0)) for k, v in errors.items()}


def _told(known: Knowledge, calibration: Calibration) -> _Told:
    """The joint fit knows its residuals better than the recursion does: the ratio holds for what comes next too. Of a
    fit with fewer parameters only that the next one is no worse."""
    scale: dict[Kind, float] = {}
    most: dict[Kind, float] = {}
    for kind, error in known.errors_deg().items():
        model = calibration.models.get(kind)
        if model is None or model.expected_error_deg is None:
            continue
        most[kind] = model.expected_error_deg
        if model.method == "gls-ml" and error > 0:
            scale[kind] = model.expected_error_deg / error
    return _Told(scale, most)


def _steps(now: Knowledge, chosen: Array, told: _Told) -> list[Step]:
    steps = []
    for R in chosen:
        turn = None if now.R is None else so3.log(now.R.T @ R)
        now = after_rest(now, R)
        steps.append(Step(R, turn, told.errors(now)))
    return steps


# --- what is known -----------------------------------------------------------------------------------


def _nominal(hands: Hands, sensors: Sequence[Kind], dip: float) -> Knowledge:
    """A node of which only the kind is known, SI units."""
    kinds = {k: _nominal_sensor(k, dip, hands == "free") for k in KINDS if k in sensors}
    how = Circumstances(s_rot=S_ROT if hands == "box" else None)
    return beginning(kinds, how)


def _nominal_sensor(kind: Kind, dip: float, free: bool) -> Sensor:
    u = {"acc": np.array([0.0, 0.0, STANDARD_GRAVITY]), "mag": np.array([0.0, np.cos(dip), -np.sin(dip)])}
    sd = {"acc": 0.0 if free else float(LEVEL_SD), "mag": 1.0, "gyr": 0.0}[kind]
    vector = u.get(kind, np.array([0.0, 0.0, 1.0]))
    se = np.full(3, NOISE[kind])
    return Sensor(kind, np.eye(3), np.zeros(3), vector, se, triangular=free and kind == "acc", u_sd=sd)


def knowledge_of(
    calibration: Calibration, recordings: Sequence[Recording], hands: Hands = "box", dip: float = DIP
) -> Knowledge:
    """What recordings told of a node, rest by rest.

    Parameters
    ----------
    calibration : Calibration
        From `calibrate(*recordings, allow_fail=True)`.
    recordings : sequence of Recording
    """
    free = calibration.frame == "acc-triangular" or (not calibration.models and hands == "free")
    there = [k for k in KINDS if any(k in r.streams for r in recordings)]
    sensors = {k: _sensor(calibration, recordings, k, dip, free) for k in there}
    how = _circumstances(calibration, hands if not calibration.models else None)
    now = beginning(sensors, how)
    poses = calibration.poses
    if poses is None or poses.R is None or not calibration.models:
        return now
    turned = {t.after for t in calibration.turns}
    rests = [j for j in range(len(poses)) if np.isfinite(poses.R[j]).all()]
    for j in rests:
        read = [k for k in calibration.models if k in poses.mean and np.isfinite(poses.mean[k][j]).all()]
        if j != rests[-1]:  # what is known from elsewhere is told once; but it tells how the node lies at last
            read = [k for k in read if sensors[k].prior is None]
        now = after_rest(now, poses.R[j], turned=j in turned and "gyr" in read, read=read)
    return now


def _sensor(
    calibration: Calibration, recordings: Sequence[Recording], kind: Kind, dip: float, free: bool
) -> Sensor:
    model = calibration.models.get(kind)
    nominal = _nominal_sensor(kind, dip, free)
    if model is None:
        return _unfitted(recordings, kind, nominal)
    u = model.reference_vector
    if kind == "gyr" or u is None or not np.isfinite(u).all():
        size = STANDARD_GRAVITY if kind == "acc" else 1.0 if model.unit == "norm" else 50.0
        u = nominal.u / np.linalg.norm(nominal.u) * size
    elsewhere = model.method == "nominal-gain" or kind in calibration.settings.get("sources", {})
    prior = _prior_of(model.covariance) if elsewhere else None
    return replace(nominal, H=model.H, B=model.B, u=np.asarray(u), se=_standard_error(calibration, kind), prior=prior)


def _prior_of(C: Array | None) -> Array | None:
    """Covariance of a sensor that was not fitted at the rests with all others, as far as it is known."""
    return None if C is None or not np.isfinite(C).all() else np.array(C)


def _unfitted(recordings: Sequence[Recording], kind: Kind, nominal: Sensor) -> Sensor:
    """A sensor that could not be calibrated: SI by its unit, else its counts as one magnitude."""
    stream = next(r.streams[kind] for r in recordings if kind in r.streams)
    factor = UNITS[kind][stream.unit]
    if factor is None:  # its noise relative to its magnitude is what counts
        return nominal
    H = np.eye(3) * (factor / 50.0 if kind == "mag" else factor)
    return replace(nominal, H=H, se=nominal.se / H[0, 0])


def _standard_error(calibration: Calibration, kind: Kind) -> Array:
    poses, model = calibration.poses, calibration.models[kind]
    size = {"acc": STANDARD_GRAVITY, "gyr": 1.0, "mag": 50.0 if model.unit == "uT" else 1.0}[kind]
    least = NOMINAL_SE * 0.05 * size / float(np.cbrt(abs(np.linalg.det(model.H))))
    if poses is None or kind not in poses.sd or not len(poses):
        return np.full(3, 20 * least)
    variance = poses.sd[kind] ** 2 / np.maximum(poses.count[kind], 1)[:, None]
    seen = np.isfinite(variance).all(axis=1)
    if not seen.any():
        return np.full(3, 20 * least)
    return np.maximum(np.sqrt(variance[seen].mean(axis=0)), 0.01 * least)


def _circumstances(calibration: Calibration, hands: Hands | None) -> Circumstances:
    """Housing error, tilt and turns as the recordings had them."""
    how = Circumstances(s_rot=S_ROT if hands == "box" else None)
    mode = calibration.settings.get("attitudes")
    if mode in ("cube", "file", "reference"):
        rows = calibration.settings.get("checks", [])
        found = [r["value"] for r in rows if r["code"] == "housing-error" and r["value"] is not None]
        how = replace(how, s_rot=np.radians(max(found[0], 0.01)) if found else S_ROT)
    elif mode == "faces":
        how = replace(how, level_sd=_tilt(calibration))
    gyr = calibration.fits.get("gyr")
    if gyr is not None and len(calibration.turns) > 2:
        residual = np.asarray(gyr.residual)
        per_axis = float(np.sqrt(np.nanmean(residual**2) / 3)) if np.isfinite(residual).any() else how.turn_se
        lasted = float(np.median([t.t[-1] - t.t[0] for t in calibration.turns if len(t.t) > 1] or [how.turn_s]))
        how = replace(how, turn_se=max(per_axis, np.radians(0.003)), turn_s=lasted)
    return how


def _tilt(calibration: Calibration) -> float:
    """How far "up" was from the faces, about each horizontal axis, rad."""
    poses = calibration.poses
    if poses is None or poses.R is None or len(poses) < 6:
        return float(LEVEL_SD)
    off = 1 - np.max(np.abs(poses.R[:, 2, :]), axis=1) ** 2  # sine of the tilt, squared
    return float(max(np.sqrt(np.mean(off) / 2), np.radians(0.02)))
