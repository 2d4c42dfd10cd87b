"""Batch normalisation inserted into a pretrained network without changing what the network computes."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, nn


class InsertedBatchNorm(nn.BatchNorm2d):
    """Batch normalisation layer that the pretrained network does not have."""


def normalized_leaky_relu(channels: int, slope: float) -> nn.Sequential:
    """Return the replacement of a ReLU: batch normalisation of the convolution's output, and a Leaky ReLU."""
    return nn.Sequential(InsertedBatchNorm(channels), nn.LeakyReLU(slope, inplace=True))


@torch.no_grad()
def initialize_as_identity(network: nn.Module, images: Iterable[Tensor]) -> None:
    """Initialise every inserted batch normalisation of a network so that, in eval mode, it is the identity.

    The running statistics are set to those of the layer's input over all images (variance over all pixels),
    the weight to sqrt(variance + eps) and the bias to the mean. Pretrained features therefore pass
    unchanged, and training mode starts close to the identity too. A network without inserted normalisations
    is left alone.

    Parameters
    ----------
    network : nn.Module
        Network that may contain `InsertedBatchNorm` layers.
    images : iterable of Tensor, shape (B, 3, H, W)
        Batches of training images, on the network's device.

    Raises
    ------
    ValueError
        If there are no images, or if activations are not finite.
    """
    layers = [module for module in network.modules() if isinstance(module, InsertedBatchNorm)]
    if not layers:
        return
    measured = {layer: _Moments() for layer in layers}
    # A hook's return value replaces the layer's output, so the network is measured without these layers.
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
    statistics = {layer: moments.mean_and_variance() for layer, moments in measured.items()}
    for layer, (mean, variance) in statistics.items():
        layer.running_mean.copy_(mean)  # type: ignore[union-attr]
        layer.running_var.copy_(variance)  # type: ignore[union-attr]
        layer.weight.copy_((variance + layer.eps).sqrt())
        layer.bias.copy_(mean)


class _Moments:
    """Count, mean and sum of squared deviations by channel, accumulated over batches in float64.

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
        """Return mean and variance by channel. Raises ValueError without images or if they are not finite."""
        if not isinstance(self.mean, Tensor) or not isinstance(self.deviation, Tensor):
            raise ValueError("no images to compute batch normalisation statistics from")
        variance = self.deviation / self.count
        if not (torch.isfinite(self.mean).all() and torch.isfinite(variance).all()):
            raise ValueError("activations on the training images are not finite")
        return self.mean, variance
