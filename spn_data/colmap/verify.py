"""Geometric verification of putative matches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spn_data.camera import Camera
from spn_data.colmap import pycolmap
from spn_data.features import Features
from spn_data.matching import MatchOptions, match_descriptors


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
    matches = match_descriptors(a.features.descriptors, b.features.descriptors, options)
    none = np.zeros((0, 2), np.uint32)
    if len(matches) < options.min_inliers:
        config = pycolmap.TwoViewGeometryConfiguration.DEGENERATE
        return VerifiedPair(pair, matches, none, int(config), None, None, None)
    geometry = pycolmap.estimate_two_view_geometry(
        native_camera(a.camera, focal_is_known=a.focal_is_known),
        a.features.keypoints[:, :2].astype(np.float64),
        native_camera(b.camera, focal_is_known=b.focal_is_known),
        b.features.keypoints[:, :2].astype(np.float64),
        matches,
        verification_options(options),
    )
    inliers = np.asarray(geometry.inlier_matches, dtype=np.uint32).reshape(-1, 2)
    if len(inliers) < options.min_inliers:
        inliers = none
    return VerifiedPair(
        pair, matches, inliers, int(geometry.config), geometry.E, geometry.F, geometry.H
    )


def verification_options(options: MatchOptions) -> pycolmap.TwoViewGeometryOptions:
    native = pycolmap.TwoViewGeometryOptions()
    native.min_num_inliers = options.min_inliers
    # On-screen display and propellers are masked; a static flat border is no watermark in drone video.
    native.detect_watermark = False
    native.ransac.max_error = options.max_error_px
    native.ransac.random_seed = options.seed
    return native
