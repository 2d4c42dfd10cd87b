"""Decoding of video containers, damaged ones too, and the geometry of stored frames."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np

from spn_data.errors import InputError
from spn_data.media.container import packets


@dataclass(frozen=True)
class Orientation:
    """Steps that make a stored image upright: transpose first, then flip."""

    transpose: bool = False
    flip_x: bool = False
    flip_y: bool = False

    def apply(self, image: np.ndarray) -> np.ndarray:
        """Return the upright image."""
        if self.transpose:
            image = cv2.transpose(image)
        if self.flip_x or self.flip_y:
            image = cv2.flip(image, -1 if self.flip_x and self.flip_y else int(self.flip_x))
        return image


def video_stream(container: Any, path: Path) -> Any:
    """Return the best video stream; raise InputError if there is none."""
    stream = container.streams.best("video")
    if stream is None:
        raise InputError("contains no video stream", path=path)
    return stream


def decoded_frames(container: Any, stream: Any) -> Iterator[tuple[Any, int]]:
    """Yield (frame, 0) for each decoded frame and (None, 1) for each packet that cannot be decoded."""
    demuxed = packets(container, [stream])
    while True:
        try:
            packet = next(demuxed)
        except StopIteration:
            return
        except av.error.FFmpegError:  # the container is cut off here
            yield None, 1
            return
        try:
            frames = packet.decode()
        except av.error.EOFError:
            return
        except av.error.FFmpegError:
            yield None, 1
            continue
        for frame in frames:
            yield frame, 0


def frame_orientation(frame: Any) -> Orientation:
    """Read the orientation from the display matrix (a, b, u, c, d, v, x, y, w).

    x' = a x + c y, y' = b x + d y (ISO 14496-12).
    """
    for data in frame.side_data:
        if data.type.name == "DISPLAYMATRIX":
            a, b, _, c, d = np.frombuffer(data, np.int32)[:5].tolist()
            if abs(b) + abs(c) > abs(a) + abs(d):
                return Orientation(True, flip_x=c < 0, flip_y=b < 0)
            return Orientation(False, flip_x=a < 0, flip_y=d < 0)
    return Orientation()


def pixel_aspect_ratio(stream: Any) -> Fraction:
    """Return width over height of a stored pixel; 1 if the file does not state it."""
    ratio = stream.sample_aspect_ratio
    return Fraction(ratio) if ratio and Fraction(1, 4) <= ratio <= 4 else Fraction(1)


def upright_size(frame: Any, orientation: Orientation, aspect: Fraction) -> tuple[int, int]:
    """Return (width, height) of the upright frame with square pixels."""
    width, height = round(frame.width * aspect), int(frame.height)
    return (height, width) if orientation.transpose else (width, height)
