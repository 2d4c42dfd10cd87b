"""Frames of a flight, rendered into the view that a network was trained on."""

from __future__ import annotations

import math
import unicodedata
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np

from spn_data.capture import video
from spn_data.capture.candidates import photo_stems
from spn_data.capture.photos import PhotoHeaders, decode_photo, read_headers
from spn_data.capture.sources import Source, SourceKind, discover
from spn_data.errors import GeometryError, InputError
from spn_data.geometry.camera import Camera
from spn_data.geometry.camera_file import camera_at_size, camera_from_focal_length
from spn_data.geometry.image_texture import missing_texture
from spn_data.geometry.rendering import PinholeRenderer, RenderingOptions, canonical_camera
from spn_data.telemetry.exif import telemetry_from_photos
from spn_model.onboard.view import View

_REMEDY = (
    "the camera is unknown, so its pose cannot be estimated; give it as --camera FILE: "
    "4-eval/<name>/camera.json of a flight with the same camera (written by spn-data register), or a "
    "calibration"
)


_MAX_RENDERERS = 16  # cameras whose renderers are cached


@dataclass(frozen=True, kw_only=True)
class FrameFilter:
    """Which frames of a video to use; all photos are always used.

    Attributes
    ----------
    every : int
        Use every Nth frame.
    fps : float or None
        Use at most this many frames per second, by the timestamps of the container; None for no limit.
    """

    every: int = 1
    fps: float | None = None


@dataclass(frozen=True, eq=False)
class Flight:
    """A source with its cameras, before any pixel is decoded.

    cameras : one per part (video) or photo, None where unknown; camera_source : "given" or "photo metadata";
    time_s : (N,) times of photos; headers : of photos; expected : number of frames, estimated for a video;
    duration_s : of a video, NaN where unknown.
    """

    source: Source
    cameras: tuple[Camera | None, ...]
    camera_source: str
    expected: int
    time_s: np.ndarray = field(default_factory=lambda: np.zeros(0))
    headers: PhotoHeaders | None = None
    duration_s: float = math.nan

    def expected_of(self, choice: FrameFilter) -> int:
        """Return how many frames a choice is expected to leave, for the display of progress."""
        if self.source.kind is not SourceKind.VIDEO:
            return self.expected
        count = math.ceil(self.expected / choice.every)
        if choice.fps is not None and math.isfinite(self.duration_s):
            count = min(count, math.ceil(self.duration_s * choice.fps))
        return count

    @property
    def is_readable(self) -> bool:
        """Whether it is a video, or the header of at least one photo can be read."""
        return self.headers is None or any(m is not None for m in self.headers.metadata)


@dataclass(frozen=True, eq=False)
class FlightFrame:
    """One frame, rendered into the view of a network.

    name : `<sequence>/<frame>.jpg`, as in the labels; source : name of its file. image : (H, W, 3) uint8 RGB
    in the view, None if `problem` says why; matrix : its camera matrix (3, 3), NaN without an image;
    readable : whether the problem is what the image shows, not that it cannot be read.
    """

    name: str
    sequence: str
    source: str
    video_frame: int
    time_s: float
    image: np.ndarray | None
    matrix: np.ndarray
    problem: str = ""
    readable: bool = False


def find_flights(paths: Sequence[Path], given: Camera | None) -> tuple[list[Flight], list[str]]:
    """Find the flights in files and folders.

    Parameters
    ----------
    paths : sequence of Path
        Photos, videos, or folders of them.
    given : Camera or None
        Camera of all flights; None to use the focal lengths in the photo metadata.

    Returns
    -------
    flights : list of Flight
        Flights with unique names.
    notes : list of str
        Messages for the user.

    Raises
    ------
    InputError
        If there is no image, if a source cannot be read at all, if the given camera has another aspect ratio,
        or if the camera of a flight is unknown.
    """
    flights: list[Flight] = []
    notes: list[str] = []
    taken: set[str] = set()
    for path in paths:
        found = discover(path)
        for source in found.sources:
            name, number = source.sequence, 2
            while name.lower() in taken:
                name, number = f"{source.sequence}-{number}", number + 1
            taken.add(name.lower())
            flight, flight_notes = _open_flight(replace(source, sequence=name), given)
            flights.append(flight)
            notes += flight_notes
        if found.ignored:
            first, why = found.ignored[0]
            notes.append(f"{len(found.ignored)} other files were ignored, e.g. {first} ({why}).")
    unreadable = [f.headers for f in flights if f.headers is not None and not f.is_readable]
    if unreadable and len(unreadable) == len(flights):
        raise InputError(
            f"none of its photos can be read: {unreadable[0].problem[0]}",
            path=unreadable[0].paths[0].parent,
        )
    return flights, notes


