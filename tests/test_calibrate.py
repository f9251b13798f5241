"""The main job on simulated nodes: raw counts in, a calibrated node out, against the truth."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from margcal.core import so3
from margcal.core.errors import DataError, InputError, UsageError
from margcal.core.types import Calibration, Recording, SensorModel
from margcal.files.calfile import dumps
from margcal.files.poses_table import PoseTable
from margcal.methods.uncertainty import direction_errors_deg
from margcal.workflow.calibrate import calibrate
from margcal.workflow.place import at
from margcal.workflow.simulate import Simulation, simulate, swing

LONDON = at(51.5, -0.17, 2025.5)
KINDS = ("acc", "gyr", "mag")


def frame_of(sim: Simulation, calibration: Calibration) -> np.ndarray:
    """Rotation from the housing to the calibration's frame h (by QR where the accelerometer defines it)."""
    if calibration.frame != "acc-triangular":
        return np.eye(3)
    Q, upper = np.linalg.qr(sim.truth.models["acc"].H)
    return (Q * np.sign(np.diag(upper))).T


def errors(sim: Simulation, calibration: Calibration) -> dict[str, np.ndarray]:
    """Angle (deg) between calibrated and true vector over the sphere, by sensor."""
    Q = frame_of(sim, calibration)
    out = {}
    for kind, model in calibration.models.items():
        true = sim.truth.models[kind]
        size = None if kind == "gyr" else float(np.linalg.norm(true.reference_vector))
        out[kind] = direction_errors_deg(model.H, model.B, Q @ true.H, true.B, size)
    return out


def worst(sim: Simulation, calibration: Calibration) -> float:
    return max(float(e.max()) for e in errors(sim, calibration).values())


def levels(calibration: Calibration, level: str) -> list[str]:
    return [i.code for i in calibration.issues if i.level == level]


@cache
def cube(seed: int = 0, **options) -> Simulation:
    return simulate(seed=seed, **options)


@cache
def plain(seed: int = 0) -> Calibration:
    """The cube's calibration with nothing told."""
    return calibrate(cube(seed).recording)


def transformed(sim: Simulation, matrices: dict) -> Simulation:
    """The same node with raw axes `matrices[kind]` times what they were."""
    streams, models = {}, {}
    for kind, stream in sim.recording.streams.items():
        M = np.asarray(matrices.get(kind, np.eye(3)), dtype=float)
        streams[kind] = replace(stream, y=stream.y @ M.T)
        true = sim.truth.models[kind]
        models[kind] = replace(true, H=true.H @ np.linalg.inv(M), B=M @ true.B)
    return replace(sim, recording=replace(sim.recording, **streams), truth=replace(sim.truth, **models))


# --- the demand --------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
def test_unlabelled_cube_is_right_everywhere_on_the_sphere(seed):
    board = seed % 2 == 0
    options = {"mag_axes": "board", "place": LONDON} if board else {}
    sim = simulate(seed=seed, **options)
    calibration = calibrate(sim.recording, place=LONDON if board else None)
    assert calibration.frame == "housing"
    assert calibration.settings["attitudes"] == "cube"
    assert set(calibration.models) == set(KINDS)
    for kind, error in errors(sim, calibration).items():
        assert error.max() <= 0.4, kind  # the issue's bar
        assert error.max() <= 0.15, kind  # what it is
        assert np.sqrt(np.mean(error**2)) < 3 * calibration.models[kind].expected_error_deg
    assert not levels(calibration, "warn")
    assert not levels(calibration, "fail")


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("poses, bar", [("faces", 0.25), ("free", 0.1)])
def test_other_ways_to_put_a_node_down(poses, bar, seed):
    sim = simulate(seed=seed, poses=poses, mag_axes="board", place=LONDON)
    calibration = calibrate(sim.recording, place=LONDON)
    assert calibration.settings["attitudes"] == poses
    assert calibration.frame == ("housing" if poses == "faces" else "acc-triangular")
    assert set(calibration.models) == set(KINDS)
    assert worst(sim, calibration) < bar
    told = calibrate(sim.recording, place=LONDON, poses=poses)
    assert np.array_equal(told.acc.H, calibration.acc.H)


@pytest.mark.parametrize("mounting_deg", [12.0, 20.0])
def test_a_badly_mounted_sensor_is_labelled_right_too(mounting_deg):
    sim = cube(1, mounting_deg=mounting_deg)
    assert worst(sim, calibrate(sim.recording)) < 0.2


