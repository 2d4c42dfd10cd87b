"""Painting of roads, gardens, houses, roof tiles, vehicles and clothes."""

from __future__ import annotations

import cv2
import numpy as np

from spn_data.simulate.surfaces import Painter
from spn_data.simulate.textures import (
    Canvas,
    clouds,
    grain,
    masonry,
    palette_around,
    shade,
    stain,
)
from spn_data.simulate.walls import PLASTER_RGB

ROOF_RGB = (
    (150, 84, 62),
    (118, 70, 58),
    (96, 96, 100),
)  # by the number that ends the texture's name
ROAD_M = 7.0  # width of the carriageway
VILLAGE_ROAD_M = 6.0
VILLAGE_SIDE_ROAD = 0.36  # where the side road crosses, as a share of the width


def paint_asphalt(canvas: Canvas) -> np.ndarray:
    """Paint a yard of plain asphalt (H, W, 3): faint patches, few stains, two painted lines."""
    rng = canvas.rng
    image = np.full((*canvas.shape, 3), (104, 104, 106), np.uint8)
    soft = clouds(rng, canvas, largest_m=8.0, smallest_m=0.5)
    image = shade(image, 1 + 0.05 * soft + grain(rng, canvas.shape, 0.04))
    stain(image, canvas, rng, count=round(canvas.size_m[0] * canvas.size_m[1] * 0.015))
    for share in rng.uniform(0.15, 0.85, 2):
        c = round(share * canvas.shape[1])
        image[:, c : c + canvas.texel(0.12)] = 205
    return image


