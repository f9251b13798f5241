"""R-BSN's experiment carried out: every node aligned by the paper's method and by ours, the walk filtered, the errors.

Errors are those of Fig. 5: the filter's attitude against the tracking system, both in the tracking frame. Without a
calibration the node's axes are taken for those of its marker plate and the tracking frame for the earth's, which is
what the wand was set for; with one, C^b and C^n lead from one to the other.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from margcal.apps.papers.r_bsn_simulation import DIP, FIELD_UT, NODE_HZ, Node, Session, Setting, session
from margcal.core import so3
from margcal.core.errors import DataError
from margcal.core.types import Array, Attitude, Calibration, Kind, Recording
from margcal.methods import ekf_quest
from margcal.workflow.align import align
from margcal.workflow.align_job import Method
from margcal.workflow.evaluate import Evaluation, error_angles, evaluate
from margcal.workflow.gait import PLACES, Place
from margcal.workflow.mocap_simulation import gyr_symmetric

SETTLED_S = 8.0
"""From the start of the walking trial: stood, set off, walking."""

UNCALIBRATED, PAPER, OURS, PERFECT = "uncalibrated", "r-bsn (paper)", "default (ours)", "perfect sensors"
WAYS: dict[str, Method | None] = {PAPER: "r-bsn", OURS: None}
VARIANTS = (UNCALIBRATED, PAPER, OURS, PERFECT)

FILTER = ekf_quest.Params(
    field=FIELD_UT,
    dip=DIP,
    mag_gate=float("inf"),
    tau=0.5,
    D=50.0,
    rate_noise=0.01 / math.sqrt(NODE_HZ),
    quest_noise=2 * 0.3 / math.sqrt(NODE_HZ),
    mag_weight=1.0,
)
"""The paper's filter, plainly: it gates nothing, (10) has equal weights, (8) has .01 rad/s and .3 a sample.

The paper gives no numbers. These are fixed here, so that `margcal orient` may be tuned without changing this table.
"""

Tick = Callable[[int], None]


@dataclass(frozen=True)
class Walked:
    """One node's walk, filtered in one way, against the optics; `evaluation` is in the tracking frame.

    `by_vqf` is the same with the public filter VQF instead of the paper's, None where it is not installed.
    """

    place: Place
    variant: str
    evaluation: Evaluation
    by_vqf: Evaluation | None = None


@dataclass(frozen=True)
class Accuracy:
    """How far an alignment is from the truth: rotations in degrees, H in per cent (rms over directions), B relative to
    the sensor's usual vector in per cent."""

    T: float
    C_b: float
    C_n: float
    acc_H: float
    acc_B: float
    mag_H: float
    mag_B: float


@dataclass(frozen=True)
class Run:
    """A session, its nodes' walks by place and variant, and how good the alignments are."""

    session: Session
    walks: dict[tuple[Place, str], Walked]
    accuracy: dict[tuple[Place, str], Accuracy]
    lost: int

    def total(self, variant: str) -> Array:
        """Rms errors (3,) of the nodes, deg; NaN where an alignment failed."""
        found = [self.walks.get((p, variant)) for p in PLACES]
        return np.array([np.nan if w is None else w.evaluation.total_deg for w in found])


@dataclass(frozen=True)
class _Job:
    """A walk to be filtered: SI vectors at 75 Hz, and how the filter's attitude becomes one of the plate in m."""

    run: int
    place: Place
    variant: str
    recording: Recording
    R_nm: Array
    R_kh: Array
    offset_s: float
    drift_ppm: float
    node: Node


def carry_out(
    seeds: Sequence[int], setting: Setting, ways: Sequence[str] = tuple(WAYS), tick: Tick | None = None
) -> list[Run]:
    """The experiment once for every seed.

    Parameters
    ----------
    seeds : sequence of int
    setting : Setting
    ways : sequence of str
        Which of `WAYS` to align by.
    tick : callable (n), optional
        Told when `n` more nodes are aligned.
    """
    sessions, jobs, lost = [], [], [0] * len(seeds)
    accuracy: list[dict[tuple[Place, str], Accuracy]] = []
    for run, seed in enumerate(seeds):
        sessions.append(session(seed, setting))
        accuracy.append({})
        for place, node in sessions[-1].nodes.items():
            jobs += _as_they_are(run, node, setting)
            for way in ways:
                found = aligned(node, WAYS[way])
                if found is None:
                    lost[run] += 1
                    continue
                jobs.append(_calibrated(run, node, way, found))
                accuracy[run][place, way] = accuracy_of(node, found)
            if tick is not None:
                tick(1)
    walks: list[dict[tuple[Place, str], Walked]] = [{} for _ in seeds]
    for job, q in zip(jobs, _filtered([j.recording for j in jobs])):
        walks[job.run][job.place, job.variant] = _judged(job, q)
    return [Run(s, w, a, n) for s, w, a, n in zip(sessions, walks, accuracy, lost)]


