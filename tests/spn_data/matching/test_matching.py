"""Features and matches of images with exactly known geometry."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from spn_data.colmap import pycolmap
from spn_data.colmap.verify import ImageForMatching, match_pairs, verification_options
from spn_data.geometry.camera import Camera
from spn_data.matching.features import FeatureOptions, Features, extract
from spn_data.matching.putative import MatchOptions, PutativeMatcher, match_descriptors


@pytest.fixture(scope="module")
def texture() -> np.ndarray:
    """Create an image (600, 800) uint8 of blobs of many sizes."""
    rng = np.random.default_rng(3)
    image = np.zeros((600, 800))
    for sigma in (2, 4, 8):
        layer = cv2.GaussianBlur(rng.normal(size=image.shape), (0, 0), sigma)
        image += layer / layer.std()
    return np.clip(128 + 40 * image, 0, 255).astype(np.uint8)


def test_keypoints_lie_in_colmaps_pixel_frame() -> None:
    """A blob centred on the corner of four pixels has integer keypoint coordinates."""
    y, x = np.mgrid[0:200, 0:200] + 0.5
    image = (255 * np.exp(-((x - 80) ** 2 + (y - 120) ** 2) / (2 * 6.0**2))).astype(np.uint8)
    features = extract(image, None, FeatureOptions())
    nearest = np.linalg.norm(features.keypoints[:, :2] - [80, 120], axis=1).min()
    assert nearest < 0.05


def test_a_reduced_image_gives_keypoints_in_full_size_pixels(texture: np.ndarray) -> None:
    """Keypoints detected at half size agree with those at full size to a fraction of a pixel."""
    full = extract(texture, None, FeatureOptions(max_features=500))
    half = extract(texture, None, FeatureOptions(max_features=500, max_image_size_px=400))
    strong = half.keypoints[half.keypoints[:, 2] > 6, :2]
    distance = np.linalg.norm(strong[:, None] - full.keypoints[None, :, :2], axis=2).min(axis=1)
    assert len(strong) > 20
    assert np.median(distance) < 0.3


def test_no_feature_lies_where_the_mask_is_black(texture: np.ndarray) -> None:
    """No keypoint is detected in the masked half of an image."""
    mask = np.ones(texture.shape, bool)
    mask[:, :400] = False
    features = extract(texture, mask, FeatureOptions())
    assert len(features) > 100
    assert features.keypoints[:, 0].min() > 399


def test_descriptors_have_colmaps_length_and_the_strongest_are_kept(texture: np.ndarray) -> None:
    """Descriptors have COLMAP's norm of 512, and the number of features is limited."""
    features = extract(texture, None, FeatureOptions(max_features=200))
    assert len(features) == 200
    lengths = np.linalg.norm(features.descriptors.astype(float), axis=1)
    assert np.abs(lengths - 512).max() < 8


def test_an_empty_image_has_no_features() -> None:
    """A uniform image has no features."""
    assert len(extract(np.full((100, 100), 128, np.uint8), None, FeatureOptions())) == 0


def test_matches_are_the_mutual_nearest_that_pass_the_ratio_test() -> None:
    """Matches equal those of a plain loop over all distances, also with near-duplicate descriptors."""
    rng = np.random.default_rng(0)
    a = rng.gamma(0.5, 40, size=(700, 128)).clip(0, 255).astype(np.uint8)
    b = np.clip(a[:500] + rng.normal(0, 15, size=(500, 128)), 0, 255).astype(np.uint8)
    b = np.concatenate(
        [b, np.clip(b[:100] + rng.normal(0, 3, (100, 128)), 0, 255).astype(np.uint8)]
    )
    found = {tuple(m) for m in match_descriptors(a, b, MatchOptions()).tolist()}
    ua, ub = (d / np.linalg.norm(d.astype(float), axis=1, keepdims=True) for d in (a, b))
    distance = np.linalg.norm(ua[:, None] - ub[None], axis=2)
    expected = set()
    for i in range(len(a)):
        j, second = np.argsort(distance[i])[:2]
        if (
            distance[:, j].argmin() == i
            and distance[i, j] < 0.8 * distance[i, second]
            and distance[i, j] < 0.7
        ):
            expected.add((i, int(j)))
    assert len(expected) > 200
    assert not {m for m in expected if m[0] < 100}, "doubles pass no ratio test"
    assert len(found ^ expected) <= 2


def test_a_comparison_that_grows_ends_in_the_matches_of_all_at_once() -> None:
    """The incremental matcher agrees at every size, even if one image has no more descriptors."""
    rng = np.random.default_rng(5)
    a = rng.gamma(0.5, 40, size=(700, 128)).clip(0, 255).astype(np.uint8)
    of_a = np.concatenate([rng.permutation(400), np.arange(50)])  # the last 50 are repeats
    b = np.clip(a[of_a] + rng.normal(0, 15, size=(450, 128)), 0, 255).astype(np.uint8)
    matcher = PutativeMatcher(a, b)
    assert len(matcher.matches(MatchOptions())) == 0
    for n in (1, 100, 300, 500, 700):
        matcher.extend(n)
        expected = match_descriptors(a[:n], b[:n], MatchOptions())
        assert np.array_equal(matcher.matches(MatchOptions()), expected)
    assert len(expected) > 300
    assert (expected[:, 0] < 50).sum() < 10, "most doubles pass no ratio test"


