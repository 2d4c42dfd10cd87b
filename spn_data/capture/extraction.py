"""The chosen frames as image files, and what making them costs."""

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
from spn_data.storage.files import write_whole

JPEG_QUALITY = 95

# Measured with videos of 0.4 to 2.5 megapixels on two cores: decoding takes 0.007 (H.264 of usual bit
# rate) to 0.012 CPU seconds a megapixel (noisy H.264, H.265), and JPEG files 0.3 to 0.65 bytes a pixel.
DECODE_S_PER_MEGAPIXEL = 0.007
ENCODE_S_PER_MEGAPIXEL = 0.015
BYTES_PER_PIXEL = 0.6
CHOSEN_PER_S = 1.3  # of video, where no target is given


@dataclass(frozen=True)
class ExtractionCost:
    """What making the frames is expected to take."""

    candidates: int
    chosen: int
    chosen_megapixels: float  # of all of them
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
    """Writes the chosen frames of one source as `<folder>/<frame>.jpg`; returns how many were written.

    frames : the rows of this source. Each file appears whole, by renaming; those that exist are kept, so
    that an interrupted call can be made again. `progress` hears how many chosen frames are done, kept ones
    included. InputError where the source does not hold a chosen frame any more, or the disk is full.
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
        here = {r: path for r, path in missing.items() if frames.sources[r] == part.name}
        if not here:
            continue
        one = _extract_photo if source.kind is SourceKind.PHOTOS else _extract_video
        for _ in one(part, frames, here, threads):
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
    """Time and disk for measuring, choosing and writing the frames of sources, from headers alone.

    The number of frames that motion will choose is not known before; without a target (of all videos) it is
    taken as `chosen_per_s`. Photos count whole, as they are. Rough: within a factor of two.
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
            seconds += (
                2 * info.frame_count * megapixel * DECODE_S_PER_MEGAPIXEL
            )  # measured, then extracted
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
    """InputError where the disk of a folder, or of the nearest that exists above it, has too little room."""
    place = folder.absolute()
    while not place.exists():
        place = place.parent
    free = shutil.disk_usage(place).free
    if needed_bytes > free:
        raise InputError(
            f"the frames need about {needed_bytes / 1e9:.2f} GB and {free / 1e9:.2f} GB are free; "
            "choose fewer frames, or another disk",
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
        write_whole(targets[row], data.tobytes())
        yield targets[row]
    if wanted:
        raise InputError(
            f"frame {min(wanted)} is not in it any more: the video changed since it was measured",
            path=part,
        )


def _extract_photo(
    part: Path, frames: Frames, targets: dict[int, Path], threads: int
) -> Iterator[Path]:
    """The JPEG's own bytes where it stands upright already, else its pixels, turned."""
    [(row, target)] = targets.items()
    (metadata,) = read_headers([part]).metadata
    with part.open("rb") as file:
        is_jpeg = file.read(3) == b"\xff\xd8\xff"
    if is_jpeg and metadata is not None and metadata.orientation == 1:
        write_whole(target, part.read_bytes())
    else:
        image = decode_photo(part)
        if image.shape[:2] != (frames.height[row], frames.width[row]):
            raise InputError("changed since it was measured", path=part)
        ok, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        assert ok
        write_whole(target, data.tobytes())
    yield target
