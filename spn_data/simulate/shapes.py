"""Solids built from planar faces: boxes, columns, trees."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise

import numpy as np

from spn_data.simulate.bodies import Sway
from spn_data.simulate.faces import Body, Face
from spn_data.simulate.textures import Canvas

# Size in metres and texels per metre by painter; shared by the objects, each face uses its own region.
SHEETS = {
    "leaves": ((6.0, 6.0), 160.0),
    "planks": ((4.0, 4.0), 200.0),
    "concrete": ((5.0, 5.0), 160.0),
    "posters": ((4.0, 4.0), 200.0),
    "bark": ((3.0, 3.0), 160.0),
}


def vector(*values: float) -> np.ndarray:
    """Return the values as a float64 array."""
    return np.array(values, dtype=np.float64)


class Builder:
    """Collector of the faces, textures and obstacles of a scene."""

    def __init__(self, seed: int, *, wind_m: float = 0.0):
        self.seed = seed
        self.wind_m = wind_m
        self.rng = np.random.default_rng([seed, 77])
        self.faces: list[Face] = []
        self.canvases: dict[str, tuple[str, Canvas]] = {}
        self.obstacles: list[tuple[float, ...]] = []
        for name, (size_m, resolution) in SHEETS.items():
            self.canvas(name, name, size_m, resolution)

    def canvas(
        self,
        texture: str,
        painter: str,
        size_m: tuple[float, float],
        resolution: float,
        name: str = "",
    ) -> None:
        """Register a texture; its resolution is reduced if the texture would get too large."""
        # Textures stay within the limits of OpenCV's remap, and within memory for large areas.
        resolution = min(resolution, 30000 / max(size_m), (40e6 / (size_m[0] * size_m[1])) ** 0.5)
        self.canvases[texture] = (
            painter,
            Canvas(name=name or texture, size_m=size_m, texels_per_m=resolution, seed=self.seed),
        )

    def patch(
        self, sheet: str, width_m: float, height_m: float
    ) -> tuple[float, float, float, float]:
        """Choose a random region of a sheet with the given size at the sheet's scale, at most all of it."""
        size = self.canvases[sheet][1].size_m
        ds, dt = min(1.0, width_m / size[0]), min(1.0, height_m / size[1])
        s, t = self.rng.uniform(0, 1 - ds), self.rng.uniform(0, 1 - dt)
        return float(s), float(t), float(s + ds), float(t + dt)

    def add(self, texture: str, origin: np.ndarray, u_edge: np.ndarray, v_edge: np.ndarray) -> None:
        """Add a parallelogram; faces of a shared sheet use a random region of it."""
        region = (0.0, 0.0, 1.0, 1.0)
        if texture in SHEETS:
            region = self.patch(
                texture, float(np.linalg.norm(u_edge)), float(np.linalg.norm(v_edge))
            )
        self.faces.append(Face(texture, origin, u_edge, v_edge, region))

    @contextmanager
    def moving(self, body: Body) -> Iterator[None]:
        """Let the faces added in the context move with a body; they are no obstacles."""
        faces, obstacles = len(self.faces), len(self.obstacles)
        yield
        self.faces[faces:] = [replace(face, body=body) for face in self.faces[faces:]]
        del self.obstacles[obstacles:]

    def polygon(self, texture: str, points: np.ndarray) -> None:
        """Add a convex planar polygon (K, 3), clockwise as seen from its front."""
        right = points[1] - points[0]
        right = right / np.linalg.norm(right)
        away = np.cross(right, points[2] - points[1])
        down = np.cross(away / np.linalg.norm(away), right)
        flat = (points - points[0]) @ np.stack([right, down], axis=1)
        low, size = flat.min(axis=0), np.ptp(flat, axis=0)
        origin = points[0] + low[0] * right + low[1] * down
        region = self.patch(texture, float(size[0]), float(size[1]))
        self.faces.append(
            Face(texture, origin, size[0] * right, size[1] * down, region, (flat - low) / size)
        )

    def box(
        self,
        low: tuple[float, float, float],
        high: tuple[float, float, float],
        side: str,
        top: str,
        *,
        blocks: bool = True,
    ) -> None:
        """Add an axis-parallel box without its bottom; it is an obstacle unless `blocks` is False."""
        (x0, y0, z0), (x1, y1, z1) = low, high
        down = vector(0, 0, z0 - z1)
        self.add(side, vector(x0, y0, z1), vector(x1 - x0, 0, 0), down)
        self.add(side, vector(x1, y1, z1), vector(x0 - x1, 0, 0), down)
        self.add(side, vector(x1, y0, z1), vector(0, y1 - y0, 0), down)
        self.add(side, vector(x0, y1, z1), vector(0, y0 - y1, 0), down)
        self.add(top, vector(x0, y1, z1), vector(x1 - x0, 0, 0), vector(0, y0 - y1, 0))
        if blocks:
            self.obstacles.append((x0, y0, z0, x1, y1, z1))

    def rings(
        self, texture: str, x: float, y: float, rings: list[tuple[float, float]], sides: int
    ) -> None:
        """Add a solid with flat sides through rings (height, radius) from top to bottom, closed on top."""
        angles = np.arange(sides) * 2 * np.pi / sides + 0.2
        loops = [
            np.stack([x + r * np.cos(angles), y + r * np.sin(angles), np.full(sides, z)], axis=1)
            for z, r in rings
        ]
        self.polygon(texture, loops[0][::-1])
        for upper, lower in pairwise(loops):
            for k in range(sides):
                j = (k + 1) % sides  # seen from outside, angles increase to the right
                self.polygon(texture, np.stack([upper[k], upper[j], lower[j], lower[k]]))
        reach = max(r for _, r in rings)
        self.obstacles.append(
            (x - reach, y - reach, rings[-1][0], x + reach, y + reach, rings[0][0])
        )

    def tree(self, x: float, y: float, height: float, radius: float) -> None:
        """Add a tree with a trunk and a crown, which sways if there is wind."""
        profile = [(1.0, 0.2), (0.85, 0.7), (0.5, 1.0), (0.15, 0.75), (0.0, 0.3)]
        self._tree((x, y), height, radius, profile, sides=(6, 8))

    def small_tree(self, x: float, y: float, height: float, radius: float) -> None:
        """Add a tree with fewer faces, to be seen from afar."""
        profile = [(1.0, 0.25), (0.6, 1.0), (0.0, 0.5)]
        self._tree((x, y), height, radius, profile, sides=(4, 6))

    def _tree(
        self,
        place: tuple[float, float],
        height: float,
        radius: float,
        profile: list[tuple[float, float]],
        sides: tuple[int, int],
    ) -> None:
        """Add a tree with the numbers of sides of its trunk and of its crown."""
        x, y = place
        self.rings("bark", x, y, [(height * 0.5, 0.14), (0.0, 0.22)], sides[0])
        low = height * 0.42
        faces = len(self.faces)
        rings = [(low + f * (height - low), r * radius) for f, r in profile]
        self.rings("leaves", x, y, rings, sides[1])
        angles = np.arange(sides[1]) * 2 * np.pi / sides[1] + 0.2
        r = rings[-1][1]
        self.polygon(
            "leaves",
            np.stack(
                [x + r * np.cos(angles), y + r * np.sin(angles), np.full(sides[1], low)], axis=1
            ),
        )
        if self.wind_m:
            sway = Sway(self.wind_m * height / 5, phase=x + 0.7 * y)
            self.faces[faces:] = [replace(face, body=sway) for face in self.faces[faces:]]
