"""Answers of lifts as the frames of a posterior."""

import numpy as np
from numpy.typing import NDArray

from models.bundle.problem import Rig
from models.bundle.shape_model import align
from models.lifting.lift import LiftedFrames
from models.network.answers import RIG_NOT_USED
from models.optics.lenses.projection import Lenses, project
from models.posterior.frames import Frames

Float64 = NDArray[np.float64]

# Student's t, as a keypoint counts less that lies further off than most; never more than one of
# white noise.
FREEDOM = 4.0


def frames_of(
    lift: LiftedFrames,
    rig: Rig,
    mean: Float64,
    keypoints: Float64,
    weights: Float64,
    noise: Float64,
) -> Frames:
    """Return the frames of a lift that has perspective cameras, all its points being known.

    Parameters
    ----------
    rig
        Of the K views of the lift.
    mean
        (P, 3) of the shapes.
    keypoints, weights
        (N, K, P, 2) pixels as they were detected, and (N, K, P) confidences, 0 where not used.
    noise
        (K, P) pixels, standard deviations of a coordinate of confidence 1.
    """
    points = lift.points3d.astype(np.float64)
    rotations = np.nan_to_num(lift.rotations.astype(np.float64))
    translations = np.nan_to_num(lift.translations.astype(np.float64))
    placed = lift.camera_models > 0  # (N, K)
    apart = (lift.findings & RIG_NOT_USED).astype(bool)
    joined = np.broadcast_to(rig.static, placed.shape) & ~apart[:, None]
    growth = _growth(rotations, translations, placed & joined, rig)
    weights = np.where(placed[..., None], weights, 0.0)
    residuals = keypoints - reprojected(points, rotations, translations, rig.lenses)
    squared = np.square(residuals).sum(-1) * weights / np.square(noise)
    robust = ((FREEDOM + 2) / (FREEDOM + squared)).clip(max=1.0)
    _, similarity = align(points, mean)
    turned = similarity.rotations / similarity.scales[:, None, None]
    return Frames(
        np.ascontiguousarray(points),
        np.ascontiguousarray(rotations),
        np.ascontiguousarray(translations),
        rig.lenses,
        np.ascontiguousarray(joined),
        np.ascontiguousarray(growth[:, None, None] * rig.translations),
        growth,
        np.ascontiguousarray(np.nan_to_num(keypoints)),
        np.ascontiguousarray(np.where(weights > 0, robust * weights, 0.0) / np.square(noise)),
        np.ascontiguousarray(turned),
    )


def reprojected(
    points: Float64, rotations: Float64, translations: Float64, lenses: Lenses
) -> Float64:
    """Return the pixels (N, K, P, 2) of points (N, P, 3); any number without a camera."""
    held = np.einsum("nkij,npj->nkpi", rotations, points) + translations[:, :, None]
    held[..., 2] = np.where(held[..., 2] > 0, held[..., 2], 1.0)
    return project(held, lenses)


def _growth(
    rotations: Float64, translations: Float64, used: NDArray[np.bool_], rig: Rig
) -> Float64:
    """Return the units (N,) of each structure in a unit of the rig, from distances of cameras.

    1 where fewer than two cameras of the rig see a frame.
    """
    centres = -np.einsum("nkji,nkj->nki", rotations, translations)
    of_rig = -np.einsum("kji,kj->ki", rig.rotations, rig.translations)
    weights = used[..., None] / used.sum(1).clip(1)[:, None, None]
    spread = np.square(weights**0.5 * (centres - (weights * centres).sum(1, keepdims=True)))
    spread_of_rig = np.square(weights**0.5 * (of_rig - (weights * of_rig).sum(1, keepdims=True)))
    ours, theirs = spread.sum((1, 2)), spread_of_rig.sum((1, 2))
    return np.where(theirs > 1e-12, np.sqrt(ours / theirs.clip(1e-12)), 1.0)
