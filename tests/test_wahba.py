"""Wahba's problem: four solvers against the truth, against each other, and where nothing can be said."""

from __future__ import annotations

import numpy as np
import pytest

from margcal.core import so3
from margcal.methods import wahba

SOLVERS = (wahba.quest, wahba.davenport, wahba.svd)


def random_attitudes(rng: np.random.Generator, n: int) -> np.ndarray:
    q = rng.normal(size=(n, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    q[:6] = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1], [0, 0.6, 0.8, 0], [1e-9, 0.6, 0, 0.8]]
    return np.where(q[:, :1] < 0, -q, q)


def seen_from(q: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Directions r (n, 3) of the reference in the body axes of attitudes q (k, 4): R^T r."""
    return np.einsum("kij,ni->knj", so3.matrix_from_quat(q), r)


def angle(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    return np.linalg.norm(so3.quat_log(so3.quat_multiply(so3.quat_conjugate(p), q)), axis=-1)


@pytest.mark.parametrize("solve", SOLVERS)
@pytest.mark.parametrize("n", [2, 3, 7])
def test_exact_directions_give_the_attitude_even_half_a_turn_away(solve, n):
    rng = np.random.default_rng(n)
    q, r = random_attitudes(rng, 300), rng.normal(size=(n, 3))
    found = solve(seen_from(q, r), r, rng.uniform(0.2, 3, n))
    assert found.determined.all()
    assert angle(q, found.q).max() < 2e-8
    assert found.loss.max() < 1e-14


@pytest.mark.parametrize("solve", SOLVERS)
def test_the_quaternion_takes_the_body_to_the_reference(solve):
    """A conjugated quaternion fails: the node's x axis points up, its z axis north, so its y axis east."""
    up_and_north = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    q = solve([[1.0, 0, 0], [0, 0, 1.0]], up_and_north).q
    R = so3.matrix_from_quat(q)
    assert np.allclose(R @ [1, 0, 0], [0, 0, 1], atol=1e-12)
    assert np.allclose(R @ [0, 0, 1], [0, 1, 0], atol=1e-12)
    assert np.allclose(R @ [0, 1, 0], [1, 0, 0], atol=1e-12)
    triad_R = so3.matrix_from_quat(wahba.triad([[1.0, 0, 0], [0, 0, 1.0]], up_and_north).q)
    assert triad_R == pytest.approx(R, abs=1e-12)


def test_noisy_solutions_minimise_the_loss():
    """Wahba's loss of the three solvers is the same, and turning away from it in any direction costs."""
    rng = np.random.default_rng(1)
    for n in (2, 5):
        q, r, a = random_attitudes(rng, 100), rng.normal(size=(n, 3)), rng.uniform(0.2, 3, n)
        r /= np.linalg.norm(r, axis=1, keepdims=True)
        b = seen_from(q, r) + 0.1 * rng.normal(size=(100, n, 3))
        b /= np.linalg.norm(b, axis=-1, keepdims=True)

        def loss(q, b=b, r=r, a=a):
            miss = r - np.einsum("kij,knj->kni", so3.matrix_from_quat(q), b)
            return 0.5 * np.sum(a / a.sum() * np.sum(miss**2, axis=-1), axis=-1)

        found = [solve(b, r, a) for solve in SOLVERS]
        for f in found:
            assert f.loss == pytest.approx(loss(f.q), abs=1e-13)
            assert angle(f.q, found[1].q).max() < 1e-7
        for axis in np.eye(3):
            for small in (1e-3, -1e-3):
                assert np.all(loss(so3.quat_multiply(found[0].q, so3.quat_exp(small * axis))) > found[0].loss)


def test_columns_of_the_adjugate_are_the_sequential_rotations():
    """Turning the reference by half a turn about x, y or z, solving by the Gibbs vector and turning back gives the
    same line through q as the columns of adj(K - lambda)."""
    rng = np.random.default_rng(2)
    q, r = so3.quat_exp([0.4, -1.1, 0.7]), rng.normal(size=(3, 3))
    r /= np.linalg.norm(r, axis=1, keepdims=True)
    b = seen_from(q[None], r)[0] + 0.05 * rng.normal(size=(3, 3))
    b /= np.linalg.norm(b, axis=1, keepdims=True)
    a = np.full(3, 1 / 3)
    for k, turn in enumerate(np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])):
        turned = r * turn
        K = wahba.davenport_matrix(b, turned, a)
        lam = np.linalg.eigvalsh(K)[-1]
        S, z = K[1:, 1:] + K[0, 0] * np.eye(3), K[0, 1:]
        gibbs = np.linalg.solve((lam + K[0, 0]) * np.eye(3) - S, z)  # Shuster & Oh (65)
        p = np.concatenate([[1], gibbs])
        back = so3.quat_multiply(np.eye(4)[k], p)  # half a turn about axis k
        column = wahba.adjugate(wahba.davenport_matrix(b, r, a) - lam * np.eye(4))[:, k]
        assert abs(back @ column) == pytest.approx(np.linalg.norm(back) * np.linalg.norm(column), rel=1e-9)


