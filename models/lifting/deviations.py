"""How far the points of a lift may be off."""

from models.bundle.problem import Rig
from models.lifting.lift import LiftedFrames
from models.lifting.observing import ObservedFrames
from models.posterior.posterior import Posterior


def with_deviations(
    lift: LiftedFrames, posterior: Posterior, rig: Rig, observed: ObservedFrames
) -> LiftedFrames:
    """Return a refined lift with the deviations of its points; `rig` is that of its views."""
    seen, detected = observed.observations, observed.detected
    sds = posterior.deviations(lift, rig, observed.views, seen, detected)
    return lift._replace(points3d_sd=sds)
