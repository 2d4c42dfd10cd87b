"""SIFT on board: as OpenCV's, with which the features of a map are extracted, in two thirds of the time.

Orientations and descriptors (Lowe 2004, sections 5 and 6) are sampled on a grid that turns and grows with the
keypoint, and binned by one matrix product. `benchmarks/search_speed.py` compares them with OpenCV's.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from spn_data.geometry.camera import colmap_pixels
from spn_data.matching.features import FeatureOptions, Features, reduced, root_sift
from spn_model.landmarks.keypoints import Keypoints, ScaleSpace

_CHUNK = 64  # keypoints sampled at once, so that their patches fit into the CPU cache
_ANGLES = 36  # bins of the histogram of an orientation
_ANGLE_SIGMA, _ANGLE_STEP, _ANGLE_STEPS = 1.5, 0.75, 6  # of its window, in scales
_OTHER_PEAK = 0.8  # of the highest one, from which a keypoint has another orientation
_CELLS, _BINS = 4, 8  # of a descriptor, on each side and by angle
_CELL_SIGMAS = 3.0  # side of a cell, in scales
_SAMPLES = 16  # on each side, over five cells
_MOST = 0.2  # of an element of a descriptor of length one


class Sift:
    """Extraction of features from images of one camera: memory is kept from one to the next.

    Parameters
    ----------
    options : FeatureOptions
    """

    def __init__(self, options: FeatureOptions):
        self.options = options
        self._space = ScaleSpace(0, 0)

    def extract(self, gray: np.ndarray) -> Features:
        """Extract the features of a grey image.

        Parameters
        ----------
        gray : ndarray of uint8, shape (H, W)

        Returns
        -------
        Features
            As `spn_data.matching.features.extract` returns them.
        """
        options, small = self.options, reduced(gray, self.options.max_image_size_px)
        size = small.shape[1], small.shape[0]
        if self._space.size != size:
            self._space = ScaleSpace(*size)
        self._space.fill(small)
        points = self._space.keypoints(
            options.max_features, options.contrast_threshold, options.edge_threshold
        )
        rows, angles = _orientations(self._space, points)
        rows, angles = rows[: options.max_features], angles[: options.max_features]
        points = points.select(rows)
        pixels = 2.0 ** (points.octaves - 1)  # of the image in one of the octave
        factors = np.array([gray.shape[1] / size[0], gray.shape[0] / size[1]])
        keypoints = np.column_stack(
            [
                colmap_pixels(points.at * pixels[:, None]) * factors,
                points.sigmas * pixels * factors.mean(),
                -angles % (2 * np.pi),
            ]
        )
        raw = _descriptors(self._space, points, angles)
        return Features(keypoints.astype(np.float32), root_sift(raw))


def _gradients(
    space: ScaleSpace, points: Keypoints, grid: np.ndarray, frames: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield rows of some keypoints (n,) with sizes and angles (n, S * S) of their gradients on a grid.

    `grid` ((S + 2)**2, 2) has columns and rows along whose axes differences are taken; `frames` (K, 2, 2) the
    steps of these axes in the image, as rows. Angles are positive upwards.
    """
    side, spread = round(len(grid) ** 0.5), np.vstack([grid.T, np.ones(len(grid), np.float32)])
    affine = np.concatenate([frames, points.at[:, None]], axis=1).astype(np.float32)
    order = np.lexsort((points.layers, points.octaves))
    changes = np.diff(points.octaves[order]).astype(bool) | np.diff(points.layers[order]).astype(
        bool
    )
    for rows in np.split(order, np.flatnonzero(changes) + 1):
        for begin in range(0, len(rows), _CHUNK):
            some = rows[begin : begin + _CHUNK]
            image = space.layer(int(points.octaves[some[0]]), int(points.layers[some[0]]))
            column, row = (affine[some, :, axis] @ spread for axis in range(2))
            found = cv2.remap(
                image, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
            ).reshape(-1, side, side)
            right = found[:, 1:-1, 2:] - found[:, 1:-1, :-2]
            up = found[:, :-2, 1:-1] - found[:, 2:, 1:-1]
            size, angle = cv2.cartToPolar(right.reshape(len(some), -1), up.reshape(len(some), -1))
            yield some, size, angle


