"""Console entry points: one line for a missing extra, too little memory, and a signal while modules load."""

from __future__ import annotations

import os
import re
import resource
import signal
import sys
from importlib import import_module
from typing import NoReturn

DISTRIBUTION = "squeezeposenet-toolkit"
_KEPT = "Completed work is kept: run the same command to resume."
STOPPED = f"Stopped. {_KEPT}"
# What libraries say instead of raising MemoryError.
_NO_MEMORY = re.compile(
    r"failed to map segment|allocate memory|bad[ _]alloc|Insufficient memory|start new thread",
    re.IGNORECASE,
)
_MOST_TOLD = 120
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
    _fit_blas_into_memory()
    try:
        import_module(f"spn_cli.{module}").main(prog_name=program)
    except ModuleNotFoundError as error:
        _report_missing(program, module, error)
    except Exception as error:
        if not isinstance(error, MemoryError) and not _NO_MEMORY.search(str(error)):
            raise
        sys.exit(
            "Error: there is not enough memory for this, or a limit such as ulimit -v is too low "
            f"({' '.join(str(error).split())[:_MOST_TOLD] or type(error).__name__}). {_KEPT}"
        )


def _fit_blas_into_memory() -> None:
    """Let OpenBLAS use one thread if memory is limited: it sends SIGINT if it cannot start more."""
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit != resource.RLIM_INFINITY and limit < 2e9 + 1e8 * (os.cpu_count() or 1):
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


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
