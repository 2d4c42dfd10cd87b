"""Putative matches of two images: mutual nearest RootSIFT descriptors that pass the ratio test."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, kw_only=True)
class MatchOptions:
    """How descriptors are matched and pairs verified."""

    max_ratio: float = 0.8  # nearest to second-nearest distance (Lowe 2004)
    max_distance: float = 0.7  # of unit descriptors
    max_error_px: float = 4.0  # epipolar error of an inlier
    min_inliers: int = 15  # of a verified pair
    strongest: int = 1024  # features of each image that tell whether two of them overlap
    telling_matches: int = 30  # of these, from which on they do
    least_share: float = 0.36  # of these that fit one epipolar geometry, below which they do not
    guided_share: float = 0.6  # from which on the others are sought along epipolar lines
    guided_px: float = 6.0  # to either side of a line
    guided_step: int = 8  # every such feature elsewhere is compared as well
    guided_ratio: float = 0.7  # in place of max_ratio there: fewer others give as few wrong ones
    seed: int = 0


_ROWS = 64  # rows of the similarity matrix at a time: they stay in the processor's cache


def match_descriptors(
    descriptors_a: np.ndarray, descriptors_b: np.ndarray, options: MatchOptions
) -> np.ndarray:
    """Matches (M, 2) uint32 of row indices into two (N, 128) uint8 RootSIFT arrays."""
    if len(descriptors_a) == 0 or len(descriptors_b) < 2:
        return np.zeros((0, 2), np.uint32)
    a = unit_descriptors(descriptors_a)
    b_transposed = np.ascontiguousarray(unit_descriptors(descriptors_b).T)
    best_of_b = np.full(b_transposed.shape[1], -1.0, np.float32)
    nearest = np.empty(len(a), np.int64)
    first = np.empty(len(a), np.float32)
    second = np.empty(len(a), np.float32)
    for start in range(0, len(a), _ROWS):
        similarity = a[start : start + _ROWS] @ b_transposed
        rows = np.arange(len(similarity))
        block = slice(start, start + len(similarity))
        np.maximum(best_of_b, similarity.max(axis=0), out=best_of_b)
        nearest[block] = similarity.argmax(axis=1)
        first[block] = similarity[rows, nearest[block]]
        similarity[rows, nearest[block]] = -1.0
        second[block] = similarity.max(axis=1)
    return mutual_matches(nearest, first, second, best_of_b, options)


def mutual_matches(
    nearest: np.ndarray,
    first: np.ndarray,
    second: np.ndarray,
    best_of_b: np.ndarray,
    options: MatchOptions,
) -> np.ndarray:
    """Matches (M, 2) uint32 of features in a whose nearest in b has them as its nearest too.

    nearest : (N,) rows of b; first, second : (N,) similarities of the nearest and of the next, whose ratio
    of distances is tested; best_of_b : (K,) highest similarity of each row of b.
    """
    distance_sq, second_sq = 2 - 2 * first, 2 - 2 * second
    good = (
        (first == best_of_b[nearest])
        & (distance_sq < options.max_ratio**2 * second_sq)
        & (distance_sq < options.max_distance**2)
    )
    matches = np.stack([np.flatnonzero(good), nearest[good]], axis=1).astype(np.uint32)
    # Two equal descriptors in a can both be the best of one in b: only one of them may keep it.
    return matches[np.sort(np.unique(matches[:, 1], return_index=True)[1])]


def unit_descriptors(descriptors: np.ndarray) -> np.ndarray:
    """(N, 128) float32 of length one."""
    floats = descriptors.astype(np.float32)
    return floats / np.maximum(np.linalg.norm(floats, axis=1, keepdims=True), 1e-12)
