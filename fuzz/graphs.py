"""Mutations of ONNX graphs: fields of the protobuf are exchanged, removed, doubled or swapped."""

from __future__ import annotations

import random
from typing import Any

import onnx

from fuzz.mutate import NUMBERS, TEXTS, mutated


def mutated_graph(data: bytes, rng: random.Random) -> bytes:
    """Return a graph with one to three changed fields; every third time, with changed bytes."""
    if rng.random() < 0.33:
        return mutated(data, rng)
    model = onnx.ModelProto.FromString(data)
    for _ in range(rng.choice((1, 1, 2, 3))):
        message: Any = model
        while True:
            filled = [field for field, _ in message.ListFields()]
            if not filled:
                break
            field = rng.choice(filled)
            value = getattr(message, field.name)
            many = not hasattr(value, "ListFields") and hasattr(value, "add") and len(value)
            if many and rng.random() < 0.9:
                message = rng.choice(value)
            elif hasattr(value, "ListFields") and rng.random() < 0.9:
                message = value
            else:
                _change(message, field, rng)
                break
    return model.SerializeToString()


def _change(message: Any, field: Any, rng: random.Random) -> None:
    """Change one field of a message."""
    value = getattr(message, field.name)
    kind = rng.randrange(4)
    if kind == 0:
        message.ClearField(field.name)
    elif hasattr(value, "append") and len(value):
        at = rng.randrange(len(value))
        if kind == 1:
            del value[at]
        elif kind == 2:
            value.append(value[at])
        elif hasattr(value, "add"):
            value[at].CopyFrom(rng.choice(value))
        else:
            value[at] = _other(value[at], rng)
    elif not hasattr(value, "ListFields"):
        try:
            setattr(message, field.name, _other(value, rng))
        except (ValueError, TypeError):
            message.ClearField(field.name)


def _other(value: Any, rng: random.Random) -> Any:
    if isinstance(value, bytes):
        return value[: rng.randrange(len(value) + 1)] + rng.choice((b"", b"\xff" * 64))
    if isinstance(value, str):
        return rng.choice(
            (*TEXTS, "Loop", "If", "Resize", "Reshape", "Tile", "ConstantOfShape", "Expand")
        )
    if isinstance(value, float):
        return rng.choice((float("nan"), float("inf"), -1.0, 0.0, 1e38))
    return rng.choice((*(n % 2**31 for n in NUMBERS), -1, -(2**31)))
