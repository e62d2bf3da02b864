"""Adam in a few operations on one tensor: `torch.optim.Adam` has more overhead per step."""

import math

import torch
from torch import Tensor

MEAN_KEPT, SQUARE_KEPT = 0.9, 0.999  # shares of the running means that stay at each step
SMALLEST_ROOT = 1e-8  # added to the root of the squares, which is divided by


class Adam:
    """Kingma and Ba, *Adam: a method for stochastic optimization*, 2015, of one tensor (W,)."""

    def __init__(self, weights: Tensor) -> None:
        self.weights = weights
        self.mean, self.square = torch.zeros_like(weights), torch.zeros_like(weights)

    @torch.no_grad()
    def step(self, gradient: Tensor, *, count: int, rate: float) -> None:
        """Take step number `count`, from 1 on, along a gradient (W,)."""
        self.mean.lerp_(gradient, 1 - MEAN_KEPT)
        self.square.mul_(SQUARE_KEPT).addcmul_(gradient, gradient, value=1 - SQUARE_KEPT)
        root = self.square.sqrt().div_(math.sqrt(1 - SQUARE_KEPT**count)).add_(SMALLEST_ROOT)
        self.weights.addcdiv_(self.mean, root, value=-rate / (1 - MEAN_KEPT**count))
