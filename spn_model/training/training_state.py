"""State of an interrupted training to resume from: weights, optimiser, position and log."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from spn_data.errors import FormatError, StageError
from spn_model.models.checkpoint import read_tensors, set_state, write_tensors

FORMAT = "squeezeposenet-state"
_NETWORK, _OPTIMIZER = "network.", "optimizer."
COLUMNS = (
    *("event", "stage", "step", "images", "progress", "train_s", "validate_s", "wait_s"),
    *("rate", "loss", "images_per_s", "frames", "located", "median_m", "median_deg", "p95_m"),
    *("p95_deg", "figures"),
)


@dataclass
class Position:
    """Progress of a training.

    Attributes
    ----------
    stage, step : int
        Next stage and step.
    steps : int
        Steps done in all stages.
    drawn, shown : int
        Training images drawn, and given to the network; they differ if a pose model makes more or fewer of
        them.
    train_s, stage_s : float
        Seconds of training in total and in this stage.
    validate_s, wait_s : float
        Seconds of validation, and of waiting for batches (part of the training time).
    validated : int
        Validations in this stage.
    best : float or None
        Lowest score so far.
    kept : dict or None
        Stage, steps and errors of the checkpoint.
    latest : dict
        Errors at the last validation.
    log_bytes : int
        Length of the log.
    is_due : bool
        Whether a validation was begun after the last step and stopped.
    """

    stage: int = 0
    step: int = 0
    steps: int = 0
    drawn: int = 0
    shown: int = 0
    train_s: float = 0.0
    stage_s: float = 0.0
    validate_s: float = 0.0
    wait_s: float = 0.0
    validated: int = 0
    best: float | None = None
    kept: dict[str, Any] | None = None
    latest: dict[str, Any] = field(default_factory=dict)
    log_bytes: int = 0
    is_due: bool = False


def save_state(
    path: Path, network: nn.Module, optimizer: torch.optim.Optimizer | None, position: Position
) -> None:
    """Write the state atomically. Raises StageError if it cannot be written."""
    tensors = {_NETWORK + name: t for name, t in network.state_dict().items()}
    if optimizer is not None:
        for index, values in optimizer.state_dict()["state"].items():
            for name, value in values.items():
                if isinstance(value, Tensor):
                    tensors[f"{_OPTIMIZER}{index}.{name}"] = value
    write_tensors(path, FORMAT, tensors, {"position": asdict(position)})


@dataclass(frozen=True, eq=False)
class TrainingState:
    """State of a training read from a file."""

    path: Path
    position: Position
    tensors: Mapping[str, Tensor]

    def restore_network(self, network: nn.Module) -> None:
        """Load the weights. Raises FormatError if they belong to another network."""
        own = {
            name.removeprefix(_NETWORK): tensor
            for name, tensor in self.tensors.items()
            if name.startswith(_NETWORK)
        }
        set_state(network, own, self.path)

    def restore_optimizer(self, optimizer: torch.optim.Optimizer) -> None:
        """Load the optimiser's state. Raises FormatError if it belongs to other parameters."""
        parameters = [p for group in optimizer.param_groups for p in group["params"]]
        state: dict[int, dict[str, Tensor]] = {}
        for name, tensor in self.tensors.items():
            if not name.startswith(_OPTIMIZER):
                continue
            index, _, key = name.removeprefix(_OPTIMIZER).partition(".")
            if not index.isdigit() or int(index) >= len(parameters):
                raise FormatError(f"{self.path}: belongs to another training; start again")
            parameter = parameters[int(index)]
            if tensor.ndim and tensor.shape != parameter.shape:
                raise FormatError(f"{self.path}: belongs to another training; start again")
            # Fused steps run over raw memory, so moments need their parameter's memory layout.
            value = torch.empty_like(parameter).copy_(tensor) if tensor.ndim else tensor
            state.setdefault(int(index), {})[key] = value
        whole = optimizer.state_dict()
        optimizer.load_state_dict({"state": state, "param_groups": whole["param_groups"]})


def read_state(path: Path) -> TrainingState | None:
    """Read a state; return None if there is none. Raises FormatError if it is damaged."""
    if not path.exists():
        return None
    tensors, document, _ = read_tensors(path, FORMAT)
    try:
        values = dict(document["position"])
        position = Position(**values)
        kinds = {f.name: type(getattr(Position(), f.name)) for f in fields(Position)}
        for name in ("stage", "step", "steps", "drawn", "shown", "validated", "log_bytes"):
            if type(values[name]) is not kinds[name] or values[name] < 0:
                raise ValueError(f"{name} is {values[name]!r}")
        for name in ("train_s", "stage_s", "validate_s", "wait_s"):
            setattr(position, name, float(values[name]))
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(f"{path}: damaged training state ({error!r})") from error
    return TrainingState(path, position, tensors)


class Log:
    """log.csv, flushed after each row; resuming truncates rows that will be computed again."""

    def __init__(self, path: Path, length: int):
        self._path = path
        try:
            self._file = path.open("r+b" if length and path.exists() else "wb")
            self._file.truncate(length)
            self._file.seek(0, os.SEEK_END)
        except OSError as error:
            raise StageError(f"{path} cannot be written: {error.strerror}") from error
        if self._file.tell() == 0:
            self._write(list(COLUMNS))

    def write(self, values: Mapping[str, object]) -> int:
        """Append a row and return the length of the file. Raises StageError if it cannot be written."""
        return self._write([_cell(values.get(name)) for name in COLUMNS])

    def _write(self, cells: list[str]) -> int:
        text = io.StringIO(newline="")
        csv.writer(text, lineterminator="\n").writerow(cells)
        try:
            self._file.write(text.getvalue().encode())
            self._file.flush()
        except OSError as error:
            raise StageError(f"{self._path} cannot be written: {error.strerror}") from error
        return self._file.tell()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _cell(value: object) -> str:
    if value is None:
        return ""
    return f"{value:.6g}" if isinstance(value, float) else str(value)
