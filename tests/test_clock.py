"""Clocks and delays between node and optics: simulated truth in standard errors, refusals, derivatives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from margcal.core import so3
from margcal.core.errors import DataError
from margcal.core.types import Reference
from margcal.methods.clock import gyroscope_at_reference, synchronise
from margcal.methods.delays import delay_of
from margcal.methods.reference_rates import (
    attitude_at,
    derivatives,
    points_at,
    reference_rates,
    savitzky_golay,
    usual_rate,
)
from margcal.workflow.mocap_simulation import MocapSimulation, simulate_mocap


def test_weights_are_exact_for_quartics() -> None:
    W, k = savitzky_golay(11), np.arange(11) - 5
    for degree, (value, first, second) in enumerate([(1, 0, 0), (0, 1, 0), (0, 0, 2), (0, 0, 0), (0, 0, 0)]):
        assert W @ k.astype(float) ** degree == pytest.approx([value, first, second], abs=1e-12)
    assert points_at(100.0) == 11
    assert points_at(60.0) == 7


def test_uneven_time_is_taken_into_account() -> None:
    t = np.linspace(0, 2, 200)
    t = t + 0.001 * np.sin(5 * t)
    value, first, second, left = derivatives(t, np.column_stack([t**2, np.sin(3 * t)]), 11)
    inner = slice(5, -5)
    assert value[inner, 0] == pytest.approx(t[inner] ** 2, abs=1e-9)
    assert first[inner, 0] == pytest.approx(2 * t[inner], abs=1e-6)
    assert second[inner, 1] == pytest.approx(-9 * np.sin(3 * t[inner]), abs=5e-3)
    assert np.isnan(first[:5]).all()
    assert left < 1e-9


def test_rate_is_in_the_bodys_axes() -> None:
    """(14) corrected: a body turned about its own z, carried about by another turn; and the sign by hand."""
    t = np.arange(400) / 100.0
    tilt = so3.quat_exp(np.array([1.2, 0.0, 0.0]))
    q = so3.quat_multiply(tilt, so3.quat_exp(np.outer(0.7 * t, [0, 0, 1.0])))
    q[::7] *= -1
    rates = reference_rates(Reference(t, q))
    assert rates.w[rates.valid] == pytest.approx(np.tile([0, 0, 0.7], (int(rates.valid.sum()), 1)), abs=1e-9)
    printed = reference_rates(Reference(t, q), as_printed=True)
    about = so3.matrix_from_quat(tilt) @ np.array([0, 0, 0.7])
    assert printed.w[printed.valid] == pytest.approx(np.tile(about, (int(rates.valid.sum()), 1)), abs=1e-9)


def test_gaps_are_masked_and_not_bridged() -> None:
    sim = simulate_mocap(seed=3, duration_s=20)
    q = np.array(sim.reference.q)
    q[500:530] = np.nan
    t = np.delete(sim.reference.t, np.s_[900:940])  # rows that are missing altogether
    rates = reference_rates(Reference(t, np.delete(q, np.s_[900:940], axis=0)))
    half = rates.points // 2
    assert not rates.valid[500 - half : 530 + half].any()
    assert not rates.valid[900 - half : 900 + half].any()
    assert rates.valid[530 + half : 900 - half].all()
    assert usual_rate(t) == pytest.approx(100.0)


@pytest.fixture(scope="module")
def moved() -> MocapSimulation:
    return simulate_mocap(
        seed=1, acceleration_rms=1.5, offset_s=0.137, drift_ppm=50, gaps=5, delays_s={"mag": 0.011, "acc": 0.004}
    )


def test_offset_drift_and_T_within_their_errors() -> None:
    scores = []
    for seed, offset, drift in ((1, 0.137, 50.0), (2, -0.25, -30.0), (3, 12.5, 0.0), (4, 0.0, 120.0)):
        sim = simulate_mocap(seed=seed, duration_s=40, acceleration_rms=0.5, offset_s=offset, drift_ppm=drift)
        gyr = sim.recording.streams["gyr"]
        found = synchronise(gyr.t, gyr.y, reference_rates(sim.reference))
        assert found.peak > 0.99
        assert abs(found.offset_s - offset) < 3e-4
        scores += [(found.offset_s - offset) / found.offset_se_s, (found.drift_ppm - drift) / found.drift_se_ppm]
        T = sim.R_kh @ sim.truth.models["gyr"].H
        assert np.linalg.norm(found.T @ np.linalg.inv(T) - np.eye(3), 2) < 1e-3
    assert np.sqrt(np.mean(np.square(scores))) < 2.0  # eight of them, one sigma each


def test_common_clock_tells_the_gyroscopes_delay() -> None:
    sim = simulate_mocap(seed=5, duration_s=40, delays_s={"gyr": 0.0045})
    gyr = sim.recording.streams["gyr"]
    rates = reference_rates(sim.reference)
    found = synchronise(gyr.t, gyr.y, rates, common_clock=True)
    assert found.delay_s == pytest.approx(0.0045, abs=4 * found.delay_se_s)
    assert found.delay_se_s < 3e-4
    assert (found.offset_s, found.drift_ppm) == (0.0, 0.0)
    # on separate clocks the same delay is part of the offset
    apart = synchronise(gyr.t, gyr.y, rates)
    assert apart.offset_s == pytest.approx(-0.0045, abs=4 * apart.offset_se_s)


def test_delay_of_the_magnetometer(moved: MocapSimulation) -> None:
    rates, streams = reference_rates(moved.reference), moved.recording.streams
    sync = synchronise(streams["gyr"].t, streams["gyr"].y, rates)
    h = moved.R_nm.T @ np.array([0.0, 0.4, -0.9])
    u = np.einsum("nji,j->ni", rates.R, h)
    mag = delay_of(sync.reference_time(streams["mag"].t), streams["mag"].y, rates.t, u)
    assert mag.delay_s == pytest.approx(0.011, abs=4 * mag.se_s)
    assert mag.se_s < 5e-4
    # a delay that is put in on top comes out
    later = delay_of(sync.reference_time(streams["mag"].t + 0.02), streams["mag"].y, rates.t, u)
    assert later.delay_s - mag.delay_s == pytest.approx(0.02, abs=1e-4)


def test_gyroscope_meets_the_optics(moved: MocapSimulation) -> None:
    """Both sides go through the same polynomials: the fit leaves the optics' noise and nothing else."""
    rates, gyr = reference_rates(moved.reference), moved.recording.streams["gyr"]
    sync = synchronise(gyr.t, gyr.y, rates)
    z = gyroscope_at_reference(sync, gyr.t, gyr.y, rates)
    miss = (rates.w - z @ sync.T.T - sync.c)[rates.valid]
    miss = miss[np.isfinite(miss).all(axis=1)]
    assert np.std(miss) == pytest.approx(rates.noise_w, rel=0.1)


