"""Hypothesis strategies: rotations, nodes, pose sets, calibrations; and the profiles that tests run under.

`ci` (default): the same few examples every time, and what fails is shown as it is found (making a session smaller takes
minutes). `long` (HYPOTHESIS_PROFILE=long): 500 random ones a property, and what fails is made smaller.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numpy as np
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st

from margcal.core import so3
from margcal.core.types import Alignment, Array, Calibration, Issue, Kind, SensorModel
from margcal.core.units import KINDS, SI_UNIT, UNITS

_SLOW = [HealthCheck.too_slow, HealthCheck.data_too_large]
settings.register_profile(
    "ci",
    derandomize=True,
    max_examples=12,
    deadline=None,
    database=None,
    suppress_health_check=_SLOW,
    phases=(Phase.explicit, Phase.generate),
)
settings.register_profile("long", max_examples=500, deadline=None, print_blob=True, suppress_health_check=_SLOW)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci"))

seeds = st.integers(0, 2**32 - 1)
kinds = st.sampled_from(KINDS)
finite = st.floats(allow_nan=False, allow_infinity=False)
unit_interval = st.floats(-1, 1)


def rngs() -> st.SearchStrategy[np.random.Generator]:
    return seeds.map(np.random.default_rng)


# --- rotations ----------------------------------------------------------------------------------------


def directions() -> st.SearchStrategy[Array]:
    """Unit vectors, those along the axes and close to them among them."""
    around = rngs().map(lambda rng: _unit(rng.normal(size=3)))
    axes = st.sampled_from([s * e for e in np.eye(3) for s in (1.0, -1.0)])
    return st.one_of(around, axes, axes.map(lambda e: _unit(e + 1e-9)))


def angles(*, below: float = np.pi) -> st.SearchStrategy[float]:
    """Angles in [0, below], with those near 0 and near pi that closed forms are afraid of."""
    tiny = st.integers(-17, -1).map(lambda p: 10.0**p)
    near_pi = tiny.map(lambda e: np.pi - e)
    anywhere = st.floats(0, below)
    special = st.sampled_from([a for a in (0.0, np.pi / 2, 2 * np.pi / 3, np.pi) if a <= below])
    return st.one_of(anywhere, tiny, near_pi if below >= np.pi else anywhere, special)


def rotation_vectors(*, below: float = np.pi) -> st.SearchStrategy[Array]:
    return st.builds(lambda axis, angle: axis * angle, directions(), angles(below=below))


def rotations() -> st.SearchStrategy[Array]:
    return rotation_vectors().map(so3.exp)


def quaternions() -> st.SearchStrategy[Array]:
    """Unit quaternions of either sign, scalar first."""
    return st.builds(lambda v, s: s * so3.quat_exp(v), rotation_vectors(), st.sampled_from([1.0, -1.0]))


def signed_permutations() -> st.SearchStrategy[Array]:
    """The 48 ways in which a triad's axes can be named and counted, mirrored ones among them."""
    return st.builds(
        lambda order, signs: np.array(signs)[:, None] * np.eye(3)[list(order)],
        st.permutations(range(3)),
        st.tuples(*[st.sampled_from([1.0, -1.0])] * 3),
    )


def _unit(v: Array) -> Array:
    return v / np.linalg.norm(v)


# --- nodes and poses ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Session:
    """One sensor in J poses: the truth, and its readings with noise of `sigma` (0: exact), raw unit."""

    H: Array
    B: Array
    u: Array
    R: Array
    y: Array
    sigma: float

    @property
    def magnitude(self) -> float:
        return float(np.linalg.norm(self.u))


def transformations() -> st.SearchStrategy[Array]:
    """H of a sensor: any mounting (never mirrored), some non-orthogonality, gains of 1e-5 to 1e3."""

    def build(mounting: Array, gain: float, seed: int) -> Array:
        skewed = np.eye(3) + 0.1 * np.random.default_rng(seed).uniform(-1, 1, (3, 3))
        return 10.0**gain * mounting @ skewed

    return st.builds(build, rotations(), st.floats(-5, 3), seeds)


def pose_sets(least: int, most: int, *, cube: bool = True) -> st.SearchStrategy[Array]:
    """Attitudes (J, 3, 3) that determine H: random ones, or (with `cube`) those of a cube put down by hand."""

    def build(n: int, seed: int, by_hand: bool) -> Array:
        rng = np.random.default_rng(seed)
        if not by_hand:
            return so3.matrix_from_quat(rng.normal(size=(n, 4)))
        return so3.cube_group()[rng.permutation(24)[:n]] @ so3.exp(0.02 * rng.normal(size=(n, 3)))

    free = st.builds(build, st.integers(least, most), seeds, st.just(False))
    if not cube:
        return free
    # twelve of the cube's attitudes: fewer may leave an axis out
    return st.one_of(free, st.builds(build, st.integers(max(least, 12), 24), seeds, st.just(True)))