def _open_flight(source: Source, given: Camera | None) -> tuple[Flight, list[str]]:
    if source.kind is SourceKind.VIDEO:
        infos = [video.probe(part) for part in source.parts]
        if given is None:
            raise InputError(_REMEDY, path=source.parts[0])
        cameras = tuple(camera_at_size(given, i.width, i.height, i.path) for i in infos)
        expected = sum(info.frame_count for info in infos)
        notes = [f"{i.path.name}: {note}" for i in infos for note in i.notes]
        seconds = sum(info.duration_s for info in infos)
        return Flight(source, cameras, "given", expected, duration_s=seconds), notes
    headers = read_headers(source.parts)
    known = [m for m in headers.metadata if m is not None]
    if not known:
        nothing = np.full(len(source.parts), np.nan)
        unknown: tuple[Camera | None, ...] = (None,) * len(source.parts)
        return Flight(source, unknown, "unknown", len(source.parts), nothing, headers), []
    photos = tuple(_photo_camera(headers, row, given) for row in range(len(source.parts)))
    readable = [row for row, metadata in enumerate(headers.metadata) if metadata is not None]
    if all(photos[row] is None for row in readable):
        raise InputError(_REMEDY, path=source.parts[readable[0]])
    telemetry = telemetry_from_photos(known, source=source.sequence)
    time_s = np.full(len(source.parts), np.nan)
    time_s[readable] = telemetry.time_s
    notes = []
    if given is None:
        notes.append(
            f"{source.sequence}: using focal lengths from the photo metadata, without distortion; "
            "a registered camera gives better poses."
        )
        doubts = (headers.focal(row)[1] for row in readable)
        notes += [f"{source.sequence}: {doubt}." for doubt in {d: None for d in doubts if d}][:1]
    origin = "photo metadata" if given is None else "given"
    return Flight(source, photos, origin, len(source.parts), time_s, headers), notes


def _photo_camera(headers: PhotoHeaders, row: int, given: Camera | None) -> Camera | None:
    if headers.metadata[row] is None:
        return None
    width, height = headers.sizes[row].tolist()
    if given is not None:
        return camera_at_size(given, width, height, headers.paths[row])
    stated, _ = headers.focal(row)
    return None if stated is None else camera_from_focal_length(stated.focal_px, width, height)


class ViewRenderers:
    """Renders images of any camera into the view of a network.

    The view is the network's one camera or, if its training images each had their own, the pinhole of the
    lens with the same width. seen : smallest share of a view that a camera has covered so far.
    """

    def __init__(self, view: View):
        self._view = view
        self._renderers: dict[tuple[object, ...], PinholeRenderer] = {}
        self.seen = 1.0

    def renderer(self, camera: Camera) -> PinholeRenderer:
        """Return the renderer of a camera; raise GeometryError if it sees nothing of the view."""
        key = (camera.model, camera.width, camera.height, *camera.params.tolist())
        if key not in self._renderers:
            if len(self._renderers) >= _MAX_RENDERERS:
                self._renderers.clear()  # bounds the memory if the zoom differs in every photo
            target = self._view.camera
            if target is None:
                width_px = self._view.size[0]
                target = canonical_camera([camera], RenderingOptions(width_px=width_px))
            renderer = PinholeRenderer(camera, target)
            if not renderer.valid.any():
                raise GeometryError(
                    "the camera sees nothing of the view that the network was trained on"
                )
            self.seen = min(self.seen, float(renderer.valid.mean()))
            self._renderers[key] = renderer
        return self._renderers[key]


def frames(flight: Flight, views: ViewRenderers, choice: FrameFilter) -> Iterator[FlightFrame]:
    """Yield the chosen frames in order, rendered one by one.

    A frame that cannot be decoded or rendered has a `problem` instead of an image.
    """
    if flight.source.kind is SourceKind.VIDEO:
        return _video_frames(flight, views, choice)
    return _photo_frames(flight, views)


