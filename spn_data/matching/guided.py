"""Guided matching: descriptors are compared along epipolar lines of a known fundamental matrix."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from spn_data.matching.putative import MatchOptions, mutual_matches, unit_descriptors

_ROWS = 128  # features with neighbouring lines that are compared in one block


def match_guided(
    points_a: np.ndarray,
    descriptors_a: np.ndarray,
    points_b: np.ndarray,
    descriptors_b: np.ndarray,
    fundamental: np.ndarray,
    options: MatchOptions,
) -> np.ndarray:
    """Match two images with known epipolar geometry: mutual nearest neighbours near the epipolar lines.

    Parameters
    ----------
    points_a, points_b : ndarray, shape (N, 2) and (K, 2)
        Keypoint positions in pixels.
    descriptors_a, descriptors_b : ndarray of uint8, shape (N, 128) and (K, 128)
        RootSIFT descriptors.
    fundamental : ndarray, shape (3, 3)
        Fundamental matrix, x_b' F x_a = 0.
    options : MatchOptions
        Points match within `guided_px` of the epipolar line.

    Returns
    -------
    ndarray of uint32, shape (M, 2)
        Row indices of matches.

    Notes
    -----
    All epipolar lines of an image pass through the epipole. Sorted by direction, a block of neighbouring
    lines encloses a wedge of the other image, and only the keypoints in it are compared, at a tenth of the
    cost of comparing all.

    Any match on a line fits the geometry, whether true or not, so only the ratio test can reject it. As few
    keypoints are near a line, every `guided_step`-th keypoint of the whole image also takes part in the test.
    """
    if len(points_a) == 0 or len(points_b) < 2:
        return np.zeros((0, 2), np.uint32)
    lines, order = _ordered_lines(fundamental, points_a)
    a, b = unit_descriptors(descriptors_a), unit_descriptors(descriptors_b)
    homogeneous_b = np.concatenate([points_b.T, np.ones((1, len(points_b)))]).astype(np.float32)
    best_of_b = np.full(len(b), -1.0, np.float32)
    nearest = np.zeros(len(a), np.int64)
    first, second = (np.full(len(a), -1.0, np.float32) for _ in range(2))
    for start in range(0, len(a), _ROWS):
        block = order[start : start + _ROWS]
        candidates = _in_wedge(lines[block[0]], lines[block[-1]], homogeneous_b, options.guided_px)
        if not len(candidates):
            continue
        similarity = a[block] @ b[candidates].T
        distance_px = lines[block] @ homogeneous_b[:, candidates]
        similarity[np.abs(distance_px) > options.guided_px] = -1.0
        best_of_b[candidates] = np.maximum(best_of_b[candidates], similarity.max(axis=0))
        rows, column = np.arange(len(block)), similarity.argmax(axis=1)
        nearest[block], first[block] = candidates[column], similarity[rows, column]
        similarity[rows, column] = -1.0
        second[block] = similarity.max(axis=1)
    along = replace(options, max_ratio=options.guided_ratio)
    matches = mutual_matches(nearest, first, second, best_of_b, along)
    sampled = np.arange(0, len(b), options.guided_step)
    similarity = a[matches[:, 0]] @ b[sampled].T
    similarity[sampled == matches[:, 1:]] = -1.0
    next_sq = 2 - 2 * similarity.max(axis=1)
    return matches[2 - 2 * first[matches[:, 0]] < options.guided_ratio**2 * next_sq]


def _ordered_lines(fundamental: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return epipolar lines (N, 3) float32 with unit normals, and their order around the epipole."""
    lines = np.column_stack([points, np.ones(len(points))]) @ fundamental.T
    # All lines are combinations of two basis lines, even if the epipole is at infinity.
    basis = np.linalg.svd(fundamental)[0][:, :2]
    along = lines @ basis
    order = np.argsort(np.arctan2(along[:, 1], along[:, 0]) % np.pi, kind="stable")
    # Orient neighbouring lines alike, so that the same side is positive.
    lines *= np.where(along[:, 1] < 0, -1.0, 1.0)[:, None]
    lines /= np.maximum(np.linalg.norm(lines[:, :2], axis=1, keepdims=True), 1e-12)
    return lines.astype(np.float32), order


def _in_wedge(
    first: np.ndarray, last: np.ndarray, points: np.ndarray, reach_px: float
) -> np.ndarray:
    """Return indices of homogeneous points (3, N) between or near two lines through the epipole."""
    distance_px = np.stack([first, last]) @ points
    inside = (distance_px[0] * distance_px[1] <= 0) | (np.abs(distance_px) <= reach_px).any(axis=0)
    return np.flatnonzero(inside)
