"""Calibration against motion capture: simulated truth, errors in standard errors, weak motion, real recordings."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from margcal.core import so3
from margcal.core.errors import DataError, InputError
from margcal.core.types import Array, Fit, Mask, Reference
from margcal.methods import mocap_fit, mocap_spectra
from margcal.methods.mocap_excitation import attitude_excitation, rate_excitation, turn_excitation
from margcal.methods.mocap_frame import common_frame, earth_from_laboratory
from margcal.methods.reference_rates import attitude_at, resample
from margcal.workflow.mocap_simulation import MocapSimulation, gyr_symmetric, simulate_mocap

G = 9.80665
FIELD = 49.1
SIZE = {"acc": G, "gyr": 1.0, "mag": FIELD}


def seen(R: Array) -> Mask:
    return np.asarray(np.isfinite(R).all(axis=(1, 2)), dtype=np.bool_)


def fits_of(s: MocapSimulation, names: tuple[str, ...] = ("gyr", "mag", "lowpass", "forward")) -> dict[str, Fit]:
    found: dict[str, Fit] = {}
    for kind, stream in s.recording.streams.items():
        t, y = stream.t, stream.y
        R = attitude_at(s.reference, t)
        valid = seen(R)
        if kind == "gyr" and "gyr" in names:
            found["gyr"] = mocap_fit.gyroscope(t, y, R, valid)
        if kind == "mag" and "mag" in names:
            found["mag"] = mocap_fit.magnetometer(t, y, R, valid, field=FIELD)
        if kind == "acc" and "lowpass" in names:
            found["lowpass"] = mocap_fit.lowpass_svd(t, y, R, valid)
        if kind == "acc" and "forward" in names and s.reference.p is not None:
            found["forward"] = mocap_fit.forward(t, y, R, resample(s.reference.t, s.reference.p, t), valid)
    return found


def percent(fit: Fit, s: MocapSimulation) -> float:
    """Error of the calibrated vector, rms over the sphere, per cent of its length, in the marker body's frame."""
    true = s.truth.models[fit.model.kind]
    H = s.R_kh @ true.H
    E = fit.model.H @ np.linalg.inv(H) - np.eye(3)
    b = H @ (fit.model.B - true.B) / SIZE[fit.model.kind]
    return 100 * float(np.sqrt(np.sum(E**2) / 3 + b @ b))


def normalised(d: Array, P: Array) -> float:
    """NEES per degree of freedom, scaled first: counts and radians in one matrix."""
    sd = np.sqrt(np.diag(P))
    return float(d / sd @ np.linalg.solve(P / np.outer(sd, sd), d / sd)) / len(d)


def angle_deg(a: Array, b: Array) -> float:
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


@pytest.fixture(scope="module")
def calm() -> list[tuple[MocapSimulation, dict[str, Fit]]]:
    runs = [simulate_mocap(seed=k) for k in range(4)]
    return [(s, fits_of(s)) for s in runs]


@pytest.fixture(scope="module")
def shaken() -> list[tuple[MocapSimulation, dict[str, Fit]]]:
    runs = [simulate_mocap(seed=k, acceleration_rms=3.0) for k in range(4)]
    return [(s, fits_of(s, ("lowpass", "forward"))) for s in runs]


def test_late_readings_are_found_by_the_fit_itself(shaken: list[tuple[MocapSimulation, dict[str, Fit]]]) -> None:
    """The delay is one more unknown: nothing in simulation, 4 ms when they are put in, with a right standard error."""
    for name, told in (("forward", 5e-5), ("lowpass", 1e-3)):
        late = np.array([fits[name].details["late_s"] for _, fits in shaken])
        assert late[:, 1].max() < told
        assert np.sqrt(np.mean((late[:, 0] / late[:, 1]) ** 2)) < 2.0
    moved = simulate_mocap(seed=2, acceleration_rms=1.5, delays_s={"acc": 0.004}, gaps=2)
    for name, fit in fits_of(moved, ("lowpass", "forward")).items():
        step, se = fit.details["late_s"]
        assert step == pytest.approx(0.004, abs=4 * se + 1e-4), name


def rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def test_without_linear_acceleration_all_sensors_meet_issue_5(
    calm: list[tuple[MocapSimulation, dict[str, Fit]]],
) -> None:
    error = {name: rms([percent(fits[name], s) for s, fits in calm]) for name in calm[0][1]}
    assert error["gyr"] < 0.03
    assert error["lowpass"] < 0.05
    assert error["forward"] < 0.05
    assert error["mag"] < 0.1


def test_linear_acceleration_does_not_shrink_the_accelerometer(
    shaken: list[tuple[MocapSimulation, dict[str, Fit]]],
) -> None:
    assert rms([percent(fits["lowpass"], s) for s, fits in shaken]) < 0.9
    assert rms([percent(fits["forward"], s) for s, fits in shaken]) < 0.05
    for s, fits in shaken:
        lever = fits["forward"].details["lever_arm"]
        np.testing.assert_allclose(lever, [0.03, -0.02, 0.01], atol=1.5e-3)
        up = s.R_nm.T @ np.array([0.0, 0.0, 1.0])
        assert fits["forward"].u is not None
        assert angle_deg(fits["forward"].u, up) < 0.02


def test_errors_are_as_large_as_the_covariances_say(
    calm: list[tuple[MocapSimulation, dict[str, Fit]]], shaken: list[tuple[MocapSimulation, dict[str, Fit]]]
) -> None:
    """48 degrees of freedom each: 0.6 and 1.5 are two and a half standard deviations."""
    for name, runs in (("gyr", calm), ("mag", calm), ("lowpass", calm), ("forward", calm), ("forward", shaken)):
        values = []
        for s, fits in runs:
            model = fits[name].model
            true = s.truth.models[model.kind]
            d = np.concatenate([(model.H - s.R_kh @ true.H).ravel(), model.B - true.B])
            assert model.covariance is not None
            values.append(normalised(d, model.covariance))
        assert 0.6 < np.mean(values) < 1.5, name


def test_the_lever_arm_and_the_field_lie_within_their_standard_errors(
    calm: list[tuple[MocapSimulation, dict[str, Fit]]],
) -> None:
    lever, field = [], []
    for s, fits in calm:
        joint = fits["forward"].details["joint"]
        lever.append(normalised(fits["forward"].details["lever_arm"] - np.array([0.03, -0.02, 0.01]), joint[15:, 15:]))
        h, true = fits["mag"].u, s.truth.models["mag"].reference_vector
        assert h is not None
        assert true is not None
        across = np.linalg.svd(h[None, :])[2][1:]  # its length is given
        P = across @ fits["mag"].details["joint"][12:15, 12:15] @ across.T
        field.append(normalised(across @ (h - true), P))
    assert 0.2 < np.mean(lever) < 2.2
    assert 0.2 < np.mean(field) < 2.5


def test_common_frame_is_the_one_of_a_symmetric_gyroscope(calm: list[tuple[MocapSimulation, dict[str, Fit]]]) -> None:
    sigmas_b, sigmas_n, gyr_nees = [], [], []
    for s, fits in calm:
        frame = common_frame(fits["gyr"], fits["forward"], fits["mag"])
        truth = s.gyr_symmetric
        np.testing.assert_array_equal(frame.gyr.H, frame.gyr.H.T)
        assert truth.alignment is not None
        R_hk = so3.matrix_from_quat(truth.alignment.values["marker_to_node"])
        d_b = so3.log(R_hk @ frame.R_kh)
        assert np.degrees(np.linalg.norm(d_b)) < 0.05
        sigmas_b += list(d_b / frame.R_kh_se)
        assert frame.R_nm is not None
        assert frame.R_nm_se is not None
        d_n = so3.log(frame.R_nm @ s.R_nm.T)
        assert np.degrees(np.linalg.norm(d_n)) < 0.3
        sigmas_n += list(d_n / frame.R_nm_se)
        for model in frame.models.values():
            error = model.H @ np.linalg.inv(truth.models[model.kind].H) - np.eye(3)
            assert 100 * np.sqrt(np.sum(error**2) / 3) < 0.15
        # six numbers of the symmetric H and three of B: the other three directions carry no variance
        P = frame.gyr.covariance
        assert P is not None
        upper = [0, 1, 2, 4, 5, 8, 9, 10, 11]
        d = np.concatenate([(frame.gyr.H - truth.models["gyr"].H).ravel(), frame.gyr.B - truth.models["gyr"].B])[upper]
        gyr_nees.append(normalised(d, P[np.ix_(upper, upper)]))
    assert 0.4 < rms(sigmas_b) < 1.8
    assert 0.4 < rms(sigmas_n) < 1.8
    assert 0.5 < np.mean(gyr_nees) < 1.7


