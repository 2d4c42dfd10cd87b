"""Files of ground control points: ODM's gcp_list.txt, and CSV with named columns."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path

from spn_data.errors import InputError
from spn_data.telemetry.textfile import csv_rows, finite_number, read_text

_MAX_BYTES = 20_000_000
_MAX_MARKS = 100_000
_MAX_POINTS = 2_000
_MAX_NAME = 100
_WGS84 = "EPSG:4326"
_CHECKED = {"check", "checkpoint", "check point", "cp", "verification"}
_CONTROLLED = {"", "control", "gcp", "ground control", "3d"}

# Field -> accepted headers of CSV columns.
_COLUMNS: Mapping[str, tuple[str, ...]] = {
    "name": ("name", "point", "label", "id", "gcp", "gcp_name", "point_name"),
    "lat": ("lat", "latitude", "lat_deg"),
    "lon": ("lon", "lng", "long", "longitude", "lon_deg"),
    "east": ("east", "easting", "e", "geo_x"),
    "north": ("north", "northing", "n", "geo_y"),
    "height": ("height", "h", "z", "alt", "altitude", "elevation", "up", "geo_z", "height_m"),
    "crs": ("epsg", "crs"),
    "image": ("image", "image_name", "photo", "file", "frame", "filename"),
    "x": ("x", "px", "im_x", "x_px", "pixel_x", "u"),
    "y": ("y", "py", "im_y", "y_px", "pixel_y", "v"),
    "width": ("width", "image_width", "width_px"),
    "image_height": ("image_height", "height_px"),
    "sigma_h": ("sigma_h", "sigma_h_m", "accuracy_h", "sigma_xy"),
    "sigma_v": ("sigma_v", "sigma_v_m", "accuracy_v", "sigma_z"),
    "sigma_px": ("sigma_px", "mark_sigma", "accuracy_px"),
    "role": ("role", "type", "use"),
}


class PointRole(StrEnum):
    """What a surveyed point is for."""

    CONTROL = "control"  # fitted
    CHECK = "check"  # held out


@dataclass(frozen=True)
class Mark:
    """Position of a point in an image.

    Attributes
    ----------
    image : str
        Name of the image as in the file.
    x, y : float
        Pixels from the upper-left corner, as in the file; the centre of the first pixel is (0.5, 0.5).
    line : int
        Line of the file.
    size : tuple of int, optional
        Width and height of the image in which it was marked; None if the file does not state them.
    sigma_px : float, optional
        Standard deviation of x and of y.
    """

    image: str
    x: float
    y: float
    line: int
    size: tuple[int, int] | None = None
    sigma_px: float | None = None


@dataclass(frozen=True)
class SurveyedPoint:
    """A surveyed point with its marks.

    Attributes
    ----------
    name : str
    east, north : float
        In the units of the file's coordinate system; longitude and latitude if that is geographic.
    height : float
        NaN if the file has none.
    line : int
        Line of the file where it first appears.
    role : PointRole
    marks : tuple of Mark
    sigma_h_m, sigma_v_m : float, optional
        Standard deviation of the survey, horizontal per axis and vertical.
    """

    name: str
    east: float
    north: float
    height: float
    line: int
    role: PointRole = PointRole.CONTROL
    marks: tuple[Mark, ...] = ()
    sigma_h_m: float | None = None
    sigma_v_m: float | None = None


@dataclass(frozen=True)
class ControlFile:
    """Points of one file, and its coordinate system as written there."""

    path: Path
    crs: str
    points: tuple[SurveyedPoint, ...]


def read_control_file(path: Path) -> ControlFile:
    """Read ground control points.

    Parameters
    ----------
    path : Path
        A CSV file whose header names its columns, otherwise ODM's gcp_list.txt.

    Returns
    -------
    ControlFile

    Raises
    ------
    InputError
        If the file cannot be read, has no or too many points, or a line cannot be understood.
    """
    text = read_text(path, max_bytes=_MAX_BYTES)
    lines = text.split("\n")
    first = next((line.strip() for line in lines if line.strip()), "")
    cells = [cell.strip().strip('"').lower() for cell in first.replace(";", ",").split(",")]
    known = {name for names in _COLUMNS.values() for name in names}
    if len(cells) > 2 and sum(cell in known for cell in cells) > len(cells) / 2:
        found = _read_csv(text, path)
    else:
        found = _read_gcp_list(lines, path)
    if not found.points:
        raise InputError("contains no ground control point", path=path)
    return found


class _Points:
    """Points by name, in order of appearance, while a file is read."""

    def __init__(self, path: Path):
        self._path = path
        self._points: dict[str, SurveyedPoint] = {}
        self._marks: dict[str, list[Mark]] = {}
        self._count = 0

    def add(self, point: SurveyedPoint, mark: Mark | None) -> None:
        """Add a row; one that repeats a point must have the same coordinates or none."""
        before = self._points.setdefault(point.name, point)
        if len(self._points) > _MAX_POINTS:
            raise InputError(f"contains more than {_MAX_POINTS} points", path=self._path)
        now = (point.east, point.north, point.height)
        first = (before.east, before.north, before.height)
        if not math.isnan(point.east) and any(
            a != b and not (math.isnan(a) and math.isnan(b))
            for a, b in zip(now, first, strict=True)
        ):
            raise InputError(
                f"point {point.name!r} has other coordinates than in line {before.line}: "
                f"{point.east:.12g} {point.north:.12g} {point.height:g}; give each point its own name",
                path=self._path,
                line=point.line,
            )
        if mark is None:
            return
        self._count += 1
        if self._count > _MAX_MARKS:
            raise InputError(f"contains more than {_MAX_MARKS} marks", path=self._path)
        mine = self._marks.setdefault(point.name, [])
        if any(other.image == mark.image for other in mine):
            raise InputError(
                f"point {point.name!r} is marked twice in {mark.image}",
                path=self._path,
                line=mark.line,
            )
        mine.append(mark)

    def all(self) -> tuple[SurveyedPoint, ...]:
        """Return the points with their marks."""
        for name, point in self._points.items():
            if math.isnan(point.east):
                raise InputError(
                    f"point {name!r} has no coordinates", path=self._path, line=point.line
                )
        return tuple(
            replace(point, marks=tuple(self._marks.get(name, ())))
            for name, point in self._points.items()
        )


def _read_gcp_list(lines: Sequence[str], path: Path) -> ControlFile:
    """Read ODM's format: the coordinate system, then `x y z pixel_x pixel_y image [name]` in each line."""
    crs, points = "", _Points(path)
    names: dict[tuple[float, float, float], str] = {}
    for number, line in enumerate(lines, 1):
        text = line.strip()
        if not text or text.startswith("#"):
            continue
        if not crs:
            crs = text
            continue
        cells = text.split("\t") if text.count("\t") >= 5 else text.split()
        try:
            if len(cells) < 6:
                raise ValueError(f"{len(cells)} columns instead of: x y z pixel_x pixel_y image")
            x, y, z, px, py = (
                finite_number(cell, name)
                for cell, name in zip(
                    cells, ("geo_x", "geo_y", "geo_z", "im_x", "im_y"), strict=False
                )
            )
        except ValueError as error:
            raise InputError(str(error), path=path, line=number) from error
        unnamed = names.setdefault((x, y, z), f"point{len(names) + 1}")
        name = cells[6].strip()[:_MAX_NAME] if len(cells) > 6 else unnamed
        points.add(SurveyedPoint(name, x, y, z, number), Mark(cells[5].strip(), px, py, number))
    return ControlFile(path, crs, points.all())


