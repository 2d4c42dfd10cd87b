"""Pose regressors by the names that recipes and checkpoints use."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any

import torch

from spn_data.errors import InputError
from spn_model.networks.option_parsing import from_mapping
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
    """Build a network with random weights drawn from a seed; torch's global random state is not changed.

    Parameters
    ----------
    name : str
        A key of `REGRESSORS`.
    options : mapping, optional
        Options by name, as read from TOML or JSON; missing ones take their defaults.
    seed : int
        Random seed of the weights.

    Raises
    ------
    InputError
        If the name, an option or a value is not known.
    """
    if name not in REGRESSORS:
        raise InputError(f"unknown network {name!r}; choose one of {', '.join(REGRESSORS)}")
    network, kind = REGRESSORS[name]
    try:
        chosen = from_mapping(kind, options or {}, f"network {name}")
    except ValueError as error:
        raise InputError(f"network {name}: {error}") from error
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return network(chosen)


def options_of(network: Regressor) -> dict[str, Any]:
    """Return the options with which `build` makes a network of the same architecture."""
    return asdict(network.options)
