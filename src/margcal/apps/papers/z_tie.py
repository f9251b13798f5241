"""Z.-Q. Zhang, "Two-step calibration methods for miniature inertial and magnetic sensor units" (Z-TIE), section III.

The paper's figures as they are printed (`z_tie_printed`) and ours beside them, in the paper's order: III.A, Figs. 3, 4,
5 and Table I (`z_tie_tables_a`), III.B, Fig. 6 and Table II (`z_tie_tables_b`). What is simulated is in
`z_tie_simulation_a` and `z_tie_simulation_b`.

What the paper leaves open (pose set, unit of the noise, norm, start) is chosen once, for reasons that stand beside the
choice, and printed; a second block reads the text literally. Nothing is tuned to a cell.
"""

from __future__ import annotations

import numpy as np

from margcal.apps.papers import z_tie_tables_a as part_a
from margcal.apps.papers import z_tie_tables_b as part_b
from margcal.apps.papers.tables import Reproduction, Tick, Work

CITATION = "Z-TIE: Z.-Q. Zhang, IEEE Trans. Ind. Electron. 62(6), 2015"


def reproduce(runs: int = 1000, seed: int = 0, tick: Tick | None = None) -> Reproduction:
    """All of section III.A and III.B; the same `runs` and `seed` give the same figures.

    Parameters
    ----------
    runs : int
        Of each simulation; the optimisers, which are not vectorised, get a fifth of them (at least ten).
    """
    few = min(runs, max(10, runs // 5))
    work = Work(tick, 14 * runs + 60 * few * 2 + 40 * runs + 40 * few + 30 * (runs + 2 * few) + 2000)
    streams = np.random.default_rng(seed).spawn(6)
    a = part_a.tables(runs, few, streams[:3], work)
    b = part_b.tables(runs, few, streams[3:], work)
    return Reproduction(
        "z-tie", CITATION, runs, seed, (*a.tables, *b.tables), {**a.pictures, **b.pictures}, (*a.seconds, *b.seconds)
    )
