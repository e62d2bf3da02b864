"""Self-distillation: what several views of a frame agree on teaches the network about fewer views.

Where a frame has two views or more, least squares over them knows better than the network
(`models.refinement`). Such settled structures become teachers: they supervise the network on the
frames they come from, and on *virtual views*: a teacher seen by made-up cameras like those of the
capture, often few of them, with the noise and the gaps of the capture. No 3D enters from outside:
teachers are a function of the keypoints and of the network's weights at the time.
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from models.adjustment import turn
from models.cameras import WeakPerspective, project, solve_cameras
from models.prior import HierarchicalPrior
from models.refinement import estimate_foreshortening, first_order, mirrored, settle

TEACHERS = 2000  # at most; others are drawn at the next refresh
NUMBERS = 2_000_000  # at most, in a sixth of the widest layer for all teachers together: memory
ROUNDS = 12  # of settling; with two, teachers repeat the errors of the network they came from
FORESHORTENED = slice(250)  # teachers that foreshortening is estimated from
UPRIGHT = 0.1  # weight of "cameras stand upright" next to "cameras do not roll"
NEAREST = 0.2  # of the distance to the teacher's centre: no camera stands nearer to a keypoint
TILT = 0.1  # radians, standard deviation by which virtual cameras tilt and roll
FEWER = 0.5  # share of the virtual frames that lose some of their views


class Teachers(NamedTuple):
    """Settled structures of T frames and what it takes to make virtual views of them."""

    points: Tensor  # (T, P, 3) centred, root-mean-square radius 1, in the network's handedness
    rotations: Tensor  # (T, K, 3, 3) of the cameras that saw them
    seen: Tensor  # (T, K) 1 where there was such a camera
    ups: Tensor  # (T, 3) unit vectors along gravity, either way
    places: Tensor  # (N,) place of every frame of the capture among the teachers, -1 if it has none
    foreshortening: float  # k in the network's handedness, see models.refinement
    noise: float  # standard deviation of a keypoint's coordinate, as a share of its view's size


@torch.no_grad()
def find_teachers(
    network: HierarchicalPrior, keypoints: Tensor, weights: Tensor, *, most: int, seed: list[int]
) -> Teachers | None:
    """Settle at most `most` frames, drawn by `seed`, of those with two views or more.

    `keypoints` (N, K, P, 2) and `weights` (N, K, P) are normalised. None without such frames.
    """
    drawn, places = draw_teachers(weights, most=most, widest=network.widest(weights), seed=seed)
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
    """Draw at most `most` of the frames with two views or more; (T,), and their places (N,)."""
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


@torch.no_grad()
def virtual_views(
    teachers: Teachers, weights: Tensor, count: int, rng: np.random.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Draw `count` teachers (V, P, 3) and normalised views of them: (V, K, P, 2) and (V, K, P).

    Gaps are those of frames of the capture, whose `weights` (N, K, P) are given; half of the
    frames lose more views, so that priors learn to do with fewer than the capture mostly has.
    """
    frames, views, _ = weights.shape
    weights = weights[torch.from_numpy(rng.integers(frames, size=count))]  # (V, K, P)
    weights = drop_views(weights, rng)

    # A camera that saw the teacher, walked round it: elevation and roll stay, azimuth is any.
    drawn = torch.from_numpy(rng.integers(len(teachers.points), size=count))
    points, seen = teachers.points[drawn], teachers.seen[drawn]
    camera = (_uniform(rng, count, views, views) * seen[:, None]).argmax(-1)  # (V, K)
    azimuth = 2 * np.pi * _uniform(rng, count, views, 1)
    tilt = TILT * _normal(rng, count, views, 3)
    walked = teachers.rotations[drawn[:, None], camera] @ turn(
        azimuth * teachers.ups[drawn][:, None]
    )
    scales = torch.ones_like(weights[..., 0])
    cameras = WeakPerspective(turn(tilt) @ walked, scales, torch.zeros_like(tilt[..., :2]))
    # At unit scale a camera's distance is 1 / k: near things are larger.
    depth = (points[:, None] @ cameras.rotations[..., 2, :, None])[..., 0]  # (V, K, P)
    nearness = 1 + teachers.foreshortening * depth
    keypoints = project(points[:, None], cameras) / nearness.clamp_min(NEAREST)[..., None]
    keypoints = keypoints + teachers.noise * _normal(rng, *keypoints.shape)

    # As in `as_observations`.
    total = weights.sum(-1)[..., None, None].clamp_min(1e-6)
    keypoints = keypoints - (weights[..., None] * keypoints).sum(-2, keepdim=True) / total
    squared = (weights[..., None] * keypoints.square()).sum((-2, -1), keepdim=True)
    keypoints = keypoints / (squared / total).clamp_min(1e-6).sqrt()
    return points, keypoints * (weights > 0)[..., None], weights


def drop_views(weights: Tensor, rng: np.random.Generator) -> Tensor:
    """Take views from half of the frames of `weights` (N, K, P); one of each is kept at least."""
    frames, views, _ = weights.shape
    there = weights.sum(-1) > 0
    # Views in random order, those that are there first; the first 1 to all of them are kept.
    order = (_uniform(rng, frames, views) - there.float()).argsort(1).argsort(1)  # (N, K)
    keep = 1 + (_uniform(rng, frames) * there.sum(1)).long()
    keep = torch.where(_uniform(rng, frames) < FEWER, keep, views)
    return weights * (order < keep[:, None])[..., None]


def structure_loss(points: Tensor, truth: Tensor) -> Tensor:
    """Root-mean-square distance of (N, P, 3) from `truth` after turning it (Kabsch), mean over N.

    The best turn needs no gradient: at the optimum the distance does not change with it.
    """
    with torch.no_grad():
        u, _, vt = torch.linalg.svd(truth.mT @ points)
        u[..., -1] *= (torch.linalg.det(u) * torch.linalg.det(vt)).sign()[:, None]
        truth = truth @ (u @ vt)
    return ((points - truth).square().sum(-1).mean(-1) + 1e-8).sqrt().mean()


def _uniform(rng: np.random.Generator, *shape: int) -> Tensor:
    return torch.from_numpy(rng.random(shape, np.float32))


def _normal(rng: np.random.Generator, *shape: int) -> Tensor:
    return torch.from_numpy(rng.standard_normal(shape, np.float32))
