"""Rests, turns and noise floor against simulated truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from margcal.core import so3
from margcal.core.errors import UsageError
from margcal.core.types import Recording, Stream
from margcal.workflow.segment import drop_poses, find_poses, measure_spans, noise_floor
from margcal.workflow.simulate import Simulation, simulate, swing
from margcal.workflow.simulated_node import NOISE

EDGE_S = 0.15


def found(simulation: Simulation, *more: Recording):
    return find_poses(simulation.recording, *more)


def assert_all_found(simulation: Simulation, segmentation, edge: float = EDGE_S) -> None:
    poses = segmentation.poses
    assert len(poses) == len(simulation.start)
    assert np.abs(poses.start - simulation.start).max() < edge
    assert np.abs(poses.stop - simulation.stop).max() < edge


def on_table(seconds: float, rate: float = 100.0, seed: int = 0, **sensors: float) -> Recording:
    """Sensors that lie still: white noise of the given sd about a mean, in counts."""
    rng = np.random.default_rng(seed)
    t = np.arange(int(seconds * rate)) / rate
    streams = {}
    for kind, sd in (sensors or {"acc": 4.0, "gyr": 2.0}).items():
        mean = {"acc": [100.0, -50, 2048], "gyr": [5.0, -7, 3], "mag": [200.0, 90, -300]}[kind]
        streams[kind] = Stream(kind, t, np.array(mean) + sd * rng.normal(size=(len(t), 3)), "count")
    return Recording(**streams)


# --- rests -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("poses", ["cube", "free", "faces"])
@pytest.mark.parametrize("seed", [0, 1])
def test_every_rest_is_found_where_it_was(poses, seed):
    sim = simulate(seed=seed, poses=poses, n_poses=12, rest_s=2.5)
    segmentation = found(sim)
    assert_all_found(sim, segmentation)
    assert segmentation.poses.knocks.sum() == 0
    assert segmentation.poses.recording == (0,) * 12
    assert not [i for i in segmentation.issues if i.level != "note"]


@pytest.mark.parametrize("rate", [50.0, 100.0, 400.0])
def test_rests_are_found_at_any_rate(rate):
    sim = simulate(seed=3, rate=rate, n_poses=8, rest_s=2.0)
    segmentation = found(sim)
    assert_all_found(sim, segmentation, EDGE_S + 2 / rate)
    expected = (segmentation.poses.stop - segmentation.poses.start) * rate
    assert segmentation.poses.count["acc"] == pytest.approx(expected, abs=2)


@pytest.mark.parametrize("rest_s", [1.3, 1.6])
def test_rests_of_little_more_than_a_second_count(rest_s):
    sim = simulate(seed=2, n_poses=14, rest_s=rest_s, turn_s=1.0)
    assert_all_found(sim, found(sim))


def test_sensors_on_separate_clocks():
    sim = simulate(seed=4, n_poses=10, rest_s=2.5, separate_clocks=True)
    segmentation = found(sim)
    assert_all_found(sim, segmentation)
    poses = segmentation.poses
    length = poses.stop - poses.start
    for kind, rate in (("acc", 100.0), ("gyr", 137.0), ("mag", 50.0)):
        assert poses.count[kind] == pytest.approx(length * rate, abs=2)
    assert all(np.all(np.diff(t.t) == pytest.approx(1 / 137, rel=1e-3)) for t in segmentation.turns)


@pytest.mark.parametrize("sensors", [("acc",), ("gyr",), ("acc", "gyr"), ("acc", "mag")])
def test_any_sensor_that_feels_motion_will_do(sensors):
    sim = simulate(seed=5, poses="free", n_poses=10, rest_s=2.5, sensors=sensors)
    segmentation = found(sim)
    assert_all_found(sim, segmentation, 0.25)
    assert set(segmentation.poses.mean) == set(sensors)
    assert len(segmentation.turns) == (9 if "gyr" in sensors else 0)


@pytest.mark.parametrize("seed", range(4))
def test_magnetometer_alone_never_pools_two_attitudes(seed):
    """A turn about the field is slow to a magnetometer; what it cannot split it must not call one rest."""
    sim = simulate(seed=seed, poses="free", sensors=("mag",))
    poses = found(sim).poses
    assert len(poses) >= 18
    inside = (sim.start[None] + 0.5 < poses.stop[:, None]) & (sim.stop[None] - 0.5 > poses.start[:, None])
    assert np.all(inside.sum(axis=1) == 1)


def test_a_recording_at_rest_is_one_rest():
    segmentation = find_poses(on_table(20.0))
    assert len(segmentation.poses) == 1
    assert segmentation.poses.start[0] < EDGE_S
    assert segmentation.poses.stop[0] > 20 - EDGE_S
    assert segmentation.turns == ()


@pytest.mark.parametrize("seed", range(3))
def test_a_swing_has_no_rests(seed):
    assert len(found(swing(seed=seed, duration_s=40)).poses) == 0


def test_no_rest_is_invented_in_noise_alone_between_motions():
    """Motion throughout but for one rest of half a second: too short."""
    sim = simulate(seed=6, n_poses=8, rest_s=0.5, turn_s=2.0)
    assert len(found(sim).poses) == 0


def test_mean_and_scatter_are_those_of_the_sensor():
    sim = simulate(seed=7, n_poses=8, rest_s=4.0, quantise=False)
    poses = found(sim).poses
    up = sim.truth.models["acc"].reference_vector
    for kind in ("acc", "mag"):
        model = sim.truth.models[kind]
        true = model.invert(np.einsum("jba,b->ja", sim.R_nh, up if kind == "acc" else model.reference_vector))
        se = NOISE[kind] / np.sqrt(poses.count[kind])[:, None]
        assert np.abs((poses.mean[kind] - true) / se).max() < 5
        assert poses.sd[kind] == pytest.approx(np.full((8, 3), NOISE[kind]), rel=0.2)
    assert np.abs((poses.mean["gyr"] - sim.truth.models["gyr"].B) / (NOISE["gyr"] / 19)).max() < 6


# --- knocks, hands, drift ----------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_a_knock_is_cut_out_without_splitting_the_rest(seed):
    sim = simulate(seed=seed, knocks=3, n_poses=10)
    segmentation = found(sim)
    assert_all_found(sim, segmentation)
    poses = segmentation.poses
    hit = np.array([np.sum((sim.knocks[:, 0] > a) & (sim.knocks[:, 1] < b)) for a, b in zip(sim.start, sim.stop)])
    assert np.array_equal(poses.knocks > 0, hit > 0)
    # what was knocked is in no mean: fewer samples count than lie between the rest's ends
    lost = (poses.stop - poses.start) * 100 - poses.count["acc"]
    assert np.all(lost[hit > 0] > 10)
    assert np.all(lost[hit == 0] < 3)
    assert poses.sd["acc"].max() < 1.3 * NOISE["acc"]
    note = next(i for i in segmentation.issues if i.code == "knocked-rest")
    assert note.level == "note"
    assert all(str(j + 1) in note.text for j in np.flatnonzero(hit))


def test_two_short_rests_in_one_attitude_are_not_one_long_motion():
    """A node lifted, turned to and fro and put back: the pause between two rests is no knock."""
    sim = simulate(seed=8, n_poses=6, rest_s=3.0, turn_s=3.0)
    assert_all_found(sim, found(sim))


def held(sim: Simulation, factor: float) -> Recording:
    """The same rests in a hand: tremor of `factor` times the noise at each rest, as slow as a hand's (2-8 Hz)."""
    rng = np.random.default_rng(1)
    streams = {}
    for kind in ("acc", "gyr"):
        s = sim.recording.streams[kind]
        tremor = np.zeros_like(s.y)
        for hz in rng.uniform(2, 8, 12):
            tremor += np.sin(2 * np.pi * (hz * s.t[:, None] + rng.uniform(0, 1, 3))) * rng.normal(size=3)
        tremor *= factor * NOISE[kind] / np.sqrt(np.mean(tremor**2))
        still = np.ones(len(s.t)) if kind == "acc" else np.full(len(s.t), 1.0)
        still[s.t < sim.stop[0]] = 0  # on a table at first: the noise floor is the sensor's
        streams[kind] = replace(s, y=s.y + still[:, None] * tremor)
    return replace(sim.recording, mag=None, **streams)


