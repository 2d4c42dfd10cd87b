"""Benchmarks measure both sides correctly and alike, and do not modify their input."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from spn_data.area.area import Area
from spn_data.area.names import FRAMES
from spn_data.capture.selection import SelectionOptions
from spn_data.colmap.model import Scene
from spn_data.geometry.pose import Poses, Similarity
from spn_data.geometry.rotations import rotations_from_vectors
from spn_data.pipeline.frames_stage import FramesOptions, choose_frames, plan
from spn_data.simulate import preset, simulate

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"


@pytest.fixture
def benchmark(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """benchmarks/reconstruct.py, imported with its folder on the path, as when run as a script."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("reconstruct")


def files(folder: Path) -> dict[str, bytes]:
    """Return the bytes of all files in a folder by relative path."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def a_scene(names: list[str], poses: Poses) -> Scene:
    """Return a scene of images with poses and without points."""
    none = np.zeros(0, int)
    return Scene(tuple(names), poses, np.ones(len(names), int), {}, np.zeros((0, 3)), none)


def some_poses(n: int) -> Poses:
    """Draw random poses."""
    rng = np.random.default_rng(5)
    return Poses.from_rotations(
        rng.normal(size=(n, 3)), rotations_from_vectors(rng.normal(size=(n, 3)))
    )


@pytest.mark.slow
def test_both_pipelines_map_simulated_frames_and_are_judged_by_the_truth(tmp_path: Path) -> None:
    """On eight 480 x 270 frames both pipelines are accurate to 5 cm, and the area is not modified."""
    flights = tmp_path / "flights"
    simulate(
        flights,
        replace(
            preset("standard", seed=3),
            width=480,
            height=270,
            fps=2.0,
            length_factor=0.08,
            texels_per_m=60.0,
            only=("flight1",),
            blur_share=0.0,
        ),
        workers=1,
    )
    area = Area(tmp_path / "area")
    options = FramesOptions(selection=SelectionOptions(target_count=8), fov_deg={"*": 72.0})
    found = plan([flights / "mapping"], options)
    record = choose_frames(area, found, options, lambda *_: None)
    before = files(area.root)
    figures = compared(area.root, tmp_path / "out.json", "--flights", str(flights))
    assert files(area.root) == before
    assert figures["frames"] == record.counts["chosen"] == 8
    assert figures["threads"] == 2
    for who, stages in (
        ("ours", {"features", "pairs", "matching", "mapping", "refinement", "covariance"}),
        ("pycolmap", {"features", "matching", "mapping"}),
    ):
        mine = figures[who]
        assert mine["failure"] is None
        assert mine["registered"] == mine["errors"]["frames"] == 8
        # At 480 pixels and about a metre from the scene, errors are usually a few millimetres.
        assert 1e-5 < mine["errors"]["position_median_m"] < 0.05
        assert mine["errors"]["rotation_median_deg"] < 0.5
        assert 0.05 < mine["mean_error_px"] < 1.0
        assert 20 < mine["peak_memory_mb"] < 4000
        for unit in ("wall_s", "cpu_s"):
            assert set(mine[unit]) == stages | {"other", "total"}
            parts = [v for k, v in mine[unit].items() if k != "total"]
            assert min(parts) >= 0
            assert sum(parts) == pytest.approx(mine[unit]["total"])
    for unit, ratio in figures["baseline_over_ours"].items():
        expected = figures["pycolmap"][unit]["total"] / figures["ours"][unit]["total"]
        assert ratio == pytest.approx(expected)
    assert figures["difference"]["frames"] == 8
    assert figures["difference"]["position_p95_share"] < 0.01
    assert figures["pycolmap"]["notes"][0] == "match_sequential; models of 8"


@pytest.mark.slow
def test_baseline_matches_real_photos_by_their_position(shared_data: Path, tmp_path: Path) -> None:
    """Photos with EXIF positions, which feature extraction inserts, are matched with match_spatial."""
    photos = tmp_path / "photos"
    photos.mkdir()
    for number in range(60, 66):
        name = f"DJI_{number:04}.JPG"
        (photos / name).write_bytes((shared_data / "photos-two-passes" / name).read_bytes())
    area = Area(tmp_path / "area")
    found = plan([photos], FramesOptions())
    choose_frames(area, found, FramesOptions(), lambda *_: None)
    figures = compared(area.root, tmp_path / "out.json", "--only", "pycolmap")
    assert figures["pycolmap"]["notes"][0] == "match_spatial; models of 6"
    assert "ours" not in figures
    assert "baseline_over_ours" not in figures


def compared(area: Path, out: Path, *arguments: str) -> dict[str, Any]:
    """Run the benchmark as a script and return its JSON output."""
    command = [sys.executable, str(BENCHMARKS / "reconstruct.py"), str(area), "--json", str(out)]
    done = subprocess.run(
        [*command, *arguments], capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "Seconds" in done.stdout
    figures: dict[str, Any] = json.loads(out.read_text())
    return figures


def test_an_area_without_frames_is_refused(benchmark: ModuleType, tmp_path: Path) -> None:
    """An area without frames is rejected; the message names the command to run."""
    with pytest.raises(Exception, match=f"{FRAMES} is missing; run spn-data reconstruct first"):
        benchmark.compare(tmp_path, None, tmp_path, who=["ours"], threads=1, seed=0)


def test_usage_counts_all_descendants(benchmark: ModuleType, tmp_path: Path) -> None:
    """A grandchild's 0.5 s of CPU time and 100 MB are counted, and an abort is reported as signal 6."""
    grandchild = (
        "import time; held = bytearray(b'x') * 100_000_000; end = time.process_time() + 0.5\n"
        "while time.process_time() < end: pass"
    )
    child = f"import os, subprocess, sys; subprocess.run([sys.executable, '-c', {grandchild!r}]); os.abort()"
    usage = benchmark.run_measured(
        [sys.executable, "-c", child], threads=1, log=tmp_path / "child.log"
    )
    assert usage.exit_code == -6
    assert 0.5 <= usage.cpu_s < 3
    assert usage.wall_s >= 0.5
    if Path("/proc/self/smaps_rollup").exists():
        assert 95 < usage.peak_memory_mb < 250


