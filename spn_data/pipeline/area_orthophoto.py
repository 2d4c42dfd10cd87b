"""Orthophoto of an area's ground from its mapping frames: exported as GeoTIFF, and as texture for a view."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from spn_data.area.area import Area
from spn_data.area.names import FRAMES, MASKS
from spn_data.errors import InputError, StageError
from spn_data.exports.exported_frames import ExportedFrames
from spn_data.exports.geotiff import FILE, utm_grid, write_geotiff
from spn_data.geometry.camera import Camera
from spn_data.inputs.area_labels import LabelledArea
from spn_data.inputs.frame_images import stored_image
from spn_data.labels.labels import Labels
from spn_data.orthophoto.ground import GroundRaster, fit_ground
from spn_data.orthophoto.mosaic import OrthophotoFrames, mosaic
from spn_data.orthophoto.views import GroundViews, ground_views
from spn_data.report.ground_texture import GroundTexture

_FINEST_M = 0.01
_TEXTURE_PX = 1024
_TEXTURE_FRAMES = 60
_TEXTURE_QUALITY = 70


class NoOrthophotoError(StageError):
    """No selected frame shows the ground."""


@dataclass(frozen=True, kw_only=True)
class WrittenOrthophoto:
    """What is known of an orthophoto.

    Attributes
    ----------
    epsg : int
        Coordinate system.
    pixel_m : float
    upper_left_m : tuple of float
        Easting and northing of the outer corner of the first pixel.
    size_px : tuple of int
        Width and height.
    opaque_share : float
        Share of the pixels that show the ground.
    frames_used : int
    displacement_per_height : float
        Median displacement of what stands on the ground, per height.
    relief_displacement_m : tuple of float or None
        Median and 95th percentile of what the spread of the ground points displaces; None if unknown.
    """

    epsg: int
    pixel_m: float
    upper_left_m: tuple[float, float]
    size_px: tuple[int, int]
    opaque_share: float
    frames_used: int
    displacement_per_height: float
    relief_displacement_m: tuple[float, float] | None

    def plain(self) -> dict[str, Any]:
        """Return the values for export.json."""
        return {"file": FILE, **asdict(self)}

    def notes(self) -> tuple[str, ...]:
        """Return sentences for the user."""
        place = f"WGS 84 / UTM, EPSG:{self.epsg}, pixels of {self.pixel_m:g} m"
        hidden = f"{1 - self.opaque_share:.0%} are transparent, where none sees the ground"
        on_ground = ""
        if self.relief_displacement_m is not None:
            median, most = self.relief_displacement_m
            on_ground = (
                f" On the ground, the scatter of its points displaces {median:.2f} m (median), "
                f"{most:.2f} m (95 %)."
            )
        return (
            f"{FILE}: {place}, from {self.frames_used} frames; {hidden}.",
            "Only the ground is rectified: what stands on it is displaced by "
            f"{self.displacement_per_height:.1f} m per metre of its height (median). Seams between frames "
            f"are not blended.{on_ground} The uncertainty of the map's place adds to this (spn-data status).",
        )


def write_orthophoto(area: Area, folder: Path, frames: ExportedFrames) -> WrittenOrthophoto:
    """Write the orthophoto of the selected mapping frames as GeoTIFF.

    Parameters
    ----------
    area : Area
    folder : Path
        Folder of the export.
    frames : ExportedFrames
        Frames of evaluation sequences among them are not used.

    Returns
    -------
    WrittenOrthophoto

    Raises
    ------
    StageError
        If the map is not georegistered, or the file cannot be written.
    NoOrthophotoError
        If no mapping frame is selected, or none sees the ground.
    GeometryError
        If the height of the ground is unknown, or UTM is not defined here.
    InputError
        If an image is missing or damaged.
    """
    origin = frames.required_origin("GeoTIFF")
    labels = frames.labels.select(~frames.is_evaluation)
    if not len(labels):
        raise NoOrthophotoError(
            "an orthophoto is made from mapping frames, but none is selected with --sequence"
        )
    ground = fit_ground(frames.points.xyz, labels.poses.centers)
    views = ground_views(ground, labels.poses, frames.cameras, labels.cameras)
    seen = views.best >= 0
    if not seen.any():
        raise NoOrthophotoError(
            "no mapping frame sees the ground steeply enough for an orthophoto; fly with the camera tilted "
            "down"
        )
    low, high = _extent(ground, seen)
    wanted = max(float(f"{np.percentile(views.sampling_m[seen], 25):.1g}"), _FINEST_M)
    grid = utm_grid(origin, low, high, float(np.median(ground.height_m[seen])), wanted)
    source = _images(area, labels, frames.cameras)
    image = mosaic(ground, views, source, grid.xy)
    write_geotiff(folder / FILE, image, grid, f"WGS 84 / UTM, EPSG:{grid.epsg}; {frames.world}")
    return WrittenOrthophoto(
        epsg=grid.epsg,
        pixel_m=grid.pixel_m,
        upper_left_m=grid.upper_left_m,
        size_px=(image.shape[1], image.shape[0]),
        opaque_share=round(float((image[..., 3] > 0).mean()), 4),
        frames_used=len(np.unique(views.best[seen])),
        displacement_per_height=round(float(np.nanmedian(views.slope)), 2),
        relief_displacement_m=_relief_displacement(ground, views),
    )


def ground_texture(area: Area, labelled: LabelledArea) -> GroundTexture | None:
    """Draw the ground as a small image for a 3D view, from the frames that show most of it.

    Parameters
    ----------
    area : Area
    labelled : LabelledArea
        Its labels, in metres.

    Returns
    -------
    GroundTexture or None
        None if no frame sees the ground.

    Raises
    ------
    GeometryError
        If the height of the ground is unknown.
    InputError
        If an image is missing or damaged.
    """
    labels = labelled.mapping.select(labelled.mapping.registered)
    ground = fit_ground(labelled.points.xyz, labels.poses.centers)
    views = ground_views(ground, labels.poses, labelled.cameras, labels.cameras)
    shown, cells = np.unique(views.best[views.best >= 0], return_counts=True)
    if len(shown) > _TEXTURE_FRAMES:
        labels = labels.select(np.sort(shown[np.argsort(-cells)[:_TEXTURE_FRAMES]]))
        views = ground_views(ground, labels.poses, labelled.cameras, labels.cameras)
    seen = views.best >= 0
    if not seen.any():
        return None
    low, high = _extent(ground, seen)
    pixel = float((high - low).max()) / _TEXTURE_PX
    width, height = np.maximum(np.round((high - low) / pixel), 1).astype(int)
    x = low[0] + pixel * (np.arange(width) + 0.5)
    y = high[1] - pixel * (np.arange(height) + 0.5)
    source = _images(area, labels, labelled.cameras)
    image = mosaic(ground, views, source, np.dstack(np.meshgrid(x, y)))
    ok, webp = cv2.imencode(
        ".webp",
        cv2.cvtColor(image, cv2.COLOR_RGBA2BGRA),
        [cv2.IMWRITE_WEBP_QUALITY, _TEXTURE_QUALITY],
    )
    assert ok
    corners = [(float(c[0]), float(c[1])) for c in (low, high)]
    up = float(np.median(ground.height_m[seen]))
    return GroundTexture(corners[0], corners[1], up, webp.tobytes())


def _extent(ground: GroundRaster, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of the smallest rectangle around the seen cells."""
    rows, columns = np.nonzero(seen)
    first, last = np.array([columns.min(), rows.min()]), np.array([columns.max(), rows.max()])
    return ground.low + ground.cell_m * first, ground.low + ground.cell_m * (last + 1)


