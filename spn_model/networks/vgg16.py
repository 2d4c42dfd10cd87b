"""VGG16 (Simonyan and Zisserman 2014) adapted to pose regression, the paper's large network.

Müller, Urban, Jutzi 2017, section 3: the activations are Leaky ReLUs, and two dense layers `x` and `q` are
added. The paper starts from Places365 weights; a file with torchvision's parameter names can be loaded.

The paper leaves some choices open; these are made here:

- Input of the heads: fc7, VGG16's last layer before its classifier.
- No batch normalisation is inserted, unlike in SqueezePoseNet: the paper names dense layers and activations
  only.
- Input size: free, by torchvision's pooling of the last feature maps to 7 x 7 cells.
- Slope 0.01 (Maas et al. 2013); dropout 0.5 after fc6 and fc7, as in VGG16.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor, nn

from spn_model.networks.regressor import Regressor, initialize_he, make_heads


@dataclass(frozen=True, kw_only=True)
class VGG16Options:
    """Choices that the paper leaves open."""

    slope: float = 0.01  # slope of the Leaky ReLUs
    dropout: float = 0.5  # fraction of fc6 and of fc7 dropped in training

    def __post_init__(self) -> None:
        if not (0 <= self.slope < 1 and 0 <= self.dropout < 1):
            raise ValueError("slope and dropout need to be in [0, 1)")


class VGG16(Regressor):
    """VGG16 up to fc7 with the heads `x` and `q`: 134 million parameters, 537 MB."""

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
        initialize_he(self, slope)
        self.x, self.q = make_heads(4096)

    def trunk(self, images: Tensor) -> tuple[Tensor, ...]:
        """Return the output of fc7, (B, 4096)."""
        maps = self.avgpool(self.features(images))  # (B, 512, 7, 7)
        return (self.classifier(maps.flatten(1)),)  # (B, 4096)

    def describe(self, features: tuple[Tensor, ...]) -> Tensor:
        """Return the features (B, 4096) after dropout."""
        return self.dropout(features[0])  # (B, 4096)


def vgg16(slope: float) -> nn.Sequential:
    """Return configuration D of VGG's table 1 up to its last pooling; sizes are for a 224 x 224 input."""
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
