"""`gls_ml` and `robust_gls`: derivatives, recovery, the bound, honest covariances, bad poses.

The studies of benchmarks/studies/single.py are run here with a few hundred nodes and the statistical bands that
these allow; the long command is ``python benchmarks/studies/trust.py``.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from margcal.core import so3
from margcal.core.errors import DataError, InputError
from margcal.core.types import Array
from margcal.methods import gls
from margcal.methods.affine import tangents
from margcal.methods.gls import gls_ml
from margcal.methods.joint import Priors, Triad, joint_fit
from margcal.methods.robust_gls import FALSE_ALARM, largest_misfit, robust_gls

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks" / "studies"))
import single
from single import NOISE, A, B, G, H, U, cube_poses, housed_readings, random_poses

RUNS = 300


def problem(J: int = 20, runs: int = 1, s_rot_deg: float = 0.0, seed: int = 1) -> tuple[Array, Array]:
    """Readings (runs, J, 3) and rotations (J, 3, 3)."""
    rng = np.random.default_rng(seed)
    R = random_poses(J, rng)
    return housed_readings(R, s_rot_deg, runs, rng), R


# --- the algebra -------------------------------------------------------------------------------------


def linearised(kappa2: float = 1.3, rot2: float = 0.01**2, J: int = 8) -> tuple[Any, Any, Any]:
    rng = np.random.default_rng(2)
    R = random_poses(J, rng)[None]
    A1 = np.eye(3)[None] + 0.2 * rng.normal(size=(1, 3, 3))
    u = rng.normal(size=(1, 3))
    one = np.ones(1)
    state = gls._State(A1, 0.1 * rng.normal(size=(1, 3)), u / np.linalg.norm(u), kappa2 * one, rot2 * one, one > 2)
    z = rng.normal(size=(1, J, 3))
    p = gls._Problem(z, R, 0.01 * rng.uniform(1, 2, size=(1, J, 3)), np.ones((1, J)))
    return p, state, gls._linearise(p, state)


def test_derivatives_match_differences():
    p, state, at = linearised()

    def model(x: Array) -> Array:
        u = state.u[0] + tangents(state.u)[0] @ x[12:]
        u = u / np.linalg.norm(u)
        return (p.R[0] @ u) @ (state.A[0] + x[:9].reshape(3, 3)).T + state.b[0] + x[9:12]

    numeric = np.stack([(model(e) - model(-e)) / 2e-6 for e in 1e-6 * np.eye(14)], axis=-1)
    assert np.allclose(at.X[0], numeric, atol=1e-8)
    assert np.allclose(at.r[0], p.z[0] - model(np.zeros(14)))


def test_covariance_of_a_reading_is_that_of_its_housing_error():
    """(1) against the derivative of the reading by the housing's rotation, by differences."""
    p, state, at = linearised()
    for j in range(2):
        v = p.R[0, j] @ state.u[0]
        D = np.stack([state.A[0] @ (so3.exp(e) @ v - so3.exp(-e) @ v) / 2e-6 for e in 1e-6 * np.eye(3)], axis=-1)
        S = 1.3 * np.diag(p.noise[0, j] ** 2) + 0.01**2 * D @ D.T
        assert np.allclose(at.S[0, j], S, rtol=1e-8)


def test_score_is_the_derivative_of_the_restricted_likelihood():
    """At a fixed state the residuals and derivatives are fixed: differences of the log-likelihood by components."""
    p, state, at = linearised()
    score, info = gls._score(p, at, (True, True))
    for i, (name, value) in enumerate((("kappa2", 1.3), ("rot2", 0.01**2))):
        step = 1e-4 * value
        up, down = (
            gls._linearise(p, replace(state, **{name: np.array([value + s])})).log_likelihood[0] for s in (step, -step)
        )
        assert np.isclose(score[0, i] / 2, (up - down) / (2 * step), rtol=1e-5)
    assert np.allclose(info[0], info[0].T)
    assert np.all(np.linalg.eigvalsh(info[0] / np.sqrt(np.outer(np.diag(info[0]), np.diag(info[0])))) > 0)


def test_recovers_without_noise():
    rng = np.random.default_rng(3)
    for poses, J in ((random_poses, 8), (random_poses, 24), (cube_poses, 24)):
        R = poses(J, rng)
        y = (R @ U) @ A.T + B
        for options in ({}, {"noise_sd": 1.0}, {"noise_sd": 1.0, "s_rot": 0.005}):
            fit = gls_ml(y, R, G, **options)
            assert np.linalg.norm(fit.model.H - H) <= 1e-9 * np.linalg.norm(H)
            assert np.abs(fit.model.B - B).max() <= 1e-6
            assert fit.converged


