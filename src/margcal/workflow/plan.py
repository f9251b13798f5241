"""Which attitudes to record next: `plan` from nothing, `plan_more` after recordings.

A-optimal, greedy: the next attitude is the one after which the sum of the sensors' expected squared direction errors
is least (`plan_information`), out of the 24 of a box or of two hundred directions for free hands. So every attitude has
a reason that can be printed, the error before and after it. (Exchanging attitudes afterwards was tried: it wins 1 to
3 % of the gyroscope's error.)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from margcal.core import so3
from margcal.core.errors import DataError, UsageError
from margcal.core.types import Array, Calibration, Issue, Kind, Recording
from margcal.core.units import KINDS
from margcal.methods.uncertainty import sphere
from margcal.workflow.calibrate import calibrate
from margcal.workflow.plan_information import Knowledge, after_rest, gain_of
from margcal.workflow.plan_start import DIP, Hands, knowledge_of, nominal

N_FIRST, N_MORE = 18, 6
MOST = 96
SAME = np.radians(15.0)
"""Attitudes nearer than this are one."""
DIRECTIONS, HEADINGS = 200, 4
LEAST_TURN = np.radians(60.0)
"""Smaller turns tell the gyroscope little."""
HARDLY_WORSE, AXIS_SLACK = 0.05, 0.02
"""Loss in the sum of squares for which an attitude is preferred that one turn about an axis of the box leads to, and
the angle (rad) within which the axis is one of the box's."""


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
    start = nominal(hands, sensors, dip)
    now = after_rest(start, np.eye(3))
    first = Step(np.eye(3), None, now.errors_deg())
    chosen = _greedy(now, attitudes(hands), n - 1, [np.eye(3)])
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
        best = _simplest(now.R, candidates, cost)
        taken[best] = True
        chosen.append(candidates[best])
        now = after_rest(now, candidates[best])
    return np.array(chosen).reshape(-1, 3, 3)


def _simplest(R: Array | None, candidates: Array, cost: Array) -> int:
    """The best candidate, or one that is hardly worse and takes a single quarter or half turn to reach."""
    if R is not None:
        single = np.max(np.abs(so3.log(R.T @ candidates)), axis=1)
        single = np.abs(single - so3.angle_between(R, candidates)) < AXIS_SLACK
        easy = np.where(single, cost, np.inf)
        if easy.min() <= (1 + HARDLY_WORSE) * cost.min():
            return int(np.argmin(easy))
    return int(np.argmin(cost))


def _reachable(R: Array | None, candidates: Array) -> Array:
    """Which attitudes a turn worth making leads to."""
    if R is None:
        return np.ones(len(candidates), dtype=bool)
    return so3.angle_between(R, candidates) >= LEAST_TURN


@dataclass(frozen=True)
class _Told:
    """What the fit said of its errors: factors on those of the recursion, and what they cannot exceed."""

    scale: Mapping[Kind, float] = field(default_factory=dict)
    most: Mapping[Kind, float] = field(default_factory=dict)

    def errors(self, known: Knowledge) -> dict[Kind, float]:
        errors: dict[Kind, float] = {k: v * self.scale.get(k, 1.0) for k, v in known.errors_deg().items()}
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
