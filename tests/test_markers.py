"""Markers to attitudes, and every kind of file that may hold a reference: C3D (made here by ezc3d), tables, folders."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from margcal.core import rigid_body, so3
from margcal.core.errors import DataError, InputError, UsageError
from margcal.core.rigid_body import MarkerReference
from margcal.core.types import Array, Reference
from margcal.files import c3d
from margcal.files.markers import Markers, marker_reference, read_markers
from margcal.files.references import read_reference
from margcal.files.tables import read, write_table

SHAPE = np.array([[0.0, 0.0, 0.0], [0.08, 0.0, 0.0], [0.05, 0.06, 0.0], [0.01, 0.03, 0.04]])
"""m, in the frame that the markers' order states."""
NAMES = ("A", "B", "C", "D")
RATE = 100.0


def motion(n: int, seed: int = 0) -> tuple[Array, Array]:
    """Attitudes (n, 3, 3) and positions (n, 3) m of a body that is waved about."""
    rng = np.random.default_rng(seed)
    t = np.arange(n)[:, None] / RATE
    angle = np.sin(2 * np.pi * t * rng.uniform(0.2, 0.7, 3) + rng.uniform(0, 6, 3))
    return so3.exp(1.5 * angle), 0.3 * angle[:, ::-1] + np.array([1.0, -2.0, 0.9])


def seen_markers(
    n: int = 300, *, shape: Array = SHAPE, noise: float = 0.0, seed: int = 0
) -> tuple[Array, Array, Array]:
    """Tracks (n, M, 3) m with R and p."""
    R, p = motion(n, seed)
    x = np.einsum("nij,mj->nmi", R, shape) + p[:, None]
    return x + noise * np.random.default_rng(seed + 1).normal(size=x.shape), R, p


def tracks(x: Array, names: tuple[str, ...] = NAMES) -> Markers:
    return Markers(names[: x.shape[1]], np.arange(len(x)) / RATE, x)


def write_c3d(
    path: Path,
    x: Array,
    *,
    names: tuple[str, ...] = NAMES,
    unit: str = "mm",
    lost: tuple[tuple[int, int], ...] = (),
    rate: float = RATE,
) -> Path:
    """Tracks (n, M, 3) in `unit`; (frame, marker) of `lost` get residual -1 and the place that they are in."""
    ezc3d = pytest.importorskip("ezc3d")
    file = ezc3d.c3d()
    n, m = x.shape[:2]
    points = np.ones((4, m, n))
    points[:3] = x.transpose(2, 1, 0)
    residual = np.zeros((1, m, n))
    for frame, marker in lost:
        residual[0, marker, frame] = -1
    point = file["parameters"]["POINT"]
    point["RATE"]["value"], point["LABELS"]["value"], point["UNITS"]["value"] = [rate], names[:m], [unit]
    file["data"]["points"] = points
    file["data"]["meta_points"]["residuals"] = residual
    file["data"]["meta_points"]["camera_masks"] = np.zeros((7, m, n), dtype=bool)
    file.write(str(path))
    return path


# --- the fit ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("m", [3, 4])
def test_attitude_and_position_are_exact_without_noise(m: int):
    x, R, p = seen_markers(shape=SHAPE[:m])
    found = marker_reference(tracks(x))
    np.testing.assert_allclose(so3.matrix_from_quat(found.q), R, atol=1e-12)
    np.testing.assert_allclose(found.p, p, atol=1e-12)
    assert np.max(found.residual) < 1e-12
    np.testing.assert_allclose(found.shape, SHAPE[:m], atol=1e-12)


def test_frame_is_that_of_the_first_three_markers_whatever_the_laboratory():
    x, *_ = seen_markers()
    turned = x @ so3.exp([0.3, -2.0, 1.0]).T + np.array([3.0, 4.0, 5.0])
    np.testing.assert_allclose(marker_reference(tracks(turned)).shape, SHAPE, atol=1e-12)
    first_from_third = marker_reference(tracks(x), names=["C", "A", "B"])
    np.testing.assert_allclose(first_from_third.shape[0], 0, atol=1e-12)
    assert first_from_third.shape[1, 0] == pytest.approx(np.linalg.norm(SHAPE[2]))
    np.testing.assert_allclose(first_from_third.shape[2, 2], 0, atol=1e-12)