def _video_frames(
    flight: Flight, views: ViewRenderers, choice: FrameFilter
) -> Iterator[FlightFrame]:
    begin_s, count = 0.0, 0
    for part, camera in zip(flight.source.parts, flight.cameras, strict=True):
        assert camera is not None
        chosen = _FrameSelector(choice, count, begin_s)
        times = [0.0, 0.04]
        report = video.DecodeReport()
        for frame in video.decode(part, wanted=chosen.wants, report=report):
            times = [times[-1], frame.time_s] if frame.index else times
            if frame.index in chosen.latest:
                index = count + frame.index
                yield _render(
                    FlightFrame(
                        f"{flight.source.sequence}/{index:06d}.jpg",
                        flight.source.sequence,
                        printable_name(part),
                        index,
                        round(begin_s + frame.time_s, 6),
                        frame.image,
                        np.full((3, 3), np.nan),
                        "the video is damaged at this frame" if frame.damaged else "",
                    ),
                    camera,
                    views,
                )
        if report.early_end:
            yield FlightFrame(
                f"{flight.source.sequence}/{count + report.frames:06d}-rest.jpg",
                flight.source.sequence,
                printable_name(part),
                count + report.frames,
                np.nan,
                None,
                np.full((3, 3), np.nan),
                report.early_end,
            )
        # The next part begins one frame after the last frame of this part.
        begin_s = round(begin_s + times[-1] + max(times[-1] - times[-2], 1e-3), 6)
        count += report.frames


class _FrameSelector:
    """Selects frames of one part of a video; latest : index of the last frame that was selected."""

    def __init__(self, choice: FrameFilter, count: int, begin_s: float):
        self._choice, self._count, self._begin_s = choice, count, begin_s
        self._interval = -1
        self.latest: tuple[int, ...] = ()

    def wants(self, frame: video.VideoFrame) -> bool:
        if (self._count + frame.index) % self._choice.every:
            return False
        if self._choice.fps is not None:
            interval = int((self._begin_s + frame.time_s) * self._choice.fps + 1e-6)
            if interval == self._interval:
                return False
            self._interval = interval
        self.latest = (frame.index,)
        return True


def _photo_frames(flight: Flight, views: ViewRenderers) -> Iterator[FlightFrame]:
    assert flight.headers is not None
    stems = photo_stems(flight.source.parts)
    for row, (path, stem) in enumerate(zip(flight.source.parts, stems, strict=True)):
        image, problem, camera = None, flight.headers.problem[row], flight.cameras[row]
        if not problem and camera is None:
            problem = "the camera is unknown: no focal length in the photo metadata"
        if not problem:
            try:
                image = decode_photo(path)
            except InputError as error:
                problem = str(error).removeprefix(f"{path}: ")
        frame = FlightFrame(
            f"{flight.source.sequence}/{stem}.jpg",
            flight.source.sequence,
            printable_name(path),
            -1,
            float(flight.time_s[row]),
            image,
            np.full((3, 3), np.nan),
            problem,
        )
        yield frame if camera is None else _render(frame, camera, views)


def _render(frame: FlightFrame, camera: Camera, views: ViewRenderers) -> FlightFrame:
    if frame.problem or frame.image is None:
        return replace(frame, image=None)
    height, width = frame.image.shape[:2]
    if (width, height) != (camera.width, camera.height):  # the size may change within a video
        try:
            camera = camera_at_size(camera, width, height)
        except InputError as error:
            return replace(frame, image=None, problem=str(error))
    problem = missing_texture(frame.image)
    if problem:
        return replace(frame, image=None, problem=problem, readable=True)
    try:
        renderer = views.renderer(camera)
    except GeometryError as error:
        return replace(frame, image=None, problem=str(error))
    image = cv2.cvtColor(renderer.render(frame.image), cv2.COLOR_BGR2RGB)
    return replace(frame, image=image, matrix=renderer.target.matrix)


def printable_name(path: Path) -> str:
    """Return the name of a file, with characters escaped that files or terminals do not accept."""
    text = path.name.encode("utf-8", "backslashreplace").decode()
    return "".join(
        letter.encode("unicode_escape").decode()
        if unicodedata.category(letter) in ("Cc", "Cf", "Cs", "Zl", "Zp")
        else letter
        for letter in text
    )
