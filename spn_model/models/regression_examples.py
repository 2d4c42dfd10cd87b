"""Training examples of a pose regressor: images of rotated cameras and their exact poses."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from spn_data.geometry.pose import Poses
from spn_model.examples.augment import PhotometricOptions, augment_photometrically, random_warp
from spn_model.examples.training_set import TrainingSet
from spn_model.models.regression_options import RegressionStageOptions


def input_size(width: int, height: int, wanted_width: int) -> tuple[int, int]:
    """Return the network's input size (width, height) for an image.

    Parameters
    ----------
    width, height : int
        Size of the image.
    wanted_width : int
        Width of the input, which keeps the aspect ratio; 0 for the image's own size.
    """
    if not wanted_width:
        return width, height
    return wanted_width, max(1, round(height * wanted_width / width))


def resized(image: np.ndarray, wanted_width: int) -> np.ndarray:
    """Resize an image (H, W, 3) uint8 to a width; 0 keeps its size.

    Pixels are averaged by area if the image shrinks.
    """
    height, width = image.shape[:2]
    size = input_size(width, height, wanted_width)
    if size == (width, height):
        return image
    smaller = size[0] < width
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR)


def augmented_example(
    data: TrainingSet,
    row: int,
    wanted_width: int,
    options: RegressionStageOptions,
    generator: np.random.Generator,
) -> tuple[np.ndarray, Poses]:
    """Return an augmented training image (h, w, 3) uint8 and its exact pose.

    The rotated camera keeps the K of the real one; it is not zoomed, because a regressor mistakes a zoomed
    view for a closer position. Pixels outside the real image are black.
    """
    image, pose = resized(data.image(row), wanted_width), data.poses[row : row + 1]
    if options.warp is not None:
        height, width = image.shape[:2]
        shrunk = np.diag([width / data.size[0], height / data.size[1], 1.0])
        matrix = shrunk @ data.intrinsics[row]
        warp = random_warp(generator, matrix, (width, height), options.warp, zoom=1.0)
        image, pose = warp.image(image), warp.pose(pose)
    if options.augmentation and options.look:
        image = augment_photometrically(image, generator, PhotometricOptions())
    return image, pose


def visible_points(
    data: TrainingSet,
    rows: np.ndarray,
    poses: Poses,
    count: int,
    generator: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Return map points (B, count, 3) seen from poses (B), and a mask (B, count) of the valid ones.

    They are drawn uniformly from the points of each image that the rotated camera still has in view.
    """
    xyz, seen = np.zeros((len(rows), count, 3)), np.zeros((len(rows), count), bool)
    for k, row in enumerate(rows):
        points = data.points(int(row)).xyz
        in_camera = poses.to_camera(points, k)
        with np.errstate(divide="ignore", invalid="ignore"):
            homogeneous = in_camera @ data.intrinsics[row].T
            pixels = homogeneous[:, :2] / homogeneous[:, 2:]
            inside = ((pixels >= 0) & (pixels < data.size)).all(axis=1) & (in_camera[:, 2] > 0)
        chosen = generator.permutation(np.flatnonzero(inside))[:count]
        xyz[k, : len(chosen)], seen[k, : len(chosen)] = points[chosen], True
    return xyz, seen


@dataclass(frozen=True, eq=False)
class FeatureCache:
    """Features that a frozen trunk computes from K augmented variants of every image.

    Attributes
    ----------
    features : tuple of ndarray, float32, shape (N, K, ...)
    poses : Poses
        N * K poses, row by row.
    """

    features: tuple[np.ndarray, ...]
    poses: Poses

    def draw(
        self, rows: np.ndarray, generator: np.random.Generator
    ) -> tuple[list[np.ndarray], Poses]:
        """Draw a variant of each row (B,); return features, each (B, ...), and poses."""
        variants = self.features[0].shape[1]
        chosen = generator.integers(variants, size=len(rows))
        return [part[rows, chosen] for part in self.features], self.poses[rows * variants + chosen]
