"""Trajectories as TUM's RGB-D benchmark writes them, one file a sequence.

`timestamp tx ty tz qx qy qz qw` a line: seconds, the camera's centre in the world, and the rotation of
camera axes into world axes, scalar last.
https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from spn_data.exports.exported_frames import ExportedFrames, timestamps_us
from spn_data.storage.files import write_whole


def write_tum(folder: Path, frames: ExportedFrames) -> None:
    """`<sequence>.txt` each, with six decimals of a second (`timestamps_us`) and nine of the pose."""
    for name, rows in frames.sequences():
        stamps = timestamps_us(frames.labels.time_s[rows])
        poses = frames.labels.poses[rows]
        # The conjugate turns the other way: camera axes into world axes.
        quats_xyzw = np.roll(poses.quats_wxyz * [1, -1, -1, -1], -1, axis=1)
        lines = [
            f"# {name}: camera poses, world from camera",
            f"# {frames.world}",
            "# timestamp (s since the sequence's first frame) tx ty tz qx qy qz qw",
        ]
        for stamp, center, quat in zip(stamps, poses.centers, quats_xyzw, strict=True):
            numbers = " ".join(f"{value:.9f}" for value in (*center, *quat))
            lines.append(f"{stamp / 1e6:.6f} {numbers}")
        write_whole(folder / f"{name}.txt", "\n".join(lines) + "\n")
