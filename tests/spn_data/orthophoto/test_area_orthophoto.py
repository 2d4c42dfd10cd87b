"""The orthophoto of an area is drawn from the stored images of its mapping frames."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from spn_data.area.area import Area
from spn_data.area.names import GROUND
from spn_data.errors import GeometryError, InputError, StageError
from spn_data.exports.exported_frames import ExportedFrames
from spn_data.inputs.area_labels import LabelledArea, read_labelled_area
from spn_data.labels.map_points import MapPoints
from spn_data.pipeline import area_ground
from spn_data.pipeline.area_export import select_frames
from spn_data.pipeline.area_ground import ground_of
from spn_data.pipeline.area_orthophoto import NoOrthophotoError, ground_texture, write_orthophoto


@pytest.fixture(scope="module")
def labelled(finished_area: Path) -> LabelledArea:
    """Return a reconstructed area, with points on level ground 3 m below its cameras instead of its own."""
    found = read_labelled_area(Area(finished_area))
    centers = found.mapping.poses.centers[found.mapping.registered]
    east, north = np.meshgrid(np.arange(-15, 15, 0.25), np.arange(-15, 15, 0.25))
    xy = centers[:, :2].mean(axis=0) + np.column_stack([east.ravel(), north.ravel()])
    xyz = np.column_stack([xy, np.full(len(xy), centers[:, 2].min() - 3.0)])
    n = len(xyz)
    points = MapPoints(np.arange(n), xyz, np.zeros((n, 3), np.uint8), np.full(n, 3))
    return replace(found, points=points)


@pytest.fixture(scope="module")
def frames(labelled: LabelledArea) -> ExportedFrames:
    """Return its frames as an export gets them."""
    return select_frames(labelled, ())


def test_an_orthophoto_is_written_and_described(
    finished_area: Path, frames: ExportedFrames, tmp_path: Path
) -> None:
    """File and description agree in size, share and place, and the notes say what is not rectified."""
    written = write_orthophoto(Area(finished_area), tmp_path, frames)
    with Image.open(tmp_path / "orthophoto.tif") as image:
        assert image.size == written.size_px
        assert tuple(image.tag_v2[33922][3:5]) == written.upper_left_m
        pixels = np.array(image)
    opaque = pixels[..., 3] > 0
    assert opaque.mean() == pytest.approx(written.opaque_share, abs=1e-3)
    assert 0.05 < written.opaque_share < 1
    assert pixels[opaque].std(axis=0)[:3].min() > 5  # not one colour
    assert written.relief_displacement_m == (0.0, 0.0)
    assert "what stands on it is displaced" in " ".join(written.notes())


def test_the_texture_is_small_and_lies_on_the_ground(
    finished_area: Path, labelled: LabelledArea
) -> None:
    """The texture has at most 1024 pixels a side, the shape of its corners, and transparent parts."""
    texture = ground_texture(Area(finished_area), labelled)
    assert texture is not None
    image = cv2.imdecode(np.frombuffer(texture.webp, np.uint8), cv2.IMREAD_UNCHANGED)
    height, width = image.shape[:2]
    assert max(height, width) == 1024
    assert image.shape[2] == 4
    (west, south), (east, north) = texture.low, texture.high
    assert width / height == pytest.approx((east - west) / (north - south), rel=0.01)
    assert 0.05 < (image[..., 3] > 127).mean() < 1
    assert texture.up_m == pytest.approx(float(labelled.points.xyz[0, 2]), abs=0.01)


def test_the_ground_of_the_page_is_drawn_once(
    finished_area: Path, tmp_path: Path, labelled: LabelledArea, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is taken from the cache until that is damaged; a place without ground has a note instead."""
    area = shutil.copytree(finished_area, tmp_path / "area")
    (area / GROUND).unlink(missing_ok=True)
    monkeypatch.setattr(area_ground, "read_labelled_area", lambda _: labelled)
    first, note = ground_of(Area(area))
    assert first is not None
    assert note == ""
    monkeypatch.setattr(area_ground, "ground_texture", lambda *_: None)
    again, _ = ground_of(Area(area))
    assert again is not None
    assert again.to_json() == first.to_json()
    (area / GROUND).write_text((area / GROUND).read_text().replace('"UklGR', '"AAAAA'))
    for _ in range(2):
        assert ground_of(Area(area)) == (None, "The ground is not drawn: no frame shows it.")


def test_what_has_no_orthophoto_is_refused(
    finished_area: Path, frames: ExportedFrames, tmp_path: Path
) -> None:
    """Without place, mapping frames, ground or an image there is an error and no file."""
    area = Area(finished_area)
    wall = replace(frames.points, xyz=frames.points.xyz[:, [0, 2, 1]])
    everything = np.ones(len(frames), bool)
    for changed, error, words in (
        (replace(frames, origin=None), StageError, "GeoTIFF needs a georegistered map"),
        (replace(frames, is_evaluation=everything), NoOrthophotoError, "none is selected"),
        (replace(frames, points=wall), GeometryError, "ground"),
    ):
        with pytest.raises(error, match=words):
            write_orthophoto(area, tmp_path, changed)
    renamed = np.char.replace(frames.labels.names, ".jpg", ".gone.jpg")
    with pytest.raises(InputError, match="missing or cannot be decoded"):
        write_orthophoto(
            area, tmp_path, replace(frames, labels=replace(frames.labels, names=renamed))
        )
    assert not list(tmp_path.iterdir())
