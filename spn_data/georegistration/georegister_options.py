"""Options of the georegistration and default accuracies of the telemetry sources."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from spn_data.geometry.geodesy import GeoOrigin, HeightReference

# Standard deviation (horizontal per axis, vertical) in metres of one fix if the source states none.
# Consumer GNSS without corrections, chosen as typical and not measured; heights in photos are often
# barometric, hence the larger values.
DEFAULT_SIGMA_M: dict[str, tuple[float, float]] = {
    "dji-srt": (1.0, 1.5),
    "gopro": (2.0, 4.0),
    "gpx": (2.0, 4.0),
    "exif": (1.0, 2.0),
    "nmea": (2.0, 4.0),
    "fit": (3.0, 5.0),
}
UNKNOWN_KIND_SIGMA_M = (1.5, 2.5)

# Standard deviation (horizontal per axis, vertical) in metres of the part of a fix's error that all flights
# of a day share, because orbits, clocks and atmosphere change over hours: no number of fixes averages it.
GNSS_BIAS_M: dict[str, tuple[float, float]] = {"gopro": (1.5, 3.0), "gpx": (1.5, 3.0)}
USUAL_GNSS_BIAS_M = (1.0, 2.5)
# Of a height above take-off: the receiver's bias cancels, the drift of the air pressure remains.
RELATIVE_HEIGHT_BIAS_M = 1.0
# A source that states less than its kind's sigma has a bias smaller in proportion, down to that of a
# differential fix: its base and its antenna.
LEAST_GNSS_BIAS_M = (0.02, 0.03)
# This share of the bias drifts, with this correlation time.
BIAS_DRIFT_SHARE = 0.5
BIAS_DRIFT_TIME_S = 1200.0

# A fix with a smaller horizontal sigma is a carrier-phase differential one (RTK, PPK). Its errors follow a
# different process from those of the same receiver without corrections.
RTK_SIGMA_M = 0.15


class Heights(StrEnum):
    """Kind of heights to use from the telemetry."""

    AUTO = "auto"  # above take-off if known, otherwise absolute
    RELATIVE = "relative"  # above take-off
    ABSOLUTE = "absolute"  # what the source calls absolute


@dataclass(frozen=True, kw_only=True)
class GeoregisterOptions:
    """Noise model, robust estimation and acceptance limits of the georegistration.

    Attributes
    ----------
    gnss_sigma_m : tuple of float, optional
        Sigma of one fix in metres, horizontal per axis and vertical. None: the sigma stated by the source,
        or `DEFAULT_SIGMA_M` if it states none.
    gnss_bias_m : tuple of float, optional
        Sigma in metres, horizontal per axis and vertical, of the error that all fixes of a day share. None:
        that of the source's kind, less if the source states a smaller sigma than its kind has.
    correlation_time_s : float
        Correlation time of the GNSS errors within a flight (first-order Gauss-Markov process).
    heights : Heights
        Kind of heights to use.
    height_reference : HeightReference, optional
        Reference of absolute heights if the source does not state it.
    takeoff_alt_m : float, optional
        Height of the take-off point above `height_reference`.
    same_takeoff : bool, optional
        Whether all flights took off at the same height. None: decided by a test on the data.
    same_takeoff_sigma_m : float
        Sigma of the height difference between take-offs assumed equal.
    use_gimbal : bool
        Whether gimbal angles are used.
    gimbal_bias_deg : float
        Sigma of a flight's constant gimbal error in pitch and in roll.
    gimbal_agreement_deg : float
        A frame is dropped if its gimbal direction differs by more than this from the rest of its flight.
    model_bend_deg : float
        Sigma of the tilt between the model's rotations and its positions.
    level_camera_sigma_deg : float
        Sigma of the roll of cameras without gimbal angles, both per flight and per frame.
    ransac_sigmas : float
        Inlier threshold of RANSAC in sigma.
    ransac_samples : int
        Number of RANSAC samples.
    seed : int
        Random seed.
    min_fixes : int
        Minimum number of frames with a fix.
    max_tilt_sigma_deg, max_heading_sigma_deg, max_scale_sigma : float
        The fit is rejected if tilt, heading or scale (relative) are less certain than this.
    origin : GeoOrigin, optional
        Origin to keep, if an existing area is extended.
    """

    gnss_sigma_m: tuple[float, float] | None = None
    gnss_bias_m: tuple[float, float] | None = None
    correlation_time_s: float = 60.0
    heights: Heights = Heights.AUTO
    height_reference: HeightReference | None = None
    takeoff_alt_m: float | None = None
    same_takeoff: bool | None = None
    same_takeoff_sigma_m: float = 0.3
    use_gimbal: bool = True
    gimbal_bias_deg: float = 0.3
    gimbal_agreement_deg: float = 5.0
    model_bend_deg: float = 0.02
    level_camera_sigma_deg: float = 6.0
    ransac_sigmas: float = 3.0
    ransac_samples: int = 600
    seed: int = 0
    min_fixes: int = 6
    max_tilt_sigma_deg: float = 3.0
    max_heading_sigma_deg: float = 10.0
    max_scale_sigma: float = 0.15
    origin: GeoOrigin | None = None

    def __post_init__(self) -> None:
        if self.gnss_sigma_m is not None and not all(
            np.isfinite(s) and s > 0 for s in self.gnss_sigma_m
        ):
            raise ValueError(f"gnss_sigma_m must be positive, got {self.gnss_sigma_m}")
        if self.gnss_bias_m is not None and not all(
            np.isfinite(b) and b >= 0 for b in self.gnss_bias_m
        ):
            raise ValueError(f"gnss_bias_m must not be negative, got {self.gnss_bias_m}")
        if not self.correlation_time_s > 0:
            raise ValueError(f"correlation_time_s must be positive, got {self.correlation_time_s}")


def default_sigma_m(kind: str) -> np.ndarray:
    """Return the default sigma (3,) east, north, up in metres for a kind of source that states none."""
    horizontal, vertical = DEFAULT_SIGMA_M.get(kind, UNKNOWN_KIND_SIGMA_M)
    return np.array([horizontal, horizontal, vertical])


def default_bias_m(kind: str) -> np.ndarray:
    """Return the usual bias sigma (3,) east, north, up in metres of positions of a kind of source."""
    horizontal, vertical = GNSS_BIAS_M.get(kind, USUAL_GNSS_BIAS_M)
    return np.array([horizontal, horizontal, vertical])
