"""Rigs put together from relative poses that are known exactly."""

from itertools import combinations

import numpy as np
import pytest

from models.epipolar.assembly import COMMON, ViewGraph, assemble
from models.epipolar.pairs import RelativePoses
from models.epipolar.rig_search import same_rig
from models.epipolar.robust_points import triangulate_points
from models.epipolar.static_cameras import SeenPoints, distances_of
from tests.models.epipolar.exact_rigs import exact_points, exact_rig, images_of, relative_poses

NOISE = 1e-3


def graph_of(views: int, left_out: tuple[tuple[int, int], ...] = ()) -> ViewGraph:
    rig = exact_rig(views)
    pairs = [pair for pair in combinations(range(views), 2) if pair not in left_out]
    return {(j, k): relative_poses(rig, j, k) for j, k in pairs}


@pytest.mark.parametrize("views", [2, 3, 5])
def test_true_pairs_give_the_true_rig(views: int) -> None:
    truth = exact_rig(views)
    seen = images_of(truth, exact_points())
    best = assemble(graph_of(views), seen, NOISE)[0]
    assert same_rig(best.rig, truth)
    points = triangulate_points(best.rig, seen)
    assert distances_of(best.rig, points, seen).max() < 1e-4


def test_a_chain_of_pairs_connects_all_views() -> None:
    truth = exact_rig(4)
    graph = graph_of(4, left_out=((0, 2), (0, 3), (1, 3)))
    seen = images_of(truth, exact_points())
    assert same_rig(assemble(graph, seen, NOISE)[0].rig, truth)


def test_views_are_of_one_scale() -> None:
    """Pairs do not know how far their cameras are apart: points that three views see do."""
    truth = exact_rig(3)
    rig = assemble(graph_of(3), images_of(truth, exact_points()), NOISE)[0].rig
    places = [-np.einsum("kji,kj->ki", r.rotations, r.translations) for r in (rig, truth)]
    gaps = [np.linalg.norm(p[[1, 2, 2]] - p[[0, 0, 1]], axis=1) for p in places]
    np.testing.assert_allclose(gaps[0] / gaps[0][0], gaps[1] / gaps[1][0], rtol=1e-3)


def test_the_best_of_several_solutions_is_taken() -> None:
    """The first solution of one pair is wrong, and so is the order of its costs."""
    truth = exact_rig(3)
    graph = graph_of(3)
    right = graph[1, 2]
    turned = np.stack((right.rotations[0].T, right.rotations[0]))
    graph[1, 2] = RelativePoses(
        turned,
        np.tile(right.translations, (2, 1)),
        np.tile(right.focals, (2, 1)),
        np.array([0.0, 0.1]),
        right.noise,
    )
    rigs = assemble(graph, images_of(truth, exact_points()), NOISE)
    assert len(rigs) > 1
    assert same_rig(rigs[0].rig, truth)
    costs = [each.cost for each in rigs]
    assert costs == sorted(costs)


def test_cost_is_that_of_an_observation_under_the_noise() -> None:
    """Exact images cost the logarithm of the noise's variance alone."""
    truth = exact_rig(3)
    best = assemble(graph_of(3), images_of(truth, exact_points()), NOISE)[0]
    assert best.cost == pytest.approx(2 * np.log(NOISE), abs=1e-3)


def test_wrong_images_do_not_misplace_a_camera() -> None:
    truth = exact_rig(3)
    seen = images_of(truth, exact_points())
    wrong = np.random.default_rng(0).random(seen.images.shape[2]) < 0.15
    seen.images[2, :, wrong] += 0.2
    rig = assemble(graph_of(3), seen, NOISE)[0].rig
    assert same_rig(rig, truth)
    right = SeenPoints(seen.images[..., ~wrong], seen.weights[:, ~wrong])
    points = triangulate_points(rig, right)
    assert np.median(distances_of(rig, points, right)) < 3 * NOISE


def test_a_view_that_shares_too_little_gives_no_rig() -> None:
    seen = images_of(exact_rig(3), exact_points())
    seen.weights[2, COMMON - 1 :] = 0
    assert assemble(graph_of(3), seen, NOISE) == []
    seen.weights[2, :COMMON] = 1
    assert assemble(graph_of(3), seen, NOISE)


def test_a_view_without_pairs_gives_no_rig() -> None:
    seen = images_of(exact_rig(3), exact_points())
    assert assemble(graph_of(3, left_out=((0, 2), (1, 2))), seen, NOISE) == []
