"""Faces, chains, headings and labels against known attitudes; pose means are built directly."""

from __future__ import annotations

import numpy as np
import pytest

from margcal.core import so3
from margcal.workflow import attitudes as att
from margcal.workflow.motion import attitudes as pose_set

G = 9.80665


def node(rng, mounting_deg: float = 4.0, scale_error: float = 0.08, gain: float = 200.0):
    """H and B of a triad: scale, non-orthogonality 1 degree, mounting about a random axis."""
    axis = rng.normal(size=3)
    S = np.eye(3) + np.triu(np.tan(np.radians(rng.uniform(-1, 1, (3, 3)))), 1)
    scale = gain * (1 + scale_error * rng.uniform(-1, 1, 3))
    H = so3.exp(np.radians(mounting_deg) * axis / np.linalg.norm(axis)) @ S @ np.diag(1 / scale)
    return H, 300 * rng.uniform(-1, 1, 3)


def means(R, u, H, B, noise: float, rng):
    v = np.einsum("jba,b->ja", R, u)
    return v @ np.linalg.inv(H).T + B + noise * rng.normal(size=v.shape)


def put_down(seed: int, poses="cube", n=24, housing_deg=0.2):
    rng = np.random.default_rng([seed, 7])
    label = pose_set(poses, n, rng)
    return label, label @ so3.exp(np.radians(housing_deg) * rng.normal(size=(n, 3))), rng


# --- faces -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mounting_deg", [0.0, 4.0, 15.0, 25.0])
@pytest.mark.parametrize("seed", range(4))
def test_faces_are_told_with_any_mounting(mounting_deg, seed):
    label, R, rng = put_down(seed, "faces", 12)
    H, B = node(rng, mounting_deg)
    faces = att.find_faces(means(R, np.array([0, 0, G]), H, B, 0.3, rng))
    assert faces is not None
    assert np.array_equal(faces.up, np.round(label[:, 2, :]))
    assert faces.tilt_deg.max() < 3
    assert att.lies_on_faces(faces)
    assert np.trace(faces.H) == pytest.approx(max(np.trace(Q @ faces.H) for Q in so3.cube_group()))


@pytest.mark.parametrize("missing", range(6))
def test_a_face_that_was_never_up_is_no_harm(missing):
    label, R, rng = put_down(missing, "faces", 18)
    axes = np.vstack([np.eye(3), -np.eye(3)])
    keep = ~np.isclose(label[:, 2, :] @ axes[missing], 1)
    H, B = node(rng)
    faces = att.find_faces(means(R[keep], np.array([0, 0, G]), H, B, 0.3, rng))
    assert faces is not None
    assert np.array_equal(faces.up, np.round(label[keep][:, 2, :]))


def test_attitudes_that_are_no_faces_are_seen_to_be_none():
    for seed in range(8):
        _, R, rng = put_down(seed, "free", 16)
        H, B = node(rng)
        faces = att.find_faces(means(R, np.array([0, 0, G]), H, B, 0.3, rng))
        assert not att.lies_on_faces(faces)


def test_coplanar_readings_tell_no_faces():
    rng = np.random.default_rng(1)
    y = rng.normal(size=(10, 3)) * [100, 100, 0] + 5
    assert att.find_faces(y) is None
    assert att.find_faces(y[:3]) is None
    assert not att.lies_on_faces(None)


# --- chains ------------------------------------------------------------------------------------------


def test_chain_levels_every_rest_and_keeps_the_headings():
    rng = np.random.default_rng(2)
    _, R, _ = put_down(3, "free", 15)
    dR = np.swapaxes(R[:-1], 1, 2) @ R[1:] @ so3.exp(np.radians(0.5) * rng.normal(size=(14, 3)))
    found, piece = att.chain(7.0 * R[:, 2, :], dR, np.arange(14))
    assert np.array_equal(piece, np.zeros(15))
    assert found[:, 2, :] == pytest.approx(R[:, 2, :], abs=1e-12)  # R^T z is exactly what gravity says
    heading = so3.log(found @ np.swapaxes(R, 1, 2))
    assert np.abs(heading[:, :2]).max() < 1e-9
    steps = np.angle(np.exp(1j * np.diff(heading[:, 2])))
    assert np.degrees(np.abs(steps)).max() < 3.0