@pytest.mark.parametrize("dip_deg", [0.0, 85.0])
def test_any_dip(dip_deg):
    sim = cube(2, dip_deg=dip_deg)
    assert worst(sim, calibrate(sim.recording)) < 0.2


def test_the_result_says_what_it_is():
    sim = cube(0)
    calibration = calibrate(sim.recording, device="node7", field=49.1)
    assert calibration.device == "node7"
    for kind, unit in (("acc", "m/s^2"), ("gyr", "rad/s"), ("mag", "uT")):
        model = calibration.models[kind]
        assert (model.unit, model.raw_unit, model.n_poses) == (unit, "count", 24)
        assert model.covariance is not None
        assert np.linalg.eigvalsh(_scaled(model.covariance)).min() > 0
        assert model.expected_error_deg == pytest.approx(0.06, abs=0.05)
    assert calibration.acc.reference_vector == pytest.approx([0, 0, 9.80665], abs=0.3)
    assert np.linalg.norm(calibration.acc.reference_vector) == pytest.approx(9.80665)
    assert np.linalg.norm(calibration.mag.reference_vector) == pytest.approx(49.1)
    assert calibration.mag.reference_vector[2] == pytest.approx(-49.1 * np.sin(np.radians(66.5)), rel=0.01)
    assert calibration.poses.R.shape == (24, 3, 3)
    same = calibration.poses.R @ np.swapaxes(sim.R_nh, 1, 2)
    assert np.degrees(so3.angle_between(same, same[0])).max() < 0.5  # right, but for the heading of the laboratory


def _scaled(C):
    d = np.sqrt(np.diag(C))
    return C / np.outer(d, d)


def test_unit_of_the_magnetometer_without_a_field_is_the_local_field():
    calibration = plain()
    assert calibration.mag.unit == "norm"
    assert np.linalg.norm(calibration.mag.reference_vector) == pytest.approx(1.0)
    known = calibrate(cube(0).recording, field=49.1)
    assert pytest.approx(49.1 * calibration.mag.H, rel=1e-6, abs=1e-6) == known.mag.H


def test_gravity_is_a_pure_scale():
    a, b = plain(), calibrate(cube(0).recording, gravity=9.78)
    assert pytest.approx(a.acc.H, rel=1e-5, abs=1e-8) == b.acc.H * 9.80665 / 9.78
    assert b.settings["gravity"] == 9.78
    assert calibrate(cube(0).recording, place=LONDON).settings["gravity"] == LONDON.gravity


# --- attitudes in a table ----------------------------------------------------------------------------


NAMES = ("+x", "-x", "+y", "-y", "+z", "-z")
AXES = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1.0]])


def named(rows) -> tuple[str, ...]:
    return tuple(NAMES[int(np.argmax(AXES @ v))] for v in rows)


def test_quaternions_in_a_table():
    sim = simulate(seed=1, poses="free", n_poses=20, rest_s=3.0)
    turned = so3.exp([0.7, -1.1, 2.0]) @ sim.nominal  # relative attitudes are enough: any laboratory
    for R in (sim.nominal, turned):
        calibration = calibrate(sim.recording, poses=PoseTable(q=so3.quat_from_matrix(R)))
        assert calibration.frame == "housing"
        assert worst(sim, calibration) < 0.25


def test_up_and_front_in_a_table():
    sim = cube(1)
    up, front = named(sim.nominal[:, 2, :]), named(sim.nominal[:, 1, :])
    both = calibrate(sim.recording, poses=PoseTable(up=up, front=front))
    assert worst(sim, both) < 0.15
    assert both.acc.reference_vector[:2] == pytest.approx([0, 0], abs=0.05)  # up is up
    headless = calibrate(sim.recording, poses=PoseTable(up=up))
    assert headless.settings["attitudes"] == "faces"
    assert worst(sim, headless) < 0.25


def test_start_and_stop_name_the_rests():
    sim = simulate(seed=1, poses="free", n_poses=20, rest_s=3.0)
    keep = np.r_[0:9, 11:20]
    q = so3.quat_from_matrix(sim.nominal)
    table = PoseTable(q=q[keep], start=sim.start[keep] + 0.3, stop=sim.stop[keep] - 0.3)
    calibration = calibrate(sim.recording, poses=table)
    assert len(calibration.poses) == 18
    assert calibration.poses.start == pytest.approx(sim.start[keep] + 0.3)
    assert worst(sim, calibration) < 0.3
    outside = replace(table, start=table.start + 1000, stop=table.stop + 1000)
    with pytest.raises(InputError, match="row 1"):
        calibrate(sim.recording, poses=outside)


