"""Self-distillation: structures from several views of a frame teach the network to use fewer views.

Where a frame has two views or more, least squares over them (`models.network.settling`) is more
accurate than the network. Such settled structures become teachers. They supervise the network on
the frames they come from, and on *virtual views* (`models.training.virtual_views`): projections of
a teacher into drawn cameras like those of the capture, often few of them, with the noise and the
gaps of the capture. No 3D data enters from outside: teachers are a function of the keypoints and of
the network's weights.
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from models.network.priors.prior import Prior
from models.network.settling import (
    estimate_foreshortening,
    first_order_cameras,
    mirror_images,
    settle,
)
from models.numerics.rotations import rotations_from_vectors

MOST_TEACHERS = 2000  # others are drawn at the next refresh
MOST_NUMBERS = 12_000_000  # in the widest layer for all teachers together: memory
ROUNDS = 12  # of settling; with two, teachers repeat the errors of the network they came from
FORESHORTENING_TEACHERS = slice(250)  # teachers that foreshortening is estimated from
UPRIGHT_WEIGHT = 0.1  # of "cameras stand upright" next to "cameras do not roll"


class Teachers(NamedTuple):
    """Settled structures of T frames, and the data for making virtual views of them."""

    points: Tensor  # (T, P, 3) centred, root-mean-square radius 1, in the network's handedness
    rotations: Tensor  # (T, K, 3, 3) of the cameras that saw them
    observed: Tensor  # (T, K) 1 where there was such a camera, else 0
    up_axes: Tensor  # (T, 3) unit vectors along gravity, upwards or downwards
    taught: Tensor  # (N,) whether a frame of the capture has a teacher
    indices: Tensor  # (N,) index of this teacher; arbitrary for other frames
    foreshortening: float  # k in the network's handedness, see models.network.settling
    noise: float  # standard deviation of a keypoint's coordinate, as a share of its view's size


@torch.inference_mode()
def foreshortening_of(network: Prior, keypoints: Tensor, weights: Tensor) -> float:
    """Return the foreshortening of a network's answers to (N, K, P, 2) and (N, K, P)."""
    points, _, matrices = network.reproject(keypoints, weights)
    return estimate_foreshortening(
        points.numpy(), keypoints.numpy(), weights.numpy(), matrices.numpy()
    )


@torch.no_grad()
def find_teachers(
    network: Prior, keypoints: Tensor, weights: Tensor, *, most: int, seed: list[int]
) -> Teachers | None:
    """Settle at most `most` frames, drawn by `seed`, of those with two views or more.

    `keypoints` (N, K, P, 2) and `weights` (N, K, P) are normalised. None without such frames.
    """
    frames = draw_frames(weights, most=most, width=network.width(), seed=seed)
    if not len(frames):
        return None
    count = len(weights)
    keypoints, weights = keypoints[frames], weights[frames]

    points, _, matrices = network.reproject(keypoints, weights)
    arrays = points.numpy(), keypoints.numpy(), weights.numpy(), matrices.numpy()
    some = (part[FORESHORTENING_TEACHERS] for part in arrays)
    foreshortening = estimate_foreshortening(*some, rounds=ROUNDS)
    early = settle(*arrays, foreshortening)
    late = settle(*arrays, foreshortening, rounds=ROUNDS)
    # Two views have hardly more equations than unknowns: more rounds would fit their noise.
    _, views, shown, _ = arrays  # (T, K, P, 2), (T, K, P)
    pair = ((shown.sum(-1) > 0).sum(1) == 2)[:, None, None]
    structures = np.where(pair, early[0], late[0])  # (T, P, 3)
    guesses = np.where(pair[..., None], early[1], late[1])  # (T, K, 3, 3)
    if foreshortening < 0:
        # Back to the handedness of the network; the fit decides the true one at its end.
        structures, guesses = mirror_images(structures, guesses)

    cameras = first_order_cameras(structures, views, shown, guesses, foreshortening)
    noise = _noise(views - cameras.projected - foreshortening * cameras.slopes, shown)
    return as_teachers(
        torch.from_numpy(structures).float(),
        torch.from_numpy(cameras.rotations).float(),
        (weights.sum(-1) > 0).to(weights.dtype),
        frames,
        count,
        foreshortening,
        noise,
    )


