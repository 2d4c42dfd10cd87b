"""Export as a VisualSFM model, as if the images were undistorted and centred on the principal point."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from spn_data.dataset.nvm import build_nvm_model, offsets_from_center, write_nvm
from spn_data.exports.exported_frames import ExportedFrames


def write_nvm_export(folder: Path, frames: ExportedFrames) -> None:
    """Write `reconstruction.nvm`: cameras without distortion, with the mean of both focal lengths."""
    labels, seen = frames.labels, frames.seen
    focal_px = np.array([np.mean(frames.camera_of(row).focal_px) for row in range(len(frames))])
    offsets = np.empty((len(seen.pixels), 2))
    ends = np.searchsorted(seen.frame_idx, np.arange(len(frames) + 1))
    for row in range(len(frames)):
        mine = slice(ends[row], ends[row + 1])
        camera = frames.camera_of(row)
        offsets[mine] = offsets_from_center(camera, seen.pixels[mine], float(focal_px[row]))
    model = build_nvm_model(
        tuple(labels.names.tolist()),
        labels.poses,
        focal_px,
        (frames.points.xyz, frames.points.colors),
        (frames.points.rows_of(seen.point_ids), seen.frame_idx, offsets),
    )
    write_nvm(folder / "reconstruction.nvm", model)
