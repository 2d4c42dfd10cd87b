"""Encodes images as H.264 video, and makes them look as from a sensor."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np

_NOISE_MARGIN_PX = 256


def noise_field(width: int, height: int, sigma: float, seed: int) -> np.ndarray:
    """Gaussian noise (height + margin, width + margin, 3) int16, of which each frame takes another cut."""
    rng = np.random.default_rng([seed, 5])
    shape = (height + _NOISE_MARGIN_PX, width + _NOISE_MARGIN_PX, 3)
    return np.rint(sigma * rng.standard_normal(shape, dtype=np.float32)).astype(np.int16)


def develop(
    image: np.ndarray,
    *,
    lens_blur_px: float,
    exposure_ev: float,
    noise: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray:
    """Image (H, W, 3) uint8 as the lens blurs it and as exposed, with the sensor's noise."""
    height, width = image.shape[:2]
    if lens_blur_px > 0:
        image = cv2.GaussianBlur(image, (5, 5), lens_blur_px)
    # Display values grow with about the 2.2th root of the light.
    exposed = cv2.convertScaleAbs(image, alpha=2.0 ** (exposure_ev / 2.2))
    r, c = rng.integers(0, _NOISE_MARGIN_PX, 2)
    cut = noise[r : r + height, c : c + width]
    if rng.random() < 0.5:
        return cv2.add(exposed, cut, dtype=cv2.CV_8U)
    return cv2.subtract(exposed, cut, dtype=cv2.CV_8U)


def write_video(
    path: Path, frames: Iterable[np.ndarray], *, width: int, height: int, fps: float, crf: int
) -> None:
    """H.264 in the container that the suffix says; frames (H, W, 3) uint8 RGB, the i-th at i / fps s."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
        stream.width, stream.height = width, height
        stream.pix_fmt = "yuv420p"
        # No B-frames and a key frame every second, as drones' encoders do. One thread keeps bytes equal.
        stream.options = {
            "crf": str(crf),
            "preset": "veryfast",
            "bf": "0",
            "g": str(max(1, round(fps))),
        }
        stream.thread_count = 1
        for pixels in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        container.mux(stream.encode())
