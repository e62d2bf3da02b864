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

from models.bundle.problem import EXTRINSICS, LENS, SIMILARITY, VIEW
from models.numerics.compiled import inner
from models.numerics.matrices import cholesky, cholesky_solve, fill, inverse_symmetric
from models.optics.lenses.projection import Lenses, differentiate_into

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

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
    """Pixels of P points in K views, and their derivatives; any numbers where a weight is 0."""

    pixels: Float64  # (K, P, 2)
    by_point: Float64  # (K, P, 2, 3)
    by_numbers: Float64  # (K, P, 2, 11) by the view's numbers
    by_shared: Float64  # (K, P, 2, T) by directions of the shared cameras


@inner
def make_slopes(views: int, points: int, shared: int) -> Slopes:
    """Return room for the slopes of one frame after the other."""
    return Slopes(
        np.empty((views, points, 2)),
        np.empty((views, points, 2, 3)),
        np.empty((views, points, 2, VIEW)),
        np.empty((views, points, 2, shared)),
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
    points: Float64,
    cameras: FrameCameras,
    weights: Float64,
    shapes: ShapeFactor,
    slopes: Slopes,
    out: FrameCovariance,
) -> bool:
    """Write the slopes and covariances of a frame; False, and NaN, where they are not determined.

    `weights` (K, P) are inverse variances, 0 where a keypoint is not used.
    """
    size, shared = out.modes.shape[2], cameras.factor.shape[2]
    equations = _Equations(
        np.empty((3, 3)),
        np.empty((3, size)),
        np.zeros((size, size)),
        np.empty((3, shared)),
        np.zeros((size, shared)),
    )
    first, middle, columns = _similarity_columns(cameras), middle_of(points), np.empty((3, size))
    _linearise(points, cameras, weights, slopes)
    _begin(points, middle, first, shapes.columns.shape[2], equations.system)
    for p in range(len(points)):
        fill(equations.coupling, 0.0)
        fill(equations.information, 0.0)
        fill(equations.lasting, 0.0)
        _add_shape(points[p], middle, shapes, p, first, equations, columns)
        _add_keypoints(p, cameras, weights, equations, slopes)
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
        x, y, z = coupling[0, a], coupling[1, a], coupling[2, a]
        for b in range(a + 1):
            system[a, b] -= x * modes[0, b]
            system[a, b] -= y * modes[1, b]
            system[a, b] -= z * modes[2, b]
        for t in range(shared):
            coupled[a, t] += x * by_cameras[0, t]
            coupled[a, t] += y * by_cameras[1, t]
            coupled[a, t] += z * by_cameras[2, t]


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
    modes, by_cameras, follow = out.modes, out.by_cameras, out.unknowns_by_cameras
    upper = system.T.copy()
    for p in range(len(modes)):
        for i in range(3):
            for t in range(shared):
                total = by_cameras[p, i, t]
                for a in range(size):
                    total -= modes[p, i, a] * follow[a, t]
                by_cameras[p, i, t] = total
            for a in range(size):  # from V c to V c L^-T
                modes[p, i, a] /= system[a, a]
                for b in range(a + 1, size):
                    modes[p, i, b] -= modes[p, i, a] * upper[a, b]


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
    information, coupling, system, _, _ = equations
    basis, size = shapes.columns, first + shapes.columns.shape[2]
    weight = 1.0 / shapes.variances[p]
    fill(columns, 0.0)
    if first:
        x, y, z = point[0] - middle[0], point[1] - middle[1], point[2] - middle[2]
        columns[0, 0], columns[1, 1], columns[2, 2] = 1.0, 1.0, 1.0
        columns[0, 4], columns[0, 5] = z, -y
        columns[1, 3], columns[1, 5] = -z, x
        columns[2, 3], columns[2, 4] = y, -x
        columns[0, 6], columns[1, 6], columns[2, 6] = x, y, z
    for i in range(3):
        information[i, i] += weight
        for a in range(first, size):
            columns[i, a] = basis[p, i, a - first]
        for a in range(size):
            coupling[i, a] -= weight * columns[i, a]
    for a in range(size):
        x, y, z = weight * columns[0, a], weight * columns[1, a], weight * columns[2, a]
        for b in range(a + 1):
            system[a, b] += x * columns[0, b]
            system[a, b] += y * columns[1, b]
            system[a, b] += z * columns[2, b]


