"""A street between rows of houses, with traffic, parked cars, trees and people."""

from __future__ import annotations

import numpy as np

from spn_data.simulate.crowd import COLOURS, add_car, drive, register_textures, walk
from spn_data.simulate.faces import Face
from spn_data.simulate.place import PlaceBuilder
from spn_data.simulate.shapes import vector

FRONTS = ("plaster", "facade", "panels", "plaster")
CROSSING_M = 14.0  # width of the streets that cross at both ends
DEPTH_M = 11.0  # of the houses


class Street(PlaceBuilder):
    """Builder of a street from west to east; its half width is that of the ground."""

    def build(self) -> None:
        """Add all faces."""
        hx, hy = self.options.half_m
        self.sky()
        self.canvas(
            "road", "road", (2 * hx + 2 * CROSSING_M, 2 * hy), min(self.options.texels_per_m, 90.0)
        )
        self.add(
            "road",
            vector(-hx - CROSSING_M, hy, 0),
            vector(2 * (hx + CROSSING_M), 0, 0),
            vector(0, -2 * hy, 0),
        )
        reach = hx + 110.0
        self.canvas("town", "surroundings", (2 * reach, 2 * reach), 10.0)
        self.add(
            "town", vector(-reach, reach, -0.05), vector(2 * reach, 0, 0), vector(0, -2 * reach, 0)
        )
        self.canvas("house", "facade", (24.0, 10.0), 20.0)
        self.canvas("roof", "roof", (40.0, 24.0), 40.0)
        self._row("north", vector(-hx, hy, 0), vector(1, 0, 0), 2 * hx)
        self._row("south", vector(hx, -hy, 0), vector(-1, 0, 0), 2 * hx)
        end = hx + CROSSING_M
        self._row("east", vector(end, hy + 20, 0), vector(0, -1, 0), 2 * hy + 40)
        self._row("west", vector(-end, -hy - 20, 0), vector(0, 1, 0), 2 * hy + 40)
        self._furniture()
        register_textures(self)
        self._traffic()

    def _row(self, side: str, start: np.ndarray, right: np.ndarray, length_m: float) -> None:
        """Add houses side by side: their fronts, sides and flat roofs."""
        inward = np.cross(vector(0, 0, 1), right)
        at, k = 0.0, 0
        while length_m - at > 0.1:
            width = float(self.rng.uniform(9.5, 16.0))
            if length_m - at - width < 9.5:
                width = length_m - at
            height = float(self.rng.uniform(9.0, 15.5))
            kind = FRONTS[int(self.rng.integers(len(FRONTS)))]
            name = f"front-{side}-{k}"
            self.canvas(name, kind, (width, height), min(self.options.texels_per_m, 90.0))
            low = start + at * right
            top = low + vector(0, 0, height)
            down, back = vector(0, 0, -height), inward * DEPTH_M
            self.faces.append(Face(name, top, right * width, down))
            self.add("house", top + right * width, back, down)
            self.add("house", top + back, -back, down)
            region = self.patch("roof", width, DEPTH_M)
            self.faces.append(Face("roof", top + back, right * width, -back, region))
            corners = np.stack([low, low + right * width + back + vector(0, 0, height)])
            self.obstacles.append((*corners.min(axis=0).tolist(), *corners.max(axis=0).tolist()))
            at, k = at + width, k + 1

    def _furniture(self) -> None:
        """Add trees on the south side, lamps on the north side, benches and bins."""
        hx, hy = self.options.half_m
        self.canvas("bin", "metal", (1.0, 1.0), 150.0)
        for x in np.arange(-hx + 8, hx - 5, 15.0):
            x += self.rng.uniform(-2.5, 2.5)
            self.tree(
                x, -hy + 2.6, float(self.rng.uniform(4.5, 6.5)), float(self.rng.uniform(1.1, 1.5))
            )
        for x in np.arange(-hx + 3, hx, 22.0):
            self.rings("concrete", x, hy - 4.6, [(6.2, 0.05), (0.0, 0.09)], 6)
        for _ in range(round(hx / 6)):
            x, side = self.rng.uniform(-hx + 2, hx - 2), 1 if self.rng.random() < 0.6 else -1
            y = side * (hy - 0.9)
            if self.rng.random() < 0.5:
                self.box((x - 0.28, y - 0.28, 0.0), (x + 0.28, y + 0.28, 0.95), "bin", "concrete")
            else:
                self.box((x - 0.95, y - 0.25, 0.0), (x + 0.95, y + 0.25, 0.46), "planks", "planks")

    def _traffic(self) -> None:
        """Add parked and driving cars, and people on both pavements."""
        hx, hy = self.options.half_m
        for x in np.arange(-hx + 4, hx - 4, 7.0):
            if self.rng.random() < 0.5:
                side = 1 if self.rng.random() < 0.5 else -1
                add_car(self, x, side * 2.55, int(self.rng.integers(COLOURS)))
        far = hx + 100.0
        for lane, direction in ((-1.1, 1), (1.1, -1)):
            line = np.array([[-far * direction, lane], [far * direction, lane]])
            drive(self, line, 6.0, self.options.cars // 2)
        for side in (1, -1):
            low, high = sorted((side * (hy - 0.6), side * (hy - 4.2)))
            walk(self, self.options.people // 2, np.array([-hx, low]), np.array([hx, high]))
