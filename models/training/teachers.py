"""Self-distillation: what several views of a frame agree on teaches the network about fewer views.

Where a frame has two views or more, least squares over them knows better than the network
(`models.network.settling`). Such settled structures become teachers: they supervise the network on
the frames they come from, and on *virtual views* (`models.training.virtual_views`): a teacher seen
by made-up cameras like those of the capture, often few of them, with the noise and the gaps of the
capture. No 3D enters from outside: teachers are a function of the keypoints and of the network's
weights.
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from models.bundle.adjustment import turn
from models.network.priors.prior import Prior
from models.network.settling import estimate_foreshortening, first_order, mirrored, settle
from models.optics.weak_perspective import solve_cameras

TEACHERS = 2000  # at most; others are drawn at the next refresh
NUMBERS = 12_000_000  # at most, in the widest layer for all teachers together: memory
ROUNDS = 12  # of settling; with two, teachers repeat the errors of the network they came from
FORESHORTENED = slice(250)  # teachers that foreshortening is estimated from
UPRIGHT = 0.1  # weight of "cameras stand upright" next to "cameras do not roll"


class Teachers(NamedTuple):
    """Settled structures of T frames and what it takes to make virtual views of them."""

    points: Tensor  # (T, P, 3) centred, root-mean-square radius 1, in the network's handedness
    rotations: Tensor  # (T, K, 3, 3) of the cameras that saw them
    seen: Tensor  # (T, K) 1 where there was such a camera
    ups: Tensor  # (T, 3) unit vectors along gravity, either way
    places: Tensor  # (N,) place of every frame of the capture among the teachers, -1 if it has none
    foreshortening: float  # k in the network's handedness, see models.network.settling
    noise: float  # standard deviation of a keypoint's coordinate, as a share of its view's size


@torch.no_grad()
def find_teachers(
    network: Prior, keypoints: Tensor, weights: Tensor, *, most: int, seed: list[int]
) -> Teachers | None:
    """Settle at most `most` frames, drawn by `seed`, of those with two views or more.

    `keypoints` (N, K, P, 2) and `weights` (N, K, P) are normalised. None without such frames.
    """
    drawn, places = draw_teachers(
        weights, most=most, widest=weights.shape[1] * network.width(), seed=seed
    )
    if not len(drawn):
        return None
    keypoints, weights = keypoints[drawn], weights[drawn]

    points, _, guesses = network(keypoints, weights)
    foreshortening = estimate_foreshortening(
        *(part[FORESHORTENED] for part in (points, keypoints, weights, guesses)), rounds=ROUNDS
    )
    early = settle(points, keypoints, weights, guesses, foreshortening)
    points, guesses = settle(points, keypoints, weights, guesses, foreshortening, rounds=ROUNDS)
    # Two views have hardly more equations than unknowns: more rounds would settle on their noise.
    pair = (weights.sum(-1) > 0).sum(1) == 2
    points = torch.where(pair[:, None, None], early[0], points)
    guesses = torch.where(pair[:, None, None, None], early[1], guesses)
    if foreshortening < 0:
        # Back to the handedness that the network is used to; the fit decides it at its end.
        points, guesses = mirrored(points, guesses)

    cameras = solve_cameras(points[:, None], keypoints, weights, guesses)
    seen = (weights.sum(-1) > 0).to(weights.dtype)
    projected, nearer = first_order(points, weights, cameras)
    squared = (keypoints - projected - foreshortening * nearer).square().sum(-1)
    # Noise: residual over degrees of freedom. A structure has 3 P numbers and a view's camera 6,
    # less the 7 of a similarity.
    shown = weights > 0  # (T, K, P)
    unknown = 3 * shown.any(1).sum(-1) + 6 * seen.sum(1) - 7
    freedom = (2 * shown.sum((1, 2)) - unknown).clamp_min(0).sum()
    noise = float(((weights * squared).sum() / freedom.clamp_min(1)).sqrt()) if freedom else 0.0
    return as_teachers(points, cameras.rotations, seen, places, foreshortening, noise)


def draw_teachers(
    weights: Tensor, *, most: int, widest: int, seed: list[int]
) -> tuple[Tensor, Tensor]:
    """Draw at most `most` of the frames with two views or more; (T,), and their places (N,).

    `widest` is how many numbers the widest layer of the network has for a frame.
    """
    frames = np.flatnonzero(((weights > 0).any(-1).sum(1) > 1).numpy())
    most = max(1, min(most, TEACHERS, NUMBERS // widest))
    drawn = torch.from_numpy(np.random.default_rng(seed).permutation(frames)[:most])
    places = torch.full((len(weights),), -1)
    places[drawn] = torch.arange(len(drawn))
    return drawn, places


def as_teachers(
    points: Tensor,
    rotations: Tensor,
    seen: Tensor,
    places: Tensor,
    foreshortening: float,
    noise: float,
) -> Teachers:
    """Make teachers of settled structures and the rotations of the cameras that saw them."""
    # Cameras hardly roll: their x axes are level, and up is what is most at right angles to all
    # of them; where they are too much alike to tell, along their y axes.
    x, y = rotations[..., 0, :], rotations[..., 1, :]  # (T, K, 3)
    level = torch.einsum("tk,tki,tkj->tij", seen, x, x)
    upright = torch.einsum("tk,tki,tkj->tij", seen, y, y)
    ups = torch.linalg.eigh(UPRIGHT * upright - level).eigenvectors[..., -1]
    return Teachers(points, rotations, seen, ups, places, foreshortening, noise)


def perspective_teachers(
    points: Tensor,
    rotations: Tensor,
    translations: Tensor,
    seen: Tensor,
    places: Tensor,
    *,
    noise: float,
    reflected: bool,
) -> Teachers:
    """Make teachers of structures (T, P, 3) seen by perspective cameras, `x_cam = R X + t`.

    Rotations are (T, K, 3, 3), translations (T, K, 3) in units of the structures; `reflected` if
    the network's structures are mirror images of these.
    """
    radius = points.square().sum(-1).mean(-1).sqrt()  # (T,)
    distances = translations.norm(dim=-1) / radius[:, None]  # (T, K)
    there = seen.to(points.dtype)
    foreshortening = float((there / distances).sum() / there.sum())
    # Weak perspective looks along the ray to the subject, not along the axis of the lens.
    rays = torch.nn.functional.normalize(translations, dim=-1)
    ahead = rays.new_tensor([0.0, 0.0, 1.0]).expand_as(rays)
    axes = torch.linalg.cross(rays, ahead, dim=-1)
    sine = axes.norm(dim=-1, keepdim=True)
    angle = torch.atan2(sine, rays[..., 2:])
    rotations = turn(axes / sine.clamp_min(1e-12) * angle) @ rotations
    points = points / radius[:, None, None]
    if reflected:
        points, rotations = mirrored(points, rotations)
        foreshortening = -foreshortening  # depths change their sign
    return as_teachers(
        points.float(), rotations.float(), there.float(), places, foreshortening, noise
    )
