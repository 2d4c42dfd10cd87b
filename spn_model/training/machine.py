"""Compute resources of a training: device, threads, precision and distributed processes."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import cv2
import torch
from threadpoolctl import threadpool_limits
from torch import Tensor, distributed

from spn_data.errors import InputError
from spn_model.training.precision import bfloat16_is_fast

PRECISIONS = ("auto", "float32", "bfloat16")
_MAX_WORKERS = 8


@dataclass(frozen=True)
class Machine:
    """Device and threads used by a training or an evaluation.

    Attributes
    ----------
    device : torch.device
        Device of the network.
    threads : int
        Threads that compute the network on the CPU.
    workers : int
        Further threads that make batches.
    bfloat16 : bool
        Whether matrices are multiplied in bfloat16 in training.
    cores : int
        Cores available to all threads.
    """

    device: torch.device
    threads: int
    workers: int
    bfloat16: bool
    cores: int

    def plain(self) -> dict[str, str | int]:
        """Return the description of the machine for the log."""
        on_card = self.device.type == "cuda"
        return {
            "device": torch.cuda.get_device_name(self.device) if on_card else str(self.device),
            "threads": self.cores,
            "precision": "bfloat16" if self.bfloat16 else "float32",
            "torch": torch.__version__,
        }


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0))


def choose(
    device: str, threads: int, precision: str, local_rank: int = 0, *, makes_batches: bool = False
) -> Machine:
    """Choose device, threads and precision.

    Parameters
    ----------
    device : str
        "auto" (CUDA if available), "cpu", "cuda" or "cuda:N".
    threads : int
        Number of threads in total; 0 for all cores.
    precision : str
        One of `PRECISIONS`.
    local_rank : int
        Index of the process on this machine, which selects the device of "cuda".
    makes_batches : bool
        Whether to reserve some of the threads, at least one, for making batches.

    Raises
    ------
    InputError
        If the device does not exist.
    """
    available = torch.cuda.is_available()
    if device == "auto":
        device = "cuda" if available else "cpu"
    if device == "cuda":
        device = f"cuda:{local_rank}"
    try:
        chosen = torch.device(device)
    except RuntimeError as error:
        raise InputError(f"unknown device {device!r}; choose auto, cpu, cuda or cuda:N") from error
    if chosen.type not in ("cpu", "cuda"):
        raise InputError(f"unknown device {device!r}; choose auto, cpu, cuda or cuda:N")
    if chosen.type == "cuda" and not (
        available and (chosen.index or 0) < torch.cuda.device_count()
    ):
        raise InputError(f"device {device} not found, or torch was built without CUDA")
    threads = threads or cores()
    fast = bfloat16_is_fast(chosen.type) if precision == "auto" else precision == "bfloat16"
    if not makes_batches:
        return Machine(chosen, threads, 0, fast, threads)
    if chosen.type == "cuda":
        return Machine(chosen, 1, min(max(1, threads - 1), _MAX_WORKERS), fast, threads)
    # Threads of one convolution wait for each other, so that one without a core of its own delays all.
    workers = min(max(1, threads // 4), _MAX_WORKERS)
    return Machine(chosen, max(1, threads - workers), workers, fast, threads)


@contextmanager
def limited_threads(machine: Machine) -> Iterator[None]:
    """Limit the threads of torch, OpenCV and BLAS to those of the machine within the block."""
    before, before_cv2 = torch.get_num_threads(), cv2.getNumThreads()
    torch.set_num_threads(machine.threads)
    cv2.setNumThreads(1)  # each worker that makes batches is one thread
    try:
        # Further BLAS threads of NumPy and SciPy busy-wait on cores that other threads need.
        with threadpool_limits(1, user_api="blas"):
            yield
    finally:
        torch.set_num_threads(before)
        cv2.setNumThreads(before_cv2)


@dataclass(frozen=True)
class Ranks:
    """Processes of one training as started by `torchrun`; a single process has rank 0 of 1.

    Attributes
    ----------
    rank, world : int
        Index of this process, and number of processes.
    local_rank : int
        Index of this process on its machine.
    """

    rank: int = 0
    world: int = 1
    local_rank: int = 0

    @property
    def is_main(self) -> bool:
        """Whether this process writes files and messages."""
        return self.rank == 0

    def broadcast_from_first(self, tensors: Sequence[Tensor]) -> None:
        """Copy the first process's tensors to all processes."""
        if self.world > 1:
            for tensor in tensors:
                distributed.broadcast(tensor, src=0)

    def average(
        self, parameters: Sequence[Tensor], seconds: float, stop: bool
    ) -> tuple[float, bool]:
        """Average gradients over the processes; return the first one's seconds and whether any stops.

        All values are sent as one message, because they are many and small.
        """
        if self.world == 1:
            return seconds, stop
        parts = [p.grad if p.grad is not None else torch.zeros_like(p) for p in parameters]
        status = [seconds if self.is_main else 0.0, float(stop)]
        more = torch.tensor(status, device=parts[0].device)
        flat = torch.cat([*(part.float().reshape(-1) for part in parts), more])
        distributed.all_reduce(flat)
        at = 0
        for parameter, part in zip(parameters, parts, strict=True):
            mean = flat[at : at + part.numel()].reshape(part.shape) / self.world
            parameter.grad = torch.empty_like(parameter).copy_(mean)
            at += part.numel()
        return float(flat[-2]), bool(flat[-1] > 0)

    def wait(self) -> None:
        """Wait until all processes have reached this call."""
        if self.world > 1:
            distributed.barrier()


def is_main_process() -> bool:
    """Return whether this process is the first of those started by `torchrun`, or the only one."""
    return int(os.environ.get("RANK", "0")) == 0


@contextmanager
def process_group(device: str) -> Iterator[Ranks]:
    """Join the processes that `torchrun` started, if any, for the duration of the block."""
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield Ranks()
        return
    local = int(os.environ.get("LOCAL_RANK", "0"))
    on_card = device != "cpu" and torch.cuda.is_available()
    if on_card:
        torch.cuda.set_device(local)
    distributed.init_process_group("nccl" if on_card else "gloo")
    try:
        yield Ranks(distributed.get_rank(), distributed.get_world_size(), local)
    finally:
        distributed.destroy_process_group()
