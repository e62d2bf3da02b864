"""What is usual of the frames of a fit, so that lifts can find frames that are unlike them."""

import numpy as np
import torch

from models.lifting.fitted_prior import FittedPrior
from models.network.answers import Usual
from models.training.batches import Data

MOST_FRAMES = 300  # plenty for a quantile of 99 %
LEAST_FRAMES = 20  # that have some number of views, to learn what is usual with these
MOST_VIEWS = 8  # with more, the misfit is as with so many
USUAL_SHARE = 0.99
# Beyond the usual by these factors is unlike it. Of poses that a capture did not show, but could
# have, 95 in 100 misfits were below 3.6 times the usual (human36m, dannce, OpenPose detections); of
# keypoints in another order the median was 9 to 34 times. A subject may come nearer, or go away.
MISFIT_FACTOR, SIZE_FACTOR = 5.0, 3.0


def learn_usual(prior: FittedPrior, data: Data, unseen: Data) -> Usual:
    """Measure the misfits of the network with one view, two, ... and the sizes of views.

    `data` are the frames that it was taught, `unseen` others of the capture, or none.
    """
    limits = _misfit_limits(prior, data)
    for views, limit in enumerate(_misfit_limits(prior, unseen)):
        limits[views] = max(limits[views], limit)
    sizes = data.sizes[(data.weights > 0).any(-1)].numpy()
    least, most = np.quantile(sizes, (1 - USUAL_SHARE, USUAL_SHARE))
    return Usual(
        np.array(limits or [np.inf]), float(least) / SIZE_FACTOR, float(most) * SIZE_FACTOR
    )


def _misfit_limits(prior: FittedPrior, data: Data) -> list[float]:
    """Return the limits with one view, two, ... as far as there are frames that show them."""
    every = max(1, -(-len(data.weights) // MOST_FRAMES))
    frames = torch.arange(0, len(data.weights), every)
    pixels, weights = data.pixels(frames), data.weights[frames]
    observed = (weights > 0).any(-1)  # (T, K)
    views = observed.shape[1]
    # Views that were observed come first, and another of them in every frame.
    turn = (torch.arange(views) + frames[:, None]) % views
    order = (turn - views * observed.long()).argsort(1).argsort(1)
    limits: list[float] = []
    for count in range(1, min(views, MOST_VIEWS) + 1):
        chosen = observed.sum(1) >= count
        if chosen.sum() < LEAST_FRAMES:
            break
        shown = (weights * (order < count)[..., None])[chosen]
        misfits = prior.lift(pixels[chosen], confidence=shown, refine="off").misfits
        limits.append(MISFIT_FACTOR * float(np.nanquantile(misfits, USUAL_SHARE)))
    return limits
