"""Reading of weight files and loading into networks; no file can execute code."""

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
_COUNTER = "num_batches_tracked"  # counter of torch's batch normalisation, not used in inference


def read_tensors(path: Path) -> dict[str, Tensor]:
    """Read tensors by name from a safetensors file or from parameters written by torch.save.

    Parameters
    ----------
    path : Path
        File to read. The parameters may be under a key `state_dict`, and their names may start with
        `module.`, as training programs write them.

    Returns
    -------
    dict of str to Tensor

    Raises
    ------
    InputError
        If the file is damaged or is not a file of parameters.
    """
    if not path.is_file():
        raise InputError("is not a file of weights", path=path)
    if path.stat().st_size > _MAX_BYTES:
        raise InputError(
            f"is larger than {_MAX_BYTES / 1e9:.0f} GB: not a file of weights", path=path
        )
    tensors = _read_safetensors(path) if path.suffix == _SAFETENSORS else _read_torch(path)
    return {name.removeprefix("module."): tensor for name, tensor in tensors.items()}


def load_pretrained(
    network: Regressor | SceneCoordinates, tensors: Mapping[str, Tensor], path: Path
) -> tuple[str, ...]:
    """Set the trunk's parameters and statistics from tensors with torchvision's names; nothing else changes.

    Parameters
    ----------
    network : Regressor or SceneCoordinates
        Network to load into.
    tensors : mapping of str to Tensor
        Tensors by name.
    path : Path
        File they come from, for messages.

    Returns
    -------
    tuple of str
        Names that were not used: those of the replaced layers.

    Raises
    ------
    InputError
        If a tensor is missing, has another shape, is not real or not finite, or belongs to another network.
        The network is not changed then.
    """
    own = _trunk_state(network)
    for name, target in own.items():
        if name not in tensors:
            raise InputError(
                f"belongs to another network: {name!r} is missing, which {type(network).__name__} needs",
                path=path,
            )
        _check(name, tensors[name], target, path)
    left = tuple(n for n in tensors if n not in own and not n.endswith(_COUNTER))
    foreign = [name for name in left if not name.startswith(network.replaced)]
    if foreign:
        raise InputError(
            f"belongs to another network: {type(network).__name__} has no {foreign[0]!r}", path=path
        )
    with torch.no_grad():
        for name, target in own.items():
            target.copy_(tensors[name])
    return left


def _trunk_state(network: Regressor | SceneCoordinates) -> dict[str, Tensor]:
    """Return the parameters and statistics that torchvision's network has too, sharing their memory."""
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
            f"belongs to another network: {name!r} is {_shape(found)}, needs to be {_shape(target)}",
            path=path,
        )
    if found.layout is not torch.strided or not found.is_floating_point():
        sparse = "" if found.layout is torch.strided else " (sparse)"
        raise InputError(
            f"{name!r} has type {found.dtype}{sparse}, needs to be dense floating point", path=path
        )
    if not torch.isfinite(found).all():
        raise InputError(f"{name!r} has values that are not finite", path=path)


def _shape(tensor: Tensor) -> str:
    return " x ".join(map(str, tensor.shape)) or "a single value"


def _read_safetensors(path: Path) -> dict[str, Tensor]:
    try:
        with safe_open(path, "pt") as file:
            return {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, RuntimeError, ValueError) as error:
        raise InputError(f"is not a safetensors file, or truncated ({error})", path=path) from error


def _read_torch(path: Path) -> dict[str, Tensor]:
    _refuse_compressed(path)
    try:
        content: Any = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # malicious bytes can make torch's reader raise anything
        first = (str(error) or type(error).__name__).splitlines()[0]
        raise InputError(
            f"cannot be read as weights: damaged, or contains more than tensors ({first})",
            path=path,
        ) from error
    if isinstance(content, dict) and isinstance(content.get("state_dict"), dict):
        content = content["state_dict"]
    if not isinstance(content, dict) or not content:
        raise InputError("contains no parameters by name", path=path)
    for name, tensor in content.items():
        if not isinstance(name, str) or not isinstance(tensor, Tensor):
            raise InputError(
                f"contains no parameters by name: {name!r:.60} is not a tensor", path=path
            )
    return content


def _refuse_compressed(path: Path) -> None:
    """Raise InputError for compressed entries, which could unpack to any size; torch does not compress."""
    try:
        with zipfile.ZipFile(path) as file:
            entries = file.infolist()
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError):
        return  # torch's older format, or a damaged file, which torch.load detects
    if any(entry.file_size > entry.compress_size for entry in entries):
        raise InputError("cannot be read as weights: its entries are compressed", path=path)
