"""A courtyard that is harder to map: plain plaster, repeated panels, glass, shop windows, an asphalt yard."""

from __future__ import annotations

import numpy as np

from spn_data.simulate.bodies import Sway
from spn_data.simulate.courtyard import Courtyard
from spn_data.simulate.crowd import drive, register_textures, walk
from spn_data.simulate.faces import Face
from spn_data.simulate.place import SceneOptions
from spn_data.simulate.shapes import vector

SHOP_M = (6.0, 2.6)
ROOM_DEPTH_M = 3.0


class ModernCourtyard(Courtyard):
    """Builder of the modern courtyard; which wall is of what depends on the seed."""

    ground_painter = "asphalt"

    def __init__(self, options: SceneOptions):
        super().__init__(options)
        kinds = ["plaster", "panels", "curtain", "plaster"]
        order = np.random.default_rng([options.seed, 79]).permutation(4)
        self._kinds = {
            side: kinds[k]
            for side, k in zip(("north", "south", "east", "west"), order, strict=True)
        }

    def wall_painter(self, side: str) -> str:
        """Return the painter of the wall on one side."""
        return self._kinds[side]

    def build(self) -> None:
        """Add all faces."""
        super().build()
        self.shops()
        self.plants()
        register_textures(self)
        hx, hy = self.options.half_m
        ring = np.array([[-0.5, -0.42], [0.5, -0.42], [0.5, 0.42], [-0.5, 0.42], [-0.5, -0.42]])
        drive(self, ring * [hx, hy], 2.2, self.options.cars)
        reach = np.array([hx - 1.2, hy - 1.2])
        walk(self, self.options.people, -reach, reach)

    def shops(self) -> None:
        """Add shop windows in the plastered walls, through which the rooms behind are seen."""
        self.canvas("shop", "shop", SHOP_M, 100.0)
        for side, (origin, along) in self.walls.items():
            if self._kinds[side] != "plaster":
                continue
            width, right = float(np.linalg.norm(along)), along / np.linalg.norm(along)
            inward = np.cross(vector(0, 0, 1), right)  # into the building
            for k, share in enumerate((0.3, 0.72)):
                room = f"room-{side}-{k}"
                self.canvas(room, "room", (SHOP_M[0] + 6.0, SHOP_M[1] + 1.0), 60.0)
                low = origin - vector(0, 0, origin[2]) + right * (share * width - SHOP_M[0] / 2)
                back = Face(
                    room,
                    low + inward * ROOM_DEPTH_M - 3.0 * right + vector(0, 0, SHOP_M[1] + 1.0),
                    (SHOP_M[0] + 6.0) * right,
                    vector(0, 0, -SHOP_M[1] - 1.0),
                )
                self.faces.append(
                    Face(
                        "shop",
                        low - inward * 0.03 + vector(0, 0, 0.3 + SHOP_M[1]),
                        SHOP_M[0] * right,
                        vector(0, 0, -SHOP_M[1]),
                        mirrored=back,
                    )
                )

    def plants(self) -> None:
        """Add more trees, and hedges in front of the walls."""
        hx, hy = self.options.half_m
        for x, y in ((17.0, 15.4), (-17.0, -15.6), (-1.6, 5.2), (1.7, -5.4)):
            height, radius = self.rng.uniform(4.4, 6.2), self.rng.uniform(1.3, 1.7)
            self.tree(x * hx / 19.5, y * hy / 18.0, float(height), float(radius))
        for x, y in ((-6.0, 17.3), (9.5, 17.3), (-9.0, -17.3), (6.5, -17.3)):
            x, y = x * hx / 19.5, y * hy / 18.0
            with self.moving(Sway(0.3 * self.options.wind_m, phase=x)):
                self.box((x - 2.0, y - 0.4, 0.0), (x + 2.0, y + 0.4, 1.3), "leaves", "leaves")
