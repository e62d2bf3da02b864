"""The posterior of the focal lengths of two static views.

Three parts count for what each is worth. Epipolar geometry: the likelihood of the keypoints along
the common focal length, with all other numbers of the cameras at their best. A prior of lenses:
usual ones, alike or not, and those that were given, with their standard deviations. The evidence of
shapes (`models.calibrating.shape_evidence`), whose errors have heavy tails: with some probability
shapes mislead, and then say nothing. The cameras are those of the posterior mean.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from models.bundle.problem import FOCAL
from models.calibrating.bagging import filled
from models.calibrating.keypoint_rig import lens_beliefs, straight_images
from models.calibrating.lens_prior import FOCAL_SDS
from models.calibrating.problem import CalibrationProblem
from models.calibrating.shape_evidence import blocks_of, shape_evidence
from models.epipolar.pairs import Beliefs
from models.epipolar.rig_adjustment import AdjustedRig, adjust_rig, lens_cost
from models.epipolar.rig_certainty import FocalLikelihood, certainty_of
from models.epipolar.rig_search import refocused
from models.epipolar.robust_points import costs_of, robust_points, robust_structures
from models.epipolar.static_cameras import CAMERA, LENS, SeenPoints
from models.epipolar.static_rig import StaticRig, StaticScene
from models.epipolar.view_graph import SharedPoints
from models.numerics.sampling import evenly_spread
from models.numerics.steps import Steps

Float64 = NDArray[np.float64]

FRAMES, POINTS = 150, 1500  # at most, that shapes are learnt from, and cameras adjusted to
ITERATIONS = 40  # of adjusting cameras
PLACES = 13  # of the common focal length
REACH = 2.4  # standard deviations of the prior to either side
SHARES = (0.6, 0.4)  # of pairs whose lenses are alike, and not
EXACT = 1e-4  # standard deviation of the common log focal length where it is held
LIKELY = 12.0  # nats below the best: shapes are not asked about less likely places
FINE = 0.01  # of the common log focal length: step of the posterior
# Errors of the evidence of shapes, learnt on drawn motions: Student's t of the log focal length,
# and the probability that shapes mislead.
SHAPE_SD, SHAPE_FREEDOM, MISLEADS = 0.1, 3.0, 0.15
COMMON, RATIO = np.array([0.5, 0.5]), np.array([1.0, -1.0])


class Kind(NamedTuple):
    """The prior of the two log focal lengths, if lenses are alike, or if not."""

    share: float
    mean: Float64  # (2,)
    covariance: Float64  # (2, 2)

    @property
    def common(self) -> tuple[float, float]:
        """Mean and standard deviation of the common log focal length."""
        return float(COMMON @ self.mean), float(np.sqrt(COMMON @ self.covariance @ COMMON))

    def at(self, common: float) -> tuple[Float64, Float64]:
        """Return mean (2,) and covariance (2, 2) where the common log focal length is held."""
        carried = self.covariance @ COMMON / (COMMON @ self.covariance @ COMMON)
        mean = self.mean + carried * (common - COMMON @ self.mean)
        left = self.covariance - np.outer(carried, COMMON @ self.covariance)
        return mean, left + EXACT**2 * np.eye(2)


class Place(NamedTuple):
    """Two cameras, the best with a common focal length that is held."""

    cameras: AdjustedRig
    beliefs: Beliefs


class Profile(NamedTuple):
    """The evidence along the common focal length, for one kind of lenses."""

    kind: Kind
    places: list[Place]  # T
    commons: Float64  # (T,)
    geometry: Float64  # (T, N) log likelihood of each frame, of epipolar geometry
    prior: Float64  # (T,) log density of all that is not the common focal length
    shapes: Float64  # (T, N) log evidence of each frame; NaN where shapes were not asked


def settle_lenses(problem: CalibrationProblem, found: StaticRig) -> Steps[StaticRig]:
    """Return two static cameras at the posterior mean of their focal lengths.

    `found` are the cameras from geometry alone, and their handedness. They stay as they are if
    there are three or more, or if both focal lengths are given exactly.
    """
    if found.static.tolist() != [True, True]:
        return found
    beliefs = lens_beliefs(problem)
    kinds = kinds_of(problem, beliefs)
    if kinds[0].common[1] <= EXACT:
        return found
    images, _ = straight_images(problem, problem.keypoints)
    shared = SharedPoints.of(images, problem.weights, np.random.default_rng(0))
    seen, frames = shared.seen([0, 1], POINTS), shared.frames[shared.chosen([0, 1], POINTS)]
    noise = np.full(2, found.noise)
    start = AdjustedRig(found.best.rig, robust_points(found.best.rig, seen, noise), noise)
    walks = []
    for kind in kinds:
        walks.append((yield from _walk(kind, beliefs, seen, start, walks)))
    noise = np.full(2, min(place.cameras.noise.mean() for walk in walks for place in walk))
    count = len(problem.keypoints)
    profiles = [
        _profile(kind, walk, seen, frames, count, noise)
        for kind, walk in zip(kinds, walks, strict=True)
    ]
    ...
