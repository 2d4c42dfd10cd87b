"""Tests of the heights and accuracies of fixes in the local frame of an origin."""

from __future__ import annotations

import numpy as np
import pytest

from spn_data.geometry.geodesy import GeoOrigin, HeightReference
from spn_data.georegistration.georegister_options import GeoregisterOptions, Heights
from spn_data.georegistration.observe import align_telemetry, observe
from spn_data.telemetry.track import Telemetry

ORIGIN = GeoOrigin(49.0, 8.4, 100.0, HeightReference.AMSL)


def up_m(options: GeoregisterOptions) -> list[float]:
    """Return the up coordinates of two fixes at the origin, 10 m and 20 m above a take-off at 112 m."""
    telemetry = Telemetry.from_columns(
        np.arange(2.0),
        lat_lon_deg=np.full((2, 2), [ORIGIN.lat_deg, ORIGIN.lon_deg]),
        rel_alt_m=np.array([10.0, 20.0]),
        abs_alt_m=np.array([122.0, 132.0]),
        abs_reference=HeightReference.AMSL,
    )
    fixes = observe(telemetry, ["flight"] * 2, telemetry.time_s, options)
    return list(fixes.enu_m[:, 2])


def test_a_take_off_above_a_kept_origin_lifts_the_fixes() -> None:
    """A take-off at 112 m, with the origin kept at 100 m, adds 12 m to heights above take-off."""
    options = GeoregisterOptions(
        origin=ORIGIN,
        heights=Heights.RELATIVE,
        takeoff_alt_m=112.0,
        height_reference=HeightReference.AMSL,
    )
    assert up_m(options) == pytest.approx([22.0, 32.0], abs=1e-6)


def test_absolute_heights_count_from_a_kept_origin() -> None:
    """Fixes at 122 m and 132 m are 22 m and 32 m above an origin kept at 100 m."""
    options = GeoregisterOptions(origin=ORIGIN, heights=Heights.ABSOLUTE)
    assert up_m(options) == pytest.approx([22.0, 32.0], abs=1e-6)


def test_a_default_sigma_grows_between_distant_fixes() -> None:
    """The default sigma is larger between fixes 5 s apart than at a fix."""
    time_s = np.arange(0.0, 21.0, 5.0)
    flight = Telemetry.from_columns(time_s, lat_lon_deg=np.full((5, 2), 45.0), kind="gpx")
    rows = align_telemetry({"a": flight}, ["a"] * 2, np.array([5.0, 7.5]))
    np.testing.assert_allclose(rows.sigma_m[:, 0], [2.0, np.hypot(2.0, 1.5625)])
