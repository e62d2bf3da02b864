"""Looking for causes: which hypotheses of single views' pixels explain all views best.

Most captures have none, so a few points screen first: would any lens of its own explain them
better? If so, views are freed one by one, what their free lenses show suggests causes, and each is
held against the frames that it was not adjusted to. The best is taken, and the others are tried
beside it.
"""

from typing import NamedTuple

import numpy as np

from models.bundle.problem import CENTRE_X
from models.calibrating.keypoint_rig import geometry_of
from models.calibrating.problem import CalibrationProblem
from models.causes.cause import Cause
from models.causes.free_rig import FreeRig
from models.causes.hypotheses import Candidate, Image, candidates, cause_of, rough_ones
from models.causes.sightings import FEW, MANY, Sightings, Trial, roll, sightings
from models.epipolar.static_rig import StaticRig
from models.numerics.steps import Steps

LEAST_VIEWS = 3
# A search begins if free lenses gain so many nats, or if so many speak against the lenses, some for
# all views together and some for each.
WORTH, ODD_LENSES, ODD_LENS = 8.0, 2.0, 1.0
NAMED, CLEARLY = 10.0, 6.0  # nats for a cause to be named, and beyond those of other views
FINALISTS = 8  # of hypotheses that were tried roughly
PROMISING = 2.0  # nats that one must gain there
TURNED = 30.0  # degrees from a quarter turn


class _Found(NamedTuple):
    candidate: Candidate
    trial: Trial
    gain: float


def find_causes(problem: CalibrationProblem) -> Steps[tuple[Cause, ...]]:
    """Find what is wrong with the pixels of single views; yields now and then, to be stopped.

    `problem` has its geometry. The causes are to be undone in their order. The geometry is found
    anew without each before the next is sought.
    """
    causes: list[Cause] = []
    turned: list[Cause] = []
    left = list(range(len(problem.poses)))
    while len(left) > 1 and len(problem.poses) >= LEAST_VIEWS:
        rig = None if problem.geometry is None else problem.geometry.rig
        if rig is None or not rig.static.all():
            break
        cause, trial = yield from _one(problem, rig, left)
        if cause is None:
            turned = _turned_views(problem, trial, left)
            break
        causes.append(cause)
        left.remove(cause.view)
        problem = _without(problem, cause)
        found = yield from geometry_of(problem, declared=False)
        problem = problem._replace(geometry=found)
    return tuple(sorted(causes + turned, key=lambda cause: cause.view))


def _one(
    problem: CalibrationProblem, rig: StaticRig, left: list[int]
) -> Steps[tuple[Cause | None, Trial]]:
    """Return the clearest cause of one of the views `left`, if any, and the cameras."""
    start = FreeRig.of(rig.best.rig)
    few = sightings(problem, rig.best.rig, rig.noise, FEW)
    yield
    usual = few.usual()
    trial = few.tried(usual, [start])
    if not (yield from _is_odd(few, trial)):
        return None, trial
    many = sightings(problem, rig.best.rig, rig.noise, MANY)
    known = many.tried(usual, [trial.fit.rig, start])
    found = yield from _best(problem, few, many, known, trial, left)
    return (None, trial) if found is None else (_cause(problem, many, found), found.trial)


def _without(problem: CalibrationProblem, cause: Cause) -> CalibrationProblem:
    """Return the problem with a cause undone, without geometry."""
    view = cause.view
    keypoints, detected = problem.keypoints.copy(), problem.detected.copy()
    for pixels in (keypoints, detected):
        pixels[:, view] = cause.map.mended(pixels[:, view])
    problem = problem._replace(keypoints=keypoints, detected=detected, geometry=None)
    if cause.size is None:
        return problem
    images, lenses = problem.images, problem.reference.lenses
    sizes, middles, centres = images.sizes.copy(), images.middles.copy(), lenses.centres.copy()
    sizes[view], middles[view] = cause.size, np.array(cause.size) / 2
    if np.isinf(problem.lens_sds[view, CENTRE_X]):
        centres[view] = middles[view]
    reference = problem.reference._replace(lenses=lenses._replace(centres=centres))
    images = images._replace(sizes=sizes, middles=middles)
    return problem._replace(images=images, reference=reference)


