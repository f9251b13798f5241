"""`verify` without the raw recording: which of the usual mistakes, once undone, makes sense of the rests and turns.

Rests and turns are found in the recording as it is: what is still stays still under any affine map. For every
combination of mistakes of the sensors (undone by ``u = G v + g``, see `verify_mistakes.Suspect.mending`) seven figures
are taken, each in units of what a right calibration leaves in practice (`USUAL`):

- length of the specific force at rest: its scatter over the rests, and its mean against g;
- length of the field at rest: its scatter, and its mean against the file's;
- rate at rest;
- angle between specific force and field: its scatter over the rests;
- turns: angle by which specific force and field, carried through a turn by the gyroscope, miss those after it.

Their root mean square is the misfit. The mistake is named only where the misfit as recorded is above `DOUBTFUL`, is
brought down by `CLEARLY`, and no simpler or other combination does nearly as well. Scatter that no mistake explains
(a field that changes about the room, a sensor that aged) is in both misfits and keeps their ratio near one: it
accuses nobody.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np

from margcal.core.errors import DataError
from margcal.core.types import Array, Calibration, Issue, Kind, Recording, Stream
from margcal.methods.preintegration import integrate, pad
from margcal.workflow.job import NAMES
from margcal.workflow.segment import Segmentation, find_poses
from margcal.workflow.verify import Finding, Verification, magnitude
from margcal.workflow.verify_mistakes import WORDS, Suspect, suspects

FEWEST_RESTS = 4

USUAL: dict[str, float] = {
    "length of the specific force, scatter, %": 0.15,
    "length of the specific force, mean, %": 1.0,
    "length of the field, scatter, %": 0.5,
    "length of the field, mean, %": 10.0,
    "rate at rest, deg/s": 0.25,
    "angle between force and field, scatter, deg": 0.25,
    "specific force after a turn, deg": 0.5,
    "field after a turn, deg": 0.5,
}
"""What a right calibration leaves in practice, one standard deviation."""

DOUBTFUL = 2.0
"""Misfit of the recording as it is below which nothing is suspected."""

HINT = 1.0
"""Misfit above which a clearly better combination is mentioned, though nobody is accused."""

CLEARLY = 2.5
"""By how much undoing a mistake must lower the misfit before it is named."""

ALIKE = 1.3
"""Misfits within this factor of the least are not told apart; the simplest is taken, if there is one."""

EQUIVALENT = 0.01
"""Relative difference up to which two mistakes are one."""

GROSS = 10.0
"""Misfit from which the recording is said to disagree even where no mistake explains it."""

RANK = {name: k for k, name in enumerate([*WORDS, "unit"])}

POSSIBLE: dict[Kind, tuple[float, float]] = {"acc": (0.5, 2.0), "mag": (0.3, 3.0), "gyr": (-1.0, 1.0)}
"""Length at rest relative to the sensed vector's (gyroscope: rad/s) that can be true at all."""

LEAST_TURN = np.radians(10.0)
"""Turns of directions below this tell nothing of the gyroscope."""


@dataclass(frozen=True)
class _Tried:
    """One sensor with one suspect undone: vectors at rest (J, 3), and for the gyroscope the turns (T, 3, 3)."""

    way: Suspect
    rest: Array
    turns: Array | None = None


@dataclass(frozen=True)
class _Judged:
    ways: dict[Kind, Suspect]
    figures: dict[str, float]
    misfit: float

    @property
    def simplicity(self) -> tuple[float, ...]:
        """Few kinds of mistake before many: one that all sensors share is one mistake."""
        named = [set(w.mistakes) for w in self.ways.values() if w.mistakes]
        return len(set().union(*named)) if named else 0, len(named)

    @property
    def rarity(self) -> int:
        """Common mistakes before rare ones."""
        return sum(RANK[m] for w in self.ways.values() for m in w.mistakes)


def verify_rests(calibration: Calibration, streams: Mapping[Kind, Stream], recording: Recording) -> Verification:
    """The case without raw readings of `verify`; `streams` are the recording's sensors in the calibration's units."""
    found = find_poses(Recording(**dict(streams), source=recording.source))  # type: ignore[arg-type]
    if len(found.poses) < FEWEST_RESTS:
        raise DataError(
            f"{recording.source}: {len(found.poses)} rests of a second or longer, {FEWEST_RESTS} are needed to tell "
            "how the calibration was applied; record the node at rest in several attitudes, or give the raw recording "
            "(--raw)"
        )
    as_it_is, *every = _combinations(calibration, {k: _tried(calibration, k, found) for k in streams}, found)
    findings, chosen = _decide(calibration, as_it_is, every, streams)
    figures = {n: (v, chosen.figures.get(n, np.nan), 3 * USUAL[n]) for n, v in as_it_is.figures.items()}
    return Verification("rests", findings, figures, _issues(findings, found))


# --- every suspect undone -----------------------------------------------------------------------------


