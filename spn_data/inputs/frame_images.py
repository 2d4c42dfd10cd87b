"""Full-size images of labelled frames: stored ones from their files, tracked ones from the video."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from operator import itemgetter
from pathlib import Path

import cv2
import numpy as np

from spn_data.area.area import Area
from spn_data.area.names import EVALUATION, FRAMES
from spn_data.capture import video
from spn_data.errors import InputError
from spn_data.inputs.source_videos import find_videos
from spn_data.labels.labels import Labels

STORED = "frames"  # subfolder of the stage of an evaluation sequence, with its images


def frame_images(
    area: Area, labels: Labels, *, video_folder: Path | None = None
) -> Iterator[tuple[int, np.ndarray]]:
    """Iterate over the full-size images of frames, with two images in memory at a time.

    Parameters
    ----------
    area : Area
    labels : Labels
        The frames.
    video_folder : Path or None
        Where to look first for the videos of tracked frames.

    Yields
    ------
    row : int
        Row of `labels`; each row once, sequence by sequence, in their order, as far as that of the video.
    image : ndarray, shape (H, W, 3), uint8
        BGR image.

    Raises
    ------
    InputError
        If a file cannot be read.
    StageError
        If a video is not found.
    """
    sequences = np.unique(labels.sequences).tolist()
    videos = {  # find all of them first, so that a missing one is reported before any work
        sequence: find_videos(area, sequence, video_folder)
        for sequence in sequences
        if labels.tracked[labels.sequences == sequence].any()
    }
    for sequence in sequences:
        mine = np.flatnonzero(labels.sequences == sequence)
        stored = (
            (row, stored_image(area, str(labels.names[row]), sequence))
            for row in mine[~labels.tracked[mine]].tolist()
        )
        tracked = mine[labels.tracked[mine]]
        decoded = _decoded(videos[sequence], labels, tracked) if len(tracked) else iter(())
        yield from heapq.merge(stored, decoded, key=itemgetter(0))


def image_path(area: Area, name: str, sequence: str) -> Path:
    """Return the image file of a chosen frame."""
    if area.has(f"{EVALUATION}/{sequence}"):
        return area.folder(f"{EVALUATION}/{sequence}") / STORED / name
    return area.folder(FRAMES) / name


def stored_image(area: Area, name: str, sequence: str) -> np.ndarray:
    """Read the image of a chosen frame, BGR; raise InputError if it is missing or damaged."""
    path = image_path(area, name, sequence)
    image = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise InputError("is missing or cannot be decoded as an image", path=path)
    return image


def _decoded(
    parts: tuple[Path, ...], labels: Labels, rows: np.ndarray
) -> Iterator[tuple[int, np.ndarray]]:
    for part in parts:
        wanted = {
            int(labels.video_frame[row]): int(row)
            for row in rows
            if labels.sources[row] == part.name
        }
        for frame in video.decode(part, wanted=wanted.keys()) if wanted else ():
            if frame.image is not None:
                yield wanted.pop(frame.index), frame.image
        if wanted:
            raise InputError(f"no longer contains frame {min(wanted)}", path=part)
