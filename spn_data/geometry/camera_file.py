"""A camera as a JSON object: model, width, height, params (COLMAP's order, pixels); and for images."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from spn_data.errors import InputError
from spn_data.geometry.camera import Camera

_MAX_BYTES = 100_000


def camera_to_json(camera: Camera) -> dict[str, Any]:
    """Plain values for json.dumps."""
    return {
        "model": camera.model,
        "width": camera.width,
        "height": camera.height,
        "params": [float(p) for p in camera.params],
    }


def camera_from_json(value: dict[str, Any]) -> Camera:
    """Raises KeyError, TypeError or ValueError where it is no camera."""
    camera = Camera(
        str(value["model"]),
        int(value["width"]),
        int(value["height"]),
        np.array(value["params"], dtype=np.float64),
    )
    if not (np.isfinite(camera.params).all() and min(camera.focal_px) > 0):
        raise ValueError("its parameters are no camera's")
    if not (0 < camera.width <= 100_000 and 0 < camera.height <= 100_000):
        raise ValueError(f"its image is {camera.width}x{camera.height}")
    return camera


def read_camera(path: Path) -> Camera:
    """Raises InputError where the file holds no camera."""
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise InputError("is too large to hold a camera", path=path)
        return camera_from_json(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"is no camera ({error}): expected model, width, height and params in COLMAP's order",
            path=path,
        ) from error


def camera_at_size(camera: Camera, width: int, height: int, where: Path | str) -> Camera:
    """A given camera for images of a size. Raises InputError, for `where`, where their shape is another."""
    if abs(camera.width * height / (camera.height * width) - 1) > 0.01:
        raise InputError(
            f"the given camera is of {camera.width}x{camera.height}, the images are {width}x{height}",
            path=where,
        )
    return camera.scaled(width, height)


def camera_from_focal_length(focal_px: float, width: int, height: int) -> Camera:
    """A lens of which nothing but a focal length is known: centred, with a radial term of 0."""
    params = np.array([focal_px, width / 2, height / 2, 0.0])
    return Camera("SIMPLE_RADIAL", width, height, params)
