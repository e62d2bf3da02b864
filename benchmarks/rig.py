"""Cameras found from a ground truth, and what spoils them and the keypoints they see.

Only the benchmark of fidelity uses this: a fit never sees a calibration or a truth.
"""

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from models.capture.observations import as_observations
from models.numerics.rotations import rotations_from_vectors

Float64 = NDArray[np.float64]
Part = Literal["extrinsics", "intrinsics"]
Size = tuple[int, int]

LEAST_POINTS = 50  # six would do without noise
MOST_POINTS = 3000  # that refine a lens
OUTLIER = 3.0  # times the median residual: left out when the camera is found again
STATIC = 0.1  # largest residual of a static camera, as a share of the subject's size in the image


class Rig(NamedTuple):
    """Static cameras, estimated from the truth."""

    projections: Float64  # (K, 3, 4): pixels ~ projection @ (X, 1)
    residuals: Float64  # (K,) pixels, median over the keypoints


def find_rig(keypoints: ArrayLike, points3d: ArrayLike) -> Rig | None:
    """Estimate every view's projection from the truth; None where a view is not static.

    The direct linear transform (Hartley & Zisserman, *Multiple View Geometry*, ch. 7) over all
    frames and keypoints of a view, in normalised coordinates, and again without what lies more
    than three median residuals off. Lens distortion stays in the residuals.
    """
    pixels, truth = np.asarray(keypoints, np.float64), np.asarray(points3d, np.float64)
    seen = as_observations(pixels)
    projections, residuals = [], []
    for view in range(pixels.shape[1]):
        known = np.isfinite(pixels[:, view]).all(-1) & np.isfinite(truth).all(-1)
        image, world = pixels[:, view][known], truth[known]
        if len(image) < LEAST_POINTS:
            return None
        distances = np.zeros(len(image))
        for _ in range(2):
            near = distances <= OUTLIER * np.median(distances)
            projection = _linear(image[near], world[near])
            distances = np.linalg.norm(_project(projection, world) - image, axis=-1)
        size = float(np.median(seen.sizes[seen.usable[:, view], view]))
        if not np.median(distances) < STATIC * size:
            return None
        projections.append(projection)
        residuals.append(float(np.median(distances)))
    return Rig(np.array(projections), np.array(residuals))


class TrueLenses(NamedTuple):
    """Poses and lenses, found from the truth."""

    rotations: Float64  # (K, 3, 3)
    translations: Float64  # (K, 3)
    lenses: Float64  # (K, 9): focal lengths, principal point, k1, k2, k3, p1, p2

    @property
    def focals(self) -> Float64:
        """Mean focal lengths (K,), pixels."""
        return np.asarray(self.lenses[:, :2].mean(1))

    @property
    def calibration(self) -> list[dict[str, Any]]:
        """The cameras as `FitConfig.calibration` takes them."""
        return [
            {
                "intrinsics": {
                    **dict(zip(("fx", "fy", "cx", "cy"), lens[:4].tolist(), strict=True)),
                    "distortion": lens[[4, 5, 7, 8, 6]].tolist(),
                },
                "rotation": rotation.tolist(),
                "translation": translation.tolist(),
            }
            for rotation, translation, lens in zip(
                self.rotations, self.translations, self.lenses, strict=True
            )
        ]


