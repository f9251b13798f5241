"""Properties that hold for every node, every pose set, every file: what changes when the input is written otherwise.

Solvers are handed readings with noise, so that equivariance is that of the estimate, not of the truth.
"""

# pyright: reportOptionalMemberAccess=false, reportOptionalOperand=false, reportArgumentType=false
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from margcal.core import so3
from margcal.core.checking import checked_reference
from margcal.core.types import Array, Calibration, Fit, Recording, Reference, SensorModel
from margcal.core.units import STANDARD_GRAVITY, UNITS
from margcal.files.calfile import dumps, loads
from margcal.files.tables import read, read_poses, write_table
from margcal.methods.ellipsoid import ellipsoid, triangular
from margcal.methods.gls import gls_ml
from margcal.methods.joint import Priors, Triad, joint_fit
from margcal.methods.one_step import one_step
from margcal.workflow.calibrate import calibrate
from margcal.workflow.simulate import simulate
from strategies import (
    Session,
    calibrations,
    covariances,
    quaternions,
    rngs,
    rotation_vectors,
    rotations,
    seeds,
    sessions,
    signed_permutations,
    transformations,
)

few = settings(max_examples=max(settings().max_examples // 4, 3))
"""For properties of the whole program, half a second each."""

scales = st.floats(-4, 4).map(lambda p: 10.0**p)


# --- the group of rotations ---------------------------------------------------------------------------


@given(rotation_vectors())
def test_exp_is_a_rotation_and_log_goes_back(v):
    R = so3.exp(v)
    assert np.abs(R.T @ R - np.eye(3)).max() < 1e-14
    assert np.linalg.det(R) == pytest.approx(1, abs=1e-14)
    assert np.abs(so3.exp(so3.log(R)) - R).max() < 1e-14
    assert np.abs(so3.exp(-v) - R.T).max() < 1e-15
    angle = np.linalg.norm(v)
    if angle < np.pi - 1e-7:  # at pi, v and -v are one rotation
        assert np.abs(so3.log(R) - v).max() < 1e-15 + 1e-14 * angle / max(np.pi - angle, 1e-2)


@given(rotation_vectors(), st.floats(-1, 1), st.floats(-1, 1))
def test_turns_about_one_axis_add(v, a, b):
    assert np.abs(so3.exp(a * v) @ so3.exp(b * v) - so3.exp((a + b) * v)).max() < 1e-14


@given(quaternions(), quaternions(), quaternions())
def test_quaternions_are_a_group_over_the_rotations(p, q, r):
    times, matrix = so3.quat_multiply, so3.matrix_from_quat
    assert np.abs(times(times(p, q), r) - times(p, times(q, r))).max() < 1e-14
    assert np.abs(times(p, so3.quat_conjugate(p)) - [1, 0, 0, 0]).max() < 1e-15
    assert np.abs(matrix(times(p, q)) - matrix(p) @ matrix(q)).max() < 1e-14
    back = so3.quat_from_matrix(so3.matrix_from_quat(p))
    assert np.abs(np.outer(back, back) - np.outer(p, p)).max() < 1e-14  # either sign


@given(quaternions())
def test_a_quaternions_sign_changes_nothing(q):
    assert np.array_equal(so3.matrix_from_quat(q), so3.matrix_from_quat(-q))
    assert np.abs(so3.exp(so3.quat_log(q)) - so3.exp(so3.quat_log(-q))).max() < 1e-15


@given(rotations(), rotation_vectors())
def test_adjoint_and_distance_are_invariant(R, v):
    S = so3.exp(v)
    assert np.abs(R @ S @ R.T - so3.exp(R @ v)).max() < 1e-14
    assert so3.angle_between(R, R @ S) == pytest.approx(np.linalg.norm(v), abs=1e-14)
    assert so3.angle_between(R, S) == pytest.approx(float(so3.angle_between(S.T, R.T)), abs=1e-14)


@given(rotation_vectors(), rotation_vectors(below=1.0))
def test_left_jacobian_is_the_derivative_of_exp(v, direction):
    d = 1e-6 * direction
    change = so3.log(so3.exp(v + d) @ so3.exp(v).T)
    assert np.abs(change - so3.left_jacobian(v) @ d).max() < 1e-11
    assert np.abs(so3.right_jacobian(v) - so3.exp(-v) @ so3.left_jacobian(v)).max() < 1e-13


@given(rotations(), rngs())
def test_mean_and_alignment_turn_with_the_frame(Q, rng):
    R = so3.exp(0.5 * rng.normal(size=(7, 3)))
    assert np.abs(so3.mean_rotation(Q @ R) - Q @ so3.mean_rotation(R)).max() < 1e-13
    b = rng.normal(size=(9, 3))
    assert np.abs(so3.align_vectors(b @ Q.T, b) - Q).max() < 1e-13


# --- the model ----------------------------------------------------------------------------------------


@given(transformations(), rngs())
def test_apply_undoes_invert(H, rng):
    model = SensorModel("mag", H, rng.normal(size=3) * np.linalg.norm(np.linalg.inv(H), 2))
    u = rng.normal(size=(20, 3))
    assert np.abs(model.apply(model.invert(u)) - u).max() < 1e-12
    y = model.invert(u)
    assert np.abs(model.invert(model.apply(y)) - y).max() < 1e-12 * np.abs(y).max()


@given(sessions(noise=False), rngs())
def test_one_row_many_rows_and_a_batch_of_nodes_agree(s, rng):
    model = SensorModel("gyr", s.H, s.B)
    y = s.B + np.linalg.norm(s.y - s.B) * rng.normal(size=(5000, 3))
    many = model.apply(y)
    scale = np.abs(many).max()
    assert np.abs(many[17] - model.apply(y[17])).max() < 1e-13 * scale
    batch = SensorModel("gyr", np.stack([s.H, 2 * s.H]), np.stack([s.B, s.B]))
    assert np.abs(batch.apply(np.stack([y[17], y[17]])) - [many[17], 2 * many[17]]).max() < 1e-13 * scale


# --- solvers: what is the same for all ----------------------------------------------------------------


@dataclass(frozen=True)
class Estimate:
    """What a solver says of one session: H, B, the sensed vector (None: it does not look for it), covariance."""

    H: Array
    B: Array
    u: Array | None
    covariance: Array
    residual: Array


def _of(fit: Fit) -> Estimate:
    assert fit.covariance is not None
    return Estimate(fit.model.H, fit.model.B, fit.u, fit.covariance, fit.residual)


def _joint(s: Session) -> Estimate:
    """The joint fit of this sensor alone; its start is off by what a nominal model is off."""
    start = so3.exp([0.01, -0.02, 0.015])
    A = np.linalg.inv(s.H) @ start * 1.02
    se = np.full_like(s.y, s.sigma or 1e-6 * np.linalg.norm(np.linalg.inv(s.H), 2) * s.magnitude)
    R_nh = np.swapaxes(s.R, 1, 2)
    triad = Triad(s.y, se, A, s.B + 0.01 * s.magnitude * np.linalg.inv(s.H)[:, 0], s.u, u_free=True)
    fit = joint_fit({"acc": triad}, None, R_nh, Priors(R0=R_nh, s_rot=1e-4), estimate_components=False, tol=1e-9)
    return Estimate(fit.H["acc"], fit.B["acc"], fit.u["acc"], fit.covariance["acc"], fit.residual["acc"])


SOLVERS: dict[str, Callable[[Session], Estimate]] = {
    "one-step": lambda s: _of(one_step(s.y, s.R, s.magnitude)),
    "gls-ml": lambda s: _of(gls_ml(s.y, s.R, s.magnitude, noise_sd=s.sigma or None, s_rot=1e-3)),
    "joint": _joint,
    "ellipsoid": lambda s: _of(ellipsoid(s.y, s.magnitude)),
    "triangular": lambda s: _of(triangular(s.y, s.magnitude)),
}
WITH_POSES = ("one-step", "gls-ml", "joint")
TOLERANCE = {"one-step": 1e-9, "gls-ml": 2e-7, "joint": 2e-6, "ellipsoid": 1e-7, "triangular": 1e-6}
"""Of H and B, relative: one-step is a closed form, the others stop where a step no longer matters."""

every_solver = pytest.mark.parametrize("name", list(SOLVERS))
pose_solvers = pytest.mark.parametrize("name", WITH_POSES)
scattered = sessions(cube=False)
"""For the solvers that know the length alone as well: more than six directions."""


def close(a: Array | None, b: Array | None, tolerance: float, scale: float | None = None) -> bool:
    assert a is not None and b is not None
    return bool(np.abs(a - b).max() <= tolerance * (np.abs(b).max() if scale is None else scale))


def assert_same(name: str, found: Estimate, H: Array, B: Array, u: Array | None, s: Session) -> None:
    """`found` is (H, B, u), B measured against the extent of the readings `s.y`, which it was estimated from."""
    extent = float(np.abs(s.y - s.y.mean(axis=0)).max()) + 1e-6 * float(np.abs(s.y).max())
    assert close(found.H, H, TOLERANCE[name])
    assert close(found.B, B, TOLERANCE[name], extent)
    if u is not None:
        assert found.u is not None and close(found.u, u, TOLERANCE[name], s.magnitude)


@every_solver
@given(scattered, scales, st.floats(-10, 10))
def test_raw_unit(name, s, c, offset):
    """Readings in another unit and from another zero: H, B and their covariance are in the new unit, u is as before."""
    d = offset * np.ptp(s.y)
    a = SOLVERS[name](s)
    t = replace(s, y=c * s.y + d, H=s.H / c, B=c * s.B + d, sigma=c * s.sigma)
    b = SOLVERS[name](t)
    assert_same(name, b, a.H / c, c * a.B + d, a.u, t)
    to = np.r_[np.full(9, 1 / c), np.full(3, c)]
    sd = to * np.sqrt(np.diag(a.covariance))
    assert np.abs(b.covariance - a.covariance * np.outer(to, to)).max() <= 1e-3 * (sd.max() ** 2)
    assert np.sqrt(np.diag(b.covariance)) == pytest.approx(sd, rel=1e-3, abs=1e-12 * sd.max())


@every_solver
@given(scattered, scales)
def test_calibrated_unit(name, s, c):
    a, b = SOLVERS[name](s), SOLVERS[name](t := replace(s, u=c * s.u, H=c * s.H))
    assert_same(name, b, c * a.H, a.B, None if a.u is None else c * a.u, t)
    assert b.residual == pytest.approx(c * a.residual, rel=1e-3, abs=1e-5 * c * s.magnitude)


@every_solver
@given(scattered, signed_permutations())
def test_axes_of_the_raw_readings(name, s, P):
    """Axes renamed, swapped, mirrored. Where poses are known the sign of (H, u) follows det H > 0."""
    if name == "triangular":
        P = np.diag(P.sum(axis=1))  # its frame is that of the axes' order
    a = SOLVERS[name](s)
    t = replace(s, y=s.y @ P.T, H=s.H @ P.T, B=P @ s.B)
    if name == "joint" and np.linalg.det(P) < 0:
        t = replace(t, H=-t.H, u=-t.u)  # it keeps the sign of its start
    b = SOLVERS[name](t)
    sign = np.sign(np.linalg.det(P)) if name in WITH_POSES else 1.0
    H = a.H @ P.T if name in WITH_POSES else P @ a.H @ P.T
    assert_same(name, b, sign * H, P @ a.B, None if a.u is None else sign * a.u, t)


@pose_solvers
@given(sessions(), rotations(), rotations())
def test_frames_of_laboratory_and_housing(name, s, Q, P):
    """Another laboratory turns u alone, another housing frame turns H alone."""
    a = SOLVERS[name](s)
    lab = SOLVERS[name](t := replace(s, R=s.R @ Q.T, u=Q @ s.u))
    assert a.u is not None
    assert_same(name, lab, a.H, a.B, Q @ a.u, t)
    housing = SOLVERS[name](t := replace(s, R=P @ s.R, H=P @ s.H))
    assert_same(name, housing, P @ a.H, a.B, a.u, t)
    assert housing.residual == pytest.approx(a.residual, rel=1e-4, abs=1e-6 * s.magnitude)


@every_solver
@given(scattered, seeds)
def test_order_of_the_poses(name, s, seed):
    order = np.random.default_rng(seed).permutation(len(s.y))
    a, b = SOLVERS[name](s), SOLVERS[name](replace(s, y=s.y[order], R=s.R[order]))
    assert_same(name, b, a.H, a.B, a.u, s)
    assert b.residual == pytest.approx(a.residual[order], rel=1e-4, abs=1e-6 * s.magnitude)


@every_solver
@given(scattered)
def test_sign_and_gauge_are_fixed(name, s):
    a = SOLVERS[name](s)
    assert np.linalg.det(a.H) > 0
    if name in WITH_POSES:
        assert a.u is not None and np.linalg.norm(a.u) == pytest.approx(s.magnitude, rel=1e-12)
    elif name == "ellipsoid":
        assert close(a.H, a.H.T, 1e-12) and np.linalg.eigvalsh(a.H).min() > 0
    else:
        assert np.array_equal(a.H, np.triu(a.H)) and np.diag(a.H).min() > 0


@every_solver
@given(scattered)
def test_covariance_is_one(name, s):
    C = SOLVERS[name](s).covariance
    sd = np.sqrt(np.diag(C))
    safe = np.where(sd > 0, sd, 1.0)
    assert np.array_equal(np.isfinite(C), np.full((12, 12), True))
    correlation = C / np.outer(safe, safe)
    assert np.abs(correlation - correlation.T).max() < 1e-9
    assert np.linalg.eigvalsh(correlation).min() > -1e-9
    assert np.array_equal(C, SOLVERS[name](s).covariance)


@every_solver
@given(sessions(noise=False, cube=False))
def test_without_noise_the_truth_comes_back(name, s):
    a = SOLVERS[name](s)
    true = s.H
    if name == "ellipsoid":
        true = so3.polar(s.H)[1]
    elif name == "triangular":
        true = np.linalg.cholesky(s.H.T @ s.H).T
    extent = float(np.ptp(s.y))
    limit = 1e-7 if name == "joint" else 1e-9
    # readings are rounded at 1e-16 of their size, offset and all; poses may carry that tenfold into H
    assert close(a.H, true, limit)
    assert close(a.B, s.B, limit, extent)
    if a.u is not None:
        assert close(a.u, s.u, limit, s.magnitude)


# --- weights ------------------------------------------------------------------------------------------


@given(scattered, seeds)
def test_a_pose_twice_is_a_pose_of_double_weight(s, seed):
    rng = np.random.default_rng(seed)
    count = rng.integers(1, 4, len(s.y))
    again = np.repeat(np.arange(len(s.y)), count)
    whole = one_step(s.y[again], s.R[again], s.magnitude, sigma=s.sigma)
    weighted = one_step(s.y, s.R, s.magnitude, weights=count, sigma=s.sigma / np.sqrt(count.mean()))
    assert close(weighted.model.H, whole.model.H, 1e-9)
    assert close(weighted.covariance, whole.covariance, 1e-6)
    length = triangular(s.y[again], s.magnitude), triangular(s.y, s.magnitude, weights=count)
    assert close(length[1].model.H, length[0].model.H, 1e-6)
    many = gls_ml(s.y[again], s.R[again], s.magnitude, noise_sd=s.sigma, s_rot=0.0)
    sure = gls_ml(s.y, s.R, s.magnitude, noise_sd=(s.sigma / np.sqrt(count))[:, None], s_rot=0.0)
    assert close(sure.model.H, many.model.H, 1e-6)
    assert close(sure.covariance, many.covariance, 1e-4)


@given(scattered, st.floats(0.1, 10))
def test_covariance_grows_with_the_square_of_the_noise(s, factor):
    a = one_step(s.y, s.R, s.magnitude, sigma=s.sigma).covariance
    b = one_step(s.y, s.R, s.magnitude, sigma=factor * s.sigma).covariance
    assert b == pytest.approx(factor**2 * a, rel=1e-9)
    twice = np.tile(np.arange(len(s.y)), 2)
    c = one_step(s.y[twice], s.R[twice], s.magnitude, sigma=s.sigma).covariance
    assert close(c, a / 2, 1e-8)


# --- files --------------------------------------------------------------------------------------------


@given(calibrations())
def test_a_calibration_file_reads_back_to_the_last_bit(calibration):
    data = dumps(calibration)
    got = loads(data)
    assert dumps(got) == data
    for kind, model in calibration.models.items():
        for field in ("H", "B", "covariance", "reference_vector"):
            a, b = getattr(model, field), getattr(got.models[kind], field)
            assert (a is None and b is None) or np.array_equal(a, b), field
        for field in ("residual_rms", "n_poses", "delay_s", "temperature_degC", "raw_unit", "unit", "method"):
            assert getattr(got.models[kind], field) == getattr(model, field), field
    assert got.issues == calibration.issues
    assert (got.device, got.frame, got.verdict) == (calibration.device, calibration.frame, calibration.verdict)
    assert got.settings == calibration.settings


@given(covariances(), st.integers(0, 11), st.integers(0, 11))
def test_covariances_are_taken_and_damaged_ones_are_not(C, i, j):
    model = SensorModel("acc", np.eye(3), np.zeros(3), covariance=C)
    assert np.array_equal(loads(dumps(_only(model))).acc.covariance, C)
    worse = C.copy()
    worse[i, j] = worse[j, i] = -2 * np.sqrt(C[i, i] * C[j, j])
    with pytest.raises(Exception, match="covariance"):
        dumps(_only(replace(model, covariance=worse)))


def _only(model: SensorModel) -> Calibration:
    return Calibration(acc=model)


@given(rngs(), st.sampled_from([".csv", ".parquet", ".csv.gz", ".tsv"]))
def test_tables_read_back_to_the_last_bit(tmp_path_factory, rng, suffix):
    path = tmp_path_factory.mktemp("table") / f"a{suffix}"
    y = rng.normal(size=(30, 3)) * 10.0 ** rng.integers(-12, 12, (30, 3))
    t = np.cumsum(rng.uniform(0.001, 0.1, 30))
    write_table(path, {"t_s": t, **{f"gyr_{a}_dps": y[:, k] for k, a in enumerate("xyz")}})
    stream = read(path).gyr
    assert np.array_equal(stream.t, t) and np.array_equal(stream.y, y)


# --- signs of quaternions -----------------------------------------------------------------------------


@given(rngs())
def test_signs_of_a_reference_track_change_nothing(rng):
    q = so3.quat_from_matrix(so3.exp(np.cumsum(0.1 * rng.normal(size=(40, 3)), axis=0)))
    t = np.arange(40) / 100
    flips = rng.choice([1.0, -1.0], size=(40, 1))
    flips[0] = 1.0
    a, b = (checked_reference(Reference(t, track))[0].q for track in (q, flips * q))
    assert np.array_equal(a, b)
    assert (np.sum(a[1:] * a[:-1], axis=1) > 0).all()


@given(st.lists(quaternions(), min_size=3, max_size=8), seeds)
def test_signs_in_a_poses_table_change_nothing(tmp_path_factory, q, seed):
    q = np.array(q)
    flips = np.random.default_rng(seed).choice([1.0, -1.0], size=(len(q), 1))
    folder = tmp_path_factory.mktemp("poses")
    for name, rows in (("a.csv", q), ("b.csv", flips * q)):
        write_table(folder / name, {c: rows[:, k] for k, c in enumerate(("qw", "qx", "qy", "qz"))})
    a, b = read_poses(folder / "a.csv").q, read_poses(folder / "b.csv").q
    assert np.array_equal(so3.matrix_from_quat(a), so3.matrix_from_quat(b))


@few
@given(rngs())
def test_signs_of_the_reference_change_no_calibration(rng):
    s = _simulated(int(rng.integers(3)), reference=True)
    track = s.recording.reference
    flipped = replace(track, q=track.q * rng.choice([1.0, -1.0], size=(len(track.q), 1)))
    plain = calibrate(s.recording, poses="reference", sensors=("acc",))
    other = replace(s.recording, reference=checked_reference(flipped)[0])
    again = calibrate(other, poses="reference", sensors=("acc",))
    assert close(again.acc.H, plain.acc.H, 1e-9)


# --- units --------------------------------------------------------------------------------------------


def _simulated(seed: int, **options):
    return simulate(seed=seed, n_poses=14, rest_s=1.6, rate=50.0, **options)


def _in_unit(recording: Recording, kind: str, unit: str, scale: float) -> Recording:
    """The recording with one sensor in `unit`, `scale` counts being one SI unit."""
    stream = getattr(recording, kind)
    y = stream.y / scale / UNITS[kind][unit]
    return replace(recording, **{kind: replace(stream, y=y, unit=unit)})


@few
@given(seeds, st.sampled_from([("acc", "g", "mps2"), ("gyr", "dps", "radps"), ("mag", "mgauss", "uT")]))
def test_the_unit_of_the_recording_is_not_the_results(tmp_path_factory, seed, units):
    """The same recording in g and in m/s^2, from files: two calibrations, the same calibrated output."""
    kind, *names = units
    scale = {"acc": 2048 / STANDARD_GRAVITY, "gyr": 16.4 * 180 / np.pi, "mag": 1 / 0.15}[kind]
    recording = _simulated(seed % 5).recording
    folder = tmp_path_factory.mktemp("units")
    found = []
    for unit in names:
        changed = _in_unit(recording, kind, unit, scale)
        columns = {"t_s": np.array(recording.acc.t)}
        for k, stream in changed.streams.items():
            columns |= {f"{k}_{a}_{stream.unit}": np.array(stream.y[:, i]) for i, a in enumerate("xyz")}
        write_table(folder / f"{unit}.parquet", columns)
        back = read(folder / f"{unit}.parquet")
        assert back.units[kind] == unit
        calibration = calibrate(back, poses="cube")
        found.append(getattr(calibration.apply(back), kind).y)
    assert close(found[0], found[1], 1e-5)
