"""Features on board, and their comparison with landmarks."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from spn_data.matching.features import FeatureOptions, extract
from spn_data.matching.putative import unit_descriptors
from spn_model.landmarks.matching import ImageFeatures, expected, match, match_all, match_near
from spn_model.landmarks.search import search
from spn_model.landmarks.sift import Sift
from tests.worlds.landmark_world import CAMERA, OPTIONS, pose, room, seen_from

ROOM = room()


def texture(width: int = 480, height: int = 270, seed: int = 0) -> np.ndarray:
    """Return a grey image with structures of many sizes."""
    rng = np.random.default_rng(seed)
    layers = [cv2.GaussianBlur(rng.normal(size=(height, width)), (0, 0), 2.0**k) for k in range(5)]
    both = sum(layer / layer.std() for layer in layers)
    return np.clip(128 + 22 * both, 0, 255).astype(np.uint8)


def test_features_are_those_of_opencv():
    """Four of five of OpenCV's features are found within 0.3 px, without bias, with its descriptors."""
    options = FeatureOptions(max_features=600, max_image_size_px=400)
    gray = texture()
    theirs, ours = extract(gray, None, options), Sift(options).extract(gray)
    assert len(ours) == len(theirs) == 600
    a, b = theirs.keypoints, ours.keypoints
    alike = unit_descriptors(theirs.descriptors) @ unit_descriptors(ours.descriptors).T
    off = np.linalg.norm(a[:, None, :2] - b[None, :, :2], axis=2)
    alike[(off > 0.3) | (np.abs(np.log(a[:, None, 2] / b[None, :, 2])) > 0.1)] = 0
    nearest = alike.argmax(axis=1)
    same = alike[np.arange(len(a)), nearest] > 0.9
    assert same.mean() > 0.8
    assert np.median(alike[np.arange(len(a)), nearest][same]) > 0.985
    shift = (b[nearest] - a)[same]
    assert np.abs(shift[:, :2].mean(axis=0)).max() < 0.01
    turn = np.abs((shift[:, 3] + np.pi) % (2 * np.pi) - np.pi)
    assert np.median(turn) < np.deg2rad(3)


def test_memory_of_an_image_leaves_no_trace():
    """An image has equal features whatever was extracted before it, of its size or of another one."""
    options = FeatureOptions(max_features=300, max_image_size_px=320)
    gray = texture(seed=1)
    wanted = Sift(options).extract(gray)
    used = Sift(options)
    for before in (texture(seed=2), texture(200, 333, seed=3)):
        used.extract(before)
        again = used.extract(gray)
        assert np.array_equal(again.keypoints, wanted.keypoints)
        assert np.array_equal(again.descriptors, wanted.descriptors)


@pytest.mark.parametrize("shape", [(270, 480), (9, 9), (11, 40), (31, 17)])
def test_an_image_without_structure_has_no_features(shape):
    """A grey image of any size has none, and so no pose."""
    found = Sift(OPTIONS).extract(np.full(shape, 90, np.uint8))
    assert len(found) == 0
    features = ImageFeatures.of(found, CAMERA, OPTIONS.max_image_size_px)
    assert search(ROOM, features) is None


def test_a_wide_match_is_that_of_the_whole_image():
    """Without a radius, landmarks match as within a radius larger than the image; with one, as within it."""
    center, rotation = pose(30.0)
    seen = seen_from(ROOM, center, rotation)
    features = ImageFeatures.of(seen, CAMERA, OPTIONS.max_image_size_px)
    wanted = expected(
        ROOM, *pose(33.0, east=0.3), features.focal_px, features.half_view, margin=1.25
    )
    for radius_px, same in ((None, 1e4), (60.0, 60.0)):
        a, b = match(features, ROOM, wanted, radius_px), match_near(features, ROOM, wanted, same)
        assert len(a) > 50
        assert set(zip(a.landmarks, a.features, strict=True)) == set(
            zip(b.landmarks, b.features, strict=True)
        )


def test_all_landmarks_are_compared_in_parts():
    """Features compared in two parts have the sightings of all at once; few or no features are no error."""
    seen = seen_from(ROOM, *pose(50.0))
    features = ImageFeatures.of(seen, CAMERA, OPTIONS.max_image_size_px)
    every = match_all(features, ROOM, slice(None))
    parts = match_all(features, ROOM, slice(200)).followed_by(
        match_all(features, ROOM, slice(200, None))
    )
    assert len(every) > 100
    for name in ("landmarks", "features", "xyz", "covariance", "at", "sigma_px"):
        assert np.array_equal(getattr(every, name), getattr(parts, name))
    assert len(match_all(features, ROOM, slice(len(features), None))) == 0
