"""Datum: heights above ellipsoid and sea level, and positions about another origin."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from spn_data.errors import InputError
from spn_data.geometry.geodesy import GeoOrigin, HeightReference
from spn_model.autopilot.datum import Datum, Geodetic
from spn_model.autopilot.projection import Projection, north_east
from tests.worlds.autopilots import AMSL_ONLY, DATUM, ORIGIN


@pytest.mark.parametrize(
    ("reference", "geoid", "ellipsoid", "amsl"),
    [
        (HeightReference.AMSL, 45.5, 635.5, 590.0),
        (HeightReference.AMSL, None, math.nan, 590.0),
        (HeightReference.ELLIPSOID, 45.5, 590.0, 544.5),
        (HeightReference.ELLIPSOID, None, 590.0, math.nan),
        (HeightReference.TAKEOFF, 45.5, math.nan, math.nan),
        (HeightReference.UNKNOWN, None, math.nan, math.nan),
    ],
)
def test_a_height_is_never_passed_off_as_another(reference, geoid, ellipsoid, amsl):
    """30 m above an origin at 560 m: each height is right or unknown, by the reference and the geoid."""
    datum = Datum(origin=replace(ORIGIN, height_reference=reference), geoid_height_m=geoid)
    place = datum.geodetic(np.array([0.0, 0.0, 30.0]))
    np.testing.assert_allclose([place.ellipsoid_m, place.amsl_m], [ellipsoid, amsl], atol=1e-6)


def test_an_autopilot_needs_heights_above_sea_level():
    """A world with heights above take-off is refused, with the remedy."""
    DATUM.require_amsl()
    AMSL_ONLY.require_amsl()
    with pytest.raises(InputError, match=r"above 'takeoff' only.*give the geoid height"):
        Datum(origin=replace(ORIGIN, height_reference=HeightReference.TAKEOFF)).require_amsl()


OWN = Geodetic(lat_deg=48.1, lon_deg=11.6, ellipsoid_m=math.nan, amsl_m=560.0)


def spherical(lat, lon, lat_0, lon_0):
    """Return north and east by PX4's formulas as they are in geo.cpp."""
    sin, cos, radians = math.sin, math.cos, math.radians
    lat, lon, lat_0, lon_0 = radians(lat), radians(lon), radians(lat_0), radians(lon_0)
    turned = cos(lon - lon_0)
    c = math.acos(min(1.0, sin(lat_0) * sin(lat) + cos(lat_0) * cos(lat) * turned))
    k = c / sin(c) if abs(c) > 0 else 1.0
    north = k * (cos(lat_0) * sin(lat) - sin(lat_0) * cos(lat) * turned)
    return north * 6371000, k * cos(lat) * sin(lon - lon_0) * 6371000


@pytest.mark.parametrize("enu", [[300.0, -200.0, 30.0], [-4000.0, 3000.0, 0.0], [0.0, 0.0, 5.0]])
def test_the_local_plane_is_that_of_the_autopilot(enu):
    """North and east are what PX4 and ArduPilot compute from the latitude and longitude of the place."""
    place = AMSL_ONLY.geodetic(np.array(enu))
    px4 = AMSL_ONLY.local_ned(np.array(enu), OWN, Projection.PX4)
    expected = spherical(place.lat_deg, place.lon_deg, 48.1, 11.6)
    # acos is good to 1e-8, which is 0.1 m on the Earth, unless the place is far from the origin.
    np.testing.assert_allclose(px4[:2], expected, atol=1e-3 if np.hypot(*enu[:2]) > 100 else 0.2)
    ardupilot = AMSL_ONLY.local_ned(np.array(enu), OWN, Projection.ARDUPILOT)
    steps = np.array([place.lat_deg - 48.1, place.lon_deg - 11.6]) * 1e7 * 0.011131884502145034
    steps[1] *= math.cos(math.radians((place.lat_deg + 48.1) / 2))
    np.testing.assert_allclose(ardupilot[:2], steps, atol=1e-6)
    for ned in (px4, ardupilot):
        np.testing.assert_allclose(ned, [enu[1], enu[0], 560.0 - place.amsl_m], atol=20, rtol=5e-3)


def test_a_map_in_metres_would_miss_the_autopilots_waypoints():
    """300 m east of the origin, PX4's plane is 0.9 m shorter than the world, ArduPilot's 0.4 m."""
    east = [
        AMSL_ONLY.local_ned(np.array([300.0, 0.0, 0.0]), OWN, projection)[1]
        for projection in (Projection.PX4, Projection.ARDUPILOT)
    ]
    np.testing.assert_allclose(east, [299.1, 299.4], atol=0.2)


def test_positions_are_about_the_origin_of_the_autopilot():
    """About an origin 300 m east, 100 m south and 7 m up, a point is as far as in the world, within 0.4 %."""
    origin = AMSL_ONLY.geodetic(np.array([300.0, -100.0, 7.0]))
    for projection in Projection:
        ned = AMSL_ONLY.local_ned(np.array([10.0, 20.0, 30.0]), origin, projection)
        np.testing.assert_allclose(ned, [120, -290, -23], rtol=4e-3)


def test_the_plane_goes_on_beyond_the_date_line():
    """A step over 180 degrees of longitude is a small one."""
    for projection in Projection:
        north, east = north_east(projection, (0.0, -179.9999), (0.0, 179.9999))
        np.testing.assert_allclose([north, east], [0, 22.2], atol=0.1)


@pytest.mark.parametrize(
    ("origin", "geoid"),
    [
        (GeoOrigin(math.nan, 0.0, 0.0), None),
        (GeoOrigin(91.0, 0.0, 0.0), None),
        (GeoOrigin(0.0, 0.0, math.inf), None),
        (ORIGIN, math.nan),
        (ORIGIN, 500.0),
    ],
)
def test_a_datum_that_is_none_is_refused(origin, geoid):
    """A place off the Earth and an impossible geoid height are refused."""
    with pytest.raises(InputError, match=r"no place on the Earth|the geoid height is"):
        Datum(origin=origin, geoid_height_m=geoid)
