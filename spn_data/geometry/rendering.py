"""Undistortion: rendering images of real lenses into pinhole cameras, and mapping their pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from spn_data.errors import GeometryError
from spn_data.geometry.camera import Camera, opencv_pixels

_WIDEST_TAN = np.tan(np.deg2rad(85.0))  # a pinhole image wider than 170 degrees is useless
_BORDER_POINTS = 512  # per side
_BORDER_TOLERANCE_PX = 1e-3  # in the source image; the view size is far more accurate
_ROUND_TRIP_PX = 1e-3  # a pixel that its ray does not project back to has no ray
SAMPLE_STEP_PX = 1.25
_MAX_SAMPLES = 16  # per side of an output pixel


@dataclass(frozen=True, kw_only=True)
class RenderingOptions:
    """Size of the canonical camera's image.

    Attributes
    ----------
    width_px : int
        Width.
    height_px : int or None
        Height; None keeps the aspect ratio of the mapping frames.
    """

    width_px: int = 480
    height_px: int | None = None


def canonical_camera(cameras: Sequence[Camera], options: RenderingOptions) -> Camera:
    """Return one pinhole camera for all lenses: the largest view without an empty pixel in any of them.

    It has square pixels and a centred principal point.

    Parameters
    ----------
    cameras : sequence of Camera
        The lenses; the first one sets the aspect ratio unless the options give a height.
    options : RenderingOptions
        Size of the image.

    Raises
    ------
    GeometryError
        If no pinhole view can be centred on the axis of a lens.
    """
    if not cameras:
        raise ValueError("at least one camera is needed")
    width = options.width_px
    height = options.height_px or max(1, round(width * cameras[0].height / cameras[0].width))
    half_width_tan = min(_largest_half_width_tan(camera, width, height) for camera in cameras)
    focal_px = width / 2 / half_width_tan
    return Camera(
        "SIMPLE_PINHOLE", width, height, np.array([focal_px, width / 2, height / 2], np.float64)
    )


def undistorted_camera(camera: Camera) -> Camera:
    """Return the pinhole of one lens at its own size: the largest centred view without empty borders."""
    options = RenderingOptions(width_px=camera.width, height_px=camera.height)
    return canonical_camera([camera], options)


def _largest_half_width_tan(camera: Camera, width: int, height: int) -> float:
    """Return tan(half the horizontal field of view) of the largest centred view of aspect width : height.

    Found by bisection. Along a ray from the axis outwards, the image point moves outwards too until the lens
    model folds, so a view that fits contains only views that fit.
    """
    side = np.linspace(-1.0, 1.0, _BORDER_POINTS)
    one = np.ones_like(side)
    border = np.concatenate(
        [
            np.stack([x, y], axis=1)
            for x, y in ((side, -one), (side, one), (-one, side), (one, side))
        ]
    )
    border[:, 1] *= height / width

    def fits(half_width_tan: float) -> bool:
        return bool(_is_seen(camera, half_width_tan * border, tolerance_px=0.0).all())

    low, high = 0.0, _WIDEST_TAN
    if not fits(1e-6):
        raise GeometryError(
            "a camera's principal point is outside its image: no pinhole view can be centred on it"
        )
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if fits(middle) else (low, middle)
    return low


def _is_seen(camera: Camera, rays: np.ndarray, *, tolerance_px: float) -> np.ndarray:
    """Return the mask (N,) of rays (N, 2), x/z and y/z, that fall inside the image and the model's fold."""
    pixels = camera.project(np.column_stack([rays, np.ones(len(rays))]))
    inside = np.all(
        (pixels >= -tolerance_px)
        & (pixels <= np.array([camera.width, camera.height]) + tolerance_px),
        axis=1,
    )
    return inside & ((rays**2).sum(axis=1) < _fold_radius(camera) ** 2)


def _fold_radius(camera: Camera) -> float:
    """Return tan(angle) beyond which a lens model maps rays back inwards; infinite if it never does.

    First root of d/dr (r + k1 r^3 + k2 r^5). Tangential terms are too small to move it by much.
    """
    k1, k2, _, _ = camera.opencv_distortion
    roots = np.roots([5 * k2, 3 * k1, 1.0])  # of r^2; np.roots drops leading zeros
    positive = roots[(np.abs(roots.imag) < 1e-12) & (roots.real > 0)].real
    return float(np.sqrt(positive.min())) if len(positive) else np.inf


