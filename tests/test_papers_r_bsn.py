"""`margcal reproduce r-bsn`, shortened: two sessions with short trials; and that errors are counted the right way."""

from __future__ import annotations

import contextlib
import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from margcal.apps import cli
from margcal.apps.papers import r_bsn, r_bsn_runs
from margcal.apps.papers.r_bsn_runs import OURS, PAPER, PERFECT, UNCALIBRATED
from margcal.apps.papers.r_bsn_simulation import Node, Session, Setting, session
from margcal.core import so3
from margcal.core.rigid_body import MarkerReference
from margcal.core.types import Alignment
from margcal.workflow.gait import PLACES

SHORT = Setting(still_s=(0.0, 6.0), moved_s=(10.0, 40.0), walk_s=(45.0, 65.0))


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """What the command writes; `shown.txt` is what it shows."""
    out = tmp_path_factory.mktemp("r-bsn") / "out"
    screen = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(screen):
        patch.setattr(r_bsn, "SETTING", SHORT)
        patch.setattr(r_bsn, "SHOWN_S", (12.0, 16.0))
        assert cli.run(["reproduce", "r-bsn", "--runs", "2", "-o", str(out)]) == 0
    (out / "shown.txt").write_text(screen.getvalue())
    return out


@pytest.fixture(scope="module")
def plain(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "results.json").read_text())


@pytest.fixture(scope="module")
def first() -> Session:
    return session(3, SHORT)


@pytest.fixture(scope="module")
def turned() -> Session:
    """The same, had the wand lain otherwise."""
    return session(3, SHORT, yaw_deg=40.0)


@pytest.fixture(scope="module")
def node(first: Session) -> Node:
    return first.nodes["thigh"]


def grid(plain: dict[str, Any], name: str) -> dict[str, dict[str, float]]:
    found = next(t for t in plain["tables"] if t["name"] == name)
    return {row[0]: dict(zip(found["header"][1:], row[1:])) for row in found["rows"]}


# --- what is simulated --------------------------------------------------------------------------------


def test_session_is_that_of_the_paper(node: Node):
    for trial in (node.still, node.moved, node.walk):
        assert trial.recording.units == {"acc": "mps2", "gyr": "radps", "mag": "uT"}
        for stream in trial.recording.streams.values():
            assert stream.rate == pytest.approx(75)
        reference = trial.reference
        assert isinstance(reference, MarkerReference) and len(reference.names) == 4
        assert (len(reference.t) - 1) / (reference.t[-1] - reference.t[0]) == pytest.approx(100)
        assert 1e-4 < np.nanmedian(reference.residual) < 4e-4
    still = so3.matrix_from_quat(node.still.reference.q)
    assert np.nanmax(np.degrees(so3.angle_between(still[0], still))) < 2


def test_readings_are_what_the_truth_makes_of_the_references(node: Node):
    """Gyroscope and magnetometer of the walk, calibrated by the truth, against the markers: frames, clocks, units."""
    reference, recording = node.walk.reference, node.truth.apply(node.walk.recording)
    R = node.R_nm @ so3.matrix_from_quat(reference.q) @ node.R_kh
    t = SHORT.offset_s + (1 + 1e-6 * SHORT.drift_ppm) * recording.streams["gyr"].t
    middle, dt = (reference.t[2:] + reference.t[:-2]) / 2, reference.t[2:] - reference.t[:-2]
    rate = so3.log(np.swapaxes(R[:-2], 1, 2) @ R[2:]) / dt[:, None]
    field = np.einsum("nji,j->ni", R, r_bsn_runs.FIELD_UT * np.array([0, np.cos(1.1606), -np.sin(1.1606)]))
    for kind, times, truth, limit in (("gyr", middle, rate, 0.4), ("mag", reference.t, field, 1.2)):
        u = recording.streams[kind].y
        seen = np.column_stack([np.interp(times, t, u[:, k]) for k in range(3)])
        good = np.isfinite(truth).all(axis=1) & (times > t[0]) & (times < t[-1])
        assert np.sqrt(np.mean(np.sum((seen - truth)[good] ** 2, axis=1))) < limit
        assert np.abs(np.mean((seen - truth)[good], axis=0)).max() < 0.05 * limit


def test_same_seed_same_session_and_the_yaw_changes_the_laboratory_only(first: Session, turned: Session):
    for place in PLACES:
        one, other = first.nodes[place], turned.nodes[place]
        for trial, same in ((one.walk, other.walk), (one.moved, other.moved)):
            np.testing.assert_array_equal(trial.recording.streams["mag"].y, same.recording.streams["mag"].y)
        turn = one.R_nm.T @ other.R_nm
        assert np.degrees(so3.angle_between(turn, np.eye(3))) == pytest.approx(40.0 - first.yaw_deg)