def test_other_motion_is_refused(moved: MocapSimulation) -> None:
    gyr = moved.recording.streams["gyr"]
    other = simulate_mocap(seed=9)
    with pytest.raises(DataError, match="correlate by 0"):
        synchronise(gyr.t, gyr.y, reference_rates(other.reference))


def test_motion_that_repeats_is_refused() -> None:
    """A wave of one period: every period later fits as well."""
    t = np.arange(6000) / 100.0
    phase = 2 * np.pi * t[:, None] + np.array([0.0, 1.0, 2.2])
    w = np.sin(phase)
    q = np.empty((len(t), 4))
    q[0] = [1, 0, 0, 0]
    for k in range(1, len(t)):  # exact enough: 10 ms steps
        q[k] = so3.quat_multiply(q[k - 1], so3.quat_exp((w[k] + w[k - 1]) / 200))
    with pytest.raises(DataError, match="repeats itself"):
        synchronise(t[500:3500], w[500:3500], reference_rates(Reference(t, q)))


def test_attitude_between_samples(moved: MocapSimulation) -> None:
    sim = simulate_mocap(seed=2, duration_s=10, optics_noise_deg=0.0)
    at = np.linspace(1, 9, 333)
    true = sim.R_nm.T @ sim.motion.at(at).R @ sim.R_kh.T
    assert np.degrees(so3.angle_between(attitude_at(sim.reference, at), true)).max() < 2e-3
    hidden = replace(
        sim.reference, q=np.where(np.arange(len(sim.reference.t))[:, None] == 400, np.nan, sim.reference.q)
    )
    assert np.isnan(attitude_at(hidden, np.array([3.995, 4.005]))).all()
