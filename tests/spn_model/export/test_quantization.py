"""Tests of 8-bit quantization: activation ranges from all images, and weight scales per channel."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from onnx import numpy_helper
from torch import nn

from spn_data.dataset.hdf5_reader import Dataset
from spn_data.dataset.hdf5_schema import DatasetFrame, DatasetInfo, Role
from spn_data.dataset.hdf5_writer import DatasetWriter
from spn_data.geometry.camera import Camera
from spn_model.export.bundle_checks import BundleOptions
from spn_model.export.bundle_export import _write_graphs
from spn_model.export.graphs import Deployment
from spn_model.networks.imagenet import MEAN, STD
from spn_model.onboard.bundle import GRAPHS, INT8, PoseDecoding

pytestmark = pytest.mark.usefixtures("one_thread")

WIDTH, HEIGHT = 16, 8
CAMERA = Camera("SIMPLE_PINHOLE", WIDTH, HEIGHT, np.array([16.0, 8.0, 4.0]))
GAINS = (0.01, 1.0)  # gains of the two channels


class Amplifier(nn.Module):
    """Network of two channels that scale an image's red, 0 to 255, by two gains, and their sums."""

    def __init__(self, outputs: int):
        super().__init__()
        self.gains = nn.Conv2d(3, 2, 1)
        self.out = nn.Conv2d(2, outputs, 1)
        with torch.no_grad():
            self.gains.weight.zero_()
            self.gains.weight[:, 0, 0, 0] = 255 * STD[0] * torch.tensor(GAINS)
            self.gains.bias.copy_(255 * MEAN[0] * torch.tensor(GAINS))
            nn.init.ones_(self.out.weight)

    def forward(self, image: torch.Tensor) -> tuple[torch.Tensor, ...]:
        made = self.out(torch.relu(self.gains(image))).mean(dim=(2, 3))
        return tuple(made[:, :1] for _ in PoseDecoding(center=np.zeros(3)).outputs)


def write_shades(path: Path, count: int) -> Path:
    """Write a data set of uniform images, image k with a red value of 2 k."""
    info = DatasetInfo(units="m", origin=None, up_is_known=True, camera=CAMERA)
    with DatasetWriter(path, info, {"train": Role.TRAIN}) as writer:
        for k in range(count):
            writer.append(
                "train",
                DatasetFrame(
                    name=f"train/{k:06d}.jpg",
                    sequence="train",
                    time_s=float(k),
                    center=np.zeros(3),
                    quat_wxyz=np.array([1.0, 0, 0, 0]),
                    intrinsics=CAMERA.matrix,
                    image=np.full((HEIGHT, WIDTH, 3), (2 * k, 0, 0), np.uint8),
                    point_ids=np.empty(0, np.int64),
                    point_pixels=np.empty((0, 2), np.float32),
                    point_xyz=np.empty((0, 3)),
                ),
            )
    return path


@pytest.fixture(scope="module")
def quantized(tmp_path_factory: pytest.TempPathFactory) -> tuple[onnx.GraphProto, list[object]]:
    """Return the 8-bit graph from 100 images with default options, and the progress reported."""
    folder = tmp_path_factory.mktemp("amplifier")
    steps: list[object] = []
    deployed = Deployment(Amplifier(1).eval(), PoseDecoding(center=np.zeros(3)), (WIDTH, HEIGHT))
    with Dataset(write_shades(folder / "dataset.h5", 100)) as data:
        _write_graphs(folder, deployed, data, BundleOptions(), lambda *step: steps.append(step))
    return onnx.load(str(folder / GRAPHS[INT8])).graph, steps


def constant(graph: onnx.GraphProto, name: str) -> np.ndarray:
    """Return the values of a constant of a graph."""
    (found,) = (one for one in graph.initializer if one.name == name)
    return numpy_helper.to_array(found)


def test_sixty_four_images_calibrate_the_activations(quantized) -> None:
    """By default 64 of 100 images are used, including the brightest one, whose red of 198 sets the range."""
    graph, steps = quantized
    assert [step for step in steps if step[0] == "int8"] == [("int8", k, 64) for k in range(65)]
    (last,) = (n for n in graph.node if n.op_type == "Conv" and "out" in n.name)
    (scale,) = (n.input[1] for n in graph.node if n.output[0] == last.input[0])
    assert constant(graph, scale) == pytest.approx(198 / 255, rel=1e-4)


def test_each_channel_of_weights_has_its_own_scale(quantized) -> None:
    """Gains of 0.01 and 1 both use all 127 steps, with a separate scale each."""
    graph, _ = quantized
    (first,) = (n for n in graph.node if n.op_type == "Conv" and "gains" in n.name)
    (weights,) = (n for n in graph.node if n.output[0] == first.input[1])
    largest = 255 * STD[0] * np.array(GAINS)
    assert constant(graph, weights.input[1]) == pytest.approx(largest / 127, rel=1e-4)
    assert constant(graph, weights.input[0])[:, 0, 0, 0].tolist() == [127, 127]
