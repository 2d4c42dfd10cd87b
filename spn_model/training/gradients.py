"""The gradient of a step: of a whole batch, or of its parts beside each other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import torch
from torch import Tensor, nn

from spn_model.models.pose_model import Batch, PoseModel
from spn_model.training.machine import Machine


class Gradients:
    """Sets the gradients of parameters; threads compute as many parts at once as the pool has."""

    def __init__(
        self, model: PoseModel, parameters: Sequence[nn.Parameter], pool: ThreadPoolExecutor | None
    ):
        self._model, self._parameters, self._pool = model, parameters, pool

    def compute(self, parts: Sequence[Batch]) -> tuple[Tensor, dict[str, Tensor]]:
        """Mean loss of a step's parts, and its figures, detached; parameters have the mean's gradient.

        The sum is taken in the order of the parts: it does not depend on which is ready first.
        """
        found = list((self._pool.map if self._pool else map)(self._part, parts))
        share = 1 / len(parts)
        for k, parameter in enumerate(self._parameters):
            given = [gradient for _, _, of in found if (gradient := of[k]) is not None]
            parameter.grad = sum(given[1:], start=given[0]) * share if given else None
        losses = torch.stack([loss for loss, _, _ in found])
        names = {name: None for _, figures, _ in found for name in figures}
        figures = {
            name: torch.stack([of[name] for _, of, _ in found if name in of]).mean()
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
    """Threads for the parts of each step, which end with the block.

    Two threads that each compute a part are faster than two that share each convolution: these wait for
    each other at every layer.
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
