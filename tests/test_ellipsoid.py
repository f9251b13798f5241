"""`ellipsoid`, `triangular`, `bias_and_scale`, `adjusted_ellipsoid` against simulated truth and public recordings."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from margcal.core import so3
from margcal.core.errors import DataError, InputError
from margcal.core.types import Array
from margcal.methods import quadric
from margcal.methods.ellipsoid import (
    adjusted_ellipsoid,
    bias_and_scale,
    distinct_directions,
    ellipsoid,
    triangular,
)

G = 9.81
H = np.array([[0.0210, -0.0024, 0.0034], [0.0, 0.0238, 0.0022], [0.0021, 0.0024, 0.0224]])
B = np.array([32429.0, 32318.0, 32368.0])
DATA = Path(os.environ.get("MARGCAL_DATA", Path(__file__).parents[2] / "shared" / "data"))
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason=f"no recordings at {DATA} (set MARGCAL_DATA)")


def directions(n: int, rng: np.random.Generator) -> Array:
    d = rng.normal(size=(n, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def readings(d: Array, H: Array = H, magnitude: float = G) -> Array:
    return (magnitude * d) @ np.linalg.inv(H).T + B


def raw(folder: str, name: str, prefix: str) -> tuple[Array, Array]:
    import pyarrow.parquet as pq

    table = pq.read_table(DATA / folder / name)
    columns = [c for c in table.column_names if c.startswith(prefix) and "osbias" not in c]
    return table["t_s"].to_numpy(), np.column_stack([table[c].to_numpy() for c in columns]).astype(float)


def rests(t: Array, y: Array, sd: float, shortest: float = 1.0, window: int = 50) -> list[slice]:
    """Spans where the standard deviation over half a second stays below `sd`."""
    windows = np.lib.stride_tricks.sliding_window_view(y, window, axis=0)
    still = np.zeros(len(y), dtype=bool)
    still[window // 2 : window // 2 + len(windows)] = windows.var(axis=-1).sum(axis=-1) < sd**2
    edges = np.flatnonzero(np.diff(np.concatenate([[0], still.astype(int), [0]])))
    return [slice(a, b) for a, b in zip(edges[::2], edges[1::2]) if t[b - 1] - t[a] > shortest]


# --------------------------------------------------------------------------------------------------- noise-
# free


@pytest.mark.parametrize("solve", [ellipsoid, triangular, adjusted_ellipsoid])
def test_noise_free_recovery(solve):
    y = readings(directions(40, np.random.default_rng(1)))
    model = solve(y, G).model
    assert np.abs(model.B - B).max() <= 1e-6
    assert np.abs(model.H.T @ model.H - H.T @ H).max() <= 1e-9 * np.abs(H.T @ H).max()


def test_noise_free_bias_and_scale():
    diagonal = np.diag([0.021, 0.024, 0.022])
    fit = bias_and_scale(readings(directions(8, np.random.default_rng(2)), diagonal), G, min_directions=5)
    assert np.abs(fit.model.B - B).max() <= 1e-6
    assert np.abs(fit.model.H - diagonal).max() <= 1e-9


def test_each_gauge():
    y = readings(directions(30, np.random.default_rng(3)))
    K, U = ellipsoid(y, G).model.H, triangular(y, G).model.H
    assert np.abs(K - K.T).max() <= 1e-15
    assert np.linalg.eigvalsh(K).min() > 0
    assert np.abs(np.tril(U, -1)).max() == 0
    assert np.diag(U).min() > 0


# ------------------------------------------------------------------------------------------- the paper's
# identities


def test_K_squared_is_G_squared_Sigma():
    """Z-TIE (21), and (17): B = Sigma^-1 Gamma / 2."""
    rng = np.random.default_rng(4)
    y = readings(directions(25, rng)) + rng.normal(size=(25, 3))
    fit = ellipsoid(y, G)
    Sigma, Gamma, K = fit.details["Sigma"], fit.details["Gamma"], fit.model.H
    assert np.allclose(K.T @ K, G**2 * Sigma, rtol=1e-12, atol=0)
    assert np.allclose(0.5 * np.linalg.solve(Sigma, Gamma), fit.model.B, rtol=1e-10)


def test_every_rotation_of_K_fits_equally():
    """Z-TIE (22)."""
    rng = np.random.default_rng(5)
    y = readings(directions(25, rng)) + rng.normal(size=(25, 3))
    model = ellipsoid(y, G).model
    Omega = so3.exp(rng.normal(size=3))
    lengths = np.linalg.norm((y - model.B) @ model.H.T, axis=1)
    turned = np.linalg.norm((y - model.B) @ (Omega @ model.H).T, axis=1)
    assert np.allclose(lengths, turned, rtol=1e-13)


def test_triangular_and_symmetric_agree_up_to_a_rotation():
    rng = np.random.default_rng(6)
    y = readings(directions(200, rng)) + 0.5 * rng.normal(size=(200, 3))
    a, b = ellipsoid(y, G).model, triangular(y, G).model
    assert np.abs(a.B - b.B).max() < 1e-3
    assert np.allclose(a.H.T @ a.H, b.H.T @ b.H, rtol=1e-4, atol=1e-8)


# --------------------------------------------------------------------------------------------- geometry
# underneath


def test_distance_is_to_the_nearest_point():
    """Against the least distance to a dense grid of points of the ellipsoid, and the foot lies on it."""
    rng = np.random.default_rng(7)
    K = so3.polar(np.diag([1.0, 0.7, 1.4]) @ so3.exp(rng.normal(size=3)))[1]
    b = np.array([0.1, -0.2, 0.3])
    z = np.concatenate([rng.normal(size=(20, 3)), [[0.1, -0.2, 0.31]]])
    distance, foot = quadric.distances(z, K, b)
    surface = directions(400_000, rng) @ np.linalg.inv(K).T + b
    nearest = np.array([np.linalg.norm(surface - p, axis=1).min() for p in z])
    assert np.abs(np.abs(distance) - nearest).max() < 2e-3
    assert np.abs(np.linalg.norm((foot - b) @ K, axis=1) - 1).max() < 1e-12
    assert np.array_equal(np.sign(distance), np.sign(np.linalg.norm((z - b) @ K, axis=1) - 1))


def test_distance_jacobian_matches_differences():
    rng = np.random.default_rng(8)
    six, b = np.array([1.0, 0.8, 1.2, 0.1, -0.1, 0.05]), np.array([0.1, 0.0, -0.2])
    z = rng.normal(size=(15, 3))
    x = np.concatenate([six, b])

    def at(x: Array) -> Array:
        return quadric.distances(z, quadric.symmetric(x[:6]), x[6:])[0]

    numeric = np.column_stack([(at(x + e) - at(x - e)) / 2e-6 for e in 1e-6 * np.eye(9)])
    _, foot = quadric.distances(z, quadric.symmetric(six), b)
    assert np.abs(quadric.distance_jacobian(foot, quadric.symmetric(six), b) - numeric).max() < 1e-8


def test_orthogonal_fit_has_no_better_neighbour():
    rng = np.random.default_rng(9)
    y = readings(directions(20, rng)) + 5 * rng.normal(size=(20, 3))
    fit = ellipsoid(y, G)
    K, b = fit.model.H / G, fit.model.B
    for _ in range(20):
        step = so3.skew(np.zeros(3)) + 1e-4 * np.abs(K).max() * rng.normal(size=(3, 3))
        other = quadric.distances(y, K + (step + step.T) / 2, b + 0.1 * rng.normal(size=3))[0]
        assert other @ other > fit.cost


# -------------------------------------------------------------------------------------------------------
# statistics


@pytest.mark.parametrize("solve", [ellipsoid, triangular])
def test_covariance_is_that_of_the_errors(solve):
    rng = np.random.default_rng(10)
    clean = readings(directions(30, rng))
    truth = solve(clean, G).model
    fits = [solve(clean + 1.4 * rng.normal(size=clean.shape), G) for _ in range(150)]
    errors = np.array([np.concatenate([(f.model.H - truth.H).ravel(), f.model.B - B]) for f in fits])
    predicted = np.mean([np.diag(f.covariance) for f in fits], axis=0)
    free = predicted > 1e-6 * predicted[:9].max()
    ratio = errors[:, free].std(axis=0) / np.sqrt(predicted[free])
    assert ratio.min() > 0.8
    assert ratio.max() < 1.25


def test_batch_is_the_single_fits():
    rng = np.random.default_rng(11)
    y = readings(directions(24, rng)) + 1.4 * rng.normal(size=(6, 24, 3))
    batch = ellipsoid(y, G)
    for k in range(6):
        one = ellipsoid(y[k], G)
        assert np.allclose(batch.model.B[k], one.model.B, rtol=0, atol=1e-6)
        assert np.allclose(batch.model.H[k], one.model.H, rtol=1e-9, atol=1e-13)


def test_adjusted_fit_is_consistent_where_the_algebraic_one_is_not():
    """5 % noise on 20000 samples of three quarters of the sphere: the plain fit's radius is off by about 1 %."""
    rng = np.random.default_rng(12)
    d = directions(30_000, rng)
    d = d[d[:, 2] > -0.5][:20_000]
    sigma = 0.05 * G / 0.0225
    y = readings(d) + sigma * rng.normal(size=d.shape)
    fit, plain = adjusted_ellipsoid(y, G), ellipsoid(y[:5000], G, geometric=False)
    truth = so3.polar(H)[1]
    assert np.abs(fit.model.H - truth).max() < 0.004 * truth.max()
    assert np.abs(plain.model.H - truth).max() > 0.005 * truth.max()
    assert np.abs(fit.model.B - B).max() < 4 * np.sqrt(np.diag(fit.covariance)[9:]).max()
    assert abs(float(fit.details["sigma"]) / sigma - 1) < 0.02


