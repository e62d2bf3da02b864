"""A lift of a made-up frame, which shows whether a prior from elsewhere can be used."""

import numpy as np

from models.lifting.fitted_prior import FittedPrior
from models.numerics.tensor_files import WeightsError

CENTRE, RADIUS = 500.0, 100.0  # pixels


def try_to_lift(prior: FittedPrior) -> None:
    """Lift a frame in which each view shows the keypoints on a circle.

    Raises
    ------
    WeightsError
        When no such frame can be lifted, as with numbers beyond all use.
    """
    angles = np.linspace(0, 2 * np.pi, prior.keypoints_per_frame, endpoint=False)
    circle = CENTRE + RADIUS * np.stack((np.cos(angles), np.sin(angles)), -1)
    frame = np.tile(circle, (1, prior.known_views or 1, 1, 1))
    try:
        prior.lift(frame, refine="full")
    except ValueError as error:  # also that of linear algebra
        raise WeightsError(f"lifts with them fail: {error}") from error
