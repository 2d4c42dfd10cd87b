"""Console entry points; they report a missing extra in one line instead of a traceback."""

from __future__ import annotations

import sys
from importlib import import_module
from typing import NoReturn

DISTRIBUTION = "squeezeposenet-toolkit"
# Packages by the extra that installs them.
_EXTRAS = {
    "data": ("av", "click", "defusedxml", "h5py", "PIL", "pycolmap", "rich", "scipy", "tomli_w"),
    "model": ("onnx", "onnxruntime", "safetensors", "threadpoolctl", "torch"),
    "cluster": ("dask", "distributed"),
}


def data() -> None:
    """Run `spn-data`."""
    _run("spn-data", "data")


def model() -> None:
    """Run `spn-model`."""
    _run("spn-model", "model")


def _run(program: str, module: str) -> None:
    try:
        import_module(f"spn_cli.{module}").main(prog_name=program)
    except ModuleNotFoundError as error:
        _report_missing(program, module, error)


def _report_missing(program: str, own_extra: str, error: ModuleNotFoundError) -> NoReturn:
    """Exit with the pip command that installs a missing package; raise what no extra installs."""
    package = (error.name or "").partition(".")[0]
    extra = next((name for name, packages in _EXTRAS.items() if package in packages), None)
    if extra is None:
        raise error
    if extra == "data":
        extra = own_extra  # the extra of spn-model includes that of spn-data
    sys.exit(
        f"Error: {program} needs the package {package}, which is not installed: "
        f"run pip install '{DISTRIBUTION}[{extra}]'"
    )
