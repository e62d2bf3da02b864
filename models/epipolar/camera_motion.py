"""How far cameras that are assumed static move, from the poses that single frames give them.

At the static rig, one linearisation gives each camera a pose of its own in every frame (a score
test; Cox & Hinkley, *Theoretical Statistics*, sec. 9.3). This pose shifts the images of the
camera's points. The shift that noise alone would cause is known and subtracted.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.epipolar.static_cameras import LENS, SeenPoints, StaticCameras, linearised

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
Bool = NDArray[np.bool_]

FEWEST = 6  # points of a frame that a view must show to get a pose
WEAKEST = 1e-3  # of the strongest direction of a pose: weaker ones are left alone
CENTRE_X = 1  # place of the principal point's x among a camera's numbers: it moves images by 1


class CameraMotion(NamedTuple):
    """How images of static cameras K move from frame to frame, beyond what noise explains."""

    squares: Float64  # (K,) square sides, mean; below 0 by chance where nothing moves
    errors: Float64  # (K,) standard errors of these


def camera_motion(
    rig: StaticCameras, points: Float64, seen: SeenPoints, noise: Float64, frames: Int64
) -> CameraMotion:
    """Return how far each camera K moves, from points (3, M) of these frames (M,)."""
    residuals, by_camera, by_point = linearised(rig, points, seen, noise)
    views = len(residuals)
    normal = np.einsum("kiam,kibm->mab", by_point, by_point, optimize=True)
    inverse = np.linalg.pinv(normal, hermitian=True)  # (M, 3, 3)
    toward = np.einsum("kiam,kim->ma", by_point, residuals)
    left = np.square(residuals).sum() / max(2 * (seen.weights > 0).sum() - 3 * len(normal), 1)
    squares, errors = np.zeros(views), np.zeros(views)
    for view in range(views):
        there = np.flatnonzero(seen.weights[view] > 0)
        order = there[np.argsort(frames[there], kind="stable")]
        if not len(order):
            continue
        starts = np.flatnonzero(np.diff(frames[order], prepend=-1))
        enough = np.diff(starts, append=len(order)) >= FEWEST
        by_pose = by_camera[view][:, LENS:, order]  # (2, 6, M)
        through = np.einsum("iam,ibm->mab", by_pose, by_point[view][..., order]) @ inverse[order]
        pulls = -np.einsum("iam,im->ma", by_pose, residuals[view][:, order])
        pulls += (through @ toward[order][..., None])[..., 0]
        images = np.einsum("iam,ibm->mab", by_pose, by_pose)
        matrices = images - through @ np.einsum("iam,ibm->mba", by_pose, by_point[view][..., order])
        weights = np.square(by_camera[view, 0, CENTRE_X, order])

        def of_frames(each: Float64, starts: Int64 = starts, enough: Bool = enough) -> Float64:
            return np.asarray(np.add.reduceat(each, starts, axis=0)[enough])

        beyond = _beyond_noise(of_frames(pulls), of_frames(matrices), of_frames(images), left)
        beyond /= of_frames(weights).clip(1e-300)
        if len(beyond) > 1:
            squares[view] = beyond.mean()
            errors[view] = beyond.std(ddof=1) / np.sqrt(len(beyond))
    return CameraMotion(squares, errors)


def _beyond_noise(pulls: Float64, matrices: Float64, images: Float64, noise: float) -> Float64:
    """Return weighted squared shifts (F,) of frames, less their expectation under noise alone."""
    values, vectors = np.linalg.eigh((matrices + matrices.mT) / 2)
    known = values > WEAKEST * values[:, -1:].clip(1e-300)
    inverse = np.where(known, 1 / np.where(known, values, 1.0), 0.0)
    inverses = (vectors * inverse[:, None]) @ vectors.mT
    steps = (inverses @ pulls[..., None])[..., 0]
    squared = np.einsum("fa,fab,fb->f", steps, images, steps)
    expected = noise * np.einsum("fab,fba->f", inverses, images)
    return np.asarray(squared - expected)
