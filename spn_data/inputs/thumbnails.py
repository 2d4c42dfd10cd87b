"""Thumbnails of the frames of an area for the report, within a budget, and their cache."""

from __future__ import annotations

import base64
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from spn_data.area.area import Area
from spn_data.area.names import THUMBNAILS
from spn_data.capture.photos import decode_reduced
from spn_data.errors import FormatError, InputError
from spn_data.inputs.frame_images import image_path
from spn_data.report.data import FAILED, FrameTable
from spn_data.report.pictures import with_image
from spn_data.storage.json_files import DAMAGE, load_json, write_json

MAX_IMAGES = 1500
MAX_BYTES = 3_600_000  # of all together; a third more in the page, which holds base64
_ROUND_TO = 100  # images: so that a few more do not change the size of all
_WIDTHS = (320, 256, 208, 176, 144, 112, 80)
_QUALITIES = (55, 40)
_VERSION = 1


@dataclass(frozen=True, eq=False)
class Thumbnails:
    """Small images of frames.

    Attributes
    ----------
    images : dict of str to bytes
        JPEG files by frame.
    files : dict of str to str
        Paths of the full images, relative to the area.
    notes : tuple of str
        Which frames have none, and why.
    """

    images: dict[str, bytes]
    files: dict[str, str]
    notes: tuple[str, ...]


def read_thumbnails(area: Area, frames: FrameTable, wanted: Collection[str] = ()) -> Thumbnails:
    """Make thumbnails of the stored images of an area, or take them from its cache, which is updated.

    Parameters
    ----------
    area : Area
        Locked, because the cache is written.
    frames : FrameTable
    wanted : collection of str
        Frames that need one where not all can have one; failed frames are next, others evenly.

    Returns
    -------
    Thumbnails

    Raises
    ------
    StageError
        If the cache cannot be written.
    """
    rows = _chosen(frames, wanted)
    most = MAX_BYTES // (_ROUND_TO * max(1, -(-len(rows) // _ROUND_TO)))
    cache = area.root / THUMBNAILS
    kept = _read_cache(cache, most)
    made: dict[str, list[Any]] = {}
    files: dict[str, str] = {}
    broken: list[str] = []
    for name, path in _paths(area, frames, rows).items():
        try:
            stamp = _stamp(area.root, path)
            old = kept.get(name, [])
            made[name] = old if old[:2] == stamp else [*stamp, _thumbnail(path, most)]
            files[name] = path.relative_to(area.root).as_posix()
        except InputError as error:
            broken.append(str(error))
    if made != kept:
        write_json(cache, {"version": _VERSION, "most_bytes": most, "images": made})
    notes = []
    if broken:
        notes.append(f"{len(broken):,} images cannot be shown; the first: {broken[0]}")
    left_out = int(with_image(frames).sum()) - len(rows)
    if left_out:
        notes.append(f"To limit the size of this page, {left_out:,} images are not in it.")
    images = {name: base64.b64decode(value[2]) for name, value in made.items()}
    return Thumbnails(images, files, tuple(notes))


def _chosen(frames: FrameTable, wanted: Collection[str]) -> np.ndarray:
    """Return the rows of frames that get a thumbnail."""
    rows = np.flatnonzero(with_image(frames))
    if len(rows) <= MAX_IMAGES:
        return rows
    is_first = np.isin(frames.names[rows], list(wanted)) | (frames.status[rows] == FAILED)
    first, rest = rows[is_first][: MAX_IMAGES // 2], rows[~is_first]
    even = np.linspace(0, len(rest) - 1, MAX_IMAGES - len(first)).astype(np.int64)
    return np.sort(np.concatenate([first, rest[even]]))


def _paths(area: Area, frames: FrameTable, rows: np.ndarray) -> dict[str, Path]:
    """Return the image file of each frame by its name."""
    folders = {
        sequence: image_path(area, "", sequence)
        for sequence in np.unique(frames.sequences[rows]).tolist()
    }
    return {
        str(frames.names[row]): folders[str(frames.sequences[row])] / str(frames.names[row])
        for row in rows
    }


def _stamp(root: Path, path: Path) -> list[int]:
    """Return size and time of change of a file; raise InputError if it is none of the area."""
    if ".." in path.parts or not path.is_relative_to(root) or not path.is_file():
        raise InputError("is missing, or not a file of the area", path=path)
    status = path.stat()
    return [status.st_size, status.st_mtime_ns]


def _thumbnail(path: Path, most: int) -> str:
    """Return the largest and best thumbnail of an image with at most so many bytes, in base64."""
    image = decode_reduced(path, max_width=_WIDTHS[0])
    for width in _WIDTHS:
        if width > image.shape[1] and width != _WIDTHS[-1]:
            continue
        height = max(1, round(image.shape[0] * width / image.shape[1]))
        small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        for quality in _QUALITIES:
            options = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_OPTIMIZE, 1]
            _, jpeg = cv2.imencode(".jpg", small, options)
            if len(jpeg) <= most:
                return base64.b64encode(jpeg.tobytes()).decode("ascii")
    raise InputError("is too detailed or too tall for a thumbnail", path=path)


def _read_cache(path: Path, most: int) -> dict[str, list[Any]]:
    """Return the cached thumbnails of this size; none if the cache is missing, damaged or of another size."""
    if not path.is_file():
        return {}
    try:
        table = load_json(path, max_bytes=4 * MAX_BYTES)
        if table["version"] != _VERSION or table["most_bytes"] != most:
            return {}
        images = dict(table["images"])
        for size, changed, image in images.values():
            if not (isinstance(size, int) and isinstance(changed, int) and len(image) <= 2 * most):
                raise ValueError("not a thumbnail")
            if base64.b64decode(image, validate=True)[:2] != b"\xff\xd8":
                raise ValueError("not a JPEG file")
        return images
    except (*DAMAGE, FormatError):
        return {}
