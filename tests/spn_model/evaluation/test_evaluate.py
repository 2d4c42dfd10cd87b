"""Tests of evaluation: networks are compared with labels of their own world, without alignment."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from spn_cli.data import main as data_main
from spn_cli.model import main

from spn_data.dataset.hdf5_reader import Dataset
from spn_data.errors import FormatError, InputError
from spn_data.geometry.geodesy import GeoOrigin, HeightReference
from spn_data.geometry.pose import Poses, pose_errors
from spn_data.storage.files import read_csv
from spn_model.evaluation import retrieval
from spn_model.evaluation.baselines import GEM, MEAN, ORACLE, VLAD
from spn_model.evaluation.comparison_files import draw_figures, select_network, write_comparison
from spn_model.evaluation.dropout import dropout_estimates, has_dropout
from spn_model.evaluation.evaluate import (
    EvaluatedGroup,
    EvaluateOptions,
    NetworkComparison,
    compare,
)
from spn_model.models.checkpoint import Checkpoint, load
from spn_model.training.training_figure import read_log, training_figure
from spn_model.training.training_state import COLUMNS
from tests.worlds.judged_world import write_judged, write_network
from tests.worlds.training_world import INFO, TinyModel

pytestmark = pytest.mark.usefixtures("tiny_kind")

WORLD = ("2-model", "3-geo")
ALONE = EvaluateOptions(baselines=False)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the path of a shared data set, which no test may change."""
    return write_judged(tmp_path_factory.mktemp("judged") / "dataset.h5")


