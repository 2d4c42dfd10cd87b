"""Marks of surveyed points in the images of a model: image names, pixels, and triangulation of each point."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from spn_data.errors import InputError
from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses
from spn_data.ground_control.control_file import ControlFile, Mark
from spn_data.ground_control.triangulation import Triangulated, Views, triangulate

_NAMES_SHOWN = 3
# Sizes and orientations of images, in terms of the model's, that are tried if marks do not meet.
_SIZES = tuple(
    (factor, 0)
    for factor in (
        0.125,
        0.2,
        0.25,
        1 / 3,
        0.5,
        2 / 3,
        0.75,
        1.0,
        4 / 3,
        1.5,
        2.0,
        3.0,
        4.0,
        5.0,
        8.0,
    )
)
_TURNED = ((1.0, 90), (1.0, 180), (1.0, 270))
_POINTS_TRIED = 6
_MET = 0.7  # share of points that have to meet under another size
_MEET_PX = 5.0


@dataclass(frozen=True, eq=False)
class ModelImages:
    """N images of a model.

    Attributes
    ----------
    names : sequence of str
        `<sequence>/<frame>.jpg`.
    files : sequence of str
        Name of the photo that each was made from; empty for frames of videos.
    absent : mapping of str to str
        Why an image that is known is not in the model, by lower-case name.
    poses : Poses
    cameras : sequence of Camera
    """

    names: Sequence[str]
    files: Sequence[str]
    absent: Mapping[str, str]
    poses: Poses
    cameras: Sequence[Camera]


@dataclass(frozen=True, eq=False)
class MarkedPoint:
    """A surveyed point in the model.

    Attributes
    ----------
    name : str
    views : Views
        Its marks in images of the model.
    found : Triangulated
    """

    name: str
    views: Views
    found: Triangulated


def marked_points(
    file: ControlFile, images: ModelImages, sigma_px: float
) -> tuple[tuple[MarkedPoint, ...], tuple[str, ...]]:
    """Find the marks' images and triangulate each point.

    Parameters
    ----------
    file : ControlFile
    images : ModelImages
    sigma_px : float
        Standard deviation of a mark for which the file states none.

    Returns
    -------
    points : tuple of MarkedPoint
        In the order of the file.
    notes : tuple of str
        Marks and points that could not be used, and why.

    Raises
    ------
    InputError
        If no mark is in an image of the model, an image name is ambiguous, a mark is outside its image, or
        marks were made in images of another size or orientation.
    """
    find = _Finder(file, images)
    rows = [[(mark, find.row(mark)) for mark in point.marks] for point in file.points]
    placed = [[(mark, row) for mark, row in marks if row is not None] for marks in rows]
    if not any(placed):
        raise InputError(
            f"none of its images is in the model: it names {find.first_unknown}, the model has "
            f"{images.names[0]}" + (f" ({images.files[0]})" if images.files[0] else ""),
            path=file.path,
        )
    views = [_views(file, images, marks, sigma_px) for marks in placed]
    found = [triangulate(v) for v in views]
    _require_meeting(file, images, views, found)
    notes = list(find.notes())
    for point, result, marks in zip(file.points, found, placed, strict=True):
        if result.problem:
            notes.append(f"Point {point.name} is not used: {result.problem}.")
            continue
        for k in np.flatnonzero(~result.used):
            distance = result.distance_px[k]
            where = f"{distance:.0f} px from" if np.isfinite(distance) else "far from"
            notes.append(
                f"Point {point.name}: its mark in {marks[k][0].image} is {where} where the other "
                f"{int(result.used.sum())} marks place it, and is left out."
            )
    points = tuple(
        MarkedPoint(p.name, v, f) for p, v, f in zip(file.points, views, found, strict=True)
    )
    return points, tuple(notes)


class _Finder:
    """Rows of the model's images by the names that a file may use for them."""

    def __init__(self, file: ControlFile, images: ModelImages):
        self._file, self._absent = file, images.absent
        self._names = images.names
        self._rows: dict[str, set[int]] = defaultdict(set)
        self._missing: dict[str, list[str]] = defaultdict(list)
        for row, (name, source) in enumerate(zip(images.names, images.files, strict=True)):
            sequence, _, base = name.lower().partition("/")
            for key in {base, source.lower(), f"{sequence}/{source.lower()}", name.lower()} - {""}:
                self._rows[key].add(row)
                self._rows[key.rpartition(".")[0] or key].add(row)

    def row(self, mark: Mark) -> int | None:
        """Return the row of a mark's image; None, with a note, if it is not in the model."""
        parts = mark.image.replace("\\", "/").lower().rsplit("/", 2)[-2:]
        for key in ("/".join(parts), parts[-1]):
            for wanted in (key, key.rpartition(".")[0] or key):
                rows = self._rows.get(wanted, set())
                if len(rows) > 1:
                    both = " and ".join(self._names[r] for r in sorted(rows)[:2])
                    raise InputError(
                        f"image {mark.image} may be {both}: write the sequence before it",
                        path=self._file.path,
                        line=mark.line,
                    )
                if rows:
                    return next(iter(rows))
        why = self._absent.get(parts[-1]) or self._absent.get("/".join(parts))
        self._missing[why or "there is no such image"].append(mark.image)
        return None

    @property
    def first_unknown(self) -> str:
        """The first image that is not in the model."""
        return next((names[0] for names in self._missing.values()), "no image")

    def notes(self) -> list[str]:
        """Return a sentence for each reason why marks are not used."""
        notes = []
        for why, names in sorted(self._missing.items()):
            images = list(dict.fromkeys(names))
            shown = ", ".join(images[:_NAMES_SHOWN])
            more = f" and {len(images) - _NAMES_SHOWN} more" if len(images) > _NAMES_SHOWN else ""
            count = "1 mark is" if len(names) == 1 else f"{len(names)} marks are"
            notes.append(f"{count} not used, in {shown}{more}: {why}.")
        return notes


