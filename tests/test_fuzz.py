"""The short run of ``benchmarks/studies/fuzz.py``: 300 damaged files into each reader and into the calibration file."""

from __future__ import annotations

import json
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks" / "studies"))

import fuzz  # type: ignore[import-not-found]
import fuzz_cases  # type: ignore[import-not-found]
from fuzz_cases import TARGETS, case_of  # type: ignore[import-not-found]

from margcal.core.errors import InputError
from margcal.core.types import Calibration, SensorModel
from margcal.files.calfile import dumps, load, loads, save
from margcal.files.tables import read, read_poses
from margcal.workflow.apply import apply_file

CASES = 300


@pytest.mark.parametrize("target", list(TARGETS))
def test_damaged_files_give_a_result_or_a_refusal(target, tmp_path):
    counts: dict[str, int] = {}
    for number in range(CASES):
        result = fuzz.run_case(target, 0, number, tmp_path / "case")
        counts[result["outcome"]] = counts.get(result["outcome"], 0) + 1
        # how long a case takes on a busy machine is for the long run to say
        assert result["outcome"] in ("accepted", "refused", "slow"), f"{target}, case {number}: {result}"
    assert counts["accepted"] > 5 and counts["refused"] > 100  # damage that is only refused, or never, finds nothing


def test_cases_are_the_same_every_time():
    for target in TARGETS:
        assert [case_of(target, 3, k) for k in range(7)] == [case_of(target, 3, k) for k in range(7)]
        assert case_of(target, 3, 1) != case_of(target, 4, 1)


def test_cuts_go_through_the_whole_length():
    whole = len(fuzz_cases._parquets()[0])
    for percent in range(100):
        length = len(case_of("parquet", 0, 5 * percent)["recording.parquet"])
        assert percent * whole // 100 <= length <= (percent + 1) * whole / 100


@pytest.mark.parametrize(
    ("error", "outcome"),
    [
        (KeyError("x"), "crash: KeyError"),
        (InputError("two\nlines"), "bad message"),
        (InputError("one line"), "refused"),
        (fuzz.Broken("no"), "crash: Broken"),
        (None, "accepted"),
    ],
)
def test_what_must_not_happen_is_seen(monkeypatch, tmp_path, error, outcome):
    def reader(path, number):
        if error is not None:
            raise error

    monkeypatch.setitem(fuzz.RUN, "csv", reader)
    assert fuzz.run_case("csv", 0, 1, tmp_path / "case")["outcome"] == outcome


def test_memory_and_printed_exceptions_are_seen(monkeypatch, tmp_path):
    class Bad:
        def __del__(self):
            raise ValueError("only printed")

    monkeypatch.setitem(fuzz.RUN, "csv", lambda path, number: Bad() and None)
    assert "Broken" in fuzz.run_case("csv", 0, 1, tmp_path / "case")["outcome"]
    monkeypatch.setitem(fuzz.RUN, "csv", lambda path, number: bytearray(b"x" * 400_000_000) and None)
    result = fuzz.run_case("csv", 0, 1, tmp_path / "case")
    if Path("/proc/self/clear_refs").exists():
        assert result["outcome"] in ("large", "slow") and result["megabytes"] > 300, result


def test_a_process_that_dies_is_a_finding_and_the_run_goes_on(monkeypatch, tmp_path):
    """The library under a reader may bring the whole process down: the case is counted, the next one is run."""
    stub = tmp_path / "worker.py"
    stub.write_text(
        "import os, sys\n"
        "for k in range(int(sys.argv[4]), int(sys.argv[5])):\n"
        "    if k == 3: os.kill(os.getpid(), 9)\n"
        '    print(\'{"outcome": "refused", "where": "", "seconds": 0.0, "megabytes": 0.0}\', flush=True)\n'
    )
    monkeypatch.setattr(fuzz, "__file__", str(stub))
    found = fuzz.fuzz("csv", 0, 6, quiet=True)
    assert found["outcomes"] == {"refused": 5, "dies: exit status -9": 1}
    assert found["findings"] == {"dies: exit status -9": {"count": 1, "cases": [3]}}


# --- what the long run found --------------------------------------------------------------------------

HEAD = "t_s,acc_x_g,acc_y_g,acc_z_g\n"
ROWS = "".join(f"{k / 100},0.{k},0,1\n" for k in range(30))


