"""Looking for causes: which hypotheses of single views' pixels explain all views best.

Most captures have none, so a few points screen first: would any lenses explain them better? If so,
views are freed one by one, what their free lenses show suggests causes, and each is held against
all frames. The best is taken if the cameras that it leads to stand, and the others are sought with
its pixels mended.
"""

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
)
from models.causes.sightings import (
    FEW,
    FIRST_ITERATIONS,
    MANY,
    Even,
    Sightings,
    Trial,
    roll,
    sightings,
)
from models.epipolar.static_rig import StaticRig
from models.numerics.steps import Steps

LEAST_VIEWS = 3
WORTH = 8.0  # nats that free lenses must gain for a search to begin
NAMED, CLEARLY = 10.0, 6.0  # nats for a cause to be named, and beyond those of other views
FINALISTS = 5  # causes that are tried with many points
PROMISING = 2.0  # nats that one must gain with a few points
HOPELESS = 500.0  # nats against a mirror image after a few steps
TURNED = 30.0  # degrees from a quarter turn
UNLIKELY_TURN = 4.0  # nats against a camera that stands on its side beside the others


def find_causes(problem: CalibrationProblem) -> Steps[tuple[Cause, ...]]:
    """Find what is wrong with the pixels of single views; yields now and then, to be stopped.

    `problem` has its geometry. The causes are to be undone in their order. The geometry is found
    anew without each before the next is sought.
    """
    causes: list[Cause] = []
    turned: list[Cause] = []
    left = list(range(len(problem.poses)))
    while len(left) > 1 and len(problem.poses) >= LEAST_VIEWS:
        rig = problem.geometry and problem.geometry.rig
        stands = rig is not None and bool(rig.static.all())
        if not stands:  # a harm may be why
            forced = yield from geometry_of(problem, declared=True)
            rig = forced.rig
        if rig is None:
            break
        cause, trial = yield from _one(problem, rig, left, stands=stands)
        mended = None if cause is None else _without(problem, cause)
        if cause is None or mended is None:
            turned = _turned_views(problem, trial, left) if stands else []
            break
        found = yield from geometry_of(mended, declared=False)
        if found.rig is None or not found.rig.static.all():
            break
        causes.append(cause)
        left.remove(cause.view)
        problem = mended._replace(geometry=found)
    return tuple(sorted(causes + turned, key=lambda cause: cause.view))


def _one(
    problem: CalibrationProblem, rig: StaticRig, left: list[int], *, stands: bool
) -> Steps[tuple[Cause | None, Trial]]:
    """Return the clearest cause of one of the views `left`, if any, and the cameras."""
    start = FreeRig.of(rig.best.rig)
    few = sightings(problem, rig.best.rig, rig.noise, FEW)
    yield
    usual = few.usual()
    free = usual
    for view in left:
        free = free.freed(view)
    known = few.tried(usual, [start])
    freed = few.tried(free, [known.fit.rig])
    if stands and known.cost - freed.cost < WORTH:
        return None, known
    few = few.noisy_as(freed)
    known = few.tried(usual, [known.fit.rig])
    many = sightings(problem, rig.best.rig, rig.noise, MANY)._replace(noise=few.noise)
    found = yield from _best(problem, few, many, known, left)
    return found, known


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


def _freed(
    problem: CalibrationProblem, few: Sightings, known: Trial, left: list[int]
) -> Steps[list[tuple[int, Trial]]]:
    """Return trials of a few points, each with one view's pixels free."""
    found: list[tuple[int, Trial]] = []
    start, usual = known.fit.rig, known.hypothesis
    for view in left:
        yield
        free = usual.freed(view)
        trial = few.tried(free, [start])
        found.append((view, trial))
        half = image_of(problem, view).width / 2 / problem.side
        bends = [free.shown(view, Even(bend=bend, half=half)) for bend in BENDS]
        bent = min((few.tried(each, [trial.fit.rig]) for each in bends), key=lambda t: t.cost)
        if bent.cost < trial.cost - PROMISING:
            found.append((view, bent))
        yield
        mirrored = usual.shown(view, Even(mirrored=True))
        mirrored_free = mirrored.freed(view, aspect=0.0)
        starts = few.mirror_starts(mirrored, start, view)
        roughly = few.tried(mirrored_free, starts, iterations=FIRST_ITERATIONS)
        if roughly.cost < known.cost + HOPELESS:
            found.append((view, few.tried(mirrored_free, [roughly.fit.rig])))
    return found


