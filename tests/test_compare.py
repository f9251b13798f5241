"""`margcal compare` and the repeatability behind it: Z-TIE Fig. 7, ZY-TBME Figs. 3 and 4."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from margcal.apps import cli
from margcal.apps.comparing import compare
from margcal.core.errors import InputError
from margcal.core.types import Calibration, Recording, SensorModel, Stream
from margcal.files.calfile import save
from margcal.files.tables import read
from margcal.workflow.calibrate import calibrate
from margcal.workflow.metrics import repeatability, spread_of
from margcal.workflow.segment import find_poses
from margcal.workflow.simulate import simulate

H = np.array([[0.0045, 0.0001, 0.0], [-0.0001, 0.0046, 0.0002], [0.0, 0.0001, 0.0044]])
B = np.array([120.0, -80.0, 30.0])


def model(dH: object = 0.0, dB: object = 0.0, **more: object) -> SensorModel:
    return SensorModel("acc", H + np.asarray(dH), B + np.asarray(dB), **more)  # type: ignore[arg-type]


# --- figures ------------------------------------------------------------------------------------------


def test_mean_sd_and_spread_are_those_of_the_values():
    rng = np.random.default_rng(0)
    made = [model(1e-5 * rng.normal(size=(3, 3)), rng.normal(size=3)) for _ in range(5)]
    r = repeatability(made)
    values = np.array([m.B for m in made])
    s = spread_of(r.B)
    np.testing.assert_allclose(s.mean, values.mean(axis=0))
    np.testing.assert_allclose(s.sd, np.sqrt(np.sum((values - values.mean(axis=0)) ** 2, axis=0) / 4))
    np.testing.assert_allclose(s.span, values.max(axis=0) - values.min(axis=0))
    assert r.raw.shape == (20, 3) and r.converted.shape == (5, 20, 3)


def test_readings_converted_by_calibrations_that_differ_in_the_bias_alone():
    shift = np.array([2.0, 0.0, -1.0])
    r = repeatability([model(), model(dB=shift)])
    # u = H (y - B): every reading moves by -H dB, whatever it is
    np.testing.assert_allclose(r.converted[1] - r.converted[0], np.broadcast_to(-H @ shift, (20, 3)), atol=1e-12)
    np.testing.assert_allclose(r.scatter, np.broadcast_to(np.abs(H @ shift) / np.sqrt(2), (20, 3)), atol=1e-12)
    middle = spread_of(r.converted).mean
    np.testing.assert_allclose(np.linalg.norm(middle, axis=1), 9.80665, rtol=1e-9)


def test_angle_between_two_calibrations_turned_against_each_other():
    angle = np.radians(1.0)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    r = repeatability([model(), replace(model(), H=turn @ H)])
    # about z by 1 degree: rms over the sphere sqrt(2/3) of it, and of two values the sd is the difference over sqrt 2
    assert r.angle_rms_deg == pytest.approx(np.sqrt(2 / 3) / np.sqrt(2), rel=0.01)


def test_scatter_over_stated_error_is_one_for_honest_calibrations():
    rng = np.random.default_rng(1)
    sd = np.concatenate([np.full(9, 1e-6), np.full(3, 0.2)])
    drawn = [
        model((e[:9] * sd[:9]).reshape(3, 3), e[9:] * sd[9:], covariance=np.diag(sd**2))
        for e in rng.normal(size=(100, 12))
    ]
    assert repeatability(drawn).over_claimed == pytest.approx(1.0, abs=0.06)
    proud = [replace(m, covariance=np.diag((sd / 5) ** 2)) for m in drawn]
    assert repeatability(proud).over_claimed == pytest.approx(5.0, abs=0.3)
    assert repeatability([model(), model(dB=1)]).over_claimed is None


def test_elements_that_the_frame_fixes_are_left_out_of_the_stated_error():
    variance = np.full(12, 1e-12)
    variance[3] = 0.0  # H yx is zero by the choice of the frame
    both = [model(1e-6 * np.eye(3) * k, covariance=np.diag(variance)) for k in (-1, 1)]
    over = repeatability(both).over_claimed
    assert over is not None and np.isfinite(over)


# --- what is refused ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"raw_unit": "g"}, "raw unit is count in a.json and g in b.json"),
        ({"unit": "g"}, "unit is m/s.2 in a.json and g in b.json"),
        ({"H": -H}, "mirrored"),
    ],
)
def test_other_units_and_signs_are_refused(change: dict[str, object], words: str):
    with pytest.raises(InputError, match=words):
        repeatability([model(), replace(model(), **change)], ["a.json", "b.json"])  # type: ignore[arg-type]


def test_other_frames_are_refused_with_what_to_do():
    two = [Calibration(acc=model(), frame="housing"), Calibration(acc=model(), frame="acc-triangular")]
    with pytest.raises(InputError, match=r"a is in frame housing and b in frame acc-triangular.*--poses"):
        compare(two, ["a", "b"])


def test_a_sensor_in_some_files_only_and_none_in_common():
    gyr = SensorModel("gyr", 1e-3 * np.eye(3), np.zeros(3))
    calibrations = [Calibration(acc=model()), Calibration(acc=model(dB=1), gyr=gyr), Calibration(gyr=gyr)]
    found = compare(calibrations, ["a", "b", "c"])
    assert found["acc"][1] == ["a", "b"] and found["gyr"][1] == ["b", "c"]
    with pytest.raises(InputError, match="nothing to compare"):
        compare([Calibration(acc=model()), Calibration(gyr=gyr)], ["a", "b"])


# --- the command, on recordings of one node -----------------------------------------------------------


@pytest.fixture(scope="module")
def node(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Five recordings of one simulated node, calibrated."""
    folder, files = tmp_path_factory.mktemp("node"), []
    for seed in range(5):
        made = simulate(seed=seed, node_seed=42, n_poses=16, rest_s=1.5, turn_s=1.0, rate=50)
        files.append(str(folder / f"trial-{seed + 1}.json"))
        save(calibrate(made.recording, poses="cube"), files[-1])
    return files


