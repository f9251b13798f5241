"""Bad recordings through `orient` and `verify`: refused in words, or followed and what is wrong said."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from margcal.apps.cli import run as command
from margcal.core import so3
from margcal.core.errors import DataError, InputError
from margcal.core.types import Array, Kind, Mask, Recording, Stream
from margcal.files.calfile import save
from margcal.files.tables import read, write_table
from margcal.workflow.apply import apply_file
from margcal.workflow.calibrate import calibrate
from margcal.workflow.orient import FRAMES, Orientation, orient
from margcal.workflow.simulate import Simulation, simulate
from margcal.workflow.verify import verify

KINDS: tuple[Kind, ...] = ("acc", "gyr", "mag")


def error_deg(q: Array, truth: Array) -> Array:
    return np.degrees(np.linalg.norm(so3.quat_log(so3.quat_multiply(q, so3.quat_conjugate(truth))), axis=-1))


def codes(found: Orientation) -> dict[str, str]:
    return {i.code: i.level for i in found.issues}


def lying(rate: float = 100.0, rest_s: float = 2.0, turn_s: float = 1.5) -> Simulation:
    return simulate(n_poses=5, rate=rate, rest_s=rest_s, turn_s=turn_s, seed=3, housing_sd_deg=0)


@pytest.fixture(scope="module")
def made() -> Simulation:
    """Five rests and the turns between them; sixteen seconds at 100 Hz."""
    return lying()


@pytest.fixture(scope="module")
def si(made: Simulation) -> Recording:
    return replace(made.truth.apply(made.recording), reference=None)


def truth_of(made: Simulation, t: Array) -> Array:
    return so3.quat_from_matrix(made.motion.at(t).R)


def changed(recording: Recording, kind: Kind, change) -> Recording:
    """The recording with `change` done to a copy of the readings of one sensor."""
    stream = recording.streams[kind]
    y = np.array(stream.y)
    new = change(y)
    return replace(recording, **{kind: replace(stream, y=y if new is None else new)})


def cut(recording: Recording, keep: Mask) -> Recording:
    return replace(recording, **{k: Stream(k, s.t[keep], s.y[keep], s.unit) for k, s in recording.streams.items()})


def columns(recording: Recording) -> dict[str, Array]:
    streams = recording.streams.values()
    return {"t_s": next(iter(streams)).t} | {
        f"{s.kind}_{a}_{s.unit}": s.y[:, k] for s in streams for k, a in enumerate("xyz")
    }


# --- what cannot be --------------------------------------------------------------------------------------


def test_units_that_cannot_be_are_refused_with_the_one_that_fits(si):
    with pytest.raises(InputError, match=r"look like dps.*--units gyr=dps"):
        orient(changed(si, "gyr", np.degrees))
    with pytest.raises(InputError, match="look like radps"):
        orient(replace(si, gyr=replace(si.gyr, unit="dps")))
    with pytest.raises(InputError, match="gravity in g, not in mps2"):
        orient(changed(si, "acc", lambda y: y / 9.80665))
    with pytest.raises(DataError, match="gravity was taken out"):
        orient(changed(si, "acc", lambda y: 0.01 * np.sin(np.arange(y.size)).reshape(y.shape)))


def test_a_calibration_of_another_range_or_scale_is_refused(made):
    truth = made.truth
    assert truth.gyr is not None and truth.acc is not None
    with pytest.raises(DataError, match="its calibration is of another node or range"):
        orient(made.recording, replace(truth, gyr=replace(truth.gyr, H=16 * truth.gyr.H)))
    with pytest.raises(InputError, match="after the calibration: it is of another node"):
        orient(made.recording, replace(truth, acc=replace(truth.acc, H=8 * truth.acc.H)))


def test_a_dead_gyroscope_is_refused_and_a_dead_axis_said(si):
    with pytest.raises(DataError, match="gyroscope is dead"):
        orient(changed(si, "gyr", np.zeros_like))

    def dead(y: Array) -> None:
        y[:, 1] = 0.0

    assert codes(orient(changed(si, "gyr", dead)))["stuck-axis"] == "warn"
    assert "stuck-axis" not in codes(orient(si))


@pytest.mark.parametrize("name", ["vector-selection", "ekf-quest", "vqf"])
def test_a_mirrored_axis_of_the_magnetometer_is_said(si, name):
    if name == "vqf":
        pytest.importorskip("vqf")
    mirrored = orient(changed(si, "mag", lambda y: y * [-1, 1, 1]), filter=name)
    assert codes(mirrored)["mag-disagrees"] == "warn"
    assert "mag-disagrees" not in codes(orient(si, filter=name))


def test_a_field_that_points_upwards_is_noted(si):
    """All three axes reversed look like the southern hemisphere, and nothing in the recording tells them apart."""
    assert codes(orient(changed(si, "mag", np.negative)))["field-upwards"] == "note"
    assert "field-upwards" not in codes(orient(si))


def test_a_magnetometer_that_reads_zero_is_left_out(made, si):
    """It is as if there were none: the start is not torn by a heading that nothing ever told."""
    truth = truth_of(made, si.gyr.t)
    for name in ("vector-selection", "ekf-quest"):
        found = orient(changed(si, "mag", np.zeros_like), filter=name, q0=truth[0])
        assert {"no-field", "heading-drifts"} <= set(codes(found))
        assert error_deg(found.attitude.q, truth).max() < 2.5
        without = orient(si, filter=name, q0=truth[0], mag=False)
        assert np.array_equal(found.attitude.q, without.attitude.q)


def test_readings_beyond_any_converter_are_not_measured(made, si, recwarn):
    def wild(y: Array) -> None:
        y[100:150] = 1e200

    for kind in KINDS:
        found = orient(changed(si, kind, wild))
        assert error_deg(found.attitude.q, truth_of(made, si.gyr.t)).max() < 4
        assert codes(found)["missing-readings"] == "warn"
    assert not recwarn.list


def test_no_mag_needs_nothing_of_the_magnetometer(made):
    """In counts without calibration it is refused, unless it is not asked for."""
    part = replace(made.truth, mag=None)
    with pytest.raises(InputError, match="--no-mag"):
        orient(made.recording, part)
    assert "heading-drifts" in codes(orient(made.recording, part, mag=False))


# --- time ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["vector-selection", "ekf-quest", "gyro"])
def test_a_slow_clock_is_no_row_of_gaps(name):
    made = lying(rate=3, rest_s=10, turn_s=10)
    found = orient(made.recording, made.truth, filter=name)
    assert found.figures["gaps"] == 0
    assert codes(found)["slow-gyroscope"] == "warn"
    assert error_deg(found.attitude.q, truth_of(made, found.attitude.t)).max() < 8


@pytest.mark.parametrize("name", ["vector-selection", "ekf-quest"])
@pytest.mark.parametrize("mag", [True, False])
def test_found_again_after_a_gap_in_which_the_node_turned_over(made, si, name, mag):
    t = si.gyr.t
    keep = (t < 5) | (t > 9)
    truth = truth_of(made, t[keep])
    turned = error_deg(truth[t[keep] < 5][-1:], truth[t[keep] > 9][:1])
    assert turned[0] > 60
    found = orient(cut(si, keep), filter=name, mag=mag)
    late = t[keep] > 10
    if mag:
        assert error_deg(found.attitude.q, truth)[late].max() < 6
    up = [so3.matrix_from_quat(q[late])[:, 2] for q in (found.attitude.q, truth)]
    assert np.degrees(np.arccos(np.clip(np.sum(up[0] * up[1], axis=1), -1, 1))).max() < 3


def test_found_again_after_rates_that_were_not_measured(made, si):
    """The same where the samples are there and the gyroscope is not."""

    def nothing(y: Array) -> None:
        y[480:900] = np.nan

    found = orient(changed(si, "gyr", nothing))
    truth = truth_of(made, si.gyr.t)
    assert error_deg(truth[480:481], truth[900:901])[0] > 60
    assert error_deg(found.attitude.q, truth)[1000:].max() < 6


def test_the_gyroscope_alone_promises_no_recovery(si):
    t = si.gyr.t
    found = orient(cut(si, (t < 5) | (t > 9)), filter="gyro")
    assert "missing from all that follows" in next(i.text for i in found.issues if i.code == "gaps")


def test_a_slower_sensor_in_the_same_arrays_is_interpolated(si):
    """NaN between its readings is its rate and not a fault: the heading must not be ten times as stiff for it."""

    def slow(y: Array) -> None:
        y[np.arange(len(y)) % 10 != 0] = np.nan

    found = orient(changed(si, "mag", slow))
    assert found.figures["used"]["mag"] > 0.95
    assert "missing-readings" not in codes(found)


# --- frames, flags ---------------------------------------------------------------------------------------


def test_frames_against_scipy():
    """NED and NWU of an ENU attitude, composed by another library from the axes' definitions."""
    from scipy.spatial.transform import Rotation

    turns = {
        "ned": Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]]),
        "nwu": Rotation.from_euler("z", -90, degrees=True),
    }
    for frame, expected in turns.items():
        q = np.roll(FRAMES[frame], -1)  # scalar last
        assert (Rotation.from_quat(q) * expected.inv()).magnitude() < 1e-12


