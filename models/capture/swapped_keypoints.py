"""Swapping back left and right keypoints that a detector took for each other in single views.

The other views of the frame and the outlier model predict where a left and a right keypoint are.
If a view has them the other way round, swapping them makes the frame far more probable. Which
keypoints are left and right of each other is learnt: the pairs that gain most by a swap.
"""

import numpy as np
from numpy.typing import NDArray

from models.capture.observations import Observations, as_observations, pixels_of, with_frames
from models.capture.outlier_kernels import (
    Judge,
    Predictor,
    Prepared,
    make_predictor,
    predictor_into,
)
from models.numerics.compiled import compiled, inner
from models.numerics.threads import in_slices

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]
Int64 = NDArray[np.int64]

# Figures: evidence/keypoints.md.
SURE = 20.0  # twice the log likelihood ratio of a frame put right and as it was
LITTLE = 4.0  # that of one more pair of keypoints
LIKELY = 12.0  # that from which a frame counts for a pair being left and right
NEAR = 6.0  # squared errors, in variances, of keypoints that are where they should be
LEAST_TIMES = 3  # that two keypoints must have changed places to be known as left and right
CLEARLY = 3.0  # times as much as with any other keypoint they must gain by it
MOST_GAIN = 60.0  # of one frame that counts for that
LEAST_VIEWS = 2  # that show a frame: one view alone may as well show it from behind
MOST_TRIALS = 3_000_000  # of two keypoints in a frame, to find pairs: a second or two
FRAMES_AT_A_TIME = 64  # that a thread puts right


def put_right(
    judge: Judge, prepared: Prepared, pairs: Int64, observations: Observations
) -> tuple[Observations, Bool]:
    """Swap back keypoints that were swapped; return also which these are (N, K, P).

    Frames that fewer than two views show stay as they are, and so do pairs (S, 2) of which not
    both are observed.
    """
    swapped = np.zeros(observations.weights.shape, np.bool_)
    if not len(pairs):
        return observations, swapped
    pixels, observed = pixels_of(observations)

    def mend(part: slice) -> None:
        swap_back(judge, prepared, pairs, pixels[part], observed[part], swapped[part])

    in_slices(len(pixels), FRAMES_AT_A_TIME, mend)
    if not swapped.any():
        return observations, swapped
    partners = np.arange(observed.shape[-1])
    partners[pairs] = pairs[:, ::-1]
    weights = np.where(swapped, observations.weights[..., partners], observations.weights)
    changed: Bool = np.logical_or.reduce(swapped, axis=(1, 2))
    shown = np.where(observed[changed][..., None], pixels[changed], np.nan)
    mended = as_observations(shown, weights[changed])
    return with_frames(observations, changed, mended), swapped


