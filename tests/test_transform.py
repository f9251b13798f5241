"""Solvers of H from poses with known rotations, the levelled housing, and the optimisers beside them."""

from __future__ import annotations

import math
import os
from pathlib import Path

import numpy as np
import pytest

from margcal.core import so3
from margcal.core.errors import DataError, InputError
from margcal.core.types import Array
from margcal.methods import elimination
from margcal.methods.baselines import active_set, interior_point, slsqp
from margcal.methods.transform import alternation, eigen, level_prior, one_step, svd

G = 9.80665
H = np.array([[0.0210, -0.0024, 0.0034], [0.0, 0.0238, 0.0022], [0.0021, 0.0024, 0.0224]])
B = np.array([32429.0, 32318.0, 32368.0])
U = G * np.array([2.0, 4.0, 6.0]) / np.sqrt(56)
DATA = Path(os.environ.get("MARGCAL_DATA", Path(__file__).parents[2] / "shared" / "data"))
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason=f"no recordings at {DATA} (set MARGCAL_DATA)")


def random_poses(n: int, rng: np.random.Generator) -> Array:
    return so3.matrix_from_quat(rng.normal(size=(n, 4)))


def euler_poses(n: int, rng: np.random.Generator) -> Array:
    a = rng.uniform(0, np.pi, size=(n, 3))
    turns = [so3.exp(a[:, k, None] * np.eye(3)[k]) for k in range(3)]
    return turns[2] @ turns[1] @ turns[0]


def readings(R: Array, u: Array = U, H: Array = H) -> Array:
    return (R @ u) @ np.linalg.inv(H).T + B


def relative(a: Array, b: Array) -> float:
    return float(np.linalg.norm(a - b) / np.linalg.norm(b))


# ---------------------------------------------------------------------------------------------------- noise-
# free


def long_alternation(*args, **kwargs):
    return alternation(*args, n_iter=300, **kwargs)


@pytest.mark.parametrize("solve", [one_step, eigen, svd, long_alternation])
@pytest.mark.parametrize("poses", [random_poses, euler_poses])
def test_noise_free_recovery(solve, poses):
    R = poses(24, np.random.default_rng(1))
    fit = solve(readings(R), R, G)
    assert relative(fit.model.H, H) <= 1e-9
    assert np.abs(fit.model.B - B).max() <= 1e-6
    assert np.abs(fit.u - U).max() <= 1e-8
    assert fit.residual.max() < 1e-8


@pytest.mark.parametrize("solve", [slsqp, interior_point, active_set])
def test_noise_free_recovery_by_optimisers(solve):
    R = random_poses(20, np.random.default_rng(2))
    fit = solve(readings(R), R, G, bias=B)
    assert relative(fit.model.H, H) <= 1e-5
    assert np.abs(fit.u - U).max() <= 1e-4


def test_five_poses_are_enough_and_four_are_not():
    R = random_poses(5, np.random.default_rng(3))
    fit = one_step(readings(R), R, G)
    assert relative(fit.model.H, H) <= 1e-9
    assert fit.rank == 14
    with pytest.raises(DataError, match="4 poses found, 5 needed"):
        one_step(readings(R[:4]), R[:4], G)


@pytest.mark.parametrize("solve", [one_step, eigen, svd, long_alternation])
def test_determinant_is_positive_whatever_the_truth(solve):
    R = random_poses(20, np.random.default_rng(4))
    fit = solve(readings(R, U, -H), R, G)
    assert relative(fit.model.H, H) <= 1e-9
    assert np.abs(fit.u + U).max() <= 1e-8


def test_laboratory_and_reference_pose_are_the_same_problem():
    """R_j = R_nh(j)^T gives u in the laboratory, R_j^i = R_nh(j)^T R_nh(i) that of pose i; H and B agree."""
    rng = np.random.default_rng(5)
    R = random_poses(20, rng)
    y = readings(R) + rng.normal(size=(20, 3))
    relative_R = R @ R[3].T
    for solve in (one_step, eigen, svd):
        a, b = solve(y, R, G), solve(y, relative_R, G)
        assert relative(a.model.H, b.model.H) < 1e-9
        assert np.abs(R[3] @ a.u - b.u).max() < 1e-8


# --------------------------------------------------------------------------- the paper's iteration and its
# limit


