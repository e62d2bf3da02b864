"""Whether and how far cameras that are assumed static move, from poses of their own in each frame.

At the static rig, one linearisation gives each camera a pose of its own in every frame (a score
test; Cox & Hinkley, *Theoretical Statistics*, sec. 9.3). This pose shifts the images of the
camera's points. The shift that noise alone would cause is known and subtracted.

Whether the camera moves is judged on keypoints that took no part (Stone, *Cross-validatory choice
and assessment of statistical predictions*, 1974): the pose that the other keypoints of a frame give
the camera predicts a keypoint better than the static camera does only if the camera moves.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.epipolar.static_cameras import CAMERA, LENS, SeenPoints, StaticCameras, linearised

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
Bool = NDArray[np.bool_]

# Figures: evidence/static-rigs.md.
FEWEST = 6  # points of a frame that a view must show to get a pose
TINY = 1e-9
WEAKEST = 1e-3  # of the strongest direction of a pose: weaker ones are left alone
USUAL = 0.1  # of the subject's size in the image: shift by the poses that are expected beforehand
POSE = CAMERA - LENS
MOST_GAIN = 3.0  # of one keypoint, so that stray ones do not decide
CENTRE_X = 1  # place of the principal point's x among a camera's numbers: it moves images by 1


class CameraMotion(NamedTuple):
    """How images of static cameras K move from frame to frame, beyond what noise explains."""

    squares: Float64  # (K,) square sides, mean; below 0 by chance where nothing moves
    gains: Float64  # (K,) mean gain in log likelihood of a keypoint that is left out
    errors: Float64  # (K,) standard errors of the gains, by frames; infinite if unknown


def camera_motion(
    rig: StaticCameras,
    points: Float64,
    seen: SeenPoints,
    noise: Float64,
    frames: Int64,
    sizes: Float64,
) -> CameraMotion:
    """Return how far each camera K moves, from points (3, M) of these frames (M,).

    `sizes` (K,) are those of the subject, in sides.
    """
    residuals, by_camera, by_point = linearised(rig, points, seen, noise)
    views = len(residuals)
    normal = np.einsum("kiam,kibm->mab", by_point, by_point, optimize=True)
    inverse = np.linalg.pinv(normal, hermitian=True)  # (M, 3, 3)
    toward = np.einsum("kiam,kim->ma", by_point, residuals)
    left = np.square(residuals).sum() / max(2 * (seen.weights > 0).sum() - 3 * len(normal), 1)
    squares, gains, errors = np.zeros(views), np.zeros(views), np.full(views, np.inf)
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
        weights_of_pixels = np.square(by_camera[view, 0, CENTRE_X, order])

        def of_frames(each: Float64, starts: Int64 = starts, enough: Bool = enough) -> Float64:
            return np.asarray(np.add.reduceat(each, starts, axis=0)[enough])

        beyond = _beyond_noise(of_frames(pulls), of_frames(matrices), of_frames(images), left)
        beyond /= of_frames(weights_of_pixels).clip(1e-300)
        if len(beyond) > 1:
            squares[view] = beyond.mean()
            usual = images.mean(0) / weights_of_pixels.mean() / (USUAL * sizes[view]) ** 2
            each = _gains(pulls, matrices, POSE * left * usual, starts) / left / 2
            gains[view], errors[view] = _mean_of_frames(each, starts, enough)
    return CameraMotion(squares, gains, errors)


def _gains(pulls: Float64, matrices: Float64, usual: Float64, starts: Int64) -> Float64:
    """Return by how much the pose of the others lowers each point's squared residual (M,).

    The points of a frame follow each other from its place in `starts` on; `usual` (6, 6) is the
    information of the poses that are expected beforehand.
    """
    frame = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(pulls)))
    others = np.add.reduceat(matrices, starts, axis=0)[frame] - matrices
    usual = usual + TINY * np.trace(others.mean(0)) * np.eye(POSE)  # without noise it is 0
    others += usual
    towards = np.add.reduceat(pulls, starts, axis=0)[frame] - pulls
    poses = np.linalg.solve(others, towards[..., None])[..., 0]
    return np.asarray(
        2 * (pulls * poses).sum(1) - np.einsum("ma,mab,mb->m", poses, matrices, poses)
    )


def _mean_of_frames(gains: Float64, starts: Int64, enough: Bool) -> tuple[float, float]:
    """Return the mean gain (M,) of a point in frames with enough of them, and its error."""
    of_frames = np.add.reduceat(gains.clip(-MOST_GAIN, MOST_GAIN), starts)[enough]
    points = float(np.diff(starts, append=len(gains))[enough].sum())
    error = of_frames.std(ddof=1) * np.sqrt(len(of_frames)) / points
    return float(of_frames.sum()) / points, float(error)


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
