"""Ctrl-C, SIGTERM and SIGKILL at any time leave no process behind, and a rerun gives the same result."""

from __future__ import annotations

import importlib.util
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from spn_data.area.area import Area
from spn_data.area.names import GEO, MODEL

OPTIONS = ["--max-features", "800", "--fov", "72"]


def _load_benchmark() -> ModuleType:
    """Import benchmarks/interruption.py."""
    path = Path(__file__).resolve().parents[2] / "benchmarks" / "interruption.py"
    spec = importlib.util.spec_from_file_location("interruption", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["interruption"] = module
    spec.loader.exec_module(module)
    return module


interruption = _load_benchmark()
Start = Callable[[], Any]


@pytest.fixture
def area(tmp_path: Path) -> Path:
    return tmp_path / "area"


@pytest.fixture
def start(flight1: Path, area: Path) -> Start:
    """Return a function that starts or resumes the reconstruction of the short flight."""
    return lambda: interruption.Run([flight1], area, OPTIONS)


def first(output: str, step: str) -> int:
    """Return the count in the first progress line of a step."""
    line = next(line for line in output.splitlines() if line.startswith(f"{step}: "))
    return int(line.split()[1])


def test_ctrl_c_in_each_step_ends_at_once_and_the_next_run_goes_on(
    start: Start, area: Path, finished_area: Path
) -> None:
    """SIGINT to the process group, in any step, exits within 5 s with code 130; the next run resumes."""
    outputs = []
    for step in ("analysis", "frames", "features", "matching", "mapping"):
        run = start()
        run.wait_for(step)
        family = run.family()
        os.killpg(run.process.pid, signal.SIGINT)
        stopped = time.monotonic()
        assert run.process.wait(20) == 130, run.output
        assert time.monotonic() - stopped < 5
        assert interruption.outliving(family, 3.0) == []
        lines = run.output.splitlines()
        assert lines[-1] == "Stopped. Completed work is kept: run the same command to resume."
        assert "Traceback" not in run.output
        outputs.append(run.output)
    run = start()
    run.finish()
    assert first(outputs[3], "features") > 1, "features of the run before were found again"
    assert not any(line.startswith("features") for line in outputs[4].splitlines())
    assert not any(line.startswith("matching") for line in run.output.splitlines())
    assert interruption.difference(finished_area, area).position_m < 0.01


@pytest.mark.parametrize("step", [pytest.param("frames", marks=pytest.mark.slow), "matching"])
def test_a_kill_outside_mapping_changes_no_pose(
    start: Start, area: Path, finished_area: Path, step: str
) -> None:
    """A kill in a step other than mapping leaves no worker, and the resumed run gives identical poses."""
    run = start()
    run.wait_for(step)
    assert run.kill() == 0, "workers outlived the process"
    assert not Area(area).has(MODEL)
    start().finish()
    found = interruption.difference(finished_area, area)
    assert found.same_frames
    assert found.largest_as_is_m < 1e-9


def test_a_kill_while_mapping_changes_poses_by_less_than_a_centimetre(
    start: Start, area: Path, finished_area: Path
) -> None:
    """After a kill during mapping, the resumed run keeps the matches and changes poses by less than 1 cm."""
    run = start()
    run.wait_for("mapping")
    assert run.kill() == 0, "the mapper outlived the process"
    resumed = start()
    resumed.finish()
    assert not any(line.startswith("matching") for line in resumed.output.splitlines())
    found = interruption.difference(finished_area, area)
    assert found.same_frames
    assert found.position_m < 0.01
    assert found.rotation_deg < 0.02


def member(run: Any, command: str) -> int:
    """Return the id of the child process of a run whose command line contains a text."""
    deadline = time.monotonic() + 20
    while time.monotonic() < deadline:
        for pid in run.family():
            try:
                line = Path(f"/proc/{pid}/cmdline").read_bytes().decode()
            except OSError:
                continue
            if command in line:
                return int(pid)
        time.sleep(0.02)
    raise AssertionError(f"no process {command}")


@pytest.mark.slow
def test_a_killed_worker_is_replaced_within_the_run(
    start: Start, area: Path, finished_area: Path
) -> None:
    """A killed feature worker is replaced, and the poses are identical."""
    run = start()
    run.wait_for("features")
    os.kill(member(run, "spawn_main"), signal.SIGKILL)
    run.finish()
    assert interruption.difference(finished_area, area).largest_as_is_m < 1e-9


@pytest.mark.slow
def test_a_killed_mapper_is_told_in_one_line_and_the_next_run_finishes(
    start: Start, area: Path, finished_area: Path
) -> None:
    """A killed mapping process is reported in one line, and the next run finishes."""
    run = start()
    run.wait_for("mapping")
    os.kill(member(run, "spn_data.colmap.mapping"), signal.SIGKILL)
    assert run.process.wait(30) == 1
    errors = [line for line in run.output.splitlines() if line.startswith("Error")]
    assert len(errors) == 1
    assert "mapping was killed by signal 9. Finished work is kept" in errors[0]
    assert "Traceback" not in run.output
    start().finish()
    assert interruption.difference(finished_area, area).position_m < 0.01


def test_a_kill_while_scratch_files_are_removed_loses_nothing(
    finished_area: Path, flight1: Path, area: Path
) -> None:
    """A stage with a record is complete even if it still has its partial name and scratch files."""
    shutil.copytree(finished_area, area)
    shutil.rmtree(area / GEO)
    record = Area(area).record(MODEL)
    partial = Area(area).partial(MODEL)
    (area / MODEL).rename(partial)
    shutil.copy(partial / "stage.json", partial / "started.json")
    (partial / "mapping-first" / "snapshots").mkdir(parents=True)
    run = interruption.Run([flight1], area, OPTIONS)
    run.finish()
    assert Area(area).record(MODEL) == record
    assert not (area / MODEL / "mapping-first").exists()
    assert not (area / MODEL / "started.json").exists()
    assert interruption.difference(finished_area, area).largest_as_is_m < 1e-9


def test_a_model_that_a_full_disk_cut_short_is_an_error(
    finished_area: Path, tmp_path: Path
) -> None:
    """A truncated model, which COLMAP does not report, is an error; a file size limit simulates the disk."""
    script = (
        "import resource, sys; from pathlib import Path\n"
        "from spn_data.colmap.model import write_transformed\n"
        "from spn_data.geometry.pose import Similarity\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))\n"
        "write_transformed(Path(sys.argv[1]), Path(sys.argv[2]), Similarity.identity())\n"
    )
    command = [sys.executable, "-c", script, str(finished_area / MODEL), str(tmp_path / "out")]
    result = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert result.returncode == 1
    assert "could not be written completely; is the disk full?" in result.stderr


@pytest.mark.slow
def test_kills_at_random_moments(flight1: Path, flight2: Path, tmp_path: Path) -> None:
    """Kills at eight random times in a run of two flights leave nothing behind and hardly change poses."""
    _, _, kills = interruption.measure(
        [flight1, flight2], tmp_path, OPTIONS, kills=8, seed=1, victim="main"
    )
    for kill in kills:
        assert kill.left_behind == 0
        assert kill.difference.same_frames
        assert kill.difference.position_m < 0.01
        assert kill.difference.rotation_deg < 0.05
        if not kill.step.startswith("mapping"):  # mapping resumes from its last snapshot
            assert kill.difference.largest_as_is_m < 1e-9


def test_sigterm_is_treated_as_ctrl_c(start: Start) -> None:
    """SIGTERM to the command alone exits with code 143, the same line and no native stack trace."""
    run = start()
    run.wait_for("features")
    family = run.family()
    os.kill(run.process.pid, signal.SIGTERM)
    assert run.process.wait(20) == 143, run.output
    assert interruption.outliving(family, 3.0) == []
    lines = run.output.splitlines()
    assert lines[-1] == "Stopped. Completed work is kept: run the same command to resume."
    assert "Traceback" not in run.output
    assert "SIGTERM" not in run.output
