"""What lifts and steps of a fit cost in this process, against the size of what they work on."""

import argparse
from collections.abc import Callable
from itertools import pairwise

import numpy as np

from benchmarks.captures import Capture, Float32, fitted, studio
from benchmarks.figures import Bar, take_turns
from models.lifting.fitted_prior import FittedPrior
from models.settings.config import FitConfig, Refine
from models.training.trainer import Trainer

VIEWS = (2, 4, 8, 16)
KEYPOINTS = (8, 16, 32, 64, 128)
DICTIONARIES = ((32, 8), (64, 16), (128, 32), (256, 64), (512, 128), (1024, 256))
FRAMES = 150  # of a capture: cameras are found in them, and a lift's cost is theirs
STEPS = 300  # of a fit: enough to find the cameras
BATCH = 256  # frames of a lift that is timed
FEW_STEPS = 8  # of a fit, timed together
TAKEN: dict[str, Refine] = {"lift, feed-forward": "off", "lift, refined": "auto"}
FIT = "step of a fit"
SHORT = FitConfig(steps=STEPS)
ROOM = 1.1  # times linear that still counts as linear: no two runs are alike

Costs = dict[str, dict[float, float]]  # microseconds by what was done and size


def measure_views(arguments: argparse.Namespace) -> tuple[Costs, list[Bar]]:
    """One fit to the most views lifts fewer; steps are those of fits to so many."""
    capture = studio(max(VIEWS), frames=FRAMES)
    prior = fitted(capture, SHORT)
    captures = {views: part(capture, views) for views in VIEWS}
    costs = time_all(dict.fromkeys(VIEWS, prior), captures, arguments.seconds)
    return costs, [linear(what, by_size, "views") for what, by_size in costs.items()]


def measure_keypoints(arguments: argparse.Namespace) -> tuple[Costs, list[Bar]]:
    """Fits to four views of so many keypoints."""
    captures = {count: studio(4, count, frames=FRAMES) for count in KEYPOINTS}
    priors = {count: fitted(capture, SHORT) for count, capture in captures.items()}
    costs = time_all(priors, captures, arguments.seconds)
    return costs, [linear(what, by_size, "keypoints") for what, by_size in costs.items()]


def measure_dictionary(arguments: argparse.Namespace) -> tuple[Costs, list[Bar]]:
    """Fits with dictionaries of so many entries; refinement has none to read."""
    capture = studio(4, frames=FRAMES)
    configs = {entries(sizes): FitConfig(dictionary_sizes=sizes, steps=1) for sizes in DICTIONARIES}
    priors = {count: fitted(capture, config) for count, config in configs.items()}
    captures = dict.fromkeys(configs, capture)
    costs = time_all(priors, captures, arguments.seconds, refines=["lift, feed-forward"])
    return costs, [linear(what, by_size, "dictionary") for what, by_size in costs.items()]


def time_all(
    priors: dict[int, FittedPrior],
    captures: dict[int, Capture],
    seconds: float,
    refines: list[str] | None = None,
) -> Costs:
    """Return microseconds per frame of lifts and of steps of a fit, for each size."""
    ways: dict[tuple[str, int], Callable[[], object]] = {}
    frames = {}
    for size, prior in priors.items():
        keypoints = np.resize(
            captures[size].keypoints, (BATCH, *captures[size].keypoints.shape[1:])
        )
        for what in TAKEN if refines is None else refines:
            ways[what, size] = lifting(prior, keypoints, TAKEN[what])
            frames[what, size] = BATCH
        ways[FIT, size] = stepping(captures[size], prior.config)
        frames[FIT, size] = FEW_STEPS * prior.config.batch_of(len(captures[size].keypoints))
    answer: Costs = {}
    for key, times in take_turns(ways, seconds).items():
        what, size = key
        answer.setdefault(what, {})[size] = 1e6 * float(np.median(times)) / frames[key]
    return answer


def lifting(prior: FittedPrior, keypoints: Float32, refine: Refine) -> Callable[[], object]:
    """Return what lifts the keypoints, as those of the fit's first views."""
    views = range(keypoints.shape[1])
    return lambda: prior.lift(keypoints, refine=refine, views=views)


def stepping(capture: Capture, config: FitConfig) -> Callable[[], object]:
    """Return what takes a few steps of a long fit, before it looks for cameras."""
    config = config.model_copy(update={"steps": 1_000_000})
    steps = Trainer(capture.keypoints, config).run()
    return lambda: [next(steps) for _ in range(FEW_STEPS)]


def part(capture: Capture, views: int) -> Capture:
    """Return the first views of a capture."""
    return Capture(capture.keypoints[:, :views], image_sizes=capture.image_sizes)


def entries(sizes: tuple[int, ...]) -> int:
    """Return how many numbers the dictionaries of a model of 17 keypoints hold."""
    inner = sum(outer * inner for outer, inner in pairwise(sizes))
    return 3 * 17 * sizes[0] + inner


def linear(what: str, by_size: dict[float, float], size: str) -> Bar:
    """Return the bar that a cost nowhere grows faster than its size does."""
    growth = max(
        (by_size[more] / by_size[less]) / (more / less) for less, more in pairwise(sorted(by_size))
    )
    return Bar(f"{what}: most growth of the cost / growth of {size}", ROOM, growth, "x")
