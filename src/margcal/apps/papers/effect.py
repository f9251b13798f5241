"""What a calibration is worth for orientation: the tables that close ZY-TBME and Z-TIE, on public data.

ZY-TBME Table II and Z-TIE Table III prove a calibration by the orientation that it gives against an optical system,
with recordings that are not public. Here the recordings are those of BROAD (Laidig et al. 2021; factory calibrated, so
that node errors can be put in and the uncorrupted result is known; `effect_nodes`), and raw phones (Michel et al., "On
attitude estimation with smartphones", 2017) with the calibration sessions of their own. What each part of a
calibration contributes is found by leaving the rest out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from margcal.apps.papers.effect_data import (
    ALIGNED_ON,
    data_folder,
    filters,
    phone_alignment,
    phone_calibration,
    phone_motions,
    trials,
)
from margcal.apps.papers.effect_nodes import (
    BIAS_ONLY,
    FULL,
    HOUSING_SD_DEG,
    MAG_BIAS_ONLY,
    MOUNTING_DEG,
    RAW,
    REST_S,
    SCALE,
    SENSOR_FRAME,
    UNCORRUPTED,
    VARIANTS,
    applied,
    make_node,
    variants_of,
)
from margcal.apps.papers.figures import BLUE, COLOURS, GREEN, GREY, ORANGE, PURPLE, Curve, Panel, figure, stacked
from margcal.apps.papers.tables import Grid, Reproduction, Tick, Work
from margcal.core.types import Array, Attitude
from margcal.files.tables import read
from margcal.workflow.evaluate import ANGLES, Evaluation, error_angles, evaluate

CITATION = "What a calibration is worth: ZY-TBME Table II and Z-TIE Table III on public data"

RUNS = 2
"""Corrupted nodes a trial where nothing is said: sixteen in all."""

PAPERS_FILTER = "vector-selection"
"""The filter that both papers evaluate with; where it is not there, the first."""

RESTORED_DEG = 0.05
"""How near H and B must come to the uncorrupted result."""

SHOWN_TRIAL = "08"

PAPER = {
    # (rms, mean, sd, correlation) of roll, pitch, yaw, rad
    ("zy-tbme-ii", FULL): (
        (0.0397, 0.0014, 0.0397, 0.9970),
        (0.0698, -0.0431, 0.0549, 0.9930),
        (0.0507, 0.0060, 0.0503, 0.9981),
    ),
    ("zy-tbme-ii", MAG_BIAS_ONLY): (
        (0.0548, -0.0252, 0.0487, 0.9763),
        (0.0854, -0.0171, 0.0836, 0.9720),
        (0.0744, 0.0095, 0.0738, 0.9873),
    ),
    ("z-tie-iii", FULL): (
        (0.0041, 0.0010, 0.0040, 0.9997),
        (0.0039, 0.0011, 0.0076, 0.9998),
        (0.0073, 0.0003, 0.0072, 0.9998),
    ),
    ("z-tie-iii", SENSOR_FRAME): (
        (0.0631, -0.0157, 0.0611, 0.9948),
        (0.0411, -0.0130, 0.0381, 0.9969),
        (0.0454, 0.0214, 0.0398, 0.9953),
    ),
}
TITLES = {
    "zy-tbme-ii": "ZY-TBME Table II: the magnetometer with H and B, and with B only",
    "z-tie-iii": "Z-TIE Table III: all sensors in one frame, and each in its own",
}

ALIGNED = "H, B and delays (align)"
PHONE_VARIANTS = (RAW, BIAS_ONLY, SENSOR_FRAME, FULL, ALIGNED)

_COLOUR = {RAW: GREY, BIAS_ONLY: ORANGE, MAG_BIAS_ONLY: "#8a6d00", SENSOR_FRAME: PURPLE, FULL: BLUE, UNCORRUPTED: GREEN}


@dataclass(frozen=True)
class One:
    """One filter on one trial of one node (node -1: uncorrupted), with one variant of the calibration."""

    filter: str
    trial: str
    node: int
    variant: str
    found: Evaluation


def reproduce(runs: int = RUNS, seed: int = 0, tick: Tick | None = None) -> Reproduction:
    """All tables; the same `runs` and `seed` give the same figures.

    Parameters
    ----------
    runs : int
        Corrupted nodes a trial.

    Raises
    ------
    InputError
        The recordings are not there (MARGCAL_DATA).
    """
    folder = data_folder()
    paths, motions = trials(folder), phone_motions(folder)
    work = Work(tick, (len(paths) * runs + len(motions)) * 100)
    broad = corrupted(paths, runs, seed, work)
    phones = raw_phones(folder, motions, work)
    names = list(dict.fromkeys(one.filter for one in broad))
    papers = PAPERS_FILTER if PAPERS_FILTER in names else names[0]
    tables = [_means(broad), *(_restored(broad, name) for name in names)]
    tables += [_paper_table(name, broad, papers) for name in TITLES]
    if phones:
        tables.append(_phone_table(phones))
    return Reproduction("effect", CITATION, runs, seed, tuple(tables), _pictures(broad, phones))


# --- the runs -----------------------------------------------------------------------------------------


def corrupted(paths: Mapping[str, Path], runs: int, seed: int, work: Work) -> list[One]:
    """Every filter on every trial: uncorrupted, and read by `runs` nodes with every variant of their calibration."""
    step, out = work.of(100), []
    run = filters()
    for number, (trial, path) in enumerate(paths.items()):
        recording = read(path)
        for name, orient in run.items():
            out.append(_one(name, trial, -1, UNCORRUPTED, evaluate(orient(recording), path)))
        for k in range(runs):
            node = make_node(1000 * (seed + 1) + 20 * number + 2 * k)
            raw = node.reads(recording)
            for variant, calibration in node.variants.items():
                vectors = applied(calibration, raw)
                out += [_one(n, trial, k, variant, evaluate(f(vectors), path)) for n, f in run.items()]
            step(1)
    return out


def raw_phones(folder: Path, motions: Mapping[str, Path], work: Work) -> list[One]:
    """Every filter on the phones' motions, with what their own calibration sessions give and with parts of it.

    Neither the phone's attitude on its marker body nor the laboratory's heading is known from those sessions, and the
    clocks are not the same: constant rotations of both frames and a constant offset are taken out, of every variant.
    """
    if not motions:
        return []
    calibrated, spheres = phone_calibration(folder)
    aligned = phone_alignment(folder)
    variants = variants_of(calibrated, spheres, {"acc": 1.0, "gyr": 1.0, "mag": 1.0})
    step, out = work.of(100), []
    for motion, path in motions.items():
        recording = read(path)
        for name, orient in filters().items():
            tracks = {v: orient(applied(variants[v], recording)) for v in (RAW, BIAS_ONLY, SENSOR_FRAME, FULL)}
            if motion != ALIGNED_ON:
                tracks[ALIGNED] = orient(replace(recording, reference=None), aligned)
            # the clocks' offset is the same for every variant, and a raw estimate is too far off to find it
            offset = evaluate(tracks[FULL], recording, align_time=True).time_offset_s or 0.0
            for variant, track in tracks.items():
                moved = Attitude(track.t + offset, track.q)
                found = evaluate(moved, recording, align_frames="full")
                out.append(_one(name, motion, 0, variant, found))
        step(1)
    return out


def _one(name: str, trial: str, node: int, variant: str, found: Evaluation) -> One:
    """The figures; the tracks only of what is drawn over time (all of them are gigabytes)."""
    if trial != SHOWN_TRIAL or node > 0:
        found = replace(found, t=found.t[:0], q_est=found.q_est[:0], q_ref=found.q_ref[:0], counted=found.counted[:0])
    return One(name, trial, node, variant, found)


# --- tables -------------------------------------------------------------------------------------------


def _means(ones: Sequence[One]) -> Grid:
    """Mean over trials and nodes, and how far the worst is from the uncorrupted result."""
    rows = []
    for name in dict.fromkeys(o.filter for o in ones):
        for variant in (*VARIANTS, UNCORRUPTED):
            here = [o for o in ones if o.filter == name and o.variant == variant]
            figures = np.mean([_figures(o.found) for o in here], axis=0)
            off = max(abs(d) for d in _differences(ones, here))
            rows.append((f"{name}, {variant}", *figures.tolist(), off))
    header = ("deg", "total", "heading", "inclination", "roll", "pitch", "yaw", "off by at most")
    nodes = (
        f"nodes: scale errors to {100 * SCALE[0]:g}-{100 * SCALE[1]:g} %, mounting {MOUNTING_DEG[0]:g}-"
        f"{MOUNTING_DEG[1]:g} deg, biases, hard and soft iron; calibrated by the pipeline from 24 simulated attitudes "
        f"of {REST_S:g} s (housing error {HOUSING_SD_DEG:g} deg)",
        "RMS over the samples in motion, nothing aligned, mean over trials and nodes; off by at most: total error "
        "against that of the uncorrupted recording, the worst of all",
        "sensor frame only: accelerometer and magnetometer by the length of the sensed vector, gyroscope without its "
        "mounting",
    )
    return Grid("effect", "BROAD, corrupted by known node errors", header, tuple(rows), nodes)


def _figures(e: Evaluation) -> tuple[float, ...]:
    return e.total_deg, e.heading_deg, e.inclination_deg, e.roll.rms, e.pitch.rms, e.yaw.rms


def _differences(ones: Sequence[One], some: Sequence[One]) -> list[float]:
    """Total error of `some` less that of the uncorrupted trial."""
    clean = {(o.filter, o.trial): o.found.total_deg for o in ones if o.variant == UNCORRUPTED}
    return [o.found.total_deg - clean[o.filter, o.trial] for o in some]


def _restored(ones: Sequence[One], name: str) -> Grid:
    """By how much each variant misses the uncorrupted result, trial by trial and node by node."""
    here = [o for o in ones if o.filter == name]
    rows = []
    for trial, node in dict.fromkeys((o.trial, o.node) for o in here if o.node >= 0):
        of_node = {o.variant: o for o in here if (o.trial, o.node) == (trial, node)}
        clean = next(o.found.total_deg for o in here if o.trial == trial and o.node < 0)
        rows.append((f"trial {trial}, node {node + 1}", clean, *_differences(ones, [of_node[v] for v in VARIANTS])))
    within = sum(abs(row[-1]) <= RESTORED_DEG for row in rows)
    text = f"H and B: within {RESTORED_DEG:g} deg of the uncorrupted result in {within} of {len(rows)}"
    header = ("deg", UNCORRUPTED, *VARIANTS)
    slug = name.replace(" ", "-")
    return Grid(
        f"restored-{slug}", f"{name}: total error less that of the uncorrupted trial", header, tuple(rows), (text,)
    )


def _paper_table(name: str, ones: Sequence[One], filter_name: str) -> Grid:
    """The paper's table, and ours beside it, in radians as there."""
    rows = []
    for variant in [v for n, v in PAPER if n == name]:
        here = [o.found for o in ones if o.filter == filter_name and o.variant == variant]
        for angle, paper in zip(ANGLES, PAPER[name, variant]):
            errors = [getattr(e, angle) for e in here]
            ours = (
                np.radians(np.sqrt(np.mean([e.rms**2 for e in errors]))),
                np.radians(np.mean([e.mean for e in errors])),
                np.radians(np.sqrt(np.mean([e.sd**2 for e in errors]))),
                np.mean([e.correlation for e in errors]),
            )
            rows.append((f"{variant}: {angle}", *paper, *(float(x) for x in ours)))
    header = ("rad", *(f"paper {c}" for c in _COLUMNS), *(f"ours {c}" for c in _COLUMNS))
    text = (
        f"paper: an arm or a rigid body against BTS SMART-D; ours: {filter_name} on the corrupted BROAD trials, which "
        "are faster and partly disturbed: compare the rows of a column, not the columns",
    )
    return Grid(name, TITLES[name], header, tuple(rows), text)


