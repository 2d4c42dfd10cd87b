"""Interface of pose models, all that training, evaluation and export know about a kind of network."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from torch import Tensor, nn

from spn_data.geometry.pose import Poses
from spn_model.examples.held_out_views import HeldOutViews
from spn_model.examples.training_set import TrainingSet
from spn_model.landmarks.aids import KnownVertical

Batch = dict[str, Tensor]
UNKNOWN_COUNT = 10**12  # number of images of a stage, if not known in advance


@dataclass(frozen=True, eq=False)
class PoseEstimates:
    """Estimated poses of N images.

    Attributes
    ----------
    poses : Poses
        N poses, NaN if none was found.
    covariance : ndarray, shape (N, 6, 6)
        Covariance of the centre in the world's unit and of a rotation vector v in the camera frame,
        R_true = exp(v) R; NaN if unknown.
    reasons : ndarray of str, shape (N,)
        Why there is no pose; empty if there is one.
    """

    poses: Poses
    covariance: np.ndarray
    reasons: np.ndarray

    def moved_by(self, offset: Sequence[float]) -> PoseEstimates:
        """Return the estimates with an offset (3,) added to all centres."""
        return replace(self, poses=self.poses.moved_by(offset))

    @classmethod
    def concatenate(cls, parts: Sequence[PoseEstimates]) -> PoseEstimates:
        """Concatenate at least one set of estimates."""
        return cls(
            Poses.concatenate(part.poses for part in parts),
            np.concatenate([part.covariance for part in parts]),
            np.concatenate([part.reasons.astype(np.str_) for part in parts]),
        )


class PoseModel(ABC):
    """Network plus what turns its output into a pose: targets, loss, data augmentation and decoding.

    Attributes
    ----------
    kind : str
        Name used in recipes and checkpoints.
    any_camera : bool
        Whether poses are valid for images of any K; otherwise only for the camera of the training images.
    has_parts : bool
        Whether a batch may be split into parts computed in several threads. Not the case if layers draw
        random numbers or keep statistics of a whole batch.
    network : nn.Module
        Its parameters and buffers hold everything learnt or measured on training images, so that its state
        is the complete state of the model.
    bfloat16 : bool
        Whether `loss` runs the network in bfloat16; set by the training loop.
    """

    kind: ClassVar[str]
    any_camera: ClassVar[bool] = False
    has_parts: ClassVar[bool] = False
    network: nn.Module
    bfloat16: bool = False

    @property
    @abstractmethod
    def options(self) -> dict[str, Any]:
        """Options of network and model by name, as plain values from which `make` builds the same model."""

    @property
    @abstractmethod
    def weights_name(self) -> str:
        """Name, in `spn_model.pretrained.weights`, of the published weights that training starts from."""

    @abstractmethod
    def load_pretrained(self, weights: str) -> None:
        """Load published weights, given by a name of `spn_model.pretrained.weights` or a file."""

    @abstractmethod
    def fit(self, data: TrainingSet) -> None:
        """Measure on the training images what is needed before the first step, such as the centre of targets.

        Called again before a stage that uses another data set; what was learnt on the first one is kept.
        """

    @abstractmethod
    def begin_stage(
        self, stage: Mapping[str, Any], data: TrainingSet, images: int = UNKNOWN_COUNT
    ) -> None:
        """Freeze layers and select loss and augmentation by the options of a recipe's stage.

        Parameters
        ----------
        stage : mapping
            Options of the stage.
        data : TrainingSet
            Images that it trains on.
        images : int
            Approximate number of images that the stage will draw; a short stage prepares less in advance.

        Raises
        ------
        InputError
            If an option or value is not known.
        """

    @abstractmethod
    def parameter_groups(self) -> list[dict[str, Any]]:
        """Return what the stage trains, as groups with "name", "params" (list) and "rate".

        "rate" is the factor of the stage's learning rate.
        """

    @abstractmethod
    def batch(
        self, data: TrainingSet, rows: np.ndarray, generator: np.random.Generator, progress: float
    ) -> Batch:
        """Make the CPU tensors of one step from training images, with augmentation.

        A pure function of its arguments and the stage, so that batches can be prefetched in other threads.

        Parameters
        ----------
        data : TrainingSet
            Training images.
        rows : ndarray of int, shape (B,)
            Images to use. The batch can have a different number of images if their size varies.
        generator : np.random.Generator
            Source of randomness.
        progress : float
            Fraction of the stage that is done, 0 to 1.
        """

    @abstractmethod
    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss to minimise and detached metrics for the log; the network is in training mode."""

    @abstractmethod
    def estimate(
        self,
        images: np.ndarray,
        intrinsics: np.ndarray,
        verticals: Sequence[KnownVertical | None] | None = None,
    ) -> PoseEstimates:
        """Estimate the poses of images, in eval mode.

        Parameters
        ----------
        images : ndarray, uint8, shape (B, H, W, 3)
            Undistorted RGB images.
        intrinsics : ndarray, shape (B, 3, 3)
            Intrinsic matrices K.
        verticals : sequence of (KnownVertical or None), optional
            Up in the camera of each image, one more observation where it is known.
        """

    def held_out_views(self, data: TrainingSet, count: int) -> HeldOutViews | None:
        """Render up to `count` novel views like those of the stage that the stage never draws.

        Returns None if the stage renders no views.
        """
        return None

    @abstractmethod
    def set_covariance_scale(self, factor: float) -> None:
        """Multiply the covariances of all later estimates by a factor, kept in the network's state."""
