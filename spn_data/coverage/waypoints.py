"""Planned waypoints as a CSV file: where a camera is to be and where it is to look."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spn_data.errors import InputError
from spn_data.geometry.geodesy import GeoOrigin, HeightReference
from spn_data.geometry.pose import Poses, rotations_from_angles
from spn_data.telemetry.textfile import csv_rows, read_text

MAX_WAYPOINTS = 100_000
_MAX_BYTES = 50_000_000
_AGREE_M = 0.5  # between positions that one row states in two ways
_KEY = re.compile(r"[\w.\- ]{1,100}")

_ENU = ("x_m", "y_m", "z_m")
_HEIGHTS = {
    "alt_ellipsoid_m": HeightReference.ELLIPSOID,
    "alt_amsl_m": HeightReference.AMSL,
    "height_takeoff_m": HeightReference.TAKEOFF,
}
# Least and greatest value of each column of numbers.
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
    """Where an area lies, as far as waypoints need it.

    origin : of its East-North-Up frame. takeoff_up_m : up coordinate of the point from which heights above
    take-off count; None where that is not known.
    """

    origin: GeoOrigin
    takeoff_up_m: float | None = None

    def zero_of(self, reference: HeightReference) -> float | None:
        """What to add to heights of a reference to get those of the origin; None where that is not known."""
        if reference is HeightReference.TAKEOFF and self.takeoff_up_m is not None:
            return self.origin.alt_m + self.takeoff_up_m
        return 0.0 if reference is self.origin.height_reference else None

    def columns(self) -> dict[str, HeightReference]:
        """The columns of heights that can be used here."""
        return {name: ref for name, ref in _HEIGHTS.items() if self.zero_of(ref) is not None}


@dataclass(frozen=True, eq=False)
class Waypoints:
    """N planned poses in an area's East-North-Up frame.

    lines : (N,) int, of the file; poses; cameras : (N,) str, key of the lens, "" where none is named.
    """

    lines: np.ndarray
    poses: Poses
    cameras: np.ndarray

    def __len__(self) -> int:
        return len(self.lines)


def read_waypoints(path: Path | str, place: WaypointFrame) -> Waypoints:
    """From a CSV with a header row; columns as in docs/coverage.md, those of other names are passed over.

    Raises InputError, with the line, for a value that is missing, is no number or out of bounds; for
    heights that count from something else than the area's; for positions stated in two ways that differ.
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
                raise ValueError(f"{len(cells)} cells, the header has {len(header)}")
            values.append(
                {name: _number(name, cells[k]) for name, k in columns.items() if name != "camera"}
            )
            cameras.append(_key(cells[columns["camera"]]) if "camera" in columns else "")
        except ValueError as error:
            raise InputError(str(error), path=path, line=line) from error
        lines.append(line)
    if not lines:
        raise InputError("a header and no rows", path=path, line=header_line)
    table = {name: np.array([row[name] for row in values]) for name in values[0]}
    for name in ("heading_deg", "pitch_deg"):
        _refuse(np.isnan(table[name]), f"{name} is missing", lines, path)
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
    """Cells by column of positions (N, 3) and heading, pitch, roll (N, 3), as `read_waypoints` reads them.

    Metres to 3 decimals, degrees of position to 9 and of direction to 3.
    """
    geodetic = place.origin.wgs84_from_enu(centers)
    columns = {
        "lat_deg": [f"{v:.9f}" for v in geodetic[:, 0]],
        "lon_deg": [f"{v:.9f}" for v in geodetic[:, 1]],
    }
    for name, reference in place.columns().items():
        zero = place.zero_of(reference)
        columns[name] = [f"{v:.3f}" for v in geodetic[:, 2] - (zero or 0.0)]
    for k, name in enumerate(_ENU):
        columns[name] = [f"{v:.3f}" for v in centers[:, k]]
    # 359.9996 would be printed as 360.000, a roll of -1e-14 as -0.000.
    angles = np.round(angles_deg, 3) + 0.0
    columns["heading_deg"] = [f"{v % 360:.3f}" for v in angles[:, 0]]
    columns["pitch_deg"] = [f"{v:.3f}" for v in angles[:, 1]]
    columns["roll_deg"] = [f"{v:.3f}" for v in angles[:, 2]]
    return columns


def _columns(header: list[str], line: int, path: Path | str) -> dict[str, int]:
    """Positions of the columns that are known, by name."""
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
            f"has no column for {' and '.join(missing)}: "
            f"found {', '.join(header)[:300] or 'none'} (see docs/coverage.md)",
            path=path,
            line=line,
        )
    return known


def _usable_heights(
    columns: dict[str, int], place: WaypointFrame, line: int, path: Path | str
) -> list[str]:
    """Columns of heights that the area knows the zero of."""
    if not columns.keys() >= {"lat_deg", "lon_deg"}:
        return []
    usable = [name for name in place.columns() if name in columns]
    if not usable and not columns.keys() >= set(_ENU):
        found = ", ".join(name for name in _HEIGHTS if name in columns)
        expected = " or ".join(place.columns()) or "x, y, z: it knows no zero of heights"
        raise InputError(
            f"has heights as {found}, the area needs {expected}; no geoid model is built in",
            path=path,
            line=line,
        )
    return usable


def _number(name: str, cell: str) -> float:
    """NaN for an empty cell. Raises ValueError for what is no number within the column's bounds."""
    if cell.lower() in _UNKNOWN:
        return math.nan
    try:
        value = math.inf if "_" in cell else float(cell)  # Python reads 1_0 as 10
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
        raise ValueError(f"camera is {cell[:40]!r}, no key of a camera")
    return cell


def _centers(
    table: dict[str, np.ndarray],
    heights: list[str],
    place: WaypointFrame,
    lines: list[int],
    path: Path | str,
) -> np.ndarray:
    """Positions (N, 3) of the rows: the first statement counts, the others must agree with it."""
    stated = [np.stack([_column(table, name) for name in _ENU], axis=1)]
    for name in heights:
        zero = place.zero_of(_HEIGHTS[name])
        alt = table[name] + (zero or 0.0)
        lat_lon_alt = np.stack([table["lat_deg"], table["lon_deg"], alt], axis=1)
        stated.append(place.origin.enu_from_wgs84(lat_lon_alt))
    centers = stated[0]
    unknown = np.isnan(centers)
    half = unknown.any(axis=1) & ~unknown.all(axis=1)
    _refuse(half, "has no position: only a part of x, y, z", lines, path)
    for other in stated[1:]:
        apart = np.linalg.norm(other - centers, axis=1)
        _refuse(
            apart > _AGREE_M,
            "its positions differ: x, y, z and latitude, longitude, height are not of one area's "
            "origin, or one was edited and not the other",
            lines,
            path,
        )
        centers = np.where(np.isnan(centers).any(axis=1, keepdims=True), other, centers)
    _refuse(np.isnan(centers).any(axis=1), "has no position", lines, path)
    return centers


def _column(table: dict[str, np.ndarray], name: str) -> np.ndarray:
    """(N,), NaN where there is no such column."""
    some = next(iter(table.values()))
    return table.get(name, np.full(len(some), np.nan))


def _refuse(bad: np.ndarray, why: str, lines: list[int], path: Path | str) -> None:
    """Raises InputError naming the first bad row."""
    rows = np.flatnonzero(bad)
    if len(rows):
        raise InputError(why, path=path, line=lines[rows[0]])
