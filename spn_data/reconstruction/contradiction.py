"""Whether a model contradicts what its images show together, or what is known of its lenses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spn_data.colmap.database import MapDatabase
from spn_data.colmap.model import Scene
from spn_data.geometry.epipolar import essential_matrix, sampson_errors
from spn_data.reconstruction.correspondences import FramesToMap

# Epipolar error of a match in focal lengths, 12 px of a drone's video; a wrong pose leaves a few hundredths
# of them below it.
_FITS = 0.0136
_SHARE = 0.5  # of a pair's matches that must fit


@dataclass(frozen=True)
class Contradiction:
    """Two images that match well, of whose matches the model's poses explain less than half."""

    images: tuple[str, str]
    matches: int
    share: float  # that fits


def contradictions(database: MapDatabase, scene: Scene) -> list[Contradiction]:
    """Of the pairs of registered images that have the median number of matches or more; worst first.

    Wrong pairs, which a right model contradicts, have few matches: facades of equal windows give a quarter
    of the median. Between parts that lie wrongly to each other it is the best pairs that are contradicted.
    """
    row = {name: k for k, name in enumerate(scene.names)}
    verified = database.verified_pairs()
    pairs = {pair: n for pair, n in verified.items() if pair[0] in row and pair[1] in row}
    if not pairs:
        return []
    telling = float(np.median(list(pairs.values())))
    rays: dict[str, np.ndarray] = {}
    found = []
    for (a, b), n in sorted(pairs.items()):
        if n < telling:
            continue
        for name in (a, b):
            if name not in rays:
                rays[name] = _rays(database, scene, name, row[name])
        matches = database.read_inliers(a, b)
        essential = essential_matrix(scene.poses, row[a], row[b])
        off = sampson_errors(rays[a][matches[:, 0]], rays[b][matches[:, 1]], essential)
        share = float(np.mean(off < _FITS))
        if share < _SHARE:
            found.append(Contradiction((a, b), n, share))
    return sorted(found, key=lambda one: -one.matches)


def _rays(database: MapDatabase, scene: Scene, name: str, k: int) -> np.ndarray:
    """(K, 2) of all features of an image, on the plane at distance one."""
    pixels = database.read_keypoints(name)[:, :2].astype(np.float64)
    return scene.cameras[int(scene.camera_ids[k])].unproject(pixels)


@dataclass(frozen=True)
class FocalChange:
    """A lens whose focal length was known, and came out otherwise."""

    camera: str
    said_px: float
    found_px: float

    @property
    def ratio(self) -> float:
        """Of the longer to the shorter one."""
        return max(self.found_px / self.said_px, self.said_px / self.found_px)


def focal_changes(scene: Scene, frames: FramesToMap, ratio: float) -> list[FocalChange]:
    """Lenses of known focal length that came out by more than `ratio` longer or shorter; worst first.

    Far longer and far off, what a flight shows looks the same but for perspective: a weak geometry lets
    adjustments drift there, without a large error or a pair that tells.
    """
    key_of = dict(zip(frames.names, frames.cameras.tolist(), strict=True))
    lenses = {key_of[n]: int(i) for n, i in zip(scene.names, scene.camera_ids, strict=True)}
    changes = []
    for key, camera_id in lenses.items():
        start, known = frames.start_cameras[key]
        change = FocalChange(key, start.focal_px[0], scene.cameras[camera_id].focal_px[0])
        if known and change.ratio > ratio:
            changes.append(change)
    return sorted(changes, key=lambda one: -one.ratio)
