"""Surfaces that training images show, which examples and novel views share."""

from __future__ import annotations

from spn_model.examples.point_targets import Surface, SurfaceOptions, surface
from spn_model.examples.training_set import TrainingSet


class TrainingSurfaces:
    """Surfaces that training images show, interpolated when they are asked for and kept.

    Parameters
    ----------
    data : TrainingSet
        With map points.
    options : SurfaceOptions
    """

    def __init__(self, data: TrainingSet, options: SurfaceOptions):
        self._data, self._options = data, options
        self._kept: dict[int, Surface] = {}

    def of(self, row: int) -> Surface:
        """Return the surface that an image shows."""
        if row not in self._kept:
            data = self._data
            self._kept[row] = surface(
                data.points(row),
                data.poses[row : row + 1],
                data.intrinsics[row],
                data.size,
                self._options,
            )
        return self._kept[row]
