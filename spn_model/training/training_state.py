"""Where a training stands, so that it can go on after it was stopped: weights, optimiser, position, log."""

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
    """How far a training is.

    stage, step : the next to do; steps : done in all stages. drawn, shown : training images drawn, and given
    to the network, which differ where a member makes more of them or fewer. Seconds : of training in all and
    in this stage, of validation, and waited for batches (part of training). validated : times in this stage.
    best : lowest score so far; kept : of the checkpoint: stage, step, errors; latest : errors at the last
    validation. log_bytes : length of the log.
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


def save_state(
    path: Path, network: nn.Module, optimizer: torch.optim.Optimizer | None, position: Position
) -> None:
    """Write whole. Raises StageError where the disk does not take it."""
    tensors = {_NETWORK + name: t for name, t in network.state_dict().items()}
    if optimizer is not None:
        for index, values in optimizer.state_dict()["state"].items():
            for name, value in values.items():
                if isinstance(value, Tensor):
                    tensors[f"{_OPTIMIZER}{index}.{name}"] = value
    write_tensors(path, FORMAT, tensors, {"position": asdict(position)})


@dataclass(frozen=True, eq=False)
class TrainingState:
    """What `save_state` saved."""

    path: Path
    position: Position
    tensors: Mapping[str, Tensor]

    def restore_network(self, network: nn.Module) -> None:
        """Raises FormatError where the state is another network's."""
        own = {
            name.removeprefix(_NETWORK): tensor
            for name, tensor in self.tensors.items()
            if name.startswith(_NETWORK)
        }
        set_state(network, own, self.path)

    def restore_optimizer(self, optimizer: torch.optim.Optimizer) -> None:
        """Raises FormatError where the state is of other parameters."""
        parameters = [p for group in optimizer.param_groups for p in group["params"]]
        state: dict[int, dict[str, Tensor]] = {}
        for name, tensor in self.tensors.items():
            if not name.startswith(_OPTIMIZER):
                continue
            index, _, key = name.removeprefix(_OPTIMIZER).partition(".")
            if not index.isdigit() or int(index) >= len(parameters):
                raise FormatError(f"{self.path}: is of another training; start anew")
            parameter = parameters[int(index)]
            if tensor.ndim and tensor.shape != parameter.shape:
                raise FormatError(f"{self.path}: is of another training; start anew")
            # Fused steps run over memory: moments lie in the order of their parameter.
            value = torch.empty_like(parameter).copy_(tensor) if tensor.ndim else tensor
            state.setdefault(int(index), {})[key] = value
        whole = optimizer.state_dict()
        optimizer.load_state_dict({"state": state, "param_groups": whole["param_groups"]})


def read_state(path: Path) -> TrainingState | None:
    """None where there is none. Raises FormatError for a damaged one."""
    if not path.exists():
        return None
    tensors, document = read_tensors(path, FORMAT)
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
        raise FormatError(f"{path}: is a damaged state of a training ({error!r})") from error
    return TrainingState(path, position, tensors)


class Log:
    """log.csv: a row a line, on disk as soon as it is written; a resumed training cuts off what is redone."""

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
        """Length of the file with this row. Raises StageError where the disk does not take it."""
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
        self._file.close()


def _cell(value: object) -> str:
    if value is None:
        return ""
    return f"{value:.6g}" if isinstance(value, float) else str(value)
