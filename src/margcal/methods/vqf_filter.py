"""The public filter VQF behind the same call as ours, so that users have the best known beside the papers'.

D. Laidig, T. Seel, "VQF: Highly accurate IMU orientation estimation with bias estimation and magnetic disturbance
rejection", Information Fusion 91 (2023) 187-204; package `vqf` (MIT), an optional extra. It estimates the gyroscope's
bias by itself. What is ours here:

- VQF knows one sampling period: recordings with another clock are interpolated to it and back;
- it goes on through gaps as if nothing were missing: here it begins anew after one, and keeps the bias (online);
- readings that are missing are skipped (VQF skips zeros), and a missing rate counts as none;
- it says nothing of its own error: the variance of the track is NaN.
"""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from margcal.core import so3
from margcal.core.errors import InputError
from margcal.core.types import Array, Mask
from margcal.methods.tracking import (
    ACC,
    GAP,
    MAG,
    NO_GYR,
    Flags,
    Track,
    as_quaternion,
    as_samples,
    measured_rate,
    unit_sample,
)

IRREGULAR = 0.02
"""Steps that differ from the period by more than this are interpolated to an even clock."""


class Params(NamedTuple):
    """`period` s between samples, `tau_acc` and `tau_mag` s as in VQF, `gap` s after which it begins anew."""

    period: float = 0.01
    tau_acc: float = 3.0
    tau_mag: float = 9.0
    gap: float = 0.25


class State(NamedTuple):
    """`vqf` the package's own state (numbers and lists), `q` the attitude (4,), `flags` of the last sample."""

    vqf: dict[str, Any]
    q: Array
    flags: Flags


def package() -> Any:
    """The package `vqf`.

    Raises
    ------
    InputError
        If it is not installed.
    """
    try:
        import vqf
    except ImportError as error:
        raise InputError(
            "the filters vqf and vqf-offline need the package vqf, which is not installed: pip install 'margcal[vqf]', "
            "or take --filter vector-selection"
        ) from error
    return vqf


def start(q: ArrayLike, sd: ArrayLike = (0.05, 0.05, 0.1)) -> State:
    """State at attitude `q` (4,); `sd` is not used (VQF trusts its first samples more than its start)."""
    q = as_quaternion(q)
    if q.ndim > 1:
        raise InputError("VQF's state is that of one node; call batch for each, or give batch leading axes")
    return State({}, q, np.zeros((), dtype=np.uint8))


def step(params: Params, state: State, dt: ArrayLike, gyr: ArrayLike, acc: ArrayLike, mag: ArrayLike) -> State:
    """The state after one more sample of one node; `dt` is taken for `params.period` unless it is a gap."""
    track = batch(params, state, np.array([dt]), *(np.asarray(v)[None] for v in (gyr, acc, mag)))
    return track.state


def batch(params: Params, state: Any, dt: ArrayLike, gyr: ArrayLike, acc: ArrayLike, mag: ArrayLike) -> Track:
    """VQF online; arguments as in `tracking`. Nodes side by side start from `state.q` (..., 4)."""
    return _each_node(_online, params, state, dt, gyr, acc, mag)


def batch_offline(params: Params, state: Any, dt: ArrayLike, gyr: ArrayLike, acc: ArrayLike, mag: ArrayLike) -> Track:
    """VQF offline: forwards and backwards, each stretch without a gap by itself.

    Without a magnetometer the heading of the first stretch is that of `state`, of the others that where the last ended.
    """
    return _each_node(_offline, params, state, dt, gyr, acc, mag)


# --- the working --------------------------------------------------------------------------------------


class _Samples(NamedTuple):
    """One node; NaN replaced by zero, which VQF skips. `flags` (N,)."""

    dt: Array
    gyr: Array
    acc: Array
    mag: Array
    flags: Flags


def _each_node(run: Any, params: Params, state: Any, dt: Any, gyr: Any, acc: Any, mag: Any) -> Track:
    gyr, acc, mag = as_samples(gyr, acc, mag)
    dt = np.broadcast_to(np.asarray(dt, dtype=np.float64), gyr.shape[:-1])
    if gyr.ndim == 2:
        return run(params, state, _prepared(params, dt, gyr, acc, mag))
    starts = [State({}, q, np.zeros((), dtype=np.uint8)) for q in state.q] if isinstance(state, State) else list(state)
    done = [run(params, s, _prepared(params, dt[k], gyr[k], acc[k], mag[k])) for k, s in enumerate(starts)]
    q, variance, flags = (np.stack([getattr(d, n) for d in done]) for n in ("q", "variance", "flags"))
    return Track(q, variance, flags, [d.state for d in done])


def _prepared(params: Params, dt: Array, gyr: Array, acc: Array, mag: Array) -> _Samples:
    dt = np.maximum(np.nan_to_num(dt), 0.0)
    rate = measured_rate(gyr)
    acc_unit, acc_length, has_acc = unit_sample(acc)
    mag_unit, mag_length, has_mag = unit_sample(mag)
    flags = ACC * has_acc + MAG * has_mag + NO_GYR * ~rate + GAP * (dt > params.gap)
    return _Samples(
        dt,
        np.where(rate[:, None], gyr, 0.0),
        acc_unit * acc_length[:, None],
        mag_unit * mag_length[:, None],
        flags.astype(np.uint8),
    )


