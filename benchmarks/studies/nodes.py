"""Studies of whole simulated nodes: is the expected error right, are the labels, what does the joint fit gain.

The recordings go through `calibrate` as a user's would: segmentation, inferred attitudes, the joint fit.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import sys
from typing import Any

import numpy as np

from margcal.core import so3
from margcal.core.errors import DataError
from margcal.core.types import Array, Calibration, Kind, SensorModel
from margcal.core.units import STANDARD_GRAVITY
from margcal.methods.gls import gls_ml
from margcal.methods.uncertainty import direction_errors_deg
from margcal.workflow.calibrate import calibrate
from margcal.workflow.simulate import Simulation, simulate

FIELD = 49.1
MAGNITUDE: dict[Kind, float | None] = {"acc": STANDARD_GRAVITY, "gyr": None, "mag": FIELD}
QUALITIES = ("good", "few poses", "poor housing", "noisy")

Row = dict[str, float | str]


def node_options(quality: str, rng: np.random.Generator) -> dict[str, Any]:
    """What `simulate` is told for a node of this quality: housing error .05-.3 degrees, 24 poses, but for what
    makes the class."""
    options: dict[str, Any] = {"n_poses": 24, "housing_sd_deg": float(rng.uniform(0.05, 0.3))}
    if quality == "few poses":
        options["n_poses"] = int(rng.integers(10, 14))
    elif quality == "poor housing":
        options["housing_sd_deg"] = float(rng.uniform(0.5, 1.0))
    elif quality == "noisy":
        options["noise"] = float(rng.uniform(3, 10))
    return options


def direction_error(model: SensorModel, truth: SensorModel) -> float:
    """True error, rms over the sphere, degrees."""
    errors = direction_errors_deg(model.H, model.B, truth.H, truth.B, MAGNITUDE[model.kind])
    return float(np.sqrt(np.mean(errors**2)))


def calibrated(simulation: Simulation) -> Calibration | None:
    try:
        return calibrate(simulation.recording, field=FIELD, allow_fail=True)
    except DataError:
        return None


def warned(calibration: Calibration) -> list[str]:
    return sorted({i.code for i in calibration.issues if i.level != "note"})


def progress(text: str) -> None:
    if sys.stderr.isatty():
        print(f"\r{text:60s}", end="", file=sys.stderr, flush=True)


def expected_error_study(nodes: int, *, seed: int = 0) -> list[Row]:
    """True over expected direction error by class of quality and sensor; `nodes` in all, evenly over the classes."""
    rows: list[Row] = []
    every: list[float] = []
    for number, quality in enumerate(QUALITIES):
        found: dict[Kind, list[tuple[float, float]]] = {"acc": [], "gyr": [], "mag": []}
        lost, with_warning = 0, 0
        per_class = max(1, nodes // len(QUALITIES))
        for i in range(per_class):
            progress(f"{quality}: node {i + 1} of {per_class}")
            options = node_options(quality, np.random.default_rng([seed, number, i]))
            simulation = simulate(seed=10_000 * (seed + 1) + 1000 * number + i, rest_s=2.0, turn_s=1.2, **options)
            calibration = calibrated(simulation)
            if calibration is None or calibration.frame != "housing":
                lost += 1
                continue
            with_warning += bool(warned(calibration))
            for kind, model in calibration.models.items():
                assert model.expected_error_deg is not None
                true = direction_error(model, simulation.truth.models[kind])
                found[kind].append((model.expected_error_deg, true))
        for kind, pairs in found.items():
            expected, true = np.array(pairs).reshape(-1, 2).T
            every += (true / expected).tolist()
            rows.append(
                {
                    "class": quality,
                    "sensor": kind,
                    "nodes": float(len(pairs)),
                    "lost": float(lost),
                    "warned": float(with_warning),
                    "expected_rms_deg": float(np.sqrt(np.mean(expected**2))),
                    "true_rms_deg": float(np.sqrt(np.mean(true**2))),
                    "true_over_expected": float(np.sqrt(np.mean(true**2) / np.mean(expected**2))),
                    "within_.3_to_3_%": 100 * within(true / expected),
                }
            )
    progress("")
    rows.append({"class": "all", "sensor": "all", "within_.3_to_3_%": 100 * within(np.array(every))})
    return rows


def within(ratio: Array) -> float:
    return float(np.mean((ratio > 0.3) & (ratio < 3)))


def same_labels(R: Array, truth: Array) -> bool:
    """Whether attitudes (J, 3, 3) are the true ones up to the names of the housing's axes and the laboratory's
    heading: ``R_j = L truth_j Q`` with L about the vertical and Q one of 24."""
    for Q in so3.cube_group():
        L = R[0] @ (truth[0] @ Q).T
        if np.allclose(L[:, 2], [0, 0, 1], atol=1e-6) and np.allclose(R, L @ truth @ Q, atol=1e-6):
            return True
    return False


LABEL_CASES: dict[str, dict[str, Any]] = {
    "mounting <= 5, dip <= 60": {"dip": (-60.0, 60.0)},
    "the same, no gyroscope": {"dip": (-60.0, 60.0), "sensors": ("acc", "mag")},
    "the same, no magnetometer": {"dip": (-60.0, 60.0), "sensors": ("acc", "gyr")},
    "mounting <= 5, dip 85": {"dip": (85.0, 85.0)},
}


def label_study(nodes: int, *, seed: int = 1, cases: tuple[str, ...] = tuple(LABEL_CASES)) -> list[Row]:
    """Share of nodes whose 24 labels are inferred right; of the wrong ones, how many say nothing of it."""
    rows: list[Row] = []
    for number, case in enumerate(LABEL_CASES):
        if case not in cases:
            continue
        what = dict(LABEL_CASES[case])
        low, high = what.pop("dip")
        right = right_warned = fallback = wrong = silent = 0
        for i in range(nodes):
            progress(f"{case}: node {i + 1} of {nodes}")
            rng = np.random.default_rng([seed, number, i])
            node = {"mounting_deg": float(rng.uniform(0, 5)), "dip_deg": float(rng.uniform(low, high))}
            simulation = simulate(
                seed=100_000 * (seed + 1) + 1000 * number + i, rest_s=2.0, turn_s=1.2, n_poses=24, **node, **what
            )
            calibration = calibrated(simulation)
            if calibration is None or calibration.settings["attitudes"] != "cube":
                fallback += 1  # says that it does not know: free, faces or refused
            elif inferred_right(calibration, simulation):
                right += 1
                right_warned += bool(warned(calibration))
            else:
                wrong += 1
                silent += not warned(calibration)
        rows.append(
            {
                "case": case,
                "nodes": float(nodes),
                "right_%": 100 * right / nodes,
                "right_but_warned_%": 100 * right_warned / max(right, 1),
                "not_inferred_%": 100 * fallback / nodes,
                "wrong": float(wrong),
                "wrong_and_silent": float(silent),
            }
        )
    progress("")
    return rows


def inferred_right(calibration: Calibration, simulation: Simulation) -> bool:
    """`Poses.R` are the estimated attitudes, fractions of a degree off the labels: snapped before they are compared."""
    poses = calibration.poses
    if poses is None or poses.R is None or len(poses) != len(simulation.nominal):
        return False
    group = so3.cube_group()
    nearest = [group[np.argmin(so3.angle_between(group, R))] for R in poses.R]
    return same_labels(np.array(nearest), simulation.nominal)


def joint_study(nodes: int, *, seed: int = 2, housing_deg: tuple[float, ...] = (0.1, 0.2, 0.5)) -> list[Row]:
    """The joint fit of a node against `gls_ml` sensor by sensor (gyroscope: `gauss_newton`), 24 cube poses.

    RMS over nodes of: true direction error; the same but for a rotation of the frame, which no fit can see (the
    mean of the attitudes' errors); B in counts.
    """
    rows: list[Row] = []
    for housing in housing_deg:
        errors: dict[tuple[Kind, str], list[tuple[float, float, float]]] = {}
        for i in range(nodes):
            progress(f"housing {housing} deg: node {i + 1} of {nodes}")
            simulation = simulate(seed=20_000 * (seed + 1) + i, rest_s=2.0, turn_s=1.2, housing_sd_deg=housing)
            joint = calibrated(simulation)
            if joint is None or joint.settings["attitudes"] != "cube":
                continue
            alone = calibrate(simulation.recording, field=FIELD, method="one-step")
            for kind, truth in simulation.truth.models.items():
                errors.setdefault((kind, "joint"), []).append(figures(joint.models[kind], truth))
                single = alone.models[kind] if kind == "gyr" else by_itself(alone, simulation, kind)
                errors.setdefault((kind, "single"), []).append(figures(single, truth))
        for kind in MAGNITUDE:
            one, two = (np.sqrt(np.mean(np.square(errors[kind, which]), axis=0)) for which in ("single", "joint"))
            names = ("direction_deg", "but_for_frame_deg", "B_count")
            row: Row = {"housing_deg": housing, "sensor": kind}
            for name, a, b in zip(names, one, two):
                row |= {f"{name}_single": float(a), f"{name}_joint": float(b)}
            rows.append(row)
    progress("")
    return rows


def figures(model: SensorModel, truth: SensorModel) -> tuple[float, float, float]:
    frame = so3.nearest_rotation(truth.H @ np.linalg.inv(model.H))
    turned = SensorModel(model.kind, frame @ model.H, model.B)
    return (
        direction_error(model, truth),
        direction_error(turned, truth),
        float(np.linalg.norm(model.B - truth.B)),
    )


def by_itself(calibration: Calibration, simulation: Simulation, kind: Kind) -> SensorModel:
    """`gls_ml` of one sensor from the same rests and labels."""
    poses = calibration.poses
    assert poses is not None and poses.R is not None
    magnitude = MAGNITUDE[kind]
    assert magnitude is not None
    noise = poses.sd[kind] / np.sqrt(poses.count[kind])[:, None]
    R = np.swapaxes(poses.R, 1, 2)  # one-step keeps the labels as they are
    return gls_ml(poses.mean[kind], R, magnitude, kind=kind, noise_sd=noise).model
