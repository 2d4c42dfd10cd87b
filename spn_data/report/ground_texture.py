"""Image of the ground that the 3D view shows."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, eq=False)
class GroundTexture:
    """Orthophoto for the 3D view.

    Attributes
    ----------
    low, high : tuple of float
        East and north of the south-western and north-eastern corners, in metres.
    up_m : float
        Median height of the ground.
    webp : bytes
        Image with transparency, north up.
    """

    low: tuple[float, float]
    high: tuple[float, float]
    up_m: float
    webp: bytes

    def to_json(self) -> dict[str, Any]:
        """Return plain values, the image in base64, as the page's script reads them."""
        webp = base64.b64encode(self.webp).decode("ascii")
        return {"low": list(self.low), "high": list(self.high), "up": self.up_m, "webp": webp}
