"""`align` end to end: truth in simulation, faults named, BROAD and tyrex, the verb and its file."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from margcal.apps.cli import run as margcal
from margcal.core import so3
from margcal.core.errors import DataError, InputError, UsageError
from margcal.core.types import Calibration, Recording, Reference, Stream
from margcal.files.calfile import load, save
from margcal.files.tables import read, write_table
from margcal.workflow.align import align
from margcal.workflow.align_job import MocapAlignment
from margcal.workflow.mocap_simulation import MocapSimulation, simulate_mocap
from margcal.workflow.place import parse_at

Data = Callable[[str], Path]


@pytest.fixture(scope="module")
def sim() -> MocapSimulation:
    return simulate_mocap(
        seed=1, acceleration_rms=1.5, offset_s=0.137, drift_ppm=50, gaps=3, delays_s={"mag": 0.011, "acc": 0.003}
    )


@pytest.fixture(scope="module")
def forward(sim: MocapSimulation) -> Calibration:
    return align(sim.recording, sim.reference, orientation=False)


@pytest.fixture(scope="module")
def short() -> MocapSimulation:
    """Half a minute, for faults and the verb."""
    return simulate_mocap(seed=1, duration_s=30, acceleration_rms=1.5, offset_s=0.137, drift_ppm=50, gaps=1)


def wrong(found: Calibration, truth: Calibration, kind: str) -> float:
    """Largest relative error of H; a magnetometer's without its scale (the field is not known)."""
    H, true = found.models[kind].H, truth.models[kind].H  # type: ignore[index]
    if kind == "mag":
        H, true = (M / np.cbrt(np.linalg.det(M)) for M in (H, true))
    return float(np.linalg.norm(H @ np.linalg.inv(true) - np.eye(3), 2))


def rotation_deg(found: Calibration, truth: Calibration, name: str) -> float:
    assert found.alignment is not None and truth.alignment is not None
    one, two = (so3.matrix_from_quat(np.array(c.alignment.values[name])) for c in (found, truth))  # type: ignore[union-attr]
    return float(np.degrees(so3.angle_between(one, two)))


def codes(calibration: Calibration, level: str) -> set[str]:
    return {i.code for i in calibration.issues if i.level == level}


def test_forward_against_truth(sim: MocapSimulation, forward: Calibration) -> None:
    found, truth = forward, sim.gyr_symmetric
    assert found.verdict == "pass"
    assert found.frame == "gyr-symmetric"
    assert found.alignment is not None
    values = found.alignment.values
    assert wrong(found, truth, "acc") < 3e-3
    assert wrong(found, truth, "gyr") < 1e-3
    assert wrong(found, truth, "mag") < 1.5e-3
    assert rotation_deg(found, truth, "marker_to_node") < 0.05
    assert rotation_deg(found, truth, "lab_to_earth") < 0.3
    assert values["offset_s"] == pytest.approx(0.137, abs=3e-4)
    assert values["drift_ppm"] == pytest.approx(50, abs=5)
    assert values["lever_arm_m"] == pytest.approx([0.03, -0.02, 0.01], abs=1e-3)
    for kind, delay in (("acc", 0.003), ("mag", 0.011)):
        model = found.models[kind]  # type: ignore[index]
        assert model.delay_se_s is not None and model.delay_se_s < 5e-4
        assert model.delay_s == pytest.approx(delay, abs=4 * model.delay_se_s)
    assert found.models["gyr"].delay_s == 0.0
    H = found.models["gyr"].H
    assert pytest.approx(H.T, rel=1e-9) == H


def test_without_positions_the_low_pass_is_taken(sim: MocapSimulation) -> None:
    found = align(sim.recording, Reference(sim.reference.t, sim.reference.q), orientation=False)
    assert found.settings["method"] == "lowpass-svd"
    assert wrong(found, sim.gyr_symmetric, "acc") < 8e-3
    acc = found.models["acc"]
    assert acc.delay_se_s is not None and acc.delay_se_s < 1e-3
    assert acc.delay_s == pytest.approx(0.003, abs=4 * acc.delay_se_s)
    with pytest.raises(InputError, match="positions"):
        align(sim.recording, Reference(sim.reference.t, sim.reference.q), method="forward")


def test_the_papers_method_is_worse_and_says_so(sim: MocapSimulation) -> None:
    found = align(sim.recording, sim.reference, method="r-bsn", orientation=False)
    assert wrong(found, sim.gyr_symmetric, "acc") > 0.01
    assert wrong(found, sim.gyr_symmetric, "gyr") < 1e-3
    assert "gated" in codes(found, "note")
    assert "linear-acceleration" in codes(found, "warn")
    calm = simulate_mocap(seed=4, duration_s=40)
    assert "linear-acceleration" not in codes(
        align(calm.recording, calm.reference, method="r-bsn", orientation=False), "warn"
    )