def test_the_frame_s_covariance_follows_from_numbers(calm: list[tuple[MocapSimulation, dict[str, Fit]]]) -> None:
    """The polar decomposition's derivative against random draws of T."""
    gyr = calm[0][1]["gyr"]
    assert gyr.covariance is not None
    frame = common_frame(gyr)
    rng = np.random.default_rng(5)
    L = np.linalg.cholesky(gyr.covariance[:9, :9])
    draws = gyr.model.H + (L @ rng.normal(size=(9, 2000))).T.reshape(-1, 3, 3)
    turned, K = so3.polar(draws)
    delta = so3.log(frame.R_kh.T @ turned)
    np.testing.assert_allclose(np.sqrt(np.diag(np.cov(delta.T))), frame.R_kh_se, rtol=0.08)
    H_sd = np.sqrt(np.diag(np.cov(K.reshape(-1, 9).T)))
    assert frame.gyr.covariance is not None
    np.testing.assert_allclose(H_sd, np.sqrt(np.diag(frame.gyr.covariance)[:9]), rtol=0.08)


def test_gaps_dropped_packets_and_jitter_do_no_harm() -> None:
    s = simulate_mocap(seed=3, acceleration_rms=1.5, gaps=6)
    stream = s.recording.streams["acc"]
    rng = np.random.default_rng(0)
    keep = np.sort(rng.permutation(len(stream.t))[: int(0.97 * len(stream.t))])
    t, y = stream.t[keep], stream.y[keep]
    R = attitude_at(s.reference, t)
    assert s.reference.p is not None
    p = resample(s.reference.t, s.reference.p, t)
    fit = mocap_fit.forward(t, y, R, p, seen(R))
    assert percent(fit, s) < 0.1


def test_jumps_of_the_optics_are_left_out() -> None:
    s = simulate_mocap(seed=6, acceleration_rms=1.5)
    stream = s.recording.streams["acc"]
    R = attitude_at(s.reference, stream.t)
    assert s.reference.p is not None
    p = resample(s.reference.t, s.reference.p, stream.t)
    p[1500:1560] += 0.05  # a marker taken for another
    p[3000:3020, 2] -= 0.1
    fit = mocap_fit.forward(stream.t, stream.y, R, p, seen(R))
    assert percent(fit, s) < 0.1
    weights = fit.details["weights"]
    moments = np.searchsorted(fit.details["track_t"], stream.t[[1500, 1559, 3000, 3019]])
    assert np.all(weights[moments] == 0.0)


def test_disturbed_stretches_of_the_field_weigh_little() -> None:
    s = simulate_mocap(seed=2)
    stream = s.recording.streams["mag"]
    y = np.array(stream.y)
    y[2000:2300] += 60.0  # nine microtesla
    R = attitude_at(s.reference, stream.t)
    fit = mocap_fit.magnetometer(stream.t, y, R, seen(R), field=FIELD)
    assert percent(fit, s) < 0.5
    inside = (fit.details["track_t"] > stream.t[2010]) & (fit.details["track_t"] < stream.t[2290])
    assert np.median(fit.details["weights"][inside]) < 0.6 * np.median(fit.details["weights"][~inside])


def test_nominal_matrix_decides_the_sign_of_a_magnetometer() -> None:
    s = simulate_mocap(seed=1)
    stream = s.recording.streams["mag"]
    R = attitude_at(s.reference, stream.t)
    plain = mocap_fit.magnetometer(stream.t, stream.y, R)
    turned = mocap_fit.magnetometer(stream.t, stream.y, R, nominal=-plain.model.H)
    np.testing.assert_allclose(turned.model.H, -plain.model.H)
    np.testing.assert_allclose(turned.model.B, plain.model.B)
    assert plain.model.unit == "norm"
    assert plain.u is not None
    assert turned.u is not None
    np.testing.assert_allclose(turned.u, -plain.u)
    np.testing.assert_allclose(np.linalg.norm(plain.u), 1.0)


