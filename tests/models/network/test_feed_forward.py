"""The compiled network against the one that is trained."""

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from models.capture.observations import Observations, as_observations
from models.network.answers import Answers, make_answers, nothing_unusual
from models.network.feed_forward import feed_forward
from models.network.priors.hierarchical import HierarchicalPrior
from models.network.reprojection_tensors import project, solve_cameras
from models.network.settling import (
    SETTLE_ALL,
    SETTLE_NONE,
    SettlingPolicy,
    mirror_images,
    settle,
    settle_beyond,
)
from models.numerics.rotations import rotations_from_rows

Float32 = NDArray[np.float32]
Floats = NDArray[Any]  # of 32 or 64 bits

SIZES = [(9,), (16, 8), (24, 12, 5)]


def network_of(sizes: tuple[int, ...], keypoints: int, *, seed: int = 0) -> HierarchicalPrior:
    """Draw a network whose thresholds matter."""
    network = HierarchicalPrior(keypoints, sizes)
    network.initialise(seed)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in network.parameters():
            if parameter.ndim == 1:
                parameter.copy_(0.1 * torch.randn(parameter.shape, generator=generator))
    return network.requires_grad_(requires_grad=False)


def seen_of(frames: int, views: int, keypoints: int, *, gaps: bool) -> Observations:
    rng = np.random.default_rng(frames)
    pixels = rng.normal(500, 80, (frames, views, keypoints, 2))
    confidence = np.ones(pixels.shape[:3])
    if gaps:
        pixels[rng.random(pixels.shape[:3]) < 0.2] = np.nan
        pixels[rng.random(pixels.shape[:2]) < 0.3] = np.nan
        confidence = rng.uniform(0.2, 1, pixels.shape[:3])
        confidence[:, 0] = 1
    return as_observations(pixels, confidence)


def answers_of(
    network: HierarchicalPrior, seen: Observations, foreshortening: float, policy: SettlingPolicy
) -> Answers:
    answers = make_answers(*seen.weights.shape)
    prepared = network.lay_out(dict(network.named_parameters()), network.sizes)
    feed_forward(
        prepared, seen, foreshortening, policy, nothing_unusual(), 0, len(seen.sizes), answers
    )
    return answers


def trained(
    network: HierarchicalPrior, seen: Observations
) -> tuple[Floats, Float32, Float32, Floats]:
    """Return what the network in torch makes of frames, as `settle` takes it."""
    keypoints, weights = torch.from_numpy(seen.keypoints), torch.from_numpy(seen.weights)
    points, _, matrices = network.reproject(keypoints, weights)
    return points.numpy(), seen.keypoints, seen.weights, matrices.numpy()


def expected(points: Floats, guesses: Floats, seen: Observations) -> tuple[Floats, Floats, Floats]:
    """Structures, rotations and reprojection errors in pixels of tensors; NaN for no answer."""
    keypoints = torch.from_numpy(seen.keypoints).double()
    weights = torch.from_numpy(seen.weights).double()
    structure = torch.from_numpy(points)[:, None].double()
    cameras = solve_cameras(structure, keypoints, weights, torch.from_numpy(guesses).double())
    distances = (project(structure, cameras) - keypoints).norm(dim=-1) * (weights > 0)
    errors = distances.sum(-1).numpy() / np.maximum((seen.weights > 0).sum(-1), 1) * seen.sizes
    rotations = cameras.rotations.numpy().copy()
    structures = points.copy()
    structures[~seen.usable.any(1)] = np.nan
    rotations[~seen.usable] = errors[~seen.usable] = np.nan
    return structures, rotations, errors


@pytest.mark.parametrize("sizes", SIZES)
@pytest.mark.parametrize("gaps", [False, True])
def test_it_computes_what_was_trained(sizes: tuple[int, ...], *, gaps: bool) -> None:
    network, seen = network_of(sizes, 11), seen_of(40, 3, 11, gaps=gaps)
    points, _, _, matrices = trained(network, seen)
    rotations_of_network = rotations_from_rows(matrices)
    for sign in (1.0, -1.0):  # the network's structures may be mirror images
        shown = points, rotations_of_network
        if sign < 0:
            shown = mirror_images(*shown)
        structures, rotations, errors = expected(*shown, seen)
        found = answers_of(network, seen, sign * 0.1, SETTLE_NONE)
        np.testing.assert_allclose(found.points3d, structures, atol=2e-4)
        np.testing.assert_allclose(found.rotations, rotations, atol=2e-3)
        np.testing.assert_allclose(found.reprojection_errors, errors, rtol=1e-3, atol=1e-2)
        assert (found.camera_models == np.where(seen.usable, 0, -1)).all()
        assert (found.keypoints_used == (seen.weights > 0).sum(-1)).all()
    assert seen.usable.all() != gaps


@pytest.mark.parametrize("foreshortening", [0.0, 0.15, -0.15])
def test_frames_are_settled_as_batches_are(foreshortening: float) -> None:
    network, seen = network_of((16, 8), 11), seen_of(60, 3, 11, gaps=True)
    points, guesses = settle(*trained(network, seen), foreshortening)
    structures, _, errors = expected(points, guesses, seen)
    found = answers_of(network, seen, foreshortening, SETTLE_ALL)
    np.testing.assert_allclose(found.points3d, structures, atol=2e-3)
    np.testing.assert_allclose(found.reprojection_errors, errors, rtol=5e-3, atol=5e-2)


def test_only_frames_beyond_the_limit_of_their_misfit_are_settled() -> None:
    network, seen = network_of((16, 8), 11), seen_of(60, 3, 11, gaps=False)
    own = answers_of(network, seen, 0.15, SETTLE_NONE)
    settled = answers_of(network, seen, 0.15, SETTLE_ALL)
    misfits = (own.reprojection_errors / own.scales).mean(1)
    found = answers_of(network, seen, 0.15, settle_beyond(float(np.median(misfits))))
    odd = misfits > np.median(misfits)
    assert 20 < odd.sum() < 40
    np.testing.assert_array_equal(found.points3d[odd], settled.points3d[odd])
    np.testing.assert_array_equal(found.points3d[~odd], own.points3d[~odd])


def test_frames_outside_of_the_slice_are_left_alone() -> None:
    network, seen = network_of((9,), 6), seen_of(5, 2, 6, gaps=False)
    whole, part = answers_of(network, seen, 0.1, SETTLE_NONE), make_answers(5, 2, 6)
    part.points3d[:] = 7
    prepared = network.lay_out(dict(network.named_parameters()), network.sizes)
    feed_forward(prepared, seen, 0.1, SETTLE_NONE, nothing_unusual(), 1, 3, part)
    np.testing.assert_array_equal(part.points3d[1:3], whole.points3d[1:3])
    assert (part.points3d[[0, 3, 4]] == 7).all()
