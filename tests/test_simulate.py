"""The simulated node against physics and against itself, independently of the code that made it."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from margcal.core.errors import InputError
from margcal.workflow.motion import bump, minimum_jerk
from margcal.workflow.place import at
from margcal.workflow.simulate import simulate, swing, write_simulation
from margcal.workflow.simulated_node import NOISE

CLEAN = {"noise": 0.0, "quantise": False}


def calibrated(sim, kind):
    """True sensed vectors from the readings, by the truth."""
    return sim.truth.models[kind].apply(sim.recording.streams[kind].y)


def rests(sim, kind):
    """Masks (J, N) of the samples in each rest, its edges left out."""
    t = sim.recording.streams[kind].t
    return (t > sim.start[:, None] + 0.005) & (t < sim.stop[:, None] - 0.005)


@pytest.fixture(scope="module")
def clean():
    return simulate(seed=3, n_poses=12, poses="free", rest_s=1.0, mag_axes="board", **CLEAN)


def test_at_rest_the_readings_are_gravity_and_field_in_the_true_attitude(clean):
    for kind in ("acc", "mag"):
        u, expected = calibrated(clean, kind), clean.truth.models[kind].reference_vector
        for inside, R in zip(rests(clean, kind), clean.R_nh):
            np.testing.assert_allclose(u[inside], np.tile(R.T @ expected, (inside.sum(), 1)), atol=1e-9)
    for inside in rests(clean, "gyr"):
        np.testing.assert_allclose(calibrated(clean, "gyr")[inside], 0, atol=1e-12)


def test_specific_force_at_rest_points_up_with_length_g(clean):
    np.testing.assert_array_equal(clean.truth.acc.reference_vector, [0, 0, 9.80665])
    u = calibrated(clean, "acc")[rests(clean, "acc").any(axis=0)]
    np.testing.assert_allclose(np.linalg.norm(u, axis=1), 9.80665, rtol=1e-12)


def test_the_field_is_the_same_in_the_laboratory_at_all_times(clean):
    t = clean.recording.mag.t
    in_n = np.einsum("nij,nj->ni", clean.motion.at(t).R, calibrated(clean, "mag"))
    np.testing.assert_allclose(in_n, np.tile(clean.truth.mag.reference_vector, (len(t), 1)), atol=1e-9)


@pytest.mark.parametrize("rate, limit_deg", [(100, 0.01), (400, 0.001)])
def test_the_gyroscope_integrates_to_the_attitudes(rate, limit_deg):
    sim = simulate(seed=4, n_poses=12, poses="free", rest_s=0.5, rate=rate, **CLEAN)
    t, w = sim.recording.gyr.t, calibrated(sim, "gyr")
    steps = Rotation.from_rotvec(0.5 * (w[1:] + w[:-1]) * np.diff(t)[:, None])
    track = [Rotation.from_matrix(sim.R_nh[0])]
    for step in steps:
        track.append(track[-1] * step)
    for inside, (before, after) in zip(rests(sim, "gyr")[1:], pairwise(range(len(sim.start)))):
        k0, k1 = np.flatnonzero(rests(sim, "gyr")[before])[-1], np.flatnonzero(inside)[0]
        turned = (track[k0].inv() * track[k1]).as_matrix()
        error = Rotation.from_matrix(turned.T @ sim.R_nh[before].T @ sim.R_nh[after]).magnitude()
        assert np.degrees(error) < limit_deg


@pytest.mark.parametrize("make", [lambda: simulate(seed=5, n_poses=4, knocks=3, **CLEAN), lambda: swing(**CLEAN)])
def test_the_rate_is_the_derivative_of_the_attitude(make):
    sim = make()
    t, h = np.linspace(0.01, sim.recording.gyr.t[-1] - 0.01, 5000), 1e-5
    R0, R1 = sim.motion.at(t - h).R, sim.motion.at(t + h).R
    numeric = Rotation.from_matrix(np.swapaxes(R0, 1, 2) @ R1).as_rotvec() / (2 * h)
    np.testing.assert_allclose(sim.motion.at(t).rate, numeric, atol=2e-6)


def test_during_turns_the_field_changes_as_the_gyroscope_says():
    sim = simulate(seed=6, n_poses=6, rest_s=0.5, rate=1000, **CLEAN)
    m, w, t = calibrated(sim, "mag"), calibrated(sim, "gyr"), sim.recording.mag.t
    change = (m[2:] - m[:-2]) / (t[2:] - t[:-2])[:, None]
    expected = -np.cross(w, m)[1:-1]
    assert np.abs(expected).max() > 50  # uT/s: it does turn
    np.testing.assert_allclose(change, expected, atol=0.5)


def test_the_hand_moves_some_tens_of_centimetres_and_comes_to_rest():
    sim = simulate(seed=7, n_poses=10, rest_s=0.5, rate=1000, **CLEAN)
    t = sim.recording.acc.t
    a = sim.motion.at(t).acceleration
    velocity = np.vstack([np.zeros(3), np.cumsum(0.5 * (a[1:] + a[:-1]), axis=0) / 1000])
    position = np.vstack([np.zeros(3), np.cumsum(0.5 * (velocity[1:] + velocity[:-1]), axis=0) / 1000])
    still = rests(sim, "acc").any(axis=0)
    assert np.abs(velocity[still]).max() < 0.02
    turning = ~still & (t > 0.6)
    assert 0.1 < np.abs(position[turning]).max() < 0.6
    assert 1 < np.linalg.norm(a, axis=1).max() < 15


def test_profiles_start_and_end_smoothly():
    x = np.linspace(0, 1, 2001)
    for profile, end in ((minimum_jerk, 1), (bump, 0)):
        y, dy, ddy = profile(x)
        np.testing.assert_allclose(np.gradient(y, x)[1:-1], dy[1:-1], atol=1e-4)
        np.testing.assert_allclose(np.gradient(dy, x)[1:-1], ddy[1:-1], atol=1e-3)
        assert (y[0], y[-1]) == (0, end)
        assert (dy[0], dy[-1], ddy[0], ddy[-1]) == (0, 0, 0, 0)
        assert profile(np.array([-3.0, 4.0]))[0].tolist() == [0, end]


@pytest.mark.parametrize("n", [6, 24, 60])
def test_cube_attitudes_differ_from_their_neighbours_and_show_all_faces(n):
    nominal = simulate(n_poses=n, rest_s=0.1, turn_s=0.1).nominal
    np.testing.assert_array_equal(np.sort(np.abs(nominal), axis=-1)[..., :2], 0)
    turns = Rotation.from_matrix(np.swapaxes(nominal[:-1], 1, 2) @ nominal[1:]).magnitude()
    assert np.degrees(turns).min() > 89
    for i in range(0, n, 6):
        assert len({tuple(R[2]) for R in nominal[i : i + 6]}) == 6
    assert len(np.unique(nominal[:24], axis=0)) == min(n, 24)


@pytest.mark.parametrize("poses", ["cube", "free"])
def test_turns_are_of_sixty_degrees_or_more(poses):
    R = simulate(seed=8, poses=poses, n_poses=24, rest_s=0.1, turn_s=0.1).R_nh
    turns = np.degrees(Rotation.from_matrix(np.swapaxes(R[:-1], 1, 2) @ R[1:]).magnitude())
    assert turns.min() > 58


def test_faces_have_one_face_up_and_any_heading():
    nominal = simulate(poses="faces", n_poses=18, rest_s=0.1, turn_s=0.1).nominal
    assert np.allclose(np.abs(nominal[:, 2]).max(axis=1), 1)  # a housing axis is up
    assert np.abs(nominal[:, 0]).max(axis=1).min() < 0.99  # but none need point east


def test_housing_error_and_tilt_have_the_size_asked_for():
    options = {"n_poses": 400, "rest_s": 0.02, "turn_s": 0.02, "sensors": ("acc",)}
    sim = simulate(housing_sd_deg=0.3, **options)
    error = Rotation.from_matrix(np.swapaxes(sim.nominal, 1, 2) @ sim.R_nh).as_rotvec(degrees=True)
    np.testing.assert_allclose(error.std(axis=0), 0.3, rtol=0.15)
    sim = simulate(housing_sd_deg=0, level_sd_deg=2.0, **options)
    tilt = Rotation.from_matrix(sim.R_nh @ np.swapaxes(sim.nominal, 1, 2)).as_rotvec(degrees=True)
    np.testing.assert_allclose(tilt[:, :2].std(axis=0), 2, rtol=0.15)
    np.testing.assert_allclose(tilt[:, 2], 0, atol=1e-9)


def test_the_node_has_the_errors_asked_for():
    sim = simulate(seed=9, mounting_deg=4, scale_error=0, non_orthogonality_deg=0, soft_iron=0, n_poses=2)
    for model in sim.truth.models.values():
        size = np.cbrt(np.linalg.det(model.H))
        rotation = Rotation.from_matrix(model.H / size)
        np.testing.assert_allclose(model.H @ model.H.T, size**2 * np.eye(3), atol=1e-15)
        assert np.degrees(rotation.magnitude()) == pytest.approx(4, abs=1e-6)


def test_board_axes_keep_the_determinant_and_turn_the_trace():
    H = simulate(seed=1, mag_axes="board", n_poses=2).truth.mag.H
    assert np.linalg.det(H) > 0 > np.trace(H)
    straight = simulate(seed=1, n_poses=2).truth.mag.H
    assert np.trace(straight) > 0


def test_readings_are_whole_counts_with_the_noise_of_the_parts():
    sim = simulate(seed=10, n_poses=3)
    for kind, stream in sim.recording.streams.items():
        assert stream.unit == "count"
        np.testing.assert_array_equal(stream.y, np.round(stream.y))
        sd = np.mean([stream.y[inside].std(axis=0) for inside in rests(sim, kind)])
        assert sd == pytest.approx(np.hypot(NOISE[kind], 12**-0.5), rel=0.05)


def test_readings_saturate_at_sixteen_bits():
    y = simulate(seed=0, n_poses=6, turn_s=0.1, rest_s=0.2).recording.gyr.y
    assert np.abs(y).max() > 32000
    assert y.max() <= 32767 and y.min() >= -32768


def test_least_squares_on_the_rests_finds_the_truth_within_its_noise():
    sim = simulate(seed=11)
    for kind in ("acc", "mag"):
        model, y = sim.truth.models[kind], sim.recording.streams[kind].y
        means = np.array([y[inside].mean(axis=0) for inside in rests(sim, kind)])
        u = np.swapaxes(sim.R_nh, 1, 2) @ model.reference_vector
        K = np.linalg.lstsq(np.column_stack([u, np.ones(len(u))]), means, rcond=None)[0].T
        noise = NOISE[kind] / np.sqrt(rests(sim, kind).sum(axis=1).mean() * len(means))
        np.testing.assert_allclose(K[:, 3], model.B, atol=5 * noise)
        bound = 5 * noise * np.sqrt(3) / np.linalg.norm(model.reference_vector)
        np.testing.assert_allclose(K[:, :3], np.linalg.inv(model.H), atol=bound)


def test_a_seed_gives_the_same_bytes_and_another_does_not():
    a, b, c = (simulate(seed=s, n_poses=3) for s in (1, 1, 2))
    for kind, stream in a.recording.streams.items():
        np.testing.assert_array_equal(stream.y, b.recording.streams[kind].y)
        assert not np.array_equal(stream.y, c.recording.streams[kind].y)


def test_an_option_changes_nothing_but_what_it_says():
    options = {"seed": 12, "n_poses": 4}
    whole = simulate(**options)
    for other in (simulate(sensors=("mag",), **options), simulate(knocks=2, reference=True, **options)):
        np.testing.assert_array_equal(other.truth.mag.H, whole.truth.mag.H)
        np.testing.assert_array_equal(other.R_nh, whole.R_nh)
        np.testing.assert_array_equal(other.recording.mag.y[:100], whole.recording.mag.y[:100])
    assert list(simulate(sensors=("mag",), **options).recording.streams) == ["mag"]


def test_recordings_of_one_node_share_its_truth():
    a, b = simulate(seed=1, node_seed=7, n_poses=3), simulate(seed=2, node_seed=7, n_poses=3)
    c = swing(seed=3, node_seed=7, duration_s=1.0)
    for kind in ("acc", "gyr", "mag"):
        for other in (b, c):
            np.testing.assert_array_equal(a.truth.models[kind].H, other.truth.models[kind].H)
            np.testing.assert_array_equal(a.truth.models[kind].B, other.truth.models[kind].B)
    assert not np.array_equal(a.nominal, b.nominal)


def test_knocks_shake_a_rest_without_moving_it():
    sim = simulate(seed=13, n_poses=4, knocks=5, **CLEAN)
    assert len(sim.knocks) == 5
    t, force = sim.recording.acc.t, np.linalg.norm(calibrated(sim, "acc"), axis=1)
    within = rests(sim, "acc").any(axis=0)
    knocked = np.any((t > sim.knocks[:, :1]) & (t < sim.knocks[:, 1:]), axis=0)
    assert np.all(within[knocked])
    np.testing.assert_allclose(force[within & ~knocked], 9.80665, atol=1e-9)
    for begin, end in sim.knocks:
        assert 0.05 < end - begin < 0.3
        assert np.abs(force[(t > begin) & (t < end)] - 9.80665).max() > 0.2
        np.testing.assert_allclose(*sim.motion.at(np.array([begin - 0.01, end + 0.01])).R, atol=1e-12)


def test_reference_is_the_housings_attitude_with_noise_and_gaps():
    sim = simulate(seed=14, n_poses=10, reference=True, reference_noise_deg=0.1, reference_gaps=4)
    ref = sim.recording.reference
    seen = ~np.isnan(ref.q).any(axis=1)
    assert 0.3 * 100 - 1 <= np.sum(~seen) <= 4 * 1.5 * 100 + 4
    R = Rotation.from_quat(ref.q[seen], scalar_first=True).as_matrix()
    error = Rotation.from_matrix(np.swapaxes(R, 1, 2) @ sim.motion.at(ref.t[seen]).R).as_rotvec(degrees=True)
    np.testing.assert_allclose(error.std(axis=0), 0.1, rtol=0.1)


def test_separate_clocks_have_their_own_rates_and_the_same_physics():
    sim = simulate(seed=15, n_poses=4, separate_clocks=True, **CLEAN)
    assert [round(s.rate, 6) for s in sim.recording.streams.values()] == [100, 137, 50]
    t = sim.recording.mag.t
    in_n = np.einsum("nij,nj->ni", sim.motion.at(t).R, calibrated(sim, "mag"))
    np.testing.assert_allclose(in_n, np.tile(sim.truth.mag.reference_vector, (len(t), 1)), atol=1e-9)


def test_the_disturbed_rest_alone_has_another_field():
    sim = simulate(seed=16, n_poses=8, disturbed=3, disturbance=0.05, **CLEAN)
    t, true = sim.recording.mag.t, sim.truth.mag.reference_vector
    in_n = np.einsum("nij,nj->ni", sim.motion.at(t).R, calibrated(sim, "mag"))
    off = np.linalg.norm(in_n - true, axis=1) / np.linalg.norm(true)
    for j, inside in enumerate(rests(sim, "mag")):
        np.testing.assert_allclose(off[inside], 0.05 if j == 3 else 0, atol=1e-9)


def test_the_wrong_label_is_wrong_by_a_quarter_turn_and_alone():
    right, wrong = simulate(seed=17, n_poses=6), simulate(seed=17, n_poses=6, wrong_label=2)
    angle = Rotation.from_matrix(np.swapaxes(right.nominal, 1, 2) @ wrong.nominal).magnitude()
    np.testing.assert_allclose(np.degrees(angle), [0, 0, 90, 0, 0, 0], atol=1e-6)
    np.testing.assert_array_equal(right.R_nh, wrong.R_nh)
    np.testing.assert_array_equal(right.recording.mag.y, wrong.recording.mag.y)


def test_a_place_gives_gravity_and_field():
    place = at(51.5, -0.12, 2026.5)
    sim = simulate(n_poses=2, place=place)
    np.testing.assert_array_equal(sim.truth.mag.reference_vector, place.field.vector)
    assert sim.truth.acc.reference_vector[2] == place.gravity


def test_temperature_rises_by_a_degree():
    sim = simulate(n_poses=5, temperature_degC=20.0)
    t, temperature = sim.recording.temperature
    assert len(t) == len(temperature) == len(sim.recording.acc.t)
    assert temperature[:100].mean() == pytest.approx(20, abs=0.05)
    assert temperature[-100:].mean() == pytest.approx(21, abs=0.05)
    assert sim.truth.acc.temperature_degC == 20.5


def test_a_late_magnetometer_shows_what_was():
    late = simulate(seed=18, n_poses=4, mag_delay_s=0.02, **CLEAN)
    now = simulate(seed=18, n_poses=4, **CLEAN)
    np.testing.assert_allclose(late.recording.mag.y[2:], now.recording.mag.y[:-2], atol=1e-9)
    np.testing.assert_array_equal(late.recording.acc.y, now.recording.acc.y)
    assert (late.truth.mag.delay_s, late.truth.acc.delay_s, now.truth.mag.delay_s) == (0.02, 0, None)


def test_a_swing_sees_the_field_from_everywhere_and_never_rests():
    for seed in range(5):
        sim = swing(seed=seed, **CLEAN)
        m = calibrated(sim, "mag")
        m = m / np.linalg.norm(m, axis=1, keepdims=True)
        sphere = np.random.default_rng(0).normal(size=(500, 3))
        sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
        assert np.degrees(np.arccos((sphere @ m.T).max(axis=1))).max() < 30
        assert np.linalg.eigvalsh(m.T @ m / len(m))[0] > 0.2  # evenly: a third each at best
        assert np.linalg.norm(calibrated(sim, "gyr"), axis=1).mean() > 1
        assert np.abs(np.mean(calibrated(sim, "gyr"), axis=0)).max() < 0.3
        assert len(sim.start) == len(sim.R_nh) == 0


@pytest.mark.parametrize(
    "options, what",
    [
        ({"n_poses": 0}, "n_poses"),
        ({"poses": "sphere"}, "sphere"),
        ({"rate": 0.0}, "rate"),
        ({"rest_s": float("nan")}, "rest_s"),
        ({"turn_s": -1.0}, "turn_s"),
        ({"sensors": ()}, "sensors"),
        ({"sensors": ("baro",)}, "baro"),
        ({"disturbed": 24}, "no rest 24"),
        ({"wrong_label": -1}, "no rest -1"),
        ({"mag_axes": "bord"}, "bord"),
        ({"mag_axes": np.ones((3, 3))}, "orthogonal"),
    ],
)
def test_options_that_make_no_sense_are_refused(options, what):
    with pytest.raises(InputError, match=what):
        simulate(**options)


def test_one_rest_is_a_recording_too():
    sim = simulate(n_poses=1, rest_s=2.0)
    assert len(sim.recording.acc.t) == 201
    assert np.ptp(sim.recording.gyr.y, axis=0).max() < 25


@pytest.mark.parametrize("separate", [False, True])
def test_written_files_read_back(tmp_path, separate):
    from margcal.files.calfile import load
    from margcal.files.tables import read

    sim = simulate(seed=19, n_poses=3, reference=True, temperature_degC=20.0, separate_clocks=separate)
    session, poses, truth = write_simulation(sim, tmp_path / "node")
    assert (session.name, poses.name, truth.name) == (
        "session" if separate else "session.parquet",
        "poses.csv",
        "truth.json",
    )
    recording = read(session)
    for kind, stream in sim.recording.streams.items():
        np.testing.assert_array_equal(recording.streams[kind].y, stream.y)
        np.testing.assert_allclose(recording.streams[kind].t, stream.t, atol=1e-9)
        assert recording.streams[kind].unit == "count"
    q, written = recording.reference.q, sim.recording.reference.q
    np.testing.assert_allclose(np.abs(np.sum(q * written, axis=1)), 1, atol=1e-12)  # either sign
    back = load(truth)
    for kind, model in sim.truth.models.items():
        np.testing.assert_array_equal(back.models[kind].H, model.H)
        np.testing.assert_array_equal(back.models[kind].B, model.B)
    table = np.loadtxt(poses, delimiter=",", skiprows=1)
    assert poses.read_text().splitlines()[0] == "start_s,stop_s,qw,qx,qy,qz"
    R = Rotation.from_quat(table[:, 2:], scalar_first=True).as_matrix()
    np.testing.assert_allclose(R, sim.nominal, atol=1e-9)
    np.testing.assert_allclose(table[:, 0], sim.start, atol=1e-9)
    with pytest.raises(InputError, match="exists"):
        write_simulation(sim, tmp_path / "node")
    write_simulation(sim, tmp_path / "node", overwrite=True)
