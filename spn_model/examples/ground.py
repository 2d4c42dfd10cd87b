"""Level ground of a scene: what images from above show, between the few points that a map has of it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

_CELL = 0.05  # spreads, side of a cell in plan
_THICK = 0.01  # spreads, to either side of its height: what still lies on it
_NEAR = 3  # cells around one with a point on the ground that are ground too
_BETWEEN = 6  # and so many between such cells
_SHARE = 0.12  # of all cells, at least: all their points lie low, the lowest on it
_LARGEST = 2000  # cells along a side: a scene is no larger


@dataclass(frozen=True, eq=False)
class Ground:
    """A level plane, and where in plan it is ground.

    height, thick : of the world's z, and how far from it a point still lies on it; near : (rows, columns)
    bool, of square cells along x and y from `corner` (2,) on.
    """

    height: float
    thick: float
    near: np.ndarray
    corner: np.ndarray
    cell: float

    def is_at_or_below(self, xyz: np.ndarray) -> np.ndarray:
        """(N,) bool: points (N, 3) that lie no higher than on it."""
        return xyz[:, 2] < self.height + self.thick

    def intersect(self, center: np.ndarray, rays: np.ndarray) -> np.ndarray:
        """(N,) lengths, in rays (N, 3) of the world, after which they meet it from above; NaN where not."""
        rows, columns = self.near.shape
        with np.errstate(divide="ignore", invalid="ignore"):
            length = (self.height - center[2]) / rays[:, 2]
            at = (center[:2] + rays[:, :2] * length[:, None] - self.corner) / self.cell
            inside = (at >= 0).all(axis=1) & (at < [columns, rows]).all(axis=1)
        inside &= (rays[:, 2] < 0) & (length > 0)
        x, y = np.where(inside[:, None], at, 0).astype(np.int64).T
        return np.where(inside & self.near[y, x], length, np.nan)

    def samples(self) -> np.ndarray:
        """(N, 3) points of it, one a cell."""
        y, x = np.nonzero(self.near)
        plan = (np.column_stack([x, y]) + 0.5) * self.cell + self.corner
        return np.column_stack([plan, np.full(len(plan), self.height)])


def fit_level_ground(xyz: np.ndarray, spread: float) -> Ground | None:
    """The ground of a scene whose z points up, from its map points (N, 3); None where it has no level one.

    In each cell in plan the lowest point counts, where none lies clearly higher: a facade has points at all
    heights. The ground is the height at which most of them lie, and a clear share of all cells does.
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
