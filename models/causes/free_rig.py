"""Static cameras whose pixels need not be square, nor their principal points where expected.

As `models.epipolar.rig_adjustment`, for a few hundred points: Levenberg-Marquardt with the points
eliminated, Student's t by reweighting, residuals in pixels as they came, in sides of the image. An
aspect of its own and a prior with means of its own for each view express any hypothesis that is a
map of x and y alone.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.epipolar.rig_adjustment import ALIKE, without_points
from models.epipolar.robust_points import robust_points
from models.epipolar.static_cameras import BLIND, FREEDOM, NEAR, SeenPoints, StaticCameras
from models.numerics.rotations import rotations_from_vectors

Float64 = NDArray[np.float64]

# Numbers of a camera: log focal length, log fx / fy, principal point, radial coefficients, pose.
FOCAL, ASPECT, CENTRE, RADIAL, LENS, CAMERA = 0, 1, 2, 4, 6, 12
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e-10, 1e6
# Figures: evidence/causes.md.
CONVERGED = 0.05  # nats in a step
MOST_STEP = 0.3  # of the logarithms
POINT_STEPS = 6


class FreeRig(NamedTuple):
    """K static cameras, x = R X + t."""

    lenses: Float64  # (K, 6)
    rotations: Float64  # (K, 3, 3)
    translations: Float64  # (K, 3)

    @classmethod
    def of(cls, rig: StaticCameras) -> "FreeRig":
        """Take cameras with square pixels."""
        square = np.zeros((len(rig.log_focals), 1))
        lenses = np.concatenate((rig.log_focals[:, None], square, rig.centres, rig.radial), 1)
        return cls(lenses, rig.rotations, rig.translations)

    def refocused(self, view: int, lens: Float64, points: Float64, image: Float64) -> "FreeRig":
        """Return it with another lens (6,) of a view, which turns and moves to see as before.

        `points` (3, M) are at the `image` (2,) of their middle in that view, roughly.
        """
        before, middle = self.lenses[view], np.median(points, 1)
        rays = []
        for its in (before, lens):
            half = np.array((its[ASPECT], -its[ASPECT])) / 2
            flat = (image - its[CENTRE:RADIAL]) / np.exp(its[FOCAL] + half)
            rays.append(np.append(flat, 1.0) / np.linalg.norm(np.append(flat, 1.0)))
        axis = np.cross(*rays)
        sine = float(np.linalg.norm(axis))
        angle = np.arctan2(sine, float(rays[0] @ rays[1]))
        turn = rotations_from_vectors(axis / max(sine, 1e-12) * angle)
        held = self.rotations[view] @ middle + self.translations[view]
        lenses, rotations, translations = (array.copy() for array in self)
        lenses[view], rotations[view] = lens, turn @ self.rotations[view]
        further = np.exp(lens[FOCAL] - before[FOCAL])
        translations[view] = further * turn @ held - rotations[view] @ middle
        return FreeRig(lenses, rotations, translations)


class LensBeliefs(NamedTuple):
    """The prior of the lenses; numbers of variance 0 are held at their mean."""

    means: Float64  # (6, K)
    covariances: Float64  # (6, K, K)
    alike: bool = False  # whether focal lengths are often nearly the same

    def widened(self, views: list[int], number: int, sd: float) -> "LensBeliefs":
        """Return it with a number of some views free."""
        covariances = self.covariances.copy()
        covariances[number, views, views] += sd**2
        return self._replace(covariances=covariances)

    def moved(self, view: int, number: int, by: float) -> "LensBeliefs":
        """Return it with another mean of a number of a view."""
        means = self.means.copy()
        means[number, view] += by
        return self._replace(means=means)

    def precisions(self) -> Float64:
        """Return the inverse covariances (6, K, K), 0 for numbers that are held."""
        held = self.covariances.diagonal(axis1=1, axis2=2) == 0  # (6, K), apart from all others
        apart = held[..., None] * np.eye(held.shape[1])
        return np.asarray(np.linalg.inv(self.covariances + apart) - apart)

    def cost(self, lenses: Float64) -> float:
        """Return minus the log density of lenses (K, 6), with that of the mean as 0."""
        offsets = lenses.T - self.means
        cost = float(np.einsum("nk,nkl,nl->", offsets, self.precisions(), offsets)) / 2
        return cost + float(np.log1p(np.square(self.unlikeness(lenses))).sum())

    def unlikeness(self, lenses: Float64) -> Float64:
        """Return how far focal lengths (K,) are from the median; 0 if they need not be alike.

        In units of the scale of Cauchy's distribution, beside their means.
        """
        offsets = lenses[:, FOCAL] - self.means[FOCAL]
        return np.asarray((offsets - np.median(offsets)) / ALIKE * self.alike)


class FreeFit(NamedTuple):
    """An adjusted rig."""

    rig: FreeRig
    points: Float64  # (3, M)
    cost: float  # nats, with that of the lenses


def adjust(
    rig: FreeRig,
    points: Float64,
    seen: SeenPoints,
    beliefs: LensBeliefs,
    noise: float,
    *,
    iterations: int,
) -> FreeFit:
    """Adjust cameras and points (3, M) under a noise in sides."""
    held = ~_free(beliefs)[:, :LENS]
    rig = rig._replace(lenses=np.where(held, beliefs.means.T, rig.lenses))
    damping = FIRST_DAMPING
    cost = costs(rig, points, seen, noise).sum() + beliefs.cost(rig.lenses)
    for _ in range(iterations):
        tried_rig, tried = _step(rig, points, seen, beliefs, noise, damping)
        tried_cost = costs(tried_rig, tried, seen, noise).sum() + beliefs.cost(tried_rig.lenses)
        if tried_cost < cost:
            gained, rig, points, cost = cost - tried_cost, tried_rig, tried, tried_cost
            damping = max(damping / 10, LEAST_DAMPING)
            if gained < CONVERGED:
                break
        else:
            damping *= 8
            if damping > MOST_DAMPING:
                break
    return FreeFit(rig, points, float(cost))


class _Equations(NamedTuple):
    matrix: Float64  # (12 K, 12 K) the points eliminated
    vector: Float64  # (12 K,)
    spread: Float64  # (12 K, 3 M)
    solved: Float64  # (3, M)


def _equations(
    rig: FreeRig,
    points: Float64,
    seen: SeenPoints,
    beliefs: LensBeliefs,
    noise: float,
    damping: float,
) -> _Equations:
    views, size = len(rig.lenses), len(rig.lenses) * CAMERA
    residuals, by_camera, by_point = _linearised(rig, points, seen, noise)
    solved, scores, cross, spread = without_points(residuals, by_camera, by_point, damping)
    vector = scores.sum(1)
    matrix = np.zeros((views, CAMERA, views, CAMERA))
    rows = by_camera.transpose(0, 2, 1, 3).reshape(views, CAMERA, -1)
    matrix[range(views), :, range(views), :] = rows @ rows.mT
    precisions = beliefs.precisions()
    for number in range(LENS):
        matrix[:, number, :, number] += precisions[number]
    offsets = rig.lenses.T - beliefs.means
    pulls = vector.reshape(views, CAMERA)
    pulls[:, :LENS] -= (precisions @ offsets[..., None])[..., 0].T
    if beliefs.alike:
        weights = 2 / (1 + np.square(beliefs.unlikeness(rig.lenses))) / ALIKE**2
        centring = np.eye(views) - weights / weights.sum()
        together = centring.T @ np.diag(weights) @ centring
        matrix[:, FOCAL, :, FOCAL] += together
        pulls[:, FOCAL] -= together @ offsets[FOCAL]
    return _Equations(matrix.reshape(size, size) - spread @ cross.T, vector, spread, solved)


def _free(beliefs: LensBeliefs) -> NDArray[np.bool_]:
    """Return which numbers (K, 12) may change; the first camera's pose is the frame."""
    variances = beliefs.covariances.diagonal(axis1=1, axis2=2).T
    free = np.ones((len(variances), CAMERA), bool)
    free[:, :LENS] = variances > 0
    free[0, LENS:] = False
    return free


