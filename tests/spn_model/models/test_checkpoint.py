"""Tests of checkpoints: they are restored completely, and other files are rejected clearly."""

from __future__ import annotations

import errno
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from spn_data.dataset.hdf5_reader import Dataset
from spn_data.errors import FormatError, InputError, StageError
from spn_model.examples.dataset_view import view_of
from spn_model.examples.training_set import TrainingSet
from spn_model.models.checkpoint import FORMAT, Checkpoint, load, save
from spn_model.onboard.view import View
from tests.worlds.training_world import CAMERA, INFO, TinyModel, write_field

pytestmark = pytest.mark.usefixtures("tiny_kind")


@pytest.fixture(scope="module")
def field(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_field(tmp_path_factory.mktemp("field") / "dataset.h5", 6, 3)


@pytest.fixture
def saved(field: Path, tmp_path: Path) -> tuple[Path, TinyModel, View]:
    """Save a checkpoint whose weights, statistics and counter differ from a new model's."""
    model = TinyModel.make({"width": 5, "dropout": 0.25}, seed=3)
    with Dataset(field) as dataset:
        model.fit(TrainingSet(dataset.groups["train"]))
        view = view_of(dataset)
    model.network.train()
    model.network(torch.rand(4, 3, 48, 64))
    path = tmp_path / "runs" / "a" / "checkpoint.safetensors"
    save(path, model, view, {"images": 96, "error": float("inf"), "table": [1.5, None]})
    return path, model, view


def rewritten(path: Path, **changes: object) -> Path:
    """Return a copy with changed values in its document, or with changed tensors."""
    from safetensors import safe_open

    with safe_open(path, "pt") as file:
        header = dict(file.metadata())
    tensors = load_file(path)
    document = json.loads(header["document"])
    for name, value in changes.items():
        if name in ("format", "version"):
            header[name] = str(value)
        elif name in tensors or isinstance(value, torch.Tensor):
            tensors[name] = value
        else:
            document[name] = value
    header["document"] = json.dumps(document)
    other = path.with_name("other.safetensors")
    save_file({k: v for k, v in tensors.items() if v is not None}, other, header)
    return other


def test_a_checkpoint_alone_gives_the_same_poses(saved, field):
    """The loaded model estimates bit-identical poses and knows its camera."""
    path, model, view = saved
    found = load(path)
    assert isinstance(found, Checkpoint)
    assert found.model.options == {"width": 5, "dropout": 0.25, "normalised": True}
    assert found.facts == {"images": 96, "error": None, "table": [1.5, None]}
    assert found.view.to_json() == view.to_json()
    assert found.view.camera is not None
    assert found.view.camera.params.tolist() == CAMERA.params.tolist()
    assert (found.view.size, found.view.units, found.view.origin) == ((64, 48), "m", INFO.origin)
    assert not found.model.network.training
    model.network.eval()
    with Dataset(field) as dataset:
        group = dataset.groups["validation"]
        images = np.stack([group.image(k) for k in range(len(group))])
        old = model.estimate(images, group.intrinsics)
        new = found.model.estimate(images, group.intrinsics)
    assert np.array_equal(old.poses.centers, new.poses.centers)
    assert np.array_equal(old.poses.quats_wxyz, new.poses.quats_wxyz)
    assert np.ptp(old.poses.centers, axis=0).max() > 1e-3


def test_weights_in_channels_last_are_saved_as_they_are(saved, tmp_path):
    """A network in channels-last memory format is saved in the default layout."""
    _, model, view = saved
    before = {k: v.clone() for k, v in model.network.state_dict().items()}
    model.network.to(memory_format=torch.channels_last)
    save(tmp_path / "b.safetensors", model, view, {})
    after = load(tmp_path / "b.safetensors").model.network.state_dict()
    assert before.keys() == after.keys()
    assert all(torch.equal(before[name], after[name]) for name in before)


def test_a_full_disk_keeps_the_old_checkpoint(saved, monkeypatch):
    """A failed write names file and reason, keeps the old checkpoint, and leaves no temporary file."""
    path, model, view = saved
    before = path.read_bytes()

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("spn_data.storage.files.os.fsync", full)
    with pytest.raises(
        StageError, match=r"checkpoint\.safetensors cannot be written: No space left"
    ):
        save(path, model, view, {})
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path]


