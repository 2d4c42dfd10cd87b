"""Copy of a model with additional images that have poses and observe its points."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from spn_data.colmap import pycolmap
from spn_data.colmap.model import load_native, write_native
from spn_data.colmap.verify import native_camera
from spn_data.errors import StageError
from spn_data.geometry.camera import Camera
from spn_data.labels.labels import LabelObservations, Labels


def write_extended(
    source: Path,
    target: Path,
    labels: Labels,
    seen: LabelObservations,
    cameras: dict[str, Camera],
    *,
    text: bool = False,
) -> None:
    """Write a copy of a model with each labelled frame as an additional image.

    Images, cameras and point positions of `source` do not change; the observations in `seen` are appended to
    the tracks of its points.

    Parameters
    ----------
    source : Path
        Folder of the model.
    target : Path
        Folder to write.
    labels : Labels
        Registered frames that are not in the model.
    seen : LabelObservations
        Map points that these frames observe.
    cameras : dict of str to Camera
        Cameras of the frames by key.
    text : bool
        Write COLMAP's text format instead of the binary one.

    Raises
    ------
    FormatError
        If `source` is not a complete model.
    StageError
        If the disk is full.
    """
    native = load_native(source)
    camera_ids = {}
    first = max(native.cameras, default=0) + 1
    for camera_id, key in enumerate(sorted(set(labels.cameras.tolist())), first):
        camera_ids[key] = camera_id
        native.add_camera_with_trivial_rig(
            native_camera(cameras[key], camera_id=camera_id, focal_is_known=True)
        )
    quats_xyzw, translations = labels.poses.to_cam_from_world()
    # A trivial frame gets its image's id, so the id must not be used by another frame either.
    first = max([*native.images, *native.frames], default=0) + 1
    for row, name in enumerate(labels.names.tolist()):
        image_id = first + row
        point_ids, pixels = seen.of_frame(row)
        image = pycolmap.Image(
            name=name,
            keypoints=np.ascontiguousarray(pixels, dtype=np.float64).reshape(-1, 2),
            camera_id=camera_ids[str(labels.cameras[row])],
            image_id=image_id,
        )
        rotation = pycolmap.Rotation3d(quats_xyzw[row])
        native.add_image_with_trivial_frame(image, pycolmap.Rigid3d(rotation, translations[row]))
        for point2d_idx, point_id in enumerate(point_ids.tolist()):
            native.add_observation(point_id, pycolmap.TrackElement(image_id, point2d_idx))
    if not text:
        write_native(native, target)
        return
    target.mkdir(parents=True, exist_ok=True)
    native.write_text(str(target))
    # COLMAP does not report write errors on a full disk.
    try:
        written = pycolmap.Reconstruction()
        written.read_text(str(target))
        complete = written.num_points3D() == native.num_points3D()
        complete = complete and written.num_reg_images() == native.num_reg_images()
    except (RuntimeError, ValueError, IndexError):
        complete = False
    if not complete:
        raise StageError(f"{target}: could not be written completely; is the disk full?")
