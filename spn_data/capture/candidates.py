"""Candidate frames of a source: every image is measured once and becomes a row of frames.csv."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from spn_data.capture import video
from spn_data.capture.frames import Frames
from spn_data.capture.measurement import MEASURE_WIDTH, GrayImage, Measurements, measure
from spn_data.capture.photos import PhotoHeaders, decode_photo_gray, read_headers
from spn_data.capture.selection import FrameChoice
from spn_data.capture.sources import Source, SourceKind, safe_name
from spn_data.errors import InputError
from spn_data.storage.array_files import ARRAY_DAMAGE
from spn_data.storage.files import atomic_writer
from spn_data.telemetry.exif import telemetry_from_photos
from spn_data.telemetry.track import Telemetry

_logger = logging.getLogger(__name__)

_CACHE_VERSION = 1  # increase whenever the measurements change
_ZOOM_CHANGE = 0.02  # relative change of focal length that starts another camera


@dataclass(frozen=True, eq=False)
class Candidates:
    """The measured images of one source, N rows.

    Attributes
    ----------
    source : Source
        The sequence that the images belong to.
    measured : Measurements
        Sharpness and motion, N rows.
    part_start_s : tuple of float, length P
        Start of each video file on the sequence's clock; empty for photos.
    photos : PhotoHeaders or None
        Headers of the photos; None for a video.
    photo_telemetry : Telemetry or None
        EXIF and XMP of the photos, N rows on the sequence's clock; None for a video.
    notes : tuple of str
        What the user should know, one sentence each.
    """

    source: Source
    measured: Measurements
    part_start_s: tuple[float, ...]
    photos: PhotoHeaders | None
    photo_telemetry: Telemetry | None
    notes: tuple[str, ...]


def analyse(
    source: Source,
    *,
    threads: int = 0,
    progress: Callable[[int], None] | None = None,
    cache: Path | None = None,
) -> Candidates:
    """Measure every image of a source once, at a reduced size.

    Parameters
    ----------
    source : Source
        A video in one or several parts, or a folder of photos.
    threads : int
        Decoder threads, 0 for one per core.
    progress : callable, optional
        Called with the number of images measured so far.
    cache : Path, optional
        A file (.npz) that keeps the measurements of a video. If it exists and the video's files have the
        same names, sizes and modification times, nothing is decoded.

    Returns
    -------
    Candidates
        One row per image.

    Raises
    ------
    InputError
        If a video cannot be decoded. Unreadable photos are kept as rows with a problem.
    """
    if source.kind is SourceKind.PHOTOS:
        return _analyse_photos(source, progress)
    cached = _read_cache(cache, source) if cache is not None else None
    if cached is not None:
        if progress is not None:
            progress(len(cached.measured))
        return cached
    starts: list[float] = []
    notes: list[str] = []
    measured = measure(_video_images(source, threads, starts, notes), progress=progress)
    candidates = Candidates(source, measured, tuple(starts), None, None, tuple(notes))
    if cache is not None:
        _write_cache(cache, candidates)
    return candidates


def build_frames(
    candidates: Candidates, choice: FrameChoice, *, focal: np.ndarray | None = None
) -> Frames:
    """Return the rows of frames.csv for one source, with its telemetry still unknown.

    Parameters
    ----------
    candidates : Candidates
        The measured images, N rows.
    choice : FrameChoice
        Status and reason of each of them.
    focal : ndarray, shape (N,), optional
        Focal length in any unit, as stated by the telemetry; NaN if unknown.

    Returns
    -------
    Frames
        N rows.

    Notes
    -----
    A change of the focal length by more than 2 %, or of the image size, starts another camera named
    `<sequence>-2` and so on. Returning to an earlier size and zoom returns to the earlier camera.
    """
    source, measured = candidates.source, candidates.measured
    n = len(measured)
    if candidates.photos is None:
        stems = [f"{i:06d}" for i in range(n)]
        video_frame = measured.index
        keys = _camera_runs(measured, focal)
    else:
        stems = photo_stems(source.parts)
        video_frame = np.full(n, -1)
        keys = list(candidates.photos.lens)
    nan = np.full(n, np.nan)
    return Frames(
        names=_strings(f"{source.sequence}/{stem}.jpg" for stem in stems),
        sequences=_strings([source.sequence] * n),
        cameras=_strings(_camera_names(source.sequence, keys)),
        sources=_strings(source.parts[i].name for i in measured.source_idx),
        video_frame=video_frame.astype(np.int64),
        time_s=measured.time_s,
        status=choice.status,
        reason=choice.reason,
        sharpness=np.round(measured.sharpness, 3),
        motion_px=choice.motion_px,
        width=measured.width,
        height=measured.height,
        lat_lon_deg=np.full((n, 2), np.nan),
        rel_alt_m=nan,
        abs_alt_m=nan,
        sigma_m=np.full((n, 3), np.nan),
        gimbal_deg=np.full((n, 3), np.nan),
    )


def _video_images(
    source: Source, threads: int, starts: list[float], notes: list[str]
) -> Iterator[GrayImage]:
    """Yield the frames of all parts on one clock; append part start times and decoding notes to the lists."""
    begin_s = 0.0
    for part_idx, part in enumerate(source.parts):
        report = video.DecodeReport()
        starts.append(begin_s)
        times: list[float] = []
        for frame in video.decode_gray(
            part, max_width=MEASURE_WIDTH, threads=threads, report=report
        ):
            times.append(frame.time_s)
            yield GrayImage(
                part_idx,
                frame.index,
                round(begin_s + frame.time_s, 6),
                frame.width,
                frame.height,
                frame.image,
                frame.damaged,
            )
        # The next part begins one frame interval after the last frame of this one.
        step_s = float(np.median(np.diff(times))) if len(times) > 1 else 0.04
        begin_s = round(begin_s + times[-1] + step_s, 6)
        notes += [f"{part.name}: {note}" for note in report.notes]


def _analyse_photos(source: Source, progress: Callable[[int], None] | None) -> Candidates:
    headers = read_headers(source.parts)
    known = [i for i, photo in enumerate(headers.metadata) if photo is not None]
    telemetry = telemetry_from_photos(
        [photo for photo in headers.metadata if photo is not None], source=source.sequence
    )
    # Unreadable photos take the time of the photo before.
    last_readable = np.maximum(
        np.searchsorted(known, np.arange(len(source.parts)), side="right") - 1, 0
    )
    times = telemetry.time_s[last_readable] if known else np.zeros(len(source.parts))

    def images() -> Iterator[GrayImage]:
        for i, (path, (width, height)) in enumerate(
            zip(source.parts, headers.sizes.tolist(), strict=True)
        ):
            gray, problem = None, headers.problem[i]
            if not problem:
                try:
                    gray = decode_photo_gray(path, max_width=MEASURE_WIDTH)
                except InputError as error:
                    problem = str(error).removeprefix(f"{path}: ")
            yield GrayImage(i, 0, float(times[i]), width, height, gray, problem=problem)

    measured = measure(images(), lost_after=1, progress=progress)
    telemetry_row = np.full(len(source.parts), -1)
    telemetry_row[known] = np.arange(len(known))
    rows = _expand_rows(telemetry, telemetry_row, times)
    return Candidates(source, measured, (), headers, rows, telemetry.notes)


def _expand_rows(telemetry: Telemetry, row: np.ndarray, time_s: np.ndarray) -> Telemetry:
    """Select telemetry rows by index (N,); rows with index -1 become NaN."""

    def column(values: np.ndarray) -> np.ndarray:
        result = np.full((len(row), *values.shape[1:]), np.nan)
        result[row >= 0] = values[row[row >= 0]]
        return result

    return Telemetry(
        time_s,
        column(telemetry.lat_lon_deg),
        column(telemetry.rel_alt_m),
        column(telemetry.abs_alt_m),
        column(telemetry.sigma_m),
        column(telemetry.gimbal_deg),
        column(telemetry.utc_s),
        column(telemetry.zoom),
        telemetry.abs_reference,
        telemetry.utc_is_local,
        telemetry.kind,
        telemetry.source,
        telemetry.notes,
    )


def _cache_key(source: Source) -> str:
    """Return a string of everything that a video's measurements depend on."""
    files = [(p.name, p.stat().st_size, p.stat().st_mtime_ns) for p in source.parts]
    return f"{_CACHE_VERSION} {MEASURE_WIDTH} {files!r}"


