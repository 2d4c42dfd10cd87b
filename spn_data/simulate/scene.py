"""The simulated place: a courtyard between brick facades, its objects, the roofs and the town around it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from spn_data.simulate.render import Face, Texture, mirror_face
from spn_data.simulate.surfaces import PAINTERS, REFLECTION_SKY_SHARE
from spn_data.simulate.textures import Canvas, target_texel


@dataclass(frozen=True, kw_only=True)
class SceneOptions:
    """Size and seed of the courtyard."""

    size_m: tuple[float, float] = (39.0, 36.0)  # east-west and north-south, between the facades
    height_m: float = 18.0  # of the facades
    area_factor: float = 1.0  # times the ground area; the height stays
    texels_per_m: float = 140.0  # of facades and ground
    seed: int = 1  # of everything painted and placed

    @property
    def half_m(self) -> tuple[float, float]:
        """Half the courtyard's extent east and north."""
        side = np.sqrt(self.area_factor) / 2
        return float(self.size_m[0] * side), float(self.size_m[1] * side)


@dataclass(frozen=True, eq=False)
class Place:
    """Faces of the scene, and how their textures are painted.

    canvases : painter's name and canvas of each texture; obstacles : (N, 6) boxes x0, y0, z0, x1, y1, z1 in
    metres that no flight may enter; landmarks : (M, 3) exact centres of the survey targets on the facades.
    World: East-North-Up, zero on the ground at the courtyard's middle.
    """

    faces: tuple[Face, ...]
    canvases: dict[str, tuple[str, Canvas]]
    obstacles: np.ndarray
    landmarks: np.ndarray


BUILDING_DEPTH_M = 10.0
_SHEETS = {  # painter, size in metres, texels per metre: shared by the objects, each face at its own place
    "leaves": ((6.0, 6.0), 160.0),
    "planks": ((4.0, 4.0), 200.0),
    "concrete": ((5.0, 5.0), 160.0),
    "posters": ((4.0, 4.0), 200.0),
    "bark": ((3.0, 3.0), 160.0),
}


def build_place(options: SceneOptions) -> Place:
    """The courtyard for a seed; textures are painted apart (`paint`)."""
    builder = _Builder(options)
    builder.shell()
    builder.surroundings()
    builder.roof_things()
    builder.courtyard_things()
    return Place(
        tuple(builder.faces),
        builder.canvases,
        np.array(builder.obstacles),
        np.array(builder.landmarks),
    )


def paint(place: Place, name: str) -> np.ndarray:
    """Picture (H, W, 3 or 4) uint8 RGB of one texture."""
    painter, canvas = place.canvases[name]
    return PAINTERS[painter](canvas)


def paint_all(place: Place) -> dict[str, Texture]:
    """All textures, in memory."""
    return {name: Texture.from_image(paint(place, name)) for name in place.canvases}


def _vector(*values: float) -> np.ndarray:
    return np.array(values, dtype=np.float64)


