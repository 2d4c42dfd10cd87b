"""Tests of image texture: a scene against noise, fog and a covered lens."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from spn_data.geometry.image_texture import MIN_DETAIL_SHARE, detail_share, missing_texture


def scene(width: int = 960, height: int = 720) -> np.ndarray:
    """Return random grey steps at several scales, similar to the edges of a real scene."""
    rng = np.random.default_rng(1)
    image = np.zeros((height, width), np.float32)
    for cells in (6, 12, 24, 48):
        coarse = rng.normal(0, 25, (cells * 3 // 4, cells)).astype(np.float32)
        image += cv2.resize(coarse, (width, height), interpolation=cv2.INTER_NEAREST)
    gray = np.clip(image + 120, 0, 255).astype(np.uint8)
    return np.repeat(gray[..., None], 3, axis=2)


@pytest.mark.parametrize("width", [80, 320, 960, 2000])
def test_a_scene_has_texture_at_every_size(width):
    """A scene has texture at any image size."""
    assert detail_share(scene(width, width * 3 // 4)) > 4 * MIN_DETAIL_SHARE
    assert missing_texture(scene(width, width * 3 // 4)) == ""


def test_half_of_a_scene_is_enough():
    """A cover over half the image leaves enough texture; one over 95 % does not."""
    image = scene()
    image[:, :480] = 0
    assert missing_texture(image) == ""
    image[:, :912] = 0
    assert "need 10 %" in missing_texture(image)


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lambda image: image * 0, "nearly black"),
        (lambda image: image * 0.03, "nearly black"),
        (lambda image: np.random.default_rng(0).normal(12, 8, image.shape), "nearly black"),
        (lambda image: image * 0 + 255, "nearly white"),
        (lambda image: image * 0.05 + 170, "uniform, blurred, fogged or covered"),
        (lambda image: cv2.GaussianBlur(image, (0, 0), 60), "uniform, blurred, fogged or covered"),
        (lambda image: np.linspace(0, 255, image.size).reshape(image.shape), "uniform"),
    ],
)
def test_what_shows_no_scene_has_a_reason(spoil, told):
    """Black with sensor noise, white, fog, defocus and a gradient are each named as the reason."""
    image = np.clip(spoil(scene().astype(np.float32)), 0, 255).astype(np.uint8)
    assert told in missing_texture(image)
