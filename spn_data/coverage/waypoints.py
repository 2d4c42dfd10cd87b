"""Planned waypoints in CSV: position and viewing direction of the camera."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spn_data.errors import InputError
from spn_data.geometry.geodesy import GeoOrigin, HeightReference
from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import rotations_from_angles
from spn_data.telemetry.textfile import csv_rows, read_text

MAX_WAYPOINTS = 100_000
_MAX_BYTES = 50_000_000
_AGREE_M = 0.5  # tolerance between two positions stated in one row
_KEY = re.compile(r"[\w.\- ]{1,100}")

_ENU = ("x_m", "y_m", "z_m")
_HEIGHTS = {
    "alt_ellipsoid_m": HeightReference.ELLIPSOID,
    "alt_amsl_m": HeightReference.AMSL,
    "height_takeoff_m": HeightReference.TAKEOFF,
}
# Smallest and largest value of each numeric column.
_BOUNDS: dict[str, tuple[float, float]] = {
    **dict.fromkeys(_ENU, (-1e6, 1e6)),
    "lat_deg": (-90, 90),
    "lon_deg": (-180, 180),
    **dict.fromkeys(_HEIGHTS, (-1e5, 1e5)),
    "heading_deg": (-360, 360),
    "pitch_deg": (-90, 90),
    "roll_deg": (-180, 180),
}
_ALIASES = {"x": "x_m", "y": "y_m", "z": "z_m", "lat": "lat_deg", "lon": "lon_deg"}
_ALIASES |= {"heading": "heading_deg", "pitch": "pitch_deg", "roll": "roll_deg"}
_UNKNOWN = {"", "nan", "n/a", "na", "null", "none", "-"}


@dataclass(frozen=True, eq=False)
class WaypointFrame:
    """Georeference of an area, as needed for waypoints.

    Attributes
    ----------
    origin : GeoOrigin
        Origin of the East-North-Up frame.
    takeoff_up_m : float, optional
        Up coordinate of the take-off point; None if unknown.
    """

    origin: GeoOrigin
    takeoff_up_m: float | None = None

    def height_offset(self, reference: HeightReference) -> float | None:
        """Return what to add to heights above `reference` to obtain those of the origin; None if unknown."""
        if reference is HeightReference.TAKEOFF and self.takeoff_up_m is not None:
            return self.origin.alt_m + self.takeoff_up_m
        return 0.0 if reference is self.origin.height_reference else None

    def columns(self) -> dict[str, HeightReference]:
        """Return the height columns that can be used in this area."""
        return {name: ref for name, ref in _HEIGHTS.items() if self.height_offset(ref) is not None}


@dataclass(frozen=True, eq=False)
class Waypoints:
    """Planned poses in an area's East-North-Up frame.

    Attributes
    ----------
    lines : ndarray of int, shape (N,)
        Line number in the file.
    poses : Poses
        N planned poses.
    cameras : ndarray of str, shape (N,)
        Key of the camera, empty if the file names none.
    """

    lines: np.ndarray
    poses: Poses
    cameras: np.ndarray

    def __len__(self) -> int:
        return len(self.lines)


def read_waypoints(path: Path | str, place: WaypointFrame) -> Waypoints:
    """Read waypoints from CSV with a header row.

    Parameters
    ----------
    path : path-like
        CSV file with the columns described in docs/coverage.md; other columns are ignored.
    place : WaypointFrame
        Georeference of the area.

    Returns
    -------
    Waypoints
        One pose per row.

    Raises
    ------
    InputError
        With the line number, for values that are missing, not a number or out of bounds, for heights with a
        reference the area does not know, and for rows whose two positions disagree.
    """
    rows = csv_rows(read_text(path, max_bytes=_MAX_BYTES), path, "waypoint")
    header_line, header = next(rows, (1, []))
    columns = _columns(header, header_line, path)
    heights = _usable_heights(columns, place, header_line, path)
    lines: list[int] = []
    values: list[dict[str, float]] = []
    cameras: list[str] = []
    for line, cells in rows:
        if len(lines) == MAX_WAYPOINTS:
            raise InputError(f"has more than {MAX_WAYPOINTS:,} rows", path=path, line=line)
        try:
            if len(cells) != len(header):
                raise ValueError(f"{len(cells)} cells, but the header has {len(header)}")
            values.append(
                {name: _number(name, cells[k]) for name, k in columns.items() if name != "camera"}
            )
            cameras.append(_key(cells[columns["camera"]]) if "camera" in columns else "")
        except ValueError as error:
            raise InputError(str(error), path=path, line=line) from error
        lines.append(line)
    if not lines:
        raise InputError("has a header but no rows", path=path, line=header_line)
    table = {name: np.array([row[name] for row in values]) for name in values[0]}
    for name in ("heading_deg", "pitch_deg"):
        _reject(np.isnan(table[name]), f"{name} is missing", lines, path)
    angles = np.stack(
        [table["heading_deg"], table["pitch_deg"], np.nan_to_num(_column(table, "roll_deg"))],
        axis=1,
    )
    centers = _centers(table, heights, place, lines, path)
    return Waypoints(
        np.array(lines, dtype=np.int64),
        Poses.from_rotations(centers, rotations_from_angles(angles)),
        np.array(cameras, dtype=np.str_),
    )


def waypoint_columns(
    centers: np.ndarray, angles_deg: np.ndarray, place: WaypointFrame
) -> dict[str, list[str]]:
    """Format waypoints as CSV columns that `read_waypoints` can read.

    Parameters
    ----------
    centers : ndarray, shape (N, 3)
        Positions in the area's East-North-Up frame.
    angles_deg : ndarray, shape (N, 3)
        Heading, pitch and roll in degrees.
    place : WaypointFrame
        Georeference of the area.

    Returns
    -------
    dict of str to list of str
        Cells by column: metres with 3 decimals, latitude and longitude with 9, angles with 3.
    """
    geodetic = place.origin.wgs84_from_enu(centers)
    columns = {
        "lat_deg": [f"{v:.9f}" for v in geodetic[:, 0]],
        "lon_deg": [f"{v:.9f}" for v in geodetic[:, 1]],
    }
    for name, reference in place.columns().items():
        offset = place.height_offset(reference)
        columns[name] = [f"{v:.3f}" for v in geodetic[:, 2] - (offset or 0.0)]
    for k, name in enumerate(_ENU):
        columns[name] = [f"{v:.3f}" for v in centers[:, k]]
    # Round first: otherwise 359.9996 would be printed as 360.000, and a roll of -1e-14 as -0.000.
    angles = np.round(angles_deg, 3) + 0.0
    columns["heading_deg"] = [f"{v % 360:.3f}" for v in angles[:, 0]]
    columns["pitch_deg"] = [f"{v:.3f}" for v in angles[:, 1]]
    columns["roll_deg"] = [f"{v:.3f}" for v in angles[:, 2]]
    return columns


def _columns(header: list[str], line: int, path: Path | str) -> dict[str, int]:
    """Return the index of each known column."""
    names = [_ALIASES.get(cell.lower(), cell.lower()) for cell in header]
    known = {name: names.index(name) for name in (*_BOUNDS, "camera") if name in names}
    twice = [name for name in known if names.count(name) > 1]
    if twice:
        raise InputError(f"has the column {twice[0]} twice", path=path, line=line)
    missing = [name for name in ("heading_deg", "pitch_deg") if name not in known]
    has_enu = known.keys() >= set(_ENU)
    has_wgs84 = known.keys() >= {"lat_deg", "lon_deg"} and any(h in known for h in _HEIGHTS)
    if not (has_enu or has_wgs84):
        missing.insert(0, f"a position (lat_deg, lon_deg and {' or '.join(_HEIGHTS)}; or x, y, z)")
    if missing:
        raise InputError(
            f"has no column for {' and '.join(missing)}; "
            f"found {', '.join(header)[:300] or 'none'} (see docs/coverage.md)",
            path=path,
            line=line,
        )
    return known


def _usable_heights(
    columns: dict[str, int], place: WaypointFrame, line: int, path: Path | str
) -> list[str]:
    """Return the height columns whose reference the area knows."""
    if not columns.keys() >= {"lat_deg", "lon_deg"}:
        return []
    usable = [name for name in place.columns() if name in columns]
    if not usable and not columns.keys() >= set(_ENU):
        found = ", ".join(name for name in _HEIGHTS if name in columns)
        expected = " or ".join(place.columns()) or "x, y, z (its height reference is unknown)"
        raise InputError(
            f"has heights as {found}, but the area needs {expected}; no geoid model is built in",
            path=path,
            line=line,
        )
    return usable


def _number(name: str, cell: str) -> float:
    """Parse a cell; NaN if empty. Raises ValueError if it is not a number within the column's bounds."""
    if cell.lower() in _UNKNOWN:
        return math.nan
    try:
        value = math.inf if "_" in cell else float(cell)  # Python would accept 1_0 as 10
    except ValueError:
        value = math.inf
    if not math.isfinite(value):
        raise ValueError(f"{name} is {cell[:40]!r}, not a number")
    low, high = _BOUNDS[name]
    if not low <= value <= high:
        raise ValueError(f"{name} is {cell[:40]}, outside {low:g} to {high:g}")
    return value


