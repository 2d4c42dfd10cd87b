"""What a network must beat: the mean pose, the most similar training image, the paper's table."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import cv2
import numpy as np

from spn_data.geometry.pose import Poses, canonical_quats
from spn_data.matching.features import FeatureOptions, extract
from spn_data.matching.pairs import PairOptions, appearance_vocabulary, describe_appearance
from spn_model.evaluation.metrics import DEG_PER_M, Estimates, Evaluation, nearest_rows

MEAN, ORACLE = "mean training pose", "nearest training pose (oracle)"
VLAD, GEM = "retrieval, VLAD of SIFT", "retrieval, GeM of SqueezeNet"

FeatureMaps = Callable[[np.ndarray], np.ndarray]
"""Images (B, H, W, 3) uint8 RGB to feature maps (B, C, h, w) float32."""


class Images(Protocol):
    """Images of N frames, read one by one; `spn_data.dataset.hdf5_reader.DatasetGroup` is one."""

    def __len__(self) -> int: ...

    def image(self, row: int) -> np.ndarray:
        """(H, W, 3) uint8 RGB."""
        ...

    def valid(self, row: int) -> np.ndarray | None:
        """(H, W) bool: pixels that show the scene; None where all do."""
        ...


class PosedImages(Images, Protocol):
    """Images with their true poses."""

    @property
    def poses(self) -> Poses: ...


Describe = Callable[[Images], np.ndarray]
"""Unit vectors (N, D) float32 of images; the zero vector for one that shows nothing."""


@dataclass(frozen=True, kw_only=True)
class VladOptions:
    """Retrieval by VLAD of SIFT."""

    features: FeatureOptions = field(default_factory=lambda: FeatureOptions(max_features=1000))
    words: int = 64
    vocabulary_images: int = 200  # at most, evenly spread over the training images
    seed: int = 0


@dataclass(frozen=True, kw_only=True)
class GemOptions:
    """Retrieval by generalised-mean pooling of feature maps."""

    power: float = 3.0  # 1: the mean; infinite: the maximum
    batch: int = 8  # images at a time: bounds the memory


def mean_pose(training: Poses) -> tuple[np.ndarray, np.ndarray]:
    """Mean centre (3,) and mean unit quaternion (4,) of at least one pose.

    The quaternion is the eigenvector of the largest eigenvalue of sum q q^T, which does not depend on
    signs: Markley et al. 2007, "Averaging quaternions", eq. 12. Where rotations cancel out it is arbitrary.
    """
    if len(training) == 0:
        raise ValueError("no poses have no mean")
    quats = training.quats_wxyz
    return training.centers.mean(axis=0), canonical_quats(np.linalg.eigh(quats.T @ quats)[1][:, -1])


def baselines(
    training: PosedImages, groups: Sequence[PosedImages], describe: Mapping[str, Describe]
) -> list[list[Estimates]]:
    """For each group: the mean training pose, the oracle, and each way of looking up, by its name.

    Training images are described once. The training frames themselves are no group to look up: each would
    find itself. Raises ValueError for them.
    """
    if any(group is training for group in groups):
        raise ValueError("a training frame looked up finds itself")
    found = [[guess_mean(training.poses, len(g)), oracle(training.poses, g.poses)] for g in groups]
    for method, described in describe.items():
        known = described(training)
        for estimates, group in zip(found, groups, strict=True):
            estimates.append(look_up(method, training.poses, known, described(group)))
    return found


def guess_mean(training: Poses, frames: int) -> Estimates:
    """The mean training pose for each of N frames: what is known without an image."""
    center, quat = mean_pose(training)
    return Estimates(MEAN, Poses(np.tile(center, (frames, 1)), np.tile(quat, (frames, 1))))


def oracle(training: Poses, true: Poses) -> Estimates:
    """The nearest training pose for each of N frames: no lookup of one training frame can be better.

    Nearest is the smallest distance + angle / 10 degrees per metre. Raises GeometryError without training.
    """
    return Estimates(ORACLE, training[nearest_rows(true, training)])


def look_up(method: str, training: Poses, described: np.ndarray, queries: np.ndarray) -> Estimates:
    """The pose of the most similar of M training images for each of N images.

    described : (M, D), queries : (N, D) unit vectors. NaN for an image that is the zero vector.
    """
    if len(training) != len(described):
        raise ValueError(f"{len(training)} training poses of {len(described)} images")
    return posed(method, training, most_similar(described, queries))


def most_similar(described: np.ndarray, queries: np.ndarray) -> np.ndarray:
    """(N,) row of the most similar of M images (M, D) for each of N (N, D), unit vectors; -1 for zero."""
    rows = np.full(len(queries), -1)
    shows = np.flatnonzero(np.any(queries != 0, axis=1))
    if len(shows):
        rows[shows] = np.argmax(queries[shows] @ described.T, axis=1)
    return rows


def posed(method: str, training: Poses, rows: np.ndarray) -> Estimates:
    """The training poses at rows (N,); NaN at -1."""
    centers, quats = np.full((len(rows), 3), np.nan), np.full((len(rows), 4), np.nan)
    found = rows >= 0
    centers[found], quats[found] = training.centers[rows[found]], training.quats_wxyz[rows[found]]
    return Estimates(method, Poses(centers, quats))


def vlad(training: Images, options: VladOptions | None = None) -> Describe:
    """Describes images by VLAD of RootSIFT with a vocabulary from the training images alone."""
    options = options or VladOptions()
    count = min(len(training), options.vocabulary_images)
    rows = np.unique(np.linspace(0, len(training) - 1, count).round().astype(np.int64))
    words = PairOptions(words=options.words, seed=options.seed)
    vocabulary = appearance_vocabulary([_sift(training, int(row), options) for row in rows], words)

    def describe(images: Images) -> np.ndarray:
        found = np.zeros((len(images), vocabulary.size), np.float32)
        for row in range(len(images)):
            found[row] = describe_appearance(_sift(images, row, options), vocabulary)
        return found

    return describe


def gem(feature_maps: FeatureMaps, options: GemOptions | None = None) -> Describe:
    """Describes images by generalised-mean pooling of non-negative feature maps.

    Radenovic et al. 2018, "Fine-tuning CNN image retrieval with no human annotation", eq. 3.
    Invalid pixels are taken as they are, black.
    """
    options = options or GemOptions()

    def describe(images: Images) -> np.ndarray:
        parts = []
        for first in range(0, len(images), options.batch):
            rows = range(first, min(first + options.batch, len(images)))
            parts.append(pool(feature_maps(np.stack([images.image(r) for r in rows])), options))
        return np.concatenate(parts) if parts else np.zeros((0, 0), np.float32)

    return describe


def pool(maps: np.ndarray, options: GemOptions) -> np.ndarray:
    """Unit vectors (B, C): the power mean over the cells of feature maps (B, C, h, w), all at least 0."""
    positive = np.maximum(np.asarray(maps, np.float64), 0.0)
    highest = np.maximum(positive.max(axis=(2, 3), keepdims=True), 1e-12)
    # Relative to the highest cell, so that no power overflows.
    mean = ((positive / highest) ** options.power).mean(axis=(2, 3)) ** (1 / options.power)
    pooled = mean * highest[:, :, 0, 0]
    length = np.linalg.norm(pooled, axis=1, keepdims=True)
    return np.asarray(np.where(length > 1e-9, pooled / np.maximum(length, 1e-9), 0.0), np.float32)


def better(evaluations: Sequence[Evaluation]) -> Evaluation:
    """Of retrieval methods on one group, the one with the smaller median of error + angle / 10 deg per m.

    Chosen by the very frames that are judged, in favour of retrieval: a network must beat the better one.
    """
    return min(evaluations, key=_cost)


def _cost(evaluation: Evaluation) -> float:
    errors = evaluation.errors
    cost = errors.error_m + errors.error_deg / DEG_PER_M
    return float(np.median(np.where(np.isnan(cost), np.inf, cost)))


def _sift(images: Images, row: int, options: VladOptions) -> np.ndarray:
    gray = cv2.cvtColor(images.image(row), cv2.COLOR_RGB2GRAY)
    return extract(gray, images.valid(row), options.features).descriptors


@dataclass(frozen=True)
class Published:
    """A published error of a network; sequence : medium or low, as the paper's coverage."""

    network: str
    sequence: str
    position_m: float
    rotation_deg: float


PAPER_SOURCE = (
    "Mueller, Urban, Jutzi 2017: SqueezePoseNet: Image Based Pose Regression with Small Convolutional "
    "Neural Networks for Real Time UAS Navigation. ISPRS Annals IV-2/W3, table 1. Measured in the LaFiDa "
    "atrium, 39 m x 36 m x 18 m, with cameras of its own: another place than the one evaluated here. "
    "Whether the figures are means or medians is not said."
)
PAPER_TABLE_1 = (
    Published("PoseNet", "medium", 8.60, 50.83),
    Published("VGG16-Net (modified)", "medium", 4.91, 33.30),
    Published("SqueezePoseNet", "medium", 5.19, 29.28),
    Published("PoseNet", "low", 11.47, 46.40),
    Published("VGG16-Net (modified)", "low", 11.34, 37.33),
    Published("SqueezePoseNet", "low", 15.18, 65.02),
)