def test_chain_breaks_where_a_turn_is_missing():
    _, R, _ = put_down(4, "free", 8)
    before = np.array([0, 1, 3, 4, 6])
    dR = np.swapaxes(R[before], 1, 2) @ R[before + 1]
    found, piece = att.chain(R[:, 2, :], dR, before)
    assert piece.tolist() == [0, 0, 0, 1, 1, 1, 2, 2]
    for i in before:
        assert so3.angle_between(np.swapaxes(found[i], 0, 1) @ found[i + 1], np.swapaxes(R[i], 0, 1) @ R[i + 1]) < 1e-6


@pytest.mark.parametrize("up", np.vstack([np.eye(3), -np.eye(3), [[0.6, 0.0, -0.8]]]))
def test_chain_stands_up_from_any_attitude(up):
    found, _ = att.chain(np.array([[0.0, 0, 1], up]), np.eye(3)[None], np.array([0]))
    assert found[1, 2] == pytest.approx(up, abs=1e-12)
    assert np.linalg.det(found[1]) == pytest.approx(1)


def test_snapping_lets_no_error_add_up():
    rng = np.random.default_rng(5)
    label, R, _ = put_down(5, "cube", 40)
    drift = so3.exp(np.radians(8.0) * np.array([0, 0, 1.0]))  # eight degrees about z in every turn
    dR = np.swapaxes(R[:-1], 1, 2) @ R[1:] @ drift @ so3.exp(np.radians(2) * rng.normal(size=(39, 3)))
    found, piece, snap = att.snap_chain(np.round(label[:, 2, :]), dR, np.arange(39))
    common = found[0] @ label[0].T
    assert np.allclose(found, common @ label)
    assert piece.max() == 0
    assert 5 < np.sqrt(np.mean(snap**2)) < 12


def test_snap_says_how_far_a_hand_was_from_the_cube():
    label = pose_set("faces", 20, np.random.default_rng(6))
    dR = np.swapaxes(label[:-1], 1, 2) @ label[1:]
    _, _, snap = att.snap_chain(np.round(label[:, 2, :]), dR, np.arange(19))
    assert np.sqrt(np.mean(snap**2)) > att.CUBE_RMS_DEG  # arbitrary headings: refused as a cube


# --- magnetometer ------------------------------------------------------------------------------------


def field_of(dip_deg: float) -> np.ndarray:
    dip = np.radians(dip_deg)
    return 49.0 * np.array([0.0, np.cos(dip), -np.sin(dip)])


def mag_case(seed: int, dip_deg: float, mounting_deg=4.0, noise=0.15, board=False):
    label, R, rng = put_down(seed)
    H, B = node(rng, mounting_deg, gain=6.7)
    if board:
        H = H @ np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    return label, att.headings_from_field(means(R, field_of(dip_deg), H, B, noise, rng), np.round(label[:, 2, :]))


def same_up_to_heading(found, label) -> bool:
    common = found[0] @ label[0].T
    return bool(np.allclose(found, common @ label))


@pytest.mark.parametrize("dip_deg", [-60.0, 30.0, 60.0])
@pytest.mark.parametrize("board", [False, True])
def test_headings_from_the_field(dip_deg, board):
    for seed in range(5):
        label, found = mag_case(seed, dip_deg, board=board)
        assert found is not None
        assert same_up_to_heading(found.R, label)
        assert found.off_deg.max() < att.CUBE_SNAP_DEG


