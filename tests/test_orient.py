"""`margcal orient`: from raw counts to attitudes, against simulated truth and BROAD; what is refused, what is said."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from margcal.apps.cli import run as command
from margcal.core import so3
from margcal.core.errors import DataError, InputError, UsageError
from margcal.core.types import Recording, Stream
from margcal.files.calfile import save
from margcal.files.tables import read, write_table
from margcal.methods.tracking import GAP, MAG
from margcal.workflow.orient import FRAMES, orient
from margcal.workflow.orient_start import find_rests
from margcal.workflow.simulate import simulate, swing

CODES_OF_NOTE = {"gyro-bias", "heading-drifts", "mag-delay", "drifts"}


def error_deg(q: np.ndarray, truth: np.ndarray) -> np.ndarray:
    return np.degrees(np.linalg.norm(so3.quat_log(so3.quat_multiply(q, so3.quat_conjugate(truth))), axis=-1))


def codes(found) -> set[str]:
    return {i.code for i in found.issues}


@pytest.fixture(scope="module")
def session():
    """Four rests and the turns between them, raw counts; twelve seconds."""
    return simulate(n_poses=4, rate=50, rest_s=2.0, turn_s=1.5, seed=3, housing_sd_deg=0, reference=True)


@pytest.fixture(scope="module")
def truth(session):
    return so3.quat_from_matrix(session.motion.at(session.recording.gyr.t).R)


def cut(recording: Recording, keep) -> Recording:
    streams = {k: Stream(k, s.t[keep], s.y[keep], s.unit) for k, s in recording.streams.items()}
    return replace(recording, **streams, reference=None)


@pytest.mark.parametrize("name", ["vector-selection", "ekf-quest", "gyro"])
def test_raw_counts_and_their_calibration_give_the_true_attitude(session, truth, name):
    found = orient(session.recording, session.truth, filter=name)
    assert error_deg(found.attitude.q, truth).max() < 2.0
    assert codes(found) <= CODES_OF_NOTE
    assert found.attitude.parent == "earth (enu)"
    assert np.all(np.sum(found.attitude.q[1:] * found.attitude.q[:-1], axis=1) > 0)
    conjugated = so3.quat_conjugate(found.attitude.q)
    assert error_deg(conjugated, truth).max() > 60  # the test would see it


def test_the_node_without_its_calibration_is_wrong(session, truth):
    """H and B matter: the same counts scaled by the nominal gain alone are tens of degrees off."""
    nominal = {
        k: replace(m, H=np.eye(3) * np.cbrt(abs(np.linalg.det(m.H))), B=np.zeros(3))
        for k, m in session.truth.models.items()
    }
    found = orient(session.recording, replace(session.truth, **nominal))
    assert error_deg(found.attitude.q, truth).max() > 10


@pytest.mark.parametrize("frame", list(FRAMES))
def test_frames(session, frame):
    """What the frames call up, north and east is the same thing."""
    enu = orient(session.recording, session.truth, filter="gyro").attitude
    other = orient(session.recording, session.truth, filter="gyro", frame=frame).attitude
    axes = {"enu": np.eye(3), "ned": [[0, 1, 0], [1, 0, 0], [0, 0, -1]], "nwu": [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]}
    expected = np.array(axes[frame]) @ so3.matrix_from_quat(enu.q)
    assert np.allclose(so3.matrix_from_quat(other.q), expected, atol=1e-12)


def test_given_start_attitude_is_in_the_frame_of_the_result(session, truth):
    q0 = so3.quat_multiply(FRAMES["ned"], truth[0])
    found = orient(session.recording, session.truth, filter="gyro", frame="ned", q0=q0)
    assert error_deg(found.attitude.q[0], q0) < 0.1
    with pytest.raises(InputError, match="no unit quaternion"):
        orient(session.recording, session.truth, q0=[1, 1, 0, 0])


def test_without_the_magnetometer_heading_is_relative_and_said(session, truth):
    found = orient(session.recording, session.truth, mag=False)
    assert "heading-drifts" in codes(found)
    assert not np.any(found.flags & MAG)
    up = np.einsum("ni,ni->n", so3.matrix_from_quat(found.attitude.q)[:, 2], so3.matrix_from_quat(truth)[:, 2])
    assert np.degrees(np.arccos(np.clip(up, -1, 1))).max() < 2
    turned = so3.quat_multiply(found.attitude.q, so3.quat_conjugate(truth))
    heading = np.unwrap(2 * np.arctan2(turned[:, 3], turned[:, 0]))
    assert np.degrees(np.ptp(heading)) < 2.5


def test_sensors_on_clocks_of_their_own_are_brought_to_the_gyroscopes():
    made = simulate(n_poses=3, rate=40, rest_s=2.0, turn_s=1.5, seed=4, separate_clocks=True)
    found = orient(made.recording, made.truth)
    assert np.array_equal(found.attitude.t, made.recording.gyr.t)
    truth = so3.quat_from_matrix(made.motion.at(found.attitude.t).R)
    assert error_deg(found.attitude.q, truth).max() < 2.5


def test_delays_of_the_file_are_corrected_and_can_be_told_from_the_motion():
    made = swing(duration_s=40, rate=50, seed=5, mag_delay_s=0.04)
    late = {how: orient(made.recording, made.truth, filter="gyro", delays=how) for how in ("file", "estimate", "none")}
    assert late["file"].figures["delays_s"] == {"mag": 0.04}
    assert late["none"].figures["delays_s"] == {}
    assert late["estimate"].figures["delays_s"]["mag"] == pytest.approx(0.04, abs=1.5e-3)
    assert "mag-delay" in codes(late["estimate"])
    resting = simulate(n_poses=1, rate=50, rest_s=8.0, seed=6)
    untold = orient(resting.recording, resting.truth, filter="gyro", delays="estimate")
    assert "no-mag-delay" in codes(untold)
    assert untold.figures["delays_s"] == {}


def test_a_delayed_magnetometer_turns_the_heading_unless_corrected():
    made = swing(duration_s=14, rate=50, seed=7, mag_delay_s=0.15)
    truth = so3.quat_from_matrix(made.motion.at(made.recording.gyr.t).R)
    corrected, not_ = (orient(made.recording, made.truth, delays=how).attitude.q for how in ("file", "none"))
    tail = slice(-300, -10)
    rms = [float(np.sqrt(np.mean(error_deg(q, truth)[tail] ** 2))) for q in (corrected, not_)]
    assert rms[0] < 0.7 * rms[1]


def test_gaps_are_held_and_said_and_recovered_from(session, truth):
    t = session.recording.gyr.t
    keep = (t < 4.5) | (t > 6.0)
    found = orient(cut(session.recording, keep), session.truth)
    assert "gaps" in codes(found)
    assert found.figures["gaps"] == 1
    k = int(np.flatnonzero(found.flags & GAP)[0])
    assert found.variance[k].max() > 10 * found.variance[k - 1].max()
    assert error_deg(found.attitude.q, truth[keep])[-50:].max() < 6


def test_a_rate_that_changes_half_way_is_no_matter(session, truth):
    keep = np.ones(len(truth), dtype=bool)
    keep[300:] = np.arange(len(truth) - 300) % 2 == 0
    found = orient(cut(session.recording, keep), session.truth)
    assert error_deg(found.attitude.q, truth[keep]).max() < 3.5
    assert found.figures["gaps"] == 0


def test_saturation_is_taken_out_and_said(session, truth):
    recording = session.recording
    y = recording.gyr.y.copy()
    limit = 0.6 * np.abs(y[:, 0]).max()
    clipped = replace(recording, gyr=Stream("gyr", recording.gyr.t, np.clip(y, -limit, limit), "count"))
    found = orient(clipped, session.truth)
    assert {"saturated", "missing-readings", "no-rate"} & codes(found) >= {"saturated"}
    assert found.figures["without_rate"] > 5
    assert np.isfinite(found.attitude.q).all()
    assert error_deg(found.attitude.q, truth)[-25:].max() < 15


def test_missing_readings_zero_field_and_free_fall_leave_finite_attitudes(session):
    recording = orient_ready(session)
    acc, gyr, mag = (recording.streams[k].y.copy() for k in ("acc", "gyr", "mag"))
    mag[100:260], acc[280:330], gyr[340:350] = 0.0, 0.01, np.nan
    broken = Recording.from_arrays(
        recording.gyr.t, acc=acc, gyr=gyr, mag=mag, units={"acc": "mps2", "gyr": "radps", "mag": "uT"}
    )
    for name in ("vector-selection", "ekf-quest"):
        found = orient(broken, filter=name)
        assert np.isfinite(found.attitude.q).all()
        assert np.allclose(np.linalg.norm(found.attitude.q, axis=1), 1, atol=1e-12)
        assert found.variance.min() > 0
        assert {"mag-not-used", "no-rate", "missing-readings"} <= codes(found)


def orient_ready(session) -> Recording:
    """The session in SI units."""
    return replace(session.truth.apply(session.recording), reference=None)


def test_si_readings_need_no_calibration_and_counts_do(session, truth):
    found = orient(orient_ready(session))
    assert error_deg(found.attitude.q, truth).max() < 2
    with pytest.raises(InputError, match="is in count and there is no calibration: calibrate the node first"):
        orient(session.recording)
    with pytest.raises(InputError, match="the calibration takes count"):
        orient(orient_ready(session), session.truth)


def test_what_cannot_be_done_is_refused_in_words(session):
    si = orient_ready(session)
    with pytest.raises(InputError, match="holds no gyroscope"):
        orient(replace(si, gyr=None))
    with pytest.raises(InputError, match="holds no accelerometer"):
        orient(replace(si, acc=None))
    with pytest.raises(UsageError, match="no filter 'best'"):
        orient(si, filter="best")
    with pytest.raises(UsageError, match="no frame 'xyz'"):
        orient(si, frame="xyz")  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="delays 'all'"):
        orient(si, delays="all")  # type: ignore[arg-type]
    later = Stream("acc", si.acc.t + 1e4, si.acc.y, "mps2")
    with pytest.raises(DataError, match="no usable reading in the time of the gyroscope"):
        orient(replace(si, acc=later))


def test_short_and_empty_minded_recordings():
    for n in (1, 2, 5):
        one = np.tile([0.0, 0.0, 9.8], (n, 1))
        recording = Recording.from_arrays(
            rate=100.0, acc=one, gyr=0 * one, mag=one[:, ::-1] * 5, units={"acc": "mps2", "gyr": "radps", "mag": "uT"}
        )
        found = orient(recording)
        assert np.isfinite(found.attitude.q).all()
        assert found.attitude.q.shape == (n, 4)
    nothing = np.zeros((50, 3))
    found = orient(
        Recording.from_arrays(
            rate=100.0, acc=nothing, gyr=nothing, mag=nothing, units={"acc": "g", "gyr": "dps", "mag": "uT"}
        )
    )
    assert np.isfinite(found.attitude.q).all()
    assert {"acc-not-used", "no-field", "heading-drifts"} <= codes(found)


def test_uncalibrated_scale_is_named(session):
    si = orient_ready(session)
    found = orient(replace(si, acc=Stream("acc", si.acc.t, 1.08 * si.acc.y, "mps2")), filter="gyro")
    assert "gravity" in codes(found)


# --- the verb -----------------------------------------------------------------------------------------


def test_verb_writes_a_table_that_is_the_attitude(session, truth, tmp_path, capsys):
    s = session.recording
    columns = {"t_s": s.gyr.t} | {
        f"{k}_{a}_count": v.y[:, i] for k, v in s.streams.items() for i, a in enumerate("xyz")
    }
    raw, cal, out = (str(tmp_path / n) for n in ("walk.csv", "node.json", "q.csv"))
    write_table(raw, columns)
    save(session.truth, cal)
    assert command(["orient", raw, "--calibration", cal, "-o", out, "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["filter"] == "vector-selection"
    assert summary["samples"] == len(truth)
    assert summary["written"] == out
    header, *rows = (tmp_path / "q.csv").read_text().split()
    assert header == "t_s,qw,qx,qy,qz"
    q = np.array([[float(v) for v in row.split(",")] for row in rows])
    assert np.allclose(q[:, 0], s.gyr.t)
    assert error_deg(q[:, 1:], truth).max() < 2
    assert command(["orient", raw, "--calibration", cal, "-o", out]) == 1  # exists
    assert "--overwrite" in capsys.readouterr().err
    assert command(["orient", raw, "-o", str(tmp_path / "r.csv")]) == 1
    assert "calibrate the node first" in capsys.readouterr().err
    assert command(["orient", raw, "--calibration", cal, "--filter", "best", "-o", str(tmp_path / "r.csv")]) == 2
    assert command(["orient", raw, "--calibration", cal, "--start", "1,0", "-o", str(tmp_path / "r.csv")]) == 2
    assert command(["orient", raw, "--calibration", cal, "-o", str(tmp_path / "r.txt.zip")]) == 1
    assert not (tmp_path / "r.csv").exists()
    parquet = str(tmp_path / "q.parquet")
    assert command(["orient", raw, "--calibration", cal, "--frame", "ned", "--no-mag", "-o", parquet]) == 0
    shown = capsys.readouterr().out
    assert "NED" in shown
    assert "heading is relative" in shown


# --- BROAD --------------------------------------------------------------------------------------------


def broad(path, seconds: float, every: int) -> tuple[Recording, np.ndarray, np.ndarray]:
    """A part of a trial at a lower rate (the mean of each few rates, every few of the others): recording, reference,
    moving."""
    import pyarrow.parquet as pq

    whole = read(path)
    n = min(len(whole.gyr.t), int(seconds * 286)) // every * every
    last = slice(every - 1, n, every)
    w = whole.gyr.y[:n].reshape(-1, every, 3).mean(axis=1)
    t = whole.gyr.t[last]
    streams = {k: Stream(k, t, whole.streams[k].y[last], whole.streams[k].unit) for k in ("acc", "mag")}
    recording = replace(whole, **streams, gyr=Stream("gyr", t, w, whole.gyr.unit), reference=None)
    moving = pq.read_table(path, columns=["movement"]).column(0).to_numpy()[last] > 0.5
    return recording, whole.reference.q[last], moving


@pytest.mark.parametrize("trial", ["05_undisturbed_slow_rotation_with_breaks_B", "03_undisturbed_slow_rotation_C"])
@pytest.mark.parametrize(("name", "limit"), [("vector-selection", 2.5), ("ekf-quest", 4.0)])
def test_broad(data_file, trial, name, limit):
    """Part of two trials, thinned, BROAD's total error; all eight in full are in benchmarks/studies/orientation.py."""
    recording, reference, moving = broad(data_file(f"broad/{trial}.parquet"), 60.0, 8)
    q = orient(recording, filter=name).attitude.q
    use = moving & ~np.isnan(reference).any(axis=1)
    assert use.sum() > 300
    error = error_deg(q[use], reference[use])
    assert np.sqrt(np.mean(error**2)) < limit


