"""Which cameras are static relative to each other, by the geometry of the keypoints alone."""

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
from models.calibrating.lens_scan import scan_lenses
from models.calibrating.problem import CLEAR, CalibrationProblem, Solution
from models.epipolar.static_rig import StaticRig
from models.numerics.steps import Steps

Float64 = NDArray[np.float64]

MORE_NOISE = 1.4  # times the noise of moving cameras: with less, small motions are no motions
LENS_ERRORS = 1e-3  # of the image's side: noise that lens models may add


class StaticViews(NamedTuple):
    """The static cameras, and why they are."""

    solution: Solution
    reason: str
    # Log odds (N,) of its handedness against the other, frame by frame, from each evidence.
    evidence: list[Float64]
    lens_groups: NDArray[np.int64]  # (K,) views of one number have alike lenses
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

    Views that are `declared` static are joined in any case. Otherwise they are those that geometry
    finds, or all, if this leaves little more noise than moving cameras do: errors that a detector
    repeats look like a small motion, and static cameras are determined far better.

    The `hint` are four keypoints that determine the handedness (see `choose_handedness`); `handed`
    is the solution from which the `moving` one was learnt.
    """
    found = yield from geometry_of(problem, declared=declared)
    seems_to_move = found is None or not found.static.all()
    if seems_to_move and not declared and len(problem.poses) >= LEAST_VIEWS:
        every = yield from geometry_of(problem, declared=True)
        static = yield from _joined(problem, handed, moving, every, hint)
        most = math.hypot(MORE_NOISE * moving.measured_noise, LENS_ERRORS * problem.side)
        if static is not None and static.solution.measured_noise < most:
            return static
    static = yield from _joined(problem, handed, moving, found, hint)
    if static is None:
        reason = "no two static cameras explain the keypoints"
        return StaticViews(moving, reason, [handed.log_odds], problem.lens_groups)
    if declared:
        static = static._replace(reason=f"the cameras were declared static; {static.reason}")
    return static


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
    if hint is not None:
        found = by_volume(found, hint)
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
    found = yield from scan_lenses(problem, found)
    started = start_from_geometry(problem, found, moving)
    if started is None:
        raise np.linalg.LinAlgError("no structure can be located")
    start, deviations = started
    views = np.flatnonzero(found.static).tolist()
    kept, noise = None, found.noise * problem.side
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
    return StaticViews(solution, reason, evidence, problem.lens_groups, kept)
