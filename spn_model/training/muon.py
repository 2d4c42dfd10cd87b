"""Muon optimiser: weight matrices are updated by orthogonalised steps, all other parameters as by AdamW.

Jordan et al. 2024, "Muon: an optimizer for hidden layers in neural networks". torch implements it for
matrices only; here the weights of convolutions are treated as matrices too, (outputs, inputs x height x
width).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

_MOMENTUM = 0.95
_BETAS, _EPSILON = (0.9, 0.999), 1e-8  # AdamW's
_NEWTON_SCHULZ = (
    3.4445,
    -4.7750,
    2.0315,
)  # the paper's coefficients: fast convergence, to singular values from 0.7 to 1.2
_ROUNDS = 5


def orthogonalized(matrix: Tensor, dtype: torch.dtype) -> Tensor:
    """Orthogonalise a matrix U S V' (n, m) to approximately U V' by five Newton-Schulz iterations.

    They are computed in `dtype`, for which bfloat16 is sufficient; the result has the matrix's own type.
    """
    a, b, c = _NEWTON_SCHULZ
    is_tall = matrix.shape[0] > matrix.shape[1]
    x = (matrix.T if is_tall else matrix).to(dtype)
    x = x / x.norm().clamp(min=1e-7)
    for _ in range(_ROUNDS):
        gram = x @ x.T
        x = torch.addmm(x, torch.addmm(gram, gram, gram, beta=b, alpha=c), x, beta=a)
    return (x.T if is_tall else x).to(matrix.dtype)


class Muon(torch.optim.Optimizer):
    """Optimiser whose steps of a matrix have the learning rate as root mean square, similar to AdamW's.

    Parameters
    ----------
    groups : iterable of dict
        Parameter groups as for torch's optimisers.
    lr : float
        Learning rate.
    weight_decay : float
        Decoupled weight decay.
    dtype : torch.dtype
        Type in which matrices are orthogonalised.
    """

    def __init__(
        self,
        groups: Iterable[dict[str, Any]],
        lr: float,
        weight_decay: float,
        dtype: torch.dtype = torch.float32,
    ):
        super().__init__(groups, {"lr": lr, "weight_decay": weight_decay})
        self._dtype = dtype

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # type: ignore[override]
        """Update all parameters that have a gradient."""
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is None:
                    continue
                move = self._move_matrix if parameter.ndim >= 2 else self._move_vector
                move(parameter, parameter.grad, group["lr"], group["weight_decay"])

    def _move_matrix(self, parameter: Tensor, gradient: Tensor, rate: float, decay: float) -> None:
        state = self.state[parameter]
        if not state:
            state["momentum"] = torch.zeros_like(parameter)
        momentum = state["momentum"].lerp_(gradient, 1 - _MOMENTUM)
        matrix = gradient.lerp(momentum, _MOMENTUM).flatten(1)
        step = orthogonalized(matrix, self._dtype) * max(matrix.shape) ** 0.5
        parameter.mul_(1 - rate * decay).add_(step.reshape(parameter.shape), alpha=-rate)

    def _move_vector(self, parameter: Tensor, gradient: Tensor, rate: float, decay: float) -> None:
        """Apply an AdamW step (Loshchilov and Hutter 2019)."""
        state = self.state[parameter]
        if not state:
            state["step"] = torch.zeros(())
            state["mean"], state["square"] = (torch.zeros_like(parameter) for _ in range(2))
        state["step"] += 1
        mean = state["mean"].lerp_(gradient, 1 - _BETAS[0])
        square = state["square"].lerp_(gradient.square(), 1 - _BETAS[1])
        of_mean, of_square = (1 - beta ** float(state["step"]) for beta in _BETAS)
        length = (square / of_square).sqrt_().add_(_EPSILON)
        parameter.mul_(1 - rate * decay).addcdiv_(mean, length, value=-rate / of_mean)
