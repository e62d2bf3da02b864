"""The method on three pages, in the plainest way: to be read after `docs/method.md`.

Nothing here is fast, robust, or used by the program; `test_reference.py` holds the program's own,
compiled code against it on small cases. Its chapters are the camera of a view by weak perspective;
the network of the paper; static cameras with perspective, from keypoints alone; and the posterior
of a frame, with how far its most likely structure may be off.

"Paper" is Dabhi, Wang, Saluja, Jeni, Fasel, Lucey: *High Fidelity 3D Reconstructions with Limited
Physical Views*, 3DV 2021. There are N frames, K views and P keypoints; all numbers are float64. A
camera's axes are x right, y down, z forward.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

# 1. The camera of a view
#
# Weak perspective projects a structure X by w = scale (R X)_xy + translation.

RIDGE = 1e-4  # of the structure's variance: how much a first guess of the rotation counts


class Camera(NamedTuple):
    """A camera of weak perspective."""

    rotation: Tensor  # (3, 3) R
    scale: Tensor  # () image units per unit of the structure
    translation: Tensor  # (2,) image units


def nearest_rotation(rows: Tensor) -> Tensor:
    """Return the rotation (3, 3) whose first two rows are nearest to a matrix (2, 3)."""
    u, _, vt = torch.linalg.svd(rows, full_matrices=False)
    x, y = u @ vt
    return torch.stack((x, y, torch.linalg.cross(x, y)))


def solve_camera(points: Tensor, image: Tensor, weights: Tensor, guess: Tensor) -> Camera:
    """Return the camera that sees points (P, 3) at image (P, 2), with weights (P,).

    The paper's orthographic-n-point problem. Least squares give a matrix M (2, 3) with w = M X. A
    flat structure leaves M open along its normal; there the ridge decides for `guess` (3, 3). The
    rotation is the one nearest to M; the best scale and translation for it follow.
    """
    shares = (weights / weights.sum())[:, None]
    middle, centre = (shares * points).sum(0), (shares * image).sum(0)
    x, w = points - middle, image - centre
    scatter, cross = x.T @ (shares * x), w.T @ (shares * x)  # (3, 3), (2, 3)
    variance = scatter.trace()
    usual_scale = ((shares * w * w).sum() / variance).sqrt()
    ridge = RIDGE * variance * torch.eye(3).double()
    matrix = (cross + usual_scale * guess[:2] @ ridge) @ torch.linalg.inv(scatter + ridge)
    rotation = nearest_rotation(matrix)
    scale = (cross * rotation[:2]).sum() / (rotation[:2] @ scatter * rotation[:2]).sum()
    return Camera(rotation, scale, centre - scale * rotation[:2] @ middle)


def project_weakly(points: Tensor, camera: Camera) -> Tensor:
    """Return the images (P, 2) of points (P, 3)."""
    return camera.scale * points @ camera.rotation[:2].T + camera.translation


# 2. The network
#
# Keypoints w of a view are those of a structure S = D_1 phi_1, phi_1 = D_2 phi_2, ..., seen by a
# rotation R. So R is part of each block of the codes: Psi = phi (x) R. The encoder finds the
# blocks, the bottleneck takes the rotation out, and the decoder goes back with the same D.


class Dictionaries(NamedTuple):
    """The weights of the network: L layers of B_1, B_2, ..., B_L atoms."""

    first: Tensor  # D_1 (P, 3, B_1): each atom is a structure
    others: list[Tensor]  # D_2, D_3, ...: each (B_{l-1}, B_l)
    encoder_thresholds: list[Tensor]  # lambda_1 (B_1,), lambda_2 (B_2,), ...
    decoder_thresholds: list[Tensor]  # (B_1,), (B_2,), ..., (B_{L-1},)
    unrotate: tuple[Tensor, Tensor]  # matrix (B_L, 6 B_L) and shift (B_L,) of the bottleneck
    rotate: tuple[Tensor, Tensor]  # (6, 6 B_L) and (6,)


def encode(network: Dictionaries, view: Tensor) -> tuple[Tensor, Tensor]:
    """Return the code (B_L,) of a normalised view (P, 2), and a matrix (2, 3) near its rotation.

    Paper, eq. "encoder": each layer is one step of ISTA, which solves for sparse codes.
    """
    blocks = torch.einsum("pib,pj->jib", network.first, view)  # (2, 3, B_1): D_1^T w
    blocks = torch.relu(blocks - network.encoder_thresholds[0])
    for dictionary, threshold in zip(network.others, network.encoder_thresholds[1:], strict=True):
        blocks = torch.relu(blocks @ dictionary - threshold)  # (2, 3, B_l)
    # The rotation factorisation layer.
    (to_code, shift), (to_rows, offset) = network.unrotate, network.rotate
    flat = blocks.reshape(-1)  # (6 B_L,)
    return to_code @ flat + shift, (to_rows @ flat + offset).reshape(2, 3)


def decode(network: Dictionaries, code: Tensor) -> Tensor:
    """Return the structure (P, 3) of a code (B_L,); paper, eq. "decoder"."""
    layers = zip(network.others, network.decoder_thresholds, strict=True)
    for dictionary, threshold in reversed(list(layers)):
        code = torch.relu(dictionary @ code - threshold)
    return network.first @ code


def normalised(points: Tensor) -> Tensor:
    """Return points (P, D) about their mean, at a root-mean-square distance of 1 from it."""
    centred = points - points.mean(0)
    return centred / centred.square().sum(-1).mean().sqrt()


def reconstruct(
    network: Dictionaries, keypoints: Tensor, weights: Tensor
) -> tuple[Tensor, list[Camera | None]]:
    """Return the structure (P, 3) of one frame, and the cameras of its views.

    `keypoints` (K, P, 2) are normalised, `weights` (K, P) are from 0, for what was not observed, to
    1. A view without any weight has no camera. The paper sums the codes of all views; here they
    are averaged, so that a view that is missing does not shrink the structure.
    """
    shares = weights.sum(1) / weights.sum()
    there = [k for k in range(len(weights)) if shares[k] > 0]
    seen = keypoints
    while True:
        read = {k: encode(network, seen[k]) for k in there}
        code = torch.stack([shares[k] * read[k][0] for k in there]).sum(0)
        points = normalised(decode(network, code))
        cameras = [
            solve_camera(points, keypoints[k], weights[k], nearest_rotation(read[k][1]))
            if k in there
            else None
            for k in range(len(weights))
        ]
        if seen is not keypoints or bool((weights[there] == 1).all()):
            return points, cameras
        # Hidden keypoints are filled with their reprojections, and the views are read once more.
        seen = keypoints.clone()
        for k in there:
            if bool((weights[k] < 1).any()):
                camera, weight = cameras[k], weights[k, :, None]
                assert camera is not None
                projected = project_weakly(points, camera)
                seen[k] = normalised(weight * keypoints[k] + (1 - weight) * projected)


def loss(
    points: Tensor, cameras: list[Camera | None], keypoints: Tensor, weights: Tensor
) -> Tensor:
    """Return the loss of a frame; paper, eq. "final_loss": how far reprojections are off."""
    errors = []
    for camera, image, weight in zip(cameras, keypoints, weights, strict=True):
        if camera is not None:
            squares = (project_weakly(points, camera) - image).square().sum(-1)
            errors.append((weight * squares).sum() / weight.sum())
    return torch.stack(errors).sqrt().mean()


# 3. Static cameras with perspective
#
# A point in a camera's axes is R X + t; its image is f (x, y) / z. Where cameras are static, the
# keypoints of all frames are M points of one rigid scene.

STEP = 1e-5  # for derivatives


class Pinholes(NamedTuple):
    """K static cameras; the first is the frame of reference, the second is 1 from it."""

    focals: Tensor  # (K,) image units
    rotations: Tensor  # (K, 3, 3)
    translations: Tensor  # (K, 3)


def turned(vectors: Tensor) -> Tensor:
    """Return the rotations (..., 3, 3) of rotation vectors (..., 3), by the exponential map."""
    x, y, z = vectors.unbind(-1)
    none = torch.zeros_like(x)
    rows = [(none, -z, y), (z, none, -x), (-y, x, none)]
    found: Tensor = torch.linalg.matrix_exp(torch.stack([torch.stack(row, -1) for row in rows], -2))
    return found


def images_of(cameras: Pinholes, points: Tensor) -> Tensor:
    """Return the images (K, M, 2) of points (M, 3)."""
    seen = points @ cameras.rotations.mT + cameras.translations[:, None]
    return cameras.focals[:, None, None] * seen[..., :2] / seen[..., 2:]


def triangulated(cameras: Pinholes, images: Tensor) -> Tensor:
    """Return the points (M, 3) whose images are (K, M, 2), by linear least squares.

    From u = f x / z follows u z - f x = 0, which is linear in the point; so for v.
    """
    rows, right = [], []
    for f, turn, shift, image in zip(*cameras, images, strict=True):
        for i in range(2):
            rows.append(image[:, i, None] * turn[2] - f * turn[i])  # (M, 3)
            right.append(f * shift[i] - image[:, i] * shift[2])  # (M,)
    found: Tensor = torch.linalg.lstsq(torch.stack(rows, 1), torch.stack(right, 1)[..., None])[0]
    return found[..., 0]


def second_camera(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return rotation, translation of length 1, and points of two views, images over focal length.

    The rays (x, 1) and (y, 1) of a point lie in one plane with both cameras: (y, 1) E (x, 1) = 0,
    E = [t] R, one equation of nine numbers a point (Longuet-Higgins, 1981). Of the four poses of E
    only one has the points in front of both cameras.
    """
    one = torch.ones(len(x), 1).double()
    rays = torch.cat((x, one), 1), torch.cat((y, one), 1)
    rows = (rays[1][:, :, None] * rays[0][:, None]).reshape(-1, 9)
    u, _, vt = torch.linalg.svd(torch.linalg.svd(rows)[2][-1].reshape(3, 3))
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]).double()
    poses = []
    for turn in (u @ quarter @ vt, u @ quarter.T @ vt):
        for shift in (u[:, 2], -u[:, 2]):
            rotation = turn * torch.linalg.det(turn)
            rotations = torch.stack((torch.eye(3).double(), rotation))
            pair = Pinholes(torch.ones(2).double(), rotations, torch.stack((0 * shift, shift)))
            points = triangulated(pair, torch.stack((x, y)))
            depths = points @ rotations[:, 2].T + pair.translations[:, 2]
            poses.append((int((depths > 0).sum()), rotation, shift, points))
    return max(poses, key=lambda pose: pose[0])[1:]


