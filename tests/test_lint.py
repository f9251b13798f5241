"""`lint`: every finding is there when the data are damaged so, and silent when they are not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from margcal.core.types import Array, Issue, Kind, Recording, Stream
from margcal.core.units import UNITS
from margcal.files.tables import read
from margcal.workflow.lint import clip_limits, clipped, lint
from margcal.workflow.lint_clock import clock_of
from margcal.workflow.lint_units import sphere_of, turn_ratio
from margcal.workflow.simulate import simulate, swing

KINDS: tuple[Kind, ...] = ("acc", "gyr", "mag")


@cache
def session(**options: Any) -> Recording:
    return simulate(**{"seed": 1, "n_poses": 12, "rest_s": 3.0, **options}).recording


@cache
def physical() -> Recording:
    """A raw recording in physical units: datasheet scale factors, the node's own errors left in."""
    made = simulate(seed=1, n_poses=12, rest_s=3.0)
    streams = {}
    for kind, unit in (("acc", "mps2"), ("gyr", "radps"), ("mag", "uT")):
        stream = made.recording.streams[kind]  # type: ignore[index]
        scale = np.cbrt(np.linalg.det(made.truth.models[kind].H))  # type: ignore[index]
        streams[kind] = replace(stream, y=stream.y * scale, unit=unit)
    return replace(made.recording, **streams)


def damaged(recording: Recording, kind: Kind, change: Callable[[Array], Any]) -> Recording:
    stream = recording.streams[kind]
    y = np.array(stream.y)
    result = change(y)
    return replace(recording, **{kind: replace(stream, y=y if result is None else result)})


def found(recording: Recording, code: str) -> Issue:
    issues = [i for i in lint(recording) if i.code == code]
    assert len(issues) == 1, [i.code for i in lint(recording)]
    assert issues[0].text.startswith(recording.source)
    return issues[0]


def codes(recording: Recording) -> set[str]:
    return {i.code for i in lint(recording)}


# --- nothing wrong -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"poses": "free"},
        {"knocks": 6},
        {"noise": 10.0},
        {"noise": 0.0, "quantise": False},
        {"separate_clocks": True},
        {"mag_axes": "board"},
        {"turn_s": 0.5},
        {"rate": 400.0, "n_poses": 4},
        {"temperature_degC": 21.0},
        {"disturbed": 3, "disturbance": 0.5},
    ],
    ids=str,
)
@pytest.mark.parametrize("seed", range(3))
def test_a_sound_session_is_silent(options: dict[str, Any], seed: int) -> None:
    assert lint(session(**{**options, "seed": seed})) == ()


@pytest.mark.parametrize("seed", range(4))
def test_a_swing_is_silent(seed: int) -> None:
    assert lint(swing(seed=seed, duration_s=40).recording) == ()


def test_physical_units_that_are_right_are_silent() -> None:
    assert lint(physical()) == ()


def test_what_apply_made_is_called_calibrated_and_nothing_worse() -> None:
    made = simulate(seed=1, n_poses=24, rest_s=3.0)
    issues = lint(made.truth.apply(made.recording))
    assert {(i.code, i.level, i.sensor) for i in issues} == {
        ("looks-calibrated", "note", "acc"),
        ("looks-calibrated", "note", "mag"),
    }


# --- missing, stuck, frozen --------------------------------------------------------------------------


@pytest.mark.parametrize(("share", "level"), [(0.004, "warn"), (0.03, "warn"), (0.08, "fail")])
def test_missing_readings_of_arrays(share: float, level: str) -> None:
    def drop(y: Array) -> None:
        y[np.random.default_rng(0).random(len(y)) < share, 1] = np.nan

    issue = found(damaged(session(), "mag", drop), "nan-rows")
    assert (issue.level, issue.sensor) == (level, "mag")
    assert issue.value == pytest.approx(share, rel=0.3)


def test_infinite_readings_of_a_hand_made_stream() -> None:
    def blow(y: Array) -> None:
        y[77, 2] = np.inf

    issue = found(damaged(session(), "acc", blow), "infinite")
    assert issue.level == "fail" and "sample 78" in issue.text


