"""ZY-TBME, section III.A: Zhang & Yang, "Micromagnetometer calibration for accurate orientation estimation", 2015.

Table I's parameters, 30 orientations, the svd method; Fig. 2 (a, b, c) as histograms, the paper's figures beside ours.
The text is read literally; what it does not say (field, orientations, how errors are counted) is printed.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from margcal.apps.papers.figures import BLUE, ORANGE, Panel, figure, histogram
from margcal.apps.papers.tables import Cell, Figure, Grid, Reproduction, Table, Tick, short
from margcal.core.types import Array, Fit
from margcal.methods.bounds import cramer_rao
from margcal.methods.gls import gls_ml
from margcal.methods.sensor_model import ZY_TBME_TABLE_I, compose, mounting
from margcal.methods.transform import eigen, one_step, svd
from margcal.workflow.metrics import frobenius, length, rms, share_below, summary

CITATION = "ZY-TBME: Z.-Q. Zhang, G.-Z. Yang, IEEE Trans. Biomed. Eng. 62(2), 2015"

N_POSES = 30
SIGMA = math.sqrt(0.1)
"""Raw unit: "variance 0.1 mg", taken as variance of the raw reading."""

M, DIP = 491.0, math.radians(66.5)
"""mgauss and angle: the field in London, where the authors work; the paper says neither."""

H, B = compose(ZY_TBME_TABLE_I)
U = M * np.array([0.0, math.cos(DIP), -math.sin(DIP)])
"""mgauss: in the reference pose the node's axes lie east, north, up."""

METHODS: dict[str, Callable[[Array, Array], Fit]] = {
    "svd (paper)": lambda y, R: svd(y, R, M, kind="mag"),
    "eigen": lambda y, R: eigen(y, R, M, kind="mag"),
    "one-step": lambda y, R: one_step(y, R, M, kind="mag"),
    "gls-ml": lambda y, R: gls_ml(y, R, M, kind="mag"),
}


def reproduce(runs: int = 1000, seed: int = 0, tick: Tick | None = None) -> Reproduction:
    """Fig. 2; the same `runs` and `seed` give the same figures."""
    rng = np.random.default_rng(seed)
    angles = rng.uniform(0, np.pi, (runs, N_POSES, 3))
    R = np.array([[mounting(*a) for a in one] for one in angles])
    R[:, 0] = np.eye(3)
    y = _readings(R, U, rng)
    errors = {}
    for i, (name, solve) in enumerate(METHODS.items()):
        errors[name] = [_errors(solve(y[k : k + 250], R[k : k + 250])) for k in range(0, runs, 250)]
        errors[name] = [np.concatenate(c) for c in zip(*errors[name])]
        if tick is not None:
            tick(i + 1, len(METHODS) + 1)
    bounds = [cramer_rao(H, U, one, SIGMA) for one in R]
    least = (rms([b.H_rms for b in bounds]), rms([b.B_rms for b in bounds]), rms([b.u_rms for b in bounds]))
    paper, ours = _percent(errors["svd (paper)"]), _percent(errors["one-step"])
    others = _by_direction(R[:300], rng)
    tables = (
        Table("fig-2", "Fig. 2", _cells(paper, others), _settings()),
        _ours(errors, least),
        others,
    )
    pictures = {"zy-tbme-fig-2.svg": figure("ZY-TBME Fig. 2: errors over the runs", _panels(paper, ours), width=430)}
    return Reproduction("zy-tbme", CITATION, runs, seed, tables, pictures)


def _readings(R: Array, u: Array, rng: np.random.Generator) -> Array:
    return (R @ u) @ np.linalg.inv(H).T + B + SIGMA * rng.normal(size=(*R.shape[:2], 3))


def _by_direction(R: Array, rng: np.random.Generator) -> Grid:
    """Errors of the bias for other fields in the reference pose: the paper does not say which it was."""
    rows = []
    for name, u in (("x", np.eye(3)[0]), ("y", np.eye(3)[1]), ("z", np.eye(3)[2]), ("London, as taken", U / M)):
        fit = svd(_readings(R, M * u, rng), R, M, kind="mag")
        percent = 100 * np.abs(fit.model.B - B) / B
        rows.append((name, 100 * share_below(percent, 0.005), float(np.nanmax(percent)), rms(percent)))
    return Grid(
        "directions",
        f"How far the field's direction in the reference pose decides ({len(R)} runs each)",
        ("", "bias < .005 %", "largest %", "rms %"),
        tuple(rows),
    )


