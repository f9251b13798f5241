"""Orientation filters against simulated truth, their signs by hand, and what nobody wishes to feed them."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from margcal.core import so3
from margcal.core.errors import UsageError
from margcal.methods import ekf_quest, strapdown, tracking, vector_selection
from margcal.methods.filters import DEFAULT, FILTERS, Surroundings, find_filter
from margcal.methods.tracking import ACC, GAP, MAG, NO_GYR, from_plain, to_plain
from margcal.workflow.motion import Swing

OURS = ("vector-selection", "ekf-quest", "gyro")
CORRECTED = ("vector-selection", "ekf-quest")
G, FIELD, DIP = 9.81, 48.0, 1.15
UP, NORTH = np.array([0.0, 0.0, G]), FIELD * np.array([0.0, math.cos(DIP), -math.sin(DIP)])
PLACE = Surroundings(G, FIELD, DIP, 0.01)


def ideal(R: np.ndarray, acceleration: np.ndarray | float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Readings (N, 3) of accelerometer and magnetometer at attitudes R (N, 3, 3) node to earth."""
    force = np.broadcast_to(UP + acceleration, (len(R), 3))
    return np.einsum("nji,nj->ni", R, force), np.einsum("nji,j->ni", R, NORTH)


class Moved:
    """A node waved about: its readings (rate taken as the mean over each step) and its true attitudes."""

    def __init__(
        self, seconds: float = 10.0, rate: float = 50.0, *, noise: float = 0.0, sway: float = 0.05, seed: int = 0
    ) -> None:
        rng = np.random.default_rng(seed)
        motion = Swing(
            np.array([1.0, 1.2, 1.3]),
            np.array([0.9, 1.4, 1.1]),
            rng.uniform(0, 6, 3),
            np.full(3, sway),
            np.full(3, 0.7),
        )
        t = np.arange(int(seconds * rate)) / rate
        state = motion.at(t)
        self.t, self.dt, self.R = t, np.diff(t, prepend=t[0]), state.R
        self.q = so3.quat_from_matrix(state.R)
        turn = so3.log(np.swapaxes(state.R[:-1], 1, 2) @ state.R[1:]) * rate
        self.gyr = np.vstack([turn[:1], turn]) + 0.01 * noise * rng.normal(size=(len(t), 3))
        acc, mag = ideal(state.R, state.acceleration)
        self.acc = acc + 0.05 * noise * rng.normal(size=acc.shape)
        self.mag = mag + 0.3 * noise * rng.normal(size=mag.shape)

    def run(self, name: str, q0: np.ndarray | None = None, sd=(0.05, 0.05, 0.1), part: slice = slice(None)):
        f = find_filter(name)
        start = f.start(self.q[0] if q0 is None else q0, sd)
        return f.batch(f.params(PLACE), start, self.dt[part], self.gyr[part], self.acc[part], self.mag[part])


def error_deg(q: np.ndarray, truth: np.ndarray) -> np.ndarray:
    return np.degrees(np.linalg.norm(so3.quat_log(so3.quat_multiply(q, so3.quat_conjugate(truth))), axis=-1))


def sound(track) -> None:
    """Finite unit quaternions and a covariance that is positive definite."""
    assert np.isfinite(track.q).all()
    assert np.allclose(np.linalg.norm(track.q, axis=-1), 1, rtol=0, atol=1e-12)
    assert np.isfinite(track.variance).all()
    assert track.variance.min() > 0
    P = getattr(track.state, "P", None)
    if P is not None:
        assert np.linalg.eigvalsh(P).min() > 0
        assert np.allclose(P, np.swapaxes(P, -1, -2), rtol=0, atol=1e-12 * P.max())


# --- truth --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", OURS)
def test_follows_the_truth_of_a_simulated_motion(name):
    moved = Moved(noise=1.0)
    track = moved.run(name, sd=(0.01, 0.01, 0.02))
    sound(track)
    limit = {"vector-selection": 1.0, "ekf-quest": 1.0, "gyro": 0.7}[name]
    assert error_deg(track.q, moved.q).max() < limit


