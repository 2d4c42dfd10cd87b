"""Viewing rays of the pixels of a distorted camera, in tiles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spn_data.geometry.camera import Camera, colmap_pixels

TILE_PX = 32


@dataclass(frozen=True, eq=False)
class RayGrid:
    """Rays of a range of image rows, and their bounds in each of T tiles.

    rays : (h, w * samples, 2) float32, x/z and y/z; the samples of a pixel are adjacent in a row.
    tiles : (T, 4) int, first row, last row + 1, first column, last column + 1 in `rays`; row by row.
    middle, half : (T, 2), centre and half size of the bounding box of a tile's rays.
    jet : (T, 3, 3), columns are the ray of the tile's middle pixel and its derivative per pixel in x and y.
    """

    rays: np.ndarray
    tiles: np.ndarray
    middle: np.ndarray
    half: np.ndarray
    jet: np.ndarray

    @classmethod
    def of_rows(
        cls, camera: Camera, offsets_px: np.ndarray, first_row: int, last_row: int, tile_rows: int
    ) -> RayGrid:
        """Compute the rays of image rows, with samples at the given offsets (S, 2) from pixel centres."""
        samples = len(offsets_px)
        x = colmap_pixels(np.arange(camera.width))[:, None] + offsets_px[:, 0]
        y = colmap_pixels(np.arange(first_row, last_row))[:, None, None] + offsets_px[:, 1]
        pixels = np.stack(np.broadcast_arrays(x[None], y), axis=-1)
        rays = camera.unproject(pixels.reshape(-1, 2)).astype(np.float32)
        rays = rays.reshape(last_row - first_row, camera.width * samples, 2)
        tiles, boxes, jets = [], [], []
        for r0 in range(0, len(rays), tile_rows):
            r1 = min(r0 + tile_rows, len(rays))
            for c0 in range(0, camera.width, TILE_PX):
                c1 = min(c0 + TILE_PX, camera.width)
                tile = rays[r0:r1, c0 * samples : c1 * samples]
                tiles.append((r0, r1, c0 * samples, c1 * samples))
                boxes.append((tile.min(axis=(0, 1)), tile.max(axis=(0, 1))))
                middle = np.array([(c0 + c1) / 2, first_row + (r0 + r1) / 2])
                jets.append(middle + np.array([[0, 0], [0.5, 0], [-0.5, 0], [0, 0.5], [0, -0.5]]))
        box = np.asarray(boxes, dtype=np.float64)  # (T, 2, 2)
        cross = camera.unproject(np.concatenate(jets)).reshape(-1, 5, 2)
        jet = np.zeros((len(tiles), 3, 3))
        jet[:, :2, 0] = cross[:, 0]
        jet[:, 2, 0] = 1
        jet[:, :2, 1] = cross[:, 1] - cross[:, 2]
        jet[:, :2, 2] = cross[:, 3] - cross[:, 4]
        half = (box[:, 1] - box[:, 0]) / 2
        return cls(rays, np.asarray(tiles), box.mean(axis=1), half, jet)
