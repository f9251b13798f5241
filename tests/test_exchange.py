"""Export and import: every target both ways, the loss that is declared, hostile names, other programs' own files."""

from __future__ import annotations

import csv
import io
import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import strategies as own
from exchange_table import BEGIN, END, PAGE, SCALE, exported, imported, in_counts, kinds_for, measured_deg, node, table
from margcal.apps.cli import run
from margcal.core import so3
from margcal.core.errors import DataError, InputError, MargcalError, UsageError
from margcal.core.types import Calibration, SensorModel
from margcal.core.units import KINDS, STANDARD_GRAVITY
from margcal.files.calfile import dumps, load, save
from margcal.files.exchange import yaml_subset
from margcal.files.exchange.fitting import (
    ORIENTATIONS,
    lower_frame,
    lower_times_rotation,
    nearest,
    orientation_number,
)
from margcal.files.exchange.registry import TARGETS, find
from margcal.files.exchange.target import MAX_BYTES, identifier, plain
from margcal.workflow.export import export
from margcal.workflow.export_check import check_export
from margcal.workflow.importing import import_calibration
from margcal.workflow.simulated_node import BOARD_AXES, NodeErrors

ALIGNED = NodeErrors(scale_error=0.03, non_orthogonality_deg=0.05, mounting_deg=0.1, soft_iron=0.002)
every = pytest.mark.parametrize("name", list(TARGETS))


# --- every target, both ways --------------------------------------------------------------------------


@every
@pytest.mark.parametrize("seed", [1, 2])
def test_import_after_export_is_the_identity_or_what_was_said_to_be_lost(name, seed):
    target, calibration = find(name), node(seed)
    done = exported(calibration, target)
    back = imported(done.data, target)
    assert tuple(back.models) == kinds_for(target) == tuple(done.models)
    assert back.verdict is None and all(m.covariance is None for m in back.models.values())
    for loss in done.losses:
        got, want, form = back.models[loss.kind], calibration.models[loss.kind], target.forms[loss.kind]
        assert (got.raw_unit, got.unit) == (want.raw_unit, want.unit)
        H, B = in_counts(*form.decode(done.page.sensors[loss.kind].fields), loss.kind, target)
        np.testing.assert_allclose(got.H, H, rtol=0, atol=1e-7 * np.abs(H).max())
        np.testing.assert_allclose(got.B, B, rtol=0, atol=1e-7 * max(1, np.abs(B).max()))
        if form.matrix == "full" and name not in ("c-q15", "c-q31"):
            np.testing.assert_allclose(got.H, want.H, rtol=0, atol=target.exact * np.abs(want.H).max())
            if form.bias:
                np.testing.assert_allclose(got.B, want.B, rtol=0, atol=target.exact * np.abs(want.B).max())
        angle = measured_deg(got, want, np.random.default_rng(seed), bias=form.bias)
        assert np.sqrt(np.mean(angle**2)) == pytest.approx(loss.rms_deg, rel=0.05, abs=1e-6)
        assert angle.max() <= 1.02 * loss.max_deg + 1e-6


@every
def test_what_is_written_passes_its_own_check(name):
    target = find(name)
    if name in ("c", "c-q15", "c-q31", "arduino", "fusion"):
        pytest.skip("compiled in test_c_export.py")
    done = exported(node(3), target)
    checks = check_export(done, done.data)
    assert [c.name for c in checks[:2]] == ["read-back", "vectors"] and all(c.passed for c in checks)


@every
def test_the_same_calibration_gives_the_same_bytes(name):
    assert exported(node(4), find(name)).data == exported(node(4), find(name)).data


@every
def test_test_vectors_are_in_the_file_and_are_what_its_numbers_make(name):
    target = find(name)
    done = exported(node(5), target)
    page = target.read(done.data, "file", kinds_for(target))
    for kind, sensor in page.sensors.items():
        assert (sensor.vectors is not None) == target.vectors
        if sensor.vectors is None:
            continue
        raw, out = sensor.vectors
        assert raw.shape == out.shape == (10, 3) and np.linalg.matrix_rank(raw) == 3
        H, B = target.forms[kind].decode(sensor.fields)
        want = (raw - B) @ H.T
        if "C_i_b" in sensor.fields:  # in the frame of the file
            want = want @ np.asarray(sensor.fields["C_i_b"]).T
        step = target.forms[kind].step
        tolerance = 0.51 * step(sensor.fields) if step else 1e-6 * np.abs(want).max()
        np.testing.assert_allclose(out, want, rtol=0, atol=tolerance)


lossy = ["kalibr", "basalt", "ardupilot", "px4", "betaflight", "qmt", "ggir", "actipy"]


@given(name=st.sampled_from(lossy), seed=own.seeds, mounting=st.floats(0, 60), board=st.sampled_from(range(24)))
def test_the_loss_declared_is_the_loss_measured(name, seed, mounting, board):
    target = find(name)
    errors = NodeErrors(mounting_deg=mounting, mag_axes=so3.cube_group()[board])
    calibration = node(seed % 2**31, errors)
    done = exported(calibration, target)
    back = imported(done.data, target)
    for loss in done.losses:
        angle = measured_deg(
            back.models[loss.kind], calibration.models[loss.kind], np.random.default_rng(0), bias=loss.bias
        )
        assert np.sqrt(np.mean(angle**2)) == pytest.approx(loss.rms_deg, rel=0.05, abs=1e-6)


@given(name=st.sampled_from([n for n in TARGETS if n not in lossy]), seed=own.seeds, mounting=st.floats(0, 180))
def test_targets_that_hold_all_of_H_hold_it_for_any_mounting(name, seed, mounting):
    target = find(name)
    calibration = node(seed % 2**31, NodeErrors(mounting_deg=mounting, mag_axes=BOARD_AXES))
    back = imported(exported(calibration, target, allow_lossy=False).data, target)
    for kind, got in back.models.items():
        want = calibration.models[kind]
        limit = {"c-q15": 1e-4, "c-q31": 1e-8}.get(name, target.exact)
        np.testing.assert_allclose(got.H, want.H, rtol=0, atol=limit * np.abs(want.H).max())