@pytest.mark.parametrize("name", CORRECTED)
def test_finds_the_attitude_from_a_wrong_start(name):
    """40 degrees off about a slanted axis: gyroscope alone would stay there."""
    moved = Moved(seconds=12)
    wrong = so3.quat_multiply(so3.quat_exp(np.radians(40) * np.array([0.6, 0.0, 0.8])), moved.q[0])
    error = error_deg(moved.run(name, wrong, sd=(0.5, 0.5, 0.7)).q, moved.q)
    assert error[0] > 30
    assert error[-200:].max() < 3
    assert error_deg(moved.run("gyro", wrong).q, moved.q)[-1] > 30


@pytest.mark.parametrize("name", OURS)
def test_signs_by_hand_a_turn_to_the_left_points_x_to_the_north(name):
    """Flat on the table, x to the east. Counterclockwise seen from above is a positive rate about z."""
    f = find_filter(name)
    n, rate = 200, math.pi / 2 / 2.0
    half = np.arange(1, n + 1) / n * math.pi / 2
    R = so3.exp(half[:, None] * np.array([0.0, 0.0, 1.0]))
    acc, mag = ideal(R)
    gyr = np.tile([0.0, 0.0, rate], (n, 1))
    track = f.batch(f.params(PLACE), f.start([1.0, 0, 0, 0]), np.full(n, 2.0 / n), gyr, acc, mag)
    assert mag[-1] == pytest.approx([FIELD * math.cos(DIP), 0, -FIELD * math.sin(DIP)], abs=1e-9)  # the field is ahead
    assert np.allclose(so3.matrix_from_quat(track.q[-1]) @ [1, 0, 0], [0, 1, 0], atol=1e-3)
    assert np.allclose(so3.matrix_from_quat(track.q[-1]) @ [0, 0, 1], [0, 0, 1], atol=1e-3)


@pytest.mark.parametrize("name", CORRECTED)
def test_signs_by_hand_an_axis_that_shows_plus_g_is_up(name):
    """Nothing turns; accelerometer and magnetometer alone say: x up, z north, hence y east."""
    f = find_filter(name)
    n = 600
    acc, mag = np.tile([G, 0.0, 0.0], (n, 1)), np.tile(FIELD * np.array([-math.sin(DIP), 0, math.cos(DIP)]), (n, 1))
    start = f.start(so3.quat_exp([0.5, -1.0, 0.3]), (1.0, 1.0, 2.0))
    track = f.batch(f.params(PLACE), start, np.full(n, 0.1), np.zeros((n, 3)), acc, mag)
    R = so3.matrix_from_quat(track.q[-1])
    assert np.allclose(R @ [1, 0, 0], [0, 0, 1], atol=0.01)
    assert np.allclose(R @ [0, 0, 1], [0, 1, 0], atol=0.01)
    assert np.allclose(R @ [0, 1, 0], [1, 0, 0], atol=0.01)


@pytest.mark.parametrize("name", OURS)
def test_errors_are_as_large_as_the_filter_believes(name):
    """Forty nodes whose readings err as the parameters say: squared errors over believed variance are about one."""
    rng, n, nodes, dt = np.random.default_rng(8), 200, 40, 0.02
    f = find_filter(name)
    p = f.params(PLACE)
    sd = np.array([0.03, 0.03, 0.06])
    truth = np.array([1.0, 0, 0, 0])
    start = f.start(so3.quat_multiply(so3.quat_exp(sd * rng.normal(size=(nodes, 3))), truth), sd)
    gyr = p.rate_noise / math.sqrt(dt) * rng.normal(size=(nodes, n, 3))
    acc, mag = np.tile(UP, (nodes, n, 1)), np.tile(NORTH, (nodes, n, 1))
    if name == "vector-selection":
        acc += G * p.acc_noise / math.sqrt(dt) * rng.normal(size=acc.shape) * [1, 1, 0]
        mag[..., 0] += FIELD * math.cos(DIP) * p.mag_noise / math.sqrt(dt) * rng.normal(size=(nodes, n))
        p = p._replace(mag_gate=10.0, dip_gate=10.0)
    elif name == "ekf-quest":
        turned = so3.exp(0.3 * p.quest_noise / math.sqrt(dt) * rng.normal(size=(nodes, n, 3)))
        p = p._replace(quest_noise=0.3 * p.quest_noise)
        acc = np.einsum("knji,j->kni", turned, UP)
        mag = np.einsum("knji,j->kni", turned, NORTH)
    track = f.batch(p, start, np.full(n, dt), gyr, acc, mag)
    error = so3.quat_log(so3.quat_multiply(track.q[:, -1], so3.quat_conjugate(truth)))
    ratio = np.mean(error**2 / track.variance[:, -1])
    assert 0.6 < ratio < 1.5  # 120 squares: sd 0.13


