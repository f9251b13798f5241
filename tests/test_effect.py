"""`margcal reproduce effect`: nodes that are corrupted and restored, on one public trial (the verb runs all)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import margcal
from conftest import find_data
from margcal.apps import cli
from margcal.apps.papers import effect
from margcal.apps.papers.effect_data import filters, phone_calibration, phone_motions
from margcal.apps.papers.effect_nodes import (
    BIAS_ONLY,
    FULL,
    MAG_BIAS_ONLY,
    MOUNTING_DEG,
    RAW,
    SENSOR_FRAME,
    Node,
    applied,
    make_node,
)
from margcal.apps.papers.tables import Work
from margcal.core import so3
from margcal.core.types import Calibration, Recording, Reference
from margcal.workflow.evaluate import Evaluation, evaluate
from margcal.workflow.simulated_node import NOMINAL_SCALE

TRIAL = "broad/05_undisturbed_slow_rotation_with_breaks_B.parquet"


@pytest.fixture(scope="module")
def node() -> Node:
    return make_node(1040)


def test_a_node_has_the_errors_that_it_should_have(node):
    for kind, model in node.truth.models.items():
        H = model.H * NOMINAL_SCALE[kind]
        rotation, stretch = so3.polar(H)
        mounting = np.degrees(float(so3.angle_between(rotation, np.eye(3))))
        assert MOUNTING_DEG[0] - 1.5 < mounting < MOUNTING_DEG[1] + 1.5  # non-orthogonality turns it a little
        assert 0.01 < np.abs(np.linalg.eigvalsh(stretch) - 1).max() < 0.2
        assert np.linalg.norm(model.B) > 10


def test_the_variants_leave_out_what_they_say(node):
    full = node.variants[FULL]
    for kind, model in full.models.items():
        truth = node.truth.models[kind]
        assert np.linalg.norm(model.H @ np.linalg.inv(truth.H) - np.eye(3)) < 2e-3
        raw, bias, frame = (node.variants[v].models[kind] for v in (RAW, BIAS_ONLY, SENSOR_FRAME))
        np.testing.assert_allclose(raw.H, np.eye(3) / NOMINAL_SCALE[kind])
        assert not raw.B.any() and np.array_equal(bias.B, model.B) and np.array_equal(bias.H, raw.H)
        # what the length alone tells: everything but a rotation
        turn = truth.H @ np.linalg.inv(frame.H)
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=5e-3)
        assert np.degrees(float(so3.angle_between(so3.nearest_rotation(turn), np.eye(3)))) > 1
    part = node.variants[MAG_BIAS_ONLY]
    assert part.acc is not None and full.acc is not None and part.mag is not None
    assert np.array_equal(part.acc.H, full.acc.H) and np.array_equal(
        part.mag.H, node.variants[BIAS_ONLY].models["mag"].H
    )


def cut(recording: Recording, seconds: float) -> Recording:
    """The first `seconds` of a recording whose sensors share a clock."""
    n = int(np.searchsorted(recording.streams["acc"].t, seconds))
    streams = {k: replace(s, t=s.t[:n], y=s.y[:n]) for k, s in recording.streams.items()}
    assert recording.reference is not None
    reference = Reference(recording.reference.t[:n], recording.reference.q[:n])
    return replace(recording, reference=reference, **streams)  # type: ignore[arg-type]


def test_h_and_b_restore_the_uncorrupted_result_and_the_rest_does_not(node):
    pytest.importorskip("vqf")
    recording = margcal.read(find_data(TRIAL))
    run = filters()["vqf"]

    def judged(vectors: Recording) -> Evaluation:
        return evaluate(run(vectors), find_data(TRIAL))

    clean = judged(recording)
    raw = node.reads(recording)
    exact = applied(node.truth, raw)
    for kind, stream in recording.streams.items():
        np.testing.assert_allclose(exact.streams[kind].y, stream.y, atol=1e-9 * np.abs(stream.y).max() + 1e-9)
    off = {v: judged(applied(c, raw)).total_deg - clean.total_deg for v, c in node.variants.items()}
    assert abs(off[FULL]) <= effect.RESTORED_DEG
    assert min(off[RAW], off[BIAS_ONLY], off[SENSOR_FRAME], off[MAG_BIAS_ONLY]) > 0.5
    assert off[RAW] > off[SENSOR_FRAME]


def test_the_tables_are_made_of_the_runs(monkeypatch):
    """The whole of `reproduce` on half a minute of one trial, with the fastest filter."""
    pytest.importorskip("vqf")
    path = find_data(TRIAL)
    part = cut(margcal.read(path), 45.0)
    monkeypatch.setattr(effect, "read", lambda _: part)
    monkeypatch.setattr(effect, "evaluate", lambda estimate, _: evaluate(estimate, part))
    monkeypatch.setattr(effect, "filters", lambda: {"vqf": filters()["vqf"]})
    ones = effect.corrupted({"08": path}, 1, 0, Work(None, 100))
    means = effect._means(ones)
    assert [row[0] for row in means.rows][-1] == "vqf, uncorrupted" and means.rows[-1][-1] == 0
    restored = effect._restored(ones, "vqf")
    assert len(restored.rows) == 1 and restored.rows[0][0] == "trial 08, node 1"
    clean = next(o.found.total_deg for o in ones if o.node < 0)
    raw = next(o.found.total_deg for o in ones if o.variant == RAW)
    assert restored.rows[0][1] == clean and restored.rows[0][2] == raw - clean
    table = effect._paper_table("zy-tbme-ii", ones, "vqf")
    assert table.rows[0][1:5] == (0.0397, 0.0014, 0.0397, 0.9970)  # as printed
    assert table.rows[2][5] == pytest.approx(
        np.radians(next(o.found.yaw.rms for o in ones if o.variant == FULL)), rel=1e-12
    )
    pictures = effect._pictures(ones, [])
    assert all("nan" not in svg for svg in pictures.values()) and len(pictures) == 2


def test_without_the_recordings_it_says_where_they_come_from(monkeypatch, capsys, tmp_path):
    monkeypatch.delenv("MARGCAL_DATA", raising=False)
    assert cli.run(["reproduce", "effect"]) == 1
    assert "MARGCAL_DATA is not set" in capsys.readouterr().err
    monkeypatch.setenv("MARGCAL_DATA", str(tmp_path))
    assert cli.run(["reproduce", "effect"]) == 1
    assert "holds no broad" in capsys.readouterr().err


def test_a_phone_is_calibrated_from_its_own_sessions():
    folder = find_data("tyrex").parent
    assert len(phone_motions(folder)) == 3
    calibrated, spheres = phone_calibration(folder)
    assert isinstance(calibrated, Calibration) and set(calibrated.models) == {"acc", "gyr", "mag"}
    assert calibrated.mag is not None
    # the data's README: hard iron from the sphere session
    np.testing.assert_allclose(calibrated.mag.B, [58.1, -73.5, 411.6], atol=0.2)
    np.testing.assert_allclose(spheres["mag"].B, [58.1, -73.5, 411.6], atol=0.2)