@pytest.mark.parametrize("poses", [random_poses, euler_poses])
@pytest.mark.parametrize("seed", range(4))
def test_alternation_goes_to_the_global_optimum(poses, seed):
    """300 iterations: u, and H (1 - lambda1(M/J)), since (32) scales H_k by |u_k|."""
    rng = np.random.default_rng(100 + seed)
    R = poses(20, rng)
    y = readings(R) + 1.4 * rng.normal(size=(20, 3))
    a, e = alternation(y, R, G, bias=B, n_iter=300), eigen(y, R, G, bias=B)
    assert relative(a.u, e.u) <= 1e-9
    assert relative(a.model.H * (1 - e.details["lambda"][0]), e.model.H) <= 1e-9


def test_alternation_is_power_iteration():
    """u_k = (I - M/J) u_(k-1), checked against M built from its definition with P = Y^+ Y."""
    rng = np.random.default_rng(6)
    R = random_poses(15, rng)
    y = readings(R) + 1.4 * rng.normal(size=(15, 3))
    u0 = rng.normal(size=3)
    history = alternation(y, R, G, bias=B, u0=u0, n_iter=5).history["u"]
    Y = (y - B).T
    P = np.linalg.pinv(Y) @ Y
    M = np.einsum("jai,jk,kab->ib", R, np.eye(15) - P, R)
    expected = np.array([np.linalg.matrix_power(np.eye(3) - M / 15, k + 1) @ u0 for k in range(5)])
    sign = np.sign(np.sum(history * expected))
    assert np.allclose(history * sign, expected, rtol=1e-11, atol=1e-12)


def test_alternation_history_and_rescaling():
    R = random_poses(20, np.random.default_rng(7))
    y = readings(R) + np.random.default_rng(8).normal(size=(20, 3))
    fit = alternation(y, R, G, n_iter=12)
    assert fit.history["H"].shape == (12, 3, 3)
    factor = G / np.linalg.norm(fit.history["u"][-1])
    assert np.allclose(fit.model.H, factor * fit.history["H"][-1], rtol=1e-14)
    assert np.allclose(fit.u, factor * fit.history["u"][-1], rtol=1e-14)


def test_alternation_costs_never_rise():
    """(35) and (36): each half-step lowers ||R u - H Y||."""
    rng = np.random.default_rng(9)
    R = euler_poses(20, rng)
    y = readings(R) + 5 * rng.normal(size=(20, 3))
    history = alternation(y, R, G, bias=B, n_iter=30).history
    H_k, u_k = history["H"], history["u"]

    def cost(H: Array, u: Array) -> float:
        return float(np.linalg.norm(R @ u - (y - B) @ H.T))

    for k in range(29):
        assert cost(H_k[k + 1], u_k[k]) <= cost(H_k[k], u_k[k]) * (1 + 1e-12)
        assert cost(H_k[k + 1], u_k[k + 1]) <= cost(H_k[k + 1], u_k[k]) * (1 + 1e-12)


def test_tolerance_looks_at_the_direction():
    rng = np.random.default_rng(10)
    R = random_poses(20, rng)
    y = readings(R) + 20 * rng.normal(size=(20, 3))
    fit = alternation(y, R, G, bias=B, n_iter=5000, tol=1e-12)
    assert fit.n_iter < 200
    assert fit.converged
    assert not alternation(y, R, G, bias=B, n_iter=2).converged


@pytest.mark.parametrize("gradient", [True, False])
def test_slsqp_agrees_with_eigen(gradient):
    rng = np.random.default_rng(11)
    R = random_poses(20, rng)
    y = readings(R) + 1.4 * rng.normal(size=(20, 3))
    s, e = slsqp(y, R, G, bias=B, gradient=gradient), eigen(y, R, G, bias=B)
    assert relative(s.u, e.u) <= 1e-6
    assert relative(s.model.H, e.model.H) <= 1e-6
    assert s.history["H"].shape == (s.n_iter, 3, 3)
    assert relative(s.history["u"][-1], s.u) < 1e-6


def test_optimiser_gradient_matches_differences():
    from margcal.methods.baselines import Problem

    rng = np.random.default_rng(12)
    problem = Problem(rng.normal(size=(8, 3)), random_poses(8, rng), 1.0, 1.0, 1.0)
    x = rng.normal(size=12)
    numeric = [(problem.cost(x + e) - problem.cost(x - e)) / 2e-6 for e in 1e-6 * np.eye(12)]
    assert np.allclose(problem.gradient(x), numeric, rtol=1e-7, atol=1e-7)


