"""Losses of the steps: their means for the log, and whether they diverge."""

from __future__ import annotations

import math

import torch
from torch import Tensor

_LEVEL_STEPS = 50  # whose mean is the level that a stage's loss starts from
_MEMORY = 0.95  # of the running mean that is compared with it
_FAR = 10.0  # times the larger of that level and of how far the loss has come down from it


class Diverged(ArithmeticError):
    """Raised when a loss leads nowhere."""


class LossMonitor:
    """Of one stage. Losses of several steps are looked at together where looking waits for the device."""

    def __init__(self, every: int):
        self._every = every
        self._waiting: list[tuple[Tensor, dict[str, Tensor]]] = []
        self._sums: dict[str, float] = {}
        self._count = self._seen = 0
        self._level = self._running = 0.0
        self._lowest = math.inf

    def add(self, loss: Tensor, gradient: Tensor, figures: dict[str, Tensor]) -> None:
        """Of a step, before it is taken. Raises Diverged where the loss does."""
        self._waiting.append((torch.stack([loss.detach().float(), gradient.float()]), figures))
        if len(self._waiting) >= self._every:
            self.settle()

    def settle(self) -> None:
        """Look at what was added. Raises Diverged where the loss does."""
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
        """Of the loss ("loss") and its figures, over the steps since the last call. Raises Diverged."""
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
            raise Diverged(f"the loss began at {self._level:.4g} and is {self._running:.4g} now")