def test_rests_in_a_hand_are_found_and_said_to_be():
    sim = simulate(seed=9, poses="free", n_poses=10, rest_s=4.0)
    segmentation = find_poses(held(sim, 7.0))
    assert len(segmentation.poses) == 10
    assert np.abs(segmentation.poses.start - sim.start).max() < 0.3
    assert [i.level for i in segmentation.issues if i.code == "held-rests"] == ["note"]
    assert not [i for i in found(sim).issues if i.code == "held-rests"]


def test_a_slow_turn_is_not_a_rest():
    recording = on_table(30.0)
    t = recording.acc.t
    tilt = np.radians(3.0) * np.clip(t - 10, 0, 10)  # 3 degrees a second for ten seconds
    g = 209.0 * 9.80665
    drift = g * np.column_stack([np.sin(tilt), 0 * tilt, np.cos(tilt) - 1])
    still = replace(recording, acc=replace(recording.acc, y=recording.acc.y + drift))
    # without a gyroscope nothing but the slow change of gravity tells
    poses = find_poses(replace(still, gyr=None)).poses
    assert not np.any((poses.start < 18) & (poses.stop > 12))


# --- turns -------------------------------------------------------------------------------------------


def test_turns_hold_all_that_was_turned():
    sim = simulate(seed=10, n_poses=10, rest_s=2.0, noise=0.0, quantise=False)
    # a noise of its own so that there is a floor
    rng = np.random.default_rng(0)
    gyr = sim.recording.gyr
    sim = replace(sim, recording=replace(sim.recording, gyr=replace(gyr, y=gyr.y + 2 * rng.normal(size=gyr.y.shape))))
    acc = sim.recording.acc
    sim = replace(sim, recording=replace(sim.recording, acc=replace(acc, y=acc.y + 4 * rng.normal(size=acc.y.shape))))
    segmentation = found(sim)
    assert len(segmentation.turns) == 9
    model = sim.truth.models["gyr"]
    for j, turn in enumerate(segmentation.turns):
        assert (turn.before, turn.after) == (j, j + 1)
        R = np.eye(3)
        for step in so3.exp(model.apply(turn.y) * turn.dt[:, None]):
            R = R @ step
        true = sim.R_nh[j].T @ sim.R_nh[j + 1]
        assert np.degrees(so3.angle_between(R, true)) < 0.3
        # the samples stand for the whole of the time between the rests
        poses = segmentation.poses
        assert turn.dt.sum() == pytest.approx(poses.start[j + 1] - poses.stop[j], abs=0.011)


