"""Python interface: data read from areas and datasets, documented names, and data loader workers."""

from __future__ import annotations

import pickle
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import spn_data
import spn_model
from spn_data.errors import InputError
from tests.worlds.judged_world import write_judged

ROOT = Path(__file__).resolve().parents[1]
NAMES = [
    name
    for page in sorted((ROOT / "docs" / "api").glob("*.md"))
    for name in re.findall(r"^::: ([\w.]+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset with images in several groups."""
    return write_judged(tmp_path_factory.mktemp("judged") / "dataset.h5")


def test_an_area_is_read_in_a_few_lines(finished_area: Path) -> None:
    """Labels, map and frames of an area are consistent with each other."""
    area = spn_data.open_area(str(finished_area))
    labels = area.labels()
    assert area.sequences[:2] == ("mapping", "mapping (tracked)")
    assert len(labels) == area.frames.chosen.sum()
    seen = area.observations()
    assert set(seen.point_ids.tolist()) <= set(area.map.points.ids.tolist())
    row = int(np.flatnonzero(labels.registered)[0])
    point_ids, pixels = seen.of_frame(row)
    xyz = area.map.points.xyz[area.map.points.rows_of(point_ids)]
    camera = area.map.cameras[str(labels.cameras[row])]
    error = np.linalg.norm(camera.project(labels.poses.to_camera(xyz, row)) - pixels, axis=1)
    assert np.sqrt((error**2).mean()) == pytest.approx(labels.error_px[row], rel=1e-6)
    assert np.isfinite(spn_data.pose_sigmas(labels.covariance[labels.registered])[0]).all()


def test_what_does_not_exist_is_named(finished_area: Path, tmp_path: Path) -> None:
    """An unknown sequence is rejected with a list of those that exist; a missing folder is rejected too."""
    area = spn_data.open_area(finished_area)
    with pytest.raises(InputError, match="no sequence 'low'; the area has: mapping"):
        area.labels("low")
    with pytest.raises(InputError, match="no evaluation sequence 'low'"):
        area.coverage("low")
    with pytest.raises(InputError, match="is not a folder"):
        spn_data.open_area(tmp_path / "nowhere")


def test_samples_are_a_sequence(dataset: Path) -> None:
    """Samples support indexing, negative indices, length and iteration, with the values of the dataset."""
    samples = spn_data.open_samples(str(dataset), "train")
    with spn_data.Dataset(str(dataset)) as opened:
        group = opened["train"]
        assert len(samples) == len(group)
        for row, sample in enumerate(samples):
            assert sample["index"] == row
            np.testing.assert_array_equal(sample["image"], group.image(row))
            np.testing.assert_array_equal(sample["position"], group.poses.centers[row])
            np.testing.assert_array_equal(sample["quaternion"], group.poses.quats_wxyz[row])
        assert samples[-1]["name"] == str(group.names[-1])
    with pytest.raises(IndexError):
        samples[len(samples)]
    with pytest.raises(InputError, match="has no group 'nothing'; it has: "):
        spn_data.open_samples(dataset, "nothing")


def test_samples_survive_pickling(dataset: Path) -> None:
    """An unpickled copy of open samples opens the file again."""
    samples = spn_data.open_samples(dataset, "train")
    copy = pickle.loads(pickle.dumps(samples))
    samples.close()
    np.testing.assert_array_equal(copy[0]["image"], samples[0]["image"])


@pytest.mark.parametrize("method", ["fork", "spawn"])
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_workers_read_what_one_process_reads(dataset: Path, method: str) -> None:
    """Two forked or spawned workers, started with the file open, read the same images as one process."""
    from torch.utils.data import DataLoader

    samples = spn_data.open_samples(dataset, "train")
    expected = [samples[row]["image"] for row in range(len(samples))]
    loader = DataLoader(samples, batch_size=2, num_workers=2, multiprocessing_context=method)
    images = np.concatenate([batch["image"].numpy() for batch in loader])
    np.testing.assert_array_equal(images, np.stack(expected))


def test_the_page_shows_names_that_exist() -> None:
    """Every attribute used in docs/python.md and every name in `__all__` exists."""
    text = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
    for package in (spn_data, spn_model):
        used = set(re.findall(rf"\b{package.__name__}\.([A-Za-z_]\w*)", text))
        used -= {"md"}
        assert used <= set(dir(package)), package.__name__
        for name in package.__all__:
            assert getattr(package, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = spn_data.nothing


def _load(name: str) -> Any:
    """Load a documented name with griffe."""
    griffe = pytest.importorskip("griffe")
    return griffe.load(name, search_paths=[str(ROOT)], docstring_parser="numpy")


@pytest.mark.parametrize("name", NAMES)
def test_documented_names_have_numpydoc_sections(name: str) -> None:
    """Every name in the API reference has numpydoc sections for parameters, attributes and results."""
    found = _load(name)
    if found.is_module:
        return
    assert found.docstring is not None
    members = [found]
    if found.is_class:
        members += [
            member
            for member in found.members.values()
            if member.is_function and not member.name.startswith("_")
        ]
    for member in members:
        assert member.docstring is not None, member.path
        kinds = {section.kind.value for section in member.docstring.parse("numpy")}
        if member.is_class:
            is_enum = any("Enum" in str(base) for base in member.bases)
            assert is_enum or kinds & {"parameters", "attributes"}, name
            continue
        takes = [p.name for p in member.parameters if p.name not in ("self", "cls")]
        if len(takes) > 1:
            assert {"parameters", "returns"} <= kinds, member.path
