"""SqueezePoseNet: SqueezeNet (Iandola et al. 2016) adapted to pose regression.

Müller, Urban, Jutzi 2017, "SqueezePoseNet: image based pose regression with small convolutional neural
networks for real time UAS navigation", section 3: a fully connected layer `fc11` of 500 neurons as
descriptor, Leaky ReLUs instead of all ReLUs, batch normalisation after each convolution, and the heads `x`
and `q`.

The paper leaves some choices open; these are made here:

- SqueezeNet version: 1.1. It needs 2.4 times less computation for the same accuracy on ImageNet, and its
  weights are shipped. The paper's 4.8 MB are those of 1.0; use `version = "1.0"` for it.
- conv10: dropped. Its 1000 channels belong to the classes of ImageNet, and its 513,000 weights are 42 % of
  the network; `fc11` continues its numbering but does not need its output. `conv10 = true` keeps it, with
  weights that include it.
- Input of `fc11`: the global average of the last feature maps, where SqueezeNet averages too. This allows
  images of any size; a layer on all cells of the map would have at least 5 million weights.
- After `fc11`: a Leaky ReLU. Without one, `fc11` and the heads would be a single linear map.
- Slope: 0.01, as in the paper's reference for Leaky ReLUs (Maas et al. 2013). SqueezeNet's pre-activations
  reach minus several hundred, so that a larger slope drowns the pretrained features: on 60 frames, pooled
  features correlate with the original ones by 0.99 at 0.01, but by 0.68 at 0.1.
- Dropout: 0.5 on the pooled features, SqueezeNet's own rate, where SqueezeNet has it before the classifier.
- Batch normalisation of pretrained layers: initialised as the identity (`initialize_as_identity`).
- Input size: free. Optimiser and learning rate are set by the training recipe.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from spn_model.networks.normalization import normalized_leaky_relu
from spn_model.networks.regressor import Regressor, initialize_he, make_heads


@dataclass(frozen=True, kw_only=True)
class SqueezePoseNetOptions:
    """Choices that the paper leaves open."""

    version: str = "1.1"  # SqueezeNet version, 1.0 or 1.1
    conv10: bool = False  # keep the classifier's convolution before the pooling
    slope: float = 0.01  # slope of the Leaky ReLUs
    dropout: float = 0.5  # fraction of the pooled features dropped in training

    def __post_init__(self) -> None:
        if self.version not in ("1.0", "1.1"):
            raise ValueError(f"version is {self.version!r}, needs to be 1.0 or 1.1")
        if not (0 <= self.slope < 1 and 0 <= self.dropout < 1):
            raise ValueError("slope and dropout need to be in [0, 1)")


class Fire(nn.Module):
    """Fire module: squeeze to few channels, then parallel 1x1 and 3x3 filters (the paper's figure 2)."""

    def __init__(self, channels: int, squeeze: int, expand: int, slope: float):
        super().__init__()
        self.squeeze = nn.Conv2d(channels, squeeze, 1)
        self.squeeze_activation = normalized_leaky_relu(squeeze, slope)
        self.expand1x1 = nn.Conv2d(squeeze, expand, 1)
        self.expand1x1_activation = normalized_leaky_relu(expand, slope)
        self.expand3x3 = nn.Conv2d(squeeze, expand, 3, padding=1)
        self.expand3x3_activation = normalized_leaky_relu(expand, slope)

    def forward(self, maps: Tensor) -> Tensor:
        """Return (B, 2 * expand, H, W) from (B, channels, H, W)."""
        squeezed = self.squeeze_activation(self.squeeze(maps))
        narrow = self.expand1x1_activation(self.expand1x1(squeezed))
        wide = self.expand3x3_activation(self.expand3x3(squeezed))
        return torch.cat([narrow, wide], 1)


class SqueezePoseNet(Regressor):
    """SqueezeNet with `fc11`, `x` and `q`: 0.99 million parameters, 4.0 MB, with the default options."""

    min_side_px = 21
    added = ("dropout", "fc11", "fc11_activation", "x", "q")
    replaced = ("classifier.1.",)

    def __init__(self, options: SqueezePoseNetOptions | None = None):
        super().__init__()
        self.options = options = options or SqueezePoseNetOptions()
        slope = options.slope
        make = {"1.0": squeezenet1_0, "1.1": squeezenet1_1}[options.version]
        self.features = make(slope)
        width = 512
        if options.conv10:
            width = 1000
            # Keep torchvision's parameter names: classifier.0 is its dropout.
            self.classifier = nn.Sequential(
                nn.Identity(), nn.Conv2d(512, 1000, 1), normalized_leaky_relu(1000, slope)
            )
        self.dropout = nn.Dropout(options.dropout)
        self.fc11 = nn.Linear(width, 500)
        self.fc11_activation = nn.LeakyReLU(slope)
        initialize_he(self, slope)
        self.x, self.q = make_heads(500)

    @property
    def weights_name(self) -> str:
        """Name of the published SqueezeNet weights that match the version and whether conv10 is kept."""
        if self.options.version == "1.0":
            return "squeezenet1_0"
        return "squeezenet1_1" if self.options.conv10 else "squeezenet1_1-features"

    def trunk(self, images: Tensor) -> tuple[Tensor, ...]:
        """Return the globally averaged feature maps, (B, 512), or (B, 1000) with conv10."""
        maps = self.features(images)  # (B, 512, about H / 16, about W / 16)
        if self.options.conv10:
            maps = self.classifier(maps)  # (B, 1000, ...)
        return (maps.mean((2, 3)),)  # (B, 512 or 1000)

    def describe(self, features: tuple[Tensor, ...]) -> Tensor:
        """Return the descriptor of `fc11`, (B, 500)."""
        return self.fc11_activation(self.fc11(self.dropout(features[0])))  # (B, 500)


def squeezenet1_1(slope: float) -> nn.Sequential:
    """Return the layers conv1 to fire9 of SqueezeNet 1.1; sizes are for a 224 x 224 input."""
    return nn.Sequential(
        nn.Conv2d(3, 64, 3, stride=2),  # conv1 (B, 64, 111, 111)
        normalized_leaky_relu(64, slope),
        nn.MaxPool2d(3, stride=2, ceil_mode=True),  # (B, 64, 55, 55)
        Fire(64, 16, 64, slope),  # fire2 (B, 128, 55, 55)
        Fire(128, 16, 64, slope),  # fire3
        nn.MaxPool2d(3, stride=2, ceil_mode=True),  # (B, 128, 27, 27)
        Fire(128, 32, 128, slope),  # fire4 (B, 256, 27, 27)
        Fire(256, 32, 128, slope),  # fire5
        nn.MaxPool2d(3, stride=2, ceil_mode=True),  # (B, 256, 13, 13)
        Fire(256, 48, 192, slope),  # fire6 (B, 384, 13, 13)
        Fire(384, 48, 192, slope),  # fire7
        Fire(384, 64, 256, slope),  # fire8 (B, 512, 13, 13)
        Fire(512, 64, 256, slope),  # fire9
    )


def squeezenet1_0(slope: float) -> nn.Sequential:
    """Return the layers conv1 to fire9 of SqueezeNet 1.0; sizes are for a 224 x 224 input."""
    return nn.Sequential(
        nn.Conv2d(3, 96, 7, stride=2),  # conv1 (B, 96, 109, 109)
        normalized_leaky_relu(96, slope),
        nn.MaxPool2d(3, stride=2, ceil_mode=True),  # (B, 96, 54, 54)
        Fire(96, 16, 64, slope),  # fire2 (B, 128, 54, 54)
        Fire(128, 16, 64, slope),  # fire3
        Fire(128, 32, 128, slope),  # fire4 (B, 256, 54, 54)
        nn.MaxPool2d(3, stride=2, ceil_mode=True),  # (B, 256, 27, 27)
        Fire(256, 32, 128, slope),  # fire5
        Fire(256, 48, 192, slope),  # fire6 (B, 384, 27, 27)
        Fire(384, 48, 192, slope),  # fire7
        Fire(384, 64, 256, slope),  # fire8 (B, 512, 27, 27)
        nn.MaxPool2d(3, stride=2, ceil_mode=True),  # (B, 512, 13, 13)
        Fire(512, 64, 256, slope),  # fire9
    )
