"""Static cameras from keypoints, without a network.

If static views see one rigid scene (`models.epipolar.static_rig`), geometry gives the cameras in
seconds, as accurately as any later step. Lenses of two views have a posterior in which the evidence
of shapes counts, too (`models.calibrating.pair_lenses`). Shapes are learnt with these cameras.
"""

from typing import NamedTuple

import numpy as np

from models.bundle.problem import Scene, moving_rig, views_apart
from models.bundle.separate_frames import adjust_frames
from models.bundle.shape_model import align
from models.calibrating.arrangement_search import Arranged
from models.calibrating.doubts import check_given
from models.calibrating.expectation_maximisation import about_model, learn, regauge
from models.calibrating.handedness import (
    DECIDED,
    Corners,
    NothingFoundError,
    by_volume,
    certainty,
    choose_handedness,
    odds_for,
)
from models.calibrating.keypoint_rig import lens_kinds, start_from_geometry
from models.calibrating.pair_lenses import settle_lenses
from models.calibrating.problem import CalibrationProblem, Solution
from models.epipolar.static_rig import StaticRig
from models.numerics.sampling import evenly_spread
from models.numerics.steps import Steps
from models.settings.config import FitConfig

ITERATIONS = 15  # of adjusting the structures of all frames


class Settled(NamedTuple):
    """Static cameras from keypoints alone."""

    arranged: Arranged  # with the frames that shapes were learnt from
    start: Solution  # of all frames, before shapes were learnt


def settle_by_geometry(
    problem: CalibrationProblem, config: FitConfig, *, most: int
) -> Steps[Settled | None]:
    """Take the static cameras of the geometry, and learn shapes from `most` of the frames.

    None where geometry does not decide: cameras that move, given poses, given lenses that keypoints
    contradict.
    """
    views = len(problem.poses)
    problem, found, certain = yield from _static_rig(problem, config.corners)
    started = None if found is None else start_from_geometry(problem, found)
    if found is None or started is None:
        return None
    whole, deviations = started
    grouped = problem._replace(lens_groups=lens_kinds(problem, found))
    frames = evenly_spread(len(problem.keypoints), most)
    kept = grouped.of(frames)._replace(kept=np.ones(views, bool))
    solution = yield from learn(kept, whole.of(frames))
    free = kept._replace(kept=np.zeros(views, bool))
    checked = yield from check_given(free, solution)
    if checked.doubts:
        return None
    reason = (
        f"keypoints of all frames are one rigid scene of {views} static cameras,"
        f" to {found.noise * problem.side:.3g} px (from keypoints)"
    )
    arranged = Arranged(solution, checked, reason, certain, (), kept=deviations)
    return Settled(arranged, whole)


def _static_rig(
    problem: CalibrationProblem, corners: Corners | None
) -> Steps[tuple[CalibrationProblem, StaticRig | None, float]]:
    """Find static cameras and the certainty of their handedness; None if there are none.

    The problem has the posterior of two views' lenses then.
    """
    found = None if problem.geometry is None else problem.geometry.rig
    if found is None or not found.static.all():
        return problem, None, 0.0
    as_given = None if corners is None else by_volume(found, corners)
    if as_given is not None:
        certain, found = 1.0, as_given
    else:
        certain, found = yield from _handed(problem, found)
    problem, found = yield from settle_lenses(problem, found)
    return problem, found, certain


def _handed(problem: CalibrationProblem, found: StaticRig) -> Steps[tuple[float, StaticRig]]:
    """Return the more certain one of the rig and its mirror image, and how certain it is.

    Where the rig leaves the handedness open, perspective within single views counts, too: poses of
    their own for all views of all frames, from those of the rig.
    """
    certain = certainty([found.log_odds])
    started = None if certain > DECIDED else start_from_geometry(problem, found)
    if started is None:
        return certain, found
    start, _ = started
    moving = problem._replace(reference=moving_rig(start.rig.lenses))
    try:
        handed = yield from choose_handedness(moving, views_apart(start.scene, start.rig), None)
    except NothingFoundError:
        return certain, found
    certain = certainty([found.log_odds, odds_for(start, handed)])
    return (certain, found) if certain >= 0.5 else (1 - certain, found.mirrored())


def structures_of_all(problem: CalibrationProblem, learnt: Solution, start: Solution) -> Scene:
    """Adjust the structures of all frames, with cameras and shapes learnt from some."""
    points, similarity = align(start.scene.points, learnt.shapes.mean)
    scene = regauge(start.scene, points, similarity, learnt.rig)
    prior = about_model(learnt.shapes, len(points))
    views = problem.views(learnt.noise)
    scene, _ = adjust_frames(views, learnt.rig, prior, scene, iterations=ITERATIONS)
    return scene
