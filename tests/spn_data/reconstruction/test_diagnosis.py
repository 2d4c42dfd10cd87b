"""Reasons why frames were not registered, on 20 synthetic images plus frames that fail to match."""

from __future__ import annotations

import re

import numpy as np
import pytest

from spn_data.colmap import pycolmap
from spn_data.colmap.database import DatabaseImage, MapDatabase
from spn_data.colmap.model import read_map, write_native
from spn_data.colmap.verify import VerifiedPair
from spn_data.geometry.camera import Camera
from spn_data.geometry.initial_lens import InitialLens
from spn_data.matching.features import Features
from spn_data.reconstruction.correspondences import FramesToMap
from spn_data.reconstruction.diagnosis import FrameRegistration, diagnose, missing_passages

CAMERA = Camera.from_horizontal_fov(1024, 768, 60, (0.0,))


def features(n: int) -> Features:
    rng = np.random.default_rng(n)
    return Features(
        rng.uniform(0, 700, (n, 4)).astype(np.float32),
        rng.integers(0, 255, (n, 128)).astype(np.uint8),
    )


@pytest.fixture(scope="module")
def registrations(tmp_path_factory: pytest.TempPathFactory) -> dict[str, FrameRegistration]:
    """Registrations of the synthetic images and of five more frames.

    Of the five, one has few features, one has no match, two match only each other, and one matches the model.
    """
    folder = tmp_path_factory.mktemp("diagnosis")
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=20, num_points3D=200
    )
    with pycolmap.Database.open(folder / "database.db") as native:
        truth = pycolmap.synthesize_dataset(options, native)
    write_native(truth, folder / "model")
    names = tuple(sorted(truth.images[i].name for i in truth.reg_image_ids()))
    more = ("few", "alone", "pair-1", "pair-2", "near")
    every = (*names, *more)
    inliers = np.stack([np.arange(30), np.arange(30)], axis=1).astype(np.uint32)
    with MapDatabase.open(folder / "database.db") as database:
        database.add_images(
            [DatabaseImage(name, "other") for name in more],
            {"other": InitialLens(CAMERA, 0.05, "")},
        )
        for name in more:
            database.write_features(name, features(40 if name == "few" else 400))
        for a, b in (("pair-1", "pair-2"), (names[3], "near")):
            pair = (database.ids[a], database.ids[b])
            database.write_pair(VerifiedPair(pair, inliers, inliers, 3, None, np.eye(3), None))
        frames = FramesToMap(
            folder,
            every,
            np.array(["a"] * len(every)),
            np.array(["a"] * len(every)),
            np.full((len(every), 3), np.nan),
            {"a": InitialLens(CAMERA, 0.05, "")},
            {},
        )
        return {
            row.name: row for row in diagnose(database, frames, *read_map(folder / "model")[:2])
        }


def test_registered_frames_have_observations_and_an_error_but_no_reason(
    registrations: dict[str, FrameRegistration],
) -> None:
    """Registered frames have observations and a reprojection error, but no reason for failure."""
    registered = [row for row in registrations.values() if row.registered]
    assert len(registered) == 20
    assert all(row.reason == "" and row.observations > 50 for row in registered)
    assert max(row.error_px for row in registered) < 1e-6


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("few", "only 40 features"),
        ("alone", "400 features, but no verified match with any frame"),
        ("pair-1", r"matches 1 frames \(best pair-2, 30 inliers\), all of them missing too"),
        ("near", "matches 1 registered frames .* but no pose agrees"),
    ],
)
def test_a_missing_frame_says_why(
    registrations: dict[str, FrameRegistration], name: str, reason: str
) -> None:
    """Each frame that was not registered has the expected reason."""
    row = registrations[name]
    assert not row.registered
    assert np.isnan(row.error_px)
    assert re.search(reason, row.reason)


def test_missing_passages_are_runs_of_one_sequence_with_their_times_and_commonest_reason() -> None:
    """Missing frames are grouped into runs per sequence, with times and the commonest reason."""

    def row(name: str, reason: str) -> FrameRegistration:
        return FrameRegistration(name, not reason, reason, 500, 3, 0, float("nan"))

    reasons = ["", "dark", "dark", "blurred", "", "dark", "dark", ""]
    rows = tuple(row(f"f{k}", reason) for k, reason in enumerate(reasons))
    sequences = np.array(["a"] * 6 + ["b"] * 2)
    told = missing_passages(rows, sequences, np.arange(8) * 1.5)
    assert told == (
        "a, 1.5 to 4.5 s: 3 of 6 frames are missing; dark",
        "a, 7.5 to 7.5 s: 1 of 6 frames are missing; dark",
        "b, 9.0 to 9.0 s: 1 of 2 frames are missing; dark",
    )
