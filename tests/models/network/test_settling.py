"""Settling against a plain least-squares solution, finite differences and known structures."""

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from models.capture.metrics import pa_mpjpe
from models.network.reprojection_tensors import solve_cameras
from models.network.settling import (
    estimate_foreshortening,
    first_order_cameras,
    mirror_images,
    settle,
)
from models.network.settling_kernels import DECISIVE, STIFFNESS

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

K = 0.12  # foreshortening


def structures(frames: int, keypoints: int, seed: int = 0) -> Float64:
    """Draw structures, centred, root-mean-square radius 1."""
    points = np.random.default_rng(seed).standard_normal((frames, keypoints, 3))
    points -= points.mean(1, keepdims=True)
    points /= np.sqrt(np.square(points).sum(-1).mean(-1))[:, None, None]
    return points


def rotations_of(frames: int, views: int, seed: int = 1) -> Float64:
    drawn = Rotation.random(frames * views, random_state=seed).as_matrix()
    return drawn.reshape(frames, views, 3, 3)


def seen_by(points: Float64, rotations: Float64, k: float) -> Float32:
    """Normalised views (N, K, P, 2) of perspective cameras at the distance 1 / k."""
    cameras = points[:, None] @ rotations.mT
    views = cameras[..., :2] / (1 + k * cameras[..., 2:])
    views -= views.mean(-2, keepdims=True)
    sizes = np.sqrt(np.square(views).sum(-1).mean(-1))
    normalised: Float32 = (views / sizes[..., None, None]).astype(np.float32)
    return normalised


def gaps(frames: int, views: int, keypoints: int) -> Float32:
    """Confidences with hidden keypoints and a hidden view, and one frame that has one view."""
    weights = np.random.default_rng(2).uniform(0.2, 1, (frames, views, keypoints))
    weights[np.random.default_rng(3).random(weights.shape) < 0.1] = 0
    weights[0, 0] = 0
    weights[1, 1:] = 0
    return weights.astype(np.float32)


def hypothesis(
    points: Float64, keypoints: Float32, weights: Float32, guesses: Float64, k: float, rounds: int
) -> tuple[Float64, float]:
    """One frame, one handedness: the settled structure (P, 3) and the error that is left."""
    target = keypoints.astype(np.float64)  # (K, P, 2)
    for step in range(rounds + 1):
        given = (points[None], target, weights.astype(np.float64), guesses)
        cameras = solve_cameras(*map(torch.from_numpy, given))
        rotations, scales, translations = (part.numpy() for part in cameras)
        axes = scales[:, None, None] * rotations[:, :2]  # (K, 2, 3)
        flat = points @ axes.mT + translations[:, None]
        share = weights / np.maximum(weights.sum(-1, keepdims=True), 1e-9)
        depth = points @ rotations[:, 2, :, None]  # (K, P, 1)
        depth = depth - (share[..., None] * depth).sum(1, keepdims=True)
        slopes = -depth * (flat - (share[..., None] * flat).sum(1, keepdims=True))
        slopes -= (share[..., None] * slopes).sum(1, keepdims=True)
        target = keypoints - k * slopes
        residuals = np.sqrt(weights)[..., None] * (target - flat)  # (K, P, 2)
        if step == rounds:
            return points, float(np.sqrt(np.square(residuals).sum()))
        moved = []
        for p, point in enumerate(points):
            rows = np.sqrt(weights[:, p])[:, None, None] * axes
            system = np.concatenate((rows.reshape(-1, 3), np.sqrt(STIFFNESS) * np.eye(3)))
            wanted = np.concatenate((residuals[:, p].ravel(), np.zeros(3)))
            moved.append(point + np.linalg.lstsq(system, wanted, rcond=None)[0])
        points = np.array(moved)
    raise AssertionError


@pytest.mark.parametrize("k", [K, -K])
@pytest.mark.parametrize("rounds", [1, 2, 5])
def test_settling_is_least_squares_in_turn(k: float, rounds: int) -> None:
    frames, views, count = 12, 3, 8
    truth, rotations = structures(frames, count), rotations_of(frames, views)
    keypoints, weights = seen_by(truth, rotations, K), gaps(frames, views, count)
    points = truth + 0.2 * structures(frames, count, seed=5)
    found, guesses = settle(points, keypoints, weights, rotations, k, rounds=rounds)
    turned = 0
    for n in range(frames):
        given = points[n], keypoints[n], weights[n], rotations[n]
        kept, error = hypothesis(*given, k, rounds)
        other, error_of_other = hypothesis(*given, -k, rounds)
        changes = (weights[n].sum(-1) > 0).sum() > 1 and error_of_other < DECISIVE * error
        turned += changes
        mirror = np.array([1, 1, -1 if (k < 0) != changes else 1])
        expected = (other if changes else kept) * mirror
        expected -= expected.mean(0)
        expected /= np.sqrt(np.square(expected).sum(-1).mean())
        np.testing.assert_allclose(found[n], expected, atol=1e-5)
        np.testing.assert_allclose(guesses[n], mirror[:, None] * rotations[n] * mirror, atol=1e-6)
    assert turned < frames
    assert k > 0 or turned > 0


