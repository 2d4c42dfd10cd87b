"""Post-training static quantization to 8 bits: per-channel weights, activation ranges from images."""

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

# Operators that run in 8 bits; others would only be wrapped into conversions.
_WEIGHTED = ("Conv", "Gemm")
_OPERATORS = [*_WEIGHTED, "MaxPool", "Relu", "LeakyRelu", "Concat"]


class _Images(CalibrationDataReader):  # type: ignore[misc]
    def __init__(self, name: str, images: Iterable[np.ndarray]):
        self._name, self._images = name, iter(images)

    def get_next(self) -> dict[str, np.ndarray] | None:
        image = next(self._images, None)
        return None if image is None else {self._name: image}


def quantize(graph: Path, quantized: Path, images: Iterable[np.ndarray]) -> int:
    """Write the 8-bit form of a float32 graph; return the number of weighted operators that stay in float32.

    images : (1, h, w, 3) uint8, calibrate the ranges of activations; each is used once. The last weighted
    operators before the outputs stay in float32, because their rounding would directly affect the poses.
    """
    with tempfile.TemporaryDirectory(dir=quantized.parent, prefix=".int8-") as folder:
        prepared = Path(folder) / "prepared.onnx"
        # Shapes are static, so symbolic shape inference is not needed.
        quant_pre_process(str(graph), str(prepared), skip_symbolic_shape=True)
        model = onnx.load(str(prepared))
        kept = _output_layers(model.graph)
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


def _output_layers(graph: onnx.GraphProto) -> list[str]:
    """Return the names of weighted operators on whose outputs no other weighted operator depends."""
    makers = {output: node for node in graph.node for output in node.output}
    used: set[str] = set()  # operators that another weighted one depends on
    for node in graph.node:
        if node.op_type in _WEIGHTED:
            pending = list(node.input)
            while pending:
                maker = makers.get(pending.pop())
                if maker is not None and maker.name not in used:
                    used.add(maker.name)
                    pending += maker.input
    return [n.name for n in graph.node if n.op_type in _WEIGHTED and n.name not in used]
