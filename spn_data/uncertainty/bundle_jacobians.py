"""A bundle adjustment at its solution: derivatives of its residuals, points eliminated.

The unknowns that stay are those of the frames (6 each) and of the lenses that mapping estimated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from spn_data.colmap.model import MapObservations, Scene
from spn_data.geometry.camera import MODELS, Camera
from spn_data.geometry.least_squares import (
    POSE,
    lens_parameter_jacobian,
    point_whitening,
    pose_jacobians,
    projection_jacobians,
    rows_to_sparse,
)

GAUGE = 7  # a similarity of everything changes no residual

# Of a point's own information: a point whose rays are parallel has a depth that nothing fixes.
_RIDGE = 1e-12


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Columns of frames and lenses, `count` in all; those of frame i are 6 i to 6 i + 5.

    lens_columns : by camera id, (L,); lens_jacobian : by camera id, (8, L) from the L parameters that mapping
    estimated to fx, fy, cx, cy, k1, k2, p1, p2.
    """

    count: int
    lens_columns: dict[int, np.ndarray]
    lens_jacobian: dict[int, np.ndarray]

    @classmethod
    def of(cls, scene: Scene, *, refine_principal_point: bool) -> Unknowns:
        columns, mixing = {}, {}
        count = POSE * len(scene.names)
        for camera_id in np.unique(scene.camera_ids).tolist():
            camera = scene.cameras[camera_id]
            mixing[camera_id] = lens_parameter_jacobian(
                _lens_parameters(camera, refine_principal_point)
            )
            columns[camera_id] = count + np.arange(mixing[camera_id].shape[1])
            count += mixing[camera_id].shape[1]
        return cls(count, columns, mixing)


def _lens_parameters(camera: Camera, refine_principal_point: bool) -> list[str]:
    """Those that mapping estimates."""
    held = () if refine_principal_point else ("cx", "cy")
    return [name for name in MODELS[camera.model] if name not in held]


@dataclass(frozen=True, eq=False)
class LinearizedBundle:
    """All M measurements of P points, linearised; n is the number of unknowns that stay.

    points : (P,) positions in Scene.points. point : (M,) 0..P-1.
    design : (2 M, n) sparse, change of the residuals by the unknowns that stay.
    whitening : (P, 3, 3) Q with Q^T Q = V^-1, where V is the information on a point.
    whitened : (M, 2, 3), change of the residuals by Q^-T times a change of the point: orthonormal over its
    measurements.
    coupling : (3 P, n) sparse, rows 3p..3p+2 are Q W^T, where W is the information that frames and lenses
    share with point p: changes x of these move the point by -Q^T coupling x.
    residuals : (2 M,) px, after all that points explain of them.
    views : (M, 4), unit direction from the frame to the point and logarithm of its distance.
    """

    points: np.ndarray
    point: np.ndarray
    design: sparse.csr_matrix
    whitening: np.ndarray
    whitened: np.ndarray
    coupling: sparse.csr_matrix
    residuals: np.ndarray
    views: np.ndarray

    def reduced_normal_matrix(self) -> sparse.csr_matrix:
        """(n, n) on frames and lenses after points are eliminated; singular by the gauge."""
        return (self.design.T @ self.design - self.coupling.T @ self.coupling).tocsr()


def linearize_bundle(
    scene: Scene, seen: MapObservations, unknowns: Unknowns, rows: np.ndarray
) -> LinearizedBundle:
    """At the scene as it is, of the measurements at `rows` (M,): all those of their points, all finite."""
    frame = seen.image_idx[rows]
    points, point = np.unique(seen.point_idx[rows], return_inverse=True)
    rotations = scene.poses.rotations[frame]
    offsets = scene.points[points[point]] - scene.poses.centers[frame]
    points_cam = np.einsum("mij,mj->mi", rotations, offsets)
    ids = scene.camera_ids[frame]
    width = max(len(columns) for columns in unknowns.lens_columns.values())
    by_cam = np.empty((len(rows), 2, 3))
    lens = np.zeros((len(rows), 2, width))
    lens_columns = np.zeros((len(rows), width), dtype=np.int64)  # what is 0 may stand anywhere
    for camera_id in np.unique(ids).tolist():
        own = np.flatnonzero(ids == camera_id)
        by_cam[own], by_lens = projection_jacobians(scene.cameras[camera_id], points_cam[own])
        columns = unknowns.lens_columns[camera_id]
        lens[own, :, : len(columns)] = by_lens @ unknowns.lens_jacobian[camera_id]
        lens_columns[own, : len(columns)] = columns
    by_point = by_cam @ rotations
    values = np.concatenate([pose_jacobians(points_cam, by_cam, by_point), lens], axis=2)
    columns = np.concatenate([POSE * frame[:, None] + np.arange(POSE), lens_columns], axis=1)
    design = rows_to_sparse(values, columns, unknowns.count)
    whitening = point_whitening(by_point, point, len(points), ridge=_RIDGE)
    whitened = by_point @ np.swapaxes(whitening, 1, 2)[point]
    by_points = rows_to_sparse(whitened, 3 * point[:, None] + np.arange(3), 3 * len(points))
    residuals = seen.residuals_px[rows].ravel()
    distance = np.linalg.norm(offsets, axis=1, keepdims=True)
    return LinearizedBundle(
        points,
        point,
        design,
        whitening,
        whitened,
        (by_points.T @ design).tocsr(),
        residuals - by_points @ (by_points.T @ residuals),
        np.concatenate([offsets / distance, np.log(distance)], axis=1),
    )


def gauge_null_space(scene: Scene, unknowns: Unknowns) -> np.ndarray:
    """(n, 7) changes of the unknowns by moving, turning and scaling the world about its centres."""
    centers, rotations = scene.poses.centers, scene.poses.rotations
    offsets = centers - centers.mean(axis=0)
    size = np.sqrt((offsets**2).sum(axis=1).mean())
    directions = np.zeros((unknowns.count, GAUGE))
    frames = directions[: POSE * len(centers)].reshape(-1, POSE, GAUGE)
    for axis, unit in enumerate(np.eye(3)):
        frames[:, axis, axis] = 1.0
        frames[:, :3, 3 + axis] = np.cross(unit, offsets) / size
        frames[:, 3:, 3 + axis] = -rotations @ unit / size
    frames[:, :3, 6] = offsets / size
    return directions