def test_vqf_is_said_to_leave_out_what_it_leaves_out():
    """Sample by sample VQF's own correction is zero exactly where the flag says that the field was not taken."""
    vqf = pytest.importorskip("vqf")
    from margcal.methods import vqf_filter
    from margcal.methods.tracking import MAG

    rng = np.random.default_rng(8)
    n, period = 9000, 0.02
    gyr = 0.3 * np.sin(np.arange(n)[:, None] * [0.011, 0.017, 0.023]) + 0.01 * rng.standard_normal((n, 3))
    q = np.array([1.0, 0, 0, 0])
    acc, mag = np.empty((n, 3)), np.empty((n, 3))
    for k in range(n):
        q = so3.quat_multiply(q, so3.quat_exp(gyr[k] * period))
        R = so3.matrix_from_quat(q)
        acc[k], mag[k] = R.T @ [0, 0, 9.8], R.T @ [0, 20, -40]
    mag[3000:7500] += [0, 25, 30]  # longer than VQF waits
    params = vqf_filter.Params(period=period)
    track = vqf_filter.batch(params, vqf_filter.start([1, 0, 0, 0]), np.full(n, period), gyr, acc, mag)
    one, expected = vqf.VQF(period, tauAcc=params.tau_acc, tauMag=params.tau_mag), np.empty(n, dtype=bool)
    for k in range(n):
        one.update(gyr[k], acc[k], mag[k])
        expected[k] = one.state["lastMagCorrAngularRate"] != 0
    assert 1000 < np.count_nonzero(~expected) < 8000
    assert np.count_nonzero((track.flags & MAG > 0) != expected) <= 4


