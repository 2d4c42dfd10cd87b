"""Local features of one image: SIFT keypoints and RootSIFT descriptors, a pure function of the pixels."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from spn_data.errors import InputError
from spn_data.geometry.camera import colmap_pixels
from spn_data.work.answers import WrongAnswerError, check_kind, check_rows


@dataclass(frozen=True, kw_only=True)
class FeatureOptions:
    """Options of feature detection.

    Attributes
    ----------
    max_features : int
        Number of strongest features kept per image.
    max_image_size_px : int
        The longer image side is reduced to this before detection.
    contrast_threshold : float
        OpenCV's; it detects what COLMAP's peak threshold of 0.0067 does.
    edge_threshold : float
        Ratio of principal curvatures above which a point is rejected as an edge.
    """

    max_features: int = 4096
    max_image_size_px: int = 1600
    contrast_threshold: float = 0.02
    edge_threshold: float = 10.0


@dataclass(frozen=True, eq=False)
class Features:
    """Features of one image, strongest first.

    Attributes
    ----------
    keypoints : ndarray of float32, shape (N, 4)
        x, y in full-size pixels (COLMAP's convention: the centre of the upper-left pixel is 0.5, 0.5), scale
        in pixels, orientation in radians.
    descriptors : ndarray of uint8, shape (N, 128)
        RootSIFT of length 512.
    """

    keypoints: np.ndarray
    descriptors: np.ndarray

    def __len__(self) -> int:
        return len(self.keypoints)


def check_features(features: object, options: FeatureOptions) -> None:
    """Check features that a worker extracted; raise WrongAnswerError if they cannot be."""
    check_kind(features, Features)
    assert isinstance(features, Features)
    check_rows(features.keypoints, "keypoints", np.float32, 4, options.max_features)
    check_rows(features.descriptors, "descriptors", np.uint8, 128, options.max_features)
    if len(features.keypoints) != len(features.descriptors):
        raise WrongAnswerError("numbers of keypoints and descriptors differ")


def extract_from_bytes(
    name: str, image: bytes, mask: bytes | None, options: FeatureOptions
) -> tuple[str, Features]:
    """Extract the features of an encoded image.

    A pure function: the same bytes give the same features on any machine.

    Parameters
    ----------
    name : str
        Name of the image, returned unchanged.
    image : bytes
        The encoded image.
    mask : bytes or None
        An encoded mask of the image, white at pixels on which features may be detected.
    options : FeatureOptions
        Options of feature detection.

    Returns
    -------
    name : str
        As given.
    features : Features
        Features of the image.

    Raises
    ------
    InputError
        If the image or its mask cannot be decoded.
    """
    gray = cv2.imdecode(np.frombuffer(image, np.uint8), cv2.IMREAD_GRAYSCALE)
    if gray is None:
        raise InputError("cannot be decoded as an image", path=name)
    usable = None
    if mask is not None:
        decoded = cv2.imdecode(np.frombuffer(mask, np.uint8), cv2.IMREAD_GRAYSCALE)
        if decoded is None:
            raise InputError("its mask cannot be decoded as an image", path=name)
        usable = decoded > 127
    return name, extract(gray, usable, options)


def extract(gray: np.ndarray, mask: np.ndarray | None, options: FeatureOptions) -> Features:
    """Extract the features of a grey image.

    Parameters
    ----------
    gray : ndarray of uint8, shape (H, W)
        The image.
    mask : ndarray of bool, shape (H, W), or None
        Pixels on which features may be detected.
    options : FeatureOptions
        Options of feature detection.

    Returns
    -------
    Features
        At most `options.max_features`.
    """
    height, width = gray.shape
    gray = reduced(gray, options.max_image_size_px)
    small_height, small_width = gray.shape
    mask_image = None
    if mask is not None:
        mask_image = cv2.resize(
            mask.astype(np.uint8), (small_width, small_height), interpolation=cv2.INTER_NEAREST
        )
    sift = cv2.SIFT_create(
        nfeatures=options.max_features,
        contrastThreshold=options.contrast_threshold,
        edgeThreshold=options.edge_threshold,
        # Without this, the doubled first octave is shifted by a quarter of a pixel.
        enable_precise_upscale=True,
    )
    points, raw = sift.detectAndCompute(gray, mask_image)
    if raw is None:
        return Features(np.zeros((0, 4), np.float32), np.zeros((0, 128), np.uint8))
    order = np.argsort([-p.response for p in points], kind="stable")[: options.max_features]
    xy = np.array([points[i].pt for i in order], dtype=np.float64)
    size_angle = np.array([(points[i].size / 2, np.deg2rad(points[i].angle)) for i in order])
    factors = np.array([width / small_width, height / small_height])
    xy = colmap_pixels(xy) * factors
    size_angle[:, 0] *= factors.mean()
    keypoints = np.concatenate([xy, size_angle], axis=1).astype(np.float32)
    return Features(keypoints, root_sift(raw[order]))


def reduced(gray: np.ndarray, max_image_size_px: int) -> np.ndarray:
    """Reduce a grey image (H, W) so that its longer side is at most this, as before detection."""
    height, width = gray.shape
    scale = min(1.0, max_image_size_px / max(height, width))
    if scale == 1:
        return gray
    size = (round(width * scale), round(height * scale))
    return cv2.resize(gray, size, interpolation=cv2.INTER_AREA)


def root_sift(descriptors: np.ndarray) -> np.ndarray:
    """Convert SIFT to RootSIFT (N, 128) uint8 of length 512 as in COLMAP (Arandjelovic & Zisserman 2012)."""
    rooted = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-12))
    return np.clip(np.rint(512.0 * rooted), 0, 255).astype(np.uint8)
