"""`margcal evaluate`: the figures against closed forms, scipy and BROAD; times, gaps, alignment, tables."""

from __future__ import annotations

import json
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

import margcal
from conftest import find_data
from margcal.apps import cli
from margcal.core import so3
from margcal.core.errors import DataError, InputError
from margcal.core.types import Attitude
from margcal.files.attitude_table import read_attitudes
from margcal.files.tables import write_table
from margcal.workflow.evaluate import euler_zyx, evaluate

Z, X = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])


def wxyz(rotation: Rotation) -> np.ndarray:
    return np.roll(rotation.as_quat(), 1, axis=-1)


def motion(t: np.ndarray) -> np.ndarray:
    """A smooth motion through all headings, pitch below 60 degrees: quaternions (N, 4)."""
    angles = np.column_stack([1.2 * t, 1.0 * np.sin(0.7 * t), 2.5 * np.sin(0.9 * t + 0.4)])
    return wxyz(Rotation.from_euler("ZYX", angles))


def track(rate: float = 100.0, seconds: float = 20.0, start: float = 0.0) -> Attitude:
    t = start + np.arange(round(rate * seconds)) / rate
    return Attitude(t, motion(t))


def turned(a: Attitude, laboratory: np.ndarray | None = None, body: np.ndarray | None = None) -> Attitude:
    """The track with constant rotation vectors (degrees) of laboratory and body."""
    left, right = (so3.quat_exp(np.radians(np.zeros(3) if v is None else v)) for v in (laboratory, body))
    return Attitude(a.t, so3.quat_multiply(so3.quat_multiply(left, a.q), right))


def columns(a: Attitude, prefix: str = "q") -> dict[str, np.ndarray]:
    return {"t_s": a.t, **{f"{prefix}{c}": a.q[:, i] for i, c in enumerate("wxyz")}}


# --- figures ------------------------------------------------------------------------------------------


def test_a_turn_about_the_vertical_is_heading_and_one_about_the_horizon_is_inclination():
    ref = track()
    about_z = evaluate(turned(ref, laboratory=3 * Z), ref)
    assert (about_z.total_deg, about_z.heading_deg) == pytest.approx((3, 3), abs=1e-9)
    assert about_z.inclination_deg == pytest.approx(0, abs=1e-7)
    assert about_z.yaw.mean == pytest.approx(3, abs=1e-9) and about_z.yaw.sd == pytest.approx(0, abs=1e-9)
    assert about_z.roll.rms == pytest.approx(0, abs=1e-9)
    about_x = evaluate(turned(ref, laboratory=2 * X), ref)
    assert (about_x.total_deg, about_x.inclination_deg) == pytest.approx((2, 2), abs=1e-9)
    assert about_x.heading_deg == pytest.approx(0, abs=1e-7)
    # a turn of the body about its x axis is an error of roll alone
    about_body = evaluate(turned(ref, body=-4 * X), ref)
    assert about_body.roll.mean == pytest.approx(-4, abs=1e-9)
    assert about_body.pitch.rms == pytest.approx(0, abs=1e-9) and about_body.yaw.rms == pytest.approx(0, abs=1e-9)
    assert about_body.quaternion == pytest.approx(2 * np.sin(np.radians(1)), rel=1e-9)  # |q1 - q2| = 2 sin(angle / 4)


def test_broads_definitions_computed_another_way():
    """Total is the angle of the error rotation; heading the turn about z nearest to it; inclination the tilt of up."""
    rng = np.random.default_rng(0)
    ref = track(50)
    est = Attitude(ref.t, so3.quat_multiply(so3.quat_exp(0.2 * rng.normal(size=(len(ref.t), 3))), ref.q))
    found = evaluate(est, ref)
    D = (est.R * ref.R.inv()).as_matrix()
    up = np.degrees(np.arccos(D[:, 2, 2]))
    nearest = np.degrees(np.arctan2(D[:, 1, 0] - D[:, 0, 1], D[:, 0, 0] + D[:, 1, 1]))  # argmax over turns about z
    total = np.degrees((est.R * ref.R.inv()).magnitude())
    for mine, theirs in zip((found.total_deg, found.heading_deg, found.inclination_deg), (total, nearest, up)):
        assert mine == pytest.approx(np.sqrt(np.mean(theirs**2)), rel=1e-9)


