"""Cameras: COLMAP's models and parameter order, projection, and the half-pixel shift to OpenCV."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

# The centre of the upper-left pixel is (0.5, 0.5) in COLMAP's convention, (0, 0) in OpenCV's.
_HALF_PIXEL = 0.5
# The shifts between them as homographies of pixels.
OPENCV_FROM_COLMAP = np.array([[1, 0, -_HALF_PIXEL], [0, 1, -_HALF_PIXEL], [0, 0, 1]])
COLMAP_FROM_OPENCV = np.array([[1, 0, _HALF_PIXEL], [0, 1, _HALF_PIXEL], [0, 0, 1]])

# Parameter names of each model, in COLMAP's order.
MODELS: dict[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
}


def opencv_pixels(pixels: np.ndarray) -> np.ndarray:
    """Convert pixels from COLMAP's convention to OpenCV's: from a first pixel centre of 0.5 to 0."""
    return pixels - _HALF_PIXEL


def colmap_pixels(pixels: np.ndarray) -> np.ndarray:
    """Convert pixels from OpenCV's convention, or array indices, to COLMAP's: from 0 to 0.5."""
    return pixels + _HALF_PIXEL


@dataclass(frozen=True, eq=False)
class Camera:
    """Intrinsics of one lens at one image size.

    Attributes
    ----------
    model : str
        A key of `MODELS`.
    width, height : int
        Image size in pixels.
    params : ndarray, shape (P,)
        Parameters in COLMAP's order, float64, in pixels; the centre of the upper-left pixel is (0.5, 0.5).
    """

    model: str
    width: int
    height: int
    params: np.ndarray

    def __post_init__(self) -> None:
        if self.model not in MODELS:
            raise ValueError(
                f"camera model {self.model!r} is not supported: use one of {', '.join(MODELS)}"
            )
        if len(self.params) != len(MODELS[self.model]):
            raise ValueError(
                f"{self.model} takes {len(MODELS[self.model])} parameters, got {len(self.params)}"
            )

    @classmethod
    def from_horizontal_fov(
        cls, width: int, height: int, fov_deg: float, distortion: tuple[float, ...] = ()
    ) -> Camera:
        """Return a camera with a centred principal point and a given horizontal field of view.

        Parameters
        ----------
        width, height : int
            Image size in pixels.
        fov_deg : float
            Horizontal field of view of the undistorted image.
        distortion : tuple of float, optional
            0, 1, 2 or 4 distortion coefficients; their number selects the camera model.

        Returns
        -------
        Camera
        """
        f = width / 2 / np.tan(np.deg2rad(fov_deg) / 2)
        center = (width / 2, height / 2)
        model = {0: "SIMPLE_PINHOLE", 1: "SIMPLE_RADIAL", 2: "RADIAL", 4: "OPENCV"}[len(distortion)]
        focals = (f, f) if model == "OPENCV" else (f,)
        return cls(
            model, width, height, np.array([*focals, *center, *distortion], dtype=np.float64)
        )

    def _get(self, name: str, default: float = 0.0) -> float:
        names = MODELS[self.model]
        return float(self.params[names.index(name)]) if name in names else default

    @property
    def focal_px(self) -> tuple[float, float]:
        """Focal lengths (fx, fy) in pixels."""
        f = self._get("f")
        return self._get("fx", f), self._get("fy", f)

    @property
    def matrix(self) -> np.ndarray:
        """Calibration matrix K (3, 3) in COLMAP's pixel convention."""
        fx, fy = self.focal_px
        return np.array([[fx, 0, self._get("cx")], [0, fy, self._get("cy")], [0, 0, 1.0]])

    @property
    def opencv_distortion(self) -> np.ndarray:
        """Distortion coefficients (k1, k2, p1, p2) in OpenCV's order."""
        return np.array([self._get("k1"), self._get("k2"), self._get("p1"), self._get("p2")])

    @property
    def horizontal_fov_deg(self) -> float:
        """Horizontal field of view of the undistorted image, in degrees."""
        return float(np.rad2deg(2 * np.arctan(self.width / 2 / self.focal_px[0])))

    def project(self, points_cam: np.ndarray) -> np.ndarray:
        """Project points from the camera frame into the image.

        Parameters
        ----------
        points_cam : ndarray, shape (N, 3)
            Points in the camera frame.

        Returns
        -------
        ndarray, shape (N, 2)
            Distorted pixels; NaN for points on or behind the camera plane.
        """
        points = np.asarray(points_cam, dtype=np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):
            xy = np.where(points[:, 2:] > 0, points[:, :2] / points[:, 2:], np.nan)
        k = self.matrix
        return self.distort(xy) * np.array([k[0, 0], k[1, 1]]) + k[:2, 2]

    def distort(self, rays: np.ndarray) -> np.ndarray:
        """Apply the lens distortion to normalised image coordinates (N, 2), x/z and y/z."""
        k1, k2, p1, p2 = self.opencv_distortion
        x, y = rays[:, 0], rays[:, 1]
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2 * r2
        return np.stack(
            [
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y),
            ],
            axis=1,
        )

    def unproject(self, pixels: np.ndarray) -> np.ndarray:
        """Undistort pixels to normalised image coordinates.

        Parameters
        ----------
        pixels : ndarray, shape (N, 2)
            Distorted pixels.

        Returns
        -------
        ndarray, shape (N, 2)
            x/z and y/z of their rays in the camera frame.
        """
        pixels = np.asarray(pixels, dtype=np.float64).reshape(-1, 1, 2)
        if not len(pixels):  # for which OpenCV returns nothing
            return np.zeros((0, 2))
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
        return cv2.undistortPoints(
            pixels, self.matrix, self.opencv_distortion, criteria=criteria
        ).reshape(-1, 2)

    def scaled(self, width: int, height: int) -> Camera:
        """Return the same lens for resized images.

        Parameters
        ----------
        width, height : int
            New image size in pixels.

        Returns
        -------
        Camera
        """
        sx, sy = width / self.width, height / self.height
        factors = {"f": sx, "fx": sx, "fy": sy, "cx": sx, "cy": sy}
        params = self.params * [factors.get(name, 1.0) for name in MODELS[self.model]]
        return Camera(self.model, width, height, params)
