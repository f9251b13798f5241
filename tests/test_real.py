"""The table "It runs on real input" of issue 2. Skipped where the recordings are not at hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import margcal
from margcal.core import so3
from margcal.core.errors import DataError
from margcal.files.poses_table import PoseTable
from margcal.methods.gyro_start import full_turns
from margcal.methods.preintegration import integrate, pad
from margcal.methods.uncertainty import direction_errors_deg
from margcal.workflow.calibrate import calibrate
from margcal.workflow.simulate import simulate


def cut(recording, start, stop):
    """The recording from `start` to `stop`, s."""
    streams = {}
    for kind, s in recording.streams.items():
        inside = (s.t >= start) & (s.t <= stop)
        streams[kind] = replace(s, t=s.t[inside], y=s.y[inside])
    return replace(recording, **streams)


def codes(calibration) -> dict:
    return {i.code: i for i in calibration.issues}


# --- imu_tk ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def xsens(data_file):
    recording = margcal.read(data_file("imu_tk/xsens_mti_multipose.parquet"))
    return calibrate(recording, poses="free", gravity=9.81744)


@pytest.mark.parametrize("kind, factory", [("acc", [415, 413, 415]), ("gyr", [4778, 4758, 4766])])
def test_xsens_scales_are_those_of_the_factory_sheet(xsens, kind, factory):
    scale = np.linalg.norm(np.linalg.inv(xsens.models[kind].H), axis=1)  # counts per SI unit
    assert scale == pytest.approx(factory, rel=0.005)


def test_xsens_bias_is_that_of_the_authors(xsens):
    assert pytest.approx([33123, 33276, 32360], abs=8) == xsens.acc.B


def test_xsens_propagation_residual(xsens):
    """Gravity at one rest, carried to the next by the gyroscope, against the accelerometer there."""
    turns = [t for t in xsens.turns if t.y.max() < 65300]
    batch = pad(turns)
    dR = integrate(batch.y, batch.dt, xsens.gyr.H, xsens.gyr.B)
    v = xsens.acc.apply(xsens.poses.mean["acc"])
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    carried = np.einsum("tba,tb->ta", dR, v[[t.before for t in turns]])
    off = np.degrees(np.arccos(np.clip(np.sum(carried * v[[t.after for t in turns]], axis=1), -1, 1)))
    assert len(turns) >= 30
    assert np.sqrt(np.mean(off**2)) <= 0.6


def test_xsens_says_what_it_took(xsens):
    assert xsens.frame == "acc-triangular"
    assert xsens.settings["attitudes"] == "free"
    assert np.allclose(np.tril(xsens.acc.H, -1), 0)
    assert len(xsens.poses) == pytest.approx(38, abs=1)
    assert not [i for i in xsens.issues if i.level == "fail"]
    assert xsens.acc.expected_error_deg < 0.2
    assert xsens.gyr.expected_error_deg < 0.5


# --- imucal ------------------------------------------------------------------------------------------


LATER_RESTS = ((61.7, 65.7), (69.7, 73.9), (75.8, 78.5), (82.3, 85.5), (87.2, 89.4), (93.3, 100.8))


@pytest.fixture(scope="module")
def session(data_file):
    return margcal.read(data_file("imucal/ferraris_session.parquet"))


@pytest.fixture(scope="module")
def session_60(session):
    return calibrate(cut(session, 0.0, 60.0), poses="faces")


def test_imucal_faces_are_right(session, session_60):
    """The raw accelerometer is right to a few per cent: the face that is up is its largest component."""
    raw = session_60.poses.mean["acc"]
    k = np.argmax(np.abs(raw), axis=1)
    sign = np.sign(raw[np.arange(len(raw)), k])
    up = session_60.poses.R[:, 2, :]
    assert np.array_equal(np.argmax(np.abs(up), axis=1), k)
    assert np.array_equal(np.sign(up[np.arange(len(up)), k]), sign)
    assert len({(int(a), int(b)) for a, b in zip(k, sign)}) == 6
    assert session_60.frame == "housing"


def test_imucal_first_minute_calibrates_the_later_rests(session, session_60):
    for start, stop in LATER_RESTS:
        u = session_60.acc.apply(cut(session, start, stop).acc.y.mean(axis=0))
        assert abs(np.linalg.norm(u) - 9.80665) <= 0.015, (start, stop)


def test_imucal_bias_is_what_is_known(session_60):
    assert pytest.approx([0.55, -0.62, 0.39], abs=0.05) == session_60.acc.B


def test_imucal_is_no_cube(session):
    """Its headings are 25 to 44 degrees off any multiple of ninety: `auto` must not take it for one."""
    calibration = calibrate(session)
    assert calibration.settings["attitudes"] == "faces"
    with pytest.raises(DataError, match="headings"):
        calibrate(session, poses="cube")


def test_imucal_full_turns_check_the_gyroscope(session):
    """-370, -354, -359 degrees raw. x and z close within 2 degrees; y misses by 3.8: its gain hangs on one turn in
    which the box clattered, and the program's own standard error for it is 3 degrees a turn."""
    calibration = calibrate(session, poses="faces")
    issue = codes(calibration)["full-turns"]
    assert "3 full turns" in issue.text
    found = full_turns(calibration.turns, calibration.gyr.H, calibration.gyr.B, low_deg=300, high_deg=420)
    assert len(found.angle_deg) == 3
    order = np.argmax(np.abs(found.axis), axis=1)
    assert order.tolist() == [0, 1, 2]
    assert found.angle_deg[[0, 2]] == pytest.approx([360, 360], abs=2.0)
    assert found.angle_deg[1] == pytest.approx(360, abs=4.5)
    # and it knows: the gain along each axis has a standard error that covers the miss
    C = calibration.gyr.covariance[:9, :9]
    gain = np.linalg.inv(calibration.gyr.H)
    for i, angle, axis in zip(order, found.angle_deg, found.axis):
        rows = np.kron(axis, gain @ axis)  # relative change of the angle about the axis
        assert abs(angle - 360) < 3 * 360 * np.sqrt(rows @ C @ rows), i
    # raw, they do not close
    raw = full_turns(calibration.turns, np.eye(3) * np.pi / 180, calibration.gyr.B, low_deg=300, high_deg=420)
    assert np.abs(raw.angle_deg - 360).max() > 5


