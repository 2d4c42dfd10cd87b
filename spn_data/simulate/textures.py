"""Building blocks of painted textures (masonry, stains, grain), and the ground of the courtyard.

Every texture is a function of its name, its size in metres and the seed. It has structure at all scales, from
stains of several metres to grain of one texel, so that image features behave as in a real scene.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import cv2
import numpy as np


@dataclass(frozen=True, kw_only=True)
class Canvas:
    """Size, resolution and random seed of a texture.

    size_m : width and height; texels_per_m : resolution; seed : of the scene; name : is also part of the
    random seed, so that no two surfaces share their stains.
    """

    name: str
    size_m: tuple[float, float]
    texels_per_m: float
    seed: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        width, height = self.size_m
        return round(height * self.texels_per_m), round(width * self.texels_per_m)

    @property
    def rng(self) -> np.random.Generator:
        """New random generator, always in the same state."""
        return np.random.default_rng([self.seed, zlib.crc32(self.name.encode())])

    def texel(self, metres: float) -> int:
        """Convert a length in metres to texels."""
        return round(metres * self.texels_per_m)


def clouds(
    rng: np.random.Generator,
    canvas: Canvas,
    *,
    largest_m: float,
    smallest_m: float,
    gain: float = 0.55,
) -> np.ndarray:
    """Draw a smooth random field (H, W) float32 as a sum of octaves, of about zero mean and unit variance."""
    rows, columns = canvas.shape
    width_m, height_m = canvas.size_m
    # The field is drawn at a quarter of the resolution and enlarged, for a sixteenth of the cost.
    small = (max(2, rows // 4), max(2, columns // 4))
    total = np.zeros(small, np.float32)
    grain, weight, power = largest_m, 1.0, 0.0
    while grain >= smallest_m:
        shape = (max(2, round(height_m / grain) + 2), max(2, round(width_m / grain) + 2))
        octave = rng.standard_normal(shape, dtype=np.float32)
        octave = cv2.resize(octave, (small[1], small[0]), interpolation=cv2.INTER_CUBIC)
        total += weight * octave
        power += 0.6 * weight**2
        grain, weight = grain / 2, weight * gain
    return cv2.resize(
        total / np.float32(np.sqrt(power)), (columns, rows), interpolation=cv2.INTER_LINEAR
    )


def grain(rng: np.random.Generator, shape: tuple[int, int], sigma: float) -> np.ndarray:
    """Draw texel noise (H, W) float32 with a period of at least 700 texels."""
    tile = rng.standard_normal((min(shape[0], 701), min(shape[1], 997)), dtype=np.float32)
    tile = 0.6 * tile + 1.2 * cv2.GaussianBlur(tile, (0, 0), 1.0)
    repeats = (-(-shape[0] // tile.shape[0]), -(-shape[1] // tile.shape[1]))
    return np.tile(sigma * tile, repeats)[: shape[0], : shape[1]]


def shade(image: np.ndarray, factor: np.ndarray) -> np.ndarray:
    """Multiply an image (H, W, 3) uint8 by a factor (H, W)."""
    return cv2.multiply(image, cv2.merge([factor] * 3), dtype=cv2.CV_8U)


def _courses(
    canvas: Canvas, size_m: tuple[float, float], joint_m: float, bond: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return row (H, W) and column (H, W) of the brick at each texel, and whether it is in a joint (H, W)."""
    rows, columns = canvas.shape
    y = (np.arange(rows, dtype=np.float32) + 0.5) / np.float32(canvas.texels_per_m)
    x = (np.arange(columns, dtype=np.float32) + 0.5) / np.float32(canvas.texels_per_m)
    row = (y / size_m[1]).astype(np.int32)
    column_of = [((x / size_m[0] + bond * odd).astype(np.int32)) for odd in (0, 1)]
    joint_of = [np.mod(x / size_m[0] + bond * odd, 1.0) < joint_m / size_m[0] for odd in (0, 1)]
    odd_row = (row % 2).astype(np.intp)
    column = np.stack(column_of)[odd_row]
    joint = np.stack(joint_of)[odd_row] | (np.mod(y, size_m[1]) < joint_m)[:, None]
    return np.broadcast_to(row[:, None], canvas.shape), column, joint


def masonry(
    canvas: Canvas,
    rng: np.random.Generator,
    palette: np.ndarray,
    size_m: tuple[float, float],
    *,
    joint_m: float = 0.012,
    joint_rgb: tuple[int, int, int] = (150, 145, 138),
    bond: float = 0.5,
) -> np.ndarray:
    """Paint stones (H, W, 3) uint8 with colours from a palette (K, 3) and joints between them."""
    row, column, joint = _courses(canvas, size_m, joint_m, bond)
    count = (int(row.max()) + 1, int(column.max()) + 1)
    choice = rng.integers(0, len(palette), count).astype(np.uint8)
    colours = np.vstack([np.clip(palette, 0, 255), [joint_rgb]]).astype(np.uint8)
    index = choice[row, column]
    index[joint] = len(palette)
    return colours[index]


def palette_around(
    rng: np.random.Generator, base: tuple[int, int, int], spread: float
) -> np.ndarray:
    """Draw colours (64, 3) that vary in brightness by the relative `spread`, and a little in hue."""
    tone = rng.normal(1.0, spread, (64, 1)) * np.asarray(base)
    return tone * rng.normal(1.0, spread / 5, (64, 3))