# --- their own ways -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", OURS)
def test_pausing_through_json_changes_nothing(name):
    moved, f = Moved(seconds=2, noise=1.0), find_filter(name)
    whole = moved.run(name)
    first = moved.run(name, part=slice(0, 90))
    params = f.params(PLACE)
    saved = json.loads(json.dumps([to_plain(params), to_plain(first.state)]))
    params, state = from_plain(type(params), saved[0]), from_plain(type(first.state), saved[1])
    rest = f.batch(params, state, moved.dt[90:], moved.gyr[90:], moved.acc[90:], moved.mag[90:])
    assert np.array_equal(np.concatenate([first.q, rest.q]), whole.q)
    assert np.array_equal(np.concatenate([first.variance, rest.variance]), whole.variance)


@pytest.mark.parametrize("name", OURS)
def test_sample_by_sample_and_side_by_side_are_the_batch(name):
    moved, f = Moved(seconds=1, noise=1.0), find_filter(name)
    params, state = f.params(PLACE), f.start(moved.q[0])
    whole = moved.run(name)
    assert f.step is not None
    for k in range(len(moved.t)):
        state = f.step(params, state, moved.dt[k], moved.gyr[k], moved.acc[k], moved.mag[k])
        q = state.x[3:] if name == "ekf-quest" else state.q
        assert q == pytest.approx(whole.q[k], abs=1e-13)
    other = moved.gyr[::-1].copy()
    nodes = f.batch(
        params,
        f.start(np.stack([moved.q[0], moved.q[0]])),
        moved.dt,
        np.stack([moved.gyr, other]),
        np.stack([moved.acc, moved.acc]),
        np.stack([moved.mag, moved.mag]),
    )
    assert nodes.q[0] == pytest.approx(whole.q, abs=1e-13)
    assert error_deg(nodes.q[1], whole.q).max() > 1


@pytest.mark.parametrize("name", CORRECTED)
def test_the_sampling_rate_does_not_make_another_filter(name):
    """The same disturbance at 20 and 80 Hz moves the attitude alike: the noises are densities."""
    moved = []
    f = find_filter(name)
    for rate in (20, 80):
        n = 4 * rate
        acc, mag = np.tile(UP + np.array([1.5, 0, 0]), (n, 1)), np.tile(NORTH, (n, 1))
        track = f.batch(f.params(PLACE), f.start([1.0, 0, 0, 0]), np.full(n, 1 / rate), np.zeros((n, 3)), acc, mag)
        moved.append(error_deg(track.q[-1], np.array([1.0, 0, 0, 0])))
    assert moved[0] == pytest.approx(moved[1], rel=0.03)
    assert moved[0] > 0.1


