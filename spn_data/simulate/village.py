"""A village to fly over: houses with pitched roofs and gardens along two roads, trees, cars and people."""

from __future__ import annotations

import numpy as np

from spn_data.simulate.crowd import COLOURS, add_car, drive, register_textures, walk
from spn_data.simulate.faces import Face
from spn_data.simulate.place import PlaceBuilder
from spn_data.simulate.shapes import vector
from spn_data.simulate.surfaces_town import ROOF_RGB, VILLAGE_ROAD_M, VILLAGE_SIDE_ROAD

GROUND_TEXELS_PER_M = 28.0
ROOF_SHEET_M = (40.0, 30.0)
BLOCK_M = (17.0, 19.0)  # one house each
MARGIN_M = 40.0  # of ground beyond the place


class Village(PlaceBuilder):
    """Builder of the village."""

    def build(self) -> None:
        """Add all faces."""
        hx, hy = self.options.half_m
        self.sky()
        wide, high = hx + MARGIN_M, hy + MARGIN_M
        resolution = min(self.options.texels_per_m, GROUND_TEXELS_PER_M)
        self.canvas("ground", "village", (2 * wide, 2 * high), resolution)
        self.add("ground", vector(-wide, high, 0), vector(2 * wide, 0, 0), vector(0, -2 * high, 0))
        far = max(wide, high) + 250.0
        self.canvas("fields", "surroundings", (2 * far, 2 * far), 3.0)
        self.add("fields", vector(-far, far, -0.5), vector(2 * far, 0, 0), vector(0, -2 * far, 0))
        for k in range(len(ROOF_RGB)):
            self.canvas(f"tiles-{k}", "tiles", ROOF_SHEET_M, min(self.options.texels_per_m, 40.0))
        register_textures(self)
        side = (2 * VILLAGE_SIDE_ROAD - 1) * wide
        for x in np.arange(-wide + BLOCK_M[0], wide - BLOCK_M[0] / 2, BLOCK_M[0]):
            for y in np.arange(BLOCK_M[1] * 0.75, high - BLOCK_M[1] / 2, BLOCK_M[1]):
                for sign in (1, -1):
                    if abs(x - side) > VILLAGE_ROAD_M / 2 + 8.5:
                        self._plot(float(x), float(sign * y))
        reach_x, reach_y = wide - 2.0, high - 2.0
        count = self.options.cars // 2
        for lane, direction in ((-1.4, 1), (1.4, -1)):
            east = np.array([[-reach_x, lane], [reach_x, lane]]) * [direction, 1]
            north = np.array([[side - lane, -reach_y], [side - lane, reach_y]]) * [1, direction]
            drive(self, east, 5.0, count)
            drive(self, north, 4.0, self.options.cars - count)
        reach = np.array([hx, hy])
        walk(self, self.options.people, -reach, reach)

    def _plot(self, x: float, y: float) -> None:
        """Add a house with its garden around a place."""
        rng = self.rng
        kind = rng.random()
        if kind > 0.1:
            w, d = rng.uniform(4.2, 6.0), rng.uniform(3.4, 4.6)
            x0, y0 = x + rng.uniform(-1.2, 1.2), y + rng.uniform(-1.2, 1.2)
            self._house(float(x0 - w), float(y0 - d), float(x0 + w), float(y0 + d))
        for _ in range(2 if kind > 0.1 else 5):
            dx, dy = rng.uniform(-8, 8), float(rng.choice([-1, 1])) * rng.uniform(6.6, 8.6)
            self.small_tree(
                x + dx, y + dy, float(rng.uniform(2.5, 7.0)), float(rng.uniform(0.9, 2.2))
            )
        if rng.random() < 0.5:
            dy = float(rng.choice([-1, 1])) * 7.4
            add_car(self, x + float(rng.uniform(-3, 3)), y + dy, int(rng.integers(COLOURS)))

    def _house(self, x0: float, y0: float, x1: float, y1: float) -> None:
        """Add a house with a ridge from west to east, its eaves 0.5 m outside the walls."""
        rng = self.rng
        eaves = float(rng.uniform(3.0, 6.2))
        ridge = eaves + (y1 - y0) / 2 * float(rng.uniform(0.6, 1.0))
        name = f"walls-{x0:.1f}-{y0:.1f}"
        width, depth = x1 - x0, y1 - y0
        round_m = 2 * (width + depth)
        self.canvas(name, "house-walls", (round_m, eaves), 32.0)
        at = 0.0
        for origin, along in (
            (vector(x0, y0, eaves), vector(width, 0, 0)),
            (vector(x1, y0, eaves), vector(0, depth, 0)),
            (vector(x1, y1, eaves), vector(-width, 0, 0)),
            (vector(x0, y1, eaves), vector(0, -depth, 0)),
        ):
            share = float(np.linalg.norm(along)) / round_m
            self.faces.append(
                Face(name, origin, along, vector(0, 0, -eaves), (at, 0.0, at + share, 1.0))
            )
            at += share
        sheet = f"tiles-{int(rng.integers(3))}"
        drop = (ridge - eaves) / (depth / 2) * 0.5
        middle = (y0 + y1) / 2
        for origin, along, slope in (
            (vector(x0 - 0.5, middle, ridge), vector(width + 1, 0, 0), y0 - 0.5 - middle),
            (vector(x1 + 0.5, middle, ridge), vector(-width - 1, 0, 0), y1 + 0.5 - middle),
        ):
            down = vector(0, slope, eaves - drop - ridge)
            region = self.patch(sheet, width + 1, float(np.linalg.norm(down)))
            self.faces.append(Face(sheet, origin, along, down, region))
        for x, near, far in ((x0, y1, y0), (x1, y0, y1)):  # gables
            self.polygon(
                "concrete",
                np.stack([vector(x, middle, ridge), vector(x, far, eaves), vector(x, near, eaves)]),
            )
        chimney = float(rng.uniform(x0 + 1, x1 - 1))
        self.box(
            (chimney - 0.35, middle + 0.4, eaves), (chimney + 0.35, middle + 1.1, ridge + 0.9),
            "concrete", "concrete",
        )  # fmt: skip
        self.obstacles.append((x0, y0, 0.0, x1, y1, ridge))
