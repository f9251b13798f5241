"""The orientation filters by name: how to make one, start it and run it. `tracking` says what they have in common."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from margcal.core.errors import UsageError
from margcal.core.units import STANDARD_GRAVITY
from margcal.methods import ekf_quest, strapdown, vector_selection, vqf_filter
from margcal.methods.tracking import Track

DEFAULT = "vector-selection"
"""Of our own filters the better one on every kind of motion that was measured, the cheaper one, the same to the last
digit wherever it runs, and there without any further package. `vqf-offline` is better where the gyroscope's bias
changes on the way; it is a package of its own, so it is asked for and not fallen into."""


class Surroundings(NamedTuple):
    """What a filter is told of the place and the recording: specific force at rest (m/s^2), length of the field (unit
    of `mag`), dip (rad) and the sampling period (s)."""

    gravity: float = STANDARD_GRAVITY
    field: float = 49.0
    dip: float = 1.15
    period: float = 0.01


class Filter(NamedTuple):
    """One filter.

    Attributes
    ----------
    name, text : str
    params : callable (Surroundings) -> Params
    start : callable (q, sd) -> State
    step : callable (params, state, dt, gyr, acc, mag) -> State, or None where all samples are needed at once
    batch : callable (params, state, dt, gyr, acc, mag) -> Track
    own_bias : bool
        It estimates the gyroscope's bias by itself.
    corrects : bool
        It looks at accelerometer and magnetometer.
    """

    name: str
    text: str
    params: Callable[[Surroundings], Any]
    start: Callable[..., Any]
    step: Callable[..., Any] | None
    batch: Callable[..., Track]
    own_bias: bool = False
    corrects: bool = True


MISSED = 2.5
"""Usual steps without a sample that are a gap where the sensor is slow; at 10 Hz and above a quarter of a second is."""

LONGEST = 0.9
"""Seconds beyond which a rate says so little of the turn since the last one that a filter which corrects does better
without it."""


def _gap(s: Surroundings) -> float:
    return min(max(strapdown.Params().gap, MISSED * s.period), LONGEST)


def _of_place(kind: Any) -> Callable[[Surroundings], Any]:
    return lambda s: kind(gravity=s.gravity, field=s.field, dip=s.dip, gap=_gap(s))


def _vqf_params(s: Surroundings) -> vqf_filter.Params:
    return vqf_filter.Params(period=s.period, gap=_gap(s))


FILTERS: dict[str, Filter] = {
    f.name: f
    for f in (
        Filter(
            "vector-selection",
            "quaternion Kalman filter that selects its vectors (Zhang et al. 2012, a reconstruction)",
            _of_place(vector_selection.Params),
            vector_selection.start,
            vector_selection.step,
            vector_selection.batch,
        ),
        Filter(
            "ekf-quest",
            "rates and quaternion, fed with QUEST (R-BSN; Yun & Bachmann 2006)",
            _of_place(ekf_quest.Params),
            ekf_quest.start,
            ekf_quest.step,
            ekf_quest.batch,
        ),
        Filter(
            "gyro",
            "the gyroscope alone, integrated",
            lambda s: strapdown.Params(gap=max(strapdown.Params().gap, MISSED * s.period)),
            strapdown.start,
            strapdown.step,
            strapdown.batch,
            corrects=False,
        ),
        Filter(
            "vqf",
            "VQF of Laidig & Seel 2023, online (package vqf)",
            _vqf_params,
            vqf_filter.start,
            vqf_filter.step,
            vqf_filter.batch,
            own_bias=True,
        ),
        Filter(
            "vqf-offline",
            "VQF forwards and backwards (package vqf)",
            _vqf_params,
            vqf_filter.start,
            None,
            vqf_filter.batch_offline,
            own_bias=True,
        ),
    )
}
"""Every filter by its name, the default first."""


def find_filter(name: str) -> Filter:
    """The filter `name`; a `UsageError` lists them all if there is none."""
    if name not in FILTERS:
        raise UsageError(f"there is no filter {name!r}; choose one of {', '.join(FILTERS)}")
    return FILTERS[name]