def test_adjusted_fit_survives_outliers_and_names_them():
    rng = np.random.default_rng(13)
    y = readings(directions(3000, rng)) + 5 * rng.normal(size=(3000, 3))
    y[:60] += 400 * rng.normal(size=(60, 3))
    fit = adjusted_ellipsoid(y, G)
    assert np.abs(fit.model.B - B).max() < 1.0
    assert fit.details["weights"][:60].mean() < 0.15
    assert fit.details["weights"][60:].mean() > 0.98


# ----------------------------------------------------------------------------------------------------- what
# is refused


def test_too_few_directions_names_found_and_needed():
    y = readings(np.repeat(directions(8, np.random.default_rng(14)), 3, axis=0))
    found = distinct_directions(y)
    with pytest.raises(DataError, match=rf"{found} distinct directions found, 10 needed") as caught:
        ellipsoid(y, G)
    issue = caught.value.issues[0]
    assert (issue.value, issue.limit, issue.level) == (found, 10, "fail")
    with pytest.raises(DataError, match="7 needed"):
        bias_and_scale(readings(np.concatenate([np.eye(3), -np.eye(3)])), G)


def test_readings_near_a_plane_name_the_axis():
    rng = np.random.default_rng(15)
    angle = rng.uniform(0, 2 * np.pi, 60)
    d = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(60)])
    with pytest.raises(DataError, match=r"plane across sensor axis -?z"):
        ellipsoid(readings(d, np.eye(3) * 0.022) + 0.5 * rng.normal(size=d.shape), G)