def test_nodes_without_errors_have_none():
    clean = session(4, SHORT.decalibrated(0.0)).nodes["hip"]
    for model in clean.truth.models.values():
        np.testing.assert_allclose(model.H, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(model.B, 0, atol=1e-12)
    np.testing.assert_allclose(clean.R_kh, np.eye(3), atol=1e-12)
    hard = session(4, SHORT.decalibrated(2.0)).nodes["hip"].truth.models["mag"]
    assert np.linalg.norm(hard.B) == pytest.approx(2 * SHORT.hard_iron_uT)


# --- how errors are counted ---------------------------------------------------------------------------


def test_the_true_calibration_is_as_good_as_perfect_sensors(node: Node):
    true = replace(node.truth, alignment=None)
    values = {
        "marker_to_node": so3.quat_from_matrix(node.R_kh.T),
        "lab_to_earth": so3.quat_from_matrix(node.R_nm),
        "offset_s": SHORT.offset_s,
        "drift_ppm": SHORT.drift_ppm,
    }
    true = replace(true, alignment=Alignment(False, values))
    jobs = [*r_bsn_runs._as_they_are(0, node, SHORT), r_bsn_runs._calibrated(0, node, "true", true)]
    q = r_bsn_runs._filtered([j.recording for j in jobs])
    walks = {j.variant: r_bsn_runs._judged(j, a) for j, a in zip(jobs, q)}
    for of in (lambda w: w.evaluation, lambda w: w.by_vqf):
        assert abs(of(walks["true"]).total_deg - of(walks[PERFECT]).total_deg) < 0.35


def test_another_yaw_of_the_wand_changes_the_uncalibrated_error_alone(first: Session, turned: Session):
    found = []
    for one in (first, turned):
        node = one.nodes["hip"]
        jobs = [*r_bsn_runs._as_they_are(0, node, SHORT)]
        q = r_bsn_runs._filtered([j.recording for j in jobs])
        found.append({j.variant: r_bsn_runs._judged(j, a).evaluation for j, a in zip(jobs, q)})
    told = r_bsn_runs.with_yaw(found[0][UNCALIBRATED], first, 40.0)
    assert told == pytest.approx(found[1][UNCALIBRATED].total_deg, abs=0.02)
    assert abs(told - found[0][UNCALIBRATED].total_deg) > 0.5
    assert found[0][PERFECT].total_deg == pytest.approx(found[1][PERFECT].total_deg, abs=0.02)


# --- the tables ---------------------------------------------------------------------------------------


def test_calibration_takes_off_what_the_frames_and_the_nodes_cost(plain: dict[str, Any]):
    errors, by_vqf = grid(plain, "errors"), grid(plain, "vqf")
    for way in (PAPER, OURS):
        assert errors[f"hip, {way}"]["total"] < 0.5 * errors[f"hip, {UNCALIBRATED}"]["total"]
        for place in PLACES:
            assert by_vqf[place][way] < 0.5 * by_vqf[place][UNCALIBRATED]
    for place in PLACES:
        assert by_vqf[place][OURS] < by_vqf[place][PERFECT] + 0.3
    # what is left at the ankle is the filter's: perfect sensors do no better
    assert abs(errors[f"ankle, {PAPER}"]["total"] - errors[f"ankle, {PERFECT}"]["total"]) < 2


def test_alignments_are_near_the_truth_and_the_papers_accelerometer_is_too_small(plain: dict[str, Any]):
    rows = grid(plain, "accuracy")
    for way in (PAPER, OURS):
        assert rows[way]["nodes"] == 6
        assert rows[way]["T %"] < 0.1 and rows[way]["C^b deg"] < 0.05 and rows[way]["C^n deg"] < 0.3
        assert rows[way]["mag H %"] < 0.3
    assert rows[OURS]["acc H %"] < 0.15 < 0.5 < rows[PAPER]["acc H %"]


def test_reduction_follows_the_wands_yaw(plain: dict[str, Any]):
    rows = grid(plain, "yaw")
    clean = rows["vqf, nodes' errors x 0"]
    assert abs(clean["0 deg"]) < 0.6
    for yaw in (5, 10, 20):
        assert clean[f"{yaw} deg"] == pytest.approx(yaw, abs=1.2)
    assert rows["vqf, nodes' errors x 2"]["0 deg"] > rows["vqf, nodes' errors x 1"]["0 deg"] > 1


def test_every_cell_has_a_reason_and_every_choice_is_printed(plain: dict[str, Any]):
    found = next(t for t in plain["tables"] if t["name"] == "section-5")
    assert [c["paper"]["mean"] for c in found["cells"]] == [8.8] * 5
    assert all("neither the wand's yaw" in c["reason"] for c in found["cells"])
    text = " ".join(found["settings"])
    assert all(word in text for word in ("75 Hz", "100 Hz", "3 km/h", "not in the paper", "ekf-quest", "hard iron"))


def test_pictures_are_well_formed(folder: Path):
    names = {*(f"r-bsn-fig-5-{p}.svg" for p in PLACES), "r-bsn-yaw.svg"}
    assert {p.name for p in folder.glob("*.svg")} == names
    for name in names:
        svg = (folder / name).read_text()
        ElementTree.fromstring(svg)
        assert "nan" not in svg and "inf" not in svg
    assert (folder / "r-bsn-fig-5-hip.svg").read_text().count("<path") == 3 * 3 + 3 * 3


def test_command_shows_what_it_writes(folder: Path, plain: dict[str, Any]):
    shown = (folder / "shown.txt").read_text()
    assert "8.8" in shown and "ours/paper" in shown and "What the 8.8 hangs on" in shown
    assert plain["paper"] == "r-bsn" and plain["runs"] == 2
    assert sorted(plain["pictures"]) == sorted(p.name for p in folder.glob("*.svg"))


def test_same_seed_same_alignment(node: Node):
    first, second = (r_bsn_runs.aligned(n, "r-bsn") for n in (node, session(3, SHORT).nodes["thigh"]))
    assert first is not None and second is not None
    assert r_bsn_runs.accuracy_of(node, first) == r_bsn_runs.accuracy_of(node, second)
