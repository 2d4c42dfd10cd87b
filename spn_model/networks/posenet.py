"""PoseNet (Kendall, Grimes, Cipolla 2015): GoogLeNet with its three classifiers replaced by regressors.

A fully connected layer of 2048 neurons follows the pooling, followed by the heads `x` and `q`. GoogLeNet's
two auxiliary classifiers regress the pose too, with a weight of 0.3 each in the loss; they are used in
training only.

Differences from the authors' Caffe network, so that torchvision's weights can be loaded (Places weights of
GoogLeNet exist for Caffe only):

- GoogLeNet is torchvision's: batch normalisation in each block, and 3 x 3 filters in the branch that has 5
  x 5 filters in the paper.
- Its pooling is global, and the auxiliary heads pool to 4 x 4 cells, so that the input size is free.
- Its weights were trained on images in -1..1; the network rescales its input accordingly.
- The auxiliary heads start untrained: torchvision's file contains them, but they were never trained.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from spn_model.networks.imagenet import MEAN, STD
from spn_model.networks.regressor import Estimate, Regressor, initialize_he, make_heads


@dataclass(frozen=True, kw_only=True)
class PoseNetOptions:
    """Dropout rates of the authors' network."""

    dropout: float = 0.5  # fraction of the 2048 neurons dropped in training
    auxiliary_dropout: float = 0.7  # fraction of the auxiliary heads' 1024 neurons

    def __post_init__(self) -> None:
        if not (0 <= self.dropout < 1 and 0 <= self.auxiliary_dropout < 1):
            raise ValueError("dropout and auxiliary_dropout need to be in [0, 1)")


class Convolution(nn.Module):
    """Convolution, batch normalisation, ReLU."""

    def __init__(self, channels: int, out: int, size: int, *, stride: int = 1, padding: int = 0):
        super().__init__()
        self.conv = nn.Conv2d(channels, out, size, stride=stride, padding=padding, bias=False)
        self.bn = nn.BatchNorm2d(out, eps=0.001)

    def forward(self, maps: Tensor) -> Tensor:
        """Return feature maps (B, out, H', W') of (B, channels, H, W)."""
        return F.relu(self.bn(self.conv(maps)), inplace=True)


class Inception(nn.Module):
    """Inception block of four parallel branches; the arguments are the columns of GoogLeNet's table 1."""

    def __init__(
        self,
        channels: int,
        n1x1: int,
        reduce3x3: int,
        n3x3: int,
        reduce5x5: int,
        n5x5: int,
        pool: int,
    ):
        super().__init__()
        self.branch1 = Convolution(channels, n1x1, 1)
        self.branch2 = nn.Sequential(
            Convolution(channels, reduce3x3, 1), Convolution(reduce3x3, n3x3, 3, padding=1)
        )
        # 3 x 3 instead of 5 x 5, as in torchvision, whose weights are loaded.
        self.branch3 = nn.Sequential(
            Convolution(channels, reduce5x5, 1), Convolution(reduce5x5, n5x5, 3, padding=1)
        )
        self.branch4 = nn.Sequential(
            nn.MaxPool2d(3, stride=1, padding=1, ceil_mode=True), Convolution(channels, pool, 1)
        )

    def forward(self, maps: Tensor) -> Tensor:
        """Return (B, n1x1 + n3x3 + n5x5 + pool, H, W) from (B, channels, H, W)."""
        branches = (self.branch1, self.branch2, self.branch3, self.branch4)
        return torch.cat([branch(maps) for branch in branches], 1)


class AuxiliaryHead(nn.Module):
    """Pose regressor on intermediate feature maps, pooled to 4 x 4 cells."""

    def __init__(self, channels: int, dropout: float):
        super().__init__()
        self.conv = Convolution(channels, 128, 1)
        self.fc1 = nn.Linear(128 * 4 * 4, 1024)
        self.dropout = nn.Dropout(dropout)
        initialize_he(self, 0.0)
        self.x, self.q = make_heads(1024)

    def forward(self, cells: Tensor) -> Estimate:
        """Return x (B, 3) and q (B, 4) from (B, channels, 4, 4)."""
        maps = self.conv(cells)  # (B, 128, 4, 4)
        kept = self.dropout(F.relu(self.fc1(maps.flatten(1)), inplace=True))  # (B, 1024)
        return self.x(kept), self.q(kept)