_COLUMNS = ("rms", "mean", "sd", "corr")


def _phone_table(ones: Sequence[One]) -> Grid:
    rows = []
    motions = list(dict.fromkeys(o.trial for o in ones))
    held_out = [m for m in motions if m != ALIGNED_ON]
    for name in dict.fromkeys(o.filter for o in ones):
        for variant in PHONE_VARIANTS:
            here = {o.trial: o.found.total_deg for o in ones if o.filter == name and o.variant == variant}
            figures = [here.get(m, "-") for m in motions]
            rows.append((f"{name}, {variant}", *figures, float(np.mean([here[m] for m in held_out]))))
    text = (
        "a Nexus 5 (raw accelerometer, uncalibrated gyroscope and magnetometer) with H and B from its own sessions by "
        "the pipeline; Qualisys; total error, RMS",
        f"{ALIGNED}: by motion capture from the first of the motions, which it is no test of; mean: of the others",
        "constant rotations of both frames and a constant offset of the clocks are taken out of every row alike",
    )
    header = ("deg", *(m.replace("_Nexus5_", " ").replace("_", " ") for m in motions), "mean")
    return Grid("phones", "A raw phone", header, tuple(rows), text)


# --- pictures -----------------------------------------------------------------------------------------


def _pictures(broad: Sequence[One], phones: Sequence[One]) -> dict[str, str]:
    out = {
        "effect-total.svg": _in_pairs("Total error with each part of a calibration, BROAD", _by_variant(broad)),
        "effect-time.svg": figure(f"BROAD trial {SHOWN_TRIAL}: what is left out shows", _over_time(broad), width=560),
    }
    if phones:
        out["effect-phones.svg"] = _in_pairs("A raw phone: total error", _by_variant(phones, PHONE_VARIANTS))
    return out


