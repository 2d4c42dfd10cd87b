"""Preparation of an area for visual localization: from flight video to a georeferenced map and labels.

`open_area` and `open_samples` read what the command `spn-data` wrote. They are loaded when first used:
on-board code imports this package without the libraries that they need.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from spn_data.api import AreaReader, open_area
    from spn_data.dataset.hdf5_reader import Dataset
    from spn_data.dataset.samples import Samples, open_samples
    from spn_data.geometry.camera_file import read_camera
    from spn_data.labels.labels import pose_sigmas

__version__ = "0.2.0.dev0"
__all__ = [
    "AreaReader",
    "Dataset",
    "Samples",
    "__version__",
    "open_area",
    "open_samples",
    "pose_sigmas",
    "read_camera",
]

_HOMES = {
    "AreaReader": "spn_data.api",
    "open_area": "spn_data.api",
    "Dataset": "spn_data.dataset.hdf5_reader",
    "Samples": "spn_data.dataset.samples",
    "open_samples": "spn_data.dataset.samples",
    "pose_sigmas": "spn_data.labels.labels",
    "read_camera": "spn_data.geometry.camera_file",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return __all__
