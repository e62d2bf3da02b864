"""Hypotheses about lenses that nobody told, weighed by evidence: which are alike, how large images.

Each is a Gaussian prior. What the keypoints say is a parabola in the numbers that all frames share
(`models.bundle.shared_likelihood`), so the evidence for a prior has a closed form (MacKay,
*Bayesian Interpolation*, 1992), and weighing a hypothesis costs no fit of its own.
"""

from collections.abc import Iterable
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from models.bundle.adjustment import RigPrior
from models.bundle.problem import FOCAL, LENS, VIEW, Rig, Scene, ShapePrior, Views
from models.bundle.shared_likelihood import SharedLikelihood, likelihood_of_shared
from models.calibrating.image_sizes import usual_sizes
from models.calibrating.lens_prior import rig_prior
from models.calibrating.problem import GivenPoses, LensBelief, Problem

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

DECISIVE = 8.0  # by so much the log evidence must be higher to give up a simpler belief
MOST_FRAMES = 100  # that are looked at to see whether errors are alike
MISFIT = 0.03  # of the log focal length: what lens models get wrong is no sign of unlike lenses
TINY = 1e-9


def weigh_beliefs(
    problem: Problem,
    rig: Rig,
    likelihood: SharedLikelihood,
    belief: LensBelief,
    given_poses: GivenPoses | None,
    free: NDArray[np.bool_],
) -> LensBelief:
    """Return the belief about lenses for which there is most evidence at a rig.

    The likelihood is of what is `free` (T,).

    Lenses that are alike, and images of any size, are given up for what is `DECISIVE`ly better.
    """
    if not np.isinf(problem.lens_sds).any():
        return belief
    told = belief.weight

    def believed(tried: LensBelief) -> RigPrior:
        tried = tried._replace(weight=1, misfit=MISFIT)
        prior = rig_prior(problem, rig, belief=tried, given_poses=given_poses)
        return prior._replace(free=free)

    def best(simple: LensBelief, others: Iterable[LensBelief]) -> LensBelief:
        bound = _evidence(likelihood, believed(simple), rig, told) + DECISIVE
        for other in others:
            evidence = _evidence(likelihood, believed(other), rig, told)
            if evidence > bound:
                simple, bound = other, evidence
        return simple

    if not problem.images.told.all():
        sized = [belief._replace(size=size) for size in usual_sizes(problem.images)]
        belief = best(belief._replace(size=None), sized)
    if problem.cameras_alike == "auto" and len(belief.kinds) > 1:
        apart = belief._replace(kinds=np.arange(len(belief.kinds)))
        focals = _untied_focals(likelihood, believed(apart), rig, told)
        alike = belief._replace(kinds=np.zeros_like(belief.kinds))
        belief = best(alike, (belief._replace(kinds=kinds) for kinds in _partitions(focals)))
    return belief


def errors_alike(
    views: Views, rig: Rig, prior: ShapePrior, scene: Scene, believed: RigPrior
) -> float:
    """How much less keypoints say of lenses than if their errors had nothing to do with each other.

    The ratio of variances, 1 or more, from some of the frames. What the errors of a keypoint have
    in common in all frames counts the more, the more frames there are.
    """
    lenses = _is_lens(believed)
    if not lenses.any():
        return 1.0
    frames = len(scene.points)
    some = np.arange(0, frames, -(-frames // MOST_FRAMES))
    likelihood = likelihood_of_shared(
        views.of(some), rig, prior.of(some), scene.of(some), free=believed.free
    )
    held = believed.precision[np.ix_(believed.free, believed.free)]
    held = held + np.diag(TINY * likelihood.curvature.diagonal() + TINY)
    fixed = np.linalg.inv(likelihood.curvature + held)
    clustered = (fixed @ (likelihood.clustered + held) * fixed).sum(1)
    ratio = float((clustered / fixed.diagonal())[lenses].mean())
    return 1 + max(ratio - 1, 0) * frames / len(some)


def _evidence(likelihood: SharedLikelihood, believed: RigPrior, rig: Rig, weight: float) -> float:
    """Log evidence for a prior, up to a constant: the parabola times it, integrated."""
    lenses = _is_lens(believed)
    held, pull, information = _posterior(likelihood, believed, rig, weight)
    offset = believed.offset(rig)[believed.free]
    _, of_prior = np.linalg.slogdet(held[np.ix_(lenses, lenses)])
    _, of_both = np.linalg.slogdet(information)
    gained = pull @ np.linalg.solve(information, pull) - offset @ held @ offset
    return float(of_prior - of_both + gained) / 2


def _untied_focals(
    likelihood: SharedLikelihood, believed: RigPrior, rig: Rig, weight: float
) -> Float64:
    """Log focal lengths (K,) over the usual ones, as keypoints say them of each camera alone."""
    _, pull, information = _posterior(likelihood, believed, rig, weight)
    offset = believed.offset(rig)
    offset[believed.free] += np.linalg.solve(information, pull)
    log_focals: Float64 = offset.reshape(-1, VIEW)[:, FOCAL]
    return log_focals


def _posterior(
    likelihood: SharedLikelihood, believed: RigPrior, rig: Rig, weight: float
) -> tuple[Float64, Float64, Float64]:
    """Precision of the prior, (F, F), the pull (F,) of both, and their information (F, F)."""
    free = believed.free
    held = believed.precision[np.ix_(free, free)]
    score = likelihood.score / weight
    told = _information(likelihood) / weight
    pull = score - held @ believed.offset(rig)[free]
    information = told + held
    return held, pull, information + np.diag(TINY * information.diagonal() + TINY)


def _information(likelihood: SharedLikelihood) -> Float64:
    """Return what keypoints say, (F, F), learnt shapes counted; never less than nothing."""
    values, vectors = np.linalg.eigh(likelihood.information)
    information: Float64 = (vectors * values.clip(0)) @ vectors.T
    return information


def _is_lens(believed: RigPrior) -> NDArray[np.bool_]:
    """Which of the free numbers (F,) are those of lenses."""
    lens: NDArray[np.bool_] = (np.arange(len(believed.free)) % VIEW < LENS)[believed.free]
    return lens


def _partitions(log_focals: Float64) -> list[Int64]:
    """Kinds (K,) of lenses: two, three and more, parted at the widest gaps between their focals."""
    order = np.argsort(log_focals, kind="stable")
    gaps = np.array([b - a for a, b in pairwise(log_focals[order])])
    widest = np.argsort(-gaps, kind="stable")
    partitions = []
    for count in range(1, len(gaps) + 1):
        bounds = np.zeros(len(order), np.int64)
        bounds[1 + widest[:count]] = 1
        kinds = np.empty(len(order), np.int64)
        kinds[order] = bounds.cumsum()
        partitions.append(kinds)
    return partitions