def _grid(along: np.ndarray) -> np.ndarray:
    """Return columns and rows ((S + 2)**2, 2) of a square grid, with the neighbours of its border."""
    wide = np.concatenate([2 * along[:1] - along[1:2], along, 2 * along[-1:] - along[-2:-1]])
    return np.stack(np.meshgrid(wide, wide), axis=-1).reshape(-1, 2).astype(np.float32)


def _orientations(space: ScaleSpace, points: Keypoints) -> tuple[np.ndarray, np.ndarray]:
    """Return rows of keypoints and their orientations: one, or more where a histogram has several peaks."""
    along = _ANGLE_STEP * np.arange(-_ANGLE_STEPS, _ANGLE_STEPS + 1)
    window = np.exp(-(along[:, None] ** 2 + along**2) / (2 * _ANGLE_SIGMA**2)).ravel()
    histogram = np.zeros((len(points), _ANGLES))
    frames = points.sigmas[:, None, None] * np.eye(2)
    for some, size, angle in _gradients(space, points, _grid(along), frames):
        size *= window.astype(np.float32)
        angle *= _ANGLES / (2 * np.pi)
        lower = angle.astype(np.int64)
        upper = size * (angle - lower)
        # Two bins more than there are: the last ones are the first ones again.
        lower += (_ANGLES + 2) * np.arange(len(some))[:, None]
        sums = np.zeros((len(some), _ANGLES + 2))
        for bins, share in ((lower, size - upper), (lower + 1, upper)):
            sums += np.bincount(bins.ravel(), share.ravel(), sums.size).reshape(sums.shape)
        histogram[some] = sums[:, :_ANGLES]
        histogram[some, :2] += sums[:, _ANGLES:]

    def turned(by: int) -> np.ndarray:
        return np.roll(histogram, by, axis=1)

    histogram = (turned(2) + turned(-2) + 4 * (turned(1) + turned(-1)) + 6 * histogram) / 16
    before, after = turned(1), turned(-1)
    highest = histogram.max(axis=1, initial=0, keepdims=True)
    peaks = (histogram > before) & (histogram > after) & (histogram >= _OTHER_PEAK * highest)
    row, at = np.nonzero(peaks)
    low, middle, high = (values[row, at] for values in (before, histogram, after))
    offset = 0.5 * (low - high) / (low - 2 * middle + high)
    return row, (at + offset) * (2 * np.pi / _ANGLES)


def _descriptors(space: ScaleSpace, points: Keypoints, angles: np.ndarray) -> np.ndarray:
    """Return SIFT descriptors (K, 128) of keypoints with orientations."""
    along = (np.arange(_SAMPLES) + 0.5) * ((_CELLS + 1) / _SAMPLES) - (_CELLS + 1) / 2
    share = np.maximum(0, 1 - np.abs(along[:, None] - (np.arange(_CELLS) - (_CELLS - 1) / 2)))
    window = np.exp(-(along[:, None] ** 2 + along**2) / (_CELLS**2 / 2))
    # How much each sample counts in each cell.
    weights = np.einsum("rc,ra,cb->rcab", window, share, share).reshape(_SAMPLES**2, -1)
    weights = weights.astype(np.float32)
    cos, sin = _CELL_SIGMAS * points.sigmas * np.array([np.cos(angles), np.sin(angles)])
    frames = np.stack([cos, -sin, sin, cos], axis=1).reshape(-1, 2, 2)
    found = np.zeros((len(points), _CELLS**2, _BINS), np.float32)
    for some, size, angle in _gradients(space, points, _grid(along), frames):
        angle *= _BINS / (2 * np.pi)
        binned = np.empty((len(some), _BINS, _SAMPLES**2), np.float32)
        for k in range(_BINS):
            off = np.subtract(angle, k)
            np.abs(off, out=off)
            if k == 0:
                np.minimum(off, _BINS - off, out=off)
            np.subtract(1, off, out=off)
            np.maximum(off, 0, out=off)
            np.multiply(off, size, out=binned[:, k])
        cells = binned.reshape(-1, _SAMPLES**2) @ weights
        found[some] = cells.reshape(len(some), _BINS, -1).transpose(0, 2, 1)
    flat = found.reshape(len(points), _CELLS**2 * _BINS)
    flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12)
    return np.minimum(flat, _MOST)
