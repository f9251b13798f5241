"""R-BSN: D. Rüschen, B. J. E. Misgeld, S. Kim, S. Leonhardt, "A novel algorithm for the calibration of
inertial/magnetic sensors: application to a body sensor network", section 5.

One figure of the paper is a number (8.8 degrees), the others are curves: Fig. 5, roll, pitch and yaw of a walker's limb
by the tracking system, by the filter without a calibration, and by the filter with one. `r_bsn_simulation` makes the
recordings, `r_bsn_runs` carries the calibration out; here are the tables and the figures.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from margcal.apps.papers.figures import BLUE, GREEN, GREY, ORANGE, Curve, Panel, figure, stacked
from margcal.apps.papers.r_bsn_runs import (
    OURS,
    PAPER,
    PERFECT,
    UNCALIBRATED,
    VARIANTS,
    Run,
    Walked,
    carry_out,
    with_yaw,
)
from margcal.apps.papers.r_bsn_simulation import DIP, FIELD_UT, NODE_HZ, OPTICS_HZ, Setting
from margcal.apps.papers.tables import Cell, Figure, Grid, Reproduction, Table, Tick, Work, figure_of, short
from margcal.core.types import Array
from margcal.workflow.evaluate import Evaluation
from margcal.workflow.gait import PLACES
from margcal.workflow.metrics import summary

CITATION = "R-BSN: D. Rüschen, B. J. E. Misgeld, S. Kim, S. Leonhardt, RWTH Aachen"

PAPER_REDUCTION = 8.8
"""Degrees, abstract: "reduces the errors incorporated by misalignment of the reference frames and decalibration"."""

RUNS = 10
"""Sessions, where nothing is said: three nodes each, a minute and a half on one core."""

YAWS = (0.0, 5.0, 8.0, 10.0, 15.0, 20.0)
FACTORS = (0.0, 1.0, 2.0)
"""Yaw of the wand, deg, and size of the nodes' errors, for the table that says what the 8.8 hangs on."""

SHOWN_S = (40.0, 46.0)
"""The part of the walk that Fig. 5 shows."""


SETTING = Setting()