def test_no_feature_is_matched_twice() -> None:
    """Each feature is part of at most one match."""
    same = np.tile(np.arange(128, dtype=np.uint8), (5, 1))
    other = np.random.default_rng(1).integers(0, 255, (50, 128)).astype(np.uint8)
    matches = match_descriptors(same, np.concatenate([same[:1], other]), MatchOptions())
    assert len(np.unique(matches[:, 1])) == len(matches) <= 1


def scene_pair(
    rng: np.random.Generator, outliers: int, n: int = 300
) -> tuple[Features, Features, Camera]:
    """Create two views of n points with 0.3 px noise and descriptors that add `outliers` false matches."""
    camera = Camera.from_horizontal_fov(800, 600, 70)
    points = rng.uniform([-4, -3, 6], [4, 3, 14], size=(n, 3))
    views = []
    for shift in (np.zeros(3), np.array([1.0, 0.2, 0.1])):
        views.append(camera.project(points - shift) + rng.normal(0, 0.3, (n, 2)))
    descriptors = rng.gamma(0.5, 40, size=(n, 128)).clip(0, 255).astype(np.uint8)
    views[1][:outliers] = rng.uniform([0, 0], [800, 600], size=(outliers, 2))
    features = [
        Features(np.column_stack([v, np.ones((n, 2))]).astype(np.float32), descriptors)
        for v in views
    ]
    return features[0], features[1], camera


def test_verification_keeps_the_true_matches_and_drops_the_others() -> None:
    """Geometric verification keeps the true matches and removes nearly all false ones."""
    a, b, camera = scene_pair(np.random.default_rng(0), outliers=90)
    images = {k: ImageForMatching(f, camera, True) for k, f in ((1, a), (2, b))}
    (pair,) = match_pairs(images, [(1, 2)], MatchOptions())
    kept = pair.inliers[:, 0]
    assert (kept >= 90).sum() >= 205
    assert (kept < 90).sum() <= 8  # those that happen to be on their epipolar line


def test_verification_of_chance_matches_fails_and_says_so_with_an_empty_pair() -> None:
    """Chance matches fail verification, and the pair has no inliers."""
    a, b, camera = scene_pair(np.random.default_rng(1), outliers=30, n=30)
    images = {k: ImageForMatching(f, camera, True) for k, f in ((1, a), (2, b))}
    (pair,) = match_pairs(images, [(1, 2)], MatchOptions())
    assert len(pair.matches) == 30
    assert len(pair.inliers) == 0


def test_no_samples_are_drawn_to_find_fewer_inliers_than_verify_a_pair() -> None:
    """RANSAC's minimum inlier ratio follows from the inliers that a verified pair needs."""
    options = MatchOptions()
    few = verification_options(options, 25).ransac
    many = verification_options(options, 1000).ransac
    assert few.min_inlier_ratio == pytest.approx(15 / 25)
    assert many.min_inlier_ratio == pycolmap.TwoViewGeometryOptions().ransac.min_inlier_ratio


def test_of_images_with_nothing_in_common_the_strongest_features_tell() -> None:
    """If the strongest features of two images do not match, the other features are not compared."""
    a, b, camera = scene_pair(np.random.default_rng(3), outliers=1500, n=1500)
    images = {k: ImageForMatching(f, camera, True) for k, f in ((1, a), (2, b))}
    (pair,) = match_pairs(images, [(1, 2)], MatchOptions())
    assert 900 < len(pair.matches) <= 1024
    assert len(pair.inliers) == 0


def test_of_images_that_overlap_the_features_on_wrong_lines_are_not_even_matched() -> None:
    """Most of 300 outliers among 1500 features are removed before verification, and true matches stay."""
    a, b, camera = scene_pair(np.random.default_rng(4), outliers=300, n=1500)
    images = {k: ImageForMatching(f, camera, True) for k, f in ((1, a), (2, b))}
    (pair,) = match_pairs(images, [(1, 2)], MatchOptions())
    assert (pair.matches[:, 0] < 300).sum() < 30
    assert (pair.inliers[:, 0] >= 300).sum() > 1170
    assert (pair.inliers[:, 0] < 300).sum() <= 20


def test_the_same_pair_is_verified_the_same_way_anywhere() -> None:
    """Verifying a pair twice gives identical inliers and fundamental matrices."""
    a, b, camera = scene_pair(np.random.default_rng(2), outliers=150)
    images = {k: ImageForMatching(f, camera, False) for k, f in ((1, a), (2, b))}
    (first,), (second,) = (match_pairs(images, [(1, 2)], MatchOptions()) for _ in range(2))
    assert np.array_equal(first.inliers, second.inliers)
    assert first.f is not None
    assert np.array_equal(first.f, second.f)