@pytest.mark.parametrize("rows", [19, 21])
def test_another_number_of_rows_is_an_error_with_both_numbers(rows):
    sim = simulate(seed=1, poses="free", n_poses=20, rest_s=3.0)
    q = np.resize(so3.quat_from_matrix(sim.nominal), (rows, 4))
    with pytest.raises(InputError, match=rf"{rows} rows.*20 rests"):
        calibrate(sim.recording, poses=PoseTable(q=q))


def test_level_is_taken_from_quaternions_only_when_it_is_said():
    sim = cube(1)
    q = so3.quat_from_matrix(so3.exp([0.3, 0.0, 0.0]) @ sim.nominal)  # a laboratory tilted by 17 degrees
    calibration = calibrate(sim.recording, poses=PoseTable(q=q))
    assert worst(sim, calibration) < 0.15
    assert np.degrees(np.arccos(calibration.acc.reference_vector[2] / 9.80665)) == pytest.approx(17.2, abs=0.3)


def test_level_that_the_attitudes_contradict_is_said_with_the_angle():
    sim = cube(1)
    q = so3.quat_from_matrix(so3.exp([np.radians(60.0), 0.0, 0.0]) @ sim.nominal)
    calibration = calibrate(sim.recording, poses=PoseTable(q=q), level=True)
    assert set(calibration.models) == {"gyr", "mag"}
    (issue,) = [i for i in calibration.issues if i.code == "not-converged"]
    assert issue.sensor == "acc" and "up is 60 degrees off the vertical" in issue.text
    assert issue.value == pytest.approx(60.0, abs=0.5)


# --- several recordings, missing sensors ----------------------------------------------------------------


def test_recordings_of_one_node_are_pooled():
    parts = [simulate(seed=s, node_seed=7, n_poses=8, rest_s=3.0, poses="free") for s in (1, 2, 3)]
    calibration = calibrate(*(p.recording for p in parts))
    assert len(calibration.poses) == 24
    assert {t.after for t in calibration.turns}.isdisjoint({0, 8, 16})
    assert worst(parts[0], calibration) < 0.15
    one = calibrate(parts[0].recording, parts[1].recording)
    assert calibration.acc.expected_error_deg < one.acc.expected_error_deg


def test_a_sensor_may_be_missing_in_some_recordings():
    a = simulate(seed=1, node_seed=7, n_poses=16, poses="free", rest_s=3.0)
    b = simulate(seed=2, node_seed=7, n_poses=16, poses="free", rest_s=3.0, sensors=("acc", "gyr"))
    calibration = calibrate(a.recording, b.recording)
    assert set(calibration.models) == set(KINDS)
    assert (calibration.acc.n_poses, calibration.mag.n_poses) == (32, 16)
    assert worst(a, calibration) < 0.15


@pytest.mark.parametrize("poses", ["auto", "cube", "faces"])
def test_the_accelerometer_may_be_missing_in_one_recording_of_a_box(poses):
    """Its rests have no face: the others carry the calibration, whichever recording comes first."""
    whole = simulate(seed=3, node_seed=1)
    without = simulate(seed=4, node_seed=1, n_poses=24, rest_s=2, sensors=("mag", "gyr"))
    calibration = calibrate(without.recording, whole.recording, poses=poses)
    assert set(calibration.models) == set(KINDS)
    assert calibration.settings["attitudes"] == ("faces" if poses == "faces" else "cube")
    assert "24 without accelerometer" in calibration.settings["attitudes_text"]
    assert calibration.acc.n_poses == 24
    assert worst(whole, calibration) < 0.15
    if poses != "faces":
        known = np.isfinite(calibration.poses.R).all(axis=(1, 2))
        assert not known[:24].any() and known[24:].all()


