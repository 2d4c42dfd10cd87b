"""VGG16 (Simonyan and Zisserman 2014) adapted to pose regression, the paper's large network.

Müller, Urban, Jutzi 2017, section 3: the activations are Leaky ReLUs and two dense layers, `x` and `q`, are
added. It starts from Places365 weights there; a file with torchvision's names takes them in.

What the paper leaves open, and what we do:

- Where the heads attach: to fc7, the last layer of VGG16 before its classes.
- Whether batch normalisation is inserted as in SqueezePoseNet: no, the paper names dense layers and
  activations only.
- Input size: free, by torchvision's pooling of the last feature maps into 7 x 7 cells.
- Slope 0.01 (Maas et al. 2013); dropout 0.5 after fc6 and fc7, VGG16's own.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor, nn

from spn_model.networks.regressor import Regressor, he_start, heads


@dataclass(frozen=True, kw_only=True)
class VGG16Options:
    """What the paper leaves open."""

    slope: float = 0.01  # of the Leaky ReLUs
    dropout: float = 0.5  # share of fc6 and of fc7 dropped in training

    def __post_init__(self) -> None:
        if not (0 <= self.slope < 1 and 0 <= self.dropout < 1):
            raise ValueError("slope and dropout lie from 0 to below 1")


class VGG16(Regressor):
    """VGG16 to fc7, `x`, `q`: 134 million parameters, 537 MB."""

    min_side_px = 32
    added = ("dropout", "x", "q")
    replaced = ("classifier.6.",)
    weights_name = "vgg16"

    def __init__(self, options: VGG16Options | None = None):
        super().__init__()
        self.options = options = options or VGG16Options()
        slope = options.slope
        self.features = vgg16(slope)
        self.avgpool = nn.AdaptiveAvgPool2d(7)
        self.classifier = nn.Sequential(
            nn.Linear(512 * 7 * 7, 4096),  # fc6
            nn.LeakyReLU(slope, inplace=True),
            nn.Dropout(options.dropout),
            nn.Linear(4096, 4096),  # fc7
            nn.LeakyReLU(slope, inplace=True),
        )
        self.dropout = nn.Dropout(options.dropout)
        he_start(self, slope)
        self.x, self.q = heads(4096)

    def trunk(self, images: Tensor) -> tuple[Tensor, ...]:
        maps = self.avgpool(self.features(images))  # (B, 512, 7, 7)
        return (self.classifier(maps.flatten(1)),)  # (B, 4096)

    def describe(self, features: tuple[Tensor, ...]) -> Tensor:
        return self.dropout(features[0])  # (B, 4096)


def vgg16(slope: float) -> nn.Sequential:
    """Configuration D of VGG's table 1 to its last pooling; sizes are those for 224 x 224."""
    return nn.Sequential(
        nn.Conv2d(3, 64, 3, padding=1),  # (B, 64, 224, 224)
        nn.LeakyReLU(slope, inplace=True),
        nn.Conv2d(64, 64, 3, padding=1),
        nn.LeakyReLU(slope, inplace=True),
        nn.MaxPool2d(2, stride=2),
        nn.Conv2d(64, 128, 3, padding=1),  # (B, 128, 112, 112)
        nn.LeakyReLU(slope, inplace=True),
        nn.Conv2d(128, 128, 3, padding=1),
        nn.LeakyReLU(slope, inplace=True),
        nn.MaxPool2d(2, stride=2),
        nn.Conv2d(128, 256, 3, padding=1),  # (B, 256, 56, 56)
        nn.LeakyReLU(slope, inplace=True),
        nn.Conv2d(256, 256, 3, padding=1),
        nn.LeakyReLU(slope, inplace=True),
        nn.Conv2d(256, 256, 3, padding=1),
        nn.LeakyReLU(slope, inplace=True),
        nn.MaxPool2d(2, stride=2),
        nn.Conv2d(256, 512, 3, padding=1),  # (B, 512, 28, 28)
        nn.LeakyReLU(slope, inplace=True),
        nn.Conv2d(512, 512, 3, padding=1),
        nn.LeakyReLU(slope, inplace=True),
        nn.Conv2d(512, 512, 3, padding=1),
        nn.LeakyReLU(slope, inplace=True),
        nn.MaxPool2d(2, stride=2),
        nn.Conv2d(512, 512, 3, padding=1),  # (B, 512, 14, 14)
        nn.LeakyReLU(slope, inplace=True),
        nn.Conv2d(512, 512, 3, padding=1),
        nn.LeakyReLU(slope, inplace=True),
        nn.Conv2d(512, 512, 3, padding=1),
        nn.LeakyReLU(slope, inplace=True),
        nn.MaxPool2d(2, stride=2),  # (B, 512, 7, 7)
    )
