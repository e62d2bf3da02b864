"""Compiling the functions of fits and lifts ahead of their first use.

Compiling takes minutes. Later processes read the machine code that this one wrote (see
`models.numerics.compiled`).
"""

import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import pairwise, product

import numpy as np
from numpy.typing import NDArray

from models.bundle.problem import VIEW, make_rig
from models.bundle.shape_model import ShapeModel, unknown_network_errors
from models.calibrating.result import SelfCalibration
from models.capture.observations import as_observations
from models.capture.outliers import LEAST_FRAMES, OutlierJudge, learn_outliers
from models.capture.synthetic import EDGES, synthetic_capture
from models.lifting.fitted_prior import FittedPrior
from models.network.priors.registry import PRIORS, make_prior
from models.network.settling import SETTLE_ALL
from models.numerics.compiled import signatures
from models.numerics.threads import use_threads
from models.optics.lenses.projection import COEFFICIENTS, PINHOLE, Lenses
from models.settings.calibration import Camera, Intrinsics
from models.settings.config import Arrangement, FitConfig, Refine
from models.settings.priors import PriorName
from models.training.trainer import fit

PROCESSES = 2  # each takes half a gigabyte
STEPS = 30  # enough for every kind of teacher
POSES, FRAMES_BETWEEN = 12, 8  # of a film
REFINING: tuple[Refine, ...] = ("auto", "off")
NOISE, FOCAL, MIDDLE, DISTANCE = 15.0, 1000.0, 500.0, 4.0  # pixels, and metres
LEFT_AND_RIGHT = ((1, 4), (2, 5))  # keypoints of its figure


def compile_all(processes: int = PROCESSES) -> frozenset[str]:
    """Fit every prior to a small capture, with and without perspective, and lift in every way.

    One more capture is a noisy film from static cameras. It compiles the removal of noise, frame by
    frame and in time, and the search for swapped limbs.

    Parameters
    ----------
    processes
        How many processes share the work. They are forked: call this before torch computes anything
        here.

    Returns
    -------
    frozenset
        The functions that are compiled now, each with the types of its arguments.
    """
    fork = multiprocessing.get_context("fork")
    with ProcessPoolExecutor(processes, mp_context=fork) as pool:
        found = [pool.submit(_compile, number) for number in range(len(PARTS))]
        return frozenset[str]().union(*(future.result() for future in found))


def _compile(part: int) -> frozenset[str]:
    use_threads(1)
    PARTS[part]()
    return signatures()


def _fit_and_lift(prior: PriorName, refine: Refine) -> None:
    capture = synthetic_capture(frames=LEAST_FRAMES, views=2, hidden_keypoints=0.05, seed=1)
    # One search for static cameras is enough.
    cameras: Arrangement = "auto" if prior == next(iter(PRIORS)) else "moving"
    config = FitConfig(
        prior=prior, steps=STEPS, batch_size=8, refine=refine, cameras=cameras, synchronise="off"
    )
    times = np.arange(LEAST_FRAMES, dtype=np.float64)
    fitted = fit(capture.keypoints, config, confidence=capture.confidence, times=times)
    lift = fitted.lift(capture.keypoints)
    fitted.lift(capture.keypoints, previous=lift)


def _lift_untrained(name: PriorName) -> None:
    """Lift with an untrained prior: so one process compiles lifts while another compiles fits."""
    capture = synthetic_capture(frames=1, views=2, seed=1)
    views, keypoints = capture.keypoints.shape[1:3]
    config = FitConfig(prior=name)
    network = make_prior(config, keypoints)
    network.initialise(seed=0)
    lenses = Lenses(
        np.full((views, 2), FOCAL),
        np.full((views, 2), MIDDLE),
        np.zeros((views, COEFFICIENTS)),
        np.full(views, PINHOLE, np.int8),
    )
    cameras = SelfCalibration(
        make_rig(
            lenses,
            np.zeros(views, np.int64),
            np.tile(np.eye(3), (views, 1, 1)),
            np.zeros((views, 3)),
        ),
        deviations=np.zeros((views, VIEW)),
        shapes=ShapeModel(capture.points3d[0].astype(np.float64), np.zeros((keypoints, 3, 1)), 1.0),
        network_errors=unknown_network_errors(keypoints),
        settling=SETTLE_ALL,
        noise=1.0,
        unit=1.0,
        reprojection_errors=np.zeros(views),
        reason="",
    )
    weights = {name: value.detach() for name, value in network.named_parameters()}
    FittedPrior(config, weights, (), 1.0, cameras).lift(capture.keypoints, refine="full")


def _fit_film() -> None:
    noisy = static_noisy_film()
    lens = Camera(intrinsics=Intrinsics(fx=FOCAL))  # to look for it would take seconds
    config = FitConfig(
        steps=STEPS, batch_size=8, cameras="static", synchronise="off", calibration=(lens, lens)
    )
    fit(noisy, config, edges=np.array(EDGES), times=np.arange(len(noisy)) / 50).lift(noisy)


def _mend_limbs() -> None:
    noisy = static_noisy_film()
    seen = as_observations(noisy)
    outliers = learn_outliers(seen)
    if outliers is not None:
        swapping = outliers._replace(pairs=np.array(LEFT_AND_RIGHT, np.int64))
        OutlierJudge(swapping, range(noisy.shape[1])).put_right(seen)


# The parts that compile most come first; the others then find much of it compiled.
PARTS: tuple[Callable[[], None], ...] = (
    partial(_fit_and_lift, next(iter(PRIORS)), REFINING[0]),
    *(partial(_lift_untrained, prior) for prior in PRIORS),
    *(partial(_fit_and_lift, *ways) for ways in [*product(PRIORS, REFINING)][1:]),
    _fit_film,
    _mend_limbs,
)


def static_noisy_film() -> NDArray[np.float64]:
    """Return keypoints (N, 2, P, 2) of a figure filmed by two static cameras, with noise.

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