def test_roll_pitch_yaw_are_scipys():
    q = wxyz(Rotation.from_quat(np.random.default_rng(1).normal(size=(500, 4))))
    theirs = Rotation.from_quat(np.roll(q, -1, axis=1)).as_euler("ZYX")[:, ::-1]
    np.testing.assert_allclose(euler_zyx(q), theirs, atol=1e-7)


def test_angles_that_jump_at_180_degrees_neither_raise_the_error_nor_hide_the_correlation():
    ref = track()
    found = evaluate(turned(ref, laboratory=1.5 * Z), ref)
    assert np.ptp(np.degrees(euler_zyx(ref.q)[:, 2])) > 355  # the yaw does go round
    assert found.yaw.rms == pytest.approx(1.5, abs=1e-9)
    assert found.yaw.correlation == pytest.approx(1, abs=1e-12)
    still = Attitude(ref.t, np.tile([1.0, 0, 0, 0], (len(ref.t), 1)))
    assert np.isnan(evaluate(still, still).yaw.correlation)


def test_the_sign_of_a_quaternion_means_nothing():
    ref = track()
    flipped = Attitude(ref.t, -ref.q)
    found = evaluate(flipped, ref)
    assert found.total_deg < 1e-9 and found.quaternion < 1e-12 and abs(found.heading_deg) < 1e-9


# --- times --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("rate", "times"), [(60.0, "reference"), (90.0, "estimate"), (250.0, "estimate")])
def test_other_rates_are_interpolated_on_the_sphere(rate, times):
    est, ref = track(100.0), track(rate, start=0.003)
    found = evaluate(est, ref)
    assert found.times == times
    assert found.total_deg < 0.02  # half the second difference of the motion over a step
    inside = est.t[(est.t >= ref.t[0]) & (est.t <= ref.t[-1])]
    if times == "estimate":
        np.testing.assert_allclose(found.t, inside)
        theirs = wxyz(Slerp(ref.t, ref.R)(inside))
        np.testing.assert_allclose(np.abs(np.sum(theirs * found.q_ref, axis=1)), 1, atol=1e-12)


def test_gaps_are_left_out_and_not_interpolated_across():
    est, ref = track(100.0), track(100.0)
    q = ref.q.copy()
    q[500:503] = np.nan
    gone = (ref.t >= 8) & (ref.t < 9)
    with_gaps = Attitude(ref.t[~gone], q[~gone])
    found = evaluate(est, with_gaps)
    assert found.n_common == len(ref.t) - 3 - 100 and found.total_deg < 1e-9
    shifted = Attitude(with_gaps.t + 0.004, with_gaps.q)  # between its samples: next to a gap there is no neighbour
    assert evaluate(est, shifted).n_common < found.n_common
    t = evaluate(est, shifted).t
    assert not ((t > 4.99) & (t < 5.03)).any() and not ((t > 8.0) & (t < 9.0)).any()


def test_tracks_without_common_time_are_refused():
    with pytest.raises(DataError, match=r"0 samples in common"):
        evaluate(track(), track(start=100.0))


@pytest.mark.parametrize("offset", [0.137, -0.25, 3.3])
def test_the_offset_of_the_clocks_is_found_whatever_the_frames(offset):
    rng = np.random.default_rng(3)
    ref = track(100.0, 40.0)
    est = track(120.0, 40.0, start=0.5)
    noise = so3.quat_exp(np.radians(0.02) * rng.normal(size=(len(est.t), 3)))
    est = turned(Attitude(est.t, so3.quat_multiply(est.q, noise)), laboratory=70 * Z, body=20 * X)
    late = Attitude(est.t - offset, est.q)
    found = evaluate(late, ref, align_time=True, align_frames="full")
    assert found.time_offset_s == pytest.approx(offset, abs=2e-4)
    assert found.total_deg < 0.1
    assert evaluate(late, ref, align_frames="full").total_deg > 3


def test_different_motions_are_not_aligned():
    t = np.arange(3000) / 100
    other = Attitude(t, so3.quat_exp(np.column_stack([np.zeros(3000), 3 * np.sin(3.1 * t), np.zeros(3000)])))
    with pytest.raises(DataError, match="no offset between the clocks"):
        evaluate(other, track(100.0, 30.0), align_time=True)


