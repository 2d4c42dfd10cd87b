"""Orthophoto as GeoTIFF in UTM: its grid of pixels, and a TIFF file with the tags that place it."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, TiffImagePlugin

from spn_data.errors import GeometryError
from spn_data.geometry.geodesy import GeoOrigin
from spn_data.storage.files import atomic_writer

FILE = "orthophoto.tif"
_MOST_PX = 4000  # a side
_UTM_LAT_DEG = (-80.0, 84.0)
_ROWS_AT_ONCE = 500
# Tags of GeoTIFF 1.0 (section 2.6) and keys of its directory (section 6.2.1).
_PIXEL_SCALE, _TIE_POINTS, _KEYS, _TEXT = 33550, 33922, 34735, 34737
_MODEL_TYPE, _RASTER_TYPE, _CITATION, _PROJECTED = 1024, 1025, 1026, 3072
_IS_PROJECTED, _PIXEL_IS_AREA = 1, 1


@dataclass(frozen=True, eq=False)
class UtmGrid:
    """Pixels of an orthophoto on the grid of UTM.

    Attributes
    ----------
    epsg : int
        WGS84 / UTM, 32601 to 32660 or 32701 to 32760.
    upper_left_m : tuple of float
        Easting and northing of the outer corner of the first pixel.
    pixel_m : float
        Side of a pixel.
    xy : ndarray, shape (H, W, 2)
        East and north of the middle of each pixel in the local frame.
    """

    epsg: int
    upper_left_m: tuple[float, float]
    pixel_m: float
    xy: np.ndarray


def utm_grid(
    origin: GeoOrigin, low: np.ndarray, high: np.ndarray, up: float, pixel_m: float
) -> UtmGrid:
    """Lay the grid of UTM over a rectangle of the local frame.

    Parameters
    ----------
    origin : GeoOrigin
        Origin of the local frame.
    low, high : ndarray, shape (2,)
        East and north of two corners of the rectangle.
    up : float
        Height of the ground in the local frame.
    pixel_m : float
        Wanted side of a pixel; it becomes larger if the image would have too many of them.

    Returns
    -------
    UtmGrid

    Raises
    ------
    GeometryError
        If UTM is not defined at this latitude.
    """
    from pyproj import Transformer  # loads PROJ's database: only when it is needed

    if not _UTM_LAT_DEG[0] <= origin.lat_deg <= _UTM_LAT_DEG[1]:
        raise GeometryError(
            f"UTM is not defined at latitude {origin.lat_deg:.1f}; geotiff cannot be exported there"
        )
    zone = min(int((origin.lon_deg + 180) // 6) + 1, 60)
    epsg = (32600 if origin.lat_deg >= 0 else 32700) + zone
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        to_utm = Transformer.from_crs(4326, epsg, always_xy=True)
    corners = np.array([[x, y, up] for x in (low[0], high[0]) for y in (low[1], high[1])])
    lat_lon = origin.wgs84_from_enu(corners)
    east, north = to_utm.transform(lat_lon[:, 1], lat_lon[:, 0])
    extent = max(np.ptp(east), np.ptp(north))
    if extent / pixel_m > _MOST_PX:
        pixel_m = float(f"{extent / _MOST_PX + 0.005:.2f}")
    left, top = np.floor(min(east) / pixel_m) * pixel_m, np.ceil(max(north) / pixel_m) * pixel_m
    width = int(np.ceil((max(east) - left) / pixel_m))
    height = int(np.ceil((top - min(north)) / pixel_m))
    xy = np.empty((height, width, 2))
    columns = left + pixel_m * (np.arange(width) + 0.5)
    for first in range(0, height, _ROWS_AT_ONCE):
        rows = top - pixel_m * (np.arange(first, min(first + _ROWS_AT_ONCE, height)) + 0.5)
        e, n = np.meshgrid(columns, rows)
        lon, lat = to_utm.transform(e.ravel(), n.ravel(), direction="INVERSE")
        places = np.column_stack([lat, lon, np.full(len(lat), origin.alt_m + up)])
        xy[first : first + len(rows)] = origin.enu_from_wgs84(places)[:, :2].reshape(*e.shape, 2)
    return UtmGrid(epsg, (float(left), float(top)), pixel_m, xy)


def write_geotiff(path: Path, image: np.ndarray, grid: UtmGrid, about: str) -> None:
    """Write an image as GeoTIFF, atomically.

    Parameters
    ----------
    path : Path
    image : ndarray of uint8, shape (H, W, 4)
        Red, green, blue and opacity.
    grid : UtmGrid
        Its pixels.
    about : str
        Description for people, in ASCII.

    Raises
    ------
    StageError
        If the file cannot be written.
    """
    tags: Any = TiffImagePlugin.ImageFileDirectory_v2()
    text = f"{about}|"  # the directory of keys counts the separator as the end of the text
    keys = (
        *(1, 1, 0, 4),  # version 1, revision 1.0, four keys
        *(_MODEL_TYPE, 0, 1, _IS_PROJECTED),
        *(_RASTER_TYPE, 0, 1, _PIXEL_IS_AREA),
        *(_CITATION, _TEXT, len(text), 0),
        *(_PROJECTED, 0, 1, grid.epsg),
    )
    for tag, kind, value in (
        (_PIXEL_SCALE, 12, (grid.pixel_m, grid.pixel_m, 0.0)),
        (_TIE_POINTS, 12, (0.0, 0.0, 0.0, *grid.upper_left_m, 0.0)),
        (_KEYS, 3, keys),
        (_TEXT, 2, text),
    ):
        tags.tagtype[tag] = kind
        tags[tag] = value
    with atomic_writer(path) as file:
        Image.fromarray(image, "RGBA").save(
            file, format="TIFF", compression="tiff_deflate", tiffinfo=tags
        )
