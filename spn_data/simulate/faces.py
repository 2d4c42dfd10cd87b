"""Surfaces of a scene: planar polygons with mip-mapped textures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import cv2
import numpy as np

MAX_CORNERS = 8
_UNIT_SQUARE_EDGES = np.array([[1.0, 0, 0], [-1, 0, 1], [0, 1, 0], [0, -1, 1]])


@dataclass(frozen=True, eq=False)
class Texture:
    """Mip levels of an image (H, W, 3 or 4) uint8 RGB; a fourth channel is the reflectance."""

    levels: tuple[np.ndarray, ...]

    @classmethod
    def from_image(cls, image: np.ndarray) -> Texture:
        """Build the mip levels: each is the area mean of the previous one at half its size (rounded down)."""
        levels = [np.ascontiguousarray(image)]
        while min(levels[-1].shape[:2]) > 8:
            height, width = levels[-1].shape[:2]
            levels.append(
                cv2.resize(levels[-1], (width // 2, height // 2), interpolation=cv2.INTER_AREA)
            )
        return cls(tuple(levels))


class Placement(NamedTuple):
    """Where a body is at one moment.

    rotation : (3, 3), and shift : (3,) metres, from the position of its faces at rest. scroll : shift of its
    textures as fractions of their width and height.
    """

    rotation: np.ndarray
    shift: np.ndarray
    scroll: tuple[float, float] = (0.0, 0.0)


class Body(Protocol):
    """Something that moves, as a function of the time of day."""

    def at(self, time_s: float) -> Placement:
        """Return its placement at a time."""


@dataclass(frozen=True, eq=False)
class Face:
    """Parallelogram, or a convex polygon in its plane, with a texture on its front.

    origin, u_edge, v_edge : (3,) metres; position of the texture's upper-left corner, and its upper and
        left border. Seen from the front, u is to the right of v: the front is where
        ``(eye - origin) . (u_edge x v_edge) < 0``.
    region : (s0, t0, s1, t1), the part of the texture used, as fractions of its width and height.
    polygon : (K, 2), 3 <= K <= 8, convex, in units of the two edges, running from +u towards +v;
        None for the whole parallelogram.
    mirrored : what the reflecting parts of the texture show, as a face at its mirror image behind this one.
    at_infinity : whether the face moves with the eye (sky).
    body : what the face moves with; None if it is static.
    """

    texture: str
    origin: np.ndarray
    u_edge: np.ndarray
    v_edge: np.ndarray
    region: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0)
    polygon: np.ndarray | None = None
    mirrored: Face | None = None
    at_infinity: bool = False
    body: Body | None = None

    def corners(self) -> np.ndarray:
        """Return the corners (K, 3) in metres."""
        flat = self.polygon
        if flat is None:
            flat = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
        return np.asarray(self.origin + flat @ np.stack([self.u_edge, self.v_edge]))

    def edges(self) -> np.ndarray:
        """Return lines (K, 3) with ``a s + b t + c >= 0`` inside, in units of the two edges."""
        if self.polygon is None:
            return _UNIT_SQUARE_EDGES
        if not 3 <= len(self.polygon) <= MAX_CORNERS:
            raise ValueError(f"a face needs 3 to {MAX_CORNERS} corners, not {len(self.polygon)}")
        start, step = self.polygon, np.roll(self.polygon, -1, axis=0) - self.polygon
        a, b = -step[:, 1], step[:, 0]
        return np.stack([a, b, -(a * start[:, 0] + b * start[:, 1])], axis=1)


def mirror_face(target: Face, mirror: Face) -> Face:
    """Reflect the face `target` in the plane of `mirror`."""
    normal = np.cross(mirror.u_edge, mirror.v_edge)
    normal = normal / np.linalg.norm(normal)
    reflect = np.eye(3) - 2 * np.outer(normal, normal)
    origin = mirror.origin + reflect @ (target.origin - mirror.origin)
    return Face(
        target.texture, origin, reflect @ target.u_edge, reflect @ target.v_edge, target.region
    )
