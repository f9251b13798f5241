"""A calibration applied to files: the same numbers as the formula, in a stream, with everything else unchanged."""

from __future__ import annotations

import os

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq
import pytest

from margcal.core.errors import InputError
from margcal.core.types import Calibration, SensorModel
from margcal.files import batches
from margcal.files.tables import read, write_table
from margcal.workflow.apply import apply_file

RNG = np.random.default_rng(11)
H = 0.0024 * (np.eye(3) + 0.05 * RNG.normal(size=(3, 3)))
B = np.array([33123.0, 33276.0, 32360.0])


def calibration(**delays):
    return Calibration(
        acc=SensorModel("acc", H, B, delay_s=delays.get("acc")),
        mag=SensorModel("mag", 30 * H, B / 50, unit="norm", delay_s=delays.get("mag")),
    )


def columns(kind, unit, y):
    return {f"{kind}_{a}_{unit}": y[:, k] for k, a in enumerate("xyz")}


@pytest.fixture
def small_batches(monkeypatch):
    """Batches of a few rows, so that every border is crossed."""
    monkeypatch.setattr(batches, "CSV_BLOCK", 2000)
    monkeypatch.setattr(batches, "PARQUET_ROWS", 97)


def numbers_of(path):
    table = pq.read_table(path) if path.suffix == ".parquet" else pacsv.read_csv(path)
    return {n: np.array(table[n].to_pylist()) for n in table.column_names}


def test_in_memory_equals_the_formula_to_the_last_bits():
    """Blocks, the remainder, and NaN that must not spread to neighbouring rows."""
    model = calibration().acc
    for n in (0, 1, 3, 4095, 4096, 4097, 12_291):
        y = B + RNG.normal(size=(n, 3)) * 4000
        if n > 10:
            y[[5, n - 1], [1, 2]] = np.nan
        expected = ((y.astype(np.longdouble) - B) @ H.T.astype(np.longdouble)).astype(float)
        np.testing.assert_allclose(model.apply(y), expected, rtol=0, atol=1e-12 * np.abs(H).max() * np.abs(B).max())
        assert np.isnan(model.apply(y)).sum() == (6 if n > 10 else 0)
    shaped = B + RNG.normal(size=(7, 2000, 3))
    np.testing.assert_allclose(model.apply(shaped)[3, 5], H @ (shaped[3, 5] - B), rtol=1e-12)
    np.testing.assert_array_equal(model.apply(shaped[:, ::2]), model.apply(shaped)[:, ::2])


