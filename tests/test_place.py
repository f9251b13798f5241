"""Gravity and field of a place: published figures, symmetries, and what is refused."""

from __future__ import annotations

import datetime

import numpy as np
import pytest

from margcal.core.errors import InputError, UsageError
from margcal.workflow.place import at, decimal_year, field, gravity, parse_at


@pytest.mark.parametrize(
    "latitude, height, expected",
    [(0, 0, 9.7803253359), (90, 0, 9.8321849379), (-90, 0, 9.8321849379), (51.5, 20, 9.81197187)],
)
def test_gravity_of_wgs84(latitude, height, expected):
    assert gravity(latitude, height) == pytest.approx(expected, abs=1e-8)


def test_gravity_at_45_degrees_is_that_of_the_grs80_ellipsoid_within_its_difference():
    assert gravity(45) == pytest.approx(9.8061992, abs=2e-6)


def test_gravity_falls_with_height_as_the_free_air_gradient():
    assert gravity(45, 1000) - gravity(45, 0) == pytest.approx(-3.0851e-3, abs=2e-6)


def test_field_of_london():
    f = field(51.4988, -0.1749, 2026.5, 20)
    assert f.total_uT == pytest.approx(49.11685, abs=1e-4)
    assert f.dip_deg == pytest.approx(66.5365, abs=1e-3)
    assert f.declination_deg == pytest.approx(1.147, abs=1e-3)
    assert f.total_se_uT == pytest.approx(0.138)
    assert f.dip_se_deg == pytest.approx(0.2)


@pytest.mark.parametrize("latitude", [51.5, -33.9, 0.0])
def test_the_vector_is_east_north_up_with_y_magnetic_north(latitude):
    f = field(latitude, 18.4, 2026.0)
    dip = np.radians(f.dip_deg)
    np.testing.assert_allclose(f.vector, f.total_uT * np.array([0, np.cos(dip), -np.sin(dip)]), atol=1e-9)
    assert f.vector[1] == pytest.approx(f.horizontal_uT) and f.vector[1] > 0
    assert not f.vector.flags.writeable
    assert (f.dip_deg > 0) == (latitude > 10)  # the magnetic equator lies north of the equator in Africa


def test_decimal_years():
    assert decimal_year("2026-07-02") == pytest.approx(2026 + 182 / 365)
    assert decimal_year("2028-12-31") == pytest.approx(2028 + 365 / 366)
    assert decimal_year(datetime.date(2026, 1, 1)) == 2026
    assert decimal_year("2026.25") == decimal_year(2026.25) == 2026.25
    assert decimal_year(None) == decimal_year(datetime.date.today())


def test_parse_at_gives_gravity_and_field():
    place = parse_at(" 51.5, -0.12 ,2026-07-02")
    assert place.gravity == gravity(51.5)
    np.testing.assert_array_equal(place.field.vector, field(51.5, -0.12, datetime.date(2026, 7, 2)).vector)
    assert (place.latitude_deg, place.longitude_deg, place.height_m) == (51.5, -0.12, 0)
    assert place.issues == ()


@pytest.mark.skipif(not 2025 <= decimal_year(None) <= 2030, reason="today is outside the model")
def test_without_a_date_it_is_today():
    assert parse_at("51.5,-0.12").field.year == decimal_year(None)


@pytest.mark.parametrize(
    "text, what",
    [
        ("51.5", "LAT,LON"),
        ("51,5,0,12,2026", "LAT,LON"),
        ("", "LAT,LON"),
        ("london,0", "numbers"),
        ("91,0,2026", "latitude 91"),
        ("nan,0,2026", "latitude nan"),
        ("0,181,2026", "longitude 181"),
        ("0,0,yesterday", "YYYY-MM-DD"),
        ("0,0,2026-02-30", "YYYY-MM-DD"),
        ("0,0,inf", "date"),
    ],
)
def test_what_is_no_place_is_a_usage_error(text, what):
    with pytest.raises(UsageError, match=what):
        parse_at(text)


@pytest.mark.parametrize("date", ["2024-12-31", "2030-01-02", "1066.8"])
def test_a_date_outside_the_model_is_refused_with_its_years(date):
    with pytest.raises(InputError, match="2025 to 2030"):
        parse_at(f"51.5,0,{date}")


def test_height_enters_gravity_and_field():
    high, low = at(45, 6, 2026.0, 3000), at(45, 6, 2026.0)
    assert high.gravity - low.gravity == pytest.approx(gravity(45, 3000) - gravity(45))
    # a dipole falls as the cube of the distance
    assert high.field.total_uT / low.field.total_uT == pytest.approx((6371 / 6374) ** 3, abs=3e-4)


def test_heights_off_the_earth_are_refused():
    with pytest.raises(InputError, match="height"):
        gravity(0, 1e7)
    with pytest.raises(InputError, match="height"):
        field(0, 0, 2026, float("nan"))


@pytest.mark.parametrize("text, level", [("86,150,2026", "warn"), ("80,150,2026", "note"), ("60,10,2026", None)])
def test_near_a_magnetic_pole_it_warns(text, level):
    issues = parse_at(text).issues
    assert [i.level for i in issues] == ([level] if level else [])
    assert all(i.value is not None and i.limit is not None and i.value < i.limit for i in issues)
