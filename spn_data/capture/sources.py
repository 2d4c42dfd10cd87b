"""Discovery of sequences in a folder: videos, photos and their telemetry files. Decodes no pixels."""

from __future__ import annotations

import logging
import os
import re
import unicodedata
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from spn_data.capture.photo_order import one_file_per_photo, photos_in_order
from spn_data.errors import InputError
from spn_data.media import photo_file
from spn_data.telemetry.dataflash import is_dataflash

if TYPE_CHECKING:
    from spn_data.capture.video import VideoInfo

_logger = logging.getLogger(__name__)

_MPEG_SUFFIXES = (".mp4", ".m4v", ".mpg", ".mpeg", ".ts", ".mts", ".m2ts")
VIDEO_SUFFIXES = frozenset([*_MPEG_SUFFIXES, ".mov", ".mkv", ".webm", ".avi", ".wmv", ".flv"])
PHOTO_SUFFIXES = frozenset(photo_file.PHOTO_SUFFIXES)
EVENTS_SUFFIX = ".mrk"  # DJI: exposures of the photos in the same folder
SUBTITLE_SUFFIXES = frozenset([".srt", ".ass"])  # on the clock of the video
LOG_SUFFIXES = frozenset([".ulg", ".bin", ".tlog", ".fit", ".nmea"])
TELEMETRY_SUFFIXES = SUBTITLE_SUFFIXES | {".gpx", ".csv", EVENTS_SUFFIX} | LOG_SUFFIXES
# What lies beside videos and is not read, with the remedy.
_NOT_READ = {
    # Videos of cameras that see all around, whose images are no pinhole images.
    ".insv": "Insta360 recording of two fisheye images: export a flat view as MP4, and its track as GPX",
    ".360": "GoPro MAX recording of cube faces: export a flat view as MP4, and its track as GPX",
    ".ubx": "raw data of u-blox receivers: convert them to NMEA or CSV",
    ".dat": "not a known log; if it is a flight record of DJI, convert it to CSV",
}
PROXY_SUFFIXES = frozenset([".lrf", ".lrv", ".thm"])

# Cameras split a recording just below 4 GiB, the largest file that FAT32 allows.
MIN_SPLIT_BYTES = int(3.5 * 2**30)
# Creation times have whole seconds, and a part starts while the one before is still being closed.
_CONTIGUOUS_S = 5.0
_MAX_DEPTH = 8
_MAX_FILES = 200_000

_DJI = re.compile(r"(?P<head>DJI_)(?:\d{14}_)?(?P<number>\d{3,5})(?P<tail>(?:_[A-Z]{1,3})?)", re.I)
_GOPRO = re.compile(r"(?P<head>G[HXP])(?P<chapter>\d{2})(?P<number>\d{4})", re.I)
_GOPRO_FIRST = re.compile(r"GOPR(?P<number>\d{4})", re.I)


_T = TypeVar("_T")


class SourceKind(StrEnum):
    """Kind of media in a sequence."""

    VIDEO = "video"
    PHOTOS = "photos"


@dataclass(frozen=True)
class Source:
    """One sequence: a flight's video in one or several parts, or a folder of photos.

    Attributes
    ----------
    sequence : str
        Unique name of the characters A-Z a-z 0-9 . _ -, so that it can name a folder.
    kind : SourceKind
        Video or photos.
    parts : tuple of Path
        Video files in order of time, or photos in order of their EXIF times, otherwise of their names (2
        before 10).
    telemetry : tuple of Path
        Telemetry files of the same name in the same folder.
    """

    sequence: str
    kind: SourceKind
    parts: tuple[Path, ...]
    telemetry: tuple[Path, ...] = ()


@dataclass(frozen=True)
class FoundSources:
    """Sequences found, sorted by name, and (path, reason) of every ignored file."""

    sources: tuple[Source, ...]
    ignored: tuple[tuple[Path, str], ...]