def _write_cache(path: Path, candidates: Candidates) -> None:
    measured = candidates.measured
    columns = {f.name: getattr(measured, f.name) for f in fields(measured)}
    with atomic_writer(path) as file:
        np.savez_compressed(
            file,
            identity=np.array(_cache_key(candidates.source)),
            part_start_s=np.array(candidates.part_start_s),
            notes=np.array(candidates.notes, dtype=np.str_),
            **columns,
        )


def _read_cache(path: Path, source: Source) -> Candidates | None:
    """Read cached measurements; None if the cache is missing, damaged or of other files."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as data:
            if str(data["identity"]) != _cache_key(source):
                _logger.debug("%s: of other files, measured again", path)
                return None
            measured = Measurements(**{f.name: data[f.name] for f in fields(Measurements)})
            starts, notes = data["part_start_s"].tolist(), data["notes"].tolist()
    except FileNotFoundError:
        return None
    except ARRAY_DAMAGE as error:
        _logger.debug("%s: cannot be used (%r), measured again", path, error)
        return None
    return Candidates(source, measured, tuple(starts), None, None, tuple(notes))


def _camera_runs(measured: Measurements, focal: np.ndarray | None) -> list[object]:
    """Return one key per frame that changes with image size or zoom; a known combination keeps its key."""
    zooms: list[float] = []
    keys: list[object] = []
    zoom = 0
    for i in range(len(measured)):
        if focal is not None and np.isfinite(focal[i]):
            near = [k for k, z in enumerate(zooms) if abs(focal[i] / z - 1) <= _ZOOM_CHANGE]
            zoom = near[0] if near else len(zooms)
            if not near:
                zooms.append(float(focal[i]))
        keys.append((int(measured.width[i]), int(measured.height[i]), zoom))
    return keys


def _camera_names(sequence: str, keys: Sequence[object]) -> list[str]:
    """Name cameras `<sequence>`, `<sequence>-2`, ... in order of their keys; None takes the first name."""
    order = {key: i for i, key in enumerate(dict.fromkeys(k for k in keys if k is not None))}
    numbers = [order.get(key, 0) for key in keys]
    return [sequence if k == 0 else f"{sequence}-{k + 1}" for k in numbers]


def photo_stems(paths: Sequence[Path]) -> list[str]:
    """Return a safe file stem for each photo, unique even if case is ignored."""
    taken: set[str] = set()
    stems = []
    for path in paths:
        base = stem = safe_name(path.stem, "photo")
        number = 2
        while stem.lower() in taken:
            stem, number = f"{base}-{number}", number + 1
        taken.add(stem.lower())
        stems.append(stem)
    return stems


def _strings(values: Iterator[str] | Sequence[str]) -> np.ndarray:
    return np.array(list(values), dtype=np.str_)
