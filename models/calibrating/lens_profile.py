"""Two static views along their common focal length: the best cameras, and what speaks for them.

Two log focal lengths are `at` (common, ratio): their mean, and the first less the second. Keypoints
of two views fit almost any common focal length, if all else follows. So all other numbers of the
cameras are adjusted to the keypoints at each of several places. Two kinds of lenses are walked
separately, alike ones and unlike ones.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle.problem import FOCAL
from models.calibrating.bagging import share_of_information
from models.calibrating.keypoint_rig import (
    FOCAL_SD,
    UNKNOWN_FOCAL_SD,
    lens_beliefs,
    straight_images,
)
from models.calibrating.lens_groups import group_covariance
from models.calibrating.lens_prior import FOCAL_SDS
from models.calibrating.problem import CalibrationProblem
from models.epipolar.pairs import Beliefs
from models.epipolar.rig_adjustment import AdjustedRig, adjust_rig, lens_cost
from models.epipolar.rig_search import refocused
from models.epipolar.robust_points import costs_of, robust_points
from models.epipolar.static_cameras import SeenPoints
from models.epipolar.static_rig import StaticRig
from models.epipolar.view_graph import SharedPoints
from models.numerics.sampling import evenly_spread
from models.numerics.steps import Steps

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

# Figures: evidence/lenses.md.
POINTS = 1200  # at most, that cameras are adjusted to
FRAMES, KEYPOINTS = 100, 40  # at most, that shapes are learnt from
ITERATIONS = 40  # of adjusting cameras
SHARES = (0.6, 0.4)  # of pairs whose lenses are alike, and not
UNLIKE_SDS = (0.4, 0.35)  # of log focal lengths: of what unlike lenses share, and of each
PLACES, REACH = 11, 2.4  # of the common focal length, within so many standard deviations
FAR_REACH = 5.0  # where lenses are given: keypoints may contradict them
GIVEN = 0.25  # a smaller standard deviation of the common log focal length is that of given lenses
FINER, CLOSE = 6, 4.0  # times that places are added about the best, until these are so near (nats)
THIN = 0.05  # a smaller standard deviation of the log ratio leaves it no freedom of its own
UNBIASED = 8.0  # over the square of the noise, as a share of the subject: points count as no more
VALLEY = 2.0  # nats that are no valley
EXACT = 1e-5  # standard deviation of a number that is held
# From the two log focal lengths to the common one and the ratio, and back.
FROM_LOGS = np.array([[0.5, 0.5], [1.0, -1.0]])
TO_LOGS = np.linalg.inv(FROM_LOGS)


class Kind(NamedTuple):
    """The prior of common log focal length and ratio, if lenses are alike, or if they are not."""

    share: float  # its probability
    mean: Float64  # (2,)
    covariance: Float64  # (2, 2)

    @property
    def sds(self) -> tuple[float, float]:
        """Standard deviations of the common log focal length, and of the ratio where it is held."""
        (common, both), (_, ratio) = self.covariance
        return float(np.sqrt(common)), float(np.sqrt(max(ratio - both**2 / common, 0) + EXACT**2))

    def ratio_at(self, common: Float64) -> Float64:
        """Return the expected ratios (T,) at common log focal lengths (T,)."""
        slope = self.covariance[0, 1] / self.covariance[0, 0]
        return np.asarray(self.mean[1] + slope * (common - self.mean[0]))


class Place(NamedTuple):
    """The cameras that explain keypoints best, with the common focal length or both held."""

    at: Float64  # (2,)
    cameras: AdjustedRig
    geometry: float  # log likelihood of the keypoints and of other numbers of lenses
    shapes: float  # log evidence; NaN where shapes were not asked


class Walk(NamedTuple):
    """The places of one kind of lenses."""

    kind: Kind
    places: list[Place]  # by common focal length
    aside: list[Place]  # two with other ratios than the best place, where ratios are free


class Profile(NamedTuple):
    """Walks of each kind of lenses, and what their likelihoods assume."""

    walks: list[Walk]
    noise: float  # sides
    worth: float  # share of the points that count


class Pair(NamedTuple):
    """The data of two views."""

    images: Float64  # (N, 2, P, 2) sides, of frames and keypoints that shapes are learnt from
    weights: Float64  # (N, 2, P)
    seen: SeenPoints  # that cameras are adjusted to
    clusters: tuple[Int64, Int64]  # their frames and keypoints
    beliefs: Beliefs
    size: float  # sides, root-mean-square radius of the subject
    independent: float  # share of the points whose errors are, after noise was removed
    start: AdjustedRig


def kinds_of(problem: CalibrationProblem) -> list[Kind]:
    """Return the kinds of lenses that two views may have, given what is known of them.

    A given focal length is an observation of the true one, with its standard deviation. It makes a
    kind as much more probable as the kind expects it.
    """
    side, sds = problem.side, problem.lens_sds[:, FOCAL]
    usual = np.log(problem.usual.lenses.focals.mean(1) / side)
    known = np.log(problem.reference.lenses.focals.mean(1) / side)
    given = np.isfinite(sds)
    unknown = 0.0 if problem.images.known.all() else np.sqrt(UNKNOWN_FOCAL_SD**2 - FOCAL_SD**2)
    one = np.zeros(2, np.int64)
    kinds = []
    for share, together, alone in (
        (SHARES[0], FOCAL_SD, FOCAL_SDS[1]),
        (SHARES[1], *UNLIKE_SDS),
    ):
        covariance = group_covariance(one, np.hypot(together, unknown), alone)
        among = covariance[np.ix_(given, given)] + np.diag(np.square(sds[given]))
        carried = np.linalg.solve(among, covariance[given]).T  # (2, g)
        off = (known - usual)[given]
        mean = usual + carried @ off
        likely = -off @ np.linalg.solve(among, off) / 2 - np.linalg.slogdet(among).logabsdet / 2
        left = covariance - carried @ covariance[given]
        kinds.append(Kind(share * np.exp(likely), FROM_LOGS @ mean, FROM_LOGS @ left @ FROM_LOGS.T))
    if problem.cameras_alike != "auto":
        kinds = kinds[:1] if len(set(problem.lens_groups)) == 1 else kinds[1:]
    total = sum(kind.share for kind in kinds)
    return [kind._replace(share=kind.share / total) for kind in kinds if kind.share > 1e-6 * total]


def pair_of(problem: CalibrationProblem, found: StaticRig) -> Pair:
    """Take the keypoints of some frames; without noise, where it was removed.

    Shapes of noisy keypoints are hardly learnt from so few frames.
    """
    images, _ = straight_images(problem, problem.keypoints)
    shared = SharedPoints.of(images, problem.weights, np.random.default_rng(0))
    seen, chosen = shared.seen([0, 1], POINTS), shared.chosen([0, 1], POINTS)
    both = np.flatnonzero((problem.weights > 0).all(1).sum(1) > 0)
    frames = both[evenly_spread(len(both), FRAMES)]
    often = np.flatnonzero((problem.weights[frames] > 0).all(1).any(0))
    keypoints = often[evenly_spread(len(often), KEYPOINTS)]
    rig, noise = found.best.rig, np.full(2, found.noise)
    return Pair(
        images[frames][:, :, keypoints],
        problem.weights[frames][:, :, keypoints],
        seen,
        (shared.frames[chosen], shared.keypoints[chosen]),
        lens_beliefs(problem),
        problem.size / problem.side,
        share_of_information(problem, found.noise * problem.side),
        AdjustedRig(rig, robust_points(rig, seen, noise), noise),
    )


def walk_lenses(pair: Pair, kinds: list[Kind]) -> Steps[Profile]:
    """Return the best cameras along the common focal length, without the evidence of shapes.

    Raises
    ------
    numpy.linalg.LinAlgError
        Where no place of a kind has cameras.
    """
    sd = max(kind.sds[0] for kind in kinds)
    reach = (FAR_REACH if sd < GIVEN else REACH) * sd
    commons = kinds[0].mean[0] + np.linspace(-reach, reach, PLACES)
    rigs: list[list[AdjustedRig]] = []
    for kind in kinds:
        before = rigs[0] if rigs else [pair.start]
        rigs.append((yield from _along(pair, kind, commons, before)))
    noise = min(float(each.noise.mean()) for walk in rigs for each in walk)
    worth = _worth(pair, rigs[0], noise)
    places = [[placed_at(pair, each, noise, worth) for each in walk] for walk in rigs]
    worth /= max(_unevenness(each) for each in places)
    walks = []
    for kind, walk in zip(kinds, rigs, strict=True):
        found = [placed_at(pair, each, noise, worth) for each in walk]
        walks.append(Walk(kind, (yield from _finer(pair, kind, found, noise, worth)), []))
    uneven = max(_unevenness(walk.places) for walk in walks)
    walks = [
        walk._replace(
            places=[each._replace(geometry=each.geometry / uneven) for each in walk.places]
        )
        for walk in walks
    ]
    return Profile(walks, noise, worth / uneven)


def _along(
    pair: Pair, kind: Kind, commons: Float64, starts: list[AdjustedRig]
) -> Steps[list[AdjustedRig]]:
    """Adjust cameras at each place, outwards from the likeliest start, and then back.

    On the way back each place is also tried from its outer neighbour: there may be two optima.
    """
    found: dict[int, tuple[float, AdjustedRig]] = {}

    def attempt(place: int, near: AdjustedRig) -> None:
        try:
            tried = adjusted_at(pair, kind, commons[place], near)
        except np.linalg.LinAlgError:
            return
        cost = -placed_at(pair, tried, float(near.noise.mean()), 1.0).geometry
        cost += _off(kind, tried) ** 2 / 2
        if place not in found or cost < found[place][0]:
            found[place] = cost, tried

    for place, common in enumerate(commons):
        nearest = min(starts, key=lambda rig: abs(rig.rig.log_focals.mean() - common))
        yield
        attempt(place, nearest)
    for step in (1, -1):
        for place in range(len(commons))[::step]:
            if place - step in found:
                yield
                attempt(place, found[place - step][1])
    if not found:
        raise np.linalg.LinAlgError("no cameras at any focal length")
    return [found[place][1] for place in sorted(found)]


def _off(kind: Kind, adjusted: AdjustedRig) -> float:
    """Return how far the ratio is off the expected one, in standard deviations."""
    common, ratio = FROM_LOGS @ adjusted.rig.log_focals
    return float((ratio - kind.ratio_at(common)) / kind.sds[1])


def adjusted_at(
    pair: Pair, kind: Kind, common: float, near: AdjustedRig, ratio: float | None = None
) -> AdjustedRig:
    """Adjust cameras with a common log focal length, from others; `ratio` is held, too, if given.

    Raises
    ------
    numpy.linalg.LinAlgError
        Where they are not determined.
    """
    expected, sd = float(kind.ratio_at(np.array(common))), kind.sds[1]
    held = ratio is not None or sd < THIN
    start = FROM_LOGS @ near.rig.log_focals
    wanted = expected if ratio is None else ratio
    logs = TO_LOGS @ [common, wanted if held else start[1]]
    across = np.outer(TO_LOGS[:, 1], TO_LOGS[:, 1])
    beliefs = replace(
        pair.beliefs,
        focals=np.exp(TO_LOGS @ [common, wanted]),
        focal_covariance=np.zeros((2, 2)) if held else sd**2 * across + EXACT**2 * np.eye(2),
        alike=False,
    )
    rig = refocused(near.rig, near.points, logs)
    points = robust_points(rig, pair.seen, near.noise)
    return adjust_rig(rig, points, pair.seen, beliefs, iterations=ITERATIONS)


def _costs(pair: Pair, adjusted: AdjustedRig, noise: float) -> Float64:
    """Return minus the log likelihood (M,) of each point."""
    noises = np.full(2, noise)
    points = robust_points(adjusted.rig, pair.seen, noises, start=adjusted.points)
    return costs_of(adjusted.rig, points, pair.seen, noises)


def placed_at(pair: Pair, adjusted: AdjustedRig, noise: float, worth: float) -> Place:
    """Return a place; its points count for `worth` each."""
    rig = adjusted.rig
    held = replace(
        pair.beliefs,
        focals=np.exp(rig.log_focals),
        focal_covariance=np.zeros((2, 2)),
        alike=False,
    )
    log_likelihood = -worth * float(_costs(pair, adjusted, noise).sum()) - lens_cost(rig, held) / 2
    return Place(FROM_LOGS @ rig.log_focals, adjusted, log_likelihood, np.nan)


def _worth(pair: Pair, rigs: list[AdjustedRig], noise: float) -> float:
    """Return the share of independent points, as errors repeat within frames and keypoints.

    It is one over the factor by which differences between places scatter more (the design effect:
    Kish, *Survey Sampling*, 1965; clusters in two ways: Cameron, Gelbach and Miller, 2011).
    """
    costs = [_costs(pair, each, noise) for each in rigs]
    best = int(np.argmin([each.sum() for each in costs]))
    effects = []
    for place in {max(best - 1, 0), min(best + 1, len(costs) - 1)} - {best}:
        apart = costs[place] - costs[best]
        apart = apart - apart.mean()
        alone = np.square(apart).sum()
        together = sum(
            np.square(np.bincount(labels, apart)).sum() - alone for labels in pair.clusters
        )
        effects.append(max(1.0, 1.0 + together / max(alone, EXACT)))
    independent = pair.independent / float(np.mean(effects)) if effects else pair.independent
    unbiased = UNBIASED / (noise / pair.size) ** 2 / pair.seen.weights.sum()
    return min(independent, float(unbiased))


def _unevenness(places: list[Place]) -> float:
    """Return by how much the likelihood is to be divided, as it has valleys along the walk.

    With all else at its best it is smooth, and has one peak as a rule. Valleys of many nats show
    that adjusting ended in other optima, or that outliers decide.
    """
    logs = np.array([place.geometry for place in places])
    sides = np.minimum(np.maximum.accumulate(logs), np.maximum.accumulate(logs[::-1])[::-1])
    return 1.0 + float((sides - logs).max()) / VALLEY


def log_posterior(kind: Kind, place: Place) -> float:
    """Return the log density of a place by geometry and the prior, up to a constant."""
    common = (place.at[0] - kind.mean[0]) / kind.sds[0]
    return place.geometry - float(common**2 + _off(kind, place.cameras) ** 2) / 2


def _finer(
    pair: Pair, kind: Kind, places: list[Place], noise: float, worth: float
) -> Steps[list[Place]]:
    """Add places midway to the neighbours of the best, until these are about as good."""
    for _ in range(FINER):
        logs = [log_posterior(kind, place) for place in places]
        best = int(np.argmax(logs))
        middle, added = places[best], []
        for beside in (best - 1, best + 1):
            if 0 <= beside < len(places) and logs[best] - logs[beside] > CLOSE:
                common = float(middle.at[0] + places[beside].at[0]) / 2
                yield
                adjusted = adjusted_at(pair, kind, common, middle.cameras)
                added.append(placed_at(pair, adjusted, noise, worth))
        if not added:
            break
        places = sorted([*places, *added], key=lambda place: float(place.at[0]))
    return places
