"""Bone lengths against SciPy's spanning trees, differences, and the bones of a figure."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.sparse.csgraph import minimum_spanning_tree

from models.bundle.bone_lengths import BoneLengths, find_bone_lengths
from models.capture.synthetic import EDGES, synthetic_capture

Float64 = NDArray[np.float64]
STEP = 1e-6


@pytest.fixture(scope="module")
def figure() -> Float64:
    """Make a figure in 200 poses, each of another size."""
    points = synthetic_capture(frames=200, views=1, seed=3).points3d.astype(np.float64)
    sizes = np.random.default_rng(0).uniform(0.5, 2, (200, 1, 1))
    return np.asarray(points * sizes)


def pairs_of(bones: BoneLengths) -> set[tuple[int, int]]:
    return {(int(min(pair)), int(max(pair))) for pair in bones.ends.T.tolist()}


def test_bones_connect_all_keypoints_and_keep_their_length(figure: Float64) -> None:
    bones = find_bone_lengths(figure)
    assert bones.ends.shape == (2, 15)
    assert bones.steady
    reached = {0}
    for _ in range(15):
        reached |= {k for pair in pairs_of(bones) if reached & set(pair) for k in pair}
    assert reached == set(range(16))
    # Bones, or what is held together by them, such as the hips.
    lengths = np.linalg.norm(figure[:, bones.ends[0]] - figure[:, bones.ends[1]], axis=-1)
    lengths /= np.linalg.norm(figure[:, [0]] - figure[:, [7]], axis=-1)  # pelvis to spine
    assert (lengths.std(0) / lengths.mean(0)).max() < 0.01
    limbs = {(1, 2), (2, 3), (4, 5), (5, 6), (10, 11), (11, 12), (13, 14), (14, 15)}
    assert limbs <= pairs_of(bones) & set(EDGES)


def test_the_tree_is_the_lightest(figure: Float64) -> None:
    rng = np.random.default_rng(1)
    points = figure + 0.02 * rng.standard_normal(figure.shape)
    bones = find_bone_lengths(points)
    # The size of a frame is the mean over its bones, weighted by their steadiness.
    every = np.linalg.norm(points[:, :, None] - points[:, None], axis=-1)
    logarithms = np.log(np.where(every > 0, every, 1))
    a, b = bones.ends
    shares = 1 / np.square(bones.scatter)
    sizes = (logarithms[:, a, b] - bones.lengths) @ shares / shares.sum()
    scaled = logarithms - sizes[:, None, None]
    scatter = 1.4826 * np.median(np.abs(scaled - np.median(scaled, 0)), 0)
    tree = minimum_spanning_tree(np.sqrt(np.square(scatter) + 0.003**2) * (every[0] > 0))
    weight = float(tree.sum())
    assert float(bones.scatter.sum()) == pytest.approx(weight, rel=0.02)


def test_lengths_that_views_do_not_determine_do_not_count(figure: Float64) -> None:
    """A third of the keypoints are anywhere; the measured ones find the bones of all."""
    rng = np.random.default_rng(2)
    measured = rng.random(figure.shape[:2]) > 0.3
    points = np.where(measured[..., None], figure, rng.standard_normal(figure.shape))
    whole, bones = find_bone_lengths(figure), find_bone_lengths(points, measured)
    assert bones.steady
    assert pairs_of(bones) & pairs_of(whole) >= {(1, 2), (2, 3), (4, 5), (5, 6)}
    assert bones.scatter == pytest.approx(whole.scatter, abs=0.01)
    both = measured[:, bones.ends[0]] & measured[:, bones.ends[1]]
    offsets = bones.offsets(points)
    assert np.abs(offsets[both]).max() < 0.02
    assert (bones.precision(offsets)[~both] == 0).all()
    elsewhere = np.where(measured[..., None], figure, 2 * points)
    np.testing.assert_allclose(bones.cost(elsewhere), bones.cost(points), atol=1e-9)


def test_distances_that_are_hardly_measured_are_no_bones(figure: Float64) -> None:
    measured = np.zeros(figure.shape[:2], np.bool_)
    measured[:4] = True
    assert not find_bone_lengths(figure, measured).steady


def test_what_has_no_bones_is_not_steady() -> None:
    points = np.random.default_rng(2).standard_normal((50, 8, 3))
    bones = find_bone_lengths(points)
    assert not bones.steady
    assert bones.cost(points).tolist() == [0.0] * 50


def test_sizes_do_not_matter(figure: Float64) -> None:
    bones = find_bone_lengths(figure)
    larger = figure * np.linspace(0.2, 5, 200)[:, None, None]
    offsets = bones.offsets(figure)
    np.testing.assert_allclose(bones.offsets(larger), offsets, rtol=0, atol=1e-9)
    assert np.abs(offsets).max() < 0.01


def test_derivatives_agree_with_differences(figure: Float64) -> None:
    rng = np.random.default_rng(4)
    points = figure[:5] + 0.03 * rng.standard_normal((5, 16, 3))
    bones = find_bone_lengths(figure)
    by = rng.standard_normal((5, 16, 3, 4))  # how points move with four numbers

    def moved(step: Float64) -> Float64:
        changed: Float64 = points + by @ step
        return changed

    derived = bones.derivatives(points, by)
    offsets = bones.offsets(points)
    slopes = 2 * ((bones.precision(offsets) * offsets)[..., None] * derived).sum(1)
    for number, unit in enumerate(STEP * np.eye(4)):
        difference = bones.offsets(moved(unit)) - bones.offsets(moved(-unit))
        np.testing.assert_allclose(
            derived[..., number], difference / (2 * STEP), rtol=1e-5, atol=1e-6
        )
        cost = bones.cost(moved(unit)) - bones.cost(moved(-unit))
        np.testing.assert_allclose(slopes[:, number], cost / (2 * STEP), rtol=1e-4, atol=1e-2)
