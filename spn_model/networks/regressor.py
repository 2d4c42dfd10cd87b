"""What all pose regressors have in common: an image in, a position and a quaternion out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar, Self

from torch import Tensor, nn

Estimate = tuple[Tensor, Tensor]  # x (B, 3), q (B, 4)


class Regressor(nn.Module, ABC):
    """A classification network whose end is replaced by two heads, `x` and `q`.

    Images are (B, 3, H, W) float, RGB, normalised with the mean and standard deviation of ImageNet; H and W
    are free, from `min_side_px` on. Position and quaternion come in the units of the targets; the quaternion
    (w, x, y, z) isn't normalised here, nor in the paper's loss.

    A network is its trunk, which has the names and shapes of torchvision's parameters so that published
    weights load, and the layers that are added to it. Trunk and added layers can be called apart: where the
    trunk is frozen, what it makes of an image may be stored and trained on.
    """

    min_side_px: ClassVar[int]  # height and width below which pooling leaves nothing
    added: ClassVar[tuple[str, ...]]  # modules that no pretraining has seen
    replaced: ClassVar[tuple[str, ...]]  # beginnings of published names that have no place here
    estimate_weights: ClassVar[tuple[float, ...]] = (1.0,)  # in the loss, by estimate
    options: Any  # frozen dataclass: what makes a network of the same kind
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
        """(B, ...) features of images (B, 3, H, W): those of the main estimate first.

        Those of auxiliary estimates follow while the network is in training mode.
        """

    @abstractmethod
    def describe(self, features: tuple[Tensor, ...]) -> Tensor:
        """(B, D), what the heads `x` and `q` read, from what `trunk` gives."""

    def auxiliary(self, features: tuple[Tensor, ...]) -> tuple[Estimate, ...]:
        """Further estimates that exist for training."""
        return ()

    def regress(self, features: tuple[Tensor, ...]) -> tuple[Estimate, ...]:
        """Estimates from what `trunk` gives, the main one first."""
        descriptor = self.describe(features)
        return (self.x(descriptor), self.q(descriptor)), *self.auxiliary(features)

    def estimates(self, images: Tensor) -> tuple[Estimate, ...]:
        """All estimates from images (B, 3, H, W), for a loss with `estimate_weights`."""
        return self.regress(self.trunk(images))

    def forward(self, images: Tensor) -> Estimate:
        """x (B, 3) and q (B, 4) of images (B, 3, H, W)."""
        return self.estimates(images)[0]

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Parameters as "added" and "pretrained"; an inserted normalisation belongs to its trunk."""
        groups: dict[str, list[nn.Parameter]] = {"added": [], "pretrained": []}
        for name, parameter in self.named_parameters():
            groups["added" if self._is_added(name) else "pretrained"].append(parameter)
        return groups

    def freeze_trunk(self, frozen: bool = True) -> None:
        """Train the added layers only, or all. A frozen trunk stays in eval mode and takes no gradient."""
        self.frozen = frozen
        for parameter in self.parameter_groups()["pretrained"]:
            parameter.requires_grad_(not frozen)
        self.train(self.training)

    def train(self, mode: bool = True) -> Self:
        """As in torch, but that a frozen trunk normalises with its stored statistics and drops nothing."""
        super().train(mode)
        if self.frozen:
            for name, module in self.named_children():
                if not self._is_added(name):
                    module.eval()
        return self

    def _is_added(self, name: str) -> bool:
        return name.partition(".")[0] in self.added


def he_start(module: nn.Module, slope: float) -> None:
    """Start convolutions and linear layers so that the size of signals lasts through leaky ReLUs.

    He et al. 2015, "Delving deep into rectifiers", equation 15. Biases start at 0.
    """
    for layer in module.modules():
        if isinstance(layer, nn.Conv2d | nn.Linear):
            nn.init.kaiming_normal_(layer.weight, a=slope, nonlinearity="leaky_relu")
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)


def heads(width: int) -> tuple[nn.Linear, nn.Linear]:
    """The layers `x` (3 neurons) and `q` (4 neurons), which start near zero: at the centre of the targets."""
    x, q = nn.Linear(width, 3), nn.Linear(width, 4)
    for layer in (x, q):
        nn.init.normal_(layer.weight, std=0.01)
        nn.init.zeros_(layer.bias)
    return x, q
