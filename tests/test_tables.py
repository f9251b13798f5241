"""Tables in and out: dialects, the meaning of columns, missing values, and everything that is refused."""

from __future__ import annotations

import gzip
import os
import sys

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq
import pytest

from margcal.core.errors import InputError, MargcalError
from margcal.files.tables import read, read_poses, write_table

HEAD = "t_s,acc_x_g,acc_y_g,acc_z_g\n"
ROWS = "".join(f"{i / 100},{i * 0.001:.3f},{-i * 0.5},1.25\n" for i in range(20))
TRUTH = np.column_stack([np.arange(20) / 1000, np.arange(20) * -0.5, np.full(20, 1.25)])


@pytest.fixture
def put(tmp_path):
    def write(data, name="walk.csv"):
        path = tmp_path / name
        path.write_bytes(data.encode() if isinstance(data, str) else data)
        return path

    return write


def codes(recording):
    return [i.code for i in recording.issues]


@pytest.mark.parametrize(
    "data",
    [
        HEAD + ROWS,
        (HEAD + ROWS).replace("\n", "\r\n"),
        (HEAD + ROWS).replace("\n", "\r"),
        (HEAD + ROWS).rstrip("\n"),
        b"\xef\xbb\xbf" + (HEAD + ROWS).encode(),
        (HEAD + ROWS).encode("utf-16"),
        (HEAD + ROWS).encode("utf-16-be"),
        (HEAD + ROWS).replace(",", ";"),
        (HEAD + ROWS).replace(",", "\t"),
        (HEAD + ROWS).replace(",", ";").replace(".", ","),
        "".join(",".join(f'"{c}"' for c in line.split(",")) + "\n" for line in (HEAD + ROWS).splitlines()),
        "# logger 3\n// second, comment\n\n" + HEAD + ROWS.replace("\n", "\n# inside, a, comment, 4\n", 3) + "\n\n",
        "# " + HEAD + ROWS,
        HEAD.upper() + ROWS,
        HEAD.replace(",", " , ") + ROWS.replace(",", " , "),
    ],
)
def test_dialects_give_the_same_numbers(put, data):
    recording = read(put(data))
    np.testing.assert_array_equal(recording.acc.y, TRUTH)
    np.testing.assert_array_equal(recording.acc.t, np.arange(20) / 100)
    assert recording.units == {"acc": "g"}
    assert recording.source == "walk.csv"


def test_decimal_comma_is_said(put):
    assert codes(read(put((HEAD + ROWS).replace(",", ";").replace(".", ",")))) == ["decimal-comma"]


def test_gzip(put):
    data = gzip.compress((HEAD + ROWS).encode())
    np.testing.assert_array_equal(read(put(data, "a.csv.gz")).acc.y, TRUTH)
    with pytest.raises(InputError, match="cut"):
        read(put(data[:-20], "b.csv.gz"))
    with pytest.raises(InputError, match="200 times"):
        read(put(gzip.compress(HEAD.encode() + b"0,1,1,1\n" * 2_000_000), "c.csv.gz"))


