"""The magnetometer's delay behind the gyroscope, from the turns of a session of rests (no optics: ``m' = -w x m``)."""

from __future__ import annotations

import numpy as np

from margcal.core.errors import DataError
from margcal.core.types import Issue
from margcal.methods.rates import relate
from margcal.workflow.job import Job, Solved

LARGEST_SE_S = 1.5e-3
"""A delay that is known no better is not kept."""
CLEAR, SMALLEST_S = 4.0, 1e-3
"""Standard errors and seconds from which it is one: `apply` interpolates, which costs a little noise."""
EXPLAINED = 0.9
"""Share of the field's changes that the calibrated gyroscope must account for: healthy sessions reach 0.98."""


def keep_magnetometer_delay(job: Job, solved: Solved) -> None:
    """Put the delay into `solved` where the motion of one of the recordings tells it clearly."""
    mag, gyr = solved.fits.get("mag"), solved.fits.get("gyr")
    if mag is None or gyr is None or "mag" in solved.delays:
        return
    best: tuple[float, float] | None = None
    for recording in job.recordings:
        field, rate = recording.mag, recording.gyr
        if field is None or rate is None:
            continue
        v = mag.model.apply(field.y) / job.options.magnitude["mag"]
        seen, moved = np.isfinite(v).all(axis=1), np.isfinite(rate.y).all(axis=1)
        try:
            found = relate(field.t[seen], v[seen], rate.t[moved], gyr.model.apply(rate.y[moved]))
        except DataError:
            continue
        told = found.explained >= EXPLAINED and found.delay_se_s <= LARGEST_SE_S
        if told and (best is None or found.delay_se_s < best[1]):
            best = (found.delay_s, found.delay_se_s)
    if best is not None and abs(best[0]) > max(CLEAR * best[1], SMALLEST_S):
        solved.delays["mag"] = best
        late, se = 1e3 * best[0], 1e3 * best[1]
        where = "behind" if late > 0 else "ahead of"
        text = (
            f"magnetometer: {abs(late):.1f} +- {se:.1f} ms {where} the gyroscope, told by the "
            "motion; margcal apply and margcal orient correct it, H and B do not depend on it"
        )
        solved.issues.append(Issue("mag-delay", "note", text, "mag", best[0]))
