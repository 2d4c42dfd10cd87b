"""A float32 graph in 8 bits: weights by channel, activations by what training images make of them."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
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
_LEARNT = ("Conv", "Gemm")
_OPERATORS = [*_LEARNT, "MaxPool", "Relu", "LeakyRelu", "Concat"]


class _Images(CalibrationDataReader):  # type: ignore[misc]
    def __init__(self, name: str, images: Iterable[np.ndarray]):
        self._name, self._images = name, iter(images)

    def get_next(self) -> dict[str, np.ndarray] | None:
        image = next(self._images, None)
        return None if image is None else {self._name: image}


def quantize(graph: Path, quantized: Path, images: Iterable[np.ndarray]) -> int:
    """Write the 8-bit form of a float32 graph; the number of learnt operators that stay in float32.

    images : (1, h, w, 3) uint8, for the ranges of activations; each is used once. The last learnt operators
    before the outputs stay as they are: what they lose, poses lose.
    """
    with tempfile.TemporaryDirectory(dir=quantized.parent, prefix=".int8-") as folder:
        prepared = Path(folder) / "prepared.onnx"
        # Shapes are fixed: onnx infers them, without symbols.
        quant_pre_process(str(graph), str(prepared), skip_symbolic_shape=True)
        model = onnx.load(str(prepared))
        kept = _last(model.graph)
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


def _last(graph: onnx.GraphProto) -> list[str]:
    """Names of the learnt operators on whose outputs no other one depends."""
    makers = {output: node for node in graph.node for output in node.output}
    used: set[str] = set()  # operators that another learnt one depends on
    for node in graph.node:
        if node.op_type in _LEARNT:
            open_inputs = list(node.input)
            while open_inputs:
                maker = makers.get(open_inputs.pop())
                if maker is not None and maker.name not in used:
                    used.add(maker.name)
                    open_inputs += maker.input
    return [n.name for n in graph.node if n.op_type in _LEARNT and n.name not in used]
