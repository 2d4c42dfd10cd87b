"""Geometric verification of putative matches."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import cv2
import numpy as np

from spn_data.colmap import pycolmap
from spn_data.geometry.camera import Camera
from spn_data.matching.features import Features
from spn_data.matching.guided import match_guided
from spn_data.matching.putative import MatchOptions, PutativeMatcher
from spn_data.work.answers import WrongAnswerError, check_indices, check_kind

_logger = logging.getLogger(__name__)

_MAX_ITERATIONS = 1000  # of the fundamental matrix estimation


@dataclass(frozen=True, eq=False)
class VerifiedPair:
    """Putative matches of two images and the result of their verification.

    Attributes
    ----------
    image_ids : (int, int)
        COLMAP's image ids.
    matches : ndarray, shape (M, 2), uint32
        Putative matches: feature indices in both images.
    inliers : ndarray, shape (K, 2), uint32
        Verified matches; empty if the pair failed verification.
    config : int
        COLMAP's TwoViewGeometryConfiguration.
    e, f, h : ndarray, shape (3, 3), or None
        Essential matrix, fundamental matrix and homography.
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
    """Everything needed to match one image.

    Attributes
    ----------
    features : Features
        Keypoints and descriptors.
    camera : Camera
        Intrinsics.
    focal_is_known : bool
        If false, the image is excluded from calibrated verification.
    """

    features: Features
    camera: Camera
    focal_is_known: bool


def native_camera(camera: Camera, *, camera_id: int = 1, focal_is_known: bool) -> pycolmap.Camera:
    """Convert a camera to COLMAP's; calibrated verification ignores it if its focal length is unknown."""
    return pycolmap.Camera(
        camera_id=camera_id,
        model=camera.model,
        width=camera.width,
        height=camera.height,
        params=camera.params,
        has_prior_focal_length=focal_is_known,
    )


def check_pair(pair: VerifiedPair, sizes: dict[int, int]) -> None:
    """Check a pair that a worker matched; raise WrongAnswerError if it cannot be.

    sizes : number of features of each image, by its id.
    """
    below = (sizes[pair.image_ids[0]], sizes[pair.image_ids[1]])
    for what in ("matches", "inliers"):
        check_indices(getattr(pair, what), what, np.uint32, below, sum(below))
    configs = [int(value) for value in pycolmap.TwoViewGeometryConfiguration.__members__.values()]
    if type(pair.config) is not int or pair.config not in configs:
        raise WrongAnswerError(f"a configuration {pair.config!r:.60}")
    for matrix in (pair.e, pair.f, pair.h):
        if matrix is not None:
            check_kind(matrix, np.ndarray)
            if matrix.shape != (3, 3) or matrix.dtype != np.float64:
                raise WrongAnswerError(f"a matrix of shape {matrix.shape} and {matrix.dtype}")


def match_pairs(
    images: dict[int, ImageForMatching],
    pairs: list[tuple[int, int]],
    options: MatchOptions,
) -> list[VerifiedPair]:
    """Match and verify pairs of images.

    A pure function: the same input gives the same output on any machine.

    Parameters
    ----------
    images : dict of int to ImageForMatching
        Images by COLMAP's image id.
    pairs : list of (int, int)
        Pairs of image ids.
    options : MatchOptions

    Returns
    -------
    list of VerifiedPair
        In the order of `pairs`.
    """
    return [_match_pair(pair, images[pair[0]], images[pair[1]], options) for pair in pairs]


def _match_pair(
    pair: tuple[int, int], a: ImageForMatching, b: ImageForMatching, options: MatchOptions
) -> VerifiedPair:
    matches, candidates = _putative(a.features, b.features, options)
    none = np.zeros((0, 2), np.uint32)
    if len(candidates) < options.min_inliers:
        config = pycolmap.TwoViewGeometryConfiguration.DEGENERATE
        return VerifiedPair(pair, matches, none, int(config), None, None, None)
    geometry = pycolmap.estimate_two_view_geometry(
        native_camera(a.camera, focal_is_known=a.focal_is_known),
        a.features.keypoints[:, :2].astype(np.float64),
        native_camera(b.camera, focal_is_known=b.focal_is_known),
        b.features.keypoints[:, :2].astype(np.float64),
        candidates,
        verification_options(options, len(candidates)),
    )
    inliers = np.asarray(geometry.inlier_matches, dtype=np.uint32).reshape(-1, 2)
    if len(inliers) < options.min_inliers:
        inliers = none
    return VerifiedPair(
        pair, matches, inliers, int(geometry.config), geometry.E, geometry.F, geometry.H
    )


def _putative(a: Features, b: Features, options: MatchOptions) -> tuple[np.ndarray, np.ndarray]:
    """Match two images; return putative matches (M, 2) and the candidates (K, 2) for verification.

    There are no candidates if so few matches fit one epipolar geometry that the images show different things.

    The strongest features are compared first, at a sixteenth of the cost, then twice as many, and so on; most
    pairs are rejected early. For pairs that certainly overlap, the other features are compared along epipolar
    lines only.
    """
    matcher = PutativeMatcher(a.descriptors, b.descriptors)
    fundamental, n = None, options.strongest
    while n < min(len(a), len(b)):
        matcher.extend(n)
        first = matcher.matches(options)
        n *= 2
        if len(first) < options.telling_matches:
            continue
        estimate, fits = _epipolar_geometry(a, b, first, options)
        if _share(fits) < options.least_share:
            return first, first[:0]
        if _share(fits) >= options.guided_share:
            fundamental = estimate
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
    """Estimate the fundamental matrix F (3, 3), x_b' F x_a = 0, and an inlier mask (M,) of the matches.

    With too few matches to decide, return None and all matches as inliers. OpenCV's MAGSAC++ (Barath et al.
    2020) is a hundred times faster on hopeless pairs than COLMAP's estimator.
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
            _MAX_ITERATIONS,
        )
    except cv2.error as error:
        _logger.debug("COLMAP decides on %d matches, as OpenCV failed: %s", len(matches), error)
        # OpenCV 5.0.0 raises if its local optimisation ends without a model: leave the decision to COLMAP.
        return None, np.ones(len(matches), bool)
    if fundamental is None or fundamental.shape != (3, 3):
        return None, np.zeros(len(matches), bool)
    return fundamental, fits.ravel().astype(bool)


def verification_options(options: MatchOptions, matches: int) -> pycolmap.TwoViewGeometryOptions:
    """Return COLMAP's options to verify a number of matches."""
    native = pycolmap.TwoViewGeometryOptions()
    native.min_num_inliers = options.min_inliers
    # On-screen display and propellers are masked; a static flat border in drone video is not a watermark.
    native.detect_watermark = False
    native.ransac.max_error = options.max_error_px
    native.ransac.min_num_trials = 30  # most outliers have been removed before
    # A pair with fewer inliers is not verified, so no samples are needed to find them.
    min_ratio = options.min_inliers / matches
    native.ransac.min_inlier_ratio = max(native.ransac.min_inlier_ratio, min_ratio)
    native.ransac.random_seed = options.seed
    return native
