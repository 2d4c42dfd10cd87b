"""Gradient of a step, computed from a whole batch or from its parts in parallel."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import torch
from torch import Tensor, nn

from spn_model.models.pose_model import Batch, PoseModel
from spn_model.training.machine import Machine


class Gradients:
    """Computation of parameter gradients, with as many parts in parallel as the pool has threads."""

    def __init__(
        self, model: PoseModel, parameters: Sequence[nn.Parameter], pool: ThreadPoolExecutor | None
    ):
        self._model, self._parameters, self._pool = model, parameters, pool

    def compute(self, parts: Sequence[Batch]) -> tuple[Tensor, dict[str, Tensor]]:
        """Set the gradients of a step and return its mean loss and metrics, both detached.

        The parameters get the gradient of the mean loss. It is summed in the order of the parts, so that it
        does not depend on which one is ready first.
        """
        computed = list((self._pool.map if self._pool else map)(self._part, parts))
        share = 1 / len(parts)
        for k, parameter in enumerate(self._parameters):
            given = [gradient for _, _, of in computed if (gradient := of[k]) is not None]
            parameter.grad = sum(given[1:], start=given[0]) * share if given else None
        losses = torch.stack([loss for loss, _, _ in computed])
        names = {name: None for _, figures, _ in computed for name in figures}
        figures = {
            name: torch.stack([of[name] for _, of, _ in computed if name in of]).mean()
            for name in names
        }
        return losses.mean(), figures

    def _part(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor], Sequence[Tensor | None]]:
        loss, figures = self._model.loss(batch)
        gradients = torch.autograd.grad(loss, self._parameters, allow_unused=True)
        return loss.detach(), figures, gradients


@contextmanager
def gradient_workers(
    model: PoseModel, parameters: Sequence[nn.Parameter], parts: int, machine: Machine
) -> Iterator[Gradients]:
    """Provide `Gradients` with threads for the parts of each step, which end with the block.

    Two threads that each compute a part are faster than two that share each convolution, since these wait
    for each other at every layer.
    """
    threads = min(parts, machine.cores) if machine.device.type == "cpu" else 1
    if threads == 1:
        yield Gradients(model, parameters, None)
        return
    each = max(1, machine.threads // threads)
    pool = ThreadPoolExecutor(
        threads, "gradients", initializer=torch.set_num_threads, initargs=(each,)
    )
    try:
        yield Gradients(model, parameters, pool)
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
