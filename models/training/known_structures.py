"""The known structures of a fit, and the numbers of views for which they improve lifts."""

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from models.bundle.known_structures import LEAST_STRUCTURES, WEIGHTS, KnownStructures
from models.bundle.problem import Views
from models.bundle.shape_model import align
from models.lifting.fitted_prior import FittedPrior
from models.lifting.lift import LiftedFrames
from models.network.settling import first_order_cameras
from models.training.batches import Data

LEAST_UNSEEN = 8  # frames to judge by
ROUNDS = 3  # of solving for cameras and foreshortening in turn
TINY = 1e-6
MOST_VIEWS = 8  # with more, structures are worth as much as with so many

MakePrior = Callable[[KnownStructures | None], FittedPrior]


def known_structures(
    lift: LiftedFrames, weights: NDArray[np.float32], mean: NDArray[np.float64]
) -> KnownStructures | None:
    """Return the refined structures of a lift, aligned to `mean` (P, 3), as known structures.

    `weights` (N, K, P) are those of the lift's keypoints. The structures are used for every number
    of views. None if they are too few.
    """
    refined = (lift.camera_models > 0).any(1)
    if refined.sum() < LEAST_STRUCTURES:
        return None
    points, _ = align(lift.points3d[refined].astype(np.float64), mean)
    views = (weights[refined] > 0).sum(1)  # (T, P)
    counts = WEIGHTS[np.minimum(views, len(WEIGHTS) - 1)]
    # Rounded as a file has them, so that a prior and its file lift alike.
    return KnownStructures.from_arrays(KnownStructures(points, counts, np.ones(1)).to_arrays())


def believe_where_better(
    structures: KnownStructures, unseen: Data, make_prior: MakePrior, *, seed: list[int]
) -> KnownStructures:
    """Return the structures, to be used for those numbers of views for which they improve lifts.

    Held-out frames are lifted from one of their views, two, and so on, with and without the known
    structures. The results are compared with the keypoints of their other views. As there are few
    such frames, the structures are used for one view unless they are worse by more than a standard
    error, and for several views only if they are better by more than that. With too few frames
    they are not used.
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
        # One view leaves so much open that known structures are used by default; with several
        # views they must prove better. If views determine every keypoint, both lifts are equal, and
        # the decision for fewer views holds.
        helps = worse.mean() <= (doubt if views == 1 else -doubt)
        believed.append(believed[-1] if believed and not worse.any() else bool(helps))
    if not any(believed):
        return nothing
    # A lift from all views has no other view to compare with: it counts as one with a view less.
    return structures._replace(believed=np.array([*believed, believed[-1]], np.float64))


def _errors_in_hidden_views(
    lift: LiftedFrames,
    hidden: Views,
    points: NDArray[np.float32],
    rotations: NDArray[np.float32],
    foreshortening: float,
) -> NDArray[np.float64]:
    """Return reprojection errors (N,) of structures in `hidden` views, as shares of a view's size.

    Cameras of these views, (N, K, P, 2) normalised, are estimated for each structure, to first
    order. They start at `rotations` (N, K, 3, 3), which see `points` (N, P, 3).
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
