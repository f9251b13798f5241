"""The compiled kernels against their NumPy references, against simulated truth, and with bad input."""

from __future__ import annotations

import functools
import json
import os
import subprocess
import sys
import threading

import numpy as np
import pytest

from margcal.core import compiled, so3
from margcal.core.types import SensorModel, Stream
from margcal.methods import ekf_quest, strapdown, vector_selection
from margcal.methods.preintegration import TurnBatch, integrate_quat, preintegrate
from margcal.workflow import segment

EXT = compiled.extension()
needs_ext = pytest.mark.skipif(EXT is None, reason=f"compiled kernels: {compiled.state()}")
FILTERS = {"ekf-quest": ekf_quest, "vector-selection": vector_selection, "gyro": strapdown}
DIP, FIELD = 1.15, 49.0


@pytest.fixture
def reference(monkeypatch):
    """Switches the kernels off and on: ``reference(True)`` leaves the plain NumPy paths."""
    compiled.extension()

    def switch(off: bool) -> None:
        monkeypatch.setattr(compiled, "_kernels", None if off else EXT)

    return switch


@pytest.fixture(params=["baseline", "avx2", "avx512"])
def lanes(request):
    """Each set of vector instructions that this machine has."""
    if EXT is None:
        pytest.skip("no compiled kernels")
    before = EXT.lanes()
    try:
        EXT.use_lanes(request.param)
    except ValueError:
        pytest.skip(f"this machine has no {request.param}")
    yield request.param
    EXT.use_lanes(before)


def both(reference, f):
    """What `f` gives by NumPy and by the kernels."""
    reference(True)
    plain = f()
    reference(False)
    return plain, f()


# --- the door -----------------------------------------------------------------------------------------


def run_python(code: str, **environment: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=os.environ | environment
    )
    return done.stdout


def test_the_state_is_said_in_words_and_the_variable_turns_the_kernels_off():
    code = "from margcal.core import compiled as c; print(c.extension() is None, c.state())"
    assert run_python(code, MARGCAL_NO_EXT="1") == "True no (MARGCAL_NO_EXT is set)\n"
    built = EXT is not None or compiled.state() == "no (MARGCAL_NO_EXT is set)"
    if built:
        assert run_python(code, MARGCAL_NO_EXT="0").startswith(("False yes (", "True no (not built"))


def test_version_says_whether_there_are_kernels():
    command = [sys.executable, "-m", "margcal.apps.cli", "--version"]
    out = subprocess.run(command, capture_output=True, text=True, env=os.environ | {"MARGCAL_NO_EXT": "1"}).stdout
    assert "compiled kernels: no (MARGCAL_NO_EXT is set)" in out


def test_a_module_built_for_another_machine_is_said_and_not_fatal(tmp_path):
    """A file of that name that is no library at all: the import fails, the package works."""
    (tmp_path / "sitecustomize.py").write_text(
        "import sys, importlib.abc\n"
        "class Broken(importlib.abc.MetaPathFinder):\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name == 'margcal.core._ext':\n"
        "            raise ImportError('wrong ELF class')\n"
        "sys.meta_path.insert(0, Broken())\n"
    )
    code = "from margcal.core import compiled as c; print(c.state())"
    path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    assert run_python(code, PYTHONPATH=path, MARGCAL_NO_EXT="") == "no (cannot be loaded: wrong ELF class)\n"


# --- apply --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [0, 1, 2, 3, 5, 1000, 300_001])
def test_apply_agrees_with_numpy(n, lanes, reference):
    rng = np.random.default_rng(n)
    H, B = 0.0024 * (np.eye(3) + 0.1 * rng.normal(size=(3, 3))), np.array([33123.0, 33276.0, 32360.0])
    y = B + 4000 * rng.normal(size=(n, 3))
    model = SensorModel("acc", H, B)
    plain, quick = both(reference, lambda: model.apply(y))
    assert quick.shape == plain.shape
    np.testing.assert_allclose(quick, plain, rtol=0, atol=1e-12 * 4000 * np.abs(H).max())
    np.testing.assert_allclose(quick, (y - B) @ H.T, rtol=0, atol=1e-12 * 4000 * np.abs(H).max())


