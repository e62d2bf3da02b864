"""How far the network's structures are off, measured on the frames of a fit.

The measure is what refinement makes of all views of a frame with the shape model alone: one that
trusts the network would find it ever more trustworthy. The network is shown one of the views, two,
and so on. How far it is off is measured on frames that it was not taught, where there are enough of
them: on those that it was, it seems better than it is.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from models.bundle.shape_model import align, learn_network_errors, unknown_network_errors
from models.calibrating.result import SelfCalibration
from models.lifting.fitted_prior import FittedPrior
from models.lifting.lift import Lift
from models.network.settling import SETTLE_ALL, SETTLE_NONE, SettlingPolicy, settle_beyond
from models.training.batches import Data

MOST_FRAMES = 400  # plenty to learn what the network's errors are like
LEAST_FRAMES = 5  # with some number of views, to learn from these at all
LEAST_UNSEEN = 8  # likewise, not taught to the network, to measure its errors on these alone
MOST_VIEWS = 8  # with more, the network errs as with so many
USUAL_SHARE = 0.95  # of the frames have a misfit that is usual for the network

MakePrior = Callable[[SelfCalibration], FittedPrior]


class _Sample(NamedTuple):
    """F frames with two views or more, and their structures as all views tell them."""

    pixels: Tensor  # (F, K, P, 2)
    weights: Tensor  # (F, K, P)
    order: Tensor  # (F, K) in which the views are shown: those that were observed come first
    observed: Tensor  # (F,) how many these are
    unseen: Tensor  # (F,) whether the network was not taught the frame
    structures: NDArray[np.float64]  # (F, P, 3)


def learn_errors_of_network(
    self_calibration: SelfCalibration,
    data: Data,
    unseen: Data,
    make_prior: MakePrior,
    *,
    seed: list[int],
) -> SelfCalibration:
    """Return the self-calibration with the network's errors as they are now.

    `data` is what the network was taught, `unseen` is not and may be empty. The errors are measured
    for two policies of settling: every frame, or only frames whose misfit is unusual. The policy
    with the smaller errors in all frames, seen and unseen, is kept: it changes the answers to the
    same frames, so the more frames, the surer the choice.
    """
    unknown = unknown_network_errors(data.keypoints.shape[2])
    blank = replace(self_calibration, network_errors=unknown, settling=SETTLE_ALL)
    sample = _sample(data, unseen, make_prior(blank), seed)
    best, least = blank, math.inf
    for policy in (SETTLE_ALL, SETTLE_NONE):
        candidate = replace(blank, settling=policy)
        learnt, size = _learn(candidate, sample, make_prior(candidate))
        if size < least:
            best, least = learnt, size
    return best


def _sample(data: Data, unseen: Data, prior: FittedPrior, seed: list[int]) -> _Sample:
    taught_pixels, taught_weights = _frames_with_several_views(data)
    unseen_pixels, unseen_weights = _frames_with_several_views(unseen)
    pixels = torch.cat((taught_pixels, unseen_pixels))
    weights = torch.cat((taught_weights, unseen_weights))
    observed = (weights > 0).any(-1)  # (F, K)
    structures = prior.lift(pixels, confidence=weights, refine="full").points3d
    drawn = torch.from_numpy(np.random.default_rng(seed).random(observed.shape))
    order = (drawn - observed.double()).argsort(1).argsort(1)
    is_unseen = torch.arange(len(pixels)) >= len(taught_pixels)
    return _Sample(
        pixels, weights, order, observed.sum(1), is_unseen, structures.astype(np.float64)
    )


def _frames_with_several_views(data: Data) -> tuple[Tensor, Tensor]:
    """Return pixels and weights of some frames with two views or more, spread over the capture."""
    several = ((data.weights > 0).any(-1).sum(1) > 1).nonzero()[:, 0]
    frames = several[:: math.ceil(max(len(several), 1) / MOST_FRAMES)]
    return data.pixels(frames), data.weights[frames]


def _learn(
    candidate: SelfCalibration, sample: _Sample, prior: FittedPrior
) -> tuple[SelfCalibration, float]:
    """Learn the errors of the network with one policy of settling, and how large they are in all.

    Too few frames tell nothing: the candidate stays as it is, and its errors are infinite.
    """
    mean = candidate.shapes.mean
    known = torch.from_numpy(np.isfinite(sample.structures).all((1, 2)))  # (F,)
    errors, judged, misfits = [], [], []
    for views in range(1, min(sample.pixels.shape[1], MOST_VIEWS) + 1):
        chosen = known & (sample.observed >= views)
        if chosen.sum() < LEAST_FRAMES:
            break
        unseen = sample.unseen[chosen]
        judging = (unseen if unseen.sum() >= LEAST_UNSEEN else torch.ones_like(unseen)).numpy()
        shown = (sample.weights * (sample.order < views)[..., None])[chosen]
        lift = prior.lift(sample.pixels[chosen], confidence=shown, refine="off")
        answers, _ = align(lift.points3d.astype(np.float64), mean)
        errors.append(align(sample.structures[chosen.numpy()], answers)[0] - answers)
        judged.append(judging)
        misfits.append(_misfits(lift)[judging])
    if not errors:
        return candidate, math.inf
    policy = _settling_in_lifts(candidate.settling, np.concatenate(misfits))
    learnt = learn_network_errors(errors, judged, mean)
    everything = [np.ones_like(judging) for judging in judged]
    size = float(learn_network_errors(errors, everything, mean).scales.sum())
    return replace(candidate, network_errors=learnt, settling=policy), size


def _settling_in_lifts(measured: SettlingPolicy, misfits: NDArray[np.float64]) -> SettlingPolicy:
    """Return the policy of lifts for one that was measured: frames unlike any may be settled."""
    if measured.every_frame:
        return measured
    return settle_beyond(float(np.quantile(misfits, USUAL_SHARE)))


def _misfits(lift: Lift) -> NDArray[np.float64]:
    """Return reprojection errors (N,) in units of the structure, as the compiled network does."""
    used = lift.keypoints_used
    total = np.nansum(used * lift.reprojection_errors / lift.scales, axis=1)
    return np.asarray(total / used.sum(1), np.float64)
