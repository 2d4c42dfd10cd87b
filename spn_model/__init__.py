"""Pose networks trained on a data set: training, evaluation, prediction, and deployment on board.

`Localizer` estimates poses with an exported bundle, `read_run` reads metrics of a trained network; both are
loaded when first used, so that on-board code needs no more than it uses.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from spn_data import __version__

if TYPE_CHECKING:
    from spn_model.evaluation.results import RunResults, read_run
    from spn_model.onboard.localizer import Localizer, Located

__all__ = ["Localizer", "Located", "RunResults", "__version__", "read_run"]

_HOMES = {
    "Located": "spn_model.onboard.localizer",
    "Localizer": "spn_model.onboard.localizer",
    "RunResults": "spn_model.evaluation.results",
    "read_run": "spn_model.evaluation.results",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return __all__
