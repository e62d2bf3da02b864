"""Fitting a prior to keypoints alone: minimise the reprojection error, resumably."""

import hashlib
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn

from models import checkpoints
from models.batches import Batches, Data
from models.checkpoints import Checkpoint
from models.config import FitConfig
from models.denoising import learn_views
from models.discovery import ImageSizes
from models.fitted import CurvePoint, FittedPrior
from models.losses import objective
from models.observations import Observations, as_observations
from models.prior import HierarchicalPrior
from models.schedule import Schedule
from models.teaching import Teaching

CURVE_ROWS = 200
RECENT = 0.05  # weight of the newest batch in the running means
STATE = {"step", "seconds", "loss", "error", "taught", "mirrored"}


@dataclass(frozen=True)
class Progress:
    """Where a fit stands after one optimiser step."""

    step: int
    steps: int
    loss: float  # running mean over recent batches
    reprojection_error: float  # pixels, running mean over recent batches
    seconds_left: float
    stage: Literal["training", "refining"] = "training"


class Trainer:
    """One fit, advanced step by step, that can be saved at any step and resumed bit for bit.

    Everything random is a function of the seed and the step, so a resumed fit ends in the very
    weights of an uninterrupted one (same data, same number of threads).
    """

    def __init__(
        self,
        keypoints: ArrayLike,
        config: FitConfig,
        *,
        confidence: ArrayLike | None = None,
        image_sizes: ImageSizes | None = None,
        checkpoint: bytes | None = None,
    ) -> None:
        """Prepare a fit of `keypoints` (N, K, P, 2) pixels, from a `checkpoint` if given.

        `image_sizes` are (width, height) in pixels, one per view, None where unknown.

        Raises
        ------
        ValueError
            When no frame has a usable view, the arrays are malformed (see `as_observations`), or
            `image_sizes` or the configuration's calibration do not have one entry per view.
        WeightsError
            When the checkpoint is damaged, or was made for other data or another configuration.
        """
        observations = as_observations(keypoints, confidence)
        frames = np.flatnonzero(observations.usable.any(1))
        if not frames.size:
            raise ValueError(
                "no frame has a usable view: a view needs at least 4 observed keypoints"
                " that do not all lie at one place"
            )
        views = observations.keypoints.shape[1]
        for name, given in (("image_sizes", image_sizes), ("calibration", config.calibration)):
            if given is not None and len(given) != views:
                raise ValueError(f"{name} must have one entry per view ({views}), got {len(given)}")
        self.config = config
        self.step = 0
        self.seconds = 0.0
        self._fingerprint = _fingerprint(observations, image_sizes)
        denoiser = learn_views(observations) if config.denoising else None
        if denoiser is not None:
            observations = denoiser.denoise(observations, range(views))
        self._data = Data.of(observations, frames)
        self._schedule = Schedule.of(config)
        self._batches = Batches(self._data, size=config.batch_size, seed=config.seed)
        self._network = HierarchicalPrior(observations.keypoints.shape[2], config.dictionary_sizes)
        self._network.initialise(config.seed)
        self._weights, self._gradient = _flatten(self._network)
        self._optimiser = torch.optim.Adam([self._weights], lr=config.learning_rate, fused=True)
        self._teaching = Teaching(self._network, self._data, config, image_sizes, denoiser)
        self._taught = -1  # the step at which there were last teachers
        self._loss = self._error = 0.0
        self._curve: list[CurvePoint] = []
        if checkpoint is not None:
            self._restore(checkpoint)

    def run(self) -> Iterator[Progress]:
        """Take the remaining steps, yielding after each; stop iterating to pause."""
        while self.step < self._schedule.steps:
            started = time.perf_counter()
            if self.step in self._schedule.refreshes and self._taught != self.step:
                for _ in self._teaching.refresh(self.step):
                    yield self._progress("refining")
                self._taught = self.step
            loss, error = self._advance()
            first = self.step == 0
            self._loss = _running(self._loss, loss, first=first)
            self._error = _running(self._error, error, first=first)
            self.step += 1
            every = math.ceil(self._schedule.steps / CURVE_ROWS)
            if self.step % every == 0 or self.step == self._schedule.steps:
                self._curve.append(CurvePoint(self.step, self._loss, self._error))
            self.seconds += time.perf_counter() - started
            yield self._progress("training")

    def _progress(self, stage: Literal["training", "refining"]) -> Progress:
        steps = self._schedule.steps
        left = self.seconds / max(self.step, 1) * (steps - self.step)
        return Progress(self.step, steps, self._loss, self._error, left, stage)

    def result(self) -> FittedPrior:
        """Return the prior as it stands, with handedness decided on the data of the fit."""
        return self._teaching.result(self.step, self._curve)

    def _advance(self) -> tuple[float, float]:
        """Take one optimiser step; the loss and the reprojection error in pixels."""
        found = self._teaching.found is not None
        batch = self._batches.draw(self.step, self._teaching.teachers, perspective=found)
        points, projected, _ = self._network.reproject(batch.keypoints, batch.weights)
        total, figures = objective(points, projected, batch)
        self._optimiser.param_groups[0]["lr"] = self._schedule.rate_at(self.step, found=found)
        self._gradient.zero_()
        torch.autograd.backward(total)
        self._optimiser.step()
        loss, error = figures.tolist()
        return loss, error

    def checkpoint(self) -> bytes:
        """Return everything needed to go on, as safetensors bytes."""
        # Before the first step Adam has no moments: they are zero.
        state = self._optimiser.state.get(self._weights, {})
        nothing = torch.zeros_like(self._weights)
        moments = state.get("exp_avg", nothing), state.get("exp_avg_sq", nothing.clone())
        return checkpoints.write(
            Checkpoint(
                weights=self._weights.detach(),
                moments=moments,
                state={
                    "step": self.step,
                    "seconds": self.seconds,
                    "loss": self._loss,
                    "error": self._error,
                    "taught": self._taught,
                    "mirrored": self._teaching.mirrored,
                },
                curve=self._curve,
                teachers=self._teaching.teachers,
                found=self._teaching.found,
            ),
            config=self.config.model_dump_json(),
            data=self._fingerprint,
        )

    def _restore(self, data: bytes) -> None:
        frames, views, keypoints, _ = self._data.keypoints.shape
        found = checkpoints.read(
            data,
            config=self.config.model_dump_json(),
            data=self._fingerprint,
            numbers=len(self._weights),
            state=STATE,
            shape=(frames, views, keypoints),
        )
        state = found.state
        self.step, self.seconds, self._taught = (
            int(state["step"]),
            state["seconds"],
            int(state["taught"]),
        )
        self._loss, self._error = state["loss"], state["error"]
        self._curve = found.curve
        self._teaching.teachers, self._teaching.found = found.teachers, found.found
        self._teaching.mirrored = state["mirrored"] > 0
        with torch.no_grad():
            self._weights.copy_(found.weights)
        if self.step:
            self._optimiser.state[self._weights] = {
                "step": torch.tensor(float(self.step)),
                "exp_avg": found.moments[0],
                "exp_avg_sq": found.moments[1],
            }