def test_trial_at_rest(sim: MocapSimulation) -> None:
    still = simulate_mocap(seed=100, node_seed=1, still=True, duration_s=10)
    found = align(sim.recording, sim.reference, static=still.recording, method="r-bsn", orientation=False)
    assert np.allclose(found.models["gyr"].B, still.recording.streams["gyr"].y.mean(axis=0))
    with pytest.raises(DataError, match="not at rest"):
        align(sim.recording, sim.reference, static=sim.recording)


def test_file_keeps_it_and_apply_takes_it(sim: MocapSimulation, forward: Calibration, tmp_path: Path) -> None:
    found = forward
    save(found, tmp_path / "cal.json")
    again = load(tmp_path / "cal.json")
    assert again.alignment is not None and found.alignment is not None
    assert again.alignment.values["offset_s"] == found.alignment.values["offset_s"]
    assert np.array_equal(again.models["acc"].H, found.models["acc"].H)
    rest = again.apply(sim.recording).streams["mag"].y
    assert np.linalg.norm(rest, axis=1).mean() == pytest.approx(1.0, abs=0.01)


# --- faults, named ------------------------------------------------------------------------------------


def test_conjugated_and_scalar_last_are_refused_by_name(short: MocapSimulation) -> None:
    q = short.reference.q
    with pytest.raises(DataError, match="quaternions are conjugated"):
        align(short.recording, replace(short.reference, q=so3.quat_conjugate(q)))
    with pytest.raises(DataError, match="quaternions are scalar last"):
        align(short.recording, replace(short.reference, q=np.roll(q, -1, axis=1)))


def test_both_errors_together(short: MocapSimulation) -> None:
    """They are a turn of both frames: the positions tell; without them H and B stay right, and it is suspected."""
    q = np.roll(so3.quat_conjugate(short.reference.q), -1, axis=1)
    found = align(short.recording, replace(short.reference, q=q), allow_fail=True, orientation=False)
    assert "reference-convention" in codes(found, "fail")
    found = align(short.recording, Reference(short.reference.t, q), orientation=False)
    assert "reference-order-suspected" in codes(found, "warn")
    assert wrong(found, short.gyr_symmetric, "gyr") < 1e-3


def test_as_printed_is_refused_by_name(short: MocapSimulation) -> None:
    with pytest.raises(DataError, match=r"\(14\) as printed"):
        align(short.recording, short.reference, as_printed=True)
    with pytest.raises(UsageError):
        align(short.recording, short.reference, as_printed=True, method="forward")


def reversed_axis(recording: Recording, *kinds: str) -> Recording:
    signs = np.array([1.0, -1.0, 1.0])
    return replace(recording, **{k: replace(s, y=s.y * signs) for k, s in recording.streams.items() if k in kinds})


def test_mirrored_axes_are_named(short: MocapSimulation) -> None:
    found = align(reversed_axis(short.recording, "gyr"), short.reference, orientation=False)
    issue = next(i for i in found.issues if i.code == "mirrored-axes")
    assert issue.sensor == "gyr" and "with y reversed" in issue.text
    rate = found.apply(reversed_axis(short.recording, "gyr")).streams["gyr"].y
    true = short.gyr_symmetric.apply(short.recording).streams["gyr"].y
    assert np.sqrt(np.mean((rate - true) ** 2)) < 2e-3 * np.sqrt(np.mean(true**2))
    found = align(reversed_axis(short.recording, "acc"), short.reference, orientation=False)
    issue = next(i for i in found.issues if i.code == "mirrored-axes")
    assert issue.sensor == "acc" and "y is its -y" in issue.text


def test_left_handed_laboratory_shows_against_accelerations(short: MocapSimulation) -> None:
    p, signs = short.reference.p, np.array([1.0, 1.0, -1.0])
    assert p is not None
    # z of laboratory and marker body reversed: R' = S R S
    reference = replace(short.reference, q=short.reference.q * np.array([1, -1, -1, 1]), p=p * signs)
    found = align(short.recording, reference, orientation=False)
    issue = next(i for i in found.issues if i.code == "mirrored-axes")
    assert issue.sensor == "acc" and "left-handed" in issue.text


def test_weak_excitation_is_told() -> None:
    weak = simulate_mocap(seed=5, duration_s=40, rotation=0.12)
    for method in ("forward", "r-bsn"):
        found = align(weak.recording, weak.reference, method=method, orientation=False, allow_fail=True)  # type: ignore[arg-type]
        assert "weak-excitation" in codes(found, "warn"), method


