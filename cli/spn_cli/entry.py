"""Console entry points: a missing extra, and a signal while libraries are loaded, give one line."""

from __future__ import annotations

import os
import signal
import sys
from importlib import import_module
from typing import NoReturn

DISTRIBUTION = "squeezeposenet-toolkit"
STOPPED = "Stopped. Completed work is kept: run the same command to resume."
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
    # Until the command begins and after it has ended; in between, see `spn_cli.console`.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _stop)
    try:
        import_module(f"spn_cli.{module}").main(prog_name=program)
    except ModuleNotFoundError as error:
        _report_missing(program, module, error)


def _stop(number: int, _frame: object) -> NoReturn:
    """Exit at once: libraries that are being loaded turn an exception into one of their own."""
    os.write(2, f"\n{STOPPED}\n".encode())
    os._exit(128 + number)


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