class PoseNet(Regressor):
    """GoogLeNet with `fc1` of 2048 neurons, heads and two auxiliary heads: 12 million parameters, 48 MB."""

    min_side_px = 15
    added = ("fc1", "dropout", "x", "q", "aux1", "aux2")
    replaced = ("fc.", "aux1.", "aux2.")
    weights_name = "googlenet"
    estimate_weights = (1.0, 0.3, 0.3)
    _scale: Tensor
    _shift: Tensor

    def __init__(self, options: PoseNetOptions | None = None):
        super().__init__()
        self.options = options = options or PoseNetOptions()
        # Sizes are for a 224 x 224 input.
        self.conv1 = Convolution(3, 64, 7, stride=2, padding=3)  # (B, 64, 112, 112)
        self.maxpool1 = nn.MaxPool2d(3, stride=2, ceil_mode=True)
        self.conv2 = Convolution(64, 64, 1)  # (B, 64, 56, 56)
        self.conv3 = Convolution(64, 192, 3, padding=1)
        self.maxpool2 = nn.MaxPool2d(3, stride=2, ceil_mode=True)
        self.inception3a = Inception(192, 64, 96, 128, 16, 32, 32)  # (B, 256, 28, 28)
        self.inception3b = Inception(256, 128, 128, 192, 32, 96, 64)
        self.maxpool3 = nn.MaxPool2d(3, stride=2, ceil_mode=True)
        self.inception4a = Inception(480, 192, 96, 208, 16, 48, 64)  # (B, 512, 14, 14)
        self.inception4b = Inception(512, 160, 112, 224, 24, 64, 64)
        self.inception4c = Inception(512, 128, 128, 256, 24, 64, 64)
        self.inception4d = Inception(512, 112, 144, 288, 32, 64, 64)  # (B, 528, 14, 14)
        self.inception4e = Inception(528, 256, 160, 320, 32, 128, 128)
        self.maxpool4 = nn.MaxPool2d(2, stride=2, ceil_mode=True)
        self.inception5a = Inception(832, 256, 160, 320, 32, 128, 128)  # (B, 832, 7, 7)
        self.inception5b = Inception(832, 384, 192, 384, 48, 128, 128)  # (B, 1024, 7, 7)
        self.fc1 = nn.Linear(1024, 2048)
        self.dropout = nn.Dropout(options.dropout)
        initialize_he(self, 0.0)
        self.x, self.q = make_heads(2048)
        self.aux1 = AuxiliaryHead(512, options.auxiliary_dropout)
        self.aux2 = AuxiliaryHead(528, options.auxiliary_dropout)
        shift, scale = torch.tensor(MEAN), torch.tensor(STD)
        self.register_buffer("_scale", (2 * scale)[:, None, None], persistent=False)
        self.register_buffer("_shift", (2 * shift - 1)[:, None, None], persistent=False)

    def trunk(self, images: Tensor) -> tuple[Tensor, ...]:
        """Return the pooled features (B, 1024), in training mode also two maps for the auxiliary heads."""
        maps = images * self._scale + self._shift  # -1..1
        maps = self.maxpool1(self.conv1(maps))
        maps = self.maxpool2(self.conv3(self.conv2(maps)))
        maps = self.maxpool3(self.inception3b(self.inception3a(maps)))
        after4a = self.inception4a(maps)
        after4d = self.inception4d(self.inception4c(self.inception4b(after4a)))
        maps = self.maxpool4(self.inception4e(after4d))
        pooled = self.inception5b(self.inception5a(maps)).mean((2, 3))  # (B, 1024)
        if not self.training:
            return (pooled,)
        return pooled, F.adaptive_avg_pool2d(after4a, 4), F.adaptive_avg_pool2d(after4d, 4)

    def describe(self, features: tuple[Tensor, ...]) -> Tensor:
        """Return the output of `fc1`, (B, 2048)."""
        return self.dropout(F.relu(self.fc1(features[0]), inplace=True))  # (B, 2048)

    def auxiliary(self, features: tuple[Tensor, ...]) -> tuple[Estimate, ...]:
        """Return the estimates of the two auxiliary heads in training mode, none in eval mode."""
        cells = zip((self.aux1, self.aux2), features[1:], strict=False)
        return tuple(head(maps) for head, maps in cells)