def test_adjugate_is_determinant_times_inverse():
    M = np.random.default_rng(3).normal(size=(50, 4, 4))
    M = M + np.swapaxes(M, 1, 2)
    expected = np.linalg.det(M)[:, None, None] * np.linalg.inv(M)
    assert wahba.adjugate(M) == pytest.approx(expected, rel=1e-9, abs=1e-9)


def test_triad_keeps_the_first_direction_and_quest_shares_the_error():
    up_and_field = np.array([[0, 0, 1.0], [0, 0.5, -0.9]])
    b = np.array([[0, 0, 1.0], [0, 0.6, -0.8]])  # the angle between them is wrong
    R = so3.matrix_from_quat(wahba.triad(b, up_and_field).q)
    assert R @ b[0] == pytest.approx(up_and_field[0], abs=1e-12)
    tilts = [
        np.degrees(angle(wahba.quest(b, up_and_field, [w, 1.0]).q, np.array([1.0, 0, 0, 0]))) for w in (1, 10, 1e4)
    ]
    assert tilts[0] > tilts[1] > tilts[2]
    assert tilts[2] < 0.01


def test_covariance_is_that_of_many_runs():
    """QUEST's errors over 4000 runs against Shuster & Oh's covariance, best and other weights, in 5 sigma of it."""
    rng = np.random.default_rng(4)
    q = so3.quat_exp([0.3, -0.8, 1.4])
    r = np.array([[0, 0, 1.0], [0, np.cos(1.2), -np.sin(1.2)], [0.8, 0.6, 0]])
    sigma = np.array([0.004, 0.01, 0.02])
    exact = seen_from(q[None], r)[0]
    runs = 4000
    for weights in (1 / sigma**2, np.array([1.0, 1.0, 0.5])):
        b = exact + sigma[:, None] * rng.normal(size=(runs, 3, 3))
        found = wahba.quest(b, r, weights)
        error = so3.quat_log(so3.quat_multiply(so3.quat_conjugate(q), found.q))  # about the body's axes
        expected = wahba.covariance(exact, sigma, weights)
        L = np.linalg.cholesky(expected)
        whitened = np.linalg.solve(L, error.T)
        assert whitened @ whitened.T / runs == pytest.approx(np.eye(3), abs=5 * np.sqrt(2 / runs))
    best = wahba.covariance(exact, sigma)
    across = np.eye(3) - exact[:, :, None] * exact[:, None, :]
    assert np.linalg.inv(best) == pytest.approx(np.sum(across / sigma[:, None, None] ** 2, axis=0))
    assert np.all(np.linalg.eigvalsh(expected - best) > 0)  # other weights are worse: Cramer-Rao


@pytest.mark.parametrize("solve", [*SOLVERS, wahba.triad])
def test_what_is_not_determined_is_said_and_not_made_up(solve):
    r = np.array([[0, 0, 1.0], [0, 1.0, 0]])
    good = r
    cases = np.array(
        [
            good,
            [[0, 0, 1.0], [0, 0, 2.0]],  # parallel
            [[0, 0, 1.0], [0, 0, -1.0]],
            [[0, 0, 1.0], [0, 0, 0]],  # one vector
            [[0, 0, 0], [0, 0, 0]],
            [[0, 0, 1.0], [np.nan, 0, 0]],
            [[0, 0, np.inf], [0, 1.0, 0]],
        ]
    )
    found = solve(cases, r)
    assert found.determined.tolist() == [True] + 6 * [False]
    assert np.isnan(found.q[1:]).all()
    assert np.isfinite(found.q[0]).all()
    assert found.n_used.tolist() == [2, 2, 2, 1, 0, 1, 1]
    assert np.isnan(found.loss[4])
    assert not np.isfinite(wahba.covariance([[0, 0, 1.0], [0, 0, 2.0]], [0.1, 0.1])).any()


def test_parallel_reference_directions_and_zero_weights():
    b = np.array([[1.0, 0, 0], [0, 1.0, 0]])
    assert not wahba.quest(b, [[0, 0, 1.0], [0, 0, 1.0]]).determined
    assert not wahba.quest(b, b, [1.0, 0.0]).determined
    assert not wahba.quest(b, b, [1.0, np.nan]).determined
    three = np.array([[0, 0, 1.0], [0, 0, -1.0], [0, 0, 2.0]])
    for solve in SOLVERS:
        assert not solve(three, three).determined
        assert solve(np.vstack([three, [[0, 1.0, 0]]]), np.vstack([three, [[0, 1.0, 0]]])).determined


def test_length_of_the_readings_does_not_matter():
    rng = np.random.default_rng(5)
    q, r = random_attitudes(rng, 20), rng.normal(size=(2, 3))
    b = seen_from(q, r) + 0.1 * rng.normal(size=(20, 2, 3))
    assert angle(wahba.quest(b * [[9.81], [48.0]], r).q, wahba.quest(b, 7 * r).q).max() < 1e-7
