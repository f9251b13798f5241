"""What `clean_reference` finds in a track that was spoilt in known places, and nothing where nothing is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from margcal.core import so3
from margcal.core.errors import InputError
from margcal.core.rigid_body import MarkerReference
from margcal.core.types import Array, Issue, Reference, Stream
from margcal.files.markers import Markers, marker_reference
from margcal.files.references import read_reference
from margcal.files.tables import read
from margcal.workflow.reference import clean_reference

RATE, N = 100.0, 2000
SHAPE = np.array([[0.0, 0.0, 0.0], [0.08, 0.0, 0.0], [0.05, 0.06, 0.0], [0.01, 0.03, 0.04]])


def attitudes(n: int = N) -> Array:
    """A body that is waved about at up to 300 deg/s, with rests between."""
    t = np.arange(n) / RATE
    pace = np.where((t % 5) < 1.2, 0.0, np.sin(np.pi * ((t % 5) - 1.2) / 3.8) ** 2)
    phase = np.cumsum(pace) / RATE
    angles = np.column_stack([1.1 * np.sin(3 * phase), 0.9 * np.sin(2.3 * phase), 1.4 * np.sin(1.7 * phase)])
    return so3.exp(angles)


def track(seed: int = 0, *, noise_deg: float = 0.03, R: Array | None = None) -> Reference:
    rng = np.random.default_rng(seed)
    R = attitudes() if R is None else R
    t = np.arange(len(R)) / RATE
    q = so3.quat_from_matrix(R @ so3.exp(np.radians(noise_deg) * rng.normal(size=(len(R), 3))))
    p = 0.3 * np.sin(t[:, None] * np.array([1.1, 0.7, 1.9])) + 2e-4 * rng.normal(size=(len(R), 3))
    return Reference(t, q, p + np.array([0.4, 2.0, 1.0]))


def changed(reference: Reference, rows: slice | Array, *, q=None, p=None) -> Reference:
    """`reference` with other attitudes or positions in some rows."""
    new_q, new_p = reference.q.copy(), None if reference.p is None else reference.p.copy()
    if q is not None:
        new_q[rows] = q
    if p is not None and new_p is not None:
        new_p[rows] = p
    return replace(reference, q=new_q, p=new_p)


def turned(reference: Reference, rows: slice, S: Array) -> Reference:
    """Some rows as another labelling of the markers shows them."""
    return changed(reference, rows, q=so3.quat_from_matrix(so3.matrix_from_quat(reference.q[rows]) @ S))


def masked(reference: Reference) -> list[int]:
    return np.flatnonzero(np.isnan(reference.q[:, 0])).tolist()


def codes(issues: tuple[Issue, ...]) -> list[str]:
    return [i.code for i in issues]


# --- nothing to find ----------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
def test_clean_track_stays_as_it_is(seed):
    reference = track(seed)
    found, issues = clean_reference(reference)
    assert issues == () and masked(found) == []
    sign = np.sign(np.sum(found.q * reference.q, axis=1))
    np.testing.assert_allclose(found.q * sign[:, None], reference.q, atol=1e-12)
    np.testing.assert_array_equal(found.p, reference.p)
    assert np.sum(found.q[1:] * found.q[:-1], axis=1).min() > 0


def test_cleaning_twice_is_cleaning_once():
    spoilt = turned(changed(track(), slice(300, 340), q=0.0), slice(700, 800), so3.exp([0, 2.0, 0.5]))
    once, _ = clean_reference(spoilt)
    twice, issues = clean_reference(once)
    np.testing.assert_allclose(once.q, twice.q, atol=1e-15)
    assert codes(issues) == ["reference-gaps"]


def test_fast_but_smooth_motion_is_no_swap():
    t = np.arange(400) / RATE
    R = so3.exp(np.radians(900) / 3 * np.sin(3 * t)[:, None] * np.array([0.0, 0.0, 1.0]))
    assert codes(clean_reference(track(R=R))[1]) == []
    slow = replace(track(R=R[::10]), t=t[::10])  # 90 degrees a frame at ten frames a second
    assert codes(clean_reference(slow)[1]) == []


def test_rest_written_with_four_decimals_is_not_frozen():
    still = np.repeat(attitudes()[900][None], 500, axis=0)
    reference = replace(track(R=still, noise_deg=0.0), q=np.round(track(R=still, noise_deg=0.0).q, 4), p=None)
    assert np.ptp(reference.q, axis=0).max() == 0
    assert codes(clean_reference(reference)[1]) == []


def test_reference_written_three_times_as_fast_as_measured_is_not_frozen():
    held = track(R=np.repeat(attitudes(600), 3, axis=0), noise_deg=0.0)
    held = replace(held, p=None)
    assert "reference-frozen" not in codes(clean_reference(held)[1])


# --- norms and signs (rows 30, 33) --------------------------------------------------------------------


def test_signs_are_made_continuous_and_norms_mended():
    reference = track()
    flips = np.where(np.random.default_rng(1).random(N) < 0.3, -1.0, 1.0)
    found, issues = clean_reference(replace(reference, q=reference.q * flips[:, None] * 1.0005))
    assert issues == () and np.sum(found.q[1:] * found.q[:-1], axis=1).min() > 0
    np.testing.assert_allclose(np.linalg.norm(found.q, axis=1), 1, atol=1e-15)
    found, issues = clean_reference(changed(reference, slice(7, 8), q=1.02 * reference.q[7]))
    assert codes(issues) == ["reference-norm"] and issues[0].value == pytest.approx(0.02)
    with pytest.raises(InputError, match=r"sample 8 .* norm 1\.1"):
        clean_reference(changed(reference, slice(7, 8), q=1.1 * reference.q[7]))


# --- gaps (row 34) ------------------------------------------------------------------------------------


def test_zeros_and_missing_values_are_gaps_and_stay_gaps():
    reference = changed(changed(track(), slice(300, 340), q=0.0), slice(700, 712), q=np.nan)
    found, issues = clean_reference(reference)
    assert masked(found) == [*range(300, 340), *range(700, 712)]
    assert codes(issues) == ["reference-gaps"] and issues[0].level == "note"
    assert issues[0].value == pytest.approx(52 / N)
    assert "2 gaps, longest 0.40 s" in issues[0].text
    assert len(found.t) == N


def test_position_at_exactly_the_origin_is_a_gap():
    reference = changed(track(), slice(500, 530), p=0.0)
    found, issues = clean_reference(reference)
    assert masked(found) == list(range(500, 530)) and codes(issues)[0] == "reference-origin"
    assert found.p is not None and np.isnan(found.p[500:530]).all()
    everywhere = changed(track(), slice(None), p=0.0)  # no positions at all
    assert masked(clean_reference(everywhere)[0]) == []


def test_exact_identities_among_other_attitudes_are_gaps():
    reference = changed(track(), slice(620, 650), q=[1.0, 0, 0, 0])
    found, issues = clean_reference(reference)
    assert masked(found) == list(range(620, 650)) and codes(issues) == ["reference-identity", "reference-gaps"]
    single = changed(track(), slice(620, 621), q=[-1.0, 0, 0, 0])
    assert masked(clean_reference(single)[0]) == [620]


def test_a_reference_that_sees_little_is_a_warning_and_one_that_sees_nothing_is_said():
    issues = clean_reference(changed(track(), slice(500, 1500), q=np.nan))[1]
    assert codes(issues) == ["reference-gaps"] and issues[0].level == "warn"
    assert codes(clean_reference(changed(track(), slice(None), q=np.nan))[1]) == ["reference-empty"]


# --- frozen bodies ------------------------------------------------------------------------------------


def gyroscope(R: Array) -> Stream:
    rate = so3.log(np.swapaxes(R[:-1], 1, 2) @ R[1:]) * RATE
    y = 900 * rate + np.array([40.0, -90.0, 15.0]) + np.random.default_rng(9).normal(size=rate.shape)
    return Stream("gyr", (np.arange(len(rate)) + 0.5) / RATE, y, "count")


@pytest.mark.parametrize("with_gyr", [False, True])
@pytest.mark.parametrize("where", [(250, 290), (811, 830), (1300, 1500)])
def test_held_body_is_found_to_the_sample(where, with_gyr):
    a, b = where
    reference = track()
    spoilt = changed(reference, slice(a, b), q=reference.q[a], p=reference.p[a] if reference.p is not None else None)
    found, issues = clean_reference(spoilt, gyr=gyroscope(attitudes()) if with_gyr else None)
    assert masked(found) == list(range(a + 1, b))  # the first was seen
    assert codes(issues) == ["reference-frozen", "reference-gaps"]
    assert f"first at {(a + 1) / RATE:.2f} s" in issues[0].text


def test_held_body_without_fast_edges_is_found_by_the_gyroscope_alone():
    """The track comes to rest and leaves it smoothly, and the gyroscope says that the body turned all the time."""
    reference = replace(track(noise_deg=0.0), p=None)
    rests = [k for k in range(1, N) if np.array_equal(reference.q[k], reference.q[k - 1])]
    assert masked(clean_reference(reference)[0]) == []
    rate = np.column_stack([200.0 * np.sin(4 * reference.t), np.zeros(N), np.zeros(N)])
    found, issues = clean_reference(reference, gyr=Stream("gyr", reference.t, rate, "count"))
    assert len(rests) > 300 and masked(found) == rests and codes(issues)[0] == "reference-frozen"


def test_body_at_rest_whose_values_repeat_is_left_alone_even_with_a_gyroscope():
    R = attitudes()
    reference = track(R=R, noise_deg=0.0)
    same = np.flatnonzero(np.abs(np.diff(reference.q, axis=0)).max(axis=1) == 0)
    assert len(same) > 300  # the rests
    found, _ = clean_reference(replace(reference, p=None), gyr=gyroscope(R))
    assert masked(found) == []


# --- swaps (row 35) -----------------------------------------------------------------------------------


@pytest.mark.parametrize("angle_deg", [40, 90, 180])
@pytest.mark.parametrize("rows", [(500, 501), (500, 523), (450, 1100), (0, 300), (1700, 2000)])
def test_swap_is_found_and_cut_to_the_sample(angle_deg, rows):
    S = so3.exp(np.radians(angle_deg) * np.array([0.6, 0.8, 0.0]))
    found, issues = clean_reference(turned(track(), slice(*rows), S))
    assert masked(found) == list(range(*rows))
    assert codes(issues) == ["reference-swap", "reference-gaps"]
    assert np.nanmin(np.sum(found.q[1:] * found.q[:-1], axis=1)) > 0


def test_several_swaps_of_several_kinds():
    spoilt, expected = track(), []
    for rows, v in (
        ((300, 360), (0, 2, 0)),
        ((360, 400), (1, 0, 1)),
        ((900, 1200), (0, 2, 0)),
        ((1500, 1501), (3, 0, 0)),
    ):
        spoilt = turned(spoilt, slice(*rows), so3.exp(v))
        expected += range(*rows)
    assert masked(clean_reference(spoilt)[0]) == expected


def test_the_labelling_that_lasts_longest_is_kept():
    S = so3.exp([0.0, 0.0, 1.2])
    found, issues = clean_reference(turned(track(), slice(600, N), S))
    assert masked(found) == list(range(600)) and "1 in all" in issues[0].text


def test_swap_next_to_a_short_gap():
    spoilt = turned(track(), slice(500, 560), so3.exp([0, 1.5, 0]))
    spoilt = changed(changed(spoilt, slice(497, 500), q=0.0), slice(560, 562), q=0.0)
    assert masked(clean_reference(spoilt)[0]) == list(range(497, 562))


def test_real_burst_of_wrong_attitudes(data_file):
    """The optics jump by 165 degrees within 0.1 s, twice, while the phone's gyroscope stays below 180 deg/s."""
    path = data_file("tyrex/Thibaud_Nexus5_NoDist_Swinging")
    reference = read_reference(path)
    gyr = read(path).gyr
    assert gyr is not None
    around = (gyr.t > 36.9) & (gyr.t < 37.2)
    assert np.degrees(np.linalg.norm(gyr.y[around], axis=1)).max() < 180
    found, issues = clean_reference(reference, gyr=gyr)
    new = np.flatnonzero(np.isnan(found.q[:, 0]) & ~np.isnan(reference.q[:, 0]))
    assert new.tolist() == [2218, 2219, 2220, 2225, 2226]
    assert "reference-swap" in codes(issues)


