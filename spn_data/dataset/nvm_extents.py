"""Checks of image sizes against a VisualSFM model, which does not state the size of its images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spn_data.dataset.nvm_frames import NvmFrames

_MARGIN_PX = 1.0
# A few measurements may lie on the border; where more are outside, the model is of other images.
_OUTSIDE_SHARE, _OUTSIDE_COUNT = 0.02, 2
# In images of the right size, measurements reach the border, if there are many of them.
_MIN_FRAMES, _MIN_MEASURED = 5, 200
_TOO_SMALL, _SUSPICIOUS = 0.7, 0.85
_SAME_FOCAL, _OTHER_WIDTH = 0.05, 0.1


@dataclass(frozen=True, eq=False)
class Extents:
    """Extent of the measurements in N frames.

    Attributes
    ----------
    count : ndarray of int, shape (N,)
        Number of measurements.
    half_px : ndarray, shape (N, 2)
        Largest distance from the image centre, right or left of it and above or below; 0 without one.
    """

    count: np.ndarray
    half_px: np.ndarray
    _offsets: tuple[np.ndarray, ...]

    @classmethod
    def of(cls, model: NvmFrames, n: int) -> Extents:
        """Return the extents of all N listed frames."""
        offsets = tuple(np.abs(model.offsets(k)) for k in range(n))
        half_px = np.array([o.max(axis=0) if len(o) else np.zeros(2) for o in offsets])
        return cls(np.array([len(o) for o in offsets]), half_px.reshape(-1, 2), offsets)

    def outside(self, sizes: np.ndarray) -> np.ndarray:
        """Return the number of measurements outside images of sizes (N, 2), (N,)."""
        return np.array(
            [
                int((offsets > size / 2 + _MARGIN_PX).any(axis=1).sum())
                for offsets, size in zip(self._offsets, sizes, strict=True)
            ],
            dtype=np.int64,
        )

    def misfits(self, sizes: np.ndarray) -> np.ndarray:
        """Return which frames are not as large as the images that the model was made of, (N,)."""
        return self.outside(sizes) > np.maximum(_OUTSIDE_COUNT, _OUTSIDE_SHARE * self.count)


def stored_orientation(
    extents: Extents, upright: np.ndarray, stored: np.ndarray, rows: np.ndarray
) -> bool | None:
    """Decide whether a model is of the pixels as stored, or of the images turned upright by their EXIF.

    Parameters
    ----------
    extents : Extents
        Of N frames.
    upright, stored : ndarray of int, shape (N, 2)
        Width and height of the images, turned upright and as stored.
    rows : ndarray of int
        Frames whose EXIF turns them.

    Returns
    -------
    bool or None
        True if the measurements fit only in the pixels as stored, False if only in the upright image, and
        None if in both (such as in an image turned by 180 degrees) or in neither.
    """
    turned = np.zeros(len(upright), dtype=bool)
    turned[rows] = True
    fits_upright = not (extents.misfits(upright) & turned).any()
    fits_stored = not (extents.misfits(stored) & turned).any()
    if fits_upright == fits_stored or not extents.count[rows].any():
        return None
    return fits_stored


def shrunken_sizes(
    extents: Extents, model: NvmFrames, sizes: np.ndarray, names: Sequence[str]
) -> tuple[str, str]:
    """Find images that are larger than those that the model was made of.

    Parameters
    ----------
    extents : Extents
        Of N frames.
    model : NvmFrames
        Their model.
    sizes : ndarray of int, shape (N, 2)
        Width and height of the images; 0 if there is none.
    names : sequence of str
        Names of the frames.

    Returns
    -------
    refusal, note : str
        One sentence each, or "". Measurements that reach less than 0.7 of the way to the border of the image,
        or images of two sizes with the same focal length in pixels, are refused; less than 0.85 is noted.
    """
    note = ""
    reach: dict[tuple[int, int], tuple[float, float, int]] = {}
    for width, height in np.unique(sizes[extents.count > 0], axis=0).tolist():
        rows = np.flatnonzero((sizes == (width, height)).all(axis=1) & (extents.count > 0))
        if not width or len(rows) < _MIN_FRAMES or extents.count[rows].sum() < _MIN_MEASURED:
            continue
        share = float((extents.half_px[rows].max(axis=0) / (width / 2, height / 2)).max())
        focal = float(np.median([model.focal_px(int(k)) for k in rows]))
        reach[width, height] = (share, focal, int(rows[0]))
    for (width, height), (share, focal, row) in reach.items():
        same_focal = any(
            abs(other_focal / focal - 1) < _SAME_FOCAL
            and width / other_width > 1 + _OTHER_WIDTH
            and other_share > share
            for (other_width, _), (other_share, other_focal, _) in reach.items()
        )
        sentence = (
            f"{names[row]} and the other images of {width}x{height}: the model's measurements reach only "
            f"{100 * share:.0f} % of the way from their centre to their border"
        )
        if share < _TOO_SMALL or same_focal:
            return f"{sentence}, so it was made of smaller images", ""
        if share < _SUSPICIOUS:
            note = f"{sentence}; if it was made of smaller images, the focal lengths are wrong"
    return "", note
