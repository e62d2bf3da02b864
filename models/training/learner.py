"""The network of a fit and its optimiser: one step a batch, on the device of the fit."""

import copy

import torch
from torch import Tensor

from models.lifting.fitted_prior import FittedPrior
from models.network.losses import Batch, objective
from models.network.priors.prior import Prior
from models.settings.config import FitConfig
from models.settings.priors import ARCHITECTURE
from models.training.adam import Adam


class Learner:
    """Trains a network on a device; `update_network` copies the weights to that on the CPU."""

    def __init__(self, network: Prior, device: torch.device) -> None:
        self._device = device
        self._network = network
        on_cpu = device.type == "cpu"
        self._trained = network if on_cpu else copy.deepcopy(network).to(device)
        weights, self._gradient = _flatten(self._trained)
        self._adam = Adam(weights)

    def step(self, batch: Batch, *, count: int, rate: float) -> tuple[float, float]:
        """Take step number `count`, from 1 on; return the loss and the error in pixels."""
        batch = batch.to(self._device)
        points, projected, _ = self._trained.reproject(batch.keypoints, batch.weights)
        total, figures = objective(points, projected, batch)
        self._gradient.zero_()
        torch.autograd.backward(total)
        self._adam.step(self._gradient, count=count, rate=rate)
        loss, error = figures.tolist()
        return loss, error

    def update_network(self) -> None:
        """Copy the trained weights to the network on the CPU."""
        if self._trained is not self._network:
            self._network.load_state_dict(self._trained.state_dict())

    @property
    def weights(self) -> Tensor:
        """All weights of the network (W,), on the CPU."""
        return self._adam.weights.cpu()

    @property
    def moments(self) -> tuple[Tensor, Tensor]:
        """Adam's running means (W,) of the gradient and of its square, on the CPU."""
        return self._adam.mean.cpu(), self._adam.square.cpu()

    def resume(self, weights: Tensor, moments: tuple[Tensor, Tensor]) -> None:
        """Continue with the `weights` and `moments` of another learner."""
        self._adam.weights.copy_(weights)
        self._adam.mean.copy_(moments[0])
        self._adam.square.copy_(moments[1])


def begin_with(network: Prior, config: FitConfig, start: FittedPrior) -> None:
    """Copy the weights of a prior; raises ValueError if it has another architecture."""
    pairs = {name: (getattr(start.config, name), getattr(config, name)) for name in ARCHITECTURE}
    for what, (has, needs) in pairs.items():
        if has != needs:
            raise ValueError(f"the prior to start from has {what} {has}, the fit {needs}")
    network.load_state_dict(start.weights)


def _flatten(network: torch.nn.Module) -> tuple[Tensor, Tensor]:
    """Make all weights of a network, and their gradients, parts of one tensor (W,) each.

    One call then updates them all.
    """
    parameters = list(network.parameters())
    weights = torch.cat([part.detach().flatten() for part in parameters])
    gradient = torch.zeros_like(weights)
    start = 0
    for part in parameters:
        place = slice(start, start + part.numel())
        part.data = weights[place].view_as(part)
        part.grad = gradient[place].view_as(part)
        start = place.stop
    return weights, gradient
