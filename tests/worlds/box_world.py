"""Painted hall seen from inside, with exact images, depths and points, for networks that learn a scene."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from spn_data.dataset.hdf5_schema import DatasetFrame, DatasetInfo, Role
from spn_data.dataset.hdf5_writer import DatasetWriter
from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import rotations_from_angles

CAMERA = Camera("SIMPLE_PINHOLE", 320, 180, np.array([230.0, 160.0, 90.0]))
SIZE_M = np.array([20.0, 16.0, 9.0])  # the hall extends from 0 to here
TEXELS_PER_M = 24.0


def painting(face: int) -> np.ndarray:
    """Paint a face (H, W, 3) uint8 with coloured blobs of all sizes that repeat nowhere."""
    u, v = (axis for axis in range(3) if axis != face // 2)
    shape = np.ceil(SIZE_M[[v, u]] * TEXELS_PER_M).astype(int) + 2
    rng = np.random.default_rng(face)
    layers = []
    for sigma in (3, 8, 20):
        noise = cv2.GaussianBlur(rng.standard_normal((*shape, 3)), (0, 0), sigma)
        layers.append(noise / noise.std())
    return np.clip(128 + 32 * sum(layers), 0, 255).astype(np.uint8)


PAINTINGS = [painting(face) for face in range(6)]


def seen_by(pose: Poses, camera: Camera = CAMERA) -> tuple[np.ndarray, np.ndarray]:
    """Render the image (H, W, 3) uint8 of a pose, and the world point (H, W, 3) at each pixel centre."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    pixels = np.stack([x, y], axis=-1).reshape(-1, 2)
    rays = np.column_stack([camera.unproject(pixels), np.ones(len(pixels))]) @ pose.rotations[0]
    center = pose.centers[0]
    with np.errstate(divide="ignore"):
        reach = np.where(rays > 0, (SIZE_M - center) / rays, -center / rays)
    axis = reach.argmin(axis=1)
    points = center + rays * reach.min(axis=1)[:, None]
    image = np.zeros((len(pixels), 3), np.uint8)
    for face, paint in enumerate(PAINTINGS):
        here = (axis == face // 2) & ((rays[np.arange(len(rays)), axis] > 0) == face % 2)
        u, v = (k for k in range(3) if k != face // 2)
        at = (points[here][:, [u, v]] * TEXELS_PER_M).astype(np.float32)
        if len(at):
            # cv2.remap is limited to maps with fewer than 32767 rows, so the list is folded to a square.
            side = int(np.ceil(np.sqrt(len(at))))
            maps = np.resize(at, (side, side, 2))
            image[here] = cv2.remap(paint, maps, None, cv2.INTER_LINEAR).reshape(-1, 3)[: len(at)]
    shape = (camera.height, camera.width, 3)
    return image.reshape(shape), points.reshape(shape)


def place(rng: np.random.Generator) -> Poses:
    """Draw a pose in the southern half that looks north and down."""
    center = rng.uniform([5, 1, 3], [15, 4, 6])
    angles = rng.uniform([-25, -35, -5], [25, -15, 5])
    return Poses.from_rotations(center[None], rotations_from_angles(angles[None]))


def frame(group: str, k: int, points: int) -> DatasetFrame:
    """Render frame k of a group, with `points` observed points."""
    rng = np.random.default_rng([k, *group.encode()])
    pose = place(rng)
    image, shown = seen_by(pose)
    at = rng.permutation(CAMERA.width * CAMERA.height)[:points]
    pixels = np.stack([at % CAMERA.width, at // CAMERA.width], axis=1) + 0.5
    return DatasetFrame(
        name=f"{group}/{k:06d}.jpg",
        sequence=group,
        time_s=0.1 * k,
        center=pose.centers[0],
        quat_wxyz=pose.quats_wxyz[0],
        intrinsics=CAMERA.matrix,
        image=image,
        point_ids=np.arange(points) + k * points,
        point_pixels=pixels.astype(np.float32),
        point_xyz=shown.reshape(-1, 3)[at],
    )


def write_box(path: Path, *, train: int, validation: int = 0, points: int = 900) -> Path:
    """Write a dataset of the hall to a path, which is returned."""
    info = DatasetInfo(units="m", origin=None, up_is_known=True, camera=CAMERA)
    roles = {"train": Role.TRAIN, "validation": Role.VALIDATION}
    with DatasetWriter(path, info, roles) as writer:
        for group, count in (("train", train), ("validation", validation)):
            for k in range(count):
                writer.append(group, frame(group, k, points))
    return path
