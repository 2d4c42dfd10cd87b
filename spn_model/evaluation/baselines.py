"""Baselines that need no network: mean pose, image retrieval, and the published results of the paper."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import cv2
import numpy as np

from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import canonical_quats
from spn_data.matching.features import FeatureOptions, extract
from spn_data.matching.pairs import PairOptions, visual_vocabulary, vlad_descriptor
from spn_model.evaluation.metrics import DEG_PER_M, Estimates, Evaluation, nearest_rows

MEAN, ORACLE = "mean training pose", "nearest training pose (oracle)"
VLAD, GEM = "retrieval, VLAD of SIFT", "retrieval, GeM of SqueezeNet"

FeatureMaps = Callable[[np.ndarray], np.ndarray]
"""Maps images (B, H, W, 3) uint8 RGB to feature maps (B, C, h, w) float32."""


class Images(Protocol):
    """Images of N frames, read one by one; `spn_data.dataset.hdf5_reader.DatasetGroup` is one."""

    def __len__(self) -> int: ...

    def image(self, row: int) -> np.ndarray:
        """Return an image, (H, W, 3) uint8 RGB."""
        ...

    def valid(self, row: int) -> np.ndarray | None:
        """Return the mask (H, W) bool of pixels that show the scene, or None if all do."""
        ...


class PosedImages(Images, Protocol):
    """Images with their true poses."""

    @property
    def poses(self) -> Poses:
        """True poses (N)."""
        ...


Describe = Callable[[Images], np.ndarray]
"""Maps N images to unit vectors (N, D) float32; an image without features gives the zero vector."""


@dataclass(frozen=True, kw_only=True)
class VladOptions:
    """Options of retrieval by VLAD of SIFT descriptors."""

    features: FeatureOptions = field(default_factory=lambda: FeatureOptions(max_features=1000))
    words: int = 64
    vocabulary_images: int = 200  # maximum, evenly spread over the training images
    seed: int = 0


@dataclass(frozen=True, kw_only=True)
class GemOptions:
    """Options of retrieval by generalised-mean (GeM) pooling of feature maps."""

    power: float = 3.0  # 1: mean pooling; infinity: max pooling
    batch: int = 8  # images per call; bounds the memory


def mean_pose(training: Poses) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean centre (3,) and mean unit quaternion (4,) of at least one pose.

    The quaternion is the eigenvector of the largest eigenvalue of sum q q^T, which does not depend on the
    signs of the quaternions: Markley et al. 2007, "Averaging quaternions", eq. 12. It is arbitrary if the
    rotations cancel out. Raises ValueError if there is no pose.
    """
    if len(training) == 0:
        raise ValueError("cannot average zero poses")
    quats = training.quats_wxyz
    return training.centers.mean(axis=0), canonical_quats(np.linalg.eigh(quats.T @ quats)[1][:, -1])


def baselines(
    training: PosedImages, groups: Sequence[PosedImages], describe: Mapping[str, Describe]
) -> list[list[Estimates]]:
    """Return, for each group, the estimates of the mean training pose, the oracle, and each retrieval method.

    describe : image descriptors, by name of the retrieval method. The training images are described only
    once. Raises ValueError if a group is the training group: each of its frames would retrieve itself.
    """
    if any(group is training for group in groups):
        raise ValueError("the training group cannot be queried: each frame would retrieve itself")
    found = [
        [
            mean_pose_estimates(training.poses, len(g)),
            nearest_pose_estimates(training.poses, g.poses),
        ]
        for g in groups
    ]
    for method, described in describe.items():
        known = described(training)
        for estimates, group in zip(found, groups, strict=True):
            estimates.append(retrieve(method, training.poses, known, described(group)))
    return found


def mean_pose_estimates(training: Poses, frames: int) -> Estimates:
    """Estimate the mean training pose for each of N frames: the best guess without an image."""
    center, quat = mean_pose(training)
    return Estimates(MEAN, Poses(np.tile(center, (frames, 1)), np.tile(quat, (frames, 1))))


def nearest_pose_estimates(training: Poses, true: Poses) -> Estimates:
    """Estimate the nearest training pose for each of N frames: a bound on retrieval of one training image.

    The nearest training pose has the smallest distance + angle / (10 degrees per metre) to the true pose.
    Raises GeometryError if there are no training poses.
    """
    return Estimates(ORACLE, training[nearest_rows(true, training)])


def retrieve(method: str, training: Poses, described: np.ndarray, queries: np.ndarray) -> Estimates:
    """Estimate, for each of N images, the pose of the most similar of M training images.

    described : (M, D), queries : (N, D), unit vectors. The pose is NaN if the query is the zero vector.
    Raises ValueError if `training` and `described` have different lengths.
    """
    if len(training) != len(described):
        raise ValueError(f"{len(training)} training poses for {len(described)} descriptors")
    return estimates_at(method, training, most_similar(described, queries))


