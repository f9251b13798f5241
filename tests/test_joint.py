"""The joint maximum-likelihood fit, on problems built from arrays: closed forms, differences, statistics."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from margcal.core import so3
from margcal.methods import joint
from margcal.methods.joint import Gyro, JointFit, Priors, Triad, joint_fit
from margcal.methods.preintegration import TurnBatch, integrate

U = {"acc": np.array([0.0, 0.0, 9.80665]), "mag": np.array([0.0, 19.6, -45.0])}
SE = {"acc": 0.2, "mag": 0.15, "gyr": 0.1}
GYRO_SD = 2.0
SAMPLES, DT = 40, 0.025


@dataclass
class Problem:
    """A node, its readings at rest and in turns, and the attitudes as labelled."""

    H: dict
    B: dict
    R: np.ndarray
    label: np.ndarray
    triads: dict
    gyro: Gyro | None


def make(seed, n=20, s_rot_deg=0.0, noise=1.0, gyro=True, kinds=("acc", "mag")) -> Problem:
    rng = np.random.default_rng(seed)
    scale = {"acc": 200.0, "mag": 7.0, "gyr": 940.0}
    A = {
        k: s * so3.exp(0.06 * rng.normal(size=3)) @ (np.eye(3) + 0.04 * rng.normal(size=(3, 3)))
        for k, s in scale.items()
    }
    B = {k: 50 * rng.normal(size=3) for k in scale}
    label = so3.exp(rng.uniform(0.5, 2.8, (n, 1)) * _unit(rng.normal(size=(n, 3))))
    R = label @ so3.exp(np.radians(s_rot_deg) * rng.normal(size=(n, 3)))
    triads = {}
    for kind in kinds:
        y = np.einsum("jba,b->ja", R, U[kind]) @ A[kind].T + B[kind] + noise * SE[kind] * rng.normal(size=(n, 3))
        triads[kind] = Triad(
            y,
            np.full((n, 3), SE[kind]),
            A[kind] * 1.01,
            B[kind] + 3,
            so3.exp([0.01, -0.02, 0.01]) @ U[kind],
            u_free=True,
        )
    g = None
    if gyro:
        H = np.linalg.inv(A["gyr"])
        steps = np.swapaxes(R[:-1], 1, 2) @ R[1:]
        rate = so3.log(steps)[:, None, :] / (SAMPLES * DT) * np.ones((1, SAMPLES, 1))
        y = rate @ A["gyr"].T + B["gyr"] + noise * GYRO_SD * rng.normal(size=rate.shape)
        rest = B["gyr"] + noise * SE["gyr"] * rng.normal(size=(n, 3))
        turns = TurnBatch(y, np.full(y.shape[:2], DT))
        i = np.arange(n - 1)
        g = Gyro(rest, np.full((n, 3), SE["gyr"]), H * 1.01, B["gyr"] + 1, turns, i, i + 1, np.full(3, GYRO_SD))
    return Problem({k: np.linalg.inv(a) for k, a in A.items()}, B, R, label, triads, g)


def _unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def solve(p: Problem, **options) -> JointFit:
    return joint_fit(p.triads, p.gyro, p.label, options.pop("priors", Priors(R0=p.label)), **options)


# --- derivatives -------------------------------------------------------------------------------------


def _everything(triangular: bool):
    p = make(3, n=8, s_rot_deg=5.0)
    p.triads["acc"] = replace(p.triads["acc"], triangular=triangular, A=np.triu(p.triads["acc"].A))
    up = np.eye(3)[np.argmax(np.abs(p.label[:, 2, :]), axis=1)]
    priors = Priors(R0=p.label, up=up, level_sd=0.02, vertical_sd=0.03)
    layout = joint._lay_out(p.triads, p.gyro, len(p.label))
    return joint._Data(p.triads, p.gyro, priors, layout), joint._start(p.triads, p.gyro, p.R)


@pytest.mark.parametrize("name", ["acc", "mag", "gyr", "turn", "rot", "level", "vertical"])
@pytest.mark.parametrize("triangular", [False, True])
def test_jacobian_of_every_block_matches_central_differences(name, triangular):
    data, state = _everything(triangular)
    scale = np.sqrt(np.sum(np.concatenate([b.J for b in joint._blocks(data, state)]) ** 2, axis=0)) + 1e-9

    def residual(step):
        return next(b.r for b in joint._blocks(data, joint._moved(data.layout, state, step)) if b.name == name)

    block = next(b for b in joint._blocks(data, state) if b.name == name)
    assert np.abs(block.J).max() > 0
    for column in range(data.layout.size):
        step = np.zeros(data.layout.size)
        step[column] = 1e-4 / max(scale[column], 1.0)
        # the turns' weights depend on H and B a little; Gauss-Newton leaves that out, and so does the tolerance
        difference = (residual(step) - residual(-step)) / (2 * step[column])
        tolerance = 2e-2 if name == "turn" else 1e-5
        assert block.J[:, column] == pytest.approx(
            difference, abs=tolerance * np.abs(block.J[:, column]).max() + 1e-6 * scale[column]
        )


# --- recovery ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("kinds", [("acc", "mag"), ("acc",), ("mag",)])
def test_noise_free_problem_is_recovered(kinds):
    p = make(1, noise=0.0, kinds=kinds)
    fit = solve(p)
    assert fit.converged
    for kind in (*kinds, "gyr"):
        assert fit.H[kind] == pytest.approx(p.H[kind], abs=1e-7 * np.abs(p.H[kind]).max()), kind
        assert fit.B[kind] == pytest.approx(p.B[kind], abs=1e-4), kind
    assert np.degrees(so3.angle_between(fit.R, p.R)).max() < 1e-5
    for kind in kinds:
        assert fit.u[kind] == pytest.approx(U[kind], abs=1e-5)
        assert np.linalg.norm(fit.u[kind]) == pytest.approx(np.linalg.norm(U[kind]), rel=1e-12)


def test_rests_without_a_reading_are_left_out_of_that_sensor_only():
    whole, p = make(5), make(5)
    for kind, rows in (("acc", [1, 4]), ("mag", [0, 7, 8])):
        y = p.triads[kind].y.copy()
        y[rows] = np.nan
        p.triads[kind] = replace(p.triads[kind], y=y)
    rest = p.gyro.y.copy()
    rest[3] = np.nan
    p.gyro = replace(p.gyro, y=rest)
    fit, full = solve(p), solve(whole)
    assert fit.converged
    assert np.isfinite(fit.R).all()
    assert np.isnan(fit.residual["acc"][[1, 4]]).all()
    assert np.isfinite(fit.residual["acc"]).sum() == 18
    for kind in ("acc", "mag", "gyr"):
        assert np.abs(fit.H[kind] @ np.linalg.inv(full.H[kind]) - np.eye(3)).max() < 3e-3
        assert np.trace(fit.covariance[kind]) > np.trace(full.covariance[kind])


def test_attitudes_unknown_to_the_labels_come_from_the_sensors():
    p = make(6, s_rot_deg=3.0)
    fit = joint_fit(p.triads, p.gyro, p.label, Priors(R0=p.label))
    error = np.degrees(so3.angle_between(fit.R, p.R))
    # the three sensors agree to hundredths of a degree on attitudes that the labels give to five, but for what
    # only labels can tell: the frames of laboratory and housing
    common = inner = np.eye(3)
    for _ in range(30):
        common = so3.mean_rotation(fit.R @ np.swapaxes(p.R @ inner, 1, 2))
        inner = so3.mean_rotation(np.swapaxes(common @ p.R, 1, 2) @ fit.R)
    left = np.degrees(so3.angle_between(common @ p.R @ inner, fit.R))
    assert np.sqrt(np.mean(left**2)) < 0.1
    assert np.sqrt(np.mean(np.degrees(so3.angle_between(p.label, p.R)) ** 2)) > 4
    assert np.sqrt(np.mean(error**2)) < 3


# --- variance components ------------------------------------------------------------------------------


@pytest.mark.parametrize("s_rot_deg", [0.05, 0.2, 0.5])
def test_housing_error_is_found_from_the_data(s_rot_deg):
    found = []
    for seed in range(6):
        fit = solve(make(100 + seed, n=24, s_rot_deg=s_rot_deg))
        assert fit.converged
        found.append(np.degrees(fit.s_rot))
        redundancy = fit.redundancy["rot"]
        assert found[-1] == pytest.approx(s_rot_deg, rel=4 / np.sqrt(2 * redundancy))  # four standard errors
    assert np.mean(found) == pytest.approx(s_rot_deg, rel=0.12)


def test_noise_of_the_readings_is_found_from_the_data():
    p = make(7, n=40, noise=3.0)
    fit = solve(p)
    for kind in ("acc", "mag", "gyr"):
        assert fit.component[kind] == pytest.approx(3.0, rel=4 / np.sqrt(2 * fit.redundancy[kind]))


def test_components_stay_where_they_are_told_to():
    p = make(8, s_rot_deg=0.2)
    fit = solve(p, priors=Priors(R0=p.label, s_rot=np.radians(0.35)))
    assert fit.s_rot == pytest.approx(np.radians(0.35), rel=1e-12)
    fit = solve(p, components={"rot": 0.01}, estimate_components=False)
    assert fit.component["rot"] == 0.01
    assert fit.component["acc"] == 1.0


# --- statistics --------------------------------------------------------------------------------------


def _nees(kind, fit, p) -> float:
    error = np.r_[(fit.H[kind] - p.H[kind]).ravel(), fit.B[kind] - p.B[kind]]
    scale = np.sqrt(np.diag(fit.covariance[kind]))
    C = fit.covariance[kind] / np.outer(scale, scale)
    return float((error / scale) @ np.linalg.solve(C, error / scale))


@pytest.fixture(scope="module")
def many():
    out = []
    for seed in range(40):
        p = make(1000 + seed, s_rot_deg=0.2)
        out.append((p, solve(p)))
    return out


@pytest.mark.parametrize("kind", ["acc", "mag", "gyr"])
def test_errors_are_as_large_as_the_covariance_says(many, kind):
    nees = [_nees(kind, fit, p) for p, fit in many]
    # mean of 40 chi-squares of 12: standard error 0.77; s_rot is estimated, which widens it by a few per cent
    assert 12 - 3 * 0.77 < np.mean(nees) < 13.2 + 3 * 0.8


def test_cost_is_chi_square_of_the_redundancy(many):
    cost = np.array([fit.cost for _, fit in many])
    dof = np.array([fit.dof for _, fit in many])
    # the components make every kind's cost equal to its redundancy, but where the least value of one holds it up
    assert np.median(cost / dof) == pytest.approx(1, abs=0.05)
    assert np.all((cost / dof > 0.85) & (cost / dof < 1.02))
    rows = 20 * 3 * 4 + 19 * 3
    unknowns = 3 * 12 + 2 * 2 + 20 * 3
    assert dof == pytest.approx(np.full(40, rows - unknowns), abs=1e-6)


def test_covariance_is_symmetric_and_positive(many):
    for _, fit in many:
        for kind, C in fit.covariance.items():
            assert np.array_equal(C, C.T)
            scale = np.sqrt(np.diag(C))
            assert np.linalg.eigvalsh(C / np.outer(scale, scale)).min() > 0, kind


def test_joint_fit_beats_each_sensor_by_itself(many):
    """The sensors share the attitudes: together they tell the housing's errors, which one alone cannot."""
    alone, together = [], []
    for p, fit in many[:12]:
        single = joint_fit({"acc": p.triads["acc"]}, None, p.label, Priors(R0=p.label))
        alone.append(np.linalg.norm(single.H["acc"] @ np.linalg.inv(p.H["acc"]) - np.eye(3)))
        together.append(np.linalg.norm(fit.H["acc"] @ np.linalg.inv(p.H["acc"]) - np.eye(3)))
    assert np.sqrt(np.mean(np.square(together))) < np.sqrt(np.mean(np.square(alone)))


