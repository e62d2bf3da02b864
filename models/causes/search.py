"""Looking for causes: which hypotheses of single views' pixels explain all views best.

Most captures have none, so a few points screen first: would any lenses explain them better? If so,
views are freed one by one, what their free lenses show suggests causes, and each is held against
all frames. The best is taken if the cameras that it leads to stand, and the others are sought with
its pixels mended.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from models.bundle.problem import CENTRE_X
from models.calibrating.keypoint_rig import geometry_of
from models.calibrating.problem import CalibrationProblem
from models.causes.cause import Cause
from models.causes.free_rig import CENTRE, RADIAL, FreeRig
from models.causes.hypotheses import (
    BENDS,
    LEAST_OFFSET,
    Candidate,
    Image,
    candidates,
    causes_of,
    framing,
    of_several,
)
from models.causes.pixel_map import PixelMap
from models.causes.sightings import (
    FEW,
    FIRST_ITERATIONS,
    MANY,
    Even,
    Sightings,
    Trial,
    sightings,
)
from models.causes.upright import QUARTER, quarter_turns
from models.epipolar.static_rig import StaticRig
from models.numerics.steps import Steps

LEAST_VIEWS = 3
WORTH = 8.0  # nats that free lenses must gain for a search to begin
NAMED = 10.0  # nats for a cause to be named
CLEARLY, SURE = 6.0, 2.5  # nats beyond those of other views, and in their standard errors
FINALISTS, FINALS = 7, 3  # hypotheses that are tried with many points, and by all cameras anew
LEFT_OVER = 0.05  # most of what free lenses gained at first, once all causes are undone
PROMISING = 2.0  # nats that one must gain with a few points
HOPELESS = 500.0  # nats against a mirror image after a few steps, beside twice the usual ones
EXPLAINED = 0.25  # least share of what free lenses of all views gain
MOVING = 0.1  # of the subject's radius: if more is left with any static lenses, cameras move
MOST_CROPPED = 0.6  # of an image's width and height, to the left and above a window
TURNED = ("on_its_side", "axes_exchanged")


class _Found(NamedTuple):
    """Causes of one hypothesis, and how well all views are explained with them."""

    causes: tuple[Cause, ...]
    gain: float  # nats
    candidate: Candidate
    trial: Trial


class _Trial(NamedTuple):
    """A hypothesis of one view, tried with a few points."""

    cost: float  # nats, with those against the hypothesis
    candidate: Candidate
    trial: Trial


class _Search(NamedTuple):
    """What causes are held against."""

    problem: CalibrationProblem
    few: Sightings
    many: Sightings
    known: Trial  # of a few points, with nothing wrong
    freed: Trial  # the same with any lenses
    left: list[int]  # the views that have no cause yet


def find_causes(problem: CalibrationProblem) -> Steps[tuple[Cause, ...]]:
    """Find what is wrong with the pixels of single views; yields now and then, to be stopped.

    `problem` has its geometry. The causes are to be undone in their order. The geometry is found
    anew without each before the next is sought. Causes that leave much unexplained are none.
    """
    causes: list[Cause] = []
    turned: list[Cause] = []
    wrong: list[float] = []  # nats that free lenses gain, before each cause
    left = list(range(len(problem.poses)))
    while len(left) > 1 and len(problem.poses) >= LEAST_VIEWS:
        rig = problem.geometry and problem.geometry.rig
        stands = rig is not None and bool(rig.static.all())
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
            search = _Search(problem, few, many, known, freed, left)
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


def _clearest(search: _Search) -> Steps[tuple[tuple[Cause, ...], CalibrationProblem] | None]:
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
    likely, every = yield from _likely(search)
    settled: dict[tuple[str, tuple[int, ...]], list[_Found]] = {}
    for each in likely:
        yield
        found = _settled(search, each.candidate, [each.trial.fit.rig], usual)
        settled.setdefault(each.candidate.place, []).append(found)
    best = sorted((max(some, key=_gain) for some in settled.values()), key=_gain, reverse=True)
    finals: list[tuple[_Found, CalibrationProblem | None]] = []
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
                again.append(_settled(search, candidate, [start], usual))
        again = [each for each in again if _possible(each.candidate, each.trial, images)]
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


def _gain(found: _Found) -> float:
    return found.gain


def _clear(found: _Found, other: _Found) -> bool:
    """Whether one explanation is better than another, whichever points had been seen.

    By the standard error of the sum of the points' differences (Vuong, *Likelihood ratio tests for
    model selection and non-nested hypotheses*, 1989).
    """
    differences = other.trial.each - found.trial.each
    error = float(differences.std() * np.sqrt(len(differences)))
    return _gain(found) - _gain(other) > max(CLEARLY, SURE * error)


def _maps(found: _Found) -> list[PixelMap]:
    return [cause.map for cause in found.causes]


def _standing(search: _Search, causes: Sequence[Cause]) -> Steps[CalibrationProblem | None]:
    """Return the problem with causes undone, with its geometry; None if a camera is left out."""
    problem = search.problem
    for cause in causes:
        problem = _without(problem, cause)
    geometry = yield from geometry_of(problem, declared=False)
    stands = geometry.rig is not None and geometry.rig.static.all()
    return problem._replace(geometry=geometry) if stands else None


def _harmed(rig: StaticRig, found: _Found, candidate: Candidate, known: Trial) -> FreeRig:
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


def _freed(search: _Search) -> Steps[list[tuple[int, Trial]]]:
    """Return trials of a few points, each with one view's pixels free."""
    found: list[tuple[int, Trial]] = []
    few, known = search.few, search.known
    start, usual = known.fit.rig, known.hypothesis
    for view in search.left:
        yield
        free = usual.freed(view)
        trial = few.tried(free, [start])
        found.append((view, trial))
        half = image_of(search.problem, view).width / 2 / search.problem.side
        bends = [free.shown(view, Even(bend=bend, half=half)) for bend in BENDS]
        bent = min((few.tried(each, [trial.fit.rig]) for each in bends), key=lambda t: t.cost)
        if bent.cost < trial.cost - PROMISING:
            found.append((view, bent))
        yield
        mirrored = usual.shown(view, Even(mirrored=True))
        mirrored_free = mirrored.freed(view, aspect=0.0)
        starts = few.mirror_starts(mirrored, start, view)
        roughly = few.tried(mirrored_free, starts, iterations=FIRST_ITERATIONS)
        if roughly.cost < 2 * known.cost + HOPELESS:
            found.append((view, few.tried(mirrored_free, [roughly.fit.rig])))
    return found