@pytest.mark.parametrize("dip_deg", [0.0, 80.0, 85.0, 89.0])
def test_headings_where_the_dip_tells_little_are_right_or_seen_to_be_doubtful(dip_deg):
    """A level field has no vertical part to go by, a steep one hardly a heading: no clear-cut wrong answer."""
    for seed in range(8):
        label, found = mag_case(seed, dip_deg)
        assert found is None or same_up_to_heading(found.R, label) or found.off_deg.max() > 10.0


def test_too_few_rests_tell_no_headings():
    label, R, rng = put_down(1)
    H, B = node(rng, gain=6.7)
    y = means(R, field_of(60), H, B, 0.1, rng)
    assert att.headings_from_field(y[:9], np.round(label[:9, 2, :])) is None


def test_labels_of_many_nodes_from_pose_means():
    """Accelerometer, magnetometer and turns together, as `cube` has them: >= 99 % of nodes, here all of them."""
    for seed in range(16):
        label, R, rng = put_down(seed)
        H, B = node(rng, 5.0)
        faces = att.find_faces(means(R, np.array([0, 0, G]), H, B, 0.3, rng))
        assert faces is not None
        dR = np.swapaxes(R[:-1], 1, 2) @ R[1:] @ so3.exp(np.radians(1.5) * rng.normal(size=(23, 3)))
        keep = np.sort(rng.permutation(23)[:19])  # four turns were lost
        chain, piece, snap = att.snap_chain(faces.up, dR[keep], keep)
        assert snap.max() < att.CUBE_SNAP_DEG
        Hm, Bm = node(rng, 5.0, gain=6.7)
        field = att.headings_from_field(means(R, field_of(60), Hm, Bm, 0.15, rng), faces.up)
        assert field is not None
        found, agree, _ = att.join_pieces(chain, piece, field.R)
        assert agree == 1.0
        assert same_up_to_heading(found, label), seed


def test_chains_are_joined_by_the_majority_of_their_rests():
    label, _, _ = put_down(8)
    quarter = np.round(so3.exp(np.array([0, 0, np.pi / 2])))
    piece = np.repeat([0, 1, 2], 8)
    chain = label.copy()
    chain[piece == 1] = quarter @ chain[piece == 1]
    chain[piece == 2] = quarter @ quarter @ chain[piece == 2]
    field = label.copy()
    field[[2, 11, 12]] = quarter @ field[[2, 11, 12]]  # the magnetometer is wrong at three rests
    found, agree, left = att.join_pieces(chain, piece, field)
    assert np.allclose(found, label)
    assert agree == pytest.approx(21 / 24)
    assert left == 0
    alone, agree, left = att.join_pieces(chain, piece, None)
    assert alone is chain
    assert np.isnan(agree)
    assert left == 2


# --- given attitudes ---------------------------------------------------------------------------------


def test_up_and_front_name_a_rotation():
    names = ["+x", "-x", "+y", "-y", "+z", "-z"]
    for u in names:
        for f in names:
            if u[1] == f[1]:
                continue
            c, R = att.from_directions([u], [f])
            axis = {"x": 0, "y": 1, "z": 2}
            up = np.eye(3)[axis[u[1]]] * (1 if u[0] == "+" else -1)
            front = np.eye(3)[axis[f[1]]] * (1 if f[0] == "+" else -1)
            assert c[0] == pytest.approx(up)
            assert R[0] @ up == pytest.approx([0, 0, 1])  # up is up
            assert R[0] @ front == pytest.approx([0, 1, 0])  # front looks to the laboratory's +y
            assert np.linalg.det(R[0]) == pytest.approx(1)
    assert att.from_directions(["+x", "-z"], ["+y", None])[1] is None
    assert att.from_directions(["+x"], None)[1] is None


def test_distinct_attitudes_are_counted_once():
    R = so3.exp(np.radians([[0, 0, 0], [0, 0, 5], [0, 30, 0], [0, 33, 0], [90, 0, 0]]))
    R = np.concatenate([R, np.full((2, 3, 3), np.nan)])
    assert att.count_distinct(R) == 3
    assert att.count_distinct(R, 4.0) == 4