def discover(
    folder: Path,
    *,
    probe: Callable[[Path], VideoInfo] | None = None,
    min_split_bytes: int = MIN_SPLIT_BYTES,
) -> FoundSources:
    """Find the sequences in a folder and its subfolders, or take a single video or photo.

    Several video files form one sequence if a camera split one recording:

    - GoPro: `GX010042`, `GX020042`, ... (also GH) and `GOPR0042`, `GP010042`, ...: the same number with
      consecutive chapters.
    - DJI: consecutive numbers (`DJI_0007`, `DJI_0008`), every part but the last at least `min_split_bytes`
      long, the same size, codec and frame rate by `probe`, and either each part starts when the one before
      ends or all have the same creation time. Without creation times the files stay separate.

    Links are followed. Proxies, hidden files, broken links and links to what is read already are listed in
    `ignored`.

    Parameters
    ----------
    folder : Path
        A folder, or a single video or photo.
    probe : callable, optional
        Returns the `VideoInfo` of a file (default `video.probe`); called only for DJI candidates.
    min_split_bytes : int
        Smallest size of a file that a DJI camera may have split.

    Returns
    -------
    FoundSources
        Sequences and ignored files, both sorted.

    Raises
    ------
    InputError
        If the folder does not exist or contains neither a video nor a photo.
    """
    if not folder.exists():
        raise InputError("does not exist", path=folder)
    ignored: list[tuple[Path, str]] = []
    if folder.is_dir():
        root = folder
        files = list(_walk(folder, ignored))
    else:
        root = folder.parent
        files = [folder, *_sibling_telemetry(folder)]
    by_kind = _classify(files, ignored)
    sources: list[Source] = []
    taken: set[str] = set()
    for parts in _group_videos(by_kind["video"], probe, min_split_bytes):
        telemetry = tuple(t for part in parts for t in _same_name(part, by_kind["telemetry"]))
        name = _unique_name(parts[0].stem, parts[0].parent.name, taken)
        sources.append(Source(name, SourceKind.VIDEO, parts, telemetry))
    for place, photos in _by_folder(by_kind["photo"]).items():
        name = _unique_name(place.resolve().name, place.resolve().parent.name, taken)
        # Telemetry of a photo folder has the folder's name, or is the only file of its kind in it.
        here = [t for t in by_kind["telemetry"] if t.parent == place]
        used = {t for s in sources for t in s.telemetry}
        events = tuple(t for t in here if t.suffix.lower() == EVENTS_SUFFIX)
        used.update(events)
        free = [t for t in here if t not in used and t.suffix.lower() not in SUBTITLE_SUFFIXES]
        named = tuple(t for t in free if t.stem.lower() == place.resolve().name.lower())
        telemetry = named or (tuple(free) if len(free) == 1 else ())
        sources.append(Source(name, SourceKind.PHOTOS, photos, (*events, *telemetry)))
    used = {t for s in sources for t in s.telemetry}
    for path in by_kind["telemetry"]:
        if path not in used and folder.is_dir():
            ignored.append((path, "telemetry without a video or photo folder of the same name"))
    if not sources:
        raise InputError(_nothing_found(folder, ignored), path=folder)
    ignored.sort()
    return FoundSources(tuple(sources), tuple((p.relative_to(root), why) for p, why in ignored))


def safe_name(text: str, fallback: str = "sequence") -> str:
    """Return text as a name of at most 80 characters A-Z a-z 0-9 . _ - without a leading dot."""
    plain = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode()
    plain = re.sub(r"[^A-Za-z0-9._-]+", "-", plain).strip(".-")[:80].rstrip(".-")
    return plain or fallback


