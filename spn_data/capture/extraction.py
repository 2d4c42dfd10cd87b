"""Writing the chosen frames as image files, and estimating what that costs."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from spn_data.capture import video
from spn_data.capture.frames import Frames
from spn_data.capture.photos import decode_photo, read_headers
from spn_data.capture.sources import Source, SourceKind
from spn_data.errors import InputError
from spn_data.storage.files import write_atomically

JPEG_QUALITY = 95

# Measured on two cores with videos of 0.4 to 2.5 megapixels: decoding takes 0.007 (H.264 at a usual bit
# rate) to 0.012 CPU seconds per megapixel (noisy H.264, H.265); JPEG files take 0.3 to 0.65 bytes per pixel.
DECODE_S_PER_MEGAPIXEL = 0.007
ENCODE_S_PER_MEGAPIXEL = 0.015
BYTES_PER_PIXEL = 0.6
CHOSEN_PER_S = 1.3  # frames per second of video if there is no target


@dataclass(frozen=True)
class ExtractionCost:
    """The expected cost of making the frames.

    Attributes
    ----------
    candidates : int
        Candidate frames in all sources.
    chosen : int
        Frames expected to be chosen.
    chosen_megapixels : float
        Total size of the chosen frames.
    seconds : float
        CPU time.
    disk_bytes : int
        Disk space.
    """

    candidates: int
    chosen: int
    chosen_megapixels: float
    seconds: float
    disk_bytes: int


def extract_chosen(
    source: Source,
    frames: Frames,
    folder: Path,
    *,
    threads: int = 0,
    progress: Callable[[int], None] | None = None,
) -> int:
    """Write the chosen frames of one source as `<folder>/<frame>.jpg`.

    Each file is written atomically and existing files are kept, so an interrupted call can be repeated.

    Parameters
    ----------
    source : Source
        The video or photos to extract from.
    frames : Frames
        The rows of this source.
    folder : Path
        Created if it does not exist.
    threads : int
        Decoder threads, 0 for one per core.
    progress : callable, optional
        Called with the number of chosen frames that are done, including those kept.

    Returns
    -------
    int
        Number of files written.

    Raises
    ------
    InputError
        If the source no longer contains a chosen frame, or the disk is full.
    """
    rows = np.flatnonzero(frames.chosen)
    targets = {int(r): folder / frames.names[r].split("/")[1] for r in rows}
    missing = {r: path for r, path in targets.items() if not path.exists()}
    pixels = sum(int(frames.width[r]) * int(frames.height[r]) for r in missing)
    needed = int(pixels * BYTES_PER_PIXEL)
    if source.kind is SourceKind.PHOTOS:
        needed = max(needed, sum(part.stat().st_size for part in source.parts))
    check_space(folder, needed)
    folder.mkdir(parents=True, exist_ok=True)
    done = len(targets) - len(missing)
    if progress is not None:
        progress(done)
    for part in source.parts:
        targets_of_part = {r: path for r, path in missing.items() if frames.sources[r] == part.name}
        if not targets_of_part:
            continue
        extract = _extract_photo if source.kind is SourceKind.PHOTOS else _extract_video
        for _ in extract(part, frames, targets_of_part, threads):
            done += 1
            if progress is not None:
                progress(done)
    return len(missing)


def estimate_cost(
    sources: Sequence[Source],
    *,
    target_count: int | None = None,
    chosen_per_s: float = CHOSEN_PER_S,
    probe: Callable[[Path], video.VideoInfo] = video.probe,
) -> ExtractionCost:
    """Estimate time and disk space for measuring, choosing and writing the frames of all sources.

    Reads headers only and is rough: within a factor of two.

    Parameters
    ----------
    sources : sequence of Source
        Videos and photo folders.
    target_count : int, optional
        Number of frames wanted from all videos together.
    chosen_per_s : float
        Frames per second of video, used if there is no target: how many frames the motion will select is
        not known in advance. Photos all count, at their file size.
    probe : callable
        Returns the `VideoInfo` of a file.

    Returns
    -------
    ExtractionCost
        The estimate.

    Raises
    ------
    InputError
        If a video cannot be read.
    """
    candidates, chosen, chosen_megapixels, seconds = 0, 0.0, 0.0, 0.0
    photos, photo_bytes, photo_megapixels = 0, 0, 0.0
    for source in sources:
        if source.kind is SourceKind.PHOTOS:
            megapixels = float(read_headers(source.parts).sizes.prod(axis=1).sum()) / 1e6
            photos += len(source.parts)
            photo_megapixels += megapixels
            photo_bytes += sum(part.stat().st_size for part in source.parts)
            seconds += megapixels * DECODE_S_PER_MEGAPIXEL
            continue
        for part in source.parts:
            info = probe(part)
            megapixel = info.width * info.height / 1e6
            number = min(info.frame_count, info.duration_s * chosen_per_s)
            candidates += info.frame_count
            chosen += number
            chosen_megapixels += number * megapixel
            # Every frame is decoded twice: once to measure, once to extract.
            seconds += 2 * info.frame_count * megapixel * DECODE_S_PER_MEGAPIXEL
    if target_count is not None and chosen:
        chosen_megapixels *= target_count / chosen
        chosen = target_count
    seconds += chosen_megapixels * ENCODE_S_PER_MEGAPIXEL
    disk_bytes = photo_bytes + int(chosen_megapixels * 1e6 * BYTES_PER_PIXEL)
    return ExtractionCost(
        candidates + photos,
        round(chosen) + photos,
        chosen_megapixels + photo_megapixels,
        seconds,
        disk_bytes,
    )


def check_space(folder: Path, needed_bytes: int) -> None:
    """Check that the disk has room for the frames.

    Parameters
    ----------
    folder : Path
        Target folder; if it does not exist, its nearest existing parent is checked.
    needed_bytes : int
        Space needed.

    Raises
    ------
    InputError
        If less space is free.
    """
    place = folder.absolute()
    while not place.exists():
        place = place.parent
    free = shutil.disk_usage(place).free
    if needed_bytes > free:
        raise InputError(
            f"the frames need about {needed_bytes / 1e9:.2f} GB but only {free / 1e9:.2f} GB are free; "
            "choose fewer frames or use another disk",
            path=folder,
        )


def _extract_video(
    part: Path, frames: Frames, targets: dict[int, Path], threads: int
) -> Iterator[Path]:
    wanted = {int(frames.video_frame[r]): r for r in targets}
    for frame in video.decode(part, wanted=wanted.keys(), threads=threads):
        if frame.image is None:
            continue
        row = wanted.pop(frame.index)
        if (frame.width, frame.height) != (frames.width[row], frames.height[row]):
            break
        ok, data = cv2.imencode(".jpg", frame.image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        assert ok
        write_atomically(targets[row], data.tobytes())
        yield targets[row]
    if wanted:
        raise InputError(
            f"frame {min(wanted)} is missing: the video has changed since it was measured",
            path=part,
        )


def _extract_photo(
    part: Path, frames: Frames, targets: dict[int, Path], threads: int
) -> Iterator[Path]:
    """Copy an upright JPEG byte by byte; re-encode any other photo as an upright JPEG."""
    [(row, target)] = targets.items()
    (metadata,) = read_headers([part]).metadata
    with part.open("rb") as file:
        is_jpeg = file.read(3) == b"\xff\xd8\xff"
    if is_jpeg and metadata is not None and metadata.orientation == 1:
        write_atomically(target, part.read_bytes())
    else:
        image = decode_photo(part)
        if image.shape[:2] != (frames.height[row], frames.width[row]):
            raise InputError("the photo has changed since it was measured", path=part)
        ok, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        assert ok
        write_atomically(target, data.tobytes())
    yield target