def _settings() -> tuple[str, ...]:
    return (
        "setting: Table I, soft iron read as the symmetric matrix (its row prints a32 where a23 must stand)",
        f"setting: {N_POSES} orientations, Euler angles uniform on 0..180 deg, drawn anew in each run; first R = I",
        f"setting: noise of variance 0.1 on the raw reading, sd {SIGMA:.3f}",
        f"setting: field {M:.0f} mgauss, dip {math.degrees(DIP):.1f} deg (London; the paper says neither)",
        "setting: B and H by element, relative to the element; u by its length, relative to the field",
    )


def _errors(fit: Fit) -> tuple[Array, Array, Array]:
    u = np.zeros(3) if fit.u is None else fit.u
    return fit.model.H - H, fit.model.B - B, u - U


def _percent(errors: list[Array]) -> tuple[Array, Array, Array]:
    """Errors of B (runs, 3), H (runs, 9) by element and of u (runs,), per cent."""
    dH, dB, du = errors
    by_element = 100 * np.abs(dH / H).reshape(len(dH), 9)
    return 100 * np.abs(dB / B), by_element, 100 * length(du) / M


def _cells(percent: tuple[Array, Array, Array], others: Grid) -> tuple[Cell, ...]:
    bias, matrix, vector = percent
    largest = [float(row[2]) for row in others.rows]
    return (
        Cell(
            "below 0.005 %, per cent", "(a) bias", Figure(92.0, limit="above"), Figure(100 * share_below(bias, 0.005))
        ),
        Cell(
            "largest, %",
            "(a) bias",
            Figure(0.012),
            Figure(float(np.nanmax(bias))),
            f"the field in the reference pose is open: {len(largest)} directions of it give {short(min(largest))} to "
            f"{short(max(largest))}",
        ),
        Cell(
            "below 0.15 %, per cent",
            "(b) H",
            Figure(50.0, limit="above"),
            Figure(100 * share_below(matrix, 0.15)),
        ),
        Cell(
            "typical, %",
            "(c) u",
            Figure(0.05),
            Figure(summary(vector).mean),
            '"small (0.05 %)" does not say whether it is a mean, a bound or a bin; ours is the mean',
        ),
        Cell("below 0.05 %, per cent", "(c) u", Figure(50.0, limit="above"), Figure(100 * share_below(vector, 0.05))),
    )


def _ours(errors: dict[str, list[Array]], least: tuple[float, float, float]) -> Grid:
    rows = []
    for name, found in errors.items():
        bias, matrix, vector = _percent(found)
        norms = (frobenius(found[0]), length(found[1]), length(found[2]))
        rows.append(
            (
                name,
                summary(bias).mean,
                100 * share_below(bias, 0.005),
                float(np.nanmax(bias)),
                100 * share_below(matrix, 0.15),
                summary(vector).mean,
                *(rms(n) / b for n, b in zip(norms, least)),
            )
        )
    header = ("", "bias %", "< .005 %", "largest %", "H < .15 %", "u %", "H/bound", "B/bound", "u/bound")
    text = (
        f"rms error over the Cramer-Rao bound (H {short(least[0])}, B {short(least[1])}, u {short(least[2])} mgauss), "
        "averaged over the runs' own poses",
    )
    return Grid("ours", "Every method on the same readings", header, tuple(rows), text)


def _panels(paper: tuple[Array, Array, Array], ours: tuple[Array, Array, Array]) -> list[Panel]:
    told = (
        ("(a) combined bias", "error of a component, %", 0.012, 24, "< 0.005 %", 0.005, "92 %"),
        ("(b) transformation matrix", "error of an element, %", 0.6, 24, "< 0.15 %", 0.15, "the majority"),
        ("(c) magnetic vector", "error of the vector, %", 0.12, 24, "< 0.05 %", 0.05, "small"),
    )
    out = []
    for (title, label, upto, bins, below, limit, said), mine, one in zip(told, paper, ours):
        note = f"{below}: {100 * share_below(mine, limit):.1f} % (paper: {said})"
        out.append(
            histogram(
                title,
                label,
                mine,
                bins=bins,
                upto=upto,
                note=note,
                colour=BLUE,
                label="svd (paper)",
                compare=("one-step", one, ORANGE),
            )
        )
    return out
