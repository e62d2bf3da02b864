"""The handedness of structures: the mirror image that perspective explains better.

The log odds of every frame are kept, so that the certainty of the handedness can be computed.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle.problem import Scene, ShapePrior, make_shape_prior
from models.bundle.separate_frames import adjust_frames
from models.bundle.shape_model import align, learn_shapes
from models.calibrating.expectation_maximisation import LEAST_SPREAD, uncertainty
from models.calibrating.problem import CalibrationProblem, Solution
from models.epipolar.static_rig import StaticRig
from models.network.settling import mirror_images
from models.numerics.medians import lower_median
from models.numerics.steps import Steps

Float64 = NDArray[np.float64]
Corners = tuple[int, int, int, int]  # keypoints of a tetrahedron

FIRST_SPREAD = 0.2  # of a structure about the network's, in units of its radius
FIRST_NOISE = 0.03  # of a keypoint, as a share of its view's size
ITERATIONS = 15
DECISIVE = 0.5  # a frame leaves the handedness of the others if its cost falls below this share
ORDINARY_FRAMES = 0.95  # quantile of the costs; frames above twice that are ignored


DECIDED = 0.99  # certainty from which the handedness counts as known
LOUDEST = 10.0  # limit of the median log odds of a frame


class Handed(NamedTuple):
    """A solution with the handedness from moving cameras."""

    solution: Solution
    log_odds: Float64  # (N,) of each frame, for it and against its mirror image


class NothingFoundError(Exception):
    """The keypoints do not determine any cameras."""


def same_handedness(points: Float64, others: Float64) -> bool:
    """Whether most structures (N, P, 3) are no mirror images of the others (N, P, 3)."""
    centred = others - others.mean(1, keepdims=True)
    distances = []
    for sign in (1, -1):
        aligned, _ = align(sign * points, centred)
        distances.append(np.square(aligned - centred).sum((1, 2)))
    return bool((distances[0] < distances[1]).mean() > 0.5)


def by_volume(found: StaticRig, corners: Corners) -> StaticRig | None:
    """Return the rig, or its mirror image if four keypoints have a negative volume in most frames.

    Frames count that show all four. None if there are none.
    """
    known = np.isfinite(found.best.points[:, corners]).all((1, 2))
    if not known.any():
        return None
    return found if volume(found.best.points[known], corners) > 0 else found.mirrored()


def choose_handedness(
    problem: CalibrationProblem, scene: Scene, hint: Corners | None
) -> Steps[Handed]:
    """Refine a scene as from the network and mirrored; return the one that fits keypoints better.

    The `hint` are four keypoints whose volume is positive in most frames; if given, it decides.

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
        mirror = volume(scenes[0].points, hint) < 0
    ours, theirs = int(mirror), int(not mirror)
    # A frame that the network mirrored is turned back, if its keypoints clearly favour that.
    turned_back = costs[theirs] < DECISIVE * costs[ours]  # (N,)
    best = _choose_frames(turned_back, scenes[theirs], scenes[ours])
    log_odds = (costs[theirs].clip(max=bound) - costs[ours].clip(max=bound)) / 2
    means = np.where(turned_back[:, None, None], best.points, starts[ours].points)
    prior = _about_structures(means)
    unsure = uncertainty(views, rig, prior, best, np.any(explained, 0))
    shapes = learn_shapes(best.points[unsure.frames], unsure.covariances, floor=LEAST_SPREAD)
    solution = Solution(rig, best, prior, shapes, noise, noise)
    return Handed(solution, log_odds)


def odds_for(solution: Solution, handed: Handed) -> Float64:
    """Return the log odds (N,) of a solution's handedness from moving cameras."""
    alike = same_handedness(solution.scene.points, handed.solution.scene.points)
    return handed.log_odds if alike else -handed.log_odds


def certainty(evidence: list[Float64]) -> float:
    """Return the certainty of the handedness, between 0 and 1, from the log odds of frames.

    Each piece of `evidence` is an array (N,) of log odds. Frames repeat errors of lenses and
    detectors, so the sum of log odds alone would be too certain: the scatter over the frames
    counts, too. Pieces are combined as by Stouffer (*The American Soldier*, 1949).
    """
    scores = [_score(log_odds) for log_odds in evidence]
    score = sum(scores) / math.sqrt(max(len(scores), 1))
    return (1 + math.erf(score / math.sqrt(2))) / 2


def _score(log_odds: Float64) -> float:
    """Return the standard normal number equivalent to the log odds of frames (N,)."""
    known = log_odds[np.isfinite(log_odds) & (log_odds != 0)]
    if len(known) < 2:
        return 0.0
    loudest = LOUDEST * float(np.median(np.abs(known)))
    known = known.clip(-loudest, loudest)
    total = float(known.sum())
    error = float(known.std(ddof=1)) * math.sqrt(len(known))
    # The deviance of two hypotheses is the square of such a number.
    by_sum = math.sqrt(2 * abs(total))
    by_scatter = abs(total) / error if error > 0 else by_sum
    return math.copysign(min(by_sum, by_scatter), total)


def mirrored(scene: Scene) -> Scene:
    """Return the mirror image of a scene, which looks the same in weak perspective."""
    points, rotations = mirror_images(scene.points, scene.rotations)
    return scene._replace(points=points, rotations=rotations)


def _choose_frames(which: NDArray[np.bool_], some: Scene, others: Scene) -> Scene:
    """Take the frames `which` (N,) from one scene and all others from another."""
    return Scene(
        *(
            np.where(which.reshape(-1, *[1] * (a.ndim - 1)), a, b)
            for a, b in zip(some, others, strict=True)
        )
    )


def volume(points: Float64, corners: Corners) -> float:
    """Median of (b - a) x (c - a) . (d - a) of four keypoints of structures (N, P, 3)."""
    a, b, c, d = (points[:, corner] for corner in corners)
    return float(lower_median((np.cross(b - a, c - a) * (d - a)).sum(-1)))


def _about_structures(points: Float64) -> ShapePrior:
    """Return the isotropic prior about structures (N, P, 3)."""
    return make_shape_prior(points, np.zeros((points.shape[1], 3, 0)), FIRST_SPREAD)