@pytest.mark.parametrize(
    "name", ["broad/08_undisturbed_fast_rotation_with_breaks_A", "broad/21_undisturbed_fast_combined"]
)
def test_real_fast_trials_lose_nothing_that_was_seen(data_file, name):
    reference = read_reference(data_file(f"{name}.parquet"))
    found, issues = clean_reference(reference)
    assert set(codes(issues)) <= {"reference-gaps", "reference-norm"}
    np.testing.assert_array_equal(np.isnan(found.q), np.isnan(reference.q))


# --- markers ------------------------------------------------------------------------------------------


def marker_track(x: Array) -> MarkerReference:
    return marker_reference(Markers(("A", "B", "C", "D"), np.arange(len(x)) / RATE, x))


def seen(noise: float = 2e-4) -> Array:
    R = attitudes()
    x = np.einsum("nij,mj->nmi", R, SHAPE) + np.array([0.4, 2.0, 1.0])
    return x + noise * np.random.default_rng(4).normal(size=x.shape)


def test_markers_swapped_within_the_body_are_found_by_the_residual_which_is_kept():
    x = seen()
    x[400:470, [1, 2]] = x[400:470, [2, 1]]
    track_of = marker_track(x)
    found, issues = clean_reference(track_of)
    assert isinstance(found, MarkerReference) and found.names == ("A", "B", "C", "D")
    assert masked(found) == list(range(400, 470)) and "reference-residual" in codes(issues)
    np.testing.assert_array_equal(found.residual, track_of.residual)
    assert found.residual[400:470].min() > 0.01  # of what was cut too


