"""Pose model of the pose regressors: the paper's SqueezePoseNet, VGG16 and PoseNet."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from spn_data.errors import GeometryError, InputError
from spn_data.geometry.pose import Poses
from spn_model.examples.training_set import TrainingSet
from spn_model.landmarks.aids import KnownVertical
from spn_model.models.pose_model import UNKNOWN_COUNT, Batch, PoseEstimates, PoseModel
from spn_model.models.regression_examples import (
    FeatureCache,
    augmented_example,
    input_size,
    resized,
    visible_points,
)
from spn_model.models.regression_options import RegressionOptions, RegressionStageOptions
from spn_model.networks.imagenet import MEAN, STD
from spn_model.networks.normalization import initialize_as_identity
from spn_model.networks.option_parsing import from_mapping
from spn_model.networks.pose_loss import (
    beta_weighted_loss,
    laplace_nll,
    pose_residuals,
    reprojection_loss,
)
from spn_model.networks.pose_network import PoseNetwork
from spn_model.networks.registry import build, options_of
from spn_model.onboard.decoding import with_aids
from spn_model.pretrained import weights
from spn_model.pretrained.tensors import load_pretrained, read_tensors

_MEASURED = (
    64  # training images, spread evenly, on which batch normalisation starts as the identity
)
_AT_ONCE = 8  # batch size of inference
_CACHE_BYTES = 4_000_000_000


class RegressionModel(PoseModel):
    """Pose model that regresses the pose directly, trained on images of rotated cameras.

    The options of `make` are those of `RegressionOptions` plus `network_options`, the options of the
    architecture in `networks.registry`. The options of a stage are those of `RegressionStageOptions`.
    """

    kind: ClassVar[str] = "regression"
    network: PoseNetwork

    def __init__(self, network: PoseNetwork, options: RegressionOptions):
        self.network = network
        self._options = options
        self._stage = RegressionStageOptions()
        self._cache: FeatureCache | None = None

    @classmethod
    def make(cls, options: Mapping[str, Any], seed: int = 0) -> RegressionModel:
        """Build the model with random weights. Raises InputError for an unknown option or a wrong value."""
        own = dict(options)
        of_network = own.pop("network_options", {})
        if not isinstance(of_network, Mapping):
            raise InputError(
                f"network {cls.kind}: network_options is {of_network!r}, needs a table"
            )
        chosen = from_mapping(RegressionOptions, own, f"network {cls.kind}")
        regressor = build(chosen.network, of_network, seed=seed)
        with torch.random.fork_rng(devices=[]):
            return cls(PoseNetwork(regressor).eval(), chosen)

    @property
    def options(self) -> dict[str, Any]:
        """Options of network and model by name."""
        return {
            "network": self._options.network,
            "network_options": options_of(self.network.regressor),
            "width": self._options.width,
        }

    @property
    def weights_name(self) -> str:
        """Name of the published weights that the trunk starts from."""
        return self.network.regressor.weights_name

    def load_pretrained(self, weights_name: str) -> None:
        """Load published weights into the trunk, by name or file."""
        path = Path(weights.find(weights_name))
        load_pretrained(self.network.regressor, read_tensors(path), path)

    def fit(self, data: TrainingSet) -> None:
        """Measure the targets on the poses; for a new network also initialise normalisations and heads.

        Inserted batch normalisations become the identity, and the heads `q` start at the mean orientation.
        A network that was trained before keeps its weights and gets the targets of this data set.
        """
        self._check_size(*input_size(*data.size, self._options.width))
        network = self.network
        network.targets.fit(data.poses)
        if network.is_started:
            return
        _, quats = network.targets.encode(data.poses)
        network.initialize_heads(torch.from_numpy(quats.mean(axis=0)))
        initialize_as_identity(network.regressor, self._measured(data))
        network.is_started.fill_(True)

    def begin_stage(
        self, stage: Mapping[str, Any], data: TrainingSet, images: int = UNKNOWN_COUNT
    ) -> None:
        """Freeze layers, set the loss and fill the feature cache; see `PoseModel.begin_stage`."""
        chosen = from_mapping(RegressionStageOptions, stage, f"stage of {self.kind}")
        if chosen.loss == "reprojection" and not data.has_points:
            raise InputError(
                "the loss reprojection needs map points, and the data set has none for training; "
                "choose the loss beta or learned"
            )
        if chosen.warp is not None and not np.isfinite(data.intrinsics).all():
            raise InputError(
                "the camera of some training images is unknown, so they cannot be rotated; "
                "set tilt_deg and roll_deg to 0"
            )
        self._stage, self._cache = chosen, None
        network = self.network
        network.regressor.freeze_trunk(chosen.freeze_trunk)
        network.weighting.requires_grad_(chosen.loss == "learned")
        network.dropout_active, network.batch_statistics_active = (
            chosen.dropout,
            chosen.batch_statistics,
        )
        network.train(network.training)
        if chosen.cached_features:
            self._cache = self._cached(data, chosen.cached_features)

    def parameter_groups(self) -> list[dict[str, Any]]:
        """Return the groups to train.

        Loss weights have no weight decay, which would pull them to weights of one.
        """
        of = self.network.regressor.parameter_groups()
        groups: list[dict[str, Any]] = [
            {"name": "added", "params": of["added"], "rate": 1.0},
            {"name": "pretrained", "params": of["pretrained"], "rate": self._stage.pretrained_rate},
            {
                "name": "uncertainty",
                "params": [*self.network.uncertainty.parameters()],
                "rate": 1.0,
            },
            {
                "name": "weighting",
                "params": [*self.network.weighting.parameters()],
                "rate": 1.0,
                "weight_decay": 0.0,
            },
        ]
        return [group for group in groups if all(p.requires_grad for p in group["params"])]

    def batch(
        self, data: TrainingSet, rows: np.ndarray, generator: np.random.Generator, progress: float
    ) -> Batch:
        """Make a batch of images (B, h, w, 3) uint8 with x (B, 3) and q (B, 4).

        Cached features0, features1, ... (B, ...) replace the images if there are any. For the reprojection
        error there are also points (B, P, 3) relative to the targets' centre, seen (B, P) and matrices (B,
        3, 3), the K of the data set's images.
        """
        batch: Batch = {}
        if self._cache is not None:
            features, poses = self._cache.draw(rows, generator)
            batch |= {f"features{k}": torch.from_numpy(f) for k, f in enumerate(features)}
        else:
            images, poses = self._examples(data, [(row, generator) for row in rows])
            batch["images"] = torch.from_numpy(images)
        x, q = self.network.targets.encode(poses)
        batch["x"], batch["q"] = torch.from_numpy(x), torch.from_numpy(q)
        if self._stage.loss == "reprojection":
            points, seen = visible_points(data, rows, poses, self._stage.points, generator)
            centered = points - self.network.targets.center.cpu().numpy()
            batch["points"] = torch.from_numpy(centered.astype(np.float32))
            batch["seen"] = torch.from_numpy(seen)
            batch["matrices"] = torch.from_numpy(data.intrinsics[rows].astype(np.float32))
        return batch

    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the pose loss plus the negative log-likelihood, whose gradient stays within `uncertainty`.

        The metrics are the median distance in the world's unit, the median angle in degrees and the
        negative log-likelihood ("likelihood").
        """
        outputs = self.network.outputs(self._features(batch))
        weights_ = self.network.regressor.estimate_weights
        pose_loss = torch.stack(
            [
                weight * self._pose_loss(x, q, batch).mean()
                for weight, (x, q) in zip(weights_, outputs.estimates, strict=False)
            ]
        ).sum()
        x, q = outputs.estimates[0]
        errors = pose_residuals(x.detach(), q.detach(), batch["x"], batch["q"])
        likelihood = laplace_nll(errors, outputs.log_std).mean()
        figures = {
            "distance": errors[:, :3].norm(dim=1).median(),
            "angle_deg": torch.rad2deg(errors[:, 3:].norm(dim=1).median()),
            "likelihood": likelihood.detach(),
        }
        return pose_loss + likelihood, figures

    @torch.inference_mode()
    def estimate(
        self,
        images: np.ndarray,
        intrinsics: np.ndarray,
        verticals: Sequence[KnownVertical | None] | None = None,
    ) -> PoseEstimates:
        """Estimate poses as `PoseModel.estimate` does.

        K is not used: images must come from the camera of the training images.
        """
        found = self.read_out(*self._answers(images))
        return found if verticals is None else _levelled(found, verticals)

    def read_out(self, x: np.ndarray, q: np.ndarray, log_std: np.ndarray) -> PoseEstimates:
        """Convert network outputs of N images, x (N, 3), q (N, 4) and log_std (N, 6), to poses."""
        poses = self.network.targets.decode(x, q)
        covariance = np.full((len(x), 6, 6), np.nan)
        valid = np.isfinite(poses.centers[:, 0])
        variance = np.exp(2 * log_std[valid].astype(np.float64))
        covariance[valid] = variance[:, :, None] * np.eye(6)
        reasons = np.where(valid, "", "the network's answer is no pose")
        return PoseEstimates(poses, covariance, reasons)

    @property
    def covariance_scale(self) -> float:
        """Factor of all covariances; see `spn_model.training.covariance_scale`."""
        return float(self.network.covariance_scale)

    def set_covariance_scale(self, factor: float) -> None:
        """Multiply the covariances of later estimates by a factor."""
        self.network.covariance_scale.mul_(factor)

    def normalised(self, images: Tensor) -> Tensor:
        """Return images (B, h, w, 3) uint8 as (B, 3, h, w), normalised with ImageNet's mean and deviation."""
        rgb = images.permute(0, 3, 1, 2).float() / 255
        mean, std = (torch.tensor(v, device=rgb.device)[:, None, None] for v in (MEAN, STD))
        return (rgb - mean) / std

    def _pose_loss(self, x: Tensor, q: Tensor, batch: Batch) -> Tensor:
        stage, true = self._stage, (batch["x"], batch["q"])
        if stage.loss == "beta":
            return beta_weighted_loss(x, q, *true, stage.beta)
        if stage.loss == "learned":
            weighted: Tensor = self.network.weighting(x, q, *true)
            return weighted
        return reprojection_loss(x, q, *true, batch["points"], batch["seen"], batch["matrices"])

    def _features(self, batch: Batch) -> tuple[Tensor, ...]:
        if "images" in batch:
            return self._trunk(batch["images"])
        return tuple(batch[name] for name in batch if name.startswith("features"))

    def _trunk(self, images: Tensor) -> tuple[Tensor, ...]:
        """Compute float32 features of images (B, h, w, 3) uint8 in the precision of training."""
        kind = images.device.type
        with torch.autocast(kind, torch.bfloat16, enabled=self.bfloat16):
            features = self.network.regressor.trunk(self.normalised(images))
        return tuple(part.float() for part in features)

    def _answers(self, images: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Run the network in eval mode and float32; return x (N, 3), q (N, 4) and log_std (N, 6)."""
        network = self.network
        parts = [np.zeros((0, 13), np.float32)]
        for start in range(0, len(images), _AT_ONCE):
            sized = [
                resized(image, self._options.width) for image in images[start : start + _AT_ONCE]
            ]
            self._check_size(sized[0].shape[1], sized[0].shape[0])
            answer = network(self.normalised(torch.from_numpy(np.stack(sized)).to(self._device)))
            parts.append(torch.cat(answer, 1).cpu().numpy())
        x, q, log_std = np.split(np.concatenate(parts), [3, 7], axis=1)
        return x, q, log_std

    def _examples(
        self, data: TrainingSet, wanted: Iterable[tuple[int, np.random.Generator]]
    ) -> tuple[np.ndarray, Poses]:
        """Return augmented images (B, h, w, 3) uint8 and poses of training rows."""
        made = [
            augmented_example(data, int(row), self._options.width, self._stage, generator)
            for row, generator in wanted
        ]
        return np.stack([image for image, _ in made]), Poses.concatenate(pose for _, pose in made)

    @torch.no_grad()
    def _cached(self, data: TrainingSet, variants: int) -> FeatureCache:
        """Compute features of augmented variants of every image; they depend on row and variant only."""
        network, was_training = self.network, self.network.training
        network.train()  # auxiliary features exist in training mode only; the trunk is frozen
        computed: list[list[np.ndarray]] = []
        poses = []
        wanted = [(row, variant) for row in range(len(data)) for variant in range(variants)]
        for start in range(0, len(wanted), _AT_ONCE):
            seeded = [
                (key[0], np.random.default_rng(key)) for key in wanted[start : start + _AT_ONCE]
            ]
            images, some = self._examples(data, seeded)
            features = self._trunk(torch.from_numpy(images).to(self._device))
            size = sum(part[0].nbytes for part in features) * len(wanted)
            if size > _CACHE_BYTES:
                raise InputError(
                    f"cached_features is {variants}: this takes {size / 1e9:.1f} GB of memory, at most "
                    f"{_CACHE_BYTES / 1e9:.0f} GB are allowed"
                )
            computed.append([part.cpu().numpy() for part in features])
            poses.append(some)
        network.train(was_training)
        joined = (np.concatenate(parts) for parts in zip(*computed, strict=True))
        by_row = tuple(part.reshape(len(data), variants, *part.shape[1:]) for part in joined)
        return FeatureCache(by_row, Poses.concatenate(poses))

    def _measured(self, data: TrainingSet) -> Iterator[Tensor]:
        chosen = np.unique(np.linspace(0, len(data) - 1, _MEASURED).astype(int))
        for start in range(0, len(chosen), _AT_ONCE):
            rows = chosen[start : start + _AT_ONCE]
            images = np.stack([resized(data.image(row), self._options.width) for row in rows])
            yield self.normalised(torch.from_numpy(images).to(self._device))

    @property
    def _device(self) -> torch.device:
        return self.network.targets.center.device

    def _check_size(self, width: int, height: int) -> None:
        smallest = self.network.regressor.min_side_px
        if min(width, height) < smallest:
            raise InputError(
                f"images of {width} x {height} are too small: {self._options.network} needs at least "
                f"{smallest} px a side"
            )


def _levelled(found: PoseEstimates, verticals: Sequence[KnownVertical | None]) -> PoseEstimates:
    """Add the known vertical of each image to its pose; one that contradicts it is none."""
    centers, quats = found.poses.centers.copy(), found.poses.quats_wxyz.copy()
    covariance, reasons = found.covariance.copy(), found.reasons.astype(object)
    for k, vertical in enumerate(verticals):
        if vertical is None or not np.isfinite(covariance[k]).all():
            continue
        try:
            pose, covariance[k] = with_aids(found.poses[k : k + 1], covariance[k], vertical)
            centers[k], quats[k] = pose.centers[0], pose.quats_wxyz[0]
        except GeometryError as error:
            centers[k], quats[k], covariance[k] = np.nan, np.nan, np.nan
            reasons[k] = str(error)
    return PoseEstimates(Poses(centers, quats), covariance, reasons.astype(np.str_))
