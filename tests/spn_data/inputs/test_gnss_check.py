"""Comparison of labels with the independent GNSS fixes of their flight."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from spn_data.geometry.geodesy import HeightReference
from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import rotations_from_angles
from spn_data.georegistration.result import GeoFit
from spn_data.inputs.gnss_check import GnssCheck, check_gnss, focal_witness_notes
from spn_data.labels.labels import Labels, LabelStatus
from spn_data.telemetry.track import Telemetry
from tests.worlds.report_data import geo_fit

N = 60
TIMES = np.arange(N) * 0.5


def positions(time_s: np.ndarray) -> np.ndarray:
    """Return the positions (N, 3) of a winding flight."""
    return np.column_stack(
        [12 * np.sin(0.3 * time_s), 9 * np.cos(0.17 * time_s), 8 + 2 * np.sin(0.23 * time_s)]
    )


def labelled(failed: int = 0) -> Labels:
    has = np.arange(N) >= failed
    poses = Poses.from_rotations(
        positions(TIMES), rotations_from_angles(np.tile([20.0, -30, 0], (N, 1)))
    )
    return Labels(
        names=np.array([f"low/{k:06d}.jpg" for k in range(N)]),
        sequences=np.full(N, "low"),
        cameras=np.full(N, "low"),
        sources=np.full(N, "low.mp4"),
        video_frame=np.arange(N),
        tracked=np.zeros(N, bool),
        time_s=TIMES,
        status=np.where(has, LabelStatus.REGISTERED.value, LabelStatus.FAILED.value),
        reason=np.where(has, "", "no feature"),
        poses=Poses(
            np.where(has[:, None], poses.centers, np.nan),
            np.where(has[:, None], poses.quats_wxyz, np.nan),
        ),
        covariance=np.full((N, 6, 6), np.nan),
        inliers=np.full(N, 100),
        coverage=np.full(N, 0.5),
        error_px=np.full(N, 0.4),
    )


def track(
    geo: GeoFit, offset_m: tuple[float, float, float], *, late_s: float = 0.0, kind: str = "dji-srt"
) -> Telemetry:
    """Return fixes at 10 Hz with a constant offset from the flight and a clock `late_s` behind."""
    time_s = np.arange(-20, 10 * N) * 0.1
    rng = np.random.default_rng(4)
    enu = positions(time_s + late_s) + offset_m + rng.normal(0, 0.05, (len(time_s), 3))
    lat_lon_alt = geo.origin.wgs84_from_enu(enu)
    return Telemetry.from_columns(
        time_s,
        lat_lon_deg=lat_lon_alt[:, :2],
        abs_alt_m=lat_lon_alt[:, 2],
        abs_reference=HeightReference.ELLIPSOID,
        kind=kind,
    )


def check(labels: Labels, telemetry: Telemetry, geo: GeoFit) -> GnssCheck:
    found = check_gnss(labels, telemetry, geo)
    assert found is not None
    return found


def test_a_shared_offset_is_told_apart_from_scatter() -> None:
    """An offset of 1 m east and 0.5 m down is separated from centimetre noise and is no contradiction."""
    geo = geo_fit(3)
    found = check(labelled(), track(geo, (1.0, 0.0, -0.5)), geo)
    assert (found.offset_e_m, found.offset_n_m) == pytest.approx((1.0, 0.0), abs=0.05)
    assert found.offset_u_m == pytest.approx(-0.5, abs=0.05)
    assert 0.01 < found.scatter_h_m < 0.2
    assert found.fixes == N
    assert not found.contradicts
    assert "1.0" in found.describe()
    assert "-0.5" in found.describe()


def test_an_offset_beyond_what_gnss_can_err_is_a_contradiction() -> None:
    """An offset of 30 m, horizontal or vertical, exceeds GNSS error and is a contradiction."""
    geo = geo_fit(3)
    for offset in ((30.0, 0.0, 0.0), (0.0, 0.0, 30.0)):
        found = check(labelled(), track(geo, offset), geo)
        assert found.contradicts
        assert "exceeds the uncertainty of georegistration and GNSS" in found.describe()


def test_frames_at_a_place_that_looks_alike_are_counted() -> None:
    """Five labels in a row, 37 m from their fixes, are counted; two in a row are outliers of the receiver."""
    geo = geo_fit(3)
    labels = labelled()
    assert check(labels, track(geo, (0.5, 0.0, 0.0)), geo).far == 0
    labels.poses.centers[20:25, 0] += 37.0
    labels.poses.centers[30:32, 0] += 37.0
    found = check(labels, track(geo, (0.5, 0.0, 0.0)), geo)
    assert found.far == 5
    assert "5 of its frames are more than" in found.describe()


def test_a_clock_that_is_behind_is_no_scatter() -> None:
    """A clock 0.6 s behind is estimated as a time offset and does not count as scatter."""
    geo = geo_fit(3)
    found = check(labelled(), track(geo, (0.0, 0.0, 0.0), late_s=0.6), geo)
    assert found.time_offset_s == pytest.approx(0.6, abs=0.1)
    assert found.scatter_h_m < 0.2


def test_heights_that_count_from_elsewhere_are_not_compared() -> None:
    """Fixes above sea level and an area above the ellipsoid are compared horizontally only."""
    geo = geo_fit(3)
    amsl = replace(track(geo, (0.5, 0.0, 40.0)), abs_reference=HeightReference.AMSL)
    found = check(labelled(), amsl, geo)
    assert found.offset_u_m is None
    assert found.scatter_v_m is None
    assert not found.contradicts
    assert "no height to compare" in found.describe()


def test_heights_above_take_off_count_from_the_origin() -> None:
    """Fixes 0.5 m too low show as -0.5 m, also if the origin is at a height of 115 m."""
    geo = geo_fit(3)
    origin = replace(geo.origin, height_reference=HeightReference.TAKEOFF)
    absolute = track(geo, (0.0, 0.0, -0.5))
    above = replace(
        absolute,
        rel_alt_m=absolute.abs_alt_m - origin.alt_m,
        abs_alt_m=np.full(len(absolute), np.nan),
    )
    found = check(labelled(), above, replace(geo, origin=origin))
    assert found.offset_u_m == pytest.approx(-0.5, abs=0.05)
    assert not found.contradicts


def test_too_few_labels_or_fixes_are_no_check() -> None:
    """With only a few labels, or without fixes, no comparison is made."""
    geo = geo_fit(3)
    telemetry = track(geo, (0.0, 0.0, 0.0))
    assert check_gnss(labelled(failed=N - 4), telemetry, geo) is None
    blind = replace(telemetry, lat_lon_deg=np.full((len(telemetry.time_s), 2), np.nan))
    assert check_gnss(labelled(), blind, geo) is None


def test_a_known_clock_is_not_estimated_again() -> None:
    """With a time offset that the user gave, late fixes are compared as they are."""
    geo = geo_fit(3)
    found = check_gnss(labelled(), track(geo, (0.0, 0.0, 0.0), late_s=0.6), geo, time_is_known=True)
    assert found is not None
    assert found.time_offset_s == 0


def test_heights_of_a_flight_are_a_witness_of_the_maps_focal_length():
    """Labels 2.4 m above their fixes at 60 m make a doubtful focal length 4 % too short."""
    check = GnssCheck(
        fixes=90,
        time_offset_s=0.0,
        offset_e_m=0.0,
        offset_n_m=0.0,
        offset_u_m=-2.4,
        scatter_h_m=0.3,
        scatter_v_m=0.3,
        max_h_m=1.0,
        far=0,
        far_limit_m=10.0,
        sigma_h_m=1.4,
        sigma_v_m=1.2,
        contradicts=False,
    )
    (note,) = focal_witness_notes(check, 60.0, 0.015, 0.065)
    assert "make it 4.0% too short (sigma 2.5%), which agrees with that" in note
    (note,) = focal_witness_notes(replace(check, offset_u_m=9.0), 60.0, 0.0, 0.02)
    assert "15.0% too long (sigma 2.0%), which contradicts that" in note
    assert focal_witness_notes(check, 60.0, 0.015, 0.002) == []
    assert focal_witness_notes(replace(check, offset_u_m=None), 60.0, 0.015, 0.065) == []
