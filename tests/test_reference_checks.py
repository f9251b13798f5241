"""References whose quaternions are not what they are taken for: each fault found, named and mended."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from margcal.core import so3
from margcal.core.errors import DataError
from margcal.core.types import Array
from margcal.methods import mocap_fit
from margcal.methods.reference_checks import READINGS, Reading, check_handedness, check_reference, mended
from margcal.methods.reference_rates import attitude_at, continuous, resample
from margcal.workflow.mocap_simulation import MocapSimulation, simulate_mocap


def spoilt(q: Array, reading: Reading) -> Array:
    """Quaternions that are right only when read as `reading`."""
    if "conjugated" in reading:
        q = so3.quat_conjugate(q)
    return np.roll(q, -1, axis=1) if "scalar last" in reading else q


@pytest.fixture(scope="module")
def trial() -> tuple[MocapSimulation, Array, Array, Array, Array]:
    s = simulate_mocap(seed=3, acceleration_rms=0.5, marker_deg=5.0, duration_s=30.0)
    gyr, acc = s.recording.streams["gyr"], s.recording.streams["acc"]
    q = resample(s.reference.t, continuous(s.reference.q), gyr.t)
    force = s.truth.models["acc"].apply(acc.y)
    return s, gyr.t, gyr.y, q, force


@pytest.mark.parametrize("reading", READINGS)
def test_each_reading_is_found_and_mended(
    trial: tuple[MocapSimulation, Array, Array, Array, Array], reading: Reading
) -> None:
    _, t, z, q, acc = trial
    wrong = spoilt(q, reading)
    np.testing.assert_allclose(mended(wrong, reading), q)
    check = check_reference(t, z, wrong, acc=acc)
    assert check.reading == reading
    assert check.misfit[reading] < 0.05
    if reading == "as read":
        assert not check.issues
    else:
        assert [i.code for i in check.issues] == ["reference-quaternions"]
        level = "warn" if reading == "conjugated and scalar last" else "fail"
        assert check.issues[0].level == level
    if reading in ("conjugated", "scalar last"):
        assert check.misfit["as read"] > 3 * check.misfit[reading]


def test_gyroscope_alone_cannot_tell_both_errors_at_once(
    trial: tuple[MocapSimulation, Array, Array, Array, Array],
) -> None:
    _, t, z, q, _ = trial
    both = check_reference(t, z, spoilt(q, "conjugated and scalar last"))
    assert not both.issues
    assert both.misfit["as read"] == pytest.approx(both.misfit["conjugated and scalar last"], rel=1e-6)
    one = check_reference(t, z, spoilt(q, "scalar last"))
    assert "cannot tell the two" in one.issues[0].text


def test_a_mirrored_gyroscope_axis_is_named(trial: tuple[MocapSimulation, Array, Array, Array, Array]) -> None:
    _, t, z, q, acc = trial
    check = check_reference(t, z * np.array([1.0, -1.0, 1.0]), q, acc=acc)
    assert [i.code for i in check.issues] == ["mirrored-axes"]
    assert np.linalg.det(check.H) < 0
    swapped = check_reference(t, z[:, [1, 0, 2]], q, acc=acc)
    assert [i.code for i in swapped.issues] == ["mirrored-axes"]


def test_another_body_belongs_to_nobody(trial: tuple[MocapSimulation, Array, Array, Array, Array]) -> None:
    _, t, z, _, acc = trial
    other = simulate_mocap(seed=8, duration_s=30.0)
    q = resample(other.reference.t, continuous(other.reference.q), t)
    check = check_reference(t, z, q, acc=acc)
    assert [i.code for i in check.issues] == ["reference-mismatch"]


def test_a_still_body_says_nothing() -> None:
    s = simulate_mocap(seed=1, still=True, duration_s=20.0, optics_noise_deg=0.01)
    gyr = s.recording.streams["gyr"]
    q = resample(s.reference.t, continuous(s.reference.q), gyr.t)
    with pytest.raises(DataError, match="hardly turns"):
        check_reference(gyr.t, gyr.y, q)
    with pytest.raises(DataError, match="too little in common"):
        check_reference(gyr.t, gyr.y, np.full_like(q, np.nan))


def test_a_left_handed_laboratory_shows_against_accelerations() -> None:
    s = simulate_mocap(seed=5, acceleration_rms=3.0)
    S = np.diag([1.0, 1.0, -1.0])
    acc, gyr = s.recording.streams["acc"], s.recording.streams["gyr"]
    R = S @ attitude_at(s.reference, gyr.t) @ S
    assert s.reference.p is not None
    p = resample(s.reference.t, s.reference.p, acc.t) @ S
    turned = mocap_fit.gyroscope(gyr.t, gyr.y, R)
    force = mocap_fit.forward(acc.t, acc.y, R, p)
    issue = check_handedness(turned, force)
    assert issue is not None
    assert issue.code == "mirrored-axes"
    assert "left-handed" in issue.text
    right = attitude_at(s.reference, gyr.t)
    position = resample(s.reference.t, s.reference.p, acc.t)
    assert check_handedness(turned, mocap_fit.forward(acc.t, acc.y, right, position)) is None


@pytest.mark.parametrize("reading", READINGS)
def test_broad_01(data_file: Callable[[str], Path], reading: Reading) -> None:
    import pyarrow.parquet as pq

    table = pq.read_table(data_file("broad/01_undisturbed_slow_rotation_A.parquet"))

    def columns(*names: str) -> Array:
        return np.column_stack([table[n].to_numpy().astype(np.float64) for n in names])[:12000]

    t = columns("t_s")[:, 0]
    gyr, acc = columns("gyr_x_radps", "gyr_y_radps", "gyr_z_radps"), columns("acc_x_mps2", "acc_y_mps2", "acc_z_mps2")
    q = columns("ref_qw", "ref_qx", "ref_qy", "ref_qz")
    check = check_reference(t, gyr, spoilt(q, reading), acc=acc)
    assert check.reading == reading