@pytest.fixture
def quietly():
    """Nothing may be printed past the program: neither a warning, nor an exception that Python only shows."""
    unheard = []
    usual, sys.unraisablehook = sys.unraisablehook, unheard.append
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield
    sys.unraisablehook = usual
    assert not unheard


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (HEAD.encode() + ROWS.encode() + b"1,2,3,4,\xf6\n", "line 32: 5 fields where the header has 4"),
        (HEAD.encode() + ROWS.encode() * 50_000 + b"1,2,3,4,\xf6 \n", "line 1500002: 5 fields"),
        ((HEAD.replace("acc_x_g", '"acc\r_x_g"') + ROWS).encode(), "no acc_x_g"),
        ((HEAD.replace("acc_x_g", '"a",acc\rb') + ROWS).encode(), "no acc_x_g"),
        ((HEAD + "0.1,inf,0,1\n0.2,-inf,0,1\n").encode(), "infinite reading in sample 1"),
        ((HEAD + "0.1,1e308,1e308,1\n0.2,1e308,inf,1\n").encode(), "infinite reading in sample 2"),
        ((HEAD + ROWS + "1e300,0,0,1\n").encode(), r"time of sample 31 is 1e\+300 s"),
        (("t_s,ref_qw,ref_qx,ref_qy,ref_qz\n" + "0.1,1e300,0,0,0\n").encode(), "norm inf"),
    ],
)
def test_tables_refused_in_one_line(tmp_path, quietly, text, message):
    path = tmp_path / "walk.csv"
    path.write_bytes(text)
    with pytest.raises(InputError, match=message):
        read(path)


def test_poses_of_enormous_norm(tmp_path, quietly):
    path = tmp_path / "poses.csv"
    path.write_text("qw,qx,qy,qz\n1e300,0,0,1\n")
    with pytest.raises(InputError, match="norm inf"):
        read_poses(path)


@pytest.mark.parametrize("lines", [1, 60_000])
def test_text_that_is_not_utf8_only_late_passes_as_in_the_first_block(tmp_path, quietly, lines):
    """The encoding is told by the first megabyte; a degree sign of cp1252 beyond it is no reason to refuse."""
    path = tmp_path / "walk.csv"
    path.write_bytes(b"t_s,acc_x_g,acc_y_g,acc_z_g,note\n" + b"0,0,0,1,plain text\n" * lines + b"1,0,0,1,21 \xb0C\n")
    apply_file(Calibration(acc=SensorModel("acc", np.eye(3), np.zeros(3), "g")), path, tmp_path / "out.csv")
    assert (tmp_path / "out.csv").read_text(encoding="utf-8").endswith(",21 \u00b0C\n")


def test_readings_that_are_not_finite_are_applied_without_a_warning(tmp_path, quietly):
    path = tmp_path / "walk.csv"
    path.write_text(HEAD + "0,inf,-inf,1\n0.1,1e308,1e308,1e308\n")
    apply_file(Calibration(acc=SensorModel("acc", 9.8 * np.ones((3, 3)), np.ones(3), "g")), path, tmp_path / "out.csv")
    assert (tmp_path / "out.csv").read_text().count("\n") == 3
    with pytest.raises(InputError, match="time is missing or runs backwards in data row 1"):
        path.write_text(HEAD + "inf,1,1,1\ninf,1,1,1\n")
        late = SensorModel("acc", np.eye(3), np.ones(3), "g", delay_s=0.1)
        apply_file(Calibration(acc=late), path, tmp_path / "late.csv")


ACC = {"H": np.eye(3).tolist(), "B": [0, 0, 0], "raw_unit": "g", "unit": "m/s^2"}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"raw_unit": "\ud800"}, r"half a character \(\\ud800\)"),
        ({"method": "\udfff"}, "half a character"),
        ({"H": (1e200 * np.eye(3)).tolist()}, "H is of size"),
        ({"H": (1e-200 * np.eye(3)).tolist()}, "H is of size"),
        ({"reference_vector": [0, 0, 1e200]}, "larger than any field"),
        ({"covariance": (1e300 * np.eye(12)).tolist()}, "too large"),
        ({"covariance": (np.diag([1e-200] * 12) + np.eye(12, k=1) + np.eye(12, k=-1)).tolist()}, "not positive"),
    ],
)
def test_calibration_files_refused(quietly, changes, message):
    document = {"format": "margcal-calibration", "version": 1, "acc": {**ACC, **changes}}
    with pytest.raises(InputError, match=message):
        loads(json.dumps(document).encode())
    settings = {"format": "margcal-calibration", "version": 1, "source": {"settings": {"a": ["\ud800"]}}}
    with pytest.raises(InputError, match="half a character"):
        loads(json.dumps(settings).encode())


def test_a_name_that_is_no_text_is_kept_as_far_as_it_goes(tmp_path, quietly):
    """The name of a recording may hold bytes that are not UTF-8; the calibration file must load all the same."""
    model = SensorModel("acc", np.eye(3), np.zeros(3))
    save(Calibration(acc=model, files=(("walk\udcf6.csv", ""),), created="x"), tmp_path / "cal.json")
    assert load(tmp_path / "cal.json").files == (("walk?.csv", ""),)
    assert dumps(load(tmp_path / "cal.json")) == (tmp_path / "cal.json").read_bytes()
