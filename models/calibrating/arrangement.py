"""Which cameras are static relative to each other: those that geometry finds, or all."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.calibrating.expectation_maximisation import learn
from models.calibrating.handedness import Corners, Handed, by_volume, certainty, odds_for
from models.calibrating.keypoint_rig import (
    LEAST_VIEWS,
    geometry_of,
    lens_kinds,
    start_from_geometry,
)
from models.calibrating.pair_lenses import settle_lenses
from models.calibrating.problem import CLEAR, CalibrationProblem, Solution
from models.epipolar.static_rig import StaticRig
from models.findings.advice import attempt_steps
from models.numerics.steps import Steps

Float64 = NDArray[np.float64]

# Figures: evidence/static-rigs.md.
MORE_NOISE = 1.4  # times the noise of moving cameras: with more, cameras are not static
LENS_ERRORS = 1e-3  # of the image's side: noise that lens models may add


class StaticViews(NamedTuple):
    """The static cameras, and why they are."""

    solution: Solution
    reason: str
    # Log odds (N,) of its handedness against the other, frame by frame, from each evidence.
    evidence: list[Float64]
    problem: CalibrationProblem  # with groups of alike lenses, and the lenses of two views
    # Standard deviations (K, VIEW) of cameras that were estimated from the rigid scene rather than
    # with shapes; infinite for the others. None: no camera was.
    kept: Float64 | None = None


def find_static(
    problem: CalibrationProblem,
    handed: Handed,
    moving: Solution,
    *,
    declared: bool,
    hint: Corners | None,
) -> Steps[StaticViews]:
    """Find which views are static relative to each other, and estimate their poses.

    Views are static if they are `declared` to be, or if geometry finds that all are. Otherwise all
    are tried together, unless two of them certainly move, and then those that geometry finds
    static. They count as static if they leave little more noise than moving cameras do: errors that
    a detector repeats look like a small motion, and static cameras are determined far better.

    The `hint` are four keypoints that determine the handedness (see `choose_handedness`); `handed`
    is the solution from which the `moving` one was learnt.
    """
    geometry = yield from geometry_of(problem, declared=declared)
    found = geometry.rig
    certain = declared or (found is not None and bool(found.static.all()))
    if not (certain or geometry.moves) and len(problem.poses) >= LEAST_VIEWS:
        every = yield from attempt_steps(geometry_of(problem, declared=True), geometry)
        static = yield from _joined(problem, handed, moving, every.rig, hint)
        if static is not None and _quiet(problem, static.solution, moving):
            return static
    static = yield from _joined(problem, handed, moving, found, hint)
    if static is None or not (certain or _quiet(problem, static.solution, moving)):
        reason = "no two static cameras explain the keypoints as well as moving ones"
        return StaticViews(moving, reason, [handed.log_odds], problem)
    if declared:
        static = static._replace(reason=f"the cameras were declared static; {static.reason}")
    return static


def _quiet(problem: CalibrationProblem, static: Solution, moving: Solution) -> bool:
    """Whether static cameras leave little more noise than moving ones."""
    most = math.hypot(MORE_NOISE * moving.measured_noise, LENS_ERRORS * problem.side)
    return static.measured_noise < most


def _joined(
    problem: CalibrationProblem,
    handed: Handed,
    moving: Solution,
    found: StaticRig | None,
    hint: Corners | None,
) -> Steps[StaticViews | None]:
    """Learn shapes with the static cameras that geometry found; None if it found none."""
    started = None if found is None else start_from_geometry(problem, found, moving)
    if found is None or started is None:
        return None
    as_given = None if hint is None else by_volume(found, hint)
    if as_given is not None:
        found = as_given
    elif certainty([found.log_odds, odds_for(started[0], handed)]) < 0.5:
        found = found.mirrored()
    try:
        return (yield from _learnt(problem, handed, moving, found))
    except np.linalg.LinAlgError:  # they are not determined
        return None


def _learnt(
    problem: CalibrationProblem, handed: Handed, moving: Solution, found: StaticRig
) -> Steps[StaticViews]:
    """Learn shapes and moving cameras with the static ones, which have their handedness."""
    problem, found = yield from settle_lenses(problem, found)
    started = start_from_geometry(problem, found, moving)
    if started is None:
        raise np.linalg.LinAlgError("no structure can be located")
    start, deviations = started
    views = np.flatnonzero(found.static).tolist()
    noise = found.noise * problem.side
    kept = None if problem.lens_posterior is None else deviations
    if len(views) >= LEAST_VIEWS:
        problem = problem._replace(lens_groups=lens_kinds(problem, found))
        # Noisy structures are adjusted towards the shape model, and focal lengths follow: they come
        # out 5 to 20 % short. Points of a rigid scene that three views see have no such prior.
        if max(noise, moving.measured_noise) > CLEAR * problem.size:
            kept = deviations
    held = np.zeros(len(found.static), bool) if kept is None else found.static
    solution = yield from learn(problem._replace(kept=held), start)
    reason = f"keypoints are one rigid scene of the static cameras {views}, to {noise:.3g} px"
    evidence = [found.log_odds, odds_for(solution, handed)]
    return StaticViews(solution, reason, evidence, problem, kept)
