"""The rotation between a magnetometer calibrated by magnitude and the node, from the dip and from rates."""

from __future__ import annotations

import numpy as np
import pytest

from margcal.core import so3
from margcal.core.errors import DataError
from margcal.methods.alignment import rotation_from_dip, rotation_from_rates
from margcal.workflow.simulate import swing

OMEGA = so3.exp(np.array([0.4, -0.7, 1.1]))


def attitudes(n: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=(n, 3))
    return so3.exp(rng.uniform(0.3, 3, (n, 1)) * axis / np.linalg.norm(axis, axis=1, keepdims=True))


def dip_problem(n: int, dip_deg: float, seed: int = 0, sign: float = 1.0, noise: float = 0.0):
    rng = np.random.default_rng(seed + 100)
    R = attitudes(n, seed)
    dip = np.radians(dip_deg)
    field = sign * np.array([0.0, np.cos(dip), -np.sin(dip)])
    b = np.einsum("jba,b->ja", R, field)
    v = b @ OMEGA + noise * rng.normal(size=b.shape)  # Omega^T b
    return v / np.linalg.norm(v, axis=1, keepdims=True), R[:, 2, :]


# --- dip ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dip_deg", [-60.0, 0.0, 30.0, 66.0, 80.0])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_constant_dip_tells_the_rotation(dip_deg, sign):
    v, up = dip_problem(16, dip_deg, sign=sign)
    found = rotation_from_dip(v, up)
    assert found is not None
    assert np.degrees(so3.angle_between(found, OMEGA)) < 1e-5
    assert np.linalg.det(found) == pytest.approx(1.0)


def test_error_of_the_dip_method_is_of_the_size_of_the_noise():
    worst = [
        np.degrees(so3.angle_between(rotation_from_dip(*dip_problem(24, 60, seed=s, noise=0.01)), OMEGA))
        for s in range(10)
    ]
    assert np.sqrt(np.mean(np.square(worst))) < 3 * np.degrees(0.01)


def test_dip_does_not_guess_where_attitudes_do_not_tell():
    v, up = dip_problem(9, 60)
    assert rotation_from_dip(v, up) is None  # nine equations for nine unknowns
    R = so3.exp(np.linspace(0, 6, 20)[:, None] * np.array([0.3, 0.4, 0.5]))  # one axis
    b = R.transpose(0, 2, 1) @ np.array([0, 0.5, -0.8])
    assert rotation_from_dip(b @ OMEGA / np.linalg.norm(b[0]), R[:, 2, :]) is None


# --- rates -------------------------------------------------------------------------------------------


def moving(seed: int, *, delay_s: float = 0.0, noise: float = 0.006, duration_s: float = 40.0, rate: float = 100.0):
    """Field directions (in the magnetometer's frame) and rates of a swing; white noise of both."""
    rng = np.random.default_rng(seed)
    motion = swing(seed=seed, duration_s=duration_s).motion
    t = np.arange(0, duration_s, 2 / rate)  # magnetometer at half the rate
    t_gyr = 0.003 + np.arange(0, duration_s, 1 / rate)
    field = np.array([0.0, 0.4, -0.9165])
    v = np.einsum("nba,b->na", motion.at(t - delay_s).R, field) @ OMEGA
    rates = motion.at(t_gyr).rate + 0.02 + 0.003 * rng.normal(size=(len(t_gyr), 3))
    return t, v + noise * rng.normal(size=v.shape), t_gyr, rates


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("delay_s", [0.0, 0.015])
def test_rotation_and_delay_within_four_standard_errors(seed, delay_s):
    found = rotation_from_rates(*moving(seed, delay_s=delay_s))
    error = np.degrees(so3.log(found.Omega @ OMEGA.T))
    assert np.all(np.abs(error) < 4 * found.se_deg)
    assert np.all(found.se_deg < 0.3)
    assert found.delay_s is not None
    assert found.delay_se_s is not None
    assert abs(found.delay_s - delay_s) < 4 * found.delay_se_s + 5e-4
    assert found.delay_se_s < 0.004
    assert found.gain == pytest.approx(1.0, abs=0.01)


def test_standard_errors_are_those_of_repeated_runs():
    runs = [rotation_from_rates(*moving(20 + s, duration_s=30.0)) for s in range(8)]
    error = np.array([np.degrees(so3.log(r.Omega @ OMEGA.T)) for r in runs])
    ratio = np.sqrt(np.mean((error / np.array([r.se_deg for r in runs])) ** 2))
    # 24 standardised errors: standard error of their rms about 15 %, and shared window ends are not independent
    assert 0.5 < ratio < 1.6


def test_a_wrong_gain_of_the_gyroscope_shows_in_the_gain_and_not_in_the_rotation():
    t, v, t_gyr, rates = moving(3)
    found = rotation_from_rates(t, v, t_gyr, 1.05 * (rates - 0.02))
    assert found.gain == pytest.approx(1 / 1.05, abs=0.01)
    assert np.degrees(so3.angle_between(found.Omega, OMEGA)) < 1.0


def test_a_magnetometer_turned_by_a_half_turn_is_found_too():
    """No start near the truth is needed: axes of boards are swapped and flipped."""
    t, v, t_gyr, rates = moving(4)
    flip = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    found = rotation_from_rates(t, v @ flip.T, t_gyr, rates)
    assert np.degrees(so3.angle_between(found.Omega, OMEGA @ flip.T)) < 1.0


def test_motion_that_is_too_short_is_refused_with_a_reason():
    t, v, t_gyr, rates = moving(5)
    with pytest.raises(DataError, match=r"too short|too little|turn"):
        rotation_from_rates(t[:40], v[:40], t_gyr[:80], rates[:80])


def test_a_node_that_lies_still_tells_no_rotation():
    rng = np.random.default_rng(1)
    t = np.arange(0, 30, 0.02)
    v = np.array([0.0, 0.4, -0.9165]) + 0.005 * rng.normal(size=(len(t), 3))
    rates = 0.02 + 0.003 * rng.normal(size=(len(t), 3))
    try:
        found = rotation_from_rates(t, v, t, rates)
    except DataError:
        return
    assert not np.all(found.se_deg < 2.0)  # or says that it does not know
