"""Which of two mirror images the structures are: the one that perspective explains better."""

import numpy as np
from numpy.typing import NDArray

from models.bundle.problem import Scene, ShapePrior, make_shape_prior
from models.bundle.scene_adjustment import adjust_frames
from models.bundle.shape_model import align, learn_shapes
from models.calibrating.expectation_maximisation import LEAST_SPREAD, uncertainty
from models.calibrating.problem import Problem, Solution, Steps
from models.network.settling import mirror_images
from models.numerics.medians import lower_median

Float64 = NDArray[np.float64]

FIRST_SPREAD = 0.2  # of a structure about the network's, in units of its radius
FIRST_NOISE = 0.03  # of a keypoint, as a share of its view's size
ITERATIONS = 15
DECISIVE = 0.5  # a frame leaves the handedness of the others if its cost falls below this share
ORDINARY_FRAMES = 0.95  # quantile of the costs; what costs more than twice that has no say


class NothingFoundError(Exception):
    """The keypoints do not determine any cameras."""


def same_hand(points: Float64, others: Float64) -> bool:
    """Whether most structures (N, P, 3) are no mirror images of the others (N, P, 3)."""
    centred = others - others.mean(1, keepdims=True)
    distances = []
    for sign in (1, -1):
        aligned, _ = align(sign * points, centred)
        distances.append(np.square(aligned - centred).sum((1, 2)))
    return bool((distances[0] < distances[1]).mean() > 0.5)


def choose_hand(
    problem: Problem, scene: Scene, hint: tuple[int, int, int, int] | None
) -> Steps[Solution]:
    """Refine a scene as the network has it and mirrored; what explains the keypoints better stays.

    The `hint` are four keypoints whose volume is positive in most frames: it decides instead.

    Raises
    ------
    NothingFoundError
        When no frame can be explained at all.
    """
    rig, noise = problem.reference, FIRST_NOISE * problem.size
    views = problem.views(noise)
    starts, scenes, costs = (scene, mirrored(scene)), [], []
    for start in starts:
        yield
        refined, cost = adjust_frames(
            views, rig, _about_structures(start.points), start, iterations=ITERATIONS
        )
        scenes.append(refined)
        costs.append(cost)
    explained = np.isfinite(costs)  # (2, N)
    if not explained.any():
        raise NothingFoundError
    # Frames that neither explains must not decide for all.
    bound = 2 * np.quantile(np.stack(costs)[explained], ORDINARY_FRAMES)
    mirror = bool(costs[1].clip(max=bound).sum() < costs[0].clip(max=bound).sum())
    if hint is not None:
        mirror = _volume(scenes[0].points, hint) < 0
    ours, theirs = int(mirror), int(not mirror)
    # A frame that the network mirrored is turned back, if its keypoints say so decidedly.
    turned_back = costs[theirs] < DECISIVE * costs[ours]  # (N,)
    best = _choose_frames(turned_back, scenes[theirs], scenes[ours])
    means = np.where(turned_back[:, None, None], best.points, starts[ours].points)
    prior = _about_structures(means)
    unsure = uncertainty(views, rig, prior, best, np.any(explained, 0))
    shapes = learn_shapes(best.points[unsure.frames], unsure.covariances, floor=LEAST_SPREAD)
    return Solution(rig, best, prior, shapes, noise, noise)


def mirrored(scene: Scene) -> Scene:
    """Return the mirror image of a scene, which weak perspective sees alike."""
    points, rotations = mirror_images(scene.points, scene.rotations)
    return scene._replace(points=points, rotations=rotations)


def _choose_frames(which: NDArray[np.bool_], some: Scene, others: Scene) -> Scene:
    """Take the frames `which` (N,) from one scene and the rest from another."""
    return Scene(
        *(
            np.where(which.reshape(-1, *[1] * (a.ndim - 1)), a, b)
            for a, b in zip(some, others, strict=True)
        )
    )


def _volume(points: Float64, corners: tuple[int, int, int, int]) -> float:
    """Median of (b - a) x (c - a) . (d - a) of four keypoints of structures (N, P, 3)."""
    a, b, c, d = (points[:, corner] for corner in corners)
    return float(lower_median((np.cross(b - a, c - a) * (d - a)).sum(-1)))


def _about_structures(points: Float64) -> ShapePrior:
    """Return the prior that structures are like these (N, P, 3), alike in every direction."""
    return make_shape_prior(points, np.zeros((points.shape[1], 3, 0)), FIRST_SPREAD)
