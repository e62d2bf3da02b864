"""Structures that a fit comes to know, and where they are worth more than its network."""

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from models.bundle.known_structures import LEAST_STRUCTURES, WEIGHTS, KnownStructures
from models.bundle.problem import Views
from models.bundle.shape_model import align
from models.lifting.fitted_prior import FittedPrior
from models.lifting.lift import Lift
from models.network.settling import first_order_cameras
from models.training.batches import Data

LEAST_UNSEEN = 8  # frames to judge by
ROUNDS = 3  # of solving for cameras and foreshortening in turn
TINY = 1e-6
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
    of their views, two, and so on. Their structures are held against what their other views show:
    those are neither the network's answer nor the structures'. As there are few such frames,
    structures are believed for one view unless they are worse by more than a standard error, and
    for several if they are better by more than that. Of too few frames nothing is believed.
    """
    shown = (unseen.weights > 0).any(-1)  # (H, K)
    several = (shown.sum(1) > 1).nonzero()[:, 0]
    pixels, weights = unseen.pixels(several), unseen.weights[several]
    shown = shown[several]
    nothing = structures._replace(believed=np.zeros(1))
    if len(several) < LEAST_UNSEEN:
        return nothing
    priors = make_prior(structures._replace(believed=np.ones(1))), make_prior(None)
    whole = priors[1].lift(pixels, confidence=weights, refine="full")
    drawn = torch.from_numpy(np.random.default_rng(seed).random(shown.shape))
    order = (drawn - shown.double()).argsort(1).argsort(1)
    believed: list[bool] = []
    for views in range(1, min(shown.shape[1], MOST_VIEWS)):
        chosen = (shown.sum(1) > views) & torch.from_numpy((whole.camera_models > 0).any(1))
        if chosen.sum() < LEAST_UNSEEN:
            break
        kept = (order < views)[chosen, :, None]  # (C, K, 1)
        frames = several[chosen]
        hidden = Views(
            unseen.keypoints[frames].double().numpy(),
            torch.where(kept, 0, unseen.weights[frames]).double().numpy(),
        )
        some = weights[chosen] * kept
        ours, theirs = (
            _errors_in_hidden_views(
                prior.lift(pixels[chosen], confidence=some, refine="full"),
                hidden,
                whole.points3d[chosen],
                whole.rotations[chosen],
                abs(prior.foreshortening),
            )
            for prior in priors
        )
        worse = ours - theirs
        doubt = worse.std() / np.sqrt(len(worse))
        # A single view leaves so much open that what is known need not prove its worth; of several
        # it must. Where views tell every keypoint, both are equal: it is as with fewer views.
        helps = worse.mean() <= (doubt if views == 1 else -doubt)
        believed.append(believed[-1] if believed and not worse.any() else bool(helps))
    if not any(believed):
        return nothing
    # What all views of a frame show has nothing to be held against: it counts as one view less.
    return structures._replace(believed=np.array([*believed, believed[-1]], np.float64))


def _errors_in_hidden_views(
    lift: Lift,
    hidden: Views,
    points: NDArray[np.float32],
    rotations: NDArray[np.float32],
    foreshortening: float,
) -> NDArray[np.float64]:
    """Return how far structures are from what `hidden` views show, shares of a view's size (N,).

    Cameras of these views, (N, K, P, 2) normalised, are found anew for each structure, to first
    order. They begin as `rotations` (N, K, 3, 3) have them, which see `points` (N, P, 3).
    """
    structures = np.nan_to_num(lift.points3d).astype(np.float64)
    _, similarity = align(structures, np.nan_to_num(points).astype(np.float64))
    structures -= structures.mean(1, keepdims=True)
    radii = np.sqrt(np.square(structures).sum(-1).mean(-1))[:, None, None]
    guesses = np.nan_to_num(rotations).astype(np.float64) @ similarity.rotations.mT[:, None]
    found = first_order_cameras(
        structures / radii.clip(TINY),
        hidden.keypoints.astype(np.float32),
        hidden.weights.astype(np.float32),
        guesses[..., :2, :],
        foreshortening,
        rounds=ROUNDS,
    )
    off = np.square(hidden.keypoints - found.projected - foreshortening * found.slopes).sum(-1)
    errors = np.sqrt((hidden.weights * off).sum(-1) / hidden.weights.sum(-1).clip(TINY))  # (N, K)
    counts = (hidden.weights > 0).any(-1)
    means: NDArray[np.float64] = (errors * counts).sum(1) / counts.sum(1)
    return means
