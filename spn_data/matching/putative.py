"""Putative matches of two images: mutual nearest RootSIFT descriptors that pass the ratio test."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, kw_only=True)
class MatchOptions:
    """Options of descriptor matching and geometric verification.

    Attributes
    ----------
    max_ratio : float
        Ratio test: nearest over second-nearest descriptor distance (Lowe 2004).
    max_distance : float
        Largest distance of unit descriptors.
    max_error_px : float
        Epipolar error of an inlier.
    min_inliers : int
        Inliers of a verified pair.
    strongest : int
        Number of strongest features per image that decide whether two images overlap.
    telling_matches : int
        Number of putative matches of these that is needed to decide.
    least_share : float
        Inlier ratio of these matches below which the images are taken not to overlap.
    guided_share : float
        Inlier ratio of these matches from which guided matching is used for all features.
    guided_px : float
        Half width of the band around an epipolar line in guided matching.
    guided_step : int
        Every such feature outside the band takes part in the ratio test of guided matching.
    guided_ratio : float
        Replaces `max_ratio` in guided matching; stricter, because there are few competitors near a line.
    seed : int
        Random seed.
    """

    max_ratio: float = 0.8
    max_distance: float = 0.7
    max_error_px: float = 4.0
    min_inliers: int = 15
    strongest: int = 1024
    telling_matches: int = 30
    least_share: float = 0.36
    guided_share: float = 0.6
    guided_px: float = 6.0
    guided_step: int = 8
    guided_ratio: float = 0.7
    seed: int = 0


_ROWS = 64  # rows of the similarity matrix per block, so that a block fits into the CPU cache


def match_descriptors(
    descriptors_a: np.ndarray, descriptors_b: np.ndarray, options: MatchOptions
) -> np.ndarray:
    """Match two sets of descriptors.

    Parameters
    ----------
    descriptors_a, descriptors_b : ndarray of uint8, shape (N, 128) and (K, 128)
        RootSIFT descriptors.
    options : MatchOptions
        Supplies `max_ratio` and `max_distance`.

    Returns
    -------
    ndarray of uint32, shape (M, 2)
        Row indices of putative matches.
    """
    matcher = PutativeMatcher(descriptors_a, descriptors_b)
    matcher.extend(max(len(descriptors_a), len(descriptors_b)))
    return matcher.matches(options)


class PutativeMatcher:
    """Incremental exhaustive matcher of two images.

    It compares the first n descriptors of one image with the first n of the other; n can grow, and nothing is
    compared twice.
    """

    def __init__(self, descriptors_a: np.ndarray, descriptors_b: np.ndarray) -> None:
        """Create a matcher that has compared nothing yet.

        Parameters
        ----------
        descriptors_a, descriptors_b : ndarray of uint8, shape (N, 128) and (K, 128)
            RootSIFT descriptors.
        """
        self._descriptors = descriptors_a, descriptors_b
        # Unit descriptors of those compared so far: rows of a, columns of b.
        self._a = np.empty(descriptors_a.shape, np.float32)
        self._b = np.empty(descriptors_b.T.shape, np.float32)
        self._compared = 0, 0
        self._nearest = np.zeros(len(descriptors_a), np.int64)
        self._first, self._second = (
            np.full(len(descriptors_a), -1.0, np.float32) for _ in range(2)
        )
        self._best_of_b = np.full(len(descriptors_b), -1.0, np.float32)

    def extend(self, n: int) -> None:
        """Compare the first n descriptors of each image, or all if there are fewer."""
        a, b = self._descriptors
        rows, columns = self._compared
        self._compared = min(n, len(a)), min(n, len(b))
        new_rows, new_columns = slice(rows, self._compared[0]), slice(columns, self._compared[1])
        self._a[new_rows] = unit_descriptors(a[new_rows])
        self._b[:, new_columns] = unit_descriptors(b[new_columns]).T
        self._compare(slice(0, rows), new_columns)
        self._compare(new_rows, slice(0, new_columns.stop))

    def _compare(self, rows: slice, columns: slice) -> None:
        if columns.start >= columns.stop:
            return
        best_of_b = self._best_of_b[columns]
        for start in range(rows.start, rows.stop, _ROWS):
            block = slice(start, min(start + _ROWS, rows.stop))
            similarity = self._a[block] @ self._b[:, columns]
            np.maximum(best_of_b, similarity.max(axis=0), out=best_of_b)
            each, best = np.arange(len(similarity)), similarity.argmax(axis=1)
            first = similarity[each, best]
            similarity[each, best] = -1.0
            second = np.maximum(similarity.max(axis=1), np.minimum(first, self._first[block]))
            self._second[block] = np.maximum(self._second[block], second)
            nearer = first > self._first[block]
            self._nearest[block][nearer] = columns.start + best[nearer]
            self._first[block][nearer] = first[nearer]

    def matches(self, options: MatchOptions) -> np.ndarray:
        """Return putative matches (M, 2) uint32, row indices of the descriptors compared so far."""
        rows, columns = self._compared
        if rows == 0 or columns < 2:
            return np.zeros((0, 2), np.uint32)
        return mutual_matches(
            self._nearest[:rows], self._first[:rows], self._second[:rows], self._best_of_b, options
        )


def mutual_matches(
    nearest: np.ndarray,
    first: np.ndarray,
    second: np.ndarray,
    best_of_b: np.ndarray,
    options: MatchOptions,
) -> np.ndarray:
    """Return mutual nearest neighbours (M, 2) uint32 that pass the ratio test.

    nearest : (N,) rows of b; first, second : (N,) similarities of the nearest and second-nearest neighbour;
    best_of_b : (K,) highest similarity of each row of b.
    """
    distance_sq, second_sq = 2 - 2 * first, 2 - 2 * second
    good = (
        (first == best_of_b[nearest])
        & (distance_sq < options.max_ratio**2 * second_sq)
        & (distance_sq < options.max_distance**2)
    )
    matches = np.stack([np.flatnonzero(good), nearest[good]], axis=1).astype(np.uint32)
    # Two equal descriptors in a can both be the best match of one in b; keep the first.
    return matches[np.sort(np.unique(matches[:, 1], return_index=True)[1])]


def unit_descriptors(descriptors: np.ndarray) -> np.ndarray:
    """Normalise descriptors to unit length, (N, 128) float32."""
    floats = descriptors.astype(np.float32)
    return floats / np.maximum(np.linalg.norm(floats, axis=1, keepdims=True), 1e-12)