@pytest.fixture(scope="module")
def beside(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> NetworkComparison:
    """Compare two networks, a and b, with all baselines."""
    folder = tmp_path_factory.mktemp("networks")
    networks = {n: write_network(folder / n, dataset, seed=k) for k, n in enumerate("ab")}
    return compare(dataset, networks, WORLD, silent, EvaluateOptions())


def silent(step: str, done: int, total: int) -> None:
    assert 0 < done <= total


def judged(
    dataset: Path, options: EvaluateOptions = ALONE, **networks: Checkpoint
) -> NetworkComparison:
    return compare(dataset, networks, WORLD, silent, options)


def group_of(found: NetworkComparison, name: str) -> EvaluatedGroup:
    return next(group for group in found.groups if group.frames.group == name)


def test_errors_are_those_of_what_the_network_says(dataset, tmp_path):
    """Median errors compare the model's own estimates with the labels of every frame in each group."""
    network = write_network(tmp_path / "n.safetensors", dataset)
    found = judged(dataset, n=network)
    assert [g.frames.group for g in found.groups] == ["low", "medium", "validation", "train"]
    with Dataset(dataset) as data:
        for group in found.groups:
            of = data.groups[group.frames.group]
            images = np.stack([of.image(k) for k in range(len(of))])
            away, _ = pose_errors(network.model.estimate(images, of.intrinsics).poses, of.poses)
            (one,) = group.evaluations
            assert one.summary.frames == len(of)
            assert one.summary.position.median == pytest.approx(np.median(away))
            assert one.calibration is not None
    assert found.costs["n"].images == 12 + 3 + 7 + 4
    assert found.costs["n"].seconds > 0


def test_nothing_is_aligned(dataset, tmp_path):
    """Shifting all estimates 5 m east increases the signed error by exactly 5 m east."""
    network = write_network(tmp_path / "n.safetensors", dataset)
    before = group_of(judged(dataset, n=network), "medium").evaluations[0].errors
    assert isinstance(network.model, TinyModel)
    network.model.network.center[0] += 5
    after = group_of(judged(dataset, n=network), "medium").evaluations[0].errors
    np.testing.assert_allclose(after.signed_m - before.signed_m, [[5, 0, 0]] * 7, atol=1e-5)


def test_training_images_are_a_fixed_sample(dataset, tmp_path):
    """Of 12 training images 5 are evaluated, always the same, evenly spread from first to last."""
    network = write_network(tmp_path / "n.safetensors", dataset)
    found = judged(dataset, EvaluateOptions(baselines=False, training_images=5), n=network)
    frames = group_of(found, "train").frames
    assert [int(name[-10:-4]) for name in frames.names] == [0, 3, 6, 8, 11]
    assert found.notes == ("5 of 12 training images were evaluated.",)


MOVED = GeoOrigin(-33.87, 151.2, 12.5, HeightReference.TAKEOFF)
HIGHER = GeoOrigin(-33.86, 151.2, 13.5, HeightReference.TAKEOFF)
ABOVE_SEA = GeoOrigin(-33.86, 151.2, 12.5, HeightReference.AMSL)
OTHER_WORLDS = {
    "its unit is 'model'": {"units": "model"},
    "the vertical is known in only one": {"up_is_known": False},
    "only one of the two is georeferenced": {"origin": None},
    "its origin differs": {"origin": MOVED},
    "3-geo differs": {"fingerprints": {"3-geo": "another"}},
    "2-model differs": {"fingerprints": {**INFO.fingerprints, "2-model": "another"}},
}


@pytest.mark.parametrize("why", OTHER_WORLDS)
def test_another_world_is_refused(dataset, tmp_path, why):
    """A data set of another map is rejected with a message that says what differs."""
    network = write_network(tmp_path / "n.safetensors", dataset)
    other = write_judged(tmp_path / "other.h5", {"train": 2, "low": 1}, **OTHER_WORLDS[why])
    with pytest.raises(InputError, match=why):
        judged(other, n=network)


@pytest.mark.parametrize("origin", [HIGHER, ABOVE_SEA])
def test_another_height_is_another_world(dataset, tmp_path, origin):
    """An origin with another height or height reference is rejected."""
    network = write_network(tmp_path / "n.safetensors", dataset)
    other = write_judged(tmp_path / "other.h5", {"train": 2, "low": 1}, origin=origin)
    with pytest.raises(InputError, match="its origin differs"):
        judged(other, n=network)


def test_worlds_that_nothing_tells_apart_are_refused(tmp_path):
    """Without map fingerprints, only the training data set itself is accepted."""
    plain = write_judged(tmp_path / "plain.h5", fingerprints={})
    network = write_network(tmp_path / "n.safetensors", plain)
    judged(plain, n=network)
    other = write_judged(tmp_path / "b.h5", {"train": 9, "medium": 2}, fingerprints={})
    with pytest.raises(InputError, match="no fingerprint shows that both belong to the same map"):
        judged(other, n=network)


def test_another_split_of_the_same_world_is_judged(dataset, tmp_path):
    """A data set registered or split again in the same map is accepted."""
    network = write_network(tmp_path / "n.safetensors", dataset)
    prints = {**INFO.fingerprints, "4-eval/new": "0f0f"}
    other = write_judged(tmp_path / "b.h5", {"train": 9, "medium": 5}, fingerprints=prints)
    assert len(group_of(judged(other, n=network), "medium").frames) == 5


def test_another_camera_needs_a_network_that_takes_any(dataset, tmp_path, monkeypatch):
    """Images of another camera are rejected unless the kind of model decodes with K."""
    network = write_network(tmp_path / "n.safetensors", dataset)
    assert INFO.camera is not None
    lens = replace(INFO.camera, params=INFO.camera.params * [1.1, 1, 1])
    other = write_judged(tmp_path / "b.h5", camera=lens)
    with pytest.raises(InputError, match="of another camera than n was trained for"):
        judged(other, n=network)
    monkeypatch.setattr(TinyModel, "any_camera", True)
    judged(other, n=network)


def test_empty_groups_are_told_and_all_empty_refused(tmp_path):
    """An empty group is skipped with a note; if all groups are empty, evaluation fails."""
    path = write_judged(tmp_path / "a.h5", {"train": 6, "medium": 3})
    network = write_network(tmp_path / "n.safetensors", path)
    found = judged(path, n=network)
    assert "Group low is empty and was skipped." in found.notes
    empty = write_judged(tmp_path / "b.h5", {"train": 6})
    with pytest.raises(InputError, match="every test and validation group is empty"):
        judged(empty, n=network)


def test_a_data_set_of_another_version_is_refused(dataset, tmp_path):
    """A data set of an unknown format version is rejected."""
    import h5py

    network = write_network(tmp_path / "n.safetensors", dataset)
    other = Path(shutil.copy(dataset, tmp_path / "other.h5"))
    with h5py.File(other, "r+") as file:
        file.attrs["version"] = 99
    with pytest.raises(FormatError, match="has format version 99"):
        judged(other, n=network)


def test_baselines_stand_beside_networks_but_not_for_training_images(beside):
    """Each group has all baselines, but training images only the mean pose: retrieval would find itself."""
    medium = group_of(beside, "medium")
    assert [e.method for e in medium.evaluations] == ["a", "b", MEAN, VLAD, GEM, ORACLE]
    assert medium.retrieval in (VLAD, GEM)
    train = group_of(beside, "train")
    assert [e.method for e in train.evaluations] == ["a", "b", MEAN]
    assert train.retrieval is None


def test_what_looks_alike_is_found_once(dataset, tmp_path, monkeypatch):
    """Cached retrieval rows are reused only for the same data set.

    Damaged rows or rows of another data set are recomputed, and no pose is cached.
    """
    kept = tmp_path / "runs" / "kept.json"
    described: list[int] = []

    def colours(images):
        described.append(len(images))
        mean = np.stack([images.image(row).mean(axis=(0, 1)) for row in range(len(images))])
        return (mean / np.linalg.norm(mean, axis=1, keepdims=True)).astype(np.float32)

    monkeypatch.setattr(retrieval, "vlad", lambda training: colours)
    monkeypatch.setattr(retrieval, "gem", lambda maps: colours)

    def found(path: Path) -> dict[str, list[np.ndarray]]:
        described.clear()
        with Dataset(path) as data:
            groups = [data.groups[name] for name in ("low", "medium")]
            return retrieval.most_similar_images(data, data.groups["train"], groups, silent, kept)

    first = found(dataset)
    assert described == [12, 4, 7, 12, 4, 7]
    rows = json.loads(kept.read_text())["rows"]
    assert {type(row) for of in rows.values() for group in of for row in group} == {int}
    second = found(dataset)
    assert described == []
    for method in (VLAD, GEM):
        for one, two in zip(first[method], second[method], strict=True):
            np.testing.assert_array_equal(one, two)
    kept.write_bytes(kept.read_bytes()[:200])
    found(dataset)
    assert len(described) == 6
    text = kept.read_text()
    for wrong in ("12", "-2", '"x"'):  # invalid rows
        kept.write_text(re.sub(r"(\[\s*)\d+,", rf"\g<1>{wrong},", text, count=1))
        found(dataset)
        assert len(described) == 6, wrong
    found(write_judged(tmp_path / "b.h5", {"train": 9, "medium": 5, "low": 2}))
    assert described == [9, 2, 5, 9, 2, 5]
    found(dataset)
    alike = write_judged(tmp_path / "c.h5", fingerprints={**INFO.fingerprints, "1-frames": "x"})
    found(alike)
    assert len(described) == 6


def test_dropout_scatters_and_leaves_the_network_as_it_was(dataset, tmp_path):
    """Dropout samples scatter, depend only on the seed, and leave dropout disabled afterwards."""
    network = write_network(tmp_path / "n.safetensors", dataset, dropout=0.5)
    with Dataset(dataset) as data:
        of = data.groups["medium"]
        images, k = np.stack([of.image(row) for row in range(3)]), of.intrinsics[:3]
    before = network.model.estimate(images, k).poses.centers
    found = dropout_estimates(network.model, images, k, 40, seed=1)
    again = dropout_estimates(network.model, images, k, 40, seed=1)
    np.testing.assert_array_equal(found.covariance, again.covariance)
    others = dropout_estimates(network.model, images, k, 40, seed=2)
    assert not np.array_equal(found.covariance, others.covariance)
    assert (np.linalg.eigvalsh(found.covariance[:, :3, :3])[:, -1] > 1e-6).all()
    np.testing.assert_array_equal(network.model.estimate(images, k).poses.centers, before)
    single = dropout_estimates(network.model, images[:1], k[:1], 40, seed=1)
    assert np.linalg.norm(single.poses.centers[0] - before[0]) < 3 * np.sqrt(
        np.trace(single.covariance[0, :3, :3])
    )


def test_dropout_stands_beside_its_network_where_there_is_any(dataset, tmp_path):
    """A network with dropout gets a second row; one without gets a note that dropout was skipped."""
    some = write_network(tmp_path / "a.safetensors", dataset, dropout=0.5)
    none = write_network(tmp_path / "b.safetensors", dataset, dropout=0.0)
    assert has_dropout(some.model)
    found = judged(dataset, replace(ALONE, dropout_samples=8), some=some, none=none)
    assert found.networks == ("some", "some, 8 dropout samples", "none")
    assert "none has no dropout layers: Monte-Carlo dropout was skipped." in found.notes
    assert select_network(found, "some").networks == ("some", "some, 8 dropout samples")
    assert select_network(found, "none").networks == ("none",)


def test_files_of_a_comparison(beside, tmp_path):
    """Each run's folder holds its own network and the baselines, with figures of held-out groups."""
    names = {"metrics": "metrics.json", "errors": "errors.csv", "drawings": "figures"}
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "old.svg").write_text("<svg")
    write_comparison(
        select_network(beside, "a"), {"runs": {}}, **{k: tmp_path / v for k, v in names.items()}
    )
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert sorted(metrics["groups"]["medium"]) == sorted(["a", MEAN, VLAD, GEM, ORACLE])
    assert metrics["facts"]["roles"]["medium"] == "test"
    assert metrics["facts"]["costs"]["a"]["images"] == 26
    rows = [row["method"] for _, row in read_csv(tmp_path / "errors.csv", _columns(tmp_path))]
    assert rows.count("a") == 26
    assert "b" not in rows
    kinds = ("calibration", "distance", "histograms", "trajectories")
    assert sorted(path.name for path in (tmp_path / "figures").iterdir()) == [
        f"{group}-{kind}.svg" for group in ("low", "medium", "validation") for kind in kinds
    ]