@st.composite
def sessions(draw: st.DrawFn, *, noise: bool = True, least: int = 16, most: int = 24, cube: bool = True) -> Session:
    """A node, its poses, and what it reads in them; the offset is up to thirty times the signal.

    The attitudes of a `cube` may be only six directions, too few for solvers that know the length alone.
    """
    H, R, rng = draw(transformations()), draw(pose_sets(least, most, cube=cube)), draw(rngs())
    u = draw(st.sampled_from([1.0, 9.80665, 50.0])) * draw(directions())
    extent = np.linalg.norm(u) * np.linalg.norm(np.linalg.inv(H), 2)
    B = extent * draw(st.floats(0, 30)) * rng.uniform(-1, 1, 3)
    sigma = float(2e-3 * extent) if noise else 0.0
    y = (R @ u) @ np.linalg.inv(H).T + B + sigma * rng.normal(size=(len(R), 3))
    return Session(H, B, u, R, y, sigma)


# --- calibrations -------------------------------------------------------------------------------------

_words = st.text(max_size=20)
_positive = st.floats(0, allow_infinity=False)
_json = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**63) | finite | _words,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(_words, inner, max_size=3),
    max_leaves=8,
)


def _vectors(n: int) -> st.SearchStrategy[Array]:
    return st.tuples(*[st.floats(-1e50, 1e50)] * n).map(np.array)


def covariances() -> st.SearchStrategy[Array]:
    """(12, 12), of full rank or less, in units that are far apart."""

    def build(rng: np.random.Generator, rank: int, spread: float) -> Array:
        half = rng.normal(size=(12, rank)) * np.exp(spread * rng.normal(size=(12, 1)))
        C = half @ half.T
        return (C + C.T) / 2

    return st.builds(build, rngs(), st.integers(1, 15), st.floats(0, 8))


@st.composite
def models(draw: st.DrawFn, kind: Kind) -> SensorModel:
    raw_unit = draw(st.sampled_from(sorted(UNITS[kind])) | st.text(min_size=1, max_size=40))
    return SensorModel(
        kind,
        draw(transformations()) * 10.0 ** draw(st.integers(-40, 40)),
        np.array(draw(st.tuples(finite, finite, finite))),
        raw_unit,
        draw(st.sampled_from(["uT", "norm"])) if kind == "mag" else SI_UNIT[kind],
        covariance=draw(st.none() | covariances()),
        residual_rms=draw(st.none() | _positive),
        n_poses=draw(st.none() | st.integers(0, 10**9)),
        method=draw(_words),
        reference_vector=draw(st.none() | _vectors(3)),
        expected_error_deg=draw(st.none() | _positive),
        delay_s=draw(st.none() | finite),
        delay_se_s=draw(st.none() | _positive),
        temperature_degC=draw(st.none() | finite),
    )


@st.composite
def calibrations(draw: st.DrawFn) -> Calibration:
    """Any calibration that a file can hold."""
    found: dict[str, Any] = {k: draw(models(k)) for k in draw(st.sets(kinds, min_size=1))}
    issue = st.builds(
        Issue,
        _words,
        st.sampled_from(["note", "warn", "fail"]),
        _words,
        st.none() | kinds,
        st.none() | finite,
        st.none() | finite,
    )
    values = {
        "offset_s": finite,
        "drift_ppm": finite,
        "marker_to_node": _vectors(4),
        "lever_arm_m": _vectors(3),
        "lab_to_earth_se": _vectors(3),
    }
    alignment = st.builds(Alignment, st.booleans(), st.fixed_dictionaries({}, optional=values))
    digest = st.text("0123456789abcdef", min_size=64, max_size=64)
    return Calibration(
        **found,
        device=draw(st.none() | _words),
        frame=draw(st.text(min_size=1, max_size=20)),
        verdict=draw(st.sampled_from([None, "pass", "warn", "fail"])),
        issues=tuple(draw(st.lists(issue, max_size=3))),
        alignment=draw(st.none() | alignment),
        created=draw(st.text(min_size=1, max_size=20)),
        program=draw(st.text(min_size=1, max_size=20)),
        files=tuple(draw(st.lists(st.tuples(_words, digest | st.just("")), max_size=2))),
        settings=draw(st.dictionaries(_words, _json, max_size=4)),
    )
