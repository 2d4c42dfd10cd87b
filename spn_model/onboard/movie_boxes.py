"""Boxes of MP4 and QuickTime files (ISO 14496-12) that say what OpenCV does not: mirrored video."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

_FIRST = (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip")
_MAX_BOXES = 10_000
_MATRIX_AT = {0: 40, 1: 52}  # in a track header (tkhd), by its version


def is_iso_media(path: Path) -> bool:
    """Return whether a file is an MP4 or QuickTime file, whose index states its number of frames."""
    with path.open("rb") as file:
        return file.read(8)[4:] in _FIRST


def is_mirrored(path: Path) -> bool:
    """Return whether the display matrix of a track of an MP4 or QuickTime file mirrors it."""
    if not is_iso_media(path):
        return False
    with path.open("rb") as file:
        end = file.seek(0, 2)
        for movie in _boxes(file, 0, end, b"moov"):
            for track in _boxes(file, *movie, b"trak"):
                if any(_mirrors(file, *header) for header in _boxes(file, *track, b"tkhd")):
                    return True
    return False


def _boxes(file: BinaryIO, at: int, end: int, wanted: bytes) -> Iterator[tuple[int, int]]:
    """Yield begin and end of the contents of the boxes of one kind between two positions."""
    for _ in range(_MAX_BOXES):
        file.seek(at)
        head = file.read(16)
        if at + 8 > end or len(head) < 8:
            return
        size, kind = struct.unpack(">I4s", head[:8])
        begin = at + 8
        if size == 1 and len(head) == 16:
            size, begin = struct.unpack(">Q", head[8:])[0], at + 16
        stop = end if size == 0 else at + size
        if not begin <= stop <= end:
            return
        if kind == wanted:
            yield begin, stop
        at = stop


def _mirrors(file: BinaryIO, begin: int, end: int) -> bool:
    file.seek(begin)
    content = file.read(min(end - begin, 100))
    at = _MATRIX_AT.get(content[0], len(content)) if content else 0
    if len(content) < at + 20:
        return False
    a, b, _, c, d = struct.unpack(">5i", content[at : at + 20])
    return a * d - b * c < 0
