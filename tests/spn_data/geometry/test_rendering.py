"""Tests that rendered images agree with projection: no shift, empty border or aliasing."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from spn_data.errors import GeometryError
from spn_data.geometry.camera import Camera
from spn_data.geometry.rendering import (
    PinholeRenderer,
    RenderingOptions,
    canonical_camera,
    undistorted_camera,
)
from spn_data.geometry.rotations import rotations_from_angles
from spn_data.simulate.place import SceneOptions
from spn_data.simulate.render import SceneRenderer as Simulator
from spn_data.simulate.scene import build_scene, paint_all

MAPPING = Camera("OPENCV", 1280, 720, np.array([880.9, 881.5, 645, 356, -0.12, 0.03, 1e-3, -5e-4]))
SLANTED = Camera("SIMPLE_RADIAL", 1280, 720, np.array([930.0, 620.0, 371.0, -0.06]))
NARROW = Camera("SIMPLE_RADIAL", 960, 540, np.array([1000.0, 480.0, 270.0, 0.02]))
SMALL = RenderingOptions()


def rays_of(target: Camera, step: float = 1.0) -> np.ndarray:
    """Return the rays (N, 3) of a pinhole camera's image border."""
    x, y = np.arange(0, target.width + step, step), np.arange(0, target.height + step, step)
    edge = [
        *((a, b) for a in x for b in (0, target.height)),
        *((a, b) for b in y for a in (0, target.width)),
    ]
    rays = target.unproject(np.array(edge, dtype=np.float64))
    return np.column_stack([rays, np.ones(len(rays))])


def shift_px(found: np.ndarray, wanted: np.ndarray, block: int = 90) -> np.ndarray:
    """Return the least-squares shift (B, 2) between blocks of two images, skipping blocks without texture."""
    a, b = (cv2.GaussianBlur(np.asarray(i, np.float64), (0, 0), 1.0) for i in (found, wanted))
    gy, gx = np.gradient(b)
    shifts = []
    for row in range(0, b.shape[0] - block + 1, block):
        for column in range(0, b.shape[1] - block + 1, block):
            part = np.s_[row : row + block, column : column + block]
            slope = np.stack([gx[part].ravel(), gy[part].ravel()], axis=1)
            if np.linalg.eigvalsh(slope.T @ slope)[0] > block**2:
                solved = np.linalg.lstsq(slope, (b - a)[part].ravel(), rcond=None)
                shifts.append(solved[0])
    return np.array(shifts)


@pytest.mark.parametrize("others", [[], [SLANTED]])
def test_the_canonical_camera_has_no_empty_border_and_is_as_wide_as_can_be(others):
    """The canonical border is inside every mapping image, but not with a 0.1 % shorter focal length."""
    cameras = [MAPPING, *others]
    target = canonical_camera(cameras, SMALL)
    assert (target.width, target.height) == (480, 270)
    assert target.model == "SIMPLE_PINHOLE"
    assert target.params[1:].tolist() == [240.0, 135.0]
    wider = Camera("SIMPLE_PINHOLE", 480, 270, target.params * [0.999, 1, 1])
    outside = []
    for view in (target, wider):
        pixels = [c.project(rays_of(view)) / [c.width, c.height] for c in cameras]
        outside.append(max(np.abs(np.concatenate(pixels) - 0.5).max() - 0.5, 0.0))
    assert outside[0] < 1e-6
    assert outside[1] > 1e-5
    assert all(PinholeRenderer(camera, target).all_valid for camera in cameras)
    assert not all(PinholeRenderer(camera, wider).all_valid for camera in cameras)


def test_a_pinhole_keeps_its_whole_view():
    """A centred pinhole is not cropped: its focal length is only scaled."""
    camera = Camera.from_horizontal_fov(1280, 720, 72.0)
    target = canonical_camera([camera], RenderingOptions(width_px=320))
    assert (target.width, target.height) == (320, 180)
    assert target.params[0] == pytest.approx(camera.params[0] / 4, rel=1e-12)


def test_the_undistorted_camera_keeps_the_images_size():
    """The undistorted camera keeps the image size, with a centred principal point."""
    target = undistorted_camera(SLANTED)
    assert (target.width, target.height) == (1280, 720)
    assert target.params[1:].tolist() == [640.0, 360.0]
    assert PinholeRenderer(SLANTED, target).all_valid


def test_an_axis_outside_the_image_is_refused():
    """A camera whose principal point is outside the image is refused."""
    camera = Camera("SIMPLE_PINHOLE", 640, 480, np.array([500.0, -20.0, 240.0]))
    with pytest.raises(GeometryError, match="principal point is outside"):
        canonical_camera([camera], SMALL)


def test_a_lens_model_that_folds_back_is_not_followed_past_the_fold():
    """Rays that strong barrel distortion folds back into the image are invalid and limit the view."""
    camera = Camera("RADIAL", 640, 480, np.array([300.0, 320.0, 240.0, -0.35, 0.0]))
    fold = np.sqrt(1 / (3 * 0.35))
    target = canonical_camera([camera], RenderingOptions(width_px=320))
    assert np.linalg.norm(target.unproject(np.zeros((1, 2)))) <= fold * (1 + 1e-9)
    beyond = Camera("SIMPLE_PINHOLE", 320, 240, np.array([80.0, 160.0, 120.0]))
    valid = PinholeRenderer(camera, beyond).valid
    radius = np.hypot(*np.meshgrid((np.arange(320) - 159.5) / 80, (np.arange(240) - 119.5) / 80))
    assert valid[120, 160]
    assert not valid[radius > fold].any()


@pytest.fixture(scope="module")
def place():
    built = build_scene(SceneOptions(seed=2, texels_per_m=40.0))
    return built.faces, paint_all(built)


