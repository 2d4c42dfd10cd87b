"""Pose model of the scene-coordinate network: its training, and PnP from its cells."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from threading import Lock
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from spn_data.errors import GeometryError, InputError
from spn_data.geometry.pose import Poses
from spn_model.examples.held_out_views import HeldOutViews
from spn_model.examples.training_set import TrainingSet
from spn_model.landmarks.aids import KnownVertical
from spn_model.models.pose_model import UNKNOWN_COUNT, Batch, PoseEstimates, PoseModel
from spn_model.models.scene_examples import SceneExamples, SceneStageOptions
from spn_model.networks.imagenet import MEAN, STD
from spn_model.networks.option_parsing import from_mapping
from spn_model.networks.scene_coordinates import SceneCoordinates
from spn_model.networks.scene_loss import mixture_loss
from spn_model.onboard.decoding import DecodingOptions, PoseEstimate, decode
from spn_model.pretrained.tensors import load_pretrained, read_tensors
from spn_model.pretrained.weights import find

_MEASURED = 16  # training images, evenly spaced, on which features are normalised

_UNSURE = 0.25  # in spreads of the scene; cells with a larger scale are too uncertain to use


@dataclass(frozen=True, kw_only=True)
class SceneCoordinatesOptions(DecodingOptions):
    """Options that define the model."""

    shrink: int = 2  # factor by which images are reduced: more context, a quarter of the time

    def __post_init__(self) -> None:
        if not 1 <= self.shrink <= 8:
            raise InputError(f"shrink is {self.shrink}, needs to be from 1 to 8")


class SceneCoordinatesModel(PoseModel):
    """Pose model that learns the map point shown by each cell of an image; PnP computes the pose.

    The options of `make` are `shrink` and those of `DecodingOptions`. The options of a stage are those of
    `SceneStageOptions`.
    """

    kind: ClassVar[str] = "scene-coordinates"
    any_camera: ClassVar[bool] = True
    has_parts: ClassVar[bool] = True
    network: SceneCoordinates

    def __init__(self, network: SceneCoordinates, decoding: DecodingOptions):
        self.network = network
        self.decoding = decoding
        self._stage, self._images = SceneStageOptions(), UNKNOWN_COUNT
        self._examples: tuple[TrainingSet, SceneExamples] | None = None
        self._making_examples = Lock()

    @classmethod
    def make(cls, options: Mapping[str, Any], seed: int = 0) -> SceneCoordinatesModel:
        """Build the model with random weights. Raises InputError for an unknown option."""
        chosen = from_mapping(SceneCoordinatesOptions, options, f"network {cls.kind}")
        decoding = DecodingOptions(
            **{f.name: getattr(chosen, f.name) for f in fields(DecodingOptions)}
        )
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            network = SceneCoordinates(chosen.shrink)
        return cls(network.eval(), decoding)

    @property
    def options(self) -> dict[str, Any]:
        """Options of network and decoding by name."""
        return {"shrink": self.network.shrink, **asdict(self.decoding)}

    @property
    def weights_name(self) -> str:
        """Name of the published weights of the features."""
        return SceneCoordinates.weights_name

    def load_pretrained(self, weights: str) -> None:
        """Load published weights of the features, by name or file."""
        path = find(weights)
        load_pretrained(self.network, read_tensors(path), path)

    def fit(self, data: TrainingSet) -> None:
        """Measure the scene's centre and spread and the scale of published features.

        Raises InputError if the training images see too few points.
        """
        xyz = np.concatenate([data.points(k).xyz for k in range(len(data))])
        if len(xyz) < 100:
            raise InputError(
                f"the training images see {len(xyz)} map points, too few for a scene-coordinate network; "
                "train another network, or make the data set from a model with points"
            )
        self._check_size(*data.size)
        self.network.set_scene(torch.from_numpy(xyz.astype(np.float32)))
        chosen = np.unique(np.linspace(0, len(data) - 1, _MEASURED).astype(int))
        images = np.stack([data.image(k) for k in chosen])
        self.network.measure_features(_normalised(torch.from_numpy(images)))

    def begin_stage(
        self, stage: Mapping[str, Any], data: TrainingSet, images: int = UNKNOWN_COUNT
    ) -> None:
        """Set the stage's options and freeze layers; see `PoseModel.begin_stage`."""
        self._stage = from_mapping(SceneStageOptions, stage, f"stage of {self.kind}")
        self._images = images
        self.network.freeze_features(self._stage.freeze_layers)
        self._examples = None

    def parameter_groups(self) -> list[dict[str, Any]]:
        """Return the trainable parameters as "added" and "pretrained", with their learning rate factors."""
        rates = {"added": 1.0, "pretrained": self._stage.features_rate}
        groups = [
            {"name": name, "params": [p for p in of if p.requires_grad], "rate": rates[name]}
            for name, of in self.network.parameter_groups().items()
        ]
        return [group for group in groups if group["params"]]

    def batch(
        self, data: TrainingSet, rows: np.ndarray, generator: np.random.Generator, progress: float
    ) -> Batch:
        """Make a batch: images (N, h, w, 3) uint8, targets (N, 3, r, c) and known (N, r, c).

        See `SceneExamples.batch`: all images have the same zoom, and a batch of smaller images has more of
        them than rows.
        """
        images, targets, known = self._examples_of(data).batch(rows, generator, progress)
        return {
            "images": torch.from_numpy(images),
            "targets": torch.from_numpy(targets),
            "known": torch.from_numpy(known),
        }

    def held_out_views(self, data: TrainingSet, count: int) -> HeldOutViews | None:
        """Render up to `count` novel views that the stage never draws; None if it renders none."""
        return self._examples_of(data).held_out_views(count)

    def _examples_of(self, data: TrainingSet) -> SceneExamples:
        with self._making_examples:  # once, by whichever thread is first: it can take seconds
            if self._examples is None or self._examples[0] is not data:
                center, spread = self.network.center.cpu().numpy(), float(self.network.spread)
                made = SceneExamples(
                    data, self._stage, center, spread, self.network.shrink, self._images
                )
                self._examples = (data, made)
            return self._examples[1]

    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the negative log-likelihood of the mixtures plus the cross-entropy of the scene's parts.

        The metrics are the median distance of cells and the median scale, both in the scene's unit, and the
        cross-entropy. The loss is 0 if no cell of the batch has a target.
        """
        images, known = batch["images"], batch["known"]
        # Each weight is used once, so a cast cache is useless, and other threads would share it.
        with torch.autocast(
            images.device.type, torch.bfloat16, enabled=self.bfloat16, cache_enabled=False
        ):
            candidates, log_scale, logits = self.network.cells(_normalised(images))
        if not known.any():
            return (candidates.sum() + log_scale.sum() + logits.sum()) * 0, {}
        candidates = candidates.permute(0, 3, 4, 1, 2)[known]
        logits = logits.permute(0, 2, 3, 1)[known]
        log_scale, targets = log_scale[:, 0][known], batch["targets"].permute(0, 2, 3, 1)[known]
        loss = mixture_loss(candidates, log_scale, logits, targets)
        choice = functional.cross_entropy(logits, self.network.part_of(targets))
        with torch.no_grad():
            chosen = candidates[torch.arange(len(logits)), logits.argmax(1)]
            distance = (chosen - targets).norm(dim=1).median()
            scale = log_scale.median().exp()
        figures = {"distance": distance, "scale": scale, "choice": choice.detach()}
        return loss + self._stage.choice_weight * choice, figures

    @property
    def covariance_scale(self) -> float:
        """Factor of all covariances; see `spn_model.training.covariance_scale`."""
        return float(self.network.covariance_scale)

    def set_covariance_scale(self, factor: float) -> None:
        """Multiply all covariances by a factor, which is kept in the network's state."""
        self.network.covariance_scale.mul_(factor)

    @property
    def decoding_options(self) -> DecodingOptions:
        """Options of `spn_model.onboard.decoding.decode`, including the measured covariance scale."""
        return replace(
            self.decoding,
            cells_per_observation=self.decoding.cells_per_observation * self.covariance_scale,
            largest_scale=self.decoding.largest_scale or _UNSURE * float(self.network.spread),
        )

    def decode(
        self,
        coordinates: np.ndarray,
        log_scale: np.ndarray,
        matrix: np.ndarray,
        vertical: KnownVertical | None = None,
    ) -> PoseEstimate:
        """Estimate a pose from the network's outputs (3, h, w) and (h, w) for one image with K (3, 3)."""
        return decode(
            coordinates,
            log_scale,
            matrix,
            first_px=self.network.first_cell_px,
            stride_px=self.network.stride_px,
            options=self.decoding_options,
            vertical=vertical,
        )

    def _check_size(self, width: int, height: int) -> None:
        shrink, smallest = self.network.shrink, SceneCoordinates.min_side_px
        if min(width, height) // shrink < smallest:
            raise InputError(
                f"images of {width} x {height}, reduced by {shrink}, are smaller than the {smallest} px "
                "a side that the network needs; use larger images or shrink = 1"
            )

    @torch.inference_mode()
    def estimate(
        self,
        images: np.ndarray,
        intrinsics: np.ndarray,
        verticals: Sequence[KnownVertical | None] | None = None,
    ) -> PoseEstimates:
        """Estimate poses as `PoseModel.estimate` does, in float32 like the exported network."""
        self._check_size(images.shape[2], images.shape[1])
        device = self.network.center.device
        poses = Poses.unknown(len(images))
        covariance = np.full((len(images), 6, 6), np.nan)
        reasons = np.full(len(images), "", dtype=object)
        for k, (image, matrix) in enumerate(zip(images, intrinsics, strict=True)):
            if not np.isfinite(matrix).all():
                reasons[k] = "its camera is not known"
                continue
            # One image at a time: just as fast on a CPU, and results do not depend on other images.
            x = torch.from_numpy(np.ascontiguousarray(image[None])).to(device)
            coordinates, log_scale = (t[0].cpu().numpy() for t in self.network(_normalised(x)))
            try:
                vertical = None if verticals is None else verticals[k]
                estimate = self.decode(coordinates, log_scale[0], matrix, vertical)
            except GeometryError as error:
                reasons[k] = str(error)
                continue
            poses.centers[k] = estimate.poses.centers[0]
            poses.quats_wxyz[k] = estimate.poses.quats_wxyz[0]
            covariance[k] = estimate.covariance
        return PoseEstimates(poses, covariance, reasons.astype(str))


def _normalised(images: Tensor) -> Tensor:
    """Return images (N, H, W, 3) uint8 RGB as network input (N, 3, H, W), channels last in memory."""
    mean = torch.tensor([v * 255 for v in MEAN], device=images.device)
    std = torch.tensor([v * 255 for v in STD], device=images.device)
    return ((images - mean) / std).permute(0, 3, 1, 2)
