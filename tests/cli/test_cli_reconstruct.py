"""`spn-data reconstruct` and `status` on a short simulated flight: create, rerun, extend, resume."""

from __future__ import annotations

import importlib.util
import shutil
import sqlite3
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result
from spn_cli.data import main

import spn_data.reconstruction.best_attempt
from spn_data.area.area import Area
from spn_data.area.names import FRAMES, GEO, MODEL
from spn_data.capture.frames import read_frames
from spn_data.colmap.model import load_native, read_scene, write_native
from spn_data.reconstruction.contradiction import Contradiction, FocalChange
from spn_data.storage.json_files import read_json

FAST = ("--max-features", "800", "--threads", "1", "--fov", "72")


def run(*arguments: object) -> Result:
    """Run spn-data once; exceptions other than SystemExit are raised."""
    result = CliRunner().invoke(main, [str(a) for a in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def contents(folder: Path) -> dict[str, bytes]:
    """Return the bytes of all files in a folder by relative path."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def _interruption() -> ModuleType:
    """Import benchmarks/interruption.py."""
    path = Path(__file__).resolve().parents[2] / "benchmarks" / "interruption.py"
    spec = importlib.util.spec_from_file_location("interruption_for_add", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def area(finished_area: Path, tmp_path: Path) -> Path:
    """A copy of the finished area that a test may change."""
    return Path(shutil.copytree(finished_area, tmp_path / "area"))


def test_run_again_unchanged_says_so_and_changes_no_byte(
    finished_area: Path, flight1: Path
) -> None:
    """An unchanged rerun reports each stage as unchanged and modifies no file."""
    before = contents(finished_area)
    result = run("reconstruct", flight1, "--area", finished_area, *FAST)
    assert result.exit_code == 0
    for stage in (FRAMES, MODEL, GEO):
        assert f"{stage}: unchanged since" in result.stdout
    assert contents(finished_area) == before


def test_more_threads_are_no_change(finished_area: Path, flight1: Path) -> None:
    """A different number of threads does not count as a changed option."""
    result = run("reconstruct", flight1, "--area", finished_area, *FAST, "--threads", "2")
    assert result.exit_code == 0
    assert "2-model: unchanged" in result.stdout


def test_an_area_in_the_folder_of_its_own_videos_is_no_input(flight1: Path, tmp_path: Path) -> None:
    """An area in the folder of its videos is not read as input (`spn-data reconstruct .` twice)."""
    here = Path(shutil.copytree(flight1, tmp_path / "here"))
    assert run("reconstruct", here, "--area", here, *FAST).exit_code == 0
    again = run("reconstruct", here, "--area", here, *FAST)
    assert again.exit_code == 0, again.output
    assert "1-frames: unchanged" in again.stdout


def test_a_refused_georegistration_leaves_the_model_and_nothing_unfinished(
    area: Path, flight1: Path
) -> None:
    """Fixes with 1 km sigma cannot georegister the model; a retry with another sigma needs no --overwrite."""
    shutil.rmtree(area / GEO)
    wild = ("--gnss-sigma", "1000", "1000", "--ignore-gimbal")
    result = run("reconstruct", flight1, "--area", area, *FAST, *wild)
    assert result.exit_code == 1
    assert "2-model is complete, but it cannot be georegistered" in result.stderr
    assert not Area(area).partial(GEO).exists()
    assert Area(area).facts.sources == (str(flight1),)
    assert run("reconstruct", flight1, "--area", area, *FAST).exit_code == 0


def rows(database: Path, sql: str) -> list[tuple[object, ...]]:
    """Query an SQLite database."""
    with sqlite3.connect(database) as connection:
        found = connection.execute(sql).fetchall()
    connection.close()
    return found


def test_add_extends_an_area_and_keeps_what_it_had(
    area: Path, finished_area: Path, flight2: Path
) -> None:
    """With --add, features, matches, origin and frame names are kept, and only new frames are processed."""
    result = run("reconstruct", flight2, "--area", area, "--add", *FAST)
    assert result.exit_code == 0, result.output
    old, new = Area(finished_area), Area(area)
    names = read_frames(new.folder(FRAMES) / "frames.csv")
    before = read_frames(old.folder(FRAMES) / "frames.csv")
    assert names.names[: len(before)].tolist() == before.names.tolist()
    assert set(names.sequences.tolist()) == {"flight1", "flight2"}
    first_told = next(s for s in result.stderr.splitlines() if s.startswith("features: "))
    kept = int(before.chosen.sum())
    assert int(first_told.split()[1]) == kept + 1, "only frames of the new flight are worked on"
    databases = [one.folder(MODEL) / "database.db" for one in (old, new)]
    for sql in (
        f"SELECT image_id, data FROM descriptors WHERE image_id <= {kept}",
        "SELECT image_id, name FROM images WHERE name LIKE 'flight1/%'",
    ):
        assert rows(databases[0], sql) == rows(databases[1], sql)
    pairs = "SELECT pair_id, data FROM two_view_geometries"
    assert set(rows(databases[0], pairs)) <= set(rows(databases[1], pairs))
    geo = [read_json(one.folder(GEO) / "geo.json")["origin"] for one in (old, new)]
    assert geo[0] == geo[1]
    registered = read_scene(new.folder(GEO)).names
    assert {name.split("/")[0] for name in registered} == {"flight1", "flight2"}
    assert new.facts.sources == (*old.facts.sources, str(flight2))
    assert not (area / ".next").exists()
    again = run("reconstruct", flight2, "--area", area, "--add", *FAST)
    assert again.exit_code == 0
    assert again.stdout.count("unchanged") == 3


@pytest.mark.slow
def test_a_sequence_of_a_name_that_exists_gets_another(
    area: Path, flight2: Path, tmp_path: Path
) -> None:
    """An added video with the name of an existing sequence becomes a new sequence with a suffix."""
    more = tmp_path / "more"
    more.mkdir()
    for path in flight2.iterdir():
        shutil.copy(path, more / path.name.replace("flight2", "flight1"))
    result = run("reconstruct", more, "--area", area, "--add", *FAST)
    assert result.exit_code == 0, result.output
    sequences = read_frames(area / FRAMES / "frames.csv").sequences.tolist()
    assert list(dict.fromkeys(sequences)) == ["flight1", "flight1-2"]


@pytest.mark.slow
def test_adding_with_other_options_says_that_features_are_made_anew(
    area: Path, flight2: Path
) -> None:
    """Adding with changed feature options recomputes features and matches, and the output says so."""
    result = run("reconstruct", flight2, "--area", area, "--add", *FAST, "--max-features", "700")
    assert result.exit_code == 0, result.output
    told = " ".join(result.stdout.split())
    assert (
        "features and matches are recomputed: those of the area were computed with max_features = 800"
        in told
    )


@pytest.mark.slow
def test_a_kill_while_adding_leaves_the_old_area_whole(area: Path, flight2: Path) -> None:
    """After a kill during --add the old area is unchanged, status shows the addition, a rerun finishes."""
    interruption = _interruption()
    before = contents(area)
    options = ["--add", "--max-features", "800", "--fov", "72"]
    killed = interruption.Run([flight2], area, options)
    killed.wait_for("matching")
    assert killed.kill() == 0
    now = {k: v for k, v in contents(area).items() if not k.startswith(".next/")}
    assert now == before
    shown = run("status", "--area", area)
    assert shown.stdout.count(" complete ") == 3
    assert "an addition is unfinished" in shown.stdout
    resumed = interruption.Run([flight2], area, options)
    resumed.finish()
    assert "features:" not in resumed.output
    sequences = set(read_frames(area / FRAMES / "frames.csv").sequences.tolist())
    assert sequences == {"flight1", "flight2"}


def test_status_of_no_area_is_an_error(tmp_path: Path) -> None:
    """`status` of a missing area is an error and creates nothing."""
    result = run("status", "--area", tmp_path / "none")
    assert result.exit_code == 1
    assert "none is not an area; create one with spn-data reconstruct VIDEO --area" in result.stderr
    assert not (tmp_path / "none").exists()


def test_status_shows_what_is_complete_unfinished_missing_and_stale(area: Path) -> None:
    """`status` distinguishes complete, unfinished, missing and stale stages."""
    complete = run("status", "--area", area).stdout
    assert complete.count(" complete ") == 3
    counts = Area(area).record(MODEL).counts
    assert f"{counts['registered']} of {counts['frames']} frames" in complete
    (area / GEO).rename(area / f".{GEO}.partial")
    partial = run("status", "--area", area).stdout
    assert "unfinished" in partial
    assert "in model units, not metres" in " ".join(partial.split())
    (area / f".{GEO}.partial").rename(area / GEO)
    stage = area / FRAMES / "stage.json"
    stage.write_text(stage.read_text().replace('"candidates": 18', '"candidates": 19'))
    stale = run("status", "--area", area)
    assert stale.exit_code == 0
    assert stale.stdout.count("stale: 1-frames") == 2


def test_a_focal_length_far_from_what_was_given_is_told(flight1: Path, tmp_path: Path) -> None:
    """A 72-degree lens given as 60 degrees is estimated as about 72, with a note on the difference."""
    options = ("--max-features", "800", "--threads", "1", "--fov", "60")
    result = run("reconstruct", flight1, "--area", tmp_path / "area", *options)
    assert result.exit_code == 0, result.output
    record = Area(tmp_path / "area").record(MODEL)
    assert 66 < record.counts["cameras"]["flight1"]["fov_deg"] < 78
    assert any(
        note.startswith("camera flight1: focal length 2")
        and note.endswith("60 deg, as given is outvoted")
        for note in record.notes
    )


def test_no_surprise_is_told_of_a_focal_length_that_was_given_rightly(finished_area: Path) -> None:
    """Of a correct initial focal length one note says that all witnesses agree."""
    notes = [note for note in Area(finished_area).record(MODEL).notes if "focal length" in note]
    assert len(notes) == 1
    assert notes[0].endswith("they agree")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("judge", "wrong", "words", "retried"),
    [
        (
            "contradictions",
            Contradiction(("flight1/000001.jpg", "flight1/000002.jpg"), 500, 0.02),
            "parts of the model are inconsistent: flight1/000001.jpg and flight1/000002.jpg share 500 "
            "matches, but its poses explain only 2% of them",
            ["look-alikes", "steady", "more features"],
        ),
        (
            "focal_changes",
            FocalChange("flight1", 220.0, 767.8),
            "the focal lengths drifted: flight1 from 220 to 768 px",
            ["steady", "more features"],
        ),
    ],
)
@pytest.mark.parametrize("stays", [False, True])
def test_a_model_that_is_contradicted_is_made_again(
    flight1: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    judge: str,
    wrong: object,
    words: str,
    retried: list[str],
    stays: bool,
) -> None:
    """A model judged wrong is reconstructed again, until it is accepted or all attempts fail, with notes."""
    expected = retried if stays else retried[:1]
    answers = [[wrong], *([[wrong]] * len(retried) if stays else [[]])]
    monkeypatch.setattr(spn_data.reconstruction.best_attempt, judge, lambda *_: answers.pop(0))
    result = run("reconstruct", flight1, "--area", tmp_path / "area", *FAST)
    assert result.exit_code == 0, result.output
    assert answers == []
    notes = Area(tmp_path / "area").record(MODEL).notes
    assert Area(tmp_path / "area").record(MODEL).counts["contradicted"] == (
        stays and judge == "contradictions"
    )
    assert notes.count(words) == (1 + len(retried) if stays else 1)
    made = [note.split(" attempt")[0] for note in notes if " attempt" in note]
    assert made == ["first", *expected]


_MISPLACED = "flight1/000008.jpg"


@pytest.fixture
def misplaced(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Deregister one frame of the first model as misplaced; the list collects the real judgements."""
    judged: list[list[str]] = []
    drop: Callable[..., list[str]] = spn_data.reconstruction.best_attempt.drop_misplaced

    def drop_one(source: Path, target: Path, matches: dict[tuple[str, str], int]) -> list[str]:
        judged.append(drop(source, target, matches))
        if any(part.endswith("-again") for part in source.parts):
            return judged[-1]
        model = load_native(source)
        frame_id = next(i.frame_id for i in model.images.values() if i.name == _MISPLACED)
        model.deregister_frame(frame_id)
        write_native(model, target)
        return [_MISPLACED]

    monkeypatch.setattr(spn_data.reconstruction.best_attempt, "drop_misplaced", drop_one)
    return judged


@pytest.mark.slow
def test_a_frame_that_lies_wrongly_is_taken_out_and_finds_its_place(
    flight1: Path, tmp_path: Path, misplaced: list[list[str]]
) -> None:
    """A frame removed as misplaced is registered again in the final model."""
    result = run("reconstruct", flight1, "--area", tmp_path / "area", *FAST)
    assert result.exit_code == 0, result.output
    assert misplaced == [[], []]
    area = Area(tmp_path / "area")
    assert any(_MISPLACED in n and "removed again" in n for n in area.record(MODEL).notes)
    assert _MISPLACED in read_scene(area.folder(MODEL)).names


@pytest.mark.slow
@pytest.mark.usefixtures("misplaced")
def test_a_run_that_is_stopped_before_its_second_chance_maps_comes_to_the_same_poses(
    flight1: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run stopped when the database has more matches than the first model used ends with the same poses."""
    match = spn_data.reconstruction.best_attempt.match_missing
    matched = []

    def match_and_stop(*arguments: Any) -> None:
        match(*arguments)
        matched.append(arguments)
        if len(matched) == 2:
            raise KeyboardInterrupt

    whole, area = Area(tmp_path / "whole"), Area(tmp_path / "area")
    assert run("reconstruct", flight1, "--area", whole.root, *FAST).exit_code == 0
    monkeypatch.setattr(spn_data.reconstruction.best_attempt, "match_missing", match_and_stop)
    assert run("reconstruct", flight1, "--area", area.root, *FAST).exit_code == 130
    result = run("reconstruct", flight1, "--area", area.root, *FAST)
    assert result.exit_code == 0, result.output
    one, other = (read_scene(a.folder(MODEL)) for a in (whole, area))
    assert one.names == other.names
    np.testing.assert_allclose(one.poses.centers, other.poses.centers, rtol=0, atol=1e-9)
    assert area.record(MODEL).notes == whole.record(MODEL).notes
