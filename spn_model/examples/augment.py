"""Data augmentation: the camera rotated and zoomed, with exact labels, and photometric changes.

A camera that only rotates about its centre is related to the original image by a homography, whatever the
depth: nothing is invented, and each pixel still shows the same scene point. Pixels are COLMAP's throughout:
the centre of the upper-left pixel is (0.5, 0.5).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from spn_data.geometry.camera import COLMAP_FROM_OPENCV, OPENCV_FROM_COLMAP
from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import rotations_from_vectors


@dataclass(frozen=True, kw_only=True)
class WarpOptions:
    """Limits of the random rotation and zoom of virtual cameras."""

    tilt_deg: float = 20.0  # largest rotation about each image axis, in both directions
    roll_deg: float = 20.0  # largest rotation about the optical axis
    zoom_min: float = 0.45  # ratio of the virtual to the real focal length
    zoom_max: float = 1.35


@dataclass(frozen=True, kw_only=True)
class PhotometricOptions:
    """Strength of the photometric augmentation of a training image."""

    exposure: float = 0.35  # standard deviation of the log of the gain
    tint: float = 0.05  # the same for each channel separately
    gamma: float = 0.2  # standard deviation of the log of the exponent
    blur_share: float = 0.3  # fraction of images with motion blur
    blur_max_px: float = 7.0  # largest length of the motion blur
    noise: float = 6.0  # largest standard deviation of the noise, in grey levels of 255
    occlusion_share: float = 0.3  # fraction of images with an occluding box of one colour
    occlusion_max: float = 0.3  # largest side of the box, as a fraction of the image's side


@dataclass(frozen=True, eq=False)
class Warp:
    """Virtual camera at the centre of a real one.

    Attributes
    ----------
    rotation : ndarray, shape (3, 3)
        Rotation from the real to the virtual camera.
    source_matrix, matrix : ndarray, shape (3, 3)
        Intrinsic matrices K of the real and of the virtual image.
    width, height : int
        Size of the virtual image.
    """

    rotation: np.ndarray
    source_matrix: np.ndarray
    matrix: np.ndarray
    width: int
    height: int

    @property
    def homography(self) -> np.ndarray:
        """Homography (3, 3) from real to virtual pixels."""
        return self.matrix @ self.rotation @ np.linalg.inv(self.source_matrix)

    def pixels(self, pixels: np.ndarray) -> np.ndarray:
        """Map pixels (N, 2) of the real image into the virtual one; NaN behind the virtual camera."""
        return _mapped(self.homography, pixels)

    def source_pixels(self, pixels: np.ndarray) -> np.ndarray:
        """Map virtual pixels (N, 2) back to the real image, whether inside it or not."""
        return _mapped(np.linalg.inv(self.homography), pixels)

    def pose(self, pose: Poses) -> Poses:
        """Return the poses of the virtual cameras from the real ones (N); the centres are the same."""
        return Poses.from_rotations(pose.centers, self.rotation @ pose.rotations)

    def image(self, image: np.ndarray, fill: tuple[int, int, int] = (0, 0, 0)) -> np.ndarray:
        """Render the virtual image (height, width, 3) from the real one (H, W, 3), both uint8.

        Pixels outside the real image get the colour `fill`. If the image shrinks to less than 0.7 of its
        size, it is first reduced by two to avoid aliasing.
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
            OPENCV_FROM_COLMAP @ homography @ COLMAP_FROM_OPENCV,
            (self.width, self.height),
            flags=cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=fill,
        )

    def _scale_at(self, pixel: np.ndarray) -> float:
        """Return the number of virtual pixels per real pixel at a virtual pixel (1, 2)."""
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
    """Draw a random virtual camera at the centre of a real one.

    Parameters
    ----------
    generator : np.random.Generator
        Source of randomness.
    matrix : ndarray, shape (3, 3)
        Intrinsic matrix K of the real camera.
    size : tuple of int
        Width and height of the real image.
    options : WarpOptions
        Limits of rotation and zoom.
    zoom : float, optional
        Fixed zoom; by default it is drawn uniformly in its logarithm.
    target_size : tuple of int, optional
        Width and height of the virtual image; by default those of the real one.

    Returns
    -------
    Warp
        The principal point keeps its position relative to the image's centre.
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
    """Change exposure, colour and sharpness of an image, add noise and occlude a part of it.

    Parameters
    ----------
    image : ndarray, uint8, shape (H, W, 3)
        RGB image; not modified.
    generator : np.random.Generator
        Source of randomness.
    options : PhotometricOptions
        Strength of the changes.

    Returns
    -------
    ndarray, uint8, shape (H, W, 3)
        A new image of the same view.
    """
    gain = generator.normal(0.0, options.exposure) + generator.normal(0.0, options.tint, 3)
    gamma = np.exp(generator.normal(0.0, options.gamma))
    levels = np.linspace(0, 1, 256)[:, None] ** gamma * np.exp(gain)
    table = np.rint(np.clip(levels * 255, 0, 255)).astype(np.uint8)
    # OpenCV takes one table for each channel as the channels of its entries.
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
    """Apply motion blur along a random line; the kernel is centred, so that nothing is displaced."""
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
