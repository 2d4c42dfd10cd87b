"""Check that an ONNX file refers to no other file, by walking its protobuf fields; `onnx` is not on board."""

from __future__ import annotations

import mmap
from pathlib import Path

# Messages of onnx.proto that can hold a tensor: field -> kind of the message in it.
_MESSAGES: dict[str, dict[int, str]] = {
    "model": {7: "graph", 20: "training", 25: "function"},
    "graph": {1: "node", 5: "tensor", 15: "sparse"},
    "node": {5: "attribute"},
    "attribute": {
        **{5: "tensor", 6: "graph", 10: "tensor", 11: "graph", 22: "sparse", 23: "sparse"},
    },
    "sparse": {1: "tensor", 2: "tensor"},
    "function": {7: "node", 11: "attribute"},
    "training": {1: "graph", 2: "graph"},
    "tensor": {},
}
_EXTERNAL_DATA, _DATA_LOCATION = 13, 14  # fields of a tensor; location 0 is the file itself
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5  # kinds of values; groups are not used by ONNX
_MAX_MESSAGES = 5_000_000
_MAX_DEPTH = 100


def check_self_contained(path: Path) -> None:
    """Raise ValueError if an ONNX file is malformed, or keeps a tensor in another file.

    The hash in bundle.json covers the graph file alone; a tensor in another file could be exchanged
    unnoticed.
    """
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        waiting = [("model", 0, len(data), 0)]
        seen = 0
        while waiting:
            kind, at, end, depth = waiting.pop()
            seen += 1
            if seen > _MAX_MESSAGES or depth > _MAX_DEPTH:
                raise ValueError("its graph has too many parts, or they are nested too deeply")
            while at < end:
                key, at = _varint(data, at, end)
                field, form = key >> 3, key & 7
                value = 0
                if form == _VARINT:
                    value, at = _varint(data, at, end)
                    start = at
                elif form in (_FIXED64, _FIXED32):
                    start = at = at + (8 if form == _FIXED64 else 4)
                elif form == _BYTES:
                    size, start = _varint(data, at, end)
                    at = start + size
                else:
                    raise ValueError("it is not an ONNX file")
                if at > end or field == 0:
                    raise ValueError("it is not an ONNX file")
                if kind == "tensor" and (
                    field == _EXTERNAL_DATA
                    or (field == _DATA_LOCATION and (value or form != _VARINT))
                ):
                    raise ValueError("it keeps a weight in another file, which no hash covers")
                if form == _BYTES and field in _MESSAGES[kind]:
                    waiting.append((_MESSAGES[kind][field], start, at, depth + 1))


def _varint(data: mmap.mmap, at: int, end: int) -> tuple[int, int]:
    """Return the integer of up to 64 bits that begins at a byte, and the place after it."""
    value = 0
    for shift in range(0, 70, 7):
        if at >= end:
            break
        byte = data[at]
        value |= (byte & 0x7F) << shift
        at += 1
        if byte < 0x80:
            return value, at
    raise ValueError("it is not an ONNX file")