def static_cameras(images: Tensor, focal: float) -> tuple[Pinholes, Tensor]:
    """Return the cameras that see M points at (K, M, 2), and the points (M, 3).

    `focal` is a rough first guess of all focal lengths. Images are from the principal points. The
    start is algebra; bundle adjustment then finds focal lengths, poses and points together, as the
    least squares of reprojection errors.
    """
    flat, views = images / focal, len(images)
    found = [second_camera(flat[0], flat[view]) for view in range(1, views)]
    rotations = torch.stack([torch.eye(3).double(), *(turn for turn, _, _ in found)])
    points = found[0][2]
    # Each pair is in units of its own distance; the points that all see have one size.
    scales = [(points[:, 2] / own[:, 2]).median() for _, _, own in found]
    moved = [scale * shift for scale, (_, shift, _) in zip(scales, found, strict=True)]
    translations = torch.stack([torch.zeros(3).double(), *moved])

    def unpacked(x: Tensor) -> tuple[Pinholes, Tensor]:
        logs, moves = x[:views], x[views:].reshape(-1, 3)
        still = torch.zeros(1, 3).double()
        turns, shifts, steps = torch.tensor_split(moves, [views - 1, 2 * (views - 1)])
        shift = translations + torch.cat((still, shifts))
        cameras = Pinholes(
            focal * logs.exp(),
            turned(torch.cat((still, turns))) @ rotations,
            shift / shift[1].norm(),
        )
        return cameras, points + steps

    x = torch.zeros(views + 6 * (views - 1) + points.numel()).double()
    return unpacked(least_squares(lambda x: (images_of(*unpacked(x)) - images).reshape(-1), x))


