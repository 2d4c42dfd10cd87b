"""Checkpoints: a trained pose model in one file, with its weights, options, camera view and world."""

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
from spn_data.geometry.json_values import parse_json
from spn_data.storage.files import atomic_writer
from spn_data.storage.json_files import finite
from spn_model.models.pose_model import PoseModel
from spn_model.models.registry import make
from spn_model.onboard.view import View

FORMAT = "squeezeposenet-checkpoint"
VERSION = 1
OFFSET_VERSION = 2  # of a view with an offset, so that programs that know none refuse it
_MAX_BYTES = 8 * 10**9
_MAX_DOCUMENT = 2_000_000  # largest length of the JSON document, in characters


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """Pose model read from a file.

    Attributes
    ----------
    model : PoseModel
        With its weights, in eval mode.
    view : View
        Camera and world that it was trained for.
    facts : dict
        Facts of its training, as plain values.
    """

    model: PoseModel
    view: View
    facts: dict[str, Any]


def save(path: Path, model: PoseModel, view: View, facts: Mapping[str, Any]) -> None:
    """Write a checkpoint atomically, replacing an existing one. Raises StageError if it cannot be written."""
    document = {
        "kind": model.kind,
        "options": model.options,
        "view": view.to_json(),
        "facts": dict(facts),
    }
    version = OFFSET_VERSION if any(view.offset) else VERSION
    write_tensors(path, FORMAT, model.network.state_dict(), document, version)


def load(path: Path, device: str | torch.device = "cpu") -> Checkpoint:
    """Read a checkpoint.

    Parameters
    ----------
    path : Path
        File written by `save`.
    device : str or torch.device
        Device to put the network on.

    Returns
    -------
    Checkpoint

    Raises
    ------
    InputError
        If the file does not exist.
    FormatError
        If it is not a checkpoint, is of another version, is damaged, or its tensors do not match its
        network.
    """
    tensors, document, version = read_tensors(path, FORMAT)
    try:
        kind, options, facts = document["kind"], document["options"], document["facts"]
        view = View.from_json(document["view"], has_offset=version == OFFSET_VERSION)
        if not (isinstance(kind, str) and isinstance(options, dict) and isinstance(facts, dict)):
            raise TypeError("kind, options or facts have a wrong type")
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise FormatError(f"{path}: damaged checkpoint ({error!r})") from error
    try:
        model = make(kind, options)
    except InputError as error:
        raise FormatError(f"{path}: this version cannot build its network: {error}") from error
    set_state(model.network, tensors, path)
    model.network.to(device).eval()
    return Checkpoint(model, view, facts)


def set_state(network: nn.Module, tensors: Mapping[str, Tensor], path: Path) -> None:
    """Load a complete state into a network.

    Parameters
    ----------
    network : nn.Module
        Network to load into.
    tensors : mapping of str to Tensor
        Its parameters and buffers by name.
    path : Path
        File they come from, for messages.

    Raises
    ------
    FormatError
        If the tensors belong to another network; nothing is changed then.
    """
    own = network.state_dict()
    for name, target in own.items():
        if name not in tensors:
            raise FormatError(
                f"{path}: belongs to another network: {name!r} is missing; train a run of an earlier "
                "version again"
            )
        tensor = tensors[name]
        if tensor.shape != target.shape or tensor.dtype != target.dtype:
            raise FormatError(
                f"{path}: belongs to another network: {name!r} is {_shape_and_type(tensor)}, "
                f"needs to be {_shape_and_type(target)}"
            )
    foreign = [name for name in tensors if name not in own]
    if foreign:
        raise FormatError(f"{path}: belongs to another network: unexpected {foreign[0]!r}")
    network.load_state_dict(dict(tensors))


def write_tensors(
    path: Path,
    form: str,
    tensors: Mapping[str, Tensor],
    document: Mapping[str, Any],
    version: int = VERSION,
) -> None:
    """Write a safetensors file atomically, with a JSON document in its header.

    Parameters
    ----------
    path : Path
        File to write; its folder is created.
    form : str
        Name of the format.
    tensors : mapping of str to Tensor
        Tensors by name.
    document : mapping
        Plain values; numbers that are not finite are written as null.
    version : int
        Version of the format.

    Raises
    ------
    StageError
        If the file cannot be written.
    """
    plain = {name: t.detach().cpu().contiguous() for name, t in tensors.items()}
    text = json.dumps(finite(document), sort_keys=True, allow_nan=False)
    content = safetensors_bytes(plain, {"format": form, "version": str(version), "document": text})
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_writer(path) as file:
        file.write(content)


def read_tensors(path: Path, form: str) -> tuple[dict[str, Tensor], dict[str, Any], int]:
    """Read tensors, document and version from a file that `write_tensors` wrote.

    Parameters
    ----------
    path : Path
        File to read.
    form : str
        Name of the format that it needs to have.

    Returns
    -------
    tensors : dict of str to Tensor
    document : dict
    version : int

    Raises
    ------
    InputError
        If the file does not exist.
    FormatError
        If it has another format or version, is damaged, or holds weights that are not finite.
    """
    if not path.is_file():
        raise InputError("does not exist" if not path.exists() else "is not a file", path=path)
    if path.stat().st_size > _MAX_BYTES:
        raise FormatError(f"{path}: is larger than {_MAX_BYTES / 1e9:.0f} GB: not a checkpoint")
    try:
        with safe_open(path, "pt") as file:
            header = file.metadata() or {}
            if header.get("format") != form:
                raise FormatError(f"{path}: is not a {form.rpartition('-')[2]} of this program")
            version = header.get("version", "")
            if version not in map(str, (VERSION, OFFSET_VERSION)):
                raise FormatError(
                    f"{path}: has format version {version}, this program reads {VERSION} and "
                    f"{OFFSET_VERSION}; train again, or update the program"
                )
            text = header.get("document", "")
            if len(text) > _MAX_DOCUMENT:
                raise ValueError(f"a document of {len(text)} characters")
            document = parse_json(text)
            if not isinstance(document, dict):
                raise TypeError("its document is not an object")
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, RuntimeError, ValueError, TypeError, RecursionError) as error:
        raise FormatError(f"{path}: is not a checkpoint, or damaged ({error})") from error
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not torch.isfinite(tensor).all():
            raise FormatError(f"{path}: {name!r} has values that are not finite; train again")
    return tensors, document, int(version)


def _shape_and_type(tensor: Tensor) -> str:
    shape = " x ".join(map(str, tensor.shape)) or "a single value"
    return f"{shape} of {str(tensor.dtype).removeprefix('torch.')}"
