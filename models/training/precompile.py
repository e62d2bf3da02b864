"""Compiling ahead: what fits and lifts need, before anybody waits for it.

Compiling takes about a minute. Later processes read the machine code that this one left (see
`models.numerics.compiled`).
"""

import numpy as np
from numpy.typing import NDArray

from models.capture.outliers import LEAST_FRAMES
from models.capture.synthetic import EDGES, synthetic_capture
from models.network.priors.registry import PRIORS
from models.settings.config import Arrangement, FitConfig
from models.training.trainer import fit

STEPS = 30  # enough for every kind of teacher
POSES, REPEATED = 12, 8  # that a subject comes back to, so that what is not its poses is noise
NOISE, FOCAL, MIDDLE, DISTANCE = 15.0, 1000.0, 500.0, 4.0  # pixels, and metres


def compile_all() -> None:
    """Fit every prior to a small capture, with and without perspective, and lift in every way.

    One more capture is noisy, from cameras at rest: the noise is removed before anything else.
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
    noisy = noisy_capture_at_rest()
    config = FitConfig(steps=STEPS, batch_size=8, cameras="static", synchronise="off")
    fit(noisy, config, edges=np.array(EDGES)).lift(noisy)


def noisy_capture_at_rest() -> NDArray[np.float64]:
    """Return keypoints (N, 2, P, 2) of a figure before two cameras at rest, with noise."""
    figure = synthetic_capture(frames=POSES, views=1, seed=2).points3d.astype(np.float64)
    figure = np.tile(figure - figure.mean((0, 1)), (REPEATED, 1, 1))
    aside = figure[..., [2, 1, 0]] * [1, 1, -1]  # as a camera sees it that stands at its side
    cameras = np.stack((figure, aside), axis=1) + np.array([0, 0, DISTANCE])
    pixels = FOCAL * cameras[..., :2] / cameras[..., 2:] + MIDDLE
    noise = np.random.default_rng(3).standard_normal(pixels.shape)
    return np.asarray(pixels + NOISE * noise, np.float64)
