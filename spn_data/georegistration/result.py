"""Result of a georegistration, and its JSON form (geo.json)."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from spn_data.errors import FormatError
from spn_data.geometry.geodesy import GeoOrigin, HeightReference
from spn_data.geometry.json_values import numbers
from spn_data.geometry.pose import Similarity
from spn_data.georegistration.control import PointResidual
from spn_data.georegistration.cross_validation import HeldOut
from spn_data.georegistration.uncertainty import Uncertainty
from spn_data.storage.json_files import DAMAGE, finite_or_none, kind_of, number_or

VERSION = 1


@dataclass(frozen=True)
class FitSummary:
    """Summary statistics of a georegistration, in metres.

    RMSE are over inliers. CE90 and LE90 (radius and height that contain 90 % of the residuals) are over all
    fixes.
    """

    frames: int
    fixes: int
    outliers: int
    effective_fixes: float
    horizontal_rmse_m: float
    vertical_rmse_m: float
    ce90_m: float
    le90_m: float
    gravity_rms_deg: float


@dataclass(frozen=True, eq=False)
class GeoFit:
    """Georegistration of a model.

    Attributes
    ----------
    world_from_model : Similarity
        From the model's gauge to East-North-Up metres at `origin`.
    origin : GeoOrigin
        Origin of the world.
    vertical_offsets_m : dict of str to float
        By flight: what to add to its heights to obtain up coordinates. For heights above take-off this is the
        height of the take-off point above the zero (the first flight's, if the take-offs differ).
    residuals_m : ndarray, shape (N, 3)
        Fix minus fitted centre, less the bias that ground control shows, east, north, up; NaN if unknown.
    outlier : ndarray of bool, shape (N,)
        Frames whose fix is an outlier.
    gravity_deg : ndarray, shape (N, 2)
        Gimbal minus fit, about the image's x axis (right) and about the viewing direction.
    gimbal_bias_deg : dict of str to tuple of float
        By flight: constant gimbal error about the camera's x, y, z axes.
    noise_m : dict of str to tuple of float
        By kind of fix: estimated sigma of (bias, white noise).
    uncertainty : Uncertainty
        Uncertainty of the georegistration.
    held_out_blocks, held_out_flights : HeldOut
        Cross-validation by time block and by flight.
    summary : FitSummary
        Summary statistics.
    observations : tuple of str
        Kinds of observations used: "fixes", "heights", "gimbal", "level cameras".
    notes : tuple of str
        Sentences for the user.
    control : tuple of PointResidual
        Residuals of the surveyed points, in the order of their file.
    """

    world_from_model: Similarity
    origin: GeoOrigin
    vertical_offsets_m: dict[str, float]
    residuals_m: np.ndarray
    outlier: np.ndarray
    gravity_deg: np.ndarray
    gimbal_bias_deg: dict[str, tuple[float, float, float]]
    noise_m: dict[str, tuple[float, float]]
    uncertainty: Uncertainty
    held_out_blocks: HeldOut
    held_out_flights: HeldOut
    summary: FitSummary
    observations: tuple[str, ...]
    notes: tuple[str, ...]
    control: tuple[PointResidual, ...] = ()

    @property
    def height_reference(self) -> HeightReference:
        """Reference surface of the origin's height."""
        return self.origin.height_reference

    def to_json(self) -> dict[str, Any]:
        """Convert to plain values for json.dumps; NaN and infinity become null.

        The fields are described in docs/georegistration.md.
        """
        uncertainty = self.uncertainty
        value = {
            "version": VERSION,
            "origin": asdict(self.origin),
            "world_from_model": {
                **self.world_from_model.to_json(),
                "translation_m": self.world_from_model.translation,  # the name in version 0.1
            },
            "vertical_offsets_m": self.vertical_offsets_m,
            "gimbal_bias_deg": self.gimbal_bias_deg,
            "noise_m": self.noise_m,
            "uncertainty": {
                "horizontal_m": uncertainty.horizontal_m,
                "vertical_m": uncertainty.vertical_m,
                "tilt_deg": uncertainty.tilt_deg,
                "heading_deg": uncertainty.heading_deg,
                "scale": uncertainty.scale,
                "middle_m": uncertainty.middle_m,
                "covariance": uncertainty.covariance,
            },
            "held_out_blocks": asdict(self.held_out_blocks),
            "held_out_flights": asdict(self.held_out_flights),
            "summary": asdict(self.summary),
            "observations": list(self.observations),
            "notes": list(self.notes),
            "residuals_m": self.residuals_m,
            "outlier": self.outlier,
            "gravity_deg": self.gravity_deg,
            "control": [asdict(point) for point in self.control],
        }
        return _plain(value)

    @classmethod
    def from_json(cls, value: dict[str, Any]) -> GeoFit:
        """Restore from the output of `to_json`.

        Raises FormatError for another version, or for missing or malformed fields.
        """
        version = value.get("version")
        if version != VERSION:
            raise FormatError(
                f"georegistration has format version {version!r}; this program reads version {VERSION}"
            )
        try:
            origin, similarity = value["origin"], value["world_from_model"]
            stated = value["uncertainty"]
            return cls(
                Similarity.from_json({**similarity, "translation": similarity["translation_m"]}),
                GeoOrigin(
                    float(numbers(origin["lat_deg"])),
                    float(numbers(origin["lon_deg"])),
                    float(numbers(origin["alt_m"])),
                    HeightReference(origin["height_reference"]),
                ),
                {name: number_or(m) for name, m in value["vertical_offsets_m"].items()},
                _array(value["residuals_m"], 3),
                _flags(value["outlier"]),
                _array(value["gravity_deg"], 2),
                {name: _triple(v) for name, v in value["gimbal_bias_deg"].items()},
                {name: (number_or(v[0]), number_or(v[1])) for name, v in value["noise_m"].items()},
                Uncertainty(
                    number_or(stated["horizontal_m"]),
                    number_or(stated["vertical_m"], math.inf),
                    number_or(stated["tilt_deg"]),
                    number_or(stated["heading_deg"]),
                    number_or(stated["scale"]),
                    _array(stated["covariance"], 7, math.inf),
                    _array([stated["middle_m"]], 3)[0],
                ),
                HeldOut(**_numbers(value["held_out_blocks"])),
                HeldOut(**_numbers(value["held_out_flights"])),
                FitSummary(**_numbers(value["summary"])),
                _texts(value["observations"]),
                _texts(value["notes"]),
                tuple(_point(p) for p in value.get("control", ())),
            )
        except DAMAGE as error:
            raise FormatError(f"damaged georegistration: {type(error).__name__} {error}") from error


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.bool_ | bool):
        return bool(value)
    if isinstance(value, np.integer | int):
        return int(value)
    if isinstance(value, np.floating | float):
        return finite_or_none(value)
    return str(value)


