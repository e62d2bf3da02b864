"""The marginal likelihood of each frame's keypoints under a rig and a shape model.

Laplace's method: structure and poses are integrated out about their best values (MacKay,
*Information Theory, Inference, and Learning Algorithms*, 2003, ch. 27). The best structure alone
would favour rigs that leave structures vague.
"""

import numpy as np
from numpy.typing import NDArray

from models.bundle.frame_equations import NormalEquations
from models.bundle.problem import POSE, Rig, Scene, ShapePrior, Views, points_in_cameras
from models.bundle.separate_frames import adjust_frames, normal_equations
from models.numerics.tiny import TINY

Float64 = NDArray[np.float64]

FREEDOM = 8.0  # of the multivariate t, with which a frame unlike all others counts little; a guess
ITERATIONS = 15


def log_evidence(views: Views, rig: Rig, prior: ShapePrior, scene: Scene) -> Float64:
    """Return the log likelihood (N,) of each frame's keypoints, up to a constant.

    `scene` is a start that is adjusted first. For each group of views, the prior of the subject's
    place is uniform over the image and over the log distance, so the overall size of a rig does not
    matter. NaN where a frame cannot be explained.
    """
    scene, costs = adjust_frames(views, rig, prior, scene, iterations=ITERATIONS)
    explained = np.flatnonzero(np.isfinite(costs))  # others have points behind cameras
    views, prior, scene = views.of(explained), prior.of(explained), scene.of(explained)
    numbers = 2 * (views.weights > 0).sum((1, 2))  # (n,)
    degrees = (numbers - POSE * rig.group_count).clip(1)
    logs = np.log(np.where(views.weights > 0, views.weights, 1.0)).sum((1, 2))
    depths = points_in_cameras(scene, rig)[..., 2].mean(2)  # (n, K)
    focals = rig.lenses.focals.mean(1)
    places = 2 * np.log(focals) - 3 * np.log(depths.clip(TINY))
    places = (places / rig.members[rig.groups]).sum(1)  # the mean of each group
    equations = normal_equations(views, rig, prior, scene, shared=False)
    fits = -(FREEDOM + degrees) / 2 * np.log1p(costs[explained] / FREEDOM)
    found = fits + logs + places - _log_determinants(equations) / 2
    found -= prior.basis.shape[0] * np.log(prior.scale * prior.spread)
    evidence = np.full(len(costs), np.nan)
    evidence[explained] = np.where(np.isfinite(found), found, np.nan)
    return evidence


def _log_determinants(equations: NormalEquations) -> Float64:
    """Log determinants (N,) of frames' normal equations; NaN of those not positive definite."""
    of_points = np.linalg.slogdet(equations.points)  # (N, P)
    definite = np.flatnonzero((of_points.sign > 0).all(1))
    blocks, coupling = equations.points[definite], equations.coupling[definite]
    flat = (len(definite), 3 * blocks.shape[1], coupling.shape[-1])
    carried = np.linalg.solve(blocks, coupling).reshape(flat)
    schur = np.linalg.slogdet(equations.others[definite] - coupling.reshape(flat).mT @ carried)
    logs = schur.logabsdet + of_points.logabsdet[definite].sum(1)
    found = np.full(len(equations.points), np.nan)
    found[definite] = np.where(schur.sign > 0, logs, np.nan)
    return found
