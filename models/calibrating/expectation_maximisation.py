"""Expectation maximisation: adjust, then learn the noise and the shape model, and again."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle.adjustment import RigPrior, adjust, move_rig
from models.bundle.bone_lengths import find_bone_lengths
from models.bundle.frame import LEAST_DAMPING
from models.bundle.frame_equations import OUTLIER
from models.bundle.problem import (
    POSE,
    VIEW,
    Rig,
    Scene,
    ShapePrior,
    Views,
    make_shape_prior,
    points_in_cameras,
)
from models.bundle.separate_frames import adjust_frames, costs_of
from models.bundle.shape_model import (
    ShapeModel,
    Similarity,
    StructureCovariances,
    align,
    learn_shapes,
)
from models.bundle.shared_likelihood import SharedLikelihood, likelihood_of_shared
from models.bundle.structure_covariances import structure_covariances
from models.calibrating.lens_prior import rig_prior
from models.calibrating.problem import CalibrationProblem, Solution
from models.numerics.steps import Steps
from models.optics.lenses.projection import project

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

ROUNDS = 4
ROUNDS_WITH_BONES = 20  # at most: until no focal length changes
SETTLED = 3e-4  # by more than this share
ADJUSTMENTS, REFINEMENTS = 10, 15  # iterations, of frames and rig together, of frames alone
LEAST_SPREAD = 0.02  # of the shape model, in radii of the structure
LEAST_SPREAD_WITH_BONES = 0.1  # lenses are then determined by bones
LEAST_NOISE = 3e-4  # of the image's side: errors of lens models
LEAST_MEASURED = 1e-5  # of the image's side: less is as good as none
FAR = 10.0  # noise standard deviations from which a keypoint is not used to estimate the noise
COOLING = 0.25  # the noise falls no faster than to this share in a round
MOST_LEARNT = 0.95  # of the remaining way in a direction: at most 19 rounds are skipped
# And at most so much of a lens (log focal length, principal point in image sides, radial
# coefficients), of a rotation in radians, and of a translation in structures.
LONGEST_LEAP = np.array([0.05, 0.03, 0.03, 0.05, 0.1, *[0.05] * 3, *[0.5] * 3])


class Uncertainty(NamedTuple):
    """Covariances of structures, and the resulting correction of the noise."""

    frames: NDArray[np.int64]  # (M,) for which they are determined
    covariances: StructureCovariances  # of their structures
    noise_factor: float  # ratio of the noise in the residuals to the assumed one


def learn(
    problem: CalibrationProblem,
    solution: Solution,
    *,
    with_bones: bool = False,
    rounds: int = ROUNDS,
    least_noise: float = LEAST_NOISE,
) -> Steps[Solution]:
    """Maximise expectations from a solution on.

    With `with_bones`, constant lengths of bones are used as well, and the shape model has less
    weight. `least_noise`, a share of the image's side, is the lower limit of the noise.
    """
    rig, scene, prior, noise = solution.rig, solution.scene, solution.prior, solution.noise
    focals = rig.lenses.focals
    floor = least_noise * problem.side
    least_spread = LEAST_SPREAD_WITH_BONES if with_bones else LEAST_SPREAD
    for _ in range(ROUNDS_WITH_BONES if with_bones else rounds):
        views = problem.views(noise)
        believed = rig_prior(problem, rig, given_poses=solution.given_poses)
        before = rig
        if believed.free.any():
            rig, scene = yield from adjust(
                views,
                rig,
                prior,
                scene,
                rig_prior=believed,
                bones=find_bone_lengths(scene.points, problem.measured) if with_bones else None,
                iterations=ADJUSTMENTS,
            )
        yield
        if np.ptp(prior.means, axis=0).max() == 0 and believed.free.any():
            bones = find_bone_lengths(scene.points, problem.measured) if with_bones else None
            likelihood = likelihood_of_shared(
                views,
                rig,
                prior,
                scene,
                free=believed.free,
                bones=bones,
                by_keypoint=False,
            )
            leap = _ahead(likelihood, believed, before, rig, problem.side)
            if np.isfinite(costs_of(views, leap, prior, scene)).all():
                rig = leap
            yield
        scene, costs = adjust_frames(views, rig, prior, scene, iterations=REFINEMENTS)
        yield
        unsure = uncertainty(views, rig, prior, scene, np.isfinite(costs))
        measured = max(unsure.noise_factor * noise, LEAST_MEASURED * problem.side)
        noise = max(unsure.noise_factor * noise, COOLING * noise, floor)
        shapes = learn_shapes(scene.points[unsure.frames], unsure.covariances, floor=least_spread)
        points, similarity = align(scene.points, shapes.mean)
        scene = regauge(scene, points, similarity, rig)
        prior = about_model(shapes, len(points))
        change, focals = np.abs(np.log(rig.lenses.focals / focals)).max(), rig.lenses.focals
        if with_bones and change < SETTLED:
            break
    return solution._replace(
        rig=rig,
        scene=scene,
        prior=prior,
        shapes=shapes,
        noise=noise,
        measured_noise=measured,
        with_bones=with_bones,
    )


def _ahead(
    likelihood: SharedLikelihood, believed: RigPrior, before: Rig, now: Rig, side: float
) -> Rig:
    """Extrapolate the rig to which further rounds would converge, from the change in one round.

    Expectation maximisation is slow where the learnt shapes follow the rig: a round goes only the
    share of the way to the optimum that is not lost to learning (Louis, 1982).
    """
    free = believed.free
    held = believed.precision[np.ix_(free, free)] + np.diag(
        LEAST_DAMPING * likelihood.curvature.diagonal() + LEAST_DAMPING
    )
    root = np.linalg.cholesky(np.linalg.inv(likelihood.curvature + held))
    values, vectors = np.linalg.eigh(root.T @ likelihood.learnt @ root)
    done = believed._replace(mean=before).offset(now)[free]
    along = vectors.T @ np.linalg.solve(root, done)
    to_come = 1 / (1 - values.clip(0, MOST_LEARNT)) - 1
    step = np.zeros(len(free))
    step[free] = root @ vectors @ (to_come * along)
    longest = np.tile(LONGEST_LEAP * [1, side, side, *[1] * (VIEW - 3)], len(now.groups))
    return move_rig(now, step / max(1.0, float((np.abs(step) / longest).max())))


def regauge(scene: Scene, points: Float64, similarity: Similarity, rig: Rig) -> Scene:
    """Transform the structures into another frame of reference, where they are `points` (N, P, 3).

    Groups of several views take the scale into their size, those of one into their distance.
    """
    several = rig.members > 1  # (G,)
    shift = (scene.rotations @ similarity.centres.mT[:, None])[..., 0]  # (N, G, 3)
    sizes = np.where(several, scene.sizes, 0.0)  # of a group of one, it is a stretch
    translations = scene.translations + np.exp(sizes)[..., None] * shift
    scales = similarity.scales[:, None]  # (N, 1)
    return Scene(
        points,
        scene.rotations @ similarity.rotations[:, None],
        np.where(several[:, None], translations, translations * scales[..., None]),
        np.where(several, scene.sizes - np.log(scales), scene.sizes),
    )


def uncertainty(
    views: Views, rig: Rig, prior: ShapePrior, scene: Scene, explained: Bool
) -> Uncertainty:
    """Compute covariances of the structures of the frames `explained` (N,).

    Raises
    ------
    numpy.linalg.LinAlgError
        When they exist for no frame.
    """
    frames = np.flatnonzero(explained)
    covariances = structure_covariances(views.of(frames), rig, prior.of(frames), scene.of(frames))
    definite = np.flatnonzero(np.isfinite(covariances.blocks[:, 0, 0, 0]))
    if not len(definite):
        raise np.linalg.LinAlgError("no frame's normal equations are positive definite")
    frames, covariances = frames[definite], covariances.of(definite)
    views, prior, scene = views.of(frames), prior.of(frames), scene.of(frames)
    pixels = project(points_in_cameras(scene, rig), rig.lenses)
    squared = views.weights * np.square(pixels - views.keypoints).sum(-1)  # (N, K, P)
    seen = (views.weights > 0) & (squared < FAR**2)
    robust = np.where(seen, (OUTLIER / np.sqrt(squared.clip(1e-12))).clip(max=1) * squared, 0.0)
    # The size of a group of one view is held.
    numbers = np.where(rig.members > 1, POSE, POSE - 1)
    belongs: Bool = rig.groups[:, None] == np.arange(rig.group_count)  # (K, G)
    observed: Bool = np.any(seen, -1)  # (N, K)
    there = np.any(observed[..., None] & belongs, 1)  # (N, G)
    determined = _determined(covariances, prior) + there @ numbers
    freedom = float((2 * seen.sum((1, 2)) - determined).clip(0).sum())
    factor = math.sqrt(float(robust.sum()) / max(freedom, 1.0))
    return Uncertainty(frames, covariances, factor)


def _determined(covariances: StructureCovariances, prior: ShapePrior) -> Float64:
    """Return how many numbers (N,) of each structure the data determine: what the prior does not.

    It is 3 P - tr(C S^-1), with the covariances C and the prior's S = s^2 I + B B^T.
    """
    components = np.linalg.solve(prior.inner, prior.basis.T)  # (Q, 3 P)
    blocks, factors = covariances
    shape = (blocks.shape[1], 3, -1)
    outer = prior.basis.reshape(shape) @ components.T.reshape(shape).mT  # (P, 3, 3)
    trace = blocks.trace(axis1=2, axis2=3).sum(1) - (blocks * outer.mT).sum((1, 2, 3))
    trace += np.square(factors).sum((1, 2))
    trace -= ((components @ factors) * (prior.basis.T @ factors)).sum((1, 2))
    return np.asarray(len(prior.basis) - trace / (prior.scale * prior.spread) ** 2)


def about_model(shapes: ShapeModel, frames: int) -> ShapePrior:
    """Return the prior that the structures of all frames are like the model's."""
    return make_shape_prior(np.tile(shapes.mean, (frames, 1, 1)), shapes.basis, shapes.spread)