def test_markers_swapped_in_a_symmetric_triangle_are_found_by_the_jump():
    side = np.array([[0.0, 0, 0], [0.08, 0, 0], [0.04, 0.0693, 0]])
    x = np.einsum("nij,mj->nmi", attitudes(), side) + 2e-4 * np.random.default_rng(4).normal(size=(N, 3, 3))
    x[400:470] = x[400:470, [1, 2, 0]]
    track_of = marker_reference(Markers(("A", "B", "C"), np.arange(N) / RATE, x))
    assert np.max(track_of.residual) < 1e-3  # the residual does not see it
    found, issues = clean_reference(track_of)
    assert masked(found) == list(range(400, 470)) and codes(issues) == ["reference-swap", "reference-gaps"]


def test_one_marker_taken_for_a_far_one():
    x = seen()
    x[1000:1003, 3] += 0.4
    assert masked(clean_reference(marker_track(x))[0]) == [1000, 1001, 1002]


# --- positions (row 36) -------------------------------------------------------------------------------


@pytest.mark.parametrize(("factor", "words"), [(1e3, "millimetres taken for metres"), (1e-3, "metres taken for milli")])
def test_positions_in_the_wrong_unit_are_named_and_left_out(factor, words):
    reference = track()
    assert reference.p is not None
    found, issues = clean_reference(replace(reference, p=factor * reference.p))
    assert found.p is None and codes(issues) == ["reference-position-unit"] and words in issues[0].text
    assert masked(found) == []