# --- motion that shows too little ---------------------------------------------------------------------


@pytest.mark.parametrize("name", ["lowpass", "forward", "mag"])
def test_a_trial_of_pure_translation_is_refused_in_words(name: str) -> None:
    s = simulate_mocap(seed=0, acceleration_rms=1.5, rotation=0.01)
    with pytest.raises(DataError, match="hardly rotated at all") as refused:
        fits_of(s, (name,))
    assert refused.value.issues[0].code == "poor-excitation"
    assert "record again" in refused.value.issues[0].text


def test_a_gyroscope_hardly_turned_is_refused_and_small_turns_widen_its_errors() -> None:
    with pytest.raises(DataError, match="hardly any rotation"):
        fits_of(simulate_mocap(seed=0, rotation=0.01), ("gyr",))
    weak = fits_of(simulate_mocap(seed=0, rotation=0.15, optics_noise_deg=0.02), ("gyr",))["gyr"]
    assert "degrees rms only about" in weak.text
    P = weak.model.covariance
    assert P is not None
    to = np.kron(np.eye(3), np.linalg.inv(weak.model.H).T)
    relative = np.sqrt(np.diag(to @ P[:9, :9] @ to.T))
    assert relative.max() > 0.005  # the cameras' 0.05 degrees beside turns of a few


def test_one_axis_turned_about_names_the_other() -> None:
    angle = np.linspace(0, 40, 4000)[:, None] * np.array([0.0, 0.0, 1.0])
    R = so3.exp(np.sin(angle) * 1.2)
    level = attitude_excitation("acc", R[:, 0, :])
    assert level.level == "fail"
    assert "z axis" in level.text
    rates = np.column_stack([np.cos(angle[:, 2]), np.sin(angle[:, 2]), 0 * angle[:, 2]])
    assert rate_excitation(rates).level == "fail"
    assert "about the z axis" in rate_excitation(rates).text
    assert turn_excitation(R).level == "fail"


def test_stuck_sensor_and_bad_shapes_are_named() -> None:
    t = np.arange(500) / 100
    R = so3.exp(np.outer(np.sin(t), [1.0, 2.0, 3.0]))
    with pytest.raises(DataError, match="stuck"):
        mocap_fit.magnetometer(t, np.ones((500, 3)), R)
    with pytest.raises(InputError, match="go with one another"):
        mocap_fit.magnetometer(t, np.ones((400, 3)), R)
    with pytest.raises(InputError, match="forward"):
        mocap_fit.magnetometer(t[::-1], np.ones((500, 3)), R)
    with pytest.raises(DataError, match="only 10 samples"):
        mocap_fit.magnetometer(t, np.ones((500, 3)), R, np.arange(500) < 10)


def test_a_mirrored_gyroscope_has_no_frame(calm: list[tuple[MocapSimulation, dict[str, Fit]]]) -> None:
    s = calm[0][0]
    stream = s.recording.streams["gyr"]
    R = attitude_at(s.reference, stream.t)
    fit = mocap_fit.gyroscope(stream.t, stream.y * np.array([1.0, 1.0, -1.0]), R)
    with pytest.raises(DataError, match="handedness") as refused:
        common_frame(fit)
    assert refused.value.issues[0].code == "mirrored-axes"


def test_a_vertical_field_has_no_north() -> None:
    with pytest.raises(DataError, match="vertical"):
        earth_from_laboratory(np.array([0.0, 0.0, G]), np.array([0.0, 0.0, -48.0]))


# --- the machinery -------------------------------------------------------------------------------------


def test_spectra_of_derivatives_are_those_of_the_closed_forms() -> None:
    s = simulate_mocap(seed=4, acceleration_rms=2.0, rate=100.0, optics_noise_m=0.0, optics_noise_deg=0.0)
    t = np.arange(6000) / 100
    state = s.motion.at(t)
    valid = np.ones(len(t), dtype=bool)
    valid[3000:3100] = False
    track = mocap_spectra.even_track(t, np.zeros((len(t), 3)), state.R, valid, s.motion.position(t))
    win = mocap_spectra.window(track.valid, track.step, 0.5)
    b = mocap_spectra.band(track, 8.0)
    assert track.p is not None
    by_parts = mocap_spectra.second_derivative(track.p, win, b)
    direct = mocap_spectra.plain(state.acceleration, win, b)
    assert np.abs(by_parts - direct).max() < 5e-4 * np.abs(direct).max()
    rate = mocap_spectra.rate(track, win, b)
    direct = mocap_spectra.plain(np.einsum("nij,nj->ni", state.R, state.rate), win, b)
    assert np.abs(rate - direct).max() < 1e-4 * np.abs(direct).max()


