"""Export as `transforms.json` of nerfstudio.

World z is up. Cameras have OpenGL's axes: x right, y up, z backwards; `transform_matrix` is world from
camera. Intrinsics are those of OpenCV's model in pixels, with COLMAP's half-pixel offset, as written by
nerfstudio's own converter. https://docs.nerf.studio/quickstart/data_conventions.html
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from spn_data.exports.exported_frames import ExportedFrames
from spn_data.geometry.camera import Camera
from spn_data.storage.json_files import write_json

IMAGE_FOLDER = "images"
_OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0])


def write_nerfstudio(folder: Path, frames: ExportedFrames) -> None:
    """Write `transforms.json`.

    Parameters
    ----------
    folder : Path
        Folder of the export.
    frames : ExportedFrames
        Frames to export.

    Notes
    -----
    Intrinsics are written once if all frames share them, otherwise with each frame. Evaluation frames
    become nerfstudio's validation and test images.
    """
    labels = frames.labels
    content: dict[str, Any] = {"camera_model": "OPENCV", "units": frames.units}
    if frames.origin is not None:
        content["world"] = frames.world
    keys = sorted(set(labels.cameras.tolist()))
    if len(keys) == 1:
        content |= _intrinsics(frames.cameras[keys[0]])
    paths = [f"{IMAGE_FOLDER}/{name}" for name in labels.names.tolist()]
    content["frames"] = []
    for row, path in enumerate(paths):
        matrix = np.eye(4)
        matrix[:3, :3] = labels.poses.rotations[row].T @ _OPENGL_FROM_OPENCV
        matrix[:3, 3] = labels.poses.centers[row]
        frame: dict[str, Any] = {"file_path": path, "transform_matrix": matrix.tolist()}
        if len(keys) > 1:
            frame |= _intrinsics(frames.camera_of(row))
        content["frames"].append(frame)
    if frames.is_evaluation.any() and not frames.is_evaluation.all():
        held_out = [p for p, is_out in zip(paths, frames.is_evaluation, strict=True) if is_out]
        content["train_filenames"] = [p for p in paths if p not in set(held_out)]
        # nerfstudio requires all three lists if any is given.
        content["val_filenames"] = content["test_filenames"] = held_out
    write_json(folder / "transforms.json", content)


def _intrinsics(camera: Camera) -> dict[str, Any]:
    fx, fy = camera.focal_px
    cx, cy = camera.matrix[:2, 2]
    k1, k2, p1, p2 = camera.opencv_distortion
    numbers = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "k1": k1, "k2": k2, "p1": p1, "p2": p2}
    return {
        "w": camera.width,
        "h": camera.height,
        **{name: float(value) for name, value in numbers.items()},
    }
