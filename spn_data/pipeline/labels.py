"""All labels of an area in the map's frame: mapping frames, dense frames, evaluation sequences."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spn_data.camera import Camera
from spn_data.geodesy import GeoOrigin
from spn_data.labels import Labels, SeenPoints


@dataclass(frozen=True, eq=False)
class MapPoints:
    """The map's points: ids (P,) COLMAP's, ascending; xyz (P, 3) in the map's frame; colors (P, 3) uint8 RGB;
    track_lengths (P,) mapping frames that see each.
    """

    ids: np.ndarray
    xyz: np.ndarray
    colors: np.ndarray
    track_lengths: np.ndarray

    def rows_of(self, point_ids: np.ndarray) -> np.ndarray:
        """Rows (K,) of point ids (K,). Raises KeyError for an id that the map does not hold."""
        rows = np.minimum(np.searchsorted(self.ids, point_ids), max(0, len(self.ids) - 1))
        if len(point_ids) and not np.array_equal(self.ids[rows], point_ids):
            raise KeyError("a point that the map does not hold")
        return rows


@dataclass(frozen=True, eq=False)
class LabelledArea:
    """Every frame with what became of it.

    units : "m" (East-North-Up about `origin`) or "model" (COLMAP's gauge; origin is None).
    mapping : chosen frames of the mapping flights; dense : their other frames; evaluation : by sequence,
    chosen and dense frames. Each with the map points that the frames see. cameras : by key, in pixels of
    the full-size images. stale : reasons for which a part is left out or doubtful.
    """

    units: str
    origin: GeoOrigin | None
    points: MapPoints
    cameras: dict[str, Camera]
    mapping: Labels
    mapping_seen: SeenPoints
    dense: Labels
    dense_seen: SeenPoints
    evaluation: dict[str, Labels]
    evaluation_seen: dict[str, SeenPoints]
