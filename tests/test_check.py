"""`margcal check`: what it says of good nodes (nothing bad) and of bad ones, and what the motion proves of the axes."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from margcal.apps.cli import run
from margcal.core import so3
from margcal.core.errors import DataError, UsageError
from margcal.core.types import Recording, Stream
from margcal.files.tables import read
from margcal.methods.rates import relate
from margcal.workflow.findings import Finding
from margcal.workflow.inspect import Inspection, inspect
from margcal.workflow.place import parse_at
from margcal.workflow.simulate import simulate, swing, write_simulation

PLACE = "48.1,11.6"


def one(found: Inspection, check: str, sensor: str | None = None) -> Finding:
    hits = [f for f in found.findings if f.check == check and (sensor is None or f.sensor == sensor)]
    assert hits, f"nothing about {check} {sensor}"
    return hits[0]


def turned(stream: Stream | None, matrix: np.ndarray) -> Stream:
    """A sensor with its axes swapped or reversed."""
    assert stream is not None
    return replace(stream, y=stream.y @ matrix.T)


# --- relate -------------------------------------------------------------------------------------------


def motion(delay: float, matrix: np.ndarray, noise: float, n: int = 6000):
    """A fixed direction in a node that turns about changing axes, seen `delay` late, and the raw gyroscope."""
    rng = np.random.default_rng(1)
    t = np.arange(n) / 200
    rate = np.column_stack([1.5 * np.sin(0.9 * t), 1.2 * np.cos(1.3 * t + 1), 1.4 * np.sin(0.5 * t + 2)])
    steps = so3.exp((rate[1:] + rate[:-1]) / 2 / 200)
    R = np.eye(3)
    v = [np.array([0.0, 0.8, -0.6])]
    for step in steps:
        R = R @ step
        v.append(R.T @ v[0])
    seen = np.column_stack([np.interp(t - delay, t, np.array(v)[:, k]) for k in range(3)])
    return t, seen + noise * rng.normal(size=(n, 3)), t, rate @ np.linalg.inv(matrix).T


@pytest.mark.parametrize("delay", [0.0, 0.012, -0.03, 0.08])
def test_relate_finds_the_delay_within_its_standard_error(delay):
    found = relate(*motion(delay, np.eye(3), 0.01))
    assert abs(found.delay_s - delay) < 4 * found.delay_se_s + 1e-4
    assert found.delay_se_s < 0.004
    np.testing.assert_allclose(found.G, np.eye(3), atol=0.01)


@pytest.mark.parametrize("seed", range(4))
def test_relate_finds_any_matrix_mirrored_ones_too(seed):
    rng = np.random.default_rng(seed)
    G = 1e-3 * (so3.cube_group()[rng.integers(24)] + 0.1 * rng.normal(size=(3, 3))) * rng.choice([-1, 1])
    found = relate(*motion(0.0, G, 0.0))
    np.testing.assert_allclose(found.G, G, atol=2e-5)
    assert found.explained > 0.999


def test_relate_standard_error_is_on_the_safe_side():
    t, v, t_gyr, z = motion(0.0, np.eye(3), 0.0)
    rng = np.random.default_rng(5)
    found = [relate(t, v + 0.03 * rng.normal(size=v.shape), t_gyr, z) for _ in range(25)]
    spread = np.std([f.delay_s for f in found])
    assert 0.9 < np.sqrt(np.mean([f.delay_se_s**2 for f in found])) / spread < 3


def test_relate_refuses_what_has_no_time_in_common():
    t, v, t_gyr, z = motion(0.0, np.eye(3), 0.0)
    with pytest.raises(DataError, match="in common"):
        relate(t + 100, v, t_gyr, z)


# --- good nodes ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("poses", ["cube", "free", "faces"])
def test_a_good_node_raises_no_alarm(seed, poses):
    made = simulate(seed=seed, poses=poses, n_poses=18, rest_s=2.0, place=parse_at(PLACE), knocks=1)
    found = inspect(made.recording, place=parse_at(PLACE))
    assert [(f.check, f.text) for f in found.findings if f.level in ("warn", "fail")] == []
    assert all(c.level == "pass" for c in found.carried) and len(found.carried) == 3
    assert found.conclusion == "ready to calibrate: accelerometer, gyroscope and magnetometer"
    assert found.next_steps == ()
    assert one(found, "sign").level == "pass"
    assert one(found, "axes", "acc").level == one(found, "axes", "mag").level == "pass"


def test_a_swing_is_ready_for_the_magnetometer_only():
    node = swing(seed=2, mag_delay_s=0.02)
    scaled = node.truth.models["gyr"].apply(node.recording.streams["gyr"].y)  # a gyroscope in a known unit
    recording = replace(node.recording, gyr=Stream("gyr", node.recording.streams["gyr"].t, scaled, "radps"))
    found = inspect(recording)
    assert [c.level for c in found.carried] == ["fail", "fail", "pass"]
    assert found.level == "warn"
    delay = one(found, "delay")
    assert delay.level == "note" and delay.value == pytest.approx(20, abs=8)


# --- axes ---------------------------------------------------------------------------------------------

NODE = simulate(seed=3, n_poses=14, rest_s=2.0, place=parse_at(PLACE)).recording
BOARD = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@pytest.mark.parametrize("axis", range(3))
def test_a_flipped_gyroscope_axis_is_named(axis):
    flip = np.eye(3)
    flip[axis, axis] = -1
    found = one(inspect(replace(NODE, gyr=turned(NODE.gyr, flip))), "axes", "acc")
    assert found.level == "warn"
    assert "left-handed" in found.text and f"most likely {'xyz'[axis]}" in found.text


def test_a_gyroscope_that_turns_the_other_way_is_named():
    found = one(inspect(replace(NODE, gyr=turned(NODE.gyr, -np.eye(3)))), "axes", "acc")
    assert found.level == "warn" and "by the left hand" in found.text


def test_swapped_axes_are_named_and_a_board_is_no_alarm():
    found = inspect(replace(NODE, mag=turned(NODE.mag, BOARD.T)))
    mag = one(found, "axes", "mag")
    assert mag.level == "note" and "x is y, y is x, z is -z" in mag.text
    cyclic = np.roll(np.eye(3), 1, axis=0)
    acc = one(inspect(replace(NODE, acc=turned(NODE.acc, cyclic))), "axes", "acc")
    assert acc.level == "warn" and "x is z, y is x, z is y" in acc.text


def test_one_flipped_axis_of_the_accelerometer_is_told_with_what_looks_the_same():
    found = one(inspect(replace(NODE, acc=turned(NODE.acc, np.diag([1.0, 1.0, -1.0])))), "axes", "acc")
    assert found.level == "warn"
    assert "x is -x, y is -y" in found.text and "left-handed accelerometer: its z is -z" in found.text


def test_still_sensors_prove_nothing():
    n = 2000
    rng = np.random.default_rng(0)
    t = np.arange(n) / 100
    still = Recording.from_arrays(
        t,
        acc=rng.normal([0, 0, 9.8], 0.02, (n, 3)),
        gyr=rng.normal(0, 0.01, (n, 3)),
        mag=rng.normal([20, 0, -40], 0.3, (n, 3)),
        units={"acc": "mps2", "gyr": "radps", "mag": "uT"},
    )
    found = inspect(still)
    assert {one(found, "axes", k).level for k in ("acc", "mag")} == {"note"}
    assert one(found, "delay").value is None
    assert [c.level for c in found.carried] == ["fail", "warn", "fail"]


# --- sign ---------------------------------------------------------------------------------------------


def test_the_sign_is_told_only_where_something_from_outside_tells_it():
    gravity = replace(NODE, acc=turned(NODE.acc, -np.eye(3)))
    for recording in (NODE, gravity):
        alone = one(inspect(recording), "sign")
        assert alone.level == "note" and "cannot be seen" in alone.text
    assert one(inspect(NODE, place=parse_at(PLACE)), "sign").level == "pass"
    wrong = one(inspect(gravity, place=parse_at(PLACE)), "sign")
    assert wrong.level == "warn" and "gravity instead of specific force" in wrong.todo
    south = one(inspect(NODE, place=parse_at("-33.9,151.2")), "sign")
    assert south.level == "warn"


def test_the_side_that_was_up_settles_it():
    k = np.argmax(np.abs(side := simulate(seed=3, n_poses=14, rest_s=2.0).R_nh[0, 2]))
    up = f"{'+' if side[k] > 0 else '-'}{'xyz'[k]}"
    assert one(inspect(NODE, up=up), "sign").level == "pass"
    gravity = replace(NODE, acc=turned(NODE.acc, -np.eye(3)))
    found = inspect(gravity, up=up)
    assert one(found, "sign").level == "fail" and found.level == "fail"
    with pytest.raises(UsageError, match="none of"):
        inspect(NODE, up="top")


# --- what is missing ----------------------------------------------------------------------------------


def test_too_little_is_said_with_what_to_record_next():
    few = simulate(seed=1, poses="free", n_poses=4, rest_s=2.0).recording
    found = inspect(few)
    assert one(found, "rests").level == "warn" and one(found, "rests").value == 4
    assert next(c for c in found.carried if c.kind == "acc").level == "fail"
    assert any("more attitudes" in step for step in found.next_steps)


def test_a_face_that_never_was_up_is_named():
    made = simulate(seed=1, n_poses=24, rest_s=2.0)
    up = made.nominal[:, 2, :]
    never = up @ np.array([0.0, 0.0, 1.0]) < -0.9  # -z up
    keep = np.ones(len(made.recording.streams["acc"].t), dtype=bool)
    t = made.recording.streams["acc"].t
    for a, b in zip(made.start[never], made.stop[never]):
        keep &= (t < a - 0.3) | (t > b + 0.3)
    cut = {k: replace(s, t=s.t[keep], y=s.y[keep]) for k, s in made.recording.streams.items()}
    found = inspect(replace(made.recording, **cut))
    assert one(found, "faces").level == "warn" and "never -z" in one(found, "faces").text
    assert "put it down with -z up" in found.next_steps


def test_a_wrong_unit_fails_before_anything_else_is_looked_at():
    acc = Stream("acc", NODE.streams["acc"].t, NODE.streams["acc"].y / 2048, "mps2")  # it is g
    found = inspect(replace(NODE, acc=acc))
    assert found.level == "fail" and one(found, "unit", "acc").level == "fail"
    assert found.segmentation is None


def test_a_saturated_gyroscope_still_tells_its_axes():
    gyr = NODE.streams["gyr"]
    clipped = Stream("gyr", gyr.t, np.clip(gyr.y, -900, 900), "count")
    found = inspect(replace(NODE, gyr=clipped))
    assert one(found, "range", "gyr").level == "fail"
    assert one(found, "axes", "acc").level == "pass"
    assert "not: gyroscope" in found.conclusion


# --- the verb -----------------------------------------------------------------------------------------


def test_the_verb_prints_a_conclusion_first_and_json_says_the_same(tmp_path, capsys):
    write_simulation(simulate(seed=5, n_poses=16, rest_s=2.0), tmp_path)
    path = str(tmp_path / "session.parquet")
    assert run(["check", path]) == 0
    out = capsys.readouterr().out.splitlines()
    assert out[0] == "session.parquet: ready to calibrate: accelerometer, gyroscope and magnetometer"
    assert any(line.split()[:2] == ["unit", "acc"] for line in out)
    assert run(["check", path, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["level"] == "note" and told["exit_status"] == 0 and told["rests"] == 16
    assert {c["check"] for c in told["checks"]} >= {"unit", "range", "clock", "rests", "axes", "sign", "delay"}
    assert set(told["sensors"]) == {"acc", "gyr", "mag"}


def test_a_check_that_fails_exits_with_three(tmp_path, capsys):
    write_simulation(simulate(seed=5, n_poses=2, rest_s=2.0), tmp_path)
    path = str(tmp_path / "session.parquet")
    assert run(["check", path]) == 3
    out = capsys.readouterr().out
    assert "not: accelerometer" in out and "what to do:" in out and f"margcal plan {path}" in out
    assert run(["check", path, "--json"]) == 3
    assert json.loads(capsys.readouterr().out)["exit_status"] == 3
    assert run(["check", str(tmp_path / "none.csv")]) == 1
    assert run(["check", path, "--up", "top"]) == 2


# --- real recordings ----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["imu_tk/xsens_mti_multipose.parquet", "mikoff/mpu9150_imu1.parquet"])
def test_real_sessions_are_ready(data_file, name):
    found = inspect(read(data_file(name)))
    assert {c.kind: c.level for c in found.carried} == {"acc": "pass", "gyr": "pass"}
    assert one(found, "axes", "acc").level == "pass" and found.level != "fail"


def test_broad_is_late_by_what_its_readme_says(data_file):
    for trial in ("08_undisturbed_fast_rotation_with_breaks_A", "21_undisturbed_fast_combined"):
        delay = one(inspect(read(data_file(f"broad/{trial}.parquet"))), "delay")
        assert delay.level == "note" and delay.value is not None and 9.5 < delay.value < 12.5


def test_translation_and_stillness_prove_nothing(data_file):
    found = inspect(read(data_file("broad/12_undisturbed_slow_translation_C.parquet")))
    assert {one(found, "axes", k).level for k in ("acc", "mag")} == {"note"}
    assert [c.kind for c in found.carried if c.level == "pass"] == []
    still = inspect(read(data_file("sunsided/set-2_unmoved-with-z-pointing-front-and-x-up")))
    assert one(still, "axes", "acc").level == "note"


def test_sunsided_has_a_gyroscope_that_is_the_odd_one(data_file):
    found = inspect(read(data_file("sunsided/set-2_full-sphere")))
    for kind in ("acc", "mag"):
        axes = one(found, "axes", kind)
        assert axes.level == "warn" and "x is -x, y is -y of the gyroscope" in axes.text
        assert "left-handed" in axes.text and "the gyroscope is the odd one" in axes.todo


def test_an_attached_magnet_makes_the_field_doubtful(data_file):
    found = inspect(read(data_file("broad/33_disturbed_attached_magnet_2cm.parquet")))
    mag = next(c for c in found.carried if c.kind == "mag")
    assert mag.level == "warn" and "off a sphere" in mag.text
    assert any("magnets and iron" in step for step in found.next_steps)
