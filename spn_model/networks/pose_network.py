"""Pose regressor together with its targets, uncertainty head and learned loss weights."""

from __future__ import annotations

from typing import NamedTuple, Self

import torch
from torch import Tensor, nn

from spn_model.networks.pose_loss import LearnedWeighting
from spn_model.networks.pose_targets import PoseTargets
from spn_model.networks.regressor import Estimate, Regressor

_LOG_STD = 7.0  # bound: 0.1 % to 1000 times the spread of the training poses, or one radian


class PoseOutputs(NamedTuple):
    """Output of a `PoseNetwork`.

    Attributes
    ----------
    estimates : tuple of (Tensor, Tensor)
        The main estimate first: x (B, 3) relative to the targets' centre, in the world's unit, and q (B,
        4), not normalised.
    log_std : Tensor, shape (B, 6)
        Log standard deviations of the main estimate: along the world's axes, then of a rotation vector.
    """

    estimates: tuple[Estimate, ...]
    log_std: Tensor


class PoseNetwork(nn.Module):
    """Network from images to x (B, 3), q (B, 4) and log standard deviations (B, 6).

    Images are (B, 3, H, W), normalised with ImageNet's mean and standard deviation. x is relative to
    `targets.center`, in the world's unit; q (w, x, y, z) is not normalised.

    The standard deviations are computed by a separate layer from the descriptor that the pose heads use.
    Its gradient stops there, so that it does not affect the poses. They start at the spread of the training
    poses and at one radian.

    Attributes
    ----------
    covariance_scale : Tensor, shape ()
        Factor by which covariances on images not used for training are larger, measured on validation
        images.
    is_started : Tensor of bool, shape ()
        Whether the heads and normalisations were initialised from training images.
    dropout_active : bool
        Whether dropout layers drop in training mode.
    batch_statistics_active : bool
        Whether training mode normalises with batch statistics instead of the stored ones.
    """

    covariance_scale: Tensor
    is_started: Tensor

    def __init__(self, regressor: Regressor) -> None:
        super().__init__()
        self.regressor = regressor
        self.targets = PoseTargets()
        self.weighting = LearnedWeighting()
        self.uncertainty = nn.Linear(regressor.x.in_features, 6)
        nn.init.zeros_(self.uncertainty.weight)
        nn.init.zeros_(self.uncertainty.bias)
        self.register_buffer("covariance_scale", torch.ones(()))
        self.register_buffer("is_started", torch.tensor(False))
        self.dropout_active = True
        self.batch_statistics_active = False

    def outputs(self, features: tuple[Tensor, ...]) -> PoseOutputs:
        """Compute the outputs from the features of the regressor's trunk."""
        descriptor = self.regressor.describe(features)
        main = self.regressor.x(descriptor), self.regressor.q(descriptor)
        scale = self.targets.scale.to(descriptor.dtype)
        # Normalise the descriptor: hundreds of large values make optimiser steps unstable.
        raw = self.uncertainty(nn.functional.normalize(descriptor.detach(), dim=1))
        log_std = _LOG_STD * (raw / _LOG_STD).tanh()
        log_scale = 0.5 * self.covariance_scale.log().expand(6)
        spread = torch.cat([scale.log().expand(3), log_scale.new_zeros(3)])
        estimates = main, *self.regressor.auxiliary(features)
        return PoseOutputs(
            tuple((x * scale, q) for x, q in estimates), log_std + spread + log_scale
        )

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return x (B, 3), q (B, 4) and log standard deviations (B, 6) of images (B, 3, H, W)."""
        outputs = self.outputs(self.regressor.trunk(images))
        return *outputs.estimates[0], outputs.log_std

    def train(self, mode: bool = True) -> Self:
        """Set the training mode; dropout and batch statistics are used only where they are active.

        Batch statistics are off by default: in small batches of a single scene they destroy pretrained
        features.
        """
        super().train(mode)
        for module in self.regressor.modules():
            if isinstance(module, nn.Dropout) and not self.dropout_active:
                module.eval()
            if isinstance(module, nn.BatchNorm2d) and not self.batch_statistics_active:
                module.eval()
        return self

    @torch.no_grad()
    def initialize_heads(self, quaternion: Tensor) -> None:
        """Initialise every estimate to the targets' centre and a quaternion (4,), for all images.

        Pretrained features are large: heads with small random weights would start two spreads away.
        """
        for name, layer in self.regressor.named_modules():
            head = name.rpartition(".")[2]
            if isinstance(layer, nn.Linear) and head in ("x", "q"):
                layer.weight.zero_()
                layer.bias.copy_(quaternion if head == "q" else torch.zeros(3))
