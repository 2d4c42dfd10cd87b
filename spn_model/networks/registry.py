"""Networks by name, as recipes and checkpoints have them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, fields
from typing import Any

import torch

from spn_data.errors import InputError
from spn_model.networks.posenet import PoseNet, PoseNetOptions
from spn_model.networks.regressor import Regressor
from spn_model.networks.squeezeposenet import SqueezePoseNet, SqueezePoseNetOptions
from spn_model.networks.vgg16 import VGG16, VGG16Options

REGRESSORS: dict[str, tuple[Callable[[Any], Regressor], type[Any]]] = {
    "squeezeposenet": (SqueezePoseNet, SqueezePoseNetOptions),
    "vgg16": (VGG16, VGG16Options),
    "posenet": (PoseNet, PoseNetOptions),
}


def build(name: str, options: Mapping[str, Any] | None = None, *, seed: int = 0) -> Regressor:
    """A network with weights drawn from a seed; torch's own random state is left as it was.

    options : by name, as TOML or JSON has them; what is left out has its default.
    Raises InputError for a name, an option or a value that there isn't.
    """
    if name not in REGRESSORS:
        raise InputError(f"there is no network {name!r}; there are {', '.join(REGRESSORS)}")
    network, kind = REGRESSORS[name]
    chosen = _options(name, kind, dict(options or {}))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return network(chosen)


def options_of(network: Regressor) -> dict[str, Any]:
    """What `build` needs to make a network of the same kind."""
    return asdict(network.options)


def _options(name: str, kind: type[Any], given: dict[str, Any]) -> Any:
    defaults = {field.name: field.default for field in fields(kind)}
    for option, value in given.items():
        if option not in defaults:
            raise InputError(
                f"network {name} has no option {option!r}; it has {', '.join(defaults)}"
            )
        wanted = type(defaults[option])
        if wanted is float and type(value) is int:
            given[option] = float(value)
        elif type(value) is not wanted:
            raise InputError(
                f"option {option} of network {name} is {value!r}, not of type {wanted.__name__}"
            )
    try:
        return kind(**given)
    except ValueError as error:
        raise InputError(f"network {name} can't be made so: {error}") from error
