"""The evidence of shapes for static cameras, judged on frames that shapes were not learnt from.

With wrong lenses a body changes its shape as it turns. Shapes are learnt from every other block of
frames, and the frames between are held against them, both ways round: on their own frames, shapes
follow wrong lenses, and the evidence jumps from one trial to the next.

A shape is x = mean + B z + e with z ~ N(0, 1) and e ~ N(0, Psi) for each keypoint (factor analysis:
Rubin and Thayer, *EM algorithms for ML factor analysis*, 1982). Psi (3, 3) has all directions:
wrong lenses stretch the room, and an isotropic one would prefer lenses that shorten the direction
in which shapes vary most, even of a subject that never turns. Points are located first, and count
by the information (3, 3) of their keypoints.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.epipolar.robust_points import robust_structures
from models.epipolar.static_cameras import FREEDOM, SeenPoints, StaticCameras, linearised
from models.numerics.rotations import nearest_rotations, rotations_from_vectors

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
Bool = NDArray[np.bool_]

LEAST_BLOCKS, MOST_BLOCKS, LONGEST_BLOCK = 4, 10, 10  # of frames
COMPONENTS, FRAMES_EACH = 6, 8  # at most, and frames that determine one
ALIGNMENTS, ROUNDS = 5, 5  # of the mean shape, and of learning shapes
STEPS_LEARNT, STEPS_JUDGED = 1, 6  # Gauss-Newton steps of each frame, in a round and when judged
POOLED = 4.0  # frames that the mean of all keypoints' Psi is worth
LONGEST_TURN = 0.5  # radians in a step
FRAME_FREEDOM = 8.0  # of the multivariate t, with which a frame unlike all others counts little
LEAST_KNOWN = 4  # points of a frame
FAR_OFF = 4.0  # median distances from the middle, beyond which a point is no part of the subject
RIDGE = 1e-9
EYE = np.eye(3)


class Located(NamedTuple):
    """Structures of frames, in sizes of the subject."""

    points: Float64  # (N, P, 3), any finite number where the information is 0
    information: Float64  # (N, P, 3, 3) inverse covariances

    @property
    def known(self) -> Bool:
        """Which points (N, P) are known."""
        return np.asarray(self.information[..., 0, 0] > 0)

    def of(self, frames: Int64) -> "Located":
        """Return some of the frames."""
        return Located(self.points[frames], self.information[frames])


class LocatedShapes(NamedTuple):
    """x = mean + B z + e, z ~ N(0, 1), e ~ N(0, Psi), in sizes of the subject."""

    mean: Float64  # (P, 3)
    basis: Float64  # (P, 3, Q)
    left: Float64  # (P, 3, 3) Psi


class _Posed(NamedTuple):
    """Frames at their most likely poses and shapes."""

    rotations: Float64  # (N, 3, 3)
    translations: Float64  # (N, 3)
    components: Float64  # (N, Q)
    canonical: Float64  # (N, P, 3) points in the frame of the mean shape
    precisions: Float64  # (N, P, 3, 3) of these about their shape
    squared: Float64  # (N,) Mahalanobis distance
    curvature: Float64  # (N, Q + 6, Q + 6)


def locate(rig: StaticCameras, images: Float64, weights: Float64, noise: float) -> Located:
    """Locate the points of images (N, K, P, 2) in sides, with weights (N, K, P)."""
    frames, views, count, _ = images.shape
    noises = np.full(views, noise)
    points = robust_structures(rig, images, weights, noises)
    seen = SeenPoints(
        images.transpose(1, 3, 0, 2).reshape(views, 2, -1),
        weights.transpose(1, 0, 2).reshape(views, -1),
    )
    flat = np.nan_to_num(points).reshape(-1, 3).T
    _, _, by_point = linearised(rig, flat, seen, noises)  # (K, 2, 3, M)
    information = np.einsum("kiam,kibm->mab", by_point, by_point, optimize=True)
    # A keypoint without error counts as one of Gaussian noise, not more.
    information *= FREEDOM / (FREEDOM + 2)
    information = information.reshape(frames, count, 3, 3)
    away = np.linalg.norm(points - np.nanmedian(points, 1, keepdims=True), axis=-1)
    near = away < FAR_OFF * np.nanmedian(away)  # False for NaN
    near &= np.linalg.det(information) > 0
    size = np.sqrt(np.square(away[near]).mean()) if near.any() else 1.0
    information = np.where(near[..., None, None], information * size**2, 0.0)
    return Located(np.where(near[..., None], points / size, 0.0), information)


def alike_in_all(trials: list[Located]) -> list[Located]:
    """Keep the points that all trials know: with fewer points the evidence is another's."""
    known = np.all([trial.known for trial in trials], 0)
    known &= known.sum(1, keepdims=True) >= LEAST_KNOWN
    return [
        trial._replace(information=trial.information * known[..., None, None]) for trial in trials
    ]


