"""The images and labels of one group of dataset.h5, at hand for training."""

from __future__ import annotations

import numpy as np

from spn_data.errors import InputError
from spn_data.hdf5_reader import DatasetGroup, FramePoints
from spn_data.pose import Poses

MEMORY_BYTES = 2_000_000_000  # of decoded images that are kept


class TrainingSet:
    """A group of role "train": rows k, images of one size, exact poses, map points.

    poses : N; intrinsics : (N, 3, 3); size : (width, height); up_is_known : z points up. Images are kept in
    memory as far as memory_bytes reaches, and read from the file beyond it. Raises InputError where nothing
    can be trained on.
    """

    def __init__(
        self,
        group: DatasetGroup,
        *,
        memory_bytes: int = MEMORY_BYTES,
        up_is_known: bool = True,
    ):
        if not len(group):
            raise InputError(f"group {group.name} is empty: there is nothing to train on")
        if group.image_size is None:
            raise InputError(f"group {group.name} holds no images: there is nothing to train on")
        self._group = group
        self.up_is_known = up_is_known
        self.size: tuple[int, int] = group.image_size
        self.poses: Poses = group.poses
        self.intrinsics: np.ndarray = group.intrinsics
        kept = min(len(group), memory_bytes // (self.size[0] * self.size[1] * 3))
        self._images = [group.image(k) for k in range(kept)]
        self._valid = [group.valid(k) for k in range(len(group))] if not group.all_valid else None
        self.has_points = group.points_for_training
        self._points = (
            [group.training_points(k) for k in range(len(group))] if self.has_points else []
        )

    def __len__(self) -> int:
        return len(self._group)

    def image(self, row: int) -> np.ndarray:
        """(H, W, 3) uint8 RGB; not to be written to."""
        return self._images[row] if row < len(self._images) else self._group.image(row)

    def valid(self, row: int) -> np.ndarray | None:
        """(H, W) bool: pixels that show the scene; None where all of them do."""
        return None if self._valid is None else self._valid[row]

    def points(self, row: int) -> FramePoints:
        """Map points that the image sees. Raises InputError where the data set has none to learn from."""
        if not self.has_points:
            raise InputError("the data set holds no points for training")
        return self._points[row]
