"""Flight along a facade whose window columns look identical, with exact poses, pixels and matches."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from spn_data.colmap.model import MapObservations, Scene
from spn_data.geometry.camera import Camera
from spn_data.geometry.initial_lens import InitialLens
from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import rotations_from_angles
from spn_data.labels.map_points import MapPoints
from spn_data.registration.frozen_map import MapFrame
from spn_data.registration.solution import UnsolvedSequence
from spn_data.registration.tracks import find_tracks
from spn_data.uncertainty.map_covariance import FunctionalCovariance

PITCH_M = 2.0  # between window columns
COLUMNS = 12
A_COLUMN = 30  # points per column
LENS = Camera("RADIAL", 320, 240, np.array([280.0, 160.0, 120.0, -0.05, 0.01]))
KNOWN = InitialLens(LENS, 1e-6, "given")


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


class FacadeMap:
    """Stand-in for FrozenMap: every point has its own descriptor, seen half a metre beside each frame."""

    def __init__(self, made: Flight, seed: int = 7):
        p, n = len(made.points), len(made.poses)
        rng = np.random.default_rng(seed)
        self._of_point = (512 * np.sqrt(rng.dirichlet(np.full(128, 0.3), p))).clip(0, 255)
        self._shows = dict(zip(self._names(n), made.shows, strict=True))
        self.points = MapPoints(
            np.arange(100, 100 + p), made.points, np.zeros((p, 3), np.uint8), np.full(p, 5)
        )
        beside = replace(made.poses, centers=made.poses.centers + np.array([0.5, 0, 0]))
        names = tuple(self._names(n))
        lens = {1: LENS}
        self.scene = Scene(names, beside, np.ones(n, int), lens, made.points, np.full(p, 5))
        seen = np.concatenate(made.shows)
        pixels = np.zeros((len(seen), 2))
        frame = np.repeat(np.arange(n), [len(shows) for shows in made.shows])
        self.observations = MapObservations(frame, seen, pixels, pixels)

    @staticmethod
    def _names(count: int) -> list[str]:
        return [f"map/{k}.jpg" for k in range(count)]

    def descriptors(self, points: np.ndarray) -> np.ndarray:
        """Return descriptors (K, 128) of features that show these points."""
        return self._of_point[points].astype(np.uint8)

    def frame(self, name: str) -> MapFrame:
        """Return a map frame."""
        return MapFrame(self.descriptors(self._shows[name]), self._shows[name])


class PerfectMap:
    """Covariance of a map without errors."""

    sigma_px = 0.3

    def functional_covariances(self, functionals):  # type: ignore[no-untyped-def]
        sizes = [f.by_points.shape[0] for f in functionals]
        return [FunctionalCovariance(*np.zeros((2, r, r))) for r in sizes]
