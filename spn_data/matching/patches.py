"""Patches of one image found in another by Lucas-Kanade, forwards and backwards."""

from __future__ import annotations

import cv2
import numpy as np

from spn_data.geometry.camera import colmap_pixels, opencv_pixels


def track_points(
    from_gray: np.ndarray,
    to_gray: np.ndarray,
    pixels: np.ndarray,
    expected: np.ndarray,
    *,
    levels: int,
    window_px: int,
    round_trip_px: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Track patches into another image.

    Parameters
    ----------
    from_gray, to_gray : ndarray of uint8, shape (H, W)
        The images.
    pixels : ndarray, shape (K, 2)
        Centres of the patches in the first image.
    expected : ndarray, shape (K, 2)
        Where the search starts in the second one; NaN where nothing is searched for.
    levels : int
        Levels of the pyramid above the image itself.
    window_px : int
        Side of a patch.
    round_trip_px : float
        Largest distance from its start of a point that was tracked there and back.

    Returns
    -------
    there : ndarray, shape (K, 2)
        Pixels in the second image; NaN where nothing was searched for.
    found : ndarray of bool, shape (K,)
        Points that return to their starting point.

    References
    ----------
    Bouguet 2001, "Pyramidal implementation of the affine Lucas Kanade feature tracker".
    """
    height, width = to_gray.shape
    found = np.all((expected > 0) & (expected < [width, height]), axis=1)  # false for NaN
    result = np.full((len(pixels), 2), np.nan)
    rows = np.flatnonzero(found)
    if len(rows) == 0:
        return result, found
    start = opencv_pixels(pixels[rows].astype(np.float32))
    there = opencv_pixels(expected[rows].astype(np.float32))
    search = (
        (window_px, window_px),
        levels,
        (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.01),
        cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    there, ok, _ = cv2.calcOpticalFlowPyrLK(from_gray, to_gray, start, there, None, None, *search)
    back, ok_back, _ = cv2.calcOpticalFlowPyrLK(
        to_gray, from_gray, there, start.copy(), None, None, *search
    )
    closed = np.linalg.norm(back - start, axis=1) <= round_trip_px
    inside = np.all((there >= 0) & (there <= [width - 1, height - 1]), axis=1)
    result[rows] = colmap_pixels(there.astype(np.float64))
    found[rows] = (ok.ravel() == 1) & (ok_back.ravel() == 1) & closed & inside
    return result, found