def test_a_gap_in_a_turn_leaves_that_turn_out_and_says_so():
    sim = simulate(seed=11, n_poses=8, rest_s=2.5)
    middle = (sim.stop[2] + sim.start[3]) / 2
    streams = {}
    for kind, s in sim.recording.streams.items():
        keep = np.abs(s.t - middle) > 0.15
        streams[kind] = replace(s, t=s.t[keep], y=s.y[keep])
    segmentation = find_poses(replace(sim.recording, **streams))
    assert_all_found(sim, segmentation)
    assert [t.before for t in segmentation.turns] == [0, 1, 3, 4, 5, 6]
    issue = next(i for i in segmentation.issues if i.code == "gap-in-turn")
    assert issue.level == "warn"
    assert "3-4" in issue.text


def test_a_run_of_nan_costs_only_what_it_covers():
    sim = simulate(seed=12, n_poses=8, rest_s=3.0)
    s = sim.recording.acc
    y = s.y.copy()
    hole = (s.t > sim.start[4] + 1.2) & (s.t < sim.start[4] + 1.5)
    y[hole] = np.nan
    from margcal.core.checking import checked_recording

    recording = checked_recording(replace(sim.recording, acc=replace(s, y=y)))
    segmentation = find_poses(recording)
    assert len(segmentation.poses) == 8
    assert np.isfinite(segmentation.poses.mean["acc"]).all()
    model = sim.truth.models["acc"]
    true = model.invert(np.einsum("jba,b->ja", sim.R_nh, model.reference_vector))
    assert np.abs(segmentation.poses.mean["acc"] - true).max() < 2.5


