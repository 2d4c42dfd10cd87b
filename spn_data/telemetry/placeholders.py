"""Values that a drone writes without having measured them: the same zero in every record."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from spn_data.geometry.geodesy import metres_from_first_fix
from spn_data.telemetry.track import Telemetry

_MIN_MOVE_M = 5.0  # a drone that has not moved may stand on the ground, at a height of 0
_HEIGHTS = {"rel_alt_m": "height above take-off", "abs_alt_m": "absolute height"}


def without_placeholders(telemetry: Telemetry) -> Telemetry:
    """Leave out gimbal angles and heights that are exactly zero in all records.

    Parameters
    ----------
    telemetry : Telemetry
        The track of one file, or of one folder of photos.

    Returns
    -------
    Telemetry
        The same track. A camera that hangs in a flying drone never points exactly level and north in all
        records, and no flight from place to place stays at exactly 0.0 m: such columns become unknown, with
        a note for each.
    """
    notes: list[str] = []
    changed: dict[str, np.ndarray] = {}
    angles = telemetry.gimbal_deg
    known = np.isfinite(angles).all(axis=1)
    if known.any() and not angles[known].any():
        changed["gimbal_deg"] = np.full_like(angles, np.nan)
        notes.append(
            f"all gimbal angles are exactly 0 in all {known.sum()} records: they were not measured and "
            "are left out"
        )
    for column, name in _HEIGHTS.items():
        heights = getattr(telemetry, column)
        known = np.isfinite(heights)
        if known.sum() > 1 and not heights[known].any() and _extent_m(telemetry) > _MIN_MOVE_M:
            changed[column] = np.full_like(heights, np.nan)
            notes.append(
                f"the {name} is exactly 0 in all {known.sum()} records: it was not measured and is left out"
            )
    if not changed:
        return telemetry
    return replace(telemetry, **changed, notes=(*telemetry.notes, *notes))  # type: ignore[arg-type]


def _extent_m(telemetry: Telemetry) -> float:
    """Return the largest distance from the first fix; 0 without a fix."""
    metres = metres_from_first_fix(telemetry.lat_lon_deg[telemetry.has_fix])
    return float(np.hypot(*metres.T).max()) if len(metres) else 0.0
