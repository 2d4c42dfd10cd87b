"""Checks of a model against the matches of its images and the known focal lengths of its cameras."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spn_data.colmap.database import MapDatabase
from spn_data.colmap.model import Scene
from spn_data.geometry.epipolar import essential_matrix, sampson_errors
from spn_data.reconstruction.correspondences import FramesToMap

# Epipolar error of an inlier in units of the focal length, 12 px in a drone's video. With a wrong pose only a
# few percent of the matches are below it.
_MAX_ERROR = 0.0136
_MIN_SHARE = 0.5  # of a pair's matches that must be inliers


@dataclass(frozen=True)
class Contradiction:
    """Two images with many matches, of which the model's poses explain less than half.

    Attributes
    ----------
    images : (str, str)
        Image names.
    matches : int
        Number of verified matches.
    share : float
        Share of the matches that the poses explain.
    """

    images: tuple[str, str]
    matches: int
    share: float


def contradictions(database: MapDatabase, scene: Scene) -> list[Contradiction]:
    """Return the contradicted pairs of registered images, those with most matches first.

    Only pairs with at least the median number of matches are checked. Wrong pairs, which contradict a correct
    model, have few matches: facades with equal windows give a quarter of the median. If parts of a model have
    wrong relative poses, the best pairs between them are contradicted.
    """
    row = {name: k for k, name in enumerate(scene.names)}
    verified = database.verified_pairs()
    pairs = {pair: n for pair, n in verified.items() if pair[0] in row and pair[1] in row}
    if not pairs:
        return []
    min_matches = float(np.median(list(pairs.values())))
    rays: dict[str, np.ndarray] = {}
    found = []
    for (a, b), n in sorted(pairs.items()):
        if n < min_matches:
            continue
        for name in (a, b):
            if name not in rays:
                rays[name] = _rays(database, scene, name, row[name])
        matches = database.read_inliers(a, b)
        essential = essential_matrix(scene.poses, row[a], row[b])
        errors = sampson_errors(rays[a][matches[:, 0]], rays[b][matches[:, 1]], essential)
        share = float(np.mean(errors < _MAX_ERROR))
        if share < _MIN_SHARE:
            found.append(Contradiction((a, b), n, share))
    return sorted(found, key=lambda one: -one.matches)


def _rays(database: MapDatabase, scene: Scene, name: str, k: int) -> np.ndarray:
    """Return the normalized image coordinates (K, 2) of all features of an image."""
    pixels = database.read_keypoints(name)[:, :2].astype(np.float64)
    return scene.cameras[int(scene.camera_ids[k])].unproject(pixels)


@dataclass(frozen=True)
class FocalChange:
    """Camera whose known focal length changed during reconstruction.

    Attributes
    ----------
    camera : str
        Key of the camera.
    known_px, estimated_px : float
        Known and estimated focal length.
    """

    camera: str
    known_px: float
    estimated_px: float

    @property
    def ratio(self) -> float:
        """Longer focal length divided by the shorter one."""
        return max(self.estimated_px / self.known_px, self.known_px / self.estimated_px)


def focal_changes(scene: Scene, frames: FramesToMap, ratio: float) -> list[FocalChange]:
    """Return cameras of known focal length whose estimate differs too much, largest ratio first.

    A far longer focal length with a far larger distance gives the same image except for perspective. With
    weak geometry, bundle adjustments drift there without large errors or contradicted pairs.

    Parameters
    ----------
    scene : Scene
    frames : FramesToMap
        Provides the known focal lengths.
    ratio : float
        Maximum ratio of the longer to the shorter focal length.

    Returns
    -------
    list of FocalChange
    """
    changes = []
    for key, camera_id in frames.camera_ids(scene).items():
        start = frames.lenses[key]
        change = FocalChange(key, start.camera.focal_px[0], scene.cameras[camera_id].focal_px[0])
        if start.focal_is_known and change.ratio > ratio:
            changes.append(change)
    return sorted(changes, key=lambda one: -one.ratio)
