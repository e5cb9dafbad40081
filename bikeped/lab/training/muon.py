"""Muon, the optimiser of the convolutions: orthogonalised momentum.

A few directions dominate the gradient of a convolution; a step of equal length in all directions
learns the rare ones, too (Jordan et al. 2024, "Muon: an optimizer for hidden layers in neural
networks"; the coefficients of the iteration are theirs).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch

_MOMENTUM = 0.95
_TURNS = 5
_A, _B, _C = 3.4445, -4.7750, 2.0315


class Muon(torch.optim.Optimizer):
    """For weights of two or more dimensions; those beyond the first are flattened."""

    def __init__(self, params: Iterable[torch.Tensor], lr: float, decay: float) -> None:
        super().__init__(params, {"lr": lr, "decay": decay})

    def step(self, closure: Any = None) -> None:
        """One step along the gradients."""
        with torch.no_grad():
            for group in self.param_groups:
                for weight in group["params"]:
                    if weight.grad is not None:
                        self._move(weight, group["lr"], group["decay"])

    def _move(self, weight: torch.Tensor, rate: float, decay: float) -> None:
        state = self.state[weight]
        if not state:
            state["momentum"] = torch.zeros_like(weight)
        state["momentum"].lerp_(weight.grad, 1 - _MOMENTUM)
        ahead = weight.grad.lerp(state["momentum"], _MOMENTUM)
        step = orthogonal(ahead.reshape(len(ahead), -1))
        tall = max(1.0, step.shape[0] / step.shape[1]) ** 0.5
        weight.mul_(1 - rate * decay)
        weight.sub_(step.reshape(weight.shape), alpha=rate * tall)


def orthogonal(matrix: torch.Tensor) -> torch.Tensor:
    """`matrix` [n, m] with its singular values moved near one (0.7 to 1.2)."""
    wide = matrix.shape[0] <= matrix.shape[1]
    x = matrix if wide else matrix.T
    x = x / (x.norm() + 1e-7)
    for _ in range(_TURNS):
        square = x @ x.T
        x = _A * x + (_B * square + _C * square @ square) @ x
    return x if wide else x.T