def _in_pairs(title: str, panels: Sequence[Panel]) -> str:
    return stacked(title, [panels[k : k + 2] for k in range(0, len(panels), 2)], width=560)


_SHORT = {
    RAW: "raw",
    BIAS_ONLY: "B",
    MAG_BIAS_ONLY: "mag B",
    SENSOR_FRAME: "own frames",
    FULL: "H and B",
    UNCORRUPTED: "clean",
    ALIGNED: "and delays",
}


def _by_variant(ones: Sequence[One], order: Sequence[str] = (*VARIANTS, UNCORRUPTED)) -> list[Panel]:
    """A panel a filter: a dot a trial and node, beside each other by trial."""
    panels = []
    names = list(dict.fromkeys(o.trial for o in ones))
    every = np.array([o.found.total_deg for o in ones])
    for name in dict.fromkeys(o.filter for o in ones):
        curves = []
        for k, trial in enumerate(names):
            here = [o for o in ones if o.filter == name and o.trial == trial and o.variant in order]
            shift = 0.6 * (k / max(len(names) - 1, 1) - 0.5)
            x = np.array([order.index(o.variant) + shift for o in here])
            y = np.array([o.found.total_deg for o in here])
            label = trial if len(names) > 4 else trial.split("_")[0] + " " + trial.split("_")[-1]
            curves.append(Curve(label, x, y, COLOURS[k % len(COLOURS)], dots=True, line=False))
        panels.append(
            Panel(
                f"{name}: total error, RMS",
                "what of the calibration is used",
                "degrees",
                tuple(curves),
                log=True,
                x_names=tuple(_SHORT[v] for v in order),
                x_range=(-0.5, len(order) - 0.5),
                y_range=(0.8 * float(every.min()), 1.3 * float(every.max())),
            )
        )
    return panels


