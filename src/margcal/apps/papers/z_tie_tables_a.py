"""Z-TIE III.A, accelerometer: Table I, Figs. 3, 4 and 5, the printed figures beside ours."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from margcal.apps.papers import z_tie_simulation_a as sim_a
from margcal.apps.papers.figures import BLUE, GREY, ORANGE, Curve, Panel, figure, histogram
from margcal.apps.papers.tables import FACTOR, Cell, Figure, Grid, Part, Table, Work, figure_of, short
from margcal.apps.papers.z_tie_printed import LITERAL_SIGMA, SIGMA, TABLE_I
from margcal.core.types import Array
from margcal.workflow.metrics import rms, share_below, summary


def tables(runs: int, few: int, streams: Sequence[np.random.Generator], work: Work) -> Part:
    sets = sim_a.pose_sets(streams[0])
    typical = sets[sim_a.N_DRAWS // 2]
    world = sim_a.fixed_world(typical, SIGMA, runs, streams[1])
    shown = sim_a.typical_run(world, few)
    ours = sim_a.alternation_iterates(world, shown)
    optimiser = sim_a.slsqp_iterates(world.first(few), work.of(60), shown)
    errors = sim_a.all_errors(world, work.of(1))
    draws = [sim_a.draw(R, SIGMA, min(runs, 200), rng) for R, rng in zip(sets, streams[0].spawn(len(sets)))]
    bounds = sim_a.bound_rms(world)
    chosen = (
        f"setting: {sim_a.N_POSES} poses, the same in all runs: Euler angles uniform on 0..180 deg, first pose R = I; "
        f"of {sim_a.N_DRAWS} draws the one with the median rate of convergence (lambda2 {sim_a.lambda2(typical):.3f})",
        f"setting: noise {SIGMA} counts on a pose (variance 0.1 (m/s^2)^2, mean of 100 samples); u0 = rand(3, 1)",
        "setting: Frobenius norm; error of H in units of S (H S^-1), since ||H_a|| itself is only 0.0392 m/s^2 a count",
        f"setting: optimisation = SciPy's SLSQP, raw variables, gradient by differences, {few} of the {runs} runs",
    )
    literal = sim_a.redrawn_world(LITERAL_SIGMA, runs, streams[2])
    literal_ours = sim_a.alternation_iterates(literal)
    literal_optimiser = sim_a.slsqp_iterates(literal.first(few), work.of(60))
    literal_errors = sim_a.all_errors(literal, work.of(1))
    as_read = (
        "setting: 20 orientations at random (uniform over all rotations), drawn anew in each run; u0 = rand(3, 1)",
        f"setting: variance 0.1 added to the raw reading: {LITERAL_SIGMA:.3f} counts; H in m/s^2 a count as printed",
        f"setting: optimisation as above, {few} of the {runs} runs",
    )
    two_step, one_step = errors["eigen"], errors["one-step"]
    within = [_within_1_percent(i, world) for i in (ours, optimiser)]
    found = (
        Table("table-1", "Table I", _table_1(ours, optimiser, draws, bounds, two_step, within[1]), chosen),
        Table("text-a", "III.A in the text, Fig. 5", _text_a(within, two_step, draws), ()),
        _ours_a("ours-a", "Simulation A, every method on the same readings", world, errors, bounds),
        _draws(draws),
        Table(
            "table-1-literal", "Table I, literal reading", _literal_1(literal_ours, literal_optimiser, literal), as_read
        ),
        _ours_a(
            "ours-a-literal",
            "Simulation A, literal reading",
            literal,
            literal_errors,
            sim_a.bound_rms(literal),
        ),
        _identities(typical, streams[0]),
    )
    pictures = {
        "z-tie-fig-3.svg": _figure_3(ours, optimiser),
        "z-tie-fig-4.svg": _figure_4(ours, optimiser, shown),
        "z-tie-fig-5.svg": _figure_5(two_step, one_step),
    }
    return Part(found, pictures, _seconds(world, min(few, 3), work))


def _table_1(
    ours: sim_a.Iterates,
    optimiser: sim_a.Iterates,
    draws: Sequence[sim_a.Draw],
    bounds: tuple[float, float, float],
    two_step: sim_a.Errors,
    stopped: float,
) -> tuple[Cell, ...]:
    cells = []
    for column, values, place, by_draw in (
        ("|H| optimisation", optimiser.H_norm, 0, None),
        ("|H| alternation", ours.H_norm, 1, [d.H_norm for d in draws]),
        ("|u| optimisation", optimiser.u_norm, 2, None),
        ("|u| alternation", ours.u_norm, 3, [d.u_norm for d in draws]),
    ):
        for k, row in TABLE_I.items():
            paper = Figure(*row[place])
            if by_draw is None:
                reason = _optimiser_reason(k, place, stopped)
            else:
                reason = _draw_reason(k, place, paper, np.array([d[k - 1] for d in by_draw]), bounds, two_step)
            cells.append(Cell(f"iteration {k}", column, paper, figure_of(values[k - 1]), reason))
    return tuple(cells)


H_UNREACHED = (
    "no reading reaches Table I's H: .0149 ± .0022 is mean/sd 6.8, where nine isotropic elements allow 4.2 at most; "
    "and in these units u errs by more than H, in the paper by less"
)


def _optimiser_reason(k: int, place: int, stopped: float) -> str:
    if k < 15:
        return (
            "on its way: MATLAB's SQP and SciPy's SLSQP take other steps and the paper's start is open; both blow up "
            "before they converge"
        )
    if k <= 20:
        return f"SciPy's SLSQP is within 1 % after {stopped:.0f} iterations (median), MATLAB's SQP between 20 and 30"
    return H_UNREACHED if place == 0 else "the floor of (25)-(26) in this pose set"


def _draw_reason(
    k: int, place: int, paper: Figure, by_draw: Array, bounds: tuple[float, float, float], two_step: sim_a.Errors
) -> str:
    low, high = short(float(by_draw.min())), short(float(by_draw.max()))
    if by_draw.min() / FACTOR <= paper.mean <= by_draw.max() * FACTOR and k < 15:
        return f"the pose set sets the rate (lambda2): {len(by_draw)} draws give {low} to {high} at iteration {k}"
    if k < 15:
        return (
            f"{len(by_draw)} pose sets give {low} to {high} at iteration {k}: start and pose set of the paper are open"
        )
    if place == 1:
        return f"{H_UNREACHED}; {len(by_draw)} pose sets give means of {low} to {high}"
    paper_rms = math.hypot(paper.mean, paper.sd or 0.0)
    return (
        f"a floor of {low} to {high} in {len(by_draw)} pose sets; the paper's rms {paper_rms:.4f} lies at the "
        f"Cramer-Rao bound of this set ({bounds[2]:.4f}), which two steps ({rms(two_step.u_norm):.4f}) do not reach"
    )


def _within_1_percent(iterates: sim_a.Iterates, world: sim_a.World) -> float:
    """Iterations (median of the runs) after which H and u stay within 1 % of the truth."""
    return float(np.nanmedian(sim_a.iterations_to(iterates, world, 0.01)))


def _text_a(within: Sequence[float], two_step: sim_a.Errors, draws: Sequence[sim_a.Draw]) -> tuple[Cell, ...]:
    percent = two_step.B_percent
    worst = [d.bias_max for d in draws]
    largest = (
        f"the largest of {percent.size} components: 21 pose sets give {short(min(worst))} to {short(max(worst))} "
        "(200 runs each)"
    )
    slower = "the optimiser and its start are not the paper's"
    return (
        Cell("alternation", "iterations to 1 %", Figure(8.0), Figure(within[0]), "the pose set decides"),
        Cell("optimisation", "iterations to 1 %", Figure(15.0, limit="above"), Figure(within[1]), slower),
        Cell("below 0.1 %, per cent of all", "bias error", Figure(93.0), Figure(100 * share_below(percent, 0.1))),
        Cell("largest, %", "bias error", Figure(0.25), Figure(float(np.nanmax(percent))), largest),
    )


def _literal_1(ours: sim_a.Iterates, optimiser: sim_a.Iterates, world: sim_a.World) -> tuple[Cell, ...]:
    stopped = _within_1_percent(optimiser, world.first(optimiser.H_norm.shape[1]))
    in_counts = (
        "in m/s^2 a count ||H_a|| is 0.0392: Table I's floor of .0149 would be an error of 38 % where the text claims "
        "less than 1 %, so the table is in other units"
    )
    rate = float(np.median([sim_a.lambda2(world.R_of(run)) for run in range(min(world.runs, 100))]))
    cells = []
    for column, values, place in (
        ("|H| optimisation", optimiser.H_norm, 0),
        ("|H| alternation", ours.H_norm, 1),
        ("|u| optimisation", optimiser.u_norm, 2),
        ("|u| alternation", ours.u_norm, 3),
    ):
        for k, row in TABLE_I.items():
            if place < 2:
                reason = in_counts
            elif place == 2 and k <= 20:
                reason = _optimiser_reason(k, place, stopped)
            elif k <= 10:
                reason = (
                    f"random attitudes converge faster (lambda2 {rate:.2f}, median) than Table I does: its rows 2 to "
                    "10 fall by a factor .65 to .69 an iteration, lambda2 .31 to .35"
                )
            else:
                reason = "variance 0.1 in raw counts is 4.4 times less noise than the floor of Table I asks for"
            cells.append(Cell(f"iteration {k}", column, Figure(*row[place]), figure_of(values[k - 1]), reason))
    return tuple(cells)


def _ours_a(
    name: str,
    title: str,
    world: sim_a.World,
    errors: dict[str, sim_a.Errors],
    bounds: tuple[float, float, float],
) -> Grid:
    rows = []
    for method, e in errors.items():
        ratio = [rms(v) / b for v, b in zip((e.H_norm, np.linalg.norm(e.B, axis=-1), e.u_norm), bounds)]
        rows.append(
            (
                method,
                summary(e.H_norm).mean,
                summary(e.u_norm).mean,
                summary(e.B_percent).mean,
                100 * share_below(e.B_percent, 0.1),
                float(np.nanmax(e.B_percent)),
                *ratio,
            )
        )
    header = ("", "|dH|", "|du| m/s^2", "bias %", "< 0.1 %", "largest %", "H/bound", "B/bound", "u/bound")
    text = (
        f"mean errors; rms error over the Cramer-Rao bound (H {short(bounds[0])}, B {short(bounds[1])} counts, "
        f"u {short(bounds[2])} m/s^2)",
    )
    return Grid(name, title, header, tuple(rows), text)


def _draws(draws: Sequence[sim_a.Draw]) -> Grid:
    """How far the pose set decides, and one-step against two-step in each."""
    by = {
        "lambda2(M/J)": [d.lambda2 for d in draws],
        "|du| alternation, iteration 2": [float(d.u_norm[1]) for d in draws],
        "|du| alternation, iteration 5": [float(d.u_norm[4]) for d in draws],
        "|du| alternation, iteration 10": [float(d.u_norm[9]) for d in draws],
        "|du| alternation, iteration 50": [float(d.u_norm[-1]) for d in draws],
        "|dH| alternation, iteration 50": [float(d.H_norm[-1]) for d in draws],
        "|du| one-step": [d.one_step_u for d in draws],
        "|du| one-step / two-step": [d.one_step_u / float(d.u_norm[-1]) for d in draws],
        "largest bias error, two-step, %": [d.bias_max for d in draws],
        "largest bias error, one-step / two-step": [d.one_step_bias_max / d.bias_max for d in draws],
    }
    rows = tuple((k, float(np.min(v)), float(np.median(v)), float(np.max(v))) for k, v in by.items())
    better = np.mean(
        [d.one_step_u <= 0.8 * d.u_norm[-1] and d.one_step_bias_max <= 0.5 * d.bias_max for d in draws], dtype=float
    )
    return Grid(
        "draws-a",
        f"How far the pose set decides: {len(draws)} draws of it",
        ("", "least", "median", "most"),
        rows,
        (f"one-step errs by <= .8 x in u and <= .5 x in the largest bias error in {100 * better:.0f} % of the sets",),
    )


def _identities(typical: Array, rng: np.random.Generator) -> Grid:
    rows = []
    for name, R in (("Euler set", typical), ("random set", sim_a.random_set(rng, sim_a.N_POSES))):
        rows.append((name, *(f"{v:.1e}" for v in sim_a.identity_errors(sim_a.fixed_world(R, SIGMA, 20, rng)))))
    return Grid(
        "identities-a",
        "Alternation after 300 iterations against eigen (worst of 20 runs, relative)",
        ("", "u", "H (1 - lambda1)"),
        tuple(rows),
        ("(32) leaves H too large by 1/(1 - lambda1(M/J)): with that taken off, both are the same optimum",),
    )


def _seconds(world: sim_a.World, optimisers: int, work: Work) -> tuple[Table | Grid, ...]:
    spent = sim_a.cpu_seconds(world, work.of(150))
    slow, ours = spent["slsqp, differences"], spent["alternation, 50 iterations"]
    alone = "one run alone is Python's overhead and a covariance that the paper does not compute; in a batch see below"
    cells = (
        Cell("optimisation", "seconds a run", Figure(1.5), Figure(slow), "another machine, another optimiser"),
        Cell("alternation", "seconds a run", Figure(0.05, limit="below"), Figure(ours)),
        Cell("optimisation / alternation", "ratio", Figure(30.0, limit="above"), Figure(slow / ours), alone),
    )
    rows = tuple((name, 1e6 * v, slow / v) for name, v in spent.items())
    grid = Grid(
        "time-a",
        "CPU time of step two, a run (bias given; one-step finds it too)",
        ("", "us", "SLSQP with differences / this"),
        rows,
    )
    paths = []
    for name in ("slsqp", "interior-point", "active-set"):
        found = [sim_a.optimiser_path(name, world, run) for run in range(optimisers)]
        paths.append((name, *(float(np.mean(v)) for v in zip(*found))))
    others = Grid(
        "optimisers-a",
        f"The paper's optimisers from SciPy, scaled variables, exact gradient ({optimisers} runs)",
        ("", "iterations", "CPU s", "|du| m/s^2"),
        tuple(paths),
    )
    return Table("time", "Run times (CPU seconds; change from run to run)", cells), grid, others


def _figure_3(ours: sim_a.Iterates, optimiser: sim_a.Iterates) -> str:
    k = np.arange(1, 31, dtype=float)
    panels = []
    for i, axis in enumerate("xyz"):
        truth = float(sim_a.U_A[i])
        curves = (
            Curve("alternation", k, ours.u[:30, i], BLUE),
            Curve("optimisation (SLSQP)", k, optimiser.u[:30, i], ORANGE, dash="6 3"),
        )
        panels.append(
            Panel(
                f"u_{axis}",
                "iteration",
                "m/s²",
                curves,
                y_range=(-20.0, 20.0),
                lines=((truth, f"truth {truth:.2f}"),),
            )
        )
    return figure("Z-TIE Fig. 3: estimate of u, one run (cut at ±20 m/s²)", panels, width=400)


def _figure_4(ours: sim_a.Iterates, optimiser: sim_a.Iterates, shown: int) -> str:
    k = np.arange(1, 31, dtype=float)
    curves = (
        Curve("alternation", k, ours.H_norm[:30, shown], BLUE),
        Curve("optimisation (SLSQP)", k, optimiser.H_norm[:30, shown], ORANGE, dash="6 3"),
    )
    papers = Curve(
        "alternation, Table I",
        np.array([i for i in TABLE_I if i <= 30], dtype=float),
        np.array([row[1][0] for i, row in TABLE_I.items() if i <= 30]),
        GREY,
        dots=True,
        line=False,
    )
    panel = Panel("error of H, one run", "iteration", "‖H − Ĥ‖ in units of S", (*curves, papers), log=True)
    return figure("Z-TIE Fig. 4: convergence of H", [panel], width=620)


def _figure_5(two_step: sim_a.Errors, one_step: sim_a.Errors) -> str:
    below = 100 * share_below(two_step.B_percent, 0.1)
    note = f"below 0.1 %: {below:.1f} % (paper 93 %); largest {np.nanmax(two_step.B_percent):.2f} % (paper 0.25 %)"
    panel = histogram(
        "",
        "error of a component of the bias, %",
        two_step.B_percent,
        bins=25,
        upto=0.25,
        note=note,
        label="two-step (ellipsoid)",
        compare=("one-step", one_step.B_percent, ORANGE),
    )
    return figure("Z-TIE Fig. 5: errors of the combined bias", [panel], width=620)
