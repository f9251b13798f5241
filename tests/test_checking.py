"""Time and units of recordings: what is mended, what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from margcal.core.checking import checked_recording, checked_reference, checked_stream, printable
from margcal.core.errors import InputError
from margcal.core.types import Recording, Reference, Stream


def stream(t, y=None, unit="g", kind="acc"):
    t = np.asarray(t, dtype=float)
    if y is None:
        y = np.column_stack([np.arange(len(t)) + k for k in range(3)])
    return Stream(kind, t, y, unit)


def codes(issues):
    return [i.code for i in issues]


def test_good_stream_comes_back_as_it_is():
    given = stream(np.arange(100) / 100)
    got, issues = checked_stream(given)
    assert got is given
    assert issues == ()


def test_nan_readings_are_kept():
    y = np.ones((10, 3))
    y[4] = np.nan
    got, issues = checked_stream(stream(np.arange(10) / 100, y))
    assert np.isnan(got.y[4]).all()
    assert not issues


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (stream(np.arange(5) / 100, unit="uT"), "unknown unit 'uT'"),
        (stream([]), "no samples"),
        (stream([0.0, np.nan, 0.02]), "sample 2"),
        (stream([0.0, np.inf, 0.02]), "sample 2"),
        (stream([0.0, 0.01, 0.005]), "backwards at sample 3"),
        (stream([0.0, 0.01], [[1, 2, 3], [1, np.inf, 3]]), "infinite reading in sample 2"),
        (stream(np.arange(50) * 10.0), "milliseconds"),
        (stream(np.arange(50) * 10_000.0), "microseconds"),
        (stream(np.repeat(np.arange(5.0), 100)), "coarser than the sampling"),
    ],
)
def test_refused(given, message):
    with pytest.raises(InputError, match=message):
        checked_stream(given)


def test_slow_clock_is_taken_when_declared():
    got, _ = checked_stream(stream(np.arange(50) * 10.0), trust_clock=True)
    assert got.rate == pytest.approx(0.1)
    assert Recording.from_arrays(acc=np.ones((9, 3)), units={"acc": "g"}, rate=0.1).acc.t[1] == 10


def test_duplicate_times_keep_the_first():
    got, issues = checked_stream(stream([0.0, 0.01, 0.01, 0.02]))
    assert got.t.tolist() == [0.0, 0.01, 0.02]
    assert got.y[:, 0].tolist() == [0, 1, 3]
    assert codes(issues) == ["duplicate-time"]
    assert issues[0].sensor == "acc"
    assert issues[0].value == 1


def test_sort_is_explicit_and_stable():
    got, issues = checked_stream(stream([0.02, 0.0, 0.01, 0.01]), sort=True)
    assert got.t.tolist() == [0.0, 0.01, 0.02]
    assert got.y[:, 0].tolist() == [1, 2, 0]
    assert codes(issues) == ["time-sorted", "duplicate-time"]


def test_float32_time_is_noticed_only_where_it_harms():
    t = 2000 + np.arange(1000) * 0.01
    _, issues = checked_stream(stream(t.astype(np.float32)))  # grain 0.12 ms of 10 ms
    assert codes(issues) == ["time-quantised"]
    assert not checked_stream(stream((t - 2000).astype(np.float32)))[1]
    assert not checked_stream(stream(2**20 + np.arange(1000) / 64))[1]  # exact in float32: no harm
    with pytest.raises(InputError, match="float32"):
        checked_stream(stream((1.7e9 + np.arange(1000) * 0.01).astype(np.float32)))


def turning(n=400):
    """Quaternions of a steady turn about z, with their times."""
    t = np.arange(n) / 100
    return t, np.column_stack([np.cos(t), 0 * t, 0 * t, np.sin(t)])


def test_reference_gaps_signs_and_norms():
    t, q = turning()
    given = q * np.where(np.arange(len(q)) % 3 == 0, -1, 1)[:, None] * 1.0005
    given[10] = 0
    given[20, 2] = np.nan
    got, issues = checked_reference(Reference(t, given))
    assert np.isnan(got.q[[10, 20]]).all()
    seen = ~np.isnan(got.q[:, 0])
    assert seen.sum() == len(t) - 2
    assert (np.sum(np.diff(got.q[seen], axis=0) ** 2, axis=1) < 0.01).all()
    np.testing.assert_allclose(got.q[seen], -q[seen], atol=1e-12)  # the first sample gives the sign
    assert issues == ()


def test_reference_norms():
    t, q = turning()
    _, issues = checked_reference(Reference(t, q * 1.02))
    assert codes(issues) == ["reference-norm"]
    with pytest.raises(InputError, match=r"norm 1\.1"):
        checked_reference(Reference(t, q * 1.1))


def test_flat_reference_is_lost_only_while_the_node_moves():
    t, q = turning()
    flat = q.copy()
    flat[100:200] = flat[100]
    moving = np.column_stack([np.sin(9 * t), np.cos(7 * t), np.ones_like(t)])
    got, issues = checked_reference(Reference(t, flat), stream(t, moving, "dps", "gyr"))
    assert np.isnan(got.q[101:200]).all()
    assert not np.isnan(got.q[:101]).any()
    assert codes(issues) == ["reference-flat"]
    resting = moving.copy()
    resting[100:200] = 0.01
    got, issues = checked_reference(Reference(t, flat), stream(t, resting, "dps", "gyr"))
    assert not np.isnan(got.q).any()
    assert issues == ()


def test_recording_names_its_source_and_gathers_issues():
    recording = Recording(acc=stream([0.0, 0.01, 0.01]), gyr=stream([0, 0.1], unit="dps", kind="gyr"), source="w.csv")
    got = checked_recording(recording)
    assert codes(got.issues) == ["duplicate-time"]
    assert got.issues[0].text.startswith("w.csv: acc")
    with pytest.raises(InputError, match="holds no accelerometer"):
        checked_recording(Recording(source="w.csv"))


def test_printable_takes_out_terminal_codes():
    assert printable("\x1b[31mred\x07\n") == "?[31mred??"
    assert len(printable("x" * 10_000)) < 300