def test_third_marker_on_the_line_is_passed_over_for_the_frame():
    shape = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.05, 0.0005, 0], [0.02, 0.05, 0]])
    assert rigid_body.frame_markers(shape) == (0, 1, 3)
    x, R, _ = seen_markers(shape=shape)
    np.testing.assert_allclose(so3.matrix_from_quat(marker_reference(tracks(x)).q), R, atol=1e-9)


def test_noise_of_attitude_and_residual_are_as_large_as_they_must_be():
    sd = 3e-4
    x, R, _ = seen_markers(2000, noise=sd)
    found = marker_reference(tracks(x))
    # four markers give 12 numbers for 6 unknowns: half of the noise is left over
    assert np.sqrt(np.mean(found.residual**2)) == pytest.approx(sd * np.sqrt(6 / 4), rel=0.05)
    angle = so3.log(np.swapaxes(R, 1, 2) @ so3.matrix_from_quat(found.q))
    centred = SHAPE - SHAPE.mean(axis=0)
    inertia = np.eye(3) * np.sum(centred**2) - centred.T @ centred
    bound = sd * np.sqrt(np.diag(np.linalg.inv(inertia)))  # Fisher information of a turn is the inertia over sd^2
    np.testing.assert_allclose(angle.std(axis=0), bound, rtol=0.06)


def test_mirrored_template_is_a_residual_and_never_a_reflection():
    x, *_ = seen_markers()
    mirrored = dict(zip(NAMES, SHAPE * np.array([1, 1, -1])))
    found = marker_reference(tracks(x), template=mirrored)
    np.testing.assert_allclose(np.linalg.det(so3.matrix_from_quat(found.q)), 1, atol=1e-12)
    assert np.min(found.residual) > 0.005


def test_a_marker_that_is_lost_is_done_without_and_two_are_not():
    x, R, _ = seen_markers()
    x[50:80, 3] = np.nan
    x[60:70, 1] = np.nan
    found = marker_reference(tracks(x))
    gap = np.isnan(found.q[:, 0])
    np.testing.assert_array_equal(np.flatnonzero(gap), np.arange(60, 70))
    assert np.isnan(found.residual[gap]).all() and np.isnan(found.p[gap]).all()
    np.testing.assert_allclose(so3.matrix_from_quat(found.q[~gap]), R[~gap], atol=1e-12)


def test_three_seen_markers_on_one_line_are_a_gap():
    shape = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.05, 0, 0], [0.02, 0.05, 0]])
    x, *_ = seen_markers(100, shape=shape)
    x[20:30, 3] = np.nan
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(marker_reference(tracks(x)).q[:, 0])), np.arange(20, 30))


def test_swaps_do_not_bend_the_mean_shape():
    x, *_ = seen_markers(400, noise=2e-4)
    x[100:180, [0, 2]] = x[100:180, [2, 0]]
    found = marker_reference(tracks(x))
    assert np.abs(found.shape - SHAPE).max() < 1e-4
    assert found.residual[100:180].min() > 5 * np.median(found.residual)


def test_template_of_one_trial_gives_the_same_frame_in_another():
    first = marker_reference(tracks(seen_markers(200, noise=5e-4, seed=1)[0]))
    x, R, _ = seen_markers(200, seed=7)
    again = marker_reference(tracks(x), template=first)
    np.testing.assert_array_equal(again.shape, first.shape)
    assert np.max(so3.angle_between(so3.matrix_from_quat(again.q), R)) < np.radians(0.1)


# --- which markers ------------------------------------------------------------------------------------


def two_bodies() -> Markers:
    x, *_ = seen_markers(seed=0)
    y, *_ = seen_markers(seed=5)
    names = tuple(f"shank_{n}" for n in NAMES) + tuple(f"thigh_{n}" for n in NAMES) + ("*17",)
    ghost = np.zeros((len(x), 1, 3)) + np.linspace(0, 1, len(x))[:, None, None]
    return Markers(names, np.arange(len(x)) / RATE, np.concatenate([x, y, ghost], axis=1), "walk.c3d")


def test_markers_of_two_bodies_are_refused_and_the_bodies_named():
    with pytest.raises(InputError, match=r"shank_A, shank_B, shank_C, shank_D; thigh_A, thigh_B"):
        marker_reference(two_bodies())


