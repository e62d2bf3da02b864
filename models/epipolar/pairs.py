"""The relative pose and the focal lengths of two static views, from all of their keypoints.

Coordinates are pixels from the expected principal point, in sides of the image (`Sight`). Samples
of five correspondences under several focal lengths give hypotheses; the best distinct ones are
refined over pose and both focal lengths with Student's weights on Sampson distances.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.epipolar.essential import SAMPLE, decompose, five_point
from models.epipolar.fundamental import FREEDOM, sampson_distances
from models.numerics.medians import NORMAL
from models.numerics.rotations import rotations_from_vectors

Float64 = NDArray[np.float64]

LEAST_CORRESPONDENCES = 20
# Factors of the two expected focal lengths that are tried.
FOCAL_FACTORS = (
    (0.45, 0.45),
    (0.65, 0.65),
    (0.9, 0.9),
    (1.3, 1.3),
    (2.0, 2.0),
    (0.7, 1.4),
    (1.4, 0.7),
)
SAMPLES = 100  # for each of these
FIRST_SCORED, SCORED = 60, 250  # correspondences that judge all hypotheses, and then the likely
REFINED = 1000  # correspondences that refine one
STARTS = 8  # hypotheses that are refined
ITERATIONS = 12
DISTINCT = 0.2  # radians between rotations that count as two
SOLUTIONS = 3  # that are kept of a pair
STEP = 1e-5  # of finite differences
LEAST_SCALE = 1e-4  # sides: noise below which nothing is concluded


@dataclass(frozen=True)
class Beliefs:
    """The prior of K lenses, in sides of the image; given numbers have variance 0.

    Principal points are measured from the expected ones. Both coordinates have the same variance.
    """

    focals: Float64  # (K,)
    focal_covariance: Float64  # (K, K) of the log
    centre_covariance: Float64  # (K, K) of a coordinate of the principal points
    radial_covariance: Float64  # (2, K, K) of the first and the second radial coefficients
    alike: bool = True  # whether focal lengths are often nearly the same

    @property
    def focal_sds(self) -> Float64:
        """Standard deviations (K,) of the log focal lengths."""
        return np.sqrt(self.focal_covariance.diagonal())

    @cached_property
    def precisions(self) -> Float64:
        """Inverse covariances (5, K, K) of log focal length, principal point (x, y), radial (2)."""
        centres = _inverse(self.centre_covariance)
        bends = [_inverse(each) for each in self.radial_covariance]
        return np.stack((_inverse(self.focal_covariance), centres, centres, *bends))

    def of(self, views: list[int]) -> "Beliefs":
        """Return the prior of some of the views."""
        some = np.ix_(views, views)
        return Beliefs(
            self.focals[views],
            self.focal_covariance[some],
            self.centre_covariance[some],
            np.stack([each[some] for each in self.radial_covariance]),
            self.alike,
        )


def _inverse(covariance: Float64) -> Float64:
    """Invert a covariance (K, K), leaving out entries of variance 0."""
    inverse = np.zeros_like(covariance)
    varies = np.flatnonzero(covariance.diagonal() > 0)
    some = np.ix_(varies, varies)
    inverse[some] = np.linalg.inv(covariance[some])
    return inverse


class RelativePoses(NamedTuple):
    """Solutions for a pair of views, the best first: y ~ R x + t with t of length 1."""

    rotations: Float64  # (S, 3, 3)
    translations: Float64  # (S, 3)
    focals: Float64  # (S, 2) sides
    costs: Float64  # (S,) mean robust cost of the Sampson distances under one noise
    noise: float  # sides, robust standard deviation of the best one's

    @property
    def fundamental(self) -> Float64:
        """The fundamental matrix (3, 3) of the best solution, for correspondences in sides."""
        essentials = essential_of(self.rotations[:1], self.translations[:1])
        return np.asarray(_in_sides(essentials, np.log(self.focals[:1]))[0])


def relate(
    x: Float64, y: Float64, focals: Float64, sds: Float64, rng: np.random.Generator
) -> RelativePoses | None:
    """Find the relative poses of two views, from correspondences x, y (M, 2) in sides.

    `focals` (2,) and `sds` (2,) of their logs are expected. None for too few correspondences.
    """
    if len(x) < LEAST_CORRESPONDENCES:
        return None
    some = rng.permutation(len(x))
    judges, refiners = some[:SCORED], some[:REFINED]
    parameters = _hypotheses(x, y, focals, sds, judges, rng)
    if not len(parameters):
        return None
    parameters, costs, noise = _refine(parameters, x[refiners], y[refiners], focals, sds)
    rotations, translations = _poses(parameters)
    kept: list[int] = []
    for h in np.argsort(costs, kind="stable"):
        if all(_angle(rotations[h] @ rotations[o].T) > DISTINCT for o in kept):
            kept.append(int(h))
    kept = kept[:SOLUTIONS]
    return RelativePoses(
        rotations[kept],
        translations[kept],
        np.exp(parameters[kept, 12:]),
        costs[kept],
        noise,
    )


def essential_of(rotations: Float64, translations: Float64) -> Float64:
    """Return [t]x R (H, 3, 3)."""
    return np.cross(translations[:, None], rotations.mT).mT


def _hypotheses(
    x: Float64,
    y: Float64,
    focals: Float64,
    sds: Float64,
    judges: NDArray[np.int64],
    rng: np.random.Generator,
) -> Float64:
    """Return the parameters (H, 14) of the best distinct hypotheses."""
    matrices, logs = [], []
    factors = {(1.0 if sds[0] == 0 else a, 1.0 if sds[1] == 0 else b) for a, b in FOCAL_FACTORS}
    samples = SAMPLES * len(FOCAL_FACTORS) // len(factors)
    for pair in sorted(factors):
        f, g = focals * pair
        drawn = rng.integers(len(x), size=(samples, SAMPLE))
        found = five_point(x[drawn] / f, y[drawn] / g).matrices
        matrices.append(found)
        logs.append(np.tile(np.log((f, g)), (len(found), 1)))
    essentials, log_focals = np.concatenate(matrices), np.concatenate(logs)
    fundamental = _in_sides(essentials, log_focals)
    best = np.arange(len(fundamental))
    for count, most in ((FIRST_SCORED, 50 * STARTS), (SCORED, 10 * STARTS)):
        some = judges[:count]
        costs = _robust_costs(fundamental[best], x[some], y[some])
        best = best[np.argsort(costs, kind="stable")[:most]]
    parameters = _in_front(essentials[best], log_focals[best], x[judges], y[judges])
    rotations = parameters[:, :9].reshape(-1, 3, 3)
    kept: list[int] = []
    for h in range(len(parameters)):
        if len(kept) < STARTS and all(
            _angle(rotations[h] @ rotations[o].T) > DISTINCT / 2
            or np.abs(log_focals[best[h]] - log_focals[best[o]]).max() > 0.5
            for o in kept
        ):
            kept.append(h)
    return parameters[kept]


def _robust_costs(fundamental: Float64, x: Float64, y: Float64) -> Float64:
    """Return robust costs (H,) of hypotheses (H, 3, 3), under the noise of the best of them."""
    distances = np.abs(sampson_distances(fundamental, x, y))
    scale = max(NORMAL * float(np.median(distances, 1).min()), LEAST_SCALE)
    return np.asarray(np.log1p(np.square(distances / scale) / FREEDOM).mean(1))


def _in_sides(essentials: Float64, log_focals: Float64) -> Float64:
    """Return K_2^-T E K_1^-1 (H, 3, 3)."""
    scale = np.exp(-log_focals)
    first = np.stack((scale[:, 0], scale[:, 0], np.ones(len(scale))), -1)
    second = np.stack((scale[:, 1], scale[:, 1], np.ones(len(scale))), -1)
    matrices: Float64 = second[:, :, None] * essentials * first[:, None]
    return matrices


def _in_front(essentials: Float64, log_focals: Float64, x: Float64, y: Float64) -> Float64:
    """Return (R, t, log focals) flat, (H, 14), with most points before both cameras."""
    rotations, translations = decompose(essentials)  # (H, 4, ...)
    ones = np.ones((len(log_focals), len(x), 1))
    first = np.concatenate((x / np.exp(log_focals[:, None, :1]), ones), -1)  # (H, M, 3)
    second = np.concatenate((y / np.exp(log_focals[:, None, 1:]), ones), -1)
    turned = first[:, None] @ rotations.mT  # (H, 4, M, 3)
    # Depths a, b of b y = a R x + t: crossed with y and with R x.
    across = np.cross(turned, second[:, None])
    squared = np.square(across).sum(-1).clip(1e-18)
    shift = translations[:, :, None]
    near = -(np.cross(shift, second[:, None]) * across).sum(-1) / squared
    far = -(np.cross(shift, turned) * across).sum(-1) / squared
    chosen = ((near > 0) & (far > 0)).mean(-1).argmax(1)
    rows = np.arange(len(chosen))
    return np.concatenate(
        (
            rotations[rows, chosen].reshape(-1, 9),
            translations[rows, chosen],
            log_focals,
        ),
        1,
    )


def _refine(
    parameters: Float64, x: Float64, y: Float64, focals: Float64, sds: Float64
) -> tuple[Float64, Float64, float]:
    """Minimise robust Sampson distances over pose and focal lengths, all starts (H, 14) at once.

    Returns parameters, costs under one noise, and that noise.
    """
    free = np.concatenate((np.ones(5, bool), sds > 0))
    expected = np.log(focals)
    precision = np.where(sds > 0, 1 / np.where(sds > 0, sds, 1) ** 2, 0) / len(x)

    def distances_of(parameters: Float64) -> Float64:
        essentials = essential_of(*_poses(parameters))
        return sampson_distances(_in_sides(essentials, parameters[:, 12:]), x, y)

    def costs_of(distances: Float64, parameters: Float64, scale: float) -> Float64:
        prior = (precision * np.square(parameters[:, 12:] - expected)).sum(1)
        robust = (FREEDOM + 1) * np.log1p(np.square(distances / scale) / FREEDOM).mean(1)
        return np.asarray(robust + prior)

    distances = distances_of(parameters)
    damping = np.full(len(parameters), 1e-3)
    for _ in range(ITERATIONS):
        scale = max(NORMAL * float(np.median(np.abs(distances), 1).min()), LEAST_SCALE)
        costs = costs_of(distances, parameters, scale)
        weights = (FREEDOM + 1) / (FREEDOM + np.square(distances / scale)) / scale**2 / len(x)
        slopes = np.zeros((7, *distances.shape))
        for j in np.flatnonzero(free):
            step = np.zeros((len(parameters), 7))
            step[:, j] = STEP
            slopes[j] = (distances_of(_moved(parameters, step)) - distances) / STEP
        normal = np.einsum("ahm,hm,bhm->hab", slopes, weights, slopes, optimize=True)
        right = -np.einsum("ahm,hm->ha", slopes, weights * distances)
        normal[:, [5, 6], [5, 6]] += precision
        right[:, 5:] -= precision * (parameters[:, 12:] - expected)
        diagonal = normal[:, range(7), range(7)]
        normal[:, range(7), range(7)] += damping[:, None] * diagonal + 1e-12
        tried = _moved(
            parameters, np.linalg.solve(normal, right[..., None])[..., 0].clip(-0.3, 0.3)
        )
        tried_distances = distances_of(tried)
        better = costs_of(tried_distances, tried, scale) < costs
        parameters = np.where(better[:, None], tried, parameters)
        distances = np.where(better[:, None], tried_distances, distances)
        damping = np.where(better, damping / 5, damping * 10)
    noise = NORMAL * float(np.median(np.abs(distances), 1).min())
    return parameters, costs_of(distances, parameters, max(noise, LEAST_SCALE)), noise


def _poses(parameters: Float64) -> tuple[Float64, Float64]:
    return parameters[:, :9].reshape(-1, 3, 3), parameters[:, 9:12]


def _moved(parameters: Float64, step: Float64) -> Float64:
    """Apply steps (H, 7): rotation vector, two directions across t, log focals."""
    rotations, translations = _poses(parameters)
    rotations = rotations_from_vectors(step[:, :3]) @ rotations
    axis = np.eye(3)[np.abs(translations).argmin(1)]
    one = np.cross(translations, axis)
    one /= np.linalg.norm(one, axis=1, keepdims=True)
    other = np.cross(translations, one)
    moved = translations + step[:, 3:4] * one + step[:, 4:5] * other
    moved /= np.linalg.norm(moved, axis=1, keepdims=True)
    return np.concatenate((rotations.reshape(-1, 9), moved, parameters[:, 12:] + step[:, 5:]), 1)


def _angle(rotation: Float64) -> float:
    """Radians."""
    return float(np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1)))