@pytest.mark.parametrize("mirror", [False, True])
def test_many_rounds_find_the_structure_behind_the_views(*, mirror: bool) -> None:
    truth, rotations = structures(10, 9), rotations_of(10, 4)
    keypoints, weights = seen_by(truth, rotations, K / 4), np.ones((10, 4, 9), np.float32)
    points, guesses = truth + 0.2 * structures(10, 9, seed=5), rotations
    if mirror:
        points, guesses = mirror_images(points, guesses)
    before = pa_mpjpe(points, truth, reflection="either").mean
    found, _ = settle(points, keypoints, weights, guesses, -K / 4 if mirror else K / 4, rounds=60)
    after = pa_mpjpe(found, truth, reflection="never").mean
    assert after < 0.05 * before
    np.testing.assert_allclose(found.mean(1), 0, atol=1e-12)
    np.testing.assert_allclose(np.square(found).sum(-1).mean(-1), 1)


def test_the_slope_is_that_of_perspective() -> None:
    truth, rotations = structures(3, 8), rotations_of(3, 2)
    keypoints, weights = seen_by(truth, rotations, K), np.ones((3, 2, 8), np.float32)
    found = first_order_cameras(truth, keypoints, weights, rotations, K, rounds=5)
    cameras = truth[:, None] @ found.rotations.mT
    scale = np.sqrt(
        np.square(found.projected).sum((-2, -1)) / np.square(cameras[..., :2]).sum((-2, -1))
    )

    def view(k: float) -> Float64:
        image = scale[..., None, None] * cameras[..., :2] / (1 + k * cameras[..., 2:])
        centred: Float64 = image - image.mean(-2, keepdims=True)
        return centred

    step = 1e-5
    np.testing.assert_allclose(found.slopes, (view(step) - view(-step)) / (2 * step), atol=1e-6)
    np.testing.assert_allclose(found.projected, view(0), atol=1e-6)
    # What foreshortening explains, weak perspective does not.
    first_order = np.abs(found.projected + K * found.slopes - keypoints).mean()
    assert first_order < 0.3 * np.abs(found.projected - keypoints).mean()


def test_views_without_weight_see_nothing() -> None:
    truth, rotations = structures(2, 8), rotations_of(2, 2)
    keypoints, weights = seen_by(truth, rotations, K), np.ones((2, 2, 8), np.float32)
    weights[0, 1] = 0
    found = first_order_cameras(truth, keypoints, weights, rotations, K)
    np.testing.assert_allclose(found.rotations[0, 1], rotations[0, 1], atol=1e-12)
    assert (found.projected[0, 1] == 0).all()
    assert (found.slopes[0, 1] == 0).all()
    assert (found.projected[1] != 0).all()


@pytest.mark.parametrize("k", [0.05, 0.1])
def test_foreshortening_is_about_that_of_the_cameras(k: float) -> None:
    truth, rotations = structures(80, 10), rotations_of(80, 4)
    keypoints, weights = seen_by(truth, rotations, k), np.ones((80, 4, 10), np.float32)
    found = estimate_foreshortening(truth, keypoints, weights, rotations)
    assert 0.4 * k < found < 1.1 * k  # settled structures take up a part of it
    image, guesses = mirror_images(truth, rotations)
    assert estimate_foreshortening(image, keypoints, weights, guesses) == pytest.approx(-found)


def test_one_view_does_not_determine_foreshortening() -> None:
    truth, rotations = structures(5, 8), rotations_of(5, 1)
    keypoints, weights = seen_by(truth, rotations, K), np.ones((5, 1, 8), np.float32)
    assert estimate_foreshortening(truth, keypoints, weights, rotations) == 0


def test_without_foreshortening_nothing_is_settled() -> None:
    truth, rotations = structures(5, 8), rotations_of(5, 3)
    keypoints, weights = seen_by(truth, rotations, 0), np.ones((5, 3, 8), np.float32)
    points, guesses = settle(truth, keypoints, weights, rotations, 0.0)
    np.testing.assert_array_equal(points, truth)
    np.testing.assert_allclose(guesses, rotations, atol=1e-12)


def test_mirror_images_look_alike() -> None:
    truth, rotations = structures(4, 8), rotations_of(4, 3)
    image, turned = mirror_images(truth, rotations)
    np.testing.assert_allclose(np.linalg.det(turned), 1)
    np.testing.assert_allclose(
        (image[:, None] @ turned.mT)[..., :2], (truth[:, None] @ rotations.mT)[..., :2]
    )
