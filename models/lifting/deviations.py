"""How far the points of a lift may be off."""

import numpy as np

from models.bundle.problem import Rig
from models.capture.observations import pixels_of
from models.lifting.lift import LiftedFrames
from models.lifting.observing import ObservedFrames
from models.posterior.posterior import Posterior


def with_deviations(
    lift: LiftedFrames, posterior: Posterior, rig: Rig, observed: ObservedFrames
) -> LiftedFrames:
    """Return a refined lift with the deviations of its points; `rig` is that of its views."""
    if not len(lift.points3d):
        return lift
    keypoints, seen = pixels_of(observed.observations)
    weights = np.where(seen, observed.observations.weights, 0.0)
    if len(observed.detected):
        there = observed.detected[..., 2:] > 0
        keypoints = np.where(there, observed.detected[..., :2], keypoints)
    sds = posterior.deviations(lift, rig, observed.views, keypoints, weights)
    return lift._replace(points3d_sd=sds)
