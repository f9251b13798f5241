"""`robust_joint` and whole nodes: what contradicts is named and left out, and the expected errors are right.

Short runs of benchmarks/studies/nodes.py; the long command is ``python benchmarks/studies/trust.py``.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from margcal.core import so3
from margcal.core.types import Array, Kind
from margcal.methods.joint import Priors, Triad
from margcal.workflow.robust import LOOK_AT, MATTERS, RobustFit, issues_of, robust_joint
from margcal.workflow.simulated_node import NOISE, NodeErrors, triad

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks" / "studies"))
import nodes

VECTORS: dict[Kind, Array] = {"acc": np.array([0.0, 0.0, 9.80665]), "mag": np.array([0.0, 20.0, -45.0])}


@dataclass
class Node:
    """Means of 24 rests on a cube's faces as the joint fit takes them, without a gyroscope; 100 samples a rest."""

    triads: dict[Kind, Triad]
    R0: Array

    def spoil(self, kind: Kind, rest: int, change: Array) -> None:
        """Add `change` (fraction of the magnitude, in the node's axes) to what `kind` senses at `rest`."""
        self.triads[kind].y[rest] += self.triads[kind].A @ change * np.linalg.norm(VECTORS[kind])

    def solve(self) -> RobustFit:
        return robust_joint(self.triads, None, self.R0, Priors(R0=self.R0, vertical_sd=0.02))

    def found(self) -> set[tuple[str, int]]:
        return {(out.what, out.index) for out in self.solve().left_out}


def node(seed: int, housing_deg: float = 0.2) -> Node:
    rng = np.random.default_rng([seed, 77])
    R0 = rng.permutation(so3.cube_group())
    R = R0 @ so3.exp(np.radians(housing_deg) * rng.normal(size=(24, 3)))
    triads: dict[Kind, Triad] = {}
    for kind, u in VECTORS.items():
        H, B = triad(kind, NodeErrors(), rng)
        A, se = np.linalg.inv(H), np.full((24, 3), NOISE[kind] / 10)
        y = np.einsum("ab,jcb,c->ja", A, R, u) + B + se * rng.normal(size=(24, 3))
        triads[kind] = Triad(y, se, A, B, u, u_free=True)
    return Node(triads, R0)


QUARTER = so3.exp(np.array([0.0, 0.0, np.pi / 2]))


def test_nothing_is_left_out_of_good_nodes():
    assert sum(bool(node(seed).found()) for seed in range(20)) <= 1


def test_wrong_label_is_named_and_its_readings_stay():
    group = so3.cube_group()
    for seed in range(10):
        rng = np.random.default_rng(seed)
        it, rest = node(seed), int(rng.integers(24))
        it.R0[rest] = it.R0[rest] @ group[rng.integers(1, 24)]
        assert it.found() == {("rot", rest)}


def test_swapped_pair_is_named():
    for seed in range(4):
        it = node(seed)
        i, k = np.random.default_rng(seed).choice(24, 2, replace=False)
        it.R0[[i, k]] = it.R0[[k, i]]
        assert it.found() == {("rot", int(i)), ("rot", int(k))}


@pytest.mark.parametrize("kind", ["acc", "mag"])
def test_disturbed_reading_is_named(kind: Kind):
    """Five per cent in random directions; without a gyroscope the other sensor tells disturbance from attitude."""
    right = 0
    for seed in range(12):
        rng = np.random.default_rng([seed, 5])
        it, rest, d = node(seed), int(rng.integers(24)), rng.normal(size=3)
        it.spoil(kind, rest, 0.05 * d / np.linalg.norm(d))
        found = it.found()
        # an error along the other sensor's cone is as well explained by the attitude of that rest
        assert {index for _, index in found} == {rest}
        right += found == {(kind, rest)}
    assert right >= 9