def test_the_window_is_zero_in_gaps_and_its_derivatives_are_its_own() -> None:
    valid = np.ones(2000, dtype=bool)
    valid[700:720] = False
    win = mocap_spectra.window(valid, 0.01, 0.5)
    assert np.all(win.w[~valid] == 0)
    np.testing.assert_allclose(np.gradient(win.w, 0.01)[5:600], win.w1[5:600], atol=0.02)
    np.testing.assert_allclose(np.gradient(win.w1, 0.01)[5:600], win.w2[5:600], atol=1.5)  # its third derivative jumps
    short = mocap_spectra.window(valid, 0.01, 0.5, whole_s=0.3)
    assert short.w[690] == 1.0
    assert short.w[710] == 0.0


def test_a_smoothed_spectrum_is_unbiased_on_a_slope() -> None:
    rng = np.random.default_rng(3)
    f = np.arange(1, 400) / 10.0
    ratio = []
    for _ in range(200):
        power = f**4 * rng.chisquare(6, size=len(f))
        ratio.append(mocap_spectra.smoothed(power, np.full(len(f), 6.0), 2, 20) / f**4)
    mean = np.mean(ratio, axis=0)
    assert abs(np.mean(mean[20:-20]) - 1) < 0.03
    assert np.all(np.abs(mean[8:-20] - 1) < 0.15)


def test_simulation_is_consistent_with_itself() -> None:
    """Readings through the true model are rate, force and field; the still trial is the same node."""
    perfect = {"noise": 0.0, "quantise": False, "optics_noise_deg": 0.0, "optics_noise_m": 0.0}
    clocks = {"offset_s": 0.137, "drift_ppm": 50.0, "delays_s": {"mag": 0.011}}
    s = simulate_mocap(seed=9, acceleration_rms=1.0, **perfect, **clocks)  # type: ignore[arg-type]
    acc, gyr, mag = (s.recording.streams[k] for k in ("acc", "gyr", "mag"))
    t = 0.137 + (1 + 50e-6) * acc.t
    state = s.motion.at(t)
    np.testing.assert_allclose(s.truth.models["gyr"].apply(gyr.y), state.rate, atol=1e-9)
    force = np.einsum("nji,nj->ni", state.R, state.acceleration + np.array([0.0, 0.0, G]))
    np.testing.assert_allclose(s.truth.models["acc"].apply(acc.y), force, atol=1e-9)
    R_late = s.motion.at(t - 0.011).R
    h_m = s.truth.models["mag"].reference_vector
    assert h_m is not None
    np.testing.assert_allclose(s.truth.models["mag"].apply(mag.y), R_late.swapaxes(1, 2) @ (s.R_nm @ h_m), atol=1e-9)
    R_mk = so3.matrix_from_quat(s.reference.q)
    np.testing.assert_allclose(s.R_nm @ R_mk @ s.R_kh, s.motion.at(s.reference.t).R, atol=1e-9)
    assert s.reference.p is not None
    node = s.reference.p + R_mk @ np.array([0.03, -0.02, 0.01])
    np.testing.assert_allclose(node @ s.R_nm.T, s.motion.position(s.reference.t), atol=1e-9)
    rms_acceleration = np.sqrt(np.mean(np.sum(s.motion.at(np.arange(0, 300, 0.01)).acceleration ** 2, axis=1)))
    np.testing.assert_allclose(rms_acceleration, 1.0, rtol=0.1)
    still = simulate_mocap(seed=77, node_seed=9, still=True, duration_s=5.0)
    np.testing.assert_array_equal(still.R_kh, s.R_kh)
    np.testing.assert_array_equal(still.truth.models["acc"].H, s.truth.models["acc"].H)
    symmetric = gyr_symmetric(s.truth).models["gyr"].H
    np.testing.assert_allclose(symmetric, symmetric.T, atol=1e-15)