# --- the verbs -------------------------------------------------------------------------------------------


def test_missing_rows_are_a_warning_here(si, tmp_path, capsys):
    table = columns(si)
    for name in table:
        if name.startswith(("acc", "mag")):
            table[name] = np.where(np.arange(len(table[name])) < 200, np.nan, table[name])
    source, out = str(tmp_path / "r.parquet"), str(tmp_path / "q.csv")
    write_table(source, table)
    assert command(["orient", source, "-o", out, "--json"]) == 0
    levels = {i["code"]: i["level"] for i in json.loads(capsys.readouterr().out)["issues"]}
    assert levels["nan-rows"] == "warn" and "fail" not in levels.values()


def test_refusals_leave_no_file(si, tmp_path, capsys):
    source, out = str(tmp_path / "r.parquet"), tmp_path / "q.csv"
    write_table(source, columns(changed(si, "gyr", np.degrees)))
    assert command(["orient", source, "-o", str(out)]) == 1
    error = capsys.readouterr().err
    assert error.startswith("margcal: r.parquet: gyroscope") and error.count("\n") == 1
    assert list(tmp_path.iterdir()) == [Path(source)]


def test_verify_of_a_recording_that_stands_still_is_no_unit_mistake(made, si):
    for kind in KINDS:
        zeros = changed(si, kind, np.zeros_like)
        finding = next(f for f in verify(made.truth, zeros, made.recording).findings if f.sensor == kind)
        assert finding.outcome == "other" and "stands still" in finding.text


