"""Guided matching equals masked exhaustive matching and finds more matches than unguided matching."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from spn_data.geometry.camera import Camera
from spn_data.matching.guided import match_guided
from spn_data.matching.putative import MatchOptions, match_descriptors, unit_descriptors

CAMERA = Camera.from_horizontal_fov(800, 600, 70)
OPTIONS = MatchOptions()
# Sideways, forward (the epipole is in the image), and both with some climb.
MOVES = [(1.0, 0.0, 0.0), (0.0, 0.0, 2.0), (0.7, 0.3, 0.8)]


def views(
    move: tuple[float, float, float], n: int = 700
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Create pixels (n, 2) of points in two views, their descriptors (n, 128), and F (3, 3)."""
    rng = np.random.default_rng(3)
    points = rng.uniform([-6, -4, 6], [6, 4, 14], size=(n, 3))
    shift = np.array(move)
    a, b = CAMERA.project(points), CAMERA.project(points - shift)
    x, y, z = -shift
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    inverse = np.linalg.inv(CAMERA.matrix)
    descriptors = rng.gamma(0.5, 40, size=(n, 128)).clip(0, 255).astype(np.uint8)
    return a, b + rng.normal(0, 0.3, (n, 2)), descriptors, inverse.T @ essential @ inverse


def off_lines(fundamental: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return distances (N, M) in pixels of points b from the epipolar lines of points a."""
    lines = np.column_stack([a, np.ones(len(a))]) @ fundamental.T
    lines /= np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
    return np.abs(lines @ np.column_stack([b, np.ones(len(b))]).T)


def compared_all(
    a: np.ndarray, da: np.ndarray, b: np.ndarray, db: np.ndarray, fundamental: np.ndarray
) -> set[tuple[int, int]]:
    """Match by definition: every feature with all near its line, and with a sample of the others."""
    everywhere = unit_descriptors(da) @ unit_descriptors(db).T
    similarity = np.where(off_lines(fundamental, a, b) > OPTIONS.guided_px, -1, everywhere)
    elsewhere = np.arange(0, len(b), OPTIONS.guided_step)
    found = set()
    for i, row in enumerate(similarity):
        first = int(np.argmax(row))
        others = np.concatenate(
            [np.delete(row, first), everywhere[i, elsewhere[elsewhere != first]]]
        )
        near, next_one = 2 - 2 * row[first], 2 - 2 * others.max()
        is_best = similarity[:, first].max() == row[first]
        telling = near < OPTIONS.guided_ratio**2 * next_one
        if is_best and telling and near < OPTIONS.max_distance**2:
            found.add((i, first))
    return found


@pytest.mark.parametrize("move", MOVES)
def test_it_finds_what_comparing_all_and_masking_finds(move) -> None:
    """Guided matching gives the matches of an exhaustive comparison masked by epipolar lines."""
    a, b, descriptors, fundamental = views(move)
    rng = np.random.default_rng(4)
    noisy = (descriptors + rng.integers(-20, 20, descriptors.shape)).clip(0, 255).astype(np.uint8)
    order = rng.permutation(len(b))
    found = match_guided(a, descriptors, b[order], noisy[order], fundamental, OPTIONS)
    expected = compared_all(a, descriptors, b[order], noisy[order], fundamental)
    # Another order of summation may change a tie or a comparison with a limit.
    assert len(expected ^ {(int(i), int(j)) for i, j in found}) <= 2
    assert np.mean(order[found[:, 1]] == found[:, 0]) > 0.99
    assert len(found) > 0.9 * len(a)


def test_most_of_what_repeats_elsewhere_is_matched_along_the_line() -> None:
    """Features with a repeated twin fail the plain ratio test and are matched along epipolar lines.

    An eighth of the twins takes part in the ratio test of guided matching, too.
    """
    a, b, descriptors, fundamental = views(MOVES[0], 300)
    rng = np.random.default_rng(5)
    places = np.concatenate([b, rng.uniform([0, 0], [800, 600], b.shape)])
    both = np.concatenate([descriptors, descriptors])
    both = (both + rng.integers(-20, 20, both.shape)).clip(0, 255).astype(np.uint8)
    assert len(match_descriptors(descriptors, both, OPTIONS)) < 0.02 * len(a)
    found = match_guided(a, descriptors, places, both, fundamental, OPTIONS)
    assert len(found) > 0.8 * len(a)
    assert np.mean(found[:, 0] == found[:, 1]) > 0.99


def test_what_is_alike_everywhere_gives_few_matches() -> None:
    """Two walls of similar bricks give few matches, though some brick is always nearest on a line."""
    rng = np.random.default_rng(7)
    bricks = rng.gamma(0.5, 40, size=(50, 128))
    a, b = (
        (bricks[rng.integers(0, 50, 2000)] + rng.normal(0, 15, (2000, 128)))
        .clip(0, 255)
        .astype(np.uint8)
        for _ in range(2)
    )
    places = rng.uniform([0, 0], [800, 600], (2, 2000, 2))
    fundamental = views(MOVES[2])[3]
    assert len(match_guided(places[0], a, places[1], b, fundamental, OPTIONS)) < 20
    fooled = replace(OPTIONS, guided_step=10**6, guided_ratio=OPTIONS.max_ratio)
    assert len(match_guided(places[0], a, places[1], b, fundamental, fooled)) > 200


@pytest.mark.parametrize("move", MOVES)
def test_no_match_is_off_its_line(move) -> None:
    """No match is farther from its epipolar line than the limit."""
    a, b, descriptors, fundamental = views(move)
    others = np.random.default_rng(6).permutation(b)
    found = match_guided(a, descriptors, others, descriptors, fundamental, OPTIONS)
    off = off_lines(fundamental, a, others)[found[:, 0], found[:, 1]]
    assert (off < OPTIONS.guided_px + 0.01).all()
    assert len(found) < 0.1 * len(a)


def test_without_features_there_are_no_matches() -> None:
    """An image without features gives no matches."""
    a, b, descriptors, fundamental = views(MOVES[0], 20)
    none = np.empty((0, 2)), np.empty((0, 128), np.uint8)
    assert match_guided(*none, b, descriptors, fundamental, OPTIONS).shape == (0, 2)
    assert match_guided(a, descriptors, *none, fundamental, OPTIONS).shape == (0, 2)