@pytest.mark.parametrize("name", ["kalibr", "basalt"])
@pytest.mark.parametrize("seed", range(4))
def test_a_moved_frame_keeps_all_of_H(name, seed):
    target, calibration = find(name), node(seed, NodeErrors(mounting_deg=25))
    done = exported(calibration, target, allow_lossy=False, move_frame=True)
    assert all(x.rms_deg < 1e-9 and x.kept == "full" for x in done.losses) and 10 < done.frame_turn_deg < 40
    back = imported(done.data, target)
    for kind in back.models:
        np.testing.assert_allclose(back.models[kind].H, calibration.models[kind].H, rtol=0, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_mirrored_triads_survive(kind):
    mirror = np.diag([1.0, 1.0, -1.0])
    calibration = node(6)
    model = calibration.models[kind]
    mirrored = replace(calibration, **{kind: replace(model, H=model.H @ mirror)})
    for name in ("c", "imufusion", "matlab", "kalibr", "openvins", "imucal", "imu-tk", "magneto"):
        target = find(name)
        if kind not in kinds_for(target):
            continue
        move = {"move_frame": True} if name == "kalibr" else {}
        back = imported(exported(mirrored, target, allow_lossy=False, **move).data, target)
        np.testing.assert_allclose(back.models[kind].H, model.H @ mirror, rtol=0, atol=1e-7 * np.abs(model.H).max())


# --- the formula, read from the file a second time, with nothing of margcal's ---------------------------


def directions(n, rng):
    v = rng.normal(size=(n, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def raw_and_true(kind, unit, n=50):
    """Readings in a driver's unit and what they truly are, of node 11."""
    rng = np.random.default_rng(8)
    model = node(11, ALIGNED).models[kind]
    u = {"acc": 9.8, "gyr": 1.0, "mag": 49.0}[kind] * directions(n, rng)
    return model.invert(u) * SCALE[kind] / unit, u


def parameters(text):
    return {k: float(v) for k, v in re.findall(r"^([A-Z_0-9]+),(\S+)$", text, re.M)}


def test_ardupilot_compass_rotates_first_then_adds_offsets_then_multiplies():
    """AP_Compass_Backend: mag.rotate(orientation); mag += offsets; mag = mat * mag, in milligauss."""
    errors = replace(ALIGNED, mag_axes=BOARD_AXES)
    model = node(12, errors).mag
    done = exported(node(12, errors), find("ardupilot"), max_loss_deg=0.5)
    p = parameters(done.data.decode())
    number = int(p["COMPASS_ORIENT"])
    # x and y swapped, z flipped is roll 180 then yaw 90 (MAV_SENSOR_ROTATION_ROLL_180_YAW_90 = 10)
    assert number == 10
    u = 49.0 * directions(20, np.random.default_rng(1))
    y = model.invert(u) * SCALE["mag"] * 10  # milligauss
    for raw, true in zip(y, u):
        x, yy, z = raw
        field = np.array([yy, x, -z])  # roll 180: (x, -y, -z); yaw 90: (-y', x')
        field = field + [p[f"COMPASS_OFS_{a}"] for a in "XYZ"]
        dx, dy, dz = (p[f"COMPASS_DIA_{a}"] for a in "XYZ")
        xy, xz, yz = (p[f"COMPASS_ODI_{a}"] for a in "XYZ")
        field = np.array([[dx, xy, xz], [xy, dy, yz], [xz, yz, dz]]) @ field
        angle = math.degrees(math.acos(field @ true / np.linalg.norm(field) / np.linalg.norm(true)))
        assert angle < 0.3 and np.linalg.norm(field) / 10 == pytest.approx(49.0, rel=5e-3)
    assert p["COMPASS_SCALE"] == 1


def test_px4_subtracts_offsets_multiplies_then_rotates():
    """Magnetometer.hpp: rotation * (scale * (data - offset)), in gauss; the accelerometer likewise with a diagonal."""
    errors = replace(ALIGNED, mag_axes=BOARD_AXES)
    text = exported(node(12, errors), find("px4")).data.decode()
    p = {m[0]: float(m[1]) for m in re.findall(r"^1\t1\t(\w+)\t(\S+)\t[69]$", text, re.M)}
    assert p["CAL_MAG0_ROT"] == 10
    u = 49.0 * directions(20, np.random.default_rng(1))
    y = node(12, errors).mag.invert(u) * SCALE["mag"] / 100  # gauss
    d, o = ([p[f"CAL_MAG0_{a}{what}"] for a in "XYZ"] for what in ("SCALE", "ODIAG"))
    scale = np.array([[d[0], o[0], o[1]], [o[0], d[1], o[2]], [o[1], o[2], d[2]]])
    field = (y - [p[f"CAL_MAG0_{a}OFF"] for a in "XYZ"]) @ scale
    field = np.column_stack([field[:, 1], field[:, 0], -field[:, 2]]) * 100
    np.testing.assert_allclose(field, u, atol=0.3)
    y, u = raw_and_true("acc", 1.0)
    p = {
        m[0]: float(m[1])
        for m in re.findall(r"^1\t1\t(\w+)\t(\S+)\t[69]$", exported(node(11, ALIGNED), find("px4")).data.decode(), re.M)
    }
    got = (y - [p[f"CAL_ACC0_{a}OFF"] for a in "XYZ"]) * [p[f"CAL_ACC0_{a}SCALE"] for a in "XYZ"]
    np.testing.assert_allclose(got, u, atol=0.05)


def test_the_accelerometer_of_ardupilot_subtracts_its_offsets():
    y, u = raw_and_true("acc", 1.0)
    p = parameters(exported(node(11, ALIGNED), find("ardupilot")).data.decode())
    got = (y - [p[f"INS_ACCOFFS_{a}"] for a in "XYZ"]) * [p[f"INS_ACCSCAL_{a}"] for a in "XYZ"]
    np.testing.assert_allclose(got, u, atol=0.05)


def test_kalibr_predicts_the_readings():
    """IccSensors.py: M * (C_i_b * a) and M * (C_gyro_i * C_i_b * w) + A (...)."""
    done = exported(node(11), find("kalibr"), move_frame=True)
    imu = yaml_subset.load(done.data.decode(), "file")["imu0"]
    C_i_b = np.array(imu["T_i_b"])[:3, :3]
    for kind, M, C in (
        ("acc", imu["accelerometers"]["M"], np.eye(3)),
        ("gyr", imu["gyroscopes"]["M"], np.array(imu["gyroscopes"]["C_gyro_i"])),
    ):
        model = node(11).models[kind]
        u = directions(30, np.random.default_rng(2))
        y = (model.invert(u) - model.B) * SCALE[kind]  # the bias is Kalibr's own affair
        np.testing.assert_allclose((np.array(M) @ C @ C_i_b @ u.T).T, y, atol=1e-12)
        assert np.array(M)[np.triu_indices(3, 1)].tolist() == [0.0, 0.0, 0.0]
    assert not np.any(imu["gyroscopes"]["A"])


def test_openvins_corrects_the_readings():
    """State.h: a = R_ACCtoIMU Da (am - ba), Da the lower triangle of Ta^-1."""
    imu = yaml_subset.load(exported(node(11), find("openvins")).data.decode(), "file")["imu0"]
    for kind, T, R in (("acc", "Ta", "R_IMUtoACC"), ("gyr", "Tw", "R_IMUtoGYRO")):
        model = node(11).models[kind]
        u = directions(30, np.random.default_rng(2))
        y = (model.invert(u) - model.B) * SCALE[kind]
        D = np.tril(np.linalg.inv(np.array(imu[T])))
        np.testing.assert_allclose((np.array(imu[R]).T @ D @ y.T).T, u, atol=1e-12)


def test_basalt_and_ros_subtract_the_bias_last():
    document = json.loads(exported(node(11), find("basalt"), move_frame=True).data)
    g = document["value0"]["calib_gyro_bias"]
    scale = np.column_stack([g[3:6], g[6:9], g[9:12]])
    y, u = ((lambda m: (m.invert(v) * SCALE["gyr"], v))(node(11).gyr) for v in [np.eye(3)]).__next__()
    R = np.array(document["margcal"]["R_ih"])
    np.testing.assert_allclose(y + y @ scale.T - g[:3], u @ R.T, atol=1e-12)
    a = document["value0"]["calib_accel_bias"]
    lower = np.array([[a[3], 0, 0], [a[4], a[6], 0], [a[5], a[7], a[8]]])
    y = node(11).acc.invert(np.eye(3)) * SCALE["acc"]
    np.testing.assert_allclose(y + y @ lower.T - a[:3], np.eye(3) @ R.T, atol=1e-12)
    ros = yaml_subset.load(exported(node(11), find("ros-imu-calib")).data.decode(), "file")
    SM = np.reshape(ros["SM"], (3, 3))
    np.testing.assert_allclose(y @ SM.T - ros["bias"], np.eye(3), atol=1e-12)


def test_matlab_multiplies_rows_from_the_right():
    from scipy.io import loadmat

    calibration = node(11)
    saved = loadmat(io.BytesIO(exported(calibration, find("matlab")).data))
    u = np.eye(3)
    np.testing.assert_allclose((calibration.mag.invert(u) - saved["mag_b"]) @ saved["mag_A"], u, atol=1e-12)
    np.testing.assert_allclose(calibration.acc.invert(u) @ saved["acc_A"] + saved["acc_b"], u, atol=1e-12)
    assert saved["mag_expmfs"].item() == pytest.approx(np.hypot(18.5, 45.6))


def test_ggir_scales_the_shifted_reading_and_actipy_shifts_the_scaled_one():
    """R's scale(x, center = -offset, scale = 1/scale) subtracts the centre and then divides."""
    y, u = raw_and_true("acc", STANDARD_GRAVITY)
    (row,) = csv.DictReader(io.StringIO(exported(node(11, ALIGNED), find("ggir")).data.decode()))
    offset, scale = (np.array([float(row[f"{k}.{a}"]) for a in "xyz"]) for k in ("offset", "scale"))
    centre, divisor = -offset, 1 / scale
    np.testing.assert_allclose((y - centre) / divisor * STANDARD_GRAVITY, u, atol=0.05)
    info = json.loads(exported(node(11, ALIGNED), find("actipy")).data)
    slope, intercept = (np.array([info[f"Calib{a}{k}"] for a in "xyz"]) for k in ("Slope", "Intercept"))
    np.testing.assert_allclose((intercept + slope * y) * STANDARD_GRAVITY, u, atol=0.05)


def test_betaflight_subtracts_whole_counts_and_imu_tk_is_three_blocks_of_numbers():
    text = exported(node(11), find("betaflight")).data.decode()
    zero = [int(v) for v in re.search(r"^set acc_calibration = (\S+),1$", text, re.M)[1].split(",")]
    np.testing.assert_array_equal(zero, np.rint(node(11).acc.B))
    v = np.array(exported(node(11), find("imu-tk")).data.split(), dtype=float)
    T, K, B = v[:9].reshape(3, 3), v[9:18].reshape(3, 3), v[18:]
    np.testing.assert_allclose(T @ K @ (node(11).acc.invert(np.eye(3)) - B).T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.diag(T), 1)
    assert not np.any(K - np.diag(np.diag(K)))


def test_the_text_of_motioncal_and_the_gains_of_qmt_by_hand():
    calibration = node(11)
    y = calibration.mag.invert(np.eye(3))
    text = re.sub(r"(?m)^#.*\n", "", exported(calibration, find("motioncal")).data.decode())
    v = [float(x) for x in re.findall(r"-?\d[\d.e+-]*", text)]
    W = np.reshape(v[3:12], (3, 3))
    np.testing.assert_allclose([W @ (row - v[:3]) for row in y], np.eye(3), atol=1e-12)
    assert v[12] == pytest.approx(np.hypot(18.5, 45.6))
    y = node(11, ALIGNED).mag.invert(49 * directions(50, np.random.default_rng(3)))
    u = node(11, ALIGNED).mag.apply(y)
    found = json.loads(exported(node(11, ALIGNED), find("qmt")).data)
    np.testing.assert_allclose(np.array(found["gain"]) * y - found["bias"], u, atol=0.4)  # mag_calibrated of its manual


def test_fusion_as_the_package_itself_computes_it():
    imufusion = pytest.importorskip("imufusion")
    calibration = node(11)
    arguments = json.loads(exported(calibration, find("imufusion")).data)
    u = {"acc": 9.8, "gyr": 2.0, "mag": 49.0}
    unit = {"acc": STANDARD_GRAVITY, "gyr": math.radians(1), "mag": 1.0}
    for kind in KINDS:
        true = u[kind] * directions(200, np.random.default_rng(3))
        model = imufusion.model_magnetic if kind == "mag" else imufusion.model_inertial
        keywords = {k: np.array(v, dtype=np.float32) for k, v in arguments[kind].items()}
        y = calibration.models[kind].invert(true).astype(np.float32)
        got = np.array([model(row, **keywords) for row in y], dtype=np.float64) * unit[kind]
        np.testing.assert_allclose(got, true, rtol=0, atol=2e-6 * u[kind])


@pytest.mark.parametrize("name", ["imucal", "imucal-hdf5"])
def test_imucal_calibrates_with_what_was_written(name, tmp_path):
    imucal = pytest.importorskip("imucal")
    target, calibration = find(name), node(11)
    path = tmp_path / f"cal{target.suffix}"
    path.write_bytes(exported(calibration, target).data)
    read = imucal.CalibrationInfo.from_hdf5 if name.endswith("5") else imucal.CalibrationInfo.from_json_file
    rng = np.random.default_rng(4)
    acc, gyr = rng.normal(size=(200, 3)) * 10, rng.normal(size=(200, 3))
    a, g = read(path).calibrate(calibration.acc.invert(acc), calibration.gyr.invert(gyr), "count", "count")
    np.testing.assert_allclose(a, acc, atol=1e-12)
    np.testing.assert_allclose(np.radians(g), gyr, atol=1e-12)


@pytest.mark.parametrize("name", ["imucal", "imucal-hdf5"])
def test_what_imucal_wrote_is_read(name, tmp_path):
    imucal = pytest.importorskip("imucal")
    rng = np.random.default_rng(5)
    K, R, b = (
        (rng.normal(size=(2, 3, 3)) * 0.1 + np.eye(3) * [[[200]], [[16]]]),
        so3.exp(rng.normal(size=(2, 3))),
        rng.normal(size=(2, 3)),
    )
    theirs = imucal.FerrarisCalibrationInfo(
        from_acc_unit="a.u.", from_gyr_unit="a.u.", comment="x", K_a=K[0], R_a=R[0], b_a=b[0], K_g=K[1], R_g=R[1],
        b_g=b[1], K_ga=np.zeros((3, 3)),
    )  # fmt: skip
    path = tmp_path / "theirs"
    theirs.to_hdf5(path) if name.endswith("5") else theirs.to_json_file(path)
    ours = import_calibration(path.read_bytes(), "theirs", find(name))
    y = rng.normal(size=(20, 3)) * 100
    a, g = theirs.calibrate(y, y, "a.u.", "a.u.")
    np.testing.assert_allclose(ours.acc.apply(y), a, atol=1e-10)
    np.testing.assert_allclose(ours.gyr.apply(y), np.radians(g), atol=1e-10)
    assert ours.acc.raw_unit == "a.u."


# --- what is lost, and what is refused ------------------------------------------------------------------


def test_a_turn_that_a_symmetric_matrix_cannot_hold_costs_what_geometry_says():
    """A rotation by t moves directions by t sin(angle to its axis): rms t sqrt(2/3), at most t."""
    R = so3.exp(np.radians(3.0) * own._unit(np.array([1.0, 2.0, -1.0])))
    model = SensorModel("mag", 0.15 * R, np.zeros(3), reference_vector=[0, 20, -45])
    done = export(Calibration(mag=model), find("px4"), scale={"mag": 0.15}, allow_lossy=True)
    (loss,) = done.losses
    assert loss.rms_deg == pytest.approx(3 * math.sqrt(2 / 3), rel=1e-3) and loss.max_deg == pytest.approx(3, rel=1e-2)
    assert loss.length_percent < 0.1 and loss.kept == "symmetric"
    assert f"direction error {loss.rms_deg:.3g} deg rms" in done.data.decode()


def test_the_nearest_matrix_is_the_nearest():
    rng = np.random.default_rng(6)
    for shape in ("lower", "symmetric", "diagonal", "scalar"):
        H = so3.exp(0.1 * rng.normal(size=3)) @ (np.eye(3) + 0.05 * rng.normal(size=(3, 3)))
        best = nearest(H, shape)
        cost = np.linalg.norm(best @ np.linalg.inv(H) - np.eye(3))
        basis = {"lower": np.tri(3), "symmetric": np.ones((3, 3)), "diagonal": np.eye(3), "scalar": np.eye(3)}[shape]
        for _ in range(50):
            step = rng.normal(size=(3, 3)) * basis
            step = step + step.T if shape == "symmetric" else np.eye(3) * step[0, 0] if shape == "scalar" else step
            other = best + 0.05 * step
            assert np.linalg.norm(other @ np.linalg.inv(H) - np.eye(3)) > cost - 0.01
        assert np.linalg.det(best) == pytest.approx(np.linalg.det(H))
        np.testing.assert_array_equal(best * (1 - np.maximum(basis, basis.T if shape == "symmetric" else basis)), 0)


def test_splits_of_a_matrix_with_a_rotation():
    rng = np.random.default_rng(7)
    for _ in range(50):
        H = rng.normal(size=(3, 3))
        R = lower_frame(H)
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(R) > 0 and np.abs((R @ H)[np.triu_indices(3, 1)]).max() < 1e-12
        L, C = lower_times_rotation(H)
        np.testing.assert_allclose(L @ C, H, atol=1e-12)
        assert np.linalg.det(C) > 0 and L[0, 0] > 0 and L[1, 1] > 0


def test_board_orientations_are_those_of_mavlink():
    """Each is its Euler angles (test_rotations.cpp of ArduPilot); the 24 of a cube are all among them."""
    assert len(ORIENTATIONS) == 38
    for R in so3.cube_group():
        assert min(np.abs(R - Q).max() for Q in ORIENTATIONS) < 1e-12
    x, y, z = np.array([1.0, 2, 3])
    h = math.sqrt(0.5)
    for number, want in ((2, [-y, x, z]), (4, [-x, -y, z]), (8, [x, -y, -z]), (12, [-x, y, -z]), (16, [x, -z, y]),
                         (24, [z, y, -x]), (25, [-z, y, x]), (1, [h * (x - y), h * (x + y), z])):  # fmt: skip
        np.testing.assert_allclose(ORIENTATIONS[number] @ [x, y, z], want, atol=1e-12)
    assert [orientation_number(R) for R in ORIENTATIONS][:12] == list(range(12))


@pytest.mark.parametrize("name", lossy)
def test_more_loss_than_allowed_is_refused_with_its_size(name):
    target, calibration = find(name), node(1)
    with pytest.raises(DataError, match=r"direction error [\d.]+ deg rms") as caught:
        exported(calibration, target, allow_lossy=False)
    assert caught.value.issues[0].code == "export-loss" and caught.value.issues[0].value > 0.5
    assert exported(calibration, target, allow_lossy=False, max_loss_deg=10).losses
    if name in ("kalibr", "basalt"):
        assert "--move-frame" in str(caught.value)


def test_values_out_of_range_are_named():
    calibration = node(1, ALIGNED, kinds=("acc",))
    far = replace(calibration, acc=replace(calibration.acc, B=np.array([900.0, 0, 0])))
    with pytest.raises(DataError, match=r"INS_ACCOFFS is 4\.3.* m/s\^2, outside -3.5 to 3.5"):
        export(far, find("ardupilot"), scale=SCALE)
    done = export(far, find("ardupilot"), scale=SCALE, allow_lossy=True)
    assert "outside -3.5 to 3.5" in done.warnings[0] and "outside -3.5 to 3.5" in done.data.decode()
    with pytest.raises(DataError, match=r"INS_ACCSCAL is 1\.4"):
        export(calibration, find("ardupilot"), scale={"acc": SCALE["acc"] / 1.42})
    magnet = node(1, ALIGNED, kinds=("mag",))
    strong = replace(magnet, mag=replace(magnet.mag, B=np.array([400.0, 0, 0])))  # 60 uT: allowed, with a warning
    done = export(strong, find("ardupilot"), scale=SCALE)
    assert "COMPASS_OFS is -600" in done.warnings[0] or "COMPASS_OFS is -60" in done.warnings[0]
    with pytest.raises(DataError, match="COMPASS_OFFS_MAX"):
        export(replace(magnet, mag=replace(magnet.mag, B=np.array([1400.0, 0, 0]))), find("ardupilot"), scale=SCALE)


def test_raw_counts_need_the_scale_of_the_driver():
    with pytest.raises(DataError, match=r"px4 takes acc readings in m/s\^2.*--scale acc="):
        export(node(1, ALIGNED), find("px4"))
    with pytest.raises(DataError, match="c-q15 takes raw counts; acc was calibrated from readings in g"):
        in_g = replace(node(1).acc, raw_unit="g", H=9.8 * np.eye(3), B=np.zeros(3))
        export(Calibration(acc=in_g), find("c-q15"))
    with pytest.raises(UsageError, match="takes readings in any unit"):
        export(node(1), find("c"), scale=SCALE)
    with pytest.raises(UsageError, match="c-q15 takes raw counts"):
        export(node(1), find("c-q15"), scale=SCALE)
    in_g = SensorModel("acc", STANDARD_GRAVITY * np.eye(3), np.zeros(3), raw_unit="g")
    with pytest.raises(UsageError, match="the calibration is for g, whose scale is known"):
        export(Calibration(acc=in_g), find("px4"), scale={"acc": 0.005})
    with pytest.raises(UsageError, match="kalibr and basalt"):
        export(node(1), find("c"), move_frame=True)


def test_named_raw_units_are_converted():
    """A calibration from g gives the same parameters as the one from m/s^2."""
    H, B = np.diag([1.01, 0.99, 1.02]), np.array([0.2, -0.1, 0.3])
    si = Calibration(acc=SensorModel("acc", H, B, raw_unit="mps2"))
    g = Calibration(acc=SensorModel("acc", H * STANDARD_GRAVITY, B / STANDARD_GRAVITY, raw_unit="g"))
    for name in ("px4", "ardupilot", "ros-imu-calib", "ggir", "actipy", "basalt", "kalibr"):
        a, b = (export(c, find(name)).page.sensors["acc"].fields for c in (si, g))
        for key in a:
            np.testing.assert_allclose(a[key], b[key], rtol=1e-6, atol=1e-12)
    (row,) = csv.DictReader(io.StringIO(export(si, find("ggir")).data.decode()))
    assert float(row["offset.x"]) == pytest.approx(-0.2 / STANDARD_GRAVITY)


def test_a_field_that_is_the_unit_needs_its_strength():
    model = SensorModel("mag", np.eye(3) * 0.003, np.zeros(3), unit="norm", reference_vector=[0, 0.4, -0.9])
    with pytest.raises(DataError, match="--field uT"):
        export(Calibration(mag=model), find("px4"), scale={"mag": 0.15})
    done = export(Calibration(mag=model), find("px4"), scale={"mag": 0.15}, field_uT=50.0)
    np.testing.assert_allclose(done.page.sensors["mag"].fields["diagonal"], 1.0, rtol=1e-6)
    back = import_calibration(export(Calibration(mag=model), find("motioncal")).data, "f", find("motioncal"))
    assert back.mag.unit == "norm"


def test_sensors_without_a_place_are_left_out_and_said_so():
    done = exported(node(1), find("imucal"))
    assert done.left_out == ()  # not asked for
    assert export(node(1), find("imucal")).left_out == ("mag",)
    with pytest.raises(DataError, match="imucal has no place for mag; it carries acc, gyr"):
        export(node(1), find("imucal"), sensors=("mag",))
    with pytest.raises(DataError, match="needs acc and gyr; gyr is not there"):
        export(node(1, kinds=("acc",)), find("imucal"))
    with pytest.raises(DataError, match="motioncal carries mag; the calibration holds acc"):
        export(node(1, kinds=("acc",)), find("motioncal"))
    with pytest.raises(DataError, match="gyr is not in the calibration"):
        export(node(1, kinds=("acc",)), find("c"), sensors=("gyr",))
    with pytest.raises(UsageError, match="one sensor; give --sensors acc or gyr"):
        export(node(1), find("imu-tk"))
    assert list(export(node(1), find("magneto")).models) == ["mag"]
    assert "fail" in export(replace(node(1), verdict="fail"), find("c")).warnings[0]


def test_names_that_are_no_target_get_a_hint():
    with pytest.raises(UsageError, match=r"did you mean.*px4"):
        find("PX5")
    with pytest.raises(UsageError, match="is no target"):
        find("\x1b[31m")


# --- files that other programs wrote --------------------------------------------------------------------

ADAFRUIT = b"""// Offsets applied to raw x/y/z mag values
float mag_offsets[3]            = { 13.37F, -4.91F, 79.91F };
// Soft iron error compensation matrix
float mag_softiron_matrix[3][3] = { {  1.012,  0.003,  0.004 },
                                    {  0.003,  0.963,  0.004 },
                                    {  0.003,  0.005,  1.027 } };
float mag_field_strength        = 48.87F;
"""
KALIBR = b"""imu0:
  T_i_b:
  - [1.0, 0.0, 0.0, 0.0]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  accelerometer_noise_density: 0.01
  accelerometers:
    M:
    - - 1.01
      - 0.0
      - 0.0
    - [0.002, 0.99, 0.0]
    - [0.003, -0.001,
       1.02]
  gyroscopes:
    A: [[0.001, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
    C_gyro_i:
    - [1.0, 0.0, 0.0]
    - [0.0, 1.0, 0.0]
    - [0.0, 0.0, 1.0]
    M:
    - [1.0, 0.0, 0.0]
    - [0.0, 1.001, 0.0]
    - [0.0, 0.0, 1.0]
  model: scale-misalignment
  rostopic: /imu0   # where it comes from
  update_rate: 200.0
"""
OPENVINS = b"""%YAML:1.0

imu0:
  T_i_b:
    - [1.0, 0.0, 0.0, 0.0]
    - [0.0, 1.0, 0.0, 0.0]
    - [0.0, 0.0, 1.0, 0.0]
    - [0.0, 0.0, 0.0, 1.0]
  rostopic: "/imu0"
  time_offset: 0.0
  model: "rpng"
  Ta:
      - [ 1.0, 0.001, 0.002 ]
      - [ 0.0, 1.1, -0.003 ]
      - [ 0.0, 0.0, 0.9 ]
  R_IMUtoACC:
      - [ 0.0, 1.0, 0.0 ]
      - [ -1.0, 0.0, 0.0 ]
      - [ 0.0, 0.0, 1.0 ]
"""
QGC = b"""# Onboard parameters for Vehicle 1
#
# Vehicle-Id Component-Id Name Value Type
1\t1\tCAL_ACC0_ID\t6684690\t6
1\t1\tCAL_ACC0_XOFF\t0.1\t9
1\t1\tCAL_ACC0_XSCALE\t1.01\t9
1\t1\tCAL_ACC0_YOFF\t-0.2\t9
1\t1\tCAL_ACC0_YSCALE\t0.99\t9
1\t1\tCAL_ACC0_ZOFF\t0.3\t9
1\t1\tCAL_ACC0_ZSCALE\t1.02\t9
1\t1\tCAL_MAG0_ROT\t-1\t6
1\t1\tCAL_MAG0_XOFF\t0.054209\t9
1\t1\tCAL_MAG0_XSCALE\t0.999952\t9
1\t1\tCAL_MAG0_XODIAG\t-0.006632\t9
1\t1\tCAL_MAG0_YOFF\t-0.012623\t9
1\t1\tCAL_MAG0_YSCALE\t0.984097\t9
1\t1\tCAL_MAG0_ZOFF\t-0.470882\t9
1\t1\tCAL_MAG0_ZSCALE\t1.017748\t9
1\t1\tSENS_BOARD_ROT\t2\t6
"""
MISSION_PLANNER = b"""#NOTE: 01.02.2025
AHRS_ORIENTATION,0
COMPASS_DIA_X,1.02
COMPASS_DIA_Y,0.98
COMPASS_DIA_Z,1.01
COMPASS_ODI_X,0.01
COMPASS_OFS_X,-120.5
COMPASS_OFS_Y,30
COMPASS_OFS_Z,7.25
COMPASS_ORIENT,2
COMPASS_SCALE,1.1
INS_ACCOFFS_X,0.05
INS_ACCOFFS_Y,-0.06
INS_ACCOFFS_Z,0.1
INS_ACCSCAL_X,1.001
INS_ACCSCAL_Y,0.999
INS_ACCSCAL_Z,0.995
"""


def test_the_text_people_have_of_motioncal():
    back = import_calibration(ADAFRUIT, "sketch.ino", find("motioncal"), units={"mag": "uT"}, unit={"mag": "uT"})
    np.testing.assert_array_equal(back.mag.B, [13.37, -4.91, 79.91])
    np.testing.assert_array_equal(back.mag.H, [[1.012, 0.003, 0.004], [0.003, 0.963, 0.004], [0.003, 0.005, 1.027]])
    assert (back.frame, back.mag.raw_unit) == ("unknown", "uT")
    assert [i.code for i in back.issues] == ["frame-unknown"]
    with pytest.raises(InputError, match="raw unit is not in the file; give --units mag=count"):
        import_calibration(ADAFRUIT, "sketch.ino", find("motioncal"))


def test_the_text_of_magneto():
    text = b"""Combined bias (b):
 -922.312  -724.354  813.166
Correction for combined scale factors,
 misalignments and soft iron (A-1):
 1.1 0.02 0
 0.02 1.2 -0.01
 0 -0.01 0.9
"""
    told = {"units": {"mag": "count"}, "unit": {"mag": "norm"}}
    back = import_calibration(text, "m.txt", find("magneto"), **told)
    np.testing.assert_array_equal(back.mag.B, [-922.312, -724.354, 813.166])
    assert back.mag.H[0, 1] == 0.02 and back.mag.unit == "norm"
    acc = import_calibration(
        text, "m.txt", find("magneto"), sensors=("acc",), units={"acc": "count"}, unit={"acc": "g"}
    )
    assert acc.acc.H[0, 0] == pytest.approx(1.1 * STANDARD_GRAVITY)


def test_kalibr_as_it_writes_itself():
    back = import_calibration(KALIBR, "imu.yaml", find("kalibr"))
    M = np.array([[1.01, 0, 0], [0.002, 0.99, 0], [0.003, -0.001, 1.02]])
    np.testing.assert_allclose(back.acc.H @ M, np.eye(3), atol=1e-15)
    codes = sorted((i.code, i.sensor) for i in back.issues if i.sensor)
    assert codes == [("bias-missing", "acc"), ("bias-missing", "gyr"), ("term-dropped", "gyr")]
    assert not back.acc.B.any() and back.acc.raw_unit == "mps2"


def test_openvins_with_upper_triangles():
    back = import_calibration(OPENVINS, "imu.yaml", find("openvins"))
    T = np.array([[1.0, 0.001, 0.002], [0, 1.1, -0.003], [0, 0, 0.9]])
    R = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    np.testing.assert_allclose(back.acc.H, R.T @ np.linalg.inv(T), atol=1e-14)
    assert list(back.models) == ["acc"]


def test_parameters_as_ground_stations_save_them():
    back = import_calibration(QGC, "px4.params", find("px4"))
    R = ORIENTATIONS[2]
    np.testing.assert_allclose(back.acc.H, R @ np.diag([1.01, 0.99, 1.02]))
    np.testing.assert_allclose(back.acc.B, [0.1, -0.2, 0.3])
    want = np.array([[0.999952, -0.006632, 0], [-0.006632, 0.984097, 0], [0, 0, 1.017748]])
    np.testing.assert_allclose(back.mag.H, want * 100)  # gauss to uT
    assert back.mag.raw_unit == "gauss" and "gyr" not in back.models
    back = import_calibration(MISSION_PLANNER, "ap.param", find("ardupilot"))
    M = 1.1 * np.array([[1.02, 0.01, 0], [0.01, 0.98, 0], [0, 0, 1.01]])
    y = np.random.default_rng(9).normal(size=(5, 3)) * 300
    turned = np.column_stack([-y[:, 1], y[:, 0], y[:, 2]])  # yaw 90
    np.testing.assert_allclose(back.mag.apply(y), (turned + np.array([-120.5, 30, 7.25])) @ M * 0.1, rtol=1e-12)
    spaces = import_calibration(MISSION_PLANNER.replace(b",", b"  "), "ap.parm", find("ardupilot"))
    np.testing.assert_array_equal(spaces.mag.H, back.mag.H)


def test_other_files_as_they_are_found():
    text = (
        b"# diff all\nset gyro_lpf = OFF\nset acc_calibration = -88,-49,23,1\nset mag_calibration = 12,-3,400\nsave\n"
    )
    back = import_calibration(text, "bf.txt", find("betaflight"), scale={"acc": 0.0048, "mag": 0.15})
    np.testing.assert_array_equal(back.acc.B, [-88, -49, 23])
    np.testing.assert_allclose(back.acc.H, 0.0048 * np.eye(3))
    with pytest.raises(InputError, match="bias of acc only; say the scale"):
        import_calibration(text, "bf.txt", find("betaflight"))
    temperature = ",".join(f"temperature.offset.{a}" for a in "xyz")
    table = (
        f"filename,n.hours,scale.x,scale.y,scale.z,offset.x,offset.y,offset.z,{temperature}\n"
        "P1.gt3x,24,1.01,0.99,1,0.02,-0.01,0,0,0,0\n"
    ).encode()
    back = import_calibration(table, "q.csv", find("ggir"))
    np.testing.assert_allclose(back.acc.apply([[0.5, 0.5, 0.5]]), [[0.5252 * 9.80665, 0.4851 * 9.80665, 0.5 * 9.80665]])
    with pytest.raises(DataError, match="temperature term"):
        import_calibration(table.replace(b",0,0,0\n", b",0.001,0,0\n"), "q.csv", find("ggir"))
    script = b"""D = load('x');
[A, b, expmfs] = magcal(D); % fitted
A = [1.01 0.02 0; 0.02, 0.99, ...
 0; 0 0 1];
b = [12 -30 5];
expmfs = 49.2;
"""
    told = {"units": {"mag": "uT"}, "unit": {"mag": "uT"}}
    back = import_calibration(script, "fit.m", find("matlab-text"), **told)
    np.testing.assert_array_equal(back.mag.B, [12, -30, 5])
    with pytest.raises(InputError, match="may be magcal's or accelcal's"):
        import_calibration(script.replace(b"expmfs = 49.2;", b""), "fit.m", find("matlab-text"), **told)
    in_si = {"units": {"acc": "mps2"}, "unit": {"acc": "mps2"}}
    silent = script.replace(b"expmfs = 49.2;", b"")
    acc = import_calibration(silent, "fit.m", find("matlab-text"), sensors=("acc",), **in_si)
    np.testing.assert_allclose(acc.acc.apply(np.zeros((1, 3))), [[12, -30, 5]])
    zeros = ",".join(["0"] * 12)
    numbers = f'"calib_accel_bias": [0.1,0,0,0.01,0,0,0,0,0], "calib_gyro_bias": [{zeros}]'
    basalt = f'{{"value0": {{"T_imu_cam": [], {numbers}}}}}'.encode()
    back = import_calibration(basalt, "c.json", find("basalt"))
    np.testing.assert_allclose(back.acc.apply(np.zeros((1, 3))), [[-0.1, 0, 0]])
    np.testing.assert_array_equal(back.gyr.H, np.eye(3))


def test_matlab_files_with_objects_are_refused():
    from scipy.io import savemat

    for value, why in (({"A": np.array([[1, "x"]], dtype=object)}, "cell"), ({"A": {"f": 1.0}}, "struct")):
        buffer = io.BytesIO()
        savemat(buffer, {**value, "b": np.zeros((1, 3))})
        with pytest.raises(InputError, match=f"class {why}"):
            import_calibration(buffer.getvalue(), "a.mat", find("matlab"), sensors=("mag",))
    with pytest.raises(InputError, match="-v7"):
        import_calibration(b"MATLAB 7.3 MAT-file".ljust(600), "a.mat", find("matlab"))
    with pytest.raises(InputError, match="256 kB"):
        import_calibration(bytes(300_000), "a.mat", find("matlab"))
    buffer = io.BytesIO()
    savemat(buffer, {"A": np.eye(3), "b": np.zeros((1, 3)), "expmfs": 50.0})
    back = import_calibration(buffer.getvalue(), "a.mat", find("matlab"), units={"mag": "uT"}, unit={"mag": "uT"})
    np.testing.assert_array_equal(back.mag.H, np.eye(3))


def test_files_that_are_too_large_or_something_else_are_refused():
    for target in TARGETS.values():
        with pytest.raises(InputError, match=r"larger than|256 kB"):
            import_calibration(bytes(MAX_BYTES + 1), "big", target, sensors=("acc",) if target.name == "imu-tk" else ())
        for data in (b"", b"\x00\xff\xfe", b"hello", b"{}", b"[]", b"\x89HDF\r\n\x1a\n", b"imu0:\n", b"a: [1, [2"):
            with pytest.raises(InputError):
                import_calibration(data, "other", target, sensors=("acc",) if target.name == "imu-tk" else ())


@pytest.mark.parametrize("name", [n for n, t in TARGETS.items() if t.vectors and not t.binary])
def test_a_number_that_was_changed_is_noticed_by_the_test_vectors(name):
    """Every digit string of the fields themselves, one after the other, its first digit changed."""
    target = find(name)
    text = exported(node(10), target).data.decode()
    page = target.read(text.encode(), "f", kinds_for(target))
    fields = [
        f for s in page.sensors.values() for k, f in s.fields.items() if (k, name) != ("B", "c-q15")
    ]  # below a step
    numbers = [v for f in fields for v in np.ravel(f) if abs(v) > 1e-3]
    changed = 0
    for value in numbers[:40]:
        for shown in (repr(float(value)), f"{value:.9g}", f"{round(float(value))}"):
            hits = list(re.finditer(rf"(?<![\w.]){re.escape(shown)}(?![\d.])", text))
            if len(hits) == 1 and len(shown) > 2:
                k = next(i for i, c in enumerate(shown) if c in "123456789")
                wrong = shown[:k] + str(int(shown[k]) % 9 + 1) + shown[k + 1 :]
                at = hits[0].start()
                with pytest.raises(InputError, match=r"test vectors|triangular|rotation|not what margcal writes"):
                    imported((text[:at] + wrong + text[at + len(shown) :]).encode(), target)
                changed += 1
                break
    assert changed >= 3


@every
def test_damaged_files_are_read_or_refused(name):
    """Bits flipped, pieces cut out and doubled, numbers replaced: a calibration, or an error of ours; nothing else."""
    target = find(name)
    rng = np.random.default_rng(list(name.encode()))
    whole = exported(node(7), target).data
    seen = {"read": 0, "refused": 0}
    for _ in range(25 if target.binary else 60):
        data = bytearray(whole)
        for _ in range(rng.integers(1, 4)):
            at = int(rng.integers(len(data)))
            what = rng.integers(5)
            if what == 0:
                data[at] ^= 1 << int(rng.integers(8))
            elif what == 1:
                del data[at:]
            elif what == 2:
                data[at : at + int(rng.integers(1, 40))] = b""
            elif what == 3:
                data[at:at] = data[at : at + 30]
            else:
                data[at:at] = [b"nan", b"1e999", b"-", b"[", b'"', b"\n", b"0"][int(rng.integers(7))]
        if not data:
            continue
        try:
            model = imported(bytes(data), target)
            dumps(model)
            seen["read"] += 1
        except MargcalError as error:
            assert "\n" not in str(error)
            seen["refused"] += 1
    assert seen["refused"] > 3


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("a: &x 1", "not read"),
        ("a: *x", "not read"),
        ("a: !!python/object:os.system 1", "not read"),
        ("a: {b: 1}", "not read"),
        ("a: |\n  b", "not read"),
        ("a: 1\na: 2", "twice"),
        ("a:\n\t b: 1", "tab"),
        ("a: [1, 2", "not closed"),
        ("a: 1]", "was not opened"),
        ("a: [1] 2", "follows"),
        ("a: 1\n   b: 2", "indentation"),
        ("- 1\nb: 2", "indentation"),
        ("a: " + "[" * 40 + "]" * 40, "deeply"),
        ("\n".join(" " * k + "- " for k in range(0, 60, 2)) + " " * 60 + "1", "deeply"),
        ("# nothing", "empty"),
    ],
)
def test_the_rest_of_yaml_is_refused(text, why):
    with pytest.raises(InputError, match=why):
        yaml_subset.load(text, "f")


def test_the_part_of_yaml_that_is_read():
    text = """%YAML:1.0
---
a: 1 # c
b:
- x
- [1, [2, -3e1]]
c:
  d: "q # not"
  e: 'f'
  g: true
  h: ~
  i:
    - - 1
      - 2
    - j: 3
      k: word two
l:
"""
    assert yaml_subset.load(text, "f") == {
        "a": 1.0,
        "b": ["x", [1.0, [2.0, -30.0]]],
        "c": {"d": "q # not", "e": "f", "g": True, "h": None, "i": [[1.0, 2.0], {"j": 3.0, "k": "word two"}]},
        "l": None,
    }


# --- names from files never become syntax ---------------------------------------------------------------

HOSTILE = [
    "*/ int main(void) { } /*",
    "x\n#include </etc/passwd>",
    "??/\n??=define ACC_H",
    "a\\",
    "]]>]]></script><script>alert(1)</script>",
    "x\nimu0:\n  model: evil",
    '=HYPERLINK("http://x")',
    "@SUM(1)",
    "-2+3",
    "%{\nsystem('rm')\n%}",
    "'; delete(1); %",
    "\x1b[31mred\x00\x07",
    "\u202egnirts\u2066",
    "margcal units: acc takes g gives g",
    "x\rset acc_calibration = 1,1,1,1",
    "é" * 500,
]


@every
def test_hostile_names_change_nothing(name):
    target = find(name)
    calm = exported(node(8, device="calm"), target)
    same = imported(calm.data, target)
    for device in HOSTILE:
        # the name is all that differs: the page is written again, nothing is computed again
        page = replace(calm.page, device=device)
        check_hostile(target, calm.data, target.write(page), same)


def check_hostile(target, calm, hostile, a):
    b = imported(hostile, target)
    for kind in a.models:
        np.testing.assert_array_equal(a.models[kind].H, b.models[kind].H)
        assert (a.models[kind].raw_unit, a.models[kind].unit) == (b.models[kind].raw_unit, b.models[kind].unit)
    if target.binary or target.suffix == ".json":
        return
    # text formats: the same lines but for the first comment (and names made from it), ASCII throughout
    lines = [x.decode("ascii").splitlines() for x in (calm, hostile)]
    assert len(lines[0]) == len(lines[1])
    other = [(p, q) for p, q in zip(*lines) if p != q]
    assert len(other) <= 3
    for _, q in other:
        assert re.match(
            r"( \*|#|%) margcal: calibration of |#(ifndef|define) MARGCAL_\w+_H$|[\w. ][\w. -]*,[\d.]+,", q
        ), q
        assert not set(q) & set('*?\\"<>%\x1b') - set("*%" if q.startswith((" *", "%")) else "")


def test_hostile_units_are_words_too():
    model = replace(node(8).acc, raw_unit="x */ #define y\n")
    calibration = Calibration(acc=model)
    for name in ("c", "magneto", "matlab-text", "imufusion"):
        data = export(calibration, find(name), sensors=("acc",)).data
        lines = data.decode("ascii").splitlines()
        assert all(re.match(r"#(define|ifndef) MARGCAL_|#ifdef MARG|#endif|#$", n) for n in lines if n.startswith("#d"))
        back = import_calibration(data, "f", find(name))
        np.testing.assert_allclose(back.acc.H, model.H, rtol=1e-6)


def test_what_is_left_of_a_name():
    assert plain("a*/b\n?") == "a_/b__"
    assert len(plain("x" * 999)) == 200
    assert identifier("7 b/ü*") == "7_B" and identifier("***") == "NODE"


# --- the verbs ------------------------------------------------------------------------------------------


@pytest.fixture
def cal(tmp_path):
    path = tmp_path / "cal.json"
    save(node(9, ALIGNED), path)
    return path


SCALES = ",".join(f"{k}={v!r}" for k, v in SCALE.items())


def test_export_and_import_from_the_command_line(cal, tmp_path, capsys):
    out, back = tmp_path / "px4.params", tmp_path / "back.json"
    assert run(["export", str(cal), "--to", "px4", "-o", str(out), "--scale", SCALES, "--json", "--check"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["target"] == "px4" and shown["written"] == str(out)
    assert shown["sensors"]["mag"]["keeps"] == "symmetric part" and shown["sensors"]["gyr"]["unit"] == "radps"
    assert 0 < shown["sensors"]["acc"]["direction_error_deg"]["rms"] < 0.5
    assert all(c["passed"] for c in shown["checks"])
    assert run(["import", str(out), "--from", "px4", "-o", str(back), "--scale", SCALES, "--device", "n9"]) == 0
    assert "no verdict" in capsys.readouterr().out
    got = load(back)
    assert got.device == "n9" and got.verdict is None and got.frame == "housing" and len(got.files[0][1]) == 64
    assert got.settings["imported_from"] == "px4"
    np.testing.assert_allclose(got.mag.B, node(9, ALIGNED).mag.B, rtol=1e-6)
    assert run(["export", str(cal), "--to", "px4", "-o", str(out), "--scale", SCALES]) == 1
    assert "--overwrite" in capsys.readouterr().err
    assert run(["export", str(cal), "--to", "px4", "-o", str(out), "--scale", SCALES, "--overwrite"]) == 0
    text = capsys.readouterr().out
    assert "direction error" in text and "written:" in text and "CAL_..._ID" in text


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        (["--to", "px4", "-o", "x"], 3, "--scale acc="),
        (["--to", "px4", "-o", "x", "--scale", SCALES, "--max-loss", "0.01"], 3, "more than 0.01 deg"),
        (["--to", "nothing", "-o", "x"], 2, "is no target"),
        (["--to", "c"], 2, "-o FILE"),
        (["--to", "c", "-o", "x", "--scale", "acc=0"], 2, "is no scale"),
        (["--to", "c", "-o", "x", "--sensors", "baro"], 2, "is no sensor"),
        (["--to", "c", "-o", "x", "--move-frame"], 2, "kalibr and basalt"),
        (["--to", "imu-tk", "-o", "x"], 2, "--sensors acc or gyr"),
        (["--to", "imucal", "-o", "x", "--sensors", "mag"], 3, "no place for mag"),
    ],
)
def test_what_cannot_be_exported(cal, tmp_path, capsys, monkeypatch, arguments, status, words):
    monkeypatch.chdir(tmp_path)
    assert run(["export", str(cal), *arguments]) == status
    error = capsys.readouterr().err
    assert words in error and error.count("\n") == 1
    assert not (tmp_path / "x").exists()


def test_what_cannot_be_imported(cal, tmp_path, capsys):
    sketch, out = tmp_path / "s.ino", tmp_path / "o.json"
    sketch.write_bytes(ADAFRUIT)
    for arguments, status, words in (
        (["--from", "motioncal"], 1, "--units mag=count"),
        (["--from", "motioncal", "--units", "mag=uT"], 1, "--unit mag=uT"),
        (["--from", "motioncal", "--units", "mag=uT", "--unit", "mag=furlong"], 1, "no unit of a calibrated vector"),
        (["--from", "motioncal", "--units", "mag=uT", "--unit", "mag=uT", "--sensors", "acc"], 3, "acc is not in it"),
        (["--from", "px4"], 1, "holds none of"),
    ):
        assert run(["import", str(sketch), *arguments, "-o", str(out)]) == status
        assert words in capsys.readouterr().err and not out.exists()
    assert run(["import", str(tmp_path / "none"), "--from", "px4", "-o", str(out)]) == 1
    told = ["--from", "motioncal", "--units", "mag=uT", "--unit", "mag=uT"]
    assert run(["import", str(sketch), *told, "-o", str(out), "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["sensors"] == {"mag": {"raw_unit": "uT", "unit": "uT"}}
    assert shown["issues"][0]["code"] == "frame-unknown"


def test_the_list_names_every_target(capsys):
    assert run(["export", "--list"]) == 0
    text = capsys.readouterr().out
    assert all(name in text for name in TARGETS)
    assert run(["export", "--list", "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert [t["name"] for t in shown] == list(TARGETS) and all(t["facts"] and t["carries"] for t in shown)


# --- the page -------------------------------------------------------------------------------------------


def test_the_table_of_the_page_is_true():
    """Words are equal; figures may differ in the last digit from machine to machine."""
    text = PAGE.read_text(encoding="utf-8")
    shown = text.split(BEGIN)[1].split(END)[0].strip().splitlines()
    made = table().strip().splitlines()
    assert len(shown) == len(made)
    for a, b in zip(shown, made):
        for x, y in zip(a.split("|"), b.split("|")):
            if re.fullmatch(r"\s*[\d.]+(e-?\d+)?\s*", x) and re.fullmatch(r"\s*[\d.]+(e-?\d+)?\s*", y):
                assert float(x) == pytest.approx(float(y), rel=0.06), f"{a}\n{b}\nrun: python tests/exchange_table.py"
            else:
                assert x == y, f"{a}\n{b}\nrun: python tests/exchange_table.py"


def test_the_page_gives_the_formula_of_every_form():
    text = PAGE.read_text(encoding="utf-8")
    for target in TARGETS.values():
        for kind, form in target.forms.items():
            formula = re.sub(r"R_[ag]\^-1 K_[ag]\^-1 \(y .*", "R^-1 K^-1 (y - b)", form.formula)
            formula = re.sub(r"^y = (.*) \+ b$", r"\1 + b", formula)
            assert formula.replace(" - Tg a", "").replace("GYRO", "ACC").replace("Tw", "Ta") in text, (
                f"{target.name} {kind}: {formula}"
            )
