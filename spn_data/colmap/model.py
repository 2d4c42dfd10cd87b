"""COLMAP models: reading, writing, and the values that they contain."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spn_data.colmap import pycolmap
from spn_data.colmap.model_files import (
    PointTable,
    check_whole,
    count_images,
    read_keypoints,
    read_points,
)
from spn_data.errors import FormatError, StageError
from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses, Similarity
from spn_data.labels.map_points import MapPoints


@dataclass(frozen=True, eq=False)
class Scene:
    """Reconstruction in its own gauge (arbitrary origin, rotation and scale).

    Attributes
    ----------
    names : tuple of str
        Registered images, sorted.
    poses : Poses
        N poses of these images.
    camera_ids : ndarray, shape (N,)
        COLMAP's camera id of each image.
    cameras : dict of int to Camera
        By COLMAP's camera id.
    points : ndarray, shape (P, 3)
    track_lengths : ndarray, shape (P,)
    """

    names: tuple[str, ...]
    poses: Poses
    camera_ids: np.ndarray
    cameras: dict[int, Camera]
    points: np.ndarray
    track_lengths: np.ndarray


@dataclass(frozen=True, eq=False)
class MapObservations:
    """M measurements of points in images.

    Attributes
    ----------
    image_idx : ndarray, shape (M,)
        Row in ``Scene.names``.
    point_idx : ndarray, shape (M,)
        Row in ``Scene.points``.
    pixels : ndarray, shape (M, 2)
        Measured.
    residuals_px : ndarray, shape (M, 2)
        Projected minus measured.
    """

    image_idx: np.ndarray
    point_idx: np.ndarray
    pixels: np.ndarray
    residuals_px: np.ndarray


def load_native(folder: Path) -> pycolmap.Reconstruction:
    """Load a model as pycolmap's object.

    Raises FormatError if a file is missing or cut short, which COLMAP itself ignores.
    """
    with _reading(folder):
        check_whole(folder)
        return pycolmap.Reconstruction(str(folder))


@contextmanager
def _reading(folder: Path) -> Iterator[None]:
    try:
        yield
    except (RuntimeError, ValueError, KeyError, IndexError, OSError) as error:
        raise FormatError(f"{folder}: not a complete COLMAP model ({error})") from error


def count_registered(folder: Path) -> int:
    """Read the number of images with a pose from a file's header.

    Raises FormatError if the file is missing or empty.
    """
    with _reading(folder):
        return count_images(folder)


def is_whole(folder: Path) -> bool:
    """Return whether a model is complete: all files are there and none is cut short."""
    try:
        load_native(folder)
    except FormatError:
        return False
    return True


def read_scene(folder: Path) -> Scene:
    """Read a model without its measurements.

    Parameters
    ----------
    folder : Path
        Folder of a COLMAP model in binary format.

    Returns
    -------
    Scene

    Raises
    ------
    FormatError
        If a file is missing, cut short or damaged.
    """
    with _reading(folder):
        return _scene(load_native(folder), read_points(folder))


def scene_of(native: pycolmap.Reconstruction) -> Scene:
    """Return the values of a pycolmap reconstruction in memory."""
    points = [(i, native.points3D[i]) for i in sorted(native.points3D)]
    table = PointTable(
        np.array([i for i, _ in points], np.int64),
        np.array([p.xyz for _, p in points]).reshape(-1, 3),
        np.array([p.color for _, p in points], np.uint8).reshape(-1, 3),
        np.array([p.track.length() for _, p in points], dtype=np.int64),
    )
    return _scene(native, table)


def _scene(native: pycolmap.Reconstruction, points: PointTable) -> Scene:
    images = sorted(registered_images(native), key=lambda image: image.name)
    rigid = [image.cam_from_world() for image in images]
    return Scene(
        tuple(image.name for image in images),
        Poses.from_cam_from_world(
            np.array([r.rotation.quat for r in rigid]).reshape(-1, 4),
            np.array([r.translation for r in rigid]).reshape(-1, 3),
        ),
        np.array([image.camera_id for image in images], dtype=np.int64),
        {i: from_native_camera(camera) for i, camera in native.cameras.items()},
        points.xyz,
        points.track_lengths,
    )


def read_map(folder: Path) -> tuple[Scene, MapObservations, MapPoints]:
    """Read a model with its measurements and the ids and colours of its points.

    Parameters
    ----------
    folder : Path
        Folder of a COLMAP model in binary format.

    Returns
    -------
    scene : Scene
    observations : MapObservations
    points : MapPoints
        In the order of ``scene.points``.

    Raises
    ------
    FormatError
        If a file is missing, cut short or damaged.
    """
    scene, observations, points, _ = read_map_with_keypoints(folder)
    return scene, observations, points


def read_map_with_keypoints(
    folder: Path,
) -> tuple[Scene, MapObservations, MapPoints, dict[str, np.ndarray]]:
    """Read a model as `read_map` does, and which keypoints are points of it.

    Returns
    -------
    scene : Scene
    observations : MapObservations
    points : MapPoints
    point_ids : dict of str to ndarray, shape (K,)
        By image name, the point of each keypoint in the order of the database; -1 if it has none.

    Raises
    ------
    FormatError
        If a file is missing, cut short or damaged.
    """
    with _reading(folder):
        table, keypoints = read_points(folder), read_keypoints(folder)
        scene = _scene(load_native(folder), table)
        points = MapPoints(table.ids, table.xyz, table.colors, table.track_lengths)
        observations = _observations(scene, points, keypoints)
    return scene, observations, points, {name: ids for name, (_, ids) in keypoints.items()}


def _observations(
    scene: Scene, points: MapPoints, keypoints: dict[str, tuple[np.ndarray, np.ndarray]]
) -> MapObservations:
    image_idx, point_idx, pixels, residuals = [], [], [], []
    for k, name in enumerate(scene.names):
        xy, point_ids = keypoints[name]
        seen = point_ids >= 0
        if not seen.any():
            continue
        index, measured = points.rows_of(point_ids[seen]), xy[seen]
        in_camera = scene.poses.to_camera(scene.points[index], k)
        projected = scene.cameras[int(scene.camera_ids[k])].project(in_camera)
        image_idx.append(np.full(len(index), k))
        point_idx.append(index)
        pixels.append(measured)
        residuals.append(projected - measured)
    return MapObservations(
        np.concatenate(image_idx),
        np.concatenate(point_idx),
        np.concatenate(pixels),
        np.concatenate(residuals),
    )


def write_transformed(source: Path, target: Path, world_from_model: Similarity) -> None:
    """Write a model transformed to another frame, in COLMAP's binary format.

    Parameters
    ----------
    source, target : Path
        Folders to read and write.
    world_from_model : Similarity

    Raises
    ------
    FormatError
        If `source` is not a complete model.
    StageError
        If the disk is full.
    """
    native = load_native(source)
    native.transform(
        pycolmap.Sim3d(
            world_from_model.scale,
            pycolmap.Rotation3d(world_from_model.rotation),
            world_from_model.translation,
        )
    )
    write_native(native, target)


def write_native(native: pycolmap.Reconstruction, target: Path) -> None:
    """Write a model and read it back, because COLMAP does not report write errors on a full disk.

    Raises StageError if it was not written completely.
    """
    target.mkdir(parents=True, exist_ok=True)
    native.write(str(target))
    try:
        found = load_native(target)
        whole = found.num_points3D() == native.num_points3D()
    except FormatError:
        whole = False
    if not whole:
        raise StageError(f"{target}: could not be written completely; is the disk full?")


def from_native_camera(camera: pycolmap.Camera) -> Camera:
    """Convert COLMAP's camera. Raises FormatError if its camera model is not supported."""
    try:
        return Camera(camera.model_name, camera.width, camera.height, np.array(camera.params))
    except ValueError as error:
        raise FormatError(str(error)) from error


_DISTORTION = {"SIMPLE_RADIAL": 1, "RADIAL": 2, "OPENCV": 4, "PINHOLE": 0, "SIMPLE_PINHOLE": 0}


def upgrade_camera(camera: Any, model: str) -> None:
    """Change COLMAP's camera in place to a model with more distortion terms and the same projection."""
    old = from_native_camera(camera)
    if _DISTORTION[model] <= _DISTORTION[old.model]:
        return
    fx, fy = old.focal_px
    cx, cy = old.matrix[:2, 2]
    focals = (fx, fy) if model in ("OPENCV", "PINHOLE") else (fx,)
    camera.model = getattr(pycolmap.CameraModelId, model)
    camera.params = [*focals, cx, cy, *old.opencv_distortion[: _DISTORTION[model]]]


def registered_images(native: pycolmap.Reconstruction) -> list[Any]:
    """Return the images with a pose, as objects of pycolmap."""
    return [native.images[i] for i in native.reg_image_ids()]