def _tried(calibration: Calibration, kind: Kind, found: Segmentation) -> list[_Tried]:
    """The right way, and the suspects whose undoing gives readings at rest of a size that can be."""
    model, v, length = calibration.models[kind], found.poses.mean[kind], magnitude(calibration, kind)
    batch = pad(found.turns) if kind == "gyr" and found.turns else None
    out = []
    for way in suspects(calibration.models, kind, everything=False):
        G, g = way.mending(model)
        rest = v @ G.T + g
        low, high = POSSIBLE[kind]
        if not out or low < float(np.nanmedian(np.linalg.norm(rest, axis=1))) / length < high:
            turns = None if batch is None else integrate(batch.y, batch.dt, G, -np.linalg.solve(G, g))
            out.append(_Tried(way, rest, turns))
    return out


def _combinations(calibration: Calibration, tried: Mapping[Kind, list[_Tried]], found: Segmentation) -> list[_Judged]:
    """Every combination of the suspects, the right one of all sensors first.

    A figure depends on one sensor or two, so all are computed before the combinations are formed.
    """
    kinds = list(tried)
    figures: dict[tuple[Kind, ...], dict[tuple[int, ...], dict[str, float]]] = {}
    for group in [*((k,) for k in kinds), *combinations(kinds, 2)]:
        numbers = product(*(range(len(tried[k])) for k in group))
        figures[group] = {n: _figures(calibration, {k: tried[k][i] for k, i in zip(group, n)}, found) for n in numbers}
    out = []
    for number in product(*(range(len(tried[k])) for k in kinds)):
        at = dict(zip(kinds, number))
        here = {n: v for group, table in figures.items() for n, v in table[tuple(at[k] for k in group)].items()}
        squares = [(v / USUAL[n]) ** 2 for n, v in here.items()]
        misfit = math.sqrt(sum(squares) / len(squares)) if squares else 0.0
        out.append(_Judged({k: tried[k][i].way for k, i in at.items()}, here, misfit))
    return out


# --- figures ------------------------------------------------------------------------------------------


def _figures(calibration: Calibration, tried: Mapping[Kind, _Tried], found: Segmentation) -> dict[str, float]:
    """What one sensor, or two together, say."""
    match tuple(tried):
        case ("gyr",):
            out = {"rate at rest, deg/s": np.degrees(np.sqrt(np.nanmean(np.sum(tried["gyr"].rest ** 2, axis=1))))}
        case (("acc" | "mag") as kind,):
            out = _lengths(calibration, kind, tried[kind].rest)
        case ("acc", "mag"):
            angle = _angle(tried["acc"].rest, tried["mag"].rest)
            out = {"angle between force and field, scatter, deg": np.degrees(np.nanstd(angle, ddof=1))}
        case ("acc", "gyr"):
            out = _missed(tried["acc"].rest, tried["gyr"].turns, found, "specific force after a turn, deg")
        case _:
            out = _missed(tried["mag"].rest, tried["gyr"].turns, found, "field after a turn, deg")
    return {n: float(v) for n, v in out.items() if np.isfinite(v)}


def _lengths(calibration: Calibration, kind: Kind, rest: Array) -> dict[str, float]:
    name = "specific force" if kind == "acc" else "field"
    length = np.linalg.norm(rest, axis=1)
    mean = float(np.nanmean(length))
    out = {f"length of the {name}, scatter, %": 100 * float(np.nanstd(length, ddof=1)) / mean}
    if kind == "acc" or calibration.models[kind].reference_vector is not None:
        out[f"length of the {name}, mean, %"] = 100 * abs(mean / magnitude(calibration, kind) - 1)
    return out


def _angle(a: Array, b: Array) -> Array:
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.sum(a * b, axis=1))


def _missed(rest: Array, turns: Array | None, found: Segmentation, name: str) -> dict[str, float]:
    """How far the direction at rest, carried through each turn, misses the one after it: median over the turns."""
    if turns is None:
        return {}
    before, after = [t.before for t in found.turns], [t.after for t in found.turns]
    carried = np.einsum("tji,tj->ti", turns, rest[before])
    seen = np.isfinite(carried).all(axis=1) & np.isfinite(rest[after]).all(axis=1)
    seen &= _angle(rest[before], rest[after]) > LEAST_TURN
    if seen.sum() < 2:
        return {}
    # a turn that was longer than it looks (a knock, a clipped sample) must not decide
    return {name: float(np.degrees(np.median(_angle(carried[seen], rest[after][seen]))))}


# --- the answer ---------------------------------------------------------------------------------------


def _decide(
    calibration: Calibration, as_it_is: _Judged, every: Sequence[_Judged], streams: Mapping[Kind, Stream]
) -> tuple[tuple[Finding, ...], _Judged]:
    """Findings of every sensor, and the combination that they are taken from."""
    least = min((j.misfit for j in every), default=as_it_is.misfit)
    near = [j for j in every if j.misfit <= max(ALIKE * least, least + 0.2)]
    chosen = min(near, key=lambda j: (j.simplicity, j.rarity, j.misfit), default=as_it_is)
    if as_it_is.misfit <= DOUBTFUL:
        hint = chosen if as_it_is.misfit > max(HINT, CLEARLY * chosen.misfit) else as_it_is
        return tuple(_right(calibration, kind, as_it_is, every, hint) for kind in streams), as_it_is
    if as_it_is.misfit < CLEARLY * chosen.misfit or chosen.misfit > GROSS or not chosen.simplicity[0]:
        return tuple(_unexplained(kind, as_it_is, chosen) for kind in streams), as_it_is
    rivals = [j for j in near if j.simplicity == chosen.simplicity and not _same(calibration, j, chosen)]
    return tuple(_named(kind, as_it_is, chosen, rivals) for kind in streams), chosen


