"""Tensors of a file, and pretrained networks from them; no file can run code."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from spn_data.errors import InputError
from spn_model.networks.normalization import InsertedBatchNorm
from spn_model.networks.regressor import Regressor
from spn_model.networks.scene_coordinates import SceneCoordinates

_MAX_BYTES = 2 * 10**9  # VGG16 in float64 has 1.1 GB
_SAFETENSORS = ".safetensors"
_COUNTER = "num_batches_tracked"  # of torch's batch normalisation: of no use to a network that runs


def read_tensors(path: Path) -> dict[str, Tensor]:
    """Tensors by name, from safetensors, or from what torch.save wrote of a network's parameters.

    The parameters may be the value of a key `state_dict`, and their names begin with `module.`, as training
    programs write them. Raises InputError for anything else, and for a damaged file.
    """
    if not path.is_file():
        raise InputError("is no file of weights", path=path)
    if path.stat().st_size > _MAX_BYTES:
        raise InputError(f"is larger than {_MAX_BYTES / 1e9:.0f} GB: no weights", path=path)
    tensors = _read_safetensors(path) if path.suffix == _SAFETENSORS else _read_torch(path)
    return {name.removeprefix("module."): tensor for name, tensor in tensors.items()}


def load_pretrained(
    network: Regressor | SceneCoordinates, tensors: Mapping[str, Tensor], path: Path
) -> tuple[str, ...]:
    """Set the trunk's parameters and statistics from tensors in torchvision's names; nothing else changes.

    path : of the file, for messages. Returns the names that were left over, those of the replaced layers.
    Raises InputError, before anything is changed, where a tensor is missing, of another shape, no number,
    not finite, or of another network.
    """
    own = _trunk_state(network)
    for name, target in own.items():
        if name not in tensors:
            raise InputError(
                f"is of another network: it holds no {name!r}, which {type(network).__name__} needs",
                path=path,
            )
        _check(name, tensors[name], target, path)
    left = tuple(n for n in tensors if n not in own and not n.endswith(_COUNTER))
    foreign = [name for name in left if not name.startswith(network.replaced)]
    if foreign:
        raise InputError(
            f"is of another network: {type(network).__name__} has no {foreign[0]!r}", path=path
        )
    with torch.no_grad():
        for name, target in own.items():
            target.copy_(tensors[name])
    return left


def _trunk_state(network: Regressor | SceneCoordinates) -> dict[str, Tensor]:
    """Parameters and statistics that torchvision's network has too; they share memory with ours."""
    inserted = tuple(
        f"{name}."
        for name, module in network.named_modules()
        if isinstance(module, InsertedBatchNorm)
    )
    return {
        name: tensor
        for name, tensor in network.state_dict().items()
        if name.partition(".")[0] not in network.added
        and not name.endswith(_COUNTER)
        and not name.startswith(inserted)
    }


def _check(name: str, found: Tensor, target: Tensor, path: Path) -> None:
    if found.shape != target.shape:
        raise InputError(
            f"is of another network: {name!r} is {_shape(found)}, {_shape(target)} is needed",
            path=path,
        )
    if found.layout is not torch.strided or not found.is_floating_point():
        sparsely = "" if found.layout is torch.strided else ", stored sparsely"
        raise InputError(
            f"{name!r} is of type {found.dtype}{sparsely}: plain real numbers are needed", path=path
        )
    if not torch.isfinite(found).all():
        raise InputError(f"{name!r} holds values that are not finite", path=path)


def _shape(tensor: Tensor) -> str:
    return " x ".join(map(str, tensor.shape)) or "a single value"


def _read_safetensors(path: Path) -> dict[str, Tensor]:
    try:
        with safe_open(path, "pt") as file:
            return {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, RuntimeError, ValueError) as error:
        raise InputError(f"is no safetensors file, or cut short ({error})", path=path) from error


def _read_torch(path: Path) -> dict[str, Tensor]:
    _refuse_compressed(path)
    try:
        content: Any = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # whatever hostile bytes make of torch's reader
        first = (str(error) or type(error).__name__).splitlines()[0]
        raise InputError(
            f"cannot be read as weights: damaged, or it holds more than tensors ({first})",
            path=path,
        ) from error
    if isinstance(content, dict) and isinstance(content.get("state_dict"), dict):
        content = content["state_dict"]
    if not isinstance(content, dict) or not content:
        raise InputError("holds no parameters by name", path=path)
    for name, tensor in content.items():
        if not isinstance(name, str) or not isinstance(tensor, Tensor):
            raise InputError(f"holds no parameters by name: {name!r:.60} is no tensor", path=path)
    return content


def _refuse_compressed(path: Path) -> None:
    """torch stores tensors as they are: a compressed entry would unpack to any size."""
    try:
        with zipfile.ZipFile(path) as file:
            entries = file.infolist()
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError):
        return  # torch's older format, or damaged, which torch.load finds out
    if any(entry.file_size > entry.compress_size for entry in entries):
        raise InputError("cannot be read as weights: its entries are compressed", path=path)
