"""Kinds of pose models by the names that recipes and checkpoints use."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any

from spn_data.errors import InputError
from spn_model.models.pose_model import PoseModel

# Imported on demand, so that one kind does not load the dependencies of another.
KINDS = {
    "regression": ("spn_model.models.regression", "RegressionModel"),
    "scene-coordinates": ("spn_model.models.scene_coordinates", "SceneCoordinatesModel"),
}


def make(kind: str, options: Mapping[str, Any], *, seed: int = 0) -> PoseModel:
    """Build a pose model with random weights.

    Parameters
    ----------
    kind : str
        A key of `KINDS`.
    options : mapping
        Options of the model, by name.
    seed : int
        Random seed of the weights.

    Raises
    ------
    InputError
        If the kind or an option is not known.
    """
    if kind not in KINDS:
        raise InputError(f"unknown kind of network {kind!r}; choose one of {', '.join(KINDS)}")
    module, name = KINDS[kind]
    model: PoseModel = getattr(import_module(module), name).make(options, seed)
    return model
