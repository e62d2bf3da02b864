"""Lifting frames, and lifting them again without the keypoints that the first answer found stray.

The network also used the stray keypoints, and refinement starts from its answer. So such frames are
lifted from the beginning, without them.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.capture.observations import as_observations, pixels_of
from models.lifting.explanations import Refiner
from models.lifting.frame_refinement import refine_frames
from models.lifting.observing import ObservedFrames
from models.lifting.stray_keypoints import RETURNS, STRAYS
from models.network.answers import Answers, Usual, make_answers
from models.network.feed_forward import feed_forward
from models.network.priors.prior import Weights
from models.network.settling import SettlingPolicy
from models.numerics.threads import in_slices

Bool = NDArray[np.bool_]
Int8 = NDArray[np.int8]

# Figures: evidence/lifts.md.
LOOKS = 3  # times at most that a frame is lifted again with other keypoints
LIFTED_FRAMES, REFINED_FRAMES = 64, 16  # that a thread takes at a time


class Lifter(NamedTuple):
    """Everything that lifting frames of some views of a fit takes."""

    network: Weights
    foreshortening: float
    settling: SettlingPolicy
    usual: Usual
    refiner: Refiner | None
    always: bool  # whether refined answers are kept even if they explain keypoints worse

    @property
    def looks(self) -> int:
        """How often a frame may be lifted again with other keypoints."""
        return LOOKS if self.refiner is not None and self.refiner.rejecting else 0


def lift_frames(lifter: Lifter, observed: ObservedFrames, before: Answers) -> Answers:
    """Return answers for N frames; `before` are the answers of the previous frames, N or none."""
    frames = np.arange(len(observed.observations.weights))
    answers, again = _lift(lifter, observed, before, judging=lifter.looks > 0)
    for look in range(1, lifter.looks + 1):
        changed: Bool = np.logical_or.reduce(again, axis=(1, 2))
        if not changed.any():
            break
        frames, before = frames[changed], _of_frames(before, changed)
        observed = _seen_so(observed.frames(changed), again[changed])
        part, again = _lift(lifter, observed, before, judging=look < lifter.looks)
        arrays: tuple[NDArray[Any], ...] = answers
        for array, some in zip(arrays, part, strict=True):
            array[frames] = some
    return answers


def _lift(
    lifter: Lifter, observed: ObservedFrames, before: Answers, *, judging: bool
) -> tuple[Answers, Int8]:
    """Return answers and, if `judging`, verdicts (N, K, P) on keypoints; else (0, K, P)."""
    observations, judged, _, left_out, _, _ = observed
    shape = observations.weights.shape
    answers = make_answers(*shape)
    if judged is not None:
        answers = answers._replace(outlier_probability=judged.copy())
    verdicts = np.zeros(shape if judging else (0, *shape[1:]), np.int8)

    def lift_part(part: slice) -> None:
        here = part.start, part.stop
        feed_forward(
            lifter.network,
            observations,
            lifter.foreshortening,
            lifter.settling,
            lifter.usual,
            *here,
            answers,
        )
        if lifter.refiner is not None:
            refine_frames(
                lifter.refiner,
                observations,
                left_out,
                before,
                lifter.always,
                *here,
                answers,
                verdicts,
            )

    in_slices(shape[0], LIFTED_FRAMES if lifter.refiner is None else REFINED_FRAMES, lift_part)
    return answers, verdicts


def _seen_so(observed: ObservedFrames, verdicts: Int8) -> ObservedFrames:
    """Return frames without stray keypoints, and with those that return."""
    observations, judged, views, left_out, detected, smoothed = observed
    strays, returns = verdicts == STRAYS, verdicts == RETURNS
    pixels, _ = pixels_of(observations)
    there = np.concatenate((pixels, observations.weights[..., None]), axis=-1, dtype=np.float32)
    seen = np.where(returns[..., None], left_out, there)
    weights = np.where(strays, 0, seen[..., 2])
    if judged is None:
        judged = np.full(strays.shape, np.nan, np.float32)
    return ObservedFrames(
        as_observations(seen[..., :2], weights),
        np.where(strays, 1, np.where(returns, 0, judged)).astype(np.float32),
        views,
        np.where(strays[..., None], there, np.where(returns[..., None], 0, left_out)),
        np.where(strays[..., None], 0, detected) if len(detected) else detected,
        smoothed,
    )


def _of_frames(before: Answers, chosen: Bool) -> Answers:
    return Answers._make(array[chosen] for array in before) if len(before.points3d) else before
