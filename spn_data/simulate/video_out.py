"""Sensor model of rendered images, and H.264 encoding."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np

_NOISE_MARGIN_PX = 256


def noise_field(width: int, height: int, sigma: float, seed: int) -> np.ndarray:
    """Draw noise (height + margin, width + margin, 3) int16; each frame uses another crop of it."""
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
    """Apply lens blur, exposure and sensor noise to an image (H, W, 3) uint8."""
    height, width = image.shape[:2]
    if lens_blur_px > 0:
        image = cv2.GaussianBlur(image, (5, 5), lens_blur_px)
    # Display values are roughly the light to the power of 1/2.2.
    exposed = cv2.convertScaleAbs(image, alpha=2.0 ** (exposure_ev / 2.2))
    r, c = rng.integers(0, _NOISE_MARGIN_PX, 2)
    crop = noise[r : r + height, c : c + width]
    if rng.random() < 0.5:
        return cv2.add(exposed, crop, dtype=cv2.CV_8U)
    return cv2.subtract(exposed, crop, dtype=cv2.CV_8U)


def write_video(
    path: Path, frames: Iterable[np.ndarray], *, width: int, height: int, fps: float, crf: int
) -> None:
    """Encode frames (H, W, 3) uint8 RGB as H.264, the i-th at i / fps seconds.

    Parameters
    ----------
    path : Path
        File to write; the suffix selects the container.
    frames : iterable of ndarray, shape (H, W, 3)
        Images in RGB, uint8.
    width, height : int
        Image size; even numbers.
    fps : float
        Frame rate.
    crf : int
        H.264 quality; lower is better.
    """
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
        stream.width, stream.height = width, height
        stream.pix_fmt = "yuv420p"
        # No B-frames and a key frame every second, like drones' encoders. One thread makes the bytes
        # reproducible.
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