def most_similar(described: np.ndarray, queries: np.ndarray) -> np.ndarray:
    """Return the row (N,) of the most similar training image for each query.

    described : (M, D), queries : (N, D), unit vectors, compared by their dot product. The row is -1 if the
    query is the zero vector.
    """
    rows = np.full(len(queries), -1)
    shows = np.flatnonzero(np.any(queries != 0, axis=1))
    if len(shows):
        rows[shows] = np.argmax(queries[shows] @ described.T, axis=1)
    return rows


def estimates_at(method: str, training: Poses, rows: np.ndarray) -> Estimates:
    """Estimate the training poses at rows (N,); NaN where the row is -1."""
    centers, quats = np.full((len(rows), 3), np.nan), np.full((len(rows), 4), np.nan)
    found = rows >= 0
    centers[found], quats[found] = training.centers[rows[found]], training.quats_wxyz[rows[found]]
    return Estimates(method, Poses(centers, quats))


def vlad(training: Images, options: VladOptions | None = None) -> Describe:
    """Return a VLAD descriptor of RootSIFT whose vocabulary comes from the training images alone."""
    options = options or VladOptions()
    count = min(len(training), options.vocabulary_images)
    rows = np.unique(np.linspace(0, len(training) - 1, count).round().astype(np.int64))
    words = PairOptions(words=options.words, seed=options.seed)
    vocabulary = visual_vocabulary([_sift(training, int(row), options) for row in rows], words)

    def describe(images: Images) -> np.ndarray:
        found = np.zeros((len(images), vocabulary.size), np.float32)
        for row in range(len(images)):
            found[row] = vlad_descriptor(_sift(images, row, options), vocabulary)
        return found

    return describe


def gem(feature_maps: FeatureMaps, options: GemOptions | None = None) -> Describe:
    """Return a descriptor that pools non-negative feature maps by their generalised mean.

    Radenovic et al. 2018, "Fine-tuning CNN image retrieval with no human annotation", eq. 3.
    Invalid pixels are not masked: they enter the feature maps as black.
    """
    options = options or GemOptions()

    def describe(images: Images) -> np.ndarray:
        parts = []
        for first in range(0, len(images), options.batch):
            rows = range(first, min(first + options.batch, len(images)))
            parts.append(gem_pool(feature_maps(np.stack([images.image(r) for r in rows])), options))
        return np.concatenate(parts) if parts else np.zeros((0, 0), np.float32)

    return describe


def gem_pool(maps: np.ndarray, options: GemOptions) -> np.ndarray:
    """Return unit vectors (B, C): the power mean over the cells of feature maps (B, C, h, w).

    Negative values of the maps are clipped to 0. An all-zero map gives the zero vector.
    """
    positive = np.maximum(np.asarray(maps, np.float64), 0.0)
    highest = np.maximum(positive.max(axis=(2, 3), keepdims=True), 1e-12)
    # Normalise by the largest cell, so that the power does not overflow.
    mean = ((positive / highest) ** options.power).mean(axis=(2, 3)) ** (1 / options.power)
    pooled = mean * highest[:, :, 0, 0]
    length = np.linalg.norm(pooled, axis=1, keepdims=True)
    return np.asarray(np.where(length > 1e-9, pooled / np.maximum(length, 1e-9), 0.0), np.float32)


def better_retrieval(evaluations: Sequence[Evaluation]) -> Evaluation:
    """Return the retrieval method with the smaller median of position error + angle / (10 degrees per metre).

    evaluations : of the retrieval methods on one group. The choice uses the evaluated frames themselves and
    so favours retrieval: a network has to beat the better of the two.
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
    """A published error of a network. sequence : "medium" or "low", the coverage in the paper."""

    network: str
    sequence: str
    position_m: float
    rotation_deg: float


PAPER_SOURCE = (
    "Mueller, Urban, Jutzi 2017: SqueezePoseNet: Image Based Pose Regression with Small Convolutional "
    "Neural Networks for Real Time UAS Navigation. ISPRS Annals IV-2/W3, table 1. Measured in the LaFiDa "
    "atrium, 39 m x 36 m x 18 m, with other cameras: not the place that is evaluated here. "
    "The paper does not say whether its figures are means or medians."
)
PAPER_TABLE_1 = (
    Published("PoseNet", "medium", 8.60, 50.83),
    Published("VGG16-Net (modified)", "medium", 4.91, 33.30),
    Published("SqueezePoseNet", "medium", 5.19, 29.28),
    Published("PoseNet", "low", 11.47, 46.40),
    Published("VGG16-Net (modified)", "low", 11.34, 37.33),
    Published("SqueezePoseNet", "low", 15.18, 65.02),
)