# --- gauge -------------------------------------------------------------------------------------------


def test_triangular_frame_stays_triangular_and_certain():
    p = make(9)
    Q, upper = np.linalg.qr(p.H["acc"])
    sign = np.sign(np.diag(upper))
    Q, upper = Q * sign, sign[:, None] * upper
    start = np.linalg.inv(upper) * 1.01
    triads = {
        "acc": replace(p.triads["acc"], A=start, triangular=True, u_free=False, u=U["acc"]),
        "mag": p.triads["mag"],
    }
    fit = joint_fit(triads, p.gyro, p.R @ Q, Priors())
    assert fit.converged
    assert np.array_equal(np.tril(fit.H["acc"], -1), np.zeros((3, 3)))
    assert np.linalg.norm(fit.H["acc"] - upper) < 2e-3 * np.linalg.norm(upper)
    assert np.linalg.norm(fit.H["gyr"] - Q.T @ p.H["gyr"]) < 5e-3 * np.linalg.norm(upper)
    below = [3, 6, 7]  # entries of H row by row under the diagonal
    assert np.all(fit.covariance["acc"][below] == 0)
    assert np.all(np.isfinite(fit.covariance["gyr"]))
    # nobody knows the heading, so it has stayed free: turning the laboratory changes nothing
    turned = joint_fit(triads, p.gyro, so3.exp([0, 0, 0.7]) @ p.R @ Q, Priors())
    assert turned.H["acc"] == pytest.approx(fit.H["acc"], rel=1e-5, abs=1e-9)
    assert turned.covariance["gyr"] == pytest.approx(
        fit.covariance["gyr"], rel=2e-2, abs=1e-3 * fit.covariance["gyr"].max()
    )


