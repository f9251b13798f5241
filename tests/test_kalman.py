"""Kalman steps against closed forms: batch least squares, moments of a square, the textbook's weighted sums."""

from __future__ import annotations

import numpy as np
import pytest

from margcal.core import kalman
from margcal.core.kalman import Sigma


def _spd(rng: np.random.Generator, n: int) -> np.ndarray:
    A = rng.normal(size=(n, n))
    return A @ A.T + n * np.eye(n)


def test_linear_corrections_end_where_batch_least_squares_does():
    rng = np.random.default_rng(1)
    prior_x, prior_P = rng.normal(size=3), _spd(rng, 3)
    rows = [rng.normal(size=(2, 3)) for _ in range(6)]
    noise = [_spd(rng, 2) for _ in range(6)]
    z = [rng.normal(size=2) for _ in range(6)]
    x, P = prior_x, prior_P
    for H, R, measured in zip(rows, noise, z):
        x, P, *_ = kalman.correct(x, P, measured, H, R)
    information = np.linalg.inv(prior_P) + sum(H.T @ np.linalg.inv(R) @ H for H, R in zip(rows, noise))
    right = np.linalg.inv(prior_P) @ prior_x + sum(H.T @ np.linalg.inv(R) @ m for H, R, m in zip(rows, noise, z))
    np.testing.assert_allclose(P, np.linalg.inv(information), rtol=1e-10)
    np.testing.assert_allclose(x, np.linalg.solve(information, right), rtol=1e-10)


def test_prediction_grows_a_random_walk():
    F = np.array([[1.0, 0.5], [0.0, 1.0]])
    x, P = kalman.predict(np.array([1.0, 2.0]), np.diag([1.0, 4.0]), F, 0.1 * np.eye(2))
    np.testing.assert_allclose(x, [2.0, 2.0])
    np.testing.assert_allclose(P, [[2.1, 2.0], [2.0, 4.1]])


@pytest.mark.parametrize("sigma", [Sigma(), Sigma(1.0, 2.0, 0.0), Sigma(0.5, 0.0, -1.0)])
def test_unscented_steps_are_the_linear_ones_on_a_linear_model(sigma: Sigma):
    rng = np.random.default_rng(2)
    x, P, F, H = rng.normal(size=4), _spd(rng, 4), rng.normal(size=(4, 4)), rng.normal(size=(2, 4))
    Q, R, z = _spd(rng, 4), _spd(rng, 2), rng.normal(size=2)
    linear = kalman.predict(x, P, F, Q)
    unscented = kalman.unscented_predict(x, P, lambda X: X @ F.T, Q, sigma)
    np.testing.assert_allclose(unscented.x, linear.x, rtol=1e-7)
    np.testing.assert_allclose(unscented.P, linear.P, rtol=1e-7)
    corrected = kalman.correct(x, P, z, H, R)
    for ours, expected in zip(kalman.unscented_correct(x, P, z, lambda X: X @ H.T, R, sigma), corrected):
        np.testing.assert_allclose(ours, expected, rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("alpha", [1e-3, 0.1, 1.0])
def test_moments_of_the_square_of_a_gaussian_are_exact_with_beta_two(alpha: float):
    m, P, sigma = 0.7, 0.3, Sigma(alpha, 2.0, 0.0)
    points = kalman.sigma_points(np.array([m]), np.array([[P]]), sigma)
    mean, cov, cross = kalman.unscented_mean_cov(points, points**2, sigma)
    assert mean[0] == pytest.approx(m**2 + P, rel=1e-9)
    assert cov[0, 0] == pytest.approx(4 * m**2 * P + 2 * P**2, rel=1e-9)
    assert cross[0, 0] == pytest.approx(2 * m * P, rel=1e-9)


def test_differences_equal_the_textbook_sums():
    rng = np.random.default_rng(3)
    n, sigma = 3, Sigma(0.8, 1.5, 0.5)
    points = kalman.sigma_points(rng.normal(size=n), _spd(rng, n), sigma)
    images = np.sin(points) @ rng.normal(size=(n, 2))
    lam = sigma.spread(n) - n
    w_mean = np.full(2 * n + 1, 0.5 / (n + lam))
    w_mean[0] = lam / (n + lam)
    w_cov = w_mean.copy()
    w_cov[0] += 1 - sigma.alpha**2 + sigma.beta
    expected = w_mean @ images
    mean, cov, _ = kalman.unscented_mean_cov(points, images, sigma)
    np.testing.assert_allclose(mean, expected, rtol=1e-12)
    np.testing.assert_allclose(cov, (w_cov[:, None] * (images - expected)).T @ (images - expected), rtol=1e-11)


def test_filters_side_by_side_are_filters_one_by_one():
    rng = np.random.default_rng(4)
    x, P = rng.normal(size=(5, 2)), np.stack([_spd(rng, 2) for _ in range(5)])
    z, R = rng.normal(size=(5, 3)), 0.1 * np.eye(3)

    def h(X: np.ndarray) -> np.ndarray:
        return np.stack([np.sin(X[..., 0]), X[..., 1] ** 2, X[..., 0] * X[..., 1]], axis=-1)

    together = kalman.unscented_correct(x, P, z, h, R)
    for i in range(5):
        alone = kalman.unscented_correct(x[i], P[i], z[i], h, R)
        np.testing.assert_allclose(together.x[i], alone.x, rtol=1e-9)
        np.testing.assert_allclose(together.P[i], alone.P, rtol=1e-7, atol=1e-12)
