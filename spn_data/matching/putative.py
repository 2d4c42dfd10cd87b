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
    comparison = DescriptorComparison(descriptors_a, descriptors_b)
    comparison.extend(max(len(descriptors_a), len(descriptors_b)))
    return comparison.matches(options)


class DescriptorComparison:
    """All with all of the first n descriptors of two images, where n can grow: nothing is compared twice."""

    def __init__(self, descriptors_a: np.ndarray, descriptors_b: np.ndarray) -> None:
        """(N, 128) and (K, 128) uint8 RootSIFT."""
        self._descriptors = descriptors_a, descriptors_b
        # Of unit length, as far as they are compared; rows of one and columns of the other.
        self._a = np.empty(descriptors_a.shape, np.float32)
        self._b = np.empty(descriptors_b.T.shape, np.float32)
        self._compared = 0, 0
        self._nearest = np.zeros(len(descriptors_a), np.int64)
        self._first, self._second = (
            np.full(len(descriptors_a), -1.0, np.float32) for _ in range(2)
        )
        self._best_of_b = np.full(len(descriptors_b), -1.0, np.float32)

    def extend(self, n: int) -> None:
        """Compare the first n of each, or all where there are fewer."""
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
        """(M, 2) uint32 row indices of those compared so far: mutual nearest that pass the ratio test."""
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
