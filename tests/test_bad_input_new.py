"""Faults that a hostile and a naive user found in export, import, evaluate and align: each stays mended.

Everything goes through the command line. Held for every run: no traceback, no internal error, no warning of numpy; a
refusal is one line on stderr, and leaves no file.
"""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from margcal.core import so3
from margcal.core.types import Array, Calibration
from margcal.files.calfile import save
from margcal.files.tables import write_table
from margcal.workflow.mocap_simulation import MocapSimulation, simulate_mocap
from margcal.workflow.simulate import simulate
from test_bad_input import Outcome, columns, margcal

Q = ("qw", "qx", "qy", "qz")


@pytest.fixture
def calibration(tmp_path: Path) -> Path:
    """A calibration from counts; 1 count is about 0.0048 m/s^2, 0.0011 rad/s, 0.15 uT."""
    path = tmp_path / "cal.json"
    save(truth(), path)
    return path


@cache
def truth() -> Calibration:
    return simulate(seed=3, n_poses=6, rest_s=1.0, rate=50.0).truth


def refused(outcome: Outcome, status: int, *words: str) -> None:
    assert outcome.status == status, outcome.err
    assert outcome.err.count("\n") == 1
    assert not outcome.new
    for word in words:
        assert word in outcome.err


# --- export -------------------------------------------------------------------------------------------

SCALES = "acc=0.0048,gyr=0.00106,mag=0.15"


def px4(folder: Path, *more: str) -> Outcome:
    return margcal(folder, "export", "cal.json", "--to", "px4", "-o", "x.params", "--scale", SCALES, *more)


def test_nan_is_no_limit_of_the_loss(tmp_path: Path, calibration: Path) -> None:
    refused(px4(tmp_path, "--max-loss", "nan"), 2, "--max-loss")
    assert px4(tmp_path, "--max-loss", "90", "--field", "49").status == 0


@pytest.mark.parametrize("field", ["nan", "inf", "49000"])
def test_field_that_is_none_of_the_earth(tmp_path: Path, calibration: Path, field: str) -> None:
    refused(px4(tmp_path, "--field", field, "--allow-lossy"), 2, "--field")


@pytest.mark.parametrize("scale", ["acc=1e308,gyr=1e308", "acc=1e-308,gyr=1e-308", "acc=0.00049,gyr=0.00106"])
def test_scale_in_another_unit(tmp_path: Path, calibration: Path, scale: str) -> None:
    """The last is in g: every number of the file would be 9.8 times too large."""
    out = margcal(
        tmp_path, "export", "cal.json", "--to", "openvins", "-o", "x.yaml", "--sensors", "acc,gyr", "--scale", scale
    )
    refused(out, 2, "--scale acc", "m/s^2 a count")


@pytest.mark.parametrize("name", ["", " "])
def test_result_without_a_name(tmp_path: Path, calibration: Path, name: str) -> None:
    refused(margcal(tmp_path, "export", "cal.json", "--to", "c", "-o", name), 2, "name of a result is empty")


# --- import -------------------------------------------------------------------------------------------


def import_(folder: Path, file: str, source: str, *more: str) -> Outcome:
    return margcal(folder, "import", file, "--from", source, "-o", "out.json", *more)


@pytest.mark.parametrize(("target", "suffix"), [("c", ".h"), ("matlab-text", ".m"), ("ardupilot", ".param")])
def test_file_that_was_cut_before_a_sensor(tmp_path: Path, calibration: Path, target: str, suffix: str) -> None:
    file = f"x{suffix}"
    more = ["--scale", SCALES, "--allow-lossy", "--field", "49"] if target == "ardupilot" else []
    assert margcal(tmp_path, "export", "cal.json", "--to", target, "-o", file, *more).status == 0
    text = (tmp_path / file).read_text()
    mark = {"c": "MAG_H[", "matlab-text": "mag_A =", "ardupilot": "COMPASS_OFS_X"}[target]
    (tmp_path / "cut.txt").write_text(text[: text.rindex("\n", 0, text.index(mark))])
    refused(import_(tmp_path, "cut.txt", target), 1, "mag", "cut or damaged")
    assert import_(tmp_path, "cut.txt", target, "--sensors", "acc").status == 0


