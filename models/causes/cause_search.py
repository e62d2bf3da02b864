"""Looking for causes: which hypotheses of single views' pixels explain all views best.

Most captures have none, so a few points screen first: would any lenses explain them better? If so,
views are freed one by one, what their free lenses show suggests causes, and each is held against
all frames. The best is taken if the cameras that it leads to stand, and the others are sought with
its pixels mended.
"""

from collections.abc import Sequence

import numpy as np

from models.bundle.problem import CENTRE_X
from models.calibrating.keypoint_rig import geometry_of
from models.calibrating.problem import CalibrationProblem
from models.causes.cause import Cause
from models.causes.free_rig import CENTRE, RADIAL, FreeRig
from models.causes.hypotheses import Candidate, causes_of
from models.causes.pixel_map import PixelMap
from models.causes.sides import SidesExchanged, exchanged_sides
from models.causes.sightings import FEW, MANY, Trial, sightings
from models.causes.trials import (
    Found,
    Search,
    image_of,
    images_of,
    likely_ones,
    possible,
    settled,
)
from models.causes.upright import quarter_turns
from models.epipolar.static_rig import StaticRig
from models.numerics.steps import Steps

# Figures: evidence/causes.md.
LEAST_VIEWS = 3
WORTH = 8.0  # nats that free lenses must gain for a search to begin
NAMED = 10.0  # nats for a cause to be named
CLEARLY, SURE = 6.0, 2.5  # nats beyond those of other views, and in their standard errors
FINALS = 3  # hypotheses for which all cameras are found anew
LEFT_OVER = 0.05  # most of what free lenses gained at first, once all causes are undone
EXPLAINED = 0.25  # least share of what free lenses of all views gain
MOVING = 0.1  # of the subject's radius: if more is left with any static lenses, cameras move


def find_causes(problem: CalibrationProblem) -> Steps[tuple[Cause, ...]]:
    """Find what is wrong with the pixels of single views; yields now and then, to be stopped.

    `problem` has its geometry. The causes are to be undone in their order. The geometry is found
    anew without each before the next is sought. Causes that leave much unexplained are none.
    """
    several = len(problem.poses) >= LEAST_VIEWS
    sides = exchanged_sides(problem) if several and not _stands(problem) else None
    if sides is not None:
        yield
        geometry = yield from geometry_of(sides.problem, declared=False)
        causes = yield from _causes_of_pixels(sides.problem._replace(geometry=geometry))
        if any(_is_mirror_of(cause, sides) for cause in causes):
            return tuple(
                cause._replace(partners=sides.partners) if _is_mirror_of(cause, sides) else cause
                for cause in causes
            )
    return (yield from _causes_of_pixels(problem))


def _is_mirror_of(cause: Cause, sides: SidesExchanged) -> bool:
    return cause.view == sides.view and cause.kind == "mirrored"


def _stands(problem: CalibrationProblem) -> bool:
    rig = problem.geometry and problem.geometry.rig
    return rig is not None and bool(rig.static.all())


def _causes_of_pixels(problem: CalibrationProblem) -> Steps[tuple[Cause, ...]]:
    """Find the causes as `find_causes` does, with keypoints that have their places."""
    causes: list[Cause] = []
    turned: list[Cause] = []
    wrong: list[float] = []  # nats that free lenses gain, before each cause
    left = list(range(len(problem.poses)))
    while len(left) > 1 and len(problem.poses) >= LEAST_VIEWS:
        rig, stands = problem.geometry and problem.geometry.rig, _stands(problem)
        if not stands:  # a harm may be why
            forced = yield from geometry_of(problem, declared=True)
            rig = forced.rig
        if rig is None:
            break
        start = FreeRig.of(rig.best.rig)
        few = sightings(problem, rig.best.rig, rig.noise, FEW)
        yield
        usual = few.usual()
        known = few.tried(usual, [start])
        freed = few.tried(usual.freed(*left), [known.fit.rig])
        found = None
        wrong.append(known.cost - freed.cost)
        odd = not stands or wrong[-1] > WORTH
        if odd:
            noise, few = few.noise, few.noisy_as(freed)
            wrong[-1] *= (noise / few.noise) ** 2
            if not stands and few.noise > MOVING * few.size:
                break
            many = sightings(problem, rig.best.rig, rig.noise, MANY)._replace(noise=few.noise)
            known = few.tried(usual, [known.fit.rig])
            search = Search(problem, few, many, known, freed, left)
            found = yield from _clearest(search)
        if found is None:
            turned = [] if odd else _turned_views(problem, known, left)
            if odd and wrong[-1] > LEFT_OVER * wrong[0]:
                causes = []
            break
        several, problem = found
        if causes and 2 * (len(causes) + len(several)) > len(problem.poses):
            causes = []  # faults of one view alone that another explains as well
            break
        causes += several
        left = [view for view in left if view not in {cause.view for cause in several}]
    return tuple(sorted(causes + turned, key=lambda cause: cause.view))


