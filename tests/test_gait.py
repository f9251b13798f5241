"""The simulated walker: every derivative is that of what it is derived from, and the walk is a plausible one."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from margcal.core import so3
from margcal.workflow import gait
from margcal.workflow.gait import PLACES, GaitNode, Place, walker
from margcal.workflow.motion import Motion

T = np.arange(0.0, 40.0, 0.01)


@pytest.fixture(scope="module")
def walked() -> gait.Gait:
    return walker(np.random.default_rng(0))


@pytest.mark.parametrize("place", PLACES)
def test_rate_and_acceleration_are_the_derivatives_of_attitude_and_position(walked, place: Place):
    node: Motion = GaitNode(walked, place)
    state, h = node.at(T), 1e-4
    position = GaitNode(walked, place).position
    acceleration = (position(T + h) - 2 * position(T) + position(T - h)) / h**2
    # the third derivative of the heel strike's bump jumps at its ends: 0.01 m/s^2 is what the difference makes of it
    np.testing.assert_allclose(state.acceleration, acceleration, atol=0.01)
    smooth = np.abs(acceleration - state.acceleration).max(axis=1) < 2e-4
    assert smooth.mean() > 0.97
    rate = so3.log(np.swapaxes(node.at(T - h).R, 1, 2) @ node.at(T + h).R) / (2 * h)
    np.testing.assert_allclose(state.rate, rate, atol=2e-6)
    np.testing.assert_allclose(
        state.R @ np.swapaxes(state.R, 1, 2), np.broadcast_to(np.eye(3), (len(T), 3, 3)), atol=1e-12
    )


def test_segments_carry_velocity_and_angular_acceleration_too(walked):
    h = 1e-5
    for segment in (walked.pelvis, walked.thigh, walked.shank):
        now, before, after = segment(T), segment(T - h), segment(T + h)
        np.testing.assert_allclose(now.v, (after.p - before.p) / (2 * h), atol=1e-6)
        np.testing.assert_allclose(now.rate_change, (after.rate - before.rate) / (2 * h), atol=1e-5)


def test_segments_hang_together(walked):
    """Knee to hip is the thigh's length at all times, and the joint bends as the series says."""
    hip = walked.pelvis(T).at(np.array([0.0, 0.09, -0.06])).p
    knee = walked.thigh(T).at(np.array([0.0, 0.0, -0.42])).p
    np.testing.assert_allclose(np.linalg.norm(hip - knee, axis=1), 0.42, atol=1e-12)
    assert np.all(hip[:, 2] > knee[:, 2])


def test_angles_are_those_of_the_textbooks():
    phi = np.linspace(0, 2 * np.pi, 721)
    zero = np.zeros_like(phi)
    for points, most, least, swing in ((gait._HIP, 33, -10, None), (gait._KNEE, 60, 0, 70)):
        angle = np.degrees(gait.through(points).at((phi, zero, zero))[0])
        assert most - 4 < angle.max() < most + 2 and least - 2 < angle.min() < least + 4
        np.testing.assert_allclose(angle[0:720:36], points, atol=1.5)
        if swing is not None:
            assert abs(100 * np.argmax(angle) / 720 - swing) < 5  # the knee is bent most in mid-swing


def test_rates_and_accelerations_are_those_of_slow_walking(walked):
    walking = T[T > 9]
    rms = {}
    for place in PLACES:
        state = GaitNode(walked, place).at(walking)
        rms[place] = float(np.degrees(np.sqrt(np.mean(np.sum(state.rate**2, axis=1)))))
        assert np.linalg.norm(state.acceleration, axis=1).max() < 25
    assert rms["hip"] < 40 < rms["thigh"] < 100 < rms["ankle"] < 180
    ankle = GaitNode(walked, "ankle").at(walking)
    assert 200 < np.degrees(np.abs(ankle.rate[:, 1]).max()) < 400  # swing
    assert 3 < np.sqrt(np.mean(np.sum(ankle.acceleration**2, axis=1))) < 9


def test_strides_scatter_by_about_two_per_cent():
    spread = []
    for seed in range(8):
        walked = walker(np.random.default_rng(seed))
        phase = walked.phase(T)[0]
        strikes = np.interp(2 * np.pi * np.arange(1, 28), phase, T)
        strides = np.diff(strikes)
        assert strides.mean() == pytest.approx(gait.STRIDE_S, rel=0.03)
        spread.append(strides.std() / strides.mean())
    assert 0.01 < np.mean(spread) < 0.03


def test_walker_stands_first_and_stays_on_the_treadmill(walked):
    for place in PLACES:
        standing = GaitNode(walked, place).at(T[walked.standing_s > T])
        np.testing.assert_allclose(standing.rate, 0, atol=1e-12)
        assert np.abs(standing.acceleration).max() < 0.1  # the slow sway
        assert np.ptp(GaitNode(walked, place).position(T)[:, :2], axis=0).max() < 1.2


def test_heel_strikes_are_felt_once_a_stride(walked):
    """The shank's jolt: more than 2 m/s^2, in one place of every stride."""
    walking = T[T > 10]
    phase = walked.phase(walking)[0] / (2 * np.pi) % 1.0
    jolt = gait._strike(walked.phase(walking), walked._fade(walking), (0.0,), 0.0008)[2]
    assert np.abs(jolt).max() > 2 and phase[np.abs(jolt) > 0.5].max() < 0.06
    felt = walking[np.abs(jolt) > 1]
    strikes = 1 + np.count_nonzero(np.diff(felt) > 0.5)
    strides = (walked.phase(walking[-1:])[0] - walked.phase(walking[:1])[0]) / (2 * np.pi)
    assert abs(strikes - strides[0]) <= 1


def test_same_seed_same_walker_and_the_heading_only_turns_him(walked):
    for a, b in itertools.pairwise([walker(np.random.default_rng(0)), walked]):
        np.testing.assert_array_equal(GaitNode(a, "thigh").position(T), GaitNode(b, "thigh").position(T))
    east = GaitNode(walker(np.random.default_rng(0), heading_deg=0.0), "ankle").at(T)
    turned = so3.exp([0, 0, np.radians(70.0)])
    there = GaitNode(walked, "ankle").at(T)
    np.testing.assert_allclose(there.R, turned @ east.R, atol=1e-12)
    np.testing.assert_allclose(there.rate, east.rate, atol=1e-12)
