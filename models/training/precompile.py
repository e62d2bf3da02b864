"""Compiling ahead: what lifts and fits need, before anybody waits for it.

    python -m models.training.precompile

The first lift and the first fit compile for half a minute; later processes read what they left
(`models.numerics.compiled`).
"""

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
import torch

from models.bundle.adjustment import Rig
from models.bundle.shape_model import Doubts, ShapeModel
from models.calibrating.self_calibration import Discovery
from models.capture.synthetic import synthetic_capture
from models.lifting.fitted_prior import FittedPrior
from models.network.priors.registry import PRIORS, make_prior
from models.network.settling import SETTLE_ALL
from models.optics.lenses import COEFFICIENTS, Optics
from models.settings.config import FitConfig
from models.training.trainer import fit

VIEWS, KEYPOINTS = 2, 4


def compile_lifts() -> None:
    """Lift a frame of noise with priors of noise, each there is, in every way there is."""
    rng = np.random.default_rng(0)
    shapes = torch.from_numpy(rng.standard_normal((KEYPOINTS, 3)))
    nothing = torch.zeros(VIEWS, 10, dtype=torch.float64)
    optics = Optics(
        nothing[:, :2] + 1000,
        nothing[:, :2],
        nothing[:, :COEFFICIENTS],
        torch.zeros(VIEWS, dtype=torch.bool),
    )
    eye = torch.eye(3, dtype=torch.float64).repeat(VIEWS, 1, 1)
    found = Discovery(
        rig=Rig(optics, torch.zeros(VIEWS, dtype=torch.long), eye, nothing[:, :3]),
        deviations=nothing,
        shapes=ShapeModel(shapes, shapes[..., None], 1.0),
        doubts=Doubts(shapes[..., None], 1.0, torch.ones(1, dtype=torch.float64)),
        settling=SETTLE_ALL,
        noise=1.0,
        unit=1.0,
        errors=nothing[:, 0],
        reason="",
        warnings=(),
    )
    keypoints = rng.normal(0, 100, (1, VIEWS, KEYPOINTS, 2))
    for name in PRIORS:
        config = FitConfig(prior=name)
        network = make_prior(config, KEYPOINTS)
        network.initialise(0)
        weights = {name: value.detach() for name, value in network.named_parameters()}
        prior = FittedPrior(config, weights, (), 0.1, found)
        prior.lift(keypoints, previous=prior.lift(keypoints, refine="full"))


def compile_fits() -> None:
    """Take a few steps of a fit with gaps, through its teachers."""
    capture = synthetic_capture(frames=24, views=VIEWS, hidden_keypoints=0.05, seed=1)
    for refine in ("off", "auto"):
        config = FitConfig(dictionary_sizes=(16, 8), steps=30, batch_size=8, refine=refine)
        fit(capture.keypoints, config, confidence=capture.confidence)


if __name__ == "__main__":
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        for done in [pool.submit(compile_lifts), pool.submit(compile_fits)]:
            done.result()
