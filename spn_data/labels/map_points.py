"""Points of a map, and the share of an image that they cover."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_CELLS = (8, 8)  # columns and rows of the grid over the image


@dataclass(frozen=True, eq=False)
class MapPoints:
    """P points of a map.

    Attributes
    ----------
    ids : ndarray of int64, shape (P,)
        COLMAP's point ids, ascending.
    xyz : ndarray, shape (P, 3)
        Positions in the map's frame.
    colors : ndarray of uint8, shape (P, 3)
        RGB colours.
    track_lengths : ndarray of int, shape (P,)
        Number of mapping frames that observe each point.
    """

    ids: np.ndarray
    xyz: np.ndarray
    colors: np.ndarray
    track_lengths: np.ndarray

    def __len__(self) -> int:
        return len(self.ids)

    def rows_of(self, point_ids: np.ndarray) -> np.ndarray:
        """Return the rows (K,) of point ids (K,).

        Raises
        ------
        KeyError
            If the map does not contain an id.
        """
        rows = np.minimum(np.searchsorted(self.ids, point_ids), max(0, len(self.ids) - 1))
        if len(point_ids) and (len(self.ids) == 0 or not np.array_equal(self.ids[rows], point_ids)):
            raise KeyError("the map does not contain a point with this id")
        return rows


def covered_share(pixels: np.ndarray, width: int, height: int) -> float:
    """Return the share of the cells of an 8 x 8 grid over the image that contain a keypoint.

    Parameters
    ----------
    pixels : ndarray, shape (K, 2)
        Keypoints.
    width, height : int
        Image size in pixels.
    """
    columns, rows = _CELLS
    x = np.clip(pixels[:, 0] * columns / width, 0, columns - 1).astype(np.int64)
    y = np.clip(pixels[:, 1] * rows / height, 0, rows - 1).astype(np.int64)
    return len(np.unique(y * columns + x)) / (columns * rows)