def test_broad_offline_vqf_gains_from_the_magnetometers_delay(data_file):
    pytest.importorskip("vqf")
    path = data_file("broad/21_undisturbed_fast_combined.parquet")
    recording, reference, moving = broad(path, 1e9, 1)
    use = moving & ~np.isnan(reference).any(axis=1)
    rms = {}
    for how in ("none", "estimate"):
        found = orient(recording, filter="vqf-offline", delays=how)
        rms[how] = float(np.sqrt(np.mean(error_deg(found.attitude.q[use], reference[use]) ** 2)))
    assert found.figures["delays_s"]["mag"] == pytest.approx(10.7e-3, abs=2.5e-3)
    assert rms["none"] == pytest.approx(5.24, abs=0.05)
    assert rms["estimate"] < 1.7


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (1.0, -2.0, 0.5)])
@pytest.mark.parametrize("turns", [False, True])
def test_a_steady_hand_is_no_rest_and_a_bias_of_the_same_rate_is_one(axis, turns):
    """3 deg/s read by the gyroscope: gravity and field tell whether the node turns."""
    rng = np.random.default_rng(4)
    t = np.arange(600) / 200
    rate = np.radians(3.0) * np.array(axis) / np.linalg.norm(axis)
    R = so3.exp(rate * t[:, None]) if turns else np.broadcast_to(np.eye(3), (len(t), 3, 3))
    acc = np.array([0.0, 0.0, 9.81]) @ R + rng.normal(0, 0.03, (len(t), 3))  # rows: R^T f
    mag = np.array([0.0, 18.0, -44.0]) @ R + rng.normal(0, 0.3, (len(t), 3))
    gyr = rate + rng.normal(0, 0.003, (len(t), 3))
    rests = find_rests(t, gyr, acc, mag)
    assert rests.still.any() != turns
    if turns:
        assert rests.gyr_bias is None
    else:
        np.testing.assert_allclose(rests.gyr_bias, rate, atol=1e-3)
        assert not find_rests(t, gyr, acc, mag, calibrated=True).still.any()  # a calibrated one has no such bias
