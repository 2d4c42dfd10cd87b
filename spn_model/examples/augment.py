"""Views of a training image that the same camera, turned and zoomed, would have had; labels stay exact.

A camera that only turns about its centre sees its old image through a homography, whatever the depth:
nothing is invented, and each pixel goes on showing the same point of the scene. Pixels are COLMAP's
throughout: the centre of the upper-left pixel is (0.5, 0.5).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from spn_data.geometry.pose import Poses, rotations_from_vectors

# cv2 counts from the centre of the upper-left pixel.
_CV2_FROM_COLMAP = np.array([[1.0, 0.0, -0.5], [0.0, 1.0, -0.5], [0.0, 0.0, 1.0]])
_COLMAP_FROM_CV2 = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])


@dataclass(frozen=True, kw_only=True)
class WarpOptions:
    """How far virtual cameras differ from the real one."""

    tilt_deg: float = 20.0  # largest turn about each of the image's axes, to either side
    roll_deg: float = 20.0  # and about the optical axis
    zoom_min: float = 0.45  # focal length against the real one
    zoom_max: float = 1.35


@dataclass(frozen=True, kw_only=True)
class PhotometricOptions:
    """How far the look of a training image is changed."""

    exposure: float = 0.35  # standard deviation of the log of the gain
    tint: float = 0.05  # the same of each channel alone
    gamma: float = 0.2  # standard deviation of the log of the exponent
    blur_share: float = 0.3  # share of images that are blurred along a line, as by motion
    blur_max_px: float = 7.0  # longest such line
    noise: float = 6.0  # largest standard deviation of the noise, of 255
    occlusion_share: float = 0.3  # share of images with a box of one colour
    occlusion_max: float = 0.3  # its largest side, as a share of the image's


@dataclass(frozen=True, eq=False)
class Warp:
    """A virtual camera at a real one's place.

    rotation : (3, 3), virtual from real camera; source_matrix, matrix : (3, 3), K of the real and of the
    virtual image; width, height : of the virtual image.
    """

    rotation: np.ndarray
    source_matrix: np.ndarray
    matrix: np.ndarray
    width: int
    height: int

    @property
    def homography(self) -> np.ndarray:
        """(3, 3), virtual from real pixels."""
        return self.matrix @ self.rotation @ np.linalg.inv(self.source_matrix)

    def pixels(self, pixels: np.ndarray) -> np.ndarray:
        """Where points that lie at real pixels (N, 2) lie in the virtual image; NaN behind its camera."""
        return _mapped(self.homography, pixels)

    def source_pixels(self, pixels: np.ndarray) -> np.ndarray:
        """The way back: (N, 2) pixels of the real image, whether inside it or not."""
        return _mapped(np.linalg.inv(self.homography), pixels)

    def pose(self, pose: Poses) -> Poses:
        """Of the virtual cameras, from the real ones' (N): the same centres."""
        return Poses.from_rotations(pose.centers, self.rotation @ pose.rotations)

    def image(self, image: np.ndarray, fill: tuple[int, int, int] = (0, 0, 0)) -> np.ndarray:
        """(height, width, 3) uint8 of the virtual camera, `fill` where the real one (H, W, 3) saw nothing.

        Where the image shrinks to less than 0.7 of its size, it is first reduced by two, so that no pixel
        is passed over.
        """
        homography = self.homography
        middle = np.array([[self.width / 2, self.height / 2]])
        if self._scale_at(middle) < 0.7:
            h, w = image.shape[:2]
            half = cv2.resize(image, (w // 2, h // 2), interpolation=cv2.INTER_AREA)
            homography = homography @ np.diag([w / (w // 2), h / (h // 2), 1.0])
            image = half
        return cv2.warpPerspective(
            image,
            _CV2_FROM_COLMAP @ homography @ _COLMAP_FROM_CV2,
            (self.width, self.height),
            flags=cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=fill,
        )

    def _scale_at(self, pixel: np.ndarray) -> float:
        """Virtual pixels per real one at a virtual pixel (1, 2)."""
        corners = self.source_pixels(pixel + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
        across, down = corners[1:] - corners[0]
        return float(np.abs(across[0] * down[1] - across[1] * down[0]) ** -0.5)


def _mapped(homography: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    x = np.asarray(pixels, dtype=np.float64) @ homography[:, :2].T + homography[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(x[:, 2:] > 0, x[:, :2] / x[:, 2:], np.nan)


def random_warp(
    generator: np.random.Generator,
    matrix: np.ndarray,
    size: tuple[int, int],
    options: WarpOptions,
    *,
    zoom: float | None = None,
    target_size: tuple[int, int] | None = None,
) -> Warp:
    """A virtual camera near a real one of K (3, 3) and size (width, height).

    zoom : a fixed one, else drawn evenly in its logarithm; target_size : (width, height) of the virtual
    image, else the real one's. The principal point keeps its place relative to the image's middle.
    """
    tilt, roll = np.deg2rad([options.tilt_deg, options.roll_deg])
    turn = generator.uniform(-1, 1, 3) * [tilt, tilt, roll]
    if zoom is None:
        low, high = np.log([options.zoom_min, options.zoom_max])
        zoom = float(np.exp(generator.uniform(low, high)))
    width, height = target_size or size
    virtual = np.array(matrix, dtype=np.float64)
    virtual[:2, :2] *= zoom
    virtual[:2, 2] = (virtual[:2, 2] - np.array(size) / 2) * zoom + np.array([width, height]) / 2
    return Warp(rotations_from_vectors(turn[None])[0], np.asarray(matrix), virtual, width, height)


def augment_photometrically(
    image: np.ndarray, generator: np.random.Generator, options: PhotometricOptions
) -> np.ndarray:
    """The same view (H, W, 3) uint8 in other light, blurred, noisy, partly hidden. A new array."""
    gain = generator.normal(0.0, options.exposure) + generator.normal(0.0, options.tint, 3)
    gamma = np.exp(generator.normal(0.0, options.gamma))
    levels = np.linspace(0, 1, 256)[:, None] ** gamma * np.exp(gain)
    table = np.rint(np.clip(levels * 255, 0, 255)).astype(np.uint8)
    # cv2 takes a table for each channel as one pixel's channels.
    image = cv2.LUT(image, table[:, None, :])
    if generator.random() < options.blur_share:
        image = _blurred(image, generator, options.blur_max_px)
    if generator.random() < options.occlusion_share:
        image = _occluded(image, generator, options.occlusion_max)
    sigma = generator.uniform(0, options.noise)
    noise = np.empty(image.shape, np.int16)
    cv2.setRNGSeed(int(generator.integers(2**31)))
    cv2.randn(noise, 0, sigma)
    return cv2.add(image, noise, dtype=cv2.CV_8U)


def _blurred(image: np.ndarray, generator: np.random.Generator, longest_px: float) -> np.ndarray:
    """Along a line through each pixel; nothing moves."""
    half = generator.uniform(0.5, longest_px / 2)
    angle = generator.uniform(0, np.pi)
    reach = int(np.ceil(half)) + 1
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1].astype(np.float64)
    along = x * np.cos(angle) + y * np.sin(angle)
    across = y * np.cos(angle) - x * np.sin(angle)
    kernel = np.clip(half + 0.5 - np.abs(along), 0, 1) * np.clip(1 - np.abs(across), 0, 1)
    return cv2.filter2D(image, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE)


def _occluded(image: np.ndarray, generator: np.random.Generator, largest: float) -> np.ndarray:
    height, width = image.shape[:2]
    w = int(generator.uniform(0.05, largest) * width)
    h = int(generator.uniform(0.05, largest) * height)
    left, top = generator.integers(0, width - w), generator.integers(0, height - h)
    image = image.copy()
    image[top : top + h, left : left + w] = generator.integers(0, 256, 3)
    return image
