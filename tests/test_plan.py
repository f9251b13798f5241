"""`margcal plan`: the recursion against the joint fit, predictions against simulation, plans against chance."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from margcal.apps.cli import run
from margcal.apps.planning_svg import drawing
from margcal.core import so3
from margcal.core.errors import UsageError
from margcal.core.types import Array, Recording
from margcal.methods.uncertainty import expected_error
from margcal.workflow.calibrate import calibrate
from margcal.workflow.motion import by_hand, put_down
from margcal.workflow.plan import Plan, attitudes, plan, plan_more
from margcal.workflow.plan_information import after_rest, direction_weight, gain_of
from margcal.workflow.plan_start import DIP, knowledge_of, nominal
from margcal.workflow.plan_words import side, turn_words
from margcal.workflow.simulate import Simulation, simulate, write_simulation
from margcal.workflow.simulated_node import Field, readings

KINDS = ("acc", "gyr", "mag")


def record(made: Simulation, labels: Array, seed: int) -> Recording:
    """The same node, put down in other attitudes."""
    rng = np.random.default_rng(seed)
    R = put_down(labels, 0.2, 0.0, rng)
    start = 3.5 * np.arange(len(R))
    motion = by_hand(R, start, start + 2.0, np.zeros((0, 2)), rng)
    t = np.arange(int((start[-1] + 2.0) * 100) + 1) / 100
    up, north = (made.truth.models[k].reference_vector for k in ("acc", "mag"))
    assert up is not None and north is not None
    streams = readings(motion, made.truth, dict.fromkeys(KINDS, t), up, Field(north), rng)
    return Recording(**streams, source="again")


def in_laboratory(planned: Plan, labels: Array) -> Array:
    """The planned attitudes in the laboratory and the housing of the simulation, from the rests that both know."""
    assert planned.calibration is not None and planned.calibration.poses is not None
    R = planned.calibration.poses.R
    assert R is not None
    frame = np.eye(3)
    if planned.hands == "free":  # the accelerometer's frame: a few degrees from the housing's
        a, b = (so3.log(np.swapaxes(x[:-1], 1, 2) @ x[1:]) for x in (R, labels))
        short = np.linalg.norm(b, axis=1) < 2.8
        frame = so3.align_vectors(a[short], b[short])
    laboratory = so3.mean_rotation(R @ frame @ np.swapaxes(labels, 1, 2))
    found = np.array([laboratory.T @ s.R @ frame for s in planned.steps])
    return np.round(found) if planned.hands == "box" else found


def chance(hands: str, last: Array, n: int, seed: int) -> Array:
    rng = np.random.default_rng(seed)
    candidates, chosen = attitudes(hands), [last]
    while len(chosen) <= n:
        R = candidates[rng.integers(len(candidates))]
        if so3.angle_between(chosen[-1], R) > 0.5:
            chosen.append(R)
    return np.array(chosen[1:])


# --- information --------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_the_weight_is_the_expected_error(kind):
    rng = np.random.default_rng(2)
    H = np.eye(3) + 0.1 * rng.normal(size=(3, 3))
    root = rng.normal(size=(12, 12)) * 1e-3
    size = 1.0 if kind == "gyr" else 9.8
    want = expected_error(kind, H, root @ root.T, size).direction_deg
    got = np.degrees(np.sqrt(np.trace(direction_weight(kind, H, size) @ root @ root.T)))
    assert got == pytest.approx(want, rel=1e-9)


@pytest.mark.parametrize(("poses", "n"), [("cube", 24), ("cube", 12), ("free", 16), ("faces", 18)])
def test_the_recursion_over_the_rests_is_the_joint_fit(poses, n):
    made = simulate(seed=1, poses=poses, n_poses=n, rest_s=2.0)
    calibration = calibrate(made.recording)
    known = knowledge_of(calibration, [made.recording]).errors_deg()
    for kind, model in calibration.models.items():
        assert known[kind] == pytest.approx(model.expected_error_deg, rel=0.4 if poses != "cube" else 0.1)


def test_the_gain_of_a_candidate_is_what_comes_after_it():
    now = after_rest(after_rest(nominal("box", KINDS, DIP), np.eye(3)), so3.cube_group()[5])
    cost, each = gain_of(now, so3.cube_group())
    for i in (3, 11, 20):
        then = after_rest(now, so3.cube_group()[i]).errors_deg()
        for kind in KINDS:
            assert np.degrees(np.sqrt(each[kind][i])) == pytest.approx(then[kind], rel=1e-9)
        assert cost[i] == pytest.approx(sum(np.radians(v) ** 2 for v in then.values()), rel=1e-9)


def test_more_rests_never_hurt():
    for hands in ("box", "free"):
        steps = plan(hands, 14).steps
        for kind in KINDS:
            errors = [s.errors_deg[kind] for s in steps]
            assert all(b <= a * (1 + 1e-9) for a, b in pairwise(errors))
            assert errors[-1] < 0.2


# --- plans from nothing -------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [12, 18, 24])
def test_a_box_is_put_down_on_all_faces_with_turns_about_all_axes(n):
    steps = plan("box", n).steps
    assert len(steps) == n
    R = np.array([s.R for s in steps])
    assert len({tuple(np.round(u).astype(int)) for u in R[:, 2]}) == 6
    assert len({tuple(np.round(r).astype(int).ravel()) for r in R}) == n  # none twice
    turns = np.array([s.turn for s in steps[1:]])
    angle = np.degrees(np.linalg.norm(turns, axis=1))
    assert angle.min() > 89 and angle.max() < 181
    spread = np.linalg.svd(turns / np.linalg.norm(turns, axis=1, keepdims=True), compute_uv=False)
    assert spread[2] / spread[0] > 0.3
    for a, b in pairwise(steps):
        np.testing.assert_allclose(a.R @ so3.exp(b.turn), b.R, atol=1e-9)


def test_free_hands_spread_their_directions():
    up = np.array([s.R[2] for s in plan("free", 18).steps])
    moments = np.linalg.eigvalsh(up.T @ up / len(up))
    assert moments[0] > 0.2  # 1/3 each if spread evenly
    nearest = np.degrees(np.arccos(np.clip(np.max(up @ up.T - 2 * np.eye(len(up)), axis=1), -1, 1)))
    assert np.median(nearest) > 25


@pytest.mark.parametrize(("hands", "n"), [("box", 8), ("free", 9)])
def test_a_plan_beats_chance_from_nothing(hands, n):
    planned = plan(hands, n).after_deg
    start = after_rest(nominal(hands, KINDS, DIP), np.eye(3))
    other = []
    for seed in range(20):
        now = start
        for R in chance(hands, np.eye(3), n - 1, seed):
            now = after_rest(now, R)
        other.append([now.errors_deg()[k] for k in KINDS])
    for kind, median in zip(KINDS, np.median(other, axis=0)):
        assert planned[kind] < median


def test_only_the_sensors_that_are_there_are_planned_for():
    assert set(plan("box", 8, sensors=("acc", "gyr")).after_deg) == {"acc", "gyr"}
    with pytest.raises(UsageError, match="1 to"):
        plan("box", 0)


# --- plans after recordings ---------------------------------------------------------------------------


@pytest.mark.parametrize(("mode", "hands"), [("cube", "box"), ("free", "free")])
def test_the_prediction_agrees_with_simulation_and_beats_chance(mode, hands):
    """The error after six planned attitudes, predicted from the readings at ten, and as the fit of all sixteen has it
    (rms over five nodes); and six attitudes by chance instead."""
    predicted: list[list[float]] = []
    fitted: list[list[float]] = []
    random: list[list[float]] = []
    for seed in range(5):
        made = simulate(seed=seed, poses=mode, n_poses=10)
        labels = made.nominal
        planned = plan_more(record(made, labels, 100 + seed))
        assert planned.hands == hands and len(planned.steps) == 6
        new = in_laboratory(planned, labels)
        after = calibrate(record(made, np.concatenate([labels, new]), 200 + seed))
        other = calibrate(record(made, np.concatenate([labels, chance(hands, labels[-1], 6, seed)]), 200 + seed))
        predicted.append([planned.after_deg[k] for k in KINDS])
        fitted.append([after.models[k].expected_error_deg or np.nan for k in KINDS])
        random.append([other.models[k].expected_error_deg or np.nan for k in KINDS])
        assert all(planned.after_deg[k] < planned.before_deg[k] for k in KINDS)
    rms = np.sqrt(np.mean(np.square(predicted), axis=0) / np.mean(np.square(fitted), axis=0))
    assert np.all((rms > 0.75) & (rms < 1.25)), rms
    gain = np.mean(np.array(fitted) / np.array(random))
    assert gain < (1.05 if mode == "cube" else 0.97), gain  # what is left of a box is the housing's own error


def test_the_missing_face_is_what_is_asked_for():
    made = simulate(seed=4, n_poses=24)
    up = np.round(made.nominal[:, 2])
    some = made.nominal[up[:, 2] > -0.5][:10]  # never upside down
    planned = plan_more(record(made, some, 7), n=2)
    assert "-z" in [side(s.R[2]) for s in planned.steps]


def test_a_recording_that_tells_nothing_gets_a_whole_plan():
    made = simulate(seed=4, n_poses=2, rest_s=2.0)
    planned = plan_more(made.recording)
    assert planned.hands == "box" and len(planned.steps) == 18 and planned.issues
    assert all(v < 0.2 for v in planned.after_deg.values())


def test_a_gyroscope_by_its_datasheet_gains_from_turns():
    made = simulate(seed=2, poses="free", n_poses=12, rest_s=2.0)
    gyr = made.recording.streams["gyr"]
    rate = replace(gyr, y=np.degrees(made.truth.models["gyr"].apply(gyr.y)), unit="dps")
    planned = plan_more(replace(made.recording, gyr=rate), n=3)
    assert planned.after_deg["gyr"] < planned.before_deg["gyr"]


# --- words and pictures -------------------------------------------------------------------------------


def test_turns_in_words_make_the_turn():
    named = {"quarter": np.pi / 2, "half": np.pi}
    for R in so3.cube_group()[1:]:
        made = np.eye(3)
        for part in turn_words(so3.log(R)).split(", then "):
            size, _, _, axis = part.split()
            made = made @ so3.exp(named[size] * float(f"{axis[0]}1") * np.eye(3)["xyz".index(axis[1])])
        np.testing.assert_allclose(made, R, atol=1e-9)
    assert turn_words(np.radians([60.0, 0, 80.0])) == "100 degrees about (0.6 0.0 0.8)"
    assert turn_words(np.zeros(3)) == "none"


def test_sides_in_words():
    assert side(np.array([0.0, 0.1, -0.99])) == "-z"
    assert side(np.array([0.7, 0.0, -0.7])) == "+x -z edge"
    assert side(np.array([-0.6, 0.6, 0.5])) == "-x +y +z corner"


@pytest.mark.parametrize("hands", ["box", "free"])
def test_the_drawing_is_svg_with_a_box_for_each_attitude(hands):
    made = plan(hands, 7)
    root = ElementTree.fromstring(drawing(made))
    boxes = [e for e in root.iter() if e.get("class") == "up"]
    assert len(boxes) == 7
    words = " ".join(root.itertext())
    assert "start here" in words and side(made.steps[3].R[2]) in words


# --- the verb -----------------------------------------------------------------------------------------


def test_the_verb_prints_draws_and_tells_programs(tmp_path, capsys):
    picture = tmp_path / "plan.svg"
    assert run(["plan", "-n", "12", "-o", str(picture)]) == 0
    out = capsys.readouterr().out.splitlines()
    assert out[0].startswith("12 attitudes of a box put down on its faces: expected error acc 0.")
    assert sum(line.strip()[:2].strip().isdigit() for line in out[1:]) == 12
    assert picture.read_text().startswith("<svg")
    assert run(["plan", "-o", str(picture)]) == 1  # it exists
    assert run(["plan", "-o", str(tmp_path / "plan.png")]) == 2
    assert run(["plan", "-n", "0"]) == 2
    capsys.readouterr()
    assert run(["plan", "--free", "-n", "5", "--json", "--sensors", "acc,mag"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["hands"] == "free" and len(told["poses"]) == 5
    first, second = told["poses"][:2]
    assert first["turn"] is None and set(second["expected_error_deg"]) == {"acc", "mag"}
    R = so3.matrix_from_quat([p["q_wxyz"] for p in told["poses"]])
    np.testing.assert_allclose(R[:, 2], [p["up_vector"] for p in told["poses"]], atol=1e-5)


def test_the_verb_after_a_recording(tmp_path, capsys):
    write_simulation(simulate(seed=5, n_poses=12, rest_s=2.0), tmp_path)
    path = str(tmp_path / "session.parquet")
    assert run(["plan", path, "--json", "-n", "3"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (
        told["hands"] == "box"
        and len(told["poses"]) == 3
        and told["last"]["up"] in ("+x", "-x", "+y", "-y", "+z", "-z")
    )
    assert all(told["after_deg"][k] < told["before_deg"][k] for k in KINDS)
    turn = so3.exp(np.radians(told["poses"][0]["turn"]["angle_deg"]) * np.array(told["poses"][0]["turn"]["axis"]))
    before, after = so3.matrix_from_quat([told["last"]["q_wxyz"], told["poses"][0]["q_wxyz"]])
    np.testing.assert_allclose(before @ turn, after, atol=1e-4)
    assert run(["plan", path]) == 0
    out = capsys.readouterr().out
    assert "the next 6 attitudes take the expected error from acc" in out and "the node lies as in its last rest" in out


@pytest.mark.parametrize(
    "name", ["mikoff/mpu9150_imu0.parquet", "tyrex/calib_acc_Nexus5_d1", "imucal/ferraris_session.parquet"]
)
def test_real_recordings_get_a_plan(data_file, name, capsys):
    assert run(["plan", str(data_file(name)), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert len(told["poses"]) == 6
    assert all(told["after_deg"][k] <= v for k, v in told["before_deg"].items())
