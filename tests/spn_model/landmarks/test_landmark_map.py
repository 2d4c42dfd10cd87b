"""The file of a landmark map, and its selection from an area."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from spn_cli.data import main

from spn_data.area.area import Area
from spn_data.area.names import DATASET, SPLIT
from spn_data.dataset.hdf5_reader import Dataset
from spn_data.dataset.hdf5_schema import Role
from spn_data.errors import FormatError, InputError
from spn_data.inputs.landmark_source import read_landmark_source
from spn_model.export.landmark_export import write_landmarks
from spn_model.landmarks.landmark_map import LandmarkMap
from tests.worlds.landmark_world import room


def test_a_map_is_read_as_it_was_written(tmp_path):
    """Positions to 1 um, covariances to 1 %, descriptors exactly; facts too."""
    before = room(count=300)
    before.save(tmp_path / "landmarks.npz")
    after = LandmarkMap.load(tmp_path / "landmarks.npz")
    assert np.abs(after.xyz - before.xyz).max() < 1e-6
    assert np.allclose(after.covariance, before.covariance, rtol=0.01, atol=1e-9)
    assert np.array_equal(after.descriptors, before.descriptors)
    assert after.facts == before.facts


def _without(arrays):
    del arrays["xyz"]


def _foreign_row(arrays):
    arrays["landmark"][-1] = 7000


def _not_finite(arrays):
    arrays["xyz"][3] = np.nan


def _other_shape(arrays):
    arrays["descriptors"] = arrays["descriptors"][:, :64]


def _pickled(arrays):
    arrays["sizes_m"] = np.array([{}] * len(arrays["sizes_m"]), dtype=object)


def _version(arrays):
    text = arrays["facts"].tobytes().replace(b'"version": 1', b'"version": 9')
    arrays["facts"] = np.frombuffer(text, np.uint8)


@pytest.mark.parametrize(
    "damage", [_without, _foreign_row, _not_finite, _other_shape, _pickled, _version]
)
def test_a_damaged_map_is_refused_in_one_line(tmp_path, damage):
    """Arrays that are missing, of another kind or shape, or contradict each other are a FormatError."""
    path = tmp_path / "landmarks.npz"
    room(count=50).save(path)
    with np.load(path) as opened:
        arrays = {name: opened[name].copy() for name in opened}
    damage(arrays)
    np.savez(path, **arrays)
    with pytest.raises(FormatError, match="copy the bundle again"):
        LandmarkMap.load(path)


def test_a_file_cut_short_is_refused(tmp_path):
    """Half a file is a FormatError, and so is no file."""
    path = tmp_path / "landmarks.npz"
    with pytest.raises(FormatError, match="copy the whole bundle"):
        LandmarkMap.load(path)
    room(count=50).save(path)
    path.write_bytes(path.read_bytes()[:9000])
    with pytest.raises(FormatError, match="is damaged"):
        LandmarkMap.load(path)


@pytest.fixture(scope="module")
def split_area(finished_area, tmp_path_factory) -> Area:
    """The area of the short flight with its data set."""
    folder = tmp_path_factory.mktemp("landmarks") / "area"
    shutil.copytree(finished_area, folder)
    result = CliRunner().invoke(main, ["split", "--area", str(folder)])
    assert result.exit_code == 0, result.output
    return Area(folder)


def test_landmarks_come_from_training_frames_alone(split_area, tmp_path):
    """Each landmark lies where at least three training frames see it; a small map holds fewer; bytes fit."""
    sizes, source = {}, read_landmark_source(split_area)
    with Dataset(split_area.folder(SPLIT) / DATASET) as data:
        seen = np.concatenate(
            [
                group.points(row).xyz
                for group in data.of_role(Role.TRAIN)
                for row in np.flatnonzero(~group.tracked)
            ]
        )
        for megabytes in (0.1, 1.0):
            path = tmp_path / f"{megabytes}.npz"
            made = write_landmarks(
                path,
                source,
                data,
                "0",
                np.zeros(3),
                max_bytes=int(1e6 * megabytes),
            )
            assert path.stat().st_size <= 1e6 * megabytes
            sizes[megabytes] = made.landmarks
            found = LandmarkMap.load(path)
            assert len(found) == made.landmarks
            for xyz in found.xyz[::20]:
                assert np.count_nonzero(np.abs(seen - xyz).max(axis=1) < 1e-4) >= 3
    assert 100 < sizes[0.1] < sizes[1.0]


def test_the_data_set_of_another_map_is_refused(split_area, tmp_path):
    """A data set that was not made from the map of the area gives no landmarks, and the message says why."""
    with Dataset(split_area.folder(SPLIT) / DATASET) as data:
        source = replace(read_landmark_source(split_area), fingerprint="another")
        with pytest.raises(InputError, match="not made from the map of this area"):
            write_landmarks(
                tmp_path / "l.npz",
                source,
                data,
                "0",
                np.zeros(3),
                max_bytes=10**6,
            )
