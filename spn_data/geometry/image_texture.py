"""Texture of an image: whether it shows enough for a pose, or is black, white, fogged or covered."""

from __future__ import annotations

import cv2
import numpy as np

# A reduced image averages the noise of a dark sensor away and keeps what a scene shows. Photos and frames of
# flights have 0.54 or more of such pixels, an image through fog that leaves a tenth of the contrast 0.04.
WIDTH_PX = 120
DETAIL_LEVELS = 4.0
MIN_DETAIL_SHARE = 0.1
_SIGMA_PX = 1.5
_DARK_LEVEL, _BRIGHT_LEVEL = 24.0, 231.0


def detail_share(image: np.ndarray) -> float:
    """Return the share of an image that has texture.

    Parameters
    ----------
    image : ndarray of uint8, shape (H, W, 3)
        Image, BGR or RGB.

    Returns
    -------
    float
        Share of the pixels, of the grey image reduced to a width of 120 pixels, that differ by more than 4
        of 255 levels from their surroundings (Gaussian mean, sigma 1.5 pixels).
    """
    height, width = image.shape[:2]
    if width > WIDTH_PX:
        size = (WIDTH_PX, max(1, round(height * WIDTH_PX / width)))
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    gray = image.astype(np.float32).mean(axis=2)
    detail = np.abs(gray - cv2.GaussianBlur(gray, (0, 0), _SIGMA_PX))
    return float((detail > DETAIL_LEVELS).mean())


def missing_texture(image: np.ndarray) -> str:
    """Return why an image shows too little for a pose; empty if it shows enough.

    Parameters
    ----------
    image : ndarray of uint8, shape (H, W, 3)
        Image as the camera took it, BGR or RGB.

    Returns
    -------
    str
        The reason, if less than 10 % of the image has texture (see `detail_share`).
    """
    share = detail_share(image)
    if share >= MIN_DETAIL_SHARE:
        return ""
    level = float(cv2.resize(image, (16, 16), interpolation=cv2.INTER_AREA).mean())
    what = "uniform, blurred, fogged or covered"
    if level < _DARK_LEVEL:
        what = "nearly black"
    elif level > _BRIGHT_LEVEL:
        what = "nearly white"
    return (
        f"the image is {what}: only {100 * share:.0f} % of it has texture, need "
        f"{100 * MIN_DETAIL_SHARE:.0f} %"
    )
