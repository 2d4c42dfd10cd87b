"""Geometric verification of putative matches."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from spn_data.colmap import pycolmap
from spn_data.geometry.camera import Camera
from spn_data.matching.features import Features
from spn_data.matching.guided import match_guided
from spn_data.matching.putative import MatchOptions, PutativeMatcher

_ITERATIONS = 1000  # of its estimation, at most


@dataclass(frozen=True, eq=False)
class VerifiedPair:
    """Matches of two images and what verification made of them.

    matches : (M, 2) uint32 putative; inliers : (K, 2) uint32, empty where the pair is not verified.
    config : COLMAP's TwoViewGeometryConfiguration; e, f, h : (3, 3) or None.
    """

    image_ids: tuple[int, int]
    matches: np.ndarray
    inliers: np.ndarray
    config: int
    e: np.ndarray | None
    f: np.ndarray | None
    h: np.ndarray | None


@dataclass(frozen=True, eq=False)
class ImageForMatching:
    """What matching one image takes."""

    features: Features
    camera: Camera
    focal_is_known: bool


def native_camera(camera: Camera, *, camera_id: int = 1, focal_is_known: bool) -> pycolmap.Camera:
    """COLMAP's object; an unknown focal length is left out of calibrated verification."""
    return pycolmap.Camera(
        camera_id=camera_id,
        model=camera.model,
        width=camera.width,
        height=camera.height,
        params=camera.params,
        has_prior_focal_length=focal_is_known,
    )


def match_pairs(
    images: dict[int, ImageForMatching],
    pairs: list[tuple[int, int]],
    options: MatchOptions,
) -> list[VerifiedPair]:
    """Match and verify pairs of image ids. Pure: the same input gives the same output anywhere."""
    return [_match_pair(pair, images[pair[0]], images[pair[1]], options) for pair in pairs]


def _match_pair(
    pair: tuple[int, int], a: ImageForMatching, b: ImageForMatching, options: MatchOptions
) -> VerifiedPair:
    matches, fitting = _putative(a.features, b.features, options)
    none = np.zeros((0, 2), np.uint32)
    if len(fitting) < options.min_inliers:
        config = pycolmap.TwoViewGeometryConfiguration.DEGENERATE
        return VerifiedPair(pair, matches, none, int(config), None, None, None)
    geometry = pycolmap.estimate_two_view_geometry(
        native_camera(a.camera, focal_is_known=a.focal_is_known),
        a.features.keypoints[:, :2].astype(np.float64),
        native_camera(b.camera, focal_is_known=b.focal_is_known),
        b.features.keypoints[:, :2].astype(np.float64),
        fitting,
        verification_options(options, len(fitting)),
    )
    inliers = np.asarray(geometry.inlier_matches, dtype=np.uint32).reshape(-1, 2)
    if len(inliers) < options.min_inliers:
        inliers = none
    return VerifiedPair(
        pair, matches, inliers, int(geometry.config), geometry.E, geometry.F, geometry.H
    )


def _putative(a: Features, b: Features, options: MatchOptions) -> tuple[np.ndarray, np.ndarray]:
    """Matches (M, 2) of two images, and those (K, 2) that are worth verifying: none where so few fit together
    that the images show different things.

    The strongest features tell first, for a sixteenth of the cost, then twice as many, and so on: most pairs
    end here. Of those that surely overlap the other features are compared along epipolar lines alone.
    """
    matcher = PutativeMatcher(a.descriptors, b.descriptors)
    fundamental, n = None, options.strongest
    while n < min(len(a), len(b)):
        matcher.extend(n)
        first = matcher.matches(options)
        n *= 2
        if len(first) < options.telling_matches:
            continue
        found, fits = _epipolar_geometry(a, b, first, options)
        if _share(fits) < options.least_share:
            return first, first[:0]
        if _share(fits) >= options.guided_share:
            fundamental = found
            break
    if fundamental is None:
        matcher.extend(max(len(a), len(b)))
        matches = matcher.matches(options)
    else:
        points = a.keypoints[:, :2], b.keypoints[:, :2]
        matches = match_guided(
            *(points[0], a.descriptors, points[1], b.descriptors, fundamental, options)
        )
    _, fits = _epipolar_geometry(a, b, matches, options)
    return matches, matches[fits] if _share(fits) >= options.least_share else matches[:0]


def _share(fits: np.ndarray) -> float:
    return float(fits.mean()) if len(fits) else 1.0


def _epipolar_geometry(
    a: Features, b: Features, matches: np.ndarray, options: MatchOptions
) -> tuple[np.ndarray | None, np.ndarray]:
    """F (3, 3), x_b' F x_a = 0, and which matches (M, 2) fit it, (M,); None and all where none can tell.

    MAGSAC++ (Barath et al. 2020) as OpenCV has it: a hundred times faster on hopeless pairs than COLMAP's.
    """
    if len(matches) < options.telling_matches:
        return None, np.ones(len(matches), bool)
    try:
        fundamental, fits = cv2.findFundamentalMat(
            a.keypoints[matches[:, 0], :2].astype(np.float64),
            b.keypoints[matches[:, 1], :2].astype(np.float64),
            cv2.USAC_MAGSAC,
            options.max_error_px,
            0.999,
            _ITERATIONS,
        )
    except cv2.error:
        # OpenCV 5.0.0 asserts where its local optimisation ends without a model: COLMAP's shall tell.
        return None, np.ones(len(matches), bool)
    if fundamental is None or fundamental.shape != (3, 3):
        return None, np.zeros(len(matches), bool)
    return fundamental, fits.ravel().astype(bool)


def verification_options(options: MatchOptions, matches: int) -> pycolmap.TwoViewGeometryOptions:
    """COLMAP's, for so many matches."""
    native = pycolmap.TwoViewGeometryOptions()
    native.min_num_inliers = options.min_inliers
    # On-screen display and propellers are masked; a static flat border is no watermark in drone video.
    native.detect_watermark = False
    native.ransac.max_error = options.max_error_px
    native.ransac.min_num_trials = 30  # what does not fit is gone before
    # With fewer inliers a pair is not verified: no samples are drawn to find them.
    least = options.min_inliers / matches
    native.ransac.min_inlier_ratio = max(native.ransac.min_inlier_ratio, least)
    native.ransac.random_seed = options.seed
    return native
