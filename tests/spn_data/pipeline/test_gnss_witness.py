"""GNSS as a witness of focal lengths, and doubts about them, in the folders of an area."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from spn_data.area.area import Area, StageWork
from spn_data.area.names import FRAMES, FRAMES_TABLE, MODEL, TELEMETRY
from spn_data.capture.frames import Frames, write_frames
from spn_data.geometry.geodesy import GeoOrigin
from spn_data.geometry.initial_lens import Hold, InitialLens
from spn_data.inputs.lens_file import map_lens_priors, write_lenses
from spn_data.pipeline.geo_stage import GeoStageOptions
from spn_data.pipeline.gnss_witness import focal_lengths_by_gnss
from spn_data.pipeline.model_stage import frames_to_map
from spn_data.telemetry.table import write_track
from spn_data.telemetry.track import Telemetry
from tests.spn_data.uncertainty.test_focal_changes import made, told
from tests.spn_data.uncertainty.test_lens_errors import MODEL as LENS

METRES = 20.0  # a unit of the model


def area_with(folder: Path, spread: float, counts: dict[str, object]) -> tuple[Area, Frames]:
    """Write an area whose photos have fixes at the model's cameras, drawn together by a factor."""
    scene = made().scene
    n = len(scene.names)
    rng = np.random.default_rng(3)
    enu_m = spread * METRES * scene.poses.centers + rng.normal(0, 0.2, (n, 3))
    lat_lon_alt = GeoOrigin(48.0, 9.0, 100.0).wgs84_from_enu(enu_m)
    text, nan = np.full(n, "a"), np.full(n, np.nan)
    frames = Frames(
        names=np.array(scene.names),
        **dict.fromkeys(("sequences", "cameras", "sources", "reason"), text),
        video_frame=np.full(n, -1),
        time_s=20.0 * np.arange(n),
        status=np.full(n, "chosen"),
        **dict.fromkeys(("sharpness", "motion_px", "rel_alt_m"), nan),
        width=np.full(n, LENS.width),
        height=np.full(n, LENS.height),
        lat_lon_deg=lat_lon_alt[:, :2],
        abs_alt_m=lat_lon_alt[:, 2],
        **dict.fromkeys(("sigma_m", "gimbal_deg"), np.full((n, 3), np.nan)),
    )
    area = Area(folder)
    work = area.begin(FRAMES, {}, {}, overwrite=False)
    assert isinstance(work, StageWork)
    write_frames(work.path / FRAMES_TABLE, frames)
    write_lenses(work.path, {"a": InitialLens(LENS, 0.01, "test", Hold.FOCAL)})
    (work.path / TELEMETRY).mkdir()
    track = Telemetry.from_columns(
        frames.time_s, lat_lon_deg=frames.lat_lon_deg, abs_alt_m=frames.abs_alt_m, kind="exif"
    )
    write_track(work.path / TELEMETRY / "a.csv", track)
    work.finish(counts={}, seconds={}, cpu_seconds={})
    work = area.begin(MODEL, {}, {}, overwrite=False)
    assert isinstance(work, StageWork)
    work.finish(counts=counts, seconds={}, cpu_seconds={})
    return area, frames


def test_gnss_tells_the_focal_length_of_a_georegistered_model(tmp_path: Path) -> None:
    """Within two sigma it says 500 px, and a unit of the model is 20 m, within 2 %."""
    area, frames = area_with(tmp_path, 1.0, {})
    said, metres = focal_lengths_by_gnss(
        area, made().scene, told(), frames_to_map(area, frames), GeoStageOptions(), lambda *_: None
    )
    assert metres == pytest.approx(METRES, rel=0.02)
    assert abs(said["a"].focal_px - 500.0) < 2 * said["a"].sigma_px
    assert said["a"].sigma_px < 0.3 * 500.0


def test_fixes_that_cannot_be_fitted_say_nothing_and_lose_no_model(tmp_path: Path) -> None:
    """Photos of a hovering drone give no statement instead of an error."""
    area, frames = area_with(tmp_path, 1e-4, {})
    said, metres = focal_lengths_by_gnss(
        area, made().scene, told(), frames_to_map(area, frames), GeoStageOptions(), lambda *_: None
    )
    assert said == {}
    assert np.isnan(metres)


def test_a_doubt_of_the_model_stage_reaches_the_covariance_of_later_sequences(
    tmp_path: Path,
) -> None:
    """What stage.json doubts is part of what is known of the lens; without it nothing is doubted."""
    scene = made().scene
    lens = {"focal_px": 500.0, "fov_deg": 65.0, "focal_doubt_px": 12.5}
    area, _ = area_with(tmp_path / "doubted", 1.0, {"cameras": {"a": lens}})
    assert map_lens_priors(area, scene)[1].focal_doubt_px == 12.5
    assert map_lens_priors(area, scene)[1].focal_sigma_px == pytest.approx(5.0)
    del lens["focal_doubt_px"]
    area, _ = area_with(tmp_path / "earlier", 1.0, {"cameras": {"a": lens}})
    assert map_lens_priors(area, scene)[1].focal_doubt_px == 0.0