def _columns(folder: Path) -> list[str]:
    return (folder / "errors.csv").read_text().splitlines()[0].split(",")


def test_a_group_of_any_name_gets_files_inside_its_folder(dataset, tmp_path):
    """Group names from the data set cannot lead out of the folder or overwrite another group's figures."""
    network = write_network(tmp_path / "n.safetensors", dataset)
    found = judged(dataset, n=network)
    low, medium = group_of(found, "low"), group_of(found, "medium")
    hostile = [
        replace(low, frames=replace(low.frames, group="../../up")),
        replace(medium, frames=replace(medium.frames, group="..\\..\\up")),
    ]
    folder = tmp_path / "out"
    folder.mkdir()
    write_comparison(
        replace(found, groups=tuple(hostile)),
        {},
        metrics=folder / "m.json",
        errors=folder / "e.csv",
        drawings=folder / "figures",
    )
    assert len(list((folder / "figures").glob("up*.svg"))) == 8
    assert {path.name for path in folder.iterdir()} == {"m.json", "e.csv", "figures"}


def test_figures_hold_the_network_beside_the_better_retrieval(beside):
    """Trajectories and histograms show the network and the better retrieval baseline."""
    found = select_network(beside, "b")
    medium = group_of(found, "medium")
    figures = draw_figures(medium, found)
    assert medium.retrieval is not None
    for what in ("trajectories", "histograms"):
        assert ">b<" in figures[what] or ">b (" in figures[what]
        assert medium.retrieval in figures[what]
    assert draw_figures(group_of(found, "train"), found) == {}