def _clearest(search: Search) -> Steps[tuple[tuple[Cause, ...], CalibrationProblem] | None]:
    """Return what explains the keypoints best, and the problem without it.

    The cameras are found from the start for the best kinds and views, for what was found step by
    step may be a wrong minimum. They must stand.
    """
    many, known = search.many, search.known
    nothing = many.tried(known.hypothesis, [known.fit.rig])
    freed = many.tried(search.freed.hypothesis, [search.freed.fit.rig])
    usual = nothing.cost + quarter_turns(nothing.fit.rig.rotations)[1]
    least = max(NAMED, EXPLAINED * (nothing.cost - freed.cost))
    images = images_of(search.problem)
    likely, every = yield from likely_ones(search)
    tried: dict[tuple[str, tuple[int, ...]], list[Found]] = {}
    for each in likely:
        yield
        found = settled(search, each.candidate, [each.trial.fit.rig], usual)
        tried.setdefault(each.candidate.place, []).append(found)
    best = sorted((max(some, key=_gain) for some in tried.values()), key=_gain, reverse=True)
    finals: list[tuple[Found, CalibrationProblem | None]] = []
    for found in best[:FINALS]:
        problem = None
        if _gain(found) > max(NAMED, least / 3):  # it may be far from its best cameras yet
            problem = yield from _standing(search, found.causes)
        if problem is None or problem.geometry is None or problem.geometry.rig is None:
            continue
        again = []
        for candidate in every:
            if candidate.place == found.candidate.place:
                yield
                start = _harmed(problem.geometry.rig, found, candidate, known)
                again.append(settled(search, candidate, [start], usual))
        again = [each for each in again if possible(each.candidate, each.trial, images)]
        if not again:
            continue
        last = max(again, key=_gain)
        finals.append((last, problem if _maps(last) == _maps(found) else None))
    if not finals:
        return None
    found, problem = max(finals, key=lambda final: _gain(final[0]))
    others = [other for other, _ in finals if other.candidate.views != found.candidate.views]
    if _gain(found) < least or not all(_clear(found, other) for other in others):
        return None
    if problem is None:
        problem = yield from _standing(search, found.causes)
    return None if problem is None else (found.causes, problem)


def _gain(found: Found) -> float:
    return found.gain


def _clear(found: Found, other: Found) -> bool:
    """Whether one explanation is better than another, whichever points had been seen.

    By the standard error of the sum of the points' differences (Vuong, *Likelihood ratio tests for
    model selection and non-nested hypotheses*, 1989).
    """
    differences = other.trial.each - found.trial.each
    error = float(differences.std() * np.sqrt(len(differences)))
    return _gain(found) - _gain(other) > max(CLEARLY, SURE * error)


def _maps(found: Found) -> list[PixelMap]:
    return [cause.map for cause in found.causes]


def _standing(search: Search, causes: Sequence[Cause]) -> Steps[CalibrationProblem | None]:
    """Return the problem with causes undone, with its geometry; None if a camera is left out."""
    problem = search.problem
    for cause in causes:
        problem = _without(problem, cause)
    geometry = yield from geometry_of(problem, declared=False)
    stands = geometry.rig is not None and geometry.rig.static.all()
    return problem._replace(geometry=geometry) if stands else None


def _harmed(rig: StaticRig, found: Found, candidate: Candidate, known: Trial) -> FreeRig:
    """Return the cameras of mended pixels with the lenses that a candidate expects."""
    lens = candidate.hypothesis.beliefs.means - known.hypothesis.beliefs.means
    if candidate.kind == "cropped":
        for view in candidate.views:
            lens[CENTRE:RADIAL, view] = found.trial.fit.rig.lenses[view, CENTRE:RADIAL]
    mended = FreeRig.of(rig.best.rig)
    return mended._replace(lenses=mended.lenses + lens.T)


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


def _turned_views(problem: CalibrationProblem, trial: Trial, left: list[int]) -> list[Cause]:
    """Return the views whose images are turned, most of the others not."""
    quarters = quarter_turns(trial.fit.rig.rotations)[0].tolist()
    turned = [view for view in left if quarters[view]]
    if 2 * len(turned) >= len(trial.hypothesis.evens):
        return []
    found = []
    for view in turned:
        candidate = Candidate("on_its_side", (view,), trial.hypothesis, {}, 0.0)
        lens = trial.fit.rig.lenses[view]
        found += causes_of(candidate, view, image_of(problem, view), lens, lens, quarters[view])
    return found