def _step(
    rig: FreeRig,
    points: Float64,
    seen: SeenPoints,
    beliefs: LensBeliefs,
    noise: float,
    damping: float,
) -> tuple[FreeRig, Float64]:
    """Take one damped step."""
    matrix, vector, spread, solved = _equations(rig, points, seen, beliefs, noise, damping)
    free = _free(beliefs)
    places = np.flatnonzero(free)
    root = np.sqrt(matrix.diagonal()[places].clip(1e-12))
    held = matrix[np.ix_(places, places)] / root / root[:, None]
    held += (damping + 1e-12) * np.eye(len(places))
    step = np.zeros(free.size)
    step[places] = np.linalg.solve(held, vector[places] / root) / root
    moved = points + solved - (step @ spread).reshape(points.shape)
    return _moved(rig, step.reshape(free.shape)), moved


def _moved(rig: FreeRig, step: Float64) -> FreeRig:
    lenses = step[:, :LENS].copy()
    lenses[:, :CENTRE] = lenses[:, :CENTRE].clip(-MOST_STEP, MOST_STEP)
    return FreeRig(
        rig.lenses + lenses,
        rotations_from_vectors(step[:, LENS : LENS + 3]) @ rig.rotations,
        rig.translations + step[:, LENS + 3 :],
    )