@pytest.mark.parametrize("camera", [MAPPING, SLANTED], ids=["mapping", "slanted"])
def test_rendering_agrees_with_the_simulators_projection(place, camera):
    """An undistorted simulated image is aligned with the same view simulated by the pinhole.

    The tolerance is 0.02 px everywhere; the simulator has no undistortion code. An error of half a source
    pixel would shift it by 0.19 px.
    """
    target = canonical_camera([MAPPING, SLANTED], SMALL)
    center, rotation = np.array([2.0, -8.0, 6.0]), rotations_from_angles(np.array([20.0, -12, 3]))
    taken = Simulator(*place, camera).render(center, rotation)
    wanted = Simulator(*place, target).render(center, rotation)
    found = PinholeRenderer(camera, target).render(taken)
    assert found.dtype == np.uint8
    assert found.shape == wanted.shape == (270, 480, 3)
    shifts = shift_px(found.mean(axis=2), wanted.mean(axis=2))
    assert len(shifts) >= 9
    assert np.abs(shifts).max() < 0.02
    assert np.abs(found.astype(float) - wanted).mean() < 3.0


def test_what_is_finer_than_a_pixel_is_averaged_away():
    """Stripes of 1.25 output pixels keep under 30 % contrast; nearest sampling would keep it all."""
    camera = Camera.from_horizontal_fov(1280, 720, 72.0)
    target = canonical_camera([camera], SMALL)
    x, y = np.meshgrid(np.arange(1280) + 0.5, np.arange(720) + 0.5)

    def contrast(period_out_px: float) -> float:
        period = period_out_px * 1280 / 480
        stripes = 127 + 100 * np.cos(2 * np.pi * (0.8 * x + 0.6 * y) / period)
        found = PinholeRenderer(camera, target).render(np.round(stripes).astype(np.uint8))
        return float(np.sqrt(2) * found[10:-10, 10:-10].std() / 100)

    assert contrast(10) > 0.97
    assert contrast(2.5) > 0.7
    assert contrast(1.25) < 0.3
    assert contrast(1.0) < 0.12


def test_a_narrower_camera_leaves_invalid_pixels_black():
    """Pixels are valid only if their whole area projects into the narrower camera's image."""
    target = canonical_camera([MAPPING], SMALL)
    renderer = PinholeRenderer(NARROW, target)
    assert 0.1 < renderer.valid.mean() < 0.9
    white = renderer.render(np.full((540, 960, 3), 200, np.uint8))
    assert (white[~renderer.valid] == 0).all()
    assert (white[renderer.valid] == 200).all()
    rng = np.random.default_rng(1)
    row, column = rng.integers(0, 270, 400), rng.integers(0, 480, 400)
    inside = np.ones(400, bool)
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        ray = target.unproject(np.stack([column + dx, row + dy], axis=1).astype(float))
        pixels = NARROW.project(np.column_stack([ray, np.ones(400)]))
        inside &= np.all((pixels >= 0) & (pixels <= [960, 540]), axis=1)
    assert (renderer.valid[row, column] == inside).all()


def test_a_users_mask_is_rendered_with_its_image():
    """Output pixels that see any masked input pixel are unusable."""
    target = canonical_camera([MAPPING], SMALL)
    usable = np.ones((720, 1280), bool)
    usable[:, 900:] = False
    rendered = PinholeRenderer(MAPPING, target).render_mask(usable)
    edge = target.project(
        np.column_stack([MAPPING.unproject(np.array([[900.0, 356.0]])), np.ones(1)])
    )[0, 0]
    assert rendered[135, : int(edge) - 1].all()
    assert not rendered[135, int(edge) + 2 :].any()


@pytest.mark.parametrize("camera", [MAPPING, NARROW], ids=["mapping", "narrow"])
def test_points_move_with_the_image(camera):
    """Mapped pixels equal the pinhole's projection within 1e-6 px; those out of view are dropped."""
    target = canonical_camera([MAPPING], SMALL)
    rng = np.random.default_rng(3)
    points = np.column_stack(
        [rng.uniform(-1, 1, 3000), rng.uniform(-0.6, 0.6, 3000), np.ones(3000)]
    )
    pixels = camera.project(points)
    points = points[np.all((pixels > 0) & (pixels < [camera.width, camera.height]), axis=1)]
    renderer = PinholeRenderer(camera, target)
    moved, seen = renderer.map_pixels(camera.project(points))
    wanted = target.project(points)
    in_view = np.all((wanted >= 0) & (wanted < [480, 270]), axis=1)
    assert seen.sum() > 100
    assert np.abs(moved - wanted)[seen].max() < 1e-6
    assert not (seen & ~in_view).any()
    column, row = moved[seen].astype(int).T
    assert renderer.valid[row, column].all()
    lost = in_view & ~seen  # on pixels only partly in the narrow camera's view
    assert lost.sum() == 0 if camera is MAPPING else 0 < lost.mean() < 0.02


def test_no_points_move_to_no_points():
    """Mapping an empty set of pixels gives empty arrays."""
    moved, seen = PinholeRenderer(MAPPING, canonical_camera([MAPPING], SMALL)).map_pixels(
        np.zeros((0, 2))
    )
    assert moved.shape == (0, 2)
    assert seen.shape == (0,)


def test_an_image_of_another_size_is_our_mistake():
    """An image whose size differs from the camera's raises ValueError."""
    with pytest.raises(ValueError, match="960x540, the camera is for 1280x720"):
        PinholeRenderer(MAPPING, canonical_camera([MAPPING], SMALL)).render(
            np.zeros((540, 960, 3), np.uint8)
        )
