"""How the answer moves when each rest is left out: bars by rest, with the expected error across."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from margcal.apps.report_bars import Bars, bar_row, bar_title
from margcal.apps.report_data import left_out, magnitude, residuals
from margcal.apps.report_text import NAMES, degrees, number
from margcal.core.types import Array, Calibration, Kind
from margcal.methods.uncertainty import shift_deg

MAX_RESTS = 240


@dataclass(frozen=True)
class Influence:
    """By how much (degrees, rms over the sphere) leaving out each rest turns a sensor's directions.

    `index` (n,) the rests, counted from 0; `expected` the expected error, degrees; `out` the numbers of the rests
    whose reading or attitude counts for nothing already.
    """

    kind: Kind
    value: Array
    index: NDArray[np.intp]
    expected: float | None
    out: frozenset[int]

    @property
    def largest(self) -> int:
        """Number of the most influential rest, counted from 1."""
        return int(self.index[np.argmax(self.value)]) + 1


def influences(calibration: Calibration) -> list[Influence]:
    """Of each sensor whose fit tells it."""
    labels = {t[0] for t in left_out(calibration, "label-left-out")}
    found = []
    for kind, fit in calibration.fits.items():
        model, shift = calibration.models.get(kind), np.asarray(fit.details.get("leave_one_out", ()), dtype=np.float64)
        if model is None or shift.ndim != 2 or shift.shape[1:] != (12,):
            continue
        index = np.flatnonzero(np.isfinite(shift).all(axis=1))
        if not len(index):
            continue
        value = shift_deg(kind, model.H, shift[index], magnitude(calibration, model))
        found.append(
            Influence(kind, value, index, model.expected_error_deg, frozenset(labels | _gone(calibration, kind)))
        )
    return sorted(found, key=lambda f: list(calibration.models).index(f.kind))


def _gone(calibration: Calibration, kind: Kind) -> set[int]:
    """Rests at which this sensor's reading was left out."""
    found = None if kind == "gyr" else residuals(calibration, kind)
    if found is None or found.by != "rest":
        return set()
    return {int(label) for label, out in zip(found.labels, found.out) if out}


def influence(found: list[Influence]) -> str:
    """The most influential rest in a sentence, and a row of bars for each sensor."""
    return _most(found) + "".join(map(_figure, found))


def _times(f: Influence) -> float:
    return float(f.value.max()) / f.expected if f.expected else 0.0


def _most(found: list[Influence]) -> str:
    known = [f for f in found if f.expected]
    if not known:
        return ""
    most = max(known, key=_times)
    moved, times = degrees(float(most.value.max())), _times(most)
    text = (
        f"<strong>Most influential: rest {most.largest}.</strong> Without it, directions of the {NAMES[most.kind]} "
        f"turn by {moved} rms, {number(times, 2)} times the expected error"
    )
    text += (
        ": the answer does not hang on any single rest."
        if times <= 1
        else ": the answer leans on it. More rests near that attitude would share the burden."
    )
    return f"<p>{text}</p>"


def _figure(f: Influence) -> str:
    text = f"<strong>{NAMES[f.kind].capitalize()}</strong>, degrees rms over the sphere"
    text += f"; expected error {degrees(f.expected)} (dashed)" if f.expected else ""
    gone = sorted(f.out & set((f.index + 1).tolist()))
    if gone:
        text += f"; hollow: rest {', '.join(map(str, gone))}, left out in part already"
    return f'<figure class="residual"><figcaption>{text}.</figcaption>{_bars(f, set(gone))}</figure>'


def _bars(f: Influence, gone: set[int]) -> str:
    n = min(len(f.index), MAX_RESTS)
    labels = [str(i + 1) for i in f.index[:n].tolist()]
    held = np.array([int(label) in gone for label in labels], dtype=bool)
    notes = ["left out in part already" if h else "" for h in held]
    titles = [bar_title("without rest", t, v, "°", note) for t, v, note in zip(labels, f.value.tolist(), notes)]
    bars = Bars(f.value[:n], labels, titles, int(np.argmax(f.value[:n])), f.expected, held, np.zeros(n, dtype=bool))
    return bar_row(bars, f"How far the {NAMES[f.kind]} moves without each rest, in degrees")
