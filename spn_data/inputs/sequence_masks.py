"""Image masks of sequences, as given by the user and as stored in the area."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from spn_data.capture.frames import Frames
from spn_data.capture.photos import load_mask
from spn_data.capture.sources import Source, SourceKind
from spn_data.capture.video import probe
from spn_data.errors import InputError


def find_masks(sources: tuple[Source, ...], given: str | None) -> dict[str, Path]:
    """Return the mask of each sequence that has one; raise InputError if a folder contains none of them."""
    if given is None:
        return {}
    path = Path(given)
    if not path.is_dir():
        return {source.sequence: path for source in sources}
    files = {source.sequence: path / f"{source.sequence}.png" for source in sources}
    found = {name: file for name, file in files.items() if file.exists()}
    if not found:
        raise InputError(
            f"contains no mask: none of {', '.join(f.name for f in files.values())}", path=path
        )
    return found


def check_mask(path: Path, source: Source) -> None:
    """Raise InputError if a mask does not fit its video."""
    if source.kind is SourceKind.VIDEO:
        info = probe(source.parts[0])
        load_mask(path, info.width, info.height)


def write_mask(path: Path, frames: Frames, folder: Path) -> None:
    """Write the mask of a source in the size of its images."""
    row = int(np.flatnonzero(frames.width > 0)[0])
    usable = load_mask(path, int(frames.width[row]), int(frames.height[row]))
    ok, data = cv2.imencode(".png", usable.astype(np.uint8) * 255)
    assert ok
    (folder / f"{frames.sequences[0]}.png").write_bytes(data.tobytes())