@pytest.mark.parametrize("factor", [1e3, 1e-3])
def test_markers_in_the_wrong_unit_are_known_by_the_size_of_the_body(factor):
    found, issues = clean_reference(marker_track(factor * seen(2e-6)))
    assert found.p is None and "reference-position-unit" in codes(issues)
    assert "markers" in next(i.text for i in issues if i.code == "reference-position-unit")


def test_positions_far_from_the_origin_are_no_mistake():
    reference = track()
    assert reference.p is not None
    assert clean_reference(replace(reference, p=reference.p + 500.0))[1] == ()


# --- time ---------------------------------------------------------------------------------------------


def test_repeated_times_are_dropped_from_residual_and_track_alike():
    x = seen()
    track_of = marker_track(x)
    t = track_of.t.copy()
    t[11] = t[10]
    found, issues = clean_reference(replace(track_of, t=t))
    assert isinstance(found, MarkerReference) and len(found.t) == len(found.residual) == N - 1
    np.testing.assert_array_equal(found.residual[11], track_of.residual[12])
    assert codes(issues) == ["duplicate-time"]


def test_messages_begin_with_what_was_asked_for():
    issues = clean_reference(changed(track(), slice(5, 9), q=np.nan), where="walk.c3d")[1]
    assert issues[0].text.startswith("walk.c3d: not seen")
    issues = clean_reference(changed(track(), slice(7, 8), q=1.02 * track().q[7]), where="walk.c3d")[1]
    assert issues[0].text.startswith("walk.c3d: norms")
