"""`margcal verify` names the usual mistakes and accuses nobody wrongly. 100 nodes: benchmarks/studies/verify.py."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import margcal
from conftest import find_data
from margcal.apps import cli
from margcal.core.errors import DataError, InputError
from margcal.core.types import Calibration, Kind, Recording, SensorModel, Stream
from margcal.core.units import KINDS, SI_COLUMN, STANDARD_GRAVITY
from margcal.files.calfile import save
from margcal.files.tables import write_table
from margcal.workflow.calibrate import calibrate
from margcal.workflow.simulate import Simulation, simulate
from margcal.workflow.verify import Verification, verify
from margcal.workflow.verify_mistakes import suspects

FACTOR = {"acc": 1 / STANDARD_GRAVITY, "gyr": 180 / np.pi, "mag": 0.01}
"""g, deg/s and gauss for m/s^2, rad/s and uT."""

APPLY: dict[str, Callable[[SensorModel, Any], Any]] = {
    # each written out as somebody would write it, not taken from the code that is tested
    "": lambda m, y: (y - m.B) @ m.H.T,
    "bias-sign": lambda m, y: (y + m.B) @ m.H.T,
    "transposed": lambda m, y: (y - m.B) @ m.H,
    "forward": lambda m, y: np.linalg.solve(m.H, (y - m.B).T).T,
    "post-offset": lambda m, y: y @ m.H.T - m.B,
    "unit": lambda m, y: (y - m.B) @ m.H.T * FACTOR[m.kind],
}
FIVE = tuple(APPLY)[1:]


def applied(calibration: Calibration, recording: Recording, wrong: Mapping[Any, str] | str = "") -> Recording:
    by_kind: Mapping[Any, str] = dict.fromkeys(KINDS, wrong) if isinstance(wrong, str) else wrong
    streams: dict[Kind, Stream] = {
        k: Stream(k, s.t, APPLY[by_kind.get(k, "")](calibration.models[k], s.y), SI_COLUMN[calibration.models[k].unit])
        for k, s in recording.streams.items()
    }
    return of_streams(streams)


def of_streams(streams: Mapping[Kind, Stream]) -> Recording:
    return Recording(streams.get("acc"), streams.get("gyr"), streams.get("mag"), source="elsewhere")


def named(found: Verification) -> dict[str, str]:
    return {f.sensor: "+".join(f.mistakes) or f.outcome for f in found.findings if f.outcome != "right"}


def typical(seed: int, **more: object) -> Simulation:
    options = {"n_poses": 10, "scale_error": 0.05, "mounting_deg": 3.0, "rest_s": 2.0, "turn_s": 1.2, **more}
    return simulate(seed=seed, **options)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def node() -> Simulation:
    return typical(1)


# --- without raw readings -----------------------------------------------------------------------------


@pytest.mark.parametrize("mistake", FIVE)
@pytest.mark.parametrize("seed", [1, 2])
def test_each_mistake_is_named_from_rests_and_turns(mistake: str, seed: int):
    made = typical(seed)
    for wrong in (dict.fromkeys(KINDS, mistake), {KINDS[(seed + len(mistake)) % 3]: mistake}):
        found = verify(made.truth, applied(made.truth, made.recording, wrong))
        assert named(found) == wrong and found.fails


@pytest.mark.parametrize(
    "more", [{}, {"disturbed": 3, "disturbance": 0.1}, {"noise": 5.0}, {"knocks": 3}, {"mag_axes": "board"}]
)
def test_right_recordings_are_accused_of_nothing(more):
    made = typical(5, **more)
    found = verify(made.truth, applied(made.truth, made.recording))
    assert not found.fails and "mistake" not in [f.outcome for f in found.findings]


def test_a_calibration_of_another_session_and_a_bias_that_drifted_are_accused_of_nothing():
    session, later = typical(7, n_poses=24), typical(8, node_seed=7)
    calibration = calibrate(session.recording, field=49.1)
    right = applied(calibration, later.recording)
    assert named(verify(calibration, right)) == {}
    assert right.gyr is not None
    drifted = replace(right, gyr=replace(right.gyr, y=right.gyr.y + np.radians([0.5, -0.4, 0.3])))
    assert not verify(calibration, drifted).fails


def test_another_node_fails_without_naming_a_mistake():
    one, other = typical(1), typical(2, mounting_deg=30.0)
    found = verify(one.truth, applied(one.truth, other.recording))
    assert found.fails and {f.outcome for f in found.findings} == {"other"}


def test_what_makes_no_difference_cannot_be_told_and_its_size_is_said(node):
    """One accelerometer alone: a transposed H turns its vectors, which lengths at rest hardly show."""
    alone = Calibration(acc=node.truth.acc)
    assert node.truth.acc is not None
    recording = Recording(acc=applied(node.truth, node.recording).acc)
    found = verify(alone, recording)
    assert not found.fails
    size = found.findings[0].unseen["transposed"]
    H = node.truth.acc.H
    turned = H.T @ np.linalg.inv(H) - np.eye(3)
    assert size == pytest.approx(np.sqrt(np.sum(turned**2) / 3), rel=0.1)  # of the sensed vector


def test_too_few_rests_are_refused(node):
    made = typical(1, n_poses=3)
    with pytest.raises(DataError, match="3 rests"):
        verify(made.truth, applied(made.truth, made.recording))
    assert named(
        verify(made.truth, applied(made.truth, made.recording, "transposed"), made.recording)
    ) == dict.fromkeys(KINDS, "transposed")


# --- with raw readings --------------------------------------------------------------------------------


def test_with_raw_readings_the_answer_is_exact(node):
    truth, raw = node.truth, node.recording
    assert named(verify(truth, applied(truth, raw), raw)) == {}
    for mistake in FIVE:
        for wrong in (dict.fromkeys(KINDS, mistake), {"gyr": mistake}):
            found = verify(truth, applied(truth, raw, wrong), raw)
            assert named(found) == wrong and found.how == "exact"
            finding = next(f for f in found.findings if f.mistakes)
            assert finding.mended < 1e-9 * finding.residual


def test_rounded_float32_and_delayed_recordings_are_right(node):
    truth, raw = node.truth, node.recording
    right = applied(truth, raw)
    rounded = of_streams({k: replace(s, y=np.round(s.y, 3)) for k, s in right.streams.items()})
    single = of_streams({k: replace(s, y=s.y.astype(np.float32).astype(float)) for k, s in right.streams.items()})
    assert named(verify(truth, rounded, raw)) == {} == named(verify(truth, single, raw))
    assert right.mag is not None and truth.mag is not None
    late = replace(truth, mag=replace(truth.mag, delay_s=0.013))
    t = right.mag.t[:-5]
    moved = np.column_stack([np.interp(t + 0.013, right.mag.t, right.mag.y[:, i]) for i in range(3)])
    assert named(verify(late, Recording(mag=Stream("mag", t, moved, "uT")), raw)) == {}


def test_two_mistakes_swapped_axes_and_other_sensors_numbers(node):
    truth, raw = node.truth, node.recording
    right = applied(truth, raw)
    assert right.acc is not None and right.gyr is not None and raw.acc is not None and truth.gyr is not None
    wrong = applied(truth, raw, "transposed")
    assert wrong.acc is not None
    both = Recording(acc=replace(wrong.acc, y=wrong.acc.y / STANDARD_GRAVITY))
    assert named(verify(truth, both, raw)) == {"acc": "transposed+unit"}
    swapped = verify(truth, Recording(gyr=replace(right.gyr, y=right.gyr.y[:, [1, 0, 2]] * [1, -1, 1])), raw)
    assert named(swapped) == {"gyr": "axes"} and "+y -x +z" in swapped.findings[0].text
    other = Recording(acc=replace(right.acc, y=(raw.acc.y - truth.gyr.B) @ truth.gyr.H.T))
    assert named(verify(truth, other, raw)) == {"acc": "other-sensor"}


def test_an_unknown_formula_is_shown_and_a_filter_is_not_accused(node):
    truth, raw = node.truth, node.recording
    right = applied(truth, raw)
    assert right.acc is not None and right.gyr is not None
    odd = verify(truth, Recording(acc=replace(right.acc, y=1.07 * right.acc.y + 0.3)), raw)
    assert odd.fails and odd.findings[0].outcome == "other" and "v = A y + c" in odd.findings[0].text
    smooth = np.column_stack([np.convolve(right.gyr.y[:, i], np.ones(80) / 80, mode="same") for i in range(3)])
    filtered = verify(truth, Recording(gyr=replace(right.gyr, y=smooth)), raw)
    assert not filtered.fails and filtered.findings[0].outcome == "cannot-tell"


def test_a_mistake_that_changes_nothing_is_not_a_mistake():
    rng = np.random.default_rng(0)
    almost = SensorModel("acc", np.eye(3) + 1e-3 * np.diag([1, -1, 0.5]), np.array([0.4, -0.2, 0.1]), raw_unit="mps2")
    y = 9.8 * rng.normal(size=(200, 3))
    t = np.arange(200) / 100
    calibration = Calibration(acc=almost)
    wrong = Recording(acc=Stream("acc", t, y @ almost.H.T - almost.B, "mps2"))
    found = verify(calibration, wrong, Recording(acc=Stream("acc", t, y, "mps2")))
    assert not found.fails
    assert found.findings[0].unseen["post-offset"] == pytest.approx(1e-3 * np.hypot(0.4, 0.2) / 9.80665, rel=0.1)
    assert "transposed" in found.findings[0].unseen  # H is symmetric


def test_every_suspect_is_undone_by_its_mending(node):
    y = np.random.default_rng(0).normal(size=(5, 3))
    for kind, model in node.truth.models.items():
        for way in suspects(node.truth.models, kind):
            G, g = way.mending(model)
            right = model.apply(y)
            np.testing.assert_allclose(way.of(y) @ G.T + g, right, rtol=1e-6, atol=1e-6 * np.abs(right).max())


def test_what_cannot_be_verified_is_refused(node):
    truth, raw = node.truth, node.recording
    with pytest.raises(InputError, match=r"count, the calibration gives m/s.*--raw"):
        verify(truth, raw)
    right = applied(truth, raw)
    with pytest.raises(InputError, match="mag is in uT, the calibration takes count"):
        verify(truth, Recording(mag=right.mag), Recording(mag=right.mag))
    with pytest.raises(InputError, match="readings of acc, the calibration is of mag"):
        verify(Calibration(mag=truth.mag), Recording(acc=right.acc))
    assert right.acc is not None
    empty = replace(right.acc, y=np.full_like(right.acc.y, np.nan))
    with pytest.raises(InputError, match="calibrated node"):
        verify(truth, Recording(acc=empty))
    later = Recording(acc=replace(right.acc, t=right.acc.t + 1e4))
    with pytest.raises(DataError, match="0 samples have a raw partner"):
        verify(truth, later, raw)


# --- the verb -----------------------------------------------------------------------------------------


def columns(recording: Recording) -> dict[str, np.ndarray]:
    first = next(iter(recording.streams.values()))
    named_columns = {f"{k}_{a}_{s.unit}": s.y[:, i] for k, s in recording.streams.items() for i, a in enumerate("xyz")}
    return {"t_s": first.t, **named_columns}


def test_the_verb_ends_with_3_where_a_mistake_was_made(node, tmp_path, capsys):
    truth, raw = node.truth, node.recording
    save(truth, tmp_path / "cal.json")
    write_table(tmp_path / "raw.parquet", columns(raw))
    write_table(tmp_path / "right.csv", columns(applied(truth, raw)))
    wrong = applied(truth, raw, "transposed")
    write_table(tmp_path / "wrong.csv", columns(wrong))
    write_table(tmp_path / "both.csv", {**columns(raw), **columns(wrong)})
    cal, right = str(tmp_path / "cal.json"), str(tmp_path / "right.csv")
    assert cli.run(["verify", cal, right]) == 0
    assert cli.run(["verify", cal, right, "--raw", str(tmp_path / "raw.parquet")]) == 0
    assert "right: u = H (y - B)" in capsys.readouterr().out
    assert cli.run(["verify", cal, str(tmp_path / "wrong.csv")]) == 3
    assert "H was transposed" in capsys.readouterr().out
    assert cli.run(["verify", cal, str(tmp_path / "both.csv"), "--json"]) == 3
    found = json.loads(capsys.readouterr().out)
    assert found["how"] == "exact" and found["sensors"]["mag"]["mistakes"] == ["transposed"]
    assert cli.run(["verify", cal, str(tmp_path / "raw.parquet")]) == 1


# --- real ---------------------------------------------------------------------------------------------


def test_real_counts_in_which_a_bias_is_large():
    recording = margcal.read(find_data("imu_tk/xsens_mti_multipose.parquet"))
    calibration = margcal.calibrate(recording)
    assert named(verify(calibration, applied(calibration, recording))) == {}
    for mistake in ("bias-sign", "forward", "post-offset", "unit"):
        wrong = verify(calibration, applied(calibration, recording, mistake))
        assert named(wrong) == {"acc": mistake, "gyr": mistake}
    # no magnetometer, almost no mounting: the rests do not tell a transposed H, and nobody is accused
    transposed = applied(calibration, recording, "transposed")
    assert not verify(calibration, transposed).fails
    assert named(verify(calibration, transposed, recording)) == {"acc": "transposed", "gyr": "transposed"}
