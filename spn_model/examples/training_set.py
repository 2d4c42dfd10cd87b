"""Images and labels of groups of dataset.h5, kept in memory for training."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from spn_data.dataset.hdf5_reader import DatasetGroup, FramePoints
from spn_data.dataset.hdf5_schema import Role
from spn_data.errors import InputError
from spn_data.geometry.pose import Poses

MEMORY_BYTES = 2_000_000_000  # largest size of the decoded images kept in memory


class TrainingSet:
    """Training frames of one or more groups, concatenated: images of one size, exact poses and map points.

    Groups have the role "train", or "validation" if these frames are trained on too. Images are kept in
    memory up to `memory_bytes` and read from the file beyond it. Networks compute in float32, so poses and
    points are relative to the offset of the data set.

    Parameters
    ----------
    *groups : DatasetGroup
        Groups to concatenate.
    memory_bytes : int
        Largest size of the images kept in memory.
    up_is_known : bool
        Whether z points up in the world.
    check : callable
        Called before the image or the points of a frame are used, by any thread; may raise an exception to
        stop what uses them.

    Attributes
    ----------
    offset : tuple of float
        World position of the zero of poses and points.
    poses : Poses
        N poses, relative to the offset.
    intrinsics : ndarray, shape (N, 3, 3)
        Intrinsic matrices K.
    size : tuple of int
        Width and height of the images.
    up_is_known : bool
        Whether z points up in the world.
    has_points : bool
        Whether map points are available for training.
    check : callable
        As given; long work on the set calls it too.

    Raises
    ------
    InputError
        If a group is empty, has no images, or the image sizes differ.
    """

    def __init__(
        self,
        *groups: DatasetGroup,
        memory_bytes: int = MEMORY_BYTES,
        up_is_known: bool = True,
        check: Callable[[], None] = lambda: None,
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
                    f"images of {group.name} and {groups[0].name} have different sizes: they cannot be "
                    "trained on together"
                )
        self.check = check
        self._rows = [(group, k) for group in groups for k in range(len(group))]
        self.up_is_known = up_is_known
        self.size: tuple[int, int] = groups[0].image_size or (0, 0)
        self.offset = groups[0].offset
        to_zero = [-part for part in self.offset]
        self.poses: Poses = Poses.concatenate(group.poses for group in groups).moved_by(to_zero)
        self.intrinsics: np.ndarray = np.concatenate([group.intrinsics for group in groups])
        kept = min(len(self._rows), memory_bytes // (self.size[0] * self.size[1] * 3))
        self._images = []
        for group, k in self._rows[:kept]:
            check()
            self._images.append(group.image(k))
        every_pixel = all(group.all_valid for group in groups)
        self.has_points = groups[0].points_for_training
        self._valid: list[np.ndarray | None] | None = None if every_pixel else []
        self._points = []
        for group, k in self._rows:
            check()
            if self._valid is not None:
                self._valid.append(group.valid(k))
            if self.has_points:
                self._points.append(_points_to_train_on(group, k, to_zero))

    def __len__(self) -> int:
        return len(self._rows)

    def image(self, row: int) -> np.ndarray:
        """Return an image (H, W, 3) uint8 RGB, which must not be modified."""
        self.check()
        if row < len(self._images):
            return self._images[row]
        group, k = self._rows[row]
        return group.image(k)

    def valid(self, row: int) -> np.ndarray | None:
        """Return a mask (H, W) bool of pixels that show the scene; None if all of them do."""
        return None if self._valid is None else self._valid[row]

    def points(self, row: int) -> FramePoints:
        """Return the map points that an image sees, relative to the offset.

        Raises InputError if there are none for training.
        """
        self.check()
        if not self.has_points:
            raise InputError("the data set has no map points for training")
        return self._points[row]


def _points_to_train_on(group: DatasetGroup, row: int, moved_by: list[float]) -> FramePoints:
    """Return the points to train on: all points of a validation frame, whose images are used too."""
    found = group.points(row) if group.role is Role.VALIDATION else group.training_points(row)
    return replace(found, xyz=found.xyz + moved_by) if any(moved_by) else found
