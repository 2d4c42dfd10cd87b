"""What a training runs on: device, threads, precision, and the processes that share its work."""

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
    """device : of torch. threads : that the network computes with on the processor. workers : others, that
    make batches. bfloat16 : matrices are multiplied in it while training. cores : that all may use."""

    device: torch.device
    threads: int
    workers: int
    bfloat16: bool
    cores: int

    def plain(self) -> dict[str, str | int]:
        """For the log."""
        on_card = self.device.type == "cuda"
        return {
            "device": torch.cuda.get_device_name(self.device) if on_card else str(self.device),
            "threads": self.cores,
            "precision": "bfloat16" if self.bfloat16 else "float32",
            "torch": torch.__version__,
        }


def cores() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0))


def choose(
    device: str, threads: int, precision: str, local_rank: int = 0, *, makes_batches: bool = False
) -> Machine:
    """device : "auto" (CUDA where there is one), "cpu", "cuda", "cuda:N"; threads : in all, 0 for all cores.

    With makes_batches some of the threads are set apart for that; it takes one in any case. Raises
    InputError for a device that there isn't.
    """
    available = torch.cuda.is_available()
    if device == "auto":
        device = "cuda" if available else "cpu"
    if device == "cuda":
        device = f"cuda:{local_rank}"
    try:
        chosen = torch.device(device)
    except RuntimeError as error:
        raise InputError(f"there is no device {device!r}: auto, cpu, cuda or cuda:N") from error
    if chosen.type not in ("cpu", "cuda"):
        raise InputError(f"there is no device {device!r}: auto, cpu, cuda or cuda:N")
    if chosen.type == "cuda" and not (
        available and (chosen.index or 0) < torch.cuda.device_count()
    ):
        raise InputError(f"device {device} is not in this machine, or torch was built without CUDA")
    threads = threads or cores()
    fast = bfloat16_is_fast(chosen.type) if precision == "auto" else precision == "bfloat16"
    if not makes_batches:
        return Machine(chosen, threads, 0, fast, threads)
    if chosen.type == "cuda":
        return Machine(chosen, 1, min(max(1, threads - 1), _MAX_WORKERS), fast, threads)
    # Threads of one convolution wait for each other: one that shares its core holds up all of them.
    workers = min(max(1, threads // 4), _MAX_WORKERS)
    return Machine(chosen, max(1, threads - workers), workers, fast, threads)


@contextmanager
def limited_threads(machine: Machine) -> Iterator[None]:
    """Libraries compute with the machine's threads inside, and as before after it."""
    before, before_cv2 = torch.get_num_threads(), cv2.getNumThreads()
    torch.set_num_threads(machine.threads)
    cv2.setNumThreads(1)  # each maker of batches is one thread
    try:
        # NumPy's and SciPy's further threads wait busily, on cores that others compute on.
        with threadpool_limits(1, user_api="blas"):
            yield
    finally:
        torch.set_num_threads(before)
        cv2.setNumThreads(before_cv2)


@dataclass(frozen=True)
class Ranks:
    """The processes of one training, as `torchrun` starts them; one alone has rank 0 of 1."""

    rank: int = 0
    world: int = 1
    local_rank: int = 0

    @property
    def is_main(self) -> bool:
        """Whether this process writes and speaks."""
        return self.rank == 0

    def broadcast_from_first(self, tensors: Sequence[Tensor]) -> None:
        """Give all processes the first one's values."""
        if self.world > 1:
            for tensor in tensors:
                distributed.broadcast(tensor, src=0)

    def average(
        self, parameters: Sequence[Tensor], seconds: float, stop: bool
    ) -> tuple[float, bool]:
        """Average gradients over the processes; to all come the first one's seconds, and whether one stops.

        One message for all of them: they are many and small.
        """
        if self.world == 1:
            return seconds, stop
        parts = [p.grad if p.grad is not None else torch.zeros_like(p) for p in parameters]
        told = [seconds if self.is_main else 0.0, float(stop)]
        more = torch.tensor(told, device=parts[0].device)
        flat = torch.cat([*(part.float().reshape(-1) for part in parts), more])
        distributed.all_reduce(flat)
        at = 0
        for parameter, part in zip(parameters, parts, strict=True):
            mean = flat[at : at + part.numel()].reshape(part.shape) / self.world
            parameter.grad = torch.empty_like(parameter).copy_(mean)
            at += part.numel()
        return float(flat[-2]), bool(flat[-1] > 0)

    def wait(self) -> None:
        """Until all processes are here."""
        if self.world > 1:
            distributed.barrier()


@contextmanager
def process_group(device: str) -> Iterator[Ranks]:
    """The processes that `torchrun` started, if it did; they part at the end."""
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