def find_pairs(judge: Judge, prepared: Prepared, observations: Observations) -> Int64:
    """Return the pairs of keypoints (S, 2) that a detector took for each other in some frames.

    Such a pair gains more likelihood by a swap than either keypoint does with any other.
    """
    pixels, observed = pixels_of(observations)
    count = observed.shape[-1]
    chosen = slice(None, None, max(1, len(pixels) * count**2 // MOST_TRIALS))
    gains, times = np.zeros((count, count)), np.zeros((count, count), np.int64)
    gains_by_pairs(judge, prepared, pixels[chosen], observed[chosen], gains, times)
    gains += gains.T
    ordered = np.sort(gains, axis=1)
    rivals = np.maximum(*np.ix_(ordered[:, -2], ordered[:, -2]))  # of a pair that is best for both
    best = gains >= np.maximum(*np.ix_(ordered[:, -1], ordered[:, -1]))
    found: Int64 = np.argwhere(best & (gains > CLEARLY * rivals) & (times >= LEAST_TIMES))
    return found


@compiled
def swap_back(
    judge: Judge, prepared: Prepared, pairs: Int64, pixels: Float64, observed: Bool, swapped: Bool
) -> None:
    """Swap keypoints back in `pixels`, and write which were swapped (N, K, P).

    Parameters
    ----------
    pairs
        (S, 2) keypoints that are left and right of each other.
    pixels, observed
        (N, K, P, 2), and (N, K, P) whether each was observed. A pair is moved only if both are.
    """
    frames, views, count, _ = pixels.shape
    size = len(judge.products)
    own = make_predictor((views, count), size)
    offsets, scores = np.empty(2 * views * count), np.empty(size)
    turned = np.empty(len(pairs), np.bool_)
    for n in range(frames):
        if not _frame_into(judge, pixels[n], observed[n], offsets):
            continue
        factors = _factors_of(judge, prepared, observed[n], own)
        energy = _energy(judge, factors, offsets, scores)
        for _ in range(views):
            where, best = _best_turns(
                judge, factors, pairs, observed[n], offsets, scores, energy, turned
            )
            usual = max(best / (2 * observed[n].sum()), 1.0)
            if energy - best < SURE * usual:
                break
            for i in range(len(pairs)):
                if turned[i]:
                    _turn(judge, factors, where, pairs[i], offsets, scores)
                    for p in pairs[i]:
                        swapped[n, where, p] = not swapped[n, where, p]
            energy = best
        _move_into(judge, swapped[n], offsets, pixels[n])


@inner
def _best_turns(
    judge: Judge,
    factors: Float64,
    pairs: Int64,
    observed: Bool,
    offsets: Float64,
    scores: Float64,
    energy: float,
    turned: Bool,
) -> tuple[int, float]:
    """Return the view in which swapping pairs helps most, and the energy then; write which pairs.

    In every view the search starts twice: with no pair swapped, and with all observed ones.
    """
    trial, trial_scores = np.empty(len(offsets)), np.empty(len(scores))
    tried, best, where = np.empty(len(pairs), np.bool_), energy, 0
    turned[:] = False
    for k in range(len(observed)):
        for start in range(2):
            trial[:], trial_scores[:], tried[:] = offsets, scores, False
            reached = energy
            for i in range(start * len(pairs)):
                if observed[k, pairs[i, 0]] and observed[k, pairs[i, 1]]:
                    reached += _turn(judge, factors, k, pairs[i], trial, trial_scores)
                    tried[i] = True
            reached += _descend(judge, factors, k, pairs, observed, trial, trial_scores, tried)
            if reached < best:
                best, where = reached, k
                turned[:] = tried
    return where, best


@inner
def _move_into(judge: Judge, swapped: Bool, offsets: Float64, pixels: Float64) -> None:
    """Write the new pixels of swapped keypoints (K, P)."""
    views, count = swapped.shape
    for k in range(views):
        for p in range(count):
            if swapped[k, p]:
                for i in range(2):
                    d = 2 * (k * count + p) + i
                    pixels[k, p, i] = offsets[d] + judge.mean[k, p, i]


@compiled
def gains_by_pairs(
    judge: Judge, prepared: Prepared, pixels: Float64, observed: Bool, gains: Float64, times: Int64
) -> None:
    """Sum the gains of swapping two keypoints of a view, (P, P) above the diagonal.

    A gain is twice the log likelihood ratio of a frame. Only gains above `LIKELY` count; `times`
    counts these frames. The other parameters are those of `swap_back`.
    """
    frames, views, count, _ = pixels.shape
    size = len(judge.products)
    own = make_predictor((views, count), size)
    offsets, scores = np.empty(2 * views * count), np.empty(size)
    trial, trial_scores = np.empty(2 * views * count), np.empty(size)
    pair = np.empty(2, np.int64)
    for n in range(frames):
        if not _frame_into(judge, pixels[n], observed[n], offsets):
            continue
        factors = _factors_of(judge, prepared, observed[n], own)
        energy = _energy(judge, factors, offsets, scores)
        for k in range(views):
            for p in range(count):
                for q in range(p + 1, count):
                    if observed[n, k, p] and observed[n, k, q]:
                        pair[0], pair[1] = p, q
                        gain = -_change(judge, factors, k, pair, offsets, scores)
                        usual = max((energy - gain) / (2 * observed[n].sum()), 1.0)
                        if gain < LIKELY * usual:
                            continue
                        trial[:], trial_scores[:] = offsets, scores
                        _turn(judge, factors, k, pair, trial, trial_scores)
                        if _suits(judge, factors, k, pair, trial, trial_scores, usual):
                            gains[p, q] += min(gain / usual, MOST_GAIN)
                            times[p, q] += 1


@inner
def _frame_into(judge: Judge, pixels: Float64, observed: Bool, offsets: Float64) -> bool:
    """Write offsets (D,) from the mean, 0 where not observed; return if enough views show it."""
    views, count = observed.shape
    shown = 0
    for k in range(views):
        shown += observed[k].any()
        for p in range(count):
            for i in range(2):
                d = 2 * (k * count + p) + i
                offsets[d] = pixels[k, p, i] - judge.mean[k, p, i] if observed[k, p] else 0.0
    return shown >= LEAST_VIEWS


@inner
def _factors_of(judge: Judge, prepared: Prepared, observed: Bool, own: Predictor) -> Float64:
    """Return the factors of the predictor from all observed keypoints (K, P); `own` is a buffer."""
    if observed.all():
        return prepared.fine.factors
    predictor_into(judge, judge.noises[-1], observed, own)
    return own.factors


@inner
def _energy(judge: Judge, factors: Float64, offsets: Float64, scores: Float64) -> float:
    """Return minus twice the log likelihood of a frame, up to a constant, and write F y (Q,)."""
    size = len(scores)
    total = 0.0
    for d in range(len(offsets)):
        total += offsets[d] ** 2
    for j in range(size):
        row = factors[j, size:]
        scores[j] = 0.0
        for d in range(len(offsets)):
            scores[j] += row[d] * offsets[d]
        total -= scores[j] ** 2
    energy: float = total / judge.noises[-1] ** 2
    return energy


@inner
def _moved(judge: Judge, k: int, pair: Int64, offsets: Float64, i: int) -> tuple[int, int, float]:
    """Return the indices of x or y of two keypoints, and how far a swap moves them."""
    count = judge.scales.shape[1]
    a, b = 2 * (k * count + pair[0]) + i, 2 * (k * count + pair[1]) + i
    apart = offsets[b] + judge.mean[k, pair[1], i] - offsets[a] - judge.mean[k, pair[0], i]
    return a, b, apart


@inner
def _change(
    judge: Judge, factors: Float64, k: int, pair: Int64, offsets: Float64, scores: Float64
) -> float:
    """Return the change of the energy if two keypoints of a view are swapped."""
    size = len(scores)
    ax, bx, x = _moved(judge, k, pair, offsets, 0)
    ay, by, y = _moved(judge, k, pair, offsets, 1)
    change = 2 * x * (offsets[ax] - offsets[bx] + x) + 2 * y * (offsets[ay] - offsets[by] + y)
    for j in range(size):
        row = factors[j, size:]
        more = (row[ax] - row[bx]) * x + (row[ay] - row[by]) * y
        change -= more * (2 * scores[j] + more)
    change /= judge.noises[-1] ** 2
    return float(change)


@inner
def _turn(
    judge: Judge, factors: Float64, k: int, pair: Int64, offsets: Float64, scores: Float64
) -> float:
    """Swap two keypoints of a view; return the change of the energy."""
    size, change = len(scores), _change(judge, factors, k, pair, offsets, scores)
    for i in range(2):
        a, b, apart = _moved(judge, k, pair, offsets, i)
        offsets[a] += apart
        offsets[b] -= apart
        for j in range(size):
            scores[j] += (factors[j, size + a] - factors[j, size + b]) * apart
    return change


@inner
def _suits(
    judge: Judge,
    factors: Float64,
    k: int,
    pair: Int64,
    offsets: Float64,
    scores: Float64,
    usual: float,
) -> bool:
    """Return whether two keypoints of a view are where all others of the frame predict them."""
    count, size = judge.scales.shape[1], len(scores)
    for p in pair:
        squared = 0.0
        for i in range(2):
            d = 2 * (k * count + p) + i
            residual = offsets[d]
            for j in range(size):
                residual -= factors[j, size + d] * scores[j]
            squared += residual**2
        if squared > NEAR * usual * judge.noises[-1] ** 2:
            return False
    return True


@inner
def _descend(
    judge: Judge,
    factors: Float64,
    k: int,
    pairs: Int64,
    observed: Bool,
    offsets: Float64,
    scores: Float64,
    turned: Bool,
) -> float:
    """Swap pairs of a view as long as that makes the frame more probable; return the change."""
    total = 0.0
    for _ in range(2 * len(pairs)):
        best, which = -LITTLE, -1
        for i in range(len(pairs)):
            if observed[k, pairs[i, 0]] and observed[k, pairs[i, 1]]:
                change = _change(judge, factors, k, pairs[i], offsets, scores)
                if change < best:
                    best, which = change, i
        if which < 0:
            break
        total += _turn(judge, factors, k, pairs[which], offsets, scores)
        turned[which] = not turned[which]
    return total
