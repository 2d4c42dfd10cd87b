"""A room with landmarks on its walls, and features of cameras in it, with exact positions."""

from __future__ import annotations

import numpy as np

from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import to_camera
from spn_data.geometry.rotations import rotations_from_angles
from spn_data.matching.features import FeatureOptions, Features
from spn_model.landmarks.landmark_map import LandmarkFacts, LandmarkMap

CAMERA = Camera("SIMPLE_RADIAL", 960, 540, np.array([480.0, 480.0, 270.0, -0.05]))
OPTIONS = FeatureOptions(max_features=1024, max_image_size_px=640)
NOISE_PX = 0.3  # at 640 pixels
FACTS = LandmarkFacts(features=OPTIONS, noise_px=NOISE_PX, map_hash="map", network="network")


def room(seed: int = 0, count: int = 4000) -> LandmarkMap:
    """Return landmarks on the walls and the ground of a room of 30 x 20 x 8 m, seen from its middle."""
    rng = np.random.default_rng(seed)
    half = np.array([15.0, 10.0, 4.0])
    xyz = rng.uniform(-half, half, (count, 3))
    side = rng.integers(0, 5, count)
    for k, (axis, at) in enumerate([(0, -15), (0, 15), (1, -10), (1, 10), (2, -4)]):
        xyz[side == k, axis] = at
    xyz[:, 2] += 4
    towards = np.array([0.0, 0.0, 5.0]) - xyz
    far = np.linalg.norm(towards, axis=1)
    descriptors = rng.gamma(0.4, 1.0, (count, 128))
    units = descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True)
    _, vectors = np.linalg.eigh(units.T @ units)
    return LandmarkMap(
        facts=FACTS,
        xyz=xyz,
        covariance=np.tile(np.eye(3) * 0.003**2, (count, 1, 1)),
        descriptors=np.clip(np.rint(512 * units), 0, 255).astype(np.uint8),
        landmark=np.arange(count),
        directions=towards / far[:, None],
        sizes_m=np.full(count, 0.1, np.float32),
        distances_m=far.astype(np.float32),
        basis=np.ascontiguousarray(vectors[:, ::-1][:, :32], np.float32),
    )


def pose(
    heading_deg: float, east: float = 0.0, north: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return centre and rotation of a camera in the room, 4 m above the ground, looking slightly down."""
    return (
        np.array([east, north, 4.0]),
        rotations_from_angles(np.array([[heading_deg, -10.0, 2.0]]))[0],
    )


def seen_from(
    landmarks: LandmarkMap,
    center: np.ndarray,
    rotation: np.ndarray,
    *,
    camera: Camera = CAMERA,
    seed: int = 0,
    wrong: float = 0.3,
    count: int = 600,
) -> Features:
    """Return features of a camera: measured with noise, and a share of them with descriptors of nothing."""
    rng = np.random.default_rng(seed)
    x = to_camera(landmarks.xyz, center, rotation)
    ahead = np.flatnonzero(x[:, 2] > 0.5)
    pixels = camera.project(x[ahead])
    inside = ((pixels > 0) & (pixels < [camera.width, camera.height])).all(axis=1)
    rays = x[ahead, :2] / x[ahead, 2:]
    inside &= np.abs(rays).max(axis=1) < 1.5
    row, pixels = ahead[inside], pixels[inside]
    chosen = rng.permutation(len(row))[:count]
    row, pixels = row[chosen], pixels[chosen]
    pixels = pixels + rng.normal(0, NOISE_PX * camera.width / 640, pixels.shape)
    noisy = landmarks.descriptors[row].astype(float) + rng.normal(0, 6, (len(row), 128))
    lost = rng.random(len(row)) < wrong
    noisy[lost] = 512 * np.sqrt(rng.dirichlet(np.full(128, 0.4), int(lost.sum())))
    scale = landmarks.sizes_m[row] * camera.focal_px[0] / x[row, 2]
    keypoints = np.column_stack([pixels, scale, np.zeros(len(row))]).astype(np.float32)
    return Features(keypoints, np.clip(np.rint(noisy), 0, 255).astype(np.uint8))
