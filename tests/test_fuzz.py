"""A short campaign of mutated files, and the campaign's own limits; `make fuzz` runs the long one."""

from __future__ import annotations

import os
import random
import shutil
import struct
import subprocess
import sys
from pathlib import Path

import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fuzz.__main__ import failed_input
from fuzz.limits import Reader, limited, wait_for
from fuzz.mutate import mutated
from fuzz.seeds import make_small
from spn_data.colmap.model import load_native
from spn_data.colmap.model_files import CAMERAS, FRAMES, RIGS
from spn_data.errors import FormatError, InputError, SpnError
from spn_data.geometry.camera_file import read_camera
from spn_data.storage.json_files import write_json
from spn_data.storage.stage_record import read_record

ROOT = Path(__file__).resolve().parents[1]
ANYTHING = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4)
    ),
    max_leaves=8,
)


def test_a_short_campaign_finds_nothing(flight1, finished_area, tmp_path):
    """Hundreds of mutated files of every kind that is made quickly give a result or one line."""
    seeds = tmp_path / "seeds"
    shutil.copytree(finished_area, seeds / "area")
    make_small(seeds, flight1)
    command = [
        sys.executable,
        "-m",
        "fuzz",
        "--folder",
        tmp_path,
        "--inputs",
        "200",
        "--seconds",
        "4",
    ]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "cli")])}
    done = subprocess.run(
        [str(part) for part in command], cwd=ROOT, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert int(done.stdout.split("\nall ")[1].split()[0]) > 100


def _fault(name: str, number: int) -> tuple[str, str]:
    """Do what a faulty reader does."""

    def task() -> None:
        if name == "spin":
            while True:
                pass
        if name == "memory":
            assert len(bytearray(1_300_000_000))
        if name == "crash":
            os.abort()
        if name == "traceback":
            raise KeyError("x")
        raise InputError("refused")

    return limited(task, SpnError)


@pytest.mark.parametrize(
    ("fault", "verdict"),
    [
        ("spin", "timeout"),
        ("memory", "memory"),
        ("crash", "crash"),
        ("traceback", "traceback"),
        ("refusal", "refused"),
    ],
)
def test_each_kind_of_fault_is_seen(fault, verdict, monkeypatch):
    """Endless loops, memory, crashes and tracebacks get their verdicts, and the next input is read."""
    if fault == "spin":
        monkeypatch.setattr("fuzz.limits.CPU_S", 1.5)
    reader = Reader(_fault)
    found = []
    for name in (fault, "refusal"):
        reader.give(name, 0)
        while not wait_for([reader]):
            pass
        found.append(reader.take()[0])
    reader.close()
    assert found == [verdict, "refused"]


def test_equal_seeds_give_equal_inputs():
    """An input can be made again from its number."""
    data = b'{"a": [1, 2, {"b": "text"}]}' * 3
    inputs = [mutated(data, random.Random(k)) for k in range(40)]
    assert inputs == [mutated(data, random.Random(k)) for k in range(40)]
    assert len(set(inputs)) > 30


@settings(max_examples=60, deadline=None)
@given(ANYTHING)
def test_any_json_value_is_read_or_refused(tmp_path_factory, value):
    """Any JSON in a camera file or stage record gives a result or one line."""
    path = tmp_path_factory.getbasetemp() / "value.json"
    write_json(path, value)
    for read in (read_camera, read_record):
        with pytest.raises(SpnError) as error:
            read(path)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("name", "at"), [(FRAMES, 0), (FRAMES, 72), (RIGS, 0), (RIGS, 12), (CAMERAS, 0)]
)
def test_a_count_beyond_the_file_is_refused_at_once(finished_area, tmp_path, name, at):
    """COLMAP's files with a count of 2^32 - 1 are refused; COLMAP itself reads on for minutes."""
    shutil.copytree(finished_area / "3-geo", tmp_path / "model")
    path = tmp_path / "model" / name
    data = bytearray(path.read_bytes())
    data[at : at + 4] = struct.pack("<I", 2**32 - 1)
    path.write_bytes(data)
    with pytest.raises(FormatError, match=name):
        load_native(path.parent)


def test_the_parameters_of_all_cameras_are_counted_as_colmap_does(tmp_path):
    """A model with any of COLMAP's cameras is whole."""
    for number in range(18):
        model = pycolmap.Reconstruction()
        camera = pycolmap.Camera.create_from_model_id(
            1, pycolmap.CameraModelId(number), 50.0, 64, 48
        )
        model.add_camera_with_trivial_rig(camera)
        model.write_binary(str(tmp_path))
        assert load_native(tmp_path).num_cameras() == 1


def test_messages_are_one_line():
    """What a library says over several lines becomes one line of an error."""
    assert (
        str(FormatError("a.onnx: onnxruntime says\n  more\r\n")) == "a.onnx: onnxruntime says more"
    )
    assert str(InputError("x", path="a\nb")) == "a b: x"


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"\xd0\xff", "cannot be read"),
        (b"[1]", "a list instead of an object"),
        (b'{"target": "srt", "seed": 1}', "'number' is missing"),
        (b'{"target": "nothing", "seed": 1, "number": 2}', "no target is named 'nothing'"),
        (b'{"target": "srt", "seed": 1, "number": "2"}', "'2' is no number"),
    ],
)
def test_what_is_no_input_of_a_failure_is_refused(tmp_path, content, told):
    """`python -m fuzz --replay` refuses another file in one line that says what is wrong with it."""
    path = tmp_path / "input.json"
    path.write_bytes(content)
    with pytest.raises(FormatError, match=told):
        failed_input(path)
    path.write_bytes(b'{"target": "srt", "seed": 1, "number": -2, "origin": "a"}')
    assert failed_input(path) == ("srt", -2, 1)