def _point(value: dict[str, Any]) -> PointResidual:
    return PointResidual(
        str(value["name"]),
        str(value["role"]),
        int(value["marks"]),
        _triple(value["residual_m"]),
        _triple(value["sigma_m"]),
        number_or(value["reprojection_px"]),
        bool(value["is_outlier"]),
    )


def _triple(value: Any) -> tuple[float, float, float]:
    return number_or(value[0]), number_or(value[1]), number_or(value[2])


def _array(rows: Any, width: int, unknown: float = math.nan) -> np.ndarray:
    if not isinstance(rows, list):
        raise TypeError(f"{kind_of(rows)} instead of a list")
    flat = [[number_or(v, unknown) for v in row] for row in rows]
    return np.array(flat, dtype=np.float64).reshape(len(flat), width)


def _numbers(fields: dict[str, Any]) -> dict[str, Any]:
    counts = ("folds", "frames", "fixes", "outliers")
    return {k: _count(v) if k in counts else number_or(v) for k, v in fields.items()}


def _count(value: Any) -> int:
    if type(value) is not int or value < 0:
        raise TypeError(f"{value!r:.40} instead of a count")
    return value


def _flags(values: Any) -> np.ndarray:
    if not isinstance(values, list) or not all(isinstance(v, bool) for v in values):
        raise TypeError("not a list of true and false")
    return np.array(values, dtype=bool)


def _texts(values: Any) -> tuple[str, ...]:
    if not isinstance(values, list) or not all(isinstance(v, str) for v in values):
        raise TypeError("not a list of texts")
    return tuple(values)
