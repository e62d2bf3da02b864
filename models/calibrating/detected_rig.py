"""Static cameras, adjusted to keypoints as they were detected and to constant lengths.

Removing noise and learning shapes pull keypoints towards their usual positions, and cameras follow:
with two views, focal lengths come out 5 to 20 % short, or long.
`models.bundle.instrumental_equations` explains how this bias is avoided. Two views alone hardly
determine their focal lengths. Edges of a skeleton do, because they have the same length in every
direction.
"""

import math

import numpy as np
from numpy.typing import NDArray

from models.bundle.adjustment import BENDING, CENTRE, TRANSLATION, RigPrior, move_rig
from models.bundle.instrumental_equations import (
    InstrumentalEquations,
    NoisyFrames,
    linearise_at_clear,
    triangulate_clear,
)
from models.bundle.problem import VIEW, Rig
from models.numerics.random_effects import random_effects
from models.numerics.steps import Steps
from models.numerics.tiny import TINY

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

# Figures: evidence/lenses.md.
ROUNDS = 30  # of linearising, at most
CONVERGED, LONGEST_STEP = 1e-3, 0.15  # radians, logarithms and baselines, in a round
MOST_NUMBERS = 8_000_000  # of derivatives: 64 MB
MOST_EDGES = 128  # that are used: each frame has a matrix of as many rows
GAUGE = 1e6  # inverse variance of the overall size, which is undetermined
# Lengths are in units of each edge's usual length.
LEAST_SCATTER = 0.02  # keypoints do not sit on bones, so no length is held tighter
LEAST_FRAMES = 40  # that show an edge
UNKNOWN = 1e12  # variance of a length that was not measured


