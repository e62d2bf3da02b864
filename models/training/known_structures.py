"""Structures that a fit comes to know, and where they are worth more than its network."""

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from models.bundle.known_structures import LEAST_STRUCTURES, WEIGHTS, KnownStructures
from models.bundle.shape_model import align
from models.lifting.fitted_prior import FittedPrior
from models.lifting.lift import Lift
from models.training.batches import Data

LEAST_UNSEEN = 8  # frames to judge by
MOST_VIEWS = 8  # with more, structures are worth as much as with so many

MakePrior = Callable[[KnownStructures | None], FittedPrior]


def known_structures(
    lift: Lift, weights: NDArray[np.float32], mean: NDArray[np.float64]
) -> KnownStructures | None:
    """Return the refined structures of a lift of weights (N, K, P), aligned to `mean` (P, 3).

    They are believed everywhere. None if they are too few to look among.
    """
    refined = (lift.camera_models > 0).any(1)
    if refined.sum() < LEAST_STRUCTURES:
        return None
    points, _ = align(lift.points3d[refined].astype(np.float64), mean)
    views = (weights[refined] > 0).sum(1)  # (T, P)
    told = WEIGHTS[np.minimum(views, len(WEIGHTS) - 1)]
    # Rounded as a file has them, so that a prior and its file lift alike.
    return KnownStructures.from_arrays(KnownStructures(points, told, np.ones(1)).to_arrays())


def believe_where_better(
    structures: KnownStructures, unseen: Data, make_prior: MakePrior, *, seed: list[int]
) -> KnownStructures:
    """Return the structures, believed for those numbers of views that they make lifts better for.

    Frames that the network was not taught, which the structures do not come from either, show one
    of their views, two, and so on. Their structures are held against those of all their views, in
    keypoints that several views tell. Of too few such frames nothing is believed.
    """
    shown = (unseen.weights > 0).any(-1)  # (H, K)
    several = (shown.sum(1) > 1).nonzero()[:, 0]
    pixels, weights = unseen.pixels(several), unseen.weights[several]
    shown = shown[several]
    nothing = structures._replace(believed=np.zeros(1))
    if len(several) < LEAST_UNSEEN:
        return nothing
    priors = make_prior(structures._replace(believed=np.ones(1))), make_prior(None)
    truth = priors[1].lift(pixels, confidence=weights, refine="full").points3d
    told = ((weights > 0).sum(1) > 1).numpy()  # (H, P)
    drawn = torch.from_numpy(np.random.default_rng(seed).random(shown.shape))
    order = (drawn - shown.double()).argsort(1).argsort(1)
    believed: list[bool] = []
    for views in range(1, min(shown.shape[1], MOST_VIEWS)):
        chosen = (shown.sum(1) > views).numpy() & np.isfinite(truth).all((1, 2))
        if chosen.sum() < LEAST_UNSEEN:
            break
        some = (weights * (order < views)[..., None])[chosen]
        lifts = [prior.lift(pixels[chosen], confidence=some, refine="full") for prior in priors]
        ours, theirs = (_mean_error(lift, truth[chosen], told[chosen]) for lift in lifts)
        # Where views tell every keypoint, both are equal: it is as with fewer views.
        believed.append(believed[-1] if believed and ours == theirs else ours < theirs)
    if not any(believed):
        return nothing
    # What all views of a frame show has nothing to be held against: it counts as one view less.
    return structures._replace(believed=np.array([*believed, believed[-1]], np.float64))


def _mean_error(lift: Lift, truth: NDArray[np.float32], told: NDArray[np.bool_]) -> float:
    """Return the mean distance from structures (N, P, 3), aligned to them, of what is told."""
    lifted = np.isfinite(lift.points3d).all((1, 2))
    goal = truth[lifted].astype(np.float64)
    aligned, _ = align(lift.points3d[lifted].astype(np.float64), goal)
    distances = np.linalg.norm(aligned - (goal - goal.mean(-2, keepdims=True)), axis=-1)
    return float(distances[told[lifted]].mean()) if told[lifted].any() else 0.0