LOG = [
    dict(event="steps", stage="head", images="40", train_s="30", loss="2.5"),
    dict(event="validation", stage="head", images="40", train_s="30", median_m="4", median_deg="9"),
    dict(event="steps", stage="all", images="80", train_s="60", loss="1.5"),
    dict(event="validation", stage="all", images="80", train_s="60", median_m="inf"),
]


def write_log(path: Path, rows: list[dict[str, str]]) -> Path:
    lines = [",".join(row.get(name, "") for name in COLUMNS) for row in rows]
    path.write_text("\n".join([",".join(COLUMNS), *lines]) + "\n")
    return path


def test_the_course_of_a_training_is_drawn(tmp_path):
    """Loss, errors and stages are plotted over minutes; undefined errors are omitted, not drawn as zero."""
    log = read_log(write_log(tmp_path / "log.csv", LOG))
    assert log.facts() == {"minutes": 1.0, "images": 80}
    assert log.stages == (("head", 0.0), ("all", 0.5))
    np.testing.assert_array_equal(log.errors["validation"][0].values, [4, np.nan])
    figure = training_figure(log)
    assert "training: 1.0 minutes, 80 images" in figure
    assert "all from 0.5 min" in figure
    assert figure.count("<circle") == 2 + 2  # the legend's, and one validation in two panels
    assert "rendered views" not in figure
    shown = [*LOG, {**LOG[1], "event": "views"}]
    assert "rendered views" in training_figure(read_log(write_log(tmp_path / "log.csv", shown)))


@pytest.mark.parametrize("cell", ["train_s", "images", "loss"])
def test_a_damaged_log_is_told_with_its_line(tmp_path, cell):
    """A non-numeric cell in a training log raises an error that names the line."""
    path = write_log(tmp_path / "log.csv", [LOG[0], {**LOG[2], cell: "<svg>"}])
    with pytest.raises(InputError, match=r"log\.csv:3: is not a training log"):
        read_log(path)