class _Builder:
    """Collects the parts of one place."""

    def __init__(self, options: SceneOptions):
        self.options = options
        self.rng = np.random.default_rng([options.seed, 77])
        self.faces: list[Face] = []
        self.canvases: dict[str, tuple[str, Canvas]] = {}
        self.obstacles: list[tuple[float, ...]] = []
        self.landmarks: list[np.ndarray] = []
        for name, (size_m, resolution) in _SHEETS.items():
            self.canvas(name, name, size_m, resolution)

    def canvas(
        self,
        texture: str,
        painter: str,
        size_m: tuple[float, float],
        resolution: float,
        name: str = "",
    ) -> None:
        # Textures stay within what OpenCV's remap can address.
        resolution = min(resolution, 30000 / max(size_m))
        self.canvases[texture] = (
            painter,
            Canvas(
                name=name or texture, size_m=size_m, texels_per_m=resolution, seed=self.options.seed
            ),
        )

    def patch(
        self, sheet: str, width_m: float, height_m: float
    ) -> tuple[float, float, float, float]:
        """A random part of a sheet, of the given size at the sheet's scale, or all of it where it is smaller."""
        size = self.canvases[sheet][1].size_m
        ds, dt = min(1.0, width_m / size[0]), min(1.0, height_m / size[1])
        s, t = self.rng.uniform(0, 1 - ds), self.rng.uniform(0, 1 - dt)
        return float(s), float(t), float(s + ds), float(t + dt)

    def add(self, texture: str, origin: np.ndarray, u_edge: np.ndarray, v_edge: np.ndarray) -> None:
        region = (0.0, 0.0, 1.0, 1.0)
        if texture in _SHEETS:
            region = self.patch(
                texture, float(np.linalg.norm(u_edge)), float(np.linalg.norm(v_edge))
            )
        self.faces.append(Face(texture, origin, u_edge, v_edge, region))

    def polygon(self, texture: str, points: np.ndarray) -> None:
        """Convex planar polygon (K, 3), clockwise as seen from its front."""
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
        """Axis-parallel box without its bottom."""
        (x0, y0, z0), (x1, y1, z1) = low, high
        down = _vector(0, 0, z0 - z1)
        self.add(side, _vector(x0, y0, z1), _vector(x1 - x0, 0, 0), down)
        self.add(side, _vector(x1, y1, z1), _vector(x0 - x1, 0, 0), down)
        self.add(side, _vector(x1, y0, z1), _vector(0, y1 - y0, 0), down)
        self.add(side, _vector(x0, y1, z1), _vector(0, y0 - y1, 0), down)
        self.add(top, _vector(x0, y1, z1), _vector(x1 - x0, 0, 0), _vector(0, y0 - y1, 0))
        if blocks:
            self.obstacles.append((x0, y0, z0, x1, y1, z1))

    def rings(
        self, texture: str, x: float, y: float, rings: list[tuple[float, float]], sides: int
    ) -> None:
        """Solid of rotation with flat sides, through rings of (height, radius) from top to bottom, closed above."""
        angles = np.arange(sides) * 2 * np.pi / sides + 0.2
        loops = [
            np.stack([x + r * np.cos(angles), y + r * np.sin(angles), np.full(sides, z)], axis=1)
            for z, r in rings
        ]
        self.polygon(texture, loops[0][::-1])
        for upper, lower in zip(loops[:-1], loops[1:], strict=True):
            for k in range(sides):
                j = (k + 1) % sides  # seen from outside, a growing angle runs to the right
                self.polygon(texture, np.stack([upper[k], upper[j], lower[j], lower[k]]))
        reach = max(r for _, r in rings)
        self.obstacles.append(
            (x - reach, y - reach, rings[-1][0], x + reach, y + reach, rings[0][0])
        )

    def tree(self, x: float, y: float, height: float, radius: float) -> None:
        self.rings("bark", x, y, [(height * 0.5, 0.14), (0.0, 0.22)], 6)
        low = height * 0.42
        profile = [(1.0, 0.2), (0.85, 0.7), (0.5, 1.0), (0.15, 0.75), (0.0, 0.3)]
        rings = [(low + f * (height - low), r * radius) for f, r in profile]
        self.rings("leaves", x, y, rings, 8)
        angles = np.arange(8) * 2 * np.pi / 8 + 0.2
        r = rings[-1][1]
        self.polygon(
            "leaves",
            np.stack([x + r * np.cos(angles), y + r * np.sin(angles), np.full(8, low)], axis=1),
        )

    def shell(self) -> None:
        """Four inner facades with what their panes reflect, the ground between them, the sky."""
        hx, hy = self.options.half_m
        height, resolution = self.options.height_m, self.options.texels_per_m
        down = _vector(0, 0, -height)
        walls = {
            "north": (_vector(-hx, hy, height), _vector(2 * hx, 0, 0), "south"),
            "south": (_vector(hx, -hy, height), _vector(-2 * hx, 0, 0), "north"),
            "east": (_vector(hx, hy, height), _vector(0, -2 * hy, 0), "west"),
            "west": (_vector(-hx, -hy, height), _vector(0, 2 * hy, 0), "east"),
        }
        rise = height * REFLECTION_SKY_SHARE / (1 - REFLECTION_SKY_SHARE)
        for name, (origin, along, opposite) in walls.items():
            width = float(np.linalg.norm(along))
            self.canvas(f"facade-{name}", "facade", (width, height), resolution)
            self.canvas(
                f"reflection-{name}", "reflection", (width, height + rise), 14.0, f"facade-{name}"
            )
            seen_origin, seen_along, _ = walls[opposite]
            seen = Face(
                f"reflection-{opposite}",
                seen_origin + _vector(0, 0, rise),
                seen_along,
                down - _vector(0, 0, rise),
            )
            wall = Face(f"facade-{name}", origin, along, down)
            self.faces.append(replace(wall, mirrored=mirror_face(seen, wall)))
            canvas = self.canvases[f"facade-{name}"][1]
            row, column = target_texel(canvas)
            rows, columns = canvas.shape
            self.landmarks.append(origin + along * column / columns + down * row / rows)
        self.canvas("plaza", "plaza", (2 * hx, 2 * hy), min(resolution, 125.0))
        self.add("plaza", _vector(-hx, hy, 0), _vector(2 * hx, 0, 0), _vector(0, -2 * hy, 0))
        self.canvas("sky", "sky", (12000.0, 12000.0), 0.1)
        self.faces.append(
            Face(
                "sky",
                _vector(-6000, -6000, 1000),
                _vector(12000, 0, 0),
                _vector(0, 12000, 0),
                at_infinity=True,
            )
        )

    def surroundings(self) -> None:
        """Roofs around the courtyard, outer walls, and the town's ground as a frame around the building."""
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
            self.add(name, _vector(x0, y1, height), _vector(x1 - x0, 0, 0), _vector(0, y0 - y1, 0))
        down = _vector(0, 0, -height)
        self.canvas("outside", "facade", (2 * ox, height), 25.0)
        for origin, along in (
            (_vector(-ox, -oy, height), _vector(2 * ox, 0, 0)),
            (_vector(ox, oy, height), _vector(-2 * ox, 0, 0)),
            (_vector(ox, -oy, height), _vector(0, 2 * oy, 0)),
            (_vector(-ox, oy, height), _vector(0, -2 * oy, 0)),
        ):
            self.add("outside", origin, along, down)
        reach = max(ox, oy) + 90.0
        self.canvas("town", "surroundings", (2 * reach, 2 * reach), 14.0)
        self.faces.append(
            # Below the courtyard's own ground, which hides it.
            Face(
                "town",
                _vector(-reach, reach, -0.05),
                _vector(2 * reach, 0, 0),
                _vector(0, -2 * reach, 0),
            )
        )
        self.canvas("house", "facade", (24.0, 10.0), 20.0)
        self.canvas("house-roof", "roof", (24.0, 16.0), 25.0)
        for k in range(10):
            angle = 2 * np.pi * (k + 0.3) / 10
            x, y = (max(ox, oy) + 42) * np.cos(angle), (max(ox, oy) + 42) * np.sin(angle)
            high = float(self.rng.uniform(7, 14))
            self.box((x - 11, y - 7, 0), (x + 11, y + 7, high), "house", "house-roof")

    def roof_things(self) -> None:
        """Air conditioners, skylights and chimneys on the roofs."""
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

    def courtyard_things(self) -> None:
        """Benches, planters, bins, a kiosk, columns and trees, clear of where the flights pass."""
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
            (3.0, -16.7, False), (18.1, 4.0, True), (18.1, -7.0, True), (-18.1, -3.0, True), (-18.2, 8.0, True),
            (-9.5, 6.0, True), (9.3, -6.2, True), (2.0, 10.2, False), (-3.0, -10.4, False),
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
