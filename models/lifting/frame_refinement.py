"""Lifting with perspective: refining the network's answers with the cameras of a fit.

Compiled: a frame goes from the network's answer to its refined one without leaving machine code.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle.known_structures import KnownStructures, no_structures
from models.bundle.problem import (
    Rig,
    Views,
    make_rig,
    make_shape_prior,
    moving_rig,
    stretch_of,
    stretch_x,
)
from models.calibrating.result import SelfCalibration
from models.capture.observations import Observations
from models.lifting.explanations import (
    Explanation,
    Refiner,
    continues,
    copy_explanation,
    explain,
    make_explanation,
    network_start_into,
    previous_start_into,
    start_cost,
    write_errors,
)
from models.lifting.neighbours import complete_from_neighbours
from models.lifting.skeleton_lengths import SkeletonLengths, hold_lengths, no_lengths
from models.lifting.stray_keypoints import Explained, look_again
from models.network.answers import RIG_NOT_USED, Answers
from models.numerics.compiled import compiled, inner
from models.numerics.matrices import total
from models.optics.lenses.projection import Lenses

Float32 = NDArray[np.float32]
Bool = NDArray[np.bool_]
Int8 = NDArray[np.int8]

LOST = 3.0  # noise standard deviations of the mean residual from which a static rig does not fit
BETTER = 0.5  # another hypothesis must reduce the cost of such a frame to this share to be used
WORSE = 1.25  # times the network's reprojection error: a refinement beyond it is dropped


class Hypothesis(NamedTuple):
    """Another explanation of a frame that the rig does not fit with the network's answer."""

    mirrored: bool  # the network's answer is the mirror image of the structure
    apart: bool  # cameras were bumped or moved: every view moves on its own


OTHER_HYPOTHESES = (
    Hypothesis(mirrored=True, apart=False),
    Hypothesis(mirrored=False, apart=True),
    Hypothesis(mirrored=True, apart=True),
)


def make_refiner(
    calibration: SelfCalibration,
    views: Sequence[int] | None,
    count: int,
    skeleton: SkeletonLengths | None = None,
    structures: KnownStructures | None = None,
    *,
    rejecting: bool = True,
) -> Refiner:
    """Prepare to refine frames of `views` of the fit, or of `count` cameras it does not know.

    Lengths of the `skeleton` are held if the rig is static, for it alone gives structures a size.
    Known `structures` are the prior of keypoints that too few views show. If `rejecting`, stray
    keypoints are left out where all cameras are static.
    """
    rig = sub_rig(calibration, views, count)
    errors, shapes = calibration.network_errors, calibration.shapes
    believed = errors if errors.known else shapes
    return Refiner(
        rig,
        moving_rig(rig.lenses, rig.stretched),
        make_shape_prior(shapes.mean, believed.basis, believed.spread, heavy=errors.known),
        errors.known,
        np.ascontiguousarray(errors.scales) if errors.known else np.ones(1),
        calibration.noise,
        calibration.unit,
        no_lengths() if skeleton is None or not rig.static.all() else skeleton,
        no_structures(len(shapes.mean)) if structures is None else structures,
        rejecting and bool(rig.static.all()),
    )


def sub_rig(calibration: SelfCalibration, views: Sequence[int] | None, count: int) -> Rig:
    """Return the rig of some views of a fit, or of `count` cameras that it does not know.

    The lenses of unknown cameras are the mean of the fit's.
    """
    rig, lenses = calibration.rig, calibration.rig.lenses
    if views is None:
        usual = Lenses(
            np.tile(np.exp(np.log(lenses.focals).mean(0)), (count, 1)),
            np.tile(lenses.centres.mean(0), (count, 1)),
            np.tile(lenses.distortion.mean(0), (count, 1)),
            np.repeat(lenses.models[:1], count),
        )
        return moving_rig(usual)
    index = np.array(views, np.int64)
    groups = np.unique(rig.groups[index], return_inverse=True)[1].reshape(-1)
    alone = (np.bincount(groups)[groups] == 1)[:, None]  # such a view is its own group's frame
    return make_rig(
        lenses.of(index),
        groups,
        np.where(alone[..., None], np.eye(3), rig.rotations[index]),
        np.where(alone, 0.0, rig.translations[index]),
        rig.stretched[index],
    )