def test_a_pattern_names_a_body_and_unlabelled_points_are_left_alone():
    found = marker_reference(two_bodies(), names=["thigh_*"])
    assert found.names == tuple(f"thigh_{n}" for n in NAMES)
    _, R, _ = seen_markers(seed=5)
    np.testing.assert_allclose(so3.matrix_from_quat(found.q), R, atol=1e-12)
    one = two_bodies().select(["shank_*", "*17"])
    assert marker_reference(one).names == tuple(f"shank_{n}" for n in NAMES)


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"names": ["A", "B"]}, InputError, "three markers or more"),
        ({"names": ["A", "B", "nose"]}, InputError, "no marker 'nose'; there are A, B, C, D"),
        ({"template": {"A": (0, 0, 0), "B": (1, 0, 0)}}, InputError, "must be in both"),
        ({"template": {"A": (0, 0, 0), "B": (1, 0), "C": (0, 1, 0)}}, InputError, "three finite coordinates"),
        ({"template": {"A": (0, 0, 0), "B": (1, 0, 0), "C": (2, 0, 0)}}, DataError, "on one line"),
    ],
)
def test_wrong_choice_of_markers_is_refused(change, error, words):
    with pytest.raises(error, match=words):
        marker_reference(tracks(seen_markers()[0]), **change)


def test_millimetres_taken_for_metres_are_named():
    with pytest.raises(InputError, match=r"are .* m apart: millimetres taken for metres"):
        marker_reference(tracks(1e3 * seen_markers(noise=2e-4)[0]))


def test_markers_on_a_line_and_never_seen_together_are_refused():
    x, *_ = seen_markers(shape=np.array([[0.0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]]))
    with pytest.raises(DataError, match="on one line"):
        marker_reference(tracks(x))
    x, *_ = seen_markers(shape=SHAPE[:3])
    x[::2, 0], x[1::2, 1] = np.nan, np.nan
    with pytest.raises(DataError, match="never all seen"):
        marker_reference(tracks(x))


# --- C3D ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("unit", "factor"), [("mm", 1e3), ("m", 1.0), ("cm", 1e2)])
def test_c3d_in_its_own_unit(tmp_path, unit, factor):
    x, R, p = seen_markers()
    found = read_reference(write_c3d(tmp_path / "a.c3d", factor * x, unit=unit))
    assert isinstance(found, MarkerReference) and found.names == NAMES
    assert np.max(so3.angle_between(so3.matrix_from_quat(found.q), R)) < 1e-4  # the file holds float32
    assert found.p is not None
    np.testing.assert_allclose(found.p, p, atol=1e-5)
    np.testing.assert_allclose(found.t, np.arange(len(x)) / RATE)


def test_c3d_points_that_were_not_seen(tmp_path):
    x, *_ = seen_markers(100)
    x[40:45, 2] = np.nan
    x[60:63, 1] = 0.0
    lost = tuple((k, 0) for k in range(20, 30))
    markers = read_markers(write_c3d(tmp_path / "a.c3d", 1e3 * x, lost=lost))
    gone = np.isnan(markers.x[:, :, 0])
    for marker, frames in ((0, range(20, 30)), (2, range(40, 45)), (1, range(60, 63)), (3, ())):
        np.testing.assert_array_equal(np.flatnonzero(gone[:, marker]), list(frames))


def test_c3d_unit_that_is_missing_must_be_declared(tmp_path):
    x, *_ = seen_markers(50)
    path = write_c3d(tmp_path / "a.c3d", 1e3 * x, unit="")
    with pytest.raises(InputError, match="no length unit"):
        read_markers(path)
    np.testing.assert_allclose(read_markers(path, unit="mm").x, x, atol=1e-5)
    path = write_c3d(tmp_path / "b.c3d", 1e3 * x, unit="furlong")
    with pytest.raises(InputError, match="furlong"):
        read_markers(path)
    path = write_c3d(tmp_path / "c.c3d", 1e3 * x)
    with pytest.raises(InputError, match="is in mm, and m was declared"):
        read_markers(path, unit="m")
    with pytest.raises(InputError, match="none of m, cm, mm, in"):
        read_markers(path, unit="ell")


