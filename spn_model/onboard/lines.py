"""Localized images as lines of text: CSV with a header, or JSON lines."""

from __future__ import annotations

import csv
import io
import json
import math

import numpy as np

from spn_data.geometry.geodesy import GeoOrigin
from spn_model.onboard.localizer import Located

_UPPER = list(zip(*np.triu_indices(6), strict=True))
COLUMNS = (
    *("source", "frame", "time_s", "reason", "x", "y", "z", "qw", "qx", "qy", "qz"),
    *("lat_deg", "lon_deg", "alt_m"),
    *(f"cov_{i}{j}" for i, j in _UPPER),
)


def geographic(located: Located, origin: GeoOrigin | None) -> np.ndarray:
    """Return latitude and longitude in degrees and height in metres, (3,); NaN where unknown.

    The height refers to the same surface as the height of the origin.
    """
    if origin is None or located.reason:
        return np.full(3, np.nan)
    return origin.wgs84_from_enu(located.poses.centers)[0]


def csv_header() -> str:
    """Return the header line with the names of `COLUMNS`."""
    return ",".join(COLUMNS)


def csv_line(
    source: str, frame: int, time_s: float, located: Located, origin: GeoOrigin | None
) -> str:
    """Return one CSV line with the cells of `COLUMNS`, empty where unknown.

    The covariance is given by its upper triangle.
    """
    values = [
        *located.poses.centers[0],
        *located.poses.quats_wxyz[0],
        *geographic(located, origin),
        *(located.covariance[i, j] for i, j in _UPPER),
    ]
    text = io.StringIO()
    row = [source, frame, _cell(time_s, 6), located.reason]
    places = [*[6] * 3, *[9] * 4, 9, 9, 4]
    cells = [_cell(v, p) for v, p in zip(values[:10], places, strict=True)]
    csv.writer(text, lineterminator="").writerow(
        [*row, *cells, *("" if math.isnan(v) else f"{v:.9g}" for v in values[10:])]
    )
    return text.getvalue()


def json_line(
    source: str, frame: int, time_s: float, located: Located, origin: GeoOrigin | None
) -> str:
    """Return one JSON object; unknown values are null."""
    lat_deg, lon_deg, alt_m = geographic(located, origin)
    return json.dumps(
        {
            "source": source,
            "frame": frame,
            "time_s": _known(time_s),
            "reason": located.reason,
            "center": _list(located.poses.centers[0]),
            "quat_wxyz": _list(located.poses.quats_wxyz[0]),
            "covariance": None
            if np.isnan(located.covariance).any()
            else located.covariance.tolist(),
            "lat_deg": _known(lat_deg),
            "lon_deg": _known(lon_deg),
            "alt_m": _known(alt_m),
        },
        allow_nan=False,
    )


def _cell(value: float, places: int) -> str:
    return "" if math.isnan(value) else f"{value:.{places}f}"


def _known(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _list(values: np.ndarray) -> list[float] | None:
    return values.tolist() if np.isfinite(values).all() else None