def test_what_is_no_file_is_told(tmp_path):
    """A missing path or a folder raises InputError."""
    with pytest.raises(InputError, match="does not exist"):
        load(tmp_path / "none.safetensors")
    with pytest.raises(InputError, match="is not a file"):
        load(tmp_path)


def test_another_file_is_refused(saved, tmp_path):
    """Published weights, another format of ours and another version are rejected with a specific message."""
    path, _, _ = saved
    save_file({"a": torch.zeros(2)}, tmp_path / "w.safetensors")
    with pytest.raises(FormatError, match="is not a checkpoint of this program"):
        load(tmp_path / "w.safetensors")
    with pytest.raises(FormatError, match="is not a checkpoint of this program"):
        load(rewritten(path, format="squeezeposenet-state"))
    with pytest.raises(FormatError, match=r"has format version 3, this program reads 1 and 2"):
        load(rewritten(path, version=3))
    assert load(rewritten(path, format=FORMAT, version=1)).facts["images"] == 96


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"kind": "nerf"}, "unknown kind of network 'nerf'"),
        ({"kind": 3}, "damaged checkpoint"),
        ({"options": {"depth": 3}}, "kind tiny has no option 'depth'"),
        (
            {"options": {"width": 6}},
            "5 of float32, needs to be 6 of float32|belongs to another network",
        ),
        ({"options": None}, "damaged checkpoint"),
        ({"view": {}}, "damaged checkpoint"),
        ({"view": []}, "damaged checkpoint"),
        ({"facts": None}, "damaged checkpoint"),
        ({"out.bias": None}, r"belongs to another network: 'out\.bias' is missing"),
        ({"out.bias": torch.zeros(6)}, "'out.bias' is 6 of float32, needs to be 7 of float32"),
        ({"out.bias": torch.zeros(7).double()}, "'out.bias' is 7 of float64"),
        ({"out.bias": torch.full((7,), torch.nan)}, "'out.bias' has values that are not finite"),
        ({"more": torch.zeros(1)}, "belongs to another network: unexpected 'more'"),
    ],
)
def test_what_does_not_fit_is_refused(saved, changes, told):
    """Another kind, other options, other tensors and damage each give one clear line with the path."""
    other = rewritten(saved[0], **changes)
    with pytest.raises(FormatError, match=told) as caught:
        load(other)
    assert str(caught.value).startswith(f"{other}: ")


def test_a_file_cut_short_is_refused(saved):
    """A file truncated at any length is rejected."""
    path, _, _ = saved
    content = path.read_bytes()
    for length in (0, 7, 100, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:length])
        with pytest.raises(FormatError, match="is not a checkpoint, or damaged"):
            load(path)


def test_the_view_is_that_of_the_data_set(saved, field, tmp_path):
    """The view changes with the data set file, and reading its JSON rejects invalid values."""
    _, _, view = saved
    with Dataset(write_field(tmp_path / "other.h5", 5, 1)) as dataset:
        assert view_of(dataset).dataset != view.dataset
    value = json.loads(json.dumps(view.to_json()))
    assert View.from_json(value).to_json() == view.to_json()
    for name, wrong in (("units", "ft"), ("size", [0, 3]), ("size", [3]), ("up_is_known", 1)):
        with pytest.raises((ValueError, TypeError)):
            View.from_json({**value, name: wrong})
    with pytest.raises(ValueError, match="is not a valid location"):
        View.from_json({**value, "origin": {**value["origin"], "lat_deg": 95}})
