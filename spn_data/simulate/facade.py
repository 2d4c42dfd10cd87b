"""Painting of brick facades: identical reflecting windows, weathering, and a few unique details."""

from __future__ import annotations

import cv2
import numpy as np

from spn_data.simulate.textures import (
    Canvas,
    clouds,
    grain,
    masonry,
    palette_around,
    poster,
    shade,
    stain,
)

BRICK_M = (0.25, 0.0833)
WINDOW_M = (1.5, 2.0)
WINDOW_PITCH_M = (3.25, 3.4)
WINDOW_SILL_M = 1.3  # height of the lowest sills above the ground
GLASS_REFLECTANCE = 0.62


def window_sprite(canvas: Canvas) -> np.ndarray:
    """Paint the window (h, w, 4) uint8 used everywhere; the fourth channel is the glass's reflectance."""
    width, height = canvas.texel(WINDOW_M[0]), canvas.texel(WINDOW_M[1])
    sprite = np.zeros((height, width, 4), np.uint8)
    sprite[:, :, :3] = (226, 224, 216)  # frame
    sill, frame, bar = canvas.texel(0.1), canvas.texel(0.08), canvas.texel(0.05)
    sprite[-sill:, :, :3] = (168, 164, 158)
    panes = [(0.0, 0.5, 0.32, 1.0), (0.5, 1.0, 0.32, 1.0), (0.0, 1.0, 0.0, 0.32)]
    inner_w, inner_h = width - 2 * frame, height - sill - 2 * frame
    for s0, s1, t0, t1 in panes:
        c0, c1 = frame + round(s0 * inner_w) + bar // 2, frame + round(s1 * inner_w) - bar // 2
        r0, r1 = frame + round(t0 * inner_h) + bar // 2, frame + round(t1 * inner_h) - bar // 2
        depth = np.linspace(34, 62, r1 - r0)[:, None]
        sprite[r0:r1, c0:c1, :3] = (depth[:, :, None] * (0.9, 1.0, 1.08)).astype(np.uint8)
        sprite[r0:r1, c0:c1, 3] = round(255 * GLASS_REFLECTANCE)
    return sprite