def _walk(folder: Path, ignored: list[tuple[Path, str]]) -> Iterable[Path]:
    """Yield the regular files in a folder tree, sorted; hidden and special files go to `ignored`.

    Links are followed, for data sets under git-annex or DVC and on servers consist of them. What a link
    leads to a second time is ignored, so that loops end and nothing is counted twice.
    """
    count = 0
    entered, taken = {os.path.realpath(folder)}, set[str]()

    def refuse(error: OSError) -> None:
        ignored.append((Path(error.filename), f"cannot be read: {error.strerror}"))

    for place, folders, names in os.walk(folder, onerror=refuse, followlinks=True):
        here = Path(place)
        # Folders before links to them, so that what is both is read under its own name.
        for name in sorted(folders, key=lambda each: ((here / each).is_symlink(), each)):
            real = os.path.realpath(here / name)
            if name.startswith("."):
                ignored.append((here / name, "hidden"))
            elif real in entered:
                ignored.append((here / name, "link to a folder that is read already"))
            elif (here / name / "stage.json").exists():
                ignored.append((here / name, "made by this program"))
            elif len((here / name).relative_to(folder).parts) > _MAX_DEPTH:
                ignored.append((here / name, f"more than {_MAX_DEPTH} folders deep"))
            else:
                entered.add(real)
                continue
            folders.remove(name)
        folders.sort()
        for name in sorted(names, key=lambda each: ((here / each).is_symlink(), each)):
            path = here / name
            real = os.path.realpath(path)
            count += 1
            if count > _MAX_FILES:
                raise InputError(f"contains more than {_MAX_FILES:,} files", path=folder)
            if any(unicodedata.category(letter) in ("Cc", "Cs") for letter in name):
                shown = name.encode("unicode_escape").decode()
                ignored.append(
                    (here / shown, "control characters or invalid UTF-8 in its name: rename it")
                )
            elif path.is_symlink() and not path.exists():
                ignored.append((path, "broken link: what it points to does not exist here"))
            elif not path.is_file():
                ignored.append((path, "not a regular file"))
            elif real in taken:
                ignored.append((path, "link to a file that is read already"))
            else:
                taken.add(real)
                yield path


def _sibling_telemetry(video: Path) -> list[Path]:
    """Return the telemetry files with the name of a single video or photo."""
    return sorted(
        p
        for p in video.parent.iterdir()
        if p.stem.lower() == video.stem.lower()
        and p.suffix.lower() in TELEMETRY_SUFFIXES
        and p.is_file()
    )


def _classify(files: Iterable[Path], ignored: list[tuple[Path, str]]) -> dict[str, list[Path]]:
    """Sort files into videos, photos and telemetry; everything else goes to `ignored`."""
    kinds: dict[str, list[Path]] = {"video": [], "photo": [], "telemetry": []}
    for path in files:
        suffix = path.suffix.lower()
        if path.name.startswith("._"):
            ignored.append((path, "macOS metadata"))
        elif path.name.startswith("."):
            ignored.append((path, "hidden"))
        elif suffix in PROXY_SUFFIXES:
            ignored.append((path, "preview or thumbnail made by the camera"))
        elif suffix in VIDEO_SUFFIXES:
            kinds["video"].append(path)
        elif suffix in PHOTO_SUFFIXES:
            kinds["photo"].append(path)
        elif suffix in photo_file.RAW_SUFFIXES:
            ignored.append((path, photo_file.RAW_REMEDY))
        elif suffix in _NOT_READ:
            ignored.append((path, _NOT_READ[suffix]))
        elif suffix in TELEMETRY_SUFFIXES and (suffix != ".bin" or is_dataflash(path)):
            kinds["telemetry"].append(path)
        else:
            ignored.append((path, "not a video, photo or telemetry file"))
    kinds["photo"] = one_file_per_photo(kinds["photo"], ignored)
    photo_file.check_readers(kinds["photo"])
    return kinds


def _nothing_found(folder: Path, ignored: list[tuple[Path, str]]) -> str:
    if not folder.is_dir():
        if folder.suffix.lower() in _NOT_READ:
            return f"cannot be read: {_NOT_READ[folder.suffix.lower()]}"
        if folder.suffix.lower() in photo_file.RAW_SUFFIXES:
            return f"is a {photo_file.RAW_REMEDY}"
        return f"is not a video or photo: unsupported suffix {folder.suffix or '(none)'}"
    links = sum(why.startswith("broken link") for _, why in ignored)
    raw = sum(why == photo_file.RAW_REMEDY for _, why in ignored)
    found = f"; {len(ignored)} other files" if ignored else "; the folder is empty"
    return (
        "contains no video or photo"
        + found
        + (f", {links} of them broken links" if links else "")
        + (f", {raw} of them RAW photos: convert them to DNG or JPEG" if raw else "")
    )


