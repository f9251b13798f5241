"""What `inspect` says of a recording: one `Finding` for each thing that was looked at, passed ones too."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from margcal.core.types import Issue, Kind
from margcal.core.units import KINDS

Grade = Literal["pass", "note", "warn", "fail"]
ORDER: tuple[Grade, ...] = ("fail", "warn", "note", "pass")

CHECK_OF = {
    "too-short": "readings",
    "nan-rows": "readings",
    "missing-rows": "readings",
    "infinite": "readings",
    "stuck-sensor": "alive",
    "stuck-axis": "alive",
    "stuck-stretch": "alive",
    "frozen-samples": "alive",
    "saturated": "range",
    "coarse-quantisation": "resolution",
    "gaps": "clock",
    "bursty-clock": "clock",
    "rate-changes": "clock",
    "slow-rate": "clock",
    "no-overlap": "clock",
    "little-overlap": "clock",
    "acc-unit": "unit",
    "gyr-unit": "unit",
    "mag-unit": "unit",
    "acc-magnitude": "unit",
    "mag-magnitude": "unit",
    "no-gravity": "unit",
    "looks-calibrated": "calibrated",
}
"""The check that a code of `lint` belongs to; any other code is a check of its own."""


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at.

    Attributes
    ----------
    check : str
        What was looked at, kebab-case: ``unit``, ``range``, ``clock``, ``rests``, ``axes`` ...
    level : {'pass', 'note', 'warn', 'fail'}
    text : str
        What was found.
    sensor : {'acc', 'gyr', 'mag'} or None
    value, limit : float or None
        The figure and what it was held against, in `unit`.
    unit : str
    todo : str
        What to do about it, or to record next; empty where nothing is to be done.
    """

    check: str
    level: Grade
    text: str
    sensor: Kind | None = None
    value: float | None = None
    limit: float | None = None
    unit: str = ""
    todo: str = ""


def from_issue(issue: Issue) -> Finding:
    """An `Issue` of lint, segmentation or reader; its text says what to do already."""
    sensor = issue.sensor
    for kind in KINDS:
        if sensor is None and issue.code.startswith(f"{kind}-"):
            sensor = kind
    check = CHECK_OF.get(issue.code, issue.code)
    return Finding(check, issue.level, issue.text, sensor, issue.value, issue.limit)


def graded(good: bool, otherwise: Grade) -> Grade:
    return "pass" if good else otherwise
