"""The keypoints that hypotheses are judged by: some frames to adjust cameras to, others to test."""

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from models.calibrating.keypoint_rig import lens_beliefs, straight_images
from models.calibrating.problem import CalibrationProblem
from models.causes.free_rig import (
    ASPECT,
    CENTRE,
    FOCAL,
    FreeFit,
    FreeRig,
    LensBeliefs,
    adjust,
    costs,
    distances,
    lens_deviations,
    located,
    settled,
)
from models.causes.pixel_map import evened
from models.epipolar.affine_rigs import affine_rigs
from models.epipolar.pairs import Beliefs
from models.epipolar.robust_points import robust_points
from models.epipolar.static_cameras import SeenPoints, StaticCameras, distances_of

Float64 = NDArray[np.float64]

FEW, MANY = 250, 1000  # points of either half of the frames
ITERATIONS, FIRST_ITERATIONS = 60, 10
WILD = 4.0  # times the median distance: larger ones count as this
LEAST_NOISE, LEAST_SHARE = 3e-4, 0.01  # sides, and of the subject's radius: what models leave
# Standard deviations of what a hypothesis frees: log fx / fy, principal point in sides.
FREE_ASPECT, FREE_CENTRE, FREE_FOCAL = 0.4, 0.4, 0.5


class Even(NamedTuple):
    """How x of a view becomes that of an image whose pixels are alike, about its middle."""

    mirrored: bool = False
    bend: float = 0.0  # as in `PixelMap`
    half: float = 1.0  # sides, half of the image's width

    def of(self, images: Float64) -> Float64:
        """Return images (2, M), in sides from the expected principal point."""
        x = images[0]
        if self.bend:
            x = self.half * evened(x / self.half, self.bend)
        return np.stack((-x if self.mirrored else x, images[1]))


AS_IT_IS = Even()


class Hypothesis(NamedTuple):
    """What is supposed of the pixels of K views."""

    beliefs: LensBeliefs
    evens: tuple[Even, ...]

    def freed(self, *views: int, aspect: float = FREE_ASPECT, centre: float = FREE_CENTRE) -> Self:
        """Return it with any shape of pixels and any principal point in views, within sds."""
        beliefs = self.beliefs
        for view in views:
            for number, sd in ((ASPECT, aspect), (CENTRE, centre), (CENTRE + 1, centre)):
                beliefs = beliefs.widened([view], number, sd) if sd else beliefs
            if not beliefs.covariances[FOCAL, view, view] > 0:
                beliefs = beliefs.widened([view], FOCAL, FREE_FOCAL)
        return self._replace(beliefs=beliefs)

    def moved(self, view: int, *, aspect: float = 0.0, centre: Float64, focal: float = 0.0) -> Self:
        """Return it with a lens of a view expected elsewhere."""
        beliefs = self.beliefs.moved(view, ASPECT, aspect).moved(view, FOCAL, focal)
        for axis in (0, 1):
            beliefs = beliefs.moved(view, CENTRE + axis, float(centre[axis]))
        return self._replace(beliefs=beliefs)

    def shown(self, view: int, even: Even) -> Self:
        """Return it with other pixels of a view."""
        return self._replace(evens=(*self.evens[:view], even, *self.evens[view + 1 :]))


class Trial(NamedTuple):
    """How well a hypothesis explains the keypoints."""

    hypothesis: Hypothesis
    fit: FreeFit
    cost: float  # nats, minus the log likelihood of all points and the log prior of the lenses
    each: Float64  # (M,) nats of each point


