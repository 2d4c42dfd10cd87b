"""Tests of worlds whose coordinates float32 cannot resolve: networks there are those of the world at zero."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from safetensors import safe_open

from spn_data.dataset.hdf5_reader import Dataset
from spn_data.errors import FormatError, InputError
from spn_data.storage.files import read_csv
from spn_model.evaluation.evaluate import EvaluateOptions, compare
from spn_model.export.bundle_export import export
from spn_model.models.checkpoint import load, save
from spn_model.models.registry import make
from spn_model.onboard import lines
from spn_model.onboard.localizer import Localizer
from spn_model.prediction.flights import find_flights
from spn_model.prediction.predict import PredictOptions, predict
from spn_model.prediction.predicted_files import COLUMNS
from spn_model.training.recipe import read_recipe
from spn_model.training.train import Data, train
from tests.worlds.judged_world import write_judged, write_network
from tests.worlds.training_world import (
    CAMERA,
    ONE_THREAD,
    TINY_RECIPE,
    Follower,
    files,
    weights,
    write_field,
)

pytestmark = pytest.mark.usefixtures("tiny_kind")

UTM = (500_000.0, 5_400_000.0, 300.0)
EARTH_CENTRED = (4_131_675.25, 610_102.5, 4_804_484.125)


def silent(step: str, done: int, total: int) -> None:
    pass


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Save random images, which have texture."""
    folder = tmp_path_factory.mktemp("photos")
    rng = np.random.default_rng(1)
    for k in range(3):
        Image.fromarray(rng.integers(0, 256, (48, 64, 3), np.uint8)).save(folder / f"{k}.png")
    return folder


def trained(folder: Path, by: tuple[float, float, float]) -> Path:
    """Train in the field moved by an offset, and return the folder."""
    recipe = folder / "tiny.toml"
    recipe.write_text(TINY_RECIPE)
    field = write_field(folder / "field.h5", moved_by=by, offset=by)
    train(read_recipe(recipe), files(folder / "run"), Data(field), ONE_THREAD, Follower())
    return folder / "run"


