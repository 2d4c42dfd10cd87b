"""Full-size images of labelled frames: stored ones from their files, tracked ones from the video."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from spn_data.area.area import Area
from spn_data.area.names import EVALUATION, FRAMES
from spn_data.capture import video
from spn_data.errors import InputError
from spn_data.inputs.source_videos import find_videos
from spn_data.labels.labels import Labels

STORED = "frames"  # folder of the images of an evaluation sequence, inside its stage


def frame_images(
    area: Area, labels: Labels, *, video_folder: Path | None = None
) -> Iterator[tuple[int, np.ndarray]]:
    """(row, (H, W, 3) uint8 BGR) of every frame, once each, by sequence; one image in memory at a time.

    Raises InputError for a file that can't be read, StageError where a video is not found.
    """
    sequences = np.unique(labels.sequences).tolist()
    videos = {  # all of them first: a missing one is told before any work
        sequence: find_videos(area, sequence, video_folder)
        for sequence in sequences
        if labels.tracked[labels.sequences == sequence].any()
    }
    for sequence in sequences:
        mine = np.flatnonzero(labels.sequences == sequence)
        for row in mine[~labels.tracked[mine]].tolist():
            yield row, _stored(area, str(labels.names[row]), sequence)
        tracked = mine[labels.tracked[mine]]
        if len(tracked):
            yield from _decoded(videos[sequence], labels, tracked)


def image_path(area: Area, name: str, sequence: str) -> Path:
    """File of a frame that was chosen."""
    if area.has(f"{EVALUATION}/{sequence}"):
        return area.folder(f"{EVALUATION}/{sequence}") / STORED / name
    return area.folder(FRAMES) / name


def _stored(area: Area, name: str, sequence: str) -> np.ndarray:
    path = image_path(area, name, sequence)
    image = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise InputError("is missing, or no image that can be decoded", path=path)
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
            raise InputError(f"frame {min(wanted)} is not in it any more", path=part)
