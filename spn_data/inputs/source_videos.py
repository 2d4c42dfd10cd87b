"""Where the video files of a sequence lie, long after it was registered or mapped."""

from __future__ import annotations

from pathlib import Path

from spn_data.area.area import Area
from spn_data.area.names import EVALUATION, FRAMES
from spn_data.capture.sources import VIDEO_SUFFIXES, discover
from spn_data.errors import InputError, StageError
from spn_data.storage.fingerprints import content_fingerprint


def find_videos(area: Area, sequence: str, given: Path | None = None) -> tuple[Path, ...]:
    """The files of a sequence's video in the order of time, recognised by their content.

    given : where to look besides the places that the area remembers. Raises StageError where the sequence
    is not made of video, or its files are not found as they were.
    """
    stage = f"{EVALUATION}/{sequence}"
    record = area.record(stage if area.has(stage) else FRAMES)
    wanted = {
        name.split("/", 1)[1]: fingerprint
        for name, fingerprint in record.inputs.items()
        if name.startswith(f"{sequence}/") and Path(name).suffix.lower() in VIDEO_SUFFIXES
    }
    if not wanted:
        raise StageError(f"{area.root}: {sequence} is not made of video: it has no other frames")
    remembered = area.facts.evaluation.get(sequence) if area.has(stage) else None
    places = [remembered] if remembered is not None else list(area.facts.sources)
    folders = [*([given] if given is not None else []), *(area.root / place for place in places)]
    found: dict[str, Path] = {}
    for folder in folders:
        for part in _videos_in(folder):
            if wanted.get(part.name) == content_fingerprint(part):
                found.setdefault(part.name, part)
    missing = [name for name in wanted if name not in found]
    if missing:
        looked = ", ".join(str(folder) for folder in folders) or "nowhere"
        raise StageError(
            f"{missing[0]} of {sequence} is not found as it was (looked in {looked}); "
            "give the place where it lies now as --video"
        )
    return tuple(found[name] for name in wanted)


def _videos_in(folder: Path) -> list[Path]:
    """None where there is no such folder any more, or nothing in it."""
    try:
        return [part for source in discover(folder).sources for part in source.parts]
    except InputError:
        return []