def window_corners_m(width_m: float, height_m: float) -> np.ndarray:
    """Return upper-left corners (N, 2) of the windows, metres right of and below the facade's upper left."""
    columns = int((width_m - 1.0) // WINDOW_PITCH_M[0])
    left = (width_m - (columns - 1) * WINDOW_PITCH_M[0] - WINDOW_M[0]) / 2
    rows = int((height_m - WINDOW_SILL_M - WINDOW_M[1]) // WINDOW_PITCH_M[1]) + 1
    corners = [
        (
            left + i * WINDOW_PITCH_M[0],
            height_m - WINDOW_SILL_M - WINDOW_M[1] - j * WINDOW_PITCH_M[1],
        )
        for j in range(rows)
        for i in range(columns)
    ]
    return np.array(corners)


def target_texel(canvas: Canvas) -> tuple[int, int]:
    """Return row and column of the texel corner at the centre of the facade's survey target."""
    pier = window_corners_m(*canvas.size_m)[0, 0] + (WINDOW_M[0] + WINDOW_PITCH_M[0]) / 2
    return canvas.shape[0] - canvas.texel(4.2), canvas.texel(pier)


def paint_target(image: np.ndarray, canvas: Canvas) -> None:
    """Paint the survey target of a wall, in place."""
    r, c = target_texel(canvas)
    half = canvas.texel(0.2)
    image[r - half : r + half, c - half : c + half] = 235
    image[r - half : r, c - half : c] = image[r : r + half, c : c + half] = 25


def paint_windows(image: np.ndarray, alpha: np.ndarray, canvas: Canvas) -> None:
    """Paint the window grid with its shadow gaps and reflectance, in place."""
    sprite = window_sprite(canvas)
    for x, y in window_corners_m(*canvas.size_m):
        r, c = canvas.texel(y), canvas.texel(x)
        shadow = canvas.texel(0.06)
        image[
            r - shadow : r + len(sprite) + shadow, c - shadow : c + sprite.shape[1] + shadow
        ] //= 2
        image[r : r + len(sprite), c : c + sprite.shape[1]] = sprite[:, :, :3]
        alpha[r : r + len(sprite), c : c + sprite.shape[1]] = sprite[:, :, 3]


def paint_facade(canvas: Canvas) -> np.ndarray:
    """Paint a brick wall (H, W, 4) with the common window grid, weathering, and details of its own."""
    rng = canvas.rng
    palette = palette_around(rng, (150, 88, 68), 0.14)
    image = masonry(canvas, rng, palette, BRICK_M)
    rows, columns = canvas.shape
    weather = clouds(rng, canvas, largest_m=9.0, smallest_m=0.12)
    factor = 1.0 + 0.085 * weather + grain(rng, canvas.shape, 0.035)
    # Rain streaks: dark vertical bands, few wide ones and many thin ones.
    streak = cv2.resize(rng.standard_normal((5, columns // 5), dtype=np.float32), (columns, rows))
    factor -= 0.05 * np.clip(streak, 0, 2.5)
    damp = np.linspace(0, canvas.size_m[1], rows, dtype=np.float32)[:, None]
    factor *= 1 - 0.28 * np.exp((damp - canvas.size_m[1]) / 0.7)  # splash zone above the ground
    image = shade(image, factor)
    stain(image, canvas, rng, count=round(canvas.size_m[0] * 0.5))
    plinth = canvas.texel(0.6)
    image[-plinth:] = shade(
        np.full((plinth, columns, 3), (128, 124, 118), np.uint8),
        1 + 0.1 * weather[-plinth:] + grain(rng, (plinth, columns), 0.06),
    )
    for level in range(1, 6):
        band = rows - canvas.texel(WINDOW_PITCH_M[1] * level - 0.25)
        if band > 0:
            image[band : band + canvas.texel(0.16)] = shade(
                np.full((canvas.texel(0.16), columns, 3), (176, 168, 154), np.uint8),
                1 + 0.08 * weather[band : band + canvas.texel(0.16)],
            )
    alpha = np.zeros((rows, columns), np.uint8)
    paint_windows(image, alpha, canvas)
    _paint_unique_details(image, alpha, canvas, rng)
    return np.dstack([image, alpha])


def _paint_unique_details(
    image: np.ndarray, alpha: np.ndarray, canvas: Canvas, rng: np.random.Generator
) -> None:
    """Paint a door, posters, pipes, the survey target and a sign between the windows, in place."""
    rows = len(alpha)
    corners = window_corners_m(*canvas.size_m)
    gaps_m = np.unique(corners[:, 0])[:-1] + WINDOW_M[0]  # left ends of the piers between windows
    pier_m = WINDOW_PITCH_M[0] - WINDOW_M[0]
    picks = 1 + rng.permutation(len(gaps_m) - 1)  # the first pier carries the survey target

    def paste(part: np.ndarray, x_m: float, y_m: float) -> None:
        r, c = canvas.texel(y_m), canvas.texel(x_m)
        image[r : r + len(part), c : c + part.shape[1]] = part
        alpha[r : r + len(part), c : c + part.shape[1]] = 0

    height_m = canvas.size_m[1]
    door_w, door_h = canvas.texel(1.3), canvas.texel(2.3)
    door = np.full((door_h, door_w, 3), rng.integers(30, 130, 3), np.uint8)
    door[:, door_w // 2 - 1 : door_w // 2 + 1] = 20
    for s in (0.08, 0.56):
        for t in (0.08, 0.56):
            cv2.rectangle(
                door,
                (int(s * door_w), int(t * door_h)),
                (int((s + 0.36) * door_w), int((t + 0.36) * door_h)),
                tuple(int(v) for v in rng.integers(20, 200, 3)),
                max(1, canvas.texel(0.03)),
            )
    paste(
        shade(door, 1 + grain(rng, door.shape[:2], 0.05)),
        gaps_m[picks[0]] + (pier_m - 1.3) / 2,
        height_m - 2.3,
    )
    for k in range(1, min(5, len(picks))):
        size = rng.uniform(0.6, 1.2)
        art = poster(rng, canvas.texel(size), canvas.texel(size * 1.35))
        paste(
            art,
            gaps_m[picks[k]] + rng.uniform(0.1, pier_m - size - 0.1),
            height_m - rng.uniform(2.2, 3.6),
        )
    for k in range(5, min(8, len(picks))):
        x = canvas.texel(gaps_m[picks[k]] + rng.uniform(0.3, pier_m - 0.3))
        width = canvas.texel(0.1)
        tone = np.sin(np.linspace(0.3, np.pi - 0.3, width)) * 120 + 20
        image[:, x : x + width] = np.repeat(tone[:, None], 3, axis=1).astype(np.uint8)
        for joint in range(canvas.texel(1.1), rows, canvas.texel(2.7)):
            image[joint : joint + canvas.texel(0.06), x - 2 : x + width + 2] = (60, 62, 64)
    paint_target(image, canvas)
    sign = poster(rng, canvas.texel(1.5), canvas.texel(0.8))
    paste(sign, gaps_m[picks[-1]] + 0.12, height_m - rng.uniform(6.0, 9.0))
