"""Level ground of a scene, fitted to the few map points on it, which views from above show."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

_CELL = 0.05  # side of a cell in plan, in spreads of the scene
_THICK = 0.01  # tolerance above and below the ground height, in spreads
_NEAR = 3  # radius in cells that a cell with ground points marks as ground
_BETWEEN = 6  # radius in cells over which gaps between such cells are closed
_SHARE = 0.12  # smallest fraction of all occupied cells that are flat and at the ground height
_LARGEST = 2000  # largest number of cells along a side; a larger scene gets no ground


@dataclass(frozen=True, eq=False)
class Ground:
    """Horizontal plane with a mask of where in plan it is ground.

    Attributes
    ----------
    height, thick : float
        z of the plane in the world, and the distance within which a point still belongs to it.
    near : ndarray of bool, shape (rows, columns)
        Square cells along x and y that are ground.
    corner : ndarray, shape (2,)
        x and y of the first cell's corner.
    cell : float
        Side of a cell.
    """

    height: float
    thick: float
    near: np.ndarray
    corner: np.ndarray
    cell: float

    def is_at_or_below(self, xyz: np.ndarray) -> np.ndarray:
        """Return which points (N, 3) are on the ground or below it, (N,) bool."""
        return xyz[:, 2] < self.height + self.thick

    def intersect(self, center: np.ndarray, rays: np.ndarray) -> np.ndarray:
        """Intersect rays from a point above with the ground.

        Parameters
        ----------
        center : ndarray, shape (3,)
            Origin of the rays.
        rays : ndarray, shape (N, 3)
            Directions in the world.

        Returns
        -------
        ndarray, shape (N,)
            Ray parameters of the intersections, in multiples of the directions; NaN without one.
        """
        rows, columns = self.near.shape
        with np.errstate(divide="ignore", invalid="ignore"):
            length = (self.height - center[2]) / rays[:, 2]
            at = (center[:2] + rays[:, :2] * length[:, None] - self.corner) / self.cell
            inside = (at >= 0).all(axis=1) & (at < [columns, rows]).all(axis=1)
        inside &= (rays[:, 2] < 0) & (length > 0)
        x, y = np.where(inside[:, None], at, 0).astype(np.int64).T
        return np.where(inside & self.near[y, x], length, np.nan)

    def samples(self) -> np.ndarray:
        """Return one point on the ground for each of its cells, (N, 3)."""
        y, x = np.nonzero(self.near)
        plan = (np.column_stack([x, y]) + 0.5) * self.cell + self.corner
        return np.column_stack([plan, np.full(len(plan), self.height)])


def fit_level_ground(xyz: np.ndarray, spread: float) -> Ground | None:
    """Fit the level ground of a scene whose z points up, from its map points (N, 3).

    Returns None if the scene has no level ground. Each cell in plan contributes its lowest point, unless it
    also has clearly higher points: a facade has points at all heights. The ground is the height shared by
    most of these lowest points, if they make up a sufficient fraction of all cells.

    Parameters
    ----------
    xyz : ndarray, shape (N, 3)
        Map points.
    spread : float
        Spread of the scene; all tolerances are fractions of it.
    """
    cell, thick = _CELL * spread, _THICK * spread
    corner = xyz[:, :2].min(axis=0) - (_BETWEEN + 1) * cell
    at = ((xyz[:, :2] - corner) / cell).astype(np.int64)
    columns, rows = at.max(axis=0) + _BETWEEN + 2
    if max(columns, rows) > _LARGEST:
        return None
    lowest = np.full(rows * columns, np.inf)
    highest = np.full(rows * columns, -np.inf)
    index = at @ np.array([1, columns])
    np.minimum.at(lowest, index, xyz[:, 2])
    np.maximum.at(highest, index, xyz[:, 2])
    occupied = np.isfinite(lowest)
    lowest = np.sort(lowest[highest - lowest < cell])
    if not len(lowest):
        return None
    within = np.searchsorted(lowest, lowest + 2 * thick) - np.arange(len(lowest))
    first = int(within.argmax())
    if within[first] < _SHARE * occupied.sum():
        return None
    height = float(np.median(lowest[first : first + within[first]]))
    here = at[np.abs(xyz[:, 2] - height) < thick]
    near = np.zeros((rows, columns), np.uint8)
    near[here[:, 1], here[:, 0]] = 1
    near = cv2.morphologyEx(near, cv2.MORPH_CLOSE, _disc(_BETWEEN)) | cv2.dilate(near, _disc(_NEAR))
    return Ground(height, thick, near > 0, corner, cell)


def _disc(radius: int) -> np.ndarray:
    return np.asarray(
        cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    )