@pytest.mark.parametrize("source", ["in.csv", "in.parquet"])
@pytest.mark.parametrize("target", ["out.csv", "out.parquet", "out.tsv", "out.csv.gz"])
def test_same_numbers_same_rows(tmp_path, small_batches, source, target):
    n = 500
    acc, gyr = RNG.integers(0, 65535, size=(2, n, 3))
    text = ["walk", "sit, rest", 'say "hi"', ""] * (n // 4)
    given = {"t_s": np.arange(n) / 100, **columns("acc", "count", acc), "note": text, **columns("gyr", "count", gyr)}
    write_table(tmp_path / source, given | {"id": np.arange(n)})
    seen = []
    summary = apply_file(
        calibration(), tmp_path / source, tmp_path / target, progress=lambda done, total: seen.append((done, total))
    )
    assert summary["rows"] == n
    assert summary["seconds"] == pytest.approx(4.99)
    assert list(summary["sensors"]) == ["acc"]
    assert summary["passed_through"] == ["gyr"]
    assert summary["missing"] == ["mag"]
    assert seen[-1][0] == seen[-1][1]
    assert len(seen) > 2
    recording = read(tmp_path / target)
    assert recording.units == {"acc": "mps2", "gyr": "count"}
    np.testing.assert_allclose(recording.acc.y, (acc - B) @ H.T, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(recording.gyr.y, gyr)
    np.testing.assert_array_equal(recording.acc.t, given["t_s"])
    if target == "out.csv":
        got = numbers_of(tmp_path / target)
        assert list(got) == ["t_s", *columns("acc", "mps2", acc), "note", *columns("gyr", "count", gyr), "id"]
        assert got["note"].tolist() == text
        assert got["id"].tolist() == list(range(n))


def test_text_passes_character_by_character(tmp_path):
    """Leading zeros, long numbers, trailing zeros and empty cells of other columns stay as they were written."""
    rows = "t_s,acc_x_count,acc_y_count,acc_z_count,serial,long,label\n"
    rows += "0.00,1,2,3,007,123456789012345678901,NA\n0.10,1,2,3,,0.10,-5\n0.20,,2,3,nan,=1,\n"
    (tmp_path / "a.csv").write_text(rows)
    apply_file(calibration(), tmp_path / "a.csv", tmp_path / "b.csv")
    lines = [line.split(",") for line in (tmp_path / "b.csv").read_text().splitlines()]
    original = [line.split(",") for line in rows.splitlines()]
    assert [line[:1] + line[4:] for line in lines] == [line[:1] + line[4:] for line in original]
    assert lines[3][1:4] == ["", "", ""]  # a reading without x has no calibrated components


def test_late_change_of_a_column_is_read_again(tmp_path, small_batches):
    rows = "".join(f"{i / 100},1,2,3,{i if i < 800 else 0.5},{'' if i < 900 else 'x'}\n" for i in range(1000))
    (tmp_path / "a.csv").write_text("t_s,acc_x_count,acc_y_count,acc_z_count,n,s\n" + rows)
    apply_file(calibration(), tmp_path / "a.csv", tmp_path / "b.parquet")
    table = pq.read_table(tmp_path / "b.parquet")
    assert table["n"].to_pylist()[798:802] == [798.0, 799.0, 0.5, 0.5]
    assert table["s"].to_pylist()[-1] == "x"


def test_decimal_comma_source(tmp_path):
    (tmp_path / "a.csv").write_text("t_s;acc_x_count;acc_y_count;acc_z_count;v\n0,5;1;2;3;1,5\n0,6;1;2;3;2,5\n")
    apply_file(calibration(), tmp_path / "a.csv", tmp_path / "b.csv")
    got = numbers_of(tmp_path / "b.csv")
    assert got["t_s"].tolist() == [0.5, 0.6]
    assert got["v"].tolist() == [1.5, 2.5]


def test_folder_gives_folder(tmp_path):
    source, target = tmp_path / "in", tmp_path / "out"
    source.mkdir()
    acc = RNG.integers(0, 65535, size=(50, 3))
    write_table(source / "a.parquet", {"t_s": np.arange(50) / 100, **columns("acc", "count", acc)})
    write_table(source / "m.csv", {"t_s": np.arange(20) / 40, **columns("mag", "count", acc[:20])})
    (source / "ref.csv").write_text("t_s,ref_qw,ref_qx,ref_qy,ref_qz\n0,1.0,0,0,0\n0.1,1.0,0,0,0\n")
    summary = apply_file(calibration(), source, target)
    assert sorted(os.listdir(target)) == ["a.parquet", "m.csv", "ref.csv"]
    assert (target / "ref.csv").read_bytes() == (source / "ref.csv").read_bytes()
    assert summary["rows"] == 70
    recording = read(target)
    assert recording.units == {"acc": "mps2", "mag": "norm"}
    np.testing.assert_allclose(recording.acc.y, (acc - B) @ H.T, rtol=0, atol=1e-9)
    with pytest.raises(InputError, match="not empty"):
        apply_file(calibration(), source, target)
    with pytest.raises(InputError, match="recording itself"):
        apply_file(calibration(), source, source, overwrite=True)


@pytest.mark.parametrize("delay", [0.013, -0.027, 0.2, 1e-9])
@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_delay_is_corrected_across_batches(tmp_path, small_batches, delay, suffix):
    """Readings linear in time are interpolated exactly: u(t) is what the delayed sensor says at t + delay."""
    n = 700
    t = np.cumsum(RNG.uniform(0.005, 0.015, n))
    truth = np.column_stack([t * 3, 5 - t, 0.5 * t])  # at the sensor, at time t
    late = np.column_stack([(t - delay) * 3, 5 - (t - delay), 0.5 * (t - delay)])  # stamped late by `delay`
    raw = late @ np.linalg.inv(H).T + B
    write_table(tmp_path / f"a{suffix}", {"t_s": t, **columns("acc", "count", raw), **columns("mag", "count", raw)})
    apply_file(calibration(acc=delay), tmp_path / f"a{suffix}", tmp_path / "b.parquet")
    got = numbers_of(tmp_path / "b.parquet")
    u = np.column_stack([got[f"acc_{a}_mps2"] for a in "xyz"])
    inside = (t + delay >= t[0]) & (t + delay <= t[-1])
    np.testing.assert_allclose(u[inside], truth[inside], atol=1e-9)
    assert np.isnan(u[~inside]).all()
    assert not inside.all()
    mag = np.column_stack([got[f"mag_{a}_norm"] for a in "xyz"])
    np.testing.assert_allclose(mag, (raw - B / 50) @ (30 * H).T, atol=1e-6)
    np.testing.assert_array_equal(got["t_s"], t)


def test_delay_leaves_gaps_and_slower_sensors_as_they_are(tmp_path, small_batches):
    n = 1200
    t = np.arange(n) / 200
    raw = np.column_stack([t, -t, 2 * t]) @ np.linalg.inv(30 * H).T + B / 50
    sampled = np.arange(n) % 4 == 0  # the magnetometer: a reading in every fourth row
    sampled[400:480] = False  # and a hole of twenty readings
    raw[~sampled] = np.nan
    acc = np.ones((n, 3))
    write_table(tmp_path / "a.csv", {"t_s": t, **columns("mag", "count", raw), **columns("acc", "count", acc)})
    apply_file(calibration(mag=0.006), tmp_path / "a.csv", tmp_path / "b.parquet")
    got = numbers_of(tmp_path / "b.parquet")
    u = np.column_stack([got[f"mag_{a}_norm"] for a in "xyz"]).astype(float)
    assert np.isnan(u[~sampled]).all()
    known = np.flatnonzero(sampled & ~np.isnan(u[:, 0]))
    np.testing.assert_allclose(u[known, 0], t[known] + 0.006, atol=1e-9)
    lost = set(np.flatnonzero(sampled)) - set(known)
    assert lost == {396, 1196}  # the last reading before the hole, and the last of all


def test_refusals(tmp_path):
    def table(name, **given):
        write_table(tmp_path / name, given, overwrite=True)
        return tmp_path / name

    t = np.arange(10) / 100
    out, y = tmp_path / "out.csv", np.ones((10, 3))
    cases = [
        (table("a.csv", t_s=t, **columns("acc", "g", y)), "acc is in g, the calibration takes count: give"),
        (table("a1.csv", t_s=t, **columns("acc", "mps2", y)), "calibrated already"),
        (table("b.csv", t_s=t, **columns("gyr", "count", y)), "nothing to calibrate"),
        (table("c.csv", t_s=t, **columns("acc", "", y)), "."),
        (tmp_path / "absent.csv", "no such file"),
        (table("e.csv", t_s=t, **columns("acc", "count", y), acc_x_mps2=t), "there already|acc_x_mps2"),
    ]
    for source, message in cases:
        with pytest.raises(InputError, match=message):
            apply_file(calibration(), source, out)
        assert not out.exists()
    good = table("d.csv", t_s=t, **columns("acc", "count", y))
    with pytest.raises(InputError, match="suffix"):
        apply_file(calibration(), good, tmp_path / "out.xlsx")
    with pytest.raises(InputError, match="recording itself"):
        apply_file(calibration(), good, good, overwrite=True)
    backwards = table("f.csv", t_s=t[::-1], **columns("acc", "count", y))
    with pytest.raises(InputError, match="runs backwards in data row 2"):
        apply_file(calibration(acc=0.01), backwards, out)
    (tmp_path / "g.csv").write_text((tmp_path / "d.csv").read_text() + "1,2,x,4\n")
    with pytest.raises(InputError, match="line 12: column acc_y_count: 'x'"):
        apply_file(calibration(), tmp_path / "g.csv", out)
    assert not [f for f in os.listdir(tmp_path) if "out" in f]
    summary = apply_file(calibration(), cases[0][0], out, force=True)
    assert summary["forced"] == ["acc: g taken as count"]


def test_declared_units_and_force_between_fixed_units(tmp_path):
    (tmp_path / "a.csv").write_text("t_s,acc_x,acc_y,acc_z\n0,1,2,3\n0.1,1,2,3\n")
    apply_file(calibration(), tmp_path / "a.csv", tmp_path / "b.parquet", units={"acc": "count"})
    assert numbers_of(tmp_path / "b.parquet")["acc_x_mps2"][0] == pytest.approx((H @ (np.array([1, 2, 3]) - B))[0])
    in_mps2 = Calibration(acc=SensorModel("acc", np.eye(3), np.zeros(3), raw_unit="mps2"))
    summary = apply_file(in_mps2, tmp_path / "a.csv", tmp_path / "c.parquet", units={"acc": "g"}, force=True)
    assert numbers_of(tmp_path / "c.parquet")["acc_y_mps2"][0] == pytest.approx(2 * 9.80665)
    assert summary["forced"]


def test_categories_and_nan_become_plain_cells(tmp_path):
    table = pa.table(
        {
            "t_s": [0.0, 0.1],
            **{f"acc_{a}_count": [1, 2] for a in "xyz"},
            "kind": pa.array(["a", "b"]).dictionary_encode(),
            "v": pa.array([1.5, float("nan")], type=pa.float32()),
        }
    )
    pq.write_table(table, tmp_path / "a.parquet")
    apply_file(calibration(), tmp_path / "a.parquet", tmp_path / "b.csv")
    lines = (tmp_path / "b.csv").read_text().splitlines()
    assert [line.split(",")[4:] for line in lines] == [["kind", "v"], ["a", "1.5"], ["b", ""]]
    nested = pa.table({"t_s": [0.0], **{f"acc_{a}_count": [1] for a in "xyz"}, "list": [[1, 2]]})
    pq.write_table(nested, tmp_path / "n.parquet")
    with pytest.raises(InputError, match="cannot be written as text"):
        apply_file(calibration(), tmp_path / "n.parquet", tmp_path / "n.csv")
    apply_file(calibration(), tmp_path / "n.parquet", tmp_path / "m.parquet")
    assert pq.read_table(tmp_path / "m.parquet")["list"].to_pylist() == [[1, 2]]


def test_real_recording(data_file, tmp_path):
    source = data_file("imu_tk/xsens_mti_multipose.parquet")
    cal = Calibration(acc=SensorModel("acc", np.eye(3) / 414.0, B))
    apply_file(cal, source, tmp_path / "out.parquet")
    raw, got = read(source), read(tmp_path / "out.parquet")
    np.testing.assert_allclose(got.acc.y, (raw.acc.y - B) / 414.0, atol=1e-10)
    np.testing.assert_array_equal(got.gyr.y, raw.gyr.y)
    assert abs(np.median(np.linalg.norm(got.acc.y, axis=1)) - 9.81) < 0.1
