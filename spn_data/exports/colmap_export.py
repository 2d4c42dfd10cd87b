"""A COLMAP model of the map and, as images more, of the evaluation frames.

In COLMAP's own convention: world-to-camera rotation and translation, pixels from the upper-left corner.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from spn_data.colmap.extend import write_extended
from spn_data.exports.exported_frames import ExportedFrames

FOLDER_OF_MODEL = "sparse/0"
FOLDER_OF_IMAGES = "images"


def write_colmap(folder: Path, frames: ExportedFrames, map_folder: Path, *, text: bool) -> None:
    """sparse/0: the model in `map_folder`, whole, and the evaluation frames."""
    rows = np.flatnonzero(frames.is_evaluation)
    write_extended(
        map_folder,
        folder / FOLDER_OF_MODEL,
        frames.labels.select(rows),
        frames.seen.select(rows),
        frames.cameras,
        text=text,
    )