def test_a_magnetometer_recorded_apart_from_the_accelerometer_is_refused_with_a_reason():
    """Nothing tells its rotation to the other sensors: at its rests nobody knows where up was."""
    inertial = simulate(seed=2, node_seed=1, poses="free", n_poses=16, sensors=("acc", "gyr"), rest_s=3.0)
    magnetic = simulate(seed=3, node_seed=1, poses="free", n_poses=16, sensors=("mag",), rest_s=3.0)
    calibration = calibrate(inertial.recording, magnetic.recording)
    assert {"acc", "gyr"} <= set(calibration.models)
    assert calibration.mag is None or calibration.mag.expected_error_deg is None
    assert [i for i in calibration.issues if i.sensor == "mag" and i.level in ("warn", "fail")]


@pytest.mark.parametrize("poses", ["cube", "free"])
@pytest.mark.parametrize("sensors", [("acc",), ("acc", "gyr"), ("acc", "mag")])
def test_what_is_there_is_calibrated(sensors, poses):
    sim = simulate(seed=0, poses=poses, sensors=sensors)
    calibration = calibrate(sim.recording)
    assert set(calibration.models) == set(sensors)
    assert worst(sim, calibration) < 0.4


def test_gyroscope_and_magnetometer_without_accelerometer_need_attitudes():
    sim = simulate(seed=0, poses="free", sensors=("gyr", "mag"))
    with pytest.raises(DataError, match="accelerometer") as caught:
        calibrate(sim.recording)
    assert caught.value.exit_status == 3
    assert {i.code for i in caught.value.issues} >= {"needs-accelerometer"}
    calibration = calibrate(sim.recording, poses=PoseTable(q=so3.quat_from_matrix(sim.nominal)))
    assert set(calibration.models) == {"gyr", "mag"}
    assert worst(sim, calibration) < 0.25


def test_sensors_that_are_not_asked_for_are_left_alone():
    calibration = calibrate(cube(0).recording, sensors=["acc"])
    assert set(calibration.models) == {"acc"}
    with pytest.raises(InputError, match="magnetometer was asked for"):
        calibrate(replace(cube(0).recording, mag=None), sensors=["acc", "mag"])


def test_a_sensor_without_data_worth_it_is_absent_with_the_reason():
    sim = cube(0)
    stuck = replace(sim.recording.mag, y=np.broadcast_to(sim.recording.mag.y[0], sim.recording.mag.y.shape))
    recording = replace(sim.recording, mag=stuck)
    calibration = calibrate(recording)
    assert set(calibration.models) == {"acc", "gyr"}
    assert [i.sensor for i in calibration.issues if i.level == "fail"] == ["mag"]
    with pytest.raises(DataError):
        calibrate(recording, sensors=["mag"])


# --- signs -------------------------------------------------------------------------------------------


MIRROR = np.diag([1.0, 1.0, -1.0])


def test_sign_of_the_magnetometer_by_default_is_det_and_said_so():
    sim = cube(1, mag_axes="board")
    calibration = calibrate(sim.recording)
    assert np.linalg.det(calibration.mag.H) > 0
    assert np.trace(calibration.mag.H) < 0  # never the trace
    assert "sign-assumed" in levels(calibration, "note")
    assert worst(sim, calibration) < 0.2


@pytest.mark.parametrize("axes", ["board", "mirror"])
def test_sign_of_the_magnetometer_by_the_dip(axes):
    sim = simulate(seed=1, mag_axes="board" if axes == "board" else MIRROR, place=LONDON)
    for poses in ("auto", "faces"):
        calibration = calibrate(sim.recording, place=LONDON, poses=poses)
        assert np.sign(np.linalg.det(calibration.mag.H)) == (1 if axes == "board" else -1)
        assert worst(sim, calibration) < 0.25
        assert "sign-assumed" not in levels(calibration, "note")
        assert calibration.mag.reference_vector[2] < 0  # it points down in London


def test_sign_by_a_nominal_model_goes_first():
    sim = simulate(seed=1, mag_axes=MIRROR, place=LONDON)
    nominal = Calibration(mag=SensorModel("mag", MIRROR * 0.15, np.zeros(3)))
    assert worst(sim, calibrate(sim.recording, nominal=nominal)) < 0.2
    wrong = Calibration(mag=SensorModel("mag", -MIRROR * 0.15, np.zeros(3)))
    calibration = calibrate(sim.recording, nominal=wrong, place=LONDON)
    assert np.linalg.det(calibration.mag.H) > 0  # the user's word, even against the dip


