"""Rendered images of places where no image was taken, which a training never draws: their poses are exact."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spn_data.geometry.pose import Poses


@dataclass(frozen=True, eq=False)
class HeldOutViews:
    """Frames to judge a network by, beside those of a data set.

    intrinsics (N, 3, 3) : of `image`'s; small : images (h, w, 3) uint8 RGB, which are `enlarged` times
    smaller than the data's, as the network sees them.
    """

    poses: Poses
    intrinsics: np.ndarray
    small: Sequence[np.ndarray]
    enlarged: int

    def image(self, row: int) -> np.ndarray:
        """(H, W, 3) of the data's size: blocks of one colour, which the network reduces to `small`."""
        return self.small[row].repeat(self.enlarged, axis=0).repeat(self.enlarged, axis=1)
