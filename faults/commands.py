"""The commands that are disturbed, each with the state of the folder in which it starts."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

# A small network that can be exported, with a few steps of training.
REAL = """\
kind = "scene-coordinates"
weights = "published"
options = { shrink = 1 }
[[stages]]
name = "all"
images = 24
batch = 8
rate = 0.001
"""
AREA = ("--area", "area")
ONE = ("--threads", "1")
SMALL = (*AREA, *ONE, "--max-features", "800")
TRAIN = (*AREA, *ONE, "--device", "cpu", "--precision", "float32", "--validations", "2")
SECOND = "second/flight2.mp4"
NAMED = ("--name", "medium", "--rate", "1", "--any-telemetry")
REDONE = ("--seed", "3", "--gap", "0.5", "--overwrite")
SHORT = ("--length-factor", "0.02", "--area-factor", "0.3")
CAMERA = ("--camera", "area/4-eval/medium/camera.json")
RUN = (*AREA, *ONE, "--device", "cpu", "--run", "real")


@dataclass(frozen=True)
class Command:
    """A command, and how it is judged.

    Attributes
    ----------
    name : str
    words : tuple of str
        Program and arguments.
    start : str
        State of the folder at its start: the name of the command that made it, or "flights".
    writes : tuple of str
        Parts of the folder that the command may change; everything else must stay as it is.
    is_mapped : bool
        Whether poses are compared (1 cm) instead of bytes: mapping resumes from a snapshot.
    """

    name: str
    words: tuple[str, ...]
    start: str
    writes: tuple[str, ...]
    is_mapped: bool = False


_DATA: tuple[Command, ...] = (
    Command(
        "simulate",
        ("spn-data", "simulate", "simulated", "--preset", "demo", "--only", "flight1", *SHORT),
        "flights",
        ("simulated",),
    ),
    Command(
        "reconstruct",
        ("spn-data", "reconstruct", "flights/mapping", *SMALL, "--fov", "72"),
        "flights",
        ("area",),
        is_mapped=True,
    ),
    Command(
        "reconstruct --add",
        ("spn-data", "reconstruct", "second", "--add", "--any-telemetry", *SMALL),
        "reconstruct",
        ("area",),
        is_mapped=True,
    ),
    Command(
        "georegister",
        ("spn-data", "georegister", *AREA, "--gnss-sigma", "1", "2", "--overwrite"),
        "reconstruct",
        ("area/3-geo", "area/report.html", "area/area.toml"),
    ),
    Command(
        "register",
        ("spn-data", "register", SECOND, *NAMED, *AREA, *ONE),
        "reconstruct",
        ("area/4-eval", "area/report.html", "area/area.toml"),
    ),
    Command(
        "register --all-frames",
        ("spn-data", "register", "--all-frames", "--any-telemetry", *AREA, *ONE),
        "register",
        ("area/4-tracked", "area/report.html"),
    ),
    Command(
        "coverage",
        ("spn-data", "coverage", *AREA, "--fly-again", "again.csv"),
        "register --all-frames",
        ("area/coverage", "area/report.html", "again.csv"),
    ),
    Command(
        "split",
        ("spn-data", "split", *AREA, "--size", "160"),
        "register --all-frames",
        ("area/5-split", "area/report.html"),
    ),
    Command(
        "split --overwrite",
        ("spn-data", "split", *AREA, "--size", "160", *REDONE),
        "split",
        ("area/5-split", "area/report.html"),
    ),
    Command("audit", ("spn-data", "audit", *AREA), "split", ("area/5-split", "area/report.html")),
    Command("report", ("spn-data", "report", *AREA), "split", ("area/report.html",)),
    Command("status", ("spn-data", "status", *AREA), "split", ()),
    Command(
        "import",
        ("spn-data", "import", "area/5-split/cambridge", "--to", "imported.h5"),
        "split",
        ("imported.h5",),
    ),
    Command(
        "export nerfstudio",
        ("spn-data", "export", "nerfstudio", "--to", "nerf", *AREA),
        "split",
        ("nerf",),
    ),
    Command(
        "export colmap --overwrite",
        ("spn-data", "export", "colmap", "--to", "out", *AREA, "--overwrite"),
        "exported",
        ("out",),
    ),
)
_MODEL: tuple[Command, ...] = (
    Command(
        "train",
        ("spn-model", "train", *TRAIN, "--recipe", "tiny.toml"),
        "split",
        ("area/runs", "area/report.html"),
    ),
    Command(
        "train --overwrite",
        ("spn-model", "train", *TRAIN, "--recipe", "tiny.toml", "--seed", "2", "--overwrite"),
        "train",
        ("area/runs/tiny", "area/report.html"),
    ),
    Command(
        "evaluate",
        ("spn-model", "evaluate", *RUN),
        "trained",
        ("area/runs", "area/report.html"),
    ),
    Command(
        "model export",
        ("spn-model", "export", *AREA, "--run", "real", "--calibration-images", "4"),
        "trained",
        ("area/runs", "area/report.html"),
    ),
    Command(
        "predict",
        ("spn-model", "predict", SECOND, *RUN, *CAMERA, "--format", "wgs84", "--to", "poses"),
        "trained",
        ("poses",),
    ),
    Command(
        "benchmark",
        ("spn-model", "benchmark", *AREA, "--run", "real", "--threads", "1"),
        "bundle",
        ("area/runs", "area/report.html"),
    ),
)
# States that no command under test makes.
_HELPERS: tuple[Command, ...] = (
    Command(
        "exported",
        ("spn-data", "export", "colmap", "--to", "out", *AREA, "--no-images"),
        "split",
        (),
    ),
    Command(
        "trained",
        ("spn-model", "train", *TRAIN, "--recipe", "real.toml"),
        "split",
        ("area/runs", "area/report.html"),
    ),
    Command(
        "bundle",
        ("spn-model", "export", *AREA, "--run", "real", "--no-int8"),
        "trained",
        (),
    ),
)
COMMANDS = {command.name: command for command in (*_DATA, *_MODEL)}
ALL = {**COMMANDS, **{command.name: command for command in _HELPERS}}


def write_flights(work: Path) -> None:
    """Write the two short flights and the recipes into a folder."""
    from tests.worlds.short_flights import write_flight1, write_flight2
    from tests.worlds.training_world import TINY_RECIPE

    flight1 = write_flight1(work / "flights")
    (work / "second").mkdir()
    write_flight2(work / "second", flight1)
    (work / "tiny.toml").write_text(TINY_RECIPE)
    (work / "real.toml").write_text(REAL)


def state(name: str, states: Path, run: Callable[[Command, Path], int]) -> Path:
    """Return the folder of a state, made once by its command with `run(command, folder)`."""
    folder = states / name.replace(" ", "_")
    if folder.is_dir():
        return folder
    making = states / ".making"
    shutil.rmtree(making, ignore_errors=True)
    if name == "flights":
        making.mkdir(parents=True)
        write_flights(making)
    else:
        command = ALL[name]
        shutil.copytree(state(command.start, states, run), making)
        code = run(command, making)
        if code:
            raise SystemExit(f"{json.dumps(command.words)} ended with {code}: see {states}/output")
    making.rename(folder)
    return folder
