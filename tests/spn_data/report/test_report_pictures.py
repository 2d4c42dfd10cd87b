"""Images and estimates of the report: their budget and cache, hostile tables, and what the page shows."""

from __future__ import annotations

import os
import re
import webbrowser
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from spn_cli import page

from spn_data.area.area import Area
from spn_data.area.names import FRAMES, THUMBNAILS
from spn_data.inputs import run_estimates, thumbnails
from spn_data.inputs.run_estimates import read_estimates
from spn_data.inputs.thumbnails import read_thumbnails
from spn_data.report.html import render
from spn_data.report.pictures import COARSE, fits_labels, worst_frames
from spn_data.report.run_facts import RunFacts
from tests.worlds.report_data import area, flight, pictures

HEADER = "method,group,name,error,error_deg,x,y,z,qw,qx,qy,qz"
LINE = "first,low,low/0.jpg,5.0000,1.0000,1.0000,2.0000,3.0000,1.000000,0.000000,0.000000,0.000000"


def run_facts() -> RunFacts:
    """Return a run with one network, evaluated on the current data set."""
    nothing: dict = {"groups": {}, "retrieval": {}, "published": (), "notes": (), "figures": ()}
    flags = {"is_current": True, "is_outdated": False}
    return RunFacts(
        name="first", units="m", dataset="00", networks={"first": None}, **flags, **nothing
    )


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """Folder of the run, in an area without anything else."""
    folder = tmp_path / "area" / "runs" / "first"
    folder.mkdir(parents=True)
    return folder


def estimates(run: Path):
    return read_estimates(Area(run.parents[1]), [run_facts()])


def test_estimates_of_a_network_and_of_its_fixes_are_read(run):
    """Poses of the run's own method are read, baselines are not; a fix without a pose keeps its reason."""
    lost = "first,low,low/1.jpg,,,,,,,,,"
    (run / "errors.csv").write_text("\n".join([HEADER, LINE, lost, LINE.replace("first", "mean")]))
    fix = "search,low/1.jpg,dark,,,,,,,,,"
    (run / "fixes.csv").write_text(f"method,name,reason,error,error_deg,x,y,z,qw,qx,qy,qz\n{fix}\n")
    (coarse, search), notes = estimates(run)
    assert notes == ()
    assert (coarse.method, search.method) == (COARSE, "search")
    assert coarse.names.tolist() == ["low/0.jpg", "low/1.jpg"]
    assert coarse.located.tolist() == [True, False]
    assert coarse.poses.centers[0].tolist() == [1, 2, 3]
    assert search.reasons.tolist() == ["dark"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (HEADER.replace(",x", "") + "\n", "has no column x: estimated poses cannot be shown"),
        (
            f"{HEADER}\n{LINE.replace('1.000000,0', '2.000000,0')}\n",
            ":2: not an estimated pose",
        ),
        (f"{HEADER}\n{LINE.replace('3.0000', 'inf')}\n", "an infinite number"),
        (f"{HEADER}\n{LINE.replace('3.0000', '')}\n", "position and unit quaternion expected"),
        (f"{HEADER}\n{LINE.replace('3.0000', 'x' * 500)}\n", "not an estimated pose"),
        (f"{HEADER}\n{LINE}\n{LINE}\n{LINE}\n", "has more than 2 rows"),
        (f'{HEADER}\n"{LINE}', "cannot be read"),
    ],
)
def test_a_damaged_table_of_estimates_is_named(run, monkeypatch, text, words):
    """A table that cannot be shown gives one line with the command that makes it again, and no poses."""
    monkeypatch.setattr(run_estimates, "_MAX_ROWS", 2)
    (run / "errors.csv").write_text(text)
    found, (note,) = estimates(run)
    assert found == ()
    assert words in note
    assert note.startswith(str(run / "errors.csv"))
    assert note.endswith("; run spn-model evaluate --run first again")
    assert len(note) < 500