def reproduce(runs: int = RUNS, seed: int = 0, tick: Tick | None = None) -> Reproduction:
    """Section 5; the same `runs` and `seed` give the same figures.

    Parameters
    ----------
    runs : int
        Sessions; the nodes of other decalibrations are simulated in a third of them (at least one).
    """
    few = max(1, runs // 3)
    work = Work(tick, 30 * runs + 20 * few * (len(FACTORS) - 1))
    setting = SETTING
    seeds = [1000 * seed + k for k in range(runs)]
    found = carry_out(seeds, setting, tick=work.of(10))
    others = {
        f: found if f == 1 else carry_out(seeds[:few], setting.decalibrated(f), [PAPER], work.of(20 // 3))
        for f in FACTORS
    }
    vqf = all(w.by_vqf is not None for r in found for w in r.walks.values())
    yaws = _yaws(others, vqf)
    title = "Section 5: what the calibration takes off the error"
    tables = (
        Table("section-5", title, _cells(found, yaws), _settings(found, setting)),
        _errors(found),
        *((_by_vqf(found),) if vqf else ()),
        _accuracies(found),
        yaws,
    )
    pictures = {f"r-bsn-fig-5-{place}.svg": _figure_5(found[0], place) for place in PLACES}
    pictures["r-bsn-yaw.svg"] = _figure_yaw(others, vqf)
    return Reproduction("r-bsn", CITATION, runs, seed, tables, pictures)


def reductions(runs: Sequence[Run], variant: str) -> Array:
    """Rms error without the calibration less that with it (runs,), deg, averaged over the nodes."""
    return np.array([float(np.nanmean(row)) for row in _by_node(runs, variant)])


def _by_node(runs: Sequence[Run], variant: str) -> Array:
    """The same by node (runs, 3); NaN where an alignment was refused."""
    return np.array([r.total(UNCALIBRATED) - r.total(variant) for r in runs])


def _settings(runs: Sequence[Run], setting: Setting) -> tuple[str, ...]:
    yaw = np.abs([r.session.yaw_deg for r in runs])

    def last(span: tuple[float, float]) -> str:
        return f"{span[1] - span[0]:.0f} s"

    return (
        f"setting: nodes at {NODE_HZ:g} Hz, optics at {OPTICS_HZ:g} Hz, clocks {1e3 * setting.offset_s:.0f} ms and "
        f"{setting.drift_ppm:g} ppm apart; {last(setting.still_s)} at rest, {last(setting.moved_s)} moved by hand "
        f"({setting.hand_mps2:g} m/s^2 rms), {last(setting.walk_s)} walking at 3 km/h",
        f"setting: wand level to {setting.wand_level:g} deg, its yaw evenly within {setting.yaw:g} deg of magnetic "
        f"north (not in the paper); marker plate {setting.plate:g} deg off the node's axes, markers to "
        f"{1e3 * setting.marker_noise_m:g} mm",
        f"setting: nodes off by {100 * setting.scale_error:g} % in scale, {setting.non_orthogonality:g} deg in axes, "
        f"{setting.mounting:g} deg in mounting, {setting.hard_iron_uT:g} uT of hard iron (not in the paper)",
        f"setting: field {FIELD_UT:g} uT, dip {np.degrees(DIP):.1f} deg, the same everywhere; filter ekf-quest "
        "with .01 rad/s and .3 a sample (not in the paper)",
        f"setting: |yaw| of these sessions {short(yaw.min())} to {short(yaw.max())} deg, mean {short(yaw.mean())}; it "
        "and the nodes' errors decide the figure below (last table), so that agreement with 8.8 proves little",
    )


def _cells(runs: Sequence[Run], yaws: Grid) -> tuple[Cell, ...]:
    found = [float(v) for row in yaws.rows for v in row[1:]]
    own = np.nanmean([r.total(PERFECT) for r in runs], axis=0)
    reason = (
        "the paper tells neither the wand's yaw nor the nodes' errors nor the limb, and over those of the last table "
        f"this figure runs from {short(min(found))} to {short(max(found))}; at the ankle the filter's own error "
        f"({short(float(own[-1]))} with perfect sensors) hides what the calibration takes off"
    )

    def cell(row: str, column: str, values: Array) -> Cell:
        return Cell(row, column, Figure(PAPER_REDUCTION), figure_of(values), reason)

    return (
        cell("mean of the nodes", PAPER, reductions(runs, PAPER)),
        *(cell(place, PAPER, _by_node(runs, PAPER)[:, k]) for k, place in enumerate(PLACES)),
        cell("mean of the nodes", OURS, reductions(runs, OURS)),
    )


def _errors(runs: Sequence[Run]) -> Grid:
    rows = []
    for place in PLACES:
        for variant in VARIANTS:
            walks = [r.walks[place, variant].evaluation for r in runs if (place, variant) in r.walks]
            figures = [
                summary([getattr(e, f"{name}_deg") for e in walks]) for name in ("total", "heading", "inclination")
            ]
            angles = [summary([getattr(e, name).rms for e in walks]).mean for name in ("roll", "pitch", "yaw")]
            rows.append(
                (f"{place}, {variant}", figures[0].mean, figures[0].sd, *(f.mean for f in figures[1:]), *angles)
            )
    return Grid(
        "errors",
        "Errors of the walk, degrees rms, mean over the sessions",
        ("", "total", "sd", "heading", "inclination", "roll", "pitch", "yaw"),
        tuple(rows),
        ("against the tracking system, in the tracking frame; perfect sensors have noise only: what the filter costs",),
    )


def _by_vqf(runs: Sequence[Run]) -> Grid:
    """The same walks by another filter."""
    rows = []
    for place in PLACES:
        means = []
        for variant in VARIANTS:
            found = [w.by_vqf for r in runs if (w := r.walks.get((place, variant))) is not None]
            means.append(summary([e.total_deg for e in found if e is not None]).mean)
        rows.append((place, *means, means[0] - means[1], means[0] - means[2]))
    header = ("", *VARIANTS, "reduction, r-bsn", "reduction, ours")
    text = "VQF: the public package, not the paper's filter; it bears the acceleration of a swinging leg"
    return Grid("vqf", "The same walks by VQF: total error, degrees rms", header, tuple(rows), (text,))


def _accuracies(runs: Sequence[Run]) -> Grid:
    names = ("T", "C_b", "C_n", "acc_H", "acc_B", "mag_H", "mag_B")
    rows = []
    for way in (PAPER, OURS):
        found = [a for r in runs for (_, w), a in r.accuracy.items() if w == way]
        lost = sum(r.lost for r in runs)
        rows.append((way, *(summary([getattr(a, n) for a in found]).mean for n in names), float(len(found))))
    text = f"means over all nodes; {lost} alignments refused" if lost else "means over all nodes; none refused"
    header = ("", "T %", "C^b deg", "C^n deg", "acc H %", "acc B %", "mag H %", "mag B %", "nodes")
    return Grid("accuracy", "How far the alignments are from the truth", header, tuple(rows), (text,))


def _yaws(others: dict[float, list[Run]], vqf: bool) -> Grid:
    rows = []
    for name, by_vqf in (("ekf-quest", False), *((("vqf", True),) if vqf else ())):
        for factor, runs in others.items():
            rows.append((f"{name}, nodes' errors x {factor:g}", *_reduction_by_yaw(runs, by_vqf)))
    return Grid(
        "yaw",
        "What the 8.8 hangs on: reduction, degrees, by the wand's yaw and the nodes' errors (r-bsn)",
        ("", *(f"{y:g} deg" for y in YAWS)),
        tuple(rows),
        ("x 0: nodes without errors on plates that are straight; only noise, the wand's level and its yaw are left",),
    )


def _reduction_by_yaw(runs: Sequence[Run], by_vqf: bool) -> Array:
    """Mean (len(YAWS),) over sessions and nodes. The calibrated error does not depend on the yaw."""

    def of(walked: Walked) -> Evaluation:
        return walked.by_vqf if by_vqf and walked.by_vqf is not None else walked.evaluation

    found = np.array(
        [
            [with_yaw(of(r.walks[p, UNCALIBRATED]), r.session, y) - of(r.walks[p, PAPER]).total_deg for y in YAWS]
            for r in runs
            for p in PLACES
            if (p, PAPER) in r.walks
        ]
    )
    return np.asarray(found.mean(axis=0))


# --- figures ------------------------------------------------------------------------------------------


def _figure_5(run: Run, place: str) -> str:
    walks = {v: w for (p, v), w in run.walks.items() if p == place}
    shown = ((UNCALIBRATED, ORANGE, "6 3", UNCALIBRATED), (PAPER, BLUE, "2 2", "calibrated"))
    only_error = ((PERFECT, GREEN, "", PERFECT),)
    angles, errors = [], []
    for k, name in enumerate(("roll", "pitch", "yaw")):
        curves, misses = [], []
        for variant, colour, dash, label in (*only_error, *shown):
            if variant not in walks:
                continue
            t, truth, estimate, error = _part(walks[variant], k)
            misses.append(Curve(label, t, error, colour, dash=dash))
            if variant == PERFECT:
                curves.append(Curve("tracking", t, truth, GREY))
            else:
                curves.append(Curve(label, t, estimate, colour, dash=dash))
        angles.append(Panel(name, "", f"{name}, deg", tuple(curves)))
        errors.append(
            Panel(f"error of {name}", "time on the treadmill, s", "error, deg", tuple(misses), zero_line=True)
        )
    title = f"R-BSN Fig. 5, simulated: {place}, 3 km/h, wand {run.session.yaw_deg:.1f}° off magnetic north"
    return stacked(title, [angles, errors], width=400, height=250)


def _part(walked: Walked, k: int) -> tuple[Array, Array, Array, Array]:
    """Time from the walk's start, tracked angle, estimated angle and error, deg, in the part that is shown."""
    found = walked.evaluation
    truth, estimate, error = found.angles_deg()
    t = found.t - found.t[0]
    part = (t >= SHOWN_S[0]) & (t < SHOWN_S[1])
    return t[part], truth[part, k], estimate[part, k], error[part, k]


def _figure_yaw(others: dict[float, list[Run]], vqf: bool) -> str:
    yaws, panels = np.array(YAWS), []
    for title, by_vqf in (("by ekf-quest", False), *((("by VQF", True),) if vqf else ())):
        curves = []
        for (factor, runs), colour in zip(others.items(), (GREY, BLUE, ORANGE)):
            mean = _reduction_by_yaw(runs, by_vqf)
            curves.append(Curve(f"nodes' errors x {factor:g}", yaws, mean, colour, dots=True))
        panel = Panel(
            title,
            "yaw of the wand off magnetic north, deg",
            "error without less error with calibration, deg",
            tuple(curves),
            lines=((PAPER_REDUCTION, "the paper's 8.8"),),
            zero_line=True,
        )
        panels.append(panel)
    return figure("R-BSN: what the calibration takes off, by the wand's yaw", panels, width=560)
