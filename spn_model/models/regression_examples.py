"""What a pose regressor learns from: training images with their cameras turned about, and their labels."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from spn_data.geometry.pose import Poses
from spn_model.examples.augment import PhotometricOptions, augment_photometrically, random_warp
from spn_model.examples.training_set import TrainingSet
from spn_model.models.regression_options import RegressionStageOptions


def input_size(width: int, height: int, wanted_width: int) -> tuple[int, int]:
    """(width, height) that a network is given of an image; wanted_width 0: as it is."""
    if not wanted_width:
        return width, height
    return wanted_width, max(1, round(height * wanted_width / width))


def resized(image: np.ndarray, wanted_width: int) -> np.ndarray:
    """(h, w, 3) uint8 of that width, from (H, W, 3); every pixel counts where it shrinks."""
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
    """A training image (h, w, 3) uint8, varied, and its pose, exactly (1).

    A turned camera has the K of the real one: nothing is zoomed, for a regressor takes a nearer view for a
    nearer place. What the real camera did not see is black.
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
    """Map points (B, count, 3) that the images of rows (B,) see from poses (B), and which are any (B, count).

    Those of the image, drawn evenly, that the turned camera still has in view.
    """
    xyz, seen = np.zeros((len(rows), count, 3)), np.zeros((len(rows), count), bool)
    for k, row in enumerate(rows):
        points = data.points(int(row)).xyz
        in_camera = (points - poses.centers[k]) @ poses.rotations[k].T
        with np.errstate(divide="ignore", invalid="ignore"):
            homogeneous = in_camera @ data.intrinsics[row].T
            pixels = homogeneous[:, :2] / homogeneous[:, 2:]
            inside = ((pixels >= 0) & (pixels < data.size)).all(axis=1) & (in_camera[:, 2] > 0)
        chosen = generator.permutation(np.flatnonzero(inside))[:count]
        xyz[k, : len(chosen)], seen[k, : len(chosen)] = points[chosen], True
    return xyz, seen


@dataclass(frozen=True, eq=False)
class FeatureCache:
    """What a frozen trunk makes of variants of every image.

    features : each (N, K, ...) float32; poses : N * K, row after row.
    """

    features: tuple[np.ndarray, ...]
    poses: Poses

    def draw(
        self, rows: np.ndarray, generator: np.random.Generator
    ) -> tuple[list[np.ndarray], Poses]:
        """Features, each (B, ...), and poses of a variant of each of rows (B,)."""
        variants = self.features[0].shape[1]
        chosen = generator.integers(variants, size=len(rows))
        return [part[rows, chosen] for part in self.features], self.poses[rows * variants + chosen]
