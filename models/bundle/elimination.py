"""Eliminating frames: their normal equations reduced to the shared numbers, compiled.

Points are eliminated first (Schur complement), then each frame's poses and shape, so the cost is
linear in frames and points (Triggs et al., *Bundle Adjustment: A Modern Synthesis*, 2000; Hartley &
Zisserman, *Multiple View Geometry*, app. 6).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle.frame_equations import (
    NormalEquations,
    back_substitute,
    eliminate,
    equations_of_frame,
    make_equations,
)
from models.bundle.separate_frames import FRAMES_AT_A_TIME
from models.numerics.compiled import compiled, inner
from models.numerics.matrices import cholesky, cholesky_solve, copy, fill
from models.numerics.threads import empty_aligned, in_slices

Float64 = NDArray[np.float64]


class Reduced(NamedTuple):
    """The equations of N frames for the T free numbers that they share, and their own steps.

    If a frame's equations are not positive definite, all its numbers are 0, and it stays as it is.
    """

    information: Float64  # (N, T, T)
    right: Float64  # (N, T) right-hand side: minus half of the gradient
    points: Float64  # (N, P, 3) step of the points with the shared numbers held
    points_by_shared: Float64  # (N, P, 3, T) its derivative by the shared numbers
    others: Float64  # (N, R) step of the poses and components, likewise
    others_by_shared: Float64  # (N, R, T)


def eliminate_frames(
    equations: NormalEquations, free: NDArray[np.bool_], damping: float
) -> Reduced:
    """Eliminate points, then the R other unknowns of each frame; keep the `free` (T,) ones."""
    frames, count, _, columns = equations.coupling.shape
    size, shared = columns - len(free), int(free.sum())
    kept = np.concatenate((np.arange(size), size + np.flatnonzero(free)))
    reduced = Reduced(
        empty_aligned(frames, shared, shared),
        empty_aligned(frames, shared),
        empty_aligned(frames, count, 3),
        empty_aligned(frames, count, 3, shared),
        empty_aligned(frames, size),
        empty_aligned(frames, size, shared),
    )
    in_slices(
        frames,
        FRAMES_AT_A_TIME,
        lambda part: _eliminate_frames(equations, kept, part.start, part.stop, damping, reduced),
    )
    return reduced


@compiled
def _eliminate_frames(
    equations: NormalEquations,
    kept: NDArray[np.int64],
    start: int,
    stop: int,
    damping: float,
    out: Reduced,
) -> None:
    count, columns = equations.coupling.shape[1], len(kept)
    size, shared = out.others_by_shared.shape[1], out.others_by_shared.shape[2]
    own, inverses = make_equations(count, columns), np.empty((count, 3, 3))
    complement, right = np.empty((columns, columns)), np.empty(columns)
    factor, answers = np.empty((size, size)), np.empty((shared + 1, size))
    for n in range(start, stop):
        frame = _reduced_of_frame(out, n)
        _keep(equations_of_frame(equations, n), kept, own)
        eliminate(own, damping, inverses, complement, right)
        for a in range(size):
            for b in range(a + 1):
                factor[a, b] = complement[a, b]
        if not cholesky(factor):
            _leave_out(frame)
            continue
        # One right-hand side for each shared number, and the frame's own at the end.
        for a in range(shared + 1):
            copy(complement[size + a, :size] if a < shared else right[:size], answers[a])
            cholesky_solve(factor, answers[a])
        _reduce(complement, right, answers, frame)
        back_substitute(own, inverses, frame.others, frame.points)
        _points_by_shared(own, inverses, frame)


@inner
def _reduced_of_frame(reduced: Reduced, n: int) -> Reduced:
    return Reduced(
        reduced.information[n],
        reduced.right[n],
        reduced.points[n],
        reduced.points_by_shared[n],
        reduced.others[n],
        reduced.others_by_shared[n],
    )


@inner
def _leave_out(frame: Reduced) -> None:
    fill(frame.information, 0)
    fill(frame.right, 0)
    fill(frame.points, 0)
    fill(frame.points_by_shared, 0)
    fill(frame.others, 0)
    fill(frame.others_by_shared, 0)


@inner
def _keep(source: NormalEquations, kept: NDArray[np.int64], out: NormalEquations) -> None:
    """Write the equations of some of the unknowns besides the points, as if others were zero."""
    copy(source.points, out.points)
    copy(source.points_right, out.points_right)
    for a in range(len(kept)):
        out.others_right[a] = source.others_right[kept[a]]
        for b in range(len(kept)):
            out.others[a, b] = source.others[kept[a], kept[b]]
        for p in range(len(source.points)):
            for i in range(3):
                out.coupling[p, i, a] = source.coupling[p, i, kept[a]]


@inner
def _reduce(complement: Float64, right: Float64, answers: Float64, frame: Reduced) -> None:
    """Write the frame's own step and the equations of the shared, from the solved (T + 1, R)."""
    size, shared = len(frame.others), len(frame.right)
    others = answers[shared]
    copy(others, frame.others)
    for a in range(shared):
        link = complement[size + a]  # (R + T,)
        frame.right[a] = right[size + a] - _dot(link, others)
        for b in range(a + 1):
            frame.information[a, b] = link[size + b] - _dot(link, answers[b])
            frame.information[b, a] = frame.information[a, b]
        for b in range(size):
            frame.others_by_shared[b, a] = -answers[a, b]


@inner
def _points_by_shared(own: NormalEquations, inverses: Float64, frame: Reduced) -> None:
    """Write the derivative of the points' step by the shared: inverse blocks times the coupling."""
    size, shared = len(frame.others), len(frame.right)
    pull = np.empty((3, shared))
    for p in range(len(frame.points)):
        for i in range(3):
            row = pull[i]
            for a in range(shared):
                row[a] = -own.coupling[p, i, size + a]
            for b in range(size):
                coupling = own.coupling[p, i, b]
                answer = frame.others_by_shared[b]
                for a in range(shared):
                    row[a] -= coupling * answer[a]
        for i in range(3):
            x, y, z = inverses[p, i, 0], inverses[p, i, 1], inverses[p, i, 2]
            for a in range(shared):
                frame.points_by_shared[p, i, a] = x * pull[0, a] + y * pull[1, a] + z * pull[2, a]


@inner
def _dot(a: Float64, b: Float64) -> float:
    """Return the sum of products of the numbers of two arrays, as many as `b` has."""
    total = 0.0
    for i in range(len(b)):
        total += a[i] * b[i]
    return total
