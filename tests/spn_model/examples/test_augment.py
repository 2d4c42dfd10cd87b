"""Tests of virtual cameras at real camera positions: exact labels and pixel positions."""

from __future__ import annotations

import numpy as np
import pytest

from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import rotations_from_vectors
from spn_model.examples.augment import (
    PhotometricOptions,
    WarpOptions,
    augment_photometrically,
    random_warp,
)

SIZE = (480, 271)  # an odd height: halving it is not exactly by two
MATRIX = np.array([[328.0, 0, 233.0], [0, 331.0, 141.0], [0, 0, 1.0]])


def warp(seed: int, zoom: float, target: tuple[int, int] | None = None):
    rng = np.random.default_rng(seed)
    return random_warp(rng, MATRIX, SIZE, WarpOptions(), zoom=zoom, target_size=target)


def camera(matrix: np.ndarray, width: int, height: int) -> Camera:
    return Camera("PINHOLE", width, height, matrix[[0, 1, 0, 1], [0, 1, 2, 2]])


def spot(width: int, height: int, at: np.ndarray, sigma: float = 2.0) -> np.ndarray:
    """Return an image of a smooth bright spot centred on a COLMAP pixel."""
    y, x = np.mgrid[:height, :width] + 0.5
    values = 250 * np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / (2 * sigma**2))
    return np.repeat(np.rint(values).astype(np.uint8)[..., None], 3, axis=2)


def middle(image: np.ndarray) -> np.ndarray:
    """Return the centroid of the intensity in COLMAP pixels."""
    light = image[..., 0].astype(np.float64)
    y, x = np.mgrid[: light.shape[0], : light.shape[1]] + 0.5
    return np.array([(light * x).sum(), (light * y).sum()]) / light.sum()


@pytest.mark.parametrize("zoom", [0.45, 1.0, 1.35])
@pytest.mark.parametrize("target", [None, (240, 136)])
def test_a_warped_pixel_is_the_projection_by_the_turned_pose(zoom, target):
    """Warped pixels equal projections by the virtual camera to 1e-6 px, and the warp is invertible."""
    rng = np.random.default_rng(0)
    pose = Poses.from_rotations([[3.0, -2.0, 5.0]], rotations_from_vectors([[0.4, -1.2, 0.3]]))
    in_camera = rng.uniform([-4, -2, 6], [4, 2, 30], (50, 3))
    xyz = in_camera @ pose.rotations[0] + pose.centers[0]
    seen = camera(MATRIX, *SIZE).project(in_camera)
    virtual = warp(1, zoom, target)
    turned = virtual.pose(pose)
    expected = camera(virtual.matrix, virtual.width, virtual.height).project(
        (xyz - turned.centers[0]) @ turned.rotations[0].T
    )
    assert virtual.pixels(seen) == pytest.approx(expected, abs=1e-6)
    assert virtual.source_pixels(virtual.pixels(seen)) == pytest.approx(seen, abs=1e-6)


@pytest.mark.parametrize("zoom", [0.45, 0.65, 1.0, 1.35])
@pytest.mark.parametrize("target", [None, (440, 260)])
def test_the_image_moves_with_its_pixels(zoom, target):
    """A bright spot is drawn within 0.05 px of its warped pixel."""
    for seed in range(4):
        virtual = warp(seed, zoom, target)
        at = virtual.source_pixels(np.array([[201.0, 118.0]]))[0]
        drawn = virtual.image(spot(*SIZE, at))
        assert drawn.shape == (virtual.height, virtual.width, 3)
        assert middle(drawn) == pytest.approx(virtual.pixels(at[None])[0], abs=0.05)


def test_a_small_virtual_image_passes_over_no_pixel():
    """Reducing an image to 0.45 blends lines one pixel wide and four apart instead of aliasing."""
    image = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    image[:, ::4] = 240
    still = WarpOptions(tilt_deg=0.0, roll_deg=0.0)
    rng = np.random.default_rng(0)
    small = random_warp(rng, MATRIX, SIZE, still, zoom=0.45, target_size=(120, 68))
    columns = small.image(image)[:, :, 0].astype(float).mean(axis=0)
    assert columns.mean() == pytest.approx(60, abs=3)
    assert columns.std() < 50  # 76 if pixels are skipped


