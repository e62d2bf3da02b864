"""How far the points of a lift may be off."""

import numpy as np

from models.bundle.problem import Rig
from models.lifting.lift import LiftedFrames
from models.lifting.observing import ObservedFrames
from models.posterior.posterior import Posterior, unknown_deviations
from models.posterior.quality import FIGURES, NO_EVIDENCE, quality_of

FURTHEST = 2.0  # root-mean-square radii of the structure: half of a person's height


def with_deviations(
    lift: LiftedFrames,
    posterior: Posterior | None,
    rig: Rig | None,
    observed: ObservedFrames,
    *,
    modes: bool,
) -> LiftedFrames:
    """Return a lift with the deviations of its points; `rig` is that of its views.

    A point that may be off by more than half of the subject's size is none. Covariances are part of
    the answer if `modes` are asked for. All are NaN without a posterior, and
    without a rig, for then nothing was refined.
    """
    if posterior is None or rig is None:
        found = unknown_deviations(*lift.points3d.shape[:2], modes=modes)
    else:
        seen, views = observed.observations, observed.views
        removed = observed.detected, observed.smoothed
        found = posterior.deviations(lift, rig, views, seen, *removed, modes=modes)
    usual = np.zeros(FIGURES) if posterior is None else posterior.usual
    quality, reasons = quality_of(found.figures, usual)
    nothing = np.isnan(lift.points3d).all((1, 2))
    known = lift._replace(
        quality=np.where(nothing, np.float32(0), quality),
        quality_reason=np.where(nothing, np.uint8(NO_EVIDENCE), reasons),
        points3d_sd=found.sds,
        points3d_covariance=found.covariances,
        points3d_modes=found.modes,
    )
    radii = np.sqrt(np.square(lift.points3d).sum(-1).mean(1))  # points are centred
    return known.without_points(found.sds > FURTHEST * radii[:, None])
