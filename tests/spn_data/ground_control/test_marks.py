"""Tests of marks in the images of a model: their images, sizes and the points that they give."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from spn_data.errors import InputError
from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import rotations_from_angles
from spn_data.ground_control.control_file import ControlFile, Mark, SurveyedPoint
from spn_data.ground_control.marks import MarkedPoint, ModelImages, marked_points

CAMERA = Camera("SIMPLE_RADIAL", 1200, 800, np.array([900.0, 600.0, 400.0, -0.05]))
POINTS = np.array([[0.0, 20.0, 1.0], [4.0, 22.0, 3.0], [-5.0, 19.0, 0.5], [1.0, 25.0, 4.0]])
N = 6


def images() -> ModelImages:
    """Return six photos that look north from a line of 10 m."""
    centers = np.column_stack([np.linspace(-5, 5, N), np.zeros(N), np.linspace(1, 3, N)])
    angles = np.column_stack([np.linspace(12, -12, N), np.zeros(N), np.linspace(-3, 3, N)])
    names = [f"photos/DJI_{k}.jpg" for k in range(N)]
    return ModelImages(
        names,
        [f"DJI_{k}.JPG" for k in range(N)],
        {"dji_9.jpg": "it has no pose in the model"},
        Poses.from_rotations(centers, rotations_from_angles(angles)),
        [CAMERA] * N,
    )


def a_file(noise_px: float = 0.0, seen: int = N) -> ControlFile:
    """Return the points with a mark in each photo."""
    rng = np.random.default_rng(4)
    known = images()
    points = []
    for k, xyz in enumerate(POINTS):
        pixels = [CAMERA.project(known.poses.to_camera(xyz[None], i))[0] for i in range(seen)]
        marks = tuple(
            Mark(f"DJI_{i}.JPG", *(p + noise_px * rng.standard_normal(2)), 2 + i)
            for i, p in enumerate(pixels)
        )
        points.append(SurveyedPoint(f"P{k}", 0.0, 0.0, 0.0, 2, marks=marks))
    return ControlFile(Path("gcp.txt"), "EPSG:32632", tuple(points))


def changed(file: ControlFile, change: object) -> ControlFile:
    """Return a file with a function applied to each mark."""
    points = tuple(replace(p, marks=tuple(change(m) for m in p.marks)) for p in file.points)  # type: ignore[operator]
    return replace(file, points=points)


def found_of(file: ControlFile) -> tuple[tuple[MarkedPoint, ...], tuple[str, ...]]:
    return marked_points(file, images(), 1.0)


def test_points_are_triangulated_within_their_stated_sigma() -> None:
    """Marks with 1 px of noise give points within 3 sigma, and exact ones the points."""
    exact, notes = found_of(a_file())
    assert notes == ()
    assert np.array([p.found.point for p in exact]) == pytest.approx(POINTS, abs=1e-6)
    for point, true in zip(found_of(a_file(1.0))[0], POINTS, strict=True):
        error = point.found.point - true
        assert (
            error @ np.linalg.solve(point.found.covariance, error) < 14.2
        )  # 3 sigma, 3 coordinates
        assert np.sqrt(np.trace(point.found.covariance)) < 0.3


def test_a_wrong_mark_is_left_out_by_name() -> None:
    """One mark 60 px off is named and does not change the point; with two marks none can be told."""
    file = a_file()
    marks = list(file.points[1].marks)
    marks[3] = replace(marks[3], x=marks[3].x + 60)
    wrong = replace(file, points=(file.points[0], replace(file.points[1], marks=tuple(marks))))
    points, notes = found_of(wrong)
    assert points[1].found.point == pytest.approx(POINTS[1], abs=1e-6)
    assert len(notes) == 1
    assert "Point P1: its mark in DJI_3.JPG is 6" in notes[0]
    two = replace(wrong, points=(file.points[0], replace(file.points[1], marks=tuple(marks[2:4]))))
    y = replace(marks[3], y=marks[3].y + 60)
    two = replace(two, points=(two.points[0], replace(two.points[1], marks=(marks[2], y))))
    points, notes = found_of(two)
    assert "Point P1 is not used: its 2 marks disagree by" in notes[0]
    assert points[1].found.problem


def test_images_are_found_by_any_of_their_names() -> None:
    """A photo is found by its name, its frame's name and its folder; others are told with the reason."""
    names = [
        "DJI_0.JPG",
        "photos/DJI_1.jpg",
        "D:/flight/photos/DJI_2.JPG",
        "dji_3",
        "DJI_9.JPG",
        "X.JPG",
    ]
    file = a_file()
    point = replace(
        file.points[0],
        marks=tuple(replace(m, image=n) for m, n in zip(file.points[0].marks, names, strict=True)),
    )
    points, notes = found_of(replace(file, points=(point,)))
    assert points[0].found.point == pytest.approx(POINTS[0], abs=1e-6)
    assert len(points[0].views) == 4
    assert "1 mark is not used, in DJI_9.JPG: it has no pose in the model." in notes
    assert "1 mark is not used, in X.JPG: there is no such image." in notes
    nowhere = changed(file, lambda m: replace(m, image="IMG_1.JPG"))
    with pytest.raises(
        InputError, match=r"none of its images is in the model: it names IMG_1\.JPG"
    ):
        found_of(nowhere)
    twice = images()
    twice = replace(twice, files=["DJI_0.JPG"] * N)
    with pytest.raises(
        InputError, match=r"gcp\.txt:2: image DJI_0\.JPG may be photos/DJI_0\.jpg and"
    ):
        marked_points(file, twice, 1.0)


