"""Groups of cameras with alike lenses: the kinds of lens that the keypoints favour."""

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from models.epipolar.rig_certainty import FocalLikelihood

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

# Figures: evidence/lenses.md.
DECISIVE = 5.0  # nats by which several kinds of lens must be more likely than one


def group_covariance(groups: Int64, together: float, alone: float) -> Float64:
    """Covariance (K, K) of numbers of lenses of several kinds.

    `together` is the standard deviation of the common part of a kind, `alone` that of each lens
    about it; `groups` (K,) are the kinds.
    """
    alike = groups[:, None] == groups
    covariance: Float64 = together**2 * alike + alone**2 * np.eye(len(groups))
    return covariance


def find_lens_groups(
    likelihood: FocalLikelihood, expected: Float64, together: float, alone: float
) -> Int64:
    """Return the kinds (K,) of lens that make the keypoints' focal lengths most likely.

    Every kind has its own focal length, whose log is expected at `expected` (K,) with a
    standard deviation of `together`; lenses of a kind differ by `alone`. The marginal likelihood of
    such a prior has a closed form. Kinds are merged as long as that makes the keypoints more likely
    (agglomerative clustering). Lenses are of one kind unless several kinds are decisively better.
    """
    views = len(expected)
    one = np.zeros(views, np.int64)
    if views < 2:
        return one

    def evidence(groups: Int64) -> float:
        covariance = group_covariance(groups, together, alone)
        return log_evidence_of_kinds(likelihood, expected, covariance)

    groups = np.arange(views)
    best = evidence(groups)
    while groups.max() > 0:
        merged = [
            _merged(groups, first, second)
            for first, second in combinations(range(groups.max() + 1), 2)
        ]
        values = [evidence(each) for each in merged]
        if max(values) < best:
            break
        best = max(values)
        groups = merged[values.index(best)]
    return groups if best > evidence(one) + DECISIVE else one


def _merged(groups: Int64, first: int, second: int) -> Int64:
    """Merge two groups, and number the groups from 0."""
    joined = np.where(groups == second, first, groups)
    numbered: Int64 = np.unique(joined, return_inverse=True)[1]
    return numbered


def log_evidence_of_kinds(
    likelihood: FocalLikelihood, expected: Float64, covariance: Float64
) -> float:
    """Log marginal likelihood of focal lengths under a Gaussian prior, up to a constant."""
    pull = likelihood.vector - likelihood.information @ expected
    inner = np.eye(len(expected)) + covariance @ likelihood.information
    explained = pull @ np.linalg.solve(inner, covariance @ pull)
    return float(explained - np.linalg.slogdet(inner).logabsdet) / 2


def posterior_of_kinds(
    likelihood: FocalLikelihood, expected: Float64, covariance: Float64
) -> tuple[Float64, Float64]:
    """Return mean (K,) and covariance (K, K) of the log focal lengths under a Gaussian prior."""
    precision = np.linalg.inv(covariance)
    posterior = np.linalg.inv(likelihood.information + precision)
    return posterior @ (likelihood.vector + precision @ expected), posterior


def covariance_over_kinds(
    likelihood: FocalLikelihood, expected: Float64, covariances: list[Float64], about: Float64
) -> Float64:
    """Return the covariance (K, K) of the log focal lengths `about` (K,) some values.

    It spans the answers under several priors, each as likely as it makes the keypoints.
    """
    evidence, spreads = [], []
    for covariance in covariances:
        mean, posterior = posterior_of_kinds(likelihood, expected, covariance)
        spreads.append(posterior + np.outer(mean - about, mean - about))
        evidence.append(log_evidence_of_kinds(likelihood, expected, covariance))
    shares = np.exp(np.array(evidence) - max(evidence))
    return np.asarray(np.average(spreads, 0, shares), np.float64)
