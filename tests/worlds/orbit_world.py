"""Matched images of an orbit around a courtyard through a lens of any focal length, with exact truth."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np

from spn_data.colmap.database import DatabaseImage, MapDatabase
from spn_data.colmap.verify import VerifiedPair
from spn_data.geometry.camera import Camera
from spn_data.geometry.initial_lens import InitialLens
from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import rotations_from_angles
from spn_data.matching.features import Features

WIDTH, HEIGHT = 960, 540
_SEEN_M = 44.0
_NOISE_PX = 0.3


def lens_of(widths: float) -> Camera:
    """Return a lens whose focal length is a number of image widths."""
    return Camera("SIMPLE_RADIAL", WIDTH, HEIGHT, np.array([widths * WIDTH, 480.0, 270.0, 0.0]))


def write_orbit(
    path: Path,
    true: Camera,
    start: InitialLens,
    *,
    other: InitialLens | None = None,
    images: int = 12,
    points: int = 200,
    track: int = 100,
) -> Poses:
    """Write a database of images from far enough to see the whole courtyard; return the true poses.

    Each point is seen in at most `track` successive images. Every second image is of camera `other` if that
    is given.
    """
    rng = np.random.default_rng(0)
    xyz = rng.uniform([-18, -18, 0], [18, 18, 12], (points, 3))
    angles = np.zeros((images, 3))
    angles[:, 0], angles[:, 1] = np.linspace(0.0, 180.0, images), -45.0
    rotations = rotations_from_angles(angles)
    distance_m = _SEEN_M * true.focal_px[0] / true.width
    centers = np.array([0.0, 0.0, 6.0]) - distance_m * rotations[:, 2]
    poses = Poses.from_rotations(centers, rotations)
    names = [f"{k:02d}.jpg" for k in range(images)]
    begins = rng.integers(1 - track, images, points)
    keys = ["other" if other is not None and k % 2 else "orbit" for k in range(images)]
    lenses = {"orbit": start} | ({} if other is None else {"other": other})
    with MapDatabase.open(path) as database:
        database.add_images(
            [DatabaseImage(*pair) for pair in zip(names, keys, strict=True)], lenses
        )
        seen = []
        for k, name in enumerate(names):
            pixels = true.project(poses.to_camera(xyz, k))
            inside = ((pixels > 0) & (pixels < [WIDTH, HEIGHT])).all(axis=1)
            seen.append(inside & (begins <= k) & (k < begins + track))
            pixels = pixels + rng.normal(0, _NOISE_PX, (points, 2))
            keypoints = np.column_stack([pixels, np.ones(points), np.zeros(points)])
            features = Features(keypoints.astype(np.float32), np.zeros((points, 128), np.uint8))
            database.write_features(name, features)
        for i, j in combinations(range(images), 2):
            rows = np.flatnonzero(seen[i] & seen[j]).astype(np.uint32)
            matches = np.column_stack([rows, rows])
            pair = (database.ids[names[i]], database.ids[names[j]])
            database.write_pair(VerifiedPair(pair, matches, matches, 2, np.eye(3), np.eye(3), None))
    return poses
