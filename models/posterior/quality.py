"""How far a frame may be relied on, against the frames of the fit.

Three figures of a frame are compared with what nine in ten frames of the fit are below: how large
the deviations of its points are, how far its keypoints lie from where its cameras see these points,
and how unlike the shapes of the fit its structure is.
"""

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from models.numerics.compiled import compiled, inner
from models.numerics.matrices import cholesky, cholesky_solve
from models.posterior.frame import middle_of
from models.posterior.frames import Frames, LearntShapes

Bool = NDArray[np.bool_]
Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
UInt8 = NDArray[np.uint8]

Reason = Literal["little_evidence", "views_disagree", "unlike_fit", "no_evidence"]
REASONS: tuple[Reason, ...] = ("little_evidence", "views_disagree", "unlike_fit", "no_evidence")
NO_EVIDENCE = len(REASONS)  # as in `judge`: 0 is no reason
DOUBTFUL = 0.5  # a quality below this has a reason
FIGURES = 3
USUAL_SHARE = 0.9  # of the frames of a fit, that are below the usual figures
# Frames of captures without noise differ by more than they need to: deviations of a hundredth of
# the radius, and a third of the misfits that noise and shapes let expect.
LEAST_USUAL = (0.01, 0.3, 0.3)
FURTHEST = 2.0  # root-mean-square radii of the structure: half of a person's height


@compiled
def judge(
    points: Float32, sds: Float32, figures: Float64, usual: Float64
) -> tuple[Float32, UInt8, Bool]:
    """Return the quality (N,) of frames, its reasons (N,), and which points (N, P) are nowhere.

    A frame whose figures are at most the usual ones has quality 1. Else it is the root of the
    product of the usual figures over its own, as far as they are larger. It is 0 without a
    structure, and NaN where a figure is. A reason is a place in `REASONS`, from 1, or 0.

    Parameters
    ----------
    points, sds
        (N, P, 3), and (N, P) their deviations.
    figures, usual
        (N, 3), and (3,) those that nine in ten frames of the fit are below; 0 if not known.
    """
    frames, count = sds.shape
    quality, reasons = np.empty(frames, np.float32), np.zeros(frames, np.uint8)
    nowhere = np.zeros((frames, count), np.bool_)
    for n in range(frames):
        there, squared, worst, product = False, 0.0, 0.0, 1.0
        for p in range(count):
            for i in range(3):
                there = there or not math.isnan(points[n, p, i])
                squared += points[n, p, i] ** 2 / count  # points are centred
        for p in range(count):
            nowhere[n, p] = sds[n, p] > FURTHEST * math.sqrt(squared)
        for f in range(FIGURES):
            expected = max(usual[f], LEAST_USUAL[f]) if usual[f] > 0 else math.nan
            excess = figures[n, f] / expected
            if not excess <= 1:  # NaN, too
                product *= excess
                if excess > worst:
                    worst, reasons[n] = excess, f + 1
        quality[n] = 1 / math.sqrt(product) if there else 0.0
        if not there:
            reasons[n] = NO_EVIDENCE
        elif not quality[n] < DOUBTFUL:
            reasons[n] = 0
    return quality, reasons, nowhere


@inner
def write_figures(
    frames: Frames, n: int, shapes: LearntShapes, factor: Float64, sds: Float32, out: Float64
) -> None:
    """Write the figures (3,) of a frame; `factor` is that of `factor_of_shapes`, `sds` are (P,)."""
    points, turned = frames.points[n], frames.turned[n]
    count, _, size = shapes.basis.shape
    centre, middle, scaled = middle_of(points), middle_of(shapes.mean), 0.0
    for i in range(3):
        for j in range(3):
            scaled += turned[i, j] ** 2 / 3
    squared, variance, unlike, along = 0.0, 0.0, 0.0, np.zeros(size)
    for p in range(count):
        variance += sds[p] ** 2
        for i in range(3):
            squared += (points[p, i] - centre[i]) ** 2
            off = middle[i] - shapes.mean[p, i]
            for j in range(3):
                off += turned[j, i] * (points[p, j] - centre[j]) / scaled
            unlike += off * off / shapes.variances[p]
            for q in range(size):
                along[q] += shapes.basis[p, i, q] * off / shapes.variances[p]
    explained = along.copy()
    cholesky_solve(factor, explained)
    for q in range(size):
        unlike -= along[q] * explained[q]
    out[0] = np.sqrt(variance / squared) if squared > 0 else np.nan
    out[1] = frames.misfits[n]
    out[2] = unlike / (3 * count)


@inner
def factor_of_shapes(shapes: LearntShapes) -> Float64:
    """Return the Cholesky factor (Q, Q) of I + B^T B / eta^2, the information on z."""
    count, _, size = shapes.basis.shape
    factor = np.eye(size)
    for p in range(count):
        for i in range(3):
            for q in range(size):
                for r in range(q + 1):
                    product = shapes.basis[p, i, q] * shapes.basis[p, i, r]
                    factor[q, r] += product / shapes.variances[p]
    cholesky(factor)
    return factor