def test_a_turned_laboratory_changes_no_calibration():
    p = make(10, s_rot_deg=0.2)
    Q = so3.exp(np.array([0.4, -1.0, 2.0]))
    fit = solve(p)
    triads = {k: replace(t, u=Q @ t.u) for k, t in p.triads.items()}
    turned = joint_fit(triads, p.gyro, Q @ p.label, Priors(R0=Q @ p.label))
    for kind in ("acc", "mag", "gyr"):
        assert turned.H[kind] == pytest.approx(fit.H[kind], rel=1e-6, abs=1e-9)
        assert turned.B[kind] == pytest.approx(fit.B[kind], rel=1e-6, abs=1e-6)
    assert turned.u["mag"] == pytest.approx(Q @ fit.u["mag"], abs=1e-5)


def test_raw_units_change_nothing_but_the_unit():
    p = make(11, s_rot_deg=0.2)
    fit = solve(p)
    c = 1e-3
    t = p.triads["acc"]
    triads = {**p.triads, "acc": replace(t, y=c * t.y, se=c * t.se, A=c * t.A, B=c * t.B)}
    scaled = joint_fit(triads, p.gyro, p.label, Priors(R0=p.label))
    assert scaled.H["acc"] * c == pytest.approx(fit.H["acc"], rel=1e-6, abs=1e-9)
    assert scaled.B["acc"] / c == pytest.approx(fit.B["acc"], rel=1e-6)
    assert scaled.H["mag"] == pytest.approx(fit.H["mag"], rel=1e-6, abs=1e-9)