def test_a_stuck_axis_is_named() -> None:
    def stick(y: Array) -> None:
        y[:, 1] = -7.0

    issue = found(damaged(session(), "gyr", stick), "stuck-axis")
    assert (issue.level, issue.sensor) == ("fail", "gyr")
    assert "y shows the same value" in issue.text


def test_a_sensor_that_was_never_read() -> None:
    issue = found(damaged(session(), "acc", lambda y: np.full_like(y, 3.0)), "stuck-sensor")
    assert (issue.level, issue.sensor) == ("fail", "acc")


def test_a_channel_that_was_written_twice() -> None:
    issue = found(damaged(session(), "mag", lambda y: y[:, [0, 1, 0]]), "same-axes")
    assert (issue.level, issue.sensor) == ("fail", "mag") and "x and z" in issue.text


def test_a_sensor_that_was_written_twice() -> None:
    acc = session().streams["acc"]
    issue = found(replace(session(), mag=replace(acc, kind="mag")), "same-readings")
    assert (issue.level, issue.sensor) == ("fail", "mag")


def test_readings_of_no_converter() -> None:
    issue = found(damaged(session(), "gyr", lambda y: 1e300 * y), "too-large")
    assert (issue.level, issue.sensor) == ("fail", "gyr")


@pytest.mark.parametrize(("seconds", "level"), [(1.0, "warn"), (20.0, "fail")])
def test_an_axis_that_sticks_for_a_while(seconds: float, level: str) -> None:
    def stick(y: Array) -> None:
        y[500 : 500 + int(100 * seconds), 0] = y[500, 0]

    issue = found(damaged(session(), "acc", stick), "stuck-stretch")
    assert (issue.level, issue.sensor) == (level, "acc")
    assert "x shows" in issue.text and "t = 5" in issue.text


@pytest.mark.parametrize("start", [120, 330], ids=["rest", "turn"])
def test_a_link_that_hung(start: int) -> None:
    def hang(y: Array) -> None:
        y[start : start + 60] = y[start]

    issue = found(damaged(session(), "gyr", hang), "frozen-samples")
    assert issue.level == "warn" and "0.59 s" in issue.text
    assert issue.value == pytest.approx(59 / len(session().streams["gyr"].t))


# --- saturation and quantisation ---------------------------------------------------------------------


def test_saturation_below_a_permille_is_left_out() -> None:
    def clip(y: Array) -> None:
        y[330:337, 0] = [9e3, 15e3, 20e3, 20e3, 20e3, 14e3, 8e3]  # 3 of 5300 samples

    recording = damaged(session(), "gyr", clip)
    issue = found(recording, "saturated")
    assert issue.level == "warn" and issue.value is not None and issue.value < 1e-3
    high = clip_limits(recording.streams["gyr"])[1]
    assert high[0] == 20e3 and np.isinf(high[1:]).all()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("axis", range(3))
def test_saturation_above_a_permille_fails(kind: Kind, axis: int) -> None:
    """Four fifths of the range: in rests (accelerometer, magnetometer) and in turns (gyroscope)."""
    edge = 0.8 * session().streams[kind].y.max(axis=0)[axis]

    def clip(y: Array) -> None:
        y[:, axis] = np.minimum(y[:, axis], edge)

    issue = found(damaged(session(), kind, clip), "saturated")
    assert (issue.level, issue.sensor) == ("fail", kind)
    assert f"{'xyz'[axis]} at the end" in issue.text and "record again" in issue.text


def test_the_ends_of_sixteen_bits_are_not_trusted() -> None:
    def stretch(y: Array) -> None:
        y[200:203, 2] = [32600, 32767, 32500]

    recording = damaged(session(), "gyr", stretch)
    assert found(recording, "saturated").level == "warn"
    stream = recording.streams["gyr"]
    assert np.flatnonzero(clipped(stream.y, stream)).tolist() == [200, 201]


def test_held_samples_do_not_saturate() -> None:
    """A stream that was filled up to four times its rate repeats its peaks, and does not clip."""
    recording = session(rate=50.0)
    for kind, stream in recording.streams.items():
        held = Stream(kind, np.arange(4 * len(stream.t)) / 200.0, np.repeat(stream.y, 4, axis=0), stream.unit)
        assert np.isinf(clip_limits(held)).all()


