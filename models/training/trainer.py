"""Fitting a prior to keypoints alone: minimise the reprojection error, resumably."""

import copy
import hashlib
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn

from models.calibrating.self_calibration import ImageSizes
from models.capture.denoising import learn_views
from models.capture.observations import Observations, as_observations
from models.lifting.curve import CurvePoint
from models.lifting.fitted_prior import FittedPrior
from models.network.losses import objective
from models.network.priors.prior import Prior
from models.network.priors.registry import make_prior
from models.settings.config import FitConfig
from models.settings.priors import ARCHITECTURE
from models.training import checkpoints
from models.training.adam import Adam
from models.training.batches import Batches, Data
from models.training.budget import EVERY, SEARCH, WARM, Clock, affordable, relaid
from models.training.checkpoints import Checkpoint, State
from models.training.holdout import Holdout, split
from models.training.schedule import Schedule
from models.training.teaching import Teaching

CURVE_ROWS = 200
RECENT = 0.05  # weight of the newest batch in the running means
PATIENCE, TOLERANCE = 0.1, 0.01  # share of the steps in which this share of the error must go
CHECKS = 100  # of the held-out frames in a fit
TAIL = 0.1  # share of the steps that the end takes of a fit that learns nothing more

StoppedBy = Literal["steps", "budget", "early"]