def test_sign_of_a_swung_magnetometer_by_the_dip():
    sim = swing(seed=1, mag_axes=MIRROR, place=LONDON)
    inertial = simulate(seed=2, node_seed=1, poses="free", n_poses=16, sensors=("acc", "gyr"), rest_s=3.0)
    calibration = calibrate(inertial.recording, sim.recording, place=LONDON)
    assert "mag" in calibration.settings["sources"]
    assert np.linalg.det(calibration.mag.H) < 0
    assert errors(sim, calibration)["mag"].max() < 1.0


def test_a_flipped_gyroscope_axis_is_found_and_said():
    sim = transformed(cube(2), {"gyr": np.diag([-1.0, 1, 1])})
    calibration = calibrate(sim.recording)
    assert worst(sim, calibration) < 0.2
    issue = next(i for i in calibration.issues if i.code == "mirrored-axes")
    assert issue.level == "warn"
    assert "likely x" in issue.text


# --- invariance --------------------------------------------------------------------------------------


def test_the_same_input_gives_the_same_bytes():
    texts = [dumps(replace(calibrate(simulate(seed=3, n_poses=12).recording), created="now")) for _ in range(2)]
    assert texts[0] == texts[1]


@pytest.mark.parametrize("poses", ["cube", "free"])
def test_other_units_change_nothing(poses):
    sim = simulate(seed=4, poses=poses, n_poses=16, rest_s=3.0, quantise=False)
    base = calibrate(sim.recording)
    factor = {"acc": 1e-3, "gyr": 7.0, "mag": 0.15}
    other = calibrate(transformed(sim, {k: f * np.eye(3) for k, f in factor.items()}).recording)
    for kind, f in factor.items():
        a, b = base.models[kind], other.models[kind]
        assert b.H * f == pytest.approx(a.H, rel=1e-4, abs=1e-4 * np.abs(a.H).max()), kind
        assert b.B / f == pytest.approx(a.B, rel=1e-3, abs=0.02), kind
        assert b.expected_error_deg == pytest.approx(a.expected_error_deg, rel=0.01)


def test_other_orders_of_raw_axes_change_nothing():
    """Of gyroscope and magnetometer: the housing's axes are named after the accelerometer's."""
    sim = cube(2)
    P = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
    base, other = plain(2), calibrate(transformed(sim, {"gyr": P, "mag": P}).recording)
    for kind in KINDS:
        M = np.eye(3) if kind == "acc" else P
        scale = np.abs(base.models[kind].H).max()
        assert pytest.approx(base.models[kind].H, abs=1e-4 * scale) == other.models[kind].H @ M
        assert pytest.approx(M @ base.models[kind].B, abs=0.02) == other.models[kind].B


def test_a_magnetometer_mounted_askew_changes_nothing_else():
    sim = transformed(cube(2), {"mag": so3.exp([0.3, 0.4, -0.2])})
    assert worst(sim, calibrate(sim.recording)) < 0.2


# --- what happens to recordings ------------------------------------------------------------------------


def test_knocks_gaps_missing_rows_and_warmth():
    sim = simulate(seed=5, knocks=4, temperature_degC=21.0)
    streams = {}
    for kind, s in sim.recording.streams.items():
        middle = (sim.stop[4] + sim.start[5]) / 2
        keep = np.abs(s.t - middle) > 0.1
        streams[kind] = replace(s, t=s.t[keep], y=s.y[keep])
    y = streams["acc"].y.copy()
    y[700:720] = np.nan
    streams["acc"] = replace(streams["acc"], y=y)
    calibration = calibrate(replace(sim.recording, **streams))
    assert set(calibration.models) == set(KINDS)
    assert worst(sim, calibration) < 0.2
    assert {"knocked-rest", "gap-in-turn", "nan-rows"} <= {i.code for i in calibration.issues}
    assert calibration.acc.temperature_degC == pytest.approx(21.5, abs=0.05)


def test_missing_rows_are_left_out_and_nothing_else():
    """NaN rows of one sensor, straight from arrays: they cost neither the other sensors nor the rests."""
    sim = cube(0)
    s = sim.recording.streams
    y = s["acc"].y.copy()
    y[3000:3060] = np.nan
    units = dict.fromkeys(KINDS, "count")
    recording = Recording.from_arrays(s["acc"].t, acc=y, gyr=s["gyr"].y, mag=s["mag"].y, units=units)
    calibration = calibrate(recording)
    assert set(calibration.models) == set(KINDS)
    assert len(calibration.poses) == 24
    assert worst(sim, calibration) < 0.2


