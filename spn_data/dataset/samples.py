"""Frames of dataset.h5 as samples for training, for `torch.utils.data.DataLoader` and plain loops."""

from __future__ import annotations

import os
from collections.abc import Iterator
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from spn_data.dataset.hdf5_reader import Dataset, DatasetGroup
from spn_data.errors import InputError


class Samples:
    """Images and poses of one group of a data set, by index.

    A sample is a dict of plain values that PyTorch's default collate function turns into batches. The file
    is opened again in each worker process; instances can be pickled.

    Parameters
    ----------
    path : str or path-like
        dataset.h5.
    group : str, optional
        Name of the group: "train", "validation", "test", or a test group's own name.

    Attributes
    ----------
    path : Path
    group : str

    Raises
    ------
    InputError
        If the file or the group does not exist.
    FormatError
        If the file is damaged or not a data set.

    Notes
    -----
    Keys of a sample: ``image`` uint8 (H, W, 3) RGB, absent from a data set without images; ``position``
    float64 (3,), the camera centre in the world; ``quaternion`` float64 (4,), unit, scalar first, world to
    camera; ``intrinsics`` float64 (3, 3), NaN if unknown, in COLMAP's pixel convention; ``covariance``
    float64 (6, 6), NaN if unknown; ``name`` str; ``index`` int.

    Subtract `offset` from positions before they become float32, and add it to estimates in float64: it is
    zero unless the world's coordinates are too large for float32, as UTM northings are.

    Examples
    --------
    >>> from torch.utils.data import DataLoader
    >>> train = spn_data.open_samples("fields/north/5-split/dataset.h5", "train")
    >>> for batch in DataLoader(train, batch_size=32, shuffle=True, num_workers=2):
    ...     batch["image"], batch["position"], batch["quaternion"]
    """

    def __init__(self, path: str | PathLike[str], group: str = "train"):
        self.path, self.group = Path(path), group
        self._opened: tuple[int, Dataset] | None = None
        self._open()

    @property
    def offset(self) -> np.ndarray:
        """World position (3,) about which the frames are; zero if float32 resolves their coordinates."""
        return np.array(self._open().offset)

    def __len__(self) -> int:
        return len(self._open())

    def __getitem__(self, index: int) -> dict[str, Any]:
        frames = self._open()
        row = range(len(frames))[index]
        sample: dict[str, Any] = {
            "position": frames.poses.centers[row],
            "quaternion": frames.poses.quats_wxyz[row],
            "intrinsics": frames.intrinsics[row],
            "covariance": frames.covariance[row],
            "name": str(frames.names[row]),
            "index": row,
        }
        if frames.image_size is not None:
            sample["image"] = frames.image(row)
        return {name: _own(value) for name, value in sample.items()}

    def __iter__(self) -> Iterator[dict[str, Any]]:
        return (self[row] for row in range(len(self)))

    def __getstate__(self) -> dict[str, Any]:
        return {"path": self.path, "group": self.group}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.path, self.group, self._opened = state["path"], state["group"], None

    def close(self) -> None:
        """Close the file; it is opened again when needed."""
        if self._opened is not None and self._opened[0] == os.getpid():
            self._opened[1].close()
        self._opened = None

    def _open(self) -> DatasetGroup:
        """Return the group, opened by this very process: HDF5 files do not survive a fork."""
        if self._opened is None or self._opened[0] != os.getpid():
            self._opened = os.getpid(), Dataset(self.path)
        groups = self._opened[1].groups
        if self.group not in groups:
            known = ", ".join(groups) or "none"
            raise InputError(f"has no group {self.group!r}; it has: {known}", path=self.path)
        return groups[self.group]


def _own(value: Any) -> Any:
    """Return a copy of a row, which a batch may then keep and change."""
    return value.copy() if isinstance(value, np.ndarray) else value


def open_samples(path: str | PathLike[str], group: str = "train") -> Samples:
    """Open a group of a data set as samples for training.

    Parameters
    ----------
    path : str or path-like
        dataset.h5.
    group : str, optional
        Name of the group.

    Returns
    -------
    Samples

    Raises
    ------
    InputError
        If the file or the group does not exist.
    FormatError
        If the file is damaged or not a data set.
    """
    return Samples(path, group)
