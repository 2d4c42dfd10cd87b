"""Image of the ground for the report: drawn once for each georegistration, and kept in a cache."""

from __future__ import annotations

import base64
import math
from pathlib import Path
from typing import Any

from spn_data.area.area import Area
from spn_data.area.names import FRAMES, GEO, GROUND
from spn_data.errors import FormatError, GeometryError, InputError
from spn_data.inputs.area_labels import read_labelled_area
from spn_data.pipeline.area_orthophoto import ground_texture
from spn_data.report.ground_texture import GroundTexture
from spn_data.storage.json_files import DAMAGE, load_json, write_json

_VERSION = 1
_MAX_BYTES = 4_000_000


def ground_of(area: Area) -> tuple[GroundTexture | None, str]:
    """Draw the ground of an area, or take it from its cache, which is updated.

    Parameters
    ----------
    area : Area
        Locked, because the cache is written; its stages are not stale.

    Returns
    -------
    texture : GroundTexture or None
        None if the area has no metres, or no frame shows the ground.
    note : str
        Why the ground is not drawn; empty if it is, or if the area has no metres.

    Raises
    ------
    StageError
        If the cache cannot be written.
    """
    if not area.has(GEO):
        return None, ""
    made_for = [area.record(stage).finished for stage in (FRAMES, GEO)]
    cache = area.root / GROUND
    kept = _read_cache(cache, made_for)
    if kept is None:
        texture, note = _draw(area)
        ground = None if texture is None else texture.to_json()
        write_json(
            cache, {"version": _VERSION, "made_for": made_for, "ground": ground, "note": note}
        )
        return texture, note
    return kept


def _draw(area: Area) -> tuple[GroundTexture | None, str]:
    try:
        texture = ground_texture(area, read_labelled_area(area))
    except (GeometryError, InputError) as error:
        return None, f"The ground is not drawn: {error}."
    return texture, "" if texture else "The ground is not drawn: no frame shows it."


def _read_cache(path: Path, made_for: list[str]) -> tuple[GroundTexture | None, str] | None:
    """Return what is cached for these stages; None if nothing is, or if the cache is damaged."""
    if not path.is_file():
        return None
    try:
        table = load_json(path, max_bytes=_MAX_BYTES)
        if table["version"] != _VERSION or table["made_for"] != made_for:
            return None
        ground, note = table["ground"], table["note"]
        if not isinstance(note, str):
            raise ValueError("not a note")
        return None if ground is None else _texture(ground), note
    except (*DAMAGE, FormatError):
        return None


def _texture(value: dict[str, Any]) -> GroundTexture:
    (west, south), (east, north) = value["low"], value["high"]
    numbers = [float(one) for one in (west, south, east, north, value["up"])]
    webp = base64.b64decode(value["webp"], validate=True)
    if not all(map(math.isfinite, numbers)) or webp[:4] + webp[8:12] != b"RIFFWEBP":
        raise ValueError("not an image of the ground")
    return GroundTexture((numbers[0], numbers[1]), (numbers[2], numbers[3]), numbers[4], webp)
