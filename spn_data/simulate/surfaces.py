"""Painting of roofs, the surroundings, objects, the sky and reflections."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import cv2
import numpy as np

from spn_data.simulate.facade import paint_facade
from spn_data.simulate.textures import (
    Canvas,
    clouds,
    grain,
    masonry,
    paint_plaza,
    palette_around,
    poster,
    shade,
    stain,
)


def paint_roof(canvas: Canvas) -> np.ndarray:
    """Paint a flat roof (H, W, 3): bitumen sheets, gravel and stains."""
    rng = canvas.rng
    image = masonry(
        canvas,
        rng,
        palette_around(rng, (118, 116, 112), 0.1),
        (1.0, 4.0),
        joint_m=0.05,
        joint_rgb=(72, 70, 68),
    )
    gravel = clouds(rng, canvas, largest_m=7.0, smallest_m=0.1, gain=0.75)
    image = shade(image, 1 + 0.14 * gravel + grain(rng, canvas.shape, 0.11))
    stain(image, canvas, rng, count=round(canvas.size_m[0] * canvas.size_m[1] * 0.08))
    return image


def paint_surroundings(canvas: Canvas) -> np.ndarray:
    """Paint the town around the building (H, W, 3): grass, streets, parked cars, trees from above."""
    rng = canvas.rng
    rows, columns = canvas.shape
    lush = clouds(rng, canvas, largest_m=25.0, smallest_m=0.3, gain=0.72)
    image = np.stack([88 + 18 * lush, 104 + 18 * lush, 62 + 12 * lush], axis=-1)
    image = np.clip(image, 0, 255).astype(np.uint8)
    asphalt = (98, 98, 100)
    lanes_m = [0.13, 0.5, 0.87]
    for share in lanes_m:
        half = canvas.texel(3.4)
        r, c = round(share * rows), round(share * columns)
        if share == 0.5:
            continue
        image[r - half : r + half] = asphalt
        image[:, c - half : c + half] = asphalt
        for start in range(0, columns, canvas.texel(4.0)):
            image[r - 1 : r + 1, start : start + canvas.texel(1.8)] = 225
            image[start : start + canvas.texel(1.8), c - 1 : c + 1] = 225
    ring = canvas.texel(32.0)
    middle = (rows // 2, columns // 2)
    image[
        middle[0] - ring - canvas.texel(2) : middle[0] + ring + canvas.texel(2),
        middle[1] - ring - canvas.texel(2) : middle[1] + ring + canvas.texel(2),
    ] = (150, 146, 138)
    for _ in range(round(canvas.size_m[0] * 1.6)):
        width, height = canvas.texel(1.9), canvas.texel(4.4)
        if rng.random() < 0.5:
            width, height = height, width
        share = float(rng.choice([0.13, 0.87]))
        side = canvas.texel(float(rng.choice([-2.6, 2.6])))
        along = int(rng.integers(0, rows - height))
        if height > width:
            r, c = along, round(share * columns) + side - width // 2
        else:
            r, c = round(share * rows) + side - height // 2, along
        colour = tuple(int(v) for v in rng.integers(20, 230, 3))
        cv2.rectangle(image, (c, r), (c + width, r + height), colour, -1)
        inset = max(1, min(width, height) // 5)
        cv2.rectangle(
            image,
            (c + inset, r + inset),
            (c + width - inset, r + height - inset),
            (38, 42, 48),
            max(1, inset // 2),
        )
    for _ in range(round(canvas.size_m[0] * 2.0)):
        centre = (int(rng.integers(0, columns)), int(rng.integers(0, rows)))
        if max(abs(centre[0] - middle[1]), abs(centre[1] - middle[0])) < ring:
            continue
        radius = canvas.texel(rng.uniform(0.4, 1.6))
        cv2.circle(image, centre, radius, (46, 64, 36), -1, cv2.LINE_AA)
        cv2.circle(
            image,
            (centre[0] - radius // 4, centre[1] - radius // 4),
            radius // 2,
            (84, 108, 58),
            -1,
            cv2.LINE_AA,
        )
    return shade(image, 1 + 0.08 * lush + grain(rng, canvas.shape, 0.07))


def _leaves(canvas: Canvas) -> np.ndarray:
    rng = canvas.rng
    rows, columns = canvas.shape
    image = np.full((rows, columns, 3), (38, 54, 30), np.uint8)
    for _ in range(round(canvas.size_m[0] * canvas.size_m[1] * 260)):
        centre = (int(rng.integers(0, columns)), int(rng.integers(0, rows)))
        axes = (
            max(1, canvas.texel(rng.uniform(0.02, 0.07))),
            max(1, canvas.texel(rng.uniform(0.012, 0.04))),
        )
        tone = rng.uniform(0.45, 1.35)
        colour = (int(78 * tone), int(112 * tone), int(52 * tone))
        cv2.ellipse(
            image, centre, axes, float(rng.uniform(0, 180)), 0, 360, colour, -1, cv2.LINE_AA
        )
    return shade(image, 1 + 0.2 * clouds(rng, canvas, largest_m=0.8, smallest_m=0.1))


def _planks(canvas: Canvas) -> np.ndarray:
    rng = canvas.rng
    image = masonry(
        canvas,
        rng,
        palette_around(rng, (134, 96, 62), 0.16),
        (2.0, 0.12),
        joint_m=0.014,
        joint_rgb=(40, 30, 22),
    )
    fibre = cv2.resize(
        rng.standard_normal((canvas.shape[0], max(2, canvas.shape[1] // 24)), dtype=np.float32),
        canvas.shape[::-1],
    )
    return shade(image, 1 + 0.09 * fibre + grain(rng, canvas.shape, 0.05))


def _concrete(canvas: Canvas) -> np.ndarray:
    rng = canvas.rng
    image = np.full((*canvas.shape, 3), rng.integers(118, 168, 3) // 2 + 70, np.uint8)
    image = shade(
        image,
        1
        + 0.13 * clouds(rng, canvas, largest_m=0.9, smallest_m=0.03, gain=0.75)
        + grain(rng, canvas.shape, 0.07),
    )
    stain(image, canvas, rng, count=5)
    return image


def _metal(canvas: Canvas) -> np.ndarray:
    rng = canvas.rng
    image = np.full((*canvas.shape, 3), rng.integers(40, 150, 3), np.uint8)
    image = shade(
        image,
        1
        + 0.12 * clouds(rng, canvas, largest_m=0.6, smallest_m=0.02, gain=0.8)
        + grain(rng, canvas.shape, 0.05),
    )
    label = poster(rng, max(8, canvas.shape[1] // 4), max(8, canvas.shape[0] // 4))
    r, c = canvas.shape[0] // 3, canvas.shape[1] // 5
    image[r : r + label.shape[0], c : c + label.shape[1]] = label
    return image


def _posters(canvas: Canvas) -> np.ndarray:
    rng = canvas.rng
    image = _concrete(canvas)
    rows, columns = canvas.shape
    step = max(8, columns // 5)
    for c in range(0, columns - step, step):
        for r in range(rows // 12, rows - step, round(step * 1.4)):
            art = poster(rng, round(step * 0.86), round(step * 1.2))
            part = image[r : r + art.shape[0], c : c + art.shape[1]]
            part[:] = art[: part.shape[0], : part.shape[1]]
    return shade(image, 1 + grain(rng, canvas.shape, 0.04))


def _bark(canvas: Canvas) -> np.ndarray:
    rng = canvas.rng
    image = np.full((*canvas.shape, 3), (92, 76, 60), np.uint8)
    fibre = cv2.resize(
        rng.standard_normal((max(2, canvas.shape[0] // 10), canvas.shape[1]), dtype=np.float32),
        canvas.shape[::-1],
    )
    return shade(image, 1 + 0.3 * fibre + grain(rng, canvas.shape, 0.1))


def _sky(canvas: Canvas) -> np.ndarray:
    """Paint an overcast sky (H, W, 3): broad soft clouds that fade to haze towards the border."""
    field = clouds(canvas.rng, canvas, largest_m=2400.0, smallest_m=300.0)
    rows, columns = canvas.shape
    y, x = np.linspace(-1, 1, rows)[:, None], np.linspace(-1, 1, columns)[None]
    inner = np.clip(1.15 - 1.15 * np.hypot(x, y), 0, 1)[:, :, None]
    blue = (
        np.array([186, 204, 226]) + np.array([18, 14, 10]) * np.clip(field, -1.5, 1.5)[:, :, None]
    )
    return np.rint(inner * blue + (1 - inner) * np.array([208, 214, 220])).astype(np.uint8)


Painter = Callable[[Canvas], np.ndarray]
REFLECTION_PARTS = (2, 1)  # sky above and ground below the facade, in facade heights


def paint_reflection(canvas: Canvas, painter: Painter) -> np.ndarray:
    """Paint the view across the courtyard (H, W, 3): the wall of that name, sky above, ground below."""
    height_m = canvas.size_m[1] / (1 + sum(REFLECTION_PARTS))
    facade = painter(replace(canvas, size_m=(canvas.size_m[0], height_m)))
    wall = cv2.GaussianBlur(cv2.cvtColor(facade, cv2.COLOR_RGBA2RGB), (0, 0), 0.8)
    field = clouds(canvas.rng, canvas, largest_m=14.0, smallest_m=0.5)[:, :, None]
    above = len(wall) * REFLECTION_PARTS[0]
    fade = np.linspace(0, 1, above)[:, None, None]
    sky = (1 - fade) * np.array([176, 196, 222]) + fade * np.array([214, 218, 222])
    below = canvas.shape[0] - above - len(wall)
    ground = np.array([124, 122, 112]) * (1 + 0.12 * field[-below:])
    parts = [sky + 8 * field[:above], wall, ground]
    return np.vstack([np.clip(part, 0, 255).astype(np.uint8) for part in parts])


PAINTERS: dict[str, Painter] = {
    "facade": paint_facade,
    "plaza": paint_plaza,
    "roof": paint_roof,
    "surroundings": paint_surroundings,
    "leaves": _leaves,
    "planks": _planks,
    "concrete": _concrete,
    "metal": _metal,
    "posters": _posters,
    "bark": _bark,
    "sky": _sky,
    "reflection-facade": partial(paint_reflection, painter=paint_facade),
}
