"""Read-only access to the map for registration: points, and descriptors of the map frames."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from spn_data.colmap.map_features import MapFeatures
from spn_data.colmap.model import MapObservations, Scene, read_map_with_keypoints
from spn_data.errors import FormatError
from spn_data.labels.map_points import MapPoints
from spn_data.matching.pairs import PairOptions, visual_vocabulary, vlad_descriptor


@dataclass(frozen=True, eq=False)
class MapFrame:
    """Features of a map frame that are points of the map.

    Attributes
    ----------
    descriptors : ndarray, shape (K, 128), uint8
        RootSIFT.
    point_rows : ndarray, shape (K,)
        Rows in MapPoints.
    """

    descriptors: np.ndarray
    point_rows: np.ndarray


class FrozenMap:
    """Model and its database, opened for reading."""

    def __init__(self, folder: Path, features: MapFeatures):
        self.scene: Scene
        self.observations: MapObservations
        self.points: MapPoints
        self.scene, self.observations, self.points, self._feature_points = read_map_with_keypoints(
            folder
        )
        self._features = features
        described = [features.descriptors(name) for name in self.scene.names]
        self.vocabulary = visual_vocabulary(described, PairOptions())
        self._appearance = np.stack([vlad_descriptor(d, self.vocabulary) for d in described])

    @classmethod
    @contextmanager
    def open(cls, folder: Path, database: Path) -> Iterator[Self]:
        """Open the model in `folder` and its database; raises FormatError if one of them is damaged."""
        with MapFeatures.open(database) as opened:
            yield cls(folder, opened)

    def similar(self, descriptors: np.ndarray, count: int) -> list[str]:
        """Return the names of the map frames most similar to an image with these descriptors, best first."""
        similarity = self._appearance @ vlad_descriptor(descriptors, self.vocabulary)
        order = np.argsort(-similarity, kind="stable")[:count]
        return [self.scene.names[k] for k in order]

    def frame(self, name: str) -> MapFrame:
        """Return a map frame. Raises FormatError if model and database contain different features."""
        descriptors = self._features.descriptors(name)
        point_ids = self._feature_points[name]
        if len(point_ids) != len(descriptors):
            raise FormatError(f"{name}: its features in the model and in the database differ")
        is_point = np.flatnonzero(point_ids >= 0)
        return MapFrame(descriptors[is_point], self.points.rows_of(point_ids[is_point]))

    def frames(self, names: Sequence[str]) -> dict[str, MapFrame]:
        """Return map frames by name."""
        return {name: self.frame(name) for name in names}
