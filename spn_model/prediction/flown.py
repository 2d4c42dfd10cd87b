"""Images of a flight as a network wants them: rendered into the view that it was trained on."""

from __future__ import annotations

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
from spn_data.geometry.rendering import PinholeRenderer, RenderingOptions, canonical_camera
from spn_data.telemetry.exif import telemetry_of_photos
from spn_model.onboard.view import View

_REMEDY = (
    "its camera is not known, and without it a pose would be a guess; give it as --camera FILE: "
    "4-eval/<name>/camera.json of a flight with the same camera, as spn-data register writes it, or a "
    "calibration"
)


_MOST_LENSES = 16  # whose maps of pixels are kept


@dataclass(frozen=True, kw_only=True)
class FrameFilter:
    """Which frames of a video. All of them by default; photos are always taken."""

    every: int = 1  # each so-many-th
    fps: float | None = None  # at most so many a second, by the container's times


@dataclass(frozen=True, eq=False)
class Flight:
    """A source with its cameras, before any pixel is decoded.

    cameras : one a part (video) or photo, None where none is known; camera_source : "given" or "photo
    metadata"; time_s : (N,) of photos; headers : of photos; expected : frames, a guess for a video.
    """

    source: Source
    cameras: tuple[Camera | None, ...]
    camera_source: str
    expected: int
    time_s: np.ndarray = field(default_factory=lambda: np.zeros(0))
    headers: PhotoHeaders | None = None


@dataclass(frozen=True, eq=False)
class FlownFrame:
    """One frame. name : `<sequence>/<frame>.jpg`, as labels have it; source : name of its file.

    image : (H, W, 3) uint8 RGB in the view, matrix : its K (3, 3); None where problem says why.
    """

    name: str
    sequence: str
    source: str
    video_frame: int
    time_s: float
    image: np.ndarray | None
    matrix: np.ndarray
    problem: str = ""