def stain(image: np.ndarray, canvas: Canvas, rng: np.random.Generator, count: int) -> None:
    """Darken or bleach irregular patches, in place."""
    rows, columns = image.shape[:2]
    for _ in range(count):
        height, width = canvas.texel(rng.uniform(0.3, 2.5)), canvas.texel(rng.uniform(0.2, 1.8))
        r, c = (
            int(rng.integers(0, max(1, rows - height))),
            int(rng.integers(0, max(1, columns - width))),
        )
        field = cv2.resize(
            rng.standard_normal((6, 6), dtype=np.float32),
            (width, height),
            interpolation=cv2.INTER_CUBIC,
        )
        y, x = np.linspace(-1, 1, height)[:, None], np.linspace(-1, 1, width)[None]
        mask = np.clip(1.2 - 1.3 * (x * x + y * y) + 0.5 * field, 0, 1).astype(np.float32)
        part = image[r : r + height, c : c + width]
        part[:] = shade(
            part,
            1 + np.float32(rng.choice([-0.45, -0.3, 0.3])) * mask[: part.shape[0], : part.shape[1]],
        )


def poster(rng: np.random.Generator, width: int, height: int) -> np.ndarray:
    """Paint a poster (h, w, 3) uint8: shapes and lettering in a few strong colours."""
    image = np.full((height, width, 3), rng.integers(150, 250, 3), np.uint8)
    for _ in range(9):
        colour = tuple(int(v) for v in rng.integers(10, 240, 3))
        centre = (int(rng.integers(0, width)), int(rng.integers(0, height)))
        size = int(rng.integers(max(2, width // 12), max(3, width // 3)))
        if rng.random() < 0.5:
            cv2.circle(image, centre, size, colour, -1, cv2.LINE_AA)
        else:
            corner = (centre[0] + size, centre[1] + int(size * rng.uniform(0.3, 1.6)))
            cv2.rectangle(image, centre, corner, colour, -1)
    for line in range(4):
        text = "".join(chr(int(v)) for v in rng.integers(65, 91, 9))
        place = (width // 14, int(height * (0.2 + 0.22 * line)))
        cv2.putText(
            image,
            text,
            place,
            cv2.FONT_HERSHEY_DUPLEX,
            width / 210,
            (20, 20, 24),
            max(1, width // 90),
            cv2.LINE_AA,
        )
    border = max(1, width // 40)
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), (245, 245, 245), border)
    return image


def paint_plaza(canvas: Canvas) -> np.ndarray:
    """Paint the ground of the courtyard (H, W, 3): slabs, cobbles, grass, leaves, manholes, stains."""
    rng = canvas.rng
    rows, columns = canvas.shape
    palette = palette_around(rng, (146, 142, 134), 0.07)
    image = masonry(
        canvas, rng, palette, (0.5, 0.5), joint_m=0.016, joint_rgb=(88, 86, 80), bond=0.0
    )
    cobbles = masonry(
        canvas,
        rng,
        palette_around(rng, (112, 106, 100), 0.15),
        (0.14, 0.12),
        joint_m=0.02,
        joint_rgb=(70, 66, 60),
    )
    lush = clouds(rng, canvas, largest_m=6.0, smallest_m=0.06, gain=0.7)
    kinds = clouds(rng, canvas, largest_m=9.0, smallest_m=2.0)
    np.copyto(image, cobbles, where=(kinds < -0.75)[:, :, None])
    green = np.clip(lush, -2.5, 2.5)
    meadow = np.stack([86 + 22 * green, 104 + 20 * green, 56 + 14 * green], axis=-1)
    np.copyto(image, np.clip(meadow, 0, 255).astype(np.uint8), where=(kinds > 0.95)[:, :, None])
    image = shade(image, 1 + 0.1 * lush + grain(rng, canvas.shape, 0.05))
    stain(image, canvas, rng, count=round(canvas.size_m[0] * canvas.size_m[1] * 0.06))
    for _ in range(round(canvas.size_m[0] * canvas.size_m[1] * 1.3)):  # leaves
        centre = (int(rng.integers(0, columns)), int(rng.integers(0, rows)))
        axes = (
            max(1, canvas.texel(rng.uniform(0.02, 0.06))),
            max(1, canvas.texel(rng.uniform(0.015, 0.04))),
        )
        tone = rng.uniform(0.5, 1.2)
        colour = (int(150 * tone), int(rng.uniform(70, 130) * tone), int(40 * tone))
        cv2.ellipse(
            image, centre, axes, float(rng.uniform(0, 180)), 0, 360, colour, -1, cv2.LINE_AA
        )
    for _ in range(14):
        centre = (int(rng.integers(0, columns)), int(rng.integers(0, rows)))
        radius = canvas.texel(0.33)
        cv2.circle(image, centre, radius, (66, 64, 62), -1, cv2.LINE_AA)
        for k in range(-3, 4):
            offset = round(k * radius / 4)
            reach = round(0.8 * np.sqrt(max(radius**2 - offset**2, 0)))
            cv2.line(
                image,
                (centre[0] + offset, centre[1] - reach),
                (centre[0] + offset, centre[1] + reach),
                (104, 100, 96),
                max(1, radius // 12),
            )
    edge = np.minimum(np.arange(rows), rows - 1 - np.arange(rows))[:, None] / canvas.texels_per_m
    side = (
        np.minimum(np.arange(columns), columns - 1 - np.arange(columns))[None] / canvas.texels_per_m
    )
    dim = 1 - 0.3 * np.exp(-edge / 0.9) - 0.3 * np.exp(-side / 0.9)  # less skylight near the walls
    return shade(image, dim.astype(np.float32))
