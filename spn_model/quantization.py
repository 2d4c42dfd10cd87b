"""A float32 graph in 8 bits: weights by channel, activations by what training images make of them."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
import onnx
from onnxruntime.quantization import (
    CalibrationDataReader,
    CalibrationMethod,
    QuantFormat,
    QuantType,
    quantize_static,
)
from onnxruntime.quantization.shape_inference import quant_pre_process

# What computes in 8 bits; all else would only be wrapped into conversions.
_OPERATORS = ["Conv", "Gemm", "MatMul", "MaxPool", "Relu", "LeakyRelu", "Concat"]


class _Images(CalibrationDataReader):  # type: ignore[misc]
    def __init__(self, name: str, images: Iterable[np.ndarray]):
        self._name, self._images = name, iter(images)

    def get_next(self) -> dict[str, np.ndarray] | None:
        image = next(self._images, None)
        return None if image is None else {self._name: image}


def quantize(
    graph: Path, quantized: Path, images: Iterable[np.ndarray], last: Sequence[str]
) -> int:
    """Write the 8-bit form of a float32 graph; the number of operators that stay float32 of those named.

    images : (1, h, w, 3) uint8, for the ranges of activations; each is used once. last : beginnings of
    parameters' names in the network, whose operators stay in float32: what they lose, poses lose.
    """
    with tempfile.TemporaryDirectory(dir=quantized.parent, prefix=".int8-") as folder:
        prepared = Path(folder) / "prepared.onnx"
        # Shapes are fixed: onnx infers them, without symbols.
        quant_pre_process(str(graph), str(prepared), skip_symbolic_shape=True)
        model = onnx.load(str(prepared))
        kept = list(_reading(model, last))
        quantize_static(
            str(prepared),
            str(quantized),
            _Images(model.graph.input[0].name, images),
            quant_format=QuantFormat.QDQ,
            per_channel=True,
            op_types_to_quantize=_OPERATORS,
            nodes_to_exclude=kept,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            calibrate_method=CalibrationMethod.MinMax,
        )
    return len(kept)


def _reading(model: onnx.ModelProto, beginnings: Sequence[str]) -> Iterator[str]:
    """Names of the nodes that read parameters whose names in the network begin so."""
    starts = tuple(f"network.{name}" for name in beginnings)
    for node in model.graph.node:
        if any(name.startswith(starts) for name in node.input):
            yield node.name