@inner
def _add_keypoints(
    p: int, cameras: FrameCameras, weights: Float64, equations: _Equations, slopes: Slopes
) -> None:
    """Add a point's keypoints, by the point, the views' own poses, and the shared numbers."""
    information, coupling, system, lasting, coupled = equations
    _, by_point, by_numbers, by_shared = slopes
    joined, shared = cameras.joined, lasting.shape[1]
    for k in range(len(weights)):
        weight = weights[k, p]
        if not weight > 0:
            continue
        own = pose_columns(joined, k, len(system))
        for a in range(2):
            for i in range(3):
                left = weight * by_point[k, p, a, i]
                for j in range(3):
                    information[i, j] += left * by_point[k, p, a, j]
                for t in range(shared):
                    lasting[i, t] += left * by_shared[k, p, a, t]
            for number in range(0 if joined[k] else EXTRINSICS):
                by_pose = weight * by_numbers[k, p, a, LENS + number]
                for i in range(3):
                    coupling[i, own + number] += by_pose * by_point[k, p, a, i]
                for other in range(number + 1):
                    by_other = by_numbers[k, p, a, LENS + other]
                    system[own + number, own + other] += by_pose * by_other
                for t in range(shared):
                    coupled[own + number, t] += by_pose * by_shared[k, p, a, t]


@inner
def pose_columns(joined: Bool, k: int, size: int) -> int:
    """Return the first of the six columns of y for the pose of a view that is not joined (K,)."""
    later = 0
    for other in range(k, len(joined)):
        if not joined[other]:
            later += EXTRINSICS
    return size - later


@inner
def _linearise(points: Float64, cameras: FrameCameras, weights: Float64, slopes: Slopes) -> None:
    """Write pixels, and their derivatives by points and by cameras.

    A rotation vector turns the camera's axes about the origin of the rig, or about the middle of
    the structure where the view is not joined; translations are in units of the rig. Arrays are
    unpacked once, for all points: that takes longer than the arithmetic of one.
    """
    rotations, translations, lenses, joined, offsets, growth, factor = cameras
    pixels, by_point, by_numbers, by_shared = slopes
    camera, by_camera, by_lens = np.empty(3), np.empty((2, 3)), np.empty((2, LENS))
    for k in range(len(weights)):
        grown, free = (growth, VIEW) if joined[k] else (1.0, LENS)
        for p in range(len(points)):
            if not weights[k, p] > 0:
                continue
            for i in range(3):
                camera[i] = translations[k, i]
                for j in range(3):
                    camera[i] += rotations[k, i, j] * points[p, j]
            differentiate_into(camera, lenses, k, pixels[k, p], by_camera, by_lens)
            for i in range(3):  # what turns with the camera
                camera[i] -= offsets[k, i] if joined[k] else translations[k, i]
            for a in range(2):
                x, y, z = by_camera[a, 0], by_camera[a, 1], by_camera[a, 2]
                for j in range(3):
                    across = x * rotations[k, 0, j] + y * rotations[k, 1, j]
                    by_point[k, p, a, j] = across + z * rotations[k, 2, j]
                for number in range(LENS):
                    by_numbers[k, p, a, number] = by_lens[a, number]
                by_numbers[k, p, a, LENS] = z * camera[1] - y * camera[2]
                by_numbers[k, p, a, LENS + 1] = x * camera[2] - z * camera[0]
                by_numbers[k, p, a, LENS + 2] = y * camera[0] - x * camera[1]
                by_numbers[k, p, a, LENS + 3] = grown * x
                by_numbers[k, p, a, LENS + 4] = grown * y
                by_numbers[k, p, a, LENS + 5] = grown * z
                for t in range(factor.shape[2]):
                    total = 0.0
                    for number in range(free):
                        total += by_numbers[k, p, a, number] * factor[k, number, t]
                    by_shared[k, p, a, t] = total
