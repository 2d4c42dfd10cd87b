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


def lens_of(widths: float) -> Camera:
    """Return a lens whose focal length is a number of image widths."""
    return Camera("SIMPLE_RADIAL", WIDTH, HEIGHT, np.array([widths * WIDTH, 480.0, 270.0, 0.0]))


def write_orbit(
    path: Path,
    true: Camera,
    start: InitialLens,
    *,
    images: int = 12,
    points: int = 200,
    noise_px: float = 0.3,
    turn_deg: float = 180.0,
) -> tuple[dict[str, InitialLens], Poses]:
    """Write a database of images from far enough to see the whole courtyard; return lenses and true poses."""
    rng = np.random.default_rng(0)
    xyz = rng.uniform([-18, -18, 0], [18, 18, 12], (points, 3))
    headings = np.linspace(0.0, turn_deg, images)
    angles = np.column_stack([headings, np.full(images, -45.0), np.zeros(images)])
    rotations = rotations_from_angles(angles)
    distance_m = _SEEN_M * true.focal_px[0] / true.width
    poses = Poses.from_rotations(
        np.array([0.0, 0.0, 6.0]) - distance_m * rotations[:, 2], rotations
    )
    lenses = {"orbit": start}
    names = [f"{k:02d}.jpg" for k in range(images)]
    with MapDatabase.open(path) as database:
        database.add_images([DatabaseImage(name, "orbit") for name in names], lenses)
        seen = []
        for k, name in enumerate(names):
            pixels = true.project(poses.to_camera(xyz, k)) + rng.normal(0, noise_px, (points, 2))
            seen.append(((pixels > 0) & (pixels < [WIDTH, HEIGHT])).all(axis=1))
            keypoints = np.column_stack([pixels, np.ones(points), np.zeros(points)])
            database.write_features(
                name, Features(keypoints.astype(np.float32), np.zeros((points, 128), np.uint8))
            )
        for i, j in combinations(range(images), 2):
            rows = np.flatnonzero(seen[i] & seen[j]).astype(np.uint32)
            matches = np.column_stack([rows, rows])
            pair = (database.ids[names[i]], database.ids[names[j]])
            database.write_pair(VerifiedPair(pair, matches, matches, 2, np.eye(3), np.eye(3), None))
    return lenses, poses
