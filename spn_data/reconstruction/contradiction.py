"""Checks of a model against the matches and the fixes of its images, and known focal lengths."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import pdist

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


@dataclass(frozen=True)
class ShapeError:
    """Contradiction between the shape of a model and the fixes of its images.

    Attributes
    ----------
    error_m, distance_m : float
        Medians over all pairs of cameras: of the error of their distance, and of their distance.
    """

    error_m: float
    distance_m: float


# Median error of distances between cameras, relative to the median distance: at most 0.05 for right models of
# drone flights with consumer receivers, at least 0.33 where look-alike places were taken for one.
_MAX_SHAPE_ERROR = 0.25
_MIN_SHAPE_ERROR_M = 4.0  # that a consumer receiver does not explain
_MOST_COMPARED = 500  # cameras, evenly chosen


def shape_error(centers: np.ndarray, fixes_m: np.ndarray) -> ShapeError | None:
    """Compare the distances between cameras with those between their fixes.

    No alignment is needed, and what all fixes have in common does not matter.

    Parameters
    ----------
    centers : ndarray, shape (N, 3)
        Camera centres of a model.
    fixes_m : ndarray, shape (N, 3)
        Their positions in ENU metres; NaN if unknown.

    Returns
    -------
    ShapeError or None
        None if the fixes do not contradict the model, or are fewer than five.
    """
    known = np.flatnonzero(np.isfinite(fixes_m).all(axis=1))
    known = known[:: max(1, len(known) // _MOST_COMPARED)]
    if len(known) < 5:
        return None
    model, metres = pdist(centers[known]), pdist(fixes_m[known])
    far = metres >= max(float(np.median(metres)), 1e-6)
    scale = float(np.median(model[far] / metres[far])) if far.any() else 0.0
    if scale <= 0:
        return None
    error, distance = float(np.median(np.abs(model / scale - metres))), float(np.median(metres))
    if error <= max(_MIN_SHAPE_ERROR_M, _MAX_SHAPE_ERROR * distance):
        return None
    return ShapeError(error, distance)