def find_lenses(keypoints: ArrayLike, points3d: ArrayLike) -> TrueLenses | None:
    """Estimate poses and lenses from the truth; None where a view is not static.

    A linear transform explains the distortion of a lens by a shifted principal point and a turned
    camera. So it is refined by robust least squares over pose, focal lengths, principal point,
    three radial and two tangential coefficients.
    """
    linear = find_rig(keypoints, points3d)
    if linear is None:
        return None
    lenses, poses = _decompose(linear.projections)
    pixels, truth = np.asarray(keypoints, np.float64), np.asarray(points3d, np.float64)
    found = []
    for view in range(pixels.shape[1]):
        known = np.isfinite(pixels[:, view]).all(-1) & np.isfinite(truth).all(-1)
        step = max(1, int(known.sum()) // MOST_POINTS)
        image, world = pixels[:, view][known][::step], truth[known][::step]
        lens = lenses[view] / lenses[view, 2, 2]
        first = Rotation.from_matrix(poses[view, :, :3]).as_rotvec()
        start = np.concatenate(
            (first, poses[view, :, 3], lens[[0, 1], [0, 1]], image.mean(0), np.zeros(5))
        )

        def residuals(numbers: Float64, world: Float64 = world, image: Float64 = image) -> Float64:
            off = (_distorted(numbers, world) - image).ravel()
            # Narrow views leave coefficients open: those of lenses are of the order of 1.
            return np.concatenate((off, numbers[10:]))

        scale = np.abs(start).clip(0.1)
        found.append(least_squares(residuals, start, loss="soft_l1", x_scale=scale, max_nfev=300).x)
    numbers = np.array(found)
    rotations = Rotation.from_rotvec(numbers[:, :3]).as_matrix()
    return TrueLenses(rotations, numbers[:, 3:6], numbers[:, 6:])


def _distorted(numbers: Float64, world: Float64) -> Float64:
    """Pixels (M, 2) of points: pose, focal lengths, centre, k1, k2, k3, p1, p2 (OpenCV's)."""
    camera = world @ Rotation.from_rotvec(numbers[:3]).as_matrix().T + numbers[3:6]
    x, y = camera[:, 0] / camera[:, 2], camera[:, 1] / camera[:, 2]
    k1, k2, k3, p1, p2 = numbers[10:]
    squared = x * x + y * y
    gain = 1 + squared * (k1 + squared * (k2 + squared * k3))
    bent = np.stack(
        (
            gain * x + 2 * p1 * x * y + p2 * (squared + 2 * x * x),
            gain * y + p1 * (squared + 2 * y * y) + 2 * p2 * x * y,
        ),
        1,
    )
    pixels: Float64 = numbers[6:8] * bent + numbers[8:10]
    return pixels


def miscalibrate(
    projections: Float64, part: Part, sigma: float, frames: int, metre: float, seed: int
) -> Float64:
    """Return projections (N, K, 3, 4) whose extrinsics or intrinsics are off, anew in each frame.

    Extrinsics: each camera is turned about its own centre by a rotation vector of standard
    deviation `sigma` radians along each axis, and its translation moved by `sigma` metres along
    each (`metre` of them in the unit of the truth). Intrinsics: both focal lengths and both
    coordinates of the principal point are multiplied by exp(e), e of standard deviation `sigma`.
    """
    rng = np.random.default_rng([seed, round(1000 * sigma), part == "intrinsics"])
    shape = (frames, len(projections))
    lenses, poses = (
        np.broadcast_to(array, (frames, *array.shape)) for array in _decompose(projections)
    )
    if part == "intrinsics":
        factors = np.exp(sigma * rng.standard_normal((*shape, 4)))
        lenses = lenses.copy()
        for place, (row, column) in enumerate(((0, 0), (1, 1), (0, 2), (1, 2))):
            lenses[..., row, column] *= factors[..., place]
    else:
        poses = rotations_from_vectors(sigma * rng.standard_normal((*shape, 3))) @ poses
        poses[..., 3] += sigma * metre * rng.standard_normal((*shape, 3))
    return lenses @ poses


def add_noise(keypoints: ArrayLike, sigma: float, seed: int) -> Float64:
    """Move every coordinate by Gaussian noise of `sigma` pixels."""
    pixels = np.asarray(keypoints, np.float64)
    rng = np.random.default_rng([seed, round(1000 * sigma)])
    return pixels + sigma * rng.standard_normal(pixels.shape)


def hide(keypoints: ArrayLike, share: float, seed: int) -> Float64:
    """Hide a share of the keypoints of every view, drawn one by one."""
    pixels = np.array(keypoints, np.float64)
    pixels[np.random.default_rng([seed, round(1000 * share)]).random(pixels.shape[:3]) < share] = (
        np.nan
    )
    return pixels


def scatter(
    keypoints: ArrayLike, share: float, sizes: Sequence[Size] | None, seed: int
) -> tuple[Float64, NDArray[np.bool_]]:
    """Place a share of the keypoints anywhere in their images, uniformly, drawn one by one.

    Return the keypoints and which (N, K, P) were placed. Those that are not detected stay so. An
    image of unknown size reaches from (0, 0) to the farthest keypoints.
    """
    pixels = np.array(keypoints, np.float64)
    rng = np.random.default_rng([seed, 72, round(1000 * share)])
    placed = np.isfinite(pixels).all(-1) & (rng.random(pixels.shape[:3]) < share)
    ends = np.nanmax(pixels, axis=(0, 2)) if sizes is None else np.array(sizes, np.float64)
    anywhere = rng.random(pixels.shape) * ends[:, None]  # (N, K, P, 2)
    pixels[placed] = anywhere[placed]
    return pixels, placed


def keep_few_views(keypoints: ArrayLike, shares: Sequence[float], seed: int) -> Float64:
    """Keep one view in a share of the frames, two in the next share, and so on, drawn at random."""
    pixels = np.array(keypoints, np.float64)
    frames, views = pixels.shape[:2]
    rng = np.random.default_rng([seed, 60])
    kept = rng.choice(np.arange(1, len(shares) + 1), frames, p=shares)  # (N,)
    order = rng.random((frames, views)).argsort(1).argsort(1)
    pixels[order >= kept[:, None]] = np.nan
    return pixels


def detect(keypoints: ArrayLike, share: float, seed: int) -> Float64:
    """Add errors like those of a detector, which loses a tenth of the views and of the keypoints.

    They are usually that `share` of the subject's root-mean-square radius in a view, more or less
    (40 %) by keypoint and view, with the tails of Student's t of 4 degrees of freedom.
    """
    pixels = np.array(keypoints, np.float64)
    rng = np.random.default_rng([seed, 70])
    size = np.sqrt(np.nanmean(np.nanvar(pixels, axis=2).sum(-1)))
    levels = share * size * np.exp(rng.normal(0, 0.4, pixels.shape[1:3]))[..., None]  # (K, P, 1)
    tails = np.sqrt(rng.chisquare(4, (*pixels.shape[:3], 1)) / 2)  # of variance 1
    pixels += levels / tails * rng.standard_normal(pixels.shape)
    pixels[rng.random(pixels.shape[:2]) < 0.1] = np.nan
    pixels[rng.random(pixels.shape[:3]) < 0.1] = np.nan
    return pixels


def swap_limbs(
    keypoints: ArrayLike, partners: NDArray[np.intp], share: float, seed: int
) -> Float64:
    """Take limbs for those of the other side in a share of the views, beside a little noise.

    In three of five such views these are all limbs, in the others a third of the `partners` (P,).
    The noise is 2 % of the subject's root-mean-square radius.
    """
    pixels = np.array(keypoints, np.float64)
    rng = np.random.default_rng([seed, 71])
    size = np.sqrt(np.nanmean(np.nanvar(pixels, axis=2).sum(-1)))
    pixels += 0.02 * size * rng.standard_normal(pixels.shape)
    limbs = np.flatnonzero(partners > np.arange(len(partners)))
    for n, k in np.argwhere(rng.random(pixels.shape[:2]) < share):
        some = limbs if rng.random() < 0.6 else rng.permutation(limbs)[: -(-len(limbs) // 3)]
        both = np.concatenate((some, partners[some]))
        pixels[n, k, both] = pixels[n, k, partners[both]]
    return pixels


def _linear(image: Float64, world: Float64) -> Float64:
    """Return the projection (3, 4) of least algebraic error, by normalised DLT."""
    to_image, to_world = _normaliser(image), _normaliser(world)
    x = _homogeneous(image) @ to_image.T
    points = _homogeneous(world) @ to_world.T
    zero = np.zeros_like(points)
    rows = np.concatenate(
        (
            np.concatenate((points, zero, -x[:, :1] * points), -1),
            np.concatenate((zero, points, -x[:, 1:2] * points), -1),
        )
    )
    solution = np.linalg.eigh(rows.T @ rows)[1][:, 0].reshape(3, 4)
    projection: Float64 = np.linalg.inv(to_image) @ solution @ to_world
    # Points in front of the camera have a positive depth.
    depth = _homogeneous(world) @ projection[2]
    projection *= np.sign(np.median(depth)) / np.linalg.norm(projection[2, :3])
    return projection


def _normaliser(points: Float64) -> Float64:
    """Return what moves points (N, D) to mean 0 and mean square radius D."""
    mean, count = points.mean(0), points.shape[1]
    scale = np.sqrt(count / np.square(points - mean).sum(-1).mean())
    matrix = np.eye(count + 1)
    matrix[:count] *= scale
    matrix[:count, count] = -scale * mean
    return matrix


def _homogeneous(points: Float64) -> Float64:
    return np.concatenate((points, np.ones((*points.shape[:-1], 1))), -1)


def _project(projection: Float64, world: Float64) -> Float64:
    image = _homogeneous(world) @ projection.T
    pixels: Float64 = image[..., :2] / image[..., 2:]
    return pixels


def _decompose(projections: Float64) -> tuple[Float64, Float64]:
    """Return lenses (K, 3, 3), upper triangular with positive diagonal, and poses (K, 3, 4)."""
    flipped = projections[:, ::-1, :3].mT  # RQ of a matrix is QR of its flipped transpose
    q, r = np.linalg.qr(flipped)
    lenses, rotations = r.mT[:, ::-1, ::-1], q.mT[:, ::-1]
    signs = np.sign(np.diagonal(lenses, axis1=1, axis2=2))
    lenses, rotations = lenses * signs[:, None], rotations * signs[..., None]
    translations = np.linalg.solve(lenses, projections[..., 3:])
    return lenses, np.concatenate((rotations, translations), -1)
