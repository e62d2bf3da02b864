"""The evidence of shapes along the walks of two views' lenses, where geometry leaves them open."""

import numpy as np

from models.calibrating.lens_profile import (
    FINER,
    THIN,
    Pair,
    Place,
    Profile,
    Walk,
    adjusted_at,
    log_posterior,
    placed_at,
)
from models.calibrating.shape_evidence import Located, alike_in_all, locate, shape_evidence
from models.numerics.steps import Steps

LIKELY = 12.0  # nats below the best: shapes are not asked about less likely places
SAME = 0.02  # of both logarithms: places nearer than this are asked once
ASIDE = 0.25  # of the log ratio, how far off the best one it is tried
SHAPE_NATS = 45.0  # of the evidence of shapes are worth one


def with_shapes(pair: Pair, profile: Profile) -> Steps[list[Walk]]:
    """Ask shapes about all places that are not far less likely than the best, and beside these."""
    walks, noise = profile.walks, profile.noise
    best = max(log_posterior(walk.kind, place) for walk in walks for place in walk.places)
    asked = [
        (walk.kind, place)
        for walk in walks
        for place in walk.places
        if log_posterior(walk.kind, place) > best - LIKELY
    ]
    trials = alike_in_all([_located(pair, place, noise) for _, place in asked])
    judged: list[Place] = []
    for (_, place), trial in zip(asked, trials, strict=True):
        same = [each for each in judged if np.abs(each.at - place.at).max() < SAME]
        yield
        judged.append(place._replace(shapes=same[0].shapes if same else _evidence(trial)))
    by_name = {id(place): each for (_, place), each in zip(asked, judged, strict=True)}
    walks = [
        walk._replace(places=[by_name.get(id(place), place) for place in walk.places])
        for walk in walks
    ]
    for number, walk in enumerate(walks):
        if walk.kind.sds[1] >= THIN:
            aside = yield from _aside(pair, walk, profile, trials[0])
            walks[number] = walk._replace(aside=aside)
    return walks


def _located(pair: Pair, place: Place, noise: float) -> Located:
    return locate(place.cameras.rig, pair.images, pair.weights, noise)


def _evidence(trial: Located) -> float:
    try:
        return float(np.nansum(shape_evidence(trial)))
    except np.linalg.LinAlgError:
        return np.nan


def _aside(pair: Pair, walk: Walk, profile: Profile, alike: Located) -> Steps[list[Place]]:
    """Return places of other ratios beside the best, judged on the points of `alike`."""

    def value(place: Place) -> float:
        shapes = -np.inf if np.isnan(place.shapes) else place.shapes / SHAPE_NATS
        return log_posterior(walk.kind, place) + shapes

    best = max(walk.places, key=value)
    step = min(ASIDE, walk.kind.sds[1])
    for _ in range(FINER):
        aside = []
        for signed in (-step, step):
            yield
            common, ratio = best.at[0], best.at[1] + signed
            adjusted = adjusted_at(pair, walk.kind, common, best.cameras, ratio)
            aside.append(placed_at(pair, adjusted, profile.noise, profile.worth))
        if best.geometry - np.mean([place.geometry for place in aside]) < LIKELY:
            break
        step /= 2
    if np.isnan(best.shapes):
        return aside
    trials = alike_in_all([alike, *(_located(pair, place, profile.noise) for place in aside)])[1:]
    judged = []
    for place, trial in zip(aside, trials, strict=True):
        yield
        judged.append(place._replace(shapes=_evidence(trial)))
    return judged