def test_a_contestant_that_dies_is_a_failure_with_the_end_of_its_log(
    benchmark: ModuleType, tmp_path: Path
) -> None:
    """A failed contestant is reported with its exit code, the end of its log and its CPU time."""
    figures, scene = benchmark.run("pycolmap", tmp_path / "absent", tmp_path / "work", 1, 0)
    assert scene is None
    assert figures["failure"].startswith("ended with code 1: ")
    assert "frames.csv" in figures["failure"]
    assert figures["cpu_s"]["total"] > 0


def test_difference_is_zero_for_the_same_cameras_in_another_gauge(benchmark: ModuleType) -> None:
    """Scenes that differ by a similarity have no difference over their common images."""
    poses = some_poses(6)
    gauge = Similarity(2.5, rotations_from_vectors(np.array([0.3, -1.0, 2.0])), np.ones(3))
    ours = a_scene(["a", "b", "c", "d", "f"], poses[np.array([0, 1, 2, 3, 5])])
    theirs = a_scene(["b", "c", "d", "e", "f"], gauge.apply_to_poses(poses[1:]))
    figures = benchmark.difference(ours, theirs)
    assert figures["frames"] == 4
    assert figures["position_p95_share"] < 1e-12
    assert figures["rotation_p95_deg"] < 1e-5


def test_difference_is_a_share_of_the_cameras_extent(benchmark: ModuleType) -> None:
    """One camera of 60, off by 1 % of the extent, hardly changes the median; `only` keeps the scene order."""
    poses = some_poses(60)
    centers = poses.centers.copy()
    extent = np.linalg.norm(np.ptp(centers, axis=0))
    centers[np.argmin(np.linalg.norm(centers, axis=1))] += [0.01 * extent, 0, 0]
    names = [f"{k:02}" for k in range(60)]
    figures = benchmark.difference(
        a_scene(names, Poses(centers, poses.quats_wxyz)), a_scene(names, poses)
    )
    # The best-fit similarity absorbs about 1/60 of the offset.
    assert figures["position_median_share"] < 0.0005
    ours = benchmark.only(a_scene(names, poses), {"07", "03"})
    assert ours.names == ("03", "07")
    np.testing.assert_array_equal(ours.poses.centers, poses.centers[[3, 7]])


def test_scenes_on_a_line_are_not_compared(benchmark: ModuleType) -> None:
    """Scenes on a straight line, which leaves a rotation undetermined, are reported as not comparable."""
    poses = some_poses(4)
    line = Poses(np.outer(np.arange(4.0), [1, 2, 3]), poses.quats_wxyz)
    scene = a_scene(list("abcd"), line)
    assert "line" in benchmark.difference(scene, scene)["failure"]
