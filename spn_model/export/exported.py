"""Result of an export."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from spn_model.export.bundle_checks import GroupErrors, Parity
from spn_model.export.landmark_export import LandmarkSummary


@dataclass(frozen=True, eq=False, kw_only=True)
class ExportedBundle:
    """What an export wrote and measured.

    Attributes
    ----------
    folder : Path
        Folder of the bundle.
    units : str
        "m" or "model", of all lengths.
    bytes : mapping of str to int
        Sizes of the graph files by precision.
    parity : Parity
        Differences from PyTorch.
    errors : tuple of GroupErrors
        By group, float32 before int8.
    landmarks : LandmarkSummary or None
        None for a bundle without landmarks.
    gimbal : str
        What was measured of the mounting of the camera in its gimbal, or why nothing was; empty for a bundle
        without landmarks.
    notes : tuple of str
        One sentence each.
    """

    folder: Path
    units: str
    bytes: Mapping[str, int]
    parity: Parity
    errors: tuple[GroupErrors, ...]
    landmarks: LandmarkSummary | None = None
    gimbal: str = ""
    notes: tuple[str, ...] = field(default=())
