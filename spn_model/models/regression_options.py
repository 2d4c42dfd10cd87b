"""What a recipe may choose about pose regressors."""

from __future__ import annotations

from dataclasses import dataclass

from spn_data.errors import InputError
from spn_model.examples.augment import WarpOptions

LOSSES = ("beta", "learned", "reprojection")


@dataclass(frozen=True, kw_only=True)
class RegressionOptions:
    """What makes a member; network_options stand beside these."""

    network: str = "squeezeposenet"
    width: int = (
        0  # px of the images that the network is given, height in proportion; 0: as they are
    )

    def __post_init__(self) -> None:
        if self.width != 0 and not 21 <= self.width <= 8192:
            raise InputError(f"width is {self.width}, needs to be 0 or to lie from 21 to 8192")


@dataclass(frozen=True, kw_only=True)
class RegressionStageOptions:
    """How one stage of a training varies its images, and what it descends."""

    freeze_trunk: bool = False  # train the added layers alone
    pretrained_rate: float = 1.0  # rate of the pretrained layers against that of the added ones
    loss: str = "beta"  # beta, learned, reprojection
    beta: float = 500.0  # world units that an error of 1 of the quaternion's length counts
    points: int = 200  # map points of an image that the reprojection error is taken at
    augmentation: bool = True  # turn the camera, change the look
    tilt_deg: float = 20.0  # largest turn about each of the image's axes
    roll_deg: float = 20.0  # and about the optical axis
    look: bool = True  # change exposure, colour, sharpness, noise, and hide parts
    dropout: bool = True
    batch_statistics: bool = False  # normalise by each batch, not by the stored statistics
    cached_features: int = 0  # variants of each image whose features are stored; 0: none are

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
                raise InputError(f"{name} is {value}, needs to lie from {low} to {high}")
        if self.cached_features and not self.freeze_trunk:
            raise InputError(
                "cached_features needs freeze_trunk: features of a trunk that is trained change"
            )
        if self.cached_features > 1 and not self.augmentation:
            raise InputError(
                "cached_features is above 1 without augmentation: all variants would be one"
            )

    @property
    def warp(self) -> WarpOptions | None:
        if not self.augmentation or self.tilt_deg == self.roll_deg == 0:
            return None
        return WarpOptions(tilt_deg=self.tilt_deg, roll_deg=self.roll_deg)