def test_estimates_of_another_map_are_found():
    """Where the labels moved by a centimetre since the evaluation, estimates do not belong to them."""
    data = area()
    coarse, fixes = pictures(data).estimates
    assert fits_labels(data.frames, coarse)
    assert fits_labels(data.frames, fixes)
    poses = replace(data.frames.poses, centers=data.frames.poses.centers + np.array([0, 0, 0.01]))
    moved = replace(data.frames, poses=poses)
    assert not fits_labels(moved, coarse)
    assert not fits_labels(moved, fixes)
    assert not fits_labels(data.frames, replace(coarse, names=np.char.add(coarse.names, "x")))


def test_worst_frames_stand_beside_what_they_were_taken_for():
    """The worst frame comes first, with the training frames nearest to its true and its estimated pose."""
    data = area()
    one = pictures(data).estimates[0]
    training = data.frames.select(data.frames.group == "train")
    far = one.poses.centers.copy()
    far[4] = training.poses.centers[100]
    turned = one.poses.quats_wxyz.copy()
    turned[4] = training.poses.quats_wxyz[100]
    moved = replace(one, poses=type(one.poses)(far, turned))
    found = worst_frames(data.frames, (moved,))
    assert found[0].name == "medium/000004.jpg"
    assert len(found) == 3
    assert found[0].error == 10
    assert found[0].taken_for == training.names[100]
    near = training.poses.centers[training.names.tolist().index(found[0].nearest)]
    truth = data.frames.poses.centers[data.frames.names.tolist().index(found[0].name)]
    assert found[0].distance == pytest.approx(float(np.linalg.norm(near - truth)))
    assert worst_frames(data.frames, pictures(data).estimates[1:]) == ()  # fixes are no networks


def write_images(root: Path, count: int) -> None:
    """Write images of noise, which no encoder makes small."""
    rng = np.random.default_rng(0)
    folder = root / FRAMES / "flight1"
    folder.mkdir(parents=True)
    for k in range(count):
        noise = rng.integers(0, 255, (180, 320, 3)).astype(np.uint8)
        cv2.imwrite(str(folder / f"{k:06d}.jpg"), noise)


def test_thumbnails_keep_to_their_budget_and_are_cached(tmp_path, monkeypatch):
    """Noise gets smaller until it fits; images that did not change are not decoded again."""
    write_images(tmp_path, 6)
    monkeypatch.setattr(thumbnails, "MAX_BYTES", 400_000)
    frames = flight("flight1", 6, radius_m=30, height_m=10)
    first = read_thumbnails(Area(tmp_path), frames)
    assert first.notes == ()
    assert list(first.images) == frames.names.tolist()
    assert all(len(image) <= 4000 for image in first.images.values())
    shapes = {
        cv2.imdecode(np.frombuffer(i, np.uint8), cv2.IMREAD_COLOR).shape
        for i in first.images.values()
    }
    assert all(90 <= width < 320 and height == round(width * 9 / 16) for height, width, _ in shapes)
    assert first.files["flight1/000002.jpg"] == "1-frames/flight1/000002.jpg"
    decoded = []
    usual = thumbnails.decode_reduced
    monkeypatch.setattr(
        thumbnails, "decode_reduced", lambda p, **more: decoded.append(p.name) or usual(p, **more)
    )
    os.utime(tmp_path / FRAMES / "flight1" / "000003.jpg", (1, 1))
    assert read_thumbnails(Area(tmp_path), frames).images == first.images
    assert decoded == ["000003.jpg"]


@pytest.mark.parametrize(
    "cache",
    [
        "{}",
        "no",
        '{"version": 1, "most_bytes": 36000, "images": {"flight1/000000.jpg": [1, 2, "!"]}}',
    ],
)
def test_a_damaged_cache_of_thumbnails_is_made_again(tmp_path, cache):
    """Whatever the cache holds, images come from the files of the area."""
    write_images(tmp_path, 1)
    (tmp_path / THUMBNAILS).write_text(cache)
    frames = flight("flight1", 1, radius_m=30, height_m=10)
    image = read_thumbnails(Area(tmp_path), frames).images["flight1/000000.jpg"]
    assert cv2.imdecode(np.frombuffer(image, np.uint8), cv2.IMREAD_COLOR).shape == (180, 320, 3)


