"""Points of a map, and how much of an image they cover."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_CELLS = (8, 8)  # of the grid over which the spread of points in an image is counted


@dataclass(frozen=True, eq=False)
class MapPoints:
    """P points of a map.

    ids : (P,) int64, COLMAP's, ascending; xyz : (P, 3) in the map's frame; colors : (P, 3) uint8 RGB;
    track_lengths : (P,) int, mapping frames that see each.
    """

    ids: np.ndarray
    xyz: np.ndarray
    colors: np.ndarray
    track_lengths: np.ndarray

    def __len__(self) -> int:
        return len(self.ids)

    def rows_of(self, point_ids: np.ndarray) -> np.ndarray:
        """Rows (K,) of point ids (K,). Raises KeyError for an id that the map does not hold."""
        rows = np.minimum(np.searchsorted(self.ids, point_ids), max(0, len(self.ids) - 1))
        if len(point_ids) and (len(self.ids) == 0 or not np.array_equal(self.ids[rows], point_ids)):
            raise KeyError("a point that the map does not hold")
        return rows


def covered_share(pixels: np.ndarray, width: int, height: int) -> float:
    """Share of an 8 x 8 grid over the image whose cells hold at least one of the pixels (K, 2)."""
    columns, rows = _CELLS
    x = np.clip(pixels[:, 0] * columns / width, 0, columns - 1).astype(np.int64)
    y = np.clip(pixels[:, 1] * rows / height, 0, rows - 1).astype(np.int64)
    return len(np.unique(y * columns + x)) / (columns * rows)
