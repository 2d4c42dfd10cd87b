"""What training, evaluation and export know of a kind of network, and nothing more."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from torch import Tensor, nn

from spn_data.geometry.pose import Poses
from spn_model.examples.held_out_views import HeldOutViews
from spn_model.examples.training_set import TrainingSet

Batch = dict[str, Tensor]
UNKNOWN_COUNT = 10**12  # of images, where it is not known how many are drawn


@dataclass(frozen=True, eq=False)
class PoseEstimates:
    """Of N images: poses, NaN where none was found; covariance (N, 6, 6) over the centre in the world's unit
    and a rotation vector v in the camera frame, R_true = exp(v) R, NaN where unknown; reasons : (N,) str,
    empty where there is a pose."""

    poses: Poses
    covariance: np.ndarray
    reasons: np.ndarray

    @classmethod
    def concatenate(cls, parts: Sequence[PoseEstimates]) -> PoseEstimates:
        """One after the other; one part at least."""
        return cls(
            Poses.concatenate(part.poses for part in parts),
            np.concatenate([part.covariance for part in parts]),
            np.concatenate([part.reasons.astype(np.str_) for part in parts]),
        )


class PoseModel(ABC):
    """A network with all that makes a pose of its output: targets, loss, augmentation, decoding.

    kind : as recipes and checkpoints have it. network : everything learnt or measured on training images is
    in its parameters and buffers, so that its state is the whole member. options : JSON-able, what `make`
    needs to build the member anew. any_camera : poses are right for images of any K; else only for those of
    the camera that it was trained on. has_parts : a batch may be computed in parts, in several threads; not
    where layers draw at random, or keep statistics of a whole batch. bfloat16 : `loss` runs the network in
    it; set by who trains.
    """

    kind: ClassVar[str]
    any_camera: ClassVar[bool] = False
    has_parts: ClassVar[bool] = False
    network: nn.Module
    bfloat16: bool = False

    @property
    @abstractmethod
    def options(self) -> dict[str, Any]:
        """Options of the network and of the member, by name; plain values."""

    @property
    @abstractmethod
    def weights_name(self) -> str:
        """Name, in `spn_model.pretrained.weights`, of the published weights that training starts from."""

    @abstractmethod
    def load_pretrained(self, weights: str) -> None:
        """Start from published weights: a name of `spn_model.pretrained.weights` or a file."""

    @abstractmethod
    def fit(self, data: TrainingSet) -> None:
        """Before the first step: what is measured on training images, as the centre of targets.

        Once more before a stage that has another data set; what was learnt on the first is kept.
        """

    @abstractmethod
    def begin_stage(
        self, stage: Mapping[str, Any], data: TrainingSet, images: int = UNKNOWN_COUNT
    ) -> None:
        """Freeze and thaw, choose loss and augmentation, as the options of a recipe's stage say.

        images : that the stage will draw, about; a short one makes less in advance.
        Raises InputError for an option or a value that this kind does not know.
        """

    @abstractmethod
    def parameter_groups(self) -> list[dict[str, Any]]:
        """Of what the stage trains: "name", "params" (list), "rate" (factor of the stage's)."""

    @abstractmethod
    def batch(
        self, data: TrainingSet, rows: np.ndarray, generator: np.random.Generator, progress: float
    ) -> Batch:
        """CPU tensors of one step, from rows (B,) of the training images, augmented.

        A pure function of its arguments and of the stage: it may run ahead, in another thread. progress :
        share of the stage that is done, 0 to 1. The number of images may differ from B where their size does.
        """

    @abstractmethod
    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss to descend, and detached figures for the log; the network is in training mode."""

    @abstractmethod
    def estimate(self, images: np.ndarray, intrinsics: np.ndarray) -> PoseEstimates:
        """Poses of images (B, H, W, 3) uint8 RGB without distortion, K (B, 3, 3). In eval mode."""

    def held_out_views(self, data: TrainingSet, count: int) -> HeldOutViews | None:
        """Up to `count` images like those that the stage renders of its data, none of which it ever draws.

        None where the stage renders none.
        """
        return None

    @abstractmethod
    def set_covariance_scale(self, factor: float) -> None:
        """Multiply the covariances of all later estimates by a factor; kept in the network's state."""
