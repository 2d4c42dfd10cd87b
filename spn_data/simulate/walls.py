"""Painting of walls with few details: plain plaster, repeated panels, glass, and rooms behind it."""

from __future__ import annotations

from functools import partial

import cv2
import numpy as np

from spn_data.simulate.facade import (
    WINDOW_M,
    WINDOW_PITCH_M,
    paint_target,
    paint_windows,
    target_texel,
    window_corners_m,
)
from spn_data.simulate.surfaces import Painter, paint_reflection
from spn_data.simulate.textures import Canvas, clouds, grain, poster, shade

PANEL_M = (WINDOW_PITCH_M[0] / 2, WINDOW_PITCH_M[1] / 4)
PLASTER_RGB = ((216, 208, 192), (200, 202, 204), (208, 190, 164), (188, 176, 160))
SHOP_GLASS = 0.84  # share of the room in what is seen through a shop window


def _plaster(canvas: Canvas, rng: np.random.Generator) -> np.ndarray:
    """Paint plaster without windows: broad stains of 2 %, hardly any grain, a few hairline cracks."""
    rows, columns = canvas.shape
    image = np.full((rows, columns, 3), PLASTER_RGB[rng.integers(len(PLASTER_RGB))], np.uint8)
    soft = clouds(rng, canvas, largest_m=6.0, smallest_m=0.4)
    image = shade(image, 1 + 0.02 * soft + grain(rng, canvas.shape, 0.01))
    for _ in range(round(canvas.size_m[0] / 4)):
        steps = rng.normal(0, 1, (12, 2)) * canvas.texel(0.09) + [0, canvas.texel(0.12)]
        start = rng.uniform(0, 1, 2) * [columns, rows]
        crack = np.rint(start + np.cumsum(steps, axis=0)).astype(np.int32)
        tone = tuple(int(v) for v in image[0, 0] * 0.78)
        cv2.polylines(image, [crack], False, tone, max(1, canvas.texel(0.006)), cv2.LINE_AA)
    return image


