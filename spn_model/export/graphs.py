"""Export of a pose model to an ONNX graph: uint8 image in, inputs of the pose decoding out."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from spn_data.errors import InputError
from spn_model.models.pose_model import PoseModel
from spn_model.models.regression import RegressionModel
from spn_model.models.regression_examples import input_size, resized
from spn_model.models.scene_coordinates import SceneCoordinatesModel
from spn_model.networks.imagenet import MEAN, STD
from spn_model.onboard.bundle import INPUT, CellDecoding, Decoding, PoseDecoding

_OPSET = 17  # read by onnxruntime from 1.12 on


@dataclass(frozen=True, eq=False)
class Deployment:
    """A pose model prepared for export.

    network : maps images (1, 3, h, w), normalised as for ImageNet, to outputs in the order of
    decoding.outputs; decoding : converts the outputs to a pose on board; size : (width, height) of the
    graph's input.
    """

    network: nn.Module
    decoding: Decoding
    size: tuple[int, int]

    def graph_input(self, image: np.ndarray) -> np.ndarray:
        """Resize a data set image to the input of the graph, (1, h, w, 3)."""
        return np.ascontiguousarray(resized(image, self.size[0]))[None]


def deployment(model: PoseModel, size: tuple[int, int]) -> Deployment:
    """Prepare a pose model for images of a size (width, height), as in the data set.

    Raises InputError for a kind of network that cannot be exported.
    """
    if isinstance(model, SceneCoordinatesModel):
        cells = CellDecoding(
            first_px=model.network.first_cell_px,
            stride_px=model.network.stride_px,
            options=model.decoding_options,
        )
        return Deployment(model.network, cells, size)
    if isinstance(model, RegressionModel):
        pose = PoseDecoding(center=model.network.targets.center.cpu().numpy())
        width = int(model.options["width"])
        return Deployment(model.network, pose, input_size(*size, width))
    raise InputError(f"a network of kind {model.kind!r} cannot be exported")


def write_graph(path: Path, deployed: Deployment) -> None:
    """Write the float32 graph: uint8 RGB (1, h, w, 3) in, outputs as named by `deployed.decoding`."""
    width, height = deployed.size
    graph = _NormalisedInput(copy.deepcopy(deployed.network).float().cpu()).eval()
    example = torch.zeros((1, height, width, 3), dtype=torch.uint8)
    _replace_adaptive_pooling(graph, example)
    with warnings.catch_warnings(), torch.no_grad():
        # The tracing exporter is deprecated, but the one based on torch.export needs three more packages. Its
        # warnings concern constants that are not folded; onnxruntime folds them.
        warnings.simplefilter("ignore", DeprecationWarning)
        warnings.simplefilter("ignore", UserWarning)
        torch.onnx.export(
            graph,
            (example,),
            str(path),
            dynamo=False,
            opset_version=_OPSET,
            input_names=[INPUT],
            output_names=list(deployed.decoding.outputs),
        )


@torch.inference_mode()
def reference(deployed: Deployment, image: np.ndarray) -> list[np.ndarray]:
    """Return the outputs of PyTorch for an image (1, h, w, 3) uint8."""
    device = next(deployed.network.parameters()).device
    graph = _NormalisedInput(deployed.network).to(device).eval()
    outputs: Sequence[Tensor] = graph(torch.from_numpy(image).to(device))
    return [output.cpu().numpy() for output in outputs]


class _NormalisedInput(nn.Module):
    """Converts images (1, h, w, 3) uint8 to (1, 3, h, w) normalised as for ImageNet, and runs a network."""

    mean: Tensor
    std: Tensor

    def __init__(self, network: nn.Module):
        super().__init__()
        self.network = network
        for name, values in (("mean", MEAN), ("std", STD)):
            self.register_buffer(name, 255 * torch.tensor(values)[:, None, None])

    def forward(self, image: Tensor) -> Sequence[Tensor]:
        outputs: Sequence[Tensor] = self.network(
            (image.permute(0, 3, 1, 2).float() - self.mean) / self.std
        )
        return tuple(outputs)


class _FixedAdaptivePool(nn.Module):
    """AdaptiveAvgPool2d for maps of a fixed size, as two matrix products.

    ONNX has no pooling into cells of different sizes.
    """

    across: Tensor
    down: Tensor

    def __init__(self, maps: tuple[int, int], cells: tuple[int, int]):
        super().__init__()
        self.register_buffer("down", _pooling_matrix(maps[0], cells[0]))
        self.register_buffer("across", _pooling_matrix(maps[1], cells[1]).T.contiguous())

    def forward(self, maps: Tensor) -> Tensor:
        return self.down @ maps @ self.across


def _pooling_matrix(pixels: int, cells: int) -> Tensor:
    """Return the pooling matrix (cells, pixels) of one axis.

    Each row averages pixels floor(k n / m) to ceil((k + 1) n / m), as torch does.
    """
    shares = torch.zeros(cells, pixels)
    for k in range(cells):
        first, last = k * pixels // cells, -(-(k + 1) * pixels // cells)
        shares[k, first:last] = 1 / (last - first)
    return shares


def _replace_adaptive_pooling(graph: nn.Module, example: Tensor) -> None:
    """Replace each adaptive pooling that the example passes through by `_FixedAdaptivePool`."""
    sizes: dict[nn.Module, tuple[int, int]] = {}

    def note(module: nn.Module, given: tuple[Tensor, ...], output: Tensor) -> None:
        sizes[module] = (given[0].shape[2], given[0].shape[3])

    pools = {n: m for n, m in graph.named_modules() if isinstance(m, nn.AdaptiveAvgPool2d)}
    hooks = [module.register_forward_hook(note) for module in pools.values()]
    with torch.no_grad():
        graph(example)
    for hook in hooks:
        hook.remove()
    for name, module in pools.items():
        if module in sizes:
            with torch.no_grad():
                cells = module(torch.zeros(1, 1, *sizes[module])).shape[2:]
            parent, _, child = name.rpartition(".")
            setattr(
                graph.get_submodule(parent),
                child,
                _FixedAdaptivePool(sizes[module], (cells[0], cells[1])),
            )