def _points_alone(
    residuals: Float64, by_point: Float64, damping: Float64
) -> tuple[Float64, Float64]:
    """Return each point's own step (3, M) and inverse normal matrix (M, 3, 3)."""
    normal = np.einsum("kiam,kibm->mab", by_point, by_point)
    trace = np.trace(normal, axis1=1, axis2=2)
    diagonal = np.einsum("maa->ma", normal)
    diagonal *= (1 + damping)[:, None]
    diagonal += (1e-9 * trace + 1e-12)[:, None]
    inverse = np.linalg.inv(normal)
    toward = -np.einsum("kiam,kim->ma", by_point, residuals)
    return np.einsum("mab,mb->am", inverse, toward), inverse


class _Images(NamedTuple):
    images: Float64  # (K, 2, M)
    flat: Float64  # (K, 2, M)
    depths: Float64  # (K, M)
    turned: Float64  # (K, 3, M)
    gains: Float64  # (K, M)
    focals: Float64  # (K, 2)
    visible: NDArray[np.bool_]  # (K, M)


def _seen_by(rig: FreeRig, points: Float64) -> _Images:
    turned = rig.rotations @ points
    held = turned + rig.translations[..., None]
    typical = np.median(held[:, 2], axis=1)[:, None]
    visible = (held[:, 2] > NEAR * typical) & (typical > 0)
    depths = np.where(visible, held[:, 2], 1.0)
    flat = held[:, :2] / depths[:, None]
    squared = np.square(flat).sum(1)
    k1, k2 = rig.lenses[:, RADIAL, None], rig.lenses[:, RADIAL + 1, None]
    gains = 1 + squared * (k1 + squared * k2)
    half = rig.lenses[:, ASPECT] / 2
    focals = np.exp(rig.lenses[:, FOCAL, None] + np.stack((half, -half), 1))
    images = focals[..., None] * gains[:, None] * flat + rig.lenses[:, CENTRE:RADIAL, None]
    return _Images(images, flat, depths, turned, gains, focals, visible)


def costs(rig: FreeRig, points: Float64, seen: SeenPoints, noise: float) -> Float64:
    """Return minus the log likelihood (M,) of all rays of each point under Student's t."""
    squared = np.square(distances(rig, points, seen) / noise)
    robust = (FREEDOM + 2) / 2 * np.log1p(squared / FREEDOM)
    return np.asarray((seen.weights * robust).sum(0))


def distances(rig: FreeRig, points: Float64, seen: SeenPoints) -> Float64:
    """Return how far points (3, M) appear from where they were seen, (K, M) in sides."""
    shown = _seen_by(rig, points)
    found = np.linalg.norm(shown.images - seen.images, axis=1)
    return np.where(shown.visible, found.clip(max=BLIND), BLIND)