def test_vectors_that_cannot_be_right_are_not_selected():
    n = 60
    acc, mag = np.tile(UP, (n, 1)), np.tile(NORTH, (n, 1))
    acc[10:20] *= 6  # an impact
    mag[20:30] *= 1.5  # a magnet
    mag[30:40] = FIELD * np.array([0, 1.0, 0])  # the right length, the wrong dip
    acc[40:45], mag[45:50] = 0.0, np.nan
    params, start = vector_selection.Params(G, FIELD, DIP), vector_selection.start([1.0, 0, 0, 0])
    track = vector_selection.batch(params, start, np.full(n, 0.01), np.zeros((n, 3)), acc, mag)
    not_acc, not_mag = np.flatnonzero(track.flags & ACC == 0), np.flatnonzero(track.flags & MAG == 0)
    assert not_acc.tolist() == [*range(10, 20), *range(40, 45)]
    assert not_mag.tolist() == [*range(20, 40), *range(45, 50)]
    assert error_deg(track.q, np.array([1.0, 0, 0, 0])).max() < 1e-9


def test_the_magnetometer_turns_only_the_heading():
    """A field that is turned by 20 degrees in the horizontal and dips wrongly within the gate leaves the tilt alone."""
    n = 400
    turned = so3.exp([0.05, 0.0, math.radians(20)]) @ NORTH
    params, start = vector_selection.Params(G, FIELD, DIP), vector_selection.start([1.0, 0, 0, 0])
    acc, mag = np.tile(UP, (n, 1)), np.tile(turned, (n, 1))
    track = vector_selection.batch(params, start, np.full(n, 0.05), np.zeros((n, 3)), acc, mag)
    up = so3.matrix_from_quat(track.q[-1])[2]
    assert np.degrees(np.arccos(min(up[2], 1.0))) < 0.01
    assert error_deg(track.q[-1], np.array([1.0, 0, 0, 0])) > 10


def test_acceleration_to_and_fro_averages_out():
    """3 m/s^2 rms at 1 Hz: without a gate on the length the tilt stays; with the narrow gate it is pulled aside."""
    dt, n = 0.04, 500
    t = dt * np.arange(n)
    acc = np.tile(UP, (n, 1))
    acc[:, 0] += 4.2 * np.sin(2 * np.pi * t)
    acc[:, 2] += 4.2 * np.sin(2 * np.pi * t + 0.6)
    params, start = vector_selection.Params(G, FIELD, DIP), vector_selection.start([1.0, 0, 0, 0], (0.01, 0.01, 0.02))
    args = (start, np.full(n, dt), np.zeros((n, 3)), acc, np.tile(NORTH, (n, 1)))
    wide = vector_selection.batch(params, *args)
    narrow = vector_selection.batch(params._replace(acc_gate=0.1), *args)
    level = np.array([1.0, 0, 0, 0])
    assert error_deg(wide.q[-100:], level).max() < 1.5
    assert error_deg(narrow.q[-100:], level).mean() > 2 * error_deg(wide.q[-100:], level).mean()


def test_rate_model_solves_the_differential_equation():
    """Mean and variance of (7) over one step of 0.3 s against 3000 small ones."""
    tau, D, T, n = 0.5, 50.0, 0.3, 3000
    mean, variance = 1.0, 0.0
    for _ in range(n):
        mean *= 1 - T / n / tau
        variance = variance * (1 - T / n / tau) ** 2 + D / tau**2 * T / n
    keep, reach, ww, wt, tt = ekf_quest.rate_model(tau, D, np.array(T))
    assert keep == pytest.approx(mean, rel=1e-3)
    assert reach == pytest.approx(T * keep)
    assert ww == pytest.approx(variance, rel=2e-3)
    assert [wt, tt] == [T * ww, T * T * ww]  # the reading is the mean over the step


def test_seven_scalar_corrections_are_the_matrix_one():
    rng = np.random.default_rng(9)
    A = rng.normal(size=(7, 7))
    P, x, z, R = A @ A.T, rng.normal(size=7), rng.normal(size=7), rng.uniform(0.1, 2, 7)
    K = P @ np.linalg.inv(P + np.diag(R))
    x_matrix, P_matrix = x + K @ (z - x), P - K @ P
    for i in range(7):
        x, P = ekf_quest._correct_state(x, P, i, z[i], R[i])
    assert x == pytest.approx(x_matrix, abs=1e-12)
    assert np.allclose(P, P_matrix, atol=1e-11)


