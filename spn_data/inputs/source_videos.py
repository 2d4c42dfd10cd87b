"""Search for the video files of a sequence that was mapped or registered earlier."""

from __future__ import annotations

import logging
from pathlib import Path

from spn_data.area.area import Area
from spn_data.area.names import EVALUATION, FRAMES
from spn_data.capture.sources import VIDEO_SUFFIXES, discover
from spn_data.errors import InputError, StageError
from spn_data.storage.fingerprints import content_fingerprint

_logger = logging.getLogger(__name__)


def find_videos(area: Area, sequence: str, given: Path | None = None) -> tuple[Path, ...]:
    """Find the video files of a sequence, recognised by their content.

    Parameters
    ----------
    area : Area
    sequence : str
        A mapping or evaluation sequence.
    given : Path or None
        Where to look first; then in the sources recorded in the area.

    Returns
    -------
    tuple of Path
        Files in temporal order.

    Raises
    ------
    StageError
        If the sequence is not a video, or a file with the same content is not found.
    """
    stage = f"{EVALUATION}/{sequence}"
    record = area.record(stage if area.has(stage) else FRAMES)
    wanted = {
        name.split("/", 1)[1]: fingerprint
        for name, fingerprint in record.inputs.items()
        if name.startswith(f"{sequence}/") and Path(name).suffix.lower() in VIDEO_SUFFIXES
    }
    if not wanted:
        raise StageError(f"{area.root}: {sequence} is not a video, so it has no other frames")
    recorded = area.facts.evaluation.get(sequence) if area.has(stage) else None
    places = [recorded] if recorded is not None else list(area.facts.sources)
    folders = [*([given] if given is not None else []), *(area.root / place for place in places)]
    found: dict[str, Path] = {}
    for folder in folders:
        for part in _videos_in(folder):
            if wanted.get(part.name) == content_fingerprint(part):
                found.setdefault(part.name, part)
    missing = [name for name in wanted if name not in found]
    if missing:
        searched = ", ".join(str(folder) for folder in folders) or "no folder"
        raise StageError(
            f"{missing[0]} of {sequence} was not found with its former content (searched {searched}); "
            "give its folder with --video"
        )
    return tuple(found[name] for name in wanted)


def _videos_in(folder: Path) -> list[Path]:
    """Return the videos in a folder; none if it no longer exists or has no video."""
    try:
        return [part for source in discover(folder).sources for part in source.parts]
    except InputError as error:
        _logger.debug("no videos found: %s", error)
        return []
