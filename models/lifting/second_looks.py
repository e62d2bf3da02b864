"""Lifting frames, and lifting those anew of which a first answer says which keypoints are wrong.

The network saw the wrong keypoints, too, and refinement starts from its answer; so such frames are
lifted from the beginning, as if what strays had not been seen.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.capture.observations import as_observations, pixels_of
from models.lifting.explanations import Refiner
from models.lifting.frame_refinement import refine_frames
from models.lifting.observing import Observed
from models.lifting.stray_keypoints import RETURNS, STRAYS
from models.network.answers import Answers, Usual, make_answers
from models.network.feed_forward import feed_forward
from models.network.priors.prior import Weights
from models.network.settling import SettlingPolicy
from models.numerics.threads import in_slices

Float32 = NDArray[np.float32]
Bool = NDArray[np.bool_]
Int8 = NDArray[np.int8]

LOOKS = 3  # at a frame, that may change which of its keypoints are used
LIFTED_FRAMES, REFINED_FRAMES = 64, 16  # that a thread takes at a time


class Lifter(NamedTuple):
    """What lifts frames of some views of a fit."""

    network: Weights
    foreshortening: float
    settling: SettlingPolicy
    usual: Usual
    refiner: Refiner | None
    always: bool  # whether refined answers are kept that explain keypoints worse

    @property
    def looks(self) -> int:
        """How often it may be found that other keypoints are to be used."""
        return LOOKS if self.refiner is not None and self.refiner.rejecting else 0


def lift_frames(lifter: Lifter, observed: Observed, before: Answers) -> Answers:
    """Return answers for N frames; `before` are those of the frames before them, N or none."""
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
    lifter: Lifter, observed: Observed, before: Answers, *, judging: bool
) -> tuple[Answers, Int8]:
    """Return answers and, if they are asked for, verdicts (N, K, P) on keypoints; else none."""
    observations, judged, _, left_out, detected = observed
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
                detected,
                before,
                lifter.always,
                *here,
                answers,
                verdicts,
            )

    in_slices(shape[0], LIFTED_FRAMES if lifter.refiner is None else REFINED_FRAMES, lift_part)
    return answers, verdicts


def _seen_so(observed: Observed, verdicts: Int8) -> Observed:
    """Return frames without the keypoints that stray, and with those that return."""
    observations, judged, views, left_out, detected = observed
    strays, returns = verdicts == STRAYS, verdicts == RETURNS
    pixels, _ = pixels_of(observations)
    there = np.concatenate((pixels, observations.weights[..., None]), axis=-1, dtype=np.float32)
    seen = np.where(returns[..., None], left_out, there)
    weights = np.where(strays, 0, seen[..., 2])
    if judged is None:
        judged = np.full(strays.shape, np.nan, np.float32)
    return Observed(
        as_observations(seen[..., :2], weights),
        np.where(strays, 1, np.where(returns, 0, judged)).astype(np.float32),
        views,
        np.where(strays[..., None], there, np.where(returns[..., None], 0, left_out)),
        np.where(strays[..., None], 0, detected) if len(detected) else detected,
    )


def _of_frames(before: Answers, chosen: Bool) -> Answers:
    return Answers._make(array[chosen] for array in before) if len(before.points3d) else before