def _best(
    problem: CalibrationProblem, few: Sightings, many: Sightings, known: Trial, left: list[int]
) -> Steps[Cause | None]:
    """Return the cause of one of the views `left` that explains the keypoints best, if any does.

    `known` is a trial of a few points with nothing wrong.
    """
    rough: dict[tuple[int, str, bool], tuple[float, Candidate, Trial]] = {}
    for view, trial in (yield from _freed(problem, few, known, left)):
        image, base = image_of(problem, view), known.hypothesis
        base = base.shown(view, trial.hypothesis.evens[view])
        sds = few.deviations(trial)[view]
        for candidate in candidates(image, view, base, trial.fit.rig.lenses[view], sds):
            yield
            tried = few.tried(candidate.hypothesis, few.starts(candidate.hypothesis, trial, view))
            cost = tried.cost + candidate.nats
            key = (view, candidate.kind, bool(candidate.numbers.get("from_corner")))
            if _possible(candidate, tried) and (key not in rough or cost < rough[key][0]):
                rough[key] = (cost, candidate, tried)
    best = sorted(rough.values(), key=lambda each: each[0])
    nothing = many.tried(known.hypothesis, [known.fit.rig])
    found: list[Cause] = []
    for cost, candidate, trial in best[:FINALISTS]:
        if known.cost - cost < PROMISING:
            break
        yield
        tried = many.tried(candidate.hypothesis, [trial.fit.rig])
        cause = _cause(problem, many, candidate, tried)
        found.append(cause._replace(gain=cause.gain + nothing.cost - tried.cost - candidate.nats))
    found.sort(key=lambda cause: -cause.gain)
    if not found or found[0].gain < NAMED:
        return None
    others = [cause.gain for cause in found if cause.view != found[0].view]
    return None if found[0].gain - max(others, default=0.0) < CLEARLY else found[0]


def _possible(candidate: Candidate, trial: Trial) -> bool:
    """Whether a window's corner is inside the image, and an image on its side seen to be so."""
    if candidate.kind == "cropped":
        x, y = trial.fit.rig.lenses[candidate.view, CENTRE:RADIAL]
        return bool(np.hypot(x, y) > LEAST_OFFSET and max(x, y) < LEAST_OFFSET)
    turned = roll(trial, candidate.view)
    if candidate.kind == "axes_exchanged":
        return turned is None or _quarters(trial, candidate.view) % 2 == 1
    return candidate.kind != "on_its_side" or _quarters(trial, candidate.view) % 2 == 1


def _cause(
    problem: CalibrationProblem, many: Sightings, candidate: Candidate, trial: Trial
) -> Cause:
    """Return the cause with the map that suits best, and what speaks for it beside the cameras."""
    view, kind = candidate.view, candidate.kind
    image, lens = image_of(problem, view), trial.fit.rig.lenses[view]
    free = trial._replace(hypothesis=trial.hypothesis.freed(view, centre=0.0))
    sds = many.deviations(free if kind == "stretched" else trial)[view]
    quarters = _quarters(trial, view)
    gain = -UNLIKELY_TURN * ((quarters % 2 == 1) != (kind in ("on_its_side", "axes_exchanged")))
    pixels = problem.detected[:, view][problem.weights[:, view] > 0]
    gain += framing(image, pixels, image.size)
    return max(
        (
            cause._replace(gain=gain - framing(image, cause.map.mended(pixels), cause.size))
            for cause in causes_of(candidate, image, lens, sds, quarters)
        ),
        key=lambda cause: cause.gain,
    )


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
    if 2 * len(turned) >= len(trial.hypothesis.evens):
        return []
    found = []
    for view in turned:
        candidate = Candidate("on_its_side", view, trial.hypothesis, {}, 0.0)
        lens = trial.fit.rig.lenses[view]
        found += causes_of(candidate, image_of(problem, view), lens, lens, quarters[view])
    return found