def _relief_displacement(ground: GroundRaster, views: GroundViews) -> tuple[float, float] | None:
    """Return median and 95th percentile of the displacement in cells with points on the ground."""
    moved = (ground.spread_m * views.slope)[(views.best >= 0) & np.isfinite(ground.spread_m)]
    if not len(moved):
        return None
    median, most = np.percentile(moved, [50, 95])
    return round(float(median), 3), round(float(most), 3)


def _images(area: Area, labels: Labels, cameras: Mapping[str, Camera]) -> OrthophotoFrames:
    """Return the images of mapping frames; what the mask of a sequence excludes is transparent."""

    @cache
    def mask_of(sequence: str) -> np.ndarray | None:
        path = area.folder(FRAMES) / MASKS / f"{sequence}.png"
        if not path.is_file():
            return None
        mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if mask is None:
            raise InputError("is damaged or not an image", path=path)
        return mask

    def read(row: int) -> np.ndarray:
        name, sequence = str(labels.names[row]), str(labels.sequences[row])
        image, mask = stored_image(area, name, sequence), mask_of(sequence)
        if mask is None:
            return image
        if mask.shape != image.shape[:2]:
            mask = cv2.resize(mask, image.shape[1::-1], interpolation=cv2.INTER_NEAREST)
        return np.dstack([image, np.where(mask > 0, 255, 0).astype(np.uint8)])

    return OrthophotoFrames(labels.poses, cameras, labels.cameras, read)