def paint_road(canvas: Canvas) -> np.ndarray:
    """Paint a street (H, W, 3) along its width: carriageway with lane marks between pavements of slabs."""
    rng = canvas.rng
    rows, columns = canvas.shape
    slabs = palette_around(rng, (150, 146, 138), 0.05)
    image = masonry(canvas, rng, slabs, (0.6, 0.4), joint_m=0.014, joint_rgb=(98, 96, 90))
    middle, half = rows // 2, canvas.texel(ROAD_M / 2)
    image[middle - half : middle + half] = (92, 92, 95)
    kerb = max(1, canvas.texel(0.15))
    for r in (middle - half, middle + half - kerb):
        image[r : r + kerb] = (172, 170, 164)
    mark = max(1, canvas.texel(0.12))
    for c in range(0, columns, canvas.texel(6.0)):
        image[middle - mark // 2 : middle + mark - mark // 2, c : c + canvas.texel(3.0)] = 222
    for _ in range(round(canvas.size_m[0] / 9)):  # patches of newer asphalt, and manholes
        r, c = middle + int(rng.integers(-half, half // 2)), int(rng.integers(0, columns))
        image[r : r + canvas.texel(1.2), c : c + canvas.texel(rng.uniform(1, 5))] = (78, 78, 82)
        centre = (int(rng.integers(0, columns)), middle + int(rng.integers(-half, half)))
        cv2.circle(image, centre, canvas.texel(0.32), (64, 62, 60), -1, cv2.LINE_AA)
    soft = clouds(rng, canvas, largest_m=7.0, smallest_m=0.15)
    image = shade(image, 1 + 0.06 * soft + grain(rng, canvas.shape, 0.05))
    stain(image, canvas, rng, count=round(canvas.size_m[0] * canvas.size_m[1] * 0.03))
    return image


def paint_village_ground(canvas: Canvas) -> np.ndarray:
    """Paint the ground of a village (H, W, 3): gardens and yards between two roads that cross."""
    rng = canvas.rng
    rows, columns = canvas.shape
    lush = clouds(rng, canvas, largest_m=14.0, smallest_m=0.2, gain=0.7)
    image = np.full((rows, columns, 3), (96, 112, 64), np.uint8)
    plot = canvas.texel(11.0)
    for r in range(0, rows, plot):  # plots differ: lawn, meadow, beds, gravel
        for c in range(0, columns, plot):
            kind = int(rng.integers(0, 5))
            part = image[r : r + plot, c : c + plot]
            part[:] = (
                (96, 112, 64),
                (110, 120, 70),
                (84, 104, 52),
                (150, 142, 126),
                (112, 92, 70),
            )[kind]
            if kind == 4:
                for row in range(0, len(part), max(2, canvas.texel(0.8))):
                    tone = rng.uniform(0.6, 1.3)
                    part[row : row + canvas.texel(0.4)] = (
                        int(92 * tone),
                        int(100 * tone),
                        int(56 * tone),
                    )
    mark = max(1, canvas.texel(0.15))
    half, middle, side = (
        canvas.texel(VILLAGE_ROAD_M / 2),
        rows // 2,
        round(VILLAGE_SIDE_ROAD * columns),
    )
    image[middle - half : middle + half] = image[:, side - half : side + half] = (100, 99, 100)
    for c in range(0, columns, canvas.texel(8.0)):
        image[middle - mark // 2 : middle + mark - mark // 2, c : c + canvas.texel(4.0)] = 220
    image = shade(image, 1 + 0.1 * lush + grain(rng, canvas.shape, 0.07))
    for _ in range(round(canvas.size_m[0] * canvas.size_m[1] * 0.05)):  # shrubs and stones
        centre = (int(rng.integers(0, columns)), int(rng.integers(0, rows)))
        if abs(centre[1] - middle) < 1.3 * half or abs(centre[0] - side) < 1.3 * half:
            continue
        tone = rng.uniform(0.5, 1.2)
        colour = (int(58 * tone), int(84 * tone), int(44 * tone))
        if rng.random() < 0.25:
            colour = (int(190 * tone), int(180 * tone), int(160 * tone))
        cv2.circle(image, centre, canvas.texel(rng.uniform(0.1, 0.7)), colour, -1, cv2.LINE_AA)
    stain(image, canvas, rng, count=round(canvas.size_m[0] * canvas.size_m[1] * 0.02))
    return image


def paint_tiles(canvas: Canvas) -> np.ndarray:
    """Paint roof tiles (H, W, 3) with moss and replaced patches."""
    rng = canvas.rng
    base = ROOF_RGB[int(canvas.name[-1]) % len(ROOF_RGB)]
    palette = palette_around(rng, base, 0.12)
    image = masonry(canvas, rng, palette, (0.3, 0.35), joint_m=0.03, joint_rgb=(52, 46, 44))
    soft = clouds(rng, canvas, largest_m=5.0, smallest_m=0.2)
    image = shade(image, 1 + 0.1 * soft + grain(rng, canvas.shape, 0.06))
    stain(image, canvas, rng, count=round(canvas.size_m[0] * canvas.size_m[1] * 0.08))
    return image


def paint_house_walls(canvas: Canvas) -> np.ndarray:
    """Paint the walls of a house as one strip (H, W, 3): plaster, windows with shutters, doors."""
    rng = canvas.rng
    rows, columns = canvas.shape
    tone = np.array(PLASTER_RGB[rng.integers(len(PLASTER_RGB))]) * rng.uniform(0.8, 1.1)
    image = np.full((rows, columns, 3), np.clip(tone, 0, 255), np.uint8)
    shutter = rng.integers(30, 150, 3)
    for c in range(canvas.texel(0.8), columns - canvas.texel(1.4), canvas.texel(2.4)):
        for up_m in np.arange(1.0, canvas.size_m[1] - 1.3, 2.7):
            if rng.random() < 0.2:
                continue
            width, height = canvas.texel(0.9), canvas.texel(1.2)
            r = rows - canvas.texel(up_m) - height
            image[r : r + height, c - width // 3 : c + width + width // 3] = shutter
            image[r : r + height, c : c + width] = (52, 60, 68)
            image[r : r + height, c + width // 2 : c + width // 2 + 1] = 220
    c = int(rng.integers(0, columns - canvas.texel(1.1)))
    image[-canvas.texel(2.1) :, c : c + canvas.texel(1.0)] = rng.integers(40, 140, 3)
    soft = clouds(rng, canvas, largest_m=3.0, smallest_m=0.2)
    return shade(image, 1 + 0.05 * soft + grain(rng, canvas.shape, 0.03))


def paint_car(canvas: Canvas) -> np.ndarray:
    """Paint the side of a car's body (H, W, 3): paint, doors, lights, wheels."""
    rng = canvas.rng
    rows, columns = canvas.shape
    image = np.full((rows, columns, 3), rng.integers(25, 225, 3), np.uint8)
    image = shade(
        image, np.repeat(np.linspace(1.15, 0.7, rows, dtype=np.float32)[:, None], columns, 1)
    )
    for share in (0.3, 0.5, 0.72):
        image[: rows * 3 // 4, round(share * columns) : round(share * columns) + 2] = 30
    image[rows // 5 : rows * 2 // 5, : columns // 25] = (230, 224, 190)
    image[rows // 5 : rows * 2 // 5, -columns // 25 :] = (170, 30, 30)
    for share in (0.19, 0.8):
        centre = (round(share * columns), rows - rows // 4)
        cv2.circle(image, centre, rows // 3, (22, 22, 24), -1, cv2.LINE_AA)
        cv2.circle(image, centre, rows // 6, (150, 152, 156), -1, cv2.LINE_AA)
    return image


def paint_car_top(canvas: Canvas) -> np.ndarray:
    """Paint the top of a car (H, W, 3) in the colour of its sides."""
    rng = canvas.rng
    image = np.full((*canvas.shape, 3), rng.integers(25, 225, 3), np.uint8)
    return shade(image, 1 + 0.06 * clouds(rng, canvas, largest_m=2.0, smallest_m=0.5))


def paint_car_glass(canvas: Canvas) -> np.ndarray:
    """Paint the windows of a car (H, W, 3)."""
    rows, columns = canvas.shape
    image = np.full((rows, columns, 3), (44, 52, 60), np.uint8)
    for share in (0.0, 0.45, 0.94):
        image[:, round(share * columns) : round((share + 0.06) * columns)] = canvas.rng.integers(
            30, 200
        )
    return image


def paint_cloth(canvas: Canvas) -> np.ndarray:
    """Paint clothes (H, W, 3): a colour with folds and a few stripes."""
    rng = canvas.rng
    rows, columns = canvas.shape
    image = np.full((rows, columns, 3), rng.integers(20, 220, 3), np.uint8)
    for r in range(0, rows, max(2, canvas.texel(rng.uniform(0.15, 0.6)))):
        image[r : r + canvas.texel(0.05)] = rng.integers(20, 235, 3)
    return shade(image, 1 + 0.2 * clouds(rng, canvas, largest_m=0.5, smallest_m=0.05))


PAINTERS: dict[str, Painter] = {
    "asphalt": paint_asphalt,
    "road": paint_road,
    "village": paint_village_ground,
    "tiles": paint_tiles,
    "house-walls": paint_house_walls,
    "car": paint_car,
    "car-top": paint_car_top,
    "car-glass": paint_car_glass,
    "cloth": paint_cloth,
}
