"""Tests of WGS84 and local coordinates, with pycolmap's GPSTransform as independent reference."""

from __future__ import annotations

import cv2  # noqa: F401  # must load before pycolmap, else PNG writing aborts
import numpy as np
import pycolmap
import pytest

from spn_data.geometry.geodesy import (
    GeoOrigin,
    HeightReference,
    ecef_from_wgs84,
    wgs84_from_ecef,
)

# pycolmap defaults to GRS80, whose poles differ by 0.1 mm.
WGS84 = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
PLACES = np.array(
    [
        [49.015422, 8.425117, 163.2],
        [-33.4, -70.6, 2500.0],  # south and west
        [0.0, 0.0, 0.0],
        [-0.0001, 179.9999, 10.0],
        [89.99, 12.0, 100.0],
        [64.1, -21.9, -50.0],
    ]
)


def test_earth_centred_coordinates_agree_with_pycolmap():
    """ECEF coordinates agree with pycolmap within 1e-7 m in all quadrants of the Earth."""
    theirs = WGS84.ellipsoid_to_ecef(PLACES)
    assert ecef_from_wgs84(PLACES) == pytest.approx(theirs, abs=1e-7)


def test_earth_centred_coordinates_have_their_known_values():
    """ECEF gives the semi-major axis on the equator and the semi-minor axis at the pole."""
    places = np.array([[0.0, 0.0, 0.0], [0.0, 90.0, 1.0], [90.0, 0.0, 0.0]])
    known = np.array([[6378137.0, 0, 0], [0, 6378138.0, 0], [0, 0, 6356752.314245]])
    assert ecef_from_wgs84(places) == pytest.approx(known, abs=1e-6)


def test_the_way_back_from_earth_centred_coordinates_is_exact():
    """The ECEF round trip is exact within 1e-8 m and 1e-12 degrees, also at the poles."""
    places = np.concatenate(
        [PLACES, [[90.0, 0.0, 5.0], [-90.0, 0.0, -5.0], [45.0, 100.0, 20000.0]]]
    )
    back = wgs84_from_ecef(ecef_from_wgs84(places))
    assert back[:, 0] == pytest.approx(places[:, 0], abs=1e-12)
    assert back[:-3, 1] == pytest.approx(places[:-3, 1], abs=1e-12)
    assert back[:, 2] == pytest.approx(places[:, 2], abs=1e-8)


@pytest.mark.parametrize("place", PLACES.tolist())
def test_local_metres_agree_with_pycolmap(place):
    """East, north and up agree with pycolmap up to a kilometre away, in both directions."""
    origin = GeoOrigin(*place)
    rng = np.random.default_rng(0)
    enu = rng.uniform(-1000, 1000, (20, 3))
    lat_lon_alt = origin.wgs84_from_enu(enu)
    theirs = WGS84.ellipsoid_to_enu(lat_lon_alt, *place)
    assert enu == pytest.approx(theirs, abs=1e-6)
    assert origin.enu_from_wgs84(lat_lon_alt) == pytest.approx(enu, abs=1e-6)


def test_axes_point_east_north_and_up():
    """Longitude increases east, latitude north and height up, also in the south and west."""
    for lat, lon in ((49.0, 8.4), (-33.4, -70.6)):
        origin = GeoOrigin(lat, lon, 100.0)
        moved = np.array([[lat, lon + 1e-4, 100.0], [lat + 1e-4, lon, 100.0], [lat, lon, 107.0]])
        enu = origin.enu_from_wgs84(moved)
        east, north, up = enu
        assert east[0] > 5
        assert north[1] == pytest.approx(11.1, abs=0.05)  # 1e-4 degrees of latitude
        assert up == pytest.approx([0, 0, 7.0], abs=1e-6)
        assert np.abs([east[1], east[2], north[0], north[2]]).max() < 1e-3


def test_one_point_may_come_without_a_list():
    """A single point of shape (3,) gives a result of shape (3,)."""
    origin = GeoOrigin(49.0, 8.4, 100.0)
    assert origin.enu_from_wgs84(np.array([49.0, 8.4, 100.0])) == pytest.approx([0, 0, 0], abs=1e-6)
    assert origin.wgs84_from_enu(np.zeros(3)) == pytest.approx([49.0, 8.4, 100.0])


def test_an_origin_knows_what_its_height_is_above():
    """The default height reference is the ellipsoid, and references have their file names."""
    assert GeoOrigin(0, 0, 0).height_reference is HeightReference.ELLIPSOID
    assert [str(r) for r in HeightReference] == ["ellipsoid", "amsl", "takeoff", "unknown"]
