"""Tests of the incremental mapper on synthetic images, in COLMAP's mode and the large-survey mode."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from spn_data.colmap import incremental, pycolmap
from spn_data.colmap.job import MappingJob
from spn_data.colmap.mapping import latest_snapshot
from spn_data.colmap.model import scene_of
from spn_data.geometry.pose import Similarity
from spn_data.work import child

_IMAGES = 40
Events = list[dict[str, int]]


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, pycolmap.Reconstruction]:
    """Return 40 images of 600 points, measured with 0.5 px noise, and the true model."""
    path = tmp_path_factory.mktemp("synthetic") / "database.db"
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=_IMAGES, num_points3D=600
    )
    noise = pycolmap.SyntheticNoiseOptions(point2D_stddev=0.5)
    with pycolmap.Database.open(path) as native:
        truth = pycolmap.synthesize_dataset(options, native)
        measured = pycolmap.Reconstruction(truth)
        pycolmap.synthesize_noise(noise, measured, native)
    return path, truth


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch) -> Events:
    """Record the events sent to the parent process."""
    events: Events = []
    monkeypatch.setattr(child, "send", events.append)
    return events


@pytest.fixture
def large(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Treat 20 images as a large survey, and record the model sizes at each adjustment."""
    monkeypatch.setattr(incremental, "_MAX_IMAGES_COLMAP", 20)
    sizes = []
    adjust_long_tracks: Callable[..., None] = incremental.adjust_long_tracks

    def adjust(model: pycolmap.Reconstruction, **how: object) -> None:
        sizes.append(model.num_reg_images())
        adjust_long_tracks(model, **how)

    monkeypatch.setattr(incremental, "adjust_long_tracks", adjust)
    return sizes


def job(database: Path, folder: Path, start_from: Path | None = None) -> MappingJob:
    for name in ("models", "snapshots"):
        (folder / name).mkdir()
    return MappingJob(
        database=str(database),
        images=str(folder),
        output=str(folder / "models"),
        snapshots=str(folder / "snapshots"),
        threads=1,
        snapshot_every=5,
        start_from="" if start_from is None else str(start_from),
    )


def position_error(model: pycolmap.Reconstruction, truth: pycolmap.Reconstruction) -> float:
    """Return the median position error after alignment, relative to the spread of the cameras."""
    found, right = scene_of(model), scene_of(truth)
    row = {name: k for k, name in enumerate(right.names)}
    true = right.poses.centers[[row[name] for name in found.names]]
    apart = Similarity.fit(found.poses.centers, true).apply(found.poses.centers) - true
    return float(np.median(np.linalg.norm(apart, axis=1)) / np.linalg.norm(true.std(axis=0)))


def test_a_large_survey_is_adjusted_as_it_grows_and_comes_out_as_right(
    database: tuple[Path, pycolmap.Reconstruction], tmp_path: Path, told: Events, large: list[int]
) -> None:
    """A large survey is adjusted at each growth by a third and at the end, and its poses are right."""
    path, truth = database
    models = incremental.map_incrementally(job(path, tmp_path))
    assert [m.num_reg_images() for m in models.values()] == [_IMAGES]
    assert [event["registered"] for event in told] == list(range(2, _IMAGES + 1))
    assert large == [20, 27, 37, 40]
    assert position_error(models[0], truth) < 0.002


def test_up_to_a_thousand_images_colmap_adjusts_by_itself(
    database: tuple[Path, pycolmap.Reconstruction],
    tmp_path: Path,
    told: Events,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Small surveys never use the adjustment meant for large ones."""
    path, truth = database
    monkeypatch.setattr(
        incremental, "adjust_long_tracks", lambda *_, **__: pytest.fail("not its own")
    )
    models = incremental.map_incrementally(job(path, tmp_path))
    assert told[-1] == {"registered": _IMAGES}
    assert position_error(models[0], truth) < 0.002


def test_an_interrupted_large_survey_goes_on_from_its_snapshot(
    database: tuple[Path, pycolmap.Reconstruction],
    tmp_path: Path,
    told: Events,
    large: list[int],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """An interrupted large survey resumes from its snapshot and is completed."""
    path, truth = database

    def send(event: dict[str, int]) -> None:
        told.append(event)
        if event["registered"] == 24:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(child, "send", send)
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
    with pytest.raises(KeyboardInterrupt):
        incremental.map_incrementally(job(path, tmp_path / "first"))
    assert told[-1]["registered"] <= 25
    snapshot = latest_snapshot(tmp_path / "first" / "snapshots")
    assert snapshot is not None
    started = pycolmap.Reconstruction(snapshot).num_reg_images()
    assert started >= 20
    told.clear()
    large.clear()
    monkeypatch.setattr(child, "send", told.append)
    models = incremental.map_incrementally(job(path, tmp_path / "second", snapshot))
    assert [m.num_reg_images() for m in models.values()] == [_IMAGES]
    assert told[-1] == {"registered": _IMAGES}
    assert large[0] == started + 1
    assert position_error(models[0], truth) < 0.002
