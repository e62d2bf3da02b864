"""The arithmetic that runtimes are compared with is the network's, at the stated cost."""

import numpy as np
import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.arithmetic import NUMPY, feed_forward, fold, products
from benchmarks.captures import studio
from models.capture.observations import as_observations
from models.network.priors.hierarchical import HierarchicalPrior
from models.network.reprojection_tensors import solve_cameras
from models.numerics.rotations import rotations_from_rows

SIZES = (32, 16, 8)


@pytest.fixture(scope="module")
def network() -> HierarchicalPrior:
    network = HierarchicalPrior(17, SIZES).requires_grad_(False)
    network.initialise(seed=3)
    generator = torch.Generator().manual_seed(4)
    for parameter in network.parameters():
        if parameter.ndim == 1:  # thresholds and biases, which begin at zero
            parameter.copy_(0.1 * torch.rand(parameter.shape, generator=generator))
    return network


def test_gives_what_the_network_gives(network: HierarchicalPrior) -> None:
    seen = as_observations(studio(3, frames=20).keypoints)
    weights = {name: value.numpy() for name, value in network.named_parameters()}
    keypoints, shown = torch.from_numpy(seen.keypoints), torch.from_numpy(seen.weights)
    structures, _, matrices = network.reproject(keypoints, shown)
    guesses = torch.from_numpy(rotations_from_rows(matrices.numpy())).to(structures.dtype)
    cameras = solve_cameras(structures[:, None], keypoints, shown, guesses)

    points, axes, scales, translations = feed_forward(
        NUMPY, fold(weights, len(SIZES), np.concatenate), seen.keypoints, seen.weights
    )

    np.testing.assert_allclose(points, structures.numpy(), atol=1e-5)
    np.testing.assert_allclose(axes, cameras.rotations[..., :2, :].numpy(), atol=1e-4)
    np.testing.assert_allclose(scales, cameras.scales.numpy(), atol=1e-4)
    np.testing.assert_allclose(translations, cameras.translations.numpy(), atol=1e-4)


@pytest.mark.thorough
def test_counts_the_products_of_the_network(network: HierarchicalPrior) -> None:
    views = torch.randn(3, 17, 2)
    with FlopCounterMode(display=False) as counter:
        codes, _ = network.encode(views)
        network.decode(codes[:1])

    counted = sum(2 * rows * inner * columns for rows, inner, columns in products(3, 17, SIZES))
    assert counted == counter.get_total_flops()
