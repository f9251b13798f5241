"""`margcal report`: a calibration file, and how it does on recordings, as one HTML page."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from margcal.apps import screen
from margcal.apps.calibrating import read_one
from margcal.apps.outputs import check_outputs
from margcal.apps.revisit import revisit
from margcal.files.calfile import load


def run(
    calibration: str,
    recordings: Sequence[str],
    *,
    output: str,
    overwrite: bool,
    as_json: bool,
    reading: Mapping[str, Any],
) -> int:
    """The verb."""
    from margcal.apps.report import write_report

    check_outputs([output], [calibration, *recordings], overwrite)
    shown = load(calibration)
    if recordings:
        shown = revisit(shown, tuple(read_one(path, reading) for path in recordings))
    with screen.progress("writing the report"):
        write_report(shown, output, overwrite=overwrite)
    residuals = {k: {"rms": m.residual_rms, "n_poses": m.n_poses} for k, m in shown.models.items()}
    if as_json:
        print(json.dumps({"written": output, "residuals": residuals}, indent=2))
        return 0
    if recordings:
        from margcal.apps.printing import show_residuals

        if shown.fits:
            show_residuals(shown)
        else:
            screen.line("no rests of a calibrated sensor in the recordings: nothing to hold the calibration against")
    screen.line(f"written: {output}")
    return 0
