"""The short run of ``benchmarks/studies/fuzz.py``: 300 damaged files into each reader and into the calibration file."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks" / "studies"))

import fuzz
import fuzz_cases
from fuzz_cases import TARGETS, case_of

from margcal.core.errors import InputError

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
