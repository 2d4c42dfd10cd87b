"""Batch normalisation put into a pretrained network without changing what the network computes."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, nn


class InsertedBatchNorm(nn.BatchNorm2d):
    """A batch normalisation that the pretrained network did not have."""


def normalized_leaky_relu(channels: int, slope: float) -> nn.Sequential:
    """What stands in the place of a ReLU: a batch normalisation of its convolution, and a Leaky ReLU."""
    return nn.Sequential(InsertedBatchNorm(channels), nn.LeakyReLU(slope, inplace=True))


@torch.no_grad()
def start_as_identity(network: nn.Module, images: Iterable[Tensor]) -> None:
    """Make every inserted batch normalisation of a network the identity, in eval mode, on all inputs.

    images : batches (B, 3, H, W) of training images, on the network's device. The running statistics become
    those of the normalisation's input over all of them (variance over all pixels), the weight
    sqrt(variance + eps) and the bias the mean, so that pretrained features pass as they are, and training
    mode starts beside them too. Networks without an inserted normalisation are left alone.
    Raises ValueError without images, or where activations aren't finite.
    """
    layers = [module for module in network.modules() if isinstance(module, InsertedBatchNorm)]
    if not layers:
        return
    measured = {layer: _Moments() for layer in layers}
    # A hook's value replaces the layer's output: what is measured is the network without the layers.
    hooks = [layer.register_forward_hook(measured[layer]) for layer in layers]
    was_training = network.training
    network.eval()
    try:
        for batch in images:
            network(batch)
    finally:
        for hook in hooks:
            hook.remove()
        network.train(was_training)
    found = {layer: moments.mean_and_variance() for layer, moments in measured.items()}
    for layer, (mean, variance) in found.items():
        layer.running_mean.copy_(mean)  # type: ignore[union-attr]
        layer.running_var.copy_(variance)  # type: ignore[union-attr]
        layer.weight.copy_((variance + layer.eps).sqrt())
        layer.bias.copy_(mean)


class _Moments:
    """Count, mean and squared deviations by channel; batches are joined in float64.

    Chan, Golub, LeVeque 1979, "Updating formulae and a pairwise algorithm", equation 2.1.
    """

    def __init__(self) -> None:
        self.count = 0
        self.mean: Tensor | float = 0.0
        self.deviation: Tensor | float = 0.0

    def __call__(self, layer: nn.Module, given: tuple[Tensor, ...], output: Any) -> Tensor:
        variance, mean = torch.var_mean(given[0], (0, 2, 3), correction=0)  # (C,), (C,)
        count = given[0].numel() // len(mean)
        total = self.count + count
        away = mean.double() - self.mean
        self.deviation = (
            self.deviation + variance.double() * count + away**2 * (self.count * count / total)
        )
        self.mean = self.mean + away * (count / total)
        self.count = total
        return given[0]

    def mean_and_variance(self) -> tuple[Tensor, Tensor]:
        if not isinstance(self.mean, Tensor) or not isinstance(self.deviation, Tensor):
            raise ValueError("no images to measure statistics on")
        variance = self.deviation / self.count
        if not (torch.isfinite(self.mean).all() and torch.isfinite(variance).all()):
            raise ValueError("activations on these images are not finite")
        return self.mean, variance
