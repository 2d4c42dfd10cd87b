"""Base class of pose regressors: from an image to a position and a quaternion."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar, Self

from torch import Tensor, nn

Estimate = tuple[Tensor, Tensor]  # x (B, 3), q (B, 4)


class Regressor(nn.Module, ABC):
    """Classification network whose classifier is replaced by two heads, `x` and `q`.

    Images are (B, 3, H, W) float RGB, normalised with the mean and standard deviation of ImageNet; H and W
    are free, from `min_side_px` upwards. Position and quaternion are in the units of the targets; the
    quaternion (w, x, y, z) is normalised neither here nor in the paper's loss.

    A network consists of a trunk, whose parameters have torchvision's names and shapes so that published
    weights can be loaded, and of added layers. The two can be called separately: the features of a frozen
    trunk may be cached and trained on.

    Attributes
    ----------
    min_side_px : int
        Smallest height and width; below it, pooling leaves nothing.
    added : tuple of str
        Names of modules without pretrained weights.
    replaced : tuple of str
        Prefixes of published parameter names that have no counterpart here.
    estimate_weights : tuple of float
        Weight of each estimate in the loss, the main one first.
    options : dataclass
        Frozen options that define the architecture.
    x, q : nn.Linear
        Heads for position and quaternion.
    frozen : bool
        Whether the trunk is frozen.
    """

    min_side_px: ClassVar[int]
    added: ClassVar[tuple[str, ...]]
    replaced: ClassVar[tuple[str, ...]]
    estimate_weights: ClassVar[tuple[float, ...]] = (1.0,)
    options: Any
    x: nn.Linear
    q: nn.Linear

    def __init__(self) -> None:
        super().__init__()
        self.frozen = False

    @property
    @abstractmethod
    def weights_name(self) -> str:
        """Name, in `spn_model.pretrained.weights`, of the published weights that the trunk starts from."""

    @abstractmethod
    def trunk(self, images: Tensor) -> tuple[Tensor, ...]:
        """Return features (B, ...) of images (B, 3, H, W), those of the main estimate first.

        Features of auxiliary estimates follow in training mode only.
        """

    @abstractmethod
    def describe(self, features: tuple[Tensor, ...]) -> Tensor:
        """Return the descriptor (B, D) that the heads `x` and `q` take, from the output of `trunk`."""

    def auxiliary(self, features: tuple[Tensor, ...]) -> tuple[Estimate, ...]:
        """Return further estimates, which are used in training only."""
        return ()

    def regress(self, features: tuple[Tensor, ...]) -> tuple[Estimate, ...]:
        """Return the estimates from the output of `trunk`, the main one first."""
        descriptor = self.describe(features)
        return (self.x(descriptor), self.q(descriptor)), *self.auxiliary(features)

    def estimates(self, images: Tensor) -> tuple[Estimate, ...]:
        """Return all estimates from images (B, 3, H, W), for a loss weighted by `estimate_weights`."""
        return self.regress(self.trunk(images))

    def forward(self, images: Tensor) -> Estimate:
        """Return x (B, 3) and q (B, 4) of images (B, 3, H, W)."""
        return self.estimates(images)[0]

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Return the parameters as "added" and "pretrained"; inserted normalisations belong to the trunk."""
        groups: dict[str, list[nn.Parameter]] = {"added": [], "pretrained": []}
        for name, parameter in self.named_parameters():
            groups["added" if self._is_added(name) else "pretrained"].append(parameter)
        return groups

    def freeze_trunk(self, frozen: bool = True) -> None:
        """Train the added layers only, or all. A frozen trunk stays in eval mode and gets no gradient."""
        self.frozen = frozen
        for parameter in self.parameter_groups()["pretrained"]:
            parameter.requires_grad_(not frozen)
        self.train(self.training)

    def train(self, mode: bool = True) -> Self:
        """Set the training mode; a frozen trunk keeps using its stored statistics, without dropout."""
        super().train(mode)
        if self.frozen:
            for name, module in self.named_children():
                if not self._is_added(name):
                    module.eval()
        return self

    def _is_added(self, name: str) -> bool:
        return name.partition(".")[0] in self.added


def initialize_he(module: nn.Module, slope: float) -> None:
    """Initialise convolutions and linear layers so that leaky ReLUs preserve the variance of signals.

    He et al. 2015, "Delving deep into rectifiers", equation 15. Biases start at 0.
    """
    for layer in module.modules():
        if isinstance(layer, nn.Conv2d | nn.Linear):
            nn.init.kaiming_normal_(layer.weight, a=slope, nonlinearity="leaky_relu")
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)


def make_heads(width: int) -> tuple[nn.Linear, nn.Linear]:
    """Return the heads `x` (3 neurons) and `q` (4 neurons), initialised near zero: the targets' centre."""
    x, q = nn.Linear(width, 3), nn.Linear(width, 4)
    for layer in (x, q):
        nn.init.normal_(layer.weight, std=0.01)
        nn.init.zeros_(layer.bias)
    return x, q