BAD = {
    "empty": ("", "empty"),
    "blank": ("\n\n", "no rows"),
    "header only": (HEAD, "a header and no rows"),
    "no header": (ROWS, "not column names"),
    "ragged": (HEAD + "# c\n\n" + ROWS + "1,2,3\n", r"line 24: 3 fields where the header has 4"),
    "text": (HEAD + ROWS + "\n// c\n1,2,abc,3\n", r"line 24: column acc_y_g: 'abc' is not a number"),
    "units row": ("t_s,acc_x_g,acc_y_g,acc_z_g\ns,g,g,g\n" + ROWS, r"line 2: column \w+: '[sg]'"),
    "open quote": (HEAD + ROWS + '1,"2,3,4\n2,3,4,5\n', r"line 22: a quote"),
    "nul": (HEAD + ROWS + "1,2\0,3,4\n", r"line 22: a NUL"),
    "binary": (bytes(range(256)) * 20, "binary"),
    "zip": (b"PK\x03\x04" + bytes(100), "zip"),
    "two commas": (HEAD + "0,01,1,5,2,5,1,0\n" * 3, "comma is used both"),
    "thousands or not": (HEAD.replace(",", ";") + "1,234;1,500;1,000;2,000\n" * 3, "may mean 1.234 or 1234"),
    "both marks": (HEAD.replace(",", ";") + "0.5;1,500;1,000;2,000\n" * 3, "where others hold a point"),
    "duplicate": ("t_s,acc_x_g,acc_x_g,acc_z_g\n" + ROWS, r"'acc_x_g' is there twice \(columns 2, 3\)"),
    "missing axis": ("t_s,acc_x_g,acc_y_g,foo\n" + ROWS, "no acc_z_g"),
    "mixed units": ("t_s,acc_x_g,acc_y_mps2,acc_z_g\n" + ROWS, "say which"),
    "no time": (HEAD.replace("t_s", "time") + ROWS, r"no column t_s among time, acc_x_g"),
    "no unit": ("t_s,acc_x,acc_y,acc_z\n" + ROWS, "--units acc="),
    "impossible unit": ("t_s,acc_x_uT,acc_y_uT,acc_z_uT\n" + ROWS, "acc cannot be in 'uT'"),
    "no sensor": ("t_s,speed,heading,height\n" + ROWS, "no sensor among .*speed"),
    "half a reference": ("t_s,ref_qw,ref_qx,ref_qy\n" + ROWS, "no ref_qz"),
    "milliseconds": (HEAD + "".join(f"{10 * i},1,2,3\n" for i in range(9)), "milliseconds"),
    "backwards": (HEAD + ROWS + "0.05,1,2,3\n", "backwards at sample 21"),
    "infinite": (HEAD + ROWS + "0.3,1,1e999,3\n", "infinite reading in sample 21"),
    "no time in a row": (HEAD + ROWS + ",1,2,3\n", "data row 21"),
    "long line": ("a" * 9_000_000, "longer than"),
    "terminal codes": ("t_s,\x1b[31mfoo\n1,2\n", r"\?\[31mfoo"),
}


@pytest.mark.parametrize("case", BAD)
def test_refused_with_place_and_mend(put, case):
    data, message = BAD[case]
    with pytest.raises(InputError, match=message) as caught:
        read(put(data))
    assert str(caught.value).startswith("walk.csv: ")
    assert "\x1b" not in str(caught.value)
    assert "Arrow" not in str(caught.value)


