"""Tests of the coordinate systems of surveyed points; no grid is downloaded."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from spn_data.errors import InputError
from spn_data.geometry.geodesy import ECCENTRICITY_2, SEMI_MAJOR_M, HeightReference
from spn_data.ground_control.control_file import ControlFile, SurveyedPoint
from spn_data.ground_control.coordinates import SurveyedPositions, surveyed_positions


def positions(
    crs: str,
    east: float,
    north: float,
    height: float = 210.0,
    wanted: HeightReference | None = None,
) -> SurveyedPositions:
    point = SurveyedPoint("A", east, north, height, 2)
    return surveyed_positions(ControlFile(Path("gcp.txt"), crs, (point,)), wanted)


def northing_m(lat_deg: float) -> float:
    """Return the northing on the central meridian of a UTM zone: 0.9996 of the arc of the meridian."""
    lat = np.linspace(0, np.deg2rad(lat_deg), 200_001)
    middle = (lat[1:] + lat[:-1]) / 2
    radius = SEMI_MAJOR_M * (1 - ECCENTRICITY_2) / (1 - ECCENTRICITY_2 * np.sin(middle) ** 2) ** 1.5
    return float(0.9996 * (radius * np.diff(lat)).sum())


@pytest.mark.parametrize(
    ("crs", "reference"),
    [
        ("EPSG:32632", HeightReference.UNKNOWN),
        ("WGS84 UTM 32N", HeightReference.UNKNOWN),
        ("+proj=utm +zone=32 +datum=WGS84 +units=m +no_defs", HeightReference.UNKNOWN),
        ("EPSG:25832+7837", HeightReference.AMSL),
        ("epsg:32632+5773", HeightReference.AMSL),
    ],
)
def test_systems_are_told_as_codes_zones_or_proj_strings(
    crs: str, reference: HeightReference
) -> None:
    """All ways of naming zone 32 give the same place, and a vertical datum is above sea level."""
    found = positions(crs, 500_000.0, northing_m(48.5))
    assert found.lat_lon_deg[0] == pytest.approx([48.5, 9.0], abs=1e-8)
    assert (found.height_m[0], found.reference) == (210.0, reference)


def test_feet_become_metres_and_three_dimensions_are_above_the_ellipsoid() -> None:
    """Heights in US survey feet are converted; EPSG:4979 is above the ellipsoid."""
    feet = positions("EPSG:6318+6360", -74.0, 40.7, 1000.0)
    assert feet.height_m[0] == pytest.approx(304.8006, abs=1e-4)
    assert feet.reference is HeightReference.AMSL
    assert positions("EPSG:4979", 9.0, 48.5).reference is HeightReference.ELLIPSOID
    assert positions("EPSG:4326", 9.0, 48.5, wanted=HeightReference.AMSL).reference == "amsl"


@pytest.mark.parametrize(
    ("crs", "east", "north", "message"),
    [
        ("EPSG:4326", 9.0, 148.5, r"gcp.txt:2: point 'A': the latitude is 148.5 \(it looks as if"),
        ("EPSG:32632", 5_371_830.0, 500_000.0, "it looks as if east and north are swapped"),
        ("EPSG:2056", 1_200_000.0, 2_600_000.0, "it looks as if east and north are swapped"),
        ("EPSG:2056", 500_000.0, 5_371_830.0, "is this the right zone and system"),
        ("EPSG:9999999", 0, 0, "is not a coordinate system"),
        ("EPSG:99999", 0, 0, "is not a coordinate system"),
        ("nonsense", 0, 0, "is not a coordinate system"),
        ("+proj=utm +zone=32 +nadgrids=/etc/passwd", 0, 0, "is not a coordinate system"),
        ("+proj=pipeline +step +proj=utm +zone=32", 0, 0, "is not a coordinate system"),
        ("http://example.org/x", 0, 0, "is not a coordinate system"),
        ("EPSG:7837", 0, 0, r"only a vertical datum.*EPSG:32632\+7837"),
        ("EPSG:4978", 1, 1, "neither geographic nor projected"),
        ("EPSG:31467", 3_500_000.0, 5_372_000.0, "pyproj sync --file de_adv_BETA2007.tif"),
    ],
)
def test_mistakes_are_refused_with_what_to_do(
    crs: str, east: float, north: float, message: str
) -> None:
    """Swapped axes, unknown systems and missing grids are named."""
    with pytest.raises(InputError, match=message):
        positions(crs, east, north)


def test_heights_above_the_ellipsoid_need_the_grid_of_their_datum() -> None:
    """Without its geoid grid a datum is not converted, in neither direction."""
    with pytest.raises(InputError, match=r"de_bkg_gcg2016\.tif, which is not installed"):
        positions("EPSG:25832+7837", 500_000.0, 5_371_830.0, wanted=HeightReference.ELLIPSOID)
    with pytest.raises(InputError, match="above the ellipsoid, but heights above 'amsl'"):
        positions("EPSG:4979", 9.0, 48.5, wanted=HeightReference.AMSL)
    assert np.isnan(positions("EPSG:4979", 9.0, 48.5, float("nan")).height_m[0])
