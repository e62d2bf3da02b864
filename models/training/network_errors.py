"""The errors of the network's structures, measured on the frames of a fit.

The reference is the refinement of all views of a frame with the shape model alone. A refinement
with the network as its prior would make the network's errors look too small. The network gets one
of the views, two, and so on. Its errors are measured on held-out frames where there are enough,
because they are smaller on the frames that it was trained on.
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
from models.lifting.lift import LiftedFrames
from models.network.settling import SETTLE_ALL, SETTLE_NONE, SettlingPolicy, settle_beyond
from models.training.batches import Data, enough_frames

MOST_FRAMES = 400  # plenty to learn the distribution of the network's errors
LEAST_FRAMES = 5  # with some number of views, to measure errors with this number
LEAST_UNSEEN = 8  # held-out frames, to measure errors on these alone
MOST_VIEWS = 8  # with more, the network errs as with so many
USUAL_SHARE = 0.95  # of the frames have a misfit within the usual limit

MakePrior = Callable[[SelfCalibration], FittedPrior]


class _Sample(NamedTuple):
    """F frames with two views or more, and their structures refined from all views."""

    pixels: Tensor  # (F, K, P, 2)
    weights: Tensor  # (F, K, P)
    order: Tensor  # (F, K) in which the views are shown: those that were observed come first
    observed: Tensor  # (F,) how many these are
    unseen: Tensor  # (F,) whether the frame was held out from training
    structures: NDArray[np.float64]  # (F, P, 3)


def learn_errors_of_network(
    self_calibration: SelfCalibration,
    data: Data,
    unseen: Data,
    make_prior: MakePrior,
    *,
    seed: list[int],
) -> SelfCalibration:
    """Return the self-calibration with the present errors of the network.

    `data` are the frames of training, `unseen` are held-out frames and may be empty. Errors are
    measured for two policies of settling: every frame, or only frames with an unusual misfit. The
    policy with the smaller errors over all frames is kept. Both policies are compared on the same
    frames, so the frames of training count as well.
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
    most = enough_frames(*data.weights.shape[1:], most=MOST_FRAMES)
    frames = several[:: math.ceil(max(len(several), 1) / most)]
    return data.pixels(frames), data.weights[frames]


def _learn(
    candidate: SelfCalibration, sample: _Sample, prior: FittedPrior
) -> tuple[SelfCalibration, float]:
    """Measure the errors of the network with one policy of settling, and their overall size.

    With too few frames the candidate stays as it is, and its errors count as infinite.
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
    """Return the policy for lifts from the measured one: unusual frames may be settled."""
    if measured.every_frame:
        return measured
    return settle_beyond(float(np.quantile(misfits, USUAL_SHARE)))


def _misfits(lift: LiftedFrames) -> NDArray[np.float64]:
    """Compute reprojection errors (N,) in structure units, as the compiled network does."""
    used = lift.keypoints_used
    total = np.nansum(used * lift.reprojection_errors / lift.scales, axis=1)
    return np.asarray(total / used.sum(1), np.float64)
