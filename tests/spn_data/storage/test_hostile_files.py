"""Damaged or hostile area files, cameras and recipes give a one-line error that names the file."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from spn_cli.data import main

from spn_data.area.area import Area, StageWork
from spn_data.area.names import FRAMES, MODEL
from spn_data.errors import FormatError, InputError
from spn_data.geometry.camera_file import read_camera
from spn_data.geometry.pose import Similarity
from spn_data.inputs.area_labels import read_written_world
from spn_data.storage.json_files import read_json
from spn_model.training.recipe import read_recipe

DEEP = "[" * 100_000 + "]" * 100_000
HUGE = "1" + "0" * 400


@pytest.fixture
def area(tmp_path: Path) -> Area:
    """Return an area with stage 1-frames."""
    made = Area(tmp_path / "area")
    work = made.begin(FRAMES, {"n": 1}, {"a.mp4": "f"}, overwrite=False)
    assert isinstance(work, StageWork)
    work.finish(counts={"chosen": 3, "frames": 3}, seconds={"all": 1.0}, cpu_seconds={})
    return made


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("counts", value) for value in (None, [], 5, {"chosen": "x"}, {"candidates": False})),
        *(("finished", value) for value in (5, None)),
        *(("stage", value) for value in ("x", "2-model", 7)),
        *(("upstream", value) for value in ([], None, {"1-frames": 5})),
        *(("options", value) for value in ([], "x")),
        *(("inputs", value) for value in ([], {"a.mp4": None})),
        *(("seconds", value) for value in ({"all": "long"}, {"all": True}, 3)),
        *(("notes", value) for value in ("text", [5], {})),
        *(("version", value) for value in ("1", None, True, 1.5)),
        ("more", 1),
    ],
)
def test_a_value_of_another_kind_in_stage_json_is_damage(area, name, value):
    """Values of the wrong type in stage.json are refused before use."""
    path = area.folder(FRAMES) / "stage.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), name: value}))
    with pytest.raises(FormatError, match=r"1-frames/stage\.json: "):
        area.record(FRAMES)


def test_a_missing_count_is_damage(area):
    """A missing count is reported with its file when it is used."""
    path = area.folder(FRAMES) / "stage.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "counts": {}}))
    with pytest.raises(FormatError, match=r"stage\.json: is damaged: its counts have no 'chosen'"):
        area.record(FRAMES).counts["chosen"]


@pytest.mark.parametrize(
    "text",
    [
        DEEP,
        '{"version": ' + HUGE + "}",
        '{"version": 1, "x": 1e999}',
        '{"version": 1, "x": ' + DEEP + "}",
        "[]",
        "null",
        '"version"',
        "",
        "{",
    ],
)
def test_json_that_is_no_object_of_bounded_numbers_is_damage(tmp_path, text):
    """Deep nesting, unbounded numbers and JSON other than an object are refused by the reader."""
    path = tmp_path / "a.json"
    path.write_text(text)
    with pytest.raises(FormatError, match=r"a\.json: cannot be read") as error:
        read_json(path)
    assert len(str(error.value)) < 500


@pytest.mark.parametrize(
    "text",
    [
        f"version = 1\nsources = {DEEP}",
        "version = 1\nsources = 'a.mp4'",
        "version = 1\nsources = [5]",
        "version = 1\nsources = []\nevaluation = []",
        "version = 1\nsources = []\n[evaluation]\na = 5",
        "version = '1'\nsources = []",
        "sources = []",
    ],
)
def test_an_area_file_of_other_kinds_is_damage(tmp_path, text):
    """An area file is refused unless sources are a list of texts and evaluation is a table of texts."""
    (tmp_path / "area.toml").write_text(text)
    with pytest.raises(FormatError, match=r"area\.toml: is not an area file"):
        Area(tmp_path)


def test_an_area_file_that_is_a_folder_is_told(tmp_path):
    """A folder with the name of the area file gives an error instead of a crash."""
    (tmp_path / "area.toml").mkdir()
    with pytest.raises(FormatError, match=r"area\.toml: .*Is a directory"):
        Area(tmp_path)


@pytest.mark.parametrize("counts", [{}, {"chosen": 3}, None, {"chosen": [], "sequences": 1}])
def test_status_tells_damage_in_one_line(area, counts):
    """`status` names the damaged record in one line and exits with code 1."""
    path = area.folder(FRAMES) / "stage.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "counts": counts}))
    result = CliRunner().invoke(main, ["status", "--area", str(area.root)])
    assert result.exit_code == 1, result.output
    assert result.output.startswith("Error: ")
    assert "stage.json" in result.output
    assert len(result.output.splitlines()) == 1


CAMERA = {"model": "PINHOLE", "width": 640, "height": 360, "params": [400, 400, 320, 180]}


@pytest.mark.parametrize(
    "text",
    [
        json.dumps(CAMERA).replace("640", "1e999"),
        json.dumps(CAMERA).replace("640", HUGE),
        json.dumps(CAMERA).replace("320", HUGE),
        json.dumps(CAMERA).replace("320", "false"),
        json.dumps(CAMERA).replace("640", '"640"'),
        json.dumps(CAMERA).replace("[400, 400, 320, 180]", '"4321"'),
        "[]",
        "[" * 50_000,
    ],
)
def test_a_camera_of_other_kinds_is_refused(tmp_path, text):
    """Non-finite, unbounded, text and boolean numbers in a camera file are refused."""
    path = tmp_path / "camera.json"
    path.write_text(text)
    with pytest.raises(InputError, match=r"camera\.json: does not contain a camera"):
        read_camera(path)


@pytest.mark.parametrize(
    ("line", "told"),
    [
        (f"momentum = {HUGE}", "2: momentum is too large"),
        (f"momentum = {DEEP[97_500:-97_500]}", " is not a valid recipe: nested too deeply"),
    ],
)
def test_a_recipe_beyond_bounds_is_refused(tmp_path, line, told):
    """A number of 400 digits is reported with its line, and deep nesting with the file."""
    path = tmp_path / "r.toml"
    path.write_text(f'kind = "regression"\n{line}\n[[stages]]\nimages = 100\n')
    with pytest.raises(InputError, match=rf"r\.toml:{told}"):
        read_recipe(str(path))


def wrong(**values: Any) -> Callable[[dict[str, Any]], dict[str, Any]]:
    return lambda similarity: {**similarity, **values}


@pytest.mark.parametrize(
    "change",
    [
        wrong(scale="x"),
        wrong(scale=0.0),
        wrong(scale=True),
        wrong(scale=None),
        wrong(translation=[1.0, False, 2.0]),
        wrong(translation=[1.0, 2.0]),
        wrong(rotation=[[2.0, 0, 0], [0, 1, 0], [0, 0, 1]]),
        wrong(rotation=[[-1.0, 0, 0], [0, 1, 0], [0, 0, 1]]),
        lambda _: {},
        lambda _: [],
    ],
)
def test_a_registration_without_a_similarity_is_damage(tmp_path, change):
    """Labels are transformed only by a positive scale, a rotation and a translation of three numbers."""
    path = tmp_path / "registration.json"
    table = {"version": 1, "world_from_model": change(Similarity.identity().to_json())}
    path.write_text(json.dumps(table))
    with pytest.raises(FormatError, match=r"registration\.json: is not a registration"):
        read_written_world(path)


def test_old_versions_of_a_killed_process_are_removed(area):
    """The next command that locks the area removes only old versions that were already replaced."""
    group = area.root / "4-eval"
    for name in (".old-b", ".old-gone", ".moved-b", "b"):
        (group / name).mkdir(parents=True)
    (area.root / f".old-{FRAMES}").mkdir()
    (area.root / ".old-mine").mkdir()
    (area.root / f".old-{MODEL}").mkdir()
    with area.locked():
        pass
    assert {p.name for p in group.iterdir()} == {".old-gone", "b"}
    assert {p.name for p in area.root.glob(".old*")} == {".old-mine", f".old-{MODEL}"}
