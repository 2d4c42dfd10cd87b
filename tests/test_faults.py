"""A few kills and limits of one command each; `make kill` and `make limits` try all commands."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

pytestmark = pytest.mark.skipif(
    sys.platform != "linux" or shutil.which("cc") is None, reason="needs Linux and a C compiler"
)


@pytest.mark.parametrize(
    ("command", "kills"), [("georegister", 4), pytest.param("register", 6, marks=pytest.mark.slow)]
)
def test_a_command_killed_at_changes_of_files_loses_nothing(
    flight1, flight2, finished_area, tmp_path, command, kills
):
    """Killed at some of its changes and run again, a command gives what an undisturbed run gives."""
    start = tmp_path / "states" / "reconstruct"
    shutil.copytree(finished_area, start / "area")
    shutil.copytree(flight1, start / "flights" / "mapping")
    shutil.copytree(flight2, start / "second")
    program = [sys.executable, "-m", "faults.kill", "--jobs", "1", "--work", tmp_path]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "cli")])}
    found = tmp_path / "found.json"
    words = [*program, "--only", command, "--kills", str(kills), "--json", found]
    done = subprocess.run(
        [str(word) for word in words], cwd=ROOT, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert f"{kills} kills: 0 lost, 0 different" in done.stdout
    assert len(json.loads(found.read_text())) == kills
