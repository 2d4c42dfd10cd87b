"""Scene coordinates: for each cell of 8 x 8 pixels, the point of the scene that it shows, and how surely.

Shotton et al. 2013, "Scene coordinate regression forests"; Brachmann et al. 2017, "DSAC", as one small
convolutional network on SqueezeNet 1.1 (Iandola et al. 2016). The pose follows by
`spn_model.onboard.decoding`.
"""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional

STRIDE_PX = 8
# SqueezeNet 1.1 neither pads its first convolution nor its pooling: the first cell lies this far in.
FIRST_CELL_PX = 7.5
PARTS = 48  # of the scene, among which each cell chooses
_SHARPNESS = 4.0  # factor of the choice's logits, and
_REACH = 0.3  # of the coordinates within a part, in spreads: what makes both learn at one rate
_FAR = 4.0  # spreads from the centre: points beyond are in no part
_LOG_SCALE = (-6.0, 4.0)  # bounds of the certainty: 0.2 % to 55 times the scene's spread


def grid_size(width: int, height: int) -> tuple[int, int]:
    """Cells (columns, rows) of an image. Raises ValueError where it is smaller than the network takes."""
    smallest = SceneCoordinates.min_side_px
    if min(width, height) < smallest:
        raise ValueError(f"an image of {width} x {height} is smaller than {smallest} pixels")

    def cells(side: int) -> int:
        side = (side - 3) // 2 + 1
        for _ in range(2):
            side = -(-(side - 3) // 2) + 1
        return side

    return cells(width), cells(height)


class TorchvisionFire(nn.Module):
    """1 x 1 squeeze, then 1 x 1 and 3 x 3 expand side by side; torchvision's names of parameters."""

    def __init__(self, inputs: int, squeeze: int, expand: int):
        super().__init__()
        self.squeeze = nn.Conv2d(inputs, squeeze, 1)
        self.expand1x1 = nn.Conv2d(squeeze, expand, 1)
        self.expand3x3 = nn.Conv2d(squeeze, expand, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        x = functional.relu(self.squeeze(x), inplace=True)
        return functional.relu(torch.cat([self.expand1x1(x), self.expand3x3(x)], 1), inplace=True)


class Context(nn.Module):
    """What lies around each cell, at a distance: added to it. 53 thousand parameters."""

    def __init__(self, channels: int, inner: int, dilation: int):
        super().__init__()
        self.reduce = nn.Conv2d(channels, inner, 1)
        self.around = nn.Conv2d(inner, inner, 3, padding=dilation, dilation=dilation)
        self.expand = nn.Conv2d(inner, channels, 1)
        for layer in (self.reduce, self.around):
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
            nn.init.zeros_(layer.bias)  # type: ignore[arg-type]
        # It begins as nothing.
        nn.init.zeros_(self.expand.weight)
        nn.init.zeros_(self.expand.bias)  # type: ignore[arg-type]

    def forward(self, x: Tensor) -> Tensor:
        near = functional.relu(self.reduce(x), inplace=True)
        return x + self.expand(functional.relu(self.around(near), inplace=True))


class SceneCoordinates(nn.Module):
    """Images (B, 3, H, W) -> coordinates (B, 3, h, w) in the scene's frame, log scale (B, 1, h, w).

    Images are RGB, normalised as ImageNet's; they are first reduced by `shrink`, then given to `cells`, which
    training does directly. The log scale is that of an isotropic Laplace distribution in the scene's unit:
    the smaller, the surer. Of a reduced image, cell (0, 0) has its centre at pixel (7.5, 7.5) in COLMAP's
    convention, its neighbours 8 pixels on; `grid_size` gives h and w.

    The features are SqueezeNet 1.1's as published, without normalisation: the head needs no descriptor of
    the whole image, and batches of one scene have statistics of their own. Weights at stride 16 see all
    of an image of 480 x 270: facades repeat, and only what lies around them tells windows apart.

    A cell chooses among parts of the scene (`pick`), then tells where it lies against the mean of their
    middles: a choice tells repeated facades apart sooner than a regression (Li et al. 2020, "Hierarchical
    scene coordinate classification and regression for visual localization").

    center (3,), spread () : of the training images' points; outputs are centred and scaled by them.
    place (3, 48) : middles of the parts, centred and scaled likewise.
    fine_mean (256,), coarse_mean (512,), fine_std, coarse_std () : of the published features on training
    images; what the head receives is centred and scaled by them, once for all.
    covariance_scale () : factor of the covariances of decoded poses, measured on validation images.
    """

    min_side_px: ClassVar[int] = 63
    weights_name: ClassVar[str] = "squeezenet1_1-features"
    added: ClassVar[tuple[str, ...]] = (
        *("coarse", "context", "wide", "fine", "merge", "out", "pick", "place"),
        *("center", "spread"),
        *("fine_mean", "fine_std", "coarse_mean", "coarse_std"),
        "covariance_scale",
    )
    replaced: ClassVar[tuple[str, ...]] = ("classifier.1.",)
    place: Tensor
    center: Tensor
    spread: Tensor
    fine_mean: Tensor
    fine_std: Tensor
    coarse_mean: Tensor
    coarse_std: Tensor
    covariance_scale: Tensor

    def __init__(self, shrink: int = 1):
        super().__init__()
        self.shrink = shrink
        self.features = nn.Sequential(
            nn.Conv2d(3, 64, 3, stride=2),  # (B, 64, H/2, W/2)
            nn.ReLU(inplace=True),
            nn.MaxPool2d(3, stride=2, ceil_mode=True),  # stride 4
            TorchvisionFire(64, 16, 64),
            TorchvisionFire(128, 16, 64),
            nn.MaxPool2d(3, stride=2, ceil_mode=True),  # stride 8
            TorchvisionFire(128, 32, 128),
            TorchvisionFire(256, 32, 128),  # (B, 256, h, w)
            nn.MaxPool2d(3, stride=2, ceil_mode=True),  # stride 16
            TorchvisionFire(256, 48, 192),
            TorchvisionFire(384, 48, 192),
            TorchvisionFire(384, 64, 256),
            TorchvisionFire(512, 64, 256),  # (B, 512, h/2, w/2)
        )
        self.coarse = nn.Conv2d(512, 128, 1)
        self.context = nn.Conv2d(128, 128, 3, padding=2, dilation=2)
        self.wide = nn.Sequential(Context(128, 64, 4), Context(128, 64, 8))
        self.fine = nn.Conv2d(256, 128, 1)
        self.merge = nn.Conv2d(128, 128, 3, padding=1)
        self.out = nn.Conv2d(128, 4, 1)
        self.pick = nn.Conv2d(128, PARTS, 1)
        self.register_buffer("center", torch.zeros(3))
        self.register_buffer("spread", torch.ones(()))
        self.register_buffer("place", torch.zeros(3, PARTS))
        self.register_buffer("covariance_scale", torch.ones(()))
        for name, channels in (("fine", 256), ("coarse", 512)):
            self.register_buffer(f"{name}_mean", torch.zeros(channels))
            self.register_buffer(f"{name}_std", torch.ones(()))
        for layer in (self.coarse, self.context, self.fine, self.merge):
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
            nn.init.zeros_(layer.bias)  # type: ignore[arg-type]
        for layer in (self.out, self.pick):
            nn.init.normal_(layer.weight, std=0.01)
            nn.init.zeros_(layer.bias)  # type: ignore[arg-type]

    @torch.no_grad()
    def set_scene(self, xyz: Tensor) -> None:
        """Centre and spread of the outputs, and parts, from points (N, 3) that the training images see.

        By medians: a map has points far outside the scene.
        """
        self.center = xyz.median(dim=0).values.to(self.center)
        self.spread = (xyz - xyz.median(dim=0).values).norm(dim=1).median().to(self.spread)
        scaled = (xyz.to(self.center) - self.center) / self.spread
        self.place.copy_(_middles(scaled[scaled.norm(dim=1) < _FAR]).T)

    def part_of(self, xyz: Tensor) -> Tensor:
        """Index of the part (N,) whose middle is the nearest to points (N, 3)."""
        scaled = (xyz - self.center) / self.spread
        return torch.cdist(scaled, self.place.T).argmin(dim=1)

    @torch.no_grad()
    def measure_features(self, images: Tensor) -> None:
        """Normalise what the head receives, by training images (B, 3, H, W) and the weights as they are.

        Without it the first steps of the training blow up: a published feature may be 800 large.
        """
        fine = self.features[:8](self.reduced(images))
        for name, x in (("fine", fine), ("coarse", self.features[8:](fine))):
            mean = x.mean(dim=(0, 2, 3))
            # One scale for all channels: channels that rarely answer would be blown up by their own.
            spread = (x - mean[:, None, None]).square().mean().sqrt()
            getattr(self, f"{name}_mean").copy_(mean)
            getattr(self, f"{name}_std").copy_(spread)

    @property
    def first_cell_px(self) -> float:
        """Where the centre of the first cell lies in an image, along both axes."""
        return FIRST_CELL_PX * self.shrink

    @property
    def stride_px(self) -> float:
        """From one cell to the next, in the image."""
        return float(STRIDE_PX * self.shrink)

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        coordinates, log_scale, _ = self.cells(self.reduced(images))
        return coordinates, log_scale

    def reduced(self, images: Tensor) -> Tensor:
        """What `cells` takes: each pixel the mean of shrink x shrink."""
        return functional.avg_pool2d(images, self.shrink) if self.shrink > 1 else images

    def cells(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """As `forward`, of images that are reduced already; also logits (B, 48, h, w) of the parts."""
        fine = self.features[:8](images)
        coarse = self._normalised("coarse", self.features[8:](fine))
        coarse = functional.relu(self.coarse(coarse), inplace=True)
        coarse = self.wide(coarse + functional.relu(self.context(coarse)))
        # Cell n at stride 16 lies on cell 2n + 1 at stride 8, and half-way cells between.
        coarse = functional.pad(coarse, (1, 1, 1, 1), mode="replicate")
        size = [2 * side - 1 for side in coarse.shape[-2:]]
        up = functional.interpolate(coarse, size=size, mode="bilinear", align_corners=True)
        rows, columns = fine.shape[-2:]
        up = up[..., 1 : 1 + rows, 1 : 1 + columns]
        x = functional.relu(self.fine(self._normalised("fine", fine)) + up, inplace=True)
        x = functional.relu(x + self.merge(x), inplace=True)
        # bfloat16 would round coordinates to 0.4 %: decimetres.
        with torch.autocast(x.device.type, enabled=False):
            x = x.float()
            out, logits = self.out(x), self.pick(x) * _SHARPNESS
            # A product of matrices, not a convolution: a quantizer leaves it alone, and what comes before.
            chosen = self.place @ logits.softmax(dim=1).flatten(2)
            coordinates = chosen.reshape(out[:, :3].shape) + out[:, :3] * _REACH
            coordinates = coordinates * self.spread + self.center[:, None, None]
            log_scale = out[:, 3:].clamp(*_LOG_SCALE) + self.spread.log()
        return coordinates, log_scale, logits

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Parameters as "added" and "pretrained", as the regressors have them."""
        groups: dict[str, list[nn.Parameter]] = {"added": [], "pretrained": []}
        for name, parameter in self.named_parameters():
            added = name.partition(".")[0] in self.added
            groups["added" if added else "pretrained"].append(parameter)
        return groups

    def freeze_features(self, layers: int) -> None:
        """Keep the first layers as published: at 5, those at stride 4 and finer, half of a step's time."""
        for k, layer in enumerate(self.features):
            layer.requires_grad_(k >= layers)

    def _normalised(self, name: str, x: Tensor) -> Tensor:
        mean, std = getattr(self, f"{name}_mean"), getattr(self, f"{name}_std")
        return (x - mean[:, None, None]) / std


def laplace_loss(coordinates: Tensor, log_scale: Tensor, targets: Tensor, known: Tensor) -> Tensor:
    """Mean negative log likelihood, without its constant, of targets (B, 3, h, w) where known (B, h, w).

    The density falls with exp(-distance / scale) in three dimensions: distance / scale + 3 log scale.
    """
    distance = (coordinates - targets).square().sum(1).add(1e-12).sqrt()
    log_scale = log_scale[:, 0]
    return (distance * (-log_scale).exp() + 3 * log_scale)[known].mean()


def _middles(points: Tensor, rounds: int = 15, most: int = 20_000) -> Tensor:
    """Middles (48, 3) of as many groups of points (N, 3), always the same ones: Lloyd's k-means.

    It begins as k-means++ (Arthur and Vassilvitskii 2007). Without points all middles are 0.
    """
    generator = torch.Generator(points.device).manual_seed(0)
    if not len(points):
        return points.new_zeros(PARTS, 3)
    points = points[torch.randperm(len(points), generator=generator, device=points.device)[:most]]
    middles = points[:1]
    for _ in range(PARTS - 1):
        squared = torch.cdist(points, middles).min(dim=1).values.square() + 1e-12
        middles = torch.cat([middles, points[torch.multinomial(squared, 1, generator=generator)]])
    for _ in range(rounds):
        nearest = torch.cdist(points, middles).argmin(dim=1)
        count = torch.bincount(nearest, minlength=PARTS)[:, None]
        sums = torch.zeros_like(middles).index_add_(0, nearest, points)
        middles = torch.where(count > 0, sums / count.clamp(min=1), middles)
    return middles