@needs_ext
def test_apply_takes_what_numpy_takes(reference):
    rng = np.random.default_rng(3)
    model = SensorModel("acc", np.eye(3) + 0.1 * rng.normal(size=(3, 3)), rng.normal(size=3))
    y = rng.normal(size=(40, 6))
    for given in (
        y[:, ::2],
        y[::-1, :3],
        y[:, :3].astype(np.float32),
        y[0, :3],
        y.reshape(20, 4, 3),
        y[:, :3].tolist(),
    ):
        plain, quick = both(reference, lambda given=given: model.apply(given))
        assert quick.shape == plain.shape and quick.dtype == np.float64
        np.testing.assert_allclose(quick, plain, rtol=1e-13, atol=1e-13)


@needs_ext
def test_a_model_from_arrays_in_another_order(reference):
    """Transposed H, every other B, and both read-only: the model lays them out for the kernel."""
    rng = np.random.default_rng(15)
    y, whole = rng.normal(size=(40, 3)), rng.normal(size=(3, 3))
    for locked in (False, True):
        H, B = np.array(whole).T, np.arange(6.0)[::2]
        H.flags.writeable = B.flags.writeable = not locked
        model = SensorModel("acc", H, B)
        assert model.H.flags.c_contiguous and model.B.flags.c_contiguous
        plain, quick = both(reference, lambda model=model: model.apply(y))
        np.testing.assert_allclose(quick, (y - [0, 2, 4]) @ whole, rtol=0, atol=1e-13)
        np.testing.assert_allclose(quick, plain, rtol=0, atol=1e-13)


def test_a_reading_that_is_not_finite_stays_alone(lanes, reference):
    y = np.random.default_rng(4).normal(size=(50_000, 3))
    y[7, 1], y[30_001, 0], y[49_999, 2] = np.nan, np.inf, -np.inf
    model = SensorModel("acc", np.eye(3) + 0.01, np.zeros(3))
    plain, quick = both(reference, lambda: model.apply(y))
    assert set(np.flatnonzero(~np.isfinite(quick).all(axis=1))) == {7, 30_001, 49_999}
    np.testing.assert_allclose(quick, plain, rtol=1e-13, atol=1e-13)


# --- stillness ----------------------------------------------------------------------------------------


