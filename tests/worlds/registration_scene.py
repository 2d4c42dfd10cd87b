"""Flight along a facade whose window columns look identical, with exact poses, pixels and matches."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import rotations_from_angles
from spn_data.registration.solution import UnsolvedSequence
from spn_data.registration.tracks import find_tracks

PITCH_M = 2.0  # between window columns
COLUMNS = 12
A_COLUMN = 30  # points per column
LENS = Camera("RADIAL", 320, 240, np.array([280.0, 160.0, 120.0, -0.05, 0.01]))


@dataclass(frozen=True, eq=False)
class Flight:
    """N frames. points : (P, 3), column by column. shows : N arrays (K,), the point of each feature."""

    poses: Poses
    points: np.ndarray
    pixels: list[np.ndarray]
    shows: list[np.ndarray]

    @property
    def pairs(self) -> dict[tuple[int, int], np.ndarray]:
        """Correct matches (K, 2) of each frame with the next three."""
        n = len(self.shows)
        found = {}
        for i in range(n):
            for j in range(i + 1, min(n, i + 4)):
                _, a, b = np.intersect1d(self.shows[i], self.shows[j], return_indices=True)
                found[i, j] = np.column_stack([a, b])
        return found

    def matched(self, columns_off: Mapping[int, int] | None = None) -> list[np.ndarray]:
        """Match each frame with the map, shifted by whole columns for the frames in `columns_off`."""
        found = []
        for row, shows in enumerate(self.shows):
            point = shows + A_COLUMN * (columns_off or {}).get(row, 0)
            there = (point >= 0) & (point < len(self.points))
            found.append(np.column_stack([np.flatnonzero(there), point[there]]))
        return found

    def sequence(self, putative: list[np.ndarray]) -> UnsolvedSequence:
        """Return the flight as a sequence to register, with putative matches with the map."""
        tracks = find_tracks(self.pairs, [len(p) for p in self.pixels])
        return UnsolvedSequence(self.pixels, putative, tracks, self.points)


def flight(frames: int = 8, *, noise_px: float = 0.3, seed: int = 5) -> Flight:
    """Simulate a flight of one metre per frame along the facade, eight metres from it."""
    rng = np.random.default_rng(seed)
    column = rng.uniform([0, 0, 0], [PITCH_M, 1.5, 6], (A_COLUMN, 3))
    points = np.concatenate([column + np.array([PITCH_M * c, 0, 0]) for c in range(COLUMNS)])
    x = 8 + np.arange(frames)
    centers = np.column_stack([x, -8 + 0.3 * np.sin(x), 3 + 0.3 * np.cos(x)])
    poses = Poses.from_rotations(centers, rotations_from_angles(rng.normal(0, 2, (frames, 3))))
    pixels, shows = [], []
    for center, rotation in zip(poses.centers, poses.rotations, strict=True):
        seen = LENS.project((points - center) @ rotation.T)
        inside = ((seen > 0) & (seen < [LENS.width, LENS.height])).all(axis=1)
        shows.append(np.flatnonzero(inside))
        pixels.append(seen[inside] + rng.normal(0, noise_px, (int(inside.sum()), 2)))
    return Flight(poses, points, pixels, shows)
