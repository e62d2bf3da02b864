"""The arrays of a lift, as the compiled functions write them: structures and cameras of frames."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.optics.lenses.projection import COEFFICIENTS

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]


class Answers(NamedTuple):
    """Structures and cameras of N frames of K views of P keypoints; NaN where there is no answer.

    A frame without a usable view has no structure; a view that is not usable has no camera. A
    camera takes the structure to its own axes by R, x right, y down, z forward.
    """

    points3d: Float32  # (N, P, 3) canonical, centred
    rotations: Float32  # (N, K, 3, 3) R, canonical to camera, det +1
    scales: Float32  # (N, K) pixels per unit, at the structure's centre
    # (N, K, 3): of perspective, x_cam = R X + t in units of the structure; of weak perspective,
    # (x, y) in pixels and NaN.
    translations: Float32
    focals: Float32  # (N, K, 2) pixels along x and y; NaN for weak perspective
    principal_points: Float32  # (N, K, 2) pixels; NaN for weak perspective
    distortions: Float32  # (N, K, 8) OpenCV's order; NaN for weak perspective
    camera_models: NDArray[np.int8]  # (N, K) see `models.lifting.lift`, -1 without a camera
    # (N, K): pixels, mean over the observed keypoints, as they were denoised if they were.
    reprojection_errors: Float32
    keypoints_used: NDArray[np.int32]  # (N, K)
    # (N, P): usable views that show the keypoint; 0 where it is inferred from the others.
    keypoints_seen: NDArray[np.uint8]
    # (N, K, P): probability of each keypoint to be an outlier, rounded to thousandths. NaN where
    # it was not observed or not judged. Above `OUTLIER` it is left out of the lift or, if left and
    # right were swapped, used in its partner's place.
    outlier_probability: Float32
    # (N, P): expected distance from the true point, root mean square, in units of the structure;
    # NaN where it is not known (see `models.posterior`).
    points3d_sd: Float32
    # Of points, in squares of that unit; (N, P, 0) and (N, P, 3, 0) unless they are asked for. The
    # covariance of a structure is Sigma (3 P, 3 P) = blockdiag(C - U U^T) + U U^T with blocks C
    # and modes U, which carry what points share.
    points3d_covariance: Float32  # (N, P, 6) xx, xy, xz, yy, yz, zz
    points3d_modes: Float32  # (N, P, 3, MODES)
    quality: Float32  # (N,) in [0, 1], 0 without a structure, NaN where it is not known
    quality_reason: NDArray[np.uint8]  # (N,) 0 for none; see `models.posterior.quality.REASONS`
    findings: NDArray[np.uint8]  # (N,) sums of the bits below this class
    continued: NDArray[np.bool_]  # (N,) whether refinement started from the previous answer
    # The figures behind the findings:
    sizes: Float32  # (N,) pixels, mean size of the usable views
    misfits: Float32  # (N,) units of the structure, mean reprojection error of the network
    rig_residuals: Float32  # (N,) pixels, mean residual with a rig that was not used; else NaN


# The bits of `Answers.findings`; the codes in `models.findings` explain them.
RIG_NOT_USED, UNLIKE_FIT, OTHER_SCALE, NOT_IN_ROOM = 1, 2, 4, 8


class Usual(NamedTuple):
    """The range of the frames of a fit; a frame outside is unlike them."""

    misfits: Float64  # (V,) largest misfit of the network with one usable view, two, ... V or more
    least_size: float  # pixels, the smallest size of a view
    most_size: float


def nothing_unusual() -> Usual:
    """Return limits that every frame is within, for fits whose range is unknown."""
    return Usual(np.full(1, np.inf), 0.0, np.inf)


def make_answers(frames: int, views: int, keypoints: int) -> Answers:
    """Return unfilled arrays for the answers of N frames of K views of P keypoints."""
    per_view = (frames, views)
    return Answers(
        points3d=np.empty((frames, keypoints, 3), np.float32),
        rotations=np.empty((*per_view, 3, 3), np.float32),
        scales=np.empty(per_view, np.float32),
        translations=np.empty((*per_view, 3), np.float32),
        focals=np.empty((*per_view, 2), np.float32),
        principal_points=np.empty((*per_view, 2), np.float32),
        distortions=np.empty((*per_view, COEFFICIENTS), np.float32),
        camera_models=np.empty(per_view, np.int8),
        reprojection_errors=np.empty(per_view, np.float32),
        keypoints_used=np.empty(per_view, np.int32),
        keypoints_seen=np.empty((frames, keypoints), np.uint8),
        outlier_probability=np.full((*per_view, keypoints), np.nan, np.float32),
        points3d_sd=np.full((frames, keypoints), np.nan, np.float32),
        points3d_covariance=np.empty((frames, keypoints, 0), np.float32),
        points3d_modes=np.empty((frames, keypoints, 3, 0), np.float32),
        quality=np.full(frames, np.nan, np.float32),
        quality_reason=np.zeros(frames, np.uint8),
        findings=np.empty(frames, np.uint8),
        continued=np.empty(frames, np.bool_),
        sizes=np.empty(frames, np.float32),
        misfits=np.empty(frames, np.float32),
        rig_residuals=np.empty(frames, np.float32),
    )