def test_a_batch_is_its_nodes():
    y, R = problem(J=14, runs=5, s_rot_deg=0.3)
    batch = gls_ml(y, R, G, noise_sd=NOISE)
    own = gls_ml(y, np.broadcast_to(R, (5, *R.shape)), G, noise_sd=np.full((5, 14, 3), NOISE))
    assert np.allclose(batch.model.H, own.model.H, rtol=1e-12)
    for i in range(5):
        one = gls_ml(y[i], R, G, noise_sd=NOISE)
        assert np.allclose(one.model.H, batch.model.H[i], rtol=1e-8)
        assert np.allclose(one.model.B, batch.model.B[i], rtol=1e-8)
        assert one.covariance is not None and batch.covariance is not None
        assert np.allclose(one.covariance, batch.covariance[i], rtol=1e-5, atol=1e-16)
        for name in ("s_rot", "chi2", "deletion"):
            assert np.allclose(one.details[name], batch.details[name][i], rtol=1e-4)
    grid = gls_ml(y[:4].reshape(2, 2, 14, 3), R, G, noise_sd=NOISE)
    assert np.allclose(grid.model.B.reshape(4, 3), batch.model.B[:4], rtol=1e-8)


def test_noise_is_found_in_whatever_units():
    y, R = problem(J=30, runs=100)
    kappa = gls_ml(y, R, G).details["noise"]
    assert abs(np.mean(kappa**2) / NOISE**2 - 1) < 4 * np.sqrt(2 / 76 / 100)
    assert np.allclose(gls_ml(1000 * y, R, G).details["noise"], 1000 * kappa, rtol=1e-4)


def test_only_the_counted_poses_count():
    y, R = problem(J=16)
    use = np.ones(16, dtype=bool)
    use[[2, 9]] = False
    without = gls_ml(y[0][use], R[use], G, noise_sd=NOISE)
    spoiled = y[0] + np.where(use, 0.0, 500.0)[:, None]
    fit = gls_ml(spoiled, R, G, noise_sd=NOISE, use=use)
    assert np.allclose(fit.model.H, without.model.H, rtol=1e-7)
    assert np.allclose(fit.model.B, without.model.B, rtol=1e-7)
    assert fit.details["dof"] == without.details["dof"] == 3 * 14 - 14
    assert np.allclose(fit.covariance, without.covariance, rtol=1e-4, atol=1e-16)


def test_deletion_is_the_refit_without_the_pose():
    """At weights that are kept, to the second order of the noise."""
    y, R = problem(J=12, s_rot_deg=0.1)
    options = {"noise_sd": NOISE, "s_rot": np.radians(0.1)}
    fit = gls_ml(y[0], R, G, **options)
    use = ~np.eye(12, dtype=bool)
    without = gls_ml(y[0], R, G, use=use, **options)  # leave-one-out, a batch
    gain = fit.details["chi2"] - without.details["chi2"]
    assert np.allclose(fit.details["deletion"], gain, rtol=0.05, atol=0.02)
    assert np.allclose(np.diagonal(without.details["deletion"]), gain, rtol=0.05, atol=0.02)
    left = without.details["predicted"][range(12), range(12)]
    assert np.allclose(fit.details["predicted"], left, atol=0.05 * NOISE)


def test_is_the_joint_fit_of_one_sensor():
    """With all components fixed: marginal (here) against explicit housing errors (there), to first order."""
    y, R = problem(J=20, s_rot_deg=0.3)
    s_rot = np.radians(0.3)
    fit = gls_ml(y[0], R, G, noise_sd=NOISE, s_rot=s_rot)
    R_nh = np.swapaxes(R, 1, 2)
    triad = Triad(y[0], np.full((20, 3), NOISE), np.linalg.inv(fit.model.H), fit.model.B, fit.u, u_free=True)
    joint = joint_fit({"acc": triad}, None, R_nh, Priors(R0=R_nh, s_rot=s_rot), estimate_components=False)
    assert joint.converged
    sd = np.sqrt(np.diag(fit.covariance))
    assert np.all(np.abs(joint.H["acc"] - fit.model.H).ravel() < 0.05 * sd[:9])
    assert np.all(np.abs(joint.B["acc"] - fit.model.B) < 0.05 * sd[9:])
    assert np.allclose(joint.covariance["acc"], fit.covariance, rtol=0.05, atol=0.02 * np.outer(sd, sd))


def test_refuses_what_cannot_be_determined():
    y, R = problem(J=20)
    with pytest.raises(DataError, match="5 poses found, 6 needed"):
        gls_ml(y[0][:5], R[:5], G)
    about_one_axis = so3.exp(np.linspace(0, 6, 12)[:, None] * [0, 0, 1.0])
    with pytest.raises(DataError, match="turn"):
        gls_ml((about_one_axis @ U) @ A.T + B, about_one_axis, G)
    with pytest.raises(InputError, match="one a pose"):
        gls_ml(y[0], R[:7], G)