def test_separate_clocks():
    sim = simulate(seed=6, separate_clocks=True)
    calibration = calibrate(sim.recording)
    assert calibration.settings["attitudes"] == "cube"
    assert worst(sim, calibration) < 0.2


@pytest.mark.parametrize("disturbance", [0.05, 0.3])
def test_a_disturbed_field_is_never_a_confident_error(disturbance):
    for seed in (0, 1):
        sim = simulate(seed=seed, disturbed=5, disturbance=disturbance)
        calibration = calibrate(sim.recording)
        if "mag" not in calibration.models:
            assert any(i.sensor == "mag" for i in calibration.issues if i.level == "fail")
            continue
        rms = np.sqrt(np.mean(errors(sim, calibration)["mag"] ** 2))
        assert rms < 3 * calibration.mag.expected_error_deg


# --- methods -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["gls-ml", "one-step", "alternation", "eigen", "svd"])
def test_every_solver_by_name(method):
    sim = simulate(seed=1, poses="free", n_poses=20, rest_s=3.0)
    table = PoseTable(q=so3.quat_from_matrix(sim.nominal))
    calibration = calibrate(sim.recording, poses=table, method=method)
    assert calibration.acc.method == method
    assert calibration.mag.method == method
    assert worst(sim, calibration) < (0.25 if method == "gls-ml" else 0.6)
    for kind in KINDS:
        assert calibration.models[kind].expected_error_deg < 0.4


def test_unscented_filter_by_name():
    sim = simulate(seed=1, poses="free", n_poses=20, rest_s=3.0)
    table = PoseTable(q=so3.quat_from_matrix(sim.nominal))
    calibration = calibrate(sim.recording, poses=table, method="one-step,ukf")
    assert (calibration.acc.method, calibration.gyr.method) == ("one-step", "ukf")
    assert errors(sim, calibration)["gyr"].max() < 0.4


@pytest.mark.parametrize("method", ["ellipsoid", "triangular"])
def test_a_fit_by_magnitude_claims_no_direction_in_the_housing(method):
    sim = simulate(seed=1, poses="free", n_poses=20, rest_s=3.0)
    table = PoseTable(q=so3.quat_from_matrix(sim.nominal))
    calibration = calibrate(sim.recording, poses=table, method=method)
    for kind in ("acc", "mag"):
        model, true = calibration.models[kind], sim.truth.models[kind]
        assert model.expected_error_deg is None
        gram = model.H.T @ model.H / np.trace(model.H.T @ model.H)
        assert gram == pytest.approx(true.H.T @ true.H / np.trace(true.H.T @ true.H), abs=2e-3)
        assert pytest.approx(true.B, abs=3) == model.B
    assert [i.sensor for i in calibration.issues if i.code == "own-frame"] == ["acc", "mag"]


def test_a_method_that_cannot_be_used_is_not_swapped_in_silence():
    sim = simulate(seed=1, poses="free", n_poses=16, rest_s=3.0)
    calibration = calibrate(sim.recording, method="one-step,ukf")
    replaced = {i.sensor: i.text for i in calibration.issues if i.code == "method-replaced"}
    assert set(replaced) == {"acc", "gyr"}
    assert calibration.mag.method == "one-step"
    for kind in ("acc", "gyr"):
        assert calibration.models[kind].method in replaced[kind]


# --- honesty -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("poses", ["cube", "faces", "free"])
def test_expected_error_is_honest(poses):
    """Over ten nodes the rms of the true error is within a factor two of what was expected."""
    true, expected = {k: [] for k in KINDS}, {k: [] for k in KINDS}
    for seed in range(10):
        sim = simulate(seed=50 + seed, poses=poses, n_poses=14, rest_s=2.0, level_sd_deg=0.2)
        calibration = calibrate(sim.recording)
        for kind, error in errors(sim, calibration).items():
            true[kind].append(np.mean(error**2))
            expected[kind].append(calibration.models[kind].expected_error_deg ** 2)
    for kind in KINDS:
        assert len(true[kind]) == 10
        ratio = np.sqrt(np.mean(true[kind]) / np.mean(expected[kind]))
        assert 0.5 < ratio < 2.0, kind