def test_given_limits_spare_the_search() -> None:
    stream = session().streams["gyr"]
    limits = np.full(3, -np.inf), np.array([100.0, np.inf, np.inf])
    assert np.array_equal(clipped(stream.y, stream, limits), stream.y[:, 0] >= 100)


def test_steps_coarser_than_the_noise() -> None:
    issue = found(damaged(session(), "mag", lambda y: 50 * np.round(y / 50)), "coarse-quantisation")
    assert (issue.level, issue.sensor) == ("warn", "mag")
    assert "50 count" in issue.text and "14 count" in issue.text  # 50 / sqrt(12)


# --- clocks ------------------------------------------------------------------------------------------


def without(recording: Recording, keep: NDArray[np.bool_]) -> Recording:
    return replace(recording, **{k: replace(s, t=s.t[keep], y=s.y[keep]) for k, s in recording.streams.items()})


def test_a_gap_is_told_once_for_a_shared_clock() -> None:
    t = session().streams["acc"].t
    issue = found(without(session(), (t < 10) | (t > 12)), "gaps")
    assert issue.level == "warn" and "at t = 9.99" in issue.text
    assert issue.value == pytest.approx(202, abs=1)


def test_five_periods_are_no_gap_and_six_are() -> None:
    n = len(session().streams["acc"].t)
    keep = np.ones(n, dtype=bool)
    keep[100:104] = False  # a step of five periods
    assert lint(without(session(), keep)) == ()
    keep[104] = False
    assert codes(without(session(), keep)) == {"gaps"}


