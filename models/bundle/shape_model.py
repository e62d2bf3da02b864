"""The Gaussian shape model: the variation of structures, learnt from these and covariances."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle.problem import SIMILARITY
from models.numerics.medians import lower_median
from models.numerics.rotations import nearest_rotations
from models.numerics.tiny import TINY

Float64 = NDArray[np.float64]

MOST_COMPONENTS = 40  # of a shape model; the remaining variance is isotropic
LEAST_ERROR = 1e-3  # smallest root-mean-square error of a network, in radii of the structure
LEAST_SHARE = 0.05  # of it, in each coordinate that is not along a component
ALIGNMENTS = 5  # rounds of aligning to the mean and computing it again


class ShapeModel(NamedTuple):
    """x = mean + B z + e with z ~ N(0, 1), e ~ N(0, spread^2); probabilistic PCA.

    Tipping and Bishop, *Probabilistic Principal Component Analysis*, 1999.
    """

    mean: Float64  # (P, 3) centred, root-mean-square radius 1
    basis: Float64  # (P, 3, Q)
    spread: float


class NetworkErrors(NamedTuple):
    """The errors of the network's structures: s (B z + e), with s for the number of views.

    Empty scales mean that errors were not learnt.
    """

    basis: Float64  # (P, 3, Q)
    spread: float
    scales: Float64  # (V,) for one view, two, ... V or more; root-mean-square distances

    @property
    def known(self) -> bool:
        """Whether they were learnt."""
        return len(self.scales) > 0


class Similarity(NamedTuple):
    """The similarity that takes structures to a mean: scale (x - centre) Q."""

    scales: Float64  # (N,)
    rotations: Float64  # (N, 3, 3) Q, acting on row vectors
    centres: Float64  # (N, 1, 3)


def align(points: Float64, mean: Float64) -> tuple[Float64, Similarity]:
    """Align structures (N, P, 3) to `mean` (P, 3) or (N, P, 3), never mirrored, by least squares.

    Umeyama, *Least-squares estimation of transformation parameters*, 1991.
    """
    centres = points.mean(-2, keepdims=True)
    centred = points - centres
    overlap = centred.mT @ (mean - mean.mean(-2, keepdims=True))  # (N, 3, 3)
    rotations = nearest_rotations(overlap)
    scales = (rotations * overlap).sum((1, 2)) / np.square(centred).sum((1, 2)).clip(TINY)
    return scales[:, None, None] * centred @ rotations, Similarity(scales, rotations, centres)


class StructureCovariances(NamedTuple):
    """Covariances of N structures: blocks on the diagonal, and factors times their transposes."""

    blocks: Float64  # (N, P, 3, 3)
    factors: Float64  # (N, 3 P, R)

    def of(self, frames: NDArray[np.int64]) -> "StructureCovariances":
        """Return the covariances of some of the frames."""
        return StructureCovariances(self.blocks[frames], self.factors[frames])


def learn_shapes(
    points: Float64, covariances: StructureCovariances | None, *, floor: float
) -> ShapeModel:
    """Fit a shape model by maximum likelihood to structures (N, P, 3) with covariances.

    `covariances` are added to the scatter (the M-step of EM); None: structures are exact.
    Similarities, which belong to the cameras, are projected out. `floor` is the least standard
    deviation.
    """
    frames, count, _ = points.shape
    mean = points.mean(0)
    for _ in range(ALIGNMENTS):
        aligned, similarity = align(points, mean)
        mean = aligned.mean(0)
        mean = mean - mean.mean(0)
        mean = mean / np.sqrt(np.square(mean).sum(-1).mean())
    offsets = (aligned - mean).reshape(frames, -1)
    scatter = offsets.T @ offsets
    if covariances is not None:
        # On column vectors a similarity acts as `scaled`, and on covariances from both sides.
        scaled = (similarity.rotations.mT * similarity.scales[:, None, None])[:, None]
        factors = scaled @ covariances.factors.reshape(frames, count, 3, -1)  # (N, P, 3, R)
        rows = factors.transpose(1, 2, 0, 3).reshape(3 * count, -1)
        scatter += rows @ rows.T
        every = np.arange(count)
        blocks = scatter.reshape(count, 3, count, 3)
        blocks[every, :, every] += (scaled @ covariances.blocks @ scaled.mT).sum(0)
    return _components(mean, scatter / frames, floor)


def unknown_network_errors(keypoints: int) -> NetworkErrors:
    """Return the value for errors that were not learnt."""
    return NetworkErrors(np.zeros((keypoints, 3, 0)), 1.0, np.zeros(0))


def learn_network_errors(
    errors: Sequence[Float64], sizes_from: Sequence[NDArray[np.bool_]], mean: Float64
) -> NetworkErrors:
    """Learn from errors (N, P, 3) in the frame of `mean` (P, 3), an array per number of views.

    The directions of the errors are learnt from all frames, their sizes from the frames
    `sizes_from` (N,) alone.
    """
    own = [np.sqrt(np.square(part).sum(-1).mean(-1)) for part in errors]  # of every frame
    judged = zip(own, sizes_from, strict=True)
    scales = np.array([lower_median(part[which]) for part, which in judged]).clip(LEAST_ERROR)
    # A frame with a large error counts no more than others; heavy tails account for it.
    flat = np.concatenate(
        [
            part / alone.clip(scale)[:, None, None]
            for part, alone, scale in zip(errors, own, scales, strict=True)
        ]
    ).reshape(-1, mean.size)
    model = _components(mean, flat.T @ flat / len(flat), LEAST_SHARE)
    return NetworkErrors(model.basis, model.spread, scales)


def similarity_directions(mean: Float64) -> Float64:
    """Orthonormal directions (3 P, 7) in which similarities move a structure (P, 3)."""
    count = len(mean)
    eye = np.broadcast_to(np.eye(3), (count, 3, 3))
    rotated = np.cross(eye, mean[:, None]).mT  # (P, 3, 3) how rotations about the axes move it
    axes = np.concatenate((eye, mean[..., None], rotated), -1).reshape(3 * count, SIMILARITY)
    return np.asarray(np.linalg.qr(axes)[0], np.float64)


def _components(mean: Float64, scatter: Float64, floor: float) -> ShapeModel:
    """Decompose a scatter (3 P, 3 P) with similarities of the mean projected out."""
    count = len(mean)
    kept_directions = 3 * count - SIMILARITY
    similarity = similarity_directions(mean)
    kept_rows = scatter - similarity @ (similarity.T @ scatter)
    values, vectors = np.linalg.eigh(kept_rows - (kept_rows @ similarity) @ similarity.T)
    values, vectors = values[::-1][:kept_directions], vectors[:, ::-1][:, :kept_directions]
    some = min(MOST_COMPONENTS, max(len(values) - 1, 0))
    spread = max(float(np.sqrt(values[some:].mean().clip(0))), floor)
    kept = values[:some] > spread**2
    basis = vectors[:, :some][:, kept] * np.sqrt(values[:some][kept] - spread**2)
    return ShapeModel(mean, np.ascontiguousarray(basis).reshape(count, 3, -1), spread)