def least_squares(residuals: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """Return the x of least squared residuals near a start, by Levenberg and Marquardt.

    Each step solves the linearised problem, (J^T J + damping) dx = -J^T r. A step that makes things
    worse is not made, and the next one is shorter.
    """
    damping, cost = 1e-3, residuals(x).square().sum()
    for _ in range(200):
        slopes = jacobian(residuals, x)
        matrix = slopes.T @ slopes
        damped = matrix + damping * matrix.diagonal().clamp_min(1e-9).diag()
        tried = x - torch.linalg.solve(damped, slopes.T @ residuals(x))
        gain = cost - residuals(tried).square().sum()
        damping *= 10 if gain < 0 else 0.1
        if gain >= 0:
            x, cost = tried, cost - gain
        if 0 <= gain <= 1e-9 * cost or cost < 1e-16 or damping > 1e12:
            break
    return x


def jacobian(residuals: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """Return the derivatives (R, X) of residuals (R,) by numbers (X,), from central differences."""
    steps = STEP * torch.eye(len(x)).double()
    return torch.stack([residuals(x + d) - residuals(x - d) for d in steps], 1) / (2 * STEP)


# 4. The posterior of a frame
#
# Its unknowns are the points X (P, 3) in the frame of reference of the cameras; the similarity S
# between them and the shapes; the coordinates z of the shape; a pose for each camera that moves;
# and what all frames share, the numbers of the static cameras. Its residuals, each over its
# standard deviation, are
#
#     keypoint   (projection of X - keypoint) sqrt(weight)
#     shape      (S^-1 X - mean - basis z) / spread
#     z          z
#
# Half of the sum of their squares is minus the logarithm of the posterior.

LENS, VIEW = 5, 11  # log focal, principal point, two radial coefficients; then the six of a pose


class Frame(NamedTuple):
    """What is known of one frame, about an answer from which all unknowns are measured."""

    similarity: tuple[Tensor, Tensor]  # (3, 3) scale times rotation, (3,), from shapes to points
    keypoints: Tensor  # (K, P, 2) pixels
    weights: Tensor  # (K, P) inverse variances, 0 where nothing was observed
    focals: Tensor  # (K, 2) pixels
    centres: Tensor  # (K, 2) principal points, pixels
    radial: Tensor  # (K, 2) radial coefficients
    rotations: Tensor  # (K, 3, 3)
    translations: Tensor  # (K, 3)
    static: Tensor  # (K,) which cameras are static
    mean: Tensor  # (P, 3) of the shapes
    basis: Tensor  # (P, 3, Q)
    spread: Tensor  # (P,) standard deviation of a point beside the shapes
    points: Tensor  # (P, 3) the answer


def own_and_shared(frame: Frame) -> tuple[Tensor, Tensor]:
    """Return which numbers belong to the frame, and which are those of shared cameras.

    Where all cameras move, their poses have all that a similarity has, and there is none.
    """
    poses = torch.zeros(len(frame.static), VIEW, dtype=torch.bool)
    poses[~frame.static, LENS:] = True
    others = torch.ones(frame.mean.numel() + 7 + frame.basis.shape[2], dtype=torch.bool)
    own = torch.cat((others, poses.reshape(-1)))
    own[frame.mean.numel() :][:7] = frame.static.any()
    return own, torch.cat((~others, ~poses.reshape(-1)))


def pixels_of(frame: Frame, points: Tensor, cameras: Tensor) -> Tensor:
    """Return the pixels (K, P, 2) of points (P, 3), with numbers of the cameras (K, 11)."""
    lens, turns, shifts = torch.tensor_split(cameras, [LENS, LENS + 3], 1)
    seen = points @ frame.rotations.mT @ turned(turns).mT
    seen = seen + (frame.translations + shifts)[:, None]
    flat = seen[..., :2] / seen[..., 2:]
    squared = flat.square().sum(-1, keepdim=True)
    first, second = torch.tensor_split((frame.radial + lens[:, 3:])[:, None], 2, -1)
    bent = flat * (1 + first * squared + second * squared.square())
    focals = frame.focals * lens[:, :1].exp()
    return focals[:, None] * bent + (frame.centres + lens[:, 1:3])[:, None]


def residuals_of(frame: Frame, x: Tensor) -> Tensor:
    """Return all residuals, each over its standard deviation.

    The unknowns x are how far the points (3 P), the similarity (translation, rotation vector and
    log size), z and the numbers of the cameras (11 K) are from the answer.
    """
    ends = frame.mean.numel() + torch.tensor([0, 7, 7 + frame.basis.shape[2]])
    moves, similarity, z, cameras = torch.tensor_split(x, ends.tolist())
    points = frame.points + moves.reshape(-1, 3)
    off = pixels_of(frame, points, cameras.reshape(-1, VIEW)) - frame.keypoints
    off = off * frame.weights.sqrt()[..., None]
    matrix, middle = frame.similarity
    shift, turn, size = torch.tensor_split(similarity, [3, 6])
    onto = size.exp() * turned(turn)  # then the similarity of the answer
    shape = (points - middle - shift) @ torch.linalg.inv(onto @ matrix).T
    beside = (shape - frame.mean - frame.basis @ z) / frame.spread[:, None]
    return torch.cat((off.reshape(-1), beside.reshape(-1), z))


def most_likely(frame: Frame) -> Tensor:
    """Return the points (P, 3) of the maximum of the posterior, with the cameras as they are."""
    own, _ = own_and_shared(frame)
    start = torch.zeros(len(own)).double()
    x = least_squares(lambda x: residuals_of(frame, start.masked_scatter(own, x)), start[own])
    return frame.points + x[: frame.mean.numel()].reshape(-1, 3)


def covariance(frame: Frame, factor: Tensor) -> Tensor:
    """Return the covariance (3 P, 3 P) of the points about the answer.

    It is the inverse of the Hessian J^T J, and what the shared cameras add, whose covariance is
    L L^T with the factor L (K, 11, T): points follow them by -H_own^-1 H_own,shared. Directions in
    which all points move, turn or grow together belong to the answer's pose, and are taken out;
    growth remains where two static cameras give it.
    """
    own, shared = own_and_shared(frame)
    slopes = jacobian(lambda x: residuals_of(frame, x), torch.zeros(len(own)).double())
    hessian, count = slopes.T @ slopes, frame.mean.numel()
    inverse: Tensor = torch.linalg.inv(hessian[own][:, own] + 1e-9 * torch.eye(int(own.sum())))
    known = factor.flatten(0, 1)[shared[-VIEW * len(factor) :]]
    follow = (-inverse @ hessian[own][:, shared] @ known)[:count]
    sized = int((frame.static & (frame.weights.sum(1) > 0)).sum()) > 1
    kept, seen = without_pose(frame.points, 6 if sized else 7), without_pose(frame.points, 7)
    return kept @ inverse[:count, :count] @ kept + seen @ follow @ follow.T @ seen


def without_pose(points: Tensor, size: int) -> Tensor:
    """Return the projection (3 P, 3 P) off translations, rotations and, of seven, growth."""
    away, axes = points - points.mean(0), torch.eye(3).double()
    shifts = [axis.repeat(len(points)) for axis in axes]
    turns = [torch.linalg.cross(axis.expand_as(away), away).reshape(-1) for axis in axes]
    poses = torch.stack([*shifts, *turns, away.reshape(-1)][:size], 1)
    basis: Tensor = torch.linalg.qr(poses)[0]
    return torch.eye(len(basis)).double() - basis @ basis.T