def predicted(run: Path, photos: Path, to: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return centres and quaternions of poses.csv."""
    flights, _ = find_flights([photos], CAMERA)
    network = load(run / "checkpoint.safetensors")
    predict(network, flights, to, silent, PredictOptions(formats=("csv", "tum")), facts={})
    names = ("x", "y", "z", "qw", "qx", "qy", "qz")
    rows = np.array(
        [[float(row[n]) for n in names] for _, row in read_csv(to / "poses.csv", COLUMNS)]
    )
    return rows[:, :3], rows[:, 3:]


@pytest.fixture(scope="module")
def at_zero(tmp_path_factory: pytest.TempPathFactory, tiny_kind: None) -> Path:
    return trained(tmp_path_factory.mktemp("zero"), (0.0, 0.0, 0.0))


@pytest.mark.parametrize("offset", [UTM, EARTH_CENTRED], ids=["UTM", "Earth-centred"])
def test_a_training_far_from_zero_is_that_at_zero(at_zero, photos, tmp_path, offset):
    """Far from zero, the trained network and its errors are those at zero, and its poses are there."""
    run = trained(tmp_path, offset)
    here, there = (weights(folder / "checkpoint.safetensors") for folder in (at_zero, run))
    for name, tensor in here.items():
        np.testing.assert_allclose(there[name], tensor, rtol=1e-4, atol=1e-4, err_msg=name)
    kept = [
        load(folder / "checkpoint.safetensors").facts["kept"]["validation"]["median_m"]
        for folder in (at_zero, run)
    ]
    assert kept[1] == pytest.approx(kept[0], rel=1e-4)
    near = predicted(at_zero, photos, tmp_path / "near")
    far = predicted(run, photos, tmp_path / "far")
    np.testing.assert_allclose(far[0] - offset, near[0], rtol=0, atol=1e-3)
    np.testing.assert_allclose(far[1], near[1], rtol=0, atol=1e-4)


def test_predicted_files_state_the_offset(photos, tmp_path):
    """predict.json and TUM state the offset that their poses include; at zero nothing is stated."""
    for by in (UTM, (0.0, 0.0, 0.0)):
        field = write_field(tmp_path / f"{by[0]}.h5", 4, 1, moved_by=by, offset=by)
        network = write_network(tmp_path / f"{by[0]}.safetensors", field)
        to, (flights, _) = tmp_path / f"{by[0]}", find_flights([photos], CAMERA)
        predict(network, flights, to, silent, PredictOptions(formats=("csv", "tum")), facts={})
        record = json.loads((to / "predict.json").read_text())
        header, *_ = next((to / "tum").iterdir()).read_text().split("# timestamp")
        assert record.get("offset") == (list(by) if any(by) else None)
        assert ("including the network's offset 500000 5400000 300" in header) is any(by)


def test_a_checkpoint_with_an_offset_has_a_newer_version(tmp_path):
    """Programs that know no offset refuse its version; without an offset it is version 1."""
    for by, version in ((UTM, "2"), ((0.0, 0.0, 0.0), "1")):
        path = tmp_path / f"{version}.safetensors"
        write_network(path, write_field(tmp_path / "f.h5", 4, 1, moved_by=by, offset=by))
        with safe_open(path, "pt") as file:
            header = file.metadata()
        assert header["version"] == version
        assert ("offset" in json.loads(header["document"])["view"]) is any(by)


def test_a_version_and_an_offset_that_contradict_each_other_are_refused(tmp_path, monkeypatch):
    """A checkpoint of version 1 with an offset is damaged."""
    field = write_field(tmp_path / "f.h5", 4, 1, moved_by=UTM, offset=UTM)
    network = write_network(tmp_path / "n.safetensors", field)
    monkeypatch.setattr("spn_model.models.checkpoint.OFFSET_VERSION", 1)
    save(tmp_path / "n.safetensors", network.model, network.view, {})
    monkeypatch.undo()
    with pytest.raises(FormatError, match="its version and its offset contradict each other"):
        load(tmp_path / "n.safetensors")


def test_errors_do_not_depend_on_the_offset_of_the_data_set(tmp_path):
    """A network is evaluated on another data set of its world, whose offset differs."""
    ours, theirs = (
        write_judged(
            tmp_path / f"{name}.h5",
            moved_by=UTM,
            offset=offset,
            origin=None,
            notes=(name,),
        )
        for name, offset in (("ours", UTM), ("theirs", (500_010.0, 5_399_950.0, 250.0)))
    )
    network = write_network(tmp_path / "n.safetensors", ours)
    found = [
        compare(path, {"n": network}, ("3-geo",), silent, EvaluateOptions(baselines=False))
        for path in (ours, theirs)
    ]
    for one, two in zip(*(comparison.groups for comparison in found), strict=True):
        assert np.abs(one.frames.poses.centers - UTM).max() < 60
        errors, others = (of.evaluations[0].errors for of in (one, two))
        assert np.median(errors.error_m) < 100
        np.testing.assert_allclose(errors.signed_m, others.signed_m, rtol=0, atol=1e-6)


def test_the_last_stage_needs_the_offset_of_the_data_set(tmp_path):
    """A recipe that ends on a data set with another offset is refused; one that begins there is not."""
    field = write_field(tmp_path / "field.h5", moved_by=UTM, offset=UTM)
    other = write_field(tmp_path / "other.h5", 7, 2)
    (tmp_path / "tiny.toml").write_text(TINY_RECIPE)
    recipe = read_recipe(tmp_path / "tiny.toml")
    first, last = recipe.stages
    wrong = replace(recipe, stages=(first, replace(last, data="pretraining")))
    with pytest.raises(
        InputError, match=r"have the offset 0 0 0, those of .* have 500000 5400000 300"
    ):
        train(wrong, files(tmp_path / "a"), Data(field, other), ONE_THREAD, Follower())
    right = replace(recipe, stages=(replace(first, data="pretraining"), last))
    train(right, files(tmp_path / "b"), Data(field, other), ONE_THREAD, Follower())


def test_a_bundle_adds_its_offset(tmp_path):
    """Bundle, lines and model card give world positions; bundle.json has version 2 and the offset."""
    field = write_field(tmp_path / "f.h5", 4, 1, moved_by=UTM, offset=UTM)
    view = write_network(tmp_path / "n.safetensors", field).view
    model = make("regression", {"network": "squeezeposenet", "width": 64}, seed=2)
    model.network.regressor.q.bias.data.fill_(0.5)
    model.network.eval()
    with Dataset(field) as data:
        image = data["train"].image(0)
        intrinsics = data["train"].intrinsics[:1]
    own = model.estimate(image[None], intrinsics)
    path = tmp_path / "checkpoint.safetensors"
    save(path, model, view, {})
    made = export(load(path), field, tmp_path / "bundle", {"run": "far"}, silent)
    document = json.loads((made.folder / "bundle.json").read_text())
    assert (document["version"], document["view"]["offset"]) == (2, list(UTM))
    assert "Add the view's offset" in document["conventions"]
    assert "Offset: 500000 5400000 300" in (made.folder / "MODEL_CARD.md").read_text()
    localizer = Localizer(made.folder)
    found = localizer.decode(localizer.run(image[None]))
    np.testing.assert_allclose(found.poses.centers - UTM, own.poses.centers, rtol=0, atol=1e-4)
    cells = lines.csv_line("a.png", 0, 0.0, found, None).split(",")
    np.testing.assert_allclose(
        [float(cell) for cell in cells[4:7]], found.poses.centers[0], rtol=0, atol=1e-6
    )