def test_the_fit_has_no_trace_of_what_was_left_out():
    it = node(3)
    it.spoil("mag", 7, np.array([0.1, 0.0, 0.05]))
    robust = it.solve()
    it.triads["mag"].y[7] = np.nan
    clean = it.solve()
    assert not clean.left_out
    assert np.allclose(robust.fit.H["mag"], clean.fit.H["mag"], rtol=1e-4, atol=1e-6)
    assert np.allclose(robust.fit.B["mag"], clean.fit.B["mag"], atol=1e-2)
    assert robust.left_out[0].chi2 > robust.left_out[0].limit > LOOK_AT


def test_what_does_not_matter_stays():
    """A quarter of a per cent is far beyond the noise of this accelerometer and of no consequence."""
    it = node(4, housing_deg=0.01)
    it.spoil("acc", 5, np.array([0.5, 0.0, 0.0]) * MATTERS["acc"])
    assert it.found() <= {("rot", 5)}


def test_at_most_a_third_is_left_out():
    it = node(5)
    rng = np.random.default_rng(5)
    for rest in range(0, 24, 2):
        it.spoil("mag", rest, 0.3 * rng.normal(size=3))
    assert len(it.solve().left_out) <= 8


def test_words_name_the_rest_and_the_likely_label():
    it = node(6)
    true = it.R0[9].copy()
    it.R0[9] = QUARTER @ it.R0[9]
    (issue,) = issues_of(it.solve(), cube=True)
    assert issue.code == "label-left-out" and issue.level == "warn" and "rest 10 " in issue.text
    axes = {f"{sign}{axis}": s * np.eye(3)[i] for i, axis in enumerate("xyz") for sign, s in (("+", 1), ("-", -1))}
    up, front = (next(n for n, a in axes.items() if np.allclose(a, row)) for row in (true[2], true[1]))
    assert f"up {up}, front {front}" in issue.text
    it = node(6)
    it.spoil("mag", 2, np.array([0.0, 0.2, 0.0]))
    issue = next(i for i in issues_of(it.solve(), cube=True) if i.code == "pose-left-out")
    assert issue.sensor == "mag" and "rest 3 " in issue.text


# --- whole nodes -------------------------------------------------------------------------------------


def test_expected_errors_are_the_true_ones():
    """Few nodes a class: the band of the pooled ratio is wide, that of the long study is .75 to 1.25."""
    rows = nodes.expected_error_study(16, seed=3)
    for row in rows[:-1]:
        assert row["nodes"] == 4 and row["lost"] == 0, row
        assert 0.4 <= row["true_over_expected"] <= 1.8, row
    pooled = np.sqrt(np.mean([float(row["true_over_expected"]) ** 2 for row in rows[:-1]]))
    assert 0.7 <= pooled <= 1.3
    assert rows[-1]["within_.3_to_3_%"] >= 90


def test_labels_are_inferred():
    cases = ("mounting <= 5, dip <= 60", "mounting <= 5, dip 85")
    for row in nodes.label_study(8, cases=cases):
        assert row["right_%"] == 100, row
        assert row["wrong_and_silent"] == 0, row
        assert row["right_but_warned_%"] <= 10, row


def test_labels_are_compared_up_to_names_and_heading():
    rng = np.random.default_rng(8)
    group = so3.cube_group()
    truth = group[rng.integers(24, size=10)]
    heading = so3.exp(np.array([0.0, 0.0, 0.4]))
    assert nodes.same_labels(heading @ truth @ group[7], truth)
    assert not nodes.same_labels(so3.exp(np.array([np.pi / 2, 0.0, 0.0])) @ truth, truth)
    one_wrong = truth.copy()
    one_wrong[3] = one_wrong[3] @ group[4]
    assert not nodes.same_labels(one_wrong, truth)


def test_joint_fit_gains_over_sensor_by_sensor():
    for row in nodes.joint_study(4, housing_deg=(0.5,)):
        assert row["but_for_frame_deg_joint"] <= 0.8 * row["but_for_frame_deg_single"], row
