"""Coordinate systems of surveyed points: to WGS84, with heights above the ellipsoid or a vertical datum.

Nothing is downloaded: a transformation whose grid is not installed is refused.
"""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from spn_data.errors import InputError
from spn_data.geometry.geodesy import HeightReference
from spn_data.ground_control.control_file import ControlFile

if TYPE_CHECKING:
    from pyproj import CRS

_MAX_TEXT = 500
_EPSG = re.compile(r"epsg:\s*(\d{4,6})(?:\s*\+\s*(\d{4,6}))?", re.I)
_UTM = re.compile(r"wgs[\s_]*84\s*/?\s*utm(?:\s*zone)?\s*(\d{1,2})\s*([NS])", re.I)
_PROJ = re.compile(r"(?:\+[a-z_0-9]+(?:=[A-Za-z0-9_.,:/-]*)?\s*)+", re.I)
# Words of a PROJ string that open files or chain operations.
_FORBIDDEN = ("grids", "init", "pipeline", "step", "/")
_DEGREES = "degree"
# Beyond this distance from the area of use, a coordinate is a mistake.
_MARGIN_DEG = 1.0
# Without the best grid: between realisations of one datum, such as ETRS89 and WGS84, and of heights.
_HORIZONTAL_ENOUGH_M, _VERTICAL_ENOUGH_M = 1.5, 0.2


@dataclass(frozen=True, eq=False)
class SurveyedPositions:
    """Positions of K points.

    Attributes
    ----------
    lat_lon_deg : ndarray, shape (K, 2)
        WGS84.
    height_m : ndarray, shape (K,)
        NaN if unknown.
    reference : HeightReference
        ELLIPSOID, AMSL (the vertical datum) or UNKNOWN.
    system : str
        Name of the coordinate system, with its vertical datum.
    """

    lat_lon_deg: np.ndarray
    height_m: np.ndarray
    reference: HeightReference
    system: str


def surveyed_positions(
    file: ControlFile, wanted: HeightReference | None = None
) -> SurveyedPositions:
    """Convert the points of a file to WGS84.

    Parameters
    ----------
    file : ControlFile
    wanted : HeightReference, optional
        Reference that the heights must have. A coordinate system with a vertical datum is converted to the
        ellipsoid; heights of one without are taken as such. None: heights stay as they are.

    Returns
    -------
    SurveyedPositions

    Raises
    ------
    InputError
        If the coordinate system is unknown, a grid is not installed, points are outside the area where the
        system is used, or heights cannot be had above the wanted reference.
    """
    crs = _crs(file)
    east, north, height = (
        np.array([getattr(p, name) for p in file.points]) for name in ("east", "north", "height")
    )
    vertical = crs.sub_crs_list[1] if crs.is_compound else None
    flat = crs.sub_crs_list[0] if crs.is_compound else crs
    if flat.is_geocentric or not (flat.is_geographic or flat.is_projected):
        raise InputError(
            f"{crs.name} is neither geographic nor projected: give latitude and longitude, or east and north",
            path=file.path,
        )
    lat_lon = _horizontal(file, flat, east, north)
    three = len(flat.axis_info) > 2
    reference = (
        HeightReference.ELLIPSOID
        if three
        else HeightReference.AMSL
        if vertical is not None
        else (wanted or HeightReference.UNKNOWN)
    )
    unit = (vertical or flat).axis_info[-1] if three or vertical is not None else None
    if unit is not None and unit.direction == "down":
        raise InputError(f"{crs.name} counts depths downwards: give heights", path=file.path)
    metres = height * (unit.unit_conversion_factor if unit is not None else 1.0)
    if wanted is not None and reference is not wanted:
        if wanted is not HeightReference.ELLIPSOID:
            raise InputError(
                f"heights of {crs.name} are above the ellipsoid, but heights above '{wanted}' are needed: "
                "give the points in a system with a vertical datum, such as EPSG:25832+7837",
                path=file.path,
            )
        metres = _above_ellipsoid(file, crs, east, north, height)
        reference = HeightReference.ELLIPSOID
    return SurveyedPositions(lat_lon, metres, reference, crs.name)


