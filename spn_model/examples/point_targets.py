"""Targets of a scene-coordinate network: for each cell of an image the map surface that it shows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import Delaunay, QhullError

from spn_data.dataset.hdf5_reader import FramePoints
from spn_data.geometry.pose import Poses


def cell_centers(columns: int, rows: int, first_px: float, stride_px: float) -> np.ndarray:
    """Return the pixels of the cell centres, (rows * columns, 2), row by row."""
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    return np.stack([x, y], axis=-1).reshape(-1, 2) * stride_px + first_px


def cell_targets(
    pixels: np.ndarray,
    xyz: np.ndarray,
    grid: tuple[int, int],
    *,
    first_px: float,
    stride_px: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return for each cell the map point nearest to its centre.

    Parameters
    ----------
    pixels : ndarray, shape (N, 2)
        Pixels of the points; NaN if not in view.
    xyz : ndarray, shape (N, 3)
        Points.
    grid : tuple of int
        Columns and rows.
    first_px, stride_px : float
        Centre of the first cell, and distance between cells.

    Returns
    -------
    targets : ndarray, float32, shape (3, h, w)
        0 if no point falls into the cell.
    known : ndarray of bool, shape (h, w)
        Cells with a point.
    """
    columns, rows = grid
    at = (pixels - first_px) / stride_px
    cell = np.floor(at + 0.5)
    inside = (cell >= 0).all(axis=1) & (cell < [columns, rows]).all(axis=1)
    off = np.abs(at[inside] - cell[inside]).max(axis=1)
    index = cell[inside].astype(np.int64) @ [1, columns]
    # If several points fall into one cell, the last one written wins: the nearest to its centre.
    order = np.argsort(-off, kind="stable")
    targets = np.zeros((rows * columns, 3), np.float32)
    known = np.zeros(rows * columns, bool)
    targets[index[order]] = xyz[inside][order]
    known[index[order]] = True
    return targets.T.reshape(3, rows, columns), known.reshape(rows, columns)


@dataclass(frozen=True, kw_only=True)
class SurfaceOptions:
    """Limits of triangles between map points that count as one surface."""

    longest_px: float = 48.0  # longest side of a triangle of neighbouring points
    depth_ratio: float = 1.35  # largest depth ratio of its farthest to its nearest vertex
    ground_px: float = 96.0  # longest side of a level triangle: ground is seen at grazing angles
    level_m: float = 0.2  # largest height difference of a level triangle; 0 if up is unknown
    step_px: int = 2  # step of the grid on which surfaces are stored


@dataclass(frozen=True, eq=False)
class Surface:
    """Surface that an image shows, interpolated between its map points.

    Attributes
    ----------
    inverse_depth : ndarray, float32, shape (h, w)
        Inverse depth in 1/m along the optical axis, at pixels (step/2 + k step); NaN if unknown.
    step_px : int
        Step of the grid.
    pose : Poses
        One pose, of the image.
    matrix : ndarray, shape (3, 3)
        Intrinsic matrix K.
    """

    inverse_depth: np.ndarray
    step_px: int
    pose: Poses
    matrix: np.ndarray

    def at(self, pixels: np.ndarray) -> np.ndarray:
        """Return the inverse depth (N,) at pixels (N, 2); NaN outside the image and where unknown."""
        rows, columns = self.inverse_depth.shape
        with np.errstate(invalid="ignore"):
            cell = np.floor(pixels / self.step_px)
            inside = (cell[:, 0] >= 0) & (cell[:, 1] >= 0)
            inside &= (cell[:, 0] < columns) & (cell[:, 1] < rows)
        x, y = np.where(inside[:, None], cell, 0).astype(np.int64).T
        return np.where(inside, self.inverse_depth[y, x], np.nan)

    def xyz(self, pixels: np.ndarray) -> np.ndarray:
        """Return the world points (N, 3) at pixels (N, 2); NaN outside the image and where unknown."""
        inverse = self.at(pixels)
        rays = np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1)
        rays = rays @ np.linalg.inv(self.matrix).T
        return rays / inverse[:, None] @ self.pose.rotations[0] + self.pose.centers[0]


def surface(
    points: FramePoints,
    pose: Poses,
    matrix: np.ndarray,
    size: tuple[int, int],
    options: SurfaceOptions,
) -> Surface:
    """Interpolate the surface that an image shows, from triangles between its map points.

    Parameters
    ----------
    points : FramePoints
        Map points that the image sees.
    pose : Poses
        One pose, of the image.
    matrix : ndarray, shape (3, 3)
        Intrinsic matrix K.
    size : tuple of int
        Width and height of the image.
    options : SurfaceOptions
        Limits of the triangles.

    Returns
    -------
    Surface

    Notes
    -----
    Inverse depth is linear in the pixels of a plane, so that the surface is exact on flat ground and
    facades. Triangles that are long or bridge a depth discontinuity are left out; with fewer than three
    points there is no surface.
    """
    width, height = size
    columns, rows = width // options.step_px, height // options.step_px
    inverse = np.full(rows * columns, np.nan)
    depth = pose.depths(points.xyz)
    ahead = depth > 0
    corners, values = points.pixels[ahead].astype(np.float64), 1 / depth[ahead]
    try:
        mesh = Delaunay(corners)
    except (QhullError, ValueError):  # fewer than three points, or all collinear
        return Surface(
            inverse.reshape(rows, columns).astype(np.float32), options.step_px, pose, matrix
        )
    of = corners[mesh.simplices]
    longest = np.linalg.norm(of - np.roll(of, 1, axis=1), axis=2).max(axis=1)
    ratio = values[mesh.simplices].max(axis=1) / values[mesh.simplices].min(axis=1)
    height = points.xyz[ahead, 2][mesh.simplices]
    level = height.max(axis=1) - height.min(axis=1) < options.level_m
    sound = (longest <= options.longest_px) & (ratio <= options.depth_ratio)
    sound |= level & (longest <= options.ground_px)
    at = cell_centers(columns, rows, options.step_px / 2, options.step_px)
    triangle = mesh.find_simplex(at)
    hit = triangle >= 0
    hit[hit] = sound[triangle[hit]]
    transform = mesh.transform[triangle[hit]]  # (M, 3, 2): to barycentric coordinates
    first = np.einsum("mij,mj->mi", transform[:, :2], at[hit] - transform[:, 2])
    weights = np.concatenate([first, 1 - first.sum(axis=1, keepdims=True)], axis=1)
    inverse[hit] = (weights * values[mesh.simplices[triangle[hit]]]).sum(axis=1)
    return Surface(inverse.reshape(rows, columns).astype(np.float32), options.step_px, pose, matrix)