def _linearised(
    rig: FreeRig, points: Float64, seen: SeenPoints, noise: float
) -> tuple[Float64, Float64, Float64]:
    """Return weighted residuals (K, 2, M) and derivatives (K, 2, 12, M), (K, 2, 3, M)."""
    shown = _seen_by(rig, points)
    images, flat, depths, turned, gains, focals, visible = shown
    offsets = images - seen.images
    squared = np.square(offsets / noise).sum(1)
    weights = seen.weights * visible * (FREEDOM + 2) / (FREEDOM + squared)
    root = (np.sqrt(weights) / noise)[:, None]
    a, b = flat[:, 0], flat[:, 1]
    bend = a * a + b * b
    k1, k2 = rig.lenses[:, RADIAL, None], rig.lenses[:, RADIAL + 1, None]
    slope = 2 * k1 + 4 * k2 * bend
    by_held = np.empty((len(a), 2, 3, a.shape[1]))
    by_held[:, 0, 0], by_held[:, 0, 1] = gains + slope * a * a, slope * a * b
    by_held[:, 1, 0], by_held[:, 1, 1] = slope * a * b, gains + slope * b * b
    by_held[:, :, 2] = -(by_held[:, :, 0] * a[:, None] + by_held[:, :, 1] * b[:, None])
    by_held *= (root * focals[..., None] / depths[:, None])[:, :, None]
    along = root * focals[..., None] * flat  # (K, 2, M)
    by_camera = np.zeros((len(a), 2, CAMERA, a.shape[1]))
    by_camera[:, :, FOCAL] = gains[:, None] * along
    by_camera[:, 0, ASPECT] = by_camera[:, 0, FOCAL] / 2
    by_camera[:, 1, ASPECT] = -by_camera[:, 1, FOCAL] / 2
    by_camera[:, 0, CENTRE] = by_camera[:, 1, CENTRE + 1] = root[:, 0]
    by_camera[:, :, RADIAL] = bend[:, None] * along
    by_camera[:, :, RADIAL + 1] = np.square(bend)[:, None] * along
    x, y, z = (by_held[:, :, axis] for axis in range(3))
    t0, t1, t2 = (turned[:, axis][:, None] for axis in range(3))
    by_camera[:, :, LENS] = t1 * z - t2 * y
    by_camera[:, :, LENS + 1] = t2 * x - t0 * z
    by_camera[:, :, LENS + 2] = t0 * y - t1 * x
    by_camera[:, :, LENS + 3 :] = by_held
    by_point = np.einsum("kiam,kab->kibm", by_held, rig.rotations)
    return root * offsets, by_camera, by_point


def located(rig: FreeRig, seen: SeenPoints, noise: float) -> Float64:
    """Return points (3, M) from where cameras with square pixels see them."""
    half = np.exp(rig.lenses[:, ASPECT] / 2)
    lenses = rig.lenses
    centres = lenses[:, CENTRE:RADIAL]
    square = StaticCameras(
        lenses[:, FOCAL], centres, lenses[:, RADIAL:], rig.rotations, rig.translations
    )
    sides = np.stack((half, 1 / half), 1)[..., None]
    images = (seen.images - centres[..., None]) / sides + centres[..., None]
    return robust_points(square, seen._replace(images=images), np.full(len(lenses), noise))


def settled(rig: FreeRig, seen: SeenPoints, noise: float) -> Float64:
    """Return the costs (M,) of points that fixed cameras locate."""
    points = located(rig, seen, noise)
    known = costs(rig, points, seen, noise)
    damping = np.full(points.shape[1], 1e-3)
    for _ in range(POINT_STEPS):
        residuals, _, by_point = _linearised(rig, points, seen, noise)
        tried = points + _points_alone(residuals, by_point, damping)[0]
        tried_costs = costs(rig, tried, seen, noise)
        better = tried_costs < known
        points, known = np.where(better, tried, points), np.where(better, tried_costs, known)
        damping = np.where(better, damping / 10, damping * 10)
    return known


def lens_deviations(fit: FreeFit, seen: SeenPoints, beliefs: LensBeliefs, noise: float) -> Float64:
    """Return standard deviations (K, 6) of the lenses; 0 of numbers that are held."""
    equations = _equations(fit.rig, fit.points, seen, beliefs, noise, 0.0)
    free = _free(beliefs)
    places = np.flatnonzero(free)
    root = np.sqrt(equations.matrix.diagonal()[places].clip(1e-12))
    scaled = equations.matrix[np.ix_(places, places)] / root / root[:, None]
    values, vectors = np.linalg.eigh((scaled + scaled.T) / 2)
    variances = (np.square(vectors) / values.clip(1e-7 * values[-1])).sum(1) / root**2
    sds = np.zeros(free.size)
    sds[places] = np.sqrt(variances)
    return sds.reshape(free.shape)[:, :LENS]
