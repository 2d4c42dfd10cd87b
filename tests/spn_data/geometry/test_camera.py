"""Tests of cameras, with pycolmap and OpenCV as independent references."""

from __future__ import annotations

import cv2
import numpy as np
import pycolmap
import pytest

from spn_data.geometry.camera import (
    MODELS,
    OPENCV_FROM_COLMAP,
    Camera,
    colmap_pixels,
    opencv_pixels,
)

PARAMS = {
    "SIMPLE_PINHOLE": [900.0, 640.0, 355.0],
    "PINHOLE": [900.0, 880.0, 640.0, 355.0],
    "SIMPLE_RADIAL": [900.0, 640.0, 355.0, -0.05],
    "RADIAL": [900.0, 640.0, 355.0, -0.05, 0.015],
    "OPENCV": [900.0, 880.0, 640.0, 355.0, -0.05, 0.015, 0.001, -0.002],
}


def _camera(model: str) -> Camera:
    return Camera(model, 1280, 720, np.array(PARAMS[model]))


def _points() -> np.ndarray:
    rng = np.random.default_rng(0)
    return rng.uniform([-3, -1.8, 4], [3, 1.8, 9], (100, 3))


@pytest.mark.parametrize("model", MODELS)
def test_projection_agrees_with_pycolmap(model):
    """Projection equals pycolmap's: parameter order, distortion and pixel origin."""
    theirs = pycolmap.Camera(model=model, width=1280, height=720, params=PARAMS[model])
    expected = np.array([theirs.img_from_cam(p) for p in _points()])
    assert _camera(model).project(_points()) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("model", MODELS)
def test_projection_agrees_with_opencv_half_a_pixel_off(model):
    """Projection equals OpenCV's shifted by 0.5 px, the difference of the pixel origins."""
    camera = _camera(model)
    zero = np.zeros(3)
    matrix = OPENCV_FROM_COLMAP @ camera.matrix
    theirs, _ = cv2.projectPoints(_points(), zero, zero, matrix, camera.opencv_distortion)
    ours = camera.project(_points())
    assert ours == pytest.approx(theirs.reshape(-1, 2) + 0.5, abs=1e-9)
    assert colmap_pixels(opencv_pixels(ours)) == pytest.approx(ours, abs=1e-9)
    assert opencv_pixels(ours) == pytest.approx(theirs.reshape(-1, 2), abs=1e-9)


@pytest.mark.parametrize("model", MODELS)
def test_unprojection_undoes_projection(model):
    """Unprojecting and projecting returns the pixels within 1e-6 px over the whole image."""
    camera = _camera(model)
    x, y = np.meshgrid(np.linspace(0.5, 1279.5, 21), np.linspace(0.5, 719.5, 13))
    pixels = np.column_stack([x.ravel(), y.ravel()])
    rays = np.column_stack([camera.unproject(pixels), np.ones(len(pixels))])
    assert camera.project(rays) == pytest.approx(pixels, abs=1e-6)


def test_points_behind_the_camera_have_no_pixel():
    """Points behind the camera project to NaN, not to mirrored pixels."""
    pixels = _camera("OPENCV").project(np.array([[0.0, 0, 1], [0, 0, -1], [1, 1, 0]]))
    assert np.isfinite(pixels[0]).all()
    assert np.isnan(pixels[1:]).all()


def test_the_field_of_view_is_that_of_the_undistorted_image():
    """72 degrees over 1280 px gives a focal length of 880.88 px with any distortion."""
    for distortion in ((), (-0.05,), (-0.05, 0.015), (-0.05, 0.015, 0.001, 0.001)):
        camera = Camera.from_horizontal_fov(1280, 720, 72.0, distortion)
        assert camera.focal_px == pytest.approx((880.884, 880.884), abs=1e-3)
        assert camera.horizontal_fov_deg == pytest.approx(72.0)
        assert camera.matrix[:2, 2].tolist() == [640.0, 360.0]


def test_a_camera_of_a_scaled_image_sees_the_same_rays():
    """At half the image size, projected pixel coordinates are halved."""
    camera = _camera("OPENCV")
    half = camera.scaled(640, 360)
    assert half.project(_points()) == pytest.approx(camera.project(_points()) / 2, abs=1e-9)
    assert (half.width, half.height) == (640, 360)


def test_the_number_of_parameters_is_checked():
    """An unknown model or a missing parameter raises ValueError."""
    with pytest.raises(ValueError, match="FISHEYE"):
        Camera("FISHEYE", 10, 10, np.zeros(4))
    with pytest.raises(ValueError, match="takes 8 parameters, got 7"):
        Camera("OPENCV", 10, 10, np.zeros(7))
