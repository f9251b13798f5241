"""The Cramer-Rao bound, and `one_step` against it."""

from __future__ import annotations

import numpy as np
import pytest

from margcal.core import so3
from margcal.core.errors import DataError
from margcal.core.types import Array
from margcal.methods.affine import tangents
from margcal.methods.bounds import cramer_rao, monte_carlo, reading_jacobian, simulated_readings
from margcal.methods.transform import one_step

H = np.array([[0.0210, -0.0024, 0.0034], [0.0, 0.0238, 0.0022], [0.0021, 0.0024, 0.0224]])
B = np.array([2429.0, 2318.0, 2368.0])
u = np.array([2.6191601, 5.2383203, 7.8574805])


def random_poses(n: int, rng: np.random.Generator) -> Array:
    return so3.matrix_from_quat(rng.normal(size=(n, 4)))


def euler_poses(n: int, rng: np.random.Generator) -> Array:
    """Euler angles U[0, 180] degrees, as in the papers."""
    a = rng.uniform(0, np.pi, size=(n, 3))
    turns = [so3.exp(a[:, k, None] * np.eye(3)[k]) for k in range(3)]
    return turns[2] @ turns[1] @ turns[0]


def cone_poses(n: int, rng: np.random.Generator) -> Array:
    """Turned by up to 60 degrees from one attitude."""
    axis = rng.normal(size=(n, 3))
    return so3.exp(axis / np.linalg.norm(axis, axis=1, keepdims=True) * rng.uniform(0, np.pi / 3, size=(n, 1)))


def test_jacobian_matches_differences():
    rng = np.random.default_rng(1)
    R, T = random_poses(6, rng), tangents(u)

    def at(x: Array) -> Array:
        return (R @ (u + T @ x[12:])) @ np.linalg.inv(H + x[:9].reshape(3, 3)).T + x[9:12]

    steps = np.concatenate([np.full(9, 1e-7), np.full(5, 1e-4)])
    numeric = np.stack([(at(e) - at(-e)) / (2 * e.max()) for e in np.diag(steps)], axis=-1)
    assert np.allclose(reading_jacobian(H, u, R), numeric, rtol=1e-5, atol=1e-3)


def test_closed_form_for_the_mean():
    """With H and u known the bound on B would be sigma^2/J; unknown, it can only be larger."""
    R = random_poses(20, np.random.default_rng(2))
    bound = cramer_rao(H, u, R, 1.4)
    assert bound.B_rms > 1.4 * np.sqrt(3 / 20)


def test_bound_scales_as_it_must():
    R = random_poses(15, np.random.default_rng(3))
    one = cramer_rao(H, u, R, 1.0)
    assert np.allclose(cramer_rao(H, u, R, 2.0).covariance, 4 * one.covariance, rtol=1e-9)
    twice = cramer_rao(H, u, np.concatenate([R, R]), 1.0)
    assert np.allclose(twice.covariance, one.covariance / 2, rtol=1e-9)
    assert np.allclose(twice.u_covariance, one.u_covariance / 2, rtol=1e-9)
    # in other raw units: B in twice the number of counts, H half as large
    other = cramer_rao(H / 2, u, R, 2.0)
    assert np.isclose(other.B_rms, 2 * one.B_rms)
    assert np.isclose(other.H_rms, one.H_rms / 2)
    assert np.isclose(one.u_covariance @ u @ u, 0, atol=1e-12)


def test_poses_about_one_axis_have_no_bound():
    R = so3.exp(np.linspace(0, 6, 12)[:, None] * [0, 0, 1])
    with pytest.raises(DataError, match="of 14 unknowns"):
        cramer_rao(H, u, R, 1.0)


COUNTS = 417.0  # |u| in raw units: .33 % noise is 1.39 counts

SETTINGS = {
    "random 10": (random_poses, 10, 0.0033),
    "random 20": (random_poses, 20, 0.0033),
    "random 30": (random_poses, 30, 0.0033),
    "random 20, 3.3 %": (random_poses, 20, 0.033),
    "Euler 0..180": (euler_poses, 20, 0.0033),
    "cone 60": (cone_poses, 20, 0.0033),
}


@pytest.mark.parametrize("name", SETTINGS)
def test_one_step_reaches_the_bound(name):
    poses, n, noise = SETTINGS[name]
    rng = np.random.default_rng(4)
    R = poses(n, rng)
    found = monte_carlo(one_step, H, B, u, R, noise * COUNTS, 2000, rng)
    assert found.lost == 0
    for ratio in (found.H, found.B, found.u):
        assert 0.95 <= ratio <= 1.06


def test_one_step_predicts_its_own_covariance():
    """Normalised squared error over runs: 12 degrees of freedom on average."""
    rng = np.random.default_rng(5)
    R = random_poses(20, rng)
    nees = []
    for y in simulated_readings(H, B, u, R, 1.39, 300, rng):
        fit = one_step(y, R, float(np.linalg.norm(u)), sigma=1.39)
        error = np.concatenate([(fit.model.H - H).ravel(), fit.model.B - B])
        nees.append(error @ np.linalg.solve(fit.covariance, error))
    assert abs(np.mean(nees) - 12) < 4 * np.sqrt(24 / 300)


def test_monte_carlo_one_by_one_is_the_batch():
    R = random_poses(12, np.random.default_rng(6))
    a = monte_carlo(one_step, H, B, u, R, 1.0, 20, np.random.default_rng(7))
    b = monte_carlo(one_step, H, B, u, R, 1.0, 20, np.random.default_rng(7), batch=False)
    assert np.allclose(a.errors, b.errors, rtol=1e-6, atol=1e-9)


def test_mirrored_truth_is_compared_with_its_own_sign():
    R = random_poses(12, np.random.default_rng(8))
    a = monte_carlo(one_step, H, B, u, R, 1.0, 50, np.random.default_rng(9))
    b = monte_carlo(one_step, -H, B, -u, R, 1.0, 50, np.random.default_rng(9))
    assert np.isclose(a.H, b.H, rtol=1e-6)
    assert np.isclose(a.u, b.u, rtol=1e-6)