def _is_odd(few: Sightings, trial: Trial) -> Steps[bool]:
    """Whether any lenses of their own, or a mirror image, may explain a few points better."""
    views = len(trial.hypothesis.flips)
    if trial.lenses > ODD_LENSES + ODD_LENS * views:
        return True
    free = trial.hypothesis
    for view in range(views):
        free = free.freed(view)
    yield
    freed = few.tried(free, [trial.fit.rig])
    return trial.whole - freed.whole > WORTH


def _best(
    problem: CalibrationProblem,
    few: Sightings,
    many: Sightings,
    known: Trial,
    roughly: Trial,
    left: list[int],
) -> Steps[_Found | None]:
    """Return the cause of one of the views `left` that explains the keypoints best, if any does.

    `known` and `roughly` are trials of what is supposed so far, with many and few points.
    """
    rough: dict[tuple[int, str], Trial] = {}
    for view in left:
        for kind, hypothesis in rough_ones(image_of(problem, view), view, known.hypothesis):
            yield
            mirror = hypothesis.flips != known.hypothesis.flips
            starts = [known.fit.rig]
            if mirror:
                starts = few.mirror_starts(hypothesis, known.fit.rig, view)
            tried = few.tried(hypothesis, starts, view=None if mirror else view)
            best = rough.get((view, kind))
            if best is None or tried.whole < best.whole:
                rough[view, kind] = tried
    found: list[_Found] = []
    finalists = sorted(rough.items(), key=lambda item: item[1].whole)[:FINALISTS]
    for (view, _), trial in finalists:
        if roughly.whole - trial.whole < PROMISING:
            break
        flipped = trial.hypothesis.flips != known.hypothesis.flips
        lens, image = trial.fit.rig.lenses[view], image_of(problem, view)
        for candidate in candidates(image, view, known.hypothesis, lens, flipped=flipped):
            yield
            starts = [trial.fit.rig]
            tried = many.tried(candidate.hypothesis, starts)
            found.append(_Found(candidate, tried, known.whole - tried.whole - candidate.nats))
    found.sort(key=lambda each: -each.gain)
    if not found or found[0].gain < NAMED:
        return None
    best_one = found[0]
    others = [each.gain for each in found if each.candidate.view != best_one.candidate.view]
    unclear = best_one.gain - max(others, default=0.0) < CLEARLY
    tested = known.cost - best_one.trial.cost - best_one.candidate.nats
    return None if unclear or tested < NAMED / 2 else best_one._replace(gain=tested)


def _cause(problem: CalibrationProblem, many: Sightings, found: _Found) -> Cause:
    view, trial = found.candidate.view, found.trial
    free = trial._replace(hypothesis=trial.hypothesis.freed(view, centre=0.0))
    sds = many.deviations(free if found.candidate.kind == "stretched" else trial)[view]
    lens, image = trial.fit.rig.lenses[view], image_of(problem, view)
    return cause_of(found.candidate, image, lens, sds, _quarters(trial, view), found.gain)


def image_of(problem: CalibrationProblem, view: int) -> Image:
    """Return the image of a view."""
    images = problem.images
    width, height = images.sizes[view].tolist()
    x, y = problem.reference.lenses.centres[view].tolist()
    return Image(width, height, (x, y), problem.side, bool(images.known[view]))


def _quarters(trial: Trial, view: int) -> int:
    """Return by how many quarter turns a view's image is turned clockwise beside the others'."""
    degrees = roll(trial, view)
    if degrees is None:
        return 0
    quarters = round(degrees / 90)
    return quarters % 4 if abs(degrees - 90 * quarters) < TURNED else 0


def _turned_views(problem: CalibrationProblem, trial: Trial, left: list[int]) -> list[Cause]:
    """Return the views whose images are turned, most of the others not."""
    quarters = {view: _quarters(trial, view) for view in left}
    turned = [view for view, count in quarters.items() if count]
    if 2 * len(turned) >= len(trial.hypothesis.flips):
        return []
    found = []
    for view in turned:
        candidate = Candidate("on_its_side", view, trial.hypothesis, {}, 0.0)
        lens = trial.fit.rig.lenses[view]
        found.append(cause_of(candidate, image_of(problem, view), lens, lens, quarters[view], 0.0))
    return found
