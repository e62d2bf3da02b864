"""What a fit learns of its own doubt: noise of its keypoints, shapes, and covariance of cameras."""

import numpy as np
from numpy.typing import NDArray

from models.bundle.problem import CENTRE_X, FOCAL, LENS, RADIAL, RADIAL_2, VIEW, Rig
from models.calibrating.shape_evidence import (
    LEAST_KNOWN,
    Located,
    blocks_of,
    learn_shapes_of,
    predicted_from_others,
)
from models.network.answers import Answers
from models.numerics.medians import MEDIAN_OF_SQUARES
from models.numerics.tiny import TINY
from models.posterior.answers import derivatives_of, frames_of, reprojected
from models.posterior.frames import Frames, LearntShapes, covariances_of, scores_of
from models.posterior.posterior import Posterior
from models.posterior.quality import FIGURES

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

LEAST_FRAMES = 4  # in which keypoints locate points
FRAMES_EACH = 8  # at least, that shapes are learnt from and judged on
LEAST_SPREAD = 1e-3  # of a keypoint about its shapes, radii of the structure
LEAST_NOISE = 0.01  # pixels: what files are rounded to, and less than any lens model leaves
ILL = 1e8  # condition of the information on a point, from which keypoints do not locate it
FURTHEST = 9.0  # variances, that the square of an error counts for
POOLED = 20.0  # frames that the noise of a view's other keypoints is worth
ROUNDS = 5  # of learning noise
MOST_LEVERAGE = 0.98  # share of the noise that an answer follows
LEFT = 1.579  # mean squared distance of white noise of variance 1, as far as it counts
BLOCKS = 20  # of frames whose errors are independent
MATTERS = 0.02  # of a point's own variance, by cameras
MOST_FACTORS = 16
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
    shares_left: tuple[float, float] = (1.0, 1.0),
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
    shares_left
        Shares of the noise that its removal leaves before a lift: of frames one by one, and
        smoothed in time.
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
    return Posterior(
        *shapes,
        noise,
        factor,
        np.array(shares_left),
        np.ones((2, weights.shape[1] + 1)),
        np.zeros(FIGURES),
    )


def _triangulated(frames: Frames) -> tuple[Located, Float64, Float64]:
    """Move points to where keypoints alone put them, by one step from the answers.

    Returns them as far as two views show them, the pixels (N, K, P, 2) that keypoints are off
    then, and the share (N, K, P) of white noise that is left in these.
    """
    derivatives, pixels = derivatives_of(frames)
    off = frames.keypoints - pixels
    information = np.einsum("nkp,nkpai,nkpaj->npij", frames.weights, derivatives, derivatives)
    pull = np.einsum("nkp,nkpai,nkpa->npi", frames.weights, derivatives, off)
    values = np.linalg.eigvalsh(information)  # (N, P, 3), rising
    known = ((frames.weights > 0).sum(1) > 1) & (values[..., 2] < ILL * values[..., 0])
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


def _shapes(located: Located) -> LearntShapes:
    """Learn shapes from points that keypoints alone locate.

    What is left of a keypoint is what the other keypoints leave open of it, in frames that shapes
    were not learnt from.
    """
    learnt = learn_shapes_of(located)
    own = learnt.left.trace(axis1=1, axis2=2) / 3
    odd = blocks_of(len(located.points)) % 2
    squares, spreads = [np.empty((0, *located.points.shape[1:]))] * 2
    for half in (0, 1):
        some, others = np.flatnonzero(odd == half), np.flatnonzero(odd != half)
        if min(len(some), len(others)) >= FRAMES_EACH:
            errors, expected = predicted_from_others(
                learn_shapes_of(located.of(some)), located.of(others)
            )
            values, axes = np.linalg.eigh(np.nan_to_num(expected))
            along = (axes.mT @ errors[..., None])[..., 0]
            squares = np.concatenate((squares, np.square(along)))
            spreads = np.concatenate((spreads, values))
    variances = np.maximum(own, _left_open(squares, spreads, own)) + LEAST_SPREAD**2
    return LearntShapes(*(np.ascontiguousarray(a) for a in (learnt.mean, learnt.basis, variances)))


def _left_open(squares: Float64, spreads: Float64, start: Float64) -> Float64:
    """Return variances (P,) by which squares (N, P, 3) of errors exceed their expectations.

    Each counts by the inverse square of its own variance, and an outlier for no more than FURTHEST.
    """
    found, known = start, np.isfinite(squares)
    for _ in range(ROUNDS if known.any() else 0):
        total = spreads + found[:, None]
        weights = known / np.square(total)
        excess = np.where(known, np.minimum(squares, FURTHEST * total) - spreads, 0.0)
        sums, counts = (weights * excess).sum((0, 2)), weights.sum((0, 2))
        typical = sums.sum() / counts.sum()
        pooled = POOLED * np.square(1 / found.mean())
        found = ((sums + pooled * typical) / (counts + pooled)).clip(LEAST_SPREAD**2)
    return found


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
    return max(float(np.sqrt(np.median(off[weights > 0]) / MEDIAN_OF_SQUARES)), LEAST_NOISE)


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
    """Keep the directions of a factor (K, 11, T) that move points by more than a frame leaves open.

    Each point's share is in units of its own covariance, since one direction in which cameras are
    hardly known would hide all others.
    """
    own = covariances_of(frames, shapes, np.zeros((*factor.shape[:2], 1)), modes=False).blocks
    moved = covariances_of(frames, shapes, factor).by_cameras  # (N, P, 3, T)
    known = np.isfinite(own).all((2, 3)) & np.isfinite(moved).all((2, 3))
    white = np.linalg.solve(np.linalg.cholesky(own[known]), moved[known])
    rows = white.reshape(-1, factor.shape[2])
    values, vectors = np.linalg.eigh(rows.T @ rows / max(len(rows), 1))
    left = values.cumsum()[::-1]  # of the variance of a coordinate, with as many fewer directions
    some = min(max(int((left > MATTERS).sum()), 1), MOST_FACTORS)
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