@dataclass(frozen=True)
class Progress:
    """Where a fit stands after one optimiser step."""

    step: int
    steps: int
    loss: float  # running mean over recent batches
    reprojection_error: float  # pixels, running mean over recent batches
    seconds_left: float
    stage: Literal["training", "refining"] = "training"
    stopped_by: StoppedBy | None = None  # what ended the fit; None while it goes on


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
        start: FittedPrior | None = None,
        checkpoint: bytes | None = None,
        device: str = "cpu",
    ) -> None:
        """Prepare a fit of `keypoints` (N, K, P, 2) pixels, from a `checkpoint` if given.

        `image_sizes` are (width, height) in pixels, one per view, None where unknown. `start` is a
        prior whose weights the fit begins with; `models.settings.config.warm` says what suits it.
        Training steps are taken on the `device`, everything else on the CPU.

        Raises
        ------
        ValueError
            When no frame has a usable view, the arrays are malformed (see `as_observations`),
            `image_sizes` or the configuration's calibration do not have one entry per view, or
            `start` has other keypoints, another prior, or other sizes of it.
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
        self._fingerprint = _fingerprint(observations, image_sizes)
        denoiser = learn_views(observations) if config.denoising else None
        if denoiser is not None:
            observations = denoiser.denoise(observations, range(views))
        self._holdout: Holdout | None = None
        if config.early_stopping:
            frames, held = split(frames, config.seed)
            self._holdout = Holdout(Data.of(observations, held), config.seed) if len(held) else None
        self._data = Data.of(observations, frames)
        self._batches = Batches(self._data, size=config.batch_size, seed=config.seed)
        self._network = make_prior(config, observations.keypoints.shape[2])
        self._network.initialise(config.seed)
        if start is not None:
            _begin_with(self._network, config, start)
        # The trained weights live on the device; all but the steps reads the CPU's.
        self._device = torch.device(device)
        self._trained = self._network
        if self._device.type != "cpu":
            self._trained = copy.deepcopy(self._network).to(self._device)
        weights, self._gradient = _flatten(self._trained)
        self._adam = Adam(weights)
        self._teaching = Teaching(self._network, self._data, config, image_sizes, denoiser)
        self._schedule = Schedule.of(config)
        self._clock = Clock()
        self._taught = 0  # how many refreshes of the teachers lie behind
        self._least = (math.inf, 0)  # error of the held-out frames, and its step
        self._hurries = False  # nothing more is learned
        self._loss = self._error = 0.0
        self._curve: list[CurvePoint] = []
        if checkpoint is not None:
            self._restore(checkpoint)

    @property
    def seconds(self) -> float:
        """The time that training has taken, over all attempts."""
        return self._clock.seconds

    @property
    def stopped_by(self) -> StoppedBy | None:
        """What ended the fit; None if it can go on."""
        if self.step < self._schedule.steps:
            return None
        if self._hurries:
            return "early"
        return "steps" if self.step >= self.config.steps else "budget"

    def run(self) -> Iterator[Progress]:
        """Take the remaining steps, yielding after each; stop iterating to pause."""
        self._clock.start()
        while self.step < self._schedule.steps:
            yield from self._refresh()
            if self.stopped_by is not None:
                break
            loss, error = self._advance()
            first = self.step == 0
            self._loss = _running(self._loss, loss, first=first)
            self._error = _running(self._error, error, first=first)
            self.step += 1
            self._look_ahead()
            self._clock.stepped(self.step)
            if self.step % math.ceil(self._schedule.steps / CURVE_ROWS) == 0 or self.stopped_by:
                self._curve.append(CurvePoint(self.step, self._loss, self._error))
            yield self._progress("training")
            self._clock.start()

    def _refresh(self) -> Iterator[Progress]:
        """Make the teachers that are due."""
        due = self._schedule.refreshes_by(self.step)
        if due <= self._taught:
            return
        budget, clock, teaching = self.config.budget_s or math.inf, self._clock, self._teaching
        searching = teaching.found is None and not teaching.given_up
        if searching or affordable(clock, budget):
            begun = clock.seconds
            limit = begun + (SEARCH if searching else 1) * (budget - begun)
            # A fit of few steps spends little on teachers.
            self._fetch()
            lesson = teaching.refresh(self.step, most=self._schedule.steps // 3)
            for _ in lesson:
                clock.tick()
                if clock.seconds > limit:
                    # Cameras that were not found in time never are.
                    teaching.given_up = teaching.found is None
                    break
                yield self._progress("refining")
                clock.start()
            clock.tick()
            if not searching:
                clock.lesson = clock.seconds - begun
        if not self._taught:
            self._least = (math.inf, self.step)  # foreshortening is known from here on
        self._taught = due
        self._plan()
        if self.stopped_by is not None:  # no time is left for another step
            self._curve.append(CurvePoint(self.step, self._loss, self._error))
            yield self._progress("refining")

    def _look_ahead(self) -> None:
        """Lay out the rest anew where time is short, or nothing more is learned."""
        if self.config.budget_s is not None and self.step % EVERY == 0:
            self._plan()
        if self._holdout is not None and self.step % math.ceil(self.config.steps / CHECKS) == 0:
            self._check(self._holdout)

    def _plan(self) -> None:
        if self.config.budget_s is not None and self.step > WARM:
            teaching = self._teaching
            self._schedule = relaid(
                self._schedule,
                self.step,
                self._clock,
                self.config.budget_s,
                cameras=not teaching.given_up and teaching.found is None,
                ending=teaching.doubting,
            )

    def _check(self, holdout: Holdout) -> None:
        """Go on to what comes next if the held-out frames gain nothing any more."""
        self._fetch()
        teachers = self._teaching.teachers
        error = holdout.error(self._network, 0.0 if teachers is None else teachers.foreshortening)
        if error < (1 - TOLERANCE) * self._least[0]:
            self._least = (error, self.step)
        elif self.step - self._least[1] >= PATIENCE * self.config.steps and not self._hurries:
            refreshes = self._schedule.refreshes
            if refreshes and not self._taught:
                self._schedule = self._schedule.advanced(self.step, refreshes[0])
            elif (tail := math.ceil(TAIL * self.config.steps)) < self._schedule.steps - self.step:
                self._schedule = self._schedule.shortened(self.step, tail)
                self._taught, self._hurries = len(refreshes), True

    def _progress(self, stage: Literal["training", "refining"]) -> Progress:
        steps, clock = self._schedule.steps, self._clock
        left = clock.seconds / max(self.step, 1) * (steps - self.step)
        if self.config.budget_s is not None:
            left = max(min(left, self.config.budget_s - clock.seconds), 0.0)
        return Progress(self.step, steps, self._loss, self._error, left, stage, self.stopped_by)

    def result(self) -> FittedPrior:
        """Return the prior as it stands, with handedness decided on the data of the fit."""
        self._fetch()
        return self._teaching.result(self.step, self._curve)

    def _fetch(self) -> None:
        """Bring the trained weights to the CPU."""
        if self._trained is not self._network:
            self._network.load_state_dict(self._trained.state_dict())

    def _advance(self) -> tuple[float, float]:
        """Take one optimiser step; the loss and the reprojection error in pixels."""
        found = self._teaching.found is not None
        batch = self._batches.draw(self.step, self._teaching.teachers, perspective=found)
        batch = batch.to(self._device)
        points, projected, _ = self._trained.reproject(batch.keypoints, batch.weights)
        total, figures = objective(points, projected, batch)
        self._gradient.zero_()
        torch.autograd.backward(total)
        rate = self._schedule.rate_at(self.step, found=found)
        self._adam.step(self._gradient, count=self.step + 1, rate=rate)
        loss, error = figures.tolist()
        return loss, error

    def checkpoint(self) -> bytes:
        """Return everything needed to go on, as safetensors bytes."""
        adam = self._adam
        schedule, clock, teaching = self._schedule, self._clock, self._teaching
        return checkpoints.write(
            Checkpoint(
                weights=adam.weights.cpu(),
                moments=(adam.mean.cpu(), adam.square.cpu()),
                state=State(
                    step=self.step,
                    loss=self._loss,
                    error=self._error,
                    steps=schedule.steps,
                    since=schedule.since,
                    done=schedule.done,
                    seconds=clock.seconds,
                    pace=clock.pace,
                    lesson=clock.lesson,
                    taught=self._taught,
                    mirrored=teaching.mirrored,
                    found_at=teaching.found_at,
                    given_up=teaching.given_up,
                    doubting=teaching.doubting,
                    least=self._least[0],
                    least_at=self._least[1],
                    hurries=self._hurries,
                ),
                curve=self._curve,
                teachers=teaching.teachers,
                found=teaching.found,
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
            numbers=len(self._adam.weights),
            shape=(frames, views, keypoints),
        )
        state, teaching = found.state, self._teaching
        self.step, self._loss, self._error = int(state.step), state.loss, state.error
        self._schedule = replace(
            self._schedule, steps=int(state.steps), since=int(state.since), done=state.done
        )
        self._clock = Clock(state.seconds, state.pace, state.lesson)
        self._taught, self._hurries = int(state.taught), state.hurries > 0
        self._least = (state.least, int(state.least_at))
        self._curve = found.curve
        teaching.teachers, teaching.found = found.teachers, found.found
        teaching.mirrored, teaching.given_up = state.mirrored > 0, state.given_up > 0
        teaching.found_at, teaching.doubting = int(state.found_at), state.doubting
        adam = self._adam
        adam.weights.copy_(found.weights)
        adam.mean.copy_(found.moments[0])
        adam.square.copy_(found.moments[1])


def fit(
    keypoints: ArrayLike,
    config: FitConfig | None = None,
    *,
    confidence: ArrayLike | None = None,
    image_sizes: ImageSizes | None = None,
    start: FittedPrior | None = None,
    device: str = "cpu",
    on_progress: Callable[[Progress], None] | None = None,
) -> FittedPrior:
    """Fit a prior to `keypoints` (N, K, P, 2) pixels; see `Trainer` for pauses and errors."""
    trainer = Trainer(
        keypoints,
        config or FitConfig(),
        confidence=confidence,
        image_sizes=image_sizes,
        start=start,
        device=device,
    )
    for progress in trainer.run():
        if on_progress is not None:
            on_progress(progress)
    return trainer.result()


def _begin_with(network: Prior, config: FitConfig, start: FittedPrior) -> None:
    """Copy the weights of a prior of the same architecture."""
    pairs = {name: (getattr(start.config, name), getattr(config, name)) for name in ARCHITECTURE}
    pairs["keypoints"] = (start.keypoints_per_frame, network.keypoints)
    for what, (has, needs) in pairs.items():
        if has != needs:
            raise ValueError(f"the prior to start from has {what} {has}, the fit {needs}")
    network.load_state_dict(start.weights)


def _flatten(network: nn.Module) -> tuple[Tensor, Tensor]:
    """Make all weights of a network, and their gradients, parts of one: one call updates them."""
    parameters = list(network.parameters())
    whole = torch.cat([part.detach().flatten() for part in parameters])
    gradient = torch.zeros_like(whole)
    start = 0
    for part in parameters:
        place = slice(start, start + part.numel())
        part.data = whole[place].view_as(part)
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
