"""How far the points of a lift may be off."""

import numpy as np

from models.bundle.problem import Rig
from models.lifting.lift import LiftedFrames
from models.lifting.observing import ObservedFrames
from models.network.answers import MODES
from models.posterior.posterior import SYMMETRIC, Posterior


def with_deviations(
    lift: LiftedFrames,
    posterior: Posterior | None,
    rig: Rig | None,
    observed: ObservedFrames,
    *,
    modes: bool,
) -> LiftedFrames:
    """Return a lift with the deviations of its points; `rig` is that of its views.

    Covariances are part of it if `modes` are asked for. All are NaN without a posterior, and
    without a rig, for then nothing was refined.
    """
    if posterior is not None and rig is not None:
        sds, covariances, shared = posterior.uncertainty(
            lift, rig, observed.views, observed.observations, observed.detected, modes=modes
        )
        return lift._replace(
            points3d_sd=sds, points3d_covariance=covariances, points3d_modes=shared
        )
    if not modes:
        return lift
    points = lift.points3d.shape[:2]
    return lift._replace(
        points3d_covariance=np.full((*points, SYMMETRIC), np.nan, np.float32),
        points3d_modes=np.full((*points, 3, MODES), np.nan, np.float32),
    )
