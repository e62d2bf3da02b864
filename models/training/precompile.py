"""Compiling ahead: what fits and lifts need, before anybody waits for it.

Compiling takes about a minute. Later processes read the machine code that this one left (see
`models.numerics.compiled`).
"""

import numpy as np

from models.capture.outliers import LEAST_FRAMES
from models.capture.synthetic import synthetic_capture
from models.network.priors.registry import PRIORS
from models.settings.config import Arrangement, FitConfig
from models.training.trainer import fit

STEPS = 30  # enough for every kind of teacher


def compile_all() -> None:
    """Fit every prior to a small capture, with and without perspective, and lift in every way."""
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