def recording(rng: np.random.Generator, n: int = 20_000) -> Stream:
    """Rests and motion, a jittery clock, a gap."""
    t = np.sort(np.arange(n) / 100 + 1e-3 * rng.normal(size=n))
    t[n // 2 :] += 3.7
    moving = (np.sin(t / 7) > 0)[:, None]
    y = np.array([300.0, -200.0, 9000.0]) + rng.normal(size=(n, 3)) + moving * 500 * np.sin(t[:, None] * [1.0, 2, 3])
    return Stream("acc", t, y, "count")


@pytest.mark.parametrize("width", [0.05, 0.3, 1.0, 30.0])
def test_scatter_agrees_with_numpy(width, lanes, reference):
    s = recording(np.random.default_rng(5))
    centres = np.arange(s.t[0] - 2, s.t[-1] + 2, 0.05)
    sd, quick = both(reference, lambda: segment._scatter(s.t, s.y, centres, width))
    np.testing.assert_array_equal(np.isnan(quick), np.isnan(sd))
    np.testing.assert_allclose(quick, sd, rtol=0, atol=1e-12 * np.nanmax(sd))


def test_scatter_is_that_of_the_samples(lanes):
    """Truth: the standard deviation of the samples in each window, one by one."""
    s = recording(np.random.default_rng(6), 3000)
    centres = np.arange(1.0, 14.0, 0.31)
    sd = segment._scatter(s.t, s.y, centres, 0.3)
    for centre, got in zip(centres, sd):
        rows = s.y[(s.t >= centre - 0.15) & (s.t < centre + 0.15)]
        assert got == pytest.approx(np.sqrt(rows.var(axis=0, ddof=1).sum()), rel=1e-6)


@pytest.mark.parametrize("n", [2, 3, 4, 5, 8193, 8194, 9000, 20_001])
def test_the_usual_step_is_the_median(n, lanes):
    """Windows count as gaps below half of what the median step promises: found out by counting."""
    rng = np.random.default_rng(n)
    step = rng.choice([0.0, 0.01, 0.02, 0.5], size=n - 1, p=[0.1, 0.35, 0.35, 0.2])
    t = np.concatenate([[0.0], np.cumsum(step)])
    centres = t.copy()
    expected = 5.0 / np.median(np.diff(t)) if np.median(np.diff(t)) > 0 else np.inf
    sd = segment._scatter(t, rng.normal(size=(n, 3)), centres, 5.0)
    count = np.searchsorted(t, centres + 2.5) - np.searchsorted(t, centres - 2.5)
    np.testing.assert_array_equal(np.isnan(sd), (count < 4) | (count < 0.5 * expected))


# --- turns --------------------------------------------------------------------------------------------


def test_integration_agrees_with_numpy_over_20000_samples(lanes, reference):
    rng = np.random.default_rng(7)
    y, dt = rng.normal(size=(2, 20_000, 3)), 0.01 * rng.random((2, 20_000))
    H = np.eye(3) + 0.1 * rng.normal(size=(5, 1, 3, 3))
    plain, quick = both(reference, lambda: integrate_quat(y, dt, H, 0.1 * np.ones(3)))
    np.testing.assert_allclose(quick, plain, rtol=0, atol=1e-12)


@pytest.mark.parametrize("rate", [0.0, 1e-9, 1.0, 6.0, 150.0, 3000.0])
def test_a_constant_rate_turns_by_its_angle(rate, lanes):
    """Truth: exp(w T), on the branch of the path, for slow and absurdly fast turns (.01 to 30 rad a sample)."""
    axis = np.array([2.0, -1.0, 2.0]) / 3
    for n in (1, 2, 7, 8, 9, 50):
        q = integrate_quat(np.tile(rate * axis, (n, 1)), np.full(n, 0.01), np.eye(3))
        half = 0.5 * rate * 0.01 * n
        np.testing.assert_allclose(q, [np.cos(half), *(np.sin(half) * axis)], rtol=0, atol=1e-12)


@needs_ext
def test_leading_axes_broadcast_as_in_numpy(reference):
    rng = np.random.default_rng(8)
    y, dt = rng.normal(size=(4, 30, 3)), np.full(30, 0.01)
    H, B = rng.normal(size=(3, 1, 3, 3)), rng.normal(size=(4, 3))
    for given in ((y, dt, H, B), (y[0], dt, H, None), (y[None], dt, H, None), (y, dt, H[0, 0], B[0])):
        plain, quick = both(reference, lambda given=given: integrate_quat(*given))
        assert quick.shape == plain.shape
        np.testing.assert_allclose(quick, plain, rtol=0, atol=1e-13)


def test_preintegration_agrees_with_numpy(lanes, reference):
    rng = np.random.default_rng(9)
    y, dt = rng.normal(size=(6, 333, 3)), np.full((6, 333), 0.01)
    dt[2, 100:], dt[4, 1:] = 0.0, 0.0  # padding
    H, B, sd = np.eye(3) + 0.2 * rng.normal(size=(3, 3)), 0.1 * rng.normal(size=3), np.array([0.1, 0.2, 0.3])
    plain, quick = both(reference, lambda: preintegrate(y, dt, H, B, sd))
    for name in ("dR", "J_H", "J_B", "C"):
        a, b = getattr(plain, name), getattr(quick, name)
        np.testing.assert_allclose(b, a, rtol=0, atol=1e-12 * max(1.0, np.abs(a).max()), err_msg=name)


def test_derivatives_are_those_of_the_integral(lanes):
    """Truth: differences of the integration itself, also for fast turns (a large angle a sample)."""
    rng = np.random.default_rng(10)
    for size in (1.0, 60.0):
        turn = TurnBatch(size * rng.normal(size=(1, 40, 3)), np.full((1, 40), 0.01))
        H, B = np.eye(3) + 0.1 * rng.normal(size=(3, 3)), 0.1 * rng.normal(size=3)
        found = preintegrate(turn.y, turn.dt, H, B)
        d = 1e-6 * rng.normal(size=12)
        ends = [preintegrate(turn.y, turn.dt, H + s * d[:9].reshape(3, 3), B + s * d[9:]).dR[0] for s in (-0.5, 0.5)]
        change = so3.log(ends[0].T @ ends[1])
        np.testing.assert_allclose(found.J_H[0] @ d[:9] + found.J_B[0] @ d[9:], change, rtol=1e-4, atol=1e-10)


# --- filters ------------------------------------------------------------------------------------------


@functools.cache
def moving_node(seed: int, nodes: int, n: int, dt: float = 0.01):
    """Smooth motion of several nodes: true attitude, and what the sensors read. Shared: copy before changing."""
    rng = np.random.default_rng(seed)
    t = dt * np.arange(1, n + 1)
    phase, speed = 6 * rng.random((nodes, 1, 3)), 0.5 + rng.random((nodes, 1, 3))
    w = 2 * np.sin(speed * t[:, None] + phase)
    q = np.empty((nodes, n, 4))
    q[:, 0] = [1.0, 0, 0, 0]
    for k in range(1, n):
        q[:, k] = so3.quat_multiply(q[:, k - 1], so3.quat_exp(w[:, k] * dt))
    w[:, 0] = 0.0  # the first attitude is the start
    R = so3.matrix_from_quat(q)
    acc = np.einsum("mnji,j->mni", R, [0, 0, 9.80665]) + 0.02 * rng.normal(size=w.shape)
    mag = np.einsum("mnji,j->mni", R, FIELD * np.array([0, np.cos(DIP), -np.sin(DIP)])) + 0.1 * rng.normal(size=w.shape)
    return q, np.full((nodes, n), dt), w + 0.002 * rng.normal(size=w.shape), acc, mag


def hostile(dt, gyr, acc, mag):
    """Everything that can be wrong with a recording, a little of it in each node."""
    dt, gyr, acc, mag = (np.array(a) for a in (dt, gyr, acc, mag))
    gyr[0, 30:40], gyr[1, 55, 2], gyr[2, 60] = np.nan, np.inf, 5000.0
    acc[3, 30:60], acc[4, 50:55], acc[5, 40], acc[0, 90] = np.nan, 0.0, 1e-20, -np.inf
    mag[6, 30:90], mag[7, 50], mag[8, 20:30], mag[1, 80] = np.nan, 0.0, 5 * mag[8, 20:30], 1e200
    acc[2, 70:75], mag[3, 70:75] = -acc[2, 70:75], acc[3, 70:75]
    dt[4, 20], dt[5, 60], dt[6, 10], dt[7, 0], dt[8, 15] = 3.0, np.nan, -1.0, 0.0, 1e9
    return dt, gyr, acc, mag


def compare(a, b, bound=1e-12):
    """Tracks, and the states that they end in. Variances to their own size."""
    np.testing.assert_allclose(b.q, a.q, rtol=0, atol=bound)
    np.testing.assert_array_equal(b.flags, a.flags)
    np.testing.assert_allclose(b.variance, a.variance, rtol=0, atol=bound * max(1.0, np.max(a.variance)))
    assert type(a.state) is type(b.state)
    for name, x, y in zip(a.state._fields, a.state, b.state):
        assert np.shape(x) == np.shape(y), name
        np.testing.assert_allclose(y, x, rtol=0, atol=bound * max(1.0, float(np.max(np.abs(x)))), err_msg=name)


@needs_ext
@pytest.mark.parametrize("name", FILTERS)
def test_a_filter_agrees_with_numpy_over_20000_samples(name, reference):
    """Eight nodes of 2500 samples each: NumPy is slow."""
    method = FILTERS[name]
    q, dt, gyr, acc, mag = moving_node(11, 8, 2500)
    mag = np.array(mag)
    mag[:, 1000:1500] = np.nan
    state = method.start(q[:, 0])
    plain, quick = both(reference, lambda: method.batch(method.Params(), state, dt, gyr, acc, mag))
    compare(plain, quick)


@functools.cache
def track_of_hostile(name):
    """The same for every set of instructions: NumPy's, so call it with the kernels off."""
    q, *samples = moving_node(12, 9, 150)
    return FILTERS[name].batch(FILTERS[name].Params(), FILTERS[name].start(q[:, 0]), *hostile(*samples))


@pytest.mark.parametrize("name", FILTERS)
def test_a_filter_agrees_with_numpy_on_hostile_input(name, lanes, reference):
    """Nine nodes: lanes and what is left over; then each of them alone."""
    method = FILTERS[name]
    q, *samples = moving_node(12, 9, 150)
    samples = hostile(*samples)
    reference(True)
    plain = track_of_hostile(name)
    reference(False)
    compare(plain, method.batch(method.Params(), method.start(q[:, 0]), *samples))
    for i in range(9):
        one = method.batch(method.Params(), method.start(q[i, 0]), *(a[i] for a in samples))
        np.testing.assert_allclose(one.q, plain.q[i], rtol=0, atol=1e-12)
        np.testing.assert_array_equal(one.flags, plain.flags[i])


@pytest.mark.parametrize("name", FILTERS)
def test_a_filter_follows_the_truth(name, lanes):
    method = FILTERS[name]
    q, *samples = moving_node(13, 5, 3000)
    track = method.batch(method.Params(), method.start(q[:, 0]), *samples)
    error = 2 * np.degrees(np.linalg.norm(so3.quat_multiply(track.q, so3.quat_conjugate(q))[..., 1:], axis=-1))
    assert np.sqrt(np.mean(error**2)) < 1.5


@pytest.mark.parametrize("name", FILTERS)
def test_a_recording_in_pieces_is_the_recording(name, lanes):
    method = FILTERS[name]
    q, *samples = moving_node(14, 6, 60)
    whole = method.batch(method.Params(), method.start(q[:, 0]), *samples)
    first = method.batch(method.Params(), method.start(q[:, 0]), *(a[:, :23] for a in samples))
    second = method.batch(method.Params(), first.state, *(a[:, 23:] for a in samples))
    np.testing.assert_array_equal(np.concatenate([first.q, second.q], axis=1), whole.q)
    np.testing.assert_array_equal(second.state[1], whole.state[1])


@pytest.mark.parametrize("name", FILTERS)
def test_empty_and_single_samples(name, lanes):
    method = FILTERS[name]
    start = method.start([1.0, 0, 0, 0])
    none = method.batch(method.Params(), start, np.zeros(0), *[np.zeros((0, 3))] * 3)
    assert none.q.shape == (0, 4) and none.state is start
    one = method.batch(method.Params(), start, [0.01], *[np.array([[0.1, 0.2, 9.8]])] * 3)
    assert one.q.shape == (1, 4) and np.isfinite(one.q).all()


# --- what the kernels refuse, and the lock ------------------------------------------------------------


@needs_ext
def test_wrong_arrays_are_refused_by_name():
    y, eye, zero, out = np.zeros((4, 3)), np.eye(3), np.zeros(3), np.zeros((4, 3))
    locked = out.copy()
    locked.flags.writeable = False
    for given, error, word in (
        ((y[:, :2], eye, zero, out), ValueError, "y: expected shape"),
        ((y.astype(np.float32), eye, zero, out), TypeError, "y: expected an array of float64"),
        ((np.zeros((4, 6))[:, ::2], eye, zero, out), ValueError, "y: the array is not C-contiguous"),
        ((y, eye[:2], zero, out), ValueError, "H: expected shape"),
        ((y, eye, zero, out[:3]), ValueError, "out: expected shape"),
        ((y, eye, zero, locked), TypeError, "incompatible"),
        ((y, None, zero, out), TypeError, "incompatible"),
    ):
        with pytest.raises(error, match=word):
            EXT.apply(*given)


@needs_ext
def test_indices_and_times_that_lead_nowhere_are_refused():
    y, dt, H, B, out = np.zeros((2, 5, 3)), np.zeros((2, 5)), np.zeros((1, 3, 3)), np.zeros((1, 3)), np.zeros((1, 4))
    for turn, sensor in (([2], [0]), ([-1], [0]), ([0], [1])):
        with pytest.raises(IndexError):
            EXT.integrate(y, dt, H, B, np.array(turn), np.array(sensor), out)
    t, sd = np.arange(5.0), np.zeros(2)
    rows, centres = np.zeros((5, 3)), np.array([1.0, 2.0])
    for bad in (t[::-1].copy(), np.array([0, 1, np.nan, 3, 4]), np.array([0.0, 1, 2, 3, np.inf])):
        with pytest.raises(ValueError, match="t: times must be finite"):
            EXT.moving_scatter(bad, rows, centres, 1.0, sd)
    for width in (0.0, -1.0, np.nan):
        with pytest.raises(ValueError, match="width"):
            EXT.moving_scatter(t, rows, centres, width, sd)
    with pytest.raises(ValueError, match="no lanes called"):
        EXT.use_lanes("cray")


@needs_ext
def test_other_threads_run_during_a_kernel():
    """A counter in another thread goes on while one long call is inside the extension."""
    n = 400_000
    samples = np.zeros((1, n, 3))
    state, out = ekf_quest.start(np.array([[1.0, 0, 0, 0]])), (np.empty((1, n, 4)), np.empty((1, n, 3)))
    memory = np.concatenate([state.x, state.P.reshape(1, 49)], axis=1)
    params, flags = np.array([ekf_quest.Params()]), np.empty((1, n), dtype=np.uint8)
    inside, counted, done = threading.Event(), [0], threading.Event()

    def count() -> None:
        inside.wait()
        while not done.is_set():
            counted[0] += 1

    thread = threading.Thread(target=count)
    thread.start()
    inside.set()
    before = counted[0]
    EXT.ekf_quest(params, memory, np.full((1, n), 0.01), samples, samples, samples, *out, flags)
    during = counted[0] - before
    done.set()
    thread.join()
    assert during > 1000


# --- the whole, without kernels -----------------------------------------------------------------------


@needs_ext
def test_a_calibration_without_the_kernels_is_the_same(tmp_path):
    """`demo` and `calibrate` in processes with and without the extension."""
    found = []
    for off in ("1", ""):
        folder = tmp_path / f"off{off}"
        environment = os.environ | {"MARGCAL_NO_EXT": off, "SOURCE_DATE_EPOCH": "0"}
        command = [sys.executable, "-m", "margcal.apps.cli"]
        subprocess.run([*command, "simulate", "-o", str(folder), "--seed", "4"], check=True, env=environment)
        file = folder / "cal.json"
        recordings = [str(folder / "session.parquet"), "--poses", "auto"]
        done = subprocess.run(
            [*command, "calibrate", *recordings, "-o", str(file), "--allow-fail"], env=environment, capture_output=True
        )
        assert done.returncode == 0, done.stderr
        found.append(json.loads(file.read_text()))
    for kind in ("acc", "gyr", "mag"):
        for name in ("H", "B"):
            a, b = (np.array(f[kind][name]) for f in found)
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-9 * np.abs(a).max(), err_msg=f"{kind} {name}")
