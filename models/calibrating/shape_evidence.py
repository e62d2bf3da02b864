"""The evidence of shapes for two static cameras, judged on frames that they were not learnt from.

With wrong lenses a body changes its shape as it turns. Shapes are learnt from every other block of
frames and the others are held against them, both ways round: on the frames they were learnt from,
shapes follow wrong lenses, and the evidence jumps from one trial to the next.
"""

import numpy as np
from numpy.typing import NDArray

from models.bundle.frame_evidence import log_evidence
from models.bundle.shape_model import align
from models.calibrating.expectation_maximisation import about_model, learn, regauge
from models.calibrating.keypoint_rig import static_start
from models.calibrating.problem import CalibrationProblem
from models.epipolar.rig_adjustment import AdjustedRig
from models.epipolar.robust_points import robust_structures
from models.epipolar.static_rig import StaticScene
from models.numerics.steps import Steps

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

ROUNDS = 8  # of learning shapes
LEAST_NOISE = 3e-4  # of the image's side: shapes distinguish lenses by less than lens models leave
LEAST_BLOCKS, MOST_BLOCKS, LONGEST_BLOCK = 4, 10, 10  # of frames


def blocks_of(frames: int) -> Int64:
    """Return the block (N,) of each frame: neighbours are alike, and belong together."""
    count = min(MOST_BLOCKS, max(LEAST_BLOCKS, frames // LONGEST_BLOCK))
    return np.arange(frames) * count // frames


def shape_evidence(
    problem: CalibrationProblem, images: Float64, cameras: AdjustedRig
) -> Steps[Float64]:
    """Return the log evidence (N,) of each frame under shapes learnt from blocks of other frames.

    `images` (N, 2, P, 2) are the keypoints in sides (`straight_images`). NaN where a frame cannot
    be explained.

    Raises
    ------
    numpy.linalg.LinAlgError
        Where shapes cannot be learnt.
    """
    structures = robust_structures(cameras.rig, images, problem.weights, cameras.noise)
    held = problem._replace(kept=np.ones(2, bool))
    noise = float(np.median(cameras.noise)) * problem.side
    odd = blocks_of(len(images)) % 2
    evidence = np.full(len(images), np.nan)
    for half in (0, 1):
        learnt, judged = np.flatnonzero(odd == half), np.flatnonzero(odd != half)
        starts = [
            static_start(held.of(some), StaticScene(cameras.rig, structures[some]), noise)
            for some in (learnt, judged)
        ]
        if starts[0] is None or starts[1] is None:
            raise np.linalg.LinAlgError("no structure can be located")
        solution = yield from learn(
            held.of(learnt), starts[0], rounds=ROUNDS, least_noise=LEAST_NOISE
        )
        points, similarity = align(starts[1].scene.points, solution.shapes.mean)
        scene = regauge(starts[1].scene, points, similarity, solution.rig)
        views, prior = held.of(judged).views(solution.noise), about_model(solution.shapes, len(judged))
        evidence[judged] = log_evidence(views, solution.rig, prior, scene)
    return evidence
