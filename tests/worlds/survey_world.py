"""Nadir surveys from one height, with exact truth, and with the doming that mapping leaves."""

from __future__ import annotations

import numpy as np

from spn_data.colmap import pycolmap
from spn_data.colmap.model import scene_of
from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses, Similarity
from spn_data.geometry.rotations import rotations_from_vectors
from tests.worlds.native_world import native_model

PER_LINE, STEP_M, APART_M, HEIGHT_M = 40, 7.5, 14.0, 45.0
_CAMERA = Camera("RADIAL", 960, 540, np.array([660.0, 480.0, 270.0, -0.05, 0.015]))


def survey(
    sag_m: float, wrong: int = 0, lines: int = 4
) -> tuple[pycolmap.Reconstruction, np.ndarray]:
    """Build a model of 40 nadir images per line with its ends lifted by `sag_m`, and the true positions.

    wrong : number of measurements placed anywhere in the image. The others have 0.3 pixels of noise.
    """
    rng = np.random.default_rng(0)
    length, width = PER_LINE * STEP_M, lines * APART_M
    points = rng.uniform((-20, -30, 0), (length + 20, width + 30, 6), (1500 * lines, 3))
    line, k = np.divmod(np.arange(lines * PER_LINE), PER_LINE)
    height = HEIGHT_M + rng.uniform(-1, 1, len(k))
    centers = np.stack([STEP_M * k, APART_M * line, height], axis=1)

    def bent(positions: np.ndarray) -> np.ndarray:
        lift = sag_m * (2 * positions[:, 0] / length - 1) ** 2
        return positions + np.stack([0 * lift, 0 * lift, lift], axis=1)

    tracks: list[list[tuple[int, int]]] = [[] for _ in points]
    down = np.diag([1.0, -1.0, -1.0])
    pixels, rotations = [], []
    for i, center in enumerate(centers):
        projected = _CAMERA.project((points - center) @ down.T)
        inside = np.flatnonzero(((projected > 0) & (projected < (960, 540))).all(axis=1))
        seen = rng.choice(inside, min(len(inside), 150), replace=False)
        measured = projected[seen] + rng.normal(0, 0.3, (len(seen), 2))
        pixels.append(measured)
        slope = 4 * sag_m / length * (2 * center[0] / length - 1)
        rotations.append(down @ rotations_from_vectors(np.array([[0.0, slope, 0.0]]))[0])
        for row, point in enumerate(seen.tolist()):
            tracks[point].append((i, row))
    model = native_model(
        {1: _CAMERA},
        [1] * len(k),
        [f"{i:03d}.jpg" for i in range(len(k))],
        Poses.from_rotations(bent(centers), np.stack(rotations)),
        pixels,
        [pair for pair in zip(bent(points), tracks, strict=True) if len(pair[1]) > 1],
    )
    for image_id in rng.choice(np.arange(1, len(k) + 1), wrong).tolist():
        image = model.images[image_id]
        row = int(rng.choice(image.get_observation_point2D_idxs()))
        image.points2D[row].xy = rng.uniform((0, 0), (960, 540))
    return model, centers


def error_m(model: pycolmap.Reconstruction, centers: np.ndarray) -> float:
    """Return the median position error of the images after alignment by the best similarity."""
    scene = scene_of(model)
    rows = [int(name[:3]) for name in scene.names]
    found = scene.poses.centers
    apart = Similarity.fit(found, centers[rows]).apply(found) - centers[rows]
    return float(np.median(np.linalg.norm(apart, axis=1)))