def test_imu_tk_of_a_magnetometer(tmp_path: Path) -> None:
    (tmp_path / "x.calib").write_text("1 0 0 0 1 0 0 0 1\n1 0 0 0 1 0 0 0 1\n0 0 0\n")
    refused(import_(tmp_path, "x.calib", "imu-tk", "--sensors", "mag"), 1, "--sensors acc or gyr")


@pytest.mark.parametrize("option", ["--units", "--unit"])
def test_unit_of_no_sensor(tmp_path: Path, option: str) -> None:
    (tmp_path / "q.json").write_text('{"gain": [1, 1, 1], "bias": [0, 0, 0]}')
    more = [option, "banana=uT,mag=uT", "--unit" if option == "--units" else "--units", "mag=uT"]
    refused(import_(tmp_path, "q.json", "qmt", *more), 2, "banana", "no sensor")


@pytest.mark.parametrize(
    ("header", "row", "word"),
    [("scale.x,scale.y,scale.z", "1,1,1,0,0", "cut or damaged"), ("scale.x,scale.x,scale.y,scale.z", None, "twice")],
)
def test_ggir_row_that_does_not_fit_its_header(tmp_path: Path, header: str, row: str | None, word: str) -> None:
    names = f"filename,{header},offset.x,offset.y,offset.z"
    cells = row or ",".join(["1"] * header.count("s") + ["0"] * 3)
    (tmp_path / "g.csv").write_text(f"{names}\nnode,{cells}\n")
    refused(import_(tmp_path, "g.csv", "ggir"), 1, word)


def test_bias_alone_is_not_the_frame_of_the_node(tmp_path: Path, calibration: Path) -> None:
    out = margcal(
        tmp_path, "export", "cal.json", "--to", "betaflight", "-o", "b.txt", "--allow-lossy", "--sensors", "acc"
    )
    assert out.status == 0
    out = import_(tmp_path, "b.txt", "betaflight", "--scale", "acc=0.0048", "--json")
    assert out.status == 0
    assert ("warn", "nominal-scale", "acc") in out.codes
    assert json.loads((tmp_path / "out.json").read_text())["frame"] == "unknown"


def test_number_that_float32_cannot_hold(tmp_path: Path, calibration: Path) -> None:
    assert margcal(tmp_path, "export", "cal.json", "--to", "c", "-o", "x.h").status == 0
    text = (tmp_path / "x.h").read_text()
    at = text.index("{", text.index("ACC_H[9]")) + 1
    (tmp_path / "y.h").write_text(text[:at] + " 1e300f," + text[text.index(",", at) + 1 :])
    refused(import_(tmp_path, "y.h", "c"), 1, "acc")


# --- evaluate -----------------------------------------------------------------------------------------


def track(path: Path, q: Array, t: Array | None = None) -> None:
    t = np.arange(len(q)) / 100 if t is None else t
    write_table(path, {"t_s": t, **{n: q[:, i] for i, n in enumerate(Q)}}, overwrite=True)


@cache
def attitudes() -> Array:
    return mocap().reference.q[:1500]


def evaluate(folder: Path, q: Array, *more: str, t: Array | None = None) -> Outcome:
    track(folder / "ref.csv", attitudes())
    track(folder / "est.csv", q, t)
    return margcal(folder, "evaluate", "est.csv", "ref.csv", *more)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_track_against_itself(tmp_path: Path, sign: float) -> None:
    assert ("warn", "same-track") in kinds(evaluate(tmp_path, sign * attitudes(), "--json"))
    other = attitudes() + 1e-9 * np.roll(attitudes(), 1, axis=1)
    assert not kinds(evaluate(tmp_path, other, "--json"))


def kinds(outcome: Outcome) -> set[tuple[str, str]]:
    return {(i["level"], i["code"]) for i in outcome.plain["issues"] if i["level"] != "note"}


