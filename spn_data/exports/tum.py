"""Trajectories in the format of TUM's RGB-D benchmark, one file per sequence.

Each line is `timestamp tx ty tz qx qy qz qw`: seconds, the camera centre in the world, and the rotation from
camera axes to world axes, scalar last.
https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from spn_data.exports.exported_frames import ExportedFrames, timestamps_us
from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import conjugate_quats, scalar_last
from spn_data.storage.files import write_atomically


def write_tum(folder: Path, frames: ExportedFrames) -> None:
    """Write one file `<sequence>.txt` per sequence."""
    for name, rows in frames.sequences():
        text = tum_text(name, frames.labels.time_s[rows], frames.labels.poses[rows], frames.world)
        write_atomically(folder / f"{name}.txt", text)


def tum_text(sequence: str, time_s: np.ndarray, poses: Poses, world: str) -> str:
    """Format the trajectory of one sequence as the content of a TUM file.

    Parameters
    ----------
    sequence : str
        Name of the sequence, for the header.
    time_s : ndarray, shape (N,)
        Ascending times since the sequence's first frame, written with six decimals (`timestamps_us`).
    poses : Poses
        N finite poses, written with nine decimals.
    world : str
        One-line description of the world frame, for the header.

    Returns
    -------
    str
        Three header lines starting with `#`, then one line per frame.
    """
    lines = [
        f"# {sequence}: camera poses, world from camera",
        f"# {world}",
        "# timestamp (s since the sequence's first frame) tx ty tz qx qy qz qw",
    ]
    # Conjugates rotate camera axes to world axes.
    quats_xyzw = scalar_last(conjugate_quats(poses.quats_wxyz))
    for stamp, center, quat in zip(timestamps_us(time_s), poses.centers, quats_xyzw, strict=True):
        numbers = " ".join(f"{value:.9f}" for value in (*center, *quat))
        lines.append(f"{stamp / 1e6:.6f} {numbers}")
    return "\n".join(lines) + "\n"
