"""The posterior of one frame, linearised at its answer and eliminated; compiled.

The factors are, with robust weights w and everything in the canonical frame of reference:

- keypoints, `u_kp = pi(theta_k, X_p) + noise`, the noise white with variance 1 / w_kp;
- structures, `X = S(mu + B z + e)`, `e_p ~ N(0, eta_p^2)`, `z ~ N(0, 1)`, where S is a similarity
  that is free if cameras that are static relative to each other see the subject;
- a pose of its own, free, for every other camera;
- the numbers theta of the cameras that all frames share, `theta ~ N(0, L L^T)`.

Points are eliminated first, then the other unknowns y of the frame (the similarity, z, and poses).
With A_p the information of keypoints on X_p, W_p that on X_p and theta together, c_p the coupling
of X_p and y,
V_p = (A_p + 1 / eta_p^2)^-1 and H = O - sum c_p^T V_p c_p:

    Cov X_p = V_p + (V_p c_p) H^-1 (V_p c_p)^T + G_p Sigma_theta G_p^T
    G_p = -V_p W_p + V_p c_p H^-1 (O_theta - sum c_q^T V_q W_q)

(Triggs et al., *Bundle adjustment, a modern synthesis*, 2000, sec. 6.1 and 9.)
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle.problem import EXTRINSICS, LENS, VIEW, Views
from models.numerics.compiled import inner
from models.numerics.matrices import cholesky, cholesky_solve, fill, inverse_symmetric
from models.optics.lenses.projection import Lenses, differentiate_into

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

SIMILARITY = 7  # numbers of a similarity: translation, rotation vector, log size
LEAST_PRECISION = 1e-6  # of unknowns that nothing determines, over the square of the frame's size


class FrameCameras(NamedTuple):
    """The cameras of K views in one frame: x_cam = R X + t, in units of the structure X."""

    rotations: Float64  # (K, 3, 3)
    translations: Float64  # (K, 3)
    lenses: Lenses
    joined: Bool  # (K,) whether the pose is that of a static rig, which all frames share
    offsets: Float64  # (K, 3) of a joined view, from the rig to its camera, units of the structure
    growth: float  # units of the structure in a unit of the rig
    factor: Float64  # (K, 11, T) rows of L; see `models.bundle.problem.VIEW` for the numbers


class ShapeFactor(NamedTuple):
    """What is known of structures, at the answer (P, 3) of one frame."""

    columns: Float64  # (P, 3, Q) B, turned and scaled as the answer
    variances: Float64  # (P,) eta^2


class Slopes(NamedTuple):
    """A pixel and its derivatives, and buffers."""

    pixel: Float64  # (2,)
    by_point: Float64  # (2, 3)
    by_numbers: Float64  # (2, 11)
    by_shared: Float64  # (2, T)
    camera: Float64  # (3,)
    by_camera: Float64  # (2, 3)
    by_lens: Float64  # (2, 5)


@inner
def make_slopes(shared: int) -> Slopes:
    """Return buffers, for so many directions of the shared cameras."""
    return Slopes(
        np.empty(2),
        np.empty((2, 3)),
        np.empty((2, VIEW)),
        np.empty((2, shared)),
        np.empty(3),
        np.empty((2, 3)),
        np.empty((2, LENS)),
    )


class _Equations(NamedTuple):
    """The equations of a point, R unknowns y of the frame, and T directions of the cameras."""

    information: Float64  # (3, 3) A + 1 / eta^2
    coupling: Float64  # (3, R) c
    system: Float64  # (R, R) O, then H; its lower half
    lasting: Float64  # (3, T) W L
    coupled: Float64  # (R, T) of y and L


class FrameCovariance(NamedTuple):
    """Covariances of P points: `own` in blocks, and what points share as modes M M^T."""

    own: Float64  # (P, 3, 3) V
    modes: Float64  # (P, 3, R) of y; the points' covariance given theta is V + M M^T
    by_cameras: Float64  # (P, 3, T) G L
    unknowns_by_cameras: Float64  # (R, T) how y follows L


@inner
def unknowns_of(cameras: FrameCameras, shapes: ShapeFactor) -> int:
    """Return R: numbers of the similarity if any view is joined, of z, and of other poses."""
    size: int = _similarity_columns(cameras) + shapes.columns.shape[2]
    for joined in cameras.joined:
        if not joined:
            size += EXTRINSICS
    return size


@inner
def covariance_of_frame(
    points: Float64, cameras: FrameCameras, views: Views, shapes: ShapeFactor, out: FrameCovariance
) -> bool:
    """Write the covariances of a frame; False, and NaN, where they are not determined.

    `views.weights` (K, P) are inverse variances, 0 where a keypoint is not used.
    """
    size, shared = out.modes.shape[2], cameras.factor.shape[2]
    equations = _Equations(
        np.empty((3, 3)),
        np.empty((3, size)),
        np.zeros((size, size)),
        np.empty((3, shared)),
        np.zeros((size, shared)),
    )
    first, slopes = _similarity_columns(cameras), make_slopes(shared)
    middle, columns = middle_of(points), np.empty((3, size))
    _begin(points, middle, first, shapes.columns.shape[2], equations.system)
    for p in range(len(points)):
        fill(equations.coupling, 0.0)
        fill(equations.information, 0.0)
        fill(equations.lasting, 0.0)
        _add_shape(points[p], middle, shapes, p, first, equations, columns)
        for k in range(len(cameras.joined)):
            if views.weights[k, p] > 0:
                _add_keypoint(points[p], cameras, k, views.weights[k, p], equations, slopes)
        _eliminate(equations, out.own[p], out.modes[p], out.by_cameras[p])
    if not cholesky(equations.system):
        for array in (out.own, out.modes, out.by_cameras):
            fill(array, np.nan)
        return False
    _carry(equations, out)
    return True


@inner
def middle_of(points: Float64) -> Float64:
    """Return the mean (3,) of points (P, 3)."""
    middle = np.zeros(3)
    for p in range(len(points)):
        for i in range(3):
            middle[i] += points[p, i] / len(points)
    return middle


@inner
def _begin(points: Float64, middle: Float64, first: int, count: int, system: Float64) -> None:
    """Write what is known of y before any keypoint: z is white, all else hardly known."""
    squared = 0.0
    for p in range(len(points)):
        for i in range(3):
            squared += (points[p, i] - middle[i]) ** 2 / len(points)
    for a in range(len(system)):
        system[a, a] = LEAST_PRECISION / squared
        if first <= a < first + count:
            system[a, a] += 1.0


@inner
def _eliminate(equations: _Equations, own: Float64, modes: Float64, by_cameras: Float64) -> None:
    """Take a point out of the equations; write V, V c and -V W."""
    information, coupling, system, lasting, coupled = equations
    size, shared = len(system), lasting.shape[1]
    inverse_symmetric(information, 0.0, own)
    for i in range(3):
        for a in range(size):
            modes[i, a] = 0.0
            for j in range(3):
                modes[i, a] += own[i, j] * coupling[j, a]
        for t in range(shared):
            by_cameras[i, t] = 0.0
            for j in range(3):
                by_cameras[i, t] -= own[i, j] * lasting[j, t]
    for a in range(size):
        for i in range(3):
            for b in range(a + 1):
                system[a, b] -= coupling[i, a] * modes[i, b]
            for t in range(shared):
                coupled[a, t] += coupling[i, a] * by_cameras[i, t]


@inner
def _carry(equations: _Equations, out: FrameCovariance) -> None:
    """Let y follow the cameras, and points follow y; the system is factorised."""
    system, coupled = equations.system, equations.coupled
    size, shared = coupled.shape
    solved = np.empty(size)
    for t in range(shared):
        for a in range(size):
            solved[a] = coupled[a, t]
        cholesky_solve(system, solved)
        for a in range(size):
            out.unknowns_by_cameras[a, t] = -solved[a]
    for p in range(len(out.own)):
        for i in range(3):
            row = out.modes[p, i]
            for a in range(size):
                for t in range(shared):
                    out.by_cameras[p, i, t] -= row[a] * out.unknowns_by_cameras[a, t]
            for a in range(size):  # from V c to V c L^-T
                total = row[a]
                for b in range(a):
                    total -= system[a, b] * row[b]
                row[a] = total / system[a, a]


@inner
def _similarity_columns(cameras: FrameCameras) -> int:
    """Return how many columns a similarity has, which come first: 7, or 0 if no view is joined."""
    for k in range(len(cameras.joined)):
        if cameras.joined[k]:
            return SIMILARITY
    return 0


@inner
def _add_shape(
    point: Float64,
    middle: Float64,
    shapes: ShapeFactor,
    p: int,
    first: int,
    equations: _Equations,
    columns: Float64,
) -> None:
    """Add the factor of a point's shape: X - S(mu + B z) of variance eta^2 in each direction.

    `columns` (3, R) is a buffer.
    """
    information, coupling, system = equations.information, equations.coupling, equations.system
    weight, count = 1.0 / shapes.variances[p], shapes.columns.shape[2]
    fill(columns, 0.0)
    if first:
        x, y, z = point[0] - middle[0], point[1] - middle[1], point[2] - middle[2]
        columns[0, 0], columns[1, 1], columns[2, 2] = 1.0, 1.0, 1.0
        columns[0, 4], columns[0, 5] = z, -y
        columns[1, 3], columns[1, 5] = -z, x
        columns[2, 3], columns[2, 4] = y, -x
        columns[0, 6], columns[1, 6], columns[2, 6] = x, y, z
    for i in range(3):
        for q in range(count):
            columns[i, first + q] = shapes.columns[p, i, q]
        information[i, i] += weight
        for a in range(first + count):
            coupling[i, a] -= weight * columns[i, a]
            for b in range(a + 1):
                system[a, b] += weight * columns[i, a] * columns[i, b]


@inner
def _add_keypoint(
    point: Float64,
    cameras: FrameCameras,
    k: int,
    weight: float,
    equations: _Equations,
    slopes: Slopes,
) -> None:
    """Add the factor of a keypoint, by the point, the view's own pose, and the shared numbers."""
    information, lasting, by_shared = equations.information, equations.lasting, slopes.by_shared
    differentiate_keypoint_into(point, cameras, k, slopes)
    for a in range(2):
        for t in range(lasting.shape[1]):
            by_shared[a, t] = 0.0
        for number in range(VIEW if cameras.joined[k] else LENS):
            for t in range(lasting.shape[1]):
                by_shared[a, t] += slopes.by_numbers[a, number] * cameras.factor[k, number, t]
        for i in range(3):
            left = weight * slopes.by_point[a, i]
            for j in range(3):
                information[i, j] += left * slopes.by_point[a, j]
            for t in range(lasting.shape[1]):
                lasting[i, t] += left * by_shared[a, t]
        if not cameras.joined[k]:
            own = pose_columns(cameras, k, len(equations.system))
            _add_pose(own, weight, slopes, a, equations)