# --- frames -------------------------------------------------------------------------------------------


def test_frames_are_turned_only_when_asked_and_what_was_found_is_said():
    ref = track()
    lab, body = np.array([10.0, -20.0, 150.0]), np.array([-5.0, 60.0, 30.0])
    est = turned(ref, lab, body)
    assert evaluate(est, ref).total_deg > 100
    full = evaluate(est, ref, align_frames="full")
    assert full.total_deg < 1e-6
    np.testing.assert_allclose(full.frames.laboratory_deg, -lab, atol=1e-6)
    np.testing.assert_allclose(full.frames.body_deg, -body, atol=1e-6)
    yaw = evaluate(turned(ref, laboratory=-170 * Z), ref, align_frames="yaw")
    assert yaw.total_deg < 1e-6
    np.testing.assert_allclose(yaw.frames.laboratory_deg, 170 * Z, atol=1e-6)


def test_a_motion_about_one_axis_does_not_tell_the_two_frames_apart():
    t = np.arange(2000) / 100
    ref = Attitude(t, so3.quat_exp(np.outer(np.sin(t), Z)))
    found = evaluate(turned(ref, laboratory=5 * X), ref, align_frames="full")
    assert "frames-not-told" in [i.code for i in found.issues]


# --- which samples ------------------------------------------------------------------------------------


def test_only_moving_samples_count_where_a_column_says_which(tmp_path):
    ref = track()
    moved = ref.t >= 5
    est = turned(ref, laboratory=2 * Z)
    q = np.where(moved[:, None], est.q, turned(ref, laboratory=8 * Z).q)
    write_table(tmp_path / "est.csv", columns(Attitude(ref.t, q)))
    write_table(tmp_path / "ref.csv", {**columns(ref, "ref_q"), "movement": moved})  # true and false in the file
    found = evaluate(tmp_path / "est.csv", tmp_path / "ref.csv")
    assert found.samples == "movement" and found.n == moved.sum()
    assert found.heading_deg == pytest.approx(2, abs=1e-6)
    everything = evaluate(tmp_path / "est.csv", tmp_path / "ref.csv", all_samples=True)
    assert everything.samples == "all" and everything.heading_deg > 4
    assert evaluate(Attitude(ref.t, q), ref, movement=moved).heading_deg == pytest.approx(2, abs=1e-9)
    with pytest.raises(DataError, match="movement leaves 0"):
        evaluate(Attitude(ref.t, q), ref, movement=np.zeros(len(ref.t)))


# --- tables -------------------------------------------------------------------------------------------


def test_a_folder_and_tables_with_both_kinds_of_columns(tmp_path):
    ref = track(50)
    est = turned(ref, laboratory=Z)
    (tmp_path / "session").mkdir()
    write_table(tmp_path / "session" / "acc.csv", {"t_s": ref.t, "acc_x_mps2": 0 * ref.t})
    both = {**columns(est), **{k: v for k, v in columns(ref, "ref_q").items() if k != "t_s"}}
    write_table(tmp_path / "session" / "optics.csv", both)
    assert read_attitudes(tmp_path / "session", prefer="ref_q").columns == "ref_q"
    assert evaluate(tmp_path / "session", tmp_path / "session").heading_deg == pytest.approx(1, abs=1e-6)


def test_a_slower_track_in_a_faster_table(tmp_path):
    ref = track(100)
    q = np.where((np.arange(len(ref.t)) % 4 == 0)[:, None], ref.q, np.nan)
    write_table(tmp_path / "ref.parquet", columns(Attitude(ref.t, q), "ref_q"))
    found = evaluate(ref, tmp_path / "ref.parquet")
    assert found.times == "reference" and found.n_common == len(ref.t) // 4 and found.total_deg < 1e-9


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"t_s": [0.0, 1.0], "acc_x_mps2": [0, 0]}, "no attitudes among the columns"),
        ({"t_s": [0.0, 1.0], "qw": [1.0, 1.0], "qx": [0.0, 0.0]}, "only qw, qx found"),
        ({"qw": [1.0], "qx": [0.0], "qy": [0.0], "qz": [0.0]}, "no column t_s"),
        ({"t_s": [0.0, 1.0], "qw": [9.0, 9.0], "qx": [0, 0], "qy": [0, 0], "qz": [0, 0]}, "qw qx qy qz are the right"),
        ({"t_s": [1.0, 0.0], "qw": [1.0, 1.0], "qx": [0, 0], "qy": [0, 0], "qz": [0, 0]}, "time runs backwards"),
    ],
)
def test_tables_that_are_no_attitudes_are_refused(tmp_path, table, message):
    write_table(tmp_path / "est.csv", {k: np.asarray(v, dtype=float) for k, v in table.items()})
    with pytest.raises(InputError, match=message) as error:
        read_attitudes(tmp_path / "est.csv")
    assert "ref_q" not in str(error.value)


