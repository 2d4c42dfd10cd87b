"""Views that a flight lacks to determine the focal length of its camera."""

from __future__ import annotations

import numpy as np

from spn_data.colmap.model import MapObservations, Scene

_SAME_DIRECTION_DEG = 25.0  # of 95 % of the views about their mean
_ONE_AXIS = 0.8  # length of the mean of doubled headings; 1 if all lie on one axis
_ONE_HEIGHT = 0.15  # spread of the heights over the viewing distance


def missing_views(scene: Scene, distance: float) -> tuple[str, ...]:
    """Return by name what further frames would determine a focal length: none if views converge.

    Parameters
    ----------
    scene : Scene
    distance : float
        Viewing distance, in units of the model.

    Returns
    -------
    tuple of str
    """
    rotations, centers = scene.poses.rotations, scene.poses.centers
    look = rotations[:, 2]
    mean = look.mean(axis=0)
    if np.linalg.norm(mean) < 0.5:  # all around
        return ()
    mean /= np.linalg.norm(mean)
    apart_deg = np.rad2deg(np.arccos(np.clip(look @ mean, -1.0, 1.0)))
    if np.quantile(apart_deg, 0.95) > _SAME_DIRECTION_DEG:
        return ()
    missing = []
    first = np.cross(mean, np.eye(3)[np.argmin(np.abs(mean))])
    first /= np.linalg.norm(first)
    top = -rotations[:, 1]
    heading = np.arctan2(top @ np.cross(mean, first), top @ first)
    if np.abs(np.exp(2j * heading).mean()) > _ONE_AXIS:
        missing.append("cross lines (camera turned by 90 deg)")
    missing.append("oblique frames (30 deg or more from the others)")
    apart = centers - centers.mean(axis=0)
    heights = apart @ np.linalg.svd(apart, full_matrices=False)[2][-1]
    if np.ptp(np.quantile(heights, [0.05, 0.95])) < _ONE_HEIGHT * distance:
        missing.append("a second height (a third higher or lower)")
    return tuple(missing)


def viewing_distance(scene: Scene, seen: MapObservations) -> float:
    """Return the median depth of the measured points in their images, in units of the model."""
    frame = seen.image_idx
    offsets = scene.points[seen.point_idx] - scene.poses.centers[frame]
    return float(np.median(np.einsum("ni,ni->n", offsets, scene.poses.rotations[frame, 2])))