def test_refused_paths(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read(tmp_path / "absent.csv")
    with pytest.raises(InputError, match="no table"):
        read(tmp_path)
    with pytest.raises(InputError, match="more than is read into memory"):
        path = tmp_path / "a.csv"
        path.write_text(HEAD + ROWS)
        read(path, max_bytes=100)


@pytest.mark.skipif(os.geteuid() == 0, reason="root reads everything")
def test_unreadable_folder(tmp_path):
    tmp_path.chmod(0)
    with pytest.raises(InputError, match="cannot be read"):
        read(tmp_path)


def test_skip_bad_rows_up_to_the_number_given(put):
    data = HEAD + "7,1,abc,2\n" + ROWS + "8,1,2\n9,1,2,x\n"
    recording = read(put(data), skip_bad=3)
    np.testing.assert_array_equal(recording.acc.y, TRUTH)
    assert [(i.code, i.value) for i in recording.issues] == [("rows-skipped", 3.0)]
    with pytest.raises(InputError, match="line"):
        read(put(data), skip_bad=2)


def test_units_declared(put):
    bare = put("t_s,acc_x,acc_y,acc_z\n" + ROWS)
    assert read(bare, units={"acc": "count", "gyr": "dps"}).units == {"acc": "count"}
    named = put(HEAD + ROWS)
    assert codes(read(named, units={"acc": "g"})) == []
    assert codes(read(named, units={"acc": "mps2"})) == ["unit-relabelled"]
    two = put("t_s,acc_x_g,acc_y_g,acc_z_g,acc_x_count,acc_y_count,acc_z_count\n" + "0,1,2,3,4,5,6\n0.1,1,2,3,4,5,6\n")
    assert read(two, units={"acc": "count"}).acc.y[0].tolist() == [4, 5, 6]
    for units in ({"acc": "uT"}, {"baro": "Pa"}):
        with pytest.raises(InputError, match="units: "):
            read(named, units=units)


def test_rate_stands_for_time(put):
    recording = read(put(HEAD.replace("t_s", "n") + ROWS), rate=50)
    assert recording.acc.t[:3].tolist() == [0, 0.02, 0.04]
    assert recording.acc.rate == pytest.approx(50)


def test_all_kinds_of_columns(put):
    head = (
        "t_s,acc_x_mg,acc_y_mg,acc_z_mg,temp_degC,ref_qw,ref_qx,ref_qy,ref_qz,ref_p_x_mm,ref_p_y_mm,ref_p_z_mm,"
        "note,gyr_osbias_x_radps\n"
    )
    recording = read(put(head + "".join(f"{i / 100},1,2,3,21.5,1,0,0,0,1000,0,0,walk,7\n" for i in range(5))))
    assert recording.other == ("note", "gyr_osbias_x_radps")
    assert recording.gyr is None
    assert recording.temperature[1].tolist() == [21.5] * 5
    assert recording.reference.p[0].tolist() == [1, 0, 0]
    assert recording.reference.q[0].tolist() == [1, 0, 0, 0]


def table_of(tmp_path, name="a.parquet", **columns):
    path = tmp_path / name
    pq.write_table(pa.table(columns), path)
    return path


def sensor(kind, unit, y):
    return {f"{kind}_{a}_{unit}": y[:, k] for k, a in enumerate("xyz")}


def test_slower_sensor_in_a_shared_table_is_no_fault(tmp_path):
    n = 4000
    t = np.arange(n) / 200
    acc, mag = np.random.default_rng(1).normal(size=(2, n, 3))
    mag[np.arange(n) % 4 != 0] = np.nan
    recording = read(table_of(tmp_path, t_s=t, **sensor("acc", "g", acc), **sensor("mag", "uT", mag)))
    assert codes(recording) == []
    assert len(recording.mag.t) == n // 4
    assert recording.mag.rate == pytest.approx(50)


def test_tables_joined_in_time_are_no_fault(tmp_path):
    """Two clocks outer-joined: accelerometer rows 200 a second, magnetometer rows 47 a second in between."""
    t_acc, t_mag = np.arange(2000) / 200, 0.0007 + np.arange(470) / 47
    t = np.concatenate([t_acc, t_mag])
    acc, mag = np.full((2, len(t), 3), np.nan)
    acc[:2000], mag[2000:] = 1.0, 2.0
    order = np.argsort(t)
    columns = {**sensor("acc", "g", acc[order]), **sensor("mag", "uT", mag[order])}
    recording = read(table_of(tmp_path, t_s=t[order], **columns))
    assert codes(recording) == []
    assert (len(recording.acc.t), len(recording.mag.t)) == (2000, 470)


@pytest.mark.parametrize(("lost", "level"), [(30, "warn"), (80, "fail")])
def test_missing_samples_are_counted(tmp_path, lost, level):
    n = 1000
    acc = np.ones((n, 3))
    acc[200 : 200 + lost - 10] = np.nan
    acc[500:600:10, 1] = np.nan
    recording = read(table_of(tmp_path, t_s=np.arange(n) / 100, **sensor("acc", "g", acc)))
    (issue,) = recording.issues
    assert (issue.code, issue.level, issue.sensor) == ("nan-rows", level, "acc")
    assert issue.value == pytest.approx(lost / n, rel=0.15)
    assert len(recording.acc.t) == n - lost
    assert not np.isnan(recording.acc.y).any()


def test_empty_sensor_is_absent_and_said(tmp_path):
    n = 50
    columns = {**sensor("acc", "g", np.ones((n, 3))), **sensor("mag", "uT", np.full((n, 3), np.nan))}
    recording = read(table_of(tmp_path, t_s=np.arange(n) / 100, **columns))
    assert recording.mag is None
    assert codes(recording) == ["sensor-empty"]


def test_parquet_types_and_faults(tmp_path):
    y = np.arange(30).reshape(10, 3)
    for kind in (np.int8, np.uint16, np.int64, np.float32, np.float64):
        path = table_of(tmp_path, t_s=np.arange(10) / 100, **sensor("gyr", "count", y.astype(kind)))
        np.testing.assert_array_equal(read(path).gyr.y, y)
    nulls = pa.array([None if i == 4 else float(i) for i in range(10)])
    path = table_of(tmp_path, t_s=np.arange(10) / 100, gyr_x_dps=nulls, gyr_y_dps=nulls, gyr_z_dps=nulls)
    assert read(path).gyr.y[:, 0].tolist() == [0, 1, 2, 3, 5, 6, 7, 8, 9]
    text = table_of(tmp_path, "t.parquet", t_s=np.arange(3) / 100, **{f"gyr_{a}_dps": ["1", "2", "3"] for a in "xyz"})
    with pytest.raises(InputError, match=r"t\.parquet: column 'gyr_x_dps' holds string"):
        read(text)
    whole = path.read_bytes()
    for k, cut in enumerate((0, 3, len(whole) // 2, len(whole) - 3)):
        part = tmp_path / f"cut{k}.parquet"
        part.write_bytes(whole[:cut])
        with pytest.raises(InputError, match=r"cut\d\.parquet: "):
            read(part)


def test_folder_of_tables(tmp_path):
    table_of(tmp_path, "one.parquet", t_s=np.arange(10) / 100, **sensor("acc", "g", np.ones((10, 3))))
    (tmp_path / "two.csv").write_text("t_s;mag_x_uT;mag_y_uT;mag_z_uT\n0,05;1;2;3\n0,25;1;2;3\n0,46;1;2;3\n")
    (tmp_path / "README.txt").write_text("These are recordings.\nOf mine.\n")
    (tmp_path / "truth.json").write_text("{}")
    (tmp_path / ".two.csv").write_text("nothing")
    recording = read(tmp_path)
    assert recording.units == {"acc": "g", "mag": "uT"}
    assert len(recording.acc.t) == 10
    assert recording.mag.t.tolist() == [0.05, 0.25, 0.46]
    assert [os.path.basename(f) for f in recording.files] == ["one.parquet", "two.csv"]
    assert "table-skipped" in codes(recording)
    (tmp_path / "three.csv").write_text(HEAD + ROWS)
    with pytest.raises(InputError, match=r"acc is in three\.csv and in another table|acc is in two|another table"):
        read(tmp_path)


def test_mutated_files_never_escape_the_errors(tmp_path):
    """Bit flips, cuts and stray bytes: a recording or a `MargcalError`, nothing else."""
    rng = np.random.default_rng(7)
    csv = ("# c\n" + HEAD + ROWS).encode()
    parquet = table_of(tmp_path, t_s=np.arange(10) / 100, **sensor("acc", "g", np.ones((10, 3)))).read_bytes()
    tokens = [b"\0", b'"', b",", b"\n", b"\r", b"nan", b"inf", b"1e999", b"\xff\xfe", b"\x1b[2J", b"#", b"//", b"-"]
    read_well = 0
    for k in range(400):
        data = bytearray(csv if k % 2 else parquet)
        for _ in range(rng.integers(1, 4)):
            at = int(rng.integers(len(data)))
            what = rng.integers(3)
            if what == 0:
                data[at] ^= 1 << rng.integers(8)
            elif what == 1:
                data[at:at] = tokens[rng.integers(len(tokens))]
            else:
                del data[at : at + int(rng.integers(1, 40))]
        path = tmp_path / ("m.csv" if k % 2 else "m.parquet")
        path.write_bytes(data)
        try:
            read(path)
            read_well += 1
        except MargcalError as error:
            assert "Traceback" not in str(error)
    assert 0 < read_well < 400


def test_reading_imports_neither_pandas_nor_datasets(tmp_path):
    import subprocess

    path = table_of(tmp_path, t_s=np.arange(10) / 100, **sensor("acc", "g", np.ones((10, 3))))
    code = (
        "import sys; from margcal.files.tables import read; read(sys.argv[1]);"
        "print([m for m in ('pandas', 'pyarrow.dataset', 'pyarrow.csv', 'scipy', 'msgspec') if m in sys.modules])"
    )
    out = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".tsv"])
def test_write_and_read_back(tmp_path, suffix):
    rng = np.random.default_rng(3)
    path = tmp_path / f"out{suffix}"
    y = rng.normal(size=(50, 3)) * 1e-7
    y[7] = np.nan
    write_table(path, {"t_s": np.arange(50) / 3, **sensor("acc", "g", y), "n": np.arange(50), "face": ["+x"] * 50})
    recording = read(path)
    np.testing.assert_array_equal(recording.acc.y, np.delete(y, 7, axis=0))
    np.testing.assert_array_equal(recording.acc.t, np.delete(np.arange(50) / 3, 7))
    with pytest.raises(InputError, match="--overwrite"):
        write_table(path, {"t_s": [0.0]})
    write_table(path, {"t_s": [0.5]}, overwrite=True)
    with pytest.raises(InputError, match="differ in length"):
        write_table(path, {"a": [1], "b": [1, 2]}, overwrite=True)
    assert os.listdir(tmp_path) == [f"out{suffix}"]


def test_formulas_are_made_harmless_and_axes_are_not(tmp_path):
    path = tmp_path / "a.csv"
    write_table(path, {"text": ["=1+1", "@x", "+x", "-1.5", "a,b", 'q"q', "-cmd"], "value": [-1.0] * 7})
    read_back = pacsv.read_csv(path).to_pydict()
    assert read_back["text"] == ["'=1+1", "'@x", "+x", "-1.5", "a,b", 'q"q', "'-cmd"]
    assert read_back["value"] == [-1.0] * 7


def test_poses_quaternions_and_intervals(put, tmp_path):
    poses = read_poses(put("qw,qx,qy,qz,start_s,stop_s,file\n1,0,0,0,1,2,a.csv\n0.7071,0.7071,0,0,3,4.5,b.csv\n"))
    np.testing.assert_allclose(np.linalg.norm(poses.q, axis=1), 1, atol=1e-15)
    assert len(poses) == 2
    assert poses.stop.tolist() == [2, 4.5]
    assert poses.file == ("a.csv", "b.csv")
    path = tmp_path / "p.parquet"
    write_table(path, {"up": ["+x", "-z"], "front": [None, "+y"]})
    poses = read_poses(path)
    assert poses.up == ("+x", "-z")
    assert poses.front == (None, "+y")
    assert poses.start is None


def test_poses_axes_as_people_write_them(put):
    poses = read_poses(put("up;front\n+X;y\nz;\n'-y;\n", "poses.csv"))
    assert poses.up == ("+x", "+z", "-y")
    assert poses.front == ("+y", None, None)
    assert read_poses(put("qw;qx;qy;qz\n0,6;0,8;0;0\n")).q[0].tolist() == [0.6, 0.8, 0, 0]


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ("a,b\n1,2\n", "expected columns qw qx qy qz, or up"),
        ("qw,qx,qy\n1,0,0\n", "no qz"),
        ("qw,qx,qy,qz\n1,0,0,0\n1,1,0,0\n", r"row 2: the quaternion has norm 1\.414"),
        ("qw,qx,qy,qz\n1,0,0,0\n1,0,,0\n", "row 2: qy is empty"),
        ("qw,qx,qy,qz\n1,0,0,zero\n", "row 1: qz 'zero'"),
        ("up\n+x\nup\n", "row 2: up is 'up'"),
        ("up,front\n+x,-y\n+x,-x\n", "row 2: .*same axis"),
        ("up,front\n+x,-y\n,-x\n", "row 2: up is empty"),
        ("up,start_s\n+x,1\n", "belong together"),
        ("up,start_s,stop_s\n+x,1,2\n+y,4,3\n", "row 2: stop_s"),
        ("up,up\n+x,+x\n", "there twice"),
    ],
)
def test_poses_refused(put, data, message):
    with pytest.raises(InputError, match=message):
        read_poses(put(data, "poses.csv"))


