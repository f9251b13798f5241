"""What a covariance means in degrees: against drawn errors and closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from margcal.core import so3
from margcal.methods.uncertainty import (
    direction_ellipses,
    direction_errors_deg,
    expected_error,
    heading_error,
    relative_covariance,
    shift_deg,
    sphere,
)

H = (
    0.005
    * so3.exp([0.1, -0.2, 0.3])
    @ (np.eye(3) + np.array([[0.05, 0.02, -0.01], [0.0, -0.04, 0.03], [0.01, 0.0, 0.02]]))
)
B = np.array([120.0, -340.0, 80.0])
G = 9.80665


def covariance(seed: int, scale: float = 1.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(12, 12)) * np.r_[np.full(9, 2e-6), np.full(3, 1.0)][:, None] * scale
    return root @ root.T


def test_sphere_is_even():
    u = sphere(400)
    assert np.linalg.norm(u, axis=1) == pytest.approx(np.ones(400))
    assert u.mean(axis=0) == pytest.approx(np.zeros(3), abs=2e-3)
    assert u.T @ u / 400 == pytest.approx(np.eye(3) / 3, abs=2e-3)


@pytest.mark.parametrize("kind", ["acc", "mag", "gyr"])
def test_expected_error_is_the_rms_of_drawn_errors(kind):
    C = covariance(1)
    drawn = np.random.default_rng(2).multivariate_normal(np.zeros(12), C, size=400)
    magnitude = 1.0 if kind == "gyr" else G
    angles = np.array(
        [direction_errors_deg(H + d[:9].reshape(3, 3), B + d[9:], H, B, None if kind == "gyr" else G) for d in drawn]
    )
    expected = expected_error(kind, H, C, magnitude)
    # mean square of 400 draws with a dozen unknowns: relative standard error of the rms about 3 %
    assert np.sqrt(np.mean(angles**2)) == pytest.approx(expected.direction_deg, rel=0.1)
    assert np.sqrt(np.mean(angles**2, axis=0)).max() == pytest.approx(expected.worst_direction_deg, rel=0.15)
    assert expected.worst_direction_deg >= expected.direction_deg


def test_a_rotation_error_is_its_angle_across_and_nothing_along():
    sd = np.radians(0.3)
    J = np.stack([(so3.skew(e) @ H).ravel() for e in np.eye(3)], axis=1)
    C = np.zeros((12, 12))
    C[:9, :9] = sd**2 * J @ J.T
    found = expected_error("acc", H, C, G)
    assert found.direction_deg == pytest.approx(0.3 * np.sqrt(2), rel=1e-6)  # two of three axes lie across
    assert found.magnitude_percent == pytest.approx(0.0, abs=1e-6)


def test_a_gain_error_is_along_and_nothing_across():
    C = np.zeros((12, 12))
    C[:9, :9] = 0.01**2 * np.outer(H.ravel(), H.ravel())
    found = expected_error("mag", H, C, 49.0)
    assert found.magnitude_percent == pytest.approx(1.0, rel=1e-9)
    assert found.direction_deg == pytest.approx(0.0, abs=1e-6)


def test_a_bias_error_counts_for_a_direction_but_not_for_a_rate():
    C = np.zeros((12, 12))
    C[9:, 9:] = np.linalg.inv(H.T @ H) * 0.05**2  # 0.05 m/s^2 about each axis of the node
    assert expected_error("acc", H, C, G).direction_deg == pytest.approx(np.degrees(0.05 / G * np.sqrt(2)), rel=1e-6)
    assert expected_error("acc", H, C, 2 * G).direction_deg == pytest.approx(
        np.degrees(0.025 / G * np.sqrt(2)), rel=1e-6
    )
    assert expected_error("gyr", H, C, 1.0).direction_deg == 0.0


def test_units_change_no_angle():
    C = covariance(4)
    T = np.diag(np.r_[np.full(9, 1e3), np.full(3, 1e-3)])  # counts to kilocounts
    scaled = expected_error("acc", 1e3 * H, T @ C @ T, G)
    assert scaled.direction_deg == pytest.approx(expected_error("acc", H, C, G).direction_deg, rel=1e-9)


def test_direction_errors_of_closed_forms():
    turned = so3.exp(np.radians(2.0) * np.array([0.0, 0.0, 1.0])) @ H
    angle = direction_errors_deg(turned, B, H, B, G)
    u = sphere()
    exact = np.degrees(2 * np.arcsin(np.sin(np.radians(1.0)) * np.hypot(u[:, 0], u[:, 1])))
    assert angle == pytest.approx(exact, abs=1e-9)
    assert direction_errors_deg(1.3 * H, B, H, B, G) == pytest.approx(np.zeros(len(u)), abs=1e-5)
    assert direction_errors_deg(-H, B, H, B, G) == pytest.approx(np.full(len(u), 180.0))
    assert direction_errors_deg(H, B + 5, H, B, None) == pytest.approx(np.zeros(len(u)), abs=1e-5)
    assert direction_errors_deg(H, B + 5, H, B, G).max() > 0.1


def test_the_worst_direction_is_where_it_says():
    found = expected_error("mag", H, covariance(3), 49.0)
    C = relative_covariance("mag", H, covariance(3), 49.0, np.array([found.worst_towards]))[0]
    u = np.array(found.worst_towards)
    assert np.degrees(np.sqrt(np.trace(C) - u @ C @ u)) == pytest.approx(found.worst_direction_deg)


@pytest.mark.parametrize("kind", ["acc", "gyr"])
def test_ellipses_hold_the_direction_errors(kind):
    C, u = covariance(6), sphere(26)
    axes = direction_ellipses(kind, H, C, G, u)
    assert np.einsum("nki,ni->nk", axes, u) == pytest.approx(np.zeros((26, 2)), abs=1e-9)  # across
    assert np.sum(axes[:, 0] * axes[:, 1], axis=1) == pytest.approx(np.zeros(26), abs=1e-12)
    assert (np.linalg.norm(axes[:, 0], axis=1) >= np.linalg.norm(axes[:, 1], axis=1)).all()
    # drawn errors along each semi-axis have its length for their standard deviation
    drawn = np.random.default_rng(7).multivariate_normal(np.zeros(12), C, size=2000)
    z = G * u @ np.linalg.inv(H).T
    e = np.einsum("dij,nj->dni", drawn[:, :9].reshape(-1, 3, 3), z)
    e = (e - (0 if kind == "gyr" else drawn[:, None, 9:] @ H.T)) / G
    size = np.linalg.norm(axes, axis=2)
    along = np.einsum("dni,nki->dnk", e, axes / size[:, :, None])
    assert np.std(along, axis=0) == pytest.approx(size, rel=0.08)


def test_shift_is_the_rms_angle_of_a_small_change():
    rng = np.random.default_rng(8)
    shift = rng.normal(size=(5, 12)) * np.r_[np.full(9, 1e-6), np.full(3, 1.0)]
    for kind, magnitude in (("acc", G), ("gyr", None)):
        found = shift_deg(kind, H, shift, G)
        for d, angle in zip(shift, found):
            exact = direction_errors_deg(H + d[:9].reshape(3, 3), B + d[9:], H, B, magnitude)
            assert angle == pytest.approx(np.sqrt(np.mean(exact**2)), rel=5e-3)


# --- heading -----------------------------------------------------------------------------------------

H_MAG = 0.1 * so3.exp([3.0, 0.1, -0.2]) @ np.diag([1.05, 0.93, 1.01])
FIELD = 49.0


def _rotation_covariance(sd):
    """Of the accelerometer's and the magnetometer's (H, B), (24, 24): one turn of the common frame."""
    J = np.zeros((24, 3))
    J[:9] = np.stack([(so3.skew(e) @ H).ravel() for e in np.eye(3)], axis=1)
    J[12:21] = np.stack([(so3.skew(e) @ H_MAG).ravel() for e in np.eye(3)], axis=1)
    return sd**2 * J @ J.T


def _heading(C, dip, between=True):
    return heading_error((H, C[:12, :12]), (H_MAG, C[12:, 12:]), G, FIELD, dip, C[12:, :12] if between else None)


@pytest.mark.parametrize("dip_deg", [0.0, 60.0, -75.0])
def test_a_turn_of_the_common_frame_turns_the_heading_by_itself(dip_deg):
    """At any dip: what the two sensors share does not mix with the dip."""
    C = _rotation_covariance(np.radians(0.3))
    assert _heading(C, np.radians(dip_deg)) == pytest.approx(0.3, rel=1e-6)
    assert _heading(C, np.radians(dip_deg), between=False) >= 0.3


def test_heading_without_accelerometer_errors_is_the_horizontal_error_over_the_horizontal_field():
    C = np.zeros((24, 24))
    C[21:, 21:] = np.linalg.inv(H_MAG.T @ H_MAG) * 0.2**2  # 0.2 uT about each axis
    for dip in np.radians([0.0, 66.0]):
        assert _heading(C, dip) == pytest.approx(np.degrees(0.2 / (FIELD * np.cos(dip))), rel=1e-6)
        assert _heading(C, dip, between=False) == pytest.approx(_heading(C, dip), rel=1e-9)


def test_heading_error_is_the_rms_of_drawn_headings():
    """Monte Carlo: headings by cross products from wrong models, against those from the true ones."""
    rng, dip = np.random.default_rng(9), np.radians(63.0)
    size = np.r_[np.full(9, 2e-6), np.full(3, 1.0), np.full(9, 4e-5), np.full(3, 0.5)]
    root = rng.normal(size=(24, 24)) * size[:, None]
    C = root @ root.T + _rotation_covariance(np.radians(0.5))
    off = []
    for d in rng.multivariate_normal(np.zeros(24), C, size=4000):
        R = so3.matrix_from_quat(rng.normal(size=4))  # R_nh
        f, m = R.T @ [0, 0, G], R.T @ (FIELD * np.array([0, np.cos(dip), -np.sin(dip)]))
        u_f = (H + d[:9].reshape(3, 3)) @ (np.linalg.inv(H) @ f - d[9:12])
        u_m = (H_MAG + d[12:21].reshape(3, 3)) @ (np.linalg.inv(H_MAG) @ m - d[21:])
        east = R @ np.cross(u_m, u_f)
        off.append(np.degrees(np.arctan2(east[1], east[0])))
    rms = np.sqrt(np.mean(np.square(off)))
    assert 0.1 < rms < 5
    assert _heading(C, dip) == pytest.approx(rms, rel=0.05)
    assert _heading(C, dip, between=False) > rms
