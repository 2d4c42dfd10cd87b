"""Tests that stages of an area appear atomically and that no user data is lost."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from spn_data.area.area import Area, StageWork
from spn_data.area.facts import Facts
from spn_data.area.names import FRAMES, GEO, MODEL
from spn_data.errors import FormatError, StageError
from spn_data.storage.fingerprints import content_fingerprint
from spn_data.storage.json_files import VERSION
from spn_data.storage.stage_record import StageRecord


def make(
    area: Area, stage: str, content: str, *, overwrite: bool = False, **options: int
) -> StageRecord:
    work = area.begin(stage, options, {}, overwrite=overwrite)
    assert isinstance(work, StageWork)
    (work.path / "content").write_text(content)
    return work.finish(counts={"content": content}, seconds={"all": 1.0}, cpu_seconds={})


def content(area: Area, stage: str) -> str:
    return (area.folder(stage) / "content").read_text()


def test_a_stage_appears_only_when_it_is_finished(tmp_path: Path) -> None:
    """A stage folder appears only after `finish`, which also removes the partial folder."""
    area = Area(tmp_path)
    work = area.begin(FRAMES, {"n": 1}, {}, overwrite=False)
    assert isinstance(work, StageWork)
    assert not area.has(FRAMES)
    work.finish(counts={}, seconds={}, cpu_seconds={})
    assert area.has(FRAMES)
    assert not area.partial(FRAMES).exists()


def test_interrupted_work_made_of_the_same_goes_on(tmp_path: Path) -> None:
    """Work interrupted with the same options and inputs is resumed with its files."""
    work = Area(tmp_path).begin(FRAMES, {"n": 1}, {"a": "1"}, overwrite=False)
    assert isinstance(work, StageWork)
    assert not work.resumed
    (work.path / "half").write_text("done")
    again = Area(tmp_path).begin(FRAMES, {"n": 1}, {"a": "1"}, overwrite=False)
    assert isinstance(again, StageWork)
    assert again.resumed
    assert (again.path / "half").read_text() == "done"


def test_interrupted_work_of_other_options_is_not_thrown_away(tmp_path: Path) -> None:
    """Partial work made with other options is discarded only with overwrite."""
    area = Area(tmp_path)
    begun = area.begin(FRAMES, {"n": 1}, {}, overwrite=False)
    assert isinstance(begun, StageWork)
    (begun.path / "half").write_text("done")
    with pytest.raises(StageError, match=r"unfinished work that was made with n = 1, now 2"):
        area.begin(FRAMES, {"n": 2}, {}, overwrite=False)
    work = area.begin(FRAMES, {"n": 2}, {}, overwrite=True)
    assert isinstance(work, StageWork)
    assert not work.resumed


def test_an_unchanged_stage_is_not_made_again(tmp_path: Path) -> None:
    """Beginning a finished stage with the same options returns its existing record."""
    area = Area(tmp_path)
    made = make(area, FRAMES, "first", n=1)
    assert area.begin(FRAMES, {"n": 1}, {}, overwrite=False) == made


def test_a_finished_stage_is_overwritten_only_on_demand(tmp_path: Path) -> None:
    """A finished stage made with other options is replaced only with overwrite."""
    area = Area(tmp_path)
    make(area, FRAMES, "first", n=1)
    with pytest.raises(StageError, match="n = 1, now 2; use --overwrite"):
        area.begin(FRAMES, {"n": 2}, {}, overwrite=False)
    assert content(area, FRAMES) == "first"
    make(area, FRAMES, "second", n=2, overwrite=True)
    assert content(area, FRAMES) == "second"


def test_changed_input_is_named(tmp_path: Path) -> None:
    """The error names the input file that was changed or added."""
    area = Area(tmp_path)
    work = area.begin(FRAMES, {}, {"a.mp4": "1", "b.mp4": "2"}, overwrite=False)
    assert isinstance(work, StageWork)
    work.finish(counts={}, seconds={}, cpu_seconds={})
    with pytest.raises(StageError, match=r"used a different b\.mp4"):
        area.begin(FRAMES, {}, {"a.mp4": "1", "b.mp4": "3"}, overwrite=False)
    with pytest.raises(StageError, match=r"does not include c\.mp4"):
        area.begin(FRAMES, {}, {"a.mp4": "1", "b.mp4": "2", "c.mp4": "3"}, overwrite=False)


def test_a_stage_made_from_an_earlier_one_is_stale(tmp_path: Path) -> None:
    """Redoing a stage makes the stages that depend on it stale."""
    area = Area(tmp_path)
    make(area, FRAMES, "frames")
    make(area, MODEL, "model")
    assert area.stale_because(MODEL) is None
    make(area, FRAMES, "other frames", overwrite=True, n=2)
    assert area.stale_because(MODEL) == "1-frames was redone since"
    with pytest.raises(StageError, match="2-model is stale: 1-frames was redone"):
        area.begin(GEO, {}, {}, overwrite=True)


def test_a_kill_between_the_two_renames_loses_neither_version(tmp_path: Path) -> None:
    """The old version is restored after a kill between the two renames of a replacement."""
    area = Area(tmp_path)
    make(area, FRAMES, "first")
    area.folder(FRAMES).rename(tmp_path / f".old-{FRAMES}")
    assert content(Area(tmp_path), FRAMES) == "first"


@pytest.mark.parametrize("killed_after", range(5))
def test_a_finished_stage_is_the_same_after_a_kill_at_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, killed_after: int
) -> None:
    """Killed at any removal or renaming of files, a replaced stage gets the files that it gets otherwise."""
    area = Area(tmp_path)
    make(area, FRAMES, "first", n=1)
    whole = {path.name for path in area.folder(FRAMES).iterdir()}
    left = [killed_after]

    def killed(change: Callable[..., Any]) -> Callable[..., Any]:
        def changed(*given: Any, **options: Any) -> Any:
            left[0] -= 1
            if left[0] < 0:
                raise KeyboardInterrupt
            return change(*given, **options)

        return changed

    with monkeypatch.context() as patch, suppress(KeyboardInterrupt):
        work = area.begin(FRAMES, {"n": 2}, {}, overwrite=True)
        assert isinstance(work, StageWork)
        (work.path / "content").write_text("second")
        for name in ("rename", "unlink", "replace"):
            patch.setattr(Path, name, killed(getattr(Path, name)))
        work.finish(counts={}, seconds={}, cpu_seconds={})
    area = Area(tmp_path)
    with area.locked():
        if not isinstance(area.begin(FRAMES, {"n": 2}, {}, overwrite=True), StageRecord):
            make(area, FRAMES, "second", n=2, overwrite=True)
    assert content(area, FRAMES) == "second"
    assert {path.name for path in area.folder(FRAMES).iterdir()} == whole
    assert {path.name for path in tmp_path.iterdir()} == {FRAMES, ".lock"}


@pytest.mark.parametrize("killed_after", [0, 1, 2, 3])
def test_the_next_version_replaces_all_stages_or_none(tmp_path: Path, killed_after: int) -> None:
    """After a kill at any rename of the replacement, the next start completes it."""
    area = Area(tmp_path)
    for stage in (FRAMES, MODEL, GEO):
        make(area, stage, "old")
    following = area.next_area()
    for stage in (FRAMES, MODEL, GEO):
        make(following, stage, "new")
    assert content(Area(tmp_path), FRAMES) == "old"
    (tmp_path / ".next" / "ready").touch()
    for stage in (FRAMES, MODEL, GEO)[:killed_after]:
        area.folder(stage).rename(tmp_path / f".old-{stage}")
        following.folder(stage).rename(area.folder(stage))
    reopened = Area(tmp_path)
    assert [content(reopened, stage) for stage in (FRAMES, MODEL, GEO)] == ["new"] * 3
    assert sorted(p.name for p in tmp_path.iterdir()) == [".lock", FRAMES, MODEL, GEO]


def test_an_area_of_a_newer_version_is_refused(tmp_path: Path) -> None:
    """An area.toml written by a newer version is refused."""
    (tmp_path / "area.toml").write_text(f"version = {VERSION + 1}\nsources = []\n")
    with pytest.raises(FormatError, match=r"area\.toml: made by a newer version"):
        Area(tmp_path)


def test_a_stage_of_a_newer_version_is_refused(tmp_path: Path) -> None:
    """A stage.json written by a newer version is refused."""
    area = Area(tmp_path)
    make(area, FRAMES, "frames")
    path = area.folder(FRAMES) / "stage.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "version": VERSION + 1}))
    with pytest.raises(FormatError, match=r"stage\.json: made by a newer version"):
        Area(tmp_path).record(FRAMES)


def test_facts_come_back_as_they_were_written(tmp_path: Path) -> None:
    """Facts with quotes and backslashes survive a round trip through area.toml."""
    facts = Facts(
        sources=('a "quoted" folder', "b\\c"),
        evaluation={"low": "d.mp4"},
        expect_low=("low",),
        options={"fov": ("72", "f=94")},
    )
    Area(tmp_path).write_facts(facts)
    assert Area(tmp_path).facts == facts


def test_two_processes_do_not_change_one_area(tmp_path: Path) -> None:
    """A locked area cannot be locked a second time."""
    with (
        Area(tmp_path).locked(),
        pytest.raises(StageError, match="in use by another"),
        Area(tmp_path).locked(),
    ):
        pass


def test_an_area_where_a_file_stands_is_refused_in_one_line(tmp_path: Path) -> None:
    """An area path that is an existing file is refused."""
    (tmp_path / "file").write_text("")
    with pytest.raises(StageError, match="cannot be created"), Area(tmp_path / "file").locked():
        pass


def test_a_fingerprint_sees_a_change_in_the_middle_of_a_long_file(tmp_path: Path) -> None:
    """Changing one byte in the middle of a 5 MB file changes its fingerprint."""
    path = tmp_path / "video"
    data = bytearray(5_000_000)
    path.write_bytes(data)
    before = content_fingerprint(path)
    data[2_500_000] = 1
    path.write_bytes(data)
    assert content_fingerprint(path) != before


def test_an_option_that_was_unknown_is_the_same_as_none(tmp_path: Path) -> None:
    """A stage of an earlier version is up to date if a later option is null, and not if it has a value."""
    area = Area(tmp_path)
    work = area.begin(FRAMES, {"n": 1, "group": {"a": 2}}, {}, overwrite=False)
    assert isinstance(work, StageWork)
    work.finish(counts={}, seconds={}, cpu_seconds={})
    same = {"n": 1, "later": None, "group": {"a": 2, "b": None}}
    assert isinstance(area.begin(FRAMES, same, {}, overwrite=False), StageRecord)
    with pytest.raises(StageError, match="was made with later = None, now 3"):
        area.begin(FRAMES, {**same, "later": 3}, {}, overwrite=False)
