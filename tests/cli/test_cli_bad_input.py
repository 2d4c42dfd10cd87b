"""Bad input is reported in one clear line with exit code 1, and existing files do not change."""

from __future__ import annotations

import errno
import json
import re
import resource
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import click
import cv2
import numpy as np
import pytest
from click.testing import CliRunner, Result
from spn_cli.data import main
from spn_cli.group import Group

from spn_data.area.area import Area
from spn_data.area.names import FRAMES, MODEL
from spn_data.errors import StageError
from spn_data.storage.json_files import VERSION
from tests.worlds.short_flights import frames_of, write_video

FAST = ("--max-features", "800", "--threads", "1", "--fov", "72")


# A line such as "analysis flight1: 1 of 375", which goes to standard error as errors do.
PROGRESS = re.compile(r"[\w ]+: \d+( of \d+)?(, about \d+ \w+ left)?$|^\s*$")


def run(*arguments: object) -> Result:
    """Run spn-data once; exceptions other than SystemExit are raised."""
    result = CliRunner().invoke(main, [str(a) for a in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def refused(*arguments: object) -> str:
    """Return the single error line of a `reconstruct` call that fails."""
    result = run("reconstruct", *arguments)
    assert result.exit_code == 1, result.output
    errors = [line for line in result.stderr.splitlines() if not PROGRESS.match(line)]
    assert len(errors) == 1, result.stderr
    return errors[0].removeprefix("Error: ")


def contents(folder: Path) -> dict[str, bytes]:
    """Return the bytes of all files in a folder by relative path."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.fixture
def copy_of_flight(flight1: Path, tmp_path: Path) -> Path:
    """A folder with a video and its SRT file that a test may damage."""
    return Path(shutil.copytree(flight1, tmp_path / "flight"))


def cut(path: Path) -> None:
    """Truncate a file to half its size."""
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda path: path.unlink(), "contains no video or photo"),
        (cut, "flight1.mp4: is truncated: the index (moov)"),
        (lambda path: path.write_bytes(b""), "flight1.mp4: is empty (0 bytes)"),
        (lambda path: path.write_text("no video\n"), "flight1.mp4: is not a video"),
    ],
    ids=["none", "truncated", "empty", "text"],
)
def test_a_video_that_is_none_is_named(
    copy_of_flight: Path, tmp_path: Path, damage: Callable[[Path], None], message: str
) -> None:
    """A missing, truncated, empty or invalid video is reported by name, and no area is created."""
    damage(copy_of_flight / "flight1.mp4")
    assert message in refused(copy_of_flight, "--area", tmp_path / "area")
    assert not (tmp_path / "area").exists(), "nothing was made, so that nothing stays"


def test_a_folder_that_does_not_exist_is_named(tmp_path: Path) -> None:
    """A source folder that does not exist is reported as such."""
    assert refused(tmp_path / "nowhere", "--area", tmp_path / "area").endswith("does not exist")


def test_telemetry_of_another_length_is_refused_before_the_video_is_measured(
    copy_of_flight: Path, tmp_path: Path
) -> None:
    """Telemetry much shorter than its video is rejected before an area is created."""
    srt = copy_of_flight / "flight1.SRT"
    srt.write_text("\n\n".join(srt.read_text().split("\n\n")[:5]) + "\n\n")
    message = refused(copy_of_flight, "--area", tmp_path / "area")
    assert "flight1.SRT: its telemetry lasts 2 s, but the video lasts 9 s" in message
    assert not (tmp_path / "area").exists()


def test_all_frames_blurred_is_said(flight1: Path, tmp_path: Path) -> None:
    """A video whose frames are all blurred is rejected with that reason."""
    (tmp_path / "v").mkdir()
    blurred = [cv2.GaussianBlur(f, (0, 0), 25) for f in frames_of(flight1 / "flight1.mp4")]
    write_video(tmp_path / "v" / "blurred.mp4", blurred)
    message = refused(tmp_path / "v", "--area", tmp_path / "area")
    assert "blurred.mp4: every frame is blurred, dark or empty" in message


def test_an_area_below_a_file_is_refused(flight1: Path, tmp_path: Path) -> None:
    """An area whose parent is a file is rejected, and the file is kept."""
    (tmp_path / "file").write_text("mine")
    assert "cannot be created: Not a directory" in refused(
        flight1, "--area", tmp_path / "file" / "area"
    )
    assert (tmp_path / "file").read_text() == "mine"


def test_an_area_of_a_newer_version_is_refused_and_left_alone(
    finished_area: Path, flight1: Path, tmp_path: Path
) -> None:
    """An area written by a newer version is rejected even with --overwrite, and not one byte changes."""
    area = Path(shutil.copytree(finished_area, tmp_path / "area"))
    path = area / MODEL / "stage.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "version": VERSION + 1}))
    before = contents(area)
    assert "2-model/stage.json: made by a newer version" in refused(
        flight1, "--area", area, "--overwrite", *FAST
    )
    assert contents(area) == before


@pytest.mark.parametrize(
    ("option", "message"),
    [
        (("--max-features", "900"), "was made with features.max_features = 800, now 900"),
        (("--fov", "80"), "1-frames already exists but was made with fov_deg.* = 72.0, now 80.0"),
        (("--gnss-sigma", "1", "2"), "3-geo already exists but was made with fit.gnss_sigma_m"),
        (("--seed", "3"), "2-model already exists but was made with seed = 0, now 3"),
    ],
)  # fmt: skip
def test_a_changed_option_is_refused_by_name_and_changes_nothing(
    finished_area: Path, flight1: Path, option: tuple[str, ...], message: str
) -> None:
    """A changed option is reported with its old and new value, and the area does not change."""
    before = contents(finished_area)
    found = refused(flight1, "--area", finished_area, *FAST, *option)
    assert message in found
    assert "use --overwrite to redo it" in found
    assert contents(finished_area) == before


@pytest.mark.parametrize(
    "option",
    [
        ("--max-features", "0"),
        ("--max-image-size", "-5"),
        ("--fov", "500"),
        ("--spacing", "nan"),
        ("--gnss-sigma", "nan", "1"),
        ("--correlation-time", "inf"),
        ("--takeoff-alt", "100"),
        ("--mask", "nowhere.png"),
    ],
)
def test_an_option_out_of_bounds_is_a_usage_error(
    flight1: Path, tmp_path: Path, option: tuple[str, ...]
) -> None:
    """An option value out of range is a usage error (exit code 2)."""
    result = run("reconstruct", flight1, "--area", tmp_path / "area", *option)
    assert result.exit_code == 2
    assert option[0] in result.stderr
    assert not (tmp_path / "area").exists()


def mask(path: Path, height: int, width: int, value: int) -> None:
    """Write a mask of one grey value."""
    path.parent.mkdir(exist_ok=True)
    cv2.imwrite(str(path), np.full((height, width), value, np.uint8))


def test_masks_that_do_not_fit_are_refused_before_any_work(flight1: Path, tmp_path: Path) -> None:
    """Missing, wrongly sized and entirely black masks are rejected before an area is created."""
    area = ("--area", tmp_path / "area")
    mask(tmp_path / "other" / "other.png", 180, 320, 255)
    assert "contains no mask: none of flight1.png" in refused(
        flight1, *area, "--mask", tmp_path / "other"
    )
    mask(tmp_path / "tall.png", 320, 180, 255)
    assert "the mask is 180x320 but the images are 320x180" in refused(
        flight1, *area, "--mask", tmp_path / "tall.png"
    )
    mask(tmp_path / "black.png", 180, 320, 0)
    assert "entirely black" in refused(flight1, *area, "--mask", tmp_path / "black.png")
    assert not (tmp_path / "area").exists()


def test_names_are_never_used_as_paths_or_markup(flight1: Path, tmp_path: Path) -> None:
    """Photo names with markup, quotes, control characters or Unicode, or equal but for case, are safe."""
    names = [
        "a.jpg",
        "A.jpg",
        "-x.jpg",
        'it\'s "q".jpg',
        "ünï 写真.jpg",
        "[b]x.jpg",
        ":smile:.jpg",
    ]
    photos = tmp_path / "[red]"
    photos.mkdir()
    for name, image in zip(names, frames_of(flight1 / "flight1.mp4"), strict=False):
        (photos / name).write_bytes(cv2.imencode(".jpg", image)[1].tobytes())
    (photos / "bad\n\x1b[31m.jpg").write_bytes(b"x")
    (photos / "cut.jpg").write_bytes((photos / "a.jpg").read_bytes()[:9000])
    (photos / "empty.png").write_bytes(b"")
    result = run("reconstruct", photos, "--area", tmp_path / "area", *FAST)
    assert "control characters" in result.output
    assert "\x1b[31m" not in result.output
    rows = (tmp_path / "area" / FRAMES / "frames.csv").read_text()
    assert rows.count(",chosen,") == len(names)
    assert rows.count(",unreadable,") == 2
    made = sorted(p.name.lower() for p in (tmp_path / "area" / FRAMES / "red").iterdir())
    assert len(set(made)) == len(names), "no two frames differ by case alone"


def test_only_one_process_works_on_an_area(flight1: Path, finished_area: Path) -> None:
    """A second process is refused while an area is locked."""
    with Area(finished_area).locked():
        assert "in use by another spn-data" in refused(flight1, "--area", finished_area, *FAST)


def test_a_damaged_database_is_named(flight1: Path, finished_area: Path, tmp_path: Path) -> None:
    """A corrupt database of unfinished matching is reported; once it is deleted, the run succeeds."""
    area = Path(shutil.copytree(finished_area, tmp_path / "area"))
    shutil.rmtree(area / "3-geo")
    partial = Area(area).partial(MODEL)
    (area / MODEL).rename(partial)
    (partial / "stage.json").rename(partial / "started.json")
    (partial / "database.db").write_bytes(b"no database" * 1000)
    message = refused(flight1, "--area", area, *FAST)
    assert "database.db: not a COLMAP database, or damaged; delete it" in message
    (partial / "database.db").unlink()
    assert run("reconstruct", flight1, "--area", area, *FAST).exit_code == 0


def limited(bytes_a_file: int) -> Callable[[], None]:
    """Return a function that limits the size of files written by a child process."""
    return lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (bytes_a_file, bytes_a_file))


def test_frames_that_cannot_be_written_are_one_line(flight1: Path, tmp_path: Path) -> None:
    """A failed write of a frame is one error line; a file size limit simulates the failing disk."""
    command = [sys.executable, "-c", "from spn_cli.data import main; main()", "reconstruct"]
    arguments = [str(flight1), "--area", str(tmp_path / "area"), *FAST]
    result = subprocess.run(
        [*command, *arguments],
        preexec_fn=limited(10_000),
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert result.returncode == 1
    assert "Traceback" not in result.stderr
    told = [line for line in result.stderr.splitlines() if not PROGRESS.match(line)]
    assert len(told) == 1
    assert "File too large" in told[0]


def test_garbage_lines_are_passed_over_and_no_fix_at_all_leaves_the_model_without_metres(
    copy_of_flight: Path, tmp_path: Path
) -> None:
    """Malformed SRT records are skipped and counted; without any GNSS fix the model is not georeferenced."""
    srt = copy_of_flight / "flight1.SRT"
    records = srt.read_text().split("\n\n")
    records[3] = "4\ngarbage here"
    records[5] = "zzz"
    text = re.sub(r"(latitude|longitude): [-\d.]+", r"\1: 0.000000", "\n\n".join(records))
    srt.write_text(text)
    result = run("reconstruct", copy_of_flight, "--area", tmp_path / "area", *FAST)
    assert result.exit_code == 0, result.output
    told = " ".join(result.stdout.split())
    assert "records left out: 1, the first at line 19" in told
    assert "0 of 16 records with a fix" in told
    assert "in model units, not metres" in told
    assert not Area(tmp_path / "area").has("3-geo")


def test_a_copy_that_fills_the_disk_names_the_file_that_was_not_written() -> None:
    """The error of a copy that fills the disk names the target file, not the source."""

    @click.group(cls=Group)
    def program() -> None:
        pass

    @program.command()
    def copy() -> None:
        raise OSError(errno.ENOSPC, "No space left on device", "from.jpg", None, "to.jpg")

    result = CliRunner().invoke(program, ["copy"])
    assert result.exit_code == 1
    assert "to.jpg: No space left on device. Completed work is kept" in result.stderr


def test_a_disk_that_may_not_be_written_to_is_not_said_to_be_full() -> None:
    """The error for a read-only file system does not advise freeing space."""

    @click.group(cls=Group)
    def program() -> None:
        pass

    @program.command()
    def write() -> None:
        raise StageError("area cannot be written to") from OSError(errno.EROFS, "read-only")

    result = CliRunner().invoke(program, ["write"])
    assert result.exit_code == 1
    assert "area cannot be written to" in result.stderr
    assert "free some space" not in result.stderr