def test_marks_of_images_of_another_size_are_told() -> None:
    """Marks of half-size photos are refused with that size, and used if the file states it."""
    half = changed(a_file(), lambda m: replace(m, x=m.x / 2, y=m.y / 2))
    with pytest.raises(InputError, match="made in images of about 600 x 400 pixels"):
        found_of(half)
    stated = changed(half, lambda m: replace(m, size=(600, 400)))
    assert found_of(stated)[0][0].found.point == pytest.approx(POINTS[0], abs=1e-6)
    double = changed(a_file(), lambda m: replace(m, x=m.x * 2, y=m.y * 2))
    with pytest.raises(InputError, match=r"is outside DJI_\d\.JPG, which has 1200 x 800 pixels"):
        found_of(double)
    other = changed(a_file(), lambda m: replace(m, size=(800, 1200)))
    with pytest.raises(InputError, match="as if it was turned or cropped"):
        found_of(other)


def test_marks_of_turned_photos_are_told() -> None:
    """Marks in photos upside down, or as they are stored, are refused."""
    turned = changed(a_file(), lambda m: replace(m, x=1200 - m.x, y=800 - m.y))
    with pytest.raises(InputError, match="turned by 180 degrees: mark photos upright"):
        found_of(turned)
    stored = changed(a_file(), lambda m: replace(m, x=m.y, y=1200 - m.x))
    with pytest.raises(InputError, match="mark the photo upright, as its EXIF orientation says"):
        found_of(stored)


def test_points_that_cannot_be_had_are_told() -> None:
    """A point with one mark or none is not used, with the reason; marks at random are refused."""
    file = a_file()
    few = replace(
        file,
        points=(
            file.points[0],
            replace(file.points[1], marks=file.points[1].marks[:1]),
            replace(file.points[2], marks=()),
        ),
    )
    notes = found_of(few)[1]
    assert "Point P1 is not used: it is marked in one image only, and two are needed." in notes
    assert "Point P2 is not used: it has no mark in an image of the model." in notes
    rng = np.random.default_rng(1)
    chance = changed(file, lambda m: replace(m, x=rng.uniform(0, 1200), y=rng.uniform(0, 800)))
    with pytest.raises(InputError, match="the marks of none of 4 points meet in the model"):
        found_of(chance)
