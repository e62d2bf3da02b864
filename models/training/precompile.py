"""Compiling ahead: what fits and lifts need, before anybody waits for it.

Compiling takes minutes. Later processes read the machine code that this one left (see
`models.numerics.compiled`).
"""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from models.capture.observations import as_observations
from models.capture.outliers import LEAST_FRAMES, OutlierJudge, learn_outliers
from models.capture.synthetic import EDGES, synthetic_capture
from models.network.priors.registry import PRIORS
from models.settings.config import Arrangement, FitConfig
from models.training.trainer import fit

STEPS = 30  # enough for every kind of teacher
POSES, FRAMES_BETWEEN = 12, 8  # of a film
NOISE, FOCAL, MIDDLE, DISTANCE = 15.0, 1000.0, 500.0, 4.0  # pixels, and metres
LEFT_AND_RIGHT = ((1, 4), (2, 5))  # keypoints of its figure


def compile_all() -> None:
    """Fit every prior to a small capture, with and without perspective, and lift in every way.

    One more capture is a noisy film, from cameras at rest: the noise is removed before anything
    else, frame by frame and in time, and limbs are looked for that a detector swapped.
    """
    capture = synthetic_capture(frames=LEAST_FRAMES, views=2, hidden_keypoints=0.05, seed=1)
    for number, name in enumerate(PRIORS):
        cameras: Arrangement = "moving" if number else "auto"  # one search for rest is enough
        for refine in ("auto", "off"):
            config = FitConfig(
                prior=name,
                steps=STEPS,
                batch_size=8,
                refine=refine,
                cameras=cameras,
                synchronise="off",
            )
            times = np.arange(LEAST_FRAMES, dtype=np.float64)
            prior = fit(capture.keypoints, config, confidence=capture.confidence, times=times)
            lift = prior.lift(capture.keypoints)
            prior.lift(capture.keypoints, previous=lift)
    noisy = noisy_film_at_rest()
    config = FitConfig(steps=STEPS, batch_size=8, cameras="static", synchronise="off")
    fit(noisy, config, edges=np.array(EDGES), times=np.arange(len(noisy)) / 50).lift(noisy)
    seen = as_observations(noisy)
    outliers = learn_outliers(seen)
    if outliers is not None:
        swapping = outliers._replace(pairs=np.array(LEFT_AND_RIGHT, np.int64))
        OutlierJudge(swapping, range(noisy.shape[1])).put_right(seen)


def noisy_film_at_rest() -> NDArray[np.float64]:
    """Return keypoints (N, 2, P, 2) of a figure that two cameras at rest film, with noise.

    It goes through some poses and back again.
    """
    poses = synthetic_capture(frames=POSES, views=1, seed=2).points3d.astype(np.float64)
    poses = np.concatenate((poses, poses[-2::-1])) - poses.mean((0, 1))
    share = np.linspace(0, 1, FRAMES_BETWEEN, endpoint=False)[:, None, None]  # of the way
    figure = np.concatenate([a + share * (b - a) for a, b in pairwise(poses)])
    aside = figure[..., [2, 1, 0]] * [1, 1, -1]  # as a camera sees it that stands at its side
    cameras = np.stack((figure, aside), axis=1) + np.array([0, 0, DISTANCE])
    pixels = FOCAL * cameras[..., :2] / cameras[..., 2:] + MIDDLE
    noise = np.random.default_rng(3).standard_normal(pixels.shape)
    return np.asarray(pixels + NOISE * noise, np.float64)