def test_static_trial_of_another_node_is_not_taken(short: MocapSimulation) -> None:
    other = simulate_mocap(seed=100, node_seed=7, still=True, duration_s=10)
    found = align(short.recording, short.reference, static=other.recording, sensors=["gyr"], orientation=False)
    assert "static-bias" in codes(found, "warn")
    true = short.truth.models["gyr"]
    assert np.abs(true.H @ (found.models["gyr"].B - true.B)).max() < 1e-3


def test_orientation_errors_are_on_the_references_clock(short: MocapSimulation) -> None:
    later = replace(short.reference, t=short.reference.t + 1000)
    found = align(short.recording, later)
    assert isinstance(found.alignment, MocapAlignment) and found.alignment.figures is not None
    after, t = found.alignment.figures.after, found.alignment.figures.t
    assert after is not None
    assert t[0] <= after.t[0] <= after.t[-1] <= t[-1]


def test_whole_node_mirrored(short: MocapSimulation) -> None:
    """A board with y reversed everywhere: one warning, and every sensor in the same right-handed frame."""
    turned = reversed_axis(short.recording, "acc", "gyr", "mag")
    found = align(turned, short.reference, orientation=False)
    true = short.gyr_symmetric.apply(short.recording).streams
    for kind, stream in found.apply(turned).streams.items():
        scale = 49.1 if kind == "mag" else 1.0
        assert np.sqrt(np.mean((scale * stream.y - true[kind].y) ** 2)) < 0.02 * np.sqrt(np.mean(true[kind].y ** 2))


def test_place_settles_the_magnetometers_sign(short: MocapSimulation) -> None:
    place = parse_at("60.0,10.0,2026-06-01")
    turned = reversed_axis(short.recording, "mag")
    found = align(turned, short.reference, place=place, orientation=False)
    assert np.linalg.det(found.models["mag"].H) < 0
    assert any(i.code == "mirrored-axes" and i.sensor == "mag" for i in found.issues)


def test_clock_that_is_not_common_is_named(short: MocapSimulation) -> None:
    later = replace(short.reference, t=short.reference.t + 7)
    with pytest.raises(DataError, match=r"not on one clock.* 7\.14 s"):
        align(short.recording, later, common_clock=True)


def test_no_rotation_is_refused() -> None:
    moved = simulate_mocap(seed=2, acceleration_rms=1.5, rotation=0.0)
    with pytest.raises(DataError, match="correlate"):
        align(moved.recording, moved.reference)


def test_wrong_unit_is_warned_of(sim: MocapSimulation) -> None:
    """No answer with |K - I| > 30 % without a warning."""
    nominal = simulate_mocap(seed=3, duration_s=30, unit="si")
    acc = nominal.recording.streams["acc"]
    odd = replace(nominal.recording, acc=Stream("acc", acc.t, acc.y * 1.4, "mps2"))
    found = align(odd, nominal.reference, orientation=False)
    assert "gain" in codes(found, "warn")


# --- real recordings --------------------------------------------------------------------------------


