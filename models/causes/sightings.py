"""The keypoints that hypotheses are judged by: some frames to adjust cameras to, others to test."""

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
    lens_deviations,
    located,
    settled,
)
from models.epipolar.affine_rigs import affine_rigs
from models.epipolar.pairs import Beliefs
from models.epipolar.robust_points import robust_points
from models.epipolar.static_cameras import SeenPoints, StaticCameras, distances_of

Float64 = NDArray[np.float64]

FEW, MANY = 250, 1000  # points of either half of the frames
ITERATIONS, COOLED_ITERATIONS = 12, 8
WARM, WARMEST = 20.0, 0.03  # times the noise, and of the subject's radius: where hypotheses begin
WILD = 4.0  # times the median distance: larger ones count as this
LEAST_NOISE, LEAST_SHARE = 3e-4, 0.005  # sides, and of the subject's radius: what models leave
# Standard deviations of what a hypothesis frees: log fx / fy, principal point in sides.
FREE_ASPECT, FREE_CENTRE, FREE_FOCAL = 0.4, 0.4, 0.5


class Hypothesis(NamedTuple):
    """What is supposed of the pixels of K views."""

    beliefs: LensBeliefs
    flips: tuple[bool, ...]  # which views are mirror images

    def freed(self, view: int, aspect: float = FREE_ASPECT, centre: float = FREE_CENTRE) -> Self:
        """Return it with any shape of pixels and any principal point in a view, within sds."""
        beliefs = self.beliefs
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

    def flipped(self, view: int) -> Self:
        """Return it with a view mirrored, or not any more."""
        flips = tuple(flip != (place == view) for place, flip in enumerate(self.flips))
        return self._replace(flips=flips)


class Trial(NamedTuple):
    """How well a hypothesis explains the keypoints."""

    hypothesis: Hypothesis
    fit: FreeFit
    train: float  # nats, minus the log likelihood of the frames that it was adjusted to
    test: float  # of the others
    lenses: float  # minus the log prior of its lenses

    @property
    def cost(self) -> float:
        """Nats against it, of the frames that it was not adjusted to."""
        return self.test + self.lenses

    @property
    def whole(self) -> float:
        """Nats against it, of all frames."""
        return self.train + self.test + self.lenses


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
        return Hypothesis(LensBeliefs(means, covariances, expected.alike), (False,) * views)

    def tried(
        self, hypothesis: Hypothesis, starts: list[FreeRig], *, view: int | None = None
    ) -> Trial:
        """Adjust cameras from all starts to one half; test the best on the other.

        With a `view`, its lens begins where it is supposed to be, with more noise at first.
        """
        train, test = (_flipped(seen, hypothesis.flips) for seen in (self.train, self.test))
        beliefs, fits = hypothesis.beliefs, []
        for start in starts:
            rig, points = start, located(start, train, self.noise)
            if view is not None:
                image = np.median(train.images[view][:, train.weights[view] > 0], 1)
                rig = rig.refocused(view, beliefs.means[:, view], points, image)
                points = located(rig, train, WARM * self.noise)
                warm = max(self.noise, min(WARM * self.noise, WARMEST * self.size))
                first = adjust(rig, points, train, beliefs, warm, iterations=COOLED_ITERATIONS)
                rig, points = first.rig, first.points
            fits.append(adjust(rig, points, train, beliefs, self.noise, iterations=ITERATIONS))
        best = min(fits, key=lambda fit: fit.cost)
        lenses = beliefs.cost(best.rig.lenses)
        tested = float(settled(best.rig, test, self.noise).sum())
        return Trial(hypothesis, best, best.cost - lenses, tested, lenses)

    def mirror_starts(self, hypothesis: Hypothesis, known: FreeRig, view: int) -> list[FreeRig]:
        """Return starts for a view that was mirrored: from afar it looks from the other side."""
        train = _flipped(self.train, hypothesis.flips)
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

    def deviations(self, trial: Trial) -> Float64:
        """Return standard deviations (K, 6) of the lenses of a trial."""
        train = _flipped(self.train, trial.hypothesis.flips)
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
    distances, there = distances_of(rig, points, train), train.weights > 0
    distances = np.minimum(distances[there], WILD * np.median(distances[there]))
    left = max(0.1, (2 * there.sum() - 3 * there.shape[1]) / (2 * there.sum()))
    found = float(np.sqrt(np.square(distances).mean() / 2 / left))
    least = min(LEAST_NOISE, LEAST_SHARE * float(np.median(sizes)))
    return Sightings(train, test, max(found, least), float(np.median(sizes)), expected)


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


def _flipped(seen: SeenPoints, flips: tuple[bool, ...]) -> SeenPoints:
    if not any(flips):
        return seen
    images = seen.images.copy()
    images[list(flips), 0] *= -1
    return seen._replace(images=images)


def roll(trial: Trial, view: int) -> float | None:
    """Return by how many degrees a view's image is turned clockwise beside the others'.

    From where the cameras have their upper side: None if they do not agree on it.
    """
    rotations = trial.fit.rig.rotations
    ups = -rotations[:, 1]  # (K, 3) in the common frame
    others = np.delete(ups, view, 0)
    mean = others.mean(0)
    if np.linalg.norm(mean) < AGREE:
        return None
    x, y, _ = rotations[view] @ mean / np.linalg.norm(mean)
    if np.hypot(x, y) < SEEN:
        return None
    return float(np.degrees(np.arctan2(x, -y)))


AGREE = 0.8  # length of the mean of unit vectors
SEEN = 0.6  # of a unit vector, in the image