def _by_folder(photos: list[Path]) -> dict[Path, tuple[Path, ...]]:
    folders: dict[Path, list[Path]] = {}
    for photo in photos:
        folders.setdefault(photo.parent, []).append(photo)
    return {place: photos_in_order(found) for place, found in sorted(folders.items())}


def _same_name(part: Path, telemetry: list[Path]) -> list[Path]:
    return [t for t in telemetry if t.parent == part.parent and t.stem.lower() == part.stem.lower()]


def _unique_name(stem: str, parent: str, taken: set[str]) -> str:
    """Return a safe name that no other sequence has, even if case is ignored; adds it to `taken`."""
    name = safe_name(stem)
    if name.lower() in taken:
        name = safe_name(f"{parent}-{stem}")
    number = 2
    base = name
    while name.lower() in taken:
        name = f"{base}-{number}"
        number += 1
    taken.add(name.lower())
    return name


def _group_videos(
    videos: list[Path], probe: Callable[[Path], VideoInfo] | None, min_split_bytes: int
) -> list[tuple[Path, ...]]:
    """Group video files that are parts of one recording, sorted by name."""
    chapters: dict[tuple[Path, str, str], list[tuple[int, Path]]] = {}
    groups: list[tuple[Path, ...]] = []
    others: list[Path] = []
    for path in videos:
        first, later = _GOPRO_FIRST.fullmatch(path.stem), _GOPRO.fullmatch(path.stem)
        if first:
            key, chapter = (path.parent, "GP", first["number"]), 0
        elif later:
            key, chapter = (
                (path.parent, later["head"].upper(), later["number"]),
                int(later["chapter"]),
            )
        else:
            others.append(path)
            continue
        chapters.setdefault(key, []).append((chapter, path))
    for found in chapters.values():
        found.sort()
        runs = _runs(found, lambda a, b: b[0] == a[0] + 1)
        groups += [tuple(path for _, path in run) for run in runs]
    others.sort()
    groups += [
        tuple(run)
        for run in _runs(others, lambda a, b: _is_next_dji_part(a, b, probe, min_split_bytes))
    ]
    return sorted(groups)


def _runs(items: list[_T], joined: Callable[[_T, _T], bool]) -> list[list[_T]]:
    """Split a list between neighbours that are not joined."""
    runs = [[item] for item in items[:1]]
    for before, after in pairwise(items):
        if joined(before, after):
            runs[-1].append(after)
        else:
            runs.append([after])
    return runs


def _is_next_dji_part(
    before: Path, after: Path, probe: Callable[[Path], VideoInfo] | None, min_split_bytes: int
) -> bool:
    a, b = _DJI.fullmatch(before.stem), _DJI.fullmatch(after.stem)
    if a is None or b is None or before.parent != after.parent:
        return False
    if int(b["number"]) != int(a["number"]) + 1 or a["tail"].lower() != b["tail"].lower():
        return False
    if before.suffix.lower() != after.suffix.lower() or before.stat().st_size < min_split_bytes:
        return False
    if probe is None:
        from spn_data.capture import video

        probe = video.probe
    try:
        first, second = probe(before), probe(after)
    except InputError as error:  # reported when the file is used
        _logger.debug("%s: not joined with %s: %s", after.name, before.name, error)
        return False
    same = (first.width, first.height, first.codec) == (second.width, second.height, second.codec)
    if not same or abs(first.fps - second.fps) > 0.01 * first.fps:
        return False
    if first.created_utc is None or second.created_utc is None:
        return False
    later_s = (second.created_utc - first.created_utc).total_seconds()
    return later_s == 0 or abs(later_s - first.duration_s) <= _CONTIGUOUS_S