def test_helpers_agree_with_so3():
    rng = np.random.default_rng(10)
    p, q, v = rng.normal(size=(9, 4)), so3.quat_exp(rng.normal(size=(9, 3))), rng.normal(size=(9, 3))
    v[0] = 1e-9
    assert tracking.product(p, q) == pytest.approx(so3.quat_multiply(p, q), abs=1e-14)
    assert tracking.rotation_step(v) == pytest.approx(so3.quat_exp(v), abs=1e-14)
    assert tracking.to_earth(q, v) == pytest.approx(np.einsum("nij,nj->ni", so3.matrix_from_quat(q), v), abs=1e-14)


# --- what nobody wishes -------------------------------------------------------------------------------

FAULTS = {
    "nothing measured": lambda m, s: [a.__setitem__(s, np.nan) for a in (m.gyr, m.acc, m.mag)],
    "no rate": lambda m, s: m.gyr.__setitem__(s, np.nan),
    "infinite": lambda m, s: [a.__setitem__(s, np.inf) for a in (m.gyr, m.acc, m.mag)],
    "absurd": lambda m, s: [a.__setitem__(s, 1e200) for a in (m.gyr, m.acc, m.mag)],
    "zero field": lambda m, s: m.mag.__setitem__(s, 0.0),
    "free fall": lambda m, s: m.acc.__setitem__(s, 1e-3),
    "dead sensors": lambda m, s: [a.__setitem__(s, 0.0) for a in (m.acc, m.mag)],
    "field along gravity": lambda m, s: m.mag.__setitem__(s, -m.acc[s]),
    "a magnet": lambda m, s: m.mag.__setitem__(s, [200.0, -300, 100]),
    "time stands still": lambda m, s: m.dt.__setitem__(s, 0.0),
    "time runs backwards": lambda m, s: m.dt.__setitem__(s, -1.0),
    "time is missing": lambda m, s: m.dt.__setitem__(s, np.nan),
}


@pytest.mark.parametrize("name", OURS)
@pytest.mark.parametrize("fault", FAULTS)
def test_faults_leave_a_sound_state_and_are_recovered_from(name, fault):
    moved = Moved(seconds=9, sway=0.02)
    stretch = slice(100, 150)  # a second
    FAULTS[fault](moved, stretch)
    track = moved.run(name)
    sound(track)
    if name != "gyro" and "time" not in fault:  # of time that is not told nothing can be known
        assert error_deg(track.q, moved.q)[-50:].max() < 3.5


@pytest.mark.parametrize("name", OURS)
@pytest.mark.parametrize("seconds", [1.0, 30.0])
def test_gaps_are_said_and_recovered_from(name, seconds):
    """The samples of a stretch are missing, and the node was turned half round meanwhile."""
    moved = Moved(seconds=9, sway=0.005)
    cut = so3.exp([0.0, 0.0, 2.5])
    k = 150
    moved.q[k:] = so3.quat_multiply(so3.quat_from_matrix(cut), moved.q[k:])
    moved.R[k:] = cut @ moved.R[k:]
    moved.acc[k:], moved.mag[k:] = ideal(moved.R[k:])
    moved.dt[k] = seconds
    track = moved.run(name)
    sound(track)
    assert np.flatnonzero(track.flags & GAP).tolist() == [k]
    assert track.variance[k].max() > 10 * track.variance[k - 1].max()
    if name != "gyro":
        assert error_deg(track.q, moved.q)[-50:].max() < 6
    assert error_deg(track.q[k - 1], track.q[k]) < (5 if name == "gyro" else 180)


@pytest.mark.parametrize("name", OURS)
def test_a_missing_rate_is_flagged_and_widens_the_variance(name):
    moved = Moved(seconds=3)
    moved.gyr[60:80] = np.nan
    track = moved.run(name)
    assert np.flatnonzero(track.flags & NO_GYR).tolist() == list(range(60, 80))
    assert track.variance[79].max() > 1.5 * track.variance[59].max()


