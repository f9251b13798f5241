"""The calibration file: round trips to the last bit, the same bytes, and refusals that say where."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from margcal.core.errors import InputError, MargcalError
from margcal.core.types import Alignment, Calibration, Issue, SensorModel
from margcal.files import calfile
from margcal.files.atomic import atomic_folder, atomic_path
from margcal.files.calfile import digests, dumps, load, loads, save, schema


def a_calibration(seed=1, **changes):
    rng = np.random.default_rng(seed)

    def model(kind, unit):
        A = rng.normal(size=(12, 12)) * np.geomspace(1e-6, 1e3, 12)[:, None]
        H = 0.0024 * (np.eye(3) + 0.05 * rng.normal(size=(3, 3)))
        return SensorModel(
            kind,
            H,
            rng.normal(size=3) * 32768,
            unit=unit,
            covariance=A @ A.T,
            residual_rms=0.0123,
            n_poses=24,
            method="one-step",
            reference_vector=[0.0, 0.1, 9.80665],
            expected_error_deg=0.21,
            delay_s=0.0042,
            delay_se_s=1e-4,
            temperature_degC=21.5,
        )

    fields = {
        "acc": model("acc", "m/s^2"),
        "gyr": model("gyr", "rad/s"),
        "mag": model("mag", "uT"),
        "device": "node 7 \u00e9 \U0001f600",
        "frame": "housing",
        "verdict": "warn",
        "issues": (Issue("few-poses", "warn", "too few", "mag", 5.0, 6.0), Issue("note", "note", "a note")),
        "alignment": Alignment(False, {"offset_s": 0.1, "marker_to_node": (1.0, 0.0, 0.0, 0.0)}),
        "files": (("walk.csv", "0" * 64),),
        "settings": {"poses": "cube", "gravity": 9.80665, "list": [1, 2.5, None]},
        "created": "2026-11-22T00:00:00Z",
        "program": "margcal 0.1.0",
    }
    return Calibration(**(fields | changes))


def test_keys_and_their_order_are_those_of_the_conventions():
    document = json.loads(dumps(a_calibration()))
    assert list(document) == [
        *("format", "version", "device", "frame", "verdict", "issues", "acc", "gyr", "mag", "alignment", "source")
    ]
    assert list(document["acc"]) == [
        *("H", "B", "raw_unit", "unit", "covariance", "residual_rms", "n_poses", "method", "reference_vector"),
        *("expected_error_deg", "delay_s", "delay_se_s", "temperature_degC"),
    ]
    assert list(document["issues"][0]) == ["code", "level", "sensor", "text", "value", "limit"]
    assert list(document["source"]) == ["created", "program", "files", "settings"]
    assert document["source"]["files"] == [{"name": "walk.csv", "sha256": "0" * 64}]
    assert document["alignment"]["common_clock"] is False


def test_round_trip_is_exact():
    given_ = a_calibration()
    data = dumps(given_)
    got = loads(data)
    assert dumps(got) == data
    for kind, model in given_.models.items():
        for name in ("H", "B", "covariance", "reference_vector"):
            np.testing.assert_array_equal(getattr(got.models[kind], name), getattr(model, name))
        assert got.models[kind].delay_s == model.delay_s
    assert got.issues == given_.issues
    assert got.alignment.values["marker_to_node"] == (1.0, 0.0, 0.0, 0.0)
    assert got.settings == given_.settings


@settings(max_examples=100, deadline=None, derandomize=True)
@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=3, max_size=3))
def test_every_float64_comes_back(values):
    model = SensorModel("gyr", np.eye(3), values)
    np.testing.assert_array_equal(loads(dumps(Calibration(gyr=model))).gyr.B, values)


def test_absent_sensors_are_absent():
    document = json.loads(dumps(Calibration(gyr=SensorModel("gyr", np.eye(3), np.zeros(3)))))
    assert "acc" not in document
    assert document["verdict"] is None
    assert loads(json.dumps(document).encode()).acc is None


def test_hand_written_minimum_and_byte_order_mark():
    text = (
        '{"format": "margcal-calibration", "version": 1,'
        '"mag": {"H": [[1,0,0],[0,1,0],[0,0,1]], "B": [1,2,3], "raw_unit": "count", "unit": "norm"}}'
    )
    for data in (text.encode(), b"\xef\xbb\xbf" + text.encode()):
        assert loads(data).mag.B.tolist() == [1, 2, 3]


def test_created_honours_source_date_epoch(monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "0")
    source = json.loads(dumps(a_calibration(created=None, program=None)))["source"]
    assert source["created"] == "1970-01-01T00:00:00Z"
    assert re.fullmatch(r"margcal \d+\.\d+\.\d+.*", source["program"])
    assert dumps(a_calibration(created=None)) == dumps(a_calibration(created=None))


def edited(**changes):
    document = json.loads(dumps(a_calibration()))
    for path, value in changes.items():
        *parents, last = path.split("__")
        place = document
        for key in parents:
            place = place[key]
        if value is KeyError:
            del place[last]
        else:
            place[last] = value
    return json.dumps(document).encode()


GOOD = dumps(a_calibration())
NEGATIVE = np.eye(12)
NEGATIVE[0, 1] = NEGATIVE[1, 0] = 2
REFUSED = {
    "nothing": (b"", "not JSON at line 1"),
    "cut": (GOOD[: len(GOOD) // 2], "not JSON at line"),
    "missing comma": (GOOD.replace(b'"version": 1,', b'"version": 1'), "line 4, column 3"),
    "not text": (b"\xff\xfe{}", "not UTF-8"),
    "a list": (b"[]", 'no "format"'),
    "format": (edited(format="imucal"), "its format is 'imucal'"),
    "no version": (edited(version=KeyError), "version 'None'"),
    "newer": (edited(version=2), "needs a newer margcal"),
    "older": (edited(version=0), "version '0' is not known"),
    "version true": (edited(version=True), "not known"),
    "unknown key": (edited(acc__bias=[1, 2, 3]), r"unknown field `bias` - at `\$\.acc`; remove the key 'bias'"),
    "duplicate": (GOOD.replace(b'"raw_unit": "count"', b'"raw_unit": "count", "raw_unit": "g"', 1), "'raw_unit' is"),
    "missing": (edited(gyr__B=KeyError), r"missing required field `B` - at `\$\.gyr`; add"),
    "text number": (edited(acc__B=["1", 2, 3]), r"Expected `float`, got `str` - at `\$\.acc\.B\[0\]`"),
    "null": (edited(acc__H=[[1, 0, 0], [0, None, 0], [0, 0, 1]]), r"\$\.acc\.H\[1\]\[1\]"),
    "boolean": (edited(acc__B=[True, 2, 3]), r"got `bool`"),
    "shape": (edited(acc__H=[[1, 0, 0], [0, 1, 0]]), r"length 3, got 2 - at `\$\.acc\.H`"),
    "covariance shape": (edited(acc__covariance=[[1.0]]), r"\$\.acc\.covariance"),
    "nan": (edited(acc__B=[float("nan"), 2, 3]), "NaN is not a number that JSON knows"),
    "infinity": (edited(acc__B=[float("-inf"), 2, 3]), "-Infinity is not"),
    "too large": (edited(acc__B=[11111, 2, 3]).replace(b"11111", b"1e999"), "1e999 is too large"),
    "digits": (edited(acc__B=[11111, 2, 3]).replace(b"11111", b"1" * 5000), "5000 digits"),
    "nested": (b"[" * 100_000, "nested too deeply"),
    "nested object": (b'{"a":' * 100_000, "nested too deeply"),
    "unit": (edited(mag__unit="gauss"), r"\$\.mag\.unit"),
    "level": (edited(issues=[{"code": "a", "level": "bad"}]), r"\$\.issues\[0\]\.level"),
    "verdict": (edited(verdict="good"), r"\$\.verdict"),
    "negative": (edited(acc__residual_rms=-1.0), r"\$\.acc\.residual_rms"),
    "singular": (edited(acc__H=[[1, 2, 3], [2, 4, 6], [0, 0, 1]]), r"H is singular.*\$\.acc\.H"),
    "zero": (edited(acc__H=[[0.0] * 3] * 3), "H is singular"),
    "ill-conditioned": (edited(acc__H=[[25, 0, 0], [0, 1, 0], [0, 0, 1]]), "condition number 25"),
    "not symmetric": (edited(acc__covariance=(np.eye(12) + np.eye(12, k=1)).tolist()), "not symmetric"),
    "not psd": (edited(acc__covariance=NEGATIVE.tolist()), "not positive semidefinite"),
    "negative variance": (edited(acc__covariance=(-np.eye(12)).tolist()), "negative variance in row 1"),
    "sha": (edited(source__files=[{"name": "a", "sha256": "xyz"}]), r"\$\.source\.files\[0\]\.sha256"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused_with_the_reason_and_the_place(case):
    data, message = REFUSED[case]
    with pytest.raises(InputError, match=message) as caught:
        loads(data, "cal.json")
    assert str(caught.value).startswith("cal.json: ")
    assert len(str(caught.value)) < 500


def test_what_load_refuses_is_not_written():
    with pytest.raises(InputError, match="singular"):
        dumps(Calibration(acc=SensorModel("acc", np.zeros((3, 3)), np.zeros(3))))
    with pytest.raises(InputError, match="not finite"):
        dumps(Calibration(acc=SensorModel("acc", np.eye(3), [np.nan, 0, 0])))
    with pytest.raises(InputError, match="finite"):
        dumps(a_calibration(settings={"gravity": float("inf")}))


def test_mutated_files_never_escape_the_errors():
    rng = np.random.default_rng(5)
    for _ in range(300):
        data = bytearray(GOOD)
        for _ in range(rng.integers(1, 4)):
            at = int(rng.integers(len(data)))
            if rng.integers(2):
                data[at] ^= 1 << rng.integers(8)
            else:
                del data[at : at + int(rng.integers(1, 30))]
        with suppress(MargcalError):
            dumps(loads(bytes(data)))


def test_shipped_schema_is_the_generated_one_and_accepts_what_is_written():
    import jsonschema

    shipped = (Path(calfile.__file__).parent / "calibration.schema.json").read_bytes()
    assert shipped == schema(), "write margcal.files.calfile.schema() to calibration.schema.json"
    validator = jsonschema.Draft202012Validator(json.loads(shipped))
    validator.check_schema(json.loads(shipped))
    validator.validate(json.loads(GOOD))
    for case in ("unknown key", "text number", "shape", "verdict", "newer", "format", "missing", "covariance shape"):
        with pytest.raises(jsonschema.ValidationError):
            validator.validate(json.loads(REFUSED[case][0]))


def test_save_load_and_overwrite(tmp_path):
    path = tmp_path / "cal.json"
    save(a_calibration(), path)
    assert path.read_bytes() == GOOD
    with pytest.raises(InputError, match="exists; give --overwrite"):
        save(a_calibration(2), path)
    assert path.read_bytes() == GOOD
    save(a_calibration(2), path, overwrite=True)
    assert load(path).acc.B.tolist() == a_calibration(2).acc.B.tolist()
    assert os.listdir(tmp_path) == ["cal.json"]
    with pytest.raises(InputError, match="no such file"):
        load(tmp_path / "absent.json")
    with pytest.raises(InputError, match="cannot be read"):
        load(tmp_path)


def test_digests(tmp_path):
    (tmp_path / "a").write_bytes(b"abc")
    assert digests([tmp_path / "a"])[0] == (
        "a",
        "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad",
    )


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_an_interrupted_write_leaves_the_old_file(tmp_path, error):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(error), atomic_path(path, overwrite=True) as temporary:
        temporary.write_text("half")
        raise error
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_targets_that_cannot_be(tmp_path):
    (tmp_path / "file").write_text("x")
    for path, message in (
        (tmp_path, "folder"),
        (tmp_path / "absent" / "a.json", "does not exist"),
        (tmp_path / "file", "--overwrite"),
        (Path("/dev/null"), "regular file|not writable"),
    ):
        with pytest.raises(InputError, match=message), atomic_path(path) as temporary:
            temporary.write_text("never")
    with pytest.raises(InputError, match="disk is full"), atomic_path(tmp_path / "b"):
        raise OSError(28, "No space left on device")
    with pytest.raises(InputError, match="is a file"), atomic_folder(tmp_path / "file", overwrite=True):
        pass
    assert os.listdir(tmp_path) == ["file"]


def test_a_link_stays_and_its_file_is_replaced(tmp_path):
    (tmp_path / "real").write_text("old")
    (tmp_path / "link").symlink_to(tmp_path / "real")
    with atomic_path(tmp_path / "link", overwrite=True) as temporary:
        temporary.write_text("new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real").read_text() == "new"


def test_folders_appear_whole_and_keep_what_is_not_ours(tmp_path):
    target = tmp_path / "out"
    with pytest.raises(RuntimeError), atomic_folder(target) as folder:
        (folder / "a").write_text("half")
        raise RuntimeError
    assert os.listdir(tmp_path) == []
    with atomic_folder(target) as folder:
        (folder / "a").write_text("1")
    (target / "mine").write_text("keep")
    with pytest.raises(InputError, match="not empty"), atomic_folder(target):
        pass
    with atomic_folder(target, overwrite=True) as folder:
        (folder / "a").write_text("2")
    assert (target / "a").read_text() == "2"
    assert (target / "mine").read_text() == "keep"
    assert os.listdir(tmp_path) == ["out"]


def test_killed_while_saving_leaves_old_or_new(tmp_path):
    """SIGKILL at several moments: the file is the old one or the new one, never half."""
    path = tmp_path / "cal.json"
    path.write_bytes(GOOD)
    new = dumps(a_calibration(2))
    code = (
        "import sys, pathlib; from margcal.files.calfile import load, save; from dataclasses import replace;"
        "c = load(sys.argv[2]); print('ready', flush=True)\n"
        "while True: save(c, sys.argv[1], overwrite=True)"
    )
    other = tmp_path / "new.json"
    other.write_bytes(new)
    for delay in (0.0, 0.01, 0.03):
        process = subprocess.Popen([sys.executable, "-c", code, str(path), str(other)], stdout=subprocess.PIPE)
        assert process.stdout is not None
        process.stdout.readline()
        with suppress(subprocess.TimeoutExpired):
            process.wait(timeout=delay)
        process.send_signal(signal.SIGKILL)
        process.wait()
        process.stdout.close()
        assert path.read_bytes() in (GOOD, new)
