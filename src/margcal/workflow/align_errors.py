"""What a calibration gains: the orientation that a filter makes of the readings before and after, against the optics.

Before: the readings as they are, in their unit's SI value, raw axes taken for those of the marker body and the
laboratory taken for the earth (the paper's dashed lines). After: calibrated, delays corrected, with C^b and C^n. The
clock relation is used for both, since without it nothing can be compared.
"""

from __future__ import annotations

from dataclasses import replace
from importlib.util import find_spec

import numpy as np

from margcal.core import so3
from margcal.core.errors import MargcalError
from margcal.core.types import Array, Attitude, Calibration, Issue
from margcal.core.units import UNITS
from margcal.methods.filters import DEFAULT
from margcal.methods.reference_rates import attitude_at
from margcal.workflow.align_job import AlignJob, AlignSolved, OrientationErrors, thinned
from margcal.workflow.evaluate import error_angles
from margcal.workflow.orient import orient

SETTLE_S = 5.0
"""Left out at the start, while the filter settles."""
NEEDED = {"acc", "gyr", "mag"}


def orientation_errors(
    job: AlignJob, solved: AlignSolved, calibration: Calibration
) -> tuple[OrientationErrors | None, OrientationErrors | None, list[Issue]]:
    """Orientation error before and after, and what to know about it."""
    if not set(calibration.models) >= NEEDED or solved.R_nm is None or solved.R_kh is None:
        return None, None, []
    chosen = "vqf-offline" if find_spec("vqf") else DEFAULT
    try:
        found = orient(job.raw, calibration, filter=chosen).attitude
        text = f"calibrated, delays corrected, frames aligned ({chosen})"
        after = _judged(job, found, text, solved.R_nm, solved.R_kh)
        before = None
        if all(UNITS[k].get(job.raw.streams[k].unit) is not None for k in ("acc", "gyr")):
            raw = job.raw
            if UNITS["mag"].get(raw.streams["mag"].unit) is None:  # its size does not matter to a filter
                raw = replace(raw, mag=replace(raw.streams["mag"], unit="uT"))
            found = orient(raw, None, filter=chosen, delays="none").attitude
            text = f"readings as they are, raw axes as the marker body's, laboratory as the earth ({chosen})"
            before = _judged(job, found, text, np.eye(3), np.eye(3))
    except MargcalError as error:
        return None, None, [Issue("no-orientation", "note", f"the orientation error was not found: {error}")]
    if after is None:
        return None, None, []
    return before, after, [_told(before, after, chosen)]


def _told(before: OrientationErrors | None, after: OrientationErrors, chosen: str) -> Issue:
    text = f"orientation error ({chosen}) with the calibration {after.total:.2f} degrees rms"
    if before is not None:
        text += f", without {before.total:.2f} (heading {before.heading:.2f} and {after.heading:.2f}, inclination "
        text += f"{before.inclination:.2f} and {after.inclination:.2f})"
    return Issue("orientation-error", "note", text, None, after.total)


def _judged(job: AlignJob, found: Attitude, text: str, R_nm: Array, R_kh: Array) -> OrientationErrors | None:
    t = job.sync.reference_time(found.t)
    R = R_nm @ attitude_at(job.reference, t) @ R_kh
    seen = np.isfinite(R).all(axis=(1, 2)) & np.isfinite(found.q).all(axis=1) & (found.t > found.t[0] + SETTLE_S)
    if np.count_nonzero(seen) < 100:
        return None
    total, heading, inclination = (np.degrees(a) for a in error_angles(found.q[seen], so3.quat_from_matrix(R[seen])))
    return OrientationErrors(_rms(total), _rms(heading), _rms(inclination), thinned(t[seen]), thinned(total), text)


def _rms(x: Array) -> float:
    return float(np.sqrt(np.mean(x**2)))
