"""Fingerprints of the input files of a stage."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from spn_data.capture.sources import Source
from spn_data.storage.fingerprints import content_fingerprint


def fingerprints(sources: tuple[Source, ...], masks: Mapping[str, Path]) -> dict[str, str]:
    """Return the content fingerprint of each source file, by sequence and name, and of each mask."""
    files = {
        f"{source.sequence}/{path.name}": content_fingerprint(path)
        for source in sources
        for path in (*source.parts, *source.telemetry)
    }
    return files | {f"{name}/mask": content_fingerprint(path) for name, path in masks.items()}