def _key(cell: str) -> str:
    if cell and not _KEY.fullmatch(cell):
        raise ValueError(f"camera is {cell[:40]!r}, which is not a valid camera key")
    return cell


def _centers(
    table: dict[str, np.ndarray],
    heights: list[str],
    place: WaypointFrame,
    lines: list[int],
    path: Path | str,
) -> np.ndarray:
    """Return the positions (N, 3); the first one stated in a row is used, the others must agree with it."""
    stated = [np.stack([_column(table, name) for name in _ENU], axis=1)]
    for name in heights:
        offset = place.height_offset(_HEIGHTS[name])
        alt = table[name] + (offset or 0.0)
        lat_lon_alt = np.stack([table["lat_deg"], table["lon_deg"], alt], axis=1)
        stated.append(place.origin.enu_from_wgs84(lat_lon_alt))
    centers = stated[0]
    unknown = np.isnan(centers)
    half = unknown.any(axis=1) & ~unknown.all(axis=1)
    _reject(half, "has no position: x, y, z are incomplete", lines, path)
    for other in stated[1:]:
        apart = np.linalg.norm(other - centers, axis=1)
        _reject(
            apart > _AGREE_M,
            "its two positions differ: x, y, z and latitude, longitude, height do not refer to the same "
            "origin, or only one of them was edited",
            lines,
            path,
        )
        centers = np.where(np.isnan(centers).any(axis=1, keepdims=True), other, centers)
    _reject(np.isnan(centers).any(axis=1), "has no position", lines, path)
    return centers


def _column(table: dict[str, np.ndarray], name: str) -> np.ndarray:
    """Return a column (N,); NaN if it is missing."""
    some = next(iter(table.values()))
    return table.get(name, np.full(len(some), np.nan))


def _reject(bad: np.ndarray, why: str, lines: list[int], path: Path | str) -> None:
    """Raise InputError for the first bad row, if there is one."""
    rows = np.flatnonzero(bad)
    if len(rows):
        raise InputError(why, path=path, line=lines[rows[0]])
