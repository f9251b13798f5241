"""A plan's attitudes and turns in words that a person at a table can follow."""

from __future__ import annotations

from functools import cache

import numpy as np

from margcal.core import so3
from margcal.core.types import Array

BY_EYE = np.radians(5.0)
"""A turn by hand is no better than this: nearer ones are called by the same name."""


def side(v: Array) -> str:
    """A direction in housing axes in words: ``+z``, ``+x -z edge``, ``+x +y -z corner``."""
    order = np.argsort(-np.abs(v))
    names = [f"{'+' if v[k] > 0 else '-'}{'xyz'[k]}" for k in order if abs(v[k]) > 0.38]
    return names[0] if len(names) == 1 else f"{' '.join(sorted(names, key=lambda s: s[1]))} {_KIND[len(names)]}"


_KIND = {2: "edge", 3: "corner"}


def turn_words(turn: Array) -> str:
    """How to turn the housing: about its own axes, a quarter or half at a time where that does it."""
    angle = float(np.linalg.norm(turn))
    if angle < np.radians(1.0):
        return "none"
    quarters = _by_quarters(so3.exp(turn))
    if quarters is not None:
        return ", then ".join(quarters)
    axis = turn / angle
    name = " ".join(f"{a + 0.0:.1f}" for a in np.round(axis, 1))
    return f"{np.degrees(angle):.0f} degrees about ({name})"


def _by_quarters(R: Array) -> list[str] | None:
    """One or two quarter or half turns about the housing's own axes that make `R`, the fewest first."""
    for words, made in _by_hand():
        if so3.angle_between(made, R) < BY_EYE:
            return words
    return None


@cache
def _by_hand() -> list[tuple[list[str], Array]]:
    single = []
    for angle, word in ((np.pi / 2, "quarter turn about"), (np.pi, "half turn about")):
        for k in range(3):
            for sign in (1, -1) if angle < 3 else (1,):
                axis = sign * angle * np.eye(3)[k]
                single.append((f"{word} {'-' if sign < 0 else '+'}{'xyz'[k]}", so3.exp(axis)))
    double = [([a, b], A @ B) for a, A in single for b, B in single]
    return [([a], A) for a, A in single] + double
