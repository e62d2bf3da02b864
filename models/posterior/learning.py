"""What a fit learns of its own doubt: noise of its keypoints, shapes, and covariance of cameras."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from models.bundle.problem import CENTRE_X, FOCAL, LENS, RADIAL, RADIAL_2, VIEW, Rig
from models.calibrating.shape_evidence import (
    LEAST_KNOWN,
    Located,
    LocatedShapes,
    blocks_of,
    learn_shapes_of,
)
from models.capture.metrics import procrustes_by_size
from models.network.answers import Answers
from models.posterior.answers import frames_of, reprojected
from models.posterior.frames import Frames, LearntShapes, covariances_of, scores_of
from models.posterior.posterior import Posterior

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

LEAST_FRAMES = 4  # in which keypoints locate points
FRAMES_EACH = 8  # at least, that shapes are learnt from and judged on
LEAST_SPREAD = 1e-3  # of a keypoint about its shapes, radii of the structure
LEAST_NOISE = 1e-3  # pixels
STEP = 1e-5  # of the largest coordinate, for differences of pixels
ILL = 1e8  # condition of the information on a point, from which keypoints do not locate it
POOLED = 20.0  # frames that the noise of a view's other keypoints is worth
ROUNDS = 5  # of learning noise
MOST_LEVERAGE = 0.98  # share of the noise that an answer follows
HALF = 2 * np.log(2)  # median of the squared distance of white noise in two directions
TINY = 1e-12
LEFT = 1.579  # mean squared distance of white noise of variance 1, as far as it counts
BLOCKS = 20  # of frames whose errors are independent
MATTERS = 0.99  # of the variance of points by cameras, that few directions of these must make
MOST_FACTORS = 8
# Standard deviations without any keypoint, where the number is free: as in
# `models.calibrating.lens_prior`, those of one kind of lens.
LENS_SDS = {FOCAL: 0.5, RADIAL: 0.2, RADIAL_2: 0.07}
CENTRE_SD = 0.02  # of the longest side, twice the distance of the principal point
WIDEST = 1e3  # of rotations (radians) and translations (structures)


def learn_posterior(
    answers: Answers,
    rig: Rig,
    mean: Float64,
    keypoints: Float64,
    weights: Float64,
    deviations: Float64,
    *,
    share_left: float = 1.0,
) -> Posterior | None:
    """Learn from the frames of a fit and their answers, which have perspective cameras.

    None where keypoints locate points in too few of them.

    Parameters
    ----------
    mean
        (P, 3) of the shapes.
    keypoints, weights
        (N, K, P, 2) pixels as they were detected, and (N, K, P) confidences, 0 where not used.
    deviations
        (K, 11) standard deviations that the calibration gives to its numbers; 0 where held.
    share_left
        Share of the noise that its removal leaves in keypoints before a lift.
    """
    weights = np.where((answers.camera_models > 0)[..., None], weights, 0.0)
    noise = np.full(weights.shape[1:], _typical(answers, rig, mean, keypoints, weights))
    for _ in range(ROUNDS):
        frames = frames_of(answers, rig, mean, keypoints, weights, noise)
        _, left, share = _triangulated(frames)
        noise = _noise(frames.weights * np.square(noise), left, share)
    frames = frames_of(answers, rig, mean, keypoints, weights, noise)
    located, _, _ = _triangulated(frames)
    usable = np.flatnonzero(located.known.sum(1) >= LEAST_KNOWN)
    if len(usable) < LEAST_FRAMES:
        return None
    shapes = _shapes(located.of(usable))
    frames = frames_of(answers, rig, shapes.mean, keypoints, weights, noise)
    factor = _that_matters(frames, shapes, camera_factor(frames, shapes, rig, deviations))
    return Posterior(*shapes, noise, factor, share_left)


def _triangulated(frames: Frames) -> tuple[Located, Float64, Float64]:
    """Move points to where keypoints alone put them, by one step from the answers.

    Returns them as far as two views show them, the pixels (N, K, P, 2) that keypoints are off
    then, and the share (N, K, P) of white noise that is left in these.
    """
    derivatives, pixels = _derivatives(frames)
    off = frames.keypoints - pixels
    information = np.einsum("nkp,nkpai,nkpaj->npij", frames.weights, derivatives, derivatives)
    pull = np.einsum("nkp,nkpai,nkpa->npi", frames.weights, derivatives, off)
    known = ((frames.weights > 0).sum(1) > 1) & (np.linalg.cond(information) < ILL)
    covariance = np.zeros(information.shape)
    covariance[known] = np.linalg.inv(information[known])
    step = (covariance @ pull[..., None])[..., 0]
    followed = np.einsum("nkpai,npij,nkpaj->nkp", derivatives, covariance, derivatives)
    share = 1 - (followed * frames.weights / 2).clip(0, MOST_LEVERAGE)
    share = np.where(known[:, None] & (frames.weights > 0), share, np.nan)
    left = off - np.einsum("nkpai,npi->nkpa", derivatives, step)
    points = frames.points + step
    sizes = np.sqrt(np.square(frames.turned).sum((1, 2)) / 3)[:, None, None]
    located = Located(
        np.where(known[..., None], points / sizes, 0.0),
        np.where(known[..., None, None], information * sizes[..., None] ** 2, 0.0),
    )
    return located, left, share


def _derivatives(frames: Frames) -> tuple[Float64, Float64]:
    """Return derivatives (N, K, P, 2, 3) of pixels by points, and the pixels (N, K, P, 2)."""

    def pixels_of(points: Float64) -> Float64:
        return reprojected(frames, points)

    return _slopes(pixels_of, frames.points), pixels_of(frames.points)


def _slopes(pixels_of: Callable[[Float64], Float64], points: Float64) -> Float64:
    """Return derivatives (..., 2, 3) of pixels (..., 2) by the coordinates of their points."""
    step = STEP * float(np.abs(points).max())
    return np.stack(
        [
            (pixels_of(points + step * axis) - pixels_of(points - step * axis)) / (2 * step)
            for axis in np.eye(3)
        ],
        -1,
    )


def _shapes(located: Located) -> LearntShapes:
    """Learn shapes from points that keypoints alone locate.

    What is left of a keypoint is what the other keypoints leave open of it, in frames that shapes
    were not learnt from.
    """
    learnt = learn_shapes_of(located)
    odd = blocks_of(len(located.points)) % 2
    left, counts = np.zeros(len(learnt.mean)), np.zeros(len(learnt.mean))
    for half in (0, 1):
        some, others = np.flatnonzero(odd == half), np.flatnonzero(odd != half)
        if min(len(some), len(others)) < FRAMES_EACH:
            continue
        squares, known = _predicted(learn_shapes_of(located.of(some)), located.of(others))
        left, counts = left + squares, counts + known
    own = learnt.left.trace(axis1=1, axis2=2) / 3
    typical = left.sum() / max(float(counts.sum()), TINY) if counts.any() else own.mean()
    variances = np.maximum(own, (left + POOLED * typical) / (counts + POOLED)) + LEAST_SPREAD**2
    return LearntShapes(*(np.ascontiguousarray(a) for a in (learnt.mean, learnt.basis, variances)))


def _predicted(shapes: LocatedShapes, located: Located) -> tuple[Float64, Float64]:
    """Predict each keypoint of frames from the others.

    Returns sums (P,) of squared errors of a coordinate, less the noise of the points, and how many
    frames (P,) know the keypoint.
    """
    known = located.known
    holes = np.where(known[..., None], located.points, np.nan)
    aligned = np.nan_to_num(procrustes_by_size(holes, np.broadcast_to(shapes.mean, holes.shape)))
    noise = np.zeros(known.shape)
    noise[known] = np.linalg.inv(located.information[known]).trace(axis1=1, axis2=2) / 3
    offsets = np.where(known[..., None], aligned - shapes.mean, 0.0)  # (N, P, 3)
    weights = known / (noise + shapes.left.trace(axis1=1, axis2=2) / 3)
    pulls = weights[..., None] * np.einsum("piq,npi->npq", shapes.basis, offsets)
    inner = weights[..., None, None] * (shapes.basis.mT @ shapes.basis)  # (N, P, Q, Q)
    others = inner.sum(1, keepdims=True) - inner + np.eye(shapes.basis.shape[2])
    pull = pulls.sum(1, keepdims=True) - pulls
    z = np.linalg.solve(others, pull[..., None])[..., 0]
    left = offsets - np.einsum("piq,npq->npi", shapes.basis, z)
    squares = np.where(known, np.square(left).mean(-1) - noise, 0.0)
    return squares.sum(0).clip(0), known.sum(0)


def _noise(weights: Float64, left: Float64, share: Float64) -> Float64:
    """Return the noise (K, P) of each keypoint of each view, with what repeats in all frames."""
    seen = np.isfinite(share)
    weights = np.where(seen, weights, 0.0)
    squares = (weights * np.square(left).sum(-1)).sum(0) / LEFT  # (K, P)
    shares = np.where(seen, share, 0.0).sum(0)
    of_view = squares.sum(1) / shares.sum(1).clip(TINY)
    of_all = squares.sum() / max(float(shares.sum()), TINY)
    of_view = np.where(shares.sum(1) > 1, of_view, of_all)
    white = (squares + POOLED * of_view[:, None]) / (shares + POOLED)
    count = seen.sum(0)
    biases = np.square((weights[..., None] * left).sum(0) / count.clip(1)[..., None]).sum(-1) / 2
    repeated = (biases / (shares / count.clip(1)).clip(0.1) - white / count.clip(1)).clip(0)
    total = white + np.where(count > 1, repeated, 0.0)
    return np.asarray(np.sqrt(total.clip(LEAST_NOISE**2)))


def _typical(
    answers: Answers, rig: Rig, mean: Float64, keypoints: Float64, weights: Float64
) -> float:
    """Return the usual distance of keypoints from their reprojections, pixels a coordinate."""
    frames = frames_of(answers, rig, mean, keypoints, weights, np.ones(weights.shape[1:]))
    off = np.square(keypoints - reprojected(frames, frames.points)).sum(-1) * weights
    return max(float(np.sqrt(np.median(off[weights > 0]) / HALF)), LEAST_NOISE)


def camera_factor(frames: Frames, shapes: LearntShapes, rig: Rig, deviations: Float64) -> Float64:
    """Return L (K, 11, T): the covariance of cameras that errors which repeat leave (sandwich).

    Errors repeat within a keypoint and within a block of frames (Cameron, Gelbach and Miller,
    *Robust inference with multiway clustering*, 2011). The first camera of a rig and the rig's size
    are held: they are its frame of reference and its unit.
    """
    views = len(rig.groups)
    free = deviations.ravel() > 0
    if not free.any():
        return np.zeros((views, VIEW, 1))
    information, scores = scores_of(frames, shapes)
    information = (information + information.T) / 2
    blocks = _by_block(scores)  # (B, P, 11 K)
    by_keypoint, by_block, both = blocks.sum(0), blocks.sum(1), blocks.reshape(-1, len(free))
    scatter = by_keypoint.T @ by_keypoint + by_block.T @ by_block - both.T @ both
    precision = _prior_precision(rig)
    growth = np.zeros((views, VIEW))
    growth[:, LENS + 3 :] = rig.translations * rig.static[:, None]
    along = growth.ravel()[free]
    matrix = information[np.ix_(free, free)] + np.diag(precision[free])
    root = np.sqrt(matrix.diagonal())
    scaled = matrix / root / root[:, None]
    held = along * root
    if np.linalg.norm(held) > 0:
        held /= np.linalg.norm(held)
        scaled += len(root) * np.outer(held, held)
    values, vectors = np.linalg.eigh(scaled)
    half = vectors / np.sqrt(values.clip(1e-12 * values[-1])) / root[:, None]  # Sigma = half half^T
    scattered = scatter[np.ix_(free, free)] + np.diag(precision[free])
    effects, turns = np.linalg.eigh(half.T @ scattered @ half)
    factor = half @ (turns * np.sqrt(effects.clip(1.0)))
    if views == 2 and rig.static.all():
        factor = _with_lenses(factor, np.flatnonzero(free), deviations)
    whole = np.zeros((views * VIEW, factor.shape[1]))
    whole[free] = factor
    return np.ascontiguousarray(whole.reshape(views, VIEW, -1))


def _that_matters(frames: Frames, shapes: LearntShapes, factor: Float64) -> Float64:
    """Keep the few directions of a factor (K, 11, T) that move points."""
    moved = covariances_of(frames, shapes, factor).by_cameras.reshape(-1, factor.shape[2])
    moved = moved[np.isfinite(moved).all(1)]
    values, vectors = np.linalg.eigh(moved.T @ moved)
    kept = values[::-1].cumsum() < MATTERS * values.sum()
    some = min(int(kept.sum()) + 1, MOST_FACTORS)
    return np.ascontiguousarray(factor @ vectors[:, ::-1][:, :some])


def _by_block(scores: Float64) -> Float64:
    """Add up scores (N, P, T) of blocks of neighbouring frames."""
    first = np.arange(min(BLOCKS, len(scores))) * len(scores) // min(BLOCKS, len(scores))
    return np.asarray(np.add.reduceat(scores, first, 0))


def _prior_precision(rig: Rig) -> Float64:
    precision = np.full((len(rig.groups), VIEW), WIDEST**-2)
    for number, sd in LENS_SDS.items():
        precision[:, number] = sd**-2
    sides = 2 * rig.lenses.centres.max(1).clip(1.0)
    precision[:, CENTRE_X:RADIAL] = ((CENTRE_SD * sides) ** -2)[:, None]
    return precision.ravel()


def _with_lenses(factor: Float64, places: NDArray[np.int64], deviations: Float64) -> Float64:
    """Give the focal lengths of a pair the deviations of their own posterior.

    Epipolar geometry hardly determines them; other evidence does. All else follows them as
    keypoints demand. Their correlation is that of the keypoints.
    """
    lenses = np.flatnonzero(places % VIEW == FOCAL)
    if not len(lenses):
        return factor
    covariance = factor @ factor.T
    among = covariance[np.ix_(lenses, lenses)]
    sds = np.sqrt(among.diagonal())
    wanted = deviations.ravel()[places[lenses]]
    asked = among * np.outer(wanted / sds, wanted / sds)
    follow = np.linalg.solve(among + 1e-12 * np.diag(among.diagonal()), covariance[lenses]).T
    given_lenses = covariance - follow @ covariance[lenses]
    total = given_lenses + follow @ asked @ follow.T
    values, vectors = np.linalg.eigh((total + total.T) / 2)
    return np.asarray(vectors * np.sqrt(values.clip(0)))
