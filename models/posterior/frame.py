"""The posterior of one frame, linearised at its answer and eliminated; compiled.

The factors are, with robust weights w and everything in the canonical frame of reference:

- keypoints, `u_kp = pi(theta_k, X_p) + noise`, the noise white with variance 1 / w_kp;
- structures, `X = S(mu + B z + e)`, `e_p ~ N(0, eta_p^2)`, `z ~ N(0, 1)`, where S is a similarity
  that is free if cameras that are static relative to each other see the subject;
- a pose of its own, free, for every other camera;
- the numbers theta of the cameras that all frames share, `theta ~ N(0, L L^T)`.

Points are eliminated first, then the other unknowns y of the frame (the similarity, z, and poses).
With A_p and W_p what keypoints say of X_p and of X_p with theta, c_p the coupling of X_p and y,
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


class FrameCovariance(NamedTuple):
    """Covariances of P points: `own` in blocks, and what points share as modes M M^T."""

    own: Float64  # (P, 3, 3) V
    modes: Float64  # (P, 3, R) of y; the points' covariance given theta is V + M M^T
    by_cameras: Float64  # (P, 3, T) G L
    poses_by_cameras: Float64  # (R, T) H^-1 times the coupling: how y follows, for scores


@inner
def unknowns_of(cameras: FrameCameras, shapes: ShapeFactor) -> int:
    """Return R: numbers of the similarity if any view is joined, of z, and of other poses."""
    apart, joined = 0, 0
    for k in range(len(cameras.joined)):
        if cameras.joined[k]:
            joined = SIMILARITY
        else:
            apart += EXTRINSICS
    return joined + shapes.columns.shape[2] + apart


@inner
def covariance_of_frame(
    points: Float64, cameras: FrameCameras, views: Views, shapes: ShapeFactor, out: FrameCovariance
) -> bool:
    """Write the covariances of a frame; False, and NaN, where they are not determined.

    `views.weights` (K, P) are inverse variances, 0 where a keypoint is not used.
    """
    count, size, shared = len(points), out.modes.shape[2], cameras.factor.shape[2]
    system, coupled = np.zeros((size, size)), np.zeros((size, shared))
    middle, radius = np.zeros(3), 0.0
    for p in range(count):
        for i in range(3):
            middle[i] += points[p, i] / count
    for p in range(count):
        for i in range(3):
            radius += (points[p, i] - middle[i]) ** 2 / count
    for a in range(size):
        system[a, a] = LEAST_PRECISION / radius
    first = _similarity_columns(cameras)
    for q in range(shapes.columns.shape[2]):
        system[first + q, first + q] += 1.0
    coupling, information = np.empty((3, size)), np.empty((3, 3))
    lasting = np.empty((3, shared))
    for p in range(count):
        fill(coupling, 0.0)
        fill(information, 0.0)
        fill(lasting, 0.0)
        _add_shape(points[p], middle, shapes, p, first, information, coupling, system)
        for k in range(len(cameras.joined)):
            if views.weights[k, p] > 0:
                _add_keypoint(
                    points[p], cameras, k, views.weights[k, p],
                    information, coupling, system, lasting, coupled,
                )  # fmt: skip
        inverse_symmetric(information, 0.0, out.own[p])
        for i in range(3):
            for a in range(size):
                out.modes[p, i, a] = 0.0
                for j in range(3):
                    out.modes[p, i, a] += out.own[p, i, j] * coupling[j, a]
            for t in range(shared):
                out.by_cameras[p, i, t] = 0.0
                for j in range(3):
                    out.by_cameras[p, i, t] -= out.own[p, i, j] * lasting[j, t]
        for a in range(size):
            for i in range(3):
                for b in range(a + 1):
                    system[a, b] -= coupling[i, a] * out.modes[p, i, b]
                for t in range(shared):
                    coupled[a, t] += coupling[i, a] * out.by_cameras[p, i, t]
    if not cholesky(system):
        fill(out.own, np.nan)
        fill(out.modes, np.nan)
        fill(out.by_cameras, np.nan)
        fill(out.poses_by_cameras, np.nan)
        return False
    solved = np.empty(size)
    for t in range(shared):
        for a in range(size):
            solved[a] = coupled[a, t]
        cholesky_solve(system, solved)
        for a in range(size):
            out.poses_by_cameras[a, t] = -solved[a]
    for p in range(count):
        for i in range(3):
            row = out.modes[p, i]
            for t in range(shared):
                for a in range(size):
                    out.by_cameras[p, i, t] -= row[a] * out.poses_by_cameras[a, t]
            for a in range(size):  # from V c to V c L^-T
                total = row[a]
                for b in range(a):
                    total -= system[a, b] * row[b]
                row[a] = total / system[a, a]
    return True


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
    information: Float64,
    coupling: Float64,
    system: Float64,
) -> None:
    """Add the factor of a point's shape: X - S(mu + B z) of variance eta^2 in each direction."""
    weight, count = 1.0 / shapes.variances[p], shapes.columns.shape[2]
    columns = np.zeros((3, first + count))
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
    information: Float64,
    coupling: Float64,
    system: Float64,
    lasting: Float64,
    coupled: Float64,
) -> None:
    """Add the factor of a keypoint, by the point, the view's own pose, and the shared numbers."""
    by_point, by_numbers = np.empty((2, 3)), np.empty((2, VIEW))
    differentiate_keypoint_into(point, cameras, k, by_point, by_numbers)
    shared = lasting.shape[1]
    by_shared = np.zeros((2, shared))
    numbers = VIEW if cameras.joined[k] else LENS
    for a in range(2):
        for number in range(numbers):
            for t in range(shared):
                by_shared[a, t] += by_numbers[a, number] * cameras.factor[k, number, t]
    for a in range(2):
        for i in range(3):
            left = weight * by_point[a, i]
            for j in range(3):
                information[i, j] += left * by_point[a, j]
            for t in range(shared):
                lasting[i, t] += left * by_shared[a, t]
    if cameras.joined[k]:
        return
    own = pose_columns(cameras, k, coupling.shape[1])
    for a in range(2):
        for number in range(EXTRINSICS):
            by_pose = weight * by_numbers[a, LENS + number]
            for i in range(3):
                coupling[i, own + number] += by_pose * by_point[a, i]
            for other in range(number + 1):
                system[own + number, own + other] += by_pose * by_numbers[a, LENS + other]
            for t in range(shared):
                coupled[own + number, t] += by_pose * by_shared[a, t]


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
    point: Float64, cameras: FrameCameras, k: int, by_point: Float64, by_numbers: Float64
) -> None:
    """Write the derivatives of a pixel by the point (2, 3) and by the view's numbers (2, 11).

    A rotation vector turns the camera's axes about the origin of the rig, or about the middle of
    the structure where the view is not joined; translations are in units of the rig.
    """
    camera, turned, pixel = np.empty(3), np.empty(3), np.empty(2)
    by_camera, by_lens = np.empty((2, 3)), np.empty((2, LENS))
    growth = cameras.growth if cameras.joined[k] else 1.0
    for i in range(3):
        camera[i] = cameras.translations[k, i]
        for j in range(3):
            camera[i] += cameras.rotations[k, i, j] * point[j]
        turned[i] = camera[i]
        turned[i] -= cameras.offsets[k, i] if cameras.joined[k] else cameras.translations[k, i]
    differentiate_into(camera, cameras.lenses, k, pixel, by_camera, by_lens)
    for a in range(2):
        x, y, z = by_camera[a, 0], by_camera[a, 1], by_camera[a, 2]
        for j in range(3):
            by_point[a, j] = 0.0
            for i in range(3):
                by_point[a, j] += by_camera[a, i] * cameras.rotations[k, i, j]
        for number in range(LENS):
            by_numbers[a, number] = by_lens[a, number]
        by_numbers[a, LENS] = z * turned[1] - y * turned[2]
        by_numbers[a, LENS + 1] = x * turned[2] - z * turned[0]
        by_numbers[a, LENS + 2] = y * turned[0] - x * turned[1]
        by_numbers[a, LENS + 3] = growth * x
        by_numbers[a, LENS + 4] = growth * y
        by_numbers[a, LENS + 5] = growth * z
