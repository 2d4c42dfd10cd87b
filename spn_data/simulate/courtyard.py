"""The simulated courtyard between brick facades: its objects, the roofs and the surrounding town."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from spn_data.simulate.facade import target_texel
from spn_data.simulate.faces import Face, mirror_face
from spn_data.simulate.place import PlaceBuilder, SceneOptions
from spn_data.simulate.shapes import vector
from spn_data.simulate.surfaces import REFLECTION_PARTS

BUILDING_DEPTH_M = 10.0


class Courtyard(PlaceBuilder):
    """Builder of the courtyard's parts."""

    ground_painter = "plaza"

    def __init__(self, options: SceneOptions):
        super().__init__(options)
        # Upper left corner and upper border of each wall, seen from inside.
        self.walls: dict[str, tuple[np.ndarray, np.ndarray]] = {}

    def build(self) -> None:
        """Add all faces."""
        self.shell()
        self.surroundings()
        self.roof_objects()
        self.courtyard_objects()
        self.houses()

    def wall_painter(self, side: str) -> str:
        """Return the painter of the wall on one side of the courtyard."""
        return "facade"

    def shell(self) -> None:
        """Add the four inner facades with their reflections, the ground between them, and the sky."""
        hx, hy = self.options.half_m
        height, resolution = self.options.height_m, self.options.texels_per_m
        down = vector(0, 0, -height)
        walls = {
            "north": (vector(-hx, hy, height), vector(2 * hx, 0, 0), "south"),
            "south": (vector(hx, -hy, height), vector(-2 * hx, 0, 0), "north"),
            "east": (vector(hx, hy, height), vector(0, -2 * hy, 0), "west"),
            "west": (vector(-hx, -hy, height), vector(0, 2 * hy, 0), "east"),
        }
        sky, ground = (height * REFLECTION_PARTS[0], height * REFLECTION_PARTS[1])
        for name, (origin, along, opposite) in walls.items():
            width = float(np.linalg.norm(along))
            painter = self.wall_painter(name)
            self.canvas(f"facade-{name}", painter, (width, height), resolution)
            self.canvas(
                f"reflection-{name}",
                f"reflection-{painter}",
                (width, sky + height + ground),
                14.0,
                f"facade-{name}",
            )
            seen_origin, seen_along, _ = walls[opposite]
            seen = Face(
                f"reflection-{opposite}",
                seen_origin + vector(0, 0, sky),
                seen_along,
                down - vector(0, 0, sky + ground),
            )
            self.walls[name] = (origin, along)
            wall = Face(f"facade-{name}", origin, along, down)
            self.faces.append(replace(wall, mirrored=mirror_face(seen, wall)))
            canvas = self.canvases[f"facade-{name}"][1]
            row, column = target_texel(canvas)
            rows, columns = canvas.shape
            self.landmarks.append(origin + along * column / columns + down * row / rows)
        self.canvas("plaza", self.ground_painter, (2 * hx, 2 * hy), min(resolution, 125.0))
        self.add("plaza", vector(-hx, hy, 0), vector(2 * hx, 0, 0), vector(0, -2 * hy, 0))
        self.sky()

    def surroundings(self) -> None:
        """Add the roofs around the courtyard, the outer walls, and the ground and houses of the town."""
        hx, hy = self.options.half_m
        ox, oy, height = hx + BUILDING_DEPTH_M, hy + BUILDING_DEPTH_M, self.options.height_m
        strips = {
            "roof-n": (-ox, hy, ox, oy),
            "roof-s": (-ox, -oy, ox, -hy),
            "roof-e": (hx, -hy, ox, hy),
            "roof-w": (-ox, -hy, -hx, hy),
        }
        for name, (x0, y0, x1, y1) in strips.items():
            self.canvas(name, "roof", (x1 - x0, y1 - y0), 50.0)
            self.add(name, vector(x0, y1, height), vector(x1 - x0, 0, 0), vector(0, y0 - y1, 0))
        down = vector(0, 0, -height)
        self.canvas("outside", "facade", (2 * ox, height), 25.0)
        for origin, along in (
            (vector(-ox, -oy, height), vector(2 * ox, 0, 0)),
            (vector(ox, oy, height), vector(-2 * ox, 0, 0)),
            (vector(ox, -oy, height), vector(0, 2 * oy, 0)),
            (vector(-ox, oy, height), vector(0, -2 * oy, 0)),
        ):
            self.add("outside", origin, along, down)
        reach = max(ox, oy) + 90.0
        self.canvas("town", "surroundings", (2 * reach, 2 * reach), 14.0)
        self.faces.append(
            # Below the courtyard's own ground, which hides it.
            Face(
                "town",
                vector(-reach, reach, -0.05),
                vector(2 * reach, 0, 0),
                vector(0, -2 * reach, 0),
            )
        )
        self.canvas("house", "facade", (24.0, 10.0), 20.0)
        self.canvas("house-roof", "roof", (24.0, 16.0), 25.0)
        for k in range(10):
            angle = 2 * np.pi * (k + 0.3) / 10
            x, y = (max(ox, oy) + 42) * np.cos(angle), (max(ox, oy) + 42) * np.sin(angle)
            high = float(self.rng.uniform(7, 14))
            self.box((x - 11, y - 7, 0), (x + 11, y + 7, high), "house", "house-roof")

    def roof_objects(self) -> None:
        """Add air conditioners, skylights and chimneys on the roofs."""
        hx, hy = self.options.half_m
        height = self.options.height_m
        self.canvas("machine", "metal", (2.0, 1.4), 90.0)
        for k in range(round(22 * np.sqrt(self.options.area_factor))):
            along, across = self.rng.uniform(-0.95, 0.95), self.rng.uniform(2.2, 8.0)
            w, d, h = (
                self.rng.uniform(0.5, 1.4),
                self.rng.uniform(0.5, 1.4),
                self.rng.uniform(0.4, 1.5),
            )
            x, y = (along * hx, hy + across) if k % 2 else (hx + across, along * hy)
            sign = 1 if k % 4 < 2 else -1
            side = "machine" if k % 3 else "concrete"
            self.box(
                (sign * x - w, sign * y - d, height),
                (sign * x + w, sign * y + d, height + h),
                side,
                side,
            )

    def courtyard_objects(self) -> None:
        """Add benches, planters, bins, a kiosk, columns and trees, clear of the flight paths."""
        hx, hy = self.options.half_m
        sx, sy = hx / 19.5, hy / 18.0
        self.canvas("bin", "metal", (1.0, 1.0), 150.0)
        self.canvas("kiosk", "metal", (3.0, 2.6), 150.0)
        for x, y in ((-4.5, 3.5), (4.0, -4.0), (5.0, 4.5), (-17.3, 15.6), (17.2, -15.8)):
            height, radius = self.rng.uniform(4.2, 6.5), self.rng.uniform(1.3, 1.8)
            self.tree(x * sx, y * sy, float(height), float(radius))
        self.box((-1.6, -1.3, 0), (1.6, 1.3, 2.6), "kiosk", "concrete")
        self.box((-1.9, -1.6, 2.6), (1.9, 1.6, 2.75), "planks", "concrete")
        self.rings("posters", -5.5 * sx, -4.0 * sy, [(3.2, 0.7), (0.0, 0.7)], 8)
        for x, y in ((-8.0, 0.5), (8.2, 0.8), (0.5, 7.0), (-0.6, -7.2)):
            self.rings("concrete", x * sx * 0.9, y * sy * 0.9, [(4.6, 0.35), (0.0, 0.4)], 8)
        for x, y, across in (
            (-12.0, 16.6, False), (-3.0, 16.7, False), (7.0, 16.6, False), (-8.0, -16.6, False),
            (3.0, -16.7, False), (18.1, 4.0, True), (18.1, -7.0, True), (-18.1, -3.0, True),
            (-18.2, 8.0, True), (-9.5, 6.0, True), (9.3, -6.2, True), (2.0, 10.2, False),
            (-3.0, -10.4, False),
        ):  # fmt: skip
            long, wide = (0.25, 0.95) if across else (0.95, 0.25)
            x, y = x * sx, y * sy
            self.box((x - long, y - wide, 0.0), (x + long, y + wide, 0.46), "planks", "planks")
        for x, y in (
            (-14.0, 13.0), (14.2, 13.1), (14.0, -12.8), (-14.1, -13.2), (-6.5, 10.5), (6.8, 10.0),
            (11.5, 2.5), (-11.8, -3.0), (6.0, -10.8), (-7.0, -9.6), (16.6, 9.0), (-16.5, -9.4),
        ):  # fmt: skip
            x, y, half = x * sx, y * sy, float(self.rng.uniform(0.5, 0.9))
            self.box((x - half, y - half, 0.0), (x + half, y + half, 0.62), "concrete", "leaves")
        for x, y in (
            (-10.0, 16.9),
            (1.0, 16.9),
            (12.5, -16.9),
            (-17.4, 2.0),
            (18.4, 12.0),
            (3.1, 2.2),
            (-3.3, -2.4),
        ):
            x, y = x * sx, y * sy
            self.box((x - 0.28, y - 0.28, 0.0), (x + 0.28, y + 0.28, 0.95), "bin", "concrete")

    def houses(self) -> None:
        """Scatter houses over the courtyard, each with its own part of the roof texture."""
        hx, hy = self.options.half_m
        count = round(self.options.houses_per_hectare * 4 * hx * hy / 1e4)
        if count == 0:
            return
        rng = np.random.default_rng(
            [self.options.seed, 78]
        )  # its own generator: everything else stays unchanged
        sheet_m = 90.0
        self.canvas("house-roofs", "roof", (sheet_m, sheet_m), self.options.texels_per_m)
        for _ in range(count):
            x, y = rng.uniform(-1, 1, 2) * (hx - 10, hy - 10)
            w, d = rng.uniform(4, 7, 2)
            h = rng.uniform(3, 9)
            self.box((x - w, y - d, 0.0), (x + w, y + d, h), "house", "house-roofs")
            s, t = rng.uniform(0, 1 - 2 * np.array([w, d]) / sheet_m)
            region = (s, t, s + 2 * w / sheet_m, t + 2 * d / sheet_m)
            self.faces[-1] = replace(self.faces[-1], region=region)
