"""Tests of input discovery: sequences, parts of one flight, their telemetry, and ignored files."""

from __future__ import annotations

import os
import re
from datetime import datetime, timedelta
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from spn_data.capture.sources import Source, SourceKind, discover, safe_name
from spn_data.errors import InputError


def touch(folder: Path, *names: str) -> None:
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"content is not looked at")


def names_of(source: Source) -> list[str]:
    return [p.name for p in source.parts]


def write_clip(path: Path, created: datetime | None, *, seconds: int = 20, width: int = 32) -> None:
    """Write a flat video at one frame per second with a creation time."""
    with av.open(str(path), "w") as container:
        if created is not None:
            container.metadata["creation_time"] = created.isoformat() + "Z"
        stream = container.add_stream("libx264", rate=1)
        stream.width, stream.height, stream.pix_fmt = width, 32, "yuv420p"
        for i in range(seconds):
            image = np.full((32, width, 3), 10 * i, np.uint8)
            frame = av.VideoFrame.from_ndarray(image, format="bgr24")
            frame.pts = i
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def test_an_sd_card_is_sorted_into_sequences(tmp_path: Path) -> None:
    """Videos are matched with telemetry, photos are grouped by folder, and ignored files are listed."""
    touch(
        tmp_path,
        *("DCIM/100MEDIA/DJI_0001.MP4", "DCIM/100MEDIA/DJI_0001.SRT", "DCIM/100MEDIA/DJI_0001.LRF"),
        *("DCIM/100MEDIA/DJI_0004.MOV", "DCIM/100MEDIA/dji_0004.gpx", "DCIM/100MEDIA/DJI_0009.SRT"),
        *(
            "DCIM/100MEDIA/DJI_0002.JPG",
            "DCIM/100MEDIA/DJI_0003.JPG",
            "DCIM/100MEDIA/._DJI_0001.MP4",
        ),
        *("DCIM/101MEDIA/DJI_0001.MP4", "MISC/notes.txt", "MISC/GOPR0001.THM", "MISC/GX010001.LRV"),
        *(".Trashes/a.mp4", ".DS_Store", "survey/b.png", "survey/a.tif", "survey/log.csv"),
    )
    found = discover(tmp_path)
    summary = [
        (s.sequence, str(s.kind), names_of(s), [t.name for t in s.telemetry]) for s in found.sources
    ]
    assert summary == [
        ("DJI_0001", "video", ["DJI_0001.MP4"], ["DJI_0001.SRT"]),
        ("DJI_0004", "video", ["DJI_0004.MOV"], ["dji_0004.gpx"]),
        ("101MEDIA-DJI_0001", "video", ["DJI_0001.MP4"], []),
        ("100MEDIA", "photos", ["DJI_0002.JPG", "DJI_0003.JPG"], []),
        ("survey", "photos", ["a.tif", "b.png"], ["log.csv"]),
    ]
    assert {str(p): why for p, why in found.ignored} == {
        ".DS_Store": "hidden",
        ".Trashes": "hidden",
        "DCIM/100MEDIA/._DJI_0001.MP4": "macOS metadata",
        "DCIM/100MEDIA/DJI_0001.LRF": "preview or thumbnail made by the camera",
        "DCIM/100MEDIA/DJI_0009.SRT": "telemetry without a video or photo folder of the same name",
        "MISC/GOPR0001.THM": "preview or thumbnail made by the camera",
        "MISC/GX010001.LRV": "preview or thumbnail made by the camera",
        "MISC/notes.txt": "not a video, photo or telemetry file",
    }


def test_a_single_video_is_a_folder_of_one(tmp_path: Path) -> None:
    """A path to one video gives that video and its telemetry, but no other file of the folder."""
    touch(tmp_path, "a.mp4", "a.srt", "A.CSV", "b.mp4", "b.srt")
    [source] = discover(tmp_path / "a.mp4").sources
    assert (source.sequence, names_of(source)) == ("a", ["a.mp4"])
    assert [t.name for t in source.telemetry] == ["A.CSV", "a.srt"]


