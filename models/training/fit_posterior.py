"""The posterior of a fit, learnt from its frames at the end."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from models.calibrating.result import SelfCalibration
from models.lifting.fitted_prior import FittedPrior
from models.posterior.learning import learn_posterior
from models.posterior.posterior import Posterior
from models.training.batches import Data

MOST_FRAMES = 300  # that it is learnt from


def posterior_of(
    found: SelfCalibration,
    prior: FittedPrior,
    data: Data,
    detected: Data,
    frames: Tensor,
    removed_noise: tuple[float, float] | None,
) -> Posterior | None:
    """Learn how far answers may be off from some of `frames` (T,), which two views or more show.

    None if keypoints locate points in too few of them. `detected` is the data before noise was
    removed, and `removed_noise` that noise and what is left of it, in pixels.
    """
    some = frames[torch.linspace(0, len(frames) - 1, min(MOST_FRAMES, len(frames))).long()]
    weights = data.weights[some]
    lift = prior.lift(data.pixels(some), confidence=weights, refine="full")
    there: NDArray[np.bool_] = np.all(np.isfinite(lift.points3d), axis=(1, 2))
    there = np.logical_and(there, np.any(lift.camera_models > 0, axis=1))
    return learn_posterior(
        lift.frames(there),
        found.rig,
        found.shapes.mean,
        detected.pixels(some).double().numpy()[there],
        weights.double().numpy()[there],
        found.deviations,
        share_left=1.0 if removed_noise is None else min(removed_noise[1] / removed_noise[0], 1.0),
    )
