"""Effects in a model's residuals that points, poses and lens do not explain: linearized bundle adjustment.

A finished bundle adjustment has moved points, poses and lens to absorb as much of an unmodelled effect as
they can. To measure the effect, it is estimated jointly with them as an additional unknown of the same
least-squares problem, in one Gauss-Newton step, so that none of it is lost to them (Frisch-Waugh-Lovell
theorem).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from spn_data.colmap.model import MapObservations, Scene
from spn_data.geometry.camera import Camera
from spn_data.geometry.least_squares import (
    LENS,
    POSE,
    point_whitening,
    projection_jacobians,
    rows_to_sparse,
)
from spn_data.geometry.pose import to_camera

FRAME_EFFECTS = 3  # zoom, shear and stretch of one frame
_PER_FRAME = POSE + FRAME_EFFECTS
_POINT_RIDGE = 1e-7  # the depth of points with tiny triangulation angles is undetermined
_RIDGE = 1e-9  # relative to each unknown's information: the gauge is free, which makes the matrix singular


@dataclass(frozen=True, eq=False)
class LensObservations:
    """M observations in F frames of one lens, linearized at the model.

    Attributes
    ----------
    frames : ndarray, shape (F,)
        Rows in the scene.
    frame : ndarray, shape (M,)
        Frame of each observation, 0 to F-1.
    weights : ndarray, shape (M,)
        Robust weights.
    effects : ndarray, shape (M, 2, E)
        Displacement of the measured pixel in px per unit of each effect to estimate.
    residuals_px : ndarray, shape (M, 2)
        Projected minus measured.
    per_frame : ndarray, shape (M, 2, 9)
        Jacobian of the residuals by pose, zoom, shear and stretch.
    lens : ndarray, shape (M, 2, 8)
        Jacobian by the intrinsics.
    whitened : ndarray, shape (M, 2, 3)
        Jacobian by the point, orthonormal over the point's observations.
    point : ndarray, shape (M,)
        Point of each observation, 0 to P-1.
    normal : ndarray, shape (9F+8+E+1, 9F+8+E+1)
        Weighted normal equations with the points eliminated (Schur complement). The E columns before the last
        one belong to the effects, the last one to the residual.
    """

    frames: np.ndarray
    frame: np.ndarray
    weights: np.ndarray
    effects: np.ndarray
    residuals_px: np.ndarray
    per_frame: np.ndarray
    lens: np.ndarray
    whitened: np.ndarray
    point: np.ndarray
    normal: np.ndarray

    @property
    def frame_columns(self) -> np.ndarray:
        """Columns (F, 9) of `normal`: pose, then zoom, shear, stretch."""
        return np.arange(_PER_FRAME * len(self.frames)).reshape(-1, _PER_FRAME)

    @property
    def degrees_of_freedom(self) -> int:
        """Degrees of freedom of the residuals after points and poses."""
        return int(2 * len(self.frame) - 3 * (self.point.max() + 1) - POSE * len(self.frames))


@dataclass(frozen=True, eq=False)
class Partialled:
    """Effects and residuals of a block after removing what points, poses and lens explain of them.

    Attributes
    ----------
    effects : ndarray, shape (M, 2, E)
    residuals_px : ndarray, shape (M, 2)
    pose_per_effect : ndarray, shape (F, 6, E)
        Displacement of the poses by one unit of the effect if it is not modelled.
    """

    effects: np.ndarray
    residuals_px: np.ndarray
    pose_per_effect: np.ndarray


def frame_effects(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Return displacements (M, 2, 3) by a zoom, shear and stretch of 1 about the image centre.

    Zoom scales both axes; shear shifts rows sideways in proportion to their distance below the centre;
    stretch scales the row distance only.
    """
    x, y = (pixels - np.array([camera.width, camera.height]) / 2).T
    zero = np.zeros_like(x)
    return np.stack(
        [np.stack([x, y], axis=1), np.stack([y, zero], axis=1), np.stack([zero, y], axis=1)],
        axis=2,
    )


