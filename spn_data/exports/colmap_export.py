"""A COLMAP model of the map, extended by the evaluation frames as additional images.

COLMAP's own convention applies: world-to-camera rotation and translation, pixels from the upper-left corner.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from spn_data.colmap.extend import write_extended
from spn_data.exports.exported_frames import ExportedFrames

MODEL_FOLDER = "sparse/0"
IMAGE_FOLDER = "images"


def write_colmap(folder: Path, frames: ExportedFrames, map_folder: Path, *, text: bool) -> None:
    """Write the whole model of `map_folder` plus the evaluation frames to `sparse/0`.

    Parameters
    ----------
    folder : Path
        Folder of the export.
    frames : ExportedFrames
        Frames to export; only evaluation frames are added, the mapping frames are in the model already.
    map_folder : Path
        Folder of the map's COLMAP model.
    text : bool
        Write COLMAP's text files instead of the binary ones.
    """
    rows = np.flatnonzero(frames.is_evaluation)
    write_extended(
        map_folder,
        folder / MODEL_FOLDER,
        frames.labels.select(rows),
        frames.seen.select(rows),
        frames.cameras,
        text=text,
    )
