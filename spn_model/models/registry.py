"""Kinds of networks by name, as recipes and checkpoints have them."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any

from spn_data.errors import InputError
from spn_model.models.pose_model import PoseModel

# Imported when they are asked for: one kind does not need what another does.
KINDS = {
    "regression": ("spn_model.models.regression", "RegressionModel"),
    "scene-coordinates": ("spn_model.models.scene_coordinates", "SceneCoordinatesModel"),
}


def make(kind: str, options: Mapping[str, Any], *, seed: int = 0) -> PoseModel:
    """A member with weights drawn from a seed. Raises InputError for a kind or an option that there isn't."""
    if kind not in KINDS:
        raise InputError(f"there is no kind of network {kind!r}; there are {', '.join(KINDS)}")
    module, name = KINDS[kind]
    model: PoseModel = getattr(import_module(module), name).make(options, seed)
    return model