def adjust_to_detected(
    frames: NoisyFrames, edges: Int64, rig: Rig, believed: RigPrior
) -> Steps[tuple[Rig, Float64] | None]:
    """Adjust the free numbers of static cameras, and yield after every round.

    Parameters
    ----------
    frames
        All frames; if they are too many for the memory they are thinned out, and so are edges.
    edges
        (E, 2) keypoints whose distances may be constant; their scatter is learnt.
    rig
        The start. Its static views are one group.
    believed
        The prior of the rig, with its free numbers.

    Returns
    -------
    The rig, and its standard deviations (K, VIEW), infinite for views that move; None if rounds do
    not converge.

    Raises
    ------
    numpy.linalg.LinAlgError
        When free numbers are not determined.
    """
    static = rig.static
    edges = edges[:: max(1, -(-len(edges) // MOST_EDGES))]
    frames = _thinned(frames, max(3 * frames.weights.shape[2], len(edges)) * VIEW * len(static))
    free = believed.free & np.repeat(static, VIEW)
    points = triangulate_clear(frames, rig)
    for _ in range(ROUNDS):
        equations = linearise_at_clear(frames, rig, points)
        if not np.isfinite(equations.by_shared).all():  # points ran away along parallel rays
            return None
        of_edges, right = _equations_of_edges(equations, points, edges)
        growing = _growing(rig)
        information = equations.information + of_edges + believed.precision
        information += GAUGE * np.outer(growing, growing)
        right += equations.right - believed.precision @ believed.offset(rig)
        inner = information[np.ix_(free, free)]
        step = np.zeros(len(free))
        step[free] = np.linalg.solve(inner, right[free])
        if not np.isfinite(step).all():
            return None
        longest = float(np.abs(step.reshape(-1, VIEW) / _units(rig)).max())
        step *= min(1.0, LONGEST_STEP / max(longest, TINY))
        points = points + equations.clear_moves + equations.by_shared @ step
        rig = move_rig(rig, step)
        yield
        if longest < CONVERGED:
            variances = np.where(np.repeat(static, VIEW), 0.0, np.inf)
            variances[free] = np.linalg.inv(inner).diagonal()
            return rig, np.sqrt(variances).reshape(-1, VIEW)
    return None


def _thinned(frames: NoisyFrames, numbers: int) -> NoisyFrames:
    """Return so many frames that all have at most `MOST_NUMBERS` together."""
    every = math.ceil(len(frames.weights) * numbers / MOST_NUMBERS)
    return NoisyFrames(
        frames.clear[::every], frames.detected[::every], frames.weights[::every], frames.noise
    )


def _growing(rig: Rig) -> Float64:
    """Return the unit vector (T,) along which the whole rig grows about its first camera."""
    first, growing = int(rig.static.argmax()), np.zeros((len(rig.groups), VIEW))
    centre = -rig.rotations[first].T @ rig.translations[first]
    growing[:, TRANSLATION] = (rig.rotations @ centre + rig.translations) * rig.static[:, None]
    growing /= max(float(np.linalg.norm(growing)), TINY)
    return growing.ravel()


def _units(rig: Rig) -> Float64:
    """Return the scales (K, VIEW) of the numbers of every view."""
    units = np.ones((len(rig.groups), VIEW))
    units[:, CENTRE] = rig.lenses.focals
    units[:, TRANSLATION] = np.linalg.norm(rig.translations[rig.static], axis=1).max()
    return units


def _equations_of_edges(
    equations: InstrumentalEquations, points: Float64, edges: Int64
) -> tuple[Float64, Float64]:
    """Return matrix (T, T) and right-hand side (T,) of edges of constant length.

    Lengths are measured along the direction of an edge in clear points. They are relative to the
    whole, and subjects may differ in size from frame to frame.
    """
    a, b = edges.T
    known = equations.measured[:, a] & equations.measured[:, b]  # (N, E)
    often = known.sum(0) >= LEAST_FRAMES
    a, b, known = a[often], b[often], known[:, often]
    if not len(a):
        return np.zeros_like(equations.information), np.zeros_like(equations.right)
    along = np.where(known[..., None], points[:, a] - points[:, b], 1.0)  # (N, E, 3)
    lengths = np.linalg.norm(along, axis=-1).clip(TINY)
    usual = lengths.mean(0, where=known)  # (E,)
    along /= (lengths * usual)[..., None]
    lengths /= usual
    moves = equations.detected_moves[:, a] - equations.detected_moves[:, b]
    measured = np.where(known, lengths + (along * moves).sum(-1), 0.0)
    weights = _weights_of_edges(measured, known, _covariances(along, a, b, equations.covariances))
    derived = along[..., None, :] @ (equations.by_shared[:, a] - equations.by_shared[:, b])
    derived = derived[..., 0, :]  # (N, E, T)
    # Subjects that differ in size in different places look like distortion.
    derived.reshape(*known.shape, -1, VIEW)[..., BENDING] = 0
    derived = derived - lengths[..., None] * derived.mean((0, 1), where=known[..., None])
    rows = np.concatenate((derived, measured[..., None]), -1)  # (N, E, T + 1)
    weighted, width = weights @ rows, rows.shape[-1]
    products = rows.reshape(-1, width).T @ weighted.reshape(-1, width)
    # The usual lengths are eliminated: they are estimated from the measured ones.
    by_lengths = weighted.sum(0)  # (E, T + 1)
    products -= by_lengths.T @ np.linalg.solve(weights.sum(0), by_lengths)
    return products[:-1, :-1], -products[:-1, -1]


def _weights_of_edges(measured: Float64, known: NDArray[np.bool_], covariances: Float64) -> Float64:
    """Return inverse covariances (N, E, E) of lengths (N, E): those of noise and true variation."""
    variances = np.where(known, covariances.diagonal(axis1=1, axis2=2), np.inf)
    means, scatter = random_effects(measured, variances)
    every = np.arange(len(means))
    covariances[:, every, every] += scatter**2 + LEAST_SCATTER**2 + np.where(known, 0, UNKNOWN)
    weights = np.asarray(np.linalg.inv(covariances), np.float64)
    there = known.any(1)
    of_frame = weights[there].sum((1, 2))[:, None]
    sizes = (weights[there].sum(1) * (measured - means)[there]).sum(1, keepdims=True) / of_frame
    _, spread = random_effects(sizes, 1 / of_frame)
    if spread[0] > 0:
        weights = np.asarray(np.linalg.inv(covariances + spread[0] ** 2), np.float64)
    return weights


def _covariances(along: Float64, a: Int64, b: Int64, of_points: Float64) -> Float64:
    """Return covariances (N, E, E) of lengths along directions; edges may share points."""
    covariances = np.zeros((len(along), len(a), len(a)))
    for p in range(of_points.shape[1]):
        edges = np.flatnonzero((a == p) | (b == p))
        if len(edges):
            ends = along[:, edges] * np.where(a[edges] == p, 1.0, -1.0)[:, None]  # (N, e, 3)
            covariances[:, edges[:, None], edges] += ends @ of_points[:, p] @ ends.mT
    return covariances