def _read_csv(text: str, path: Path) -> ControlFile:
    rows = csv_rows(text, path, "ground control points")
    line, header = next(rows)
    column = _columns(header, path, line)
    geographic = "lat" in column
    first, second = ("lon", "lat") if geographic else ("east", "north")
    crs, points = "", _Points(path)
    for line, cells in rows:
        row = {field: cells[k] if k < len(cells) else "" for field, k in column.items()}
        try:
            crs = _same_crs(crs, row.get("crs", ""))
            name = row["name"][:_MAX_NAME]
            if not name:
                raise ValueError("the point has no name")
            if not row[first] and not row[second]:
                east = north = height = math.nan
            else:
                east = finite_number(row[first], first)
                north = finite_number(row[second], second)
                told = _optional(row, "height")
                height = math.nan if told is None else told
            point = SurveyedPoint(
                name,
                east,
                north,
                height,
                line,
                _role(row.get("role", "")),
                sigma_h_m=_positive(row, "sigma_h"),
                sigma_v_m=_positive(row, "sigma_v"),
            )
            points.add(point, _mark(row, line))
        except ValueError as error:
            raise InputError(str(error), path=path, line=line) from error
    if not crs and not geographic:
        raise InputError(
            "does not state the coordinate system of east and north: add a column epsg, such as 32632, or "
            "25832+7837 with a vertical datum",
            path=path,
        )
    return ControlFile(path, crs or _WGS84, points.all())


def _columns(header: Sequence[str], path: Path, line: int) -> dict[str, int]:
    """Return the index of the column of each field."""
    names = [cell.strip().lower() for cell in header]
    column: dict[str, int] = {}
    for field, accepted in _COLUMNS.items():
        found = [k for k, name in enumerate(names) if name in accepted]
        if len(found) > 1:
            both = " and ".join(header[k] for k in found[:2])
            raise InputError(f"two columns for one quantity: {both}", path=path, line=line)
        if found:
            column[field] = found[0]
    geographic = {"lat", "lon"} <= column.keys()
    if not geographic and not {"east", "north"} <= column.keys():
        raise InputError("has neither columns lat and lon nor east and north", path=path, line=line)
    if geographic and {"east", "north"} <= column.keys():
        raise InputError(
            "has both lat, lon and east, north: keep one of them", path=path, line=line
        )
    missing = [field for field in ("name", "image", "x", "y") if field not in column]
    if missing:
        raise InputError(f"has no column {', '.join(missing)}", path=path, line=line)
    return column


def _mark(row: Mapping[str, str], line: int) -> Mark | None:
    if not row["image"]:
        if row["x"] or row["y"]:
            raise ValueError("the mark has no image")
        return None
    width, height = (_positive(row, name) for name in ("width", "image_height"))
    if (width is None) != (height is None):
        raise ValueError("only one of width and image_height is stated")
    return Mark(
        row["image"],
        finite_number(row["x"], "x"),
        finite_number(row["y"], "y"),
        line,
        None if width is None or height is None else (round(width), round(height)),
        _positive(row, "sigma_px"),
    )


def _same_crs(before: str, text: str) -> str:
    if not text:
        return before
    crs = f"EPSG:{text}" if text.replace("+", "").isdigit() else text
    if before and crs != before:
        raise ValueError(f"the coordinate system is {crs} here, {before} above: use one file each")
    return crs


def _role(text: str) -> PointRole:
    role = text.strip().lower()
    if role in _CHECKED:
        return PointRole.CHECK
    if role in _CONTROLLED:
        return PointRole.CONTROL
    raise ValueError(f"the role is {text[:40]!r}: control or check")


def _optional(row: Mapping[str, str], name: str) -> float | None:
    return finite_number(row[name], name) if row.get(name) else None


def _positive(row: Mapping[str, str], name: str) -> float | None:
    value = _optional(row, name)
    if value is not None and not value > 0:
        raise ValueError(f"{name} is {value:g}, not positive")
    return value
