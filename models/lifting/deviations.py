"""How far the points of a lift may be off."""

import numpy as np

from models.bundle.problem import Rig
from models.lifting.lift import LiftedFrames
from models.lifting.observing import ObservedFrames
from models.posterior.answers import Lifted
from models.posterior.posterior import Posterior, unknown_deviations
from models.posterior.quality import FIGURES, judge


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
        lifted = as_lifted(lift, posterior, rig, observed)
        found = posterior.deviations(lifted, observed.views, modes=modes)
    usual = np.zeros(FIGURES) if posterior is None else posterior.usual
    quality, reasons, nowhere = judge(lift.points3d, found.sds, found.figures, usual)
    known = lift._replace(
        quality=quality,
        quality_reason=reasons,
        points3d_sd=found.sds,
        points3d_covariance=found.covariances,
        points3d_modes=found.modes,
    )
    return known.without_points(nowhere)


def as_lifted(
    lift: LiftedFrames, posterior: Posterior, rig: Rig, observed: ObservedFrames
) -> Lifted:
    """Return refined answers for observed frames, as a posterior takes them."""
    return Lifted(
        lift,
        rig,
        observed.observations,
        observed.detected,
        observed.smoothed,
        posterior.shapes,
        posterior.noise_of(observed.views, lift.scales.shape[1]),
    )