def test_gopro_chapters_are_one_sequence(tmp_path: Path) -> None:
    """GoPro chapters of one recording (GX, GH or GOPR names) are joined; a missing chapter splits them."""
    touch(
        tmp_path,
        *("GX010042.MP4", "GX020042.MP4", "GX030042.MP4", "GX010043.MP4", "GX030043.MP4"),
        *("GOPR0007.MP4", "GP010007.MP4", "GH010042.MP4"),
    )
    assert [names_of(s) for s in discover(tmp_path).sources] == [
        ["GH010042.MP4"],
        ["GOPR0007.MP4", "GP010007.MP4"],
        ["GX010042.MP4", "GX020042.MP4", "GX030042.MP4"],
        ["GX010043.MP4"],
        ["GX030043.MP4"],
    ]


START = datetime(2024, 5, 1, 10, 0, 0)


@pytest.mark.parametrize(
    ("later_s", "width", "second", "joined"),
    [
        (20, 32, "DJI_0002.MP4", True),  # begins when the first ends
        (23, 32, "DJI_0002.MP4", True),  # the clock has whole seconds
        (0, 32, "DJI_0002.MP4", True),  # all parts carry the start time of the recording
        (60, 32, "DJI_0002.MP4", False),  # another flight, later
        (20, 48, "DJI_0002.MP4", False),  # another size
        (20, 32, "DJI_0003.MP4", False),  # a number is missing
        (20, 32, "DJI_0002_T.MP4", False),  # from the thermal camera
        (None, 32, "DJI_0002.MP4", False),  # no creation time to compare
    ],
)
def test_dji_parts_are_joined_where_all_speaks_for_it(
    tmp_path: Path, later_s: int | None, width: int, second: str, joined: bool
) -> None:
    """DJI parts are joined only if number, file size, image size and creation time all agree."""
    write_clip(tmp_path / "DJI_0001.MP4", START)
    later = None if later_s is None else START + timedelta(seconds=later_s)
    write_clip(tmp_path / second, later, width=width)
    found = discover(tmp_path, min_split_bytes=100).sources
    assert len(found) == (1 if joined else 2)
    # Files far below the split size were not split by the camera, so they are not even decoded.
    assert len(discover(tmp_path).sources) == 2


def test_new_dji_names_with_a_time_are_joined(tmp_path: Path) -> None:
    """DJI_20240501100000_0001_D names are joined, with the telemetry of both parts in order."""
    write_clip(tmp_path / "DJI_20240501100000_0001_D.MP4", START)
    write_clip(tmp_path / "DJI_20240501100020_0002_D.MP4", START + timedelta(seconds=20))
    touch(tmp_path, "DJI_20240501100020_0002_D.SRT", "DJI_20240501100000_0001_D.SRT")
    [source] = discover(tmp_path, min_split_bytes=100).sources
    assert [t.stem for t in source.telemetry] == [p.stem for p in source.parts]
    assert source.sequence == "DJI_20240501100000_0001_D"


def test_links_are_followed(tmp_path: Path) -> None:
    """Linked files and folders keep the names of their links, as in a git-annex data set."""
    touch(tmp_path, "store/f3a9.mp4", "store/77c1.SRT", "other/b.mp4")
    (tmp_path / "video").mkdir()
    (tmp_path / "video" / "a.mp4").symlink_to("../store/f3a9.mp4")
    (tmp_path / "video" / "a.SRT").symlink_to("../store/77c1.SRT")
    (tmp_path / "video" / "more").symlink_to(tmp_path / "other")
    found = discover(tmp_path / "video")
    assert [s.sequence for s in found.sources] == ["a", "b"]
    assert [t.name for t in found.sources[0].telemetry] == ["a.SRT"]
    assert found.ignored == ()


def test_links_are_read_once_and_loops_end(tmp_path: Path) -> None:
    """Duplicate, looping and broken links are listed as ignored; nothing is counted twice."""
    touch(tmp_path, "a.mp4", "inner/b.mp4")
    (tmp_path / "again.mp4").symlink_to("a.mp4")
    (tmp_path / "gone.mp4").symlink_to("nowhere.mp4")
    (tmp_path / "inner" / "loop").symlink_to(tmp_path)
    (tmp_path / "twice").symlink_to("inner")
    found = discover(tmp_path)
    assert [s.sequence for s in found.sources] == ["a", "b"]
    assert dict((str(p), why) for p, why in found.ignored) == {
        "again.mp4": "link to a file that is read already",
        "gone.mp4": "broken link: what it points to does not exist here",
        "inner/loop": "link to a folder that is read already",
        "twice": "link to a folder that is read already",
    }


