"""The data and unknowns of bundle adjustment, as named arrays that compiled functions take.

Every frame has a structure X (P, 3) with a Gaussian shape prior, and every *group* of cameras has
a similarity per frame, `v = e^a R X + t`. Cameras that are static relative to each other form a
group and see it through extrinsics that all frames share, `x_cam = C v + d`. A moving camera is a
group of one, with C = 1 and d = 0. So a static rig, moving cameras and any mixture of the two are
one problem.

The images of a moving view may be *stretched*: a detector resizes its boxes to one shape, in each
frame by another factor along x than along y. Then `v = diag(e^a, 1, 1) (R X + t)`.

Everything is float64: N frames, K views, P keypoints, G groups, Q components of the shape prior.
Compiled functions of one frame take the same tuples without the leading N.
"""

import math
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from models.numerics.compiled import inner
from models.optics.lenses.projection import Lenses

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
Tuple = TypeVar("Tuple", bound=NamedTuple)

SIMILARITY = 7  # directions in which shifts, rotations and scale move a structure
POSE = 7  # unknowns of a group in a frame: rotation vector, translation, log size
LENS = 5  # of a lens: log focal length, principal point (x, y), first two radial coefficients
EXTRINSICS = 6  # of a camera in its group: rotation vector, translation
VIEW = LENS + EXTRINSICS  # numbers of a view that all frames share
FOCAL, CENTRE_X, CENTRE_Y, RADIAL, RADIAL_2 = range(LENS)  # places among a view's eleven numbers

SIZE_SD = 0.3  # of the log size of a subject from frame to frame, seen by static cameras
STRETCH_SD = 0.3  # of the log stretch of an image from frame to frame: subjects spread their arms
FIXED = 1e8  # inverse variance of numbers that are held


class Views(NamedTuple):
    """Keypoints and their weights."""

    keypoints: Float64  # (N, K, P, 2) pixels, any finite number where the weight is 0
    weights: Float64  # (N, K, P) confidence over noise variance, 1 / pixels^2

    def of(self, frames: Int64 | slice) -> "Views":
        """Return the keypoints of some of the frames."""
        return Views(*(array[frames] for array in self))


class Rig(NamedTuple):
    """The numbers of K views that all frames share; see `make_rig`."""

    lenses: Lenses
    groups: Int64  # (K,) the group of each view, 0 to G - 1
    rotations: Float64  # (K, 3, 3) C, group to camera
    translations: Float64  # (K, 3) d, units of the structure
    size_precision: Float64  # (G,) inverse variance of the log size or stretch a of each group
    stretched: NDArray[np.bool_]  # (K,) moving views with another stretch in each frame

    @property
    def group_count(self) -> int:
        """The number of groups G."""
        return len(self.size_precision)

    @property
    def members(self) -> Int64:
        """How many views each group has, (G,)."""
        return np.bincount(self.groups, minlength=self.group_count)

    @property
    def static(self) -> NDArray[np.bool_]:
        """Which views (K,) are static relative to another."""
        return self.members[self.groups] > 1


class ShapePrior(NamedTuple):
    """Gaussian about a mean per frame: x = mean + s (B z + e), z ~ N(0, 1), e ~ N(0, spread^2).

    With `heavy` tails the scale of a frame may be larger than s, if its structure fits that better:
    the density is the profile of the Gaussian over all scales from s on. See `make_shape_prior`.
    """

    means: Float64  # (N, P, 3)
    basis: Float64  # (3 P, Q) B, columns scaled by their standard deviations
    inner: Float64  # (Q, Q) B^T B + spread^2 1
    factor: Float64  # (Q, Q) its Cholesky factor, lower
    spread: float
    scale: float  # s
    heavy: bool

    def of(self, frames: Int64 | slice) -> "ShapePrior":
        """Return the prior of some of the frames."""
        return self._replace(means=self.means[frames])


class Scene(NamedTuple):
    """The unknowns of N frames."""

    points: Float64  # (N, P, 3)
    rotations: Float64  # (N, G, 3, 3) R
    translations: Float64  # (N, G, 3) t
    sizes: Float64  # (N, G) log size a, or log stretch of a view that is stretched

    def of(self, frames: Int64 | slice) -> "Scene":
        """Return the unknowns of some of the frames."""
        return Scene(*(array[frames] for array in self))