@pytest.mark.parametrize("name", CORRECTED)
def test_without_a_magnetometer_the_tilt_is_kept_and_the_heading_is_not_believed(name):
    moved = Moved(seconds=10, noise=1.0)
    tilted = so3.quat_multiply(so3.quat_exp([0.2, -0.1, 0.0]), moved.q[0])
    moved.mag[:] = np.nan
    track = moved.run(name, tilted, sd=(0.3, 0.3, 0.05))
    sound(track)
    up = so3.matrix_from_quat(track.q[-1])[2] @ so3.matrix_from_quat(moved.q[-1])[2]
    assert np.degrees(np.arccos(up)) < 2.5
    assert track.variance[-1, 2] > track.variance[0, 2]
    assert not np.any(track.flags & MAG)


@pytest.mark.parametrize("name", OURS)
def test_long_rest_neither_drifts_nor_loses_its_covariance(name):
    """A million samples of rest; five hundred where there is no compiled filter."""
    from margcal.core import compiled

    n = 1_000_000 if compiled.extension() is not None else 500
    moved = np.zeros((n, 3))
    f = find_filter(name)
    start = f.start(so3.quat_exp([0.3, 0.2, -0.4]))
    acc, mag = ideal(so3.exp(np.array([[0.3, 0.2, -0.4]])))
    track = f.batch(
        f.params(PLACE), start, np.full(n, 0.01), moved, np.broadcast_to(acc, (n, 3)), np.broadcast_to(mag, (n, 3))
    )
    sound(track)
    assert error_deg(track.q[-1], so3.quat_exp([0.3, 0.2, -0.4])) < 1e-6


def test_registry_names_and_default():
    assert next(iter(FILTERS)) == DEFAULT
    for f in FILTERS.values():
        assert f.text
        assert (f.step is None) == (f.name == "vqf-offline")
    with pytest.raises(UsageError, match="choose one of vector-selection, ekf-quest"):
        find_filter("kalman")


# --- the public filter --------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["vqf", "vqf-offline"])
def test_vqf_behind_the_same_call(name):
    pytest.importorskip("vqf")
    moved = Moved(seconds=20, rate=100, noise=1.0)
    track = moved.run(name)
    assert np.isfinite(track.q).all()
    assert np.isnan(track.variance).all()
    assert error_deg(track.q, moved.q)[500:].max() < 3
    jitter = moved.dt * np.where(np.arange(len(moved.dt)) % 2, 1.3, 0.7)  # the samples stay where they were, nearly
    f = find_filter(name)
    uneven = f.batch(f.params(PLACE), f.start(moved.q[0]), jitter, moved.gyr, moved.acc, moved.mag)
    assert error_deg(uneven.q, moved.q)[500:].max() < 4
    moved.gyr[300:310], moved.mag[400:600], moved.acc[700:720] = np.nan, np.nan, np.nan
    assert np.isfinite(moved.run(name).q).all()


def test_vqf_can_be_paused_and_begins_anew_after_a_gap():
    pytest.importorskip("vqf")
    moved = Moved(seconds=6, rate=100, noise=1.0)
    f = find_filter("vqf")
    whole, first = moved.run("vqf"), moved.run("vqf", part=slice(0, 200))
    state = from_plain(type(first.state), json.loads(json.dumps(to_plain(first.state))))
    rest = f.batch(f.params(PLACE), state, moved.dt[200:], moved.gyr[200:], moved.acc[200:], moved.mag[200:])
    assert rest.q == pytest.approx(whole.q[200:], abs=1e-12)
    moved.dt[300] = 5.0
    assert np.flatnonzero(moved.run("vqf").flags & GAP).tolist() == [300]


def test_vqf_that_is_not_installed_says_how_to_get_it(monkeypatch):
    import sys

    from margcal.core.errors import InputError

    monkeypatch.setitem(sys.modules, "vqf", None)
    with pytest.raises(InputError, match=r"pip install 'margcal\[vqf\]'"):
        Moved(seconds=1).run("vqf")
    assert strapdown.Params().gap > 0
