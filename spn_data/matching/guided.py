"""Matches of two images whose epipolar geometry is known: each feature is compared along its line alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from spn_data.matching.putative import MatchOptions, mutual_matches, unit_descriptors

_ROWS = 128  # features whose lines are neighbours, compared at a time


def match_along_lines(
    points_a: np.ndarray,
    descriptors_a: np.ndarray,
    points_b: np.ndarray,
    descriptors_b: np.ndarray,
    fundamental: np.ndarray,
    options: MatchOptions,
) -> np.ndarray:
    """Matches (M, 2) uint32 of row indices: mutual nearest within options.guided_px of the epipolar lines.

    points : (N, 2) pixels. descriptors : (N, 128) uint8 RootSIFT. fundamental (3, 3) : x_b' F x_a = 0.
    Lines of one image all pass through one point: in their order, neighbouring ones enclose a wedge of the
    other image, and only what lies in it is compared, for a tenth of the cost of all. Whatever is found on a
    line fits the geometry, true or not, so that the ratio test must tell; few features lie along a line, and
    every `guided_step`-th of those elsewhere takes part in it, too.
    """
    if len(points_a) == 0 or len(points_b) < 2:
        return np.zeros((0, 2), np.uint32)
    lines, order = _ordered_lines(fundamental, points_a)
    a, b = unit_descriptors(descriptors_a), unit_descriptors(descriptors_b)
    places = np.concatenate([points_b.T, np.ones((1, len(points_b)))]).astype(np.float32)
    best_of_b = np.full(len(b), -1.0, np.float32)
    nearest = np.zeros(len(a), np.int64)
    first, second = (np.full(len(a), -1.0, np.float32) for _ in range(2))
    for start in range(0, len(a), _ROWS):
        block = order[start : start + _ROWS]
        candidates = _in_wedge(lines[block[0]], lines[block[-1]], places, options.guided_px)
        if not len(candidates):
            continue
        similarity = a[block] @ b[candidates].T
        off = lines[block] @ places[:, candidates]
        similarity[np.abs(off) > options.guided_px] = -1.0
        best_of_b[candidates] = np.maximum(best_of_b[candidates], similarity.max(axis=0))
        rows, column = np.arange(len(block)), similarity.argmax(axis=1)
        nearest[block], first[block] = candidates[column], similarity[rows, column]
        similarity[rows, column] = -1.0
        second[block] = similarity.max(axis=1)
    along = replace(options, max_ratio=options.guided_ratio)
    matches = mutual_matches(nearest, first, second, best_of_b, along)
    elsewhere = np.arange(0, len(b), options.guided_step)
    similarity = a[matches[:, 0]] @ b[elsewhere].T
    similarity[elsewhere == matches[:, 1:]] = -1.0
    next_sq = 2 - 2 * similarity.max(axis=1)
    return matches[2 - 2 * first[matches[:, 0]] < options.guided_ratio**2 * next_sq]


def _ordered_lines(fundamental: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Epipolar lines (N, 3) float32 of points, unit normals first, and their order around the epipole."""
    lines = np.column_stack([points, np.ones(len(points))]) @ fundamental.T
    # They are combinations of two of them, wherever the epipole lies, at infinity too.
    basis = np.linalg.svd(fundamental)[0][:, :2]
    along = lines @ basis
    order = np.argsort(np.arctan2(along[:, 1], along[:, 0]) % np.pi, kind="stable")
    # The same side is positive for neighbours.
    lines *= np.where(along[:, 1] < 0, -1.0, 1.0)[:, None]
    lines /= np.maximum(np.linalg.norm(lines[:, :2], axis=1, keepdims=True), 1e-12)
    return lines.astype(np.float32), order


def _in_wedge(
    one: np.ndarray, other: np.ndarray, places: np.ndarray, reach_px: float
) -> np.ndarray:
    """Indices of points (3, N) between two lines through the epipole, or near one of them."""
    off = np.stack([one, other]) @ places
    inside = (off[0] * off[1] <= 0) | (np.abs(off) <= reach_px).any(axis=0)
    return np.flatnonzero(inside)