def shape_evidence(located: Located) -> Float64:
    """Return the log likelihood (N,) of each frame under shapes learnt from blocks of others.

    It is a density of keypoints, up to a constant, with the subject's place uniform over the
    images and its direction uniform. NaN where a frame shows too little.

    Raises
    ------
    numpy.linalg.LinAlgError
        Where shapes cannot be learnt.
    """
    frames = len(located.points)
    odd = blocks_of(frames) % 2
    usable = located.known.sum(1) >= LEAST_KNOWN
    evidence = np.full(frames, np.nan)
    for half in (0, 1):
        learnt = np.flatnonzero((odd == half) & usable)
        judged = np.flatnonzero((odd != half) & usable)
        if len(learnt) < 2 or not len(judged):
            raise np.linalg.LinAlgError("too few frames show the subject")
        shapes = learn_shapes_of(located.of(learnt))
        evidence[judged] = _log_likelihood(shapes, located.of(judged))
    return evidence


def predicted_from_others(shapes: LocatedShapes, located: Located) -> tuple[Float64, Float64]:
    """Predict each point of frames from the others by shapes that were learnt elsewhere.

    Returns errors (N, P, 3) in the shapes' frame of reference, and their covariances (N, P, 3, 3)
    without what shapes leave open of the point itself; NaN where a point is not known.
    """
    posed = _posed(shapes, located, STEPS_JUDGED)
    frames, count = *located.known.shape[:1], shapes.basis.shape[2]
    columns = np.concatenate(
        (
            np.broadcast_to(shapes.basis, (frames, *shapes.basis.shape)),
            -_crossed(posed.canonical),
            np.broadcast_to(EYE, posed.precisions.shape),
        ),
        -1,
    )  # (N, P, 3, Q + 6)
    expected = shapes.mean + np.einsum("pij,nj->npi", shapes.basis, posed.components)
    own = columns.mT @ posed.precisions @ columns
    without = np.linalg.inv(posed.curvature[:, None] - own + RIDGE * np.eye(count + 6))
    by_others = columns @ without @ columns.mT  # of the prediction
    errors = (posed.canonical - expected)[..., None]
    errors = (EYE + by_others @ posed.precisions) @ errors
    known = located.known
    covariances = np.full(posed.precisions.shape, np.nan)
    turns = np.broadcast_to(posed.rotations[:, None], covariances.shape)[known]
    noise = turns.mT @ np.linalg.inv(located.information[known]) @ turns
    covariances[known] = noise + by_others[known]
    return np.where(known[..., None], errors[..., 0], np.nan), covariances