def test_a_node_that_cannot_be_solved_spoils_no_other():
    rng = np.random.default_rng(4)
    R = np.stack([random_poses(12, rng), so3.exp(np.linspace(0, 6, 12)[:, None] * [0, 0, 1.0])])
    y = (R @ U) @ A.T + B + NOISE * rng.normal(size=(2, 12, 3))
    both, one = gls_ml(y, R, G, noise_sd=NOISE), gls_ml(y[0], R[0], G, noise_sd=NOISE)
    assert both.details["converged"].tolist() == [True, False]
    assert "1 of 2" in both.text
    assert np.allclose(both.model.H[0], one.model.H, rtol=1e-8)
    assert np.isnan(both.model.H[1]).all()
    found = robust_gls(y, R, G, noise_sd=NOISE)
    assert not found.left_out.any()


# --- statistics --------------------------------------------------------------------------------------


def test_reaches_the_bound_and_knows_how_well():
    """Six settings; bands of four standard errors about the bars of the long study."""
    for row in single.bound_study(RUNS):
        for name in "HBu":
            assert 0.95 - 0.08 <= row[name] <= 1.06 + 0.08, row
        assert 13.5 - 4 * row["NEES_se"] <= row["NEES"] <= 14.5 + 4 * row["NEES_se"], row
        assert 93 <= row["coverage_%"] <= 97, row
        assert row["converged_%"] == 100, row


def test_housing_error_is_found_and_weighed():
    for row in single.housing_study(RUNS):
        assert row["B_over_best"] <= 0.9 + 0.04, row
        assert row["H_over_best"] <= 0.95, row
        assert row["NEES"] <= 16, row
        assert 0.45 <= row["s_rot_deg"] <= 0.55, row


def test_no_housing_error_is_found_where_there_is_none():
    y, R = problem(J=20, runs=RUNS)
    taken = gls_ml(y, R, G, noise_sd=NOISE).details["s_rot"] > gls.MIN_S_ROT * 1.01
    assert taken.mean() <= 0.15


def test_bad_poses_are_named():
    rows = {row["fault"]: row for row in single.bad_pose_study(200)}
    assert rows["none"]["others_left_out_%"] <= 2.5
    for fault in single.FAULTS[1:]:
        assert rows[fault]["named_%"] >= 99, fault
        assert rows[fault]["others_left_out_%"] <= 2.5, fault


def test_robust_batch_is_its_nodes_and_the_fit_has_no_trace_of_the_bad_pose():
    y, R, bad = single.faulty_nodes("label of the set", 4, 20, 0.1, np.random.default_rng(11))
    batch = robust_gls(y, R, G, noise_sd=NOISE)
    for i in range(4):
        one = robust_gls(y[i], R[i], G, noise_sd=NOISE)
        assert np.flatnonzero(one.left_out).tolist() == [bad[i]] == np.flatnonzero(batch.left_out[i]).tolist()
        assert one.chi2[bad[i]] > one.limit[bad[i]]
        assert np.isnan(np.delete(one.chi2, bad[i])).all()
        rest = np.delete(np.arange(20), bad[i])
        assert np.allclose(one.fit.model.H, gls_ml(y[i][rest], R[i][rest], G, noise_sd=NOISE).model.H, rtol=1e-6)


def test_two_bad_poses_and_a_swapped_pair():
    y, R, _ = single.faulty_nodes("none", 60, 20, 0.1, np.random.default_rng(12))
    swapped = R.copy()
    swapped[:, [3, 8]] = R[:, [8, 3]]
    found = robust_gls(y, swapped, G, noise_sd=NOISE)
    expected = np.isin(np.arange(20), [3, 8])
    assert np.mean((found.left_out == expected).all(axis=1)) >= 0.95


def test_does_not_go_on_below_ten_poses():
    y, R, _ = single.faulty_nodes("none", 1, 11, 0.1, np.random.default_rng(13))
    y[0, [1, 4]] += 100.0
    found = robust_gls(y[0], R[0], G, noise_sd=NOISE)
    assert found.left_out.sum() <= 1
    assert found.contradictory


def test_limit_is_that_of_the_f_distribution():
    from scipy import stats

    for dof in (20, 46, 200):
        exact = 3 * stats.f.isf(FALSE_ALARM / 20, 3, dof)
        assert np.isclose(largest_misfit(np.array([20]), np.array([dof]))[0], exact, rtol=0.03)
    assert largest_misfit(np.array([20]), np.array([0.0]))[0] > 100