def _panels(canvas: Canvas, rng: np.random.Generator) -> np.ndarray:
    """Paint fibre-cement panels, each the exact copy of one."""
    width, height = canvas.texel(PANEL_M[0]), canvas.texel(PANEL_M[1])
    tone = np.array((132, 136, 140)) * rng.uniform(0.7, 1.3) * rng.uniform(0.93, 1.07, 3)
    panel = np.full((height, width, 3), np.clip(tone, 0, 255), np.uint8)
    panel = shade(panel, 1 + grain(rng, (height, width), 0.025))
    joint, rivet = max(1, canvas.texel(0.014)), max(1, canvas.texel(0.012))
    panel[:joint] = panel[:, :joint] = 46
    for s in (0.06, 0.94):
        for t in (0.1, 0.9):
            cv2.circle(panel, (round(s * width), round(t * height)), rivet, (88, 90, 92), -1)
    repeats = (-(-canvas.shape[0] // height), -(-canvas.shape[1] // width), 1)
    return np.ascontiguousarray(np.tile(panel, repeats)[: canvas.shape[0], : canvas.shape[1]])


def _details(
    image: np.ndarray, alpha: np.ndarray, canvas: Canvas, rng: np.random.Generator
) -> None:
    """Paint a door, two posters, the survey target and soot above the ground, in place."""
    rows, columns = alpha.shape
    splash = canvas.texel(0.5)
    image[-splash:] = shade(
        image[-splash:],
        np.repeat(np.linspace(1, 0.75, splash, dtype=np.float32)[:, None], columns, 1),
    )
    piers_m = np.unique(window_corners_m(*canvas.size_m)[:, 0])[:-1] + WINDOW_M[0]
    picks = 1 + rng.permutation(len(piers_m) - 1)[:3]  # the first pier carries the survey target
    sizes_m = [(1.1, 2.2), *[(size, 1.35 * size) for size in rng.uniform(0.5, 0.9, 2)]]
    for k, (pier, (width_m, height_m)) in enumerate(zip(picks, sizes_m, strict=False)):
        width, height = canvas.texel(width_m), canvas.texel(height_m)
        art = poster(rng, width, height)
        if k == 0:
            art = np.full((height, width, 3), rng.integers(40, 150, 3), np.uint8)
            art[:, :2] = art[:, -2:] = art[:2] = 30
        low_m = 0.0 if k == 0 else float(rng.uniform(1.0, 1.8))
        r, c = rows - canvas.texel(low_m + height_m), canvas.texel(piers_m[pier] + 0.3)
        image[r : r + height, c : c + width] = art
        alpha[r : r + height, c : c + width] = 0
    r, c = target_texel(canvas)
    half = canvas.texel(0.25)
    image[r - half : r + half, c - half : c + half] = 235
    alpha[r - half : r + half, c - half : c + half] = 0
    paint_target(image, canvas)


def _with_windows(image: np.ndarray, canvas: Canvas, rng: np.random.Generator) -> np.ndarray:
    """Return a wall (H, W, 4) with the common window grid and details; alpha marks what reflects."""
    alpha = np.zeros(canvas.shape, np.uint8)
    paint_windows(image, alpha, canvas)
    _details(image, alpha, canvas, rng)
    return np.dstack([image, alpha])


def paint_plaster_wall(canvas: Canvas) -> np.ndarray:
    """Paint a plain plastered wall (H, W, 4) with the common window grid."""
    rng = canvas.rng
    return _with_windows(_plaster(canvas, rng), canvas, rng)


def paint_panel_wall(canvas: Canvas) -> np.ndarray:
    """Paint a wall of identical panels (H, W, 4) with the common window grid."""
    rng = canvas.rng
    return _with_windows(_panels(canvas, rng), canvas, rng)


def paint_curtain_wall(canvas: Canvas) -> np.ndarray:
    """Paint a glass wall (H, W, 4): panes that reflect between mullions, bands at the floors, some blinds."""
    rng = canvas.rng
    rows, columns = canvas.shape
    image = np.full((rows, columns, 3), (40, 52, 56), np.uint8)
    alpha = np.full((rows, columns), round(255 * 0.72), np.uint8)
    step_x, step_y = canvas.texel(PANEL_M[0]), canvas.texel(WINDOW_PITCH_M[1])
    for top in range(0, rows, step_y):
        for left in range(0, columns, step_x):
            if rng.random() < 0.1:  # blinds, drawn to some height
                drop = round(step_y * rng.uniform(0.2, 0.8))
                slats = np.where(np.arange(drop) // max(1, canvas.texel(0.05)) % 2, 205, 180)
                part = image[top : top + drop, left : left + step_x]
                part[:] = slats[: len(part), None, None]
                alpha[top : top + drop, left : left + step_x] = 70
    band, frame = canvas.texel(0.5), max(1, canvas.texel(0.06))
    for top in range(0, rows, step_y):
        image[top : top + band], alpha[top : top + band] = (92, 98, 102), 60
    for left in range(0, columns, step_x):
        image[:, left : left + frame], alpha[:, left : left + frame] = (70, 72, 74), 0
    _details(image, alpha, canvas, rng)
    return np.dstack([shade(image, 1 + grain(rng, canvas.shape, 0.012)), alpha])


def paint_shop_window(canvas: Canvas) -> np.ndarray:
    """Paint a shop window (H, W, 4): the fourth channel is the share of the room behind."""
    rows, columns = canvas.shape
    image = np.full((rows, columns, 3), (150, 164, 176), np.uint8)
    alpha = np.full((rows, columns), round(255 * SHOP_GLASS), np.uint8)
    frame = max(1, canvas.texel(0.07))
    for c in (0, columns // 3, 2 * columns // 3, columns - frame):
        image[:, c : c + frame], alpha[:, c : c + frame] = 60, 0
    for r in (0, rows - frame):
        image[r : r + frame], alpha[r : r + frame] = 60, 0
    return np.dstack([image, alpha])


def paint_room(canvas: Canvas) -> np.ndarray:
    """Paint the back wall of a room (H, W, 3): shelves with goods, a lit ceiling, the floor."""
    rng = canvas.rng
    rows, columns = canvas.shape
    image = np.full((rows, columns, 3), rng.integers(90, 150, 3), np.uint8)
    image[: rows // 4] = (226, 224, 210)
    for c in range(0, columns, max(2, canvas.texel(1.4))):
        image[rows // 8 : rows // 6, c : c + canvas.texel(0.9)] = 250
    image[3 * rows // 4 :] = (96, 82, 66)
    shelf = canvas.texel(0.45)
    for r in range(rows // 4 + shelf, 3 * rows // 4, shelf):
        c = 0
        while c < columns:
            width, height = (
                canvas.texel(rng.uniform(0.12, 0.5)),
                canvas.texel(rng.uniform(0.1, 0.38)),
            )
            image[r - height : r, c : c + width] = rng.integers(20, 235, 3)
            c += width + canvas.texel(rng.uniform(0.02, 0.5))
        image[r : r + max(1, canvas.texel(0.03))] = 50
    return shade(image, 1 + grain(rng, canvas.shape, 0.03))


PAINTERS: dict[str, Painter] = {
    "plaster": paint_plaster_wall,
    "panels": paint_panel_wall,
    "curtain": paint_curtain_wall,
    "shop": paint_shop_window,
    "room": paint_room,
    "reflection-plaster": partial(paint_reflection, painter=paint_plaster_wall),
    "reflection-panels": partial(paint_reflection, painter=paint_panel_wall),
    "reflection-curtain": partial(paint_reflection, painter=paint_curtain_wall),
}