def test_five_recordings_of_one_node_agree_as_they_state(node: list[str], capsys):
    assert cli.run(["compare", *node, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert set(found["sensors"]) == {"acc", "gyr", "mag"}
    for sensor in found["sensors"].values():
        assert sensor["direction_sd_deg"] < 2 * sensor["expected_error_deg"] < 0.5
        assert 0.4 < sensor["sd_over_stated_se"] < 1.6
        assert np.shape(sensor["readings"]["converted"]) == (5, 20, 3)
        size = np.linalg.norm(sensor["readings"]["mean"], axis=1).mean()
        assert np.max(sensor["readings"]["sd"]) < 0.003 * size


def test_tables_and_pictures(node: list[str], tmp_path: Path, capsys):
    folder = tmp_path / "out"
    assert cli.run(["compare", *node, "-o", str(folder)]) == 0
    out = capsys.readouterr().out
    assert "accelerometer, B in count" in out and "stated se" in out and "20 readings of 9.807" in out
    names = {p.name for p in folder.iterdir()}
    pictures = {f"{k}-{w}.svg" for k in ("acc", "gyr", "mag") for w in ("parameters", "readings")}
    assert names == {"compare.json", "parameters.csv", "readings.csv"} | pictures
    for name in pictures:
        root = ElementTree.fromstring((folder / name).read_text())
        dots = len(list(root.iter("{http://www.w3.org/2000/svg}circle")))
        assert dots >= 5 * 12 if name.endswith("parameters.svg") else dots >= 5 * 20 * 3
    rows = (folder / "parameters.csv").read_text().splitlines()
    assert len(rows) == 1 + 3 * 12 * 5
    assert cli.run(["compare", *node, "-o", str(folder)]) == 1
    assert "--overwrite" in capsys.readouterr().err


def test_a_node_that_changed_is_seen(node: list[str], tmp_path: Path, capsys):
    from margcal.files.calfile import load

    good = load(node[0])
    assert good.acc is not None
    bent = str(tmp_path / "bent.json")
    save(replace(good, acc=replace(good.acc, B=good.acc.B + 20)), bent)
    assert cli.run(["compare", *node[1:3], bent]) == 0
    assert "MORE than they state" in capsys.readouterr().out


@pytest.mark.parametrize("files", [1, 2])
def test_one_file_and_the_same_file_twice_are_refused(node: list[str], files: int, capsys):
    assert cli.run(["compare", *[node[0]] * files]) == 2
    assert ("two calibration files" if files == 1 else "given twice") in capsys.readouterr().err


# --- real recordings ----------------------------------------------------------------------------------


def between(recording: Recording, start: float, stop: float) -> Recording:
    def cut(s: Stream) -> Stream:
        keep = (s.t >= start) & (s.t < stop)
        return replace(s, t=s.t[keep], y=s.y[keep])

    return replace(recording, **{k: cut(s) for k, s in recording.streams.items()})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "worst_deg"), [("imu_tk/xsens_mti_multipose.parquet", 0.1), ("mikoff/mpu9150_imu0.parquet", 0.7)]
)
def test_halves_of_a_real_recording_agree(name: str, worst_deg: float, data_file: Callable[[str], Path]):
    recording = read(data_file(name))
    poses = find_poses(recording).poses
    middle = float((poses.start + poses.stop)[len(poses) // 2] / 2)
    parts = [between(recording, -np.inf, middle), between(recording, middle, np.inf)]
    found = compare([calibrate(p, sensors=("acc",)) for p in parts], ["first", "second"])["acc"][0]
    assert found.angle_rms_deg < worst_deg
    assert found.over_claimed is not None and found.over_claimed < 2