def test_what_the_real_camera_did_not_see_is_filled():
    """Pixels outside the source image have exactly the fill colour."""
    white = np.full((SIZE[1], SIZE[0], 3), 255, np.uint8)
    drawn = warp(2, 0.45).image(white, fill=(1, 2, 3))
    assert drawn[0, 0].tolist() == [1, 2, 3]
    assert drawn[SIZE[1] // 2, SIZE[0] // 2].tolist() == [255, 255, 255]


def test_points_behind_the_virtual_camera_have_no_pixel():
    """Pixels that a strong rotation puts behind the image plane are NaN, not mirrored."""
    options = WarpOptions(tilt_deg=0.0, roll_deg=0.0)
    still = random_warp(np.random.default_rng(0), MATRIX, SIZE, options, zoom=1.0)
    turned = type(still)(rotations_from_vectors([[0.0, 1.2, 0.0]])[0], MATRIX, still.matrix, *SIZE)
    pixels = turned.pixels(np.array([[0.0, 135.0], [480.0, 135.0]]))
    assert np.isnan(pixels).any()
    assert still.pixels(np.array([[7.0, 9.0]])) == pytest.approx(np.array([[7.0, 9.0]]))


def test_turns_and_zooms_fill_their_ranges():
    """Random zooms and tilts stay within the options and cover most of their range."""
    rng = np.random.default_rng(0)
    warps = [random_warp(rng, MATRIX, SIZE, WarpOptions()) for _ in range(300)]
    zoom = np.array([w.matrix[0, 0] / MATRIX[0, 0] for w in warps])
    assert 0.45 <= zoom.min() < 0.47
    assert 1.3 < zoom.max() <= 1.35
    tilt = np.rad2deg([np.arccos(w.rotation[2, 2]) for w in warps])
    assert 20 < tilt.max() <= 20 * np.sqrt(2) + 1e-6


def test_a_look_without_changes_is_the_image():
    """With all strengths at zero, augmentation returns an equal copy."""
    image = np.random.default_rng(0).integers(0, 256, (40, 60, 3), dtype=np.uint8)
    still = PhotometricOptions(
        exposure=0, tint=0, gamma=0, blur_share=0, noise=0, occlusion_share=0
    )
    changed = augment_photometrically(image, np.random.default_rng(1), still)
    assert changed is not image
    assert np.array_equal(changed, image)


def test_looks_are_those_of_their_seed():
    """Equal seeds give equal images, other seeds differ, and the input is unchanged."""
    image = np.random.default_rng(0).integers(0, 256, (90, 120, 3), dtype=np.uint8)
    before = image.copy()
    first, again, other = (
        augment_photometrically(image, np.random.default_rng(seed), PhotometricOptions())
        for seed in (5, 5, 6)
    )
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    assert np.array_equal(image, before)


def test_blur_moves_nothing():
    """Motion blur spreads a spot but moves its centroid by less than 0.02 px."""
    only = PhotometricOptions(exposure=0, tint=0, gamma=0, blur_share=1, noise=0, occlusion_share=0)
    image = spot(121, 91, np.array([60.3, 45.8]), sigma=3.0)
    for seed in range(8):
        changed = augment_photometrically(image, np.random.default_rng(seed), only)
        assert changed.max() < image.max()
        assert middle(changed) == pytest.approx(middle(image), abs=0.02)


def test_an_occlusion_is_one_box_of_one_colour():
    """An occlusion is one rectangle of uniform colour; all other pixels are unchanged."""
    only = PhotometricOptions(exposure=0, tint=0, gamma=0, blur_share=0, noise=0, occlusion_share=1)
    image = np.random.default_rng(0).integers(0, 256, (90, 120, 3), dtype=np.uint8)
    changed = augment_photometrically(image, np.random.default_rng(3), only)
    y, x = np.nonzero((changed != image).any(axis=2))
    box = changed[y.min() : y.max() + 1, x.min() : x.max() + 1].reshape(-1, 3)
    assert 20 < len(box) <= 0.3 * 90 * 0.3 * 120
    assert (box == box[0]).all()