def fit(
    keypoints: ArrayLike,
    config: FitConfig | None = None,
    *,
    confidence: ArrayLike | None = None,
    image_sizes: ImageSizes | None = None,
    on_progress: Callable[[Progress], None] | None = None,
) -> FittedPrior:
    """Fit a prior to `keypoints` (N, K, P, 2) pixels; see `Trainer` for pauses and errors."""
    trainer = Trainer(
        keypoints, config or FitConfig(), confidence=confidence, image_sizes=image_sizes
    )
    for progress in trainer.run():
        if on_progress is not None:
            on_progress(progress)
    return trainer.result()


def _flatten(network: nn.Module) -> tuple[nn.Parameter, Tensor]:
    """Make all weights of a network, and their gradients, parts of one: one call updates them."""
    parameters = list(network.parameters())
    whole = nn.Parameter(torch.cat([part.detach().flatten() for part in parameters]))
    whole.grad = gradient = torch.zeros_like(whole)
    start = 0
    for part in parameters:
        place = slice(start, start + part.numel())
        part.data = whole.detach()[place].view_as(part)
        part.grad = gradient[place].view_as(part)
        start = place.stop
    return whole, gradient


def _running(mean: float, value: float, *, first: bool) -> float:
    return value if first else mean + RECENT * (value - mean)


def _fingerprint(observations: Observations, image_sizes: ImageSizes | None) -> str:
    digest = hashlib.sha256(repr(image_sizes and [s and tuple(s) for s in image_sizes]).encode())
    for array in (observations.keypoints, observations.weights):
        digest.update(str(array.shape).encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
