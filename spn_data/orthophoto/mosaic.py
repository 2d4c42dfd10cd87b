"""Mosaic of the ground: each pixel from the frame that shows its cell best, transparent where none does."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from spn_data.geometry.camera import Camera, opencv_pixels
from spn_data.geometry.pose import Poses
from spn_data.orthophoto.ground import GroundRaster
from spn_data.orthophoto.views import GroundViews


@dataclass(frozen=True, eq=False)
class OrthophotoFrames:
    """N frames with poses, in full-size pixels.

    Attributes
    ----------
    poses : Poses
    cameras : dict of str to Camera
    camera_of : ndarray of str, shape (N,)
    read : callable of int to ndarray
        Image of a frame as it was taken, BGR, with an alpha channel if parts of it are masked. It may be
        smaller than its camera states.
    """

    poses: Poses
    cameras: Mapping[str, Camera]
    camera_of: np.ndarray
    read: Callable[[int], np.ndarray]


def mosaic(
    ground: GroundRaster, views: GroundViews, frames: OrthophotoFrames, xy: np.ndarray
) -> np.ndarray:
    """Draw the ground at positions.

    Parameters
    ----------
    ground : GroundRaster
    views : GroundViews
        Its views in the frames.
    frames : OrthophotoFrames
    xy : ndarray, shape (H, W, 2)
        East and north of the middle of each pixel.

    Returns
    -------
    ndarray of uint8, shape (H, W, 4)
        Red, green, blue and opacity, which is 0 where no frame sees the ground and 255 elsewhere.
    """
    height, width = xy.shape[:2]
    flat = xy.reshape(-1, 2)
    row, column, inside = ground.cells_of(flat)
    source = np.where(inside, views.best[row, column], -1)
    drawn = np.zeros((height * width, 4), np.uint8)
    order = np.argsort(source, kind="stable")
    starts = np.searchsorted(source[order], np.arange(len(frames.poses) + 1))
    for k in np.unique(source[source >= 0]).tolist():
        pixels = order[starts[k] : starts[k + 1]]
        heights = _bilinear(ground, flat[pixels])
        known = np.isfinite(heights)
        pixels = pixels[known]
        places = np.column_stack([flat[pixels], heights[known]])
        drawn[pixels] = _sample(frames, k, places)
    return drawn.reshape(height, width, 4)


def _bilinear(ground: GroundRaster, xy: np.ndarray) -> np.ndarray:
    """Return heights of the ground, between cells linear where all four are known."""
    place = (xy - ground.low) / ground.cell_m - 0.5
    shape = np.array(ground.height_m.shape)[::-1]
    first = np.clip(np.floor(place).astype(np.int64), 0, np.maximum(shape - 2, 0))
    second = np.minimum(first + 1, shape - 1)
    share = np.clip(place - first, 0, 1)
    heights = ground.height_m
    (x0, y0), (x1, y1), (u, v) = first.T, second.T, share.T
    mixed = (heights[y0, x0] * (1 - u) + heights[y0, x1] * u) * (1 - v) + (
        heights[y1, x0] * (1 - u) + heights[y1, x1] * u
    ) * v
    row, column, _ = ground.cells_of(xy)
    return np.where(np.isfinite(mixed), mixed, heights[row, column])


def _sample(frames: OrthophotoFrames, k: int, places: np.ndarray) -> np.ndarray:
    """Return colours and opacity (M, 4) of places (M, 3) in a frame."""
    image = frames.read(k)
    camera = frames.cameras[str(frames.camera_of[k])].scaled(image.shape[1], image.shape[0])
    pixels = opencv_pixels(camera.project(frames.poses.to_camera(places, k))).astype(np.float32)
    found = np.zeros((len(places), 4), np.uint8)
    step = 32_000  # columns that cv2.remap takes
    for first in range(0, len(pixels), step):
        some = pixels[first : first + step]
        colours = cv2.remap(
            image,
            some[None, :, 0],
            some[None, :, 1],
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
        )[0]
        found[first : first + step, :3] = colours[:, 2::-1]
        opaque = colours[:, 3] == 255 if image.shape[2] == 4 else np.ones(len(colours), bool)
        found[first : first + step, 3] = np.where(opaque, 255, 0)
    found[found[:, 3] == 0] = 0
    return found
