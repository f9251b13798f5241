"""The command line: what is printed, what is written, and the exit status, verb by verb."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from margcal.apps import screen
from margcal.apps.cli import run
from margcal.files.calfile import load
from margcal.files.poses_table import read_poses
from margcal.files.tables import read, write_table
from margcal.methods.uncertainty import direction_errors_deg
from margcal.workflow import routes
from margcal.workflow.simulate import simulate, write_simulation

MARGCAL = [sys.executable, "-m", "margcal.apps.cli"]


@pytest.fixture(scope="module")
def node(tmp_path_factory) -> Path:
    """A folder with session.parquet, poses.csv and truth.json."""
    folder = tmp_path_factory.mktemp("node")
    write_simulation(simulate(seed=5, n_poses=16, rest_s=2.0, knocks=1), folder)
    return folder


@pytest.fixture(scope="module")
def calibrated(node) -> Path:
    path = node / "made.json"
    assert run(["calibrate", str(node / "session.parquet"), "-o", str(path), "--device", "node7"]) == 0
    return path


def one_line(capsys) -> str:
    """What is on stderr, which must be one line of ours; nothing may be on stdout."""
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("margcal: ") and err.count("\n") == 1 and "Traceback" not in err
    return err


# --- the whole ----------------------------------------------------------------------------------------


def test_help_names_the_verbs_and_version_the_version(capsys):
    assert run(["--help"]) == 0
    text = capsys.readouterr().out
    for verb in ("demo", "segment", "calibrate", "apply", "report", "simulate"):
        assert f"\n  {verb} " in text
    assert run(["--version"]) == 0
    assert capsys.readouterr().out.startswith("margcal 0.")


def test_help_names_every_solver(capsys):
    assert run(["calibrate", "--help"]) == 0
    text = capsys.readouterr().out
    for name in (*routes.POSE_SOLVERS, *routes.MAGNITUDE_SOLVERS, *routes.GYRO_SOLVERS):
        assert name in text


@pytest.mark.parametrize(
    "arguments",
    [
        ["orient"],
        ["levitate"],
        ["calibrate"],
        ["calibrate", "x.csv", "--nonsense"],
        ["calibrate", "x.csv", "--gravity", "heavy"],
        ["calibrate", "x.csv", "--units", "acc"],
        ["calibrate", "x.csv", "--sensors", "nose"],
        ["calibrate", "x.csv", "--skip-bad", "-1"],
        ["apply", "cal.json", "x.csv"],
        ["simulate", "-o", "x", "--poses", "swing", "--knocks", "2"],
    ],
)
def test_wrong_usage_is_one_line_and_exit_status_2(arguments, capsys):
    assert run(arguments) == 2
    one_line(capsys)


def test_without_a_verb_the_help_is_shown_and_the_exit_status_is_2(capsys):
    assert run([]) == 2
    assert "Commands:" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--gravity", "98"], "gravity is 98"),
        (["--gravity", "nan"], "gravity is nan"),
        (["--field", "50000"], "between 1 and 1000"),
        (["--field", "50", "--at", "52,6,2026"], "give one of them"),
        (["--at", "north"], "LAT,LON"),
        (["--at", "91,0"], "latitude"),
        (["--level-sd", "-1"], "level_sd"),
        (["--method", "magic"], "magic"),
        (["--poses", "cubes"], "cubes"),
    ],
)
def test_options_that_cannot_be_are_usage_errors(node, options, said, capsys):
    assert run(["calibrate", str(node / "session.parquet"), *options]) == 2
    assert said in one_line(capsys)


def test_input_that_cannot_be_read_is_one_line_and_exit_status_1(node, tmp_path, capsys):
    empty, text, cut = tmp_path / "empty.csv", tmp_path / "text.csv", tmp_path / "cut.parquet"
    empty.write_bytes(b"")
    text.write_text("a,b\n1,2\n")
    cut.write_bytes((node / "session.parquet").read_bytes()[:5000])
    for path in (empty, text, cut, tmp_path / "missing.csv", tmp_path / "\x1b[31mred.csv"):
        assert run(["calibrate", str(path)]) == 1
        line = one_line(capsys)
        assert "\x1b" not in line
    assert run(["calibrate", str(node / "session.parquet"), "--poses", str(tmp_path / "none.csv")]) == 1
    assert "there is no such file" in one_line(capsys)
    assert run(["calibrate", str(node / "session.parquet"), "--nominal", str(text)]) == 1
    assert "not JSON" in one_line(capsys)


def test_an_internal_error_is_one_line_too(monkeypatch, capsys):
    def broken(*_args, **_options):
        raise ZeroDivisionError("x")

    monkeypatch.setattr("margcal.apps.segmenting.run", broken)
    assert run(["segment", "x.csv"]) == 1
    assert "internal error, ZeroDivisionError" in one_line(capsys)


# --- calibrate ----------------------------------------------------------------------------------------


def test_calibrate_prints_what_was_taken_and_what_came_out(node, capsys):
    assert run(["calibrate", str(node / "session.parquet"), "--field", "49.1"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    for words in (
        "attitudes: cube, inferred: 16 rests",
        "axes of the housing",
        "gravity 9.80665 m/s^2, field 49.1 uT",
        "count per m/s^2",
        "non-orthogonality",
        "mounting",
        "hard iron",
        "u = H (y - B)",
        "a knock was cut out",
        "nothing was written",
    ):
        assert words in out
    assert max(map(len, out.splitlines()[3:-5])) <= 100  # the tables fit a terminal


def test_the_written_calibration_is_true(node, calibrated):
    found, truth = load(calibrated), load(node / "truth.json")
    assert found.device == "node7" and found.frame == "housing"
    for kind, model in found.models.items():
        length = None if kind == "gyr" else 9.80665 if kind == "acc" else 49.1
        true = truth.models[kind]
        assert direction_errors_deg(model.H, model.B, true.H, true.B, length).max() < 0.4


def test_json_is_the_file_and_what_was_written(node, tmp_path, capsys):
    path = tmp_path / "cal.json"
    assert run(["calibrate", str(node / "session.parquet"), "--json", "-o", str(path), "--sensors", "acc,mag"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    said, file = json.loads(out), json.loads(path.read_text())
    assert said["written"] == {"calibration": str(path)}
    assert said["attitudes"]["mode"] == "cube" and said["attitudes"]["n_rests"] == 16
    assert {k: said[k] for k in file} == file
    assert "gyr" not in file and "acc" in file


def test_existing_results_need_overwrite(node, tmp_path, capsys):
    path = tmp_path / "cal.json"
    path.write_text("precious")
    arguments = ["calibrate", str(node / "session.parquet"), "-o", str(path)]
    assert run(arguments) == 1
    assert "--overwrite" in one_line(capsys)
    assert path.read_text() == "precious"
    assert run([*arguments, "--overwrite"]) == 0
    assert load(path).acc is not None


def test_results_never_replace_what_is_read(node, tmp_path, capsys):
    session = str(node / "session.parquet")
    assert run(["calibrate", session, "-o", session, "--overwrite"]) == 2
    one_line(capsys)
    both = str(tmp_path / "x")
    assert run(["calibrate", session, "-o", both, "--report", both]) == 2
    one_line(capsys)
    assert run(["calibrate", session, "-o", str(tmp_path / "none" / "x.json")]) == 1
    assert "make it first" in one_line(capsys)


def test_labelled_poses_give_the_same_as_inferred_ones(node, calibrated, tmp_path):
    path = tmp_path / "told.json"
    session, poses = str(node / "session.parquet"), str(node / "poses.csv")
    assert run(["calibrate", session, "--poses", poses, "--level", "-o", str(path)]) == 0
    told, inferred = load(path), load(calibrated)
    for kind, model in told.models.items():
        length = None if kind == "gyr" else 9.80665 if kind == "acc" else 1.0
        other = inferred.models[kind]
        assert direction_errors_deg(model.H, model.B, other.H, other.B, length).max() < 0.3


@pytest.fixture(scope="module")
def lying(tmp_path_factory) -> Path:
    """A node that was never turned over: it carries nothing."""
    path = tmp_path_factory.mktemp("lying") / "lying.csv"
    rng = np.random.default_rng(3)
    t = np.arange(2000) / 100
    columns = {"t_s": t}
    for kind, mean, sd in (("acc", (10.0, 20.0, 2048.0), 3.0), ("gyr", (5.0, -3.0, 2.0), 2.0)):
        columns |= {f"{kind}_{a}_count": np.round(m + rng.normal(0, sd, 2000)) for a, m in zip("xyz", mean)}
    write_table(path, columns)
    return path


def test_data_that_carry_nothing_exit_with_3_and_say_what_to_record(lying, tmp_path, capsys):
    path, page = tmp_path / "cal.json", tmp_path / "page.html"
    assert run(["calibrate", str(lying), "-o", str(path), "--report", str(page)]) == 3
    out, err = capsys.readouterr()
    assert "fail: " in out and "record" in out
    assert err.startswith("margcal: lying.csv cannot calibrate") and err.count("\n") == 1
    assert not path.exists() and page.exists()


def test_allow_fail_writes_and_json_says_why(lying, tmp_path, capsys):
    path = tmp_path / "cal.json"
    assert run(["calibrate", str(lying), "-o", str(path), "--allow-fail", "--json"]) == 3
    said = json.loads(capsys.readouterr().out)
    assert said["exit_status"] == 3 and said["written"] == {"calibration": str(path)}
    assert any(i["level"] == "fail" for i in said["issues"])
    assert load(path).models == {}


def test_a_sensor_that_is_not_there_is_an_input_error(lying, capsys):
    assert run(["calibrate", str(lying), "--sensors", "mag"]) == 1
    assert "magnetometer" in one_line(capsys)


def test_units_that_names_do_not_carry_are_declared(node, tmp_path, capsys):
    recording = read(node / "session.parquet")
    path = tmp_path / "bare.csv"
    columns = {"t_s": recording.acc.t}
    for kind, stream in recording.streams.items():
        columns |= {f"{kind}_{a}": stream.y[:, k] for k, a in enumerate("xyz")}
    write_table(path, columns)
    assert run(["calibrate", str(path)]) == 1
    assert "--units" in one_line(capsys)
    assert run(["calibrate", str(path), "--units", "acc=count,gyr=count,mag=count", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["acc"]["raw_unit"] == "count"
    assert run(["calibrate", str(path), "--units", "acc=stones"]) == 1
    assert "stones" in one_line(capsys)


# --- the other verbs ----------------------------------------------------------------------------------


def test_segment_makes_a_table_that_becomes_a_poses_file(node, tmp_path, capsys):
    path, session = tmp_path / "rests.csv", str(node / "session.parquet")
    assert run(["segment", session, "-o", str(path)]) == 0
    assert "16 rests, 15 turns" in capsys.readouterr().out
    assert run(["calibrate", session, "--poses", str(path)]) == 1
    assert "up is empty" in one_line(capsys)
    lines = path.read_text().splitlines()
    names = lines[0].split(",")
    assert {"start_s", "stop_s", "knocks", "acc_x_count", "acc_x_count_sd", "acc_n"} <= set(names)
    up, q = names.index("up"), read_poses(node / "poses.csv").q
    filled = [lines[0]]
    for row, (w, x, y, z) in zip(lines[1:], q):
        # the housing axis that points up: third row of R_nh
        r = np.array([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])
        k = int(np.argmax(np.abs(r)))
        cells = row.split(",")
        cells[up] = ("+" if r[k] > 0 else "-") + "xyz"[k]
        filled.append(",".join(cells))
    path.write_text("\n".join(filled) + "\n")
    assert run(["calibrate", session, "--poses", str(path), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["frame"] == "housing" and said["acc"]["n_poses"] == 16


def test_segment_as_json_and_of_several_recordings(node, tmp_path, capsys):
    session = str(node / "session.parquet")
    other = tmp_path / "other"
    write_simulation(simulate(seed=6, node_seed=5, n_poses=4, rest_s=2.0, sensors=("acc", "gyr")), other)
    path = tmp_path / "rests.parquet"
    assert run(["segment", session, str(other / "session.parquet"), "--json", "-o", str(path)]) == 0
    said = json.loads(capsys.readouterr().out)
    assert len(said["rests"]) == 20 and said["rests"][19]["file"] == "session.parquet"
    assert said["rests"][19]["mag_x_count"] is None  # not measured there
    assert said["written"] == str(path) and path.exists()


def test_segment_of_a_swing_finds_nothing_and_says_so(tmp_path, capsys):
    folder = tmp_path / "swing"
    assert run(["simulate", "-o", str(folder), "--poses", "swing", "--duration-s", "20"]) == 0
    assert not (folder / "poses.csv").exists()
    capsys.readouterr()
    assert run(["segment", str(folder / "session.parquet"), "-o", str(tmp_path / "x.csv")]) == 3
    assert "no rests" in capsys.readouterr().err
    assert not (tmp_path / "x.csv").exists()


def test_apply_gives_si_columns_beside_the_others(node, calibrated, tmp_path, capsys):
    path = tmp_path / "si.parquet"
    arguments = ["apply", str(calibrated), str(node / "session.parquet"), "-o", str(path)]
    assert run(arguments) == 0
    assert "count to m/s^2" in capsys.readouterr().out
    raw, si = read(node / "session.parquet"), read(path)
    assert si.units == {"acc": "mps2", "gyr": "radps", "mag": "norm"}
    np.testing.assert_allclose(si.acc.y, load(calibrated).acc.apply(raw.acc.y), rtol=1e-12)
    assert run(arguments) == 1
    assert "--overwrite" in one_line(capsys)
    assert run(["apply", str(calibrated), str(path), "-o", str(tmp_path / "twice.csv")]) == 1
    assert "calibrated already" in one_line(capsys)
    assert run([*arguments, "--overwrite", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rows"] == len(raw.acc.t)


def test_report_of_a_file_and_of_recordings(node, calibrated, tmp_path, capsys):
    path = tmp_path / "page.html"
    assert run(["report", str(calibrated), "-o", str(path)]) == 0
    assert "<html" in path.read_text(encoding="utf-8")
    capsys.readouterr()
    arguments = ["report", str(calibrated), str(node / "session.parquet"), "-o", str(path), "--overwrite"]
    assert run([*arguments, "--json"]) == 0
    left = json.loads(capsys.readouterr().out)["residuals"]
    assert left["acc"]["n_poses"] == 16
    assert left["acc"]["rms"] < 0.01 and left["gyr"]["rms"] < np.radians(0.5) and left["mag"]["rms"] < 0.01
    assert run(["report", str(tmp_path / "none.json"), "-o", str(tmp_path / "y.html")]) == 1
    assert "there is no such file" in one_line(capsys)


def test_report_shows_where_a_calibration_does_not_fit(node, calibrated, tmp_path, capsys):
    """The residual on another node's recording is that node's own error, computed by hand."""
    write_simulation(simulate(seed=9, n_poses=6, rest_s=2.0), tmp_path / "other")
    other = tmp_path / "other" / "session.parquet"
    assert run(["report", str(calibrated), str(other), "-o", str(tmp_path / "y.html"), "--json"]) == 0
    left = json.loads(capsys.readouterr().out)["residuals"]["acc"]["rms"]
    recording, model = read(other), load(calibrated).acc
    from margcal.workflow.segment import find_poses

    lengths = np.linalg.norm(model.apply(find_poses(recording).poses.mean["acc"]), axis=1)
    assert left == pytest.approx(np.sqrt(np.mean((lengths - 9.80665) ** 2)), rel=1e-9)
    assert left > 0.1


def test_simulate_writes_a_recording_with_its_truth(tmp_path, capsys):
    folder = tmp_path / "made"
    arguments = ["simulate", "-o", str(folder), "--n-poses", "5", "--seed", "4", "--rest-s", "1.5", "--json"]
    assert run(arguments) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["rests"] == 5 and Path(said["written"]["truth"]) == folder / "truth.json"
    expected = simulate(seed=4, n_poses=5, rest_s=1.5)
    np.testing.assert_array_equal(read(folder / "session.parquet").acc.y, expected.recording.acc.y)
    np.testing.assert_array_equal(load(folder / "truth.json").mag.H, expected.truth.mag.H)
    assert len(read_poses(folder / "poses.csv")) == 5
    assert run(arguments) == 1
    one_line(capsys)


def test_demo_again_in_the_same_folder_but_never_among_other_files(tmp_path, capsys):
    folder = tmp_path / "demo"
    assert run(["demo", "-o", str(folder)]) == 0
    out = capsys.readouterr().out
    assert "bias, true" in out and "bias, found" in out and "Try next" in out
    assert {p.name for p in folder.iterdir()} == {
        "session.parquet", "poses.csv", "truth.json", "calibration.json", "report.html",
    }  # fmt: skip
    assert run(["demo", "-o", str(folder), "--json", "--seed", "2"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert all(c["direction_error_deg"]["worst"] < 0.4 for c in said["compared"].values())
    assert said["attitudes"]["mode"] == "cube"
    (folder / "thesis.txt").write_text("mine")
    assert run(["demo", "-o", str(folder)]) == 1
    assert "thesis.txt" in one_line(capsys)
    assert (folder / "thesis.txt").read_text() == "mine"


# --- interruption and terminals -----------------------------------------------------------------------


def test_ctrl_c_exits_with_130_and_leaves_no_half_file(calibrated, tmp_path):
    n, rng = 1_500_000, np.random.default_rng(0)
    columns = {"t_s": np.arange(n) / 100.0}
    columns |= {f"acc_{a}_count": rng.integers(-2000, 2000, n).astype(float) for a in "xyz"}
    write_table(tmp_path / "long.parquet", columns)
    command = [*MARGCAL, "apply", str(calibrated), str(tmp_path / "long.parquet"), "-o", str(tmp_path / "out.csv")]
    # a test run in the background of a shell inherits SIGINT as ignored: give the command what a terminal would
    heeding = lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)  # noqa: E731
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=heeding)
    deadline = time.monotonic() + 60
    while not any(p.name.startswith(".") for p in tmp_path.iterdir()):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.005)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert out == "" and err == "margcal: interrupted; nothing was left half written\n"
    assert [p.name for p in tmp_path.iterdir()] == ["long.parquet"]


def on_a_terminal(command: list[str]) -> tuple[int, str]:
    """Exit status and output of a command that sees a terminal 100 columns wide."""
    pty = pytest.importorskip("pty")
    ours, theirs = pty.openpty()
    env = os.environ | {"TERM": "xterm", "COLUMNS": "100"}
    process = subprocess.Popen(command, stdin=theirs, stdout=theirs, stderr=theirs, env=env)
    os.close(theirs)
    seen = b""
    while True:
        try:
            part = os.read(ours, 65536)
        except OSError:  # Linux: the other end is closed
            break
        if not part:
            break
        seen += part
    os.close(ours)
    return process.wait(), seen.decode()


def test_on_a_terminal_tables_are_drawn_and_markup_in_names_is_harmless(node, tmp_path):
    odd = tmp_path / "[red]odd.parquet"
    odd.write_bytes((node / "session.parquet").read_bytes())
    status, text = on_a_terminal([*MARGCAL, "calibrate", str(odd)])
    assert status == 0
    assert "─" in text and "accelerometer" in text
    assert "[red]odd.parquet" in text.replace("\r\n", "")


def test_a_bar_appears_only_for_what_takes_long(monkeypatch):
    started = []
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(screen._Bar, "_start", lambda bar: started.append(bar.label))
    monkeypatch.setattr(screen, "SHOWN_AFTER_S", 30.0)
    with screen.progress("short") as tick:
        tick(1, 2)
    assert started == []
    monkeypatch.setattr(screen, "SHOWN_AFTER_S", 0.0)
    with screen.progress("long") as tick:
        while not started:
            time.sleep(0.001)
        tick(1, 2)
    assert started == ["long"]


def test_clean_leaves_nothing_that_a_terminal_would_obey():
    assert screen.clean("a\x1b[31mb\nc\x07\x9bd\u202ee") == "a?[31mb c??d?e"