class PinholeRenderer:
    """Renders images of one lens into one pinhole camera and maps pixels between them.

    Parameters
    ----------
    camera : Camera
        The lens of the source images.
    target : Camera
        The pinhole to render.
    sample_step_px : float, optional
        Maximum distance between two samples, in source pixels.

    Attributes
    ----------
    camera, target : Camera
        As given.
    valid : ndarray of bool, shape (H, W)
        Output pixels that are completely inside the source image.

    Notes
    -----
    Each output pixel is the mean of k x k samples of the source. k is large enough that no source pixel is
    skipped, so detail finer than the output is averaged out without aliasing and without a shift. k is
    chosen once, by the greatest reduction in the image. Samples are bilinear, which preserves as much as an
    area reduction of a whole image does (0.74 of a wave of 2.5 output pixels, 0.1 of one of 1 pixel; bicubic
    samples 0.80 and 0.14 for three times the time). If nothing is reduced, samples are bicubic for sharpness.
    """

    def __init__(self, camera: Camera, target: Camera, *, sample_step_px: float = SAMPLE_STEP_PX):
        if not np.isfinite(camera.params).all():
            raise ValueError("the camera has unknown parameters")
        if target.opencv_distortion.any():
            raise ValueError("the target must be a pinhole camera without distortion")
        self.camera, self.target = camera, target
        corners = _grid(target, target.width + 1, target.height + 1, first=0.0)
        shape = (target.height + 1, target.width + 1)
        seen = _is_seen(camera, corners, tolerance_px=_BORDER_TOLERANCE_PX).reshape(shape)
        self.valid = seen[:-1, :-1] & seen[:-1, 1:] & seen[1:, :-1] & seen[1:, 1:]
        self._samples = self._samples_per_side(corners, shape, sample_step_px)
        fine = target.scaled(target.width * self._samples, target.height * self._samples)
        source = _project(camera, _grid(fine, fine.width, fine.height, first=0.5))
        source = opencv_pixels(source).reshape(fine.height, fine.width, 2).astype(np.float32)
        self._maps = cv2.convertMaps(source, None, cv2.CV_16SC2)

    @property
    def all_valid(self) -> bool:
        """Whether every output pixel is valid."""
        return bool(self.valid.all())

    def _samples_per_side(
        self, corners: np.ndarray, shape: tuple[int, int], sample_step_px: float
    ) -> int:
        """Return k, the samples per output pixel and side."""
        source = _project(self.camera, corners).reshape(*shape, 2)
        across = np.linalg.norm(np.diff(source, axis=1), axis=-1)[:-1][self.valid]
        down = np.linalg.norm(np.diff(source, axis=0), axis=-1)[:, :-1][self.valid]
        step_px = float(max(across.max(initial=1.0), down.max(initial=1.0)))
        return int(np.clip(np.ceil(step_px / sample_step_px), 1, _MAX_SAMPLES))

    def render(self, image: np.ndarray) -> np.ndarray:
        """Render a full-size image of the lens.

        Parameters
        ----------
        image : ndarray of uint8, shape (h, w, ...)
            Image of the source camera's size.

        Returns
        -------
        ndarray of uint8, shape (H, W, ...)
            The pinhole image; invalid pixels are 0.
        """
        out = self._resample(image, cv2.INTER_CUBIC if self._samples == 1 else cv2.INTER_LINEAR)
        if not self.all_valid:
            out[~self.valid] = 0
        return out

    def render_mask(self, usable: np.ndarray) -> np.ndarray:
        """Return the mask (H, W) of valid pixels that see only usable pixels of a source mask (h, w)."""
        weights = self._resample(np.where(usable, 255, 0).astype(np.uint8), cv2.INTER_LINEAR)
        return self.valid & (weights == 255)

    def _resample(self, image: np.ndarray, interpolation: int) -> np.ndarray:
        if image.shape[:2] != (self.camera.height, self.camera.width):
            raise ValueError(
                f"the image is {image.shape[1]}x{image.shape[0]}, the camera is for "
                f"{self.camera.width}x{self.camera.height}"
            )
        fine = cv2.remap(image, *self._maps, interpolation, borderMode=cv2.BORDER_REPLICATE)
        if self._samples == 1:
            return fine
        size = (self.target.width, self.target.height)
        return cv2.resize(fine, size, interpolation=cv2.INTER_AREA)

    def map_pixels(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Map pixels of the full-size image into the rendered image, both in COLMAP's pixel convention.

        Parameters
        ----------
        pixels : ndarray, shape (N, 2)
            Distorted pixels of the source image.

        Returns
        -------
        mapped : ndarray, shape (N, 2)
            Pixels of the rendered image.
        seen : ndarray of bool, shape (N,)
            False for points outside the rendered image or on an invalid pixel of it, and for pixels that
            no ray leads to.
        """
        pixels = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
        rays = self.camera.unproject(pixels) if len(pixels) else pixels
        back = np.linalg.norm(_project(self.camera, rays) - pixels, axis=1)
        mapped = _project(self.target, rays)
        size = np.array([self.target.width, self.target.height])
        seen = (back < _ROUND_TRIP_PX) & np.all((mapped >= 0) & (mapped < size), axis=1)
        column, row = np.where(seen[:, None], mapped, 0.0).astype(np.int64).T
        return mapped, seen & self.valid[row, column]


def _project(camera: Camera, rays: np.ndarray) -> np.ndarray:
    return camera.project(np.column_stack([rays, np.ones(len(rays))]))


def _grid(target: Camera, columns: int, rows: int, *, first: float) -> np.ndarray:
    """Return rays (rows * columns, 2) of a pinhole at pixels first, first + 1, ... in x and y, row by row."""
    (fx, fy), (cx, cy) = target.focal_px, target.matrix[:2, 2]
    x = (np.arange(columns) + first - cx) / fx
    y = (np.arange(rows) + first - cy) / fy
    return np.stack(np.broadcast_arrays(x[None], y[:, None]), axis=-1).reshape(-1, 2)
