"""What an export wrote, and what it measured."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from spn_model.export.bundle_checks import GroupErrors, Parity


@dataclass(frozen=True, eq=False, kw_only=True)
class ExportedBundle:
    """What was written, and what was found. bytes : by precision; errors : float32, then int8, of a group."""

    folder: Path
    units: str
    bytes: Mapping[str, int]
    parity: Parity
    errors: tuple[GroupErrors, ...]
    notes: tuple[str, ...] = field(default=())
