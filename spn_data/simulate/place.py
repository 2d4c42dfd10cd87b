"""What a simulated place consists of, and the part of its construction that all places share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from spn_data.simulate.faces import Face
from spn_data.simulate.shapes import Builder, vector
from spn_data.simulate.textures import Canvas


class Place(StrEnum):
    """Places to fly over."""

    COURTYARD = "courtyard"  # between brick facades with one window grid
    MODERN = "modern"  # courtyard between plain plaster, repeated panels, glass and brick
    STREET = "street"
    VILLAGE = "village"


@dataclass(frozen=True, kw_only=True)
class SceneOptions:
    """Kind, size and seed of the place."""

    place: Place = Place.COURTYARD
    size_m: tuple[float, float] = (39.0, 36.0)  # east-west and north-south
    height_m: float = 18.0  # of a courtyard's facades
    area_factor: float = 1.0  # factor on the ground area; the height stays the same
    texels_per_m: float = 140.0  # of facades and ground
    houses_per_hectare: float = 0.0  # on the ground, for flights that look down on a large area
    people: int = 0  # that walk
    cars: int = 0  # that drive
    wind_m: float = 0.0  # sway of the crowns of trees
    seed: int = 1  # random seed of textures and objects

    @property
    def half_m(self) -> tuple[float, float]:
        """Half the extent of the ground east and north."""
        side = np.sqrt(self.area_factor) / 2
        return float(self.size_m[0] * side), float(self.size_m[1] * side)


@dataclass(frozen=True, eq=False)
class SceneFaces:
    """Faces of the scene and the recipes of their textures.

    canvases : name of the painter and canvas of each texture. obstacles : (N, 6) boxes x0, y0, z0, x1, y1, z1
    in metres that no flight may enter. landmarks : (M, 3) exact centres of the survey targets on the facades.
    The world is East-North-Up with its origin on the ground in the middle of the place.
    """

    faces: tuple[Face, ...]
    canvases: dict[str, tuple[str, Canvas]]
    obstacles: np.ndarray
    landmarks: np.ndarray


class PlaceBuilder(Builder, ABC):
    """Builder of one kind of place."""

    def __init__(self, options: SceneOptions):
        super().__init__(options.seed, wind_m=options.wind_m)
        self.options = options
        self.landmarks: list[np.ndarray] = []

    @abstractmethod
    def build(self) -> None:
        """Add all faces."""

    def scene(self) -> SceneFaces:
        """Build the place."""
        self.build()
        return SceneFaces(
            tuple(self.faces),
            self.canvases,
            np.array(self.obstacles),
            np.array(self.landmarks),
        )

    def sky(self) -> None:
        """Add the sky."""
        self.canvas("sky", "sky", (12000.0, 12000.0), 0.1)
        self.faces.append(
            Face(
                "sky",
                vector(-6000, -6000, 1000),
                vector(12000, 0, 0),
                vector(0, 12000, 0),
                at_infinity=True,
            )
        )