def test_c3d_cut_at_any_length_is_refused_or_whole(tmp_path):
    x, *_ = seen_markers(200)
    path = write_c3d(tmp_path / "a.c3d", 1e3 * x)
    whole = path.read_bytes()
    layout = c3d.check_layout(path, 10**9)
    end = layout.data_offset + layout.frames * 16 * 4
    assert (layout.points, layout.frames, layout.value_bytes) == (4, 200, 4) and end <= len(whole)
    for length in [*range(0, end, end // 60), end - 1]:
        path.write_bytes(whole[:length])
        with pytest.raises(InputError):
            read_markers(path)
    path.write_bytes(whole[:end])
    np.testing.assert_allclose(read_markers(path).x, x, atol=1e-5)


def test_c3d_that_promises_more_than_it_holds_is_refused_before_anything_is_read(tmp_path):
    x, *_ = seen_markers(20)
    path = write_c3d(tmp_path / "a.c3d", 1e3 * x)
    for word, value, words in ((4, 65000, "promises 65000 frames"), (1, 40000, "frames of"), (2, 60000, "frames of")):
        raw = bytearray(path.read_bytes())
        raw[2 * word : 2 * word + 2] = value.to_bytes(2, "little")
        (tmp_path / "b.c3d").write_bytes(raw)
        with pytest.raises(InputError, match=words):
            c3d.check_layout(tmp_path / "b.c3d", 10**9)
    with pytest.raises(InputError, match="more than is read"):
        c3d.check_layout(path, 1000)


@pytest.mark.parametrize(
    ("content", "words"),
    [(b"", "no C3D file"), (b"t_s,a\n1,2\n" * 100, "no C3D file"), (bytes(4096), "no C3D file")],
)
def test_what_is_no_c3d_file(tmp_path, content, words):
    (tmp_path / "a.c3d").write_bytes(content)
    with pytest.raises(InputError, match=words):
        read_markers(tmp_path / "a.c3d")
    with pytest.raises(InputError, match="cannot be read"):
        read_markers(tmp_path / "missing.c3d")


def test_c3d_with_bytes_changed_is_read_or_refused_and_never_ends_the_process(tmp_path):
    """In a process of its own: ezc3d alone ends it at one such file in eighty."""
    x, *_ = seen_markers(30)
    write_c3d(tmp_path / "a.c3d", 1e3 * x)
    script = """
import sys, numpy as np
from pathlib import Path
from margcal.core.errors import InputError
from margcal.files.markers import read_markers
whole, rng, refused = Path("a.c3d").read_bytes(), np.random.default_rng(0), 0
for k in range(160):
    raw = bytearray(whole)
    for _ in range(rng.integers(1, 6)):
        raw[rng.integers(0, 1600)] = rng.integers(0, 256)
    Path("b.c3d").write_bytes(raw)
    try:
        read_markers("b.c3d", unit=None)
    except InputError:
        refused += 1
print(refused)
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert 40 < int(done.stdout) < 155


def test_c3d_without_ezc3d_says_what_to_install(tmp_path, monkeypatch):
    path = write_c3d(tmp_path / "a.c3d", 1e3 * seen_markers(20)[0])
    monkeypatch.setitem(sys.modules, "ezc3d", None)
    with pytest.raises(UsageError, match=r"margcal\[io\]"):
        read_markers(path)


# --- tables and folders -------------------------------------------------------------------------------


def marker_table(x: Array, *, unit: str = "_mm", names: tuple[str, ...] = NAMES) -> dict[str, Array]:
    columns = {"t_s": np.arange(len(x)) / RATE}
    for k, name in enumerate(names[: x.shape[1]]):
        columns |= {f"{name}_{a}{unit}": x[:, k, j] for j, a in enumerate("xyz")}
    return columns


def quaternion_table(prefix: str, *, p: str = "", n: int = 60) -> dict[str, Array]:
    R, position = motion(n)
    q = so3.quat_from_matrix(R)
    columns = {"t_s": np.arange(n) / RATE} | {f"{prefix}{c}": q[:, k] for k, c in enumerate("wxyz")}
    factor = 1e3 if p.endswith("mm") else 1.0
    return columns | ({p.replace("?", a): factor * position[:, k] for k, a in enumerate("xyz")} if p else {})


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_marker_table(tmp_path, suffix):
    x, R, p = seen_markers(100)
    x[10:15, 1] = np.nan
    path = tmp_path / f"markers.{suffix}"
    write_table(path, marker_table(1e3 * x[:, :3]))
    found = read_reference(path)
    assert isinstance(found, MarkerReference) and found.names == ("A", "B", "C")
    seen = ~np.isnan(found.q[:, 0])
    np.testing.assert_array_equal(np.flatnonzero(~seen), np.arange(10, 15))
    np.testing.assert_allclose(so3.matrix_from_quat(found.q[seen]), R[seen], atol=1e-8)
    assert found.p is not None
    np.testing.assert_allclose(found.p[seen], p[seen], atol=1e-8)


def test_marker_table_without_unit_or_time(tmp_path):
    x, *_ = seen_markers(30)
    columns = marker_table(x, unit="")
    write_table(tmp_path / "a.csv", columns)
    with pytest.raises(InputError, match="no length unit"):
        read_markers(tmp_path / "a.csv")
    np.testing.assert_allclose(read_markers(tmp_path / "a.csv", unit="m").x, x, atol=1e-9)
    del columns["t_s"]
    write_table(tmp_path / "b.csv", columns)
    with pytest.raises(InputError, match="no column t_s"):
        read_markers(tmp_path / "b.csv", unit="m")
    np.testing.assert_allclose(read_markers(tmp_path / "b.csv", unit="m", rate=50.0).t, np.arange(30) / 50)
    write_table(tmp_path / "c.csv", quaternion_table("ref_q"))
    with pytest.raises(InputError, match="0 markers among its columns"):
        read_markers(tmp_path / "c.csv")


@pytest.mark.parametrize(
    ("prefix", "p"),
    [("ref_q", ""), ("ref_q", "ref_p_?_m"), ("ref_q", "ref_p_?_mm"), ("q", ""), ("q", "p_?_m"), ("q", "ref_p_?_mm")],
)
def test_tables_of_quaternions(tmp_path, prefix, p):
    write_table(tmp_path / "a.parquet", quaternion_table(prefix, p=p))
    found = read_reference(tmp_path / "a.parquet")
    R, position = motion(60)
    np.testing.assert_allclose(so3.matrix_from_quat(found.q), R, atol=1e-12)
    assert type(found) is Reference
    if p:
        assert found.p is not None
        np.testing.assert_allclose(found.p, position, atol=1e-12)
    else:
        assert found.p is None


def test_table_with_nothing_but_a_reference_is_a_recording_too(tmp_path):
    write_table(tmp_path / "a.csv", quaternion_table("ref_q", p="ref_p_?_m"))
    recording = read(tmp_path / "a.csv")
    assert not recording.streams and recording.reference is not None and recording.reference.p is not None
    np.testing.assert_allclose(recording.reference.q, read_reference(tmp_path / "a.csv").q, atol=1e-15)


def test_which_columns_are_taken_where_a_table_has_several(tmp_path):
    x, R, _ = seen_markers(60)
    estimate = {k: np.roll(v, 3) for k, v in quaternion_table("q").items()}
    columns = estimate | quaternion_table("ref_q") | marker_table(1e3 * x)
    write_table(tmp_path / "a.csv", columns)
    np.testing.assert_allclose(so3.matrix_from_quat(read_reference(tmp_path / "a.csv").q), motion(60)[0], atol=1e-9)
    named = read_reference(tmp_path / "a.csv", markers=["A", "B", "C"])
    assert isinstance(named, MarkerReference)
    np.testing.assert_allclose(so3.matrix_from_quat(named.q), R, atol=1e-8)


def test_slower_reference_in_a_faster_table(tmp_path):
    columns = quaternion_table("q", p="p_?_m", n=300)
    for name in columns:
        if name != "t_s":
            columns[name][np.arange(300) % 3 > 0] = np.nan
    write_table(tmp_path / "a.csv", columns)
    found = read_reference(tmp_path / "a.csv")
    np.testing.assert_allclose(found.t, np.arange(0, 300, 3) / RATE)
    assert not np.isnan(found.q).any()


def test_folder_with_one_reference_and_with_two(tmp_path):
    gyr = {"t_s": np.arange(50) / 75} | {f"gyr_{a}_dps": np.zeros(50) for a in "xyz"}
    write_table(tmp_path / "gyr.csv", gyr)
    with pytest.raises(InputError, match="no reference"):
        read_reference(tmp_path)
    write_table(tmp_path / "optics.csv", quaternion_table("q"))
    assert len(read_reference(tmp_path).t) == 60
    x, *_ = seen_markers(30)
    write_c3d(tmp_path / "trial.c3d", 1e3 * x)
    assert len(read_reference(tmp_path).t) == 60  # quaternions come before markers
    assert len(read_reference(tmp_path, markers=["A", "B", "C"]).t) == 30
    write_table(tmp_path / "more.csv", quaternion_table("q"))
    with pytest.raises(InputError, match=r"any of more\.csv, optics\.csv"):
        read_reference(tmp_path)
    write_table(tmp_path / "truth.csv", quaternion_table("ref_q", n=40))
    assert len(read_reference(tmp_path).t) == 40


@pytest.mark.parametrize(
    ("drop", "words"),
    [("ref_qz", "no ref_qz among"), ("t_s", "no column t_s"), ("ref_p_y_m", "needs ref_p_x, ref_p_y and ref_p_z")],
)
def test_incomplete_tables_are_refused(tmp_path, drop, words):
    columns = quaternion_table("ref_q", p="ref_p_?_m")
    del columns[drop]
    write_table(tmp_path / "a.csv", columns)
    with pytest.raises(InputError, match=words):
        read_reference(tmp_path / "a.csv")


def test_nothing_to_read(tmp_path):
    write_table(tmp_path / "a.csv", {"t_s": np.arange(5.0), "nonsense": np.arange(5.0)})
    with pytest.raises(InputError, match="no reference among its columns"):
        read_reference(tmp_path / "a.csv")
    with pytest.raises(InputError, match="no such file"):
        read_reference(tmp_path / "b.csv")
    with pytest.raises(InputError, match="no frame rate"):
        read_reference(tmp_path / "a.csv", rate=0.0)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("Format Version,1.23,Take Name,walk\n\n,Type,Rigid Body\n", "Motive export.* X, Y, Z, W"),
        ("NO_OF_FRAMES\t6000\nFREQUENCY\t100\n", "Qualisys TSV.* column by column"),
        ("PathFileType\t4\t(X/Y/Z)\twalk.trc\n", "TRC file"),
    ],
)
def test_exports_of_motion_capture_programs_are_named(tmp_path, content, words):
    (tmp_path / "walk.csv").write_text(content)
    with pytest.raises(InputError, match=words):
        read_reference(tmp_path / "walk.csv")


# --- real feet ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("side", "length_mm"), [("L", 248.8), ("R", 254.7)])
def test_feet_of_a_walker_are_nearly_rigid(data_file, side, length_mm):
    found = read_reference(data_file(f"gaitmap/{side}_foot_markers.parquet"))
    assert isinstance(found, MarkerReference) and found.names == ("heel_FCC", "toe_TOE", "FM5")
    assert not np.isnan(found.q).any() and len(found.t) == 3870
    assert 1e3 * found.shape[1, 0] == pytest.approx(length_mm, abs=0.1)
    assert 0.5 < 1e3 * np.median(found.residual) < 1.0
    assert 4 < 1e3 * np.quantile(found.residual, 0.95) < 7  # the toes bend at push-off


@pytest.mark.parametrize(("side", "sensor"), [("L", "left"), ("R", "right")])
def test_rates_of_the_feet_and_of_the_gyroscopes_on_them(data_file, side, sensor):
    """Shoe and markers are no rigid body: 20 deg/s rms differ about the ankle's axis, 60 to 100 along the foot.

    The markers lie nearly on the foot's long axis (58 mm off it, of 249), so the turn about it is carried least.
    """
    found = read_reference(data_file(f"gaitmap/{side}_foot_markers.parquet"))
    gyr = read(data_file(f"gaitmap/{sensor}_sensor.parquet")).gyr
    assert gyr is not None
    R = so3.matrix_from_quat(found.q)
    rate = np.degrees(so3.log(np.swapaxes(R[:-2], 1, 2) @ R[2:])) * RATE / 2
    seen = np.column_stack([np.interp(found.t[1:-1], gyr.t, gyr.y[:, k]) for k in range(3)])
    miss = rate @ so3.align_vectors(seen, rate).T - seen
    along, ankle, across = np.sqrt(np.mean(miss**2, axis=0))
    assert 15 < ankle < 25 and 20 < across < 35 and 50 < along < 105
    assert ankle < 0.12 * np.sqrt(np.mean(seen[:, 1] ** 2))
