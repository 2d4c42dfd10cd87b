"""COLMAP model files and the values they hold."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spn_data.colmap import pycolmap
from spn_data.errors import FormatError, StageError
from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses, Similarity
from spn_data.labels.map_points import MapPoints


@dataclass(frozen=True, eq=False)
class Scene:
    """A reconstruction in COLMAP's own gauge (arbitrary origin, rotation and unit).

    names : the registered images, sorted; poses : of these; camera_ids : (N,); cameras : by id;
    points : (P, 3); point_errors_px : (P,); track_lengths : (P,).
    """

    names: tuple[str, ...]
    poses: Poses
    camera_ids: np.ndarray
    cameras: dict[int, Camera]
    points: np.ndarray
    point_errors_px: np.ndarray
    track_lengths: np.ndarray


@dataclass(frozen=True, eq=False)
class MapObservations:
    """Every measurement of a point in an image, M in all.

    image_idx : (M,) position in Scene.names; point_idx : (M,) position in Scene.points;
    pixels : (M, 2) measured; residuals_px : (M, 2) projected minus measured.
    """

    image_idx: np.ndarray
    point_idx: np.ndarray
    pixels: np.ndarray
    residuals_px: np.ndarray


def load_native(folder: Path) -> pycolmap.Reconstruction:
    """Raises FormatError where a file is missing or cut short, which COLMAP itself passes over."""
    try:
        _check_whole(folder / "images.bin", _end_of_image)
        _check_whole(folder / "points3D.bin", _end_of_point)
        return pycolmap.Reconstruction(str(folder))
    except (RuntimeError, ValueError, IndexError, OSError) as error:
        raise FormatError(f"{folder}: not a complete COLMAP model ({error})") from error


def _check_whole(path: Path, end_of: Callable[[bytes, int], int]) -> None:
    """ValueError unless the file holds just the number of records that its head says."""
    data = path.read_bytes()
    try:
        (count,) = struct.unpack_from("<Q", data)
        offset = 8
        for _ in range(count):
            offset = end_of(data, offset)
    except (struct.error, ValueError):
        offset = -1
    if offset != len(data):
        raise ValueError(f"{path.name} is cut short or damaged")


def _end_of_image(data: bytes, offset: int) -> int:
    """Id, pose (7 doubles), camera id, name, then 24 bytes a point."""
    end_of_name = data.index(b"\0", offset + 64) + 1
    (points,) = struct.unpack_from("<Q", data, end_of_name)
    return int(end_of_name + 8 + 24 * points)


def _end_of_point(data: bytes, offset: int) -> int:
    """Id, position (3 doubles), colour (3 bytes), error, then 8 bytes a track element."""
    (length,) = struct.unpack_from("<Q", data, offset + 43)
    return int(offset + 51 + 8 * length)


def count_registered(folder: Path) -> int:
    """Number of images with a pose."""
    return int(load_native(folder).num_reg_images())


def read_scene(folder: Path) -> Scene:
    return scene_of(load_native(folder))


def scene_of(native: pycolmap.Reconstruction) -> Scene:
    images = sorted(registered_images(native), key=lambda image: image.name)
    rigid = [image.cam_from_world() for image in images]
    points = [native.points3D[i] for i in sorted(native.points3D)]
    return Scene(
        tuple(image.name for image in images),
        Poses.from_cam_from_world(
            np.array([r.rotation.quat for r in rigid]).reshape(-1, 4),
            np.array([r.translation for r in rigid]).reshape(-1, 3),
        ),
        np.array([image.camera_id for image in images], dtype=np.int64),
        {i: from_native_camera(camera) for i, camera in native.cameras.items()},
        np.array([p.xyz for p in points]).reshape(-1, 3),
        np.array([p.error for p in points]),
        np.array([p.track.length() for p in points], dtype=np.int64),
    )


def read_observations(folder: Path) -> tuple[Scene, MapObservations]:
    """The scene with all its measurements."""
    native = load_native(folder)
    scene = scene_of(native)
    return scene, observations_of(native, scene)


def read_map(folder: Path) -> tuple[Scene, MapObservations, MapPoints]:
    """The scene, its measurements, and its points with ids and colours, in the order of Scene.points."""
    return _map_of(load_native(folder))


def read_map_with_features(
    folder: Path,
) -> tuple[Scene, MapObservations, MapPoints, dict[str, np.ndarray]]:
    """As `read_map`, and the point id of every feature (K,) by image name, -1 where it is no point.

    Features are in the order of the database.
    """
    native = load_native(folder)
    of_features = {
        image.name: np.array(
            [p.point3D_id if p.has_point3D() else -1 for p in image.points2D], dtype=np.int64
        )
        for image in registered_images(native)
    }
    return *_map_of(native), of_features


def _map_of(native: pycolmap.Reconstruction) -> tuple[Scene, MapObservations, MapPoints]:
    scene = scene_of(native)
    ids = sorted(native.points3D)
    colors = np.array([native.points3D[i].color for i in ids], dtype=np.uint8).reshape(-1, 3)
    points = MapPoints(np.array(ids, np.int64), scene.points, colors, scene.track_lengths)
    return scene, observations_of(native, scene), points


def observations_of(native: pycolmap.Reconstruction, scene: Scene) -> MapObservations:
    point_position = {point_id: k for k, point_id in enumerate(sorted(native.points3D))}
    image_idx, point_idx, pixels, residuals = [], [], [], []
    by_name = {image.name: image for image in registered_images(native)}
    for k, name in enumerate(scene.names):
        image = by_name[name]
        seen = image.get_observation_points2D()
        if not seen:
            continue
        index = np.array([point_position[p.point3D_id] for p in seen])
        measured = np.array([p.xy for p in seen])
        pose = scene.poses[k : k + 1]
        in_camera = (scene.points[index] - pose.centers[0]) @ pose.rotations[0].T
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
    """The same model in another frame, in COLMAP's binary format."""
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
    """Write a model and read it back: COLMAP does not notice a disk that is full. Raises StageError then."""
    target.mkdir(parents=True, exist_ok=True)
    native.write(str(target))
    try:
        found = load_native(target)
        whole = found.num_points3D() == native.num_points3D()
    except FormatError:
        whole = False
    if not whole:
        raise StageError(f"{target}: cannot be written whole; is the disk full?")


def from_native_camera(camera: pycolmap.Camera) -> Camera:
    try:
        return Camera(camera.model_name, camera.width, camera.height, np.array(camera.params))
    except ValueError as error:
        raise FormatError(str(error)) from error


_DISTORTION = {"SIMPLE_RADIAL": 1, "RADIAL": 2, "OPENCV": 4, "PINHOLE": 0, "SIMPLE_PINHOLE": 0}


def upgrade_camera(camera: Any, model: str) -> None:
    """Change COLMAP's camera in place to a fuller model with the same projection, if it is fuller."""
    old = from_native_camera(camera)
    if _DISTORTION[model] <= _DISTORTION[old.model]:
        return
    fx, fy = old.focal_px
    cx, cy = old.matrix[:2, 2]
    focals = (fx, fy) if model in ("OPENCV", "PINHOLE") else (fx,)
    camera.model = getattr(pycolmap.CameraModelId, model)
    camera.params = [*focals, cx, cy, *old.opencv_distortion[: _DISTORTION[model]]]


def registered_images(native: pycolmap.Reconstruction) -> list[Any]:
    return [native.images[i] for i in native.reg_image_ids()]