def _crs(file: ControlFile) -> CRS:
    """Return the coordinate system of a file; only codes, UTM zones and plain PROJ strings are accepted."""
    try:
        import pyproj
    except ImportError as error:
        raise InputError(
            "ground control points need pyproj: pip install 'squeezeposenet-toolkit[data]'"
        ) from error
    pyproj.network.set_network_enabled(active=False)
    text = file.crs.strip()
    shown = repr(text[:60])
    how = "give an EPSG code (EPSG:32632, EPSG:25832+7837), WGS84 UTM 32N, or a PROJ string"
    epsg, utm = _EPSG.fullmatch(text), _UTM.fullmatch(text)
    if epsg:
        wanted = f"EPSG:{epsg[1]}" + (f"+{epsg[2]}" if epsg[2] else "")
    elif utm and 1 <= int(utm[1]) <= 60:
        wanted = f"EPSG:{(32600 if utm[2].upper() == 'N' else 32700) + int(utm[1])}"
    elif (
        len(text) <= _MAX_TEXT
        and _PROJ.fullmatch(text)
        and not any(word in text.lower() for word in _FORBIDDEN)
    ):
        wanted = text
    else:
        raise InputError(
            f"{shown} is not a coordinate system that is known here: {how}", path=file.path
        )
    try:
        crs = pyproj.CRS.from_user_input(wanted)
    except pyproj.exceptions.CRSError as error:
        raise InputError(
            f"{shown} is not a coordinate system that is known here (PROJ: {error}): {how}",
            path=file.path,
        ) from error
    if crs.is_vertical and not crs.is_compound:
        raise InputError(
            f"{crs.name} is only a vertical datum: name the horizontal system first, such as "
            f"EPSG:32632+{epsg[1] if epsg else '5773'}",
            path=file.path,
        )
    return crs


def _horizontal(file: ControlFile, crs: CRS, east: np.ndarray, north: np.ndarray) -> np.ndarray:
    """Return latitude and longitude (K, 2); refuse what is outside the system's area of use."""
    geographic = crs.is_geographic and crs.axis_info[0].unit_name == _DEGREES
    if geographic and (np.abs(north) > 90).any():
        k = int(np.argmax(np.abs(north) > 90))
        swapped = (
            " (it looks as if latitude and longitude are swapped)" if abs(east[k]) <= 90 else ""
        )
        raise _at(
            file, k, f"the latitude is {north[k]:g}{swapped}; gcp_list.txt has longitude first"
        )
    # Where the points are roughly, without caring for grids: the exact transformation depends on the place.
    rough = _transform(crs, east, north)
    _require_inside(file, crs, rough, _transform(crs, north, east))
    place = np.nanmin(rough, axis=0), np.nanmax(rough, axis=0)
    transformer = _best(file, crs, 4326, place)
    lon, lat = transformer.transform(east, north)
    found = np.column_stack([lat, lon])
    lost = ~np.isfinite(found).all(axis=1)
    if lost.any():
        raise _at(file, int(np.argmax(lost)), f"{crs.name} cannot be converted to WGS84 there")
    return found


def _transform(crs: CRS, east: np.ndarray, north: np.ndarray) -> np.ndarray:
    """Return longitude and latitude (K, 2) on the system's own datum; NaN where that is impossible."""
    from pyproj import Transformer

    lon, lat = Transformer.from_crs(crs, crs.geodetic_crs, always_xy=True).transform(east, north)
    found = np.column_stack([lon, lat])
    return np.where(np.isfinite(found), found, np.nan)