def test_eigen_is_the_least_cost_there_is():
    rng = np.random.default_rng(13)
    R = random_poses(15, rng)
    y = readings(R) + 10 * rng.normal(size=(15, 3))
    fit = eigen(y, R, G, bias=B)
    for _ in range(200):
        u = rng.normal(size=3)
        u *= G / np.linalg.norm(u)
        best_H = (R @ u).T @ np.linalg.pinv((y - B).T)
        assert np.sum((R @ u - (y - B) @ best_H.T) ** 2) >= fit.cost


@pytest.mark.parametrize("solve", [eigen, svd])
@pytest.mark.parametrize("given", [True, False])
def test_two_step_covariance_is_that_of_the_errors(solve, given):
    rng = np.random.default_rng(27)
    R = random_poses(24, rng)
    bias = B if given else None
    y = readings(R) + 1.4 * rng.normal(size=(800, 24, 3))
    many = solve(y, R, G, bias=bias)
    errors = np.concatenate([(many.model.H - H).reshape(-1, 9), many.model.B - B], axis=1)
    sampled = np.sqrt(np.mean(errors**2, axis=0))
    predicted = np.sqrt(np.mean([np.diag(solve(v, R, G, bias=bias).covariance) for v in y[:60]], axis=0))
    known = 9 if given else 12
    assert np.abs(sampled[:known] / predicted[:known] - 1).max() < 0.15
    assert given == (predicted[9:].max() == 0)


def test_svd_is_the_smallest_singular_vector():
    """A X = 0 of (30) holds for the truth, and the estimate's |A X| is the least of all unit X."""
    rng = np.random.default_rng(14)
    R = random_poses(12, rng)
    fit = svd(readings(R), R, G, bias=B)
    assert fit.details["singular_values"][-1] < 1e-9 * fit.details["singular_values"][-2]
    noisy = readings(R) + 5 * rng.normal(size=(12, 3))
    plain, scaled = svd(noisy, R, G, bias=B), svd(noisy, R, G, bias=B, scale=True)
    assert np.isclose(np.linalg.norm(plain.u), G)
    assert np.allclose(svd(noisy / 50, R, G, bias=B, scale=True).u, scaled.u, rtol=1e-9)


# ------------------------------------------------------------------------------------------------------- one-
# step


def test_closed_form_eigenvector_is_lapacks():
    rng = np.random.default_rng(15)
    factors = rng.normal(size=(500, 5, 3)) * [1.0, 1.0, 1e-3]
    M = np.swapaxes(factors, -1, -2) @ factors
    u, eigenvalues = (a.T for a in elimination.smallest_eigenvector(M.transpose(1, 2, 0)))
    expected, vectors = np.linalg.eigh(M)
    assert np.abs(np.abs(np.sum(u * vectors[..., 0], axis=-1)) - 1).max() < 1e-12
    assert np.abs(eigenvalues - expected).max() < 1e-12 * expected.max()


def test_batches_are_the_single_nodes():
    rng = np.random.default_rng(16)
    R = random_poses(14, rng)
    y = readings(R) + 1.4 * rng.normal(size=(40, 14, 3))
    own = random_poses(40 * 14, rng).reshape(40, 14, 3, 3)
    y_own = (own @ U) @ np.linalg.inv(H).T + B + 1.4 * rng.normal(size=(40, 14, 3))
    for solve in (one_step, eigen, svd, alternation):
        bias = {} if solve is one_step else {"bias": B}
        for readings_, rotations in ((y, R), (y_own, own)):
            batch = solve(readings_, rotations, G, **bias)
            one = solve(readings_[5], rotations if rotations.ndim == 3 else rotations[5], G, **bias)
            assert np.allclose(batch.model.H[5], one.model.H, rtol=1e-9, atol=1e-12)
            assert np.allclose(batch.model.B[5], one.model.B, rtol=0, atol=1e-6)
            assert np.allclose(batch.u[5], one.u, rtol=1e-9)
            assert np.allclose(batch.residual[5], one.residual, rtol=1e-6, atol=1e-12)


def test_input_is_left_as_it_was():
    R = random_poses(12, np.random.default_rng(29))
    y = readings(R)
    before = y.copy(), R.copy()
    for solve in (one_step, eigen, svd, alternation):
        solve(y, R, G)
        solve(y[None], R, G)
    level_prior(readings(np.eye(3)[None].repeat(6, 0)) + FACES, FACES, G)
    assert np.array_equal(y, before[0])
    assert np.array_equal(R, before[1])


