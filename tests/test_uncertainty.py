"""What a covariance means in degrees: against drawn errors and closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from margcal.core import so3
from margcal.methods.uncertainty import direction_errors_deg, expected_error, sphere

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
