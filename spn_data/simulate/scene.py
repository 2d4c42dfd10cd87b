"""The scene of a simulation: its place, built from a seed, and the painting of its textures."""

from __future__ import annotations

import numpy as np

from spn_data.simulate.courtyard import Courtyard
from spn_data.simulate.faces import Texture
from spn_data.simulate.modern import ModernCourtyard
from spn_data.simulate.place import Place, PlaceBuilder, SceneFaces, SceneOptions
from spn_data.simulate.street import Street
from spn_data.simulate.surfaces import PAINTERS
from spn_data.simulate.surfaces_town import PAINTERS as TOWN_PAINTERS
from spn_data.simulate.village import Village
from spn_data.simulate.walls import PAINTERS as WALL_PAINTERS

BUILDERS: dict[Place, type[PlaceBuilder]] = {
    Place.COURTYARD: Courtyard,
    Place.MODERN: ModernCourtyard,
    Place.STREET: Street,
    Place.VILLAGE: Village,
}


def build_scene(options: SceneOptions) -> SceneFaces:
    """Build the place for a seed; textures are painted separately (`paint`)."""
    return BUILDERS[options.place](options).scene()


def paint(scene: SceneFaces, name: str) -> np.ndarray:
    """Paint one texture (H, W, 3 or 4) uint8 RGB."""
    painter, canvas = scene.canvases[name]
    return (PAINTERS | WALL_PAINTERS | TOWN_PAINTERS)[painter](canvas)


def paint_all(scene: SceneFaces) -> dict[str, Texture]:
    """Paint all textures in memory."""
    return {name: Texture.from_image(paint(scene, name)) for name in scene.canvases}