def test_weights_are_repetitions():
    rng = np.random.default_rng(17)
    R = random_poses(12, rng)
    y = readings(R) + 1.4 * rng.normal(size=(12, 3))
    again = np.concatenate([np.arange(12), [4, 4, 7]])
    counts = np.bincount(again).astype(float)
    a, b = one_step(y[again], R[again], G), one_step(y, R, G, weights=counts)
    assert relative(a.model.H, b.model.H) < 1e-11
    assert np.abs(a.model.B - b.model.B).max() < 1e-8
    assert np.abs(a.u - b.u).max() < 1e-10


def test_weights_of_their_own_in_a_batch():
    rng = np.random.default_rng(28)
    R = random_poses(12, rng)
    y = readings(R) + 1.4 * rng.normal(size=(3, 12, 3))
    w = rng.uniform(0.2, 3, size=(3, 12))
    batch, one = one_step(y, R, G, weights=w), one_step(y[1], R, G, weights=w[1])
    assert relative(batch.model.H[1], one.model.H) < 1e-11
    assert np.abs(batch.model.B[1] - one.model.B).max() < 1e-8


def test_rotating_the_laboratory_or_scaling_the_readings_changes_nothing_else():
    rng = np.random.default_rng(18)
    R, Q = random_poses(15, rng), so3.exp([0.3, -1.0, 0.5])
    y = readings(R) + 1.4 * rng.normal(size=(15, 3))
    base = one_step(y, R, G)
    turned = one_step(y, R @ Q.T, G)
    assert np.allclose(turned.u, Q @ base.u, rtol=1e-10)
    assert relative(turned.model.H, base.model.H) < 1e-10
    volts = one_step(y * 1e-4 - 3, R, G)
    assert relative(volts.model.H, base.model.H * 1e4) < 1e-9
    assert np.allclose(volts.model.B, base.model.B * 1e-4 - 3, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("axis", "words"), [([0, 0, 1], r"\(0\.0, 0\.0, 1\.0\)"), ([1, 0, -1], r"\(0\.7, 0\.0, -0\.7\)")]
)
def test_one_axis_only_is_named(axis, words):
    turn = np.asarray(axis) / np.linalg.norm(axis)
    R = so3.exp(np.linspace(0, 6, 12)[:, None] * turn) @ so3.exp([0.4, 0.2, -0.9])
    noise = np.random.default_rng(19).normal(size=(12, 3))
    with pytest.raises(DataError, match=rf"only turn about one axis {words}") as caught:
        one_step(readings(R) + noise, R, G)
    assert caught.value.issues[0].code == "one-axis"


def test_sensed_vector_in_one_plane_is_named():
    """Faces +-x, +-y up, each with four headings: z never points up or down."""
    R = []
    for roll in range(4):
        for heading in range(4):
            R.append(so3.exp([0, 0, roll * np.pi / 2]) @ so3.exp([heading * np.pi / 2, 0, 0]))
    R = np.array(R)
    with pytest.raises(DataError, match=r"plane across axis \(0\.0, 0\.0, 1\.0\)"):
        one_step(readings(R, np.array([G, 0, 0])) + np.random.default_rng(20).normal(size=(16, 3)), R, G)


def test_same_attitude_and_wrong_shapes():
    R = np.repeat(np.eye(3)[None], 8, axis=0)
    with pytest.raises(DataError, match="same attitude"):
        one_step(readings(R) + np.random.default_rng(21).normal(size=(8, 3)), R, G)
    R = random_poses(8, np.random.default_rng(22))
    with pytest.raises(InputError, match="one a pose"):
        one_step(readings(R)[:6], R, G)
    with pytest.raises(InputError, match="rotation 2 is not a rotation"):
        one_step(readings(R), np.where(np.arange(8)[:, None, None] == 2, -R, R), G)


def test_a_lost_node_does_not_take_the_batch_with_it():
    rng = np.random.default_rng(23)
    R = random_poses(4 * 10, rng).reshape(4, 10, 3, 3)
    R[2] = so3.exp(np.linspace(0, 6, 10)[:, None] * [0, 0, 1])
    y = (R @ U) @ np.linalg.inv(H).T + B
    y[2] += rng.normal(size=(10, 3))
    fit = one_step(y, R, G)
    assert not fit.converged
    assert np.isnan(fit.model.H[2]).all()
    assert max(relative(fit.model.H[k], H) for k in (0, 1, 3)) < 1e-9


