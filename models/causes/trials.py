"""Hypotheses of views' pixels: which are likely with a few points, and how likely with many."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

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
from models.causes.sightings import FIRST_ITERATIONS, Even, Sightings, Trial
from models.causes.upright import QUARTER, quarter_turns
from models.numerics.steps import Steps

# Figures: evidence/causes.md.
FINALISTS = 7  # hypotheses that are tried with many points
PROMISING = 2.0  # nats that one must gain with a few points
HOPELESS = 500.0  # nats against a mirror image after a few steps, beside twice the usual ones
MOST_CROPPED = 0.6  # of an image's width and height, to the left and above a window
TURNED = ("on_its_side", "axes_exchanged")


class Search(NamedTuple):
    """What causes are held against."""

    problem: CalibrationProblem
    few: Sightings
    many: Sightings
    known: Trial  # of a few points, with nothing wrong
    freed: Trial  # the same with any lenses
    left: list[int]  # the views that have no cause yet


class Found(NamedTuple):
    """Causes of one hypothesis, and how well all views are explained with them."""

    causes: tuple[Cause, ...]
    gain: float  # nats
    candidate: Candidate
    trial: Trial


class RoughTrial(NamedTuple):
    """A hypothesis of one view, tried with a few points."""

    cost: float  # nats, with those against the hypothesis
    candidate: Candidate
    trial: Trial


def _freed(search: Search) -> Steps[list[tuple[int, Trial]]]:
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


def likely_ones(search: Search) -> Steps[tuple[list[RoughTrial], list[Candidate]]]:
    """Return the hypotheses that explain a few points best, the best first, and all hypotheses."""
    few, known = search.few, search.known
    found: list[RoughTrial] = []
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
    found = [each for each in found if possible(each.candidate, each.trial, images)]
    best: dict[tuple[str, tuple[int, ...], bool], RoughTrial] = {}
    for each in sorted(found, key=_cost):
        best.setdefault((*each.candidate.place, "from_corner" in each.candidate.numbers), each)
    likely = []
    for each in best.values():
        yield
        tried = few.tried(each.candidate.hypothesis, [each.trial.fit.rig])
        likely.append(RoughTrial(tried.cost + each.candidate.nats, each.candidate, tried))
    likely = [each for each in likely if known.cost - each.cost > PROMISING]
    return sorted(likely, key=_cost)[:FINALISTS], [each.candidate for each in found]


def _first(few: Sightings, candidate: Candidate, near: Trial) -> RoughTrial:
    """Try a hypothesis with a few steps, from several starts."""
    starts = few.starts(candidate.hypothesis, near, candidate.views)
    tried = few.tried(candidate.hypothesis, starts, iterations=0)
    return RoughTrial(tried.cost + candidate.nats, candidate, tried)


def _cost(each: RoughTrial) -> float:
    return each.cost


def settled(search: Search, candidate: Candidate, starts: list[FreeRig], usual: float) -> Found:
    """Try a hypothesis with many points; `usual` are the nats against them with nothing wrong."""
    trial = search.many.tried(candidate.hypothesis, starts)
    quarters, against = quarter_turns(trial.fit.rig.rotations)
    gain = usual - trial.cost - candidate.nats - against + QUARTER * (candidate.kind in TURNED)
    causes = []
    for view in candidate.views:
        cause, framed = _cause(search, candidate, trial, view, int(quarters[view]))
        causes.append(cause)
        gain += framed
    return Found(tuple(cause._replace(gain=gain) for cause in causes), gain, candidate, trial)


def possible(candidate: Candidate, trial: Trial, images: Sequence[Image]) -> bool:
    """Whether a window's corner is well inside the image, and an image that is turned seen so."""
    if candidate.kind == "cropped":
        corners = -trial.fit.rig.lenses[list(candidate.views), CENTRE:RADIAL]
        most = 2 * MOST_CROPPED * np.array([images[v].middle_in_sides for v in candidate.views])
        far = np.hypot(*corners.T) > LEAST_OFFSET
        return bool(far.all() and (corners > -LEAST_OFFSET).all() and (corners < most).all())
    turned = quarter_turns(trial.fit.rig.rotations)[0][candidate.views[0]] % 2 == 1
    return bool(turned == (candidate.kind in TURNED)) or candidate.kind not in (*TURNED, "mirrored")


def _cause(
    search: Search, candidate: Candidate, trial: Trial, view: int, quarters: int
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