def test_special_files_are_not_opened(tmp_path: Path) -> None:
    """A named pipe ending in .mp4 is ignored because reading it would block."""
    touch(tmp_path, "a.mp4")
    os.mkfifo(tmp_path / "b.mp4")
    found = discover(tmp_path)
    assert [s.sequence for s in found.sources] == ["a"]
    assert found.ignored == ((Path("b.mp4"), "not a regular file"),)


def test_names_of_sequences_are_safe_and_unique(tmp_path: Path) -> None:
    """Any file name gives a valid folder name that is unique on case-insensitive file systems."""
    touch(tmp_path, "Flug über Köln.mp4", "полёт.mp4", "a/x.mp4", "b/x.mp4", "c/X.mp4", "..x.mp4")
    names = [s.sequence for s in discover(tmp_path).sources]
    assert names == ["Flug-uber-Koln", "x", "b-x", "c-X", "sequence"]
    assert len({n.lower() for n in names}) == len(names)
    assert safe_name("../../etc/passwd") == "etc-passwd"
    assert safe_name("...") == "sequence"
    assert re.fullmatch(r"[A-Za-z0-9._-]{1,80}", safe_name("ä/" * 300))


def test_a_folder_without_input_is_refused_in_one_line(tmp_path: Path) -> None:
    """Missing, empty and unusable inputs are refused with a one-line reason."""
    touch(tmp_path, "other/readme.txt", "other/flight.srt", "linked/notes.txt")
    (tmp_path / "empty").mkdir()
    (tmp_path / "linked" / "a.mp4").symlink_to("nowhere.mp4")
    expected = {
        "missing": "does not exist",
        "empty": "contains no video or photo; the folder is empty",
        "other": "contains no video or photo; 2 other files",
        "linked": "contains no video or photo; 2 other files, 1 of them broken links",
        "other/readme.txt": "is not a video or photo: unsupported suffix .txt",
    }
    for name, message in expected.items():
        with pytest.raises(InputError) as caught:
            discover(tmp_path / name)
        assert str(caught.value) == f"{tmp_path / name}: {message}"


def test_the_real_data_is_found(shared_data: Path) -> None:
    """The real data gives three videos, and 172 photos in one sequence ordered by name."""
    assert [s.sequence for s in discover(shared_data / "video").sources] == [
        "gopro-karma",
        "sample-5s",
        "sample-5s_h265",
    ]
    [photos] = discover(shared_data / "photos-two-passes").sources
    assert (photos.kind, len(photos.parts)) == (SourceKind.PHOTOS, 172)
    assert names_of(photos) == sorted(names_of(photos))


def test_photos_are_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    """Photos without times are sorted by number (1, 2, ..., 10), with a copy after its original."""
    for name in ("frame10.png", "frame2.png", "frame1 (1).png", "frame1.png"):
        Image.new("L", (8, 8)).save(tmp_path / name)
    (source,) = discover(tmp_path).sources
    assert names_of(source) == ["frame1.png", "frame1 (1).png", "frame2.png", "frame10.png"]


def test_photos_are_in_the_order_of_their_times(tmp_path: Path) -> None:
    """EXIF times take precedence over names, because camera counters wrap around."""
    for second, name in enumerate(("DJI_0999.jpg", "DJI_0001.jpg", "DJI_0002.jpg")):
        exif = Image.Exif()
        exif[306] = f"2026:05:01 12:00:0{second}"
        Image.new("L", (8, 8)).save(tmp_path / name, exif=exif)
    (tmp_path / "DJI_0003.jpg").write_bytes(b"no photo")
    (source,) = discover(tmp_path).sources
    assert names_of(source) == ["DJI_0999.jpg", "DJI_0001.jpg", "DJI_0002.jpg", "DJI_0003.jpg"]