def find_flights(paths: Sequence[Path], given: Camera | None) -> tuple[list[Flight], list[str]]:
    """The flights of files and folders, each under a name of its own, and notes.

    given : the camera of all of them. Raises InputError where there is no image, where one cannot be read at
    all, where the given camera is of another shape, and where a flight's camera is not known.
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
            flight, told = _flight(replace(source, sequence=name), given)
            flights.append(flight)
            notes += told
        if found.ignored:
            first, why = found.ignored[0]
            notes.append(
                f"{len(found.ignored)} other files are left out, the first {first} ({why})."
            )
    return flights, notes


def _flight(source: Source, given: Camera | None) -> tuple[Flight, list[str]]:
    if source.kind is SourceKind.VIDEO:
        infos = [video.probe(part) for part in source.parts]
        if given is None:
            raise InputError(_REMEDY, path=source.parts[0])
        cameras = tuple(camera_at_size(given, i.width, i.height, i.path) for i in infos)
        expected = sum(info.frame_count for info in infos)
        notes = [f"{i.path.name}: {note}" for i in infos for note in i.notes]
        return Flight(source, cameras, "given", expected), notes
    headers = read_headers(source.parts)
    known = [m for m in headers.metadata if m is not None]
    if not known:
        raise InputError(
            f"no photo of it can be read: {headers.problem[0]}", path=source.parts[0].parent
        )
    photos = tuple(_photo_camera(headers, row, given) for row in range(len(source.parts)))
    readable = [row for row, metadata in enumerate(headers.metadata) if metadata is not None]
    if all(photos[row] is None for row in readable):
        raise InputError(_REMEDY, path=source.parts[readable[0]])
    telemetry = telemetry_of_photos(known, source=source.sequence)
    time_s = np.full(len(source.parts), np.nan)
    time_s[readable] = telemetry.time_s
    notes = []
    if given is None:
        notes.append(
            f"{source.sequence}: focal lengths are those of the photos' own metadata, without distortion: "
            "a registered camera gives better poses."
        )
    origin = "photo metadata" if given is None else "given"
    return Flight(source, photos, origin, len(source.parts), time_s, headers), notes


def _photo_camera(headers: PhotoHeaders, row: int, given: Camera | None) -> Camera | None:
    if headers.metadata[row] is None:
        return None
    width, height = headers.sizes[row].tolist()
    if given is not None:
        return camera_at_size(given, width, height, headers.paths[row])
    focal_px = headers.focal_px(row)
    return None if focal_px is None else camera_from_focal_length(focal_px, width, height)


class Views:
    """Renders images of any lens into the view of a network: its one camera, or the lens's own pinhole of the
    same width where it was trained on those. seen : least share of a view that a lens has filled."""

    def __init__(self, view: View):
        self._view = view
        self._renderers: dict[tuple[object, ...], PinholeRenderer] = {}
        self.seen = 1.0

    def of(self, camera: Camera) -> PinholeRenderer:
        """Raises GeometryError where the lens sees nothing of the view."""
        key = (camera.model, camera.width, camera.height, *camera.params.tolist())
        if key not in self._renderers:
            if len(self._renderers) >= _MOST_LENSES:
                self._renderers.clear()  # photos whose every zoom differs: memory stays bounded
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


def frames(flight: Flight, views: Views, choice: FrameFilter) -> Iterator[FlownFrame]:
    """The chosen frames in their order, rendered one by one; what fails has its reason."""
    if flight.source.kind is SourceKind.VIDEO:
        return _of_video(flight, views, choice)
    return _of_photos(flight, views)


def _of_video(flight: Flight, views: Views, choice: FrameFilter) -> Iterator[FlownFrame]:
    begin_s, count = 0.0, 0
    for part, camera in zip(flight.source.parts, flight.cameras, strict=True):
        assert camera is not None
        chosen = _Chosen(choice, count, begin_s)
        times = [0.0, 0.04]
        for frame in video.decode(part, wanted=chosen.wants):
            times = [times[-1], frame.time_s] if frame.index else times
            if frame.index in chosen.latest:
                index = count + frame.index
                yield _rendered(
                    FlownFrame(
                        f"{flight.source.sequence}/{index:06d}.jpg",
                        flight.source.sequence,
                        shown(part),
                        index,
                        round(begin_s + frame.time_s, 6),
                        frame.image,
                        np.full((3, 3), np.nan),
                        "the file is damaged here" if frame.damaged else "",
                    ),
                    camera,
                    views,
                )
        # The next part begins one frame after this one's last.
        begin_s = round(begin_s + times[-1] + max(times[-1] - times[-2], 1e-3), 6)
        count += frame.index + 1


class _Chosen:
    """Which frames of a part are wanted; latest : index of the last one that was."""

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


def _of_photos(flight: Flight, views: Views) -> Iterator[FlownFrame]:
    assert flight.headers is not None
    stems = photo_stems(flight.source.parts)
    for row, (path, stem) in enumerate(zip(flight.source.parts, stems, strict=True)):
        image, problem, camera = None, flight.headers.problem[row], flight.cameras[row]
        if not problem and camera is None:
            problem = "its camera is not known: its metadata tells no focal length"
        if not problem:
            try:
                image = decode_photo(path)
            except InputError as error:
                problem = str(error).removeprefix(f"{path}: ")
        frame = FlownFrame(
            f"{flight.source.sequence}/{stem}.jpg",
            flight.source.sequence,
            shown(path),
            -1,
            float(flight.time_s[row]),
            image,
            np.full((3, 3), np.nan),
            problem,
        )
        yield frame if camera is None else _rendered(frame, camera, views)


def _rendered(frame: FlownFrame, camera: Camera, views: Views) -> FlownFrame:
    if frame.problem or frame.image is None:
        return replace(frame, image=None)
    if frame.image.shape[:2] != (camera.height, camera.width):
        height, width = frame.image.shape[:2]
        told = f"is {width}x{height}, where {camera.width}x{camera.height} was expected"
        return replace(frame, image=None, problem=told)
    try:
        renderer = views.of(camera)
    except GeometryError as error:
        return replace(frame, image=None, problem=str(error))
    image = cv2.cvtColor(renderer.render(frame.image), cv2.COLOR_BGR2RGB)
    return replace(frame, image=image, matrix=renderer.target.matrix)


def shown(path: Path) -> str:
    """A file's name as text that any file and terminal takes."""
    text = path.name.encode("utf-8", "backslashreplace").decode()
    return "".join(
        letter.encode("unicode_escape").decode()
        if unicodedata.category(letter) in ("Cc", "Cf", "Cs", "Zl", "Zp")
        else letter
        for letter in text
    )