def linearize(
    scene: Scene,
    seen: MapObservations,
    frames: np.ndarray,
    twists: np.ndarray,
    trend: np.ndarray,
    *,
    max_observations: int,
) -> LensObservations | None:
    """Linearize the observations of some frames (F,) of one lens.

    The effects are rolling shutter (per second of readout) and zoom trend.

    Parameters
    ----------
    scene : Scene
    seen : MapObservations
    frames : ndarray, shape (F,)
        Rows in the scene.
    twists : ndarray, shape (F, 6)
        Velocity of a static world in the camera frame per second: translation, then rotation vector.
    trend : ndarray, shape (F,)
        Weight of the zoom trend in each frame.
    max_observations : int
        Number of observations to use, drawn by whole tracks.

    Returns
    -------
    LensObservations or None
        None if tracks of three or more frames have too few observations.
    """
    camera = scene.cameras[int(scene.camera_ids[frames[0]])]
    place = np.full(len(scene.names), -1)
    place[frames] = np.arange(len(frames))
    rows = np.flatnonzero((place[seen.image_idx] >= 0) & np.isfinite(seen.residuals_px).all(axis=1))
    # A point near the camera's plane projects anywhere, and no weight bounds its derivatives.
    length = np.linalg.norm(seen.residuals_px[rows], axis=1)
    rows = rows[length <= 20 * np.median(length)] if len(rows) else rows
    tracks = np.bincount(seen.point_idx[rows], minlength=len(scene.points))
    # Choose tracks at random, not by length: long tracks cover only some parts of the scene.
    order = np.random.default_rng(0).permutation(np.flatnonzero(tracks >= 3))
    order = order[: int(np.searchsorted(np.cumsum(tracks[order]), max_observations)) + 1]
    position = np.full(len(scene.points), -1)
    position[order] = np.arange(len(order))
    rows = rows[position[seen.point_idx[rows]] >= 0]
    if len(rows) < 20 * len(frames):
        return None
    frame, point = place[seen.image_idx[rows]], position[seen.point_idx[rows]]
    poses = scene.poses[frames]
    rotations = poses.rotations[frame]
    points_cam = to_camera(scene.points[seen.point_idx[rows]], poses.centers[frame], rotations)
    by_point, lens = projection_jacobians(camera, points_cam)
    # Unlike elsewhere, translations are along the camera's axes.
    pose = np.concatenate([by_point, np.cross(points_cam[:, None], by_point)], axis=2)
    pixels = seen.pixels[rows]
    share = pixels[:, 1] / camera.height - 0.5
    shutter = share[:, None] * np.einsum("mij,mj->mi", pose, twists[frame])
    own = frame_effects(camera, pixels)
    effects = np.stack([shutter, own[:, :, 0] * trend[frame][:, None]], axis=2)
    residuals = seen.residuals_px[rows]
    weights = huber_weights(residuals)
    per_frame = np.concatenate([pose, own], axis=2)
    by_place = by_point @ rotations
    inverse_root = point_whitening(
        np.sqrt(weights)[:, None, None] * by_place, point, len(order), ridge=_POINT_RIDGE
    )
    whitened = by_place @ np.swapaxes(inverse_root, 1, 2)[point]
    shared = np.concatenate([lens, effects, residuals[:, :, None]], axis=2)
    normal = _normal(per_frame, shared, frame, len(frames), whitened, point, weights)
    return LensObservations(
        frames, frame, weights, effects, residuals, per_frame, lens, whitened, point, normal
    )


def huber_weights(residuals_px: np.ndarray, *, beyond_sigmas: float = 2.5) -> np.ndarray:
    """Return Huber weights (M,) of residuals (M, 2); sigma is estimated from the median length."""
    length = np.linalg.norm(residuals_px, axis=1)
    sigma = max(float(np.median(length)) / 1.1774, 1e-6)  # median of a Rayleigh distribution
    return np.minimum(1.0, beyond_sigmas * sigma / np.maximum(length, 1e-12))


def _normal(
    per_frame: np.ndarray,
    shared: np.ndarray,
    frame: np.ndarray,
    frames: int,
    whitened: np.ndarray,
    point: np.ndarray,
    weights: np.ndarray,
) -> np.ndarray:
    """Return the normal equations with whitened points eliminated."""
    m = len(frame)
    first_shared = _PER_FRAME * frames
    columns = np.concatenate(
        [
            _PER_FRAME * frame[:, None] + np.arange(_PER_FRAME),
            np.broadcast_to(first_shared + np.arange(shared.shape[2]), (m, shared.shape[2])),
        ],
        axis=1,
    )
    root = np.sqrt(weights)[:, None, None]
    a = rows_to_sparse(
        root * np.concatenate([per_frame, shared], axis=2), columns, first_shared + shared.shape[2]
    )
    count = int(point.max()) + 1
    p = rows_to_sparse(root * whitened, 3 * point[:, None] + np.arange(3), 3 * count)
    through_points = p.T @ a
    direct = a.T @ a
    normal = np.asarray((direct - through_points.T @ through_points).todense())
    # The information left after eliminating the points can be below the rounding error.
    normal[np.diag_indices(len(normal))] += 1e-8 * direct.diagonal()
    return normal


def partial_out(block: LensObservations) -> Partialled:
    """Remove from effects and residuals what points, poses and lens explain of them."""
    frames = len(block.frames)
    first_shared = _PER_FRAME * frames
    nuisance = np.concatenate(
        [block.frame_columns[:, :POSE].ravel(), first_shared + np.arange(LENS)]
    )
    wanted = np.arange(first_shared + LENS, len(block.normal))
    solved = solve_spd(
        block.normal[np.ix_(nuisance, nuisance)], block.normal[np.ix_(nuisance, wanted)]
    )
    pose, lens = np.split(solved, [POSE * frames])
    pose = pose.reshape(frames, POSE, -1)
    values = np.concatenate([block.effects, block.residuals_px[:, :, None]], axis=2)
    values = values - block.per_frame[:, :, :POSE] @ pose[block.frame] - block.lens @ lens
    by_point = np.zeros((int(block.point.max()) + 1, 3, values.shape[2]))
    weighted = block.weights[:, None, None] * (np.swapaxes(block.whitened, 1, 2) @ values)
    np.add.at(by_point, block.point, weighted)
    values = values - block.whitened @ by_point[block.point]
    return Partialled(values[:, :, :-1], values[:, :, -1], pose[:, :, :-1])


def solve_spd(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solve a positive semi-definite system.

    The matrix is scaled to unit diagonal and regularized against undetermined combinations.
    """
    diagonal = np.diag(matrix)
    scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    scaled = matrix * scale[:, None] * scale
    scaled[np.diag_indices(len(scaled))] += _RIDGE
    factor = linalg.cho_factor(scaled, check_finite=True)
    return np.asarray(scale[:, None] * linalg.cho_solve(factor, right * scale[:, None]))
