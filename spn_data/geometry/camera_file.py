"""Cameras as JSON objects (model, width, height, params in COLMAP's order), and default cameras."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from spn_data.errors import InputError
from spn_data.geometry.camera import Camera
from spn_data.geometry.json_values import numbers, parse_file

_MAX_BYTES = 100_000
SHAPE_TOLERANCE = 0.01  # relative, between the aspect ratios of a given camera and of images


def camera_to_json(camera: Camera) -> dict[str, Any]:
    """Return a camera as plain values for `json.dumps`."""
    return {
        "model": camera.model,
        "width": camera.width,
        "height": camera.height,
        "params": [float(p) for p in camera.params],
    }


def camera_from_json(value: dict[str, Any]) -> Camera:
    """Return the camera that a JSON object describes.

    Parameters
    ----------
    value : dict
        With the keys model, width, height and params.

    Raises
    ------
    KeyError, TypeError, ValueError
        If it does not describe a valid camera.
    """
    if not isinstance(value, dict):
        raise TypeError(f"{type(value).__name__} instead of an object")
    camera = Camera(
        str(value["model"]),
        int(numbers(value["width"])),
        int(numbers(value["height"])),
        numbers(value["params"], len(value["params"])),
    )
    if min(camera.focal_px) <= 0:
        raise ValueError("its focal length is not positive")
    if not (0 < camera.width <= 100_000 and 0 < camera.height <= 100_000):
        raise ValueError(f"its image size of {camera.width}x{camera.height} is not valid")
    return camera


def read_camera(path: str | PathLike[str]) -> Camera:
    """Read a camera from a JSON file.

    Parameters
    ----------
    path : str or path-like
        JSON with model, width, height and params, as `spn-data register` writes it.

    Returns
    -------
    Camera

    Raises
    ------
    InputError
        If the file does not contain a valid camera.
    """
    path = Path(path)
    try:
        return camera_from_json(parse_file(path, max_bytes=_MAX_BYTES))
    except (OSError, ValueError, KeyError, TypeError, OverflowError) as error:
        why = f"{error} is missing" if isinstance(error, KeyError) else str(error)[:200]
        raise InputError(
            f"does not contain a camera ({why}); expected model, width, height and params "
            "in COLMAP's order",
            path=path,
        ) from error


def camera_at_size(
    camera: Camera, width: int, height: int, where: Path | str | None = None
) -> Camera:
    """Rescale a given camera to the size of the images it is used for.

    Parameters
    ----------
    camera : Camera
        The camera that the user gave.
    width, height : int
        Size of the images.
    where : Path or str, optional
        File or sequence named in the error message.

    Raises
    ------
    InputError
        If the aspect ratios differ by more than 1 %.
    """
    if abs(camera.width * height / (camera.height * width) - 1) > SHAPE_TOLERANCE:
        raise InputError(
            f"the given camera is for {camera.width}x{camera.height} images, these are {width}x{height}",
            path=where,
        )
    return camera.scaled(width, height)


def camera_from_focal_length(focal_px: float, width: int, height: int) -> Camera:
    """Return a camera of which only the focal length is known: centred, SIMPLE_RADIAL, with k1 = 0."""
    params = np.array([focal_px, width / 2, height / 2, 0.0])
    return Camera("SIMPLE_RADIAL", width, height, params)
