"""State of a trained network: what was done with it since, and a flight that its bundle can be tried on."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class NetworkState:
    """State of a trained network.

    Attributes
    ----------
    name : str
        Name of its run.
    bundle : str
        Folder of its exported bundle, relative to the area.
    recipe : str
        Recipe that it was trained by; empty if unknown.
    is_evaluated : bool
        Whether it was evaluated on the present data set since it was trained.
    has_bundle, is_exported : bool
        Whether it was exported at all, and whether the bundle is of the present network.
    has_landmarks : bool
        Whether the bundle has landmarks, without which it gives no fixes.
    is_measured : bool
        Whether its fixes were measured with the present bundle.
    """

    name: str
    bundle: str
    recipe: str = ""
    is_evaluated: bool = False
    has_bundle: bool = False
    is_exported: bool = False
    has_landmarks: bool = False
    is_measured: bool = False


@dataclass(frozen=True)
class RecordedFlight:
    """A recorded flight. video : absolute path; camera : path of its camera, relative to the area."""

    video: str
    camera: str