def blocks_of(frames: int) -> Int64:
    """Return the block (N,) of each frame: neighbours are alike, and belong together."""
    count = min(MOST_BLOCKS, max(LEAST_BLOCKS, frames // LONGEST_BLOCK))
    return np.arange(frames) * count // frames


def learn_shapes_of(located: Located) -> LocatedShapes:
    """Learn shapes by expectation maximisation, from the principal components of the frames."""
    shapes = _start(located)
    known = located.known.astype(np.float64)
    seen = known.sum(0)[:, None, None]  # (P, 1, 1)
    posed = None
    for _ in range(ROUNDS):
        posed = _posed(shapes, located, STEPS_LEARNT, posed)
        z, count = posed.components, posed.components.shape[1]
        spread = np.linalg.inv(posed.curvature)[:, :count, :count]
        gain = shapes.left @ posed.precisions  # (N, P, 3, 3)
        expected = shapes.mean + np.einsum("pij,nj->npi", shapes.basis, z)
        offsets = (gain @ (posed.canonical - expected)[..., None])[..., 0]
        x = expected + offsets * known[..., None]
        carried = (EYE - gain) @ shapes.basis  # (N, P, 3, Q) of x by z
        by_spread = carried @ spread[:, None]
        # Regress every point on (1, z).
        inputs = np.concatenate((np.ones((len(z), 1)), z), 1)
        moments = inputs[:, :, None] * inputs[:, None]
        moments[:, 1:, 1:] += spread
        normal = np.einsum("np,nab->pab", known, moments) + RIDGE * np.eye(count + 1)
        across = np.einsum("np,npi,na->pia", known, x, inputs)
        across[..., 1:] += np.einsum("np,npir->pir", known, by_spread)
        solved = np.linalg.solve(normal, across.mT).mT  # (P, 3, Q + 1)
        within = shapes.left - gain @ shapes.left + by_spread @ carried.mT
        squares = np.einsum("np,npi,npj->pij", known, x, x)
        squares += np.einsum("np,npij->pij", known, within) - solved @ across.mT
        mean = np.where(seen[..., 0] > 0, solved[..., 0], shapes.mean)
        shapes = LocatedShapes(mean, solved[..., 1:], _pooled((squares + squares.mT) / 2, seen))
    return shapes


def _start(located: Located) -> LocatedShapes:
    """Align structures with their mean, and take their principal components."""
    known = located.known
    fullest = int(known.sum(1).argmax())
    mean = located.points[fullest] - located.points[fullest][known[fullest]].mean(0)
    there = known[fullest]
    for _ in range(ALIGNMENTS):
        rotations, translations = _aligned(located, mean, there)
        turned = (located.points - translations[:, None]) @ rotations
        counts = known.sum(0)[:, None]
        mean = (turned * known[..., None]).sum(0) / counts.clip(1)
        there = counts[:, 0] > 0
    apart = ((turned - mean) * known[..., None]).reshape(len(turned), -1)
    left, sizes, right = np.linalg.svd(apart, full_matrices=False)
    count = min(COMPONENTS, max(1, len(apart) // FRAMES_EACH), len(sizes))
    basis = right[:count].T * sizes[:count]
    rest = (apart - left[:, :count] @ basis.T).reshape(turned.shape)
    squares = np.einsum("npi,npj->pij", rest, rest)
    basis = (basis / np.sqrt(len(apart))).reshape(*mean.shape, count)
    return LocatedShapes(mean, basis, _pooled(squares, counts[..., None]))


def _pooled(squares: Float64, counts: Float64) -> Float64:
    """Return covariances (P, 3, 3) from sums of squares, pooled with that of all keypoints."""
    typical = squares.sum(0) / counts.sum()
    return np.asarray((squares + POOLED * typical) / (counts + POOLED) + RIDGE**2 * EYE)


def _aligned(located: Located, mean: Float64, there: Bool) -> tuple[Float64, Float64]:
    """Return rotations (N, 3, 3) and translations (N, 3) that put `mean` on the structures."""
    weights = (located.known & there)[..., None].astype(np.float64)
    weights /= weights.sum(1, keepdims=True).clip(1)
    centres = (weights * located.points).sum(1)
    middles = (weights * mean).sum(1)
    overlap = (weights * (located.points - centres[:, None])).mT @ (mean - middles[:, None])
    rotations = nearest_rotations(overlap)
    return rotations, centres - (rotations @ middles[..., None])[..., 0]


def _posed(
    shapes: LocatedShapes, located: Located, steps: int, start: _Posed | None = None
) -> _Posed:
    """Find poses and shapes of frames by Gauss-Newton steps, from aligned structures if need be."""
    frames, points, count = *located.known.shape, shapes.basis.shape[2]
    if start is None:
        rotations, translations = _aligned(located, shapes.mean, np.ones(points, bool))
        z = np.zeros((frames, count))
    else:
        rotations, translations, z = start[:3]
    fixed = np.concatenate(
        (
            np.broadcast_to(shapes.basis, (frames, *shapes.basis.shape)),
            np.zeros((frames, points, 3, 3)),
            np.broadcast_to(EYE, (frames, points, 3, 3)),
        ),
        -1,
    )
    unit = np.eye(count + 6) * np.where(np.arange(count + 6) < count, 1.0, RIDGE)
    for step in range(steps + 1):
        turned = rotations.mT[:, None] @ located.information @ rotations[:, None]
        precisions = turned @ np.linalg.inv(EYE + shapes.left @ turned)
        canonical = (located.points - translations[:, None]) @ rotations
        expected = shapes.mean + np.einsum("pij,nj->npi", shapes.basis, z)
        fixed[..., count : count + 3] = -_crossed(canonical)
        offsets = (canonical - expected)[..., None]
        weighted = (precisions @ fixed).reshape(frames, 3 * points, -1)
        curvature = fixed.reshape(weighted.shape).mT @ weighted + unit
        if step == steps:
            break
        pull = (weighted.mT @ offsets.reshape(frames, -1, 1))[..., 0]
        pull[:, :count] -= z
        move = np.linalg.solve(curvature, pull[..., None])[..., 0]
        turn = move[:, count : count + 3]
        longest = np.linalg.norm(turn, axis=1, keepdims=True) / LONGEST_TURN
        z = z + move[:, :count]
        translations = translations + (rotations @ move[:, count + 3 :, None])[..., 0]
        rotations = rotations @ rotations_from_vectors(turn / longest.clip(1))
    squared = (offsets.mT @ precisions @ offsets)[..., 0, 0].sum(1) + np.square(z).sum(1)
    return _Posed(rotations, translations, z, canonical, precisions, squared, curvature)


def _crossed(vectors: Float64) -> Float64:
    """Return matrices [v]x (..., 3, 3)."""
    return np.cross(vectors[..., None, :], EYE).mT


def _log_likelihood(shapes: LocatedShapes, located: Located) -> Float64:
    """Return the log likelihood (N,) of frames, with poses and shapes integrated out (Laplace)."""
    posed = _posed(shapes, located, STEPS_JUDGED)
    known, information = located.known, located.information

    def log_volumes(matrices: Float64) -> Float64:
        inside = np.where(known[..., None, None], matrices, EYE)
        return np.asarray(np.linalg.slogdet(inside).logabsdet.sum(1))

    middle = information.sum(1) / known.sum(1)[:, None, None]
    volumes = log_volumes(posed.precisions) - log_volumes(information)
    volumes += np.linalg.slogdet(middle).logabsdet - np.linalg.slogdet(posed.curvature).logabsdet
    degrees = 3 * known.sum(1) - 6
    fits = -(FRAME_FREEDOM + degrees) / 2 * np.log1p(posed.squared / FRAME_FREEDOM)
    return np.asarray(fits + volumes / 2)