def test_readings_that_are_not_finite():
    y = readings(directions(20, np.random.default_rng(16)))
    y[3, 1] = np.nan
    with pytest.raises(InputError, match="reading 3 is not finite"):
        ellipsoid(y, G)


def test_distinct_directions_counts_what_was_put_in():
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    jitter = 0.02 * np.random.default_rng(17).normal(size=(5, 6, 3))
    assert distinct_directions(readings((axes + jitter).reshape(-1, 3)), B, H) == 6
    assert distinct_directions(np.zeros((0, 3))) == 0
    assert distinct_directions(readings(axes)) == 6


# ------------------------------------------------------------------------------------------------ real
# recordings


@needs_data
def test_swing_of_a_phone():
    _, y = raw("tyrex/calib_mag_Nexus5_d1", "mag.parquet", "mag_")
    fit = adjusted_ellipsoid(y, 47.4, kind="mag", raw_unit="uT")
    soft_iron = fit.model.H / np.linalg.det(fit.model.H) ** (1 / 3)
    expected = np.array([[1.002, 0.027, -0.026], [0.027, 0.976, 0.013], [-0.026, 0.013, 1.024]])
    assert np.abs(fit.model.B - [58.1, -73.5, 411.6]).max() < 2
    assert np.abs(soft_iron - expected).max() < 0.01
    assert abs(float(fit.details["radius"]) - 47.4) < 0.5


@needs_data
def test_xsens_multipose():
    t, y = raw("imu_tk", "xsens_mti_multipose.parquet", "acc_")
    means = np.array([y[s].mean(axis=0) for s in rests(t, y, 8.0)])
    fit = triangular(means, 9.81744)
    assert np.abs(fit.model.B - [33123, 33276, 32360]).max() < 8
    assert np.abs(1 / np.diag(fit.model.H) / [415, 413, 415] - 1).max() < 0.005
    assert fit.residual.max() < 4e-4 * 9.81744


@needs_data
def test_eight_directions_give_six_parameters_and_never_nine():
    t, y = raw("tyrex/calib_acc_Nexus5_d1", "acc.parquet", "acc_")
    means = np.array([y[s].mean(axis=0) for s in rests(t, y, 0.06)])
    with pytest.raises(DataError, match="10 needed"):
        triangular(means, 9.80665)
    fit = bias_and_scale(means, 9.80665, raw_unit="m/s^2")
    assert np.abs(np.diag(fit.model.H) - 1).max() < 0.01
    assert fit.residual.max() > 1e-4
