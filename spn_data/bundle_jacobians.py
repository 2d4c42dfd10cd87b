"""A bundle adjustment at its solution: derivatives of all residuals, points eliminated.

The unknowns that stay are those of the frames (6 each) and of the lenses that mapping estimated. A change of
a frame is that of its centre in world axes, then a rotation vector v in the camera frame with
R_changed = exp(v) R.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from spn_data.camera import MODELS, Camera
from spn_data.colmap.model import Observations, Scene
from spn_data.residual_fit import LENS, projection_jacobians, rows_to_sparse

POSE = 6
GAUGE = 7  # a similarity of everything changes no residual

# Columns of residual_fit.projection_jacobians that each parameter of a lens moves.
_FOCAL = {"f": (0, 1), "fx": (0,), "fy": (1,)}
_PRINCIPAL_POINT = {"cx": (2,), "cy": (3,)}
_DISTORTION = {"k1": (4,), "k2": (5,), "p1": (6,), "p2": (7,)}
# Of a point's own information: a point whose rays are parallel has a depth that nothing fixes.
_RIDGE = 1e-12


@dataclass(frozen=True, eq=False)
class Bundle:
    """M observations of P points in N frames, linearised; n = 6 N + parameters of the lenses.

    design : (2 M, n) sparse, change of the residuals by the unknowns that stay.
    whitening : (P, 3, 3) Q_k with Q_k^T Q_k = V_k^-1, where V_k (3, 3) is the information on point k.
    coupling : (3 P, n) sparse, rows 3k..3k+2 are Q_k W_k^T, where W_k is the information that frames and
    lenses share with point k: changes x of these move point k by -Q_k^T coupling_k x.
    reduced : (n, n) sparse, information on the unknowns after points are eliminated; singular by the gauge.
    residuals : (2 M,) px, after all that points explain of them.
    point_idx : (M,); pixels : (M, 2); frame_idx : (M,), of the observations that were used.
    lens_columns : by camera id, (L,) columns of the lens's unknowns; lens_mixing : by camera id, (8, L) from
    these to fx, fy, cx, cy, k1, k2, p1, p2.
    """

    design: sparse.csr_matrix
    whitening: np.ndarray
    coupling: sparse.csr_matrix
    reduced: sparse.csc_matrix
    residuals: np.ndarray
    frame_idx: np.ndarray
    point_idx: np.ndarray
    pixels: np.ndarray
    lens_columns: dict[int, np.ndarray]
    lens_mixing: dict[int, np.ndarray]

    @property
    def degrees_of_freedom(self) -> int:
        """Of the residuals, after points, frames and lenses."""
        points = len(np.unique(self.point_idx))
        return int(len(self.residuals) - 3 * points - self.design.shape[1] + GAUGE)


def lens_mixing(camera: Camera, *, refine_principal_point: bool) -> np.ndarray:
    """(8, L) from the L parameters that mapping estimates to fx, fy, cx, cy, k1, k2, p1, p2."""
    refined = _FOCAL | _DISTORTION | (_PRINCIPAL_POINT if refine_principal_point else {})
    columns = [refined[name] for name in MODELS[camera.model] if name in refined]
    mixing = np.zeros((LENS, len(columns)))
    for k, rows in enumerate(columns):
        mixing[list(rows), k] = 1.0
    return mixing


def linearize_bundle(
    scene: Scene, seen: Observations, *, refine_principal_point: bool = False
) -> Bundle:
    """Derivatives at the scene as it is; measurements of points behind a camera are left out."""
    used = np.flatnonzero(np.isfinite(seen.residuals_px).all(axis=1))
    frame, point = seen.image_idx[used], seen.point_idx[used]
    rotations = scene.poses.rotations[frame]
    offsets = scene.points[point] - scene.poses.centers[frame]
    points_cam = np.einsum("mij,mj->mi", rotations, offsets)
    ids = scene.camera_ids[frame]
    mixing = {
        int(i): lens_mixing(scene.cameras[int(i)], refine_principal_point=refine_principal_point)
        for i in np.unique(ids)
    }
    width = max((m.shape[1] for m in mixing.values()), default=0)
    by_cam = np.empty((len(used), 2, 3))
    lens = np.zeros((len(used), 2, width))
    lens_cols = np.zeros((len(used), width), dtype=np.int64)  # zeros of narrow lenses go anywhere
    columns: dict[int, np.ndarray] = {}
    n = POSE * len(scene.names)
    for camera_id, mix in mixing.items():
        rows = np.flatnonzero(ids == camera_id)
        by_cam[rows], by_lens = projection_jacobians(scene.cameras[camera_id], points_cam[rows])
        columns[camera_id] = n + np.arange(mix.shape[1])
        lens[rows, :, : mix.shape[1]] = by_lens @ mix
        lens_cols[rows, : mix.shape[1]] = columns[camera_id]
        n += mix.shape[1]
    by_point = by_cam @ rotations
    values = np.concatenate([-by_point, np.cross(points_cam[:, None], by_cam), lens], axis=2)
    cols = np.concatenate([POSE * frame[:, None] + np.arange(POSE), lens_cols], axis=1)
    design = rows_to_sparse(values, cols, n)
    whitening = _whitening(by_point, point, len(scene.points))
    whitened = rows_to_sparse(
        by_point @ np.swapaxes(whitening, 1, 2)[point],
        3 * point[:, None] + np.arange(3),
        3 * len(scene.points),
    )
    coupling = (whitened.T @ design).tocsr()
    reduced = (design.T @ design - coupling.T @ coupling).tocsc()
    residuals = seen.residuals_px[used].ravel()
    residuals = residuals - whitened @ (whitened.T @ residuals)
    return Bundle(
        design,
        whitening,
        coupling,
        reduced,
        residuals,
        frame,
        point,
        seen.pixels[used],
        columns,
        mixing,
    )


def gauge_directions(scene: Scene, unknowns: int) -> np.ndarray:
    """(n, 7) changes of the unknowns by moving, turning and scaling the world about its centres."""
    centers, rotations = scene.poses.centers, scene.poses.rotations
    offsets = centers - centers.mean(axis=0)
    size = np.sqrt((offsets**2).sum(axis=1).mean())
    directions = np.zeros((unknowns, GAUGE))
    frames = directions[: POSE * len(centers)].reshape(-1, POSE, GAUGE)
    for axis, unit in enumerate(np.eye(3)):
        frames[:, axis, axis] = 1.0
        frames[:, :3, 3 + axis] = np.cross(unit, offsets) / size
        frames[:, 3:, 3 + axis] = -rotations @ unit / size
    frames[:, :3, 6] = offsets / size
    return directions


def _whitening(by_point: np.ndarray, point: np.ndarray, count: int) -> np.ndarray:
    information = np.zeros((count, 3, 3))
    np.add.at(information, point, np.einsum("mki,mkj->mij", by_point, by_point))
    trace = np.trace(information, axis1=1, axis2=2)
    seen = trace > 0
    information[seen] += (_RIDGE * trace[seen])[:, None, None] * np.eye(3)
    whitening = np.full((count, 3, 3), np.nan)  # of a point that nothing sees
    whitening[seen] = np.linalg.inv(np.linalg.cholesky(information[seen]))
    return whitening
