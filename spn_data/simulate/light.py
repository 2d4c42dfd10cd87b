"""Light of the sun on a scene: shadows of one flight, and clouds that pass during it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from spn_data.simulate.bodies import Sway
from spn_data.simulate.faces import MAX_CORNERS, Face

GAIN_UNIT = 100  # value of a gain of one in a gain image
_TEXELS_PER_M = 6.0
_MAX_TEXELS = 900
_RECEIVER_M2 = 100.0  # smaller faces have no shadows on them
_CLEARANCE_M = 0.02  # what touches a surface casts no shadow on it
_AMBIENT = 0.72
_SUN = 0.75


@dataclass(frozen=True, kw_only=True)
class LightOptions:
    """Sun and clouds; with a `sun` of zero, surfaces look as they are painted."""

    sun: float = 0.0  # strength of the sun: 1 for a clear day
    elevation_deg: tuple[float, float] = (25.0, 60.0)
    cloud_s: float = 45.0  # period of the clouds


@dataclass(frozen=True, eq=False)
class Sunlight:
    """Light during one flight.

    toward_sun : (3,), unit vector. phase : of the clouds in radians.
    """

    toward_sun: np.ndarray
    phase: float
    options: LightOptions

    @classmethod
    def draw(cls, options: LightOptions, rng: np.random.Generator) -> Sunlight:
        """Draw the light of a flight: at another hour, other shadows."""
        azimuth = np.deg2rad(rng.uniform(90.0, 270.0))
        up = np.deg2rad(rng.uniform(*options.elevation_deg))
        toward = np.array([np.sin(azimuth) * np.cos(up), np.cos(azimuth) * np.cos(up), np.sin(up)])
        return cls(toward, float(rng.uniform(0, 2 * np.pi)), options)

    def strength(self, time_s: float) -> float:
        """Return the strength of the sun at a time of the flight, between 0 and that of the options."""
        wave = np.sin(2 * np.pi * time_s / self.options.cloud_s + self.phase)
        wave += 0.6 * np.sin(2 * np.pi * time_s / (0.37 * self.options.cloud_s) + 2 * self.phase)
        return float(self.options.sun * np.clip(0.6 + 0.5 * wave, 0.0, 1.0))

    def gains(
        self, shadows: dict[int, np.ndarray], incidence: np.ndarray, time_s: float
    ) -> tuple[np.ndarray, dict[int, np.ndarray]]:
        """Return the gain of each face (F,), and gain images (h, w, 3) uint8 of those with shadows."""
        sun = self.strength(time_s)
        ambient = _AMBIENT + 0.2 * (1 - sun)
        direct = _SUN * sun * incidence
        images = {}
        for k, lit in shadows.items():
            gain = np.rint(GAIN_UNIT * (ambient + direct[k] * lit))
            images[k] = cv2.merge([np.clip(gain, 0, 255).astype(np.uint8)] * 3)
        return ambient + direct, images


def normals(faces: Sequence[Face]) -> np.ndarray:
    """Return unit normals (F, 3) on the fronts of the faces."""
    across = np.stack([np.cross(face.v_edge, face.u_edge) for face in faces])
    return np.asarray(across / np.linalg.norm(across, axis=1, keepdims=True))


def cast_shadows(faces: Sequence[Face], toward_sun: np.ndarray) -> dict[int, np.ndarray]:
    """Return how much sun reaches the texels (h, w), 0 to 1, of each large static face, by its index.

    Everything that is static or sways casts shadows; what travels casts none.
    """
    casters = np.stack(
        [np.pad(corners, ((0, MAX_CORNERS - len(corners)), (0, 0)), mode="edge")
         for corners in (face.corners() for face in faces if _casts(face))]
    )  # fmt: skip
    masks = {}
    for k, face in enumerate(faces):
        size_m = np.array([np.linalg.norm(face.u_edge), np.linalg.norm(face.v_edge)])
        if face.at_infinity or face.body is not None or np.prod(size_m) < _RECEIVER_M2:
            continue
        columns, rows = np.clip(np.rint(size_m * _TEXELS_PER_M), 8, _MAX_TEXELS).astype(int)
        lit = np.full((rows, columns), 255, np.uint8)
        front = normals([face])[0]
        if front @ toward_sun > 0.03:
            _draw_shadows(lit, face, front, casters, toward_sun)
        masks[k] = lit.astype(np.float32) / 255
    return masks


def _casts(face: Face) -> bool:
    """Return whether a face casts a shadow: everything does but the sky and what travels."""
    if face.body is None:
        return not face.at_infinity
    return isinstance(face.body, Sway)


def _draw_shadows(
    lit: np.ndarray, face: Face, front: np.ndarray, casters: np.ndarray, toward_sun: np.ndarray
) -> None:
    """Blacken the shadows of polygons (C, 8, 3) on a face, in place."""
    height = (casters - face.origin) @ front - _CLEARANCE_M
    step = toward_sun / (front @ toward_sun)  # leads 1 m away from the face
    texel_from_world = np.linalg.pinv(np.stack([face.u_edge, face.v_edge])) * lit.shape[::-1]

    def shadow(corners: np.ndarray, height: np.ndarray) -> np.ndarray:
        return (corners - height[..., None] * step - face.origin) @ texel_from_world - 0.5

    texels = shadow(casters, np.maximum(height, 0.0))
    inside = (texels.max(axis=1) >= 0).all(axis=1) & (texels.min(axis=1) <= lit.shape[::-1]).all(
        axis=1
    )
    for k in np.flatnonzero(inside & (height.max(axis=1) > 0)):
        shape = texels[k]
        if height[k].min() < 0:
            above = _above(casters[k], height[k])
            shape = shadow(above, np.maximum((above - face.origin) @ front - _CLEARANCE_M, 0.0))
        points = np.rint(np.clip(shape, -20000, 20000) * 16).astype(np.int32)
        cv2.fillConvexPoly(lit, points, 0, cv2.LINE_8, 4)
    cv2.GaussianBlur(lit, (0, 0), 0.8, dst=lit)


def _above(corners: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Return the part (M, 3) of a polygon (K, 3) whose heights (K,) are not negative."""
    kept = []
    for k in range(len(corners)):
        j = (k + 1) % len(corners)
        if height[k] >= 0:
            kept.append(corners[k])
        if (height[k] >= 0) != (height[j] >= 0):
            share = height[k] / (height[k] - height[j])
            kept.append(corners[k] + share * (corners[j] - corners[k]))
    return np.array(kept)
