"""Views of the ground: how many frames see each cell, and which of them shows it best."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses
from spn_data.orthophoto.ground import GroundRaster

_STEEPEST_DEG = 78.0  # between the view and the vertical: flatter views smear the ground
_BORDER = 0.02  # of the image, where lenses are worst
_SAMPLES = 48  # along a line of sight
_CLEARANCE_M = 0.3


@dataclass(frozen=True, eq=False)
class GroundViews:
    """What N frames see of the cells (R, C) of a ground.

    Attributes
    ----------
    count : ndarray of int, shape (R, C)
        Number of frames that see the whole cell, not hidden by what stands before it.
    best : ndarray of int, shape (R, C)
        Frame with the finest sampling of the cell, -1 if none sees it.
    sampling_m : ndarray, shape (R, C)
        Size of a pixel of that frame on the ground, along its view; NaN if none.
    slope : ndarray, shape (R, C)
        Tangent of the angle between that view and the vertical: displacement per error of height.
    """

    count: np.ndarray
    best: np.ndarray
    sampling_m: np.ndarray
    slope: np.ndarray


def ground_views(
    ground: GroundRaster, poses: Poses, cameras: Mapping[str, Camera], camera_of: np.ndarray
) -> GroundViews:
    """Find the frames that see each cell of the ground.

    Parameters
    ----------
    ground : GroundRaster
    poses : Poses
        Poses of N frames.
    cameras : mapping of str to Camera
        Cameras by key.
    camera_of : ndarray of str, shape (N,)
        Camera of each frame.

    Returns
    -------
    GroundViews
    """
    shape = ground.height_m.shape
    known = np.flatnonzero(np.isfinite(ground.height_m).ravel())
    center = ground.centers.reshape(-1, 3)[known]
    half = ground.cell_m / 2
    steps = np.array([(x, y, 0.0) for x in (-half, half) for y in (-half, half)])
    count = np.zeros(len(known), np.int64)
    best = np.full(len(known), -1)
    finest, slope = np.full(len(known), np.inf), np.full(len(known), np.nan)
    lowest = np.cos(np.deg2rad(_STEEPEST_DEG))
    for k in range(len(poses)):
        camera = cameras[str(camera_of[k])]
        ray = center - poses.centers[k]
        distance = np.linalg.norm(ray, axis=1)
        down = -ray[:, 2] / np.maximum(distance, 1e-9)
        rows = np.flatnonzero(down > lowest)
        rows = rows[_in_image(camera, poses.to_camera(center[rows], k))]
        corners = (center[rows, None] + steps).reshape(-1, 3)
        rows = rows[_in_image(camera, poses.to_camera(corners, k)).reshape(-1, 4).all(axis=1)]
        rows = rows[_is_free(ground, poses.centers[k], center[rows])]
        count[rows] += 1
        sampling = distance[rows] / (min(camera.focal_px) * down[rows])
        finer = sampling < finest[rows]
        rows, sampling = rows[finer], sampling[finer]
        best[rows], finest[rows] = k, sampling
        slope[rows] = np.sqrt(1 - down[rows] ** 2) / down[rows]
    finest[best < 0] = np.nan

    def on_grid(values: np.ndarray, otherwise: float) -> np.ndarray:
        grid = np.full(shape[0] * shape[1], otherwise, dtype=values.dtype)
        grid[known] = values
        return grid.reshape(shape)

    return GroundViews(
        on_grid(count, 0), on_grid(best, -1), on_grid(finest, np.nan), on_grid(slope, np.nan)
    )


def _in_image(camera: Camera, points_cam: np.ndarray) -> np.ndarray:
    """Return which points (M, 3) in camera coordinates lie in the image, its border aside."""
    ahead = points_cam[:, 2] > 1e-6
    # Polynomials of distortion fold back far outside the image, so that the pixel alone does not tell.
    with np.errstate(divide="ignore", invalid="ignore"):
        tangents = np.abs(points_cam[:, :2] / points_cam[:, 2:])
    edge = np.array([camera.width, camera.height]) / np.array(camera.focal_px)
    ahead &= np.all(tangents < edge, axis=1)
    found = np.zeros(len(points_cam), bool)
    pixels = camera.project(points_cam[ahead])
    size = np.array([camera.width, camera.height])
    found[ahead] = np.all((pixels > _BORDER * size) & (pixels < (1 - _BORDER) * size), axis=1)
    return found


def _is_free(ground: GroundRaster, eye: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Return which targets (M, 3) on the ground are not hidden from the eye by what stands between."""
    length = np.linalg.norm(targets[:, :2] - eye[:2], axis=1)
    near = np.minimum(1.5 * ground.cell_m / np.maximum(length, 1e-9), 1.0)  # cells of both ends
    hidden = np.zeros(len(targets), bool)
    for share in np.linspace(0, 1, _SAMPLES):
        along = near + share * (1 - 2 * near)
        place = eye + along[:, None] * (targets - eye)
        row, column, inside = ground.cells_of(place[:, :2])
        top = ground.top_m[row, column]
        hidden |= inside & (near < 0.5) & (top > place[:, 2] + _CLEARANCE_M)
    return ~hidden