def _noise(residuals: NDArray[np.float64], weights: NDArray[np.float32]) -> float:
    """Return the noise of a coordinate from residuals (T, K, P, 2): over degrees of freedom.

    A structure has 3 P unknowns and a view's camera 6, less the 7 of a similarity.
    """
    shown = weights > 0  # (T, K, P)
    unknowns = 3 * shown.any(1).sum(-1) + 6 * shown.any(-1).sum(1) - 7
    freedom = np.maximum(2 * shown.sum((1, 2)) - unknowns, 0).sum()
    if freedom == 0:
        return 0.0
    return math.sqrt((weights * np.square(residuals).sum(-1)).sum() / freedom)


def draw_frames(weights: Tensor, *, most: int, width: int, seed: list[int]) -> Tensor:
    """Draw at most `most` of the frames with two views or more; their indices (T,).

    `weights` (N, K, P) are those of the capture; `width` is how many numbers the widest layer of
    the network has for a view.
    """
    frames = np.flatnonzero(((weights > 0).any(-1).sum(1) > 1).numpy())
    widest = weights.shape[1] * width
    most = max(1, min(most, MOST_TEACHERS, MOST_NUMBERS // widest))
    return torch.from_numpy(np.random.default_rng(seed).permutation(frames)[:most])


def as_teachers(
    points: Tensor,
    rotations: Tensor,
    observed: Tensor,
    frames: Tensor,
    count: int,
    foreshortening: float,
    noise: float,
) -> Teachers:
    """Make teachers of settled structures and the rotations of the cameras that saw them.

    They come from `frames` (T,) of the `count` N of the capture.
    """
    # Cameras hardly roll, so their x axes are level. Up is the direction most perpendicular to all
    # of them, or along their y axes where the x axes are too much alike.
    x, y = rotations[..., 0, :], rotations[..., 1, :]  # (T, K, 3)
    level = torch.einsum("tk,tki,tkj->tij", observed, x, x)
    upright = torch.einsum("tk,tki,tkj->tij", observed, y, y)
    axes = torch.linalg.eigh(UPRIGHT_WEIGHT * upright - level).eigenvectors
    up_axes = axes[..., -1].contiguous()  # laid out as in a checkpoint, so compiled only once
    taught = torch.zeros(count, dtype=torch.bool)
    indices = torch.zeros(count, dtype=torch.long)
    taught[frames] = True
    indices[frames] = torch.arange(len(frames))
    return Teachers(points, rotations, observed, up_axes, taught, indices, foreshortening, noise)


def perspective_teachers(
    points: Tensor,
    rotations: Tensor,
    translations: Tensor,
    observed: Tensor,
    frames: Tensor,
    count: int,
    *,
    noise: float,
    reflected: bool,
) -> Teachers:
    """Make teachers of structures (T, P, 3) seen by perspective cameras, `x_cam = R X + t`.

    Parameters
    ----------
    rotations, translations
        (T, K, 3, 3) and (T, K, 3), in units of the structures.
    observed
        (T, K) whether there was such a camera; others may have any finite numbers.
    frames, count
        Indices (T,) of the frames that the structures come from, of the N of the capture.
    noise
        Standard deviation of a coordinate as a share of its view's size.
    reflected
        Whether the network's structures are mirror images of these.
    """
    radius = points.square().sum(-1).mean(-1).sqrt()  # (T,)
    distances = translations.norm(dim=-1) / radius[:, None]  # (T, K)
    weights = observed.to(points.dtype)
    foreshortening = float((weights / distances).sum() / weights.sum())
    # A weak-perspective camera looks along the ray to the subject, not along the lens's axis.
    rays = torch.nn.functional.normalize(translations, dim=-1)
    ahead = rays.new_tensor([0.0, 0.0, 1.0]).expand_as(rays)
    axes = torch.linalg.cross(rays, ahead, dim=-1)
    sine = axes.norm(dim=-1, keepdim=True)
    angle = torch.atan2(sine, rays[..., 2:])
    past = rotations_from_vectors((axes / sine.clamp_min(1e-12) * angle).double().numpy())
    rotations = torch.from_numpy(past).to(rotations.dtype) @ rotations
    points = points / radius[:, None, None]
    if reflected:
        points, rotations = map(torch.from_numpy, mirror_images(points.numpy(), rotations.numpy()))
        foreshortening = -foreshortening  # depths change their sign
    return as_teachers(
        points.float(), rotations.float(), weights.float(), frames, count, foreshortening, noise
    )