def _likely(search: _Search) -> Steps[tuple[list[_Trial], list[Candidate]]]:
    """Return the hypotheses that explain a few points best, the best first, and all hypotheses."""
    few, known = search.few, search.known
    found: list[_Trial] = []
    widths = search.problem.images.sizes[search.problem.images.known, 0].tolist()
    for view, trial in (yield from _freed(search)):
        image, base = image_of(search.problem, view), known.hypothesis
        ratios = {width / image.width for width in widths if image.known}
        base = base.shown(view, trial.hypothesis.evens[view])
        for candidate in candidates(image, view, base, trial.fit.rig.lenses[view], ratios):
            yield
            found.append(_first(few, candidate, trial))
    images = images_of(search.problem)
    for candidate in of_several(images, known.hypothesis, search.left):
        yield
        found.append(_first(few, candidate, known))
    found = [each for each in found if _possible(each.candidate, each.trial, images)]
    best: dict[tuple[str, tuple[int, ...], bool], _Trial] = {}
    for each in sorted(found, key=_cost):
        best.setdefault((*each.candidate.place, "from_corner" in each.candidate.numbers), each)
    likely = []
    for each in best.values():
        yield
        tried = few.tried(each.candidate.hypothesis, [each.trial.fit.rig])
        likely.append(_Trial(tried.cost + each.candidate.nats, each.candidate, tried))
    likely = [each for each in likely if known.cost - each.cost > PROMISING]
    return sorted(likely, key=_cost)[:FINALISTS], [each.candidate for each in found]


def _first(few: Sightings, candidate: Candidate, near: Trial) -> _Trial:
    """Try a hypothesis with a few steps, from several starts."""
    starts = few.starts(candidate.hypothesis, near, candidate.views)
    tried = few.tried(candidate.hypothesis, starts, iterations=0)
    return _Trial(tried.cost + candidate.nats, candidate, tried)


def _cost(each: _Trial) -> float:
    return each.cost


def _settled(search: _Search, candidate: Candidate, starts: list[FreeRig], usual: float) -> _Found:
    """Try a hypothesis with many points; `usual` are the nats against them with nothing wrong."""
    trial = search.many.tried(candidate.hypothesis, starts)
    quarters, against = quarter_turns(trial.fit.rig.rotations)
    gain = usual - trial.cost - candidate.nats - against + QUARTER * (candidate.kind in TURNED)
    causes = []
    for view in candidate.views:
        cause, framed = _cause(search, candidate, trial, view, int(quarters[view]))
        causes.append(cause)
        gain += framed
    return _Found(tuple(cause._replace(gain=gain) for cause in causes), gain, candidate, trial)


def _possible(candidate: Candidate, trial: Trial, images: Sequence[Image]) -> bool:
    """Whether a window's corner is well inside the image, and an image that is turned seen so."""
    if candidate.kind == "cropped":
        corners = -trial.fit.rig.lenses[list(candidate.views), CENTRE:RADIAL]
        most = 2 * MOST_CROPPED * np.array([images[v].middle_in_sides for v in candidate.views])
        far = np.hypot(*corners.T) > LEAST_OFFSET
        return bool(far.all() and (corners > -LEAST_OFFSET).all() and (corners < most).all())
    turned = quarter_turns(trial.fit.rig.rotations)[0][candidate.views[0]] % 2 == 1
    return bool(turned == (candidate.kind in TURNED)) or candidate.kind not in (*TURNED, "mirrored")


def _cause(
    search: _Search, candidate: Candidate, trial: Trial, view: int, quarters: int
) -> tuple[Cause, float]:
    """Return the cause of a view with the map that suits best, and nats for it from the framing."""
    problem = search.problem
    image, lens = image_of(problem, view), trial.fit.rig.lenses[view]
    free = trial._replace(hypothesis=trial.hypothesis.freed(view, centre=0.0))
    sds = search.many.deviations(free if candidate.kind == "stretched" else trial)[view]
    pixels = problem.detected[:, view][problem.weights[:, view] > 0]
    causes = causes_of(candidate, view, image, lens, sds, quarters)
    framed = [framing(image, cause.map.mended(pixels), cause.size) for cause in causes]
    best = int(np.argmin(framed))
    return causes[best], framing(image, pixels, image.size) - framed[best]


def images_of(problem: CalibrationProblem) -> list[Image]:
    """Return the images of all views."""
    return [image_of(problem, view) for view in range(len(problem.poses))]


def image_of(problem: CalibrationProblem, view: int) -> Image:
    """Return the image of a view."""
    images = problem.images
    width, height = images.sizes[view].tolist()
    x, y = problem.reference.lenses.centres[view].tolist()
    return Image(width, height, (x, y), problem.side, bool(images.known[view]))


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
