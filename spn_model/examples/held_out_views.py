"""Rendered novel views that training never draws, for validation; their poses are exact."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spn_data.geometry.pose import Poses


@dataclass(frozen=True, eq=False)
class HeldOutViews:
    """Validation frames rendered from a data set, in addition to its own.

    Attributes
    ----------
    poses : Poses
        N exact poses.
    intrinsics : ndarray, shape (N, 3, 3)
        Intrinsic matrices K of the images that `image` returns.
    small : sequence of ndarray, uint8, shape (h, w, 3)
        RGB images as the network sees them, `enlarged` times smaller than the data set's.
    enlarged : int
        Factor between the two sizes.
    """

    poses: Poses
    intrinsics: np.ndarray
    small: Sequence[np.ndarray]
    enlarged: int

    def image(self, row: int) -> np.ndarray:
        """Return an image (H, W, 3) of the data set's size.

        Its pixels are blocks of one colour, which the network reduces to `small` again.
        """
        return self.small[row].repeat(self.enlarged, axis=0).repeat(self.enlarged, axis=1)
