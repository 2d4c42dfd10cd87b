"""The view that a network was trained on, and the world of its poses; no torch."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from spn_data.geometry.camera import Camera
from spn_data.geometry.camera_file import camera_from_json, camera_to_json
from spn_data.geometry.geodesy import GeoOrigin, HeightReference
from spn_data.geometry.json_values import numbers


@dataclass(frozen=True, eq=False, kw_only=True)
class View:
    """View and world of the data set that a network was trained on.

    Attributes
    ----------
    camera : Camera or None
        Common pinhole of all images; None if each frame has its own.
    size : tuple of int
        Width and height of the images.
    units : str
        "m", or "model" for a world of arbitrary scale.
    origin : GeoOrigin or None
        Origin of the East-North-Up world and its height reference; None if it is not georeferenced.
    up_is_known : bool
        Whether z points up.
    dataset : str
        Fingerprint of the data set.
    made_from : mapping of str to str
        Fingerprints of what the data set was made from, by name.
    offset : tuple of float
        World position of the network's zero: add it to the network's positions in float64.
    """

    camera: Camera | None
    size: tuple[int, int]
    units: str
    origin: GeoOrigin | None
    up_is_known: bool
    dataset: str
    made_from: Mapping[str, str] = field(default_factory=dict)
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def to_json(self) -> dict[str, Any]:
        """Return plain values for JSON; unknown ones are null."""
        return {
            "camera": None if self.camera is None else camera_to_json(self.camera),
            "size": list(self.size),
            "units": self.units,
            "origin": None if self.origin is None else self.origin.plain(),
            "up_is_known": self.up_is_known,
            "dataset": self.dataset,
            "made_from": dict(self.made_from),
            **({"offset": list(self.offset)} if any(self.offset) else {}),
        }

    @classmethod
    def from_json(cls, value: Mapping[str, Any], *, has_offset: bool = False) -> View:
        """Parse the result of `to_json`.

        Parameters
        ----------
        value : mapping of str to object
        has_offset : bool
            Whether there has to be an offset, as the version of the file says.

        Returns
        -------
        View

        Raises
        ------
        KeyError, TypeError, ValueError
            If it does not describe a view.
        """
        camera, units, up = value["camera"], value["units"], value["up_is_known"]
        width, height = (int(side) for side in value["size"])
        if units not in ("m", "model") or not isinstance(up, bool):
            raise ValueError(f"units {units!r}, up_is_known {up!r}")
        if not (0 < width <= 65_536 and 0 < height <= 65_536):
            raise ValueError(f"image size {width}x{height}")
        x, y, z = numbers(value.get("offset", [0, 0, 0]), 3).tolist()
        if any((x, y, z)) is not has_offset:
            raise ValueError("its version and its offset contradict each other")
        return cls(
            camera=None if camera is None else camera_from_json(camera),
            size=(width, height),
            units=units,
            origin=None if value["origin"] is None else _origin(value["origin"]),
            up_is_known=up,
            dataset=str(value["dataset"]),
            made_from={str(k): str(v) for k, v in dict(value["made_from"]).items()},
            offset=(x, y, z),
        )


def _origin(value: Mapping[str, Any]) -> GeoOrigin:
    lat_deg, lon_deg, alt_m = (float(value[name]) for name in ("lat_deg", "lon_deg", "alt_m"))
    if not (abs(lat_deg) <= 90 and abs(lon_deg) <= 360 and math.isfinite(alt_m)):
        raise ValueError(f"the origin {lat_deg}, {lon_deg}, {alt_m} is not a valid location")
    return GeoOrigin(lat_deg, lon_deg, alt_m, HeightReference(value["height_reference"]))