@pytest.mark.parametrize(
    ("name", "units", "rows"),
    [
        ("imu_tk/xsens_mti_multipose.parquet", {"acc": "count", "gyr": "count"}, 51175),
        ("imucal/ferraris_session.parquet", {"acc": "mps2", "gyr": "dps"}, 10376),
        ("maglogs/qmc5883l_tomisuarez2.parquet", {"mag": "count"}, None),
        ("sunsided/set-2_full-sphere", {"acc": "g", "gyr": "dps", "mag": "gauss"}, 10528),
        ("tyrex/calib_acc_Nexus5_d1", {"acc": "mps2", "gyr": "radps", "mag": "uT"}, 10596),
        ("tyrex/Thibaud_Nexus5_NoDist_AR", {"acc": "mps2", "gyr": "radps", "mag": "uT"}, 24068),
        (
            "broad/05_undisturbed_slow_rotation_with_breaks_B.parquet",
            {"acc": "mps2", "gyr": "radps", "mag": "uT"},
            59212,
        ),
    ],
)
def test_real_recordings(data_file, name, units, rows):
    recording = read(data_file(name))
    assert recording.units == units
    assert rows is None or len(recording.acc.t) == rows
    assert not [i for i in recording.issues if i.level == "fail"]
    if name.startswith(("broad", "tyrex/Thibaud")):
        seen = ~np.isnan(recording.reference.q[:, 0])
        assert seen.mean() > 0.5
        np.testing.assert_allclose(np.linalg.norm(recording.reference.q[seen], axis=1), 1, atol=1e-12)
    if name.startswith("tyrex/calib"):
        assert "gyr_osbias_x_radps" in recording.other


def test_slow_real_recording_needs_its_rate(data_file):
    path = data_file("cats_temperature/period_x_10s_median.parquet")
    with pytest.raises(InputError, match=r"declare the rate \(0\.1 Hz\)"):
        read(path)
    assert read(path, rate=0.1).acc.rate == pytest.approx(0.1)
