"""What the user may say of a georegistration, and what is assumed of each kind of source."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from spn_data.geometry.geodesy import GeoOrigin, HeightReference

# Standard deviation (horizontal per axis, vertical) in metres of one fix of a source that states none.
# Consumer GNSS without correction; heights of photos are as often barometric as not, hence wider.
DEFAULT_SIGMA_M: dict[str, tuple[float, float]] = {
    "dji-srt": (1.0, 1.5),
    "gopro": (2.0, 4.0),
    "gpx": (2.0, 4.0),
    "exif": (1.0, 2.0),
}
UNKNOWN_KIND_SIGMA_M = (1.5, 2.5)

# Below this horizontal sigma a fix is one of differential carrier phase (RTK, PPK), whose errors are
# another process than those of the same receiver without it.
RTK_SIGMA_M = 0.15


class Heights(StrEnum):
    """Which of a record's heights are used."""

    AUTO = "auto"  # above take-off where known, else absolute
    RELATIVE = "relative"  # above take-off
    ABSOLUTE = "absolute"  # what the source calls absolute


@dataclass(frozen=True, kw_only=True)
class GeoregisterOptions:
    """How fixes and gimbal angles are believed."""

    # Sigma of one fix, horizontal per axis and vertical; None: the source's own, else DEFAULT_SIGMA_M.
    gnss_sigma_m: tuple[float, float] | None = None
    correlation_time_s: float = 60.0  # over which GNSS errors of one flight stay alike
    heights: Heights = Heights.AUTO
    height_reference: HeightReference | None = (
        None  # of absolute heights, where the source does not say
    )
    takeoff_alt_m: float | None = None  # height of the take-off point above `height_reference`
    same_takeoff: bool | None = None  # all flights took off at one height; None: tested
    same_takeoff_sigma_m: float = 0.3  # between take-offs that pass as one
    use_gimbal: bool = True
    gimbal_bias_deg: float = 0.3  # sigma of a flight's constant error of pitch and of roll
    gimbal_agreement_deg: float = (
        5.0  # frames whose gimbal differs by more from the flight's others are dropped
    )
    model_bend_deg: float = 0.02  # sigma of the tilt between a model's rotations and its positions
    level_camera_sigma_deg: float = (
        6.0  # roll of cameras without gimbal angles: of a flight, and of a frame
    )
    ransac_sigmas: float = 3.0
    ransac_samples: int = 600
    seed: int = 0
    min_fixes: int = 6
    max_tilt_sigma_deg: float = 3.0  # a model whose tilt is known worse than this is refused
    max_heading_sigma_deg: float = 10.0
    max_scale_sigma: float = 0.15  # relative
    origin: GeoOrigin | None = None  # keep this origin (an area that is extended)

    def __post_init__(self) -> None:
        if self.gnss_sigma_m is not None and not all(
            np.isfinite(s) and s > 0 for s in self.gnss_sigma_m
        ):
            raise ValueError(f"gnss_sigma_m must be positive, got {self.gnss_sigma_m}")
        if not self.correlation_time_s > 0:
            raise ValueError(f"correlation_time_s must be positive, got {self.correlation_time_s}")


def default_sigma_m(kind: str) -> np.ndarray:
    """(3,) sigma east, north, up in metres assumed for a kind of source that states none."""
    horizontal, vertical = DEFAULT_SIGMA_M.get(kind, UNKNOWN_KIND_SIGMA_M)
    return np.array([horizontal, horizontal, vertical])