def test_nothing_is_integrated_across_recordings():
    a, b = (
        simulate(seed=1, n_poses=6, rest_s=2),
        simulate(seed=2, node_seed=1, n_poses=7, rest_s=2, sensors=("acc", "gyr")),
    )
    segmentation = found(a, b.recording)
    poses = segmentation.poses
    assert poses.recording == (0,) * 6 + (1,) * 7
    assert np.isfinite(poses.mean["mag"][:6]).all()
    assert np.isnan(poses.mean["mag"][6:]).all()
    assert np.all(poses.count["mag"][6:] == 0)
    assert [(t.before, t.after) for t in segmentation.turns] == [(j, j + 1) for j in range(12) if j != 5]


def test_leaving_rests_out_renumbers_the_turns():
    segmentation = found(simulate(seed=1, n_poses=7, rest_s=2))
    keep = np.array([True, True, False, True, True, True, False])
    less = drop_poses(segmentation, keep)
    assert np.array_equal(less.poses.start, segmentation.poses.start[keep])
    assert [(t.before, t.after) for t in less.turns] == [(0, 1), (2, 3), (3, 4)]
    assert less.turns[1].t[0] == segmentation.turns[3].t[0]


def test_rests_that_the_user_names_are_taken_as_they_are():
    sim = simulate(seed=3, n_poses=6, rest_s=4.0)
    spans = [(0, float(a) + 1.0, float(a) + 1.5) for a in sim.start]  # half a second: the user's business
    poses = measure_spans((sim.recording,), spans).poses
    assert poses.start == pytest.approx([a for _, a, _ in spans])
    assert poses.count["acc"] == pytest.approx(np.full(6, 50), abs=1)


def test_mean_reference_attitude_leaves_gaps_out():
    sim = simulate(seed=4, n_poses=6, rest_s=2.0, reference=True)
    ref = sim.recording.reference
    q = ref.q.copy()
    q[ref.t < sim.stop[0] + 0.2] = np.nan
    q[1::2] *= -1  # either sign is the same attitude
    recording = replace(sim.recording, reference=replace(ref, q=q))
    poses = find_poses(recording).poses
    assert np.isnan(poses.q_ref[0]).all()
    off = so3.angle_between(so3.matrix_from_quat(poses.q_ref[1:]), sim.R_nh[1:])
    assert np.degrees(off).max() < 0.03


# --- noise floor -------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["acc", "gyr", "mag"])
def test_noise_floor_is_that_of_the_sensor(kind):
    sim = simulate(seed=1, n_poses=12, rest_s=4.0)
    assert noise_floor(sim.recording.streams[kind]) == pytest.approx(np.sqrt(3) * NOISE[kind], rel=0.2)


def test_noise_floor_follows_the_noise():
    for factor in (0.5, 5.0):
        sim = simulate(seed=1, n_poses=12, rest_s=4.0, noise=factor)
        assert noise_floor(sim.recording.gyr) == pytest.approx(np.sqrt(3) * factor * NOISE["gyr"], rel=0.2)


def test_motion_throughout_has_no_noise_floor():
    assert np.isnan(noise_floor(swing(seed=1, duration_s=30).recording.gyr))


def test_a_coarse_sensor_has_the_floor_of_its_last_bit():
    """Readings that never change at rest: half of the last bit is as far as anyone can know them."""
    recording = on_table(10.0, gyr=0.01)
    y = np.round(recording.gyr.y)
    y[500:520] += 1  # something moved once, so that there is a last bit to be seen
    assert noise_floor(replace(recording.gyr, y=y)) == pytest.approx(0.5, rel=0.01)


def test_too_short_a_stream_has_no_noise_floor():
    stream = on_table(0.5).acc
    assert np.isnan(noise_floor(stream))


# --- nothing to find ---------------------------------------------------------------------------------


def test_clocks_that_do_not_overlap_and_streams_of_nothing_have_no_rests():
    recording = on_table(10.0)
    late = replace(recording, gyr=replace(recording.gyr, t=recording.gyr.t + 1000))
    assert len(find_poses(late).poses) == 0
    blank = {k: replace(s, y=np.full(s.y.shape, np.nan)) for k, s in recording.streams.items()}
    assert len(find_poses(replace(recording, **blank)).poses) == 0
    assert len(find_poses(Recording()).poses) == 0
    with pytest.raises(UsageError):
        find_poses()
