"""Scene-coordinate network: for each cell of 8 x 8 pixels the scene point it shows, and its uncertainty.

Shotton et al. 2013, "Scene coordinate regression forests"; Brachmann et al. 2017, "DSAC", as one small
convolutional network on SqueezeNet 1.1 (Iandola et al. 2016). `spn_model.onboard.decoding` computes the
pose.
"""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional

STRIDE_PX = 8
# Centre of the first cell: SqueezeNet 1.1 pads neither its first convolution nor its pooling.
FIRST_CELL_PX = 7.5
PARTS = 48  # parts of the scene, which each cell classifies into
# Factors that let one learning rate suit both classification and regression:
_SHARPNESS = 4.0  # of the part logits
_REACH = 0.3  # of the offsets from a part's centre, in spreads
_FAR = 4.0  # spreads from the scene's centre; points beyond belong to no part
_LOG_SCALE = (-6.0, 4.0)  # bounds of the log scale: 0.2 % to 55 times the scene's spread


def grid_size(width: int, height: int) -> tuple[int, int]:
    """Return the number of cells (columns, rows) of an image.

    Raises ValueError if the image is smaller than the network needs.
    """
    smallest = SceneCoordinates.min_side_px
    if min(width, height) < smallest:
        raise ValueError(f"an image of {width} x {height} is smaller than {smallest} px a side")

    def cells(side: int) -> int:
        side = (side - 3) // 2 + 1
        for _ in range(2):
            side = -(-(side - 3) // 2) + 1
        return side

    return cells(width), cells(height)


class TorchvisionFire(nn.Module):
    """Fire module: 1 x 1 squeeze, then parallel 1 x 1 and 3 x 3 expand, with torchvision's parameter names.

    It applies one ReLU after the concatenation, as the published network does; the `Fire` of SqueezePoseNet
    has a normalised activation for each convolution.
    """

    def __init__(self, inputs: int, squeeze: int, expand: int):
        super().__init__()
        self.squeeze = nn.Conv2d(inputs, squeeze, 1)
        self.expand1x1 = nn.Conv2d(squeeze, expand, 1)
        self.expand3x3 = nn.Conv2d(squeeze, expand, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """Return (B, 2 * expand, H, W) from (B, inputs, H, W)."""
        x = functional.relu(self.squeeze(x), inplace=True)
        return functional.relu(torch.cat([self.expand1x1(x), self.expand3x3(x)], 1), inplace=True)


class Context(nn.Module):
    """Residual block that adds context from a distance to each cell; 53 thousand parameters."""

    def __init__(self, channels: int, inner: int, dilation: int):
        super().__init__()
        self.reduce = nn.Conv2d(channels, inner, 1)
        self.around = nn.Conv2d(inner, inner, 3, padding=dilation, dilation=dilation)
        self.expand = nn.Conv2d(inner, channels, 1)
        for layer in (self.reduce, self.around):
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
            nn.init.zeros_(layer.bias)  # type: ignore[arg-type]
        # The block starts as the identity.
        nn.init.zeros_(self.expand.weight)
        nn.init.zeros_(self.expand.bias)  # type: ignore[arg-type]

    def forward(self, x: Tensor) -> Tensor:
        """Return feature maps of the input's shape."""
        near = functional.relu(self.reduce(x), inplace=True)
        return x + self.expand(functional.relu(self.around(near), inplace=True))


class SceneCoordinates(nn.Module):
    """Network from images (B, 3, H, W) to scene coordinates (B, 3, h, w) and log scales (B, 1, h, w).

    Images are RGB, normalised with ImageNet's mean and standard deviation. `forward` first reduces them by
    `shrink` and passes them to `cells`, which training calls directly. The log scale is that of an
    isotropic Laplace distribution in the scene's unit; a smaller one means a more certain cell. In a
    reduced image, the centre of cell (0, 0) is at pixel (7.5, 7.5) in COLMAP's convention and neighbours
    are 8 pixels apart; `grid_size` gives h and w.

    Attributes
    ----------
    center : Tensor, shape (3,)
        Centre of the points that the training images see; outputs are centred by it.
    spread : Tensor, shape ()
        Spread of these points; outputs are scaled by it.
    place : Tensor, shape (3, 48)
        Centres of the scene's parts, centred and scaled likewise.
    fine_mean, coarse_mean : Tensor, shape (256,) and (512,)
        Means of the published features on training images, by which the head's inputs are centred.
    fine_std, coarse_std : Tensor, shape ()
        Standard deviations of these features, by which the head's inputs are scaled; fixed once measured.
    covariance_scale : Tensor, shape ()
        Factor of the covariances of decoded poses, measured on validation images.

    Notes
    -----
    The features are SqueezeNet 1.1's as published, without batch normalisation: the head needs no
    descriptor of the whole image, and batches of a single scene have statistics of their own. The layers at
    stride 16 see all of an image of 480 x 270: facades repeat, and only their surroundings distinguish one
    window from another.

    Each cell is a mixture over parts of the scene (Bishop 1994, "Mixture density networks"): `pick` gives
    the weights, and a component's mean is the centre of its part plus an offset, one that all components
    share (`out`) and one of its own (`offset`). The coordinates of a cell are those of its likeliest part.
    Classification separates repeated facades sooner than regression (Li et al. 2020, "Hierarchical scene
    coordinate classification and regression for visual localization"), and a mean over parts would lie
    between two look-alike places.
    """

    min_side_px: ClassVar[int] = 63
    weights_name: ClassVar[str] = "squeezenet1_1-features"
    added: ClassVar[tuple[str, ...]] = (
        *("coarse", "context", "wide", "fine", "merge", "out", "offset", "pick", "place"),
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
        self.offset = nn.Conv2d(128, 3 * PARTS, 1)
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
        nn.init.zeros_(self.offset.weight)
        nn.init.zeros_(self.offset.bias)  # type: ignore[arg-type]

    @torch.no_grad()
    def set_scene(self, xyz: Tensor) -> None:
        """Set centre, spread and parts of the scene from points (N, 3) that the training images see.

        Uses medians, because a map has outliers far outside the scene.
        """
        self.center = xyz.median(dim=0).values.to(self.center)
        self.spread = (xyz - xyz.median(dim=0).values).norm(dim=1).median().to(self.spread)
        scaled = (xyz.to(self.center) - self.center) / self.spread
        self.place.copy_(_middles(scaled[scaled.norm(dim=1) < _FAR]).T)

    def part_of(self, xyz: Tensor) -> Tensor:
        """Return the index (N,) of the part whose centre is nearest to each point (N, 3)."""
        scaled = (xyz - self.center) / self.spread
        return torch.cdist(scaled, self.place.T).argmin(dim=1)

    @torch.no_grad()
    def measure_features(self, images: Tensor) -> None:
        """Set the normalisation of the head's inputs from training images (B, 3, H, W).

        It depends on the current weights of the features. Without it the first training steps diverge:
        published features can be as large as 800.
        """
        fine = self.features[:8](self.reduced(images))
        for name, x in (("fine", fine), ("coarse", self.features[8:](fine))):
            mean = x.mean(dim=(0, 2, 3))
            # One scale for all channels: a scale of their own would blow up channels that are rarely active.
            spread = (x - mean[:, None, None]).square().mean().sqrt()
            getattr(self, f"{name}_mean").copy_(mean)
            getattr(self, f"{name}_std").copy_(spread)

    @property
    def first_cell_px(self) -> float:
        """Pixel coordinate of the first cell's centre in the full image, along both axes."""
        return FIRST_CELL_PX * self.shrink

    @property
    def stride_px(self) -> float:
        """Distance between neighbouring cells in the full image, in pixels."""
        return float(STRIDE_PX * self.shrink)

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Return coordinates (B, 3, h, w) and log scales (B, 1, h, w) of images (B, 3, H, W)."""
        candidates, log_scale, logits = self.cells(self.reduced(images))
        part = logits.argmax(dim=1)[:, None, None].expand(-1, -1, 3, -1, -1)
        return candidates.gather(1, part)[:, 0], log_scale

    def reduced(self, images: Tensor) -> Tensor:
        """Return the input of `cells`: images averaged over blocks of shrink x shrink pixels."""
        return functional.avg_pool2d(images, self.shrink) if self.shrink > 1 else images

    def cells(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the mixture of each cell, of images already reduced.

        Returns the components' coordinates (B, 48, 3, h, w), their common log scale (B, 1, h, w) and their
        logits (B, 48, h, w).
        """
        fine = self.features[:8](images)
        coarse = self._normalised("coarse", self.features[8:](fine))
        coarse = functional.relu(self.coarse(coarse), inplace=True)
        coarse = self.wide(coarse + functional.relu(self.context(coarse)))
        # Cell n at stride 16 is centred on cell 2n + 1 at stride 8; the cells between are interpolated.
        coarse = functional.pad(coarse, (1, 1, 1, 1), mode="replicate")
        size = [2 * side - 1 for side in coarse.shape[-2:]]
        up = functional.interpolate(coarse, size=size, mode="bilinear", align_corners=True)
        rows, columns = fine.shape[-2:]
        up = up[..., 1 : 1 + rows, 1 : 1 + columns]
        x = functional.relu(self.fine(self._normalised("fine", fine)) + up, inplace=True)
        x = functional.relu(x + self.merge(x), inplace=True)
        # Compute in float32: bfloat16 rounds coordinates to 0.4 %, which is decimetres.
        with torch.autocast(x.device.type, enabled=False):
            x = x.float()
            out, logits = self.out(x), self.pick(x) * _SHARPNESS
            offsets = self.offset(x).unflatten(1, (PARTS, 3)) + out[:, None, :3]
            candidates = self.place.T[:, :, None, None] + offsets * _REACH
            candidates = candidates * self.spread + self.center[:, None, None]
            log_scale = out[:, 3:].clamp(*_LOG_SCALE) + self.spread.log()
        return candidates, log_scale, logits

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Return the parameters as "added" and "pretrained", as `Regressor.parameter_groups` does."""
        groups: dict[str, list[nn.Parameter]] = {"added": [], "pretrained": []}
        for name, parameter in self.named_parameters():
            added = name.partition(".")[0] in self.added
            groups["added" if added else "pretrained"].append(parameter)
        return groups

    def freeze_features(self, layers: int) -> None:
        """Freeze the first layers at their published weights.

        With 5 layers, those at stride 4 and finer are frozen, which account for half of the time of a step.
        """
        for k, layer in enumerate(self.features):
            layer.requires_grad_(k >= layers)

    def _normalised(self, name: str, x: Tensor) -> Tensor:
        mean, std = getattr(self, f"{name}_mean"), getattr(self, f"{name}_std")
        return (x - mean[:, None, None]) / std


def _middles(points: Tensor, rounds: int = 15, most: int = 20_000) -> Tensor:
    """Return k-means centres (48, 3) of points (N, 3), always the same ones: Lloyd's algorithm.

    The centres are initialised by k-means++ (Arthur and Vassilvitskii 2007). Without points they are all 0.
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
