"""Monitoring of the losses of steps: means for the log, and detection of divergence."""

from __future__ import annotations

import math

import torch
from torch import Tensor

_LEVEL_STEPS = 50  # first steps of a stage, whose mean loss is the initial level
_MEMORY = 0.95  # decay of the running mean that is compared with this level
_FAR = 10.0  # allowed rise, in multiples of the larger of this level and the decrease from it


class Diverged(ArithmeticError):
    """Raised when a loss diverges."""


class LossMonitor:
    """Losses of one stage, checked every few steps if checking has to wait for the device."""

    def __init__(self, every: int):
        self._every = every
        self._waiting: list[tuple[Tensor, dict[str, Tensor]]] = []
        self._sums: dict[str, float] = {}
        self._count = self._seen = 0
        self._level = self._running = 0.0
        self._lowest = math.inf

    def add(self, loss: Tensor, gradient: Tensor, figures: dict[str, Tensor]) -> None:
        """Add the loss of a step before its update is applied. Raises Diverged if the loss does."""
        self._waiting.append((torch.stack([loss.detach().float(), gradient.float()]), figures))
        if len(self._waiting) >= self._every:
            self.settle()

    def settle(self) -> None:
        """Check the losses added since the last call. Raises Diverged if the loss does."""
        waiting, self._waiting = self._waiting, []
        for pair, figures in waiting:
            loss, gradient = pair.tolist()
            if not (math.isfinite(loss) and math.isfinite(gradient)):
                raise Diverged(f"the loss is {loss:g}, its gradient {gradient:g}")
            self._compare(loss)
            self._count += 1
            for name, value in {"loss": loss, **{k: float(v) for k, v in figures.items()}}.items():
                self._sums[name] = self._sums.get(name, 0.0) + value

    def means(self) -> dict[str, float]:
        """Return the means of "loss" and of the metrics since the last call.

        Raises Diverged if the loss does.
        """
        self.settle()
        count, sums = self._count, self._sums
        self._count, self._sums = 0, {}
        return {name: total / count for name, total in sums.items()}

    def _compare(self, loss: float) -> None:
        self._seen += 1
        if self._seen <= _LEVEL_STEPS:
            self._level += (loss - self._level) / self._seen
            self._running = self._level
            return
        self._running = _MEMORY * self._running + (1 - _MEMORY) * loss
        self._lowest = min(self._lowest, self._running)
        room = _FAR * max(abs(self._level), self._level - self._lowest, 1.0)
        if self._running > self._level + room:
            raise Diverged(f"the loss rose from {self._level:.4g} to {self._running:.4g}")