def bursts(t: Array, size: int) -> Array:
    """Times stamped by a host that reads `size` samples at once."""
    number = np.arange(len(t))
    last = np.minimum((number // size + 1) * size - 1, len(t) - 1)
    return t[last] + 2e-4 * (number % size)


def test_bursts_are_no_gaps() -> None:
    recording = session()
    t = bursts(recording.streams["acc"].t, 8)
    late = replace(recording, **{k: replace(s, t=t) for k, s in recording.streams.items()})
    issue = found(late, "bursty-clock")
    assert codes(late) == {"bursty-clock"} and "100" in issue.text
    clock = clock_of(t)
    assert not clock.regular and clock.period == pytest.approx(0.01, rel=0.01)


def test_a_rate_that_changes() -> None:
    t = np.array(session().streams["acc"].t)
    t[2000:] = t[2000] + 1.5 * (t[2000:] - t[2000])
    late = replace(session(), **{k: replace(s, t=t) for k, s in session().streams.items()})
    assert found(late, "rate-changes").value == pytest.approx(0.5, rel=0.01)


def test_tables_that_share_no_time() -> None:
    mag = session().streams["mag"]
    apart = replace(session(), mag=replace(mag, t=mag.t + 1e4))
    issue = found(apart, "no-overlap")
    assert (issue.level, issue.sensor) == ("fail", None) and "origin" in issue.text
    half = replace(session(), mag=replace(mag, t=mag.t + 0.5 * mag.t[-1]))
    assert {i.level for i in lint(half) if i.code == "little-overlap"} == {"warn"}


def test_a_rate_too_slow_for_turns() -> None:
    recording = session(rate=8.0)
    assert {i.sensor for i in lint(recording) if i.code == "slow-rate"} == {"acc", "gyr"}


def test_temperature() -> None:
    t = session().streams["acc"].t
    warm = replace(session(), temperature=(t, np.linspace(10, 25, len(t))))
    assert found(warm, "temperature-span").value == pytest.approx(14.85, abs=0.01)
    assert lint(replace(session(), temperature=(t, np.linspace(10, 19.9, len(t))))) == ()


# --- units -------------------------------------------------------------------------------------------


def relabelled(kind: Kind, true_unit: str, label: str) -> Recording:
    """Readings in `true_unit` under the name of another unit."""
    factor = UNITS[kind][true_unit]
    assert factor is not None

    def convert(y: Array) -> Array:
        return y / factor

    recording = damaged(physical(), kind, convert)
    return replace(recording, **{kind: replace(recording.streams[kind], unit=label)})


@pytest.mark.parametrize(
    ("kind", "true_unit", "label"),
    [(k, t, u) for k in KINDS for t in UNITS[k] for u in UNITS[k] if UNITS[k][t] and UNITS[k][u] and t != u],
)
def test_every_confusion_of_units_is_told_with_the_mend(kind: Kind, true_unit: str, label: str) -> None:
    issue = found(relabelled(kind, true_unit, label), f"{kind}-unit")
    assert (issue.level, issue.sensor) == ("fail", None)
    assert f"--units {kind}={true_unit}" in issue.text


@pytest.mark.parametrize("kind", KINDS)
def test_right_labels_are_silent(kind: Kind) -> None:
    for unit, factor in UNITS[kind].items():
        if factor is not None:
            assert lint(relabelled(kind, unit, unit)) == ()


@pytest.mark.parametrize("label", ["mps2", "g"])
def test_counts_that_are_called_physical(label: str) -> None:
    recording = replace(session(), acc=replace(session().streams["acc"], unit=label))
    assert "--units acc=count" in found(recording, "acc-unit").text


def test_gyroscope_counts_that_are_called_physical() -> None:
    recording = replace(session(), gyr=replace(session().streams["gyr"], unit="radps"))
    assert found(recording, "gyr-unit").level == "fail"


@pytest.mark.parametrize("bias", [(0.8, 0.5, -0.4), (-1.0, 0.0, 0.0)])
def test_bias_of_a_raw_accelerometer_is_normal(bias: tuple[float, ...]) -> None:
    assert lint(damaged(physical(), "acc", lambda y: y + np.array(bias))) == ()


def test_hard_iron_of_a_phone_is_normal() -> None:
    assert lint(damaged(physical(), "mag", lambda y: y + np.array([58.0, -73.0, 412.0]))) == ()


def test_gravity_that_was_taken_out() -> None:
    def linear(y: Array) -> Array:
        return np.random.default_rng(0).normal(0, 0.05, y.shape)

    issue = found(damaged(physical(), "acc", linear), "no-gravity")
    assert (issue.level, issue.sensor) == ("fail", "acc")


def test_a_wrong_full_scale_is_doubtful() -> None:
    issue = found(damaged(physical(), "acc", lambda y: 2 * y), "acc-magnitude")
    assert issue.level == "warn" and issue.value == pytest.approx(2.0, rel=0.05)


def test_a_strong_magnet_is_told() -> None:
    issue = found(damaged(physical(), "mag", lambda y: 4 * y), "mag-magnitude")
    assert issue.level == "warn" and "magnet" in issue.text


def test_slow_turns_tell_degrees_from_radians() -> None:
    """Nobody turns at 35 rad/s: gravity that turns along says that the numbers are degrees."""
    recording = relabelled("gyr", "dps", "radps")
    rms = np.sqrt(np.mean(np.sum(recording.streams["gyr"].y ** 2, axis=1)))
    slow = damaged(recording, "gyr", lambda y: y)
    assert "dps" in found(slow, "gyr-unit").text
    acc, gyr = physical().streams["acc"], physical().streams["gyr"]
    ratio = turn_ratio(acc, gyr)
    assert ratio is not None and 0.7 < ratio < 1.4
    without_acc = replace(recording, acc=None)
    assert ("gyr-unit" in codes(without_acc)) == (rms > 35)


def test_without_motion_nothing_is_said_about_the_gyroscope() -> None:
    still = simulate(seed=1, n_poses=1, rest_s=20.0).recording
    assert turn_ratio(replace(still.streams["acc"], unit="g"), replace(still.streams["gyr"], unit="radps")) is None


def test_the_sphere_is_exact_without_noise() -> None:
    rng = np.random.default_rng(3)
    u = rng.normal(size=(500, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    sphere = sphere_of(np.array([400.0, -70.0, 5.0]) + 48.0 * u)
    assert sphere is not None
    assert sphere.centre == pytest.approx([400, -70, 5], abs=1e-9)
    assert sphere.radius == pytest.approx(48, abs=1e-9)


def test_the_standard_error_of_the_radius_is_that_of_the_scatter() -> None:
    """A cap of 40 degrees, noise of one sample in ten independent: error over standard error has unit spread."""
    rng = np.random.default_rng(4)
    normal = []
    for _ in range(200):
        z = rng.uniform(np.cos(np.radians(40)), 1, 200)
        phi = rng.uniform(0, 2 * np.pi, 200)
        u = np.column_stack([np.sqrt(1 - z**2) * np.cos(phi), np.sqrt(1 - z**2) * np.sin(phi), z])
        sphere = sphere_of(np.repeat(50 * u + rng.normal(0, 0.2, u.shape), 10, axis=0))
        assert sphere is not None
        normal.append((sphere.radius - 50) / sphere.radius_se)
    assert 0.6 < np.std(normal) < 1.4


def test_a_reader_of_nan_rows_is_not_repeated(tmp_path: Path) -> None:
    stream = session().streams["acc"]
    lines = ["t_s,acc_x_count,acc_y_count,acc_z_count"]
    lines += [f"{t:.3f},{y[0]:.0f},{y[1]:.0f},{y[2]:.0f}" for t, y in zip(stream.t[:1000], stream.y)]
    lines[400], lines[401] = "3.990,,,", "4.000,,,"
    path = tmp_path / "holes.csv"
    path.write_text("\n".join(lines) + "\n")
    recording = read(path)
    assert [i.code for i in recording.issues] == ["nan-rows"]
    assert lint(recording) == ()


# --- real recordings ---------------------------------------------------------------------------------

EXPECTED: dict[str, set[tuple[str, str, str | None]]] = {
    "broad/05_undisturbed_slow_rotation_with_breaks_B.parquet": {("note", "looks-calibrated", "mag")},
    "broad/08_undisturbed_fast_rotation_with_breaks_A.parquet": {("note", "looks-calibrated", "mag")},
    "broad/12_undisturbed_slow_translation_C.parquet": set(),
    "broad/29_disturbed_stationary_magnet_B.parquet": set(),
    "broad/33_disturbed_attached_magnet_2cm.parquet": set(),
    "gaitmap/left_sensor.parquet": set(),
    "imu_tk/xsens_mti_multipose.parquet": {("warn", "saturated", "gyr")},  # 30 samples near 65535, see the README
    "imucal/ferraris_session.parquet": set(),
    "maglogs/mpu6050_tomisuarez2_multipose.parquet": {("fail", "saturated", "gyr")},  # runs at -32768
    "maglogs/qmc5883l_tomisuarez2.parquet": set(),
    "mikoff/mpu9150_imu0.parquet": set(),
    "mikoff/mpu9150_imu1.parquet": set(),
    "mikoff/mpu9150_imu2.parquet": set(),
    # x at +-250 deg/s in runs of 9 to 13; samples stamped by the computer
    "sunsided/set-2_full-sphere": {
        ("fail", "saturated", "gyr"),
        ("warn", "bursty-clock", "acc"),
        ("warn", "bursty-clock", "mag"),
    },
    "tyrex/Jakob_Nexus5_NoDist_AR": set(),
    "tyrex/Thibaud_Nexus5_NoDist_Swinging": set(),
    # the field runs from 14 to 264 uT once the known hard iron is taken off: something magnetic was near
    "tyrex/calib_acc_Nexus5_d1": {("warn", "mag-magnitude", "mag")},
    # x repeats one value for the first 169 samples
    "tyrex/calib_gyr_Nexus5_d1": {("warn", "stuck-stretch", "acc")},
    "tyrex/calib_mag_Nexus5_d1": set(),
    "tyrex/calib_mag_iPhone4S_d2": set(),
}


@pytest.mark.parametrize("name", EXPECTED)
def test_real_recordings(name: str, data_file: Callable[[str], Path]) -> None:
    issues = lint(read(data_file(name)))
    assert {(i.level, i.code, i.sensor) for i in issues} == EXPECTED[name]


def test_a_tag_in_the_sea(data_file: Callable[[str], Path]) -> None:
    issues = lint(read(data_file("cats_temperature/period_x_10s_median.parquet"), rate=0.1))
    assert {i.code for i in issues} == {"temperature-span", "slow-rate"}