def _same(calibration: Calibration, a: _Judged, b: _Judged) -> bool:
    """Whether two combinations give the same vectors for any purpose: then the commoner name will do."""
    for kind, model in calibration.models.items():
        if kind in a.ways and a.ways[kind].mistakes != b.ways[kind].mistakes:
            (G, g), (G0, g0) = a.ways[kind].mending(model), b.ways[kind].mending(model)
            M = G @ np.linalg.inv(G0)
            if _size(M, g - M @ g0, magnitude(calibration, kind)) > EQUIVALENT:
                return False
    return True


_FIGURE = "misfit of rests and turns (1: as a right calibration leaves it)"


def _right(calibration: Calibration, kind: Kind, as_it_is: _Judged, every: Sequence[_Judged], hint: _Judged) -> Finding:
    """Nothing is wrong that could be seen; `hint` is what would fit clearly better all the same, if anything."""
    unseen: dict[str, float] = {}
    for judged in every:
        ways = {k: w for k, w in judged.ways.items() if w.mistakes}
        if set(ways) == {kind} and len(ways[kind].mistakes) == 1 and judged.misfit <= DOUBTFUL:
            G, g = ways[kind].mending(calibration.models[kind])
            unseen[ways[kind].mistakes[0]] = _size(G, g, magnitude(calibration, kind))
    if kind == "gyr" and not any("turn" in n for n in as_it_is.figures):
        text = "the rate at rest fits; without turns between the rests H cannot be told"
        return Finding(kind, "cannot-tell", (), text, as_it_is.misfit, as_it_is.misfit, DOUBTFUL, _FIGURE, unseen)
    if hint.ways[kind].mistakes:
        text = (
            "the recording is as a right calibration leaves it, and yet fits better as if this had happened: "
            f"{hint.ways[kind].text}; too little to say so, the raw recording (--raw) would tell"
        )
        return Finding(kind, "cannot-tell", (), text, as_it_is.misfit, hint.misfit, DOUBTFUL, _FIGURE, unseen)
    text = "rests and turns agree with u = H (y - B)"
    return Finding(kind, "right", (), text, as_it_is.misfit, as_it_is.misfit, DOUBTFUL, _FIGURE, unseen)


def _size(G: Array, g: Array, length: float) -> float:
    """Difference between right and wrong vectors, rms over the sphere, relative to their length."""
    D = (G - np.eye(3)) * length
    return float(np.sqrt(np.sum(D**2) / 3 + np.sum(g**2)) / length)


def _unexplained(kind: Kind, as_it_is: _Judged, chosen: _Judged) -> Finding:
    gross = as_it_is.misfit > GROSS
    worst = max(as_it_is.figures, key=lambda n: as_it_is.figures[n] / USUAL[n])
    text = (
        f"the recording does not agree well with the calibration ({worst}: {as_it_is.figures[worst]:.3g}), and none of "
        "the usual mistakes explains it: another node, a sensor that changed, a field that differs from place to "
        "place, or a mistake of another kind; the raw recording (--raw) would tell"
    )
    outcome = "other" if gross else "cannot-tell"
    return Finding(kind, outcome, (), text, as_it_is.misfit, chosen.misfit, DOUBTFUL, _FIGURE)


def _named(kind: Kind, as_it_is: _Judged, chosen: _Judged, rivals: Sequence[_Judged]) -> Finding:
    way = chosen.ways[kind]
    if any(r.ways[kind].mistakes != way.mistakes for r in rivals):
        others = sorted({"/".join(r.ways[kind].mistakes) or "right" for r in [chosen, *rivals]})
        text = f"something is wrong, but of this sensor it cannot be told whether it is: {', '.join(others)}"
        return Finding(kind, "cannot-tell", (), text, as_it_is.misfit, chosen.misfit, DOUBTFUL, _FIGURE)
    if not way.mistakes:
        text = "u = H (y - B), once the other sensors are mended"
        return Finding(kind, "right", (), text, as_it_is.misfit, chosen.misfit, DOUBTFUL, _FIGURE)
    return Finding(kind, "mistake", way.mistakes, way.text, as_it_is.misfit, chosen.misfit, DOUBTFUL, _FIGURE)


def _issues(findings: Sequence[Finding], found: Segmentation) -> tuple[Issue, ...]:
    wrong = [f for f in findings if f.outcome in ("mistake", "other")]
    made = tuple(
        Issue(f"applied-{'-'.join(f.mistakes) or 'otherwise'}", "fail", f"{NAMES[f.sensor]}: {f.text}", f.sensor)
        for f in wrong
    )
    return (*made, *(i for i in found.issues if i.level != "note"))
