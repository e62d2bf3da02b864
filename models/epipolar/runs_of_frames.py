"""Which frames are in another state than most: by log likelihood ratios, in runs or scattered."""

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
    a hidden Markov chain of two states; how often they occur and change is learnt (Baum & Welch).
    If states are scattered, the neighbours of a frame then say nothing, and in runs they say much.
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
    frames = len(ratios)
    forward, backward = np.empty((frames, 2)), np.ones((frames, 2))
    belief = np.array([1 - share, share])
    for n in range(frames):
        belief = (belief @ change if n else belief) * likelihoods[n]
        belief = forward[n] = belief / belief.sum()
    for n in range(frames - 2, -1, -1):
        later = change @ (likelihoods[n + 1] * backward[n + 1])
        backward[n] = later / later.sum()
    posterior = forward * backward
    posterior /= posterior.sum(1, keepdims=True)
    ahead = likelihoods[1:] * backward[1:]
    joint = forward[:-1, :, None] * change * ahead[:, None]
    joint /= joint.sum((1, 2), keepdims=True)
    changed = float((joint[:, 0, 1] + joint[:, 1, 0]).mean()) if frames > 1 else 0.0
    return posterior[:, 1], changed
