"""After the network: let the views of a frame settle its structure, and decide its handedness.

Both rest on plain least squares, no learning. Weak perspective sees a structure and its mirror
image alike, but a real camera makes near things larger. To first order in depth over distance,

    w = s (R X)_xy (1 - k z) + t,    z = (R X)_z about its mean,

with a foreshortening k > 0 that is the inverse of the distance in units of the structure. With the
mirror image every z changes its sign, and so does the k that fits: its sign is the handedness.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from models.optics.weak_perspective import WeakPerspective, project, solve_cameras

ROUNDS = 2  # a third lowers the error by some 2 % and costs a frame 0.3 ms
STIFFNESS = 0.05  # pull to the network's structure, where one view seen head-on pulls with about 1
DECISIVE = 0.8  # a frame leaves the handedness of the fit if its error falls below this share
MIRROR = (1.0, 1.0, -1.0)  # through the x-y plane


class SettlingPolicy(NamedTuple):
    """Which frames of a lift are settled; the others keep the structure of the network."""

    every_frame: bool
    misfit_limit: float  # otherwise frames whose misfit is larger; in units of the structure


SETTLE_ALL = SettlingPolicy(every_frame=True, misfit_limit=0.0)
SETTLE_NONE = SettlingPolicy(every_frame=False, misfit_limit=math.inf)


def settle_beyond(misfit_limit: float) -> SettlingPolicy:
    """Settle the frames whose misfit, the mean reprojection error, is larger than a limit."""
    return SettlingPolicy(every_frame=False, misfit_limit=misfit_limit)


def settle(
    points: Tensor,
    keypoints: Tensor,
    weights: Tensor,
    guesses: Tensor,
    foreshortening: float,
    *,
    rounds: int = ROUNDS,
) -> tuple[Tensor, Tensor]:
    """Refine the structures of frames and make them right-handed.

    A frame with one view is only moved along its image: depth stays the network's.

    Parameters
    ----------
    points
        (N, P, 3) structures of the network, in its own handedness.
    keypoints, weights
        (N, K, P, 2) normalised and (N, K, P), as the network got them.
    guesses
        (N, K, 3, 3) rotations for `solve_cameras`.
    foreshortening
        k of the fit, negative if the network's structures are mirror images; see
        `estimate_foreshortening`. A frame follows that sign unless the other explains its
        keypoints decidedly better. A frame with one view follows it always.
    rounds
        How often cameras and structure take turns; with more, the network has less of a say.

    Returns
    -------
    Structures (N, P, 3), centred and of root-mean-square radius 1, and their guesses.
    """
    if foreshortening == 0:
        return points, guesses
    views = (weights.sum(-1) > 0).sum(1)  # (N,)
    some, several = views > 0, views > 1
    signs = torch.full_like(points[:, 0, 0], 1.0 if foreshortening > 0 else -1.0)  # (N,)
    if some.any():
        # Both hypotheses at once: the first half of the batch keeps the sign of the fit.
        both = torch.cat((signs, -signs)) * abs(foreshortening)
        refined, errors = _refine(
            points.repeat(2, 1, 1),
            keypoints.repeat(2, 1, 1, 1),
            weights.repeat(2, 1, 1),
            guesses.repeat(2, 1, 1, 1),
            both,
            rounds,
        )
        kept, turned = refined.chunk(2)
        error, error_turned = errors.chunk(2)
        turn = several & (error_turned < DECISIVE * error)
        refined = torch.where(turn[:, None, None], turned, kept)
        points = torch.where(some[:, None, None], refined, points)
        signs = torch.where(turn, -signs, signs)
    mirror = torch.where((signs < 0)[:, None], points.new_tensor(MIRROR), 1.0)  # (N, 3)
    points = points * mirror[:, None]
    # (D R D)(D X) = D R X has the same x and y; D R D is a rotation again.
    guesses = mirror[:, None, :, None] * guesses * mirror[:, None, None, :]
    points = points - points.mean(-2, keepdim=True)
    radius = points.square().sum(-1).mean(-1).clamp_min(1e-12).sqrt()
    return points / radius[:, None, None], guesses


def mirrored(points: Tensor, rotations: Tensor) -> tuple[Tensor, Tensor]:
    """Turn structures (N, P, 3) into their mirror images, seen alike by rotations (N, K, 3, 3)."""
    mirror = points.new_tensor(MIRROR)
    # (D R D)(D X) = D R X has the same x and y; D R D is a rotation again.
    return points * mirror, mirror[:, None] * rotations * mirror


def estimate_foreshortening(
    points: Tensor, keypoints: Tensor, weights: Tensor, guesses: Tensor, *, rounds: int = ROUNDS
) -> float:
    """Return k of a whole fit, in the handedness that most of its frames have.

    Least squares over the frames with two views or more (one view is explained by any shape), each
    with the sign it prefers; 0 without such a frame. Arguments as for `settle`.
    """
    several = (weights.sum(-1) > 0).sum(1) > 1
    if not several.any():
        return 0.0
    points, keypoints = points[several], keypoints[several]
    weights, guesses = weights[several], guesses[several]
    k = torch.zeros_like(points[:, 0, 0])
    for _ in range(rounds):
        refined, _ = _refine(points, keypoints, weights, guesses, k, rounds)
        cameras = solve_cameras(refined[:, None], keypoints, weights, guesses)
        projected, nearer = first_order(refined, weights, cameras)
        match = (weights[..., None] * (keypoints - projected) * nearer).sum((1, 2, 3))  # (N,)
        square = (weights[..., None] * nearer.square()).sum((1, 2, 3)).sum().clamp_min(1e-9)
        k = match.sign() * (match.abs().sum() / square)
    return float(k.abs().max()) * (1.0 if k.sum() >= 0 else -1.0)


def _refine(
    points: Tensor, keypoints: Tensor, weights: Tensor, guesses: Tensor, k: Tensor, rounds: int
) -> tuple[Tensor, Tensor]:
    """Alternate cameras and structure; structures (N, P, 3) and squared-error roots (N,)."""
    k = k[:, None, None, None]
    stiffness = STIFFNESS * torch.eye(3, dtype=points.dtype)
    target = keypoints
    for _ in range(rounds):
        cameras = solve_cameras(points[:, None], target, weights, guesses)
        projected, nearer = first_order(points, weights, cameras)
        target = keypoints - k * nearer  # what weak perspective would have shown
        axes = cameras.scales[..., None, None] * cameras.rotations[..., :2, :]  # (N, K, 2, 3)
        squares = (axes.mT @ axes).flatten(-2)  # (N, K, 9)
        normal = (weights.mT @ squares).reshape(*points.shape, 3) + stiffness  # (N, P, 3, 3)
        residual = weights[..., None] * (target - projected)  # (N, K, P, 2)
        pull = (residual @ axes).sum(1)  # (N, P, 3)
        points = points + torch.linalg.solve(normal, pull)
    cameras = solve_cameras(points[:, None], target, weights, guesses)
    projected, nearer = first_order(points, weights, cameras)
    residual = keypoints - k * nearer - projected
    return points, (weights[..., None] * residual.square()).sum((1, 2, 3)).sqrt()


def first_order(points: Tensor, weights: Tensor, cameras: WeakPerspective) -> tuple[Tensor, Tensor]:
    """Weak-perspective projections (N, K, P, 2) and how they move per unit of k."""
    projected = project(points[:, None], cameras)
    share = weights / weights.sum(-1, keepdim=True).clamp_min(1e-6)
    z = (points[:, None] @ cameras.rotations[..., 2, :, None])[..., 0]  # (N, K, P)
    z = z - (share * z).sum(-1, keepdim=True)
    centre = (share[..., None] * projected).sum(-2, keepdim=True)
    nearer = -z[..., None] * (projected - centre)
    return projected, nearer - (share[..., None] * nearer).sum(-2, keepdim=True)
