"""The sensor error model: closed forms, exact round trips, and figures that people read."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from margcal.core.errors import InputError
from margcal.core.types import SensorModel
from margcal.methods.sensor_model import (
    ZY_TBME_TABLE_I,
    ErrorParameters,
    compose,
    describe,
    mounting,
    mounting_angles,
    sensing_axes,
    split,
)

Z_TIE_H_A = np.array(
    [[0.0209850, -0.0023786, 0.0033562], [0, 0.0237864, 0.0022374], [0.0020985, 0.0023786, -0.0223744]]
)


def random_parameters(rng: np.random.Generator, soft: bool = False) -> ErrorParameters:
    iron = np.eye(3)
    if soft:
        upper = rng.uniform(-0.1, 0.1, (3, 3))
        iron = iron + upper + upper.T
    return ErrorParameters(
        rng.uniform(0.5, 2, 3),
        *rng.uniform(-0.3, 0.3, 3),
        *rng.uniform(-1.5, 1.5, 3),
        soft_iron=iron,
        hard_iron=rng.normal(size=3),
        bias=rng.normal(size=3),
    )


def test_table_i_composes_to_the_product_of_its_matrices():
    H, B = compose(ZY_TBME_TABLE_I)
    R = Rotation.from_euler("ZYX", [0.1, 0.1, 0.1]).as_matrix()
    T = np.array([[1, 0, 0], [0.1, 1, 0], [0.1, 0.1, 1]])
    A = np.full((3, 3), 0.1) + 0.9 * np.eye(3)
    np.testing.assert_allclose(H, R @ T @ np.diag([1 / 1.2, 1 / 1.383, 1 / 1.12]) @ A, rtol=1e-14)
    np.testing.assert_array_equal(B, [32268, 31877, 31891])


def test_the_two_papers_place_the_offsets_on_either_side_of_the_soft_iron():
    p = random_parameters(np.random.default_rng(0), soft=True)
    y, offset = np.array([3.0, -2.0, 5.0]), p.bias + p.hard_iron
    H, B = compose(p, "z-tie")
    H2, B2 = compose(p, "zy-tbme")
    np.testing.assert_allclose(H, H2)
    RTS = H @ np.linalg.inv(p.soft_iron)
    np.testing.assert_allclose(H @ (y - B), RTS @ (p.soft_iron @ y - offset), rtol=1e-12)  # Z-TIE (2)
    np.testing.assert_allclose(H2 @ (y - B2), RTS @ p.soft_iron @ (y - offset), rtol=1e-12)  # ZY-TBME (8)


@pytest.mark.parametrize("seed", range(20))
def test_split_gives_the_parameters_back(seed):
    p = random_parameters(np.random.default_rng(seed))
    q = split(*compose(p))
    for name in ("scale", "alpha", "beta", "gamma", "phi", "theta", "psi"):
        np.testing.assert_allclose(getattr(q, name), getattr(p, name), rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(q.bias, p.bias + p.hard_iron, rtol=1e-15)


@pytest.mark.parametrize("soft_iron", [False, True])
@pytest.mark.parametrize("seed", range(20))
def test_any_matrix_splits_and_composes_to_itself(seed, soft_iron):
    rng = np.random.default_rng(seed)
    H, B = rng.normal(size=(3, 3)) * 10.0 ** rng.integers(-5, 5), rng.normal(size=3) * 1e4
    p = split(H, B, soft_iron=soft_iron)
    H2, B2 = compose(p)
    np.testing.assert_allclose(H2, H, rtol=0, atol=1e-14 * np.abs(H).max() * np.linalg.cond(H))
    np.testing.assert_array_equal(B2, B)
    assert np.sum(p.scale < 0) == (np.linalg.det(H) < 0)
    if soft_iron:
        assert np.linalg.det(p.soft_iron) == pytest.approx(1, rel=1e-12)
        np.testing.assert_allclose(p.soft_iron, p.soft_iron.T, atol=1e-13)
        assert np.ptp(np.abs(p.scale)) <= 1e-15 * np.abs(p.scale).max()


def test_a_mirrored_triad_has_one_negative_scale_on_the_axis_that_is_mirrored():
    p = split(Z_TIE_H_A, np.zeros(3))  # det < 0, its z column points down
    assert p.scale[2] < 0 < min(p.scale[:2])
    np.testing.assert_allclose(compose(p)[0], Z_TIE_H_A, atol=1e-16)


@pytest.mark.parametrize("theta", [np.pi / 2, -np.pi / 2, np.pi / 2 - 1e-9, 0.3])
def test_mounting_angles_survive_gimbal_lock(theta):
    R = mounting(0.4, theta, -0.9)
    np.testing.assert_allclose(mounting(*mounting_angles(R)), R, atol=1e-9 if abs(theta) > 1.5 else 1e-15)


@pytest.mark.parametrize("H", [np.zeros((3, 3)), np.diag([1, 1, np.nan]), np.ones((3, 3)), np.eye(2)])
def test_what_cannot_be_split_is_said(H):
    with pytest.raises(InputError, match="H"):
        split(H, np.zeros(3))


def test_wrong_shapes_and_forms_are_said():
    with pytest.raises(InputError, match="scale"):
        ErrorParameters(scale=np.ones(2))
    with pytest.raises(InputError, match="neither"):
        compose(ErrorParameters(), "other")  # type: ignore[arg-type]


def test_describe_reads_sensing_axes_scale_and_angles():
    # y leans 2 degrees towards x, z is square to both; 200, 210, 190 counts per m/s^2
    lean = np.radians(2)
    axes = np.array([[1, 0, 0], [np.sin(lean), np.cos(lean), 0], [0, 0, 1.0]])
    K_fwd = np.array([200.0, 210, 190])[:, None] * axes
    d = describe(SensorModel("acc", np.linalg.inv(K_fwd), np.array([10.0, -20, 30])))
    assert d.bias == (10, -20, 30)
    assert d.scale_factor == pytest.approx((200, 210, 190), rel=1e-12)
    assert d.scale_unit == "count per m/s^2"
    assert d.non_orthogonality_deg == pytest.approx({"xy": 2, "xz": 0, "yz": 0}, abs=1e-10)
    assert d.axes == ("+x", "+y", "+z")
    # the nearest rotation to axes at 0 and 88 degrees shares the two degrees: one about z
    assert d.mounting_deg == pytest.approx({"roll": 0, "pitch": 0, "yaw": -1}, abs=1e-10)
    assert d.hard_iron is None and d.soft_iron is None and not d.mirrored


def test_describe_finds_the_mounting_rotation():
    R = mounting(*np.radians([3.0, -2.0, 5.0]))
    d = describe(SensorModel("gyr", R @ np.diag([0.01, 0.011, 0.012]), np.zeros(3)))
    assert d.mounting_deg == pytest.approx({"roll": 3, "pitch": -2, "yaw": 5}, abs=1e-9)
    assert d.mounting_angle_deg == pytest.approx(np.degrees(Rotation.from_matrix(R).magnitude()), abs=1e-9)


def signed_permutations():
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1, -1), repeat=3):
            yield order, signs


@pytest.mark.parametrize("kind", ["acc", "mag"])
def test_describe_names_every_swap_and_flip(kind):
    small = mounting(0.05, -0.04, 0.06)
    for order, signs in signed_permutations():
        P = np.zeros((3, 3))  # raw axis i points along signs[i] times the frame's axis order[i]
        P[list(order), range(3)] = signs
        d = describe(SensorModel(kind, 0.15 * small @ P, np.zeros(3)))
        assert d.axes == tuple(("+" if s > 0 else "-") + "xyz"[o] for o, s in zip(order, signs))
        assert d.mirrored == (np.linalg.det(P) < 0)
        assert [np.radians(d.mounting_deg[k]) for k in ("roll", "pitch", "yaw")] == pytest.approx(
            [0.05, -0.04, 0.06], abs=1e-12
        )


def test_a_mounting_far_from_the_axes_is_told_as_a_whole():
    R = Rotation.from_rotvec(np.radians(50) * np.ones(3) / np.sqrt(3)).as_matrix()
    d = describe(SensorModel("acc", R, np.zeros(3)))
    assert d.axes is None
    assert d.mounting_angle_deg == pytest.approx(50)


def test_describe_of_a_magnetometer_gives_hard_and_soft_iron_of_the_ellipsoid():
    A = np.array([[1.1, 0.03, -0.02], [0.03, 0.95, 0.01], [-0.02, 0.01, 1.0]])
    A /= np.cbrt(np.linalg.det(A))
    R = Rotation.from_euler("ZYX", [92, 1, 178], degrees=True).as_matrix()
    H = 0.15 * R @ A
    d = describe(SensorModel("mag", H, np.array([100.0, -200, 50])))
    np.testing.assert_allclose(d.soft_iron, A, atol=1e-12)
    scale, axes = sensing_axes(H)
    np.testing.assert_allclose(np.linalg.inv(H), scale[:, None] * axes, rtol=1e-12)
    assert d.hard_iron == pytest.approx(np.array([100, -200, 50]) / scale)
    assert d.scale_unit == "count per uT"
