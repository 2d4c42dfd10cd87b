"""Options of pose regressors in a recipe."""

from __future__ import annotations

from dataclasses import dataclass

from spn_data.errors import InputError
from spn_model.examples.augment import WarpOptions

LOSSES = ("beta", "learned", "reprojection")


@dataclass(frozen=True, kw_only=True)
class RegressionOptions:
    """Options that define the model, in addition to `network_options`."""

    network: str = "squeezeposenet"
    width: int = (
        0  # width of the network's input in px, keeping the aspect ratio; 0: the images' own
    )

    def __post_init__(self) -> None:
        if self.width != 0 and not 21 <= self.width <= 8192:
            raise InputError(f"width is {self.width}, needs to be 0 or from 21 to 8192")


@dataclass(frozen=True, kw_only=True)
class RegressionStageOptions:
    """Options of one training stage: augmentation, loss and frozen layers."""

    freeze_trunk: bool = False  # train the added layers only
    pretrained_rate: float = 1.0  # learning rate of pretrained layers relative to added ones
    loss: str = "beta"  # beta, learned or reprojection
    beta: float = 500.0  # world units that correspond to a quaternion error of length 1
    points: int = 200  # map points of an image used for the reprojection error
    augmentation: bool = True  # rotate the camera, augment photometrically
    tilt_deg: float = 20.0  # largest rotation about each image axis
    roll_deg: float = 20.0  # largest rotation about the optical axis
    look: bool = True  # augment exposure, colour, sharpness and noise, and occlude parts
    dropout: bool = True
    batch_statistics: bool = False  # normalise with batch statistics, not the stored ones
    cached_features: int = 0  # augmented variants of each image whose features are cached

    def __post_init__(self) -> None:
        if self.loss not in LOSSES:
            raise InputError(f"loss is {self.loss!r}, needs to be one of {', '.join(LOSSES)}")
        for name, low, high in (
            ("pretrained_rate", 0, 10),
            ("beta", 0, 1e6),
            ("points", 1, 100_000),
            ("tilt_deg", 0, 60),
            ("roll_deg", 0, 180),
            ("cached_features", 0, 10_000),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise InputError(f"{name} is {value}, needs to be from {low} to {high}")
        if self.cached_features and not self.freeze_trunk:
            raise InputError(
                "cached_features needs freeze_trunk: features change while the trunk is trained"
            )
        if self.cached_features > 1 and not self.augmentation:
            raise InputError(
                "cached_features is above 1 without augmentation: all variants would be identical"
            )

    @property
    def warp(self) -> WarpOptions | None:
        """Limits of the camera's rotation; None without geometric augmentation."""
        if not self.augmentation or self.tilt_deg == self.roll_deg == 0:
            return None
        return WarpOptions(tilt_deg=self.tilt_deg, roll_deg=self.roll_deg)
