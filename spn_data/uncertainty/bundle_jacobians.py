"""Jacobians of a bundle adjustment at its solution, with the points eliminated (Schur complement).

The remaining unknowns are the poses (6 per frame) and the intrinsics.
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
from spn_data.geometry.pose import to_camera

GAUGE = 7  # dimension of the gauge: a similarity changes no residual

# Share of the trace of a point's normal matrix: the depth of a point with parallel rays is undetermined.
_RIDGE = 1e-12


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Columns of poses and intrinsics in the design matrix; frame i has columns 6 i to 6 i + 5.

    Attributes
    ----------
    count : int
        Number of columns n.
    lens_columns : dict of int to ndarray, shape (L,)
        Columns of the intrinsics in the order of `estimated_names`, by camera id.
    lens_jacobian : dict of int to ndarray, shape (8, L)
        Derivatives of fx, fy, cx, cy, k1, k2, p1, p2 by the L intrinsics, by camera id.
    """

    count: int
    lens_columns: dict[int, np.ndarray]
    lens_jacobian: dict[int, np.ndarray]

    @classmethod
    def of(cls, scene: Scene) -> Unknowns:
        """Return the unknowns of a map: all poses, and all intrinsics but the principal points."""
        columns, mixing = {}, {}
        count = POSE * len(scene.names)
        for camera_id in np.unique(scene.camera_ids).tolist():
            camera = scene.cameras[camera_id]
            mixing[camera_id] = lens_parameter_jacobian(estimated_names(camera))
            columns[camera_id] = count + np.arange(mixing[camera_id].shape[1])
            count += mixing[camera_id].shape[1]
        return cls(count, columns, mixing)


def estimated_names(camera: Camera) -> list[str]:
    """Return the names of the intrinsics that are unknowns; a principal point is a field of its lens."""
    return [name for name in MODELS[camera.model] if name not in ("cx", "cy")]


@dataclass(frozen=True, eq=False)
class LinearizedBundle:
    """All M measurements of P points, linearised; n is the number of unknowns that remain.

    Attributes
    ----------
    points : ndarray, shape (P,)
        Rows in `Scene.points`.
    point : ndarray, shape (M,)
        Point of each measurement, 0..P-1.
    design : csr_matrix, shape (2 M, n)
        Derivatives of the residuals by the remaining unknowns.
    whitening : ndarray, shape (P, 3, 3)
        Q with Q^T Q = V^-1, where V is the normal matrix of a point.
    whitened : ndarray, shape (M, 2, 3)
        Derivatives of the residuals by the point in whitened coordinates (Q^-T times a change of the point);
        their columns are orthonormal over the measurements of a point.
    coupling : csr_matrix, shape (3 P, n)
        Rows 3p..3p+2 are Q W^T, where W is the off-diagonal block of the normal matrix between the remaining
        unknowns and point p. A change x of these unknowns moves the point by -Q^T coupling x.
    residuals : ndarray, shape (2 M,)
        Residuals in px after projecting out all that the points explain.
    views : ndarray, shape (M, 4)
        Unit direction from the frame to the point, and logarithm of the distance.
    """

    points: np.ndarray
    point: np.ndarray
    design: sparse.csr_matrix
    whitening: np.ndarray
    whitened: np.ndarray
    coupling: sparse.csr_matrix
    residuals: np.ndarray
    views: np.ndarray

    def by_points(self) -> sparse.csr_matrix:
        """Return the derivatives (2 M, 3 P) of the residuals by the points in whitened coordinates."""
        columns = 3 * self.point[:, None] + np.arange(3)
        return rows_to_sparse(self.whitened, columns, 3 * len(self.points))

    def reduced_normal_matrix(self) -> sparse.csr_matrix:
        """Return the Schur complement (n, n) of the points; singular in the seven gauge directions."""
        return (self.design.T @ self.design - self.coupling.T @ self.coupling).tocsr()


def linearize_bundle(
    scene: Scene, seen: MapObservations, unknowns: Unknowns, rows: np.ndarray
) -> LinearizedBundle:
    """Linearise the bundle adjustment at the scene's current estimate.

    Parameters
    ----------
    scene : Scene
        Poses, cameras and points.
    seen : MapObservations
        Measurements of the points.
    unknowns : Unknowns
        The unknowns that remain.
    rows : ndarray, shape (M,)
        Measurements to use: all those of their points, all finite.
    """
    frame = seen.image_idx[rows]
    points, point = np.unique(seen.point_idx[rows], return_inverse=True)
    rotations = scene.poses.rotations[frame]
    xyz, centers = scene.points[points[point]], scene.poses.centers[frame]
    points_cam = to_camera(xyz, centers, rotations)
    ids = scene.camera_ids[frame]
    width = max(len(columns) for columns in unknowns.lens_columns.values())
    by_cam = np.empty((len(rows), 2, 3))
    lens = np.zeros((len(rows), 2, width))
    lens_columns = np.zeros((len(rows), width), dtype=np.int64)  # columns of zeros are arbitrary
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
    offsets = xyz - centers
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
    """Return the null space of the normal matrix: translation, rotation and scale of the world.

    Parameters
    ----------
    scene : Scene
        The map; rotation and scale are about the centroid of its camera centres.
    unknowns : Unknowns
        Columns of the normal matrix.

    Returns
    -------
    ndarray, shape (n, 7)
        Derivatives of the unknowns by three translations, three rotations and the scale.
    """
    centers, rotations = scene.poses.centers, scene.poses.rotations
    offsets = centers - centers.mean(axis=0)
    size = np.sqrt((offsets**2).sum(axis=1).mean())
    null_space = np.zeros((unknowns.count, GAUGE))
    frames = null_space[: POSE * len(centers)].reshape(-1, POSE, GAUGE)
    for axis, unit in enumerate(np.eye(3)):
        frames[:, axis, axis] = 1.0
        frames[:, :3, 3 + axis] = np.cross(unit, offsets) / size
        frames[:, 3:, 3 + axis] = -rotations @ unit / size
    frames[:, :3, 6] = offsets / size
    return null_space