class Sightings(NamedTuple):
    """Points that K static views see, of two halves of the frames."""

    train: SeenPoints
    test: SeenPoints
    noise: float  # sides
    size: float  # sides, root-mean-square radius of the subject
    expected: Beliefs

    def usual(self) -> Hypothesis:
        """Return the hypothesis that nothing is wrong."""
        expected, views = self.expected, len(self.expected.focals)
        means = np.zeros((6, views))
        means[FOCAL] = np.log(expected.focals)
        centre, square = expected.centre_covariance, np.zeros((views, views))
        covariances = np.stack(
            (expected.focal_covariance, square, centre, centre, *expected.radial_covariance)
        )
        return Hypothesis(LensBeliefs(means, covariances, expected.alike), (AS_IT_IS,) * views)

    def tried(
        self, hypothesis: Hypothesis, starts: Sequence[FreeRig], *, iterations: int = ITERATIONS
    ) -> Trial:
        """Adjust cameras to one half of the frames, from the best of the starts; test the other."""
        train, test = (_even(seen, hypothesis.evens) for seen in (self.train, self.test))
        beliefs, fits = hypothesis.beliefs, []
        for start in starts:
            points = located(start, train, self.noise)
            short = iterations if len(starts) == 1 else FIRST_ITERATIONS
            fits.append(adjust(start, points, train, beliefs, self.noise, iterations=short))
        best = min(fits, key=lambda fit: fit.cost)
        if len(starts) > 1:
            best = adjust(best.rig, best.points, train, beliefs, self.noise, iterations=iterations)
        tested = settled(best.rig, test, self.noise)
        each = np.concatenate((costs(best.rig, best.points, train, self.noise), tested))
        return Trial(hypothesis, best, best.cost + float(tested.sum()), each)

    def starts(self, hypothesis: Hypothesis, near: Trial, views: Sequence[int]) -> list[FreeRig]:
        """Return starts for views whose lenses are supposed elsewhere than in a trial."""
        rig, points, expected = near.fit.rig, near.fit.points, hypothesis.beliefs.means
        seen = _even(self.train, hypothesis.evens)
        as_found = as_expected = rig
        for view in views:
            image = np.median(seen.images[view][:, seen.weights[view] > 0], 1)
            lens = expected[:, view].copy()
            as_expected = as_expected.refocused(view, lens, points, image)
            lens[FOCAL] = rig.lenses[view, FOCAL]
            as_found = as_found.refocused(view, lens, points, image)
        return [rig, as_found, as_expected]

    def mirror_starts(self, hypothesis: Hypothesis, known: FreeRig, view: int) -> list[FreeRig]:
        """Return starts for a view that was mirrored: from afar it looks from the other side."""
        train = _even(self.train, hypothesis.evens)
        points = located(known, self.train, self.noise)
        middle, turn = np.median(points, 1), np.diag([-1.0, 1.0, -1.0])
        held = known.rotations[view] @ middle + known.translations[view]
        lenses, rotations, translations = (array.copy() for array in known)
        rotations[view] = turn @ known.rotations[view]
        translations[view] = held * (-1, 1, 1) - rotations[view] @ middle
        lenses[view, CENTRE] *= -1
        behind = FreeRig(lenses, rotations, translations)
        usual = hypothesis.beliefs.means.T
        image = np.median(train.images[view][:, train.weights[view] > 0], 1)
        near = behind.refocused(view, usual[view], points, image)
        return [near, *(FreeRig.of(rig) for rig in affine_rigs(train, self.expected))]

    def noisy_as(self, trial: Trial) -> Self:
        """Return it with the noise that a trial leaves."""
        train = _even(self.train, trial.hypothesis.evens)
        left = distances(trial.fit.rig, trial.fit.points, train)
        return self._replace(noise=_noise(left, train.weights > 0, self.size))

    def deviations(self, trial: Trial) -> Float64:
        """Return standard deviations (K, 6) of the lenses of a trial."""
        train = _even(self.train, trial.hypothesis.evens)
        return lens_deviations(trial.fit, train, trial.hypothesis.beliefs, self.noise)


def sightings(
    problem: CalibrationProblem, rig: StaticCameras, noise: float, most: int
) -> Sightings:
    """Take points at random, those that many views see first; `rig` shows how noisy they are."""
    images, sizes = straight_images(problem, problem.detected)
    expected = lens_beliefs(problem)
    rng = np.random.default_rng(0)
    order = rng.permutation(len(images))
    half = (len(images) + 1) // 2
    train, test = (
        _points(images[part], problem.weights[part], rng, most)
        for part in (order[:half], order[half:])
    )
    points = robust_points(rig, train, np.full(len(sizes), noise))
    size = float(np.median(sizes))
    found = _noise(distances_of(rig, points, train), train.weights > 0, size)
    return Sightings(train, test, found, size, expected)


def _noise(distances: Float64, there: NDArray[np.bool_], size: float) -> float:
    """Return the standard deviation of a coordinate from the distances (K, M) of rays."""
    left = max(0.1, (2 * there.sum() - 3 * there.shape[1]) / (2 * there.sum()))
    seen = distances[there]
    seen = np.minimum(seen, WILD * np.median(seen))
    found = float(np.sqrt(np.square(seen).mean() / 2 / left))
    return max(found, min(LEAST_NOISE, LEAST_SHARE * size))


def _points(images: Float64, weights: Float64, rng: np.random.Generator, most: int) -> SeenPoints:
    frames, keypoints = np.nonzero((weights > 0).sum(1) > 1)
    order = rng.permutation(len(frames))
    seen = (weights > 0).sum(1)[frames, keypoints][order]
    order = order[np.argsort(-np.minimum(seen, 3), kind="stable")][:most]
    frames, keypoints = frames[order], keypoints[order]
    return SeenPoints(
        np.ascontiguousarray(images[frames, :, keypoints].transpose(1, 2, 0)),
        np.ascontiguousarray(weights[frames, :, keypoints].T),
    )


def _even(seen: SeenPoints, evens: tuple[Even, ...]) -> SeenPoints:
    if all(even == AS_IT_IS for even in evens):
        return seen
    shown = [even.of(images) for images, even in zip(seen.images, evens, strict=True)]
    return seen._replace(images=np.stack(shown))