@inner
def _add_pose(own: int, weight: float, slopes: Slopes, a: int, equations: _Equations) -> None:
    """Add coordinate `a` of a keypoint by the pose whose columns of y begin at `own`."""
    for number in range(EXTRINSICS):
        by_pose = weight * slopes.by_numbers[a, LENS + number]
        for i in range(3):
            equations.coupling[i, own + number] += by_pose * slopes.by_point[a, i]
        for other in range(number + 1):
            by_other = slopes.by_numbers[a, LENS + other]
            equations.system[own + number, own + other] += by_pose * by_other
        for t in range(slopes.by_shared.shape[1]):
            equations.coupled[own + number, t] += by_pose * slopes.by_shared[a, t]


@inner
def pose_columns(cameras: FrameCameras, k: int, size: int) -> int:
    """Return the first of the six columns of y for the pose of a view that is not joined."""
    later = 0
    for other in range(k, len(cameras.joined)):
        if not cameras.joined[other]:
            later += EXTRINSICS
    return size - later


@inner
def differentiate_keypoint_into(
    point: Float64, cameras: FrameCameras, k: int, slopes: Slopes
) -> None:
    """Write a pixel, and its derivatives by the point and by the view's numbers.

    A rotation vector turns the camera's axes about the origin of the rig, or about the middle of
    the structure where the view is not joined; translations are in units of the rig.
    """
    camera, by_camera, by_numbers = slopes.camera, slopes.by_camera, slopes.by_numbers
    rotation, joined = cameras.rotations[k], cameras.joined[k]
    growth = cameras.growth if joined else 1.0
    for i in range(3):
        camera[i] = cameras.translations[k, i]
        for j in range(3):
            camera[i] += rotation[i, j] * point[j]
    differentiate_into(camera, cameras.lenses, k, slopes.pixel, by_camera, slopes.by_lens)
    for i in range(3):  # what turns with the camera
        camera[i] -= cameras.offsets[k, i] if joined else cameras.translations[k, i]
    for a in range(2):
        x, y, z = by_camera[a, 0], by_camera[a, 1], by_camera[a, 2]
        for j in range(3):
            slopes.by_point[a, j] = x * rotation[0, j] + y * rotation[1, j] + z * rotation[2, j]
        for number in range(LENS):
            by_numbers[a, number] = slopes.by_lens[a, number]
        by_numbers[a, LENS] = z * camera[1] - y * camera[2]
        by_numbers[a, LENS + 1] = x * camera[2] - z * camera[0]
        by_numbers[a, LENS + 2] = y * camera[0] - x * camera[1]
        by_numbers[a, LENS + 3] = growth * x
        by_numbers[a, LENS + 4] = growth * y
        by_numbers[a, LENS + 5] = growth * z
