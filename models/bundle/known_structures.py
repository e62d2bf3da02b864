"""Known structures of a fit, and the shape prior from those most similar to a frame.

For a keypoint seen by fewer than two views, the network's answer with one covariance for all frames
is a weak prior. Captures repeat poses, and then the structures nearest to a frame are a better one:
their mean and their differences make a Gaussian prior of this frame alone. This is non-local Bayes
(Lebrun, Buades and Morel, *A Nonlocal Bayesian Image Denoising Algorithm*, 2013) with structures in
place of patches.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle.problem import ShapePrior
from models.numerics.compiled import inner
from models.numerics.matrices import cholesky, copy
from models.numerics.tensor_files import Arrays, Shapes, WeightsError, as_tensors

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

NEIGHBOURS = 10  # that make a prior where views hide keypoints
LEAST_STRUCTURES = 40  # with fewer, ten are no neighbours
WEIGHTS = np.array([0.01, 0.1, 1.0])  # of a keypoint seen by no view, by one, by more
ALONG_RAY = 0.25  # weight of a difference along the ray of a keypoint's only view
SPREAD = 1.0  # variance beside the neighbours' directions, in mean variances of their coordinates
LEAST_SPREAD = 1e-4  # standard deviation, radii of the structure


class KnownStructures(NamedTuple):
    """T structures in the frame of reference of a fit's shapes; there may be none."""

    points: Float64  # (T, P, 3) aligned to the mean of the shapes
    weights: Float64  # (T, P) of `WEIGHTS`
    believed: Float64  # (V,) 1 if they improve frames of one view, two, ... V or more; else 0

    def to_arrays(self) -> Arrays:
        """Return the structures as tensors, for a file."""
        return {name: value.float() for name, value in as_tensors(self._asdict()).items()}

    @classmethod
    def shapes(cls, keypoints: int) -> Shapes:
        """Shapes of what `to_arrays` returns, of so many keypoints; None stands for any length."""
        return {"points": (None, keypoints, 3), "weights": (None, keypoints), "believed": (None,)}

    @classmethod
    def from_arrays(cls, arrays: Arrays) -> "KnownStructures":
        """Read what `to_arrays` returned.

        Raises
        ------
        WeightsError
            When the tensors contradict each other.
        """
        points, weights, believed = (arrays[name].double().numpy().copy() for name in cls._fields)
        enough = len(points) == len(weights) >= LEAST_STRUCTURES and len(believed) > 0
        if (
            not enough
            or not np.isfinite(points).all()
            or not ((weights > 0) & (weights <= 1)).all()
        ):
            raise WeightsError("the file contradicts itself about the structures")
        return cls(points, weights, believed)


def no_structures(keypoints: int) -> KnownStructures:
    """Return an empty set of structures."""
    return KnownStructures(np.zeros((0, keypoints, 3)), np.zeros((0, keypoints)), np.zeros(1))


@inner
def prior_of_neighbours(
    known: KnownStructures, points: Float64, views: Int64, rays: Float64
) -> ShapePrior:
    """Return the shape prior from the known structures nearest to `points` (P, 3).

    Points are aligned to the mean of the shapes. `views` (P,) counts the views that show a
    keypoint; if it is one, `rays` (P, 3) is the unit vector of that view's ray.
    """
    count, size = len(points), NEIGHBOURS
    nearest = np.zeros(size, np.int64)
    _find_nearest(known, points, views, rays, nearest)
    mean, weight = np.zeros((count, 3)), np.zeros(count)
    for q in range(size):
        for p in range(count):
            w = known.weights[nearest[q], p]
            weight[p] += w
            for i in range(3):
                mean[p, i] += w * known.points[nearest[q], p, i]
    for p in range(count):
        for i in range(3):
            mean[p, i] /= weight[p]
    # The mean of so few has an error of its own: its share of their variance.
    basis, variance = np.empty((3 * count, size)), 0.0
    for q in range(size):
        for p in range(count):
            for i in range(3):
                offset = known.points[nearest[q], p, i] - mean[p, i]
                basis[3 * p + i, q] = offset * math.sqrt((1.0 + 1.0 / size) / size)
                variance += offset * offset / (3 * count * size)
    deviation = math.sqrt(SPREAD * variance + LEAST_SPREAD**2)
    inner_products, factor = np.empty((size, size)), np.empty((size, size))
    for q in range(size):
        for r in range(size):
            total = deviation**2 if q == r else 0.0
            for a in range(3 * count):
                total += basis[a, q] * basis[a, r]
            inner_products[q, r] = total
    copy(inner_products, factor)
    cholesky(factor)
    return ShapePrior(mean, basis, inner_products, factor, deviation, 1.0, False)


@inner
def _find_nearest(
    known: KnownStructures, points: Float64, views: Int64, rays: Float64, nearest: Int64
) -> None:
    """Write the structures that differ least from `points` where views measure, nearest first."""
    distances = np.full(len(nearest), np.inf)
    most = max(float((views > 0).sum()), WEIGHTS[0])  # the weight of all, as none is over 1
    for t in range(len(known.points)):
        squared, weight = 0.0, 0.0
        for p in range(len(points)):
            if views[p] == 0:
                continue
            w = known.weights[t, p]
            x = known.points[t, p, 0] - points[p, 0]
            y = known.points[t, p, 1] - points[p, 1]
            z = known.points[t, p, 2] - points[p, 2]
            off = x * x + y * y + z * z
            if views[p] == 1:
                along = x * rays[p, 0] + y * rays[p, 1] + z * rays[p, 2]
                off -= (1.0 - ALONG_RAY) * along * along
            squared += w * off
            weight += w
            if squared > most * distances[-1]:  # too far already
                break
        distance = squared / max(weight, WEIGHTS[0])
        place = len(nearest)
        while place > 0 and distance < distances[place - 1]:
            place -= 1
        for q in range(len(nearest) - 1, place, -1):
            distances[q], nearest[q] = distances[q - 1], nearest[q - 1]
        if place < len(nearest):
            distances[place], nearest[place] = distance, t
