"""The Gaussian shape model: what structures vary like, learnt from structures and their doubts."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

MOST_COMPONENTS = 40  # of a shape model; the rest of the variance is isotropic
LEAST_DOUBT = 1e-3  # root-mean-square error that no network falls below
LEAST_SHARE = 0.05  # of it, in each coordinate that is not along a component
ALIGNMENTS = 5  # rounds of aligning to the mean and taking it anew


class ShapeModel(NamedTuple):
    """x = mean + B z + e with z ~ N(0, 1), e ~ N(0, spread^2); probabilistic PCA.

    Tipping and Bishop, *Probabilistic Principal Component Analysis*, 1999.
    """

    mean: Tensor  # (P, 3) centred, root-mean-square radius 1
    basis: Tensor  # (P, 3, Q)
    spread: float


class Doubts(NamedTuple):
    """How far the network's structures are off: by s (B z + e), s for the number of views it saw.

    Empty scales stand for doubts that were not learnt.
    """

    basis: Tensor  # (P, 3, Q)
    spread: float
    scales: Tensor  # (V,) for one view, two, ... V or more; root-mean-square distances


class Similarity(NamedTuple):
    """What takes structures to a mean: scale (x - centre) Q."""

    scales: Tensor  # (N,)
    rotations: Tensor  # (N, 3, 3) Q, acting on row vectors
    centres: Tensor  # (N, 1, 3)


def align(points: Tensor, mean: Tensor) -> tuple[Tensor, Similarity]:
    """Bring structures (N, P, 3) onto `mean` (P, 3) or (N, P, 3), never mirrored, by least squares.

    Umeyama, *Least-squares estimation of transformation parameters*, 1991.
    """
    centres = points.mean(-2, keepdim=True)
    centred = points - centres
    u, values, vt = torch.linalg.svd(centred.mT @ (mean - mean.mean(-2, keepdim=True)))
    sign = (torch.linalg.det(u) * torch.linalg.det(vt)).sign()
    u = torch.cat((u[..., :2], u[..., 2:] * sign[:, None, None]), -1)
    rotations = u @ vt
    overlap = values[:, 0] + values[:, 1] + sign * values[:, 2]
    scales = overlap / centred.square().sum((1, 2)).clamp_min(1e-12)
    return scales[:, None, None] * centred @ rotations, Similarity(scales, rotations, centres)


def learn_shapes(points: Tensor, covariances: Tensor, *, floor: float) -> ShapeModel:
    """Maximum likelihood of structures (N, P, 3) that are themselves known up to covariances.

    `covariances` (N, 3 P, 3 P) is added to the scatter (the M-step of EM); similarities, which
    cameras explain, are projected out; `floor` is the least standard deviation.
    """
    count = points.shape[1]
    mean = points.mean(0)
    for _ in range(ALIGNMENTS):
        aligned, moved = align(points, mean)
        mean = aligned.mean(0)
        mean = mean - mean.mean(0)
        mean = mean / mean.square().sum(-1).mean().sqrt()
    turned = moved.rotations.mT * moved.scales[:, None, None]  # column vectors' turn
    blocks = covariances.reshape(-1, count, 3, count, 3)
    doubt = torch.einsum("nai,npiqj,nbj->paqb", turned, blocks, turned) / len(points)
    offsets = (aligned - mean).flatten(1)
    scatter = offsets.T @ offsets / len(points) + doubt.flatten(2).flatten(0, 1)
    return _components(mean, scatter, floor)


def no_doubts(keypoints: int) -> Doubts:
    """Return doubts that were not learnt."""
    nothing = torch.zeros(0, dtype=torch.float64)
    return Doubts(nothing.expand(keypoints, 3, 0), 1.0, nothing)


def learn_doubts(errors: Sequence[Tensor], mean: Tensor) -> Doubts:
    """Learn doubts from errors (N, P, 3) in the frame of `mean` (P, 3), a tensor per view count."""
    own = [part.square().sum(-1).mean(-1).sqrt() for part in errors]  # of every frame
    scales = torch.stack([part.median() for part in own]).clamp_min(LEAST_DOUBT)
    # A frame that is off by far counts no more than others; it is what heavy tails are for.
    flat = torch.cat(
        [
            part / alone.clamp_min(scale)[:, None, None]
            for part, alone, scale in zip(errors, own, scales, strict=True)
        ]
    ).flatten(1)
    model = _components(mean, flat.T @ flat / len(flat), LEAST_SHARE)
    return Doubts(model.basis, model.spread, scales)


def _components(mean: Tensor, scatter: Tensor, floor: float) -> ShapeModel:
    count = len(mean)
    eye = torch.eye(3, dtype=mean.dtype).expand(count, 3, 3)
    axes = torch.cat(
        (eye, mean[..., None], torch.linalg.cross(eye, mean[:, None].expand_as(eye), dim=-1).mT), -1
    )
    similarity, _ = torch.linalg.qr(axes.flatten(0, 1))  # (3 P, 7)
    keep = torch.eye(3 * count, dtype=mean.dtype) - similarity @ similarity.T
    values, vectors = torch.linalg.eigh(keep @ scatter @ keep)
    values, vectors = values.flip(0)[: 3 * count - 7], vectors.flip(1)[:, : 3 * count - 7]
    some = min(MOST_COMPONENTS, max(len(values) - 1, 0))
    spread = max(float(values[some:].mean().clamp_min(0).sqrt()), floor)
    kept = values[:some] > spread**2
    basis = vectors[:, :some][:, kept] * (values[:some][kept] - spread**2).sqrt()
    return ShapeModel(mean, basis.reshape(count, 3, -1), spread)
