"""The usual mistakes in applying ``u = H (y - B)``, each as the affine map ``v = A y + c`` that it amounts to.

They are what users of every calibration tool ask about: whose sign, whose order, whose unit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from margcal.core.types import Array, Kind, SensorModel
from margcal.core.units import STANDARD_GRAVITY
from margcal.workflow.job import NAMES

WORDS = {
    "bias-sign": "the sign of the bias is wrong: B was added, H (y + B)",
    "transposed": "H was transposed, rows taken for columns: H^T (y - B)",
    "forward": "the forward matrix was used as correction: H^-1 (y - B)",
    "post-offset": "B was subtracted after H, in the post-offset form: H y - B (the offset of that form is H B)",
    "bias-left-out": "B was left out: H y",
    "forward-model": "the forward model was applied to a raw reading: H^-1 y + B",
    "post-offset-sign": "B was added after H: H y + B",
    "raw": "nothing was applied: these are the raw readings",
}
"""What each mistake is called, and what was done instead of H (y - B); the four commonest first."""

_DEG = 180 / np.pi

UNIT_WORDS: dict[Kind, dict[str, float]] = {
    "acc": {
        "the numbers are in g": 1 / STANDARD_GRAVITY,
        "the numbers are in mg": 1e3 / STANDARD_GRAVITY,
        "the numbers were multiplied by g once too often": STANDARD_GRAVITY,
    },
    "gyr": {
        "the numbers are in degrees per second": _DEG,
        "the numbers are in mdps": 1e3 * _DEG,
        "the numbers were converted from degrees once too often": 1 / _DEG,
    },
    "mag": {
        "the numbers are in gauss": 1e-2,
        "the numbers are in mgauss": 10.0,
        "the numbers are in nT": 1e3,
        "the numbers are in tesla": 1e-6,
        "the numbers were converted from gauss once too often": 1e2,
    },
}
"""The numbers of a wrong unit over the right ones, SI being what the columns state."""


@dataclass(frozen=True)
class Suspect:
    """One way in which readings may have been turned into the recording: ``v = A y + c``.

    `mistakes` holds the names of what is wrong with it, none for the right way; `text` says it in words.
    """

    mistakes: tuple[str, ...]
    text: str
    A: Array
    c: Array

    def of(self, y: Array) -> Array:
        return y @ self.A.T + self.c

    def mending(self, model: SensorModel) -> tuple[Array, Array]:
        """G (3, 3) and g (3,) that turn what this way gave into the right vector: ``u = G v + g``."""
        if not self.mistakes:
            return np.eye(3), np.zeros(3)
        back = np.linalg.inv(self.A)
        return model.H @ back, -model.H @ (back @ self.c + model.B)


def formula(name: str, model: SensorModel) -> tuple[Array, Array]:
    """A and c of the mistake `name`, '' for the right way."""
    H, B = model.H, model.B
    K = np.linalg.inv(H)
    return {
        "": (H, -H @ B),
        "bias-sign": (H, H @ B),
        "transposed": (H.T, -H.T @ B),
        "forward": (K, -K @ B),
        "post-offset": (H, -B),
        "bias-left-out": (H, np.zeros(3)),
        "forward-model": (K, B),
        "post-offset-sign": (H, B),
        "raw": (np.eye(3), np.zeros(3)),
    }[name]


def suspects(models: Mapping[Kind, SensorModel], kind: Kind, *, everything: bool = True) -> list[Suspect]:
    """Ways to apply the model of `kind`, the right one first, then the commonest mistakes.

    `everything`: also rarer ones: swapped or flipped axes, and the numbers of another sensor of the node.
    """
    model = models[kind]
    units = {"": 1.0} if model.unit == "norm" else {"": 1.0, **UNIT_WORDS[kind]}
    out = []
    for name, (unit, factor) in product(["", *WORDS], units.items()):
        A, c = formula(name, model)
        mistakes = tuple(m for m in (name, "unit" if unit else "") if m)
        text = "; ".join(t for t in (WORDS.get(name, ""), unit and f"{unit}, the columns say {model.unit}") if t)
        out.append(Suspect(mistakes, text, factor * A, factor * c))
    out.sort(key=lambda s: len(s.mistakes))  # stable: one mistake before two
    if everything:
        out += [*_swapped(model), *_of_others(models, kind)]
    return out


def signed_axes() -> list[tuple[str, Array]]:
    """The 47 ways to swap or flip axes, by name: what stands in x, y and z."""
    out = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            P = np.zeros((3, 3))
            P[np.arange(3), order] = signs
            if not np.array_equal(P, np.eye(3)):
                out.append((" ".join(f"{'+' if s > 0 else '-'}{'xyz'[k]}" for k, s in zip(order, signs)), P))
    return out


def _swapped(model: SensorModel) -> list[Suspect]:
    out = []
    for name, P in signed_axes():
        after = f"the axes of the result are swapped or flipped: x, y, z hold {name}"
        before = f"the axes of the raw reading were swapped or flipped before H: x, y, z hold {name}"
        out.append(Suspect(("axes",), after, P @ model.H, -P @ model.H @ model.B))
        out.append(Suspect(("axes",), before, model.H @ P, -model.H @ model.B))
    return out


def _of_others(models: Mapping[Kind, SensorModel], kind: Kind) -> list[Suspect]:
    return [
        Suspect(("other-sensor",), f"H and B of the {NAMES[other]} were used", m.H, -m.H @ m.B)
        for other, m in models.items()
        if other != kind
    ]