# --- priors ------------------------------------------------------------------------------------------


def test_level_prior_tells_the_frame_where_headings_are_free():
    """Six faces, headings unknown: with the prior the acc's rotation to the housing is known to its tilt."""
    rng = np.random.default_rng(12)
    p = make(12, n=24)
    up = np.tile(np.vstack([np.eye(3), -np.eye(3)]), (4, 1))
    R = np.array([_with_up(c, a) for c, a in zip(up, rng.uniform(0, 6, 24))])
    tilt = so3.exp(np.radians(0.5) * rng.normal(size=(24, 3)) * [1, 1, 0])
    true = tilt @ R
    A = np.linalg.inv(p.H["acc"])
    y = np.einsum("jba,b->ja", true, U["acc"]) @ A.T + p.B["acc"] + SE["acc"] * rng.normal(size=(24, 3))
    triad = Triad(y, np.full((24, 3), SE["acc"]), A, p.B["acc"], U["acc"])
    fit = joint_fit({"acc": triad}, None, R, Priors(up=up, level_sd=np.radians(1.0)))
    assert fit.converged
    assert _nees("acc", fit, p) < 32.9  # chi-square of 12, 99.9 %
    assert fit.component["level"] == pytest.approx(0.5, rel=0.5)
    off = so3.log(so3.nearest_rotation(fit.H["acc"] @ A))
    assert np.degrees(np.abs(off)).max() < 4 * 0.5 / np.sqrt(24)


def _with_up(up, heading):
    side = np.cross(up, np.roll(up, 1))
    R = np.stack([side, np.cross(up, side), up])
    return so3.exp([0, 0, heading]) @ R


def test_predicted_turns_agree_with_the_attitudes():
    p = make(13, s_rot_deg=0.3)
    fit = solve(p)
    dR = integrate(p.gyro.turns.y, p.gyro.turns.dt, fit.H["gyr"], fit.B["gyr"])
    off = so3.angle_between(dR, np.swapaxes(fit.R[:-1], 1, 2) @ fit.R[1:])
    assert fit.residual["gyr"] == pytest.approx(off, abs=1e-12)
    # white noise of 40 samples of 2 counts at 1/940 rad/s, 0.025 s each: 0.02 degrees about each axis
    assert np.degrees(np.sqrt(np.mean(off**2))) < 0.06