def _require_inside(file: ControlFile, crs: CRS, place: np.ndarray, swapped: np.ndarray) -> None:
    """Raise InputError for points far outside the system's area of use, naming swapped axes."""
    area = crs.area_of_use
    west, south, east, north = (-180.0, -90.0, 180.0, 90.0) if area is None else area.bounds

    def inside(lon_lat: np.ndarray) -> np.ndarray:
        lon, lat = lon_lat.T
        width = (east - west) % 360 if east != west else 360.0
        width = 360.0 if width == 0 else width
        from_west = (lon - (west - _MARGIN_DEG)) % 360
        return np.asarray(
            np.isfinite(lon_lat).all(axis=1)
            & (from_west <= width + 2 * _MARGIN_DEG)
            & (lat >= south - _MARGIN_DEG)
            & (lat <= north + _MARGIN_DEG)
        )

    outside = ~inside(place)
    if not outside.any():
        return
    k = int(np.argmax(outside))
    point = file.points[k]
    told = f"{point.east:.12g} {point.north:.12g} is outside the area where {crs.name} is used"
    if inside(swapped)[outside].all():
        raise _at(file, k, f"{told}: it looks as if east and north are swapped")
    raise _at(file, k, f"{told}: is this the right zone and system?")


def _best(file: ControlFile, crs: CRS, target: int, place: tuple[np.ndarray, np.ndarray]) -> Any:
    """Return the best transformation at a place; raise InputError if its grid is not installed."""
    from pyproj import CRS
    from pyproj.aoi import AreaOfInterest
    from pyproj.transformer import TransformerGroup

    (west, south), (east, north) = place
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # pyproj warns of the missing grid, which is told below
        group = TransformerGroup(
            crs,
            CRS.from_epsg(target),
            always_xy=True,
            allow_ballpark=False,
            area_of_interest=AreaOfInterest(west - 0.01, south - 0.01, east + 0.01, north + 0.01),
        )
    if group.transformers:
        accuracy = group.transformers[0].accuracy
        enough = _HORIZONTAL_ENOUGH_M if target == 4326 else _VERTICAL_ENOUGH_M
        if group.best_available or 0 <= accuracy <= enough:
            return group.transformers[0]
    grids = [
        grid.short_name
        for operation in group.unavailable_operations[:1]
        for grid in operation.grids
        if not grid.available
    ]
    wgs84 = "WGS84" if target == 4326 else "heights above the ellipsoid"
    if not grids:
        raise InputError(f"PROJ knows no transformation from {crs.name} to {wgs84}", path=file.path)
    commands = "; ".join(f"pyproj sync --file {grid}" for grid in grids)
    without = (
        f" (without it, only to {group.transformers[0].accuracy:g} m)"
        if group.transformers and group.transformers[0].accuracy > 0
        else ""
    )
    raise InputError(
        f"from {crs.name} to {wgs84} needs the grid {', '.join(grids)}, which is not installed{without}: run "
        f"{commands}, or give the points in a system of WGS84 or ETRS89",
        path=file.path,
    )


def _above_ellipsoid(
    file: ControlFile, crs: CRS, east: np.ndarray, north: np.ndarray, height: np.ndarray
) -> np.ndarray:
    """Return heights (K,) above the ellipsoid, by a geoid grid that must be installed."""
    rough = _transform(crs.sub_crs_list[0], east, north)
    place = np.nanmin(rough, axis=0), np.nanmax(rough, axis=0)
    transformer = _best(file, crs, 4979, place)
    up = np.asarray(transformer.transform(east, north, np.nan_to_num(height))[2])
    outside = ~np.isfinite(up)
    if outside.any():
        raise _at(file, int(np.argmax(outside)), f"is outside the geoid grid of {crs.name}")
    return np.where(np.isfinite(height), up, np.nan)


def _at(file: ControlFile, k: int, text: str) -> InputError:
    point = file.points[k]
    return InputError(f"point {point.name!r}: {text}", path=file.path, line=point.line)
