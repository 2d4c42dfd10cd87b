"""State of a trained network: what was done with it since."""

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
    is_evaluated : bool
        Whether it was evaluated on the present data set since it was trained.
    has_bundle, is_exported : bool
        Whether it was exported at all, and since it was trained.
    """

    name: str
    bundle: str
    is_evaluated: bool
    has_bundle: bool
    is_exported: bool