def test_imucal_full_turns_have_no_part_in_the_fit(session):
    """With 5 per cent more rate in the full turns alone, the gyroscope stays what it is."""
    before = calibrate(session, poses="faces")
    gyr = session.gyr
    y = gyr.y.copy()
    for a, b in ((66.0, 69.6), (78.9, 82.2), (89.8, 93.0)):
        inside = (gyr.t > a) & (gyr.t < b)
        y[inside] = before.gyr.B + 1.02 * (y[inside] - before.gyr.B)
    after = calibrate(replace(session, gyr=replace(gyr, y=y)), poses="faces")
    assert pytest.approx(before.gyr.H, rel=1e-3, abs=2e-5) == after.gyr.H


# --- mikoff ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def board(data_file):
    files = [data_file(f"mikoff/mpu9150_imu{i}.parquet") for i in range(3)]
    return [calibrate(margcal.read(f), poses="free") for f in files]


def test_mikoff_rests_and_their_norm(board):
    for calibration in board:
        assert 18 <= len(calibration.poses) <= 19
        norm = np.linalg.norm(calibration.acc.apply(calibration.poses.mean["acc"]), axis=1)
        assert np.std(norm / 9.80665) <= 4e-4
        assert norm.mean() == pytest.approx(9.80665, rel=2e-4)


def test_mikoff_sensors_turn_by_the_same_angle(board):
    """Three sensors on one board, each in a frame of its own: angles between common rests agree within a degree."""
    common = []
    for j, (a, b) in enumerate(zip(board[0].poses.start, board[0].poses.stop)):
        match = [np.flatnonzero((c.poses.start < b) & (c.poses.stop > a)) for c in board]
        if all(len(m) == 1 for m in match):
            common.append([int(m[0]) for m in match])
        del j
    index = np.array(common)
    assert len(index) >= 17
    angles = []
    for k, calibration in enumerate(board):
        R = calibration.poses.R[index[:, k]]
        angles.append(np.degrees(so3.angle_between(R[:-1], R[1:])))
    assert np.ptp(angles, axis=0).max() < 1.0
    assert np.max(angles) > 60


