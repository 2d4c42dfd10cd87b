"""COLMAP models built from exact cameras, poses, points and measurements."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from spn_data.colmap import pycolmap
from spn_data.colmap.verify import native_camera
from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses


def native_model(
    cameras: dict[int, Camera],
    camera_ids: Sequence[int],
    names: Sequence[str],
    poses: Poses,
    pixels: Sequence[np.ndarray],
    points: Iterable[tuple[np.ndarray, Iterable[tuple[int, int]]]],
) -> pycolmap.Reconstruction:
    """Build a model of N images with poses; image ids count from one.

    pixels : N arrays (K, 2). points : position (3,) and track of each point, as pairs of the rows of image
    and measurement.
    """
    model = pycolmap.Reconstruction()
    for camera_id, camera in cameras.items():
        model.add_camera_with_trivial_rig(
            native_camera(camera, camera_id=camera_id, focal_is_known=True)
        )
    quats, translations = poses.to_cam_from_world()
    for k, name in enumerate(names):
        image = pycolmap.Image(name=name, camera_id=int(camera_ids[k]), image_id=k + 1)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in pixels[k]])
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(quats[k]), translations[k])
        model.add_image_with_trivial_frame(image, pose)
    for xyz, elements in points:
        track = pycolmap.Track()
        for k, row in elements:
            track.add_element(k + 1, row)
        model.add_point3D(xyz, track, np.zeros(3, np.uint8))
    return model