@compiled
def refine_frames(
    refiner: Refiner,
    seen: Observations,
    left_out: Float32,
    previous: Answers,
    always: bool,
    begin: int,
    end: int,
    answers: Answers,
    verdicts: Int8,
) -> None:
    """Refine the network's weak-perspective answers of frames from `begin` to `end`, in place.

    A frame stays as it is if perspective explains its keypoints worse than the network by more than
    a quarter (`WORSE`), or not at all; with `always` only in the latter case. `previous` are the
    answers of the previous frames, N or none. A frame whose views all have a perspective camera
    there starts from it if that explains it better, and is marked as continued. A frame that the
    rig does not fit gets the finding `RIG_NOT_USED`.

    `verdicts` (N, K, P), 0 at first, are written for keypoints that stray, and for those of
    `left_out` (N, K, P, 3) that return (see `look_again`). A frame that has any is not refined.
    With (0, K, P) keypoints are not judged.
    """
    _, cameras, count, _ = seen.keypoints.shape
    views = Views(np.empty((cameras, count, 2)), np.empty((cameras, count)))
    start, earlier = (
        make_explanation(count, cameras),
        make_explanation(count, cameras),
    )
    best, other = make_explanation(count, cameras), make_explanation(count, cameras)
    mean = np.empty((count, 3))
    joined = len(refiner.rig.size_precision) < cameras
    for n in range(begin, end):
        usable = seen.usable[n]
        there = total(usable)
        if not there:
            continue
        _pixels_into(seen, n, refiner.noise, views)
        network_start_into(refiner, answers, n, usable, False, start, mean)
        continued = False
        if continues(previous, n, usable):
            previous_start_into(refiner, previous, n, mean, earlier)
            continued = start_cost(refiner, refiner.rig, views, usable, mean, earlier) < start_cost(
                refiner, refiner.rig, views, usable, mean, start
            )
        chosen = earlier if continued else start
        cost = explain(refiner, refiner.rig, views, usable, mean, chosen, best)
        if len(verdicts) and look_again(
            Explained(refiner.rig.lenses, refiner.noise, views, seen.sizes[n], left_out[n], best),
            verdicts[n],
        ):
            continue
        residual, apart = _residual(best, usable), False
        if there > 1 and residual > LOST * refiner.noise:
            for hypothesis in OTHER_HYPOTHESES:
                if hypothesis.apart and not joined:
                    continue
                network_start_into(refiner, answers, n, usable, hypothesis.mirrored, start, mean)
                rig = refiner.apart if hypothesis.apart else refiner.rig
                other_cost = explain(refiner, rig, views, usable, mean, start, other)
                if other_cost < BETTER * cost:
                    copy_explanation(other, best)
                    cost, continued, apart = other_cost, False, hypothesis.apart
        rig = refiner.apart if apart else refiner.rig
        complete_from_neighbours(refiner, rig, views, usable, best, start, other)
        accepted = _accept(best, cost, answers.reprojection_errors[n], usable, always)
        if accepted:
            answers.continued[n] = continued
            if there > 1 and not apart and len(refiner.held.lengths):
                _hold_lengths(refiner, views, best)
            _write(refiner, best, n, usable, answers)
        if (apart or not accepted) and _shares_group(refiner.rig.groups, usable):
            answers.findings[n] += RIG_NOT_USED
            answers.rig_residuals[n] = residual


@inner
def _pixels_into(seen: Observations, n: int, noise: float, views: Views) -> None:
    """Write the keypoints of frame n in pixels, with weights divided by the noise's variance."""
    for k in range(len(views.keypoints)):
        for p in range(views.keypoints.shape[1]):
            w = seen.weights[n, k, p]
            views.weights[k, p] = w / noise**2
            for i in range(2):
                views.keypoints[k, p, i] = (
                    seen.keypoints[n, k, p, i] * seen.sizes[n, k] + seen.centres[n, k, i]
                )


@inner
def _hold_lengths(refiner: Refiner, views: Views, explanation: Explanation) -> None:
    """Move points so that the edges of the skeleton have their lengths; poses stay."""
    hold_lengths(
        refiner.held,
        views,
        refiner.noise,
        refiner.rig.lenses,
        explanation.points,
        explanation.rotations,
        explanation.translations,
    )
    write_errors(refiner.rig, views, explanation)


@inner
def _residual(explanation: Explanation, usable: Bool) -> float:
    """Return the mean reprojection error of a frame's usable views, pixels."""
    error = 0.0
    for k in range(len(usable)):
        if usable[k]:
            error += explanation.errors[k]
    return error / total(usable)


@inner
def _shares_group(groups: NDArray[np.int64], usable: Bool) -> bool:
    """Whether two usable views are static relative to each other."""
    for k in range(len(usable)):
        for other in range(k):
            if usable[k] and usable[other] and groups[k] == groups[other]:
                return True
    return False


@inner
def _accept(
    explanation: Explanation, cost: float, errors: Float32, usable: Bool, always: bool
) -> bool:
    """Whether there is an answer that explains the keypoints no worse than the network's."""
    if not math.isfinite(cost):
        return False
    ours, theirs = 0.0, 0.0
    for k in range(len(usable)):
        if not math.isfinite(explanation.errors[k]):
            return False
        if usable[k]:
            ours += explanation.errors[k]
            theirs += errors[k]
    return always or ours <= WORSE * theirs


@inner
def _write(
    refiner: Refiner, explanation: Explanation, n: int, usable: Bool, answers: Answers
) -> None:
    """Write a frame's answer in the user's unit, the structure centred."""
    count, centre = len(explanation.points), np.zeros(3)
    for p in range(count):
        for i in range(3):
            centre[i] += explanation.points[p, i] / count
    for p in range(count):
        for i in range(3):
            answers.points3d[n, p, i] = refiner.unit * (explanation.points[p, i] - centre[i])
    lenses = refiner.rig.lenses
    for k in range(len(usable)):
        if not usable[k]:
            continue
        stretch = stretch_of(explanation.rotations[k]) if refiner.rig.stretched[k] else 1.0
        stretch_x(explanation.rotations[k], explanation.translations[k], 1 / stretch)
        for i in range(3):
            shift = explanation.translations[k, i]
            for j in range(3):
                answers.rotations[n, k, i, j] = explanation.rotations[k, i, j]
                shift += explanation.rotations[k, i, j] * centre[j]
            answers.translations[n, k, i] = refiner.unit * shift
        focal = 0.5 * (lenses.focals[k, 0] + lenses.focals[k, 1])
        answers.scales[n, k] = focal / answers.translations[n, k, 2]
        for i in range(2):
            answers.focals[n, k, i] = lenses.focals[k, i] * (stretch if i == 0 else 1.0)
            answers.principal_points[n, k, i] = lenses.centres[k, i]
        for i in range(lenses.distortion.shape[1]):
            answers.distortions[n, k, i] = lenses.distortion[k, i]
        answers.camera_models[n, k] = 1 + lenses.models[k]  # 0 is weak perspective
        answers.reprojection_errors[n, k] = explanation.errors[k]
