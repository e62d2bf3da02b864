"""Frames in another state than most, from log likelihood ratios, in runs or scattered."""

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

ROUNDS = 4
MOST_RATIO = 50.0  # of one frame: no frame outweighs a run
LEAST_SWITCHING = 1e-4  # of frames: about one change of state in a long capture


def likely_frames(ratios: Float64) -> Bool:
    """Return which frames (N,) are more likely in the second of two states.

    `ratios` (N,) are log likelihoods of the second state less those of the first. The frames are
    a hidden Markov chain of two states, whose frequencies and rate of change are learnt (Baum &
    Welch). So neighbouring frames count much if states come in runs, and nothing if scattered.
    """
    bounded = np.clip(ratios, -MOST_RATIO, MOST_RATIO)
    share = float(np.clip((bounded > 0).mean(), 0.01, 0.99))
    switching = 2 * share * (1 - share)
    for _ in range(ROUNDS):
        posterior, pairs = _smooth(bounded, share, switching)
        share = float(np.clip(posterior.mean(), 1e-3, 1 - 1e-3))
        switching = float(np.clip(pairs, LEAST_SWITCHING, 2 * share * (1 - share)))
    return np.asarray(posterior > 0.5)


def _smooth(ratios: Float64, share: float, switching: float) -> tuple[Float64, float]:
    """Posterior (N,) of the second state, and how often the state is expected to change."""
    leave = np.array([switching / (2 * (1 - share)), switching / (2 * share)]).clip(0, 1)
    change = np.array([[1 - leave[0], leave[0]], [leave[1], 1 - leave[1]]])
    likelihoods = np.stack((np.exp(-ratios.clip(0)), np.exp(ratios.clip(None, 0))), 1)
    steps = change * likelihoods[:, None]  # (N, 2, 2) from the state before to that of a frame
    first = np.array([1 - share, share]) * likelihoods[0]
    forward = np.concatenate((first[None], first @ _products(steps[1:])))
    backward = np.ones_like(forward)
    backward[:-1] = _products(steps[:0:-1].mT)[::-1].mT.sum(-1)
    forward /= forward.sum(1, keepdims=True)
    posterior = forward * backward
    posterior /= posterior.sum(1, keepdims=True)
    joint = forward[:-1, :, None] * steps[1:] * backward[1:, None]  # (N - 1, 2, 2)
    joint /= joint.sum((1, 2), keepdims=True)
    changed = float((joint[:, 0, 1] + joint[:, 1, 0]).mean()) if len(ratios) > 1 else 0.0
    return posterior[:, 1], changed


def _products(matrices: Float64) -> Float64:
    """Products (M, 2, 2) of each of the matrices and all before it, up to positive factors.

    Hillis and Steele's parallel prefix: a few operations on whole arrays in place of a loop.
    """
    products, step = matrices.copy(), 1
    while step < len(products):
        products[step:] = products[:-step] @ products[step:]
        products /= products.max((1, 2), keepdims=True)
        step *= 2
    return products
