"""Gyroscope: integration, solvers and starts against simulated truth, closed forms and the Cramer-Rao bound.

The truth comes from scipy's Rotation composed sample by sample, never from the functions under test.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from margcal.core import so3
from margcal.core.errors import DataError, InputError
from margcal.core.types import Turn
from margcal.methods import gyro, gyro_paper, gyro_start, preintegration
from margcal.methods.gyro_bound import bound
from margcal.methods.preintegration import TurnBatch

NEAR_IDENTITY = np.eye(3) + np.array([[0.06, -0.03, 0.05], [0.02, -0.05, 0.04], [-0.06, 0.03, 0.04]])
PERMUTED = np.array([[0.0, -1, 0], [0, 0, 1], [1, 0, 0]])


@dataclass
class World:
    """Turns, their noise-free twins and what is true of them."""

    turns: TurnBatch
    clean: TurnBatch
    dR: np.ndarray
    q: np.ndarray  # on the branch of the motion
    up_before: np.ndarray
    up_after: np.ndarray
    up_along: np.ndarray


def simulate(
    H: np.ndarray,
    *,
    seed: int = 0,
    n_turns: int = 10,
    n: int = 100,
    angle: tuple[float, float] = (np.pi, np.pi),
    wobble: float = 0.0,
    sd: float = 0.0,
    B: np.ndarray | None = None,
    duration: float = 1.0,
) -> World:
    """Turns about random axes by `angle` with a bell-shaped rate, and `wobble` rad/s about other axes."""
    rng = np.random.default_rng(seed)
    B = np.zeros(3) if B is None else B
    dt = duration / n
    s = (np.arange(n) + 0.5) / n
    axis = rng.normal(size=(n_turns, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    size = rng.uniform(*angle, size=n_turns)[:, None, None]
    u = size / duration * axis[:, None] * (1 - np.cos(2 * np.pi * s))[:, None]
    u = u + wobble * rng.normal(size=(n_turns, 1, 3)) * np.sin(2 * np.pi * s)[:, None]
    start = Rotation.random(n_turns, seed)
    attitude, along, branch = start, [], np.tile([1.0, 0, 0, 0], (n_turns, 1))
    for i in range(n):
        step = Rotation.from_rotvec(u[:, i] * dt)
        half = (attitude * Rotation.from_rotvec(u[:, i] * dt / 2)).inv()
        along.append(half.apply([0, 0, 1]))
        attitude = attitude * step
        now = (start.inv() * attitude).as_quat(scalar_first=True)
        branch = np.where(np.sum(now * branch, axis=1, keepdims=True) < 0, -now, now)
    y = u @ np.linalg.inv(H).T + B
    noisy = y + sd * rng.normal(size=y.shape)
    steps = np.full((n_turns, n), dt)
    return World(
        TurnBatch(noisy, steps),
        TurnBatch(y, steps),
        (start.inv() * attitude).as_matrix(),
        branch,
        start.inv().apply([0, 0, 1]),
        attitude.inv().apply([0, 0, 1]),
        np.stack(along, axis=1),
    )


def relative(H: np.ndarray, truth: np.ndarray) -> float:
    return float(np.linalg.norm(H - truth) / np.linalg.norm(truth))


def redraw(world: World, rng: np.random.Generator, sd: float) -> TurnBatch:
    """The same turns with fresh noise."""
    return TurnBatch(world.clean.y + sd * rng.normal(size=world.clean.y.shape), world.clean.dt)


# --- integration ------------------------------------------------------------------------------------------------------


def test_a_quarter_turn_to_the_left_has_the_right_sign():
    # the gyroscope reads +90 degrees about z: the body's x axis swings to where its y axis was, so what lay along
    # the body's +x before lies along its -y after
    y, dt = np.tile([0, 0, np.pi / 2], (50, 1)), np.full(50, 0.02)
    dR = preintegration.integrate(y, dt, np.eye(3))
    np.testing.assert_allclose(dR @ [0, -1, 0], [1, 0, 0], atol=1e-12)
    q = preintegration.integrate_quat(y, dt, np.eye(3))
    np.testing.assert_allclose(q, [np.sqrt(0.5), 0, 0, np.sqrt(0.5)], atol=1e-12)


def test_integration_composes_in_the_order_of_the_samples():
    B = np.array([3.0, -2.0, 1.0])
    world = simulate(NEAR_IDENTITY, wobble=3, B=B, angle=(1, 4))
    dR = preintegration.integrate(world.turns.y, world.turns.dt, NEAR_IDENTITY, B)
    np.testing.assert_allclose(dR, world.dR, atol=1e-12)
    v_before = dR @ world.up_after[..., None]
    np.testing.assert_allclose(v_before[..., 0], world.up_before, atol=1e-12)


def test_quaternion_keeps_the_branch_of_the_motion():
    world = simulate(np.eye(3), angle=(np.radians(200), np.radians(300)))
    q = preintegration.integrate_quat(world.turns.y, world.turns.dt, np.eye(3))
    np.testing.assert_allclose(q, world.q, atol=1e-12)
    assert (q[:, 0] < 0).all()


def test_hypotheses_and_turns_broadcast():
    world = simulate(NEAR_IDENTITY, n_turns=4, wobble=2)
    guesses = NEAR_IDENTITY * np.array([0.5, 1.0, 1.5])[:, None, None]
    together = preintegration.integrate(world.turns.y, world.turns.dt, guesses[:, None])
    assert together.shape == (3, 4, 3, 3)
    for i in range(3):
        alone = preintegration.integrate(world.turns.y, world.turns.dt, guesses[i])
        np.testing.assert_allclose(together[i], alone, atol=1e-13)


def test_padding_changes_nothing():
    world = simulate(NEAR_IDENTITY, n_turns=3, wobble=2, sd=0.1)
    turns = [
        Turn(j, j + 1, np.arange(n) * 0.01, world.turns.y[j, :n], world.turns.dt[j, :n])
        for j, n in enumerate((100, 37, 1))
    ]
    batch = preintegration.pad(turns)
    step = preintegration.preintegrate(batch.y, batch.dt, NEAR_IDENTITY, np.ones(3), 0.1)
    for j, turn in enumerate(turns):
        alone = preintegration.preintegrate(turn.y[None], turn.dt[None], NEAR_IDENTITY, np.ones(3), 0.1)
        for name in ("dR", "J_H", "J_B", "C"):
            np.testing.assert_allclose(getattr(step, name)[j], getattr(alone, name)[0], atol=1e-12)


def test_long_batches_worked_in_pieces_give_the_same():
    world = simulate(NEAR_IDENTITY, n_turns=6, n=1000, wobble=2)
    whole = preintegration.preintegrate(world.turns.y, world.turns.dt, NEAR_IDENTITY, None, 0.1)
    for j in range(6):
        alone = preintegration.preintegrate(world.turns.y[j], world.turns.dt[j], NEAR_IDENTITY, None, 0.1)
        for name in ("dR", "J_H", "J_B", "C"):
            np.testing.assert_allclose(getattr(whole, name)[j], getattr(alone, name), atol=1e-11)


@pytest.mark.parametrize("n", [100, 8])  # small steps go by series, large ones by closed forms
def test_jacobians_are_the_derivatives(n: int):
    B = np.array([0.3, -0.2, 0.1])
    world = simulate(NEAR_IDENTITY, n=n, wobble=3, B=B)
    y, dt = world.turns.y, world.turns.dt
    step = preintegration.preintegrate(y, dt, NEAR_IDENTITY, B)
    np.testing.assert_allclose(step.dR, world.dR, atol=1e-12)
    h = 1e-6
    for k, E in enumerate(np.eye(9).reshape(9, 3, 3)):
        up = preintegration.integrate(y, dt, NEAR_IDENTITY + h * E, B)
        down = preintegration.integrate(y, dt, NEAR_IDENTITY - h * E, B)
        slope = so3.log(np.swapaxes(down, -1, -2) @ up) / (2 * h)
        np.testing.assert_allclose(step.J_H[..., k], slope, atol=1e-6)
    for k, e in enumerate(np.eye(3)):
        up, down = (preintegration.integrate(y, dt, NEAR_IDENTITY, B + sign * h * e) for sign in (1, -1))
        np.testing.assert_allclose(step.J_B[..., k], so3.log(np.swapaxes(down, -1, -2) @ up) / (2 * h), atol=1e-6)


def test_noise_of_the_readings_turns_into_this_covariance():
    rng, sd = np.random.default_rng(5), np.array([0.02, 0.05, 0.1])
    world = simulate(NEAR_IDENTITY, n_turns=1, n=60, wobble=3)
    y = world.turns.y[0] + sd * rng.normal(size=(6000, 60, 3))
    dR = preintegration.integrate(y, world.turns.dt[0], NEAR_IDENTITY)
    scatter = so3.log(world.dR[0].T @ dR)
    C = preintegration.preintegrate(world.turns.y, world.turns.dt, NEAR_IDENTITY, None, sd).C[0]
    root = np.linalg.inv(np.linalg.cholesky(C))
    np.testing.assert_allclose(np.cov((scatter @ root.T).T), np.eye(3), atol=0.08)


def test_readings_that_are_not_numbers_are_refused():
    turn = Turn(2, 3, np.arange(3.0), np.array([[0, 0, 0], [np.nan, 0, 0], [0, 0, 0.0]]), np.ones(3))
    with pytest.raises(InputError, match="rest 2 to 3"):
        preintegration.pad([turn])
    with pytest.raises(InputError, match="no turn"):
        preintegration.pad([])


# --- gauss_newton -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [1.0, 2.2, 0.45])
def test_recovery_without_noise_from_nominal_and_from_wrong_scales(scale: float):
    world = simulate(NEAR_IDENTITY, wobble=2)
    fit = gyro.gauss_newton(world.turns, world.dR, H0=scale * np.eye(3))
    assert fit.converged and relative(fit.model.H, NEAR_IDENTITY) < 1e-9


def test_bias_is_recovered_jointly():
    B = np.array([0.03, -0.02, 0.05])
    world = simulate(NEAR_IDENTITY, wobble=2, B=B)
    fit = gyro.gauss_newton(world.turns, world.dR, H0=np.eye(3), bias_prior=(B + 0.02, 0.05**2 * np.eye(3)))
    assert relative(fit.model.H, NEAR_IDENTITY) < 1e-9
    np.testing.assert_allclose(fit.model.B, B, atol=1e-6)
    assert fit.rank == 12


@pytest.mark.parametrize("mirror", [1, -1])
def test_raw_counts_of_permuted_and_mirrored_axes_need_no_start(mirror: int):
    H, B = mirror * PERMUTED @ NEAR_IDENTITY * 2e-4, np.array([32768.0, 32700.0, 33000.0])
    world = simulate(H, n_turns=12, wobble=1.5, B=B, angle=(1, 4), sd=5)
    fit = gyro.gauss_newton(world.turns, world.dR, B0=B, sd=5)
    assert fit.converged and relative(fit.model.H, H) < 3e-4


def test_rms_error_is_the_cramer_rao_bound_after_three_iterations():
    """Z-TIE Table II: 180-degree turns of 1 s at 100 Hz, standard deviation .05 rad/s."""
    rng, third, last = np.random.default_rng(8), [], []
    worlds = [simulate(NEAR_IDENTITY, seed=seed) for seed in range(30)]
    for world in worlds * 9:
        fit = gyro.gauss_newton(redraw(world, rng, 0.05), world.dR, H0=np.eye(3), sd=0.05, sigma_angle=0.0)
        path = fit.history["H"]
        third.append(np.linalg.norm(path[min(3, fit.n_iter)] - NEAR_IDENTITY))
        last.append(np.linalg.norm(path[-1] - NEAR_IDENTITY))
    limit = [np.trace(bound(world.clean, NEAR_IDENTITY, sd=0.05)) for world in worlds]
    rms = np.sqrt(np.mean(np.square(last)))
    assert 0.95 <= rms / np.sqrt(np.mean(limit)) <= 1.06
    assert np.sqrt(np.mean(np.square(third))) <= 1.05 * rms
    assert np.mean(last) <= 0.0045


def test_stated_covariance_covers_the_error_of_h_and_b():
    rng, nees, B, prior_sd = np.random.default_rng(9), [], np.array([5.0, -3.0, 2.0]), 0.02
    worlds = [simulate(NEAR_IDENTITY, seed=seed, n_turns=16, n=50, wobble=1, B=B) for seed in range(10)]
    for world in worlds * 15:
        turns = redraw(world, rng, 0.05)
        noise = Rotation.from_rotvec(0.01 * rng.normal(size=(16, 3))).as_matrix()
        prior = (B + prior_sd * rng.normal(size=3), prior_sd**2 * np.eye(3))
        fit = gyro.gauss_newton(turns, world.dR @ noise, H0=np.eye(3), bias_prior=prior, sd=0.05, sigma_angle=0.01)
        error = np.concatenate([(fit.model.H - NEAR_IDENTITY).ravel(), fit.model.B - B])
        assert fit.covariance is not None
        nees.append(error @ np.linalg.solve(fit.covariance, error))
    assert np.mean(nees) == pytest.approx(12, abs=3 * np.sqrt(24 / 150))


def test_noise_of_the_rotations_is_estimated():
    rng, found = np.random.default_rng(10), []
    world = simulate(NEAR_IDENTITY, n_turns=20, n=50, sd=0.01)
    for _ in range(40):
        noise = Rotation.from_rotvec(0.02 * rng.normal(size=(20, 3))).as_matrix()
        fit = gyro.gauss_newton(world.turns, world.dR @ noise, H0=np.eye(3), sd=0.01)
        found.append(float(fit.history["sigma_angle"]))
    assert np.mean(found) == pytest.approx(0.02, rel=0.1)


@pytest.mark.parametrize("sd", [None, 0.05])
def test_one_bad_turn_is_held_down_and_named(sd: float | None):
    world = simulate(NEAR_IDENTITY, n_turns=12, wobble=1, sd=0.05)
    dR = world.dR.copy()
    dR[3] = dR[3] @ Rotation.from_euler("z", 90, degrees=True).as_matrix()
    fit = gyro.gauss_newton(world.turns, dR, H0=np.eye(3), sd=sd)
    good = gyro.gauss_newton(world.turns.select(np.arange(12) != 3), np.delete(dR, 3, 0), H0=np.eye(3), sd=sd)
    assert np.argmax(fit.residual) == 3 and fit.residual[3] == pytest.approx(np.pi / 2, abs=0.05)
    assert fit.history["weights"][3] < 0.01 and np.delete(fit.history["weights"], 3).min() > 0.5
    assert np.linalg.norm(fit.model.H - good.model.H) < 0.1 * np.linalg.norm(good.model.H - NEAR_IDENTITY) + 1e-4


def test_turns_about_one_axis_are_said_to_be_too_few():
    y = np.tile([0, 0, 2.0], (6, 50, 1)) * np.array([1, -1, 0.5, 0.7, -0.6, 0.9])[:, None, None]
    turns = TurnBatch(y, np.full((6, 50), 0.01))
    dR = Rotation.from_rotvec(y.sum(axis=1) * 0.01).as_matrix()
    fit = gyro.gauss_newton(turns, dR, H0=np.eye(3))
    assert not fit.converged and fit.rank == 3 and fit.covariance is None
    assert "three different axes" in fit.text
    with pytest.raises(DataError, match="three axes"):
        bound(turns, np.eye(3), sd=0.05)


def test_numbers_that_do_not_match_are_refused():
    world = simulate(np.eye(3), n_turns=4)
    with pytest.raises(InputError, match="4 turns but attitudes or directions for 3"):
        gyro.gauss_newton(world.turns, world.dR[:3], H0=np.eye(3))
    with pytest.raises(InputError, match="positive definite"):
        gyro.gauss_newton(world.turns, world.dR, H0=np.eye(3), bias_prior=(np.zeros(3), np.zeros((3, 3))))
    with pytest.raises(DataError, match="no start"):
        gyro.propagate_gravity(world.turns, world.up_before, world.up_after)


def test_known_rotations_take_components_from_after_to_before():
    R = Rotation.random(3, 0)
    turns = [
        Turn(0, 1, np.zeros(1), np.zeros((1, 3)), np.ones(1)),
        Turn(2, 0, np.zeros(1), np.zeros((1, 3)), np.ones(1)),
    ]
    dR = gyro.known_rotations(R.as_matrix(), turns)
    fixed = np.array([0.3, -0.5, 0.8])
    for turn, rotation in zip(turns, dR):
        before, after = (R[i].inv().apply(fixed) for i in (turn.before, turn.after))
        np.testing.assert_allclose(rotation @ after, before, atol=1e-12)


def test_mean_bias_is_the_mean_of_the_rests():
    np.testing.assert_allclose(gyro.mean_bias([[1, 2, 3], [3, 2, 1], [np.nan] * 3]), [2, 2, 2])


# --- propagate_gravity ------------------------------------------------------------------------------------------------


def test_gravity_alone_recovers_h_and_b_without_noise():
    B = np.array([0.02, -0.03, 0.01])
    world = simulate(NEAR_IDENTITY, n_turns=15, wobble=2, B=B)
    fit = gyro.propagate_gravity(
        world.turns, 9.8 * world.up_before, 9.7 * world.up_after, H0=np.eye(3), bias_prior=(B + 0.01, 1e-4 * np.eye(3))
    )
    assert fit.converged and relative(fit.model.H, NEAR_IDENTITY) < 1e-8
    np.testing.assert_allclose(fit.model.B, B, atol=1e-6)
    assert fit.residual.max() < 1e-7


@pytest.mark.parametrize("mirror", [1, -1])
def test_gravity_along_the_turn_replaces_the_nominal_scale(mirror: int):
    H, B = mirror * PERMUTED @ NEAR_IDENTITY * 2e-4, np.array([32768.0, 32700.0, 33000.0])
    world = simulate(H, n_turns=15, wobble=1.5, B=B, angle=(1, 4), sd=5)
    shaken = world.up_along + 0.1 * np.random.default_rng(0).normal(size=world.up_along.shape)
    start = gyro_start.linear_start(world.turns, shaken, B=B, before=world.up_before, after=world.up_after)
    assert relative(start, H) < 0.06
    fit = gyro.propagate_gravity(world.turns, world.up_before, world.up_after, along=shaken, B0=B, sd=5)
    assert fit.converged and relative(fit.model.H, H) < 5e-4


def test_linear_start_is_exact_up_to_the_sampling():
    world = simulate(PERMUTED @ NEAR_IDENTITY, n_turns=12, n=800, wobble=2)
    errors = [
        relative(gyro_start.linear_start(thinned, world.up_along[:, offset::every]), PERMUTED @ NEAR_IDENTITY)
        for every, offset in ((8, 3), (1, 0))
        for thinned in [TurnBatch(world.turns.y[:, offset::every], every * world.turns.dt[:, ::every])]
    ]
    assert errors[1] < 0.01 and errors[1] < errors[0]


def test_gravity_errors_have_the_stated_covariance_with_one_and_two_directions():
    field = Rotation.from_euler("y", 60, degrees=True).apply([0, 0, 1])
    worlds = [simulate(NEAR_IDENTITY, seed=seed, n_turns=16, n=50, wobble=1) for seed in range(10)]
    for several in (False, True):
        rng, nees = np.random.default_rng(11), []
        for seed, world in list(enumerate(worlds)) * 10:
            before, after = world.up_before[:, None], world.up_after[:, None]
            if several:
                start = Rotation.random(16, seed)
                m_before = start.inv().apply(field)
                m_after = np.einsum("tji,tj->ti", world.dR, m_before)
                before, after = (np.stack(pair, 1) for pair in ((before[:, 0], m_before), (after[:, 0], m_after)))
            noisy = after + 0.005 * rng.normal(size=after.shape)
            turns = redraw(world, rng, 0.05)
            fit = gyro.propagate_gravity(turns, before, noisy, H0=np.eye(3), sd=0.05, sigma_angle=0.005)
            error = (fit.model.H - NEAR_IDENTITY).ravel()
            assert fit.covariance is not None
            nees.append(error @ np.linalg.solve(fit.covariance[:9, :9], error))
        assert np.mean(nees) == pytest.approx(9, abs=3 * np.sqrt(18 / 100))


def test_a_direction_that_is_missing_in_some_turns_is_left_out_there():
    world = simulate(NEAR_IDENTITY, n_turns=15, wobble=2)
    before, after = np.stack([world.up_before] * 2, 1), np.stack([world.up_after] * 2, 1)
    before[4:, 1] = np.nan
    after[7, :] = np.nan
    fit = gyro.propagate_gravity(world.turns, before, after, H0=np.eye(3))
    assert relative(fit.model.H, NEAR_IDENTITY) < 1e-8
    assert fit.model.n_poses == 14 and fit.history["weights"][7] == 0


def test_angles_and_full_turns():
    degrees = np.array([360.0, 90.0, -352.0, 180.0])
    axes = np.array([[0, 0, 1.0], [1, 0, 0], [0.6, 0.8, 0], [0, 1, 0]])
    y = np.repeat((np.radians(degrees)[:, None] * axes)[:, None], 200, axis=1)
    turns = TurnBatch(y, np.full((4, 200), 1 / 200))
    angle = gyro_start.turn_angle(turns, np.eye(3))
    np.testing.assert_allclose(np.degrees(angle.about_axis), np.abs(degrees), atol=1e-9)
    np.testing.assert_allclose(np.degrees(angle.net), [0, 90, 8, 180], atol=1e-6)
    np.testing.assert_allclose(angle.axis, axes * np.sign(degrees)[:, None], atol=1e-9)
    found = gyro_start.full_turns(turns, np.eye(3))
    assert list(found.index) == [0, 2]
    np.testing.assert_allclose(found.angle_deg, [360, 352])


def test_a_tumble_and_a_swing_to_and_fro_are_no_full_turns():
    s = np.linspace(0, 1, 300)[:, None]
    tumble = 2 * np.pi * np.hstack([np.sin(9 * s), np.cos(9 * s), np.sin(5 * s)])
    swing = np.hstack([0 * s, 0 * s, np.where(s < 0.6, 4 * np.pi * 0.9, -4 * np.pi * 0.2)])
    turns = TurnBatch(np.stack([tumble, swing]), np.full((2, 300), 1 / 300))
    assert len(gyro_start.full_turns(turns, np.eye(3), low_deg=300, high_deg=420).index) == 0


# --- the paper's methods ----------------------------------------------------------------------------------------------


def test_ukf_without_noise_ends_at_the_truth():
    world = simulate(NEAR_IDENTITY)
    fit = gyro_paper.ukf(world.turns, world.dR, H0=np.eye(3), q=world.q, n_iter=20)
    assert relative(fit.model.H, NEAR_IDENTITY) <= 1e-6
    assert fit.history["H"].shape == (21, 3, 3) and np.array_equal(fit.history["H"][0], np.eye(3))


def test_ukf_is_at_its_floor_by_iteration_five_for_runs_side_by_side():
    worlds = [simulate(NEAR_IDENTITY, seed=seed, sd=0.05, n=50) for seed in range(40)]
    batch = TurnBatch(np.stack([w.turns.y for w in worlds]), worlds[0].turns.dt)
    fit = gyro_paper.ukf(batch, q=np.stack([w.q for w in worlds]), H0=np.eye(3), n_iter=12)
    error = np.linalg.norm(fit.history["H"] - NEAR_IDENTITY, axis=(-2, -1))
    assert error[5].mean() == pytest.approx(error[-1].mean(), rel=0.01)
    alone = gyro_paper.ukf(worlds[7].turns, q=worlds[7].q, H0=np.eye(3), n_iter=12)
    np.testing.assert_allclose(fit.model.H[7], alone.model.H, rtol=1e-7)


def test_ukf_takes_counts_with_their_nominal_scale():
    world = simulate(NEAR_IDENTITY, angle=(1, 3), wobble=1)
    counts = TurnBatch(world.turns.y * 4000 + 100, world.turns.dt)
    fit = gyro_paper.ukf(counts, world.dR, H0=np.eye(3) / 4000, B=np.full(3, 100.0), n_iter=20, scale=1 / 4000)
    assert relative(fit.model.H * 4000, NEAR_IDENTITY) <= 1e-6


def test_labels_follow_the_motion_not_the_positive_scalar_part():
    world = simulate(NEAR_IDENTITY, angle=(np.radians(60), np.radians(270)))
    np.testing.assert_allclose(gyro_paper.labels(world.turns, world.dR, np.eye(3)), world.q, atol=1e-9)
    assert (world.q[:, 0] < 0).any()


@pytest.mark.parametrize(
    ("solver", "bar"),
    [(gyro_paper.quasi_newton, 1e-8), (gyro_paper.trust_region, 1e-9), (gyro_paper.nelder_mead, 1e-5)],
)
def test_baselines_minimise_the_papers_cost(solver: Callable[..., object], bar: float):
    world = simulate(NEAR_IDENTITY, n=20)
    fit = solver(world.turns, world.dR, H0=np.eye(3), q=world.q)
    assert relative(fit.model.H, NEAR_IDENTITY) < bar  # type: ignore[attr-defined]
    path = fit.history["H"]  # type: ignore[attr-defined]
    assert np.array_equal(path[0], np.eye(3)) and len(path) == fit.n_iter + 1  # type: ignore[attr-defined]


def test_baselines_and_ukf_agree_on_noisy_data():
    world = simulate(NEAR_IDENTITY, sd=0.05, angle=(2, 3))
    trust = gyro_paper.trust_region(world.turns, world.dR, H0=np.eye(3), q=world.q)
    numerical = gyro_paper.trust_region(world.turns, world.dR, H0=np.eye(3), q=world.q, numerical=True)
    newton = gyro_paper.quasi_newton(world.turns, world.dR, H0=np.eye(3), q=world.q)
    np.testing.assert_allclose(newton.model.H, trust.model.H, atol=1e-6)
    np.testing.assert_allclose(numerical.model.H, trust.model.H, atol=1e-6)
    filtered = gyro_paper.ukf(world.turns, world.dR, H0=np.eye(3), q=world.q, n_iter=30)
    assert np.linalg.norm(filtered.model.H - trust.model.H) < 0.2 * np.linalg.norm(trust.model.H - NEAR_IDENTITY) + 1e-3


# --- real readings ----------------------------------------------------------------------------------------------------


def test_xsens_scale_factors_by_gravity(data_file: Callable[[str], Path]):
    """Factory sheet 4778/4758/4766 LSB per rad/s; rests by a crude threshold, so that this test stands alone."""
    import pyarrow.parquet as pq

    table = pq.read_table(data_file("imu_tk/xsens_mti_multipose.parquet"))
    t = table["t_s"].to_numpy()
    acc, gyr = (
        np.column_stack([table[f"{s}_{a}_count"].to_numpy() for a in "xyz"]).astype(float) for s in ("acc", "gyr")
    )
    # the triangular fit of the rests: bias, and H from scale factors 414.4 / 412.1 / 414.6 and its cross terms
    H_acc = np.linalg.inv(np.diag([414.42, 412.03, 414.62]))
    B_acc = np.array([33123.8, 33275.2, 32364.5])
    rests = _crude_rests(acc)
    means = np.array([acc[a:b].mean(axis=0) for a, b in rests])
    H_acc = _triangular(means - B_acc, H_acc)
    u = (acc - B_acc) @ H_acc.T
    up = np.array([u[a:b].mean(axis=0) for a, b in rests])
    still = np.array([gyr[a:b].mean(axis=0) for a, b in rests])
    sd = np.median([gyr[a:b].std(axis=0) for a, b in rests], axis=0)
    turns = [
        Turn(j, j + 1, t[b:c], gyr[b:c], np.gradient(t)[b:c]) for j, ((_, b), (c, _)) in enumerate(pairwise(rests))
    ]
    turns = [turn for turn in turns if turn.y.max() < 65300]
    ends = (up[[turn.before for turn in turns]], up[[turn.after for turn in turns]])
    prior = (gyro.mean_bias(still), np.diag(still.var(axis=0) / len(still)))
    fit = gyro.propagate_gravity(turns, *ends, along=preintegration.along(turns, t, u), bias_prior=prior, sd=sd)
    assert fit.converged
    np.testing.assert_allclose(1 / np.diag(fit.model.H), [4778, 4758, 4766], rtol=0.005)
    assert np.degrees(fit.model.residual_rms or np.inf) < 0.6


def _crude_rests(acc: np.ndarray, width: int = 100) -> list[tuple[int, int]]:
    centred = acc - acc.mean(axis=0)
    sums, squares = (np.cumsum(np.vstack([np.zeros(3), x]), axis=0) for x in (centred, centred**2))
    mean = (sums[width:] - sums[:-width]) / width
    variance = ((squares[width:] - squares[:-width]) / width - mean**2).sum(axis=1)
    still = np.concatenate([[False], variance < 8 * np.percentile(variance, 10), [False]])
    edges = np.flatnonzero(np.diff(still.astype(int)))
    return [(a + width // 2, b + width // 2) for a, b in zip(edges[::2], edges[1::2]) if b - a > width]


def _triangular(x: np.ndarray, H: np.ndarray) -> np.ndarray:
    """Upper-triangular H with |H x| = 9.81744, by Newton on H^T H (linear in it)."""
    pairs = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]
    scaled = x @ H.T / 9.81744
    A = np.column_stack([scaled[:, i] * scaled[:, k] * (1 if i == k else 2) for i, k in pairs])
    found = np.linalg.lstsq(A, np.ones(len(x)), rcond=None)[0]
    M = np.zeros((3, 3))
    for value, (i, k) in zip(found, pairs):
        M[i, k] = M[k, i] = value
    return np.linalg.cholesky(M).T @ H