def test_images_that_cannot_be_read_are_counted(tmp_path):
    """Missing and damaged images, and names that lead out of the area, are told; the others are shown."""
    write_images(tmp_path / "area", 4)
    (tmp_path / "area" / FRAMES / "flight1" / "000001.jpg").unlink()
    (tmp_path / "area" / FRAMES / "flight1" / "000002.jpg").write_bytes(b"no image")
    (tmp_path / "out.jpg").write_bytes(
        (tmp_path / "area" / FRAMES / "flight1" / "000000.jpg").read_bytes()
    )
    frames = flight("flight1", 5, radius_m=30, height_m=10)
    names = frames.names.astype("<U80")
    names[3], names[4] = "../../out.jpg", str(tmp_path / "out.jpg")
    found = read_thumbnails(Area(tmp_path / "area"), replace(frames, names=names))
    assert list(found.images) == list(found.files) == ["flight1/000000.jpg"]
    assert found.notes[0].startswith("4 images cannot be shown; the first: ")
    assert "000001.jpg: is missing" in found.notes[0]


def test_where_images_are_too_many_those_that_matter_stay(tmp_path, monkeypatch):
    """Wanted and failed frames keep their images, others are thinned evenly, and the page says so."""
    write_images(tmp_path, 40)
    monkeypatch.setattr(thumbnails, "MAX_IMAGES", 10)
    frames = flight("flight1", 40, radius_m=30, height_m=10, failed=2)
    found = read_thumbnails(Area(tmp_path), frames, ["flight1/000011.jpg"])
    assert len(found.images) == 10
    assert {"flight1/000011.jpg", "flight1/000038.jpg", "flight1/000039.jpg"} <= set(found.images)
    assert found.notes == ("To limit the size of this page, 30 images are not in it.",)


def test_the_page_links_its_sections_and_shows_networks_before_lists():
    """Each entry of the contents leads to a section, in the order of the page."""
    data = area()
    html = render(data, pictures=pictures(data))
    (nav,) = re.findall(r"<nav.*?</nav>", html)
    links = re.findall(r'href="#([\w-]+)"', nav)
    assert links == [
        "map",
        "worst",
        "coverage",
        "residuals",
        "split",
        "time",
        "failed",
        "frames",
        "stages",
    ]
    places = [html.index(f'<section id="{name}"') for name in links]
    assert places == sorted(places)


def test_failed_frames_are_pictures_with_reasons():
    """Frames without a label and without a usable fix are listed with their reasons."""
    data = area()
    html = render(data, pictures=pictures(data))
    (part,) = re.findall(r'<section id="failed">.*?</section>', html)
    assert part.count("<figure") == 3
    assert "<b>medium/000039.jpg</b> failed: ambiguous" in part
    assert "No usable fix: first, search" in part
    assert "<b>medium/000000.jpg</b> too few landmarks agree" in part
    assert "failed" not in re.findall(r'<section id="(\w+)"', render(data))


def test_the_page_is_opened_in_the_browser_of_the_user(tmp_path, monkeypatch, capfd):
    """`--open` hands the file's address to the browser, and says so if there is none."""
    monkeypatch.setattr(webbrowser, "_tryorder", None)  # it reads BROWSER once
    seen = tmp_path / "seen"
    program = tmp_path / "browser"
    program.write_text(f'#!/bin/sh\necho "$1" > {seen}\n')
    program.chmod(0o755)
    monkeypatch.setenv("BROWSER", str(program))
    page.open_in_browser((tmp_path / "a b.html").as_uri())
    assert seen.read_text().strip() == (tmp_path / "a b.html").as_uri()
    assert capfd.readouterr().out == ""
    monkeypatch.setattr(webbrowser, "open", lambda address: False)
    page.open_in_browser((tmp_path / "a b.html").as_uri())
    assert "no browser could be started" in capfd.readouterr().out
