"""Waypoint heights in an area whose origin is not at the take-off point."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from spn_data.area.area import Area
from spn_data.area.names import GEO
from spn_data.geometry.geodesy import GeoOrigin, HeightReference
from spn_data.geometry.pose import Poses
from spn_data.georegistration.georegister_options import GeoregisterOptions
from spn_data.inputs.area_labels import LabelledArea
from spn_data.labels.labels import LabelObservations, Labels
from spn_data.labels.map_points import MapPoints
from spn_data.pipeline.area_coverage import _waypoint_frame
from spn_data.pipeline.geo_stage import GeoStageOptions
from spn_data.storage.json_files import VERSION, write_json
from spn_data.storage.stage_record import StageRecord


def labelled(origin: GeoOrigin) -> LabelledArea:
    """Return an area in metres about an origin, without a frame."""
    none, text = np.empty(0), np.empty(0, np.str_)
    labels = Labels(
        names=text,
        sequences=text,
        cameras=text,
        sources=text,
        video_frame=none,
        tracked=none,
        time_s=none,
        status=text,
        reason=text,
        poses=Poses(np.empty((0, 3)), np.empty((0, 4))),
        covariance=np.empty((0, 6, 6)),
        inliers=none,
        coverage=none,
        error_px=none,
    )
    points = MapPoints(none, np.empty((0, 3)), np.empty((0, 3), np.uint8), none)
    seen = LabelObservations(none, none, np.empty((0, 2)))
    return LabelledArea("m", origin, points, {}, labels, seen, labels, seen, {}, {})


@pytest.mark.parametrize(
    ("reference", "takeoff_up_m"), [(HeightReference.AMSL, 12.0), (HeightReference.ELLIPSOID, None)]
)
def test_a_take_off_above_the_origin_is_that_much_up(
    tmp_path: Path, reference: HeightReference, takeoff_up_m: float | None
) -> None:
    """A take-off at 112 m is 12 m above an origin at 100 m, and unknown if the references differ."""
    options = GeoStageOptions(
        fit=GeoregisterOptions(takeoff_alt_m=112.0, height_reference=reference)
    )
    (tmp_path / GEO).mkdir()
    record = StageRecord(stage=GEO, options=asdict(options), inputs={}, upstream={})
    write_json(tmp_path / GEO / "stage.json", {"version": VERSION, **asdict(record)})
    origin = GeoOrigin(49.0, 8.4, 100.0, HeightReference.AMSL)
    place = _waypoint_frame(Area(tmp_path), labelled(origin))
    assert place is not None
    assert place.takeoff_up_m == takeoff_up_m
