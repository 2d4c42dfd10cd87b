"""Order of the photos of a folder."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from spn_data.errors import InputError
from spn_data.media.photo_file import JPEG_SUFFIXES, TWIN_SUFFIXES
from spn_data.telemetry.exif import read_photo
from spn_data.telemetry.photo_time import natural_order


def photos_in_order(paths: Sequence[Path]) -> tuple[Path, ...]:
    """Return photos in the order in which they were taken.

    Parameters
    ----------
    paths : sequence of Path
        Photos of one folder. Their headers are read, not their pixels.

    Returns
    -------
    tuple of Path
        By their times, if every readable photo states one on the same kind of clock; photos of equal times,
        and all photos otherwise, by their names, in which numbers count by their value. An unreadable photo
        follows the one before it by name.
    """
    named = sorted(paths, key=lambda path: natural_order(path.name))
    utc_s: list[float | None] = []
    local_s: list[float | None] = []
    for path in named:
        try:
            photo = read_photo(path)
        except InputError:  # reported when the photo is used
            utc_s.append(None)
            local_s.append(None)
        else:
            utc_s.append(photo.utc_s)
            local_s.append(photo.local_s)
    for times in (utc_s, local_s):
        if not any(t is not None and math.isnan(t) for t in times):
            return _by_time(named, times)
    return tuple(named)


def one_file_per_photo(photos: Sequence[Path], ignored: list[tuple[Path, str]]) -> list[Path]:
    """Leave out the DNG or HEIC of which there is a JPEG of the same name in the same folder."""
    jpegs = {(p.parent, p.stem.lower()): p for p in photos if p.suffix.lower() in JPEG_SUFFIXES}
    kept = []
    for path in photos:
        twin = jpegs.get((path.parent, path.stem.lower()))
        if twin is not None and path.suffix.lower() in TWIN_SUFFIXES:
            ignored.append((path, f"the same photo as {twin.name}, which is used"))
        else:
            kept.append(path)
    return kept


def _by_time(named: Sequence[Path], times: Sequence[float | None]) -> tuple[Path, ...]:
    """Sort photos stably by their times; None is the time of the photo before."""
    last = -math.inf
    filled: list[float] = []
    for time_s in times:
        last = last if time_s is None else time_s
        filled.append(last)
    return tuple(named[k] for k in sorted(range(len(named)), key=filled.__getitem__))