def _stretches(params: Params, samples: _Samples) -> list[slice]:
    edges = [k for k in np.flatnonzero(samples.dt > params.gap).tolist() if k]
    return [slice(a, b) for a, b in itertools.pairwise([0, *edges, len(samples.dt)])]


def _even(params: Params, s: _Samples, part: slice) -> tuple[Array, tuple[Array, ...], Array]:
    """Times of the samples of a stretch, its readings on VQF's clock, and the times of those."""
    t = np.cumsum(s.dt[part])
    t -= t[0]
    values = (s.gyr[part], s.acc[part], s.mag[part])
    if len(t) < 3 or np.all(np.abs(np.diff(t) / params.period - 1) <= IRREGULAR):
        return t, tuple(np.ascontiguousarray(v) for v in values), t
    even = np.linspace(0.0, t[-1], max(2, round(t[-1] / params.period) + 1))
    columns = (np.stack([np.interp(even, t, v[:, k]) for k in range(3)], axis=-1) for v in values)
    return t, tuple(columns), even


def _back(t: Array, even: Array, q: Array) -> Array:
    """Quaternions q (M, 4) of the even clock at the samples' times."""
    if t is even:
        return q
    k = np.clip(np.searchsorted(even, t) - 1, 0, len(even) - 2)
    x = ((t - even[k]) / (even[k + 1] - even[k]))[:, None]
    between = so3.quat_log(so3.quat_multiply(so3.quat_conjugate(q[k]), q[k + 1]))
    return so3.quat_multiply(q[k], so3.quat_exp(x * between))


def _online(params: Params, state: State, samples: _Samples) -> Track:
    vqf = package().VQF(params.period, tauAcc=params.tau_acc, tauMag=params.tau_mag)
    if state.vqf:
        vqf.state = state.vqf
    else:
        _begin(vqf, state.q)
    q, flags = np.empty((len(samples.dt), 4)), samples.flags.copy()
    nine = bool(np.any(flags & MAG))
    for part in _stretches(params, samples):
        if part.start or (samples.flags[part.start] & GAP):
            bias, sigma = vqf.getBiasEstimate()
            vqf.resetState()
            _begin(vqf, q[part.start - 1] if part.start else state.q)
            vqf.setBiasEstimate(bias, sigma)
        t, (gyr, acc, mag), even = _even(params, samples, part)
        rejected_s = float(vqf.state["magRejectT"])
        out = vqf.updateBatch(gyr, acc, mag if nine else None)
        q[part] = _back(t, even, out["quat9D" if nine else "quat6D"])
        if nine and t is even:
            taken = part.start + np.flatnonzero(flags[part] & MAG)  # VQF passes over the others
            left_out = _rejected(np.asarray(out["magDistDetected"], dtype=bool)[taken - part.start], rejected_s, vqf)
            flags[taken[left_out]] &= ~np.uint8(MAG)
    return Track(q, np.full((len(q), 3), np.nan), flags, State(dict(vqf.state), q[-1].copy(), flags[-1]))


def _rejected(disturbed: Mask, seconds: float, vqf: Any) -> Mask:
    """Samples (N,) of which VQF does not take the magnetometer. A field that it finds disturbed is left out for
    `magMaxRejectionTime` and then taken with less weight, so also at the start, where it knows no field yet."""
    most, factor, period = (float(v) for v in _limits(vqf))
    out = np.zeros(len(disturbed), dtype=bool)
    edges = [0, *(np.flatnonzero(np.diff(disturbed)) + 1).tolist(), len(disturbed)]
    for a, b in itertools.pairwise(edges if len(out) else []):
        if not disturbed[a]:
            seconds = max(seconds - factor * period * (b - a), 0.0)
            continue
        count = min(b - a, int(np.floor(max(most - seconds, -period) / period + 1e-9)) + 1)
        out[a : a + count] = True
        seconds += period * count
    return out


def _limits(vqf: Any) -> tuple[float, float, float]:
    return vqf.params["magMaxRejectionTime"], vqf.params["magRejectionFactor"], vqf.coeffs["magTs"]


def _begin(vqf: Any, q: Array) -> None:
    """Attitude q as VQF's start: its first magnetometer readings still count most."""
    vqf.state = {**vqf.state, "gyrQuat": np.asarray(q).tolist(), "accQuat": [1.0, 0.0, 0.0, 0.0], "delta": 0.0}


def _offline(params: Params, state: State, samples: _Samples) -> Track:
    module = package()
    q = np.empty((len(samples.dt), 4))
    before = state.q
    for part in _stretches(params, samples):
        t, (gyr, acc, mag), even = _even(params, samples, part)
        nine = bool(np.any(samples.flags[part] & MAG))
        settings = {"tauAcc": params.tau_acc, "tauMag": params.tau_mag}
        out = module.offlineVQF(gyr, acc, mag if nine else None, params.period, settings)
        found = _back(t, even, out["quat9D" if nine else "quat6D"])
        q[part] = found if nine else _with_heading(found, before)
        before = q[part.stop - 1]
    end = State({}, q[-1].copy(), samples.flags[-1])
    return Track(q, np.full((len(q), 3), np.nan), samples.flags, end)


def _with_heading(q: Array, first: Array) -> Array:
    """q turned about the vertical so that its first attitude comes nearest to `first`."""
    d = so3.quat_multiply(first, so3.quat_conjugate(q[0]))
    half = np.arctan2(d[3], d[0])
    return so3.quat_multiply([np.cos(half), 0.0, 0.0, np.sin(half)], q)