def _views(
    file: ControlFile, images: ModelImages, marks: Sequence[tuple[Mark, int]], sigma_px: float
) -> Views:
    """Return the marks of a point in the pixels of the model's images."""
    pixels, sigmas = np.zeros((len(marks), 2)), np.zeros(len(marks))
    for k, (mark, row) in enumerate(marks):
        camera = images.cameras[row]
        scale = np.ones(2)
        if mark.size is not None:
            scale = np.array([camera.width, camera.height]) / mark.size
            if abs(scale[0] / scale[1] - 1) > 0.02:
                raise InputError(
                    f"the mark was made in an image of {mark.size[0]} x {mark.size[1]} pixels, but "
                    f"{mark.image} has {camera.width} x {camera.height} here: its sides differ, as if it was "
                    "turned or cropped",
                    path=file.path,
                    line=mark.line,
                )
        pixels[k] = np.array([mark.x, mark.y]) * scale
        sigmas[k] = (mark.sigma_px or sigma_px) * scale.mean()
        if not (0 <= pixels[k, 0] <= camera.width and 0 <= pixels[k, 1] <= camera.height):
            turned = 0 <= mark.x <= camera.height and 0 <= mark.y <= camera.width
            raise InputError(
                f"the mark at {mark.x:g} {mark.y:g} is outside {mark.image}, which has {camera.width} x "
                f"{camera.height} pixels here: "
                + (
                    "mark the photo upright, as its EXIF orientation says"
                    if turned and mark.size is None
                    else "if it was marked in an image of another size, add columns width and image_height"
                ),
                path=file.path,
                line=mark.line,
            )
    rows = np.array([row for _, row in marks], dtype=np.int64)
    return Views(pixels, sigmas, images.poses[rows], tuple(images.cameras[r] for r in rows))


def _require_meeting(
    file: ControlFile, images: ModelImages, views: Sequence[Views], found: Sequence[Triangulated]
) -> None:
    """Raise InputError if most points' rays do not meet, but would in images of another size or turned."""
    several = [k for k, v in enumerate(views) if len(v) >= 2]
    failed = [k for k in several if found[k].problem]
    if not several or len(failed) <= len(several) / 2:
        return
    tried = several[:_POINTS_TRIED]
    shares = {
        (factor, turn): float(np.mean([_meets(views[k], factor, turn) for k in tried]))
        for factor, turn in (*_SIZES, *_TURNED)
    }
    (factor, turn), share = max(shares.items(), key=lambda item: item[1])
    if share < _MET or (factor, turn) == (1.0, 0):
        if len(failed) == len(several):
            k = failed[0]
            raise InputError(
                f"the marks of none of {len(several)} points meet in the model (point "
                f"{file.points[k].name!r}: {found[k].problem}): are they of these images?",
                path=file.path,
            )
        return
    camera = images.cameras[0]
    size = f"{round(camera.width / factor)} x {round(camera.height / factor)}"
    here = f"the images have {camera.width} x {camera.height} here"
    if turn:
        raise InputError(
            f"the marks meet only if the images are turned by {turn} degrees: mark photos upright, as their "
            "EXIF orientation says",
            path=file.path,
        )
    raise InputError(
        f"the marks meet only if they were made in images of about {size} pixels, but {here}: add columns "
        "width and image_height with the size in which they were marked",
        path=file.path,
    )


def _meets(views: Views, factor: float, turn: int) -> bool:
    """Return whether a point's rays meet if its marks are scaled, and turned about the images' middle."""
    size = np.array([[c.width, c.height] for c in views.cameras], dtype=np.float64)
    x, y = (views.pixels * factor).T
    width, height = size.T
    turned = {
        0: (x, y),
        90: (width - y, x),
        180: (width - x, height - y),
        270: (y, height - x),
    }[turn]
    if not all((v >= 0).all() and (v <= s).all() for v, s in zip(turned, size.T, strict=True)):
        return False
    moved = Views(np.column_stack(turned), views.sigma_px, views.poses, views.cameras)
    result = triangulate(moved)
    return not result.problem and bool(result.used.all() and (result.distance_px <= _MEET_PX).all())
