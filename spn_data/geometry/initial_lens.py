"""Initial lens of a camera: its intrinsics, how well the focal length is known, and what is held."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from spn_data.geometry.camera import Camera
from spn_data.geometry.camera_file import camera_from_json, camera_to_json
from spn_data.geometry.json_values import numbers

GUESS_SIGMA = 0.3  # relative standard deviation of a focal length that nothing states
# Of a focal length in an area of an earlier version, which does not record how well it is known.
_EARLIER_SIGMA = 0.05


class Hold(StrEnum):
    """What an adjustment may not change."""

    NOTHING = "nothing"
    FOCAL = "focal length"  # distortion is estimated
    LENS = "lens"  # all intrinsics


@dataclass(frozen=True, eq=False)
class InitialLens:
    """Intrinsics from which an adjustment starts.

    Attributes
    ----------
    camera : Camera
    focal_sigma : float
        Standard deviation of the focal length divided by the focal length.
    source : str
        What states the focal length, for the user.
    hold : Hold
        What the adjustment does not change.
    """

    camera: Camera
    focal_sigma: float
    source: str
    hold: Hold = Hold.NOTHING

    @property
    def focal_is_known(self) -> bool:
        """Whether anything states the focal length."""
        return self.focal_sigma < GUESS_SIGMA

    def to_json(self) -> dict[str, Any]:
        """Return plain values for `json.dumps`."""
        return {
            **camera_to_json(self.camera),
            "focal_sigma": self.focal_sigma,
            "focal_is_known": self.focal_is_known,
            "source": self.source,
            "hold": str(self.hold),
        }

    @classmethod
    def from_json(cls, value: dict[str, Any]) -> InitialLens:
        """Return the lens that a JSON object describes, also one of an earlier version.

        Raises
        ------
        KeyError, TypeError, ValueError
            If it does not describe a lens.
        """
        camera = camera_from_json(value)
        earlier = _EARLIER_SIGMA if value["focal_is_known"] else GUESS_SIGMA
        sigma = float(numbers(value.get("focal_sigma", earlier)))
        if not sigma > 0:
            raise ValueError(f"the standard deviation of its focal length is {sigma}")
        return cls(
            camera, sigma, str(value.get("source", "")), Hold(value.get("hold", Hold.NOTHING))
        )
