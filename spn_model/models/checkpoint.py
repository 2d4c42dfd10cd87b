"""A trained network in one file: weights, what makes them a member, and the world that it tells poses in."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as safetensors_bytes
from torch import Tensor, nn

from spn_data.errors import FormatError, InputError
from spn_data.storage.files import atomic_writer
from spn_data.storage.json_files import finite
from spn_model.models.pose_model import PoseModel
from spn_model.models.registry import make
from spn_model.onboard.view import View

FORMAT = "squeezeposenet-checkpoint"
VERSION = 1
_MAX_BYTES = 8 * 10**9
_MAX_DOCUMENT = 2_000_000  # characters of JSON


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A member with its weights, in eval mode; what it sees; facts of its training, plain values."""

    model: PoseModel
    view: View
    facts: dict[str, Any]


def save(path: Path, model: PoseModel, view: View, facts: Mapping[str, Any]) -> None:
    """Write whole, in place of what stood there. Raises StageError where the disk does not take it."""
    document = {
        "kind": model.kind,
        "options": model.options,
        "view": view.to_json(),
        "facts": dict(facts),
    }
    write_tensors(path, FORMAT, model.network.state_dict(), document)


def load(path: Path, device: str | torch.device = "cpu") -> Checkpoint:
    """Raises InputError where there is no such file, FormatError where it is no checkpoint, one of a newer
    version, damaged, or does not hold what its own network needs."""
    tensors, document = read_tensors(path, FORMAT)
    try:
        kind, options, facts = document["kind"], document["options"], document["facts"]
        view = View.from_json(document["view"])
        if not (isinstance(kind, str) and isinstance(options, dict) and isinstance(facts, dict)):
            raise TypeError("kind, options or facts are not what is written there")
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise FormatError(f"{path}: is a damaged checkpoint ({error!r})") from error
    try:
        model = make(kind, options)
    except InputError as error:
        raise FormatError(f"{path}: this program cannot make its network: {error}") from error
    set_state(model.network, tensors, path)
    model.network.to(device).eval()
    return Checkpoint(model, view, facts)


def set_state(network: nn.Module, tensors: Mapping[str, Tensor], path: Path) -> None:
    """Load a whole state. Raises FormatError, before anything is changed, where it is another network's."""
    own = network.state_dict()
    for name, target in own.items():
        if name not in tensors:
            raise FormatError(f"{path}: is of another network: it holds no {name!r}")
        found = tensors[name]
        if found.shape != target.shape or found.dtype != target.dtype:
            raise FormatError(
                f"{path}: is of another network: {name!r} is {_kind_of(found)}, "
                f"{_kind_of(target)} is needed"
            )
    foreign = [name for name in tensors if name not in own]
    if foreign:
        raise FormatError(f"{path}: is of another network, which has {foreign[0]!r}")
    network.load_state_dict(dict(tensors))


def write_tensors(
    path: Path, form: str, tensors: Mapping[str, Tensor], document: Mapping[str, Any]
) -> None:
    """A safetensors file with a JSON document in its header; see `atomic_writer`.

    Numbers of the document that are not finite are written as null.
    """
    plain = {name: t.detach().cpu().contiguous() for name, t in tensors.items()}
    text = json.dumps(finite(document), sort_keys=True, allow_nan=False)
    content = safetensors_bytes(plain, {"format": form, "version": str(VERSION), "document": text})
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_writer(path) as file:
        file.write(content)


def read_tensors(path: Path, form: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """What `write_tensors` wrote in this format.

    Raises InputError where there is no such file, FormatError where it is another, of a newer version,
    damaged, or holds weights that are not finite.
    """
    if not path.is_file():
        raise InputError("does not exist" if not path.exists() else "is no file", path=path)
    if path.stat().st_size > _MAX_BYTES:
        raise FormatError(f"{path}: is larger than {_MAX_BYTES / 1e9:.0f} GB: no checkpoint")
    try:
        with safe_open(path, "pt") as file:
            header = file.metadata() or {}
            if header.get("format") != form:
                raise FormatError(f"{path}: is no {form.rpartition('-')[2]} of this program")
            if header.get("version") != str(VERSION):
                raise FormatError(
                    f"{path}: is of format {header.get('version')}, this program reads {VERSION}; "
                    "train anew, or update the program"
                )
            text = header.get("document", "")
            if len(text) > _MAX_DOCUMENT:
                raise ValueError(f"a document of {len(text)} characters")
            document = json.loads(text)
            if not isinstance(document, dict):
                raise TypeError("its document is no object")
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, RuntimeError, ValueError, TypeError, RecursionError) as error:
        raise FormatError(f"{path}: is no checkpoint, or damaged ({error})") from error
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not torch.isfinite(tensor).all():
            raise FormatError(f"{path}: {name!r} holds values that are not finite; train anew")
    return tensors, document


def _kind_of(tensor: Tensor) -> str:
    shape = " x ".join(map(str, tensor.shape)) or "a single value"
    return f"{shape} of {str(tensor.dtype).removeprefix('torch.')}"