def evaluated(area: Path, *words: str) -> Result:
    fixed = ["--area", str(area), "--device", "cpu", "--threads", "1"]
    return CliRunner().invoke(main, ["evaluate", *fixed, *words], env={"COLUMNS": "200"})


def place_run(area: Path, name: str, seed: int) -> None:
    """Create a run folder as training leaves it."""
    dataset = area.parent / "own.h5"
    if not dataset.exists():
        write_judged(dataset)
    folder = area / "runs" / name
    folder.mkdir(parents=True)
    write_network(folder / "checkpoint.safetensors", dataset, seed=seed)
    write_log(folder / "log.csv", LOG)


def test_several_runs_stand_in_one_table(tmp_path):
    """Each run's folder gets its own files, `compared` those of both; tables name all methods."""
    area = tmp_path / "area"
    place_run(area, "first", 0)
    place_run(area, "second", 1)
    words = ("--run", "first", "--run", "second", "--batch", "3")
    ran = evaluated(area, str(tmp_path / "own.h5"), *words)
    assert ran.exit_code == 0, ran.output
    for words in ("medium: errors of 7 test frames", "first", "second", ORACLE, "in the paper*"):
        assert words in ran.output
    for folder in ("first", "second", "compared"):
        metrics = json.loads((area / "runs" / folder / "metrics.json").read_text())
        both = folder == "compared"
        assert set(metrics["facts"]["runs"]) == ({"first", "second"} if both else {folder})
        assert (area / "runs" / folder / "figures" / "training.svg").exists() != both
    assert load(area / "runs" / "first" / "checkpoint.safetensors").facts["images_shown"] == 40
    shown = CliRunner().invoke(data_main, ["status", "--area", str(area)])
    assert "is not an area" in shown.output  # a folder that holds only networks


def test_facts_of_a_run_are_documented(tmp_path):
    """docs/evaluation.md documents all facts in metrics.json about a run, its network and its cost."""
    place_run(tmp_path / "area", "first", 0)
    words = ("--run", "first", "--no-baselines")
    assert evaluated(tmp_path / "area", str(tmp_path / "own.h5"), *words).exit_code == 0
    metrics = json.loads((tmp_path / "area" / "runs" / "first" / "metrics.json").read_text())
    facts = metrics["facts"]
    page = (Path(__file__).resolve().parents[3] / "docs" / "evaluation.md").read_text("utf-8")
    table = page.split("### Facts")[1].split("\n##")[0]
    assert re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE) == list(
        dict.fromkeys(["roles", "networks", "runs", "costs", "dataset", "notes", *facts])
    )
    named = set(re.findall(r"`(\w+)`", table))
    assert {*facts["runs"]["first"], *facts["runs"]["first"]["course"]} <= named
    assert set(facts["costs"]["first"]) <= named


def test_a_run_that_is_not_there_is_told(tmp_path):
    """A missing run names the folder and the command that makes it; `compared` is not a valid run name."""
    ran = evaluated(tmp_path / "area", "--run", "nothing")
    assert ran.exit_code == 1
    assert "holds no trained network; run spn-model train --run nothing first" in ran.output
    for name in ("compared", "../up", ""):
        ran = evaluated(tmp_path / "area", "--run", name)
        assert ran.exit_code == 1
        assert "is not a valid run name" in ran.output


def test_an_area_without_a_split_says_what_to_do(tmp_path):
    """Without DATASET the area's own is used; if it is missing, the message names the command to run."""
    place_run(tmp_path / "area", "first", 0)
    ran = evaluated(tmp_path / "area", "--run", "first")
    assert ran.exit_code == 1
    assert "run spn-data split first" in ran.output


def test_a_frame_without_a_pose_counts_as_infinitely_wrong(dataset, tmp_path, monkeypatch):
    """If the network finds no pose for any frame, median errors are infinite."""
    network = write_network(tmp_path / "n.safetensors", dataset)
    real = network.model.estimate

    def lost(images, intrinsics):
        found = real(images, intrinsics)
        return replace(found, poses=Poses.unknown(len(images)))

    monkeypatch.setattr(network.model, "estimate", lost)
    summary = group_of(judged(dataset, n=network), "medium").evaluations[0].summary
    assert summary.located == 0
    assert summary.position.median == np.inf
    assert all(part.share == 0 for part in summary.within)
