"""A pose regressor with all that its poses need: what it aims at, how sure it is, how its loss weighs."""

from __future__ import annotations

from typing import NamedTuple, Self

import torch
from torch import Tensor, nn

from spn_model.networks.pose_loss import LearnedWeighting
from spn_model.networks.pose_targets import PoseTargets
from spn_model.networks.regressor import Estimate, Regressor

_LOG_STD = 7.0  # bound: from 0.1 % to 1000 times the training poses' spread, and radians


class PoseOutputs(NamedTuple):
    """estimates : the main one first, x (B, 3) from the targets' centre in the world's unit, q (B, 4) not
    normalised; log_std : (B, 6) of the main one, of the axes of the world and of a rotation vector."""

    estimates: tuple[Estimate, ...]
    log_std: Tensor


class PoseNetwork(nn.Module):
    """Images (B, 3, H, W), normalised as ImageNet's -> x (B, 3), q (B, 4), log standard deviations (B, 6).

    x is relative to `targets.center`, in the world's unit; q (w, x, y, z) isn't normalised. The standard
    deviations are read from the descriptor that the heads read, by a layer of their own whose gradient goes
    no further: it changes nothing about the poses. They start at the spread of the training poses and at
    one radian. covariance_scale : (), by which covariances of images that were not trained on are larger, as
    measured on validation images.
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
        self.drops = True
        self.normalizes_by_batch = False

    def outputs(self, features: tuple[Tensor, ...]) -> PoseOutputs:
        """From what the regressor's trunk gives."""
        descriptor = self.regressor.describe(features)
        main = self.regressor.x(descriptor), self.regressor.q(descriptor)
        scale = self.targets.scale.to(descriptor.dtype)
        # Of unit length: descriptors have hundreds of large numbers, by which a step would go astray.
        answer = self.uncertainty(nn.functional.normalize(descriptor.detach(), dim=1))
        log_std = _LOG_STD * (answer / _LOG_STD).tanh()
        larger = 0.5 * self.covariance_scale.log().expand(6)
        spread = torch.cat([scale.log().expand(3), larger.new_zeros(3)])
        estimates = main, *self.regressor.auxiliary(features)
        return PoseOutputs(tuple((x * scale, q) for x, q in estimates), log_std + spread + larger)

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        outputs = self.outputs(self.regressor.trunk(images))
        return *outputs.estimates[0], outputs.log_std

    def train(self, mode: bool = True) -> Self:
        """As in torch, but that dropout may be off, and that stored statistics normalise unless chosen else.

        In small batches of one scene, the batch's own statistics destroy pretrained features.
        """
        super().train(mode)
        for module in self.regressor.modules():
            if isinstance(module, nn.Dropout) and not self.drops:
                module.eval()
            if isinstance(module, nn.BatchNorm2d) and not self.normalizes_by_batch:
                module.eval()
        return self

    @torch.no_grad()
    def start_heads(self, quaternion: Tensor) -> None:
        """Let every estimate begin at the targets' centre and a quaternion (4,), whatever the image.

        Pretrained features are large: heads of small random weights would begin two spreads off.
        """
        for name, layer in self.regressor.named_modules():
            head = name.rpartition(".")[2]
            if isinstance(layer, nn.Linear) and head in ("x", "q"):
                layer.weight.zero_()
                layer.bias.copy_(quaternion if head == "q" else torch.zeros(3))