def make_rig(
    lenses: Lenses,
    groups: Int64,
    rotations: Float64,
    translations: Float64,
    stretched: NDArray[np.bool_] | None = None,
) -> Rig:
    """Lay out a rig for compiled functions.

    If several views see a group, its size varies from frame to frame by `SIZE_SD`. With one view
    the size is held, because only its ratio to the distance is determined; if its images are
    `stretched` (K,), that number is the stretch and varies by `STRETCH_SD`.
    """
    members = np.bincount(groups)
    alone: NDArray[np.bool_] = members[groups] == 1
    stretched = alone & (False if stretched is None else stretched)
    precision = np.where(members > 1, 1 / SIZE_SD**2, FIXED)
    precision[groups[stretched]] = 1 / STRETCH_SD**2
    return Rig(
        contiguous(lenses),
        np.ascontiguousarray(groups),
        np.ascontiguousarray(rotations),
        np.ascontiguousarray(translations),
        precision,
        np.ascontiguousarray(stretched),
    )


def moving_rig(lenses: Lenses, stretched: NDArray[np.bool_] | None = None) -> Rig:
    """Return the rig in which every view is a separate group."""
    views = len(lenses.focals)
    poses = np.tile(np.eye(3), (views, 1, 1)), np.zeros((views, 3))
    return make_rig(lenses, np.arange(views), *poses, stretched)


def make_shape_prior(
    means: Float64, basis: Float64, spread: float, *, scale: float = 1.0, heavy: bool = False
) -> ShapePrior:
    """Lay out a shape prior about `means` (N, P, 3), with `basis` (P, 3, Q)."""
    flat = np.ascontiguousarray(basis.reshape(3 * len(basis), basis.shape[-1]))
    inner_products: Float64 = flat.T @ flat + spread**2 * np.eye(flat.shape[1])
    return ShapePrior(
        np.ascontiguousarray(means),
        flat,
        inner_products,
        np.asarray(np.linalg.cholesky(inner_products), np.float64),
        spread,
        scale,
        heavy,
    )


def contiguous(arrays: Tuple) -> Tuple:
    """Return named arrays laid out in C order, as compiled functions need them."""
    laid_out: Any = map(np.ascontiguousarray, arrays)
    return type(arrays)._make(laid_out)


def points_in_cameras(scene: Scene, rig: Rig) -> Float64:
    """Return the points in every camera's frame (N, K, P, 3)."""
    turned = scene.points[:, None] @ scene.rotations.mT  # (N, G, P, 3)
    scales = np.exp(scene.sizes)[:, rig.groups, None]  # (N, K, 1)
    grown = np.where(rig.stretched[:, None], 1.0, scales)[..., None] * turned[:, rig.groups]
    held = grown + scene.translations[:, rig.groups, None]  # v, (N, K, P, 3)
    held[..., 0] *= np.where(rig.stretched[:, None], scales, 1.0)
    points: Float64 = held @ rig.rotations.mT + rig.translations[:, None]
    return points


def views_apart(scene: Scene, rig: Rig) -> Scene:
    """Return the same scene with a group for each view, in units of each frame's structure."""
    stretches = np.where(rig.stretched, scene.sizes[:, rig.groups], 0.0)
    sizes = np.exp(scene.sizes[:, rig.groups] - stretches)[..., None]
    held = scene.translations[:, rig.groups]  # (N, K, 3)
    shifts = np.einsum("kij,nkj->nki", rig.rotations, held) + rig.translations
    rotations = rig.rotations @ scene.rotations[:, rig.groups]
    return Scene(scene.points, rotations, shifts / sizes, stretches)


@inner
def views_of_frame(views: Views, n: int) -> Views:
    """Return keypoints and weights of frame n: (K, P, 2) and (K, P)."""
    return Views(views.keypoints[n], views.weights[n])


@inner
def prior_of_frame(prior: ShapePrior, n: int) -> ShapePrior:
    """Return the prior of frame n: its mean is (P, 3)."""
    return ShapePrior(
        prior.means[n],
        prior.basis,
        prior.inner,
        prior.factor,
        prior.spread,
        prior.scale,
        prior.heavy,
    )


@inner
def scene_of_frame(scene: Scene, n: int) -> Scene:
    """Return the unknowns of frame n: (P, 3), (G, 3, 3), (G, 3) and (G,)."""
    return Scene(scene.points[n], scene.rotations[n], scene.translations[n], scene.sizes[n])


@inner
def prior_about(prior: ShapePrior, mean: Float64, scale: float) -> ShapePrior:
    """Return a frame's prior with another mean (P, 3) and scale."""
    return ShapePrior(
        mean, prior.basis, prior.inner, prior.factor, prior.spread, scale, prior.heavy
    )


@inner
def stretch_x(rotation: Float64, translation: Float64, factor: float) -> None:
    """Multiply a camera's x axis, (3, 3) and (3,), by a factor."""
    for j in range(3):
        rotation[0, j] *= factor
    translation[0] *= factor


@inner
def stretch_of(rotation: Float64) -> float:
    """Return the length of a camera's x axis (3, 3)."""
    return math.sqrt(rotation[0, 0] ** 2 + rotation[0, 1] ** 2 + rotation[0, 2] ** 2)