def _over_time(ones: Sequence[One]) -> list[Panel]:
    """Heading and inclination error of one trial and node."""
    first = ones[0].filter
    here = [o for o in ones if o.filter == first and o.trial == SHOWN_TRIAL and o.node <= 0]
    shown = {o.variant: o.found for o in here if o.variant in (BIAS_ONLY, SENSOR_FRAME, FULL, UNCORRUPTED)}
    panels = []
    for k, name in ((1, "heading"), (2, "inclination")):
        curves = []
        for variant, found in shown.items():
            error = np.degrees(error_angles(found.q_est, found.q_ref)[k])
            dash = "3 4" if variant == UNCORRUPTED else ""
            curves.append(Curve(variant, *_thin(found.t, error), _COLOUR[variant], dash=dash))
        curves.sort(key=lambda c: c.label == UNCORRUPTED)
        panels.append(Panel(f"{name} error, {first}", "time, s", "degrees", tuple(curves), zero_line=True))
    return panels


def _thin(t: Array, y: Array, bins: int = 500) -> tuple[Array, Array]:
    """Means over `bins` stretches of time; NaN where there is nothing."""
    cell = np.minimum(((t - t[0]) / (t[-1] - t[0]) * bins).astype(int), bins - 1)
    count = np.bincount(cell, minlength=bins)
    with np.errstate(invalid="ignore"):
        return t[0] + (np.arange(bins) + 0.5) * (t[-1] - t[0]) / bins, np.bincount(cell, y, bins) / np.where(
            count, count, np.nan
        )