def test_verify_says_which_sensors_it_did_not_see(made, si):
    found = verify(made.truth, replace(si, mag=None), made.recording)
    assert [i.code for i in found.issues] == ["not-verified"]
    assert "mag is not in the calibrated recording" in found.issues[0].text
    assert not verify(made.truth, si, made.recording).issues


def test_verify_gives_no_pass_where_it_cannot_tell(made, si, tmp_path, capsys):
    other = simulate(n_poses=5, rate=100, rest_s=2.0, turn_s=1.5, seed=9, housing_sd_deg=0)
    cal, fine, raw = (str(tmp_path / n) for n in ("cal.json", "fine.parquet", "raw.parquet"))
    save(made.truth, cal)
    write_table(fine, columns(si))
    write_table(raw, columns(made.recording))
    assert command(["verify", cal, fine, "--raw", raw, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["verdict"] == "pass"
    write_table(raw, columns(other.recording), overwrite=True)
    assert command(["verify", cal, fine, "--raw", raw, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["verdict"] == "warn"


# --- the magnetometer's delay ----------------------------------------------------------------------------


@pytest.mark.parametrize("late", [0.1, -0.02])
def test_calibrate_says_the_magnetometers_delay_and_apply_takes_it_out(late, tmp_path):
    made = simulate(n_poses=14, rate=100, rest_s=1.6, turn_s=1.5, seed=4, poses="free")
    mag = made.recording.mag
    assert mag is not None
    y = np.stack([np.interp(mag.t, mag.t + late, c) for c in mag.y.T], axis=-1)
    delayed = replace(made.recording, mag=replace(mag, y=y))
    found, prompt = calibrate(delayed), calibrate(made.recording)
    assert found.mag is not None and prompt.mag is not None and found.mag.delay_s is not None
    assert found.mag.delay_s == pytest.approx(late, abs=4 * (found.mag.delay_se_s or 0))
    (issue,) = (i for i in found.issues if i.code == "mag-delay")
    assert issue.level == "note" and ("behind" if late > 0 else "ahead of") in issue.text
    assert prompt.mag.delay_s is None and "mag-delay" not in [i.code for i in prompt.issues]
    # H and B are of the rests, which a delay does not touch
    assert np.abs(found.mag.H @ np.linalg.inv(prompt.mag.H) - np.eye(3)).max() < 1e-3
    write_table(tmp_path / "late.parquet", columns(replace(delayed, reference=None)))
    apply_file(found, tmp_path / "late.parquet", tmp_path / "si.parquet")
    expected, mended = prompt.mag.apply(mag.y), read(tmp_path / "si.parquet").mag
    assert mended is not None
    assert np.isin(mended.t, mag.t).all()
    expected, raw = (v[np.isin(mag.t, mended.t)] for v in (expected, found.mag.apply(y)))
    rms = [float(np.sqrt(np.mean((v - expected) ** 2))) for v in (raw, mended.y)]
    assert rms[1] < 0.3 * rms[0]


@pytest.mark.parametrize("poses", ["cube", "swing", "mocap"])
@pytest.mark.parametrize("noise", ["nan", "-1", "inf"])
def test_no_node_is_simulated_with_noise_that_is_no_factor(poses, noise, tmp_path, capsys):
    options = ["--noise", noise, "--rate", "50"]
    assert command(["simulate", "--poses", poses, *options, "-o", str(tmp_path / "s")]) == 1
    assert "noise is" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
