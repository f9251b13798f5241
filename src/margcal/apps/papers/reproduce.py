"""`margcal reproduce`: a paper's tables beside ours, on the screen and in a folder."""

from __future__ import annotations

import json
from pathlib import Path

from margcal.apps import screen
from margcal.apps.outputs import check_outputs
from margcal.apps.papers import tables

PAPERS = {"z-tie": 1000, "zy-tbme": 1000, "r-bsn": 10, "effect": 2}
"""Papers and the runs of each where nothing is said; a run of R-BSN is three nodes of three trials, one of `effect` a
corrupted node in each of eight trials."""


def run(paper: str, *, runs: int | None, seed: int, output: str | None, overwrite: bool, as_json: bool) -> int:
    """The verb; `paper` is one of `PAPERS`."""
    from margcal.files.atomic import atomic_folder

    check_outputs([output], [], overwrite)
    with screen.progress(f"reproducing {paper}") as tick:
        if paper == "z-tie":
            from margcal.apps.papers.z_tie import reproduce
        elif paper == "r-bsn":
            from margcal.apps.papers.r_bsn import reproduce
        elif paper == "effect":
            from margcal.apps.papers.effect import reproduce
        else:
            from margcal.apps.papers.zy_tbme import reproduce
        result = reproduce(PAPERS[paper] if runs is None else runs, seed, tick)
    if output is not None:
        with atomic_folder(output, overwrite=overwrite) as folder:
            tables.write(result, folder)
    if as_json:
        print(json.dumps(tables.as_plain(result), indent=1, ensure_ascii=False, allow_nan=False))
        return 0
    tables.show(result)
    screen.line()
    if output is None:
        screen.line("nothing was written (-o DIR keeps the tables and draws the figures)")
    else:
        screen.line(f"written to {Path(output)}: {', '.join(tables.file_names(result))}")
    return 0