@pytest.mark.parametrize("seed", range(4))
def test_few_free_rests_give_bias_and_scale_and_an_error_that_owns_up(seed):
    sim = simulate(seed=seed, poses="free", n_poses=9, rest_s=3.0)
    calibration = calibrate(sim.recording)
    assert "bias-and-scale-only" in levels(calibration, "warn")
    for kind, error in errors(sim, calibration).items():
        assert calibration.models[kind].expected_error_deg > 0.3
        assert np.sqrt(np.mean(error**2)) < 3 * calibration.models[kind].expected_error_deg


def test_sequential_methods_know_the_housing_no_better_than_the_accelerometer():
    """Each sensor by itself after the accelerometer: its error in the housing's frame is the accelerometer's too."""
    for seed in range(3):
        sim = simulate(seed=seed, poses="faces")
        calibration = calibrate(sim.recording, method="one-step")
        for kind, error in errors(sim, calibration).items():
            assert np.sqrt(np.mean(error**2)) < 2 * calibration.models[kind].expected_error_deg, kind


# --- refusals ----------------------------------------------------------------------------------------


def test_too_few_rests_are_refused_with_what_to_record():
    sim = simulate(seed=0, poses="free", n_poses=4, rest_s=3.0)
    with pytest.raises(DataError, match="record") as caught:
        calibrate(sim.recording)
    assert caught.value.exit_status == 3
    rest = calibrate(sim.recording, allow_fail=True)
    assert not rest.models
    assert levels(rest, "fail")


def test_turns_about_one_axis_are_refused():
    """A cube rolled about one edge: four faces."""
    sim = cube(0, n_poses=40, rest_s=2.0)
    z = np.abs(sim.nominal[:, 2, 2]) < 0.5  # rests with z level
    poses = PoseTable(up=named(sim.nominal[z][:, 2, :]), start=sim.start[z] + 0.2, stop=sim.stop[z] - 0.2)
    with pytest.raises(DataError) as caught:
        calibrate(sim.recording, poses=poses, sensors=["acc"])
    assert "z" in str(caught.value)


def test_no_motion_at_all():
    rng = np.random.default_rng(0)
    t = np.arange(3000) / 100
    recording = Recording.from_arrays(
        t,
        acc=rng.normal([0, 0, 2048], 4, (3000, 3)),
        gyr=rng.normal(0, 2, (3000, 3)),
        units={"acc": "count", "gyr": "count"},
    )
    with pytest.raises(DataError, match="record"):
        calibrate(recording)


def test_a_free_node_is_no_box():
    sim = simulate(seed=0, poses="free", n_poses=16, rest_s=2.0)
    for poses in ("cube", "faces"):
        with pytest.raises(DataError, match="face"):
            calibrate(sim.recording, poses=poses)


def test_arbitrary_headings_are_no_cube():
    sim = simulate(seed=0, poses="faces", n_poses=16, rest_s=2.0)
    with pytest.raises(DataError, match="use --poses faces"):
        calibrate(sim.recording, poses="cube")


def test_no_reference_where_one_was_asked_for():
    with pytest.raises(DataError, match="no ref_q"):
        calibrate(cube(0).recording, poses="reference")


@pytest.mark.parametrize(
    "options, words",
    [
        ({"method": "magic"}, "magic"),
        ({"poses": "sideways"}, "sideways"),
        ({"gravity": 98.0}, "gravity"),
        ({"field": 0.5}, "field"),
        ({"field": 50.0, "place": LONDON}, "--at"),
        ({"level_sd_deg": 0.0}, "level_sd_deg"),
        ({"sensors": ["baro"]}, "baro"),
    ],
)
def test_a_wrong_call_is_a_usage_error_that_names_it(options, words):
    with pytest.raises(UsageError, match=words):
        calibrate(cube(0).recording, **options)


@pytest.mark.parametrize("value", ["stuck", "nan"])
def test_nothing_but_dead_sensors(value):
    sim = cube(0, n_poses=8, rest_s=2.0)
    dead = {
        k: replace(s, y=np.broadcast_to(s.y[0] if value == "stuck" else np.nan, s.y.shape))
        for k, s in sim.recording.streams.items()
    }
    with pytest.raises(DataError, match="accelerometer"):
        calibrate(replace(sim.recording, **dead))


def test_no_recording_is_a_usage_error():
    with pytest.raises(UsageError):
        calibrate()


def test_recordings_in_two_units_are_refused():
    sim = cube(0)
    other = replace(sim.recording, acc=replace(sim.recording.acc, unit="mps2"), source="second")
    with pytest.raises(InputError, match="second"):
        calibrate(sim.recording, other)
