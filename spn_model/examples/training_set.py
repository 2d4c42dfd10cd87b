"""The images and labels of groups of dataset.h5, at hand for training."""

from __future__ import annotations

import numpy as np

from spn_data.dataset.hdf5_reader import DatasetGroup, FramePoints
from spn_data.dataset.hdf5_schema import Role
from spn_data.errors import InputError
from spn_data.geometry.pose import Poses

MEMORY_BYTES = 2_000_000_000  # of decoded images that are kept


class TrainingSet:
    """Groups of role "train", and of role "validation" where these are learnt too, one after the other: rows
    k, images of one size, exact poses, map points.

    poses : N; intrinsics : (N, 3, 3); size : (width, height); up_is_known : z points up. Images are kept in
    memory as far as memory_bytes reaches, and read from the file beyond it. Raises InputError where nothing
    can be trained on.
    """

    def __init__(
        self,
        *groups: DatasetGroup,
        memory_bytes: int = MEMORY_BYTES,
        up_is_known: bool = True,
    ):
        for group in groups:
            if not len(group):
                raise InputError(f"group {group.name} is empty: there is nothing to train on")
            if group.image_size is None:
                raise InputError(
                    f"group {group.name} holds no images: there is nothing to train on"
                )
            if group.image_size != groups[0].image_size:
                raise InputError(
                    f"images of {group.name} are of another size than those of {groups[0].name}: both "
                    "cannot be trained on together"
                )
        self._rows = [(group, k) for group in groups for k in range(len(group))]
        self.up_is_known = up_is_known
        self.size: tuple[int, int] = groups[0].image_size or (0, 0)
        self.poses: Poses = Poses.concatenate([group.poses for group in groups])
        self.intrinsics: np.ndarray = np.concatenate([group.intrinsics for group in groups])
        kept = min(len(self._rows), memory_bytes // (self.size[0] * self.size[1] * 3))
        self._images = [group.image(k) for group, k in self._rows[:kept]]
        every_pixel = all(group.all_valid for group in groups)
        self._valid = None if every_pixel else [group.valid(k) for group, k in self._rows]
        self.has_points = groups[0].points_for_training
        self._points = (
            [_points_to_train_on(group, k) for group, k in self._rows] if self.has_points else []
        )

    def __len__(self) -> int:
        return len(self._rows)

    def image(self, row: int) -> np.ndarray:
        """(H, W, 3) uint8 RGB; not to be written to."""
        if row < len(self._images):
            return self._images[row]
        group, k = self._rows[row]
        return group.image(k)

    def valid(self, row: int) -> np.ndarray | None:
        """(H, W) bool: pixels that show the scene; None where all of them do."""
        return None if self._valid is None else self._valid[row]

    def points(self, row: int) -> FramePoints:
        """Map points that the image sees. Raises InputError where the data set has none to learn from."""
        if not self.has_points:
            raise InputError("the data set holds no points for training")
        return self._points[row]


def _points_to_train_on(group: DatasetGroup, row: int) -> FramePoints:
    """Of validation frames all points: they were made of images that are learnt with them."""
    return group.points(row) if group.role is Role.VALIDATION else group.training_points(row)
