"""The built wheel in a clean environment without network: its files, dependencies and commands."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import zipfile
from importlib import metadata
from pathlib import Path

import cv2
import numpy as np
import pytest
from packaging.markers import default_environment
from packaging.requirements import Requirement

from spn_data.dataset.hdf5_reader import Dataset
from spn_data.geometry.camera_file import camera_to_json
from spn_data.storage.json_files import write_json
from spn_model.export.bundle_checks import BundleOptions
from spn_model.export.bundle_export import export
from tests.worlds.box_world import seen_by, write_box
from tests.worlds.bundle_world import LENS, learnt

ROOT = Path(__file__).resolve().parents[1]
NAME = "squeezeposenet-toolkit"

pytestmark = pytest.mark.slow


def needed(requirements: list[str], extra: str = "") -> set[str]:
    """Return the installed distributions required directly or indirectly; names in lower case."""
    found: set[str] = set()
    waiting = [(Requirement(text), extra) for text in requirements]
    while waiting:
        requirement, of_extra = waiting.pop()
        environment = {**default_environment(), "extra": of_extra}
        if requirement.marker and not requirement.marker.evaluate(environment):
            continue
        name = requirement.name.lower()
        if name == NAME:
            inner = metadata.requires(NAME) or []
            waiting += [(Requirement(r), e) for e in requirement.extras for r in inner]
        elif name not in found:
            found.add(name)
            inner = metadata.requires(name) or []
            waiting += [(Requirement(r), "") for r in inner]
    return found


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built with the installed build backend."""
    folder = tmp_path_factory.mktemp("wheel")
    code = f"import hatchling.build as b; print(b.build_wheel({str(folder)!r}))"
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True, capture_output=True)
    (found,) = folder.glob("*.whl")
    return found


class Clean:
    """Virtual environment with only the wheel and the dependencies of one of its extras."""

    def __init__(self, folder: Path, wheel: Path, extra: str):
        subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder], check=True)
        version = f"python{sys.version_info.major}.{sys.version_info.minor}"
        self.packages = folder / "lib" / version / "site-packages"
        self.python = folder / "bin" / "python"
        with zipfile.ZipFile(wheel) as archive:
            archive.extractall(self.packages)
        self.own = metadata.PathDistribution(next(self.packages.glob("*.dist-info")))
        assert self.own.requires is not None
        self.distributions = needed(self.own.requires, extra)
        for name in self.distributions:
            self._link(metadata.distribution(name))

    def _link(self, distribution: metadata.Distribution) -> None:
        """Link the top-level entries of an installed distribution into the environment."""
        for top in {file.parts[0] for file in distribution.files or [] if file.parts[0] != ".."}:
            source = Path(str(distribution.locate_file(top)))
            if source.exists() and not (self.packages / top).exists():
                (self.packages / top).symlink_to(source)

    def run(self, *words: str) -> subprocess.CompletedProcess[str]:
        """Run Python in the environment, in another folder and without any path of this checkout."""
        environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
        return subprocess.run(
            [self.python, *words],
            cwd=self.packages.parent,
            env=environment,
            capture_output=True,
            text=True,
            timeout=120,
        )

    def command(self, entry: str, *words: str) -> subprocess.CompletedProcess[str]:
        """Run a console command of the wheel."""
        value = next(e.value for e in self.own.entry_points if e.name == entry)
        module, _, function = value.partition(":")
        code = f"import sys; sys.argv[0] = {entry!r}; from {module} import {function} as f; sys.exit(f())"
        return self.run("-c", code, *words)


def test_the_wheel_holds_our_packages_and_nothing_of_a_generic_name(wheel: Path) -> None:
    """The wheel has only our three packages at top level, with data files and type markers."""
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    tops = {name.split("/")[0] for name in names}
    assert {t for t in tops if not t.endswith(".dist-info")} == {"spn_data", "spn_model", "spn_cli"}
    for name in (
        *("spn_data/py.typed", "spn_model/py.typed", "spn_cli/py.typed"),
        "spn_model/pretrained/squeezenet1_1-features.safetensors",
        "spn_model/training/recipes/default.toml",
        "spn_data/report/assets/page.html",
    ):
        assert name in names
    assert wheel.stat().st_size < 8_000_000


def test_the_drone_needs_three_packages(wheel: Path, tmp_path: Path) -> None:
    """A bundle runs with the extra `onboard` alone, without COLMAP, PyAV, HDF5 and PyTorch."""
    clean = Clean(tmp_path / "drone", wheel, "onboard")
    assert {"numpy", "onnxruntime", "opencv-python-headless"} <= clean.distributions
    assert not {"av", "click", "h5py", "pycolmap", "scipy", "torch"} & clean.distributions
    hall = write_box(tmp_path / "dataset.h5", train=4)
    bundle = tmp_path / "bundle"
    export(learnt(hall), hall, bundle, {}, lambda *_: None, BundleOptions(calibration_images=4))
    with Dataset(hall) as data:
        true = data["train"].poses[:1]
    cv2.imwrite(str(tmp_path / "image.png"), seen_by(true, LENS)[0][..., ::-1])
    write_json(tmp_path / "camera.json", camera_to_json(LENS))
    words = [str(bundle), str(tmp_path / "image.png"), "--camera", str(tmp_path / "camera.json")]
    done = clean.command("spn-onboard", *words, "--format", "jsonl")
    assert done.returncode == 0, done.stderr
    line = json.loads(done.stdout)
    assert line["reason"] == ""
    assert np.linalg.norm(np.array(line["center"]) - true.centers[0]) < 0.3


@pytest.mark.parametrize(("command", "extra"), [("spn-data", "data"), ("spn-model", "model")])
def test_a_missing_extra_is_named_in_one_line(
    wheel: Path, tmp_path: Path, command: str, extra: str
) -> None:
    """Without its extra a command prints the pip command that installs it and exits with code 1."""
    clean = Clean(tmp_path / "bare", wheel, "")
    done = clean.command(command, "--version")
    assert done.returncode == 1
    (line,) = done.stderr.strip().splitlines()
    assert line.endswith(f"run pip install '{NAME}[{extra}]'")


def test_the_data_command_runs_with_its_extra(wheel: Path, tmp_path: Path) -> None:
    """With the extra `data`, spn-data prints version and help, and spn-model names its missing extra."""
    clean = Clean(tmp_path / "data", wheel, "data")
    assert "torch" not in clean.distributions
    done = clean.command("spn-data", "--version")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("spn-data, version 0.")
    simulated = clean.command("spn-data", "simulate", "--help")
    assert "Usage: spn-data simulate" in simulated.stdout
    lacking = clean.run("-c", "from spn_cli.entry import model; model()", "train", "--area", "x")
    assert lacking.returncode == 1