# ------------------------------------------------------------------------------------------------ levelled
# housing

FACES = np.concatenate([np.eye(3), -np.eye(3)])


def tilted(up: Array, sd: float, rng: np.random.Generator) -> Array:
    return so3.exp(sd * np.cross(up, rng.normal(size=up.shape))) @ up[:, :, None]


def test_six_faces_once_each():
    """Within what its covariance says; lengths far better than directions."""
    rng = np.random.default_rng(24)
    nees, lengths = [], []
    d = rng.normal(size=(500, 3))
    d *= G / np.linalg.norm(d, axis=1, keepdims=True)
    for _ in range(60):
        s = tilted(FACES, np.radians(0.5), rng)[..., 0]
        y = (G * s) @ np.linalg.inv(H).T + B + 0.2 * rng.normal(size=(6, 3))
        fit = level_prior(y, FACES, G, np.radians(0.5), sigma=0.2 * 0.0225)
        error = np.concatenate([(fit.model.H - H).ravel(), fit.model.B - B])
        nees.append(error @ np.linalg.solve(fit.covariance, error))
        lengths.append(np.linalg.norm(fit.model.apply(d @ np.linalg.inv(H).T + B), axis=1) / G - 1)
    assert abs(np.mean(nees) - 12) < 4 * np.sqrt(24 / 60)
    assert np.std(lengths) < 0.5 * np.radians(0.5)


def test_level_recovers_exactly_on_a_level_table():
    up = np.concatenate([FACES, FACES])
    y = (G * up) @ np.linalg.inv(H).T + B
    fit = level_prior(y, up, G)
    assert relative(fit.model.H, H) < 1e-9
    assert np.abs(fit.model.B - B).max() < 1e-6
    assert fit.details["tilt_rad"].max() < 1e-7


def test_level_estimates_the_radial_noise():
    rng = np.random.default_rng(25)
    up = np.repeat(FACES, 15, axis=0)
    y = (G * tilted(up, np.radians(1), rng)[..., 0]) @ np.linalg.inv(H).T + B + 1.0 * rng.normal(size=(90, 3))
    fit = level_prior(y, up, G)
    assert abs(float(fit.details["sigma"]) / 0.0225 - 1) < 0.25


def test_level_start_does_not_matter():
    rng = np.random.default_rng(26)
    y = (G * tilted(FACES, 0.02, rng)[..., 0]) @ np.linalg.inv(H).T + B
    a, b = level_prior(y, FACES, G), level_prior(y, FACES, G, start=(1.2 * H, B + 30))
    assert relative(a.model.H, b.model.H) < 1e-8


def test_a_missing_face_is_named():
    up = np.concatenate([FACES[:5], FACES[:2]])
    with pytest.raises(DataError, match=r"5 distinct directions of up found, 6 needed.*-z up"):
        level_prior((G * up) @ np.linalg.inv(H).T + B, up, G)


@needs_data
def test_ferraris_session_put_down_by_hand():
    import pyarrow.parquet as pq

    table = pq.read_table(DATA / "imucal" / "ferraris_session.parquet")
    t = table["t_s"].to_numpy()
    y = np.column_stack([table[f"acc_{a}_mps2"].to_numpy() for a in "xyz"]).astype(float)
    first = [(0.2, 2.9), (3.9, 13.3), (14.9, 24.4), (25.5, 33.9), (35.5, 41.7), (42.9, 49.9), (51.5, 59.4)]
    later = [(61.7, 65.7), (69.7, 73.9), (75.8, 78.5), (82.3, 85.5), (87.2, 89.4), (93.3, 100.8)]
    means, check = (np.array([y[(t >= a) & (t <= b)].mean(axis=0) for a, b in s]) for s in (first, later))
    axis = np.abs(means).argmax(axis=1)
    up = np.sign(means[np.arange(7), axis])[:, None] * np.eye(3)[axis]
    fit = level_prior(means, up, G, math.radians(1.0), raw_unit="m/s^2")
    off = np.abs(np.linalg.norm(fit.model.apply(check), axis=1) - G)
    assert off.max() < 0.015
    assert np.degrees(fit.details["tilt_rad"]).max() < 1.0