# --- the verb -----------------------------------------------------------------------------------------


def test_the_verb_prints_writes_and_draws(tmp_path, capsys):
    ref = track(200)
    est, target = tmp_path / "est.csv", tmp_path / "ref.csv"
    write_table(est, columns(turned(ref, laboratory=2 * Z)))
    write_table(target, columns(ref, "ref_q"))
    assert cli.run(["evaluate", str(est), str(target), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["heading_deg"] == pytest.approx(2, abs=1e-6)
    assert set(found["yaw"]) == {"rms", "mean", "sd", "correlation"}
    assert found["time_offset_s"] is None and found["laboratory_turned_deg"] == [0, 0, 0]
    assert cli.run(["evaluate", str(est), str(target), "-o", str(tmp_path / "out"), "--align-frames", "yaw"]) == 0
    assert "turned by -2.000 deg about the vertical" in capsys.readouterr().out
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"evaluation.json", "errors.csv", "evaluation.svg"}
    ElementTree.parse(tmp_path / "out" / "evaluation.svg")
    assert cli.run(["evaluate", str(est), str(target), "-o", str(tmp_path / "one.svg")]) == 0
    ElementTree.parse(tmp_path / "one.svg")
    assert cli.run(["evaluate", str(est), str(target), "-o", str(tmp_path / "one.svg")]) == 1  # exists
    capsys.readouterr()
    assert cli.run(["evaluate", str(est), str(est), "-o", str(est), "--overwrite"]) == 2
    assert cli.run(["evaluate", str(tmp_path / "none.csv"), str(target)]) == 1


def test_a_short_track_breaks_its_curve_at_gaps(tmp_path):
    t = np.concatenate([np.arange(50), 200 + np.arange(50)]) / 50
    ref = Attitude(t, motion(t))
    from margcal.apps.evaluating import picture

    svg = picture(evaluate(turned(ref, laboratory=Z), ref), "a & b")
    assert ElementTree.fromstring(svg) is not None and "nan" not in svg.lower()


# --- real ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("trial", "online", "offline"),
    [
        ("05_undisturbed_slow_rotation_with_breaks_B", (0.99, 0.92, 0.35), (0.63, 0.57, 0.27)),
        ("21_undisturbed_fast_combined", (4.08, 3.70, 1.72), (5.24, 5.15, 0.95)),
        ("33_disturbed_attached_magnet_2cm", (3.75, 3.70, 0.60), (1.81, 1.77, 0.39)),
    ],
)
def test_vqf_on_broad_gives_the_figures_of_the_datas_readme(trial, online, offline):
    """All eight trials: benchmarks/studies/evaluate.py."""
    vqf = pytest.importorskip("vqf")
    path = find_data(f"broad/{trial}.parquet")
    recording = margcal.read(path)
    assert recording.acc is not None and recording.gyr is not None and recording.mag is not None
    acc, gyr, mag = (np.ascontiguousarray(s.y) for s in (recording.acc, recording.gyr, recording.mag))
    t = recording.gyr.t
    ts = (t[-1] - t[0]) / (len(t) - 1)
    for q, wanted in (
        (vqf.VQF(ts).updateBatch(gyr, acc, mag)["quat9D"], online),
        (vqf.offlineVQF(gyr, acc, mag, ts)["quat9D"], offline),
    ):
        found = margcal.evaluate(Attitude(t, q), Path(path))
        assert found.samples == "movement"
        assert (found.total_deg, found.heading_deg, found.inclination_deg) == pytest.approx(wanted, abs=0.02)