def aligned(node: Node, method: Method | None, *, as_printed: bool = False) -> Calibration | None:
    """The node calibrated from its trials at rest and moved by hand; None where a sensor or all of it is refused."""
    try:
        found = align(
            node.moved.recording,
            node.moved.reference,
            static=node.still.recording,
            method=method,
            as_printed=as_printed,
            field=FIELD_UT,
            orientation=False,
        )
    except DataError:
        return None
    return found if len(found.models) == 3 else None


def accuracy_of(node: Node, found: Calibration) -> Accuracy:
    """Errors against the truth, in the frame in which the gyroscope's H is symmetric."""
    truth = gyr_symmetric(node.truth)
    R_kh, R_nm, *_ = _frames(found)
    turn = so3.polar(node.truth.models["gyr"].H)[0]

    def error(kind: Kind) -> tuple[float, float]:
        a, b = found.models[kind], truth.models[kind]
        size = {"acc": 9.8, "gyr": 1.0, "mag": FIELD_UT}[kind]
        H = float(np.linalg.norm(a.H - b.H) / np.linalg.norm(b.H))
        return 100 * H, 100 * float(np.linalg.norm(a.B - b.B)) / size

    return Accuracy(
        error("gyr")[0],
        float(np.degrees(so3.angle_between(R_kh, node.R_kh @ turn))),
        float(np.degrees(so3.angle_between(R_nm, node.R_nm))),
        *error("acc"),
        *error("mag"),
    )


def _frames(found: Calibration) -> tuple[Array, Array, float, float]:
    """R_kh, R_nm, offset and drift of the clocks."""
    values = {} if found.alignment is None else found.alignment.values
    return (
        so3.matrix_from_quat(values["marker_to_node"]).T,
        so3.matrix_from_quat(values["lab_to_earth"]),
        values["offset_s"],
        values["drift_ppm"],
    )


def _as_they_are(run: int, node: Node, setting: Setting) -> list[_Job]:
    """Without any calibration, and with sensors that need none; clocks as they are in truth."""
    clock = setting.offset_s, setting.drift_ppm
    eye = np.eye(3)
    return [
        _Job(run, node.place, UNCALIBRATED, node.walk.recording, eye, eye, *clock, node),
        _Job(run, node.place, PERFECT, node.perfect, node.R_nm, node.R_kh, *clock, node),
    ]


def _calibrated(run: int, node: Node, way: str, found: Calibration) -> _Job:
    R_kh, R_nm, offset, drift = _frames(found)
    return _Job(run, node.place, way, found.apply(node.walk.recording), R_nm, R_kh, offset, drift, node)


def _filtered(recordings: Sequence[Recording]) -> Array:
    """Attitudes (J, N, 4) node to earth: all walks side by side, they have the same length."""
    gyr, acc, mag = (np.array([r.streams[k].y for r in recordings]) for k in ("gyr", "acc", "mag"))
    t = recordings[0].streams["gyr"].t
    q, _ = ekf_quest.quest_measurement(FILTER, acc[:, 0], mag[:, 0])
    dt = np.diff(t, prepend=t[0])
    return ekf_quest.batch(FILTER, ekf_quest.start(q), dt, gyr, acc, mag).q


def _judged(job: _Job, q_nh: Array) -> Walked:
    """The plate's attitude in the tracking frame, R_mk = R_nm^T R_nh R_kh^T, against the tracked one."""
    t = job.offset_s + (1 + 1e-6 * job.drift_ppm) * job.recording.streams["gyr"].t
    reference = job.node.walk.reference
    walking = reference.t > reference.t[0] + SETTLED_S

    def against(q: Array) -> Evaluation:
        before, after = so3.quat_from_matrix(job.R_nm.T), so3.quat_from_matrix(job.R_kh.T)
        in_m = so3.quat_multiply(so3.quat_multiply(before, q), after)
        return evaluate(Attitude(t, in_m), reference, movement=walking)

    other = _vqf(job.recording)
    return Walked(job.place, job.variant, against(q_nh), None if other is None else against(other))


def _vqf(recording: Recording) -> Array | None:
    """Attitudes (N, 4) by VQF as it comes, sample by sample; None where it is not installed."""
    try:
        from vqf import VQF
    except ImportError:
        return None
    gyr, acc, mag = (np.ascontiguousarray(recording.streams[k].y) for k in ("gyr", "acc", "mag"))
    return np.asarray(VQF(1 / recording.streams["gyr"].rate).updateBatch(gyr, acc, mag)["quat9D"])


def with_yaw(found: Evaluation, session: Session, yaw_deg: float) -> float:
    """Rms error, deg, of an uncalibrated walk, had the wand's yaw been another (nothing else changes)."""
    R_nm = session.R_nm
    turn = so3.quat_from_matrix(R_nm.T @ so3.exp(np.radians([0.0, 0.0, session.yaw_deg - yaw_deg])) @ R_nm)
    q_ref = so3.quat_multiply(turn, found.q_ref)
    total, *_ = error_angles(found.q_est[found.counted], q_ref[found.counted])
    return float(np.degrees(np.sqrt(np.mean(total**2))))
