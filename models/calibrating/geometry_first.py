"""Static cameras that keypoints settle without a network.

Where static views see one rigid scene (`models.epipolar.static_rig`), geometry gives the cameras in
seconds, as surely as anything later could. Lenses of two views are scanned by the evidence of
shapes (`models.calibrating.lens_scan`). Shapes are learnt with these cameras.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle.problem import Scene
from models.bundle.scene_adjustment import adjust_frames
from models.bundle.shape_model import align
from models.calibrating.doubts import Checked
from models.calibrating.expectation_maximisation import about_model, learn, regauge
from models.calibrating.handedness import DECIDED, certainty
from models.calibrating.keypoint_rig import geometry_of, lens_kinds, start_from_geometry
from models.calibrating.lens_scan import scan_lenses
from models.calibrating.problem import Problem, Solution
from models.calibrating.search import Arranged
from models.numerics.steps import Steps
from models.settings.config import FitConfig

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

EXPLAINED = 0.15  # of the subject's size: geometry leaves more noise than this to shapes
ITERATIONS = 15  # of adjusting the structures of all frames


class Settled(NamedTuple):
    """Static cameras that keypoints alone give."""

    arranged: Arranged  # with the frames that shapes were learnt from
    start: Solution  # of all frames, before shapes were learnt


def settle_by_geometry(problem: Problem, config: FitConfig, *, most: int) -> Steps[Settled | None]:
    """Find static cameras from all frames, and shapes from `most` of them.

    None where geometry does not decide: cameras that move, lenses, poses or a hand that were given,
    lenses that look like another camera model, a handedness that keypoints leave open.
    """
    views = len(problem.poses)
    given = problem.posed or config.hand is not None or np.isfinite(problem.lens_sds).any()
    if views < 2 or given or config.cameras == "moving":
        return None
    found = yield from geometry_of(problem, list(range(views)))
    if found is None or not found.resting.all():
        return None
    hand = certainty([found.log_odds])
    if hand < DECIDED or found.noise * problem.side > EXPLAINED * problem.size:
        return None
    if views == 2:
        found = yield from scan_lenses(problem, found)
    started = start_from_geometry(problem, found)
    if started is None:
        return None
    whole, deviations = started
    grouped = problem._replace(lens_groups=lens_kinds(problem, found))
    frames = np.unique(np.linspace(0, len(problem.keypoints) - 1, most).astype(np.int64))
    kept = grouped.of(frames)._replace(kept=np.ones(views, bool))
    solution = yield from learn(kept, whole.of(frames))
    free = kept._replace(kept=np.zeros(views, bool))
    reason = (
        f"keypoints of all frames are one rigid scene of {views} static cameras,"
        f" to {found.noise * problem.side:.3g} px (from keypoints)"
    )
    checked = Checked(free, solution, ())
    arranged = Arranged(solution, checked, reason, hand, (), kept=deviations)
    return Settled(arranged, whole)


def structures_of_all(problem: Problem, learnt: Solution, start: Solution) -> Scene:
    """Adjust the structures of all frames to cameras and shapes as they were learnt of some."""
    points, similarity = align(start.scene.points, learnt.shapes.mean)
    scene = regauge(start.scene, points, similarity, learnt.rig)
    prior = about_model(learnt.shapes, len(points))
    views = problem.views(learnt.noise)
    scene, _ = adjust_frames(views, learnt.rig, prior, scene, iterations=ITERATIONS)
    return scene