# --- real recordings: BROAD is factory calibrated, so the identity is the right answer -------------------


def broad(path: Path) -> tuple[dict[str, Array], Reference]:
    import pyarrow.parquet as pq

    table = pq.read_table(path)
    names = table.column_names

    def columns(*wanted: str) -> Array:
        return np.column_stack([table[n].to_numpy().astype(np.float64) for n in wanted])

    t = columns("t_s")[:, 0]
    found = {"t": t}
    for kind in ("acc", "gyr", "mag"):
        found[kind] = columns(*[n for n in names if n.startswith(f"{kind}_")][:3])
    q = columns("ref_qw", "ref_qx", "ref_qy", "ref_qz")
    return found, Reference(t, q, columns("ref_p_x_m", "ref_p_y_m", "ref_p_z_m"))


def test_broad_03_is_nearly_the_identity(data_file: Callable[[str], Path]) -> None:
    data, reference = broad(data_file("broad/03_undisturbed_slow_rotation_C.parquet"))
    half = slice(0, len(data["t"]) // 2)
    t = data["t"][half] - 0.0045  # the gyroscope's delay
    R = attitude_at(reference, t)
    valid = seen(R)
    gyr = mocap_fit.gyroscope(t, data["gyr"][half], R, valid)
    C, K = so3.polar(gyr.model.H)
    assert np.abs(K - np.eye(3)).max() < 0.007
    assert 0.05 < np.degrees(np.linalg.norm(so3.log(C))) < 0.6
    assert reference.p is not None
    p = resample(reference.t, reference.p, t)
    acc = mocap_fit.forward(t, data["acc"][half], R, p, valid)
    assert np.abs(so3.polar(acc.model.H)[1] - np.eye(3)).max() < 0.01
    assert 0.004 < np.linalg.norm(acc.details["lever_arm"]) < 0.015
    assert acc.u is not None
    assert angle_deg(acc.u, np.array([0.0, 0.0, 1.0])) < 1.0


def test_broad_12_is_refused_or_widened(data_file: Callable[[str], Path]) -> None:
    """A translation trial: hardly any rotation."""
    data, reference = broad(data_file("broad/12_undisturbed_slow_translation_C.parquet"))
    t = data["t"] - 0.0045
    R = attitude_at(reference, t)
    valid = seen(R)
    with pytest.raises(DataError, match="hardly rotated"):
        mocap_fit.lowpass_svd(t, data["acc"], R, valid)
    gyr = mocap_fit.gyroscope(t, data["gyr"], R, valid)
    assert "turned through" in gyr.text
    assert gyr.covariance is not None
    off, sd = gyr.model.H - np.eye(3), np.sqrt(np.diag(gyr.covariance)[:9]).reshape(3, 3)
    assert sd.max() > 0.01
    assert np.all(np.abs(off) < 3 * sd + 0.005)


def test_broad_21_without_positions_is_refused_and_with_them_within_one_per_cent(
    data_file: Callable[[str], Path],
) -> None:
    """Fast turns and accelerations that go with them: low frequencies alone cannot tell, and must not pretend to."""
    data, reference = broad(data_file("broad/21_undisturbed_fast_combined.parquet"))
    t = data["t"] - 0.0045
    R = attitude_at(reference, t)
    with pytest.raises(DataError, match="least determined"):
        mocap_fit.lowpass_svd(t, data["acc"], R, seen(R))
    widened = mocap_fit.lowpass_svd(t, data["acc"], R, seen(R), gate=False)
    assert mocap_fit.CROWDED in widened.text
    assert widened.covariance is not None
    off, sd = widened.model.H - np.eye(3), np.sqrt(np.diag(widened.covariance)[:9]).reshape(3, 3)
    assert np.abs(off).max() > 0.05
    assert np.all(np.abs(off) < 3 * sd)
    assert reference.p is not None
    acc = mocap_fit.forward(t, data["acc"], R, resample(reference.t, reference.p, t), seen(R))
    assert np.abs(so3.polar(acc.model.H)[1] - np.eye(3)).max() < 0.01