def broad(data_file: Data, name: str, first_s: float = np.inf) -> Calibration:
    """The node at half its rate, every sample the mean of two."""
    recording = read(data_file(f"broad/{name}.parquet"))
    streams = {}
    for kind, s in recording.streams.items():
        n = 2 * (np.count_nonzero(s.t < first_s) // 2)
        streams[kind] = replace(s, t=s.t[:n].reshape(-1, 2).mean(axis=1), y=s.y[:n].reshape(-1, 2, 3).mean(axis=1))
    r = recording.reference
    assert r is not None and r.p is not None
    seen = r.t < first_s
    return align(replace(recording, **streams, reference=Reference(r.t[seen], r.q[seen], r.p[seen])))


def test_broad_is_near_the_identity(data_file: Data) -> None:
    """Factory calibrated: the identity is the right answer. All trials: benchmarks/studies/mocap.py."""
    found = broad(data_file, "21_undisturbed_fast_combined")
    assert found.verdict == "pass"
    assert np.abs(found.models["acc"].H - np.eye(3)).max() < 0.01
    assert np.abs(found.models["gyr"].H - np.eye(3)).max() < 7e-3
    mag = found.models["mag"]
    soft = so3.polar(mag.H / np.cbrt(np.linalg.det(mag.H)))[1]
    assert np.abs(soft - np.eye(3)).max() < 0.02
    assert np.abs(mag.B).max() < 2.0
    assert found.alignment is not None
    turned = np.degrees(so3.quat_log(np.array(found.alignment.values["marker_to_node"])))
    assert 0.1 < np.linalg.norm(turned) < 0.45
    gyr_delay = found.models["gyr"].delay_s
    assert gyr_delay == pytest.approx(0.0042, abs=3e-4)
    assert mag.delay_s is not None and gyr_delay is not None
    assert mag.delay_s - gyr_delay == pytest.approx(0.0107, abs=0.0015)
    assert mag.delay_se_s is not None and mag.delay_se_s < 1e-3
    assert isinstance(found.alignment, MocapAlignment) and found.alignment.figures is not None
    before, after = found.alignment.figures.before, found.alignment.figures.after
    assert before is not None and after is not None
    assert after.total < before.total


def test_broad_without_rotation_is_refused_or_widened(data_file: Data) -> None:
    found = broad(data_file, "12_undisturbed_slow_translation_C", 60.0)
    assert set(found.models) == {"gyr"}
    assert "poor-excitation" in codes(found, "fail")
    error = found.models["gyr"].expected_error_deg
    assert error is not None
    assert np.radians(error) > 0.5 * np.abs(found.models["gyr"].H - np.eye(3)).max()


def test_tyrex_hard_iron_and_marker(data_file: Data) -> None:
    for name in ("Jakob_Nexus5_NoDist_AR", "Thibaud_Nexus5_NoDist_AR"):
        recording = read(data_file(f"tyrex/{name}"))
        found = align(recording, recording.reference, common_clock=False, orientation=False)
        assert np.allclose(found.models["mag"].B, [58.1, -73.5, 411.6], atol=2.0)
        assert found.alignment is not None
        turned = -np.degrees(so3.quat_log(np.array(found.alignment.values["marker_to_node"])))
        assert turned == pytest.approx([-1.0, 1.1, -0.2], abs=0.3)
        assert -0.03 < found.alignment.values["offset_s"] < -0.01


# --- the verb -----------------------------------------------------------------------------------------


def written(sim: MocapSimulation, folder: Path) -> tuple[str, str]:
    """Recording and reference as two tables."""
    node, optics = folder / "node.parquet", folder / "optics.csv"
    columns = {"t_s": sim.recording.streams["gyr"].t}
    for kind, stream in sim.recording.streams.items():
        columns |= {f"{kind}_{axis}_{stream.unit}": stream.y[:, k] for k, axis in enumerate("xyz")}
    write_table(node, columns)
    r = sim.reference
    p = np.zeros((len(r.t), 3)) if r.p is None else r.p
    rows = np.column_stack([r.t, r.q, p])
    header = "t_s,ref_qw,ref_qx,ref_qy,ref_qz,ref_p_x_m,ref_p_y_m,ref_p_z_m"
    text = "\n".join(",".join("" if np.isnan(v) else f"{v:.9g}" for v in row) for row in rows)
    optics.write_text(f"{header}\n{text}\n")
    return str(node), str(optics)


def test_verb(short: MocapSimulation, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    node, optics = written(short, tmp_path)
    cal, report = str(tmp_path / "cal.json"), str(tmp_path / "report.html")
    assert margcal(["align", node, "--reference", optics, "-o", cal, "--report", report, "--device", "hip"]) == 0
    assert "clock offset" in capsys.readouterr().out
    content = json.loads(Path(cal).read_text())
    assert content["alignment"]["offset_s"] == pytest.approx(0.137, abs=5e-4)
    assert {f["name"] for f in content["source"]["files"]} == {"node.parquet", "optics.csv"}
    assert margcal(["apply", cal, node, "-o", str(tmp_path / "out.csv")]) == 0
    assert margcal(["align", node, "--reference", optics, "-o", cal]) == 1  # exists
    capsys.readouterr()
    assert margcal(["align", node, "--reference", optics, "--json", "--method", "lowpass-svd"]) == 0
    assert json.loads(capsys.readouterr().out)["source"]["settings"]["method"] == "lowpass-svd"


def test_verb_refuses_with_reasons(short: MocapSimulation, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    node, optics = written(short, tmp_path)
    cal = str(tmp_path / "cal.json")
    assert margcal(["align", node, "--reference", optics, "--as-printed", "-o", cal]) == 3
    assert not Path(cal).exists()
    assert "as printed" in capsys.readouterr().err
    assert margcal(["align", node, "--reference", node, "-o", cal]) == 1
    assert "no reference" in capsys.readouterr().err


# --- without optics -------------------------------------------------------------------------------------


def test_calibrate_keeps_the_magnetometers_delay() -> None:
    """A session of rests and turns whose magnetometer is 11 ms late: the file says so, and `apply` takes it out."""
    from margcal.workflow.calibrate import calibrate
    from margcal.workflow.simulate import simulate

    made = simulate(seed=1).recording
    mag = made.streams["mag"]
    on_time = calibrate(made).models["mag"]
    late = calibrate(replace(made, mag=replace(mag, t=mag.t + 0.011))).models["mag"]
    assert on_time.delay_s is None
    assert late.delay_s == pytest.approx(0.011, abs=4 * (late.delay_se_s or 0))
