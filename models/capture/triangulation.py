"""Multi-view triangulation with known cameras: TRNG, the baseline the paper compares with."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from models.settings.keypoints import check_keypoints

Float64 = NDArray[np.float64]
PARALLEL = 1e-9  # smallest curvature per ray of the squared distance; 0 where all rays are parallel


class Triangulation(NamedTuple):
    """Points in the frame of reference and unit of the projections."""

    points3d: Float64  # (N, P, 3), NaN where fewer than two rays, or only parallel ones, are left
    used: NDArray[np.bool_]  # (N, K, P) rays that were kept


def triangulate(keypoints: ArrayLike, projections: ArrayLike, *, rounds: int = 2) -> Triangulation:
    """Find the points closest to their viewing rays, dropping the furthest ray a few times.

    Iterative triangulation with outlier rejection as the paper describes TRNG ("Baseline"): the
    point of least squared distance to all rays (the midpoint method; Hartley & Zisserman,
    *Multiple View Geometry*, ch. 12), then without the ray furthest from it, for as many rounds;
    two rays are always kept.

    Parameters
    ----------
    keypoints
        (N, K, P, 2) pixels, NaN where not observed.
    projections
        (K, 3, 4) for static cameras or (N, K, 3, 4): pixels ~ projection @ (X, 1). Their left
        3x3 block must be invertible (a camera at a finite place).
    rounds
        How many rays of each point may be dropped, 0 to 64.

    Raises
    ------
    ValueError
        When shapes do not match, a projection is not that of a finite camera, or `rounds` is out
        of range.
    """
    pixels = check_keypoints(keypoints).astype(np.float64)
    if not 0 <= rounds <= 64:
        raise ValueError(f"rounds must lie between 0 and 64, got {rounds}")
    centres, directions = _rays(pixels, np.asarray(projections, np.float64))
    used: NDArray[np.bool_] = np.all(np.isfinite(pixels), axis=-1)  # (N, K, P)
    # I - d d^T takes an offset to its part across the ray.
    across = np.eye(3) - directions[..., :, None] * directions[..., None, :]  # (N, K, P, 3, 3)
    across[~used] = 0
    anchors = (across @ centres[:, :, None, :, None])[..., 0]  # (N, K, P, 3)

    points = _closest(across, anchors, used)
    for _ in range(rounds):
        offsets = (across @ (points[:, None] - centres[:, :, None])[..., None])[..., 0]
        distances = np.where(used, np.linalg.norm(offsets, axis=-1), -1.0)
        frame, point = np.nonzero((used.sum(1) > 2) & np.isfinite(points).all(-1))
        furthest = distances.argmax(1)  # (N, P)
        used[frame, furthest[frame, point], point] = False
        points = _closest(across, anchors, used)
    return Triangulation(points, used)


def _rays(pixels: Float64, projections: Float64) -> tuple[Float64, Float64]:
    """Camera centres (N, K, 3) and unit directions (N, K, P, 3)."""
    frames, views = pixels.shape[:2]
    if projections.shape not in ((views, 3, 4), (frames, views, 3, 4)):
        raise ValueError(
            f"projections must have shape {(views, 3, 4)} or {(frames, views, 3, 4)},"
            f" got {projections.shape}"
        )
    projections = np.broadcast_to(projections, (frames, views, 3, 4))
    if (
        not np.isfinite(projections).all()
        or (np.abs(np.linalg.det(projections[..., :3])) < 1e-12).any()
    ):
        raise ValueError("projections must be finite, with an invertible left 3x3 block")
    inverse = np.linalg.inv(projections[..., :3])
    centres = -(inverse @ projections[..., 3:])[..., 0]
    homogeneous = np.concatenate((pixels, np.ones_like(pixels[..., :1])), -1)
    directions = homogeneous @ inverse.mT
    return centres, directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def _closest(across: Float64, anchors: Float64, used: NDArray[np.bool_]) -> Float64:
    """Points (N, P, 3) of least squared distance to the rays that are used."""
    normal = (across * used[..., None, None]).sum(1)  # (N, P, 3, 3)
    target = (anchors * used[..., None]).sum(1)  # (N, P, 3)
    count = used.sum(1)  # (N, P)
    curvature = np.linalg.eigvalsh(normal)[..., 0]
    solvable = (count >= 2) & (curvature > PARALLEL * count)
    normal[~solvable] = np.eye(3)
    points: Float64 = np.linalg.solve(normal, target[..., None])[..., 0]
    points[~solvable] = np.nan
    return points
