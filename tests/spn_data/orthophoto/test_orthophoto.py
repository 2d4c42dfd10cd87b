"""The orthophoto shows the ground where it is, and nothing where no frame sees it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from pyproj import Transformer

from spn_data.errors import GeometryError
from spn_data.exports.geotiff import utm_grid, write_geotiff
from spn_data.geometry.camera import Camera, colmap_pixels
from spn_data.geometry.geodesy import GeoOrigin
from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import rotations_from_angles
from spn_data.orthophoto.ground import fit_ground
from spn_data.orthophoto.mosaic import OrthophotoFrames, mosaic
from spn_data.orthophoto.views import ground_views

CAMERA = Camera("RADIAL", 320, 240, np.array([250.0, 161.0, 119.0, -0.06, 0.01]))


def height_of(xy: np.ndarray) -> np.ndarray:
    """Return the true height of the ground: a slope with a gentle hill."""
    return 0.05 * xy[:, 0] + 1.5 * np.exp(-((xy - [8, 8]) ** 2).sum(axis=1) / 80) - 1.0


def colour_of(xy: np.ndarray) -> np.ndarray:
    """Return the true colours (N, 3) of the ground, waves of a few metres."""
    x, y = xy.T
    waves = [np.sin(x * 1.1) + np.cos(y * 0.9), np.sin(y * 1.3), np.cos(x * 0.7 + y)]
    return 128 + 55 * np.stack(waves, axis=1)


def scene_points(rng: np.random.Generator) -> np.ndarray:
    """Return points of a ground, of a house with a flat roof on it, and reflections below it."""
    ground = rng.uniform(-22, 22, (6000, 2))
    ground = ground[~np.all(np.abs(ground - [-8, 0]) < 4, axis=1)]
    wall = np.column_stack([np.full(400, -4.0), rng.uniform(-4, 4, 400), rng.uniform(-1, 5, 400)])
    roof = np.column_stack([rng.uniform([-12, -4], [-4, 4], (600, 2)), np.full(600, 5.0)])
    below = np.column_stack([rng.uniform(-22, 22, (12, 2)), rng.uniform(-6, -4, 12)])
    on_ground = np.column_stack([ground, height_of(ground) + rng.normal(0, 0.03, len(ground))])
    return np.vstack([on_ground, wall, roof, below])


def looking_down(centers: np.ndarray, pitch_deg: float = -60.0) -> Poses:
    """Return poses at centers (N, 3) that look north."""
    angles = np.column_stack(
        [np.zeros(len(centers)), np.full(len(centers), pitch_deg), np.zeros(len(centers))]
    )
    return Poses.from_rotations(centers, rotations_from_angles(angles))


def photo(poses: Poses, row: int) -> np.ndarray:
    """Render what a camera sees of the ground alone, BGR."""
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = CAMERA.unproject(colmap_pixels(np.column_stack([x.ravel(), y.ravel()]).astype(float)))
    world = np.column_stack([rays, np.ones(len(rays))]) @ poses.rotations[row]
    center, length = poses.centers[row], np.full(len(rays), 10.0)
    for _ in range(12):
        at = center + length[:, None] * world
        length = np.where(
            world[:, 2] < -0.05, (height_of(at[:, :2]) - center[2]) / world[:, 2], 1.0
        )
    colours = colour_of((center + length[:, None] * world)[:, :2])
    return np.clip(colours[:, ::-1], 0, 255).round().astype(np.uint8).reshape(240, 320, 3)


@pytest.fixture(scope="module")
def cameras() -> Poses:
    """Return nine poses 14 m above the ground."""
    x, y = np.meshgrid([-14.0, 0.0, 14.0], [-22.0, -8.0, 6.0])
    return looking_down(np.column_stack([x.ravel(), y.ravel(), np.full(9, 14.0)]))


def test_the_ground_is_found_beside_houses_and_above_reflections(cameras: Poses) -> None:
    """Heights agree with the true ground to 0.15 m, also under a roof, which stands on it."""
    ground = fit_ground(scene_points(np.random.default_rng(3)), cameras.centers)
    centers = ground.centers.reshape(-1, 3)
    known = np.isfinite(centers[:, 2]) & (np.abs(centers[:, :2]) < 20).all(axis=1)
    assert known.mean() > 0.5
    off = np.abs(centers[known, 2] - height_of(centers[known, :2]))
    assert np.percentile(off, 95) < 0.15
    row, column, _ = ground.cells_of(np.array([-8.0, 0.0]))
    assert ground.top_m[row, column] == pytest.approx(5.0, abs=0.1)
    assert abs(ground.height_m[row, column] - height_of(np.array([[-8.0, 0.0]]))[0]) < 0.5


def test_a_map_without_ground_has_none(cameras: Poses) -> None:
    """A map of walls alone is refused instead of given a ground."""
    rng = np.random.default_rng(4)
    walls = np.column_stack(
        [rng.uniform(-20, 20, 3000), np.full(3000, 5.0), rng.uniform(0, 9, 3000)]
    )
    with pytest.raises(GeometryError, match="level ground"):
        fit_ground(walls, cameras.centers)


def test_pixels_have_the_colours_of_their_place(cameras: Poses) -> None:
    """Colours agree with the true ground to 4 grey values, and hidden ground is transparent."""
    ground = fit_ground(scene_points(np.random.default_rng(5)), cameras.centers)
    views = ground_views(ground, cameras, {"c": CAMERA}, np.full(9, "c"))
    frames = OrthophotoFrames(cameras, {"c": CAMERA}, np.full(9, "c"), lambda k: photo(cameras, k))
    x, y = np.arange(-15, 15, 0.3), np.arange(18, -10, -0.3)
    xy = np.dstack(np.meshgrid(x, y))
    image = mosaic(ground, views, frames, xy)
    seen = image[..., 3] == 255
    assert 0.6 < seen.mean() < 0.99
    off = np.abs(image[seen][:, :3].astype(float) - colour_of(xy[seen]))
    assert np.percentile(off, 95) < 8
    assert off.mean() < 3
    assert not image[~seen].any()
    under_the_roof = (np.abs(xy - [-8, 0]) < 2.5).all(axis=2)
    assert not seen[under_the_roof].any()
    assert views.count.max() > 1
    assert (views.best[views.count == 0] == -1).all()


def test_masked_parts_of_an_image_are_transparent(cameras: Poses) -> None:
    """A frame whose mask excludes everything leaves its cells transparent."""
    ground = fit_ground(scene_points(np.random.default_rng(5)), cameras.centers)
    views = ground_views(ground, cameras, {"c": CAMERA}, np.full(9, "c"))
    empty = np.dstack([np.full((240, 320, 3), 90, np.uint8), np.zeros((240, 320), np.uint8)])
    frames = OrthophotoFrames(cameras, {"c": CAMERA}, np.full(9, "c"), lambda _: empty)
    xy = np.dstack(np.meshgrid(np.arange(-5, 5, 0.5), np.arange(5, -5, -0.5)))
    assert not mosaic(ground, views, frames, xy).any()


@pytest.mark.parametrize(("lat", "lon", "epsg"), [(49.0, 8.4, 32632), (-33.9, 18.4, 32734)])
def test_the_tags_place_each_pixel(tmp_path: Path, lat: float, lon: float, epsg: int) -> None:
    """A point of the local frame lies, by the tags of the file, on the pixel drawn for it, to 1 mm."""
    origin = GeoOrigin(lat, lon, 110.0)
    grid = utm_grid(origin, np.array([-40.0, -30.0]), np.array([50.0, 45.0]), -2.0, 0.5)
    image = np.full((*grid.xy.shape[:2], 4), 255, np.uint8)
    image[:5] = 0
    write_geotiff(tmp_path / "o.tif", image, grid, "test")
    with Image.open(tmp_path / "o.tif") as read:
        tags = dict(read.tag_v2)
        assert np.array_equal(np.array(read), image)
    keys = np.array(tags[34735]).reshape(-1, 4)[1:]
    assert {int(k): int(v) for k, where, _, v in keys if where == 0} == {
        1024: 1,
        1025: 1,
        3072: epsg,
    }
    assert grid.epsg == epsg
    scale, tie = tags[33550], tags[33922]
    assert scale[:2] == (0.5, 0.5)
    assert tie[:3] == (0, 0, 0)
    to_utm = Transformer.from_crs(4326, epsg, always_xy=True)
    for row, column in ((0, 0), (100, 20), (image.shape[0] - 1, image.shape[1] - 1)):
        here = origin.wgs84_from_enu(np.array([[*grid.xy[row, column], -2.0]]))[0]
        east, north = to_utm.transform(here[1], here[0])
        assert east == pytest.approx(tie[3] + scale[0] * (column + 0.5), abs=1e-3)
        assert north == pytest.approx(tie[4] - scale[1] * (row + 0.5), abs=1e-3)
    assert grid.xy[..., 0].min() < -39
    assert grid.xy[..., 0].max() > 49


def test_utm_ends_before_the_poles() -> None:
    """North of 84 degrees the export is refused."""
    with pytest.raises(GeometryError, match="UTM is not defined"):
        utm_grid(GeoOrigin(85.0, 8.0, 0.0), np.zeros(2), np.ones(2), 0.0, 0.1)