# --- tyrex -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def phone_mag(data_file):
    return calibrate(margcal.read(data_file("tyrex/calib_mag_Nexus5_d1")), poses="swing", sensors=["mag"])


def test_phone_hard_and_soft_iron(phone_mag):
    mag = phone_mag.mag
    assert pytest.approx([58.1, -73.5, 411.6], abs=2.0) == mag.B
    S = so3.polar(mag.H)[1]
    S /= np.cbrt(np.linalg.det(S))
    known = np.array([[1.002, 0.027, -0.026], [0.027, 0.976, 0.013], [-0.026, 0.013, 1.024]])
    assert known == pytest.approx(S, abs=0.01)


def test_phone_magnetometer_is_aligned_and_says_how_well(phone_mag):
    issue = codes(phone_mag)["aligned-to-gyroscope"]
    assert "standard errors" in issue.text
    assert 0 < issue.value < 1.0
    assert np.degrees(so3.angle_between(so3.polar(phone_mag.mag.H)[0], np.eye(3))) < 10
    assert phone_mag.mag.expected_error_deg is not None
    assert "calib_mag_Nexus5_d1" in phone_mag.settings["sources"]["mag"]
    assert phone_mag.settings["attitudes"] == "swing"


def test_phone_accelerometer_carries_bias_and_scale_only(data_file):
    calibration = calibrate(margcal.read(data_file("tyrex/calib_acc_Nexus5_d1")), poses="free", sensors=["acc"])
    H = calibration.acc.H
    assert np.array_equal(H, np.diag(np.diag(H)))
    issue = codes(calibration)["bias-and-scale-only"]
    assert issue.level == "warn"
    assert "record" in issue.text
    assert 6 <= issue.value <= 11
    # six parameters leave a residual and an error that own up to the angles they do not know
    assert calibration.acc.residual_rms > 1e-3
    assert calibration.acc.expected_error_deg > 0.3
    assert np.diag(H) == pytest.approx(np.ones(3), abs=0.05)


def test_phone_three_sessions_make_one_node(data_file):
    names = [f"tyrex/calib_{kind}_Nexus5_d1" for kind in ("acc", "gyr", "mag")]
    calibration = calibrate(*(margcal.read(data_file(n)) for n in names))
    assert set(calibration.models) == {"acc", "gyr", "mag"}
    assert "calib_mag" in calibration.settings["sources"]["mag"]
    # each file of the three is in the provenance
    assert len(calibration.files) >= 3
    assert pytest.approx([58.1, -73.5, 411.6], abs=3.0) == calibration.mag.B
    assert pytest.approx(np.zeros(3), abs=0.1) == calibration.gyr.B
    for model in calibration.models.values():
        assert model.expected_error_deg is not None


# --- reference ---------------------------------------------------------------------------------------


def test_reference_attitudes_do_what_a_table_of_them_does():
    sim = simulate(seed=3, poses="free", n_poses=16, rest_s=3.0, reference=True, reference_gaps=3, housing_sd_deg=0.0)
    by_reference = calibrate(sim.recording, poses="reference")
    assert by_reference.frame == "marker"
    assert by_reference.settings["attitudes"] == "reference"
    table = PoseTable(q=so3.quat_from_matrix(sim.R_nh))
    by_table = calibrate(replace(sim.recording, reference=None), poses=table)
    assert by_table.frame == "housing"
    for kind, truth in sim.truth.models.items():
        size = None if kind == "gyr" else float(np.linalg.norm(truth.reference_vector))
        a, b = by_reference.models[kind], by_table.models[kind]
        assert direction_errors_deg(a.H, a.B, truth.H, truth.B, size).max() < 0.1
        assert direction_errors_deg(a.H, a.B, b.H, b.B, size).max() < 0.05
    assert calibrate(sim.recording).settings["attitudes"] == "reference"  # what `auto` takes