@pytest.mark.parametrize("name", ["conjugated", "scalar last", "scalar last and conjugated"])
def test_estimate_of_another_convention(tmp_path: Path, name: str) -> None:
    rng = np.random.default_rng(1)
    q = attitudes() + 1e-3 * rng.normal(size=attitudes().shape)
    if "conjugated" in name:
        q = q * [1, -1, -1, -1]
    if "scalar last" in name:
        q = np.roll(q, -1, axis=1)
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    found = evaluate(tmp_path, q, "--json").plain["issues"]
    said = [i for i in found if i["code"] == "convention"]
    assert len(said) == 1 and f"read {name}" in said[0]["text"]


def test_estimate_that_is_simply_bad_is_of_no_other_convention(tmp_path: Path) -> None:
    q = np.roll(attitudes(), 400, axis=0)
    assert not kinds(evaluate(tmp_path, q, "--json"))


@pytest.mark.parametrize("value", [0.0, np.nan])
def test_estimate_without_an_attitude(tmp_path: Path, value: float) -> None:
    refused_track = evaluate(tmp_path, np.full((500, 4), value))
    assert refused_track.status == 3
    assert "no sample holds an attitude" in refused_track.err


def test_advice_names_no_option_that_evaluate_has_not(tmp_path: Path) -> None:
    q = attitudes()
    clock: Array = np.arange(float(len(q)))
    outcomes = [evaluate(tmp_path, q, t=t) for t in (np.flip(clock), np.multiply(10.0, clock))]
    text = (tmp_path / "ref.csv").read_text()
    (tmp_path / "est.csv").write_text(text[: len(text) // 2].rsplit(",", 1)[0])
    outcomes.append(margcal(tmp_path, "evaluate", "est.csv", "ref.csv"))
    (tmp_path / "est.csv").write_text(text.replace("0.7", "x", 1))
    outcomes.append(margcal(tmp_path, "evaluate", "est.csv", "ref.csv"))
    for outcome in outcomes:
        refused(outcome, 1, "est.csv")
        for option in ("--sort", "--skip-bad", "declare the rate"):
            assert option not in outcome.err


@pytest.mark.parametrize("name", ["out.json", "out.csv", "out.PNG"])
def test_folder_is_not_named_like_a_file(tmp_path: Path, name: str) -> None:
    track(tmp_path / "est.csv", attitudes())
    refused(margcal(tmp_path, "evaluate", "est.csv", "est.csv", "-o", name), 2, "folder", ".svg")


# --- align --------------------------------------------------------------------------------------------


@cache
def mocap() -> MocapSimulation:
    return simulate_mocap(seed=1, duration_s=30.0, rate=50.0, optics_rate=100.0)


def align(
    folder: Path, *more: str, q: Array | None = None, rows: slice = slice(None), node: slice = slice(None)
) -> Outcome:
    simulated = mocap()
    write_table(folder / "node.csv", {k: v[node] for k, v in columns(simulated.recording).items()})
    given = simulated.reference.q if q is None else q
    track(folder / "ref.csv", given[rows], simulated.reference.t[rows])
    return margcal(folder, "align", "node.csv", "--reference", "ref.csv", *more)


@pytest.mark.parametrize("rows", [slice(1), slice(2), slice(300)])
def test_reference_of_a_moment(tmp_path: Path, rows: slice) -> None:
    """One sample ended in an internal error, three seconds in an accusation of conjugated quaternions."""
    refused(align(tmp_path, "-o", "x.json", rows=rows), 3, "reference", "too short")


def test_node_of_a_moment(tmp_path: Path) -> None:
    refused(align(tmp_path, node=slice(120)), 3, "gyroscope", "too short")


def test_reference_that_stands_still_is_not_conjugated(tmp_path: Path) -> None:
    q = np.tile(mocap().reference.q[0], (len(mocap().reference.t), 1))
    outcome = align(tmp_path, "--json", q=q)
    assert outcome.status == 3
    assert "conjugated" not in outcome.err
    assert {i["code"] for i in outcome.plain["issues"] if i["level"] == "fail"} == {"no-synchronisation"}


def test_reference_that_is_conjugated_is(tmp_path: Path) -> None:
    outcome = align(tmp_path, q=mocap().reference.q * [1, -1, -1, -1])
    assert outcome.status == 3 and "conjugated" in outcome.err


def test_reason_is_in_the_json_too(tmp_path: Path) -> None:
    outcome = align(tmp_path, "--json", q=np.full((len(mocap().reference.t), 4), np.nan))
    assert outcome.status == 3
    assert any(i["level"] == "fail" and "sees the body nowhere" in i["text"] for i in outcome.plain["issues"])


@pytest.mark.parametrize(("off_deg_s", "status"), [(0.0, 0), (2.0, 0), (20.0, 3)])
def test_trial_at_rest_of_another_node(tmp_path: Path, off_deg_s: float, status: int) -> None:
    """Its bias went into H without a word, and turned the attitude by degrees."""
    gyr = mocap().truth.gyr
    assert gyr is not None
    bias = gyr.B + np.linalg.solve(gyr.H, np.radians([off_deg_s, 0.0, 0.0]))
    t = np.arange(500) / 50
    y = np.rint(bias + np.random.default_rng(2).normal(0, 2, (len(t), 3)))
    write_table(tmp_path / "rest.csv", {"t_s": t, **{f"gyr_{a}_count": y[:, i] for i, a in enumerate("xyz")}})
    outcome = align(tmp_path, "--static", "rest.csv", "--json")
    assert outcome.status == status, outcome.err
    found = {i["level"] for i in outcome.plain["issues"] if i["code"] == "static-bias"}
    assert found == ({"fail"} if status else {"warn"} if off_deg_s else set())


def test_marker_column_that_is_there_twice(tmp_path: Path) -> None:
    assert align(tmp_path, "--sensors", "gyr").status == 0
    names = [f"{m}_{a}_mm" for m in "abc" for a in "xyz"]
    rows = "\n".join(",".join(["0.0"] + ["1.0"] * 10) for _ in range(3))
    (tmp_path / "m.csv").write_text(",".join(["t_s", *names, "a_x_mm"]) + "\n" + rows + "\n")
    refused(margcal(tmp_path, "align", "node.csv", "--reference", "m.csv"), 1, "m.csv", "a_x_mm", "twice")


def test_advice_for_a_reference_names_no_option_that_does_not_reach_it(tmp_path: Path) -> None:
    align(tmp_path, "--sensors", "gyr")
    text = (tmp_path / "ref.csv").read_text()
    (tmp_path / "ref.csv").write_text(text.replace("0.7", "x", 1))
    outcome = margcal(tmp_path, "align", "node.csv", "--reference", "ref.csv")
    refused(outcome, 1, "ref.csv")
    assert "--skip-bad" not in outcome.err


def test_markers_without_a_unit_are_refused_and_read_once_it_is_told(tmp_path: Path) -> None:
    sim = simulate_mocap(seed=5, duration_s=30.0, offset_s=0.1)
    write_table(tmp_path / "node.parquet", columns(sim.recording))
    q, p = sim.reference.q, sim.reference.p
    assert p is not None
    shape = np.array([[0.0, 0.0, 0.0], [0.08, 0.0, 0.0], [0.05, 0.06, 0.0]])
    x = 1e3 * (np.einsum("nij,mj->nmi", so3.matrix_from_quat(q), shape) + p[:, None])
    table = {"t_s": sim.reference.t}
    table |= {f"{n}_{a}": x[:, m, i] for m, n in enumerate("ABC") for i, a in enumerate("xyz")}
    write_table(tmp_path / "markers.csv", table)
    call = ("align", "node.parquet", "--reference", "markers.csv", "--markers", "A,B,C", "-o", "cal.json")
    refused(margcal(tmp_path, *call), 1, "--marker-unit")
    told = margcal(tmp_path, *call, "--marker-unit", "mm", "--json")
    assert told.status == 0, told.err
    lever = json.loads((tmp_path / "cal.json").read_text())["alignment"]["lever_arm_m"]
    np.testing.assert_allclose(lever, (0.03, -0.02, 0.01), atol=2e-3)
